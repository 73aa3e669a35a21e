#include "blob.h"

#include <stdio.h>
#include <string.h>

enum { HEAD = 32 };

static void put(unsigned char *at, uint64_t value) {
    int i;
    for (i = 0; i < 8; i++) {
        at[i] = (unsigned char)(value >> (8 * i));
    }
}

static uint64_t get(const unsigned char *at) {
    uint64_t value = 0;
    int i;
    for (i = 0; i < 8; i++) {
        value |= (uint64_t)at[i] << (8 * i);
    }
    return value;
}

size_t blob_size(size_t numbers) {
    return HEAD + 8 * (numbers + 1);
}

void blob_write(unsigned char *blob, const struct blob_kind *kind, uint32_t resource, const void *numbers, size_t count,
                uint64_t flags) {
    size_t i;
    for (i = 0; i < count; i++) {
        uint64_t bits;
        memcpy(&bits, (const char *)numbers + 8 * i, 8);
        put(blob + HEAD + 8 * i, bits);
    }
    put(blob + HEAD + 8 * count, flags);
    memcpy(blob, kind->magic, sizeof kind->magic);
    put(blob + 16, (uint64_t)kind->version | (uint64_t)resource << 32);
    put(blob + 24, 0);
}

void blob_seal(unsigned char *blob, size_t size) {
    put(blob + 24, resource_checksum(blob + HEAD, size - HEAD));
}

int blob_check(const unsigned char *blob, size_t size, const struct blob_kind *kind, uint32_t resource, size_t count,
               int sealed, char message[MESSAGE_SIZE]) {
    const char *wrong = NULL;
    if (blob == NULL || size < HEAD || memcmp(blob, kind->magic, sizeof kind->magic) != 0) {
        snprintf(message, MESSAGE_SIZE, "these bytes are not the state of a %s.", kind->model);
        return 1;
    }
    if ((get(blob + 16) & 0xffffffffu) != kind->version) {
        wrong = "this state is of another version than this FMU reads.";
    } else if (size != blob_size(count) || (sealed && get(blob + 24) != resource_checksum(blob + HEAD, size - HEAD))) {
        wrong = "this state is damaged: its size or checksum does not fit.";
    } else if (get(blob + 16) >> 32 != resource) {
        wrong = kind->other;
    }
    if (wrong != NULL) {
        snprintf(message, MESSAGE_SIZE, "%s", wrong);
    }
    return wrong != NULL;
}

void blob_read(const unsigned char *blob, void *numbers, size_t count) {
    size_t i;
    for (i = 0; i < count; i++) {
        uint64_t bits = get(blob + HEAD + 8 * i);
        memcpy((char *)numbers + 8 * i, &bits, 8);
    }
}

uint64_t blob_flags(const unsigned char *blob, size_t count) {
    return get(blob + HEAD + 8 * count);
}
