/* Shared by FMI 2.0 and 3.0: an instance with its resources, its log and its phase. */
#ifndef CYCLOID_INSTANCE_H
#define CYCLOID_INSTANCE_H

#include "calls.h"
#include "drive.h"

struct instance {
    char *name;
    struct table *table;
    struct drive drive;
    enum phase phase;
    /* Logs a message; `status` is FMI's number, the same in both versions. */
    void (*log)(struct instance *instance, int status, const char *message);
    void *environment, *callback; /* callback: FMI 2.0's callback functions */
    void (*callback3)(void);      /* FMI 3.0's logMessage */
    int warned; /* whether the tables were left */
    int events; /* whether event mode is used: in Model Exchange, and if the host requested it */
    char message[MESSAGE_SIZE];
};

#endif
