/* Functions of an instance for fmi2.c and fmi3.c: of a drive here, of a compensator in its own FMU. */
#ifndef CYCLOID_CALLS_H
#define CYCLOID_CALLS_H

#include <stddef.h>
#include <stdint.h>

struct instance;
struct variable;

enum phase { INSTANTIATED, INITIALIZING, STEPPING, EVENT, CONTINUOUS, TERMINATED };
enum { STATUS_OK, STATUS_WARNING, STATUS_DISCARD, STATUS_ERROR, STATUS_FATAL };

/* Return an instance, or NULL with a message; the caller has set the log. */
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

/* Derivatives of unknowns in the direction of seeds at the knowns; `adjoint`: of knowns, with seeds at the unknowns. */
int instance_derivatives(struct instance *instance, const uint32_t *unknowns, size_t count, const uint32_t *knowns,
                         size_t known_count, const double *seeds, double *found, int adjoint);
int instance_reset(struct instance *instance);

/* Return a variable of a kind, or NULL with a message. */
const struct variable *instance_variable(struct instance *instance, uint32_t reference, int kind);
int instance_get(struct instance *instance, const struct variable *variable, double *value);
int instance_set(struct instance *instance, const struct variable *variable, double value);

/* A state is a block of `drive_state_size` bytes; a given one is overwritten. */
int instance_state(struct instance *instance, void **state);
int instance_restore(struct instance *instance, const void *state);
int instance_state_free(void **state);
int instance_state_to_bytes(struct instance *instance, const void *state, unsigned char *bytes, size_t size);
int instance_state_from_bytes(struct instance *instance, const unsigned char *bytes, size_t size, void **state);

#endif
