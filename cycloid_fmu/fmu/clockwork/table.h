/* Tables of a drive, read and interpolated. Their contents: cycloid_fmu/fmu/tables.py. */
#ifndef CYCLOID_TABLE_H
#define CYCLOID_TABLE_H

#include "resource.h"

/* One direction of torque: spline coefficients in steps of each load, the loads of a crank angle side by side. */
struct side {
    uint32_t loads, pressure_loads; /* pressure: of contact count and pressure, which are outputs only */
    double reach; /* the last load but one, up to which the accuracy is stated */
    double load[MOST_LOADS], pressure_load[MOST_LOADS];
    double base[MOST_LOADS], step[MOST_LOADS]; /* of the transmission error: its smallest value, and its step */
    double compliance_step[MOST_LOADS], pressure_step[MOST_LOADS];
    const int16_t *transmission_error;
    const uint16_t *compliance, *pressure;
    const uint8_t *contact_count;
};

/* What the losses take more than their mean at a crank angle θ, N.m at flange_a: the sum of c cos(nθ) + s sin(nθ) over
   orders n, which need not be whole. Linear between speeds of flange_a and between torques of the teeth at flange_a, both
   from 0 on. By the sign of that torque (>= 0 first) and by who drives (flange_a first). */
struct ripple {
    uint32_t orders, speeds, loads; /* no orders: none */
    double order[MOST_RIPPLE_ORDERS], speed[MOST_RIPPLE_SPEEDS], load[MOST_RIPPLE_LOADS];
    double part[MOST_RIPPLE_SPEEDS][2][2][MOST_RIPPLE_LOADS][MOST_RIPPLE_ORDERS][2];
};

/* Constant once it is complete: the instances of a process share it. */
struct table {
    struct table *next;
    size_t users;
    unsigned char *file, head[TABLE_HEAD]; /* the file, whose steps are used in place; and its head */
    uint32_t checksum;
    char *token;
    uint32_t offers, variables; /* the interface; `interface` is a macro in Windows' headers */
    uint32_t angles;          /* of transmission error and compliance; 0 without tables */
    uint32_t pressure_angles; /* of contact count and pressure */
    struct variable *variable;
    double ratio, period, allowed;
    double sun_teeth, planet_teeth, sun_play, bearing_play; /* of an RV reducer's first stage; else no teeth */
    struct ripple ripple;
    struct side side[2]; /* positive and negative torque */
    double *rest_torque, *rest_energy; /* at zero load, by crank angle; NULL without interference */
};

/* Nodes and weights of a crank angle. */
struct place {
    uint32_t node[4];
    double weight[4], rate[4], share;
};

/* Results for a load at a crank angle, mirrored like the sides, so that all increase with the load. */
struct interpolated {
    double transmission_error, rate; /* and its change with the crank angle, rad and rad/rad */
    double compliance;      /* rad/(N.m) */
};

/* Return the table of a file, shared with other instances if the head is the same, or NULL with a message. */
struct table *table_open(const char *path, char message[MESSAGE_SIZE]);
/* The same of a file that this process made, which may be without tables, for a drive with other contacts; not shared. */
struct table *table_read(const unsigned char *file, size_t size);
void table_close(struct table *table);

struct place table_place(const struct table *table, double crank_angle);
struct place table_pressure_place(const struct table *table, double crank_angle); /* of contact count and pressure */
/* A crank angle whose values are the first derivatives with respect to the crank angle, and whose rates are the second. */
struct place table_turning(const struct table *table, const struct place *place);
struct interpolated table_at(const struct side *side, const struct place *place, double load);
struct interpolated table_at_node(const struct side *side, const struct place *place, uint32_t node);
/* Beyond the very last load the tangent continues with constant compliance. */
/* Load at which the transmission error, with a further compliance in series, has a given value; 0 below the first. */
double table_load(const struct side *side, const struct place *place, double transmission_error, double series);
/* Integral of the transmission error over the load, and of its rate. */
void table_energy(const struct side *side, const struct place *place, double load, double *energy, double *rate);
double table_pressure(const struct side *side, const struct place *place, double load);
int table_contact_count(const struct side *side, const struct place *place, double load);
double table_rest_torque(const struct table *table, const struct place *place);
double table_rest_energy(const struct table *table, const struct place *place);

#endif
