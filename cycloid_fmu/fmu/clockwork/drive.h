/* The drive in time: its variables, history and steps, over contacts that are tables or the contact problem itself
   (contacts.h). The theory is in docs/theory/fmu.md. */
#ifndef CYCLOID_DRIVE_H
#define CYCLOID_DRIVE_H

#include "table_contacts.h"

enum { INPUT, OUTPUT }; /* flange_a and flange_b, in arrays over both */

/* Friction at a flange: `Law` of cycloid_fmu/fmu/friction.py. */
struct friction {
    double coulomb, load_share, stribeck, stribeck_speed, viscous, temperature_coefficient, reference_temperature,
        presliding_angle;
};

/* Everything that later steps and outputs depend on: only doubles, so that it can be stored as it is. */
struct state {
    double time;
    double crank_angle, crank_speed, torque; /* torque: the input, or that on the inertia; else unused */
    double output_angle, output_speed;       /* in the kinematic interface the speed is computed on request */
    double temperature, series_compliance, backlash_on, mesh_damping, largest_step, output_inertia;
    double settled, placed, transmission_error, load, side, pushed; /* kinematic: at the last step */
    double strain[2][FRICTION_ELEMENTS], crank_seen; /* friction: its strains; the crank angle that it has followed */
    double gear, loose; /* reducer: the gear's own transmission error, and whether it is unloaded within its plays */
    /* Not in the kinematic interface. */
    double seen, dissipated_energy; /* seen: output angle up to which friction has followed */
    /* With an inertia inside: angle of the crank, because the input may already be the next angle; and of the last step the
       mean torque, the dissipated energy, and whether a torque was beyond the tables. */
    double turned, mean_torque, mean_output, mean_loss, outside;
    /* Of the housing. All other angles and speeds are relative to it; those of the variables are absolute. */
    double support_angle, support_speed;
    /* Of the heat capacity, which is 0 without one, and of what it is given besides the losses. */
    double heat_capacity, thermal_resistance, ambient_temperature, heat_flow, temperature_start;
    double crank_torque, crank_inertia, crank_angle_start, crank_speed_start; /* of a crank with an inertia */
    /* With the arm in the host, whose inertia is `output_inertia`: the rate of `torque`, and how much less the motor's torque
       is per angle and per speed from the beginning of a step. */
    double torque_rate, motor_stiffness, motor_damping;
    /* Model Exchange: output angle, crank angle and strains at the end of the kinematic interface's last step. */
    double held, held_crank, held_strain[2][FRICTION_ELEMENTS];
    double event_mode; /* whether the instance is in it */
    double viscosity_40, viscosity_100, lubricant_temperature; /* of the loss table; 0 without a lubricant */
    struct friction friction[2];
    double loss[MOST_LOSS_ROWS * LOSS_COLUMNS];
};

/* The ends of the play, and the part of it that `backlash_on` = false removes on each side. */
struct play {
    double low, high, width, offset;
};

/* Torques at which friction slides towards negative and towards positive angles. */
struct yields {
    double low, high;
};

/* Friction over a displacement: mean torque, its derivative with respect to the end, dissipated energy. */
struct slid {
    double torque, slope, lost;
};

/* Friction at an angle: torque, dissipated power, stored energy. */
struct rubbing {
    double torque, power, stored;
};

struct drive {
    const struct table *table;
    struct contacts contacts;
    struct table_contacts tables; /* if these are the contacts */
    double ratio;     /* of the flanges */
    double a, b, s;   /* of an RV reducer (reducer.c); b = 0 without its first stage */
    struct state state;
    double rated;     /* torque */
    int rows;         /* of the loss table */
    const struct ripple *ripple; /* of the losses; NULL for none */
    int lossy, rubs[2]; /* whether there are losses, and friction at each flange */
    double element[2];  /* stiffness of each of its elements */
    int initializing; /* outputs follow the inputs without a step */
    int resting;      /* at rest under load, as the kinematic interface is, before an inertia moves */
    int exchange;     /* Model Exchange: the solver is the host's; an inertia's transmission error is a state */
    int early, impact; /* whether a step ends where contact begins, and whether the last one did */
    double remaining;       /* rest of the step after that, s */
    double step;       /* being made, s, for its message; 0 outside a step */
    int solved; /* whether the following belong to the state; likewise */
    struct pressed pressed;
    double damping;
};

/* Every function that can fail returns 0, or 1 with one sentence in `message` and nothing changed. */
void drive_open(struct drive *drive, struct table *table);
void drive_reset(struct drive *drive);
int drive_start(struct drive *drive, char message[MESSAGE_SIZE]);
int drive_step(struct drive *drive, double time, double step, char message[MESSAGE_SIZE]);
int drive_outside(const struct drive *drive); /* whether its torque is, or in the last step was, beyond the tables */
int drive_get(struct drive *drive, const struct variable *variable, double *value, char message[MESSAGE_SIZE]);
int drive_set(struct drive *drive, const struct variable *variable, double value, char message[MESSAGE_SIZE]);

size_t drive_state_size(void);
void drive_state_write(const struct drive *drive, unsigned char *blob);
void drive_state_seal(unsigned char *blob); /* with a checksum, for where it may be damaged */
int drive_state_check(const struct drive *drive, const unsigned char *blob, size_t size, int sealed,
                      char message[MESSAGE_SIZE]);
void drive_state_read(struct drive *drive, const unsigned char *blob);

/* Only for the drive's own files. */
int drive_refuse(char message[MESSAGE_SIZE], const char *format, double value, double limit);
int drive_kinematic(const struct drive *drive);
int drive_swings(const struct drive *drive);           /* whether an inertia inside moves in its steps */
double drive_angle(const struct drive *drive);         /* of the driven shaft */
double drive_crank_angle(const struct drive *drive);   /* of the cycloid stage's crank, at which its contacts are solved */
double *drive_stored(struct state *s, const struct variable *variable); /* or NULL if it is computed on request */
double drive_stiffness(struct drive *drive);           /* at the flange, the compliance in series included; 0 without contact */

int losses_check(const struct drive *drive, char message[MESSAGE_SIZE]);
int losses_take(const struct drive *drive); /* whether they take anything */
double losses_thinning(const struct drive *drive); /* factor of the speed at the present temperature */
double losses_torque(const struct drive *drive, double speed, double asked);
/* What is added to that torque at the present crank angle, for a torque of the teeth at flange_a and a direction of motion. */
double losses_ripple(const struct drive *drive, double reduced, double load, double direction);

int heat_stored(const struct drive *drive); /* whether the temperature is a state */
double heat_rate(const struct drive *drive, double power); /* of the temperature, K/s */
int heat_step(struct drive *drive, double power, double step, char message[MESSAGE_SIZE]);

void friction_settle(struct drive *drive);
double friction_viscous(const struct drive *drive, int flange);
struct yields friction_yields(const struct drive *drive, int flange, double load, double speed);
struct slid friction_slide(const double strain[FRICTION_ELEMENTS], double following[FRICTION_ELEMENTS], double way, double time,
                           double stiffness, struct yields yields);
struct slid friction_rub(const struct drive *drive, int flange, double way, double time, double load,
                         double following[FRICTION_ELEMENTS]);
/* Torque of the elements after a displacement, at any speed, and the stiffness of those that hold. */
double friction_held(const struct drive *drive, int flange, double way, double load, double speed,
                     double following[FRICTION_ELEMENTS], double *slope);
struct rubbing friction_press(const struct drive *drive, int flange, double way, double speed, double load, double time);
/* Strain rates of the elements for a solver that integrates them: a sliding element exceeds its yield strain by at most
   YIELDING_SHARE of the presliding angle. Returns the power that they store. */
double friction_flow(const struct drive *drive, int flange, double speed, double load, double rate[FRICTION_ELEMENTS]);
double friction_strained(const struct drive *drive, int flange); /* torque of the elements */

int teeth_outside(const struct drive *drive, double torque); /* whether the contacts' accuracy is not stated there */
int teeth_refuse(int status, double torque, char message[MESSAGE_SIZE]); /* 0 if the contacts are solved */
int teeth_play(const struct drive *drive, double crank_angle, struct play *play, char message[MESSAGE_SIZE]);
double teeth_width(const struct drive *drive, double crank_angle); /* of the play; NAN if it can't be found */
double teeth_offset_rate(const struct drive *drive, double crank_angle); /* derivative of `offset` by the crank angle */
/* Torque of the crank from the contacts: the energy's derivative at fixed output. */
double teeth_crank_torque(const struct drive *drive, double crank_angle, double torque);
double teeth_stiffness(const struct drive *drive, double crank_angle, double torque); /* in contact */
/* Torque of the teeth with the gear held at a transmission error, behind a compliance in series. */
int teeth_hold(const struct drive *drive, double crank_angle, double transmission_error, double series, double *torque,
               char message[MESSAGE_SIZE]);
int teeth_press(const struct drive *drive, double crank_angle, double transmission_error, struct pressed *pressed,
                char message[MESSAGE_SIZE]); /* of a reducer, at given angles of its flanges */
int teeth_press_gear(const struct drive *drive, double crank_angle, double transmission_error, double series,
                     struct pressed *pressed, char message[MESSAGE_SIZE]);

int kinematic_follow(struct drive *drive, char message[MESSAGE_SIZE]);
/* The gear's transmission error at a torque, without the play if it is off; at zero torque the given end of the play. */
int kinematic_gear(struct drive *drive, double torque, double end, double *transmission_error, char message[MESSAGE_SIZE]);
double kinematic_torque(const struct drive *drive);  /* of the teeth on the gear */
int kinematic_pressed(const struct drive *drive);    /* whether there is contact */
double kinematic_rate(const struct drive *drive);    /* of the gear's angle with the crank's */
double kinematic_crank_torque(struct drive *drive);
double kinematic_speed(struct drive *drive);
struct rubbing kinematic_rubbing(struct drive *drive, int flange, double torque);
double kinematic_power(struct drive *drive); /* dissipated */
double kinematic_yielding(struct drive *drive, double speed, double stiffness);

int reducer_elastic(struct drive *drive, double torque, double end, double *transmission_error, char message[MESSAGE_SIZE]);
int reducer_hold(struct drive *drive, double transmission_error, char message[MESSAGE_SIZE]);
/* Contacts and series compliance behind the first stage, at given angles of sun and output. */
int reducer_press(const struct drive *drive, double sun_angle, double transmission_error, struct pressed *pressed,
                  char message[MESSAGE_SIZE]);
double reducer_pressed_stiffness(const struct drive *drive);
double reducer_speed(struct drive *drive);
double reducer_stiffness(struct drive *drive);
double reducer_backlash(const struct drive *drive, double crank_angle, double gear);

int compliant_solve(struct drive *drive, char message[MESSAGE_SIZE]);
int compliant_move(struct drive *drive, double step, char message[MESSAGE_SIZE]);
int compliant_swing(struct drive *drive, double step, char message[MESSAGE_SIZE]);
double compliant_power(const struct drive *drive); /* of the contacts' damping */
double compliant_load(const struct drive *drive, int flange); /* torque of the teeth */
double compliant_way(const struct drive *drive, int flange);  /* that friction has not followed */
struct rubbing compliant_rubbing(const struct drive *drive, int flange);

enum { MOST_STATES = 6 + 2 * FRICTION_ELEMENTS };
int exchange_states(const struct drive *drive, int fields[MOST_STATES]);
int exchange_solve(struct drive *drive, char message[MESSAGE_SIZE]);
double exchange_rate(struct drive *drive, int field);
void exchange_indicators(struct drive *drive, double result[EVENT_INDICATORS]);
void exchange_keep(struct drive *drive);

/* A direction of inputs, parameters or states: the seeds are in the fields of their variables. */
struct direction {
    struct state along;
    double size; /* its largest seed, in steps of a difference */
    int parameters;
};

void derivative_begin(struct direction *direction);
int derivative_seed(const struct drive *drive, struct direction *direction, const struct variable *known, double seed,
                    char message[MESSAGE_SIZE]);
int derivative_of(struct drive *drive, const struct direction *direction, const struct variable *unknown, double *value,
                  char message[MESSAGE_SIZE]);

#endif
