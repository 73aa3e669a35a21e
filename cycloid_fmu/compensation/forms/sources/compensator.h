/* A compensator of one drive: the motor angle at which the drive's output stands where it should.

   Angles are rad, speeds rad/s, torques N·m, temperatures K. A number that is missing is COMPENSATOR_NONE or NaN. No
   function allocates memory, keeps anything of its own or runs longer for one input than the operations that it lists.
   Sums, products, quotients and square roots alone are used, which IEC 60559 rounds alike everywhere; compilers must not
   contract them (-ffp-contract=off, which the source asks for itself) nor reorder them (no -ffast-math). */
#ifndef COMPENSATOR_H
#define COMPENSATOR_H

#ifdef __cplusplus
extern "C" {
#endif

#define COMPENSATOR_NONE 1e300

/* What it remembers from step to step: one for each drive, begun by compensator_start. */
struct compensator_memory {
    double index;       /* crank angle of the model where the desired output angle is 0 */
    double probability; /* that it is right */
    double angle;       /* desired output angle of the last step, or COMPENSATOR_NONE */
    double strains[5];  /* of friction's elements, rad */
    double output;      /* last output angle that was measured, or COMPENSATOR_NONE */
    double settled;     /* way of the crank since the flank was not sure, rad */
    double applied[4];  /* offset (rad), further play (rad), gains of wind-up and of ripple, as the command has them */
    double learned[4];  /* the same as measurements have it, over what was known before */
    double sure;        /* variance of the last of them */
    double moments[10]; /* sums over measurements, which fade */
    double products[4];
    double count, left; /* measurements that count, and the sum of squares that they leave, rad² */
};

struct compensator_command {
    double motor_angle, motor_speed; /* rad, rad/s */
    double band;                     /* standard deviation of the output angle from the desired one, rad */
    double gain;                     /* of what the crank angle makes of the deviation, 0 to 2 */
    int holds;                       /* whether the model holds */
};

/* index: crank angle of the model where the desired output angle is 0, or COMPENSATOR_NONE where it is unknown.
   probability: that it is right and the drive is this one, 0 to 1; to this part ripple is compensated at first. */
void compensator_start(struct compensator_memory *memory, double index, double probability);

/* load_torque: of the environment on the output, inertia's too, counter-clockwise positive. motor_angle and output_angle:
   what the encoders show now, or COMPENSATOR_NONE. */
struct compensator_command compensator_step(struct compensator_memory *memory, double desired_angle,
                                            double desired_speed, double load_torque, double temperature,
                                            double motor_angle, double output_angle);

#ifdef __cplusplus
}
#endif

#endif
