/* The drive behind FMI's functions. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "drive.h"
#include "model.h"

struct self {
    struct table *table;
    struct drive drive;
    struct direction direction;
};

static void *open_drive(const char *path, char message[MESSAGE_SIZE]) {
    struct table *table = table_open(path, message);
    struct self *self = table == NULL ? NULL : calloc(1, sizeof *self);
    if (self == NULL) {
        if (table != NULL) {
            snprintf(message, MESSAGE_SIZE, "there is not enough memory for an instance.");
            table_close(table);
        }
        return NULL;
    }
    self->table = table;
    drive_open(&self->drive, table);
    return self;
}

static void close_drive(void *of) {
    struct self *self = of;
    table_close(self->table);
    free(self);
}

static const char *token(const void *of) {
    const struct self *self = of;
    return self->table->token;
}

static const struct variable *variables(const void *of, uint32_t *count) {
    const struct self *self = of;
    *count = self->table->variables;
    return self->table->variable;
}

static struct drive *drive_of(void *of) {
    return &((struct self *)of)->drive;
}

static const struct drive *constant(const void *of) {
    return &((const struct self *)of)->drive;
}

static void reset(void *of) {
    drive_reset(drive_of(of));
}

static int start(void *of, char message[MESSAGE_SIZE]) {
    return drive_start(drive_of(of), message);
}

static int step(void *of, double time, double length, char message[MESSAGE_SIZE]) {
    return drive_step(drive_of(of), time, length, message);
}

static int get(void *of, const struct variable *variable, double *value, char message[MESSAGE_SIZE]) {
    return drive_get(drive_of(of), variable, value, message);
}

static int set(void *of, const struct variable *variable, double value, char message[MESSAGE_SIZE]) {
    return drive_set(drive_of(of), variable, value, message);
}

static double *time_of(void *of) {
    return &drive_of(of)->state.time;
}

static int initializing(const void *of) {
    return constant(of)->initializing;
}

static int outside(const void *of, char message[MESSAGE_SIZE]) {
    const struct drive *drive = constant(of);
    if (!drive_outside(drive)) {
        return 0;
    }
    snprintf(message, MESSAGE_SIZE, "at %g s the torque is beyond the %g N.m of the FMU's tables: what goes on there has no "
             "stated accuracy (--largest-torque makes them longer). This is said once.", drive->state.time,
             fmin(drive->table->side[0].reach, drive->table->side[1].reach));
    return 1;
}

static size_t state_size(const void *of) {
    (void)of;
    return drive_state_size();
}

static void state_write(const void *of, unsigned char *bytes) {
    drive_state_write(constant(of), bytes);
}

static void state_seal(const void *of, unsigned char *bytes) {
    (void)of;
    drive_state_seal(bytes);
}

static int state_check(const void *of, const unsigned char *bytes, size_t size, int sealed, char message[MESSAGE_SIZE]) {
    return drive_state_check(constant(of), bytes, size, sealed, message);
}

static void state_read(void *of, const unsigned char *bytes) {
    drive_state_read(drive_of(of), bytes);
}

/* ---- Model Exchange ---- */

static void prepare(void *of, int exchange, int early) {
    drive_of(of)->exchange = exchange;
    drive_of(of)->early = early;
}

static int exchanges(const void *of) {
    return constant(of)->exchange;
}

static void set_event_mode(void *of, int on) {
    drive_of(of)->state.event_mode = on;
}

static int in_event_mode(const void *of) {
    return constant(of)->state.event_mode != 0.0;
}

static double rest(const void *of) {
    return constant(of)->left;
}

static int event(const void *of) {
    return constant(of)->early && constant(of)->impact;
}

static size_t states(const void *of) {
    int fields[MOST_STATES];
    return (size_t)exchange_states(constant(of), fields);
}

static double *state_at(struct drive *drive, int field) {
    struct variable variable = {NULL, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0};
    variable.field = field;
    return drive_stored(&drive->state, &variable);
}

static void get_states(void *of, double *values) {
    int fields[MOST_STATES], count = exchange_states(constant(of), fields), i;
    for (i = 0; i < count; i++) {
        values[i] = *state_at(drive_of(of), fields[i]);
    }
}

static void set_states(void *of, const double *values) {
    int fields[MOST_STATES], count = exchange_states(constant(of), fields), i;
    for (i = 0; i < count; i++) {
        *state_at(drive_of(of), fields[i]) = values[i];
    }
    drive_of(of)->solved = 0;
}

static void nominals(const void *of, double *values) {
    const struct table *table = constant(of)->table;
    int fields[MOST_STATES], count = exchange_states(constant(of), fields), i;
    for (i = 0; i < count; i++) {
        uint32_t j = 0;
        while (j < table->variables && table->variable[j].field != fields[i]) {
            j++;
        }
        values[i] = j < table->variables && table->variable[j].nominal > 0.0 ? table->variable[j].nominal : 1.0;
    }
}

static int solve(void *of, char message[MESSAGE_SIZE]) {
    return exchange_solve(drive_of(of), message);
}

static void rates(void *of, double *values) {
    int fields[MOST_STATES], count = exchange_states(constant(of), fields), i;
    for (i = 0; i < count; i++) {
        values[i] = exchange_rate(constant(of), fields[i]);
    }
}

static void indicators(void *of, double values[EVENT_INDICATORS]) {
    exchange_indicators(drive_of(of), values);
}

static void accept(void *of) {
    exchange_keep(drive_of(of));
}

static void begin(void *of) {
    derivative_begin(&((struct self *)of)->direction);
}

static int seed(void *of, const struct variable *known, double value, char message[MESSAGE_SIZE]) {
    return derivative_seed(constant(of), &((struct self *)of)->direction, known, value, message);
}

static int derivative(void *of, const struct variable *unknown, double *value, char message[MESSAGE_SIZE]) {
    return derivative_of(drive_of(of), &((struct self *)of)->direction, unknown, value, message);
}

static const struct exchange EXCHANGE = {
    prepare, exchanges, set_event_mode, in_event_mode, rest, event, states, get_states, set_states, nominals, solve, rates,
    indicators, accept, begin, seed, derivative,
};

const struct model drive_model = {
    TABLE_FILE, open_drive, close_drive, token, variables, reset, start, step, get, set, time_of, initializing, outside,
    state_size, state_write, state_seal, state_check, state_read, &EXCHANGE,
};
