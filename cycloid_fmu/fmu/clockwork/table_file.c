#include "table.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#define WIN32_LEAN_AND_MEAN
#include <windows.h>
#else
#include <pthread.h>
#endif

static const struct resource_kind KIND = {TABLE_MAGIC, TABLE_VERSION, "this is not a table of a cycloid drive"};

/* The size of a step at each load. */
static void read_steps(struct reader *reader, uint32_t count, double *step) {
    uint32_t j;
    for (j = 0; j < count; j++) {
        step[j] = reader_number(reader);
        reader->failed |= !(step[j] > 0.0 && step[j] < 1e20);
    }
}

/* The file has them as differences from one crank angle to the next. */
static const int16_t *read_transmission_error(struct reader *reader, uint32_t angles, uint32_t loads) {
    uint16_t *first = reader_words(reader, (size_t)angles * loads), *row = first, *end;
    uint32_t j;
    if (first == NULL) {
        return NULL;
    }
    for (end = first + (size_t)angles * loads - loads; row < end; row += loads) {
        for (j = 0; j < loads; j++) {
            row[loads + j] = (uint16_t)(row[loads + j] + row[j]);
        }
    }
    return (const int16_t *)first;
}

static void read_loads(struct reader *reader, uint32_t count, double *load) {
    uint32_t j;
    for (j = 0; j < count; j++) {
        load[j] = reader_number(reader);
        if (!(j == 0 ? load[j] == 0.0 : load[j] > load[j - 1] && load[j] < HUGE_VAL)) {
            reader->failed = 1;
        }
    }
}

static void read_side(struct reader *reader, const struct table *table, struct side *side) {
    uint32_t j;
    read_loads(reader, side->loads, side->load);
    read_loads(reader, side->pressure_loads, side->pressure_load);
    side->reach = side->pressure_load[side->pressure_loads - 1]; /* one cell beyond the last load */
    reader->failed |= side->reach != side->load[side->loads - 2];
    for (j = 0; j < side->loads; j++) {
        side->base[j] = reader_number(reader);
        reader->failed |= !(fabs(side->base[j]) < 1e20);
    }
    read_steps(reader, side->loads, side->step);
    read_steps(reader, side->loads, side->compliance_step);
    read_steps(reader, side->pressure_loads, side->pressure_step);
    side->transmission_error = read_transmission_error(reader, table->angles, side->loads);
    side->compliance = reader_words(reader, (size_t)table->angles * side->loads);
    side->pressure = reader_words(reader, (size_t)table->pressure_angles * side->pressure_loads);
    side->contact_count = reader_take(reader, (size_t)table->pressure_angles * side->pressure_loads);
    reader_align(reader);
}

/* The mean of the torque is removed: a whole crank turn does no work. Its integral is the energy at the nodes. */
static void integrate_rest(struct table *table) {
    double mean = 0.0, least = 0.0, width = table->period / table->angles, *c = table->rest_torque;
    uint32_t i, n = table->angles;
    for (i = 0; i < n; i++) {
        mean += c[i] / n;
    }
    for (i = 0; i < n; i++) {
        c[i] -= mean;
    }
    for (i = 1; i < n; i++) {
        double mass = c[(i + n - 2) % n] + 11.0 * c[i - 1] + 11.0 * c[i] + c[(i + 1) % n];
        table->rest_energy[i] = table->rest_energy[i - 1] + width * mass / 24.0;
        least = table->rest_energy[i] < least ? table->rest_energy[i] : least;
    }
    for (i = 0; i < n; i++) {
        table->rest_energy[i] -= least;
    }
}

static void read_rest(struct reader *reader, struct table *table, uint32_t n) {
    if (n > 0 && !reader->failed) {
        table->rest_torque = reader_numbers(reader, n);
        table->rest_energy = reader_allocate(reader, n, sizeof *table->rest_energy);
    }
    if (n > 0 && !reader->failed) {
        integrate_rest(table);
    }
}

/* Nodes that ascend from 0. */
static void read_ascending(struct reader *reader, double *nodes, uint32_t count) {
    uint32_t i;
    for (i = 0; i < count; i++) {
        nodes[i] = reader_number(reader);
        reader->failed |= !(i == 0 ? nodes[0] == 0.0 : nodes[i] > nodes[i - 1] && nodes[i] < HUGE_VAL);
    }
}

static void read_ripple(struct reader *reader, struct ripple *ripple) {
    uint32_t i, j, k;
    ripple->orders = (uint32_t)reader_whole(reader, 4);
    ripple->speeds = (uint32_t)reader_whole(reader, 4);
    ripple->loads = (uint32_t)reader_whole(reader, 4);
    if (ripple->orders > MOST_RIPPLE_ORDERS || ripple->speeds > MOST_RIPPLE_SPEEDS || ripple->loads > MOST_RIPPLE_LOADS
        || (ripple->orders > 0 && (ripple->speeds < 2 || ripple->loads < 2))) {
        reader->failed = 1;
        return;
    }
    for (k = 0; k < ripple->orders; k++) {
        ripple->order[k] = reader_number(reader);
        reader->failed |= !(fabs(ripple->order[k]) < 1e9);
    }
    read_ascending(reader, ripple->speed, ripple->speeds);
    read_ascending(reader, ripple->load, ripple->loads);
    for (i = 0; i < 4 * ripple->speeds; i++) {
        for (j = 0; j < ripple->loads; j++) {
            for (k = 0; k < 2 * ripple->orders; k++) {
                double *part = &ripple->part[i / 4][i / 2 % 2][i % 2][j][k / 2][k % 2];
                *part = reader_number(reader);
                reader->failed |= !(fabs(*part) < 1e3);
            }
        }
    }
}

static void read_body(struct reader *reader, struct table *table) {
    uint32_t i, rest;
    int tabled;
    double *numbers[7];
    table->offers = (uint32_t)reader_whole(reader, 4);
    reader->failed |= table->offers > INTERFACE_ROTOR;
    table->variable = reader_variables(reader, &table->variables, LOSS_TABLE + MOST_LOSS_ROWS * LOSS_COLUMNS);
    numbers[0] = &table->ratio, numbers[1] = &table->period, numbers[2] = &table->allowed;
    numbers[3] = &table->sun_teeth, numbers[4] = &table->planet_teeth, numbers[5] = &table->sun_play;
    numbers[6] = &table->bearing_play;
    for (i = 0; i < 7; i++) {
        *numbers[i] = reader_number(reader);
    }
    read_ripple(reader, &table->ripple);
    table->angles = (uint32_t)reader_whole(reader, 4);
    table->pressure_angles = (uint32_t)reader_whole(reader, 4);
    rest = (uint32_t)reader_whole(reader, 4);
    tabled = table->angles > 0;
    for (i = 0; i < 2; i++) {
        struct side *side = &table->side[i];
        side->loads = (uint32_t)reader_whole(reader, 4);
        side->pressure_loads = (uint32_t)reader_whole(reader, 4);
        if (tabled
            && (side->loads < 3 || side->loads > MOST_LOADS || side->pressure_loads < 2 || side->pressure_loads > MOST_LOADS)) {
            reader->failed = 1;
        }
    }
    if (!(table->sun_teeth >= 0.0 && table->sun_teeth < 1e6 && table->planet_teeth >= 0.0 && table->planet_teeth < 1e9
          && (table->sun_teeth == 0.0 || table->planet_teeth > 0.0) && fabs(table->sun_play) < 10.0
          && fabs(table->bearing_play) < 1.0)) {
        reader->failed = 1;
    }
    if (!(fabs(table->ratio) >= 1.0 && table->period > 0.0 && table->period < 1e6
          && (table->pressure_angles >= 4 || !tabled) && table->pressure_angles <= table->angles && table->angles <= 100000000u
          && (rest == 0 || rest == table->angles))) {
        reader->failed = 1;
    }
    reader_align(reader);
    for (i = 0; i < 2 && tabled && !reader->failed; i++) {
        read_side(reader, table, &table->side[i]);
    }
    read_rest(reader, table, rest);
    reader_align(reader);
    table->token = reader_text(reader);
    reader_align(reader);
    reader->failed |= reader->at != reader->end;
}

/* Read the file after its head, which is in the table already; returns NULL, or what is wrong with it. */
static const char *read_rest_of_file(struct table *table, FILE *file) {
    struct reader reader = {NULL, NULL, NULL, 0};
    const char *wrong = resource_read(file, &KIND, table->head, &reader);
    table->file = reader.start;
    if (wrong != NULL) {
        return wrong;
    }
    table->checksum = resource_checksum(table->head, TABLE_HEAD);
    read_body(&reader, table);
    return reader.failed ? RESOURCE_DAMAGED : NULL;
}

static void table_free(struct table *table) {
    free(table->file);
    variables_free(table->variable, table->variables);
    free(table->token);
    free(table->rest_torque);
    free(table->rest_energy);
    free(table);
}

/* ---- tables of this process ---- */

static struct table *tables = NULL;

#ifdef _WIN32
static SRWLOCK tables_lock = SRWLOCK_INIT;
static void lock_tables(void) {
    AcquireSRWLockExclusive(&tables_lock);
}
static void unlock_tables(void) {
    ReleaseSRWLockExclusive(&tables_lock);
}
#else
static pthread_mutex_t tables_lock = PTHREAD_MUTEX_INITIALIZER;
static void lock_tables(void) {
    pthread_mutex_lock(&tables_lock);
}
static void unlock_tables(void) {
    pthread_mutex_unlock(&tables_lock);
}
#endif

static struct table *table_of(FILE *file, const char **wrong) {
    struct table *opened = calloc(1, sizeof *opened), *known;
    *wrong = opened == NULL ? "there is not enough memory for it" : NULL;
    if (opened != NULL && fread(opened->head, 1, TABLE_HEAD, file) != TABLE_HEAD) {
        *wrong = KIND.unknown;
    }
    for (known = tables; *wrong == NULL && known != NULL; known = known->next) {
        if (memcmp(known->head, opened->head, TABLE_HEAD) == 0) {
            free(opened);
            return known;
        }
    }
    *wrong = *wrong == NULL ? read_rest_of_file(opened, file) : *wrong;
    if (*wrong == NULL) {
        opened->next = tables;
        tables = opened;
    } else if (opened != NULL) {
        table_free(opened);
    }
    return *wrong == NULL ? opened : NULL;
}

struct table *table_open(const char *path, char message[MESSAGE_SIZE]) {
    FILE *file = resource_open(path);
    const char *wrong = "the table can't be read";
    struct table *table = NULL;
    if (file != NULL) {
        lock_tables();
        table = table_of(file, &wrong);
        if (table != NULL) {
            table->users++;
        }
        unlock_tables();
        fclose(file);
    }
    if (table == NULL) {
        snprintf(message, MESSAGE_SIZE, "%.300s: %s.", path, wrong);
    }
    return table;
}

struct table *table_read(const unsigned char *file, size_t size) {
    struct table *table = calloc(1, sizeof *table);
    struct reader reader = {NULL, NULL, NULL, 0};
    if (table == NULL || size < TABLE_HEAD || (table->file = malloc(size)) == NULL) {
        free(table);
        return NULL;
    }
    memcpy(table->head, file, TABLE_HEAD);
    memcpy(table->file, file + TABLE_HEAD, size - TABLE_HEAD);
    reader.start = reader.at = table->file;
    reader.end = table->file + (size - TABLE_HEAD);
    table->checksum = resource_checksum(table->head, TABLE_HEAD);
    read_body(&reader, table);
    if (reader.failed) {
        table_free(table);
        return NULL;
    }
    table->users = 1;
    return table;
}

void table_close(struct table *table) {
    struct table **at;
    if (table == NULL) {
        return;
    }
    lock_tables();
    if (--table->users == 0) {
        for (at = &tables; *at != NULL && *at != table;) {
            at = &(*at)->next;
        }
        if (*at != NULL) {
            *at = table->next;
        }
        table_free(table);
    }
    unlock_tables();
}
