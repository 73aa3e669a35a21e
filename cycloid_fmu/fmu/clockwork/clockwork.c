/* The drive for a program that has its contact problem: the functions that cycloid_fmu/fmu/clockwork.py calls. */
#include <stdlib.h>
#include <string.h>

#include "drive.h"
#include "exact_contacts.h"

#ifdef _WIN32
#define EXPORTED __declspec(dllexport)
#else
#define EXPORTED __attribute__((visibility("default")))
#endif

struct clockwork {
    struct table *table;
    struct drive drive;
    struct exact_contacts contacts;
    char *message; /* of the last function that failed, in the program's memory */
};

/* Values of variables that are exchanged together. */
struct exchanged {
    const uint32_t *references;
    double *values;
    size_t count;
};

/* Return a drive described by a file of tables without tables, or NULL; with room for messages. */
EXPORTED struct clockwork *clockwork_open(const unsigned char *file, size_t size, char message[MESSAGE_SIZE]);
EXPORTED void clockwork_close(struct clockwork *clockwork);
EXPORTED size_t clockwork_message_size(void);
/* Give it a contact problem, in place of the one before. */
EXPORTED int clockwork_solve(struct clockwork *clockwork, const struct exact_problem *problem);
EXPORTED void clockwork_set_time(struct clockwork *clockwork, double time);
EXPORTED double clockwork_time(const struct clockwork *clockwork);
EXPORTED int clockwork_start(struct clockwork *clockwork);
EXPORTED int clockwork_step(struct clockwork *clockwork, double time, double step);
EXPORTED int clockwork_get(struct clockwork *clockwork, const struct exchanged *exchanged);
EXPORTED int clockwork_set(struct clockwork *clockwork, const struct exchanged *exchanged); /* up to one that is refused */
EXPORTED size_t clockwork_state_size(const struct clockwork *clockwork);
EXPORTED void clockwork_state(const struct clockwork *clockwork, unsigned char *bytes);
EXPORTED int clockwork_restore(struct clockwork *clockwork, const unsigned char *bytes, size_t size);

struct clockwork *clockwork_open(const unsigned char *file, size_t size, char message[MESSAGE_SIZE]) {
    struct clockwork *clockwork = calloc(1, sizeof *clockwork);
    struct table *table = clockwork == NULL ? NULL : table_read(file, size);
    if (table == NULL) {
        free(clockwork);
        return NULL;
    }
    clockwork->table = table;
    clockwork->message = message;
    drive_open(&clockwork->drive, table);
    return clockwork;
}

void clockwork_close(struct clockwork *clockwork) {
    exact_close(&clockwork->contacts);
    table_close(clockwork->table);
    free(clockwork);
}

size_t clockwork_message_size(void) {
    return MESSAGE_SIZE;
}

int clockwork_solve(struct clockwork *clockwork, const struct exact_problem *problem) {
    exact_close(&clockwork->contacts);
    clockwork->drive.solved = 0;
    return exact_open(&clockwork->contacts, problem, &clockwork->drive.contacts);
}

void clockwork_set_time(struct clockwork *clockwork, double time) {
    clockwork->drive.state.time = time;
}

double clockwork_time(const struct clockwork *clockwork) {
    return clockwork->drive.state.time;
}

int clockwork_start(struct clockwork *clockwork) {
    return drive_start(&clockwork->drive, clockwork->message);
}

int clockwork_step(struct clockwork *clockwork, double time, double step) {
    return drive_step(&clockwork->drive, time, step, clockwork->message);
}

int clockwork_get(struct clockwork *clockwork, const struct exchanged *exchanged) {
    const struct variable *variables = clockwork->table->variable;
    size_t i;
    for (i = 0; i < exchanged->count; i++) {
        if (drive_get(&clockwork->drive, &variables[exchanged->references[i]], &exchanged->values[i], clockwork->message)) {
            return 1;
        }
    }
    return 0;
}

int clockwork_set(struct clockwork *clockwork, const struct exchanged *exchanged) {
    const struct variable *variables = clockwork->table->variable;
    size_t i;
    for (i = 0; i < exchanged->count; i++) {
        if (drive_set(&clockwork->drive, &variables[exchanged->references[i]], exchanged->values[i], clockwork->message)) {
            return 1;
        }
    }
    return 0;
}

size_t clockwork_state_size(const struct clockwork *clockwork) {
    return drive_state_size() + exact_size(&clockwork->contacts);
}

void clockwork_state(const struct clockwork *clockwork, unsigned char *bytes) {
    drive_state_write(&clockwork->drive, bytes);
    exact_save(&clockwork->contacts, bytes + drive_state_size());
}

int clockwork_restore(struct clockwork *clockwork, const unsigned char *bytes, size_t size) {
    const size_t own = drive_state_size();
    if (size != clockwork_state_size(clockwork)) {
        drive_refuse(clockwork->message, "this state has %g bytes, those of this drive have %g.", (double)size,
                     (double)clockwork_state_size(clockwork));
        return 1;
    }
    if (drive_state_check(&clockwork->drive, bytes, own, 0, clockwork->message)) {
        return 1;
    }
    drive_state_read(&clockwork->drive, bytes);
    exact_restore(&clockwork->contacts, bytes + own);
    return 0;
}
