/* The operations of `step` in cycloid_fmu/compensation/compensator.py in the same order: results have the same bits. */
#include "compensator.h"

#include <math.h>
#include <stdint.h>

#if defined(__FAST_MATH__)
#error "a compensator's sums must not be reordered: compile it without -ffast-math"
#endif
#if defined(__clang__) || !defined(__GNUC__)
#pragma STDC FP_CONTRACT OFF
#else
#pragma GCC optimize("fp-contract=off") /* GCC ignores the standard's pragma */
#endif

#include "compensator_numbers.h"

#define MOST_TURNS 4503599627370496.0 /* 2^52: beyond it all doubles are whole */

enum { MEAN, FLANK, VARIANCE, RIPPLE }; /* the first columns of a node */

/* The tables at a torque and a temperature. */
struct state {
    double torque, wound, node[COLUMNS + MOST_FUNCTIONS];
};

static int given(const struct compensator *c, double value) {
    return value < c->largest && value > -c->largest; /* false for NaN */
}

static double larger(double a, double b) {
    return b > a ? b : a;
}

static double smaller(double a, double b) {
    return b < a ? b : a;
}

static double size_of(double value) {
    return value < 0.0 ? -value : value;
}

/* The cell of a value between nodes, and its position in the cell, 0 to 1; values beyond the ends are clipped. */
static inline int between(const double *nodes, const double *rates, int count, double at, double *share) {
    int cell = 0, remaining = count - 1;
    if (count == 1) {
        *share = 0.0;
        return 0;
    }
    while (remaining > 1) { /* the same number of rounds for any value */
        int half = remaining / 2;
        cell += nodes[cell + half] <= at ? half : 0;
        remaining -= half;
    }
    *share = smaller(larger((at - nodes[cell]) * rates[cell], 0.0), 1.0);
    return cell;
}

static inline double on_line(const double *nodes, const double *rates, const double *values, int count, double at) {
    double share;
    int cell = between(nodes, rates, count, at, &share);
    return share > 0.0 ? (1.0 - share) * values[cell] + share * values[cell + 1] : values[cell];
}

/* The torque through the teeth, the load minus friction; moves the friction elements. */
static double torque_of_teeth(const struct compensator *c, struct compensator_memory *m, double angle, double speed,
                              double load, double temperature) {
    double rotation = given(c, m->angle) ? angle - m->angle : 0.0;
    double dry = c->coulomb + c->load_share * size_of(load);
    double rest = dry + c->stribeck;
    double sliding, warmth, bound, total = 0.0;
    int i;
    m->angle = angle;
    if (rest <= 0.0) {
        return load - c->viscous * speed;
    }
    sliding = dry + c->stribeck * on_line(c->stribeck_speed, c->stribeck_rate, c->stribeck_share, c->stribeck_speeds,
                                          size_of(speed));
    warmth = on_line(c->warmth_temperature, c->warmth_rate, c->warmth, c->warmths, temperature);
    bound = c->strain * warmth * sliding / rest;
    for (i = 0; i < FRICTION_ELEMENTS; i++) {
        double most = bound * (i + 1);
        m->strains[i] = smaller(larger(m->strains[i] + rotation, -most), most);
        total += m->strains[i];
    }
    return load - c->stiffness * rest * total - c->viscous * speed;
}

static const double *node_of(const struct compensator *c, int cell) {
    return c->node + cell * (COLUMNS + c->functions);
}

static void state_of(const struct compensator *c, struct state *state, double torque, double temperature) {
    double u, v, p, q, r, s;
    int j = between(c->torque, c->torque_rate, c->torques, torque, &v);
    int i = between(c->temperature, c->temperature_rate, c->temperatures, temperature, &u), n;
    const double *low = node_of(c, i * c->torques + j), *above = node_of(c, i * c->torques + j + 1);
    if (c->temperatures > 1) {
        const double *high = node_of(c, (i + 1) * c->torques + j);
        const double *beyond = node_of(c, (i + 1) * c->torques + j + 1);
        p = (1.0 - u) * (1.0 - v);
        q = (1.0 - u) * v;
        r = u * (1.0 - v);
        s = u * v;
        for (n = 0; n < COLUMNS + c->functions; n++) {
            state->node[n] = p * low[n] + q * above[n] + r * high[n] + s * beyond[n];
        }
    } else {
        p = 1.0 - v;
        for (n = 0; n < COLUMNS + c->functions; n++) {
            state->node[n] = p * low[n] + v * above[n];
        }
    }
    state->torque = torque;
    state->wound = c->compliance * torque;
}

/* The ripple at an ideal crank angle (rad), and its derivative unless `slope` is 0. */
static inline double ripple_of(const struct compensator *c, const struct state *state, double crank, double *slope) {
    double value = 0.0, steep = 0.0;
    double turn = crank * c->per_period, whole;
    int n;
    if (size_of(turn) < MOST_TURNS) {
        whole = (double)(int64_t)turn;
        turn -= whole > turn ? whole - 1.0 : whole;
    } else {
        turn = 0.0;
    }
    for (n = 0; n < c->functions; n++) {
        const struct spline *spline = &c->spline[n];
        double position = turn * spline->knots, share = state->node[COLUMNS + n], s, third, second, first;
        int knot = (int)position, a, b, d, e; /* integers of 19 bits at most */
        s = position - knot;
        if (spline->small != 0) {
            const int8_t *at = spline->small + knot;
            a = at[0], b = at[1], d = at[2], e = at[3];
        } else {
            const int16_t *at = spline->large + knot;
            a = at[0], b = at[1], d = at[2], e = at[3];
        }
        third = e - a + 3 * (b - d);
        second = 3 * (a + d - 2 * b);
        first = 3 * (d - a);
        value += share * (((third * s + second) * s + first) * s + (a + 4 * b + d));
        if (slope != 0) {
            steep += share * spline->knots * ((3.0 * third * s + 2.0 * second) * s + first);
        }
    }
    if (slope != 0) {
        *slope = steep * c->per_period;
    }
    return value;
}

/* Solve for the posterior mean given measurements with a variance; returns the variance of the ripple's gain.

   Normal equations with the variance on their diagonal by L D L', written out: shorter than loops. */
static inline double solve(const struct compensator *c, struct compensator_memory *m, double v) {
    const double *a = m->moments, *b = m->products;
    double d0 = 1.0 / larger(a[0] + v, v);
    double l10 = a[1] * d0, l20 = a[3] * d0, l30 = a[6] * d0;
    double d1 = 1.0 / larger(a[2] + v - a[1] * l10, v);
    double c21 = a[4] - a[3] * l10, c31 = a[7] - a[6] * l10;
    double l21 = c21 * d1, l31 = c31 * d1;
    double d2 = 1.0 / larger(a[5] + v - a[3] * l20 - c21 * l21, v);
    double c32 = a[8] - a[6] * l20 - c31 * l21;
    double l32 = c32 * d2;
    double d3 = 1.0 / larger(a[9] + v - a[6] * l30 - c31 * l31 - c32 * l32, v);
    double y0 = b[0] + v * c->prior[0];
    double y1 = b[1] + v * c->prior[1] - l10 * y0;
    double y2 = b[2] + v * c->prior[2] - l20 * y0 - l21 * y1;
    double z3 = (b[3] + v * c->prior[3] - l30 * y0 - l31 * y1 - l32 * y2) * d3;
    double z2 = y2 * d2 - l32 * z3;
    double z1 = y1 * d1 - l21 * z2 - l31 * z3;
    m->learned[0] = y0 * d0 - l10 * z1 - l20 * z2 - l30 * z3;
    m->learned[1] = z1;
    m->learned[2] = z2;
    m->learned[3] = z3;
    return c->known[3] * c->known[3] * v * d3;
}

/* Share of the ripple's variance that remains with an index of its probability. */
static double doubt(const struct compensator_memory *m) {
    return 1.0 - m->probability * m->probability;
}

/* Add a measurement to the regression; returns whether it is plausible for this drive. */
static int learn(const struct compensator *c, struct compensator_memory *m, const struct state *state,
                 double motor_angle, double output_angle) {
    double measured = output_angle - motor_angle * c->per_ratio;
    double rows[4], targets[4], crank, rotation, crank_rotation, forgetting, expected, variance, residual, weight;
    double most, g;
    const double *node = state->node;
    int first = !given(c, m->output), i, j, n = 0;
    if (size_of(measured) > c->largest_transmission_error) {
        return 0;
    }
    crank = (output_angle - m->applied[0] - m->applied[2] * state->wound) * c->crank_ratio;
    rows[0] = c->known[0];
    rows[1] = c->known[1] * node[FLANK];
    rows[2] = c->known[2] * (state->wound + node[MEAN]);
    rows[3] = c->known[3] * ripple_of(c, state, crank + m->index, 0);
    rotation = first ? 0.0 : size_of(output_angle - m->output);
    crank_rotation = size_of(c->crank_ratio * rotation);
    m->output = output_angle;
    forgetting = larger(0.0, 1.0 - crank_rotation * c->per_memory);
    expected = node[VARIANCE] + c->noise + doubt(m) * node[RIPPLE];
    variance = (c->first * expected + forgetting * m->residual_squares) / (c->first + forgetting * m->count);
    residual = measured - (m->learned[0] * rows[0] + m->learned[1] * rows[1] + m->learned[2] * rows[2]
                           + m->learned[3] * rows[3]);
    m->settled = size_of(node[FLANK]) >= c->sure_flank ? m->settled + rotation : 0.0;
    weight = m->settled < c->settled ? 0.0 : first ? 1.0 : smaller(1.0, crank_rotation * c->per_correlation);
    weight *= smaller(1.0, c->least / (node[VARIANCE] + c->noise));
    most = c->outlier * c->outlier * variance;
    if (residual * residual > most) {
        weight *= sqrt(most / (residual * residual));
    }
    m->count = forgetting * m->count + weight;
    m->residual_squares = forgetting * m->residual_squares + weight * residual * residual;
    for (i = 0; i < 4; i++) {
        double weighted = weight * rows[i];
        for (j = 0; j <= i; j++) {
            m->moments[n] = forgetting * m->moments[n] + weighted * rows[j];
            n++;
        }
        m->products[i] = forgetting * m->products[i] + weighted * measured;
    }
    m->gain_variance = solve(c, m, variance);
    g = c->known[3] * m->learned[3];
    targets[0] = c->known[0] * m->learned[0];
    targets[1] = c->known[1] * m->learned[1];
    targets[2] = smaller(larger(c->known[2] * m->learned[2], 0.0), c->largest_gain);
    targets[3] = smaller(g > 0.0 ? g * g * g / (g * g + m->gain_variance) : 0.0, c->largest_gain);
    for (i = 0; i < 4; i++) {
        most = crank_rotation * (i < 2 ? c->angle_rate : c->gain_rate);
        m->applied[i] += smaller(larger(targets[i] - m->applied[i], -most), most);
    }
    return 1;
}

void compensator_start(const struct compensator *c, struct compensator_memory *memory, double index,
                       double probability) {
    struct compensator_memory fresh = {0};
    int i;
    fresh.index = given(c, index) ? index : 0.0;
    fresh.probability = given(c, index) && probability > 0.0 ? smaller(probability, 1.0) : 0.0;
    fresh.angle = fresh.output = COMPENSATOR_NONE;
    fresh.settled = c->settled;
    for (i = 0; i < 4; i++) {
        fresh.applied[i] = c->expected[i];
        fresh.learned[i] = c->prior[i];
    }
    fresh.applied[3] = fresh.probability;
    fresh.gain_variance = c->known[3] * c->known[3];
    *memory = fresh;
}

struct compensator_command compensator_step(const struct compensator *c, struct compensator_memory *memory,
                                            double desired_angle, double desired_speed, double load_torque,
                                            double temperature, double motor_angle, double output_angle) {
    struct compensator_memory *m = memory;
    struct compensator_command command;
    struct state state;
    double ripple, slope, wound, gain, angle, expected, variance, small;
    int inside, plausible = 1, more, another;
    if (!given(c, desired_angle) || !given(c, desired_speed) || !given(c, load_torque) || !given(c, temperature)) {
        command.motor_angle = given(c, desired_angle) ? desired_angle : given(c, m->angle) ? m->angle : 0.0;
        command.motor_angle *= c->ratio;
        command.motor_speed = command.gain = 0.0;
        command.band = c->largest;
        command.holds = 0;
        return command;
    }
    state_of(c, &state, torque_of_teeth(c, m, desired_angle, desired_speed, load_torque, temperature), temperature);
    inside = size_of(state.torque) <= c->reach;
    if (inside && given(c, motor_angle) && given(c, output_angle)) {
        plausible = learn(c, m, &state, motor_angle, output_angle);
    }
    wound = m->applied[2];
    gain = m->applied[3];
    angle = desired_angle - m->applied[0] - wound * state.wound;
    ripple = ripple_of(c, &state, angle * c->crank_ratio + m->index, &slope);
    expected = state.node[VARIANCE] + doubt(m) * state.node[RIPPLE];
    variance = (c->first * expected + m->residual_squares) / (c->first + m->count);
    command.motor_angle =
        c->ratio * (angle - m->applied[1] * state.node[FLANK] - wound * state.node[MEAN] - gain * ripple);
    command.motor_speed = c->ratio * desired_speed * (1.0 - gain * c->crank_ratio * slope);
    command.band = sqrt(variance);
    command.gain = gain;
    small = c->least_gain * m->probability - c->known[3] * m->learned[3];
    more = variance > c->alarm * c->alarm * (expected + c->noise);
    another = small > 0.0 && small * small > c->alarm * c->alarm * m->gain_variance;
    command.holds = plausible && inside && !(m->count > c->enough && (more || another));
    return command;
}
