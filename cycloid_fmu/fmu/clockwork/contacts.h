/* What the drive's model in time asks of the contacts of gear, pins and bearings: of tables (table_contacts.c), or of
   the contact problem itself (exact_contacts.c). Torques are those on the output; transmission errors are its angle less the ideal
   φ_a/ratio, at an angle of the cycloid stage's crank. */
#ifndef CYCLOID_CONTACTS_H
#define CYCLOID_CONTACTS_H

enum contacts_status { CONTACTS_SOLVED, CONTACTS_UNBALANCED, CONTACTS_UNSOLVED };

/* The output's transmission error at rest under a torque (rad) and its derivative by the torque, rad/(N.m). */
struct loaded {
    double transmission_error, compliance;
};

/* Contacts with the output held at a transmission error, behind a compliance in series: stored energy with that of the
   series compliance (J), its derivatives by crank and output angle (N.m), and the contacts' own stiffness; 0 without contact. */
struct pressed {
    double energy, by_angle, by_rotation, stiffness;
    double torque;           /* of the teeth on the gear */
    double crank, transmission_error; /* of the cycloid stage's crank; of the gear without series compliance */
};

/* Second derivatives at rest under a torque, by the crank angle: of the rate, of the crank's torque at constant torque,
   and of half the play; and that of the compliance. */
struct bending {
    double rate, crank_torque, offset, compliance;
};

/* A function returns a status, or a number, which is NAN where there is none. */
struct contacts {
    void *self;
    double reach[2];    /* largest positive and negative torque of stated accuracy, N.m */
    double stiffness;   /* at the largest torque, N.m/rad */
    double free_energy; /* J: contacts that store no more are free within the plays around them */
    /* Both ends of the output's free rotation; without play the transmission error at zero torque, twice. */
    int (*play)(void *self, double crank_angle, double ends[2]);
    /* Derivative by the crank angle of the play's end on a side (±1). */
    double (*touch_rate)(void *self, double crank_angle, double side);
    /* At rest under a torque, which is 0 only without play; the transmission error's derivative by the crank angle there,
       and the torque that the crank needs. */
    int (*loaded)(void *self, double crank_angle, double torque, struct loaded *loaded);
    double (*rate)(void *self, double crank_angle, double torque);
    double (*crank_torque)(void *self, double crank_angle, double torque);
    /* Torque with the output at rest at a transmission error, behind a compliance in series. */
    int (*held)(void *self, double crank_angle, double transmission_error, double series, double *torque);
    /* The same with its energy: all but the last three fields. */
    int (*press)(void *self, double crank_angle, double transmission_error, double series, struct pressed *pressed);
    /* Pins in contact and the largest pressure (Pa) under a torque. */
    void (*sharing)(void *self, double crank_angle, double torque, double *count, double *pressure);
    void (*bending)(void *self, double crank_angle, double torque, struct bending *bending); /* or NULL */
    /* Save everything that later results depend on, and return to it; or NULL if they depend on nothing. */
    void (*begin)(void *self);
    void (*undo)(void *self);
};

#endif
