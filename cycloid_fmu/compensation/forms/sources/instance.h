/* An FMU's instance around a compensator, for fmi2.c and fmi3.c of cycloid_fmu/native/sources: what these two know of an
   instance has the same names here. Co-Simulation alone; each communication step is one step of the compensator. */
#ifndef CYCLOID_INSTANCE_H
#define CYCLOID_INSTANCE_H

#include <stddef.h>
#include <stdint.h>

#include "compensator.h"

enum { MESSAGE_SIZE = 512 };
enum { KIND_REAL, KIND_INTEGER, KIND_BOOLEAN };
enum { STATUS_OK, STATUS_WARNING, STATUS_DISCARD, STATUS_ERROR, STATUS_FATAL };
enum { EVENT_INDICATORS, MOST_STATES }; /* none, and room for one */
enum phase { INSTANTIATED, INITIALIZING, STEPPING, EVENT, CONTINUOUS, TERMINATED };

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

int instance_open(struct instance *instance, const char *name, const char *token, const char *resources, int exchange);
void instance_close(struct instance *instance);
int instance_refuse(struct instance *instance, int status, const char *format, ...);

int instance_initialize(struct instance *instance, double start);
int instance_start(struct instance *instance);
int instance_step(struct instance *instance, double time, double step);
int instance_terminate(struct instance *instance);
int instance_reset(struct instance *instance);
const struct variable *instance_variable(struct instance *instance, uint32_t reference, int kind);
int instance_get(struct instance *instance, const struct variable *variable, double *value);
int instance_set(struct instance *instance, const struct variable *variable, double value);

size_t drive_state_size(void);
int instance_state(struct instance *instance, void **state);
int instance_restore(struct instance *instance, const void *state);
int instance_state_free(void **state);
int instance_state_to_bytes(struct instance *instance, const void *state, unsigned char *bytes, size_t size);
int instance_state_from_bytes(struct instance *instance, const unsigned char *bytes, size_t size, void **state);

int exchange_states(const void *drive, int fields[MOST_STATES]);

/* Refused all: of Model Exchange, event mode and derivatives. */
int instance_enter(struct instance *instance, enum phase phase);
int instance_update(struct instance *instance);
int instance_set_time(struct instance *instance, double time);
int instance_set_states(struct instance *instance, const double *values, size_t count);
int instance_states(struct instance *instance, double *values, size_t count);
int instance_nominals(struct instance *instance, double *values, size_t count);
int instance_rates(struct instance *instance, double *values, size_t count);
int instance_indicators(struct instance *instance, double *values, size_t count);
int instance_completed(struct instance *instance);
int instance_derivatives(struct instance *instance, const uint32_t *unknowns, size_t count, const uint32_t *knowns,
                         size_t known_count, const double *seeds, double *found, int adjoint);

#endif
