/* A compensator of one drive: the motor angle for a desired angle of the drive's output.

   Angles are rad, speeds rad/s, torques N·m, temperatures K. A missing number is COMPENSATOR_NONE or NaN. No
   function allocates memory or has static variables, and the number of operations of a call is fixed. Only sums, products,
   quotients and square roots are used, which IEC 60559 rounds identically everywhere; compilers must not contract them
   (-ffp-contract=off, which the source sets itself) nor reorder them (no -ffast-math). */
#ifndef COMPENSATOR_H
#define COMPENSATOR_H

#ifdef __cplusplus
extern "C" {
#endif

#define COMPENSATOR_NONE 1e300

struct compensator; /* numbers of a drive: compensator_numbers.h */

/* Memory from step to step: one for each drive, initialised by compensator_start. */
struct compensator_memory {
    double index;                   /* crank angle of the model where the desired output angle is 0 */
    double probability;             /* that the index is right */
    double angle;                   /* desired output angle of the last step, or COMPENSATOR_NONE */
    double strains[5];              /* of the friction elements, rad */
    double output;                  /* last measured output angle, or COMPENSATOR_NONE */
    double settled;                 /* rotation of the output since the flank was last uncertain, rad */
    double applied[4];              /* offset (rad), further play (rad), gains of wind-up and of ripple, in the command */
    double learned[4];              /* the same as estimated from measurements and prior */
    double gain_variance;           /* of the last of them */
    double moments[10];             /* sums over measurements, which fade */
    double products[4];
    double count, residual_squares; /* number of measurements, and sum of squares of their residuals, rad² */
};

struct compensator_command {
    double motor_angle, motor_speed; /* rad, rad/s */
    double band;                     /* standard deviation of the output angle from the desired one, rad */
    double gain;                     /* of the part that depends on the crank angle, 0 to 2 */
    int holds;                       /* whether the model is valid */
};

/* index: crank angle of the model where the desired output angle is 0, or COMPENSATOR_NONE if unknown.
   probability: that it is right and the drive is this one, 0 to 1; ripple is compensated in this proportion at first. */
void compensator_start(const struct compensator *c, struct compensator_memory *memory, double index,
                       double probability);

/* load_torque: of the environment on the output, inertia included, counter-clockwise positive. motor_angle and output_angle:
   readings of the encoders now, or COMPENSATOR_NONE. */
struct compensator_command compensator_step(const struct compensator *c, struct compensator_memory *memory,
                                            double desired_angle, double desired_speed, double load_torque,
                                            double temperature, double motor_angle, double output_angle);

#ifdef __cplusplus
}
#endif

#endif
