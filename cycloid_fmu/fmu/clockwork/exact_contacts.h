/* Contacts by the contact problem itself, which cycloid_fmu/fmu/exact_contacts.py compiles. */
#ifndef CYCLOID_EXACT_CONTACTS_H
#define CYCLOID_EXACT_CONTACTS_H

#include <stddef.h>
#include <stdint.h>

#include "constants.h"
#include "contacts.h"

enum { MOST_BLOCKS = 16, MOST_RESULTS = 6 };

/* What a contact problem consists of; the blocks of memory are the solutions under load and at the ends of the play. */
struct exact_problem {
    int64_t (*solve)(intptr_t box, int64_t operation, double crank_angle, double a, double b, double *result);
    intptr_t box;
    uint64_t counts[2];
    void *blocks[2][MOST_BLOCKS];
    uint64_t sizes[2][MOST_BLOCKS];
    double ratio, period;  /* of the cycloid stage; the crank angle after which it repeats, rad */
    double tangent;        /* torque below which solutions under load change those of the play as well, N.m */
    double stiffness, free_energy; /* of `struct contacts` */
};

/* The last solutions; NAN for none. Only doubles, so that they can be stored as they are. */
struct exact_solution {
    double crank_angle, torque, transmission_error, stiffness;
    double turned, crank_torque, rate; /* turned: whether the others are those of the solution */
    double shared, count, pressure;    /* likewise */
    double held_at, series, energy, by_angle; /* pressed: the transmission error that was held, behind a compliance */
    double play_angle, ends[2];
};

struct exact_contacts {
    struct exact_problem problem;
    struct exact_solution last, last_before;
    unsigned char *before; /* the blocks at `begin`, if they have changed since */
    int changed[2];
};

/* The size of everything that later results depend on. */
size_t exact_size(const struct exact_contacts *contacts);
void exact_save(const struct exact_contacts *contacts, unsigned char *bytes);
void exact_restore(struct exact_contacts *contacts, const unsigned char *bytes);
/* Contacts of a problem, whose memory must stay; 1 without enough memory. */
int exact_open(struct exact_contacts *self, const struct exact_problem *problem, struct contacts *contacts);
void exact_close(struct exact_contacts *self);

#endif
