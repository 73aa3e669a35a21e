/* The contacts of single pins, which the tables do not hold: solved when asked for, as in cycloid_fmu/contact.py. */
#ifndef CYCLOID_PINS_H
#define CYCLOID_PINS_H

#include <stddef.h>
#include <stdint.h>

/* One pin on one tooth in one slice; lengths in m. */
struct contact {
    double gap, arm, arm_rate; /* gap: infinite where the pin has no foot on the tooth */
    double foot, foot_rate;    /* of the nominal flank, rad from the conjugate point */
    double curvature, curvature_rate;
    double force, stiffness, force_by_curvature;
    double at; /* the deviation that it was solved at, rad */
};

/* The contact problem, as `Drive` in cycloid_fmu/contact.py has it, SI. What follows `contacts` is of the last
   solution; each begins anew, so its results do not depend on those before. */
struct pins {
    uint32_t discs, slices, teeth, ring, points, elements, curved; /* points, elements: 0 without deviations */
    double circle_radius, generating_radius, generating_eccentricity, eccentricity, slice_width;
    double compliance_gear, compliance_pin, largest_log_radius, root_phase, root_margin, largest_deviation;
    double *x, *y, *radius, *tooth_turn, *crank_phase, *centre_x, *centre_y;
    double *alpha, *flank_x, *flank_y, *normal_x, *normal_y;
    float *gear_deviation, *pin_deviation, *gear_curvature, *pin_curvature;
    struct contact *contacts;
    double *force, *pressure; /* disc by disc, N and Pa */
    double crank_angle, torque;
    int solved;
};

size_t pins_count(const struct pins *pins);
size_t pins_contacts(const struct pins *pins);
/* Solve the contacts that balance a torque of the environment on the output (N.m), from a deviation near theirs (rad);
   1 where they can't. */
int pins_solve(struct pins *pins, double crank_angle, double torque, double deviation);

#endif
