#include "instance.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "token.h"

enum { NUMBERS = sizeof(struct kept) / 8, HEAD = 24, BLOB = HEAD + 8 * NUMBERS };
static const char MAGIC[8] = "CYCOMP1";

static const struct variable VARIABLE[VARIABLES] = {
    {DESIRED_ANGLE, KIND_REAL}, {DESIRED_SPEED, KIND_REAL}, {LOAD_TORQUE, KIND_REAL}, {DRIVE_TEMPERATURE, KIND_REAL},
    {MOTOR_MEASURED, KIND_REAL}, {OUTPUT_MEASURED, KIND_REAL}, {IS_MEASURED, KIND_BOOLEAN},
    {INDEX, KIND_REAL}, {INDEX_PROBABILITY, KIND_REAL}, {MOTOR_ANGLE, KIND_REAL}, {MOTOR_SPEED, KIND_REAL},
    {BAND, KIND_REAL}, {GAIN, KIND_REAL}, {HOLDS, KIND_BOOLEAN}, {TIME, KIND_REAL}, /* TIME: of FMI 3.0 */
};

int instance_refuse(struct instance *instance, int status, const char *format, ...) {
    char message[MESSAGE_SIZE];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    instance->log(instance, status, message);
    return status;
}

static void fresh(struct instance *instance) {
    static const struct kept EMPTY = {0};
    struct kept *state = &instance->drive.state;
    *state = EMPTY;
    state->phase = INSTANTIATED;
    state->value[DRIVE_TEMPERATURE] = START_TEMPERATURE;
}

int instance_open(struct instance *instance, const char *name, const char *token, const char *resources, int exchange) {
    size_t size = name == NULL ? 0 : strlen(name);
    (void)resources; /* everything is compiled in */
    instance->name = calloc(size + 1, 1);
    if (instance->name == NULL) {
        return 1;
    }
    if (size > 0) {
        memcpy(instance->name, name, size);
    }
    fresh(instance);
    if (exchange) {
        return instance_refuse(instance, STATUS_ERROR, "this FMU is for Co-Simulation only.");
    }
    if (token == NULL || strcmp(token, TOKEN) != 0) {
        return instance_refuse(instance, STATUS_ERROR, "the model description and the library belong to two FMUs: \"%.100s\" "
                               "and \"%.100s\".", token == NULL ? "" : token, TOKEN);
    }
    return STATUS_OK;
}

void instance_close(struct instance *instance) {
    if (instance != NULL) {
        free(instance->name);
        free(instance);
    }
}

static int in_phase(struct instance *instance, enum phase phase, const char *what) {
    static const char *const NAMES[] = {"before initialization", "during initialization", "while stepping", "", "",
                                        "after termination"};
    int now = (int)instance->drive.state.phase;
    if (now != (int)phase) {
        return instance_refuse(instance, STATUS_ERROR, "%s is allowed %s only, not %s.", what, NAMES[phase], NAMES[now]);
    }
    return STATUS_OK;
}

/* Make a step. Its memory is kept, except where outputs are read before the first step: the index may still be set then. */
static void stepped(struct kept *state, int keep) {
    const double *in = state->value;
    struct compensator_memory memory = state->memory;
    struct compensator_command found;
    int measured = in[IS_MEASURED] != 0.0;
    if (state->phase < STEPPING) {
        compensator_start(&state->memory, in[INDEX], in[INDEX_PROBABILITY]);
        memory = state->memory;
    }
    found = compensator_step(&memory, in[DESIRED_ANGLE], in[DESIRED_SPEED], in[LOAD_TORQUE], in[DRIVE_TEMPERATURE],
                             measured ? in[MOTOR_MEASURED] : COMPENSATOR_NONE,
                             measured ? in[OUTPUT_MEASURED] : COMPENSATOR_NONE);
    if (keep) {
        state->memory = memory;
    }
    state->value[MOTOR_ANGLE] = found.motor_angle;
    state->value[MOTOR_SPEED] = found.motor_speed;
    state->value[BAND] = found.band;
    state->value[GAIN] = found.gain;
    state->value[HOLDS] = found.holds;
}

int instance_initialize(struct instance *instance, double start) {
    int status = in_phase(instance, INSTANTIATED, "to begin initialization");
    if (status == STATUS_OK && !(start > -1e300 && start < 1e300)) {
        return instance_refuse(instance, STATUS_ERROR, "the start time is %g s: it must be finite.", start);
    }
    if (status == STATUS_OK) {
        instance->drive.state.time = start;
        instance->drive.state.phase = INITIALIZING;
    }
    return status;
}

int instance_start(struct instance *instance) {
    int status = in_phase(instance, INITIALIZING, "to end initialization");
    if (status == STATUS_OK) {
        stepped(&instance->drive.state, 0);
        instance->drive.state.phase = STEPPING;
    }
    return status;
}

int instance_step(struct instance *instance, double time, double step) {
    int status = in_phase(instance, STEPPING, "a step");
    if (status == STATUS_OK && !(step >= 0.0 && step < 1e300 && time > -1e300 && time < 1e300)) {
        return instance_refuse(instance, STATUS_ERROR, "a step of %g s at %g s: both must be finite, and the step not "
                               "below zero.", step, time);
    }
    if (status == STATUS_OK) {
        stepped(&instance->drive.state, 1);
        instance->drive.state.time = time + step;
    }
    return status;
}

int instance_terminate(struct instance *instance) {
    int status = in_phase(instance, STEPPING, "to terminate");
    if (status == STATUS_OK) {
        instance->drive.state.phase = TERMINATED;
    }
    return status;
}

int instance_reset(struct instance *instance) {
    fresh(instance);
    return STATUS_OK;
}

const struct variable *instance_variable(struct instance *instance, uint32_t reference, int kind) {
    static const char *const KINDS[] = {"real", "integer", "boolean"};
    if (reference >= VARIABLES || VARIABLE[reference].kind != kind) {
        instance_refuse(instance, STATUS_ERROR, "there is no %s variable with the value reference %u.", KINDS[kind],
                        (unsigned)reference);
        return NULL;
    }
    return &VARIABLE[reference];
}

int instance_get(struct instance *instance, const struct variable *variable, double *value) {
    struct kept *state = &instance->drive.state;
    if (state->phase < STEPPING && variable->number >= MOTOR_ANGLE) {
        stepped(state, 0);
    }
    *value = variable->number == TIME ? state->time : state->value[variable->number];
    return STATUS_OK;
}

int instance_set(struct instance *instance, const struct variable *variable, double value) {
    struct kept *state = &instance->drive.state;
    int index = variable->number == INDEX || variable->number == INDEX_PROBABILITY;
    if (state->phase == TERMINATED) {
        return in_phase(instance, STEPPING, "to set a variable");
    }
    if (variable->number >= MOTOR_ANGLE) {
        return instance_refuse(instance, STATUS_ERROR, "outputs and time can't be set.");
    }
    if (index && state->phase == STEPPING) {
        return instance_refuse(instance, STATUS_ERROR, "the index is fixed: it can be set until initialization ends.");
    }
    if (variable->kind == KIND_REAL && !(value > -1e300 && value < 1e300)) {
        return instance_refuse(instance, STATUS_ERROR, "the variable %d is %g: it must be finite; a missing reading of an encoder "
                               "is stated by output_measured.", variable->number, value);
    }
    state->value[variable->number] = variable->kind == KIND_BOOLEAN ? value != 0.0 : value;
    return STATUS_OK;
}

/* ---- states: a mark, checksum of the tables, checksum of what follows, numbers; all little endian ---- */

size_t drive_state_size(void) {
    return BLOB;
}

static void put(unsigned char *bytes, uint64_t value) {
    int i;
    for (i = 0; i < 8; i++) {
        bytes[i] = (unsigned char)(value >> (8 * i) & 0xff);
    }
}

static uint64_t get(const unsigned char *bytes) {
    uint64_t value = 0;
    int i;
    for (i = 7; i >= 0; i--) {
        value = value << 8 | bytes[i];
    }
    return value;
}

/* FNV-1a with 64 bits. */
static uint64_t checksum(const unsigned char *bytes, size_t size) {
    uint64_t sum = 0xcbf29ce484222325u;
    size_t i;
    for (i = 0; i < size; i++) {
        sum = (sum ^ bytes[i]) * 0x100000001b3u;
    }
    return sum;
}

static uint64_t own(void) {
    return checksum((const unsigned char *)TOKEN, sizeof TOKEN);
}

static int check(struct instance *instance, const unsigned char *blob, size_t size) {
    if (blob == NULL || size != BLOB || memcmp(blob, MAGIC, sizeof MAGIC) != 0) {
        return instance_refuse(instance, STATUS_ERROR, "these bytes are not the state of a compensator.");
    }
    if (get(blob + 8) != own()) {
        return instance_refuse(instance, STATUS_ERROR, "this state belongs to another compensator.");
    }
    if (get(blob + 16) != checksum(blob + HEAD, BLOB - HEAD)) {
        return instance_refuse(instance, STATUS_ERROR, "this state is damaged: its checksum does not fit.");
    }
    return STATUS_OK;
}

int instance_state(struct instance *instance, void **state) {
    const unsigned char *numbers = (const unsigned char *)&instance->drive.state;
    unsigned char *blob;
    size_t i;
    if (*state == NULL) {
        *state = malloc(BLOB);
    }
    if (*state == NULL) {
        return instance_refuse(instance, STATUS_ERROR, "there is not enough memory for a state.");
    }
    blob = *state;
    memcpy(blob, MAGIC, sizeof MAGIC);
    put(blob + 8, own());
    for (i = 0; i < NUMBERS; i++) {
        uint64_t bits;
        memcpy(&bits, numbers + 8 * i, 8);
        put(blob + HEAD + 8 * i, bits);
    }
    put(blob + 16, checksum(blob + HEAD, BLOB - HEAD));
    return STATUS_OK;
}

int instance_restore(struct instance *instance, const void *state) {
    const unsigned char *blob = state;
    struct kept found;
    size_t i;
    if (check(instance, blob, BLOB) != STATUS_OK) {
        return STATUS_ERROR;
    }
    for (i = 0; i < NUMBERS; i++) {
        uint64_t bits = get(blob + HEAD + 8 * i);
        memcpy((unsigned char *)&found + 8 * i, &bits, 8);
    }
    if (!(found.phase == INSTANTIATED || found.phase == INITIALIZING || found.phase == STEPPING
          || found.phase == TERMINATED)) {
        return instance_refuse(instance, STATUS_ERROR, "this state is damaged: it has an unknown phase.");
    }
    instance->drive.state = found;
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
    if (state == NULL || size < BLOB) {
        return instance_refuse(instance, STATUS_ERROR, "a state takes %u bytes, given are %u.", (unsigned)BLOB,
                               (unsigned)size);
    }
    memcpy(bytes, state, BLOB);
    return STATUS_OK;
}

int instance_state_from_bytes(struct instance *instance, const unsigned char *bytes, size_t size, void **state) {
    if (check(instance, bytes, size) != STATUS_OK) {
        return STATUS_ERROR;
    }
    if (*state == NULL) {
        *state = malloc(BLOB);
    }
    if (*state == NULL) {
        return instance_refuse(instance, STATUS_ERROR, "there is not enough memory for a state.");
    }
    memcpy(*state, bytes, BLOB);
    return STATUS_OK;
}

/* ---- functions of Model Exchange, which it does not support ---- */

int exchange_states(const void *drive, int fields[MOST_STATES]) {
    (void)drive, (void)fields;
    return 0;
}

static int absent(struct instance *instance, const char *what) {
    return instance_refuse(instance, STATUS_ERROR, "this FMU has no %s.", what);
}

int instance_enter(struct instance *instance, enum phase phase) {
    return phase == STEPPING ? STATUS_OK : absent(instance, "modes but step mode");
}

int instance_update(struct instance *instance) {
    return absent(instance, "event mode");
}

int instance_set_time(struct instance *instance, double time) {
    (void)time;
    return absent(instance, "Model Exchange");
}

int instance_set_states(struct instance *instance, const double *values, size_t count) {
    (void)values;
    return count == 0 ? STATUS_OK : absent(instance, "continuous states");
}

int instance_states(struct instance *instance, double *values, size_t count) {
    (void)values;
    return count == 0 ? STATUS_OK : absent(instance, "continuous states");
}

int instance_nominals(struct instance *instance, double *values, size_t count) {
    return instance_states(instance, values, count);
}

int instance_rates(struct instance *instance, double *values, size_t count) {
    return instance_states(instance, values, count);
}

int instance_indicators(struct instance *instance, double *values, size_t count) {
    (void)values;
    return count == 0 ? STATUS_OK : absent(instance, "event indicators");
}

int instance_completed(struct instance *instance) {
    return absent(instance, "Model Exchange");
}

int instance_derivatives(struct instance *instance, const uint32_t *unknowns, size_t count, const uint32_t *knowns,
                         size_t known_count, const double *seeds, double *found, int adjoint) {
    (void)unknowns, (void)count, (void)knowns, (void)known_count, (void)seeds, (void)found, (void)adjoint;
    return absent(instance, "derivatives");
}
