#define _CRT_SECURE_NO_WARNINGS /* Microsoft's compiler warns of _wfopen */
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

static const double LARGEST_FILE = 1e9;

struct reader {
    unsigned char *at;
    const unsigned char *end;
    int failed;
};

static unsigned char *take(struct reader *reader, size_t size) {
    unsigned char *taken = reader->at;
    if (reader->failed || (size_t)(reader->end - reader->at) < size) {
        reader->failed = 1;
        return NULL;
    }
    reader->at += size;
    return taken;
}

static uint64_t whole(struct reader *reader, size_t bytes) {
    const unsigned char *taken = take(reader, bytes);
    uint64_t value = 0;
    size_t i;
    for (i = 0; taken != NULL && i < bytes; i++) {
        value |= (uint64_t)taken[i] << (8 * i);
    }
    return value;
}

static double number(struct reader *reader) {
    uint64_t bits = whole(reader, 8);
    double value;
    memcpy(&value, &bits, 8);
    return value;
}

static void *allocate(struct reader *reader, size_t count, size_t size) {
    void *memory = reader->failed ? NULL : calloc(count > 0 ? count : 1, size);
    if (memory == NULL) {
        reader->failed = 1;
    }
    return memory;
}

static char *text(struct reader *reader) {
    size_t size = (size_t)whole(reader, 2);
    const unsigned char *taken = take(reader, size);
    char *copy = allocate(reader, size + 1, 1);
    if (copy != NULL && taken != NULL) {
        memcpy(copy, taken, size);
    }
    return copy;
}

uint32_t table_checksum(const unsigned char *data, size_t size) {
    static const uint32_t OF_HALF_BYTE[16] = {
        0x00000000, 0x1db71064, 0x3b6e20c8, 0x26d930ac, 0x76dc4190, 0x6b6b51f4, 0x4db26158, 0x5005713c,
        0xedb88320, 0xf00f9344, 0xd6d6a3e8, 0xcb61b38c, 0x9b64c2b0, 0x86d3d2d4, 0xa00ae278, 0xbdbdf21c,
    };
    uint32_t found = 0xffffffffu;
    size_t i;
    for (i = 0; i < size; i++) {
        found ^= data[i];
        found = OF_HALF_BYTE[found & 15u] ^ (found >> 4);
        found = OF_HALF_BYTE[found & 15u] ^ (found >> 4);
    }
    return ~found;
}

/* Read numbers, all of which must be finite. */
static double *numbers(struct reader *reader, size_t count) {
    double *values;
    size_t i;
    if (count > (size_t)(reader->end - reader->at) / 8) {
        reader->failed = 1;
    }
    values = allocate(reader, count, sizeof *values);
    for (i = 0; i < count && !reader->failed; i++) {
        values[i] = number(reader);
        reader->failed |= !(fabs(values[i]) < 1e30);
    }
    return values;
}

static int is_little_endian(void) {
    const uint16_t one = 1;
    return *(const unsigned char *)&one == 1;
}

/* Numbers of 16 bits, used in place in the file. */
static uint16_t *steps(struct reader *reader, size_t count) {
    unsigned char *at = take(reader, 2 * count);
    size_t i;
    for (i = 0; at != NULL && i < count && !is_little_endian(); i++) {
        unsigned char low = at[2 * i];
        at[2 * i] = at[2 * i + 1];
        at[2 * i + 1] = low;
    }
    return (uint16_t *)(void *)at;
}

/* The size of a step at each load. */
static void read_steps(struct reader *reader, uint32_t count, double *step) {
    uint32_t j;
    for (j = 0; j < count; j++) {
        step[j] = number(reader);
        reader->failed |= !(step[j] > 0.0 && step[j] < 1e20);
    }
}

/* The file has them as differences from one crank angle to the next. */
static const int16_t *read_deviation(struct reader *reader, uint32_t angles, uint32_t loads) {
    uint16_t *first = steps(reader, (size_t)angles * loads), *row = first, *end;
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

/* The next item begins at a multiple of 8 bytes in the file. */
static void align(struct reader *reader, const struct table *table) {
    take(reader, (size_t)(-(intptr_t)(reader->at - table->file) & 7));
}

static void read_loads(struct reader *reader, uint32_t count, double *load) {
    uint32_t j;
    for (j = 0; j < count; j++) {
        load[j] = number(reader);
        if (!(j == 0 ? load[j] == 0.0 : load[j] > load[j - 1] && load[j] < HUGE_VAL)) {
            reader->failed = 1;
        }
    }
}

static void read_side(struct reader *reader, const struct table *table, struct side *side) {
    uint32_t j;
    read_loads(reader, side->loads, side->load);
    read_loads(reader, side->told_loads, side->told_load);
    side->reach = side->told_load[side->told_loads - 1]; /* one cell beyond the last load */
    reader->failed |= side->reach != side->load[side->loads - 2];
    for (j = 0; j < side->loads; j++) {
        side->base[j] = number(reader);
        reader->failed |= !(fabs(side->base[j]) < 1e20);
    }
    read_steps(reader, side->loads, side->step);
    read_steps(reader, side->loads, side->compliance_step);
    read_steps(reader, side->told_loads, side->pressure_step);
    side->deviation = read_deviation(reader, table->angles, side->loads);
    side->compliance = steps(reader, (size_t)table->angles * side->loads);
    side->pressure = steps(reader, (size_t)table->told_angles * side->told_loads);
    side->contact_count = take(reader, (size_t)table->told_angles * side->told_loads);
    align(reader, table);
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
        table->rest_torque = numbers(reader, n);
        table->rest_energy = allocate(reader, n, sizeof *table->rest_energy);
    }
    if (n > 0 && !reader->failed) {
        integrate_rest(table);
    }
}

static void read_variable(struct reader *reader, struct variable *v) {
    v->name = text(reader);
    v->kind = (int)whole(reader, 1);
    v->causality = (int)whole(reader, 1);
    v->baked = (int)whole(reader, 1);
    v->fixed = (int)whole(reader, 1);
    v->field = (int)(int32_t)(uint32_t)whole(reader, 4);
    v->least = number(reader);
    v->most = number(reader);
    v->start = number(reader);
    v->nominal = number(reader);
    if (v->field < (v->baked ? -1 : 0) || v->field >= LOSS_TABLE + MOST_LOSS_ROWS * LOSS_COLUMNS) {
        reader->failed = 1;
    }
}

static void read_body(struct reader *reader, struct table *table) {
    uint32_t i, rest;
    int tabled;
    double *numbers[7];
    table->offers = (uint32_t)whole(reader, 4);
    table->variables = (uint32_t)whole(reader, 4);
    if (table->offers > INTERFACE_INERTIA || table->variables > 100000) {
        reader->failed = 1;
    }
    table->variable = allocate(reader, table->variables, sizeof *table->variable);
    for (i = 0; i < table->variables && !reader->failed; i++) {
        read_variable(reader, &table->variable[i]);
    }
    numbers[0] = &table->ratio, numbers[1] = &table->period, numbers[2] = &table->allowed;
    numbers[3] = &table->sun_teeth, numbers[4] = &table->planet_teeth, numbers[5] = &table->sun_play;
    numbers[6] = &table->bearing_play;
    for (i = 0; i < 7; i++) {
        *numbers[i] = number(reader);
    }
    table->angles = (uint32_t)whole(reader, 4);
    table->told_angles = (uint32_t)whole(reader, 4);
    rest = (uint32_t)whole(reader, 4);
    tabled = table->angles > 0;
    for (i = 0; i < 2; i++) {
        struct side *side = &table->side[i];
        side->loads = (uint32_t)whole(reader, 4);
        side->told_loads = (uint32_t)whole(reader, 4);
        if (tabled && (side->loads < 3 || side->loads > MOST_LOADS || side->told_loads < 2 || side->told_loads > MOST_LOADS)) {
            reader->failed = 1;
        }
    }
    if (!(table->sun_teeth >= 0.0 && table->sun_teeth < 1e6 && table->planet_teeth >= 0.0 && table->planet_teeth < 1e9
          && (table->sun_teeth == 0.0 || table->planet_teeth > 0.0) && fabs(table->sun_play) < 10.0
          && fabs(table->bearing_play) < 1.0)) {
        reader->failed = 1;
    }
    if (!(fabs(table->ratio) >= 1.0 && table->period > 0.0 && table->period < 1e6
          && (table->told_angles >= 4 || !tabled) && table->told_angles <= table->angles && table->angles <= 100000000u
          && (rest == 0 || rest == table->angles))) {
        reader->failed = 1;
    }
    align(reader, table);
    for (i = 0; i < 2 && tabled && !reader->failed; i++) {
        read_side(reader, table, &table->side[i]);
    }
    read_rest(reader, table, rest);
    align(reader, table);
    table->token = text(reader);
    align(reader, table);
    reader->failed |= reader->at != reader->end;
}

static FILE *open_utf8(const char *path) {
#ifdef _WIN32
    FILE *file = NULL;
    int size = MultiByteToWideChar(CP_UTF8, 0, path, -1, NULL, 0);
    wchar_t *wide = size > 0 ? calloc((size_t)size, sizeof *wide) : NULL;
    if (wide != NULL && MultiByteToWideChar(CP_UTF8, 0, path, -1, wide, size) > 0) {
        file = _wfopen(wide, L"rb");
    }
    free(wide);
    return file;
#else
    return fopen(path, "rb");
#endif
}

static uint32_t word(const unsigned char *data) {
    return (uint32_t)data[0] | (uint32_t)data[1] << 8 | (uint32_t)data[2] << 16 | (uint32_t)data[3] << 24;
}

/* Sum of the file's words, and sum of the partial sums (Fletcher, IEEE Trans. Comm. 30 (1982) 247): no two damaged words
   leave both unchanged. Four words at a time with separate sums, because each addition waits for the one before. */
static void sums(const unsigned char *data, size_t size, uint64_t found[2]) {
    uint64_t first[4] = {0, 0, 0, 0}, second[4] = {0, 0, 0, 0};
    size_t i;
    int k;
    for (i = 0; i + 16 <= size; i += 16) {
        for (k = 0; k < 4; k++) {
            first[k] += word(data + i + 4 * k);
            second[k] += first[k];
        }
    }
    found[0] = first[0] + first[1] + first[2] + first[3];
    found[1] = 4 * (second[0] + second[1] + second[2] + second[3]) - first[1] - 2 * first[2] - 3 * first[3];
    for (; i + 4 <= size; i += 4) {
        found[0] += word(data + i);
        found[1] += found[0];
    }
}

/* The size of the file after its head, which is in the table already; or a message. */
static const char *read_head(struct table *table, size_t *size, uint64_t stated[2]) {
    struct reader head = {table->head + 8, table->head + TABLE_HEAD, 0};
    uint32_t version = (uint32_t)whole(&head, 4);
    *size = (size_t)whole(&head, 4);
    stated[0] = whole(&head, 8);
    stated[1] = whole(&head, 8);
    if (memcmp(table->head, TABLE_MAGIC, 8) != 0) {
        return "this is not a table of a cycloid drive";
    }
    if (version != TABLE_VERSION) {
        return "the table is of another version than this FMU reads; build the FMU again";
    }
    table->file = (double)*size < LARGEST_FILE ? malloc(*size + 1) : NULL;
    if (table->file == NULL) {
        return "the table is damaged, or there is not enough memory for it";
    }
    return NULL;
}

static const char *read_file(struct table *table, size_t size, const uint64_t stated[2]) {
    struct reader reader;
    uint64_t found[2];
    sums(table->file, size, found);
    if (found[0] != stated[0] || found[1] != stated[1]) {
        return "the table is damaged: its checksum does not fit";
    }
    table->checksum = table_checksum(table->head, TABLE_HEAD);
    reader.at = table->file;
    reader.end = table->file + size;
    reader.failed = 0;
    read_body(&reader, table);
    return reader.failed ? "the table is damaged, or there is not enough memory for it" : NULL;
}

/* Read the file after its head, which is in the table already, or write a message. */
static const char *read_rest_of_file(struct table *table, FILE *file) {
    size_t size;
    uint64_t stated[2];
    const char *wrong = read_head(table, &size, stated);
    if (wrong == NULL && (size % 4 != 0 || fread(table->file, 1, size + 1, file) != size)) {
        wrong = "the table is damaged: it has another size than it says";
    }
    return wrong == NULL ? read_file(table, size, stated) : wrong;
}

static void table_free(struct table *table) {
    uint32_t i;
    for (i = 0; table->variable != NULL && i < table->variables; i++) {
        free(table->variable[i].name);
    }
    free(table->file);
    free(table->variable);
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
    struct table *made = calloc(1, sizeof *made), *known;
    *wrong = made == NULL ? "there is not enough memory for it" : NULL;
    if (made != NULL && fread(made->head, 1, TABLE_HEAD, file) != TABLE_HEAD) {
        *wrong = "this is not a table of a cycloid drive";
    }
    for (known = tables; *wrong == NULL && known != NULL; known = known->next) {
        if (memcmp(known->head, made->head, TABLE_HEAD) == 0) {
            free(made);
            return known;
        }
    }
    *wrong = *wrong == NULL ? read_rest_of_file(made, file) : *wrong;
    if (*wrong == NULL) {
        made->next = tables;
        tables = made;
    } else if (made != NULL) {
        table_free(made);
    }
    return *wrong == NULL ? made : NULL;
}

struct table *table_open(const char *path, char message[MESSAGE_SIZE]) {
    FILE *file = open_utf8(path);
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

struct table *table_read(const unsigned char *file, size_t size, char message[MESSAGE_SIZE]) {
    struct table *table = calloc(1, sizeof *table);
    const char *wrong = table == NULL ? "there is not enough memory for it" : NULL;
    size_t rest = 0;
    uint64_t stated[2];
    if (wrong == NULL && size < TABLE_HEAD) {
        wrong = "this is not a table of a cycloid drive";
    }
    if (wrong == NULL) {
        memcpy(table->head, file, TABLE_HEAD);
        wrong = read_head(table, &rest, stated);
    }
    if (wrong == NULL && (rest % 4 != 0 || rest != size - TABLE_HEAD)) {
        wrong = "the table is damaged: it has another size than it says";
    }
    if (wrong == NULL) {
        memcpy(table->file, file + TABLE_HEAD, rest);
        wrong = read_file(table, rest, stated);
    }
    if (wrong != NULL) {
        snprintf(message, MESSAGE_SIZE, "%s.", wrong);
        if (table != NULL) {
            table_free(table);
        }
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
