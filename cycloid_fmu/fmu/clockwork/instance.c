#include "instance.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "uri.h"

static const struct model *const MODELS[] = {&drive_model, &compensator_model};
enum { MODEL_COUNT = sizeof MODELS / sizeof *MODELS, PATH_SIZE = 4096 };

int instance_refuse(struct instance *instance, int status, const char *format, ...) {
    char message[MESSAGE_SIZE];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    instance->log(instance, status, message);
    return status;
}

/* Status of a model's function that has written its message. */
static int status_of(struct instance *instance, int failed) {
    return failed ? instance_refuse(instance, STATUS_ERROR, "%s", instance->message) : STATUS_OK;
}

/* The same where a solver may try again with a shorter step. */
static int solver_status_of(struct instance *instance, int failed) {
    return failed ? instance_refuse(instance, instance->phase == CONTINUOUS ? STATUS_DISCARD : STATUS_ERROR, "%s",
                                    instance->message)
                  : STATUS_OK;
}

/* Path of a file in a folder with an end of `used` characters; returns 1 if it is too long. */
static int file_path(char path[PATH_SIZE], size_t used, const char *name) {
    size_t size = strlen(name) + 1;
    if (used + size > PATH_SIZE) {
        return 1;
    }
    memcpy(path + used, name, size);
    return 0;
}

/* Find the model whose file is in the resources, and its path; NULL with a message without one. */
static const struct model *model_of(struct instance *instance, const char *resources, char path[PATH_SIZE]) {
    size_t used, i;
    int failed = path_from_uri(resources, path, PATH_SIZE - 1);
    used = failed ? 0 : strlen(path);
    if (!failed && path[used - 1] != '/' && path[used - 1] != '\\') {
        path[used++] = '/';
    }
    for (i = 0; i < MODEL_COUNT && !failed; i++) {
        FILE *file;
        failed = file_path(path, used, MODELS[i]->file);
        file = failed ? NULL : resource_open(path);
        if (file != NULL) {
            fclose(file);
            return MODELS[i];
        }
    }
    if (failed) {
        instance_refuse(instance, STATUS_ERROR, "\"%.200s\" is neither a path nor a file URI of the FMU's resources.",
                        resources == NULL ? "" : resources);
    } else {
        path[used] = '\0';
        instance_refuse(instance, STATUS_ERROR, "%.300s: the table can't be read: there is neither %s nor %s.", path,
                        MODELS[0]->file, MODELS[1]->file);
    }
    return NULL;
}

int instance_open(struct instance *instance, const char *name, const char *token, const char *resources, int exchange,
                  int early) {
    char path[PATH_SIZE];
    const struct model *model;
    size_t size = name == NULL ? 0 : strlen(name);
    instance->name = calloc(size + 1, 1);
    if (instance->name == NULL) {
        return STATUS_ERROR;
    }
    if (size > 0) {
        memcpy(instance->name, name, size);
    }
    model = model_of(instance, resources, path);
    if (model == NULL) {
        return STATUS_ERROR;
    }
    if (exchange && model->exchange == NULL) {
        return instance_refuse(instance, STATUS_ERROR, "this FMU is for Co-Simulation only.");
    }
    instance->self = model->open(path, instance->message);
    if (instance->self == NULL) {
        return status_of(instance, 1);
    }
    instance->model = model;
    instance->variable = model->variables(instance->self, &instance->variables);
    if (model->exchange != NULL) {
        model->exchange->prepare(instance->self, exchange, early);
        instance->events |= exchange;
    } else {
        instance->events = 0;
    }
    if (token == NULL || strcmp(token, model->token(instance->self)) != 0) {
        return instance_refuse(instance, STATUS_ERROR, "the model description and the table belong to two FMUs: \"%.100s\" "
                               "and \"%.100s\".", token == NULL ? "" : token, model->token(instance->self));
    }
    return STATUS_OK;
}

void instance_close(struct instance *instance) {
    if (instance != NULL) {
        if (instance->self != NULL) {
            instance->model->close(instance->self);
        }
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
        *instance_time(instance) = start;
        instance->phase = INITIALIZING;
    }
    return status;
}

int instance_start(struct instance *instance) {
    int status = in_phase(instance, INITIALIZING, "to end initialization");
    if (status == STATUS_OK) {
        status = status_of(instance, instance->model->start(instance->self, instance->message));
    }
    if (status == STATUS_OK) {
        instance->phase = instance->events ? EVENT : STEPPING;
    }
    if (status == STATUS_OK && instance->model->exchange != NULL) {
        instance->model->exchange->set_event_mode(instance->self, instance->events);
    }
    return status;
}

static void warn_outside(struct instance *instance) {
    if (!instance->warned && instance->model->outside(instance->self, instance->message)) {
        instance->warned = 1;
        instance_refuse(instance, STATUS_WARNING, "%s", instance->message);
    }
}

int instance_step(struct instance *instance, double time, double step) {
    int status = in_phase(instance, STEPPING, "a step");
    if (status == STATUS_OK) {
        status = status_of(instance, instance->model->step(instance->self, time, step, instance->message));
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

int instance_reset(struct instance *instance) {
    instance->model->reset(instance->self);
    instance->warned = 0;
    instance->phase = INSTANTIATED;
    return STATUS_OK;
}

double *instance_time(struct instance *instance) {
    return instance->model->time(instance->self);
}

/* ---- events and Model Exchange ---- */

int instance_exchanges(const struct instance *instance) {
    return instance->model->exchange != NULL && instance->model->exchange->exchanges(instance->self);
}

int instance_early(const struct instance *instance) {
    return instance->model->exchange != NULL && instance->model->exchange->rest(instance->self) > 0.0;
}

int instance_event(const struct instance *instance) {
    return instance->model->exchange != NULL && instance->model->exchange->event(instance->self);
}

static enum phase running(const struct instance *instance) {
    return instance_exchanges(instance) ? CONTINUOUS : STEPPING;
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
        instance->model->exchange->set_event_mode(instance->self, phase == EVENT);
    }
    return status;
}

static int exchanging(struct instance *instance) {
    if (!instance_exchanges(instance)) {
        return instance_refuse(instance, STATUS_ERROR, "this instance is one for Co-Simulation, not for Model Exchange.");
    }
    if (instance->phase != EVENT && instance->phase != CONTINUOUS) {
        return in_phase(instance, CONTINUOUS, "to exchange the model's states");
    }
    return STATUS_OK;
}

static int solved(struct instance *instance) {
    int status = exchanging(instance);
    return status != STATUS_OK
               ? status
               : solver_status_of(instance, instance->model->exchange->solve(instance->self, instance->message));
}

int instance_update(struct instance *instance) {
    int status = in_phase(instance, EVENT, "to update discrete states");
    if (status == STATUS_OK && instance_exchanges(instance)) {
        status = solved(instance);
    }
    if (status == STATUS_OK && instance_exchanges(instance)) {
        instance->model->exchange->accept(instance->self);
    }
    return status;
}

size_t instance_state_count(const struct instance *instance) {
    return instance_exchanges(instance) ? instance->model->exchange->states(instance->self) : 0;
}

/* Whether the host exchanges as many states as there are. */
static int states_of(struct instance *instance, size_t count) {
    int status = exchanging(instance);
    if (status == STATUS_OK && count != instance_state_count(instance)) {
        return instance_refuse(instance, STATUS_ERROR, "%u continuous states were asked for, there are %u.", (unsigned)count,
                               (unsigned)instance_state_count(instance));
    }
    return status;
}

int instance_set_time(struct instance *instance, double time) {
    int status = exchanging(instance);
    if (status == STATUS_OK && !(fabs(time) < HUGE_VAL)) {
        return instance_refuse(instance, STATUS_ERROR, "the time is %g s: it must be finite.", time);
    }
    if (status == STATUS_OK) {
        *instance_time(instance) = time;
    }
    return status;
}

int instance_set_states(struct instance *instance, const double *values, size_t count) {
    int status = states_of(instance, count);
    size_t i;
    for (i = 0; status == STATUS_OK && i < count; i++) {
        if (!(fabs(values[i]) < HUGE_VAL)) {
            return instance_refuse(instance, STATUS_ERROR, "the continuous state %u is %g: it must be finite.", (unsigned)i,
                                   values[i]);
        }
    }
    if (status == STATUS_OK) {
        instance->model->exchange->set_states(instance->self, values);
    }
    return status;
}

int instance_states(struct instance *instance, double *values, size_t count) {
    int status = states_of(instance, count);
    if (status == STATUS_OK) {
        instance->model->exchange->get_states(instance->self, values);
    }
    return status;
}

int instance_nominals(struct instance *instance, double *values, size_t count) {
    int status = states_of(instance, count);
    if (status == STATUS_OK) {
        instance->model->exchange->nominals(instance->self, values);
    }
    return status;
}

int instance_rates(struct instance *instance, double *values, size_t count) {
    int status = states_of(instance, count);
    if (status == STATUS_OK) {
        status = solved(instance);
    }
    if (status == STATUS_OK) {
        instance->model->exchange->rates(instance->self, values);
    }
    return status;
}

int instance_indicators(struct instance *instance, double *values, size_t count) {
    int status = exchanging(instance);
    if (status == STATUS_OK && count != EVENT_INDICATORS) {
        status = instance_refuse(instance, STATUS_ERROR, "%u event indicators were asked for, there are %d.",
                                 (unsigned)count, EVENT_INDICATORS);
    }
    if (status == STATUS_OK) {
        status = solved(instance);
    }
    if (status == STATUS_OK) {
        instance->model->exchange->indicators(instance->self, values);
    }
    return status;
}

int instance_completed(struct instance *instance) {
    int status = solved(instance);
    if (status == STATUS_OK) {
        instance->model->exchange->accept(instance->self);
        warn_outside(instance);
    }
    return status;
}

int instance_derivatives(struct instance *instance, const uint32_t *unknowns, size_t count, const uint32_t *knowns,
                         size_t known_count, const double *seeds, double *values, int adjoint) {
    const struct exchange *exchange = instance->model->exchange;
    size_t rounds = adjoint ? known_count : 1, i, j, k;
    if (exchange == NULL) {
        return instance_refuse(instance, STATUS_ERROR, "this FMU has no derivatives.");
    }
    for (k = 0; k < rounds; k++) {
        exchange->begin(instance->self);
        for (j = adjoint ? k : 0; j < (adjoint ? k + 1 : known_count); j++) {
            const struct variable *known = instance_variable(instance, knowns[j], KIND_REAL);
            if (known == NULL) {
                return STATUS_ERROR;
            }
            if (exchange->seed(instance->self, known, adjoint ? 1.0 : seeds[j], instance->message)) {
                return status_of(instance, 1);
            }
        }
        if (adjoint) {
            values[k] = 0.0;
        }
        for (i = 0; i < count; i++) {
            const struct variable *unknown = instance_variable(instance, unknowns[i], KIND_REAL);
            double value;
            if (unknown == NULL) {
                return STATUS_ERROR;
            }
            if (exchange->derivative(instance->self, unknown, &value, instance->message)) {
                return status_of(instance, 1);
            }
            if (adjoint) {
                values[k] += seeds[i] * value;
            } else {
                values[i] = value;
            }
        }
    }
    return STATUS_OK;
}

/* ---- variables ---- */

const struct variable *instance_variable(struct instance *instance, uint32_t reference, int kind) {
    if (reference >= instance->variables || instance->variable[reference].kind != kind) {
        static const char *const KINDS[] = {"real", "integer", "boolean"};
        instance_refuse(instance, STATUS_ERROR, "there is no %s variable with the value reference %u.", KINDS[kind],
                        (unsigned)reference);
        return NULL;
    }
    return &instance->variable[reference];
}

int instance_get(struct instance *instance, const struct variable *variable, double *value) {
    return solver_status_of(instance, instance->model->get(instance->self, variable, value, instance->message));
}

int instance_set(struct instance *instance, const struct variable *variable, double value) {
    if (instance->phase == TERMINATED) {
        return in_phase(instance, STEPPING, "to set a variable");
    }
    return status_of(instance, instance->model->set(instance->self, variable, value, instance->message));
}

/* ---- the state as bytes ---- */

size_t instance_state_size(const struct instance *instance) {
    return instance->model->state_size(instance->self);
}

int instance_state(struct instance *instance, void **state) {
    if (*state == NULL) {
        *state = malloc(instance_state_size(instance));
    }
    if (*state == NULL) {
        return instance_refuse(instance, STATUS_ERROR, "there is not enough memory for a state.");
    }
    instance->model->state_write(instance->self, *state);
    return STATUS_OK;
}

/* Whether bytes are a state of this model; `sealed`: with a checksum. */
static int check(struct instance *instance, const unsigned char *bytes, size_t size, int sealed) {
    return status_of(instance, instance->model->state_check(instance->self, bytes, size, sealed, instance->message));
}

int instance_restore(struct instance *instance, const void *state) {
    const struct exchange *exchange = instance->model->exchange;
    int initializing;
    if (check(instance, state, instance_state_size(instance), 0) != STATUS_OK) {
        return STATUS_ERROR;
    }
    instance->model->state_read(instance->self, state);
    initializing = instance->model->initializing(instance->self);
    if (instance->phase == TERMINATED || instance->phase == INSTANTIATED || !initializing) {
        instance->phase = initializing                                            ? INITIALIZING
            : exchange != NULL && exchange->in_event_mode(instance->self) ? EVENT : running(instance);
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
    size_t needed = instance_state_size(instance);
    if (state == NULL || size < needed) {
        return instance_refuse(instance, STATUS_ERROR, "a state takes %u bytes, given are %u.", (unsigned)needed,
                               (unsigned)size);
    }
    memcpy(bytes, state, needed);
    instance->model->state_seal(instance->self, bytes);
    return STATUS_OK;
}

int instance_state_from_bytes(struct instance *instance, const unsigned char *bytes, size_t size, void **state) {
    void *blob;
    if (check(instance, bytes, size, 1) != STATUS_OK) {
        return STATUS_ERROR;
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
