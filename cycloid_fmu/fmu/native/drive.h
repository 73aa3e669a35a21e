/* The drive with its history, stepped like cycloid_fmu/fmu/model.py and compliant_model.py, on tables. */
#ifndef CYCLOID_DRIVE_H
#define CYCLOID_DRIVE_H

#include "table.h"

enum { MOST_ROWS = 64, LOSS_COLUMNS = 5, BLOB_HEAD = 48 };

/* What later steps and outputs depend on: doubles alone, so that it can be written down as it is. */
struct state {
    double time;
    double crank_angle, crank_speed, torque; /* torque: the input, the load on the inertia; else unused */
    double output_angle, output_speed;       /* of the kinematic interface the speed is found when asked for */
    double friction_torque, series_compliance, backlash_on, mesh_damping, largest_step, output_inertia;
    double settled, placed, deviation, load, side, pushed; /* kinematic: at the last step */
    double gear, loose; /* of a reducer: the gear's own deviation, and whether the plays around it leave it unloaded */
    double bristle, seen, dissipated_energy;               /* compliant */
    double loss[MOST_ROWS * LOSS_COLUMNS];
};

/* Contacts and series compliance pressed by a deviation: energy, its derivatives, and how the teeth stand. */
struct pressed {
    double energy, by_angle, by_rotation, stiffness, load, side;
};

struct drive {
    const struct table *table;
    double ratio;     /* of the flanges */
    double a, b, s;   /* of an RV reducer (reducer_model.py); b = 0 without its first stage */
    struct state state;
    int rows;         /* of the loss table */
    int initializing; /* outputs follow the inputs without a step */
    int placed;       /* whether `place` is that of the state; of no effect on results */
    struct place place;
    struct loaded at; /* what the contacts do there under `at_load`, where that is not 0 */
    double at_load;
    int solved; /* whether the following belong to the state; likewise */
    struct pressed pressed;
    double loss_torque, damping, strain;
};

/* Every function that can fail returns 0, or 1 with one sentence in `message` and everything left as it was. */
int drive_open(struct drive *drive, struct table *table, char message[MESSAGE_SIZE]);
void drive_reset(struct drive *drive);
int drive_start(struct drive *drive, char message[MESSAGE_SIZE]);
int drive_step(struct drive *drive, double time, double step, char message[MESSAGE_SIZE]);
int drive_get(struct drive *drive, const struct variable *variable, double *values, char message[MESSAGE_SIZE]);
int drive_set(struct drive *drive, const struct variable *variable, const double *values, char message[MESSAGE_SIZE]);

size_t drive_state_size(void);
void drive_state_write(const struct drive *drive, unsigned char *blob);
int drive_state_check(const struct drive *drive, const unsigned char *blob, size_t size, char message[MESSAGE_SIZE]);
void drive_state_read(struct drive *drive, const unsigned char *blob);

#endif
