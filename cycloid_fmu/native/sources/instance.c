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

static const struct variable *of_field(const struct instance *instance, int field) {
    uint32_t i;
    for (i = 0; i < instance->table->variables; i++) {
        if (instance->table->variable[i].field == field) {
            return &instance->table->variable[i];
        }
    }
    return NULL;
}

int instance_open(struct instance *instance, const char *name, const char *token, const char *resources, int exchange) {
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
    instance->drive.exchange = exchange;
    instance->events |= exchange;
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
                                        "in event mode", "in continuous-time mode", "after termination"};
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
        instance->phase = instance->events ? EVENT : STEPPING;
        instance->drive.state.event_mode = instance->events;
    }
    return status;
}

static void warn_outside(struct instance *instance) {
    if (!instance->warned && drive_outside(&instance->drive)) {
        const struct side *side = instance->drive.table->side;
        instance->warned = 1;
        instance_refuse(instance, STATUS_WARNING, "at %g s the torque is beyond the %g N.m of the FMU's tables: what goes "
                        "on there has no stated accuracy (--largest-torque makes them longer). This is said once.",
                        instance->drive.state.time, fmin(side[0].reach, side[1].reach));
    }
}

int instance_step(struct instance *instance, double time, double step) {
    int status = in_phase(instance, STEPPING, "a step");
    if (status == STATUS_OK && drive_step(&instance->drive, time, step, instance->message)) {
        return instance_refuse(instance, STATUS_ERROR, "%s", instance->message);
    }
    if (status == STATUS_OK) {
        warn_outside(instance);
    }
    return status;
}

int instance_terminate(struct instance *instance) {
    int status = instance->phase == EVENT || instance->phase == CONTINUOUS ? STATUS_OK
                                                                           : in_phase(instance, STEPPING, "to terminate");
    instance->phase = status == STATUS_OK ? TERMINATED : instance->phase;
    return status;
}

/* ---- events and Model Exchange ---- */

static enum phase running(const struct instance *instance) {
    return instance->drive.exchange ? CONTINUOUS : STEPPING;
}

int instance_enter(struct instance *instance, enum phase phase) {
    static const char *const WHAT[] = {"step mode", "event mode", "continuous-time mode"};
    enum phase from = phase == EVENT ? running(instance) : EVENT;
    int status;
    if (phase == EVENT ? !instance->events : phase != running(instance)) {
        return instance_refuse(instance, STATUS_ERROR, "this instance has no %s.", WHAT[phase - STEPPING]);
    }
    if (phase == EVENT && instance->phase == EVENT) {
        return STATUS_OK;
    }
    status = in_phase(instance, from, "to change the mode");
    if (status == STATUS_OK) {
        instance->phase = phase;
        instance->drive.state.event_mode = phase == EVENT;
    }
    return status;
}

static int solved(struct instance *instance) {
    if (exchange_solve(&instance->drive, instance->message)) {
        return instance_refuse(instance, instance->phase == CONTINUOUS ? STATUS_DISCARD : STATUS_ERROR, "%s",
                               instance->message);
    }
    return STATUS_OK;
}

int instance_update(struct instance *instance) {
    int status = in_phase(instance, EVENT, "to update discrete states");
    if (status == STATUS_OK && instance->drive.exchange) {
        status = solved(instance);
    }
    if (status == STATUS_OK && instance->drive.exchange) {
        exchange_keep(&instance->drive);
    }
    return status;
}

static int exchanging(struct instance *instance) {
    if (!instance->drive.exchange) {
        return instance_refuse(instance, STATUS_ERROR, "this instance is one for Co-Simulation, not for Model Exchange.");
    }
    if (instance->phase != EVENT && instance->phase != CONTINUOUS) {
        return in_phase(instance, CONTINUOUS, "to exchange the model's states");
    }
    return STATUS_OK;
}

/* The fields of the states, if the host expects their number. */
static int states_of(struct instance *instance, size_t count, int fields[MOST_STATES]) {
    int status = exchanging(instance);
    size_t own = (size_t)exchange_states(&instance->drive, fields);
    if (status == STATUS_OK && count != own) {
        return instance_refuse(instance, STATUS_ERROR, "%u continuous states were asked for, there are %u.", (unsigned)count,
                               (unsigned)own);
    }
    return status;
}

static double *state_at(struct instance *instance, int field) {
    struct variable of = {NULL, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0};
    of.field = field;
    return drive_stored(&instance->drive.state, &of);
}

int instance_set_time(struct instance *instance, double time) {
    int status = exchanging(instance);
    if (status == STATUS_OK && !(fabs(time) < HUGE_VAL)) {
        return instance_refuse(instance, STATUS_ERROR, "the time is %g s: it must be finite.", time);
    }
    if (status == STATUS_OK) {
        instance->drive.state.time = time;
    }
    return status;
}

int instance_set_states(struct instance *instance, const double *values, size_t count) {
    int fields[MOST_STATES], status = states_of(instance, count, fields);
    size_t i;
    for (i = 0; status == STATUS_OK && i < count; i++) {
        if (!(fabs(values[i]) < HUGE_VAL)) {
            return instance_refuse(instance, STATUS_ERROR, "the continuous state %u is %g: it must be finite.", (unsigned)i,
                                   values[i]);
        }
        *state_at(instance, fields[i]) = values[i];
    }
    instance->drive.solved = 0;
    return status;
}

int instance_states(struct instance *instance, double *values, size_t count) {
    int fields[MOST_STATES], status = states_of(instance, count, fields);
    size_t i;
    for (i = 0; status == STATUS_OK && i < count; i++) {
        values[i] = *state_at(instance, fields[i]);
    }
    return status;
}

int instance_nominals(struct instance *instance, double *values, size_t count) {
    int fields[MOST_STATES], status = states_of(instance, count, fields);
    size_t i;
    for (i = 0; status == STATUS_OK && i < count; i++) {
        const struct variable *variable = of_field(instance, fields[i]);
        values[i] = variable != NULL && variable->nominal > 0.0 ? variable->nominal : 1.0;
    }
    return status;
}

int instance_rates(struct instance *instance, double *values, size_t count) {
    int fields[MOST_STATES], status = states_of(instance, count, fields);
    size_t i;
    if (status == STATUS_OK) {
        status = solved(instance);
    }
    for (i = 0; status == STATUS_OK && i < count; i++) {
        values[i] = exchange_rate(&instance->drive, fields[i]);
    }
    return status;
}

int instance_indicators(struct instance *instance, double *values, size_t count) {
    double found[EVENT_INDICATORS];
    int status = exchanging(instance);
    if (status == STATUS_OK && count != EVENT_INDICATORS) {
        status = instance_refuse(instance, STATUS_ERROR, "%u event indicators were asked for, there are %d.",
                                 (unsigned)count, EVENT_INDICATORS);
    }
    if (status == STATUS_OK) {
        status = solved(instance);
    }
    if (status == STATUS_OK) {
        exchange_indicators(&instance->drive, found);
        memcpy(values, found, sizeof found);
    }
    return status;
}

int instance_completed(struct instance *instance) {
    int status = exchanging(instance);
    if (status == STATUS_OK) {
        status = solved(instance);
    }
    if (status == STATUS_OK) {
        exchange_keep(&instance->drive);
        warn_outside(instance);
    }
    return status;
}

int instance_derivatives(struct instance *instance, const uint32_t *unknowns, size_t count, const uint32_t *knowns,
                         size_t known_count, const double *seeds, double *found, int adjoint) {
    struct direction direction;
    size_t rounds = adjoint ? known_count : 1, i, j, k;
    for (k = 0; k < rounds; k++) {
        derivative_begin(&direction);
        for (j = adjoint ? k : 0; j < (adjoint ? k + 1 : known_count); j++) {
            const struct variable *known = instance_variable(instance, knowns[j], KIND_REAL);
            if (known == NULL) {
                return STATUS_ERROR;
            }
            if (derivative_seed(&instance->drive, &direction, known, adjoint ? 1.0 : seeds[j], instance->message)) {
                return instance_refuse(instance, STATUS_ERROR, "%s", instance->message);
            }
        }
        if (adjoint) {
            found[k] = 0.0;
        }
        for (i = 0; i < count; i++) {
            const struct variable *unknown = instance_variable(instance, unknowns[i], KIND_REAL);
            double value;
            if (unknown == NULL) {
                return STATUS_ERROR;
            }
            if (derivative_of(&instance->drive, &direction, unknown, &value, instance->message)) {
                return instance_refuse(instance, STATUS_ERROR, "%s", instance->message);
            }
            if (adjoint) {
                found[k] += seeds[i] * value;
            } else {
                found[i] = value;
            }
        }
    }
    return STATUS_OK;
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
        return instance_refuse(instance, instance->phase == CONTINUOUS ? STATUS_DISCARD : STATUS_ERROR, "%s",
                               instance->message);
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
        instance->phase = instance->drive.initializing              ? INITIALIZING
            : instance->drive.state.event_mode != 0.0 ? EVENT : running(instance);
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
