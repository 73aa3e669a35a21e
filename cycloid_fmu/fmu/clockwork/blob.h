/* A model's state as bytes, little endian: magic, version, checksum of the model's resource, checksum of the rest; numbers;
   a word of flags. */
#ifndef CYCLOID_BLOB_H
#define CYCLOID_BLOB_H

#include "resource.h"

struct blob_kind {
    char magic[16];
    uint32_t version;
    const char *model; /* as in "the state of a native cycloid drive" */
    const char *other; /* message for the state of another resource */
};

size_t blob_size(size_t numbers);
void blob_write(unsigned char *blob, const struct blob_kind *kind, uint32_t resource, const void *numbers, size_t count,
                uint64_t flags);
void blob_seal(unsigned char *blob, size_t size); /* with a checksum, for where it may be damaged */
/* Return 1 with a message if these bytes are no state of this kind and resource. */
int blob_check(const unsigned char *blob, size_t size, const struct blob_kind *kind, uint32_t resource, size_t count,
               int sealed, char message[MESSAGE_SIZE]);
void blob_read(const unsigned char *blob, void *numbers, size_t count);
uint64_t blob_flags(const unsigned char *blob, size_t count);

#endif
