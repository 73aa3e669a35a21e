/* An FMU's instance around a compensator, for fmi2.c and fmi3.c of cycloid_fmu/native/sources: what these two know of an
   instance has the same names here. Co-Simulation alone: calls of Model Exchange, event mode and derivatives are refused.
   Each communication step is one step of the compensator. */
#ifndef CYCLOID_INSTANCE_H
#define CYCLOID_INSTANCE_H

#include "calls.h"
#include "compensator.h"

enum { MESSAGE_SIZE = 512 };
enum { KIND_REAL, KIND_INTEGER, KIND_BOOLEAN };
enum { EVENT_INDICATORS, MOST_STATES }; /* none, and room for one */

/* In the order of cycloid_fmu/compensation/forms/fmu.py. */
enum {
    DESIRED_ANGLE, DESIRED_SPEED, LOAD_TORQUE, DRIVE_TEMPERATURE, MOTOR_MEASURED, OUTPUT_MEASURED, IS_MEASURED,
    INDEX, INDEX_PROBABILITY, MOTOR_ANGLE, MOTOR_SPEED, BAND, GAIN, HOLDS, TIME, VARIABLES
};

struct variable {
    int number, kind;
};

/* All that later steps and outputs depend on: numbers of 8 bytes alone, so that it can be written down as it is. */
struct kept {
    int64_t phase; /* an enum phase */
    double time, value[VARIABLES];
    struct compensator_memory memory;
};

struct instance {
    char *name;
    void (*log)(struct instance *instance, int status, const char *message);
    void *environment, *callback;
    void (*callback3)(void);
    int events;
    struct {
        struct kept state;
        int exchange, early, impact; /* never */
        double left;
    } drive;
};

size_t drive_state_size(void);
int exchange_states(const void *drive, int fields[MOST_STATES]);

#endif
