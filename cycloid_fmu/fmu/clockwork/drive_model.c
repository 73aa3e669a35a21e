/* The drive behind FMI's functions. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "drive.h"
#include "model.h"

struct drive_instance {
    struct table *table;
    struct drive drive;
    struct direction direction;
};

static void *open_drive(const char *path, char message[MESSAGE_SIZE]) {
    struct table *table = table_open(path, message);
    struct drive_instance *instance = table == NULL ? NULL : calloc(1, sizeof *instance);
    if (instance == NULL) {
        if (table != NULL) {
            snprintf(message, MESSAGE_SIZE, "there is not enough memory for an instance.");
            table_close(table);
        }
        return NULL;
    }
    instance->table = table;
    drive_open(&instance->drive, table);
    return instance;
}

static void close_drive(void *self) {
    struct drive_instance *instance = self;
    table_close(instance->table);
    free(instance);
}

static const char *token(const void *self) {
    const struct drive_instance *instance = self;
    return instance->table->token;
}

static const struct variable *variables(const void *self, uint32_t *count) {
    const struct drive_instance *instance = self;
    *count = instance->table->variables;
    return instance->table->variable;
}

static struct drive *drive_of(void *self) {
    return &((struct drive_instance *)self)->drive;
}

static const struct drive *constant(const void *self) {
    return &((const struct drive_instance *)self)->drive;
}

static void reset(void *self) {
    drive_reset(drive_of(self));
}

static int start(void *self, char message[MESSAGE_SIZE]) {
    return drive_start(drive_of(self), message);
}

static int step(void *self, double time, double length, char message[MESSAGE_SIZE]) {
    return drive_step(drive_of(self), time, length, message);
}

static int get(void *self, const struct variable *variable, double *value, char message[MESSAGE_SIZE]) {
    return drive_get(drive_of(self), variable, value, message);
}

static int set(void *self, const struct variable *variable, double value, char message[MESSAGE_SIZE]) {
    return drive_set(drive_of(self), variable, value, message);
}

static double *time_of(void *self) {
    return &drive_of(self)->state.time;
}

static int initializing(const void *self) {
    return constant(self)->initializing;
}

static int outside(const void *self, char message[MESSAGE_SIZE]) {
    const struct drive *drive = constant(self);
    if (!drive_outside(drive)) {
        return 0;
    }
    snprintf(message, MESSAGE_SIZE, "at %g s the torque is beyond the %g N.m of the FMU's tables: what goes on there has no "
             "stated accuracy (--largest-torque makes them longer). This is said once.", drive->state.time,
             fmin(drive->table->side[0].reach, drive->table->side[1].reach));
    return 1;
}

static size_t state_size(const void *self) {
    (void)self;
    return drive_state_size();
}

static void state_write(const void *self, unsigned char *bytes) {
    drive_state_write(constant(self), bytes);
}

static void state_seal(const void *self, unsigned char *bytes) {
    (void)self;
    drive_state_seal(bytes);
}

static int state_check(const void *self, const unsigned char *bytes, size_t size, int sealed, char message[MESSAGE_SIZE]) {
    return drive_state_check(constant(self), bytes, size, sealed, message);
}

static void state_read(void *self, const unsigned char *bytes) {
    drive_state_read(drive_of(self), bytes);
}

/* ---- Model Exchange ---- */

static void prepare(void *self, int exchange, int early) {
    drive_of(self)->exchange = exchange;
    drive_of(self)->early = early;
}

static int exchanges(const void *self) {
    return constant(self)->exchange;
}

static void set_event_mode(void *self, int on) {
    drive_of(self)->state.event_mode = on;
}

static int in_event_mode(const void *self) {
    return constant(self)->state.event_mode != 0.0;
}

static double rest(const void *self) {
    return constant(self)->remaining;
}

static int event(const void *self) {
    return constant(self)->early && constant(self)->impact;
}

static size_t states(const void *self) {
    int fields[MOST_STATES];
    return (size_t)exchange_states(constant(self), fields);
}

static double *state_at(struct drive *drive, int field) {
    struct variable variable = {NULL, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0};
    variable.field = field;
    return drive_stored(&drive->state, &variable);
}

static void get_states(void *self, double *values) {
    int fields[MOST_STATES], count = exchange_states(constant(self), fields), i;
    for (i = 0; i < count; i++) {
        values[i] = *state_at(drive_of(self), fields[i]);
    }
}

static void set_states(void *self, const double *values) {
    int fields[MOST_STATES], count = exchange_states(constant(self), fields), i;
    for (i = 0; i < count; i++) {
        *state_at(drive_of(self), fields[i]) = values[i];
    }
    drive_of(self)->solved = 0;
}

static void nominals(const void *self, double *values) {
    const struct table *table = constant(self)->table;
    int fields[MOST_STATES], count = exchange_states(constant(self), fields), i;
    for (i = 0; i < count; i++) {
        uint32_t j = 0;
        while (j < table->variables && table->variable[j].field != fields[i]) {
            j++;
        }
        values[i] = j < table->variables && table->variable[j].nominal > 0.0 ? table->variable[j].nominal : 1.0;
    }
}

static int solve(void *self, char message[MESSAGE_SIZE]) {
    return exchange_solve(drive_of(self), message);
}

static void rates(void *self, double *values) {
    int fields[MOST_STATES], count = exchange_states(constant(self), fields), i;
    for (i = 0; i < count; i++) {
        values[i] = exchange_rate(drive_of(self), fields[i]);
    }
}

static void indicators(void *self, double values[EVENT_INDICATORS]) {
    exchange_indicators(drive_of(self), values);
}

static void accept(void *self) {
    exchange_keep(drive_of(self));
}

static void begin(void *self) {
    derivative_begin(&((struct drive_instance *)self)->direction);
}

static int seed(void *self, const struct variable *known, double value, char message[MESSAGE_SIZE]) {
    return derivative_seed(constant(self), &((struct drive_instance *)self)->direction, known, value, message);
}

static int derivative(void *self, const struct variable *unknown, double *value, char message[MESSAGE_SIZE]) {
    return derivative_of(drive_of(self), &((struct drive_instance *)self)->direction, unknown, value, message);
}

static const struct exchange EXCHANGE = {
    prepare, exchanges, set_event_mode, in_event_mode, rest, event, states, get_states, set_states, nominals, solve, rates,
    indicators, accept, begin, seed, derivative,
};

const struct model drive_model = {
    TABLE_FILE, open_drive, close_drive, token, variables, reset, start, step, get, set, time_of, initializing, outside,
    state_size, state_write, state_seal, state_check, state_read, &EXCHANGE,
};
