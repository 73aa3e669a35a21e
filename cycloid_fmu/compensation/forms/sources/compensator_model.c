/* A compensator behind FMI's functions: Co-Simulation, each communication step is one step of the compensator. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "blob.h"
#include "compensator.h"
#include "compensator_numbers.h"
#include "model.h"

/* Fields of the variables, in the order of cycloid_fmu/compensation/forms/fmu.py. */
enum {
    DESIRED_ANGLE, DESIRED_SPEED, LOAD_TORQUE, DRIVE_TEMPERATURE, MOTOR_MEASURED, OUTPUT_MEASURED, IS_MEASURED,
    INDEX, INDEX_PROBABILITY, MOTOR_ANGLE, MOTOR_SPEED, BAND, GAIN, HOLDS, CLOCK, FIELDS
};

/* Everything that later steps and outputs depend on: only doubles, so that it can be stored as it is. */
struct history {
    double value[FIELDS];
    struct compensator_memory memory;
};
enum { NUMBERS = sizeof(struct history) / sizeof(double) };

struct compensator_instance {
    unsigned char *file;
    double *arrays;
    char *token;
    struct variable *variable;
    uint32_t variables, checksum;
    struct compensator compensator;
    struct history history;
    int initializing;
};

static const struct resource_kind KIND = {COMPENSATOR_MAGIC, COMPENSATOR_VERSION, "this is not a table of a compensator"};
static const struct blob_kind STATE = {"compensator\n", COMPENSATOR_STATE_VERSION, "compensator",
                                       "this state belongs to another compensator."};

/* ---- the file ---- */

static int count(struct reader *reader) {
    uint64_t value = reader_whole(reader, 4);
    reader->failed |= value > 65535u;
    return reader->failed ? 0 : (int)value;
}

/* The sizes are checked before anything depends on them; values of the numbers can't reach other memory. */
static void read_numbers(struct reader *reader, struct compensator_instance *instance) {
    struct compensator *c = &instance->compensator;
    size_t total = 0;
    double *next;
    int n;
#define COUNT(NAME) c->NAME = count(reader);
    COMPENSATOR_COUNTS(COUNT)
    if (c->functions > MOST_FUNCTIONS || c->torques < 2 || c->torques > 4096 || c->temperatures < 1 || c->temperatures > 256
        || c->stribeck_speeds < 1 || c->warmths < 1) {
        reader->failed = 1;
        return;
    }
#define SCALAR(NAME) c->NAME = reader_number(reader), reader->failed |= !(fabs(c->NAME) < HUGE_VAL);
    COMPENSATOR_SCALARS(SCALAR)
#define SIZE(NAME, COUNT_OF) total += (size_t)(COUNT_OF);
    COMPENSATOR_ARRAYS(SIZE)
    next = instance->arrays = reader_numbers(reader, total);
    for (n = 0; n < c->functions && !reader->failed; n++) {
        uint32_t knots = (uint32_t)reader_whole(reader, 4), bytes = (uint32_t)reader_whole(reader, 4);
        struct spline *spline = &c->spline[n];
        if (knots < 1 || knots > 100000000u || (bytes != 1 && bytes != 2)) {
            reader->failed = 1;
            return;
        }
        spline->knots = knots;
        if (bytes == 1) {
            spline->small = (const int8_t *)reader_take(reader, knots + SUPPORT);
        } else {
            spline->large = (const int16_t *)reader_words(reader, knots + SUPPORT);
        }
        reader_align(reader);
    }
    if (!reader->failed) {
#define ARRAY(NAME, COUNT_OF) c->NAME = next, next += COUNT_OF;
        COMPENSATOR_ARRAYS(ARRAY)
    }
}

static const char *read_file(FILE *file, struct compensator_instance *instance) {
    unsigned char head[TABLE_HEAD];
    struct reader reader = {NULL, NULL, NULL, 0};
    const char *wrong = fread(head, 1, TABLE_HEAD, file) == TABLE_HEAD ? resource_read(file, &KIND, head, &reader)
                                                                       : KIND.unknown;
    uint32_t i;
    instance->file = reader.start;
    if (wrong != NULL) {
        return wrong;
    }
    instance->checksum = resource_checksum(head, TABLE_HEAD);
    instance->variable = reader_variables(&reader, &instance->variables, FIELDS);
    for (i = 0; !reader.failed && i < instance->variables; i++) {
        reader.failed |= instance->variable[i].baked != 0;
    }
    reader_align(&reader);
    read_numbers(&reader, instance);
    reader_align(&reader);
    instance->token = reader_text(&reader);
    reader_align(&reader);
    return reader.failed || reader.at != reader.end ? RESOURCE_DAMAGED : NULL;
}

static void reset(void *self) {
    struct compensator_instance *instance = self;
    uint32_t i;
    memset(&instance->history, 0, sizeof instance->history);
    for (i = 0; i < instance->variables; i++) {
        instance->history.value[instance->variable[i].field] = instance->variable[i].start;
    }
    instance->initializing = 1;
}

static void close_compensator(void *self) {
    struct compensator_instance *instance = self;
    variables_free(instance->variable, instance->variables);
    free(instance->token);
    free(instance->arrays);
    free(instance->file);
    free(instance);
}

static void *open_compensator(const char *path, char message[MESSAGE_SIZE]) {
    struct compensator_instance *instance = calloc(1, sizeof *instance);
    FILE *file = instance == NULL ? NULL : resource_open(path);
    const char *wrong = instance == NULL ? "there is not enough memory for it"
        : file == NULL               ? "the table can't be read"
                                     : read_file(file, instance);
    if (file != NULL) {
        fclose(file);
    }
    if (wrong != NULL) {
        snprintf(message, MESSAGE_SIZE, "%.300s: %s.", path, wrong);
        if (instance != NULL) {
            close_compensator(instance);
        }
        return NULL;
    }
    reset(instance);
    return instance;
}

static const char *token(const void *self) {
    return ((const struct compensator_instance *)self)->token;
}

static const struct variable *variables(const void *self, uint32_t *count) {
    const struct compensator_instance *instance = self;
    *count = instance->variables;
    return instance->variable;
}

/* ---- steps ---- */

/* Make a step. Its memory is stored, except where outputs are read before the first step: the index may still be set then. */
static void make_step(struct compensator_instance *instance, int store) {
    double *value = instance->history.value;
    struct compensator_memory memory;
    struct compensator_command command;
    int measured = value[IS_MEASURED] != 0.0;
    if (instance->initializing) {
        compensator_start(&instance->compensator, &instance->history.memory, value[INDEX], value[INDEX_PROBABILITY]);
    }
    memory = instance->history.memory;
    command = compensator_step(&instance->compensator, &memory, value[DESIRED_ANGLE], value[DESIRED_SPEED], value[LOAD_TORQUE],
                               value[DRIVE_TEMPERATURE], measured ? value[MOTOR_MEASURED] : COMPENSATOR_NONE,
                               measured ? value[OUTPUT_MEASURED] : COMPENSATOR_NONE);
    if (store) {
        instance->history.memory = memory;
    }
    value[MOTOR_ANGLE] = command.motor_angle;
    value[MOTOR_SPEED] = command.motor_speed;
    value[BAND] = command.band;
    value[GAIN] = command.gain;
    value[HOLDS] = command.holds;
}

static int start(void *self, char message[MESSAGE_SIZE]) {
    struct compensator_instance *instance = self;
    (void)message;
    make_step(instance, 0);
    instance->initializing = 0;
    return 0;
}

static int step(void *self, double time, double length, char message[MESSAGE_SIZE]) {
    struct compensator_instance *instance = self;
    if (!(length >= 0.0 && length < HUGE_VAL && fabs(time + length) < HUGE_VAL)) {
        snprintf(message, MESSAGE_SIZE, "a step of %g s at %g s: both must be finite, and the step not below zero.", length,
                 time);
        return 1;
    }
    make_step(instance, 1);
    instance->history.value[CLOCK] = time + length;
    return 0;
}

static int get(void *self, const struct variable *variable, double *value, char message[MESSAGE_SIZE]) {
    struct compensator_instance *instance = self;
    (void)message;
    if (instance->initializing && variable->causality == CAUSALITY_OUTPUT) {
        make_step(instance, 0);
    }
    *value = instance->history.value[variable->field];
    return 0;
}

static int set(void *self, const struct variable *variable, double value, char message[MESSAGE_SIZE]) {
    struct compensator_instance *instance = self;
    if (variable->causality != CAUSALITY_INPUT && variable->causality != CAUSALITY_PARAMETER) {
        snprintf(message, MESSAGE_SIZE, "%.100s can't be set: outputs and time are results.", variable->name);
        return 1;
    }
    if (variable->fixed && !instance->initializing) {
        snprintf(message, MESSAGE_SIZE, "%.100s is fixed: it can be set until initialization ends.", variable->name);
        return 1;
    }
    if (!(fabs(value) < COMPENSATOR_NONE)) {
        snprintf(message, MESSAGE_SIZE, "%.100s = %g: it must be finite; a missing reading of an encoder is stated by "
                 "output_measured.", variable->name, value);
        return 1;
    }
    instance->history.value[variable->field] = variable->kind == KIND_BOOLEAN ? value != 0.0 : value;
    return 0;
}

static double *time_of(void *self) {
    return &((struct compensator_instance *)self)->history.value[CLOCK];
}

static int initializing(const void *self) {
    return ((const struct compensator_instance *)self)->initializing;
}

static int outside(const void *self, char message[MESSAGE_SIZE]) {
    (void)self, (void)message; /* the output `holds` says it */
    return 0;
}

/* ---- the state as bytes ---- */

static size_t state_size(const void *self) {
    (void)self;
    return blob_size(NUMBERS);
}

static void state_write(const void *self, unsigned char *bytes) {
    const struct compensator_instance *instance = self;
    blob_write(bytes, &STATE, instance->checksum, &instance->history, NUMBERS, (uint64_t)instance->initializing);
}

static void state_seal(const void *self, unsigned char *bytes) {
    blob_seal(bytes, state_size(self));
}

static int state_check(const void *self, const unsigned char *bytes, size_t size, int sealed, char message[MESSAGE_SIZE]) {
    return blob_check(bytes, size, &STATE, ((const struct compensator_instance *)self)->checksum, NUMBERS, sealed, message);
}

static void state_read(void *self, const unsigned char *bytes) {
    struct compensator_instance *instance = self;
    blob_read(bytes, &instance->history, NUMBERS);
    instance->initializing = (blob_flags(bytes, NUMBERS) & 1) != 0;
}

const struct model compensator_model = {
    COMPENSATOR_FILE, open_compensator, close_compensator, token, variables, reset, start, step, get, set, time_of,
    initializing, outside, state_size, state_write, state_seal, state_check, state_read, NULL,
};
