/* What FMI 2.0 and 3.0 share: an instance with its resources, its log and its phase. */
#ifndef CYCLOID_INSTANCE_H
#define CYCLOID_INSTANCE_H

#include "drive.h"

enum phase { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED };

struct instance {
    char *name;
    struct table *table;
    struct drive drive;
    enum phase phase;
    /* Hands a message on; `status` is FMI's own number, the same in both versions. */
    void (*log)(struct instance *instance, int status, const char *message);
    void *environment, *callback; /* callback: FMI 2.0's callback functions */
    void (*callback3)(void);      /* FMI 3.0's logMessage */
    int warned; /* that the tables were left */
    char message[MESSAGE_SIZE];
};

enum { STATUS_OK, STATUS_WARNING, STATUS_DISCARD, STATUS_ERROR, STATUS_FATAL };

/* An instance, or NULL with a sentence in its message; the caller has set the log. */
int instance_open(struct instance *instance, const char *name, const char *token, const char *resources);
void instance_close(struct instance *instance);
int instance_refuse(struct instance *instance, int status, const char *format, ...);

int instance_initialize(struct instance *instance, double start);
int instance_start(struct instance *instance);
int instance_step(struct instance *instance, double time, double step);
int instance_terminate(struct instance *instance);
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
