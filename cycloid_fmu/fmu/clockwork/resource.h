/* The file of a model's numbers in an FMU's resources: a head, the model's variables and numbers, and the FMU's token, all
   little endian. The head has magic, version, size of the rest and two sums of its words. */
#ifndef CYCLOID_RESOURCE_H
#define CYCLOID_RESOURCE_H

#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

#include "constants.h"

enum { MESSAGE_SIZE = 512 };

struct variable {
    char *name;
    int kind, causality, baked, fixed;
    int field; /* its field in the model, for the loss table plus row and column; -1 if it is fixed in the tables */
    double least, most, start, nominal;
};

/* Reads from `at` on. After a failure it stays where it is and returns zeros. */
struct reader {
    unsigned char *start, *at;
    const unsigned char *end;
    int failed;
};

struct resource_kind {
    const char *magic; /* of 8 bytes */
    uint32_t version;
    const char *unknown; /* message for a file of another kind */
};

extern const char RESOURCE_DAMAGED[];

FILE *resource_open(const char *path); /* a path in UTF-8 */
/* Read a file after its head into memory from malloc at `reader->start`; returns NULL, or what is wrong with it. */
const char *resource_read(FILE *file, const struct resource_kind *kind, const unsigned char head[TABLE_HEAD],
                          struct reader *reader);

unsigned char *reader_take(struct reader *reader, size_t size);
uint64_t reader_whole(struct reader *reader, size_t bytes);
double reader_number(struct reader *reader);
/* Memory for `count` items, from calloc. */
void *reader_allocate(struct reader *reader, size_t count, size_t size);
char *reader_text(struct reader *reader);                     /* from malloc */
double *reader_numbers(struct reader *reader, size_t count);  /* from malloc; all must be finite */
uint16_t *reader_words(struct reader *reader, size_t count);  /* of 16 bits, in place */
void reader_align(struct reader *reader);                     /* to a multiple of 8 bytes in the file */
/* Variables whose fields are below a limit. */
struct variable *reader_variables(struct reader *reader, uint32_t *count, int fields);
void variables_free(struct variable *variables, uint32_t count);

uint32_t resource_checksum(const unsigned char *data, size_t size); /* CRC-32 */

#endif
