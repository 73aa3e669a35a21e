/* What FMI 2.0 and 3.0 share: an instance with its resources, its log and its phase. */
#ifndef CYCLOID_INSTANCE_H
#define CYCLOID_INSTANCE_H

#include "drive.h"

enum phase { INSTANTIATED, INITIALIZING, STEPPING, EVENT, CONTINUOUS, TERMINATED };

struct instance {
    char *name;
    char *path;                  /* of the table, with room for a draw's number behind it */
    struct table *table, *drawn; /* of the most likely drive, and of the draw that is taken, or NULL */
    struct drive drive;
    enum phase phase;
    /* Hands a message on; `status` is FMI's own number, the same in both versions. */
    void (*log)(struct instance *instance, int status, const char *message);
    void *environment, *callback; /* callback: FMI 2.0's callback functions */
    void (*callback3)(void);      /* FMI 3.0's logMessage */
    int warned; /* that the tables were left */
    int events; /* whether event mode is used: in Model Exchange, and where the host asked for it */
    char message[MESSAGE_SIZE];
};

enum { STATUS_OK, STATUS_WARNING, STATUS_DISCARD, STATUS_ERROR, STATUS_FATAL };

/* An instance, or NULL with a sentence in its message; the caller has set the log. */
int instance_open(struct instance *instance, const char *name, const char *token, const char *resources, int exchange);
void instance_close(struct instance *instance);
int instance_refuse(struct instance *instance, int status, const char *format, ...);

int instance_initialize(struct instance *instance, double start);
int instance_start(struct instance *instance);
int instance_step(struct instance *instance, double time, double step);
int instance_terminate(struct instance *instance);
int instance_enter(struct instance *instance, enum phase phase); /* from event mode or to it */
int instance_update(struct instance *instance);                  /* at an event */

/* Model Exchange. */
int instance_set_time(struct instance *instance, double time);
int instance_set_states(struct instance *instance, const double *values, size_t count);
int instance_states(struct instance *instance, double *values, size_t count);
int instance_nominals(struct instance *instance, double *values, size_t count);
int instance_rates(struct instance *instance, double *values, size_t count);
int instance_indicators(struct instance *instance, double *values, size_t count);
int instance_completed(struct instance *instance); /* a step of the host's solver */

/* Derivatives of unknowns in the direction of seeds at the knowns; `adjoint`: of knowns, seeds at the unknowns. */
int instance_derivatives(struct instance *instance, const uint32_t *unknowns, size_t count, const uint32_t *knowns,
                         size_t known_count, const double *seeds, double *found, int adjoint);
int instance_reset(struct instance *instance);

/* A variable of a kind, or NULL with a message. */
const struct variable *instance_variable(struct instance *instance, uint32_t reference, int kind);
int instance_get(struct instance *instance, const struct variable *variable, double *value);
int instance_set(struct instance *instance, const struct variable *variable, double value);

/* A state is a blob of `drive_state_size` bytes; one that is handed in is written over. */
int instance_state(struct instance *instance, void **state);
int instance_restore(struct instance *instance, const void *state);
int instance_state_free(void **state);
int instance_state_to_bytes(struct instance *instance, const void *state, unsigned char *bytes, size_t size);
int instance_state_from_bytes(struct instance *instance, const unsigned char *bytes, size_t size, void **state);

#endif
