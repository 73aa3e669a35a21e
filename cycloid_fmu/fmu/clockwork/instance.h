/* An FMU's instance with its resources, log and phase, for fmi2.c and fmi3.c. Functions return a status. */
#ifndef CYCLOID_INSTANCE_H
#define CYCLOID_INSTANCE_H

#include "model.h"

enum phase { INSTANTIATED, INITIALIZING, STEPPING, EVENT, CONTINUOUS, TERMINATED };
enum { STATUS_OK, STATUS_WARNING, STATUS_DISCARD, STATUS_ERROR, STATUS_FATAL }; /* of FMI, the same in both versions */

struct instance {
    char *name;
    const struct model *model;
    void *self; /* of the model */
    const struct variable *variable;
    uint32_t variables;
    enum phase phase;
    void (*log)(struct instance *instance, int status, const char *message);
    void *environment, *callback; /* callback: FMI 2.0's callback functions */
    void (*callback3)(void);      /* FMI 3.0's logMessage */
    int warned; /* whether results had no stated accuracy */
    int events; /* whether event mode is used: in Model Exchange, and if the host requested it */
    char message[MESSAGE_SIZE];
};

/* Open the model whose file is in the resources; the caller has set the log. */
int instance_open(struct instance *instance, const char *name, const char *token, const char *resources, int exchange,
                  int early);
void instance_close(struct instance *instance);
int instance_refuse(struct instance *instance, int status, const char *format, ...);

int instance_initialize(struct instance *instance, double start);
int instance_start(struct instance *instance);
int instance_step(struct instance *instance, double time, double step);
int instance_terminate(struct instance *instance);
int instance_reset(struct instance *instance);
double *instance_time(struct instance *instance);
int instance_early(const struct instance *instance); /* whether the last step ended before its end */
int instance_event(const struct instance *instance); /* whether the host has to handle one after the last step */

/* Model Exchange, event mode and derivatives. */
int instance_exchanges(const struct instance *instance);
int instance_enter(struct instance *instance, enum phase phase); /* from event mode or to it */
int instance_update(struct instance *instance);                  /* at an event */
int instance_set_time(struct instance *instance, double time);
size_t instance_state_count(const struct instance *instance);
int instance_set_states(struct instance *instance, const double *values, size_t count);
int instance_states(struct instance *instance, double *values, size_t count);
int instance_nominals(struct instance *instance, double *values, size_t count);
int instance_rates(struct instance *instance, double *values, size_t count);
int instance_indicators(struct instance *instance, double *values, size_t count);
int instance_completed(struct instance *instance); /* a step of the host's solver */
/* Derivatives of unknowns in the direction of seeds at the knowns; `adjoint`: of knowns, with seeds at the unknowns. */
int instance_derivatives(struct instance *instance, const uint32_t *unknowns, size_t count, const uint32_t *knowns,
                         size_t known_count, const double *seeds, double *values, int adjoint);

/* Return a variable of a kind, or NULL with a message. */
const struct variable *instance_variable(struct instance *instance, uint32_t reference, int kind);
int instance_get(struct instance *instance, const struct variable *variable, double *value);
int instance_set(struct instance *instance, const struct variable *variable, double value);

/* A state is a block of `instance_state_size` bytes; a given one is overwritten. */
size_t instance_state_size(const struct instance *instance);
int instance_state(struct instance *instance, void **state);
int instance_restore(struct instance *instance, const void *state);
int instance_state_free(void **state);
int instance_state_to_bytes(struct instance *instance, const void *state, unsigned char *bytes, size_t size);
int instance_state_from_bytes(struct instance *instance, const unsigned char *bytes, size_t size, void **state);

#endif
