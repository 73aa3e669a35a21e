#include "instance.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "uri.h"

static const char TABLE[] = TABLE_FILE;

static int table_path(const char *resources, char *path, size_t size) {
    size_t used;
    if (path_from_uri(resources, path, size)) {
        return 1;
    }
    used = strlen(path);
    if (used + 1 + sizeof TABLE > size) {
        return 1;
    }
    if (path[used - 1] != '/' && path[used - 1] != '\\') {
        path[used++] = '/';
    }
    memcpy(path + used, TABLE, sizeof TABLE);
    return 0;
}

int instance_refuse(struct instance *instance, int status, const char *format, ...) {
    char message[MESSAGE_SIZE];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    instance->log(instance, status, message);
    return status;
}

int instance_open(struct instance *instance, const char *name, const char *token, const char *resources) {
    char path[4096];
    size_t size = name == NULL ? 0 : strlen(name);
    instance->name = calloc(size + 1, 1);
    if (instance->name == NULL) {
        return 1;
    }
    if (size > 0) {
        memcpy(instance->name, name, size);
    }
    if (table_path(resources, path, sizeof path)) {
        instance_refuse(instance, STATUS_ERROR, "\"%.200s\" is neither a path nor a file URI of the FMU's resources.",
                        resources == NULL ? "" : resources);
        return 1;
    }
    instance->table = table_open(path, instance->message);
    if (instance->table == NULL) {
        instance_refuse(instance, STATUS_ERROR, "%s", instance->message);
        return 1;
    }
    drive_open(&instance->drive, instance->table);
    if (token == NULL || strcmp(token, instance->table->token) != 0) {
        instance_refuse(instance, STATUS_ERROR, "the model description and the table belong to two FMUs: \"%.100s\" and "
                        "\"%.100s\".", token == NULL ? "" : token, instance->table->token);
        return 1;
    }
    return 0;
}

void instance_close(struct instance *instance) {
    if (instance != NULL) {
        table_close(instance->table);
        free(instance->name);
        free(instance);
    }
}

static int in_phase(struct instance *instance, enum phase phase, const char *what) {
    static const char *const NAMES[] = {"before initialization", "during initialization", "while stepping",
                                        "after termination"};
    if (instance->phase != phase) {
        return instance_refuse(instance, STATUS_ERROR, "%s is allowed %s only, not %s.", what, NAMES[phase],
                               NAMES[instance->phase]);
    }
    return STATUS_OK;
}

int instance_initialize(struct instance *instance, double start) {
    int status = in_phase(instance, INSTANTIATED, "to begin initialization");
    if (status == STATUS_OK && !(start > -1e300 && start < 1e300)) {
        return instance_refuse(instance, STATUS_ERROR, "the start time is %g s: it must be finite.", start);
    }
    if (status == STATUS_OK) {
        instance->drive.state.time = start;
        instance->phase = INITIALIZING;
    }
    return status;
}

int instance_start(struct instance *instance) {
    int status = in_phase(instance, INITIALIZING, "to end initialization");
    if (status == STATUS_OK && drive_start(&instance->drive, instance->message)) {
        return instance_refuse(instance, STATUS_ERROR, "%s", instance->message);
    }
    if (status == STATUS_OK) {
        instance->phase = STEPPING;
    }
    return status;
}

int instance_step(struct instance *instance, double time, double step) {
    int status = in_phase(instance, STEPPING, "a step");
    if (status == STATUS_OK && drive_step(&instance->drive, time, step, instance->message)) {
        return instance_refuse(instance, STATUS_ERROR, "%s", instance->message);
    }
    if (status == STATUS_OK && !instance->warned && drive_outside(&instance->drive)) {
        const struct side *side = instance->table->side;
        instance->warned = 1;
        instance_refuse(instance, STATUS_WARNING, "at %g s the torque is beyond the %g N.m of the FMU's tables: what goes "
                        "on there has no stated accuracy (--largest-torque makes them longer). This is said once.", time + step,
                        fmin(side[0].reach, side[1].reach));
    }
    return status;
}

int instance_terminate(struct instance *instance) {
    int status = in_phase(instance, STEPPING, "to terminate");
    instance->phase = status == STATUS_OK ? TERMINATED : instance->phase;
    return status;
}

int instance_reset(struct instance *instance) {
    drive_reset(&instance->drive);
    instance->warned = 0;
    instance->phase = INSTANTIATED;
    return STATUS_OK;
}

const struct variable *instance_variable(struct instance *instance, uint32_t reference, int kind) {
    if (reference >= instance->table->variables || instance->table->variable[reference].kind != kind) {
        static const char *const KINDS[] = {"real", "integer", "boolean"};
        instance_refuse(instance, STATUS_ERROR, "there is no %s variable with the value reference %u.", KINDS[kind],
                        (unsigned)reference);
        return NULL;
    }
    return &instance->table->variable[reference];
}

int instance_get(struct instance *instance, const struct variable *variable, double *value) {
    if (drive_get(&instance->drive, variable, value, instance->message)) {
        return instance_refuse(instance, STATUS_ERROR, "%s", instance->message);
    }
    return STATUS_OK;
}

int instance_set(struct instance *instance, const struct variable *variable, double value) {
    if (instance->phase == TERMINATED) {
        return in_phase(instance, STEPPING, "to set a variable");
    }
    if (drive_set(&instance->drive, variable, value, instance->message)) {
        return instance_refuse(instance, STATUS_ERROR, "%s", instance->message);
    }
    return STATUS_OK;
}

int instance_state(struct instance *instance, void **state) {
    if (*state == NULL) {
        *state = malloc(drive_state_size());
    }
    if (*state == NULL) {
        return instance_refuse(instance, STATUS_ERROR, "there is not enough memory for a state.");
    }
    drive_state_write(&instance->drive, *state);
    return STATUS_OK;
}

int instance_restore(struct instance *instance, const void *state) {
    if (drive_state_check(&instance->drive, state, drive_state_size(), 0, instance->message)) {
        return instance_refuse(instance, STATUS_ERROR, "%s", instance->message);
    }
    drive_state_read(&instance->drive, state);
    if (instance->phase == TERMINATED || instance->phase == INSTANTIATED || !instance->drive.initializing) {
        instance->phase = instance->drive.initializing ? INITIALIZING : STEPPING;
    }
    return STATUS_OK;
}

int instance_state_free(void **state) {
    if (state != NULL) {
        free(*state);
        *state = NULL;
    }
    return STATUS_OK;
}

int instance_state_to_bytes(struct instance *instance, const void *state, unsigned char *bytes, size_t size) {
    if (state == NULL || size < drive_state_size()) {
        return instance_refuse(instance, STATUS_ERROR, "a state takes %u bytes, given are %u.",
                               (unsigned)drive_state_size(), (unsigned)size);
    }
    memcpy(bytes, state, drive_state_size());
    drive_state_seal(bytes);
    return STATUS_OK;
}

int instance_state_from_bytes(struct instance *instance, const unsigned char *bytes, size_t size, void **state) {
    void *blob;
    if (drive_state_check(&instance->drive, bytes, size, 1, instance->message)) {
        return instance_refuse(instance, STATUS_ERROR, "%s", instance->message);
    }
    blob = malloc(size);
    if (blob == NULL) {
        return instance_refuse(instance, STATUS_ERROR, "there is not enough memory for a state.");
    }
    memcpy(blob, bytes, size);
    free(*state);
    *state = blob;
    return STATUS_OK;
}
