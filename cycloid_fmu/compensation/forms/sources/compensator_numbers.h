/* The numbers of a drive's compensator, as `Tables` of cycloid_fmu/compensation/compensator.py. In C99 source for a controller
   each is a constant of its own, in capitals. */
#ifndef COMPENSATOR_NUMBERS_H
#define COMPENSATOR_NUMBERS_H

#include "resource.h"

enum { COLUMNS = 4, SUPPORT = 4 }; /* of a node before its functions; coefficients of a spline at a point */

/* Integer coefficients of a periodic spline, of 8 or 16 bits, from the one before the first knot on. */
struct spline {
    const int8_t *small;
    const int16_t *large;
    double knots;
};

/* In the order of the file: `counts`, `scalars` and `arrays` of cycloid_fmu/compensation/forms/numbers.py. */
#define COMPENSATOR_COUNTS(X) X(functions) X(torques) X(temperatures) X(stribeck_speeds) X(warmths)
#define COMPENSATOR_SCALARS(X)                                                                                         \
    X(ratio) X(per_ratio) X(crank_ratio) X(per_period) X(compliance) X(coulomb) X(load_share) X(stribeck) X(viscous)   \
    X(strain) X(stiffness) X(noise) X(least) X(reach) X(largest) X(first) X(largest_gain) X(gain_rate) X(angle_rate)   \
    X(outlier) X(alarm) X(least_gain) X(enough) X(sure_flank) X(settled) X(largest_transmission_error) X(per_memory)   \
    X(per_correlation)
#define COMPENSATOR_ARRAYS(X)                                                                                          \
    X(expected, 4) X(known, 4) X(prior, 4) X(torque, c->torques) X(torque_rate, c->torques)                            \
    X(temperature, c->temperatures) X(temperature_rate, c->temperatures)                                               \
    X(node, c->temperatures * c->torques * (COLUMNS + c->functions)) X(stribeck_speed, c->stribeck_speeds)        \
    X(stribeck_rate, c->stribeck_speeds) X(stribeck_share, c->stribeck_speeds) X(warmth_temperature, c->warmths)       \
    X(warmth_rate, c->warmths) X(warmth, c->warmths)

struct compensator {
#define COUNT(NAME) int NAME;
#define SCALAR(NAME) double NAME;
#define ARRAY(NAME, SIZE) const double *NAME;
    COMPENSATOR_COUNTS(COUNT)
    COMPENSATOR_SCALARS(SCALAR)
    COMPENSATOR_ARRAYS(ARRAY)
#undef COUNT
#undef SCALAR
#undef ARRAY
    struct spline spline[MOST_FUNCTIONS];
};

#endif
