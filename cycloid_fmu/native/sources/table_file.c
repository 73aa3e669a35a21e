#define _CRT_SECURE_NO_WARNINGS /* Microsoft's compiler warns of _wfopen */
#include "table.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#define WIN32_LEAN_AND_MEAN
#include <windows.h>
#endif

static const double LARGEST_FILE = 1e9;

struct reader {
    const unsigned char *at, *end;
    int failed;
};

static const unsigned char *take(struct reader *reader, size_t size) {
    const unsigned char *taken = reader->at;
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

/* Numbers that are all finite. */
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

/* Values of each load, which the file has as whole steps: the first, then the differences from angle to angle. */
static float *channels(struct reader *reader, uint32_t angles, uint32_t loads) {
    double *step = numbers(reader, loads), *whole = numbers(reader, loads);
    const unsigned char *changes = take(reader, 2 * (size_t)angles * loads);
    float *values = allocate(reader, (size_t)angles * loads, sizeof *values);
    uint32_t i, j;
    for (j = 0; j < loads && !reader->failed; j++) {
        for (i = 0; i < angles; i++, changes += 2) {
            whole[j] += (int16_t)(changes[0] | changes[1] << 8);
            values[(size_t)i * loads + j] = (float)(whole[j] * step[j]);
        }
        reader->failed |= !(step[j] > 0.0 && step[j] < 1e20 && fabs(whole[j]) < 1e18);
    }
    free(step);
    free(whole);
    return values;
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
    size_t told = (size_t)table->told_angles * side->told_loads;
    const unsigned char *counts;
    uint32_t i, j;
    read_loads(reader, side->loads, side->load);
    read_loads(reader, side->told_loads, side->told_load);
    side->reach = side->load[side->loads - 1];
    if (side->reach != side->told_load[side->told_loads - 1]) {
        reader->failed = 1;
    }
    side->deviation = channels(reader, table->angles, side->loads);
    side->compliance = channels(reader, table->angles, side->loads);
    side->pressure = channels(reader, table->told_angles, side->told_loads);
    counts = take(reader, told);
    side->contact_count = allocate(reader, told, 1);
    for (j = 0; j < side->told_loads && !reader->failed; j++) {
        for (i = 0; i < table->told_angles; i++) {
            side->contact_count[(size_t)i * side->told_loads + j] = *counts++;
        }
    }
}

/* The torque's mean is taken off: a crank turned round gives no energy. Its integral is the energy at the nodes. */
static void read_rest(struct reader *reader, struct table *table, uint32_t n) {
    double mean = 0.0, least = 0.0, width = table->period / table->angles, *c;
    uint32_t i;
    if (n == 0 || reader->failed) {
        return;
    }
    c = table->rest_torque = numbers(reader, n);
    table->rest_energy = allocate(reader, n, sizeof *table->rest_energy);
    if (reader->failed) {
        return;
    }
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
    if (v->field < -1 || v->field >= LOSS_TABLE + MOST_LOSS_ROWS * LOSS_COLUMNS) {
        reader->failed = 1;
    }
}

static void read_body(struct reader *reader, struct table *table) {
    uint32_t i, rest;
    double *numbers[7];
    table->token = text(reader);
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
    for (i = 0; i < 2; i++) {
        struct side *side = &table->side[i];
        side->loads = (uint32_t)whole(reader, 4);
        side->told_loads = (uint32_t)whole(reader, 4);
        if (side->loads < 2 || side->loads > MOST_LOADS || side->told_loads < 2 || side->told_loads > MOST_LOADS) {
            reader->failed = 1;
        }
    }
    if (!(table->sun_teeth >= 0.0 && table->sun_teeth < 1e6 && table->planet_teeth >= 0.0 && table->planet_teeth < 1e9
          && (table->sun_teeth == 0.0 || table->planet_teeth > 0.0) && fabs(table->sun_play) < 10.0
          && fabs(table->bearing_play) < 1.0)) {
        reader->failed = 1;
    }
    if (!(fabs(table->ratio) >= 1.0 && table->period > 0.0 && table->period < 1e6 && table->told_angles >= 4
          && table->told_angles <= table->angles && table->angles <= 100000000u
          && (rest == 0 || rest == table->angles))) {
        reader->failed = 1;
    }
    for (i = 0; i < 2 && !reader->failed; i++) {
        read_side(reader, table, &table->side[i]);
    }
    read_rest(reader, table, rest);
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

static unsigned char *contents(const char *path, size_t *size) {
    FILE *file = open_utf8(path);
    unsigned char *data = NULL;
    long length = -1;
    if (file == NULL) {
        return NULL;
    }
    if (fseek(file, 0, SEEK_END) == 0) {
        length = ftell(file);
    }
    if (length >= 0 && (double)length < LARGEST_FILE && fseek(file, 0, SEEK_SET) == 0) {
        data = malloc((size_t)length + 1);
    }
    if (data != NULL && fread(data, 1, (size_t)length, file) != (size_t)length) {
        free(data);
        data = NULL;
    }
    fclose(file);
    *size = data != NULL ? (size_t)length : 0;
    return data;
}

struct table *table_read(const char *path, char message[MESSAGE_SIZE]) {
    size_t size = 0;
    unsigned char *data = contents(path, &size);
    struct reader reader = {data, data + size, 0};
    struct table *table = NULL;
    const char *wrong = NULL;
    uint32_t checksum = 0;
    if (data == NULL) {
        snprintf(message, MESSAGE_SIZE, "%.300s: the table can't be read.", path);
        return NULL;
    }
    if (size < TABLE_HEAD || memcmp(take(&reader, 8), TABLE_MAGIC, 8) != 0) {
        wrong = "this is not a table of a cycloid drive";
    } else if (whole(&reader, 4) != TABLE_VERSION) {
        wrong = "the table is of another version than this FMU reads; build the FMU again";
    } else if (whole(&reader, 4) != (checksum = table_checksum(data + TABLE_HEAD, size - TABLE_HEAD))) {
        wrong = "the table is damaged: its checksum does not fit";
    } else {
        table = calloc(1, sizeof *table);
        if (table != NULL) {
            table->checksum = checksum;
            read_body(&reader, table);
        }
        if (table == NULL || reader.failed) {
            wrong = "the table is damaged, or there is not enough memory for it";
            table_free(table);
            table = NULL;
        }
    }
    free(data);
    if (wrong != NULL) {
        snprintf(message, MESSAGE_SIZE, "%.300s: %s.", path, wrong);
    }
    return table;
}

void table_free(struct table *table) {
    uint32_t i;
    if (table == NULL) {
        return;
    }
    for (i = 0; table->variable != NULL && i < table->variables; i++) {
        free(table->variable[i].name);
    }
    for (i = 0; i < 2; i++) {
        free(table->side[i].deviation);
        free(table->side[i].compliance);
        free(table->side[i].pressure);
        free(table->side[i].contact_count);
    }
    free(table->variable);
    free(table->token);
    free(table->rest_torque);
    free(table->rest_energy);
    free(table);
}
