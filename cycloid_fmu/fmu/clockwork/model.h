/* What FMI's functions need of a model. A function that can fail returns 0, or 1 with one sentence in `message` and nothing
   changed. */
#ifndef CYCLOID_MODEL_H
#define CYCLOID_MODEL_H

#include "resource.h"

/* Model Exchange, event mode and derivatives. */
struct exchange {
    /* Before anything else: whether it is for Model Exchange, and whether a step may end where contact begins. */
    void (*prepare)(void *self, int exchange, int early);
    int (*exchanges)(const void *self);
    void (*set_event_mode)(void *self, int on);
    int (*in_event_mode)(const void *self);
    double (*rest)(const void *self);   /* of the last step, if it ended early, s */
    int (*event)(const void *self);     /* whether the last step ended at one */
    size_t (*states)(const void *self); /* number of continuous states */
    void (*get_states)(void *self, double *values);
    void (*set_states)(void *self, const double *values);
    void (*nominals)(const void *self, double *values);
    int (*solve)(void *self, char message[MESSAGE_SIZE]); /* before rates, indicators and `accept` */
    void (*rates)(void *self, double *values);
    void (*indicators)(void *self, double values[EVENT_INDICATORS]);
    void (*accept)(void *self); /* what happened so far: at the end of the host's step, and at an event */
    /* Derivatives of unknowns in a direction: begin, seeds of knowns, unknowns. */
    void (*begin)(void *self);
    int (*seed)(void *self, const struct variable *known, double seed, char message[MESSAGE_SIZE]);
    int (*derivative)(void *self, const struct variable *unknown, double *value, char message[MESSAGE_SIZE]);
};

struct model {
    const char *file; /* with its numbers, in the FMU's resources */
    void *(*open)(const char *path, char message[MESSAGE_SIZE]); /* NULL with a message */
    void (*close)(void *self);
    const char *(*token)(const void *self);
    const struct variable *(*variables)(const void *self, uint32_t *count);
    void (*reset)(void *self);
    int (*start)(void *self, char message[MESSAGE_SIZE]); /* at the end of initialization */
    int (*step)(void *self, double time, double step, char message[MESSAGE_SIZE]);
    int (*get)(void *self, const struct variable *variable, double *value, char message[MESSAGE_SIZE]);
    int (*set)(void *self, const struct variable *variable, double value, char message[MESSAGE_SIZE]);
    double *(*time)(void *self);
    int (*initializing)(const void *self); /* until `start` */
    /* Whether results have no stated accuracy, with the warning. */
    int (*outside)(const void *self, char message[MESSAGE_SIZE]);
    size_t (*state_size)(const void *self);
    void (*state_write)(const void *self, unsigned char *bytes);
    void (*state_seal)(const void *self, unsigned char *bytes); /* with a checksum, for where it may be damaged */
    int (*state_check)(const void *self, const unsigned char *bytes, size_t size, int sealed, char message[MESSAGE_SIZE]);
    void (*state_read)(void *self, const unsigned char *bytes);
    const struct exchange *exchange; /* or NULL */
};

extern const struct model drive_model, compensator_model;

#endif
