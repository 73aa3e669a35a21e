#define _CRT_SECURE_NO_WARNINGS /* Microsoft's compiler warns of _wfopen */
#include "resource.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#define WIN32_LEAN_AND_MEAN
#include <windows.h>
#endif

static const double LARGEST_FILE = 1e9;
const char RESOURCE_DAMAGED[] = "the table is damaged, or there is not enough memory for it";

unsigned char *reader_take(struct reader *reader, size_t size) {
    unsigned char *taken = reader->at;
    if (reader->failed || (size_t)(reader->end - reader->at) < size) {
        reader->failed = 1;
        return NULL;
    }
    reader->at += size;
    return taken;
}

uint64_t reader_whole(struct reader *reader, size_t bytes) {
    const unsigned char *taken = reader_take(reader, bytes);
    uint64_t value = 0;
    size_t i;
    for (i = 0; taken != NULL && i < bytes; i++) {
        value |= (uint64_t)taken[i] << (8 * i);
    }
    return value;
}

double reader_number(struct reader *reader) {
    uint64_t bits = reader_whole(reader, 8);
    double value;
    memcpy(&value, &bits, 8);
    return value;
}

void *reader_allocate(struct reader *reader, size_t count, size_t size) {
    void *memory = reader->failed ? NULL : calloc(count > 0 ? count : 1, size);
    if (memory == NULL) {
        reader->failed = 1;
    }
    return memory;
}

char *reader_text(struct reader *reader) {
    size_t size = (size_t)reader_whole(reader, 2);
    const unsigned char *taken = reader_take(reader, size);
    char *copy = reader_allocate(reader, size + 1, 1);
    if (copy != NULL && taken != NULL) {
        memcpy(copy, taken, size);
    }
    return copy;
}

uint32_t resource_checksum(const unsigned char *data, size_t size) {
    static const uint32_t OF_HALF_BYTE[16] = {
        0x00000000, 0x1db71064, 0x3b6e20c8, 0x26d930ac, 0x76dc4190, 0x6b6b51f4, 0x4db26158, 0x5005713c,
        0xedb88320, 0xf00f9344, 0xd6d6a3e8, 0xcb61b38c, 0x9b64c2b0, 0x86d3d2d4, 0xa00ae278, 0xbdbdf21c,
    };
    uint32_t crc = 0xffffffffu;
    size_t i;
    for (i = 0; i < size; i++) {
        crc ^= data[i];
        crc = OF_HALF_BYTE[crc & 15u] ^ (crc >> 4);
        crc = OF_HALF_BYTE[crc & 15u] ^ (crc >> 4);
    }
    return ~crc;
}

/* Read numbers, all of which must be finite. */
double *reader_numbers(struct reader *reader, size_t count) {
    double *values;
    size_t i;
    if (count > (size_t)(reader->end - reader->at) / 8) {
        reader->failed = 1;
    }
    values = reader_allocate(reader, count, sizeof *values);
    for (i = 0; i < count && !reader->failed; i++) {
        values[i] = reader_number(reader);
        reader->failed |= !(fabs(values[i]) < 1e30);
    }
    return values;
}

static int is_little_endian(void) {
    const uint16_t unit = 1;
    return *(const unsigned char *)&unit == 1;
}

/* Numbers of 16 bits, used in place in the file. */
uint16_t *reader_words(struct reader *reader, size_t count) {
    unsigned char *at = reader_take(reader, 2 * count);
    size_t i;
    for (i = 0; at != NULL && i < count && !is_little_endian(); i++) {
        unsigned char low = at[2 * i];
        at[2 * i] = at[2 * i + 1];
        at[2 * i + 1] = low;
    }
    return (uint16_t *)(void *)at;
}

void reader_align(struct reader *reader) {
    reader_take(reader, (size_t)(-(intptr_t)(reader->at - reader->start) & 7));
}

static void read_variable(struct reader *reader, struct variable *v, int fields) {
    v->name = reader_text(reader);
    v->kind = (int)reader_whole(reader, 1);
    v->causality = (int)reader_whole(reader, 1);
    v->baked = (int)reader_whole(reader, 1);
    v->fixed = (int)reader_whole(reader, 1);
    v->field = (int)(int32_t)(uint32_t)reader_whole(reader, 4);
    v->least = reader_number(reader);
    v->most = reader_number(reader);
    v->start = reader_number(reader);
    v->nominal = reader_number(reader);
    if (v->field < (v->baked ? -1 : 0) || v->field >= fields) {
        reader->failed = 1;
    }
}

struct variable *reader_variables(struct reader *reader, uint32_t *count, int fields) {
    struct variable *variables;
    uint32_t i;
    *count = (uint32_t)reader_whole(reader, 4);
    reader->failed |= *count > 100000;
    variables = reader_allocate(reader, *count, sizeof *variables);
    for (i = 0; i < *count && !reader->failed; i++) {
        read_variable(reader, &variables[i], fields);
    }
    return variables;
}

void variables_free(struct variable *variables, uint32_t count) {
    uint32_t i;
    for (i = 0; variables != NULL && i < count; i++) {
        free(variables[i].name);
    }
    free(variables);
}

FILE *resource_open(const char *path) {
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
static void sums(const unsigned char *data, size_t size, uint64_t sum[2]) {
    uint64_t first[4] = {0, 0, 0, 0}, second[4] = {0, 0, 0, 0};
    size_t i;
    int k;
    for (i = 0; i + 16 <= size; i += 16) {
        for (k = 0; k < 4; k++) {
            first[k] += word(data + i + 4 * k);
            second[k] += first[k];
        }
    }
    sum[0] = first[0] + first[1] + first[2] + first[3];
    sum[1] = 4 * (second[0] + second[1] + second[2] + second[3]) - first[1] - 2 * first[2] - 3 * first[3];
    for (; i + 4 <= size; i += 4) {
        sum[0] += word(data + i);
        sum[1] += sum[0];
    }
}

const char *resource_read(FILE *file, const struct resource_kind *kind, const unsigned char head[TABLE_HEAD],
                          struct reader *reader) {
    unsigned char numbers[TABLE_HEAD];
    struct reader of_head = {numbers, numbers + 8, numbers + TABLE_HEAD, 0};
    uint32_t version;
    size_t size;
    uint64_t stated[2], actual[2];
    memcpy(numbers, head, TABLE_HEAD);
    version = (uint32_t)reader_whole(&of_head, 4);
    size = (size_t)reader_whole(&of_head, 4);
    stated[0] = reader_whole(&of_head, 8);
    stated[1] = reader_whole(&of_head, 8);
    if (memcmp(head, kind->magic, 8) != 0) {
        return kind->unknown;
    }
    if (version != kind->version) {
        return "the table is of another version than this FMU reads; build the FMU again";
    }
    reader->start = reader->at = (double)size < LARGEST_FILE ? malloc(size + 1) : NULL;
    if (reader->start == NULL) {
        return RESOURCE_DAMAGED;
    }
    if (size % 4 != 0 || fread(reader->start, 1, size + 1, file) != size) {
        return "the table is damaged: it has another size than it says";
    }
    sums(reader->start, size, actual);
    if (actual[0] != stated[0] || actual[1] != stated[1]) {
        return "the table is damaged: its checksum does not fit";
    }
    reader->end = reader->start + size;
    reader->failed = 0;
    return NULL;
}
