/* One operation after the other as `step` of cycloid_fmu/compensation/compensator.py makes them: the same bits. */
#include "compensator.h"

#include <math.h>
#include <stdint.h>

#if defined(__FAST_MATH__)
#error "a compensator's sums must not be reordered: compile it without -ffast-math"
#endif
#if defined(__clang__) || !defined(__GNUC__)
#pragma STDC FP_CONTRACT OFF
#else
#pragma GCC optimize("fp-contract=off") /* GCC does not know the standard's */
#endif

/* Whole numbers of a spline over the period: of 8 bits or of 16. */
struct spline {
    const int8_t *small;
    const int16_t *large;
    int knots;
};

#include "tables.h"

#define MOST_TURNS 4503599627370496.0 /* 2^52: beyond it all doubles are whole */

/* What a torque and a temperature make of the tables. */
struct state {
    double torque, wound, mean, flank, shares[FUNCTIONS + 1], variance, ripple;
};

static int given(double value) {
    return value < LARGEST && value > -LARGEST; /* not so for NaN */
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

/* A cell between nodes and the share of it at which a value lies; the ends hold beyond. */
static int between(const double *nodes, int count, double at, double *share) {
    int low = 0, high = count - 1;
    *share = 0.0;
    if (count == 1) {
        return 0;
    }
    while (high - low > 1) {
        int middle = (low + high) / 2;
        if (nodes[middle] <= at) {
            low = middle;
        } else {
            high = middle;
        }
    }
    *share = smaller(larger((at - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0), 1.0);
    return low;
}

static double on_line(const double *nodes, const double *values, int count, double at) {
    double share;
    int cell = between(nodes, count, at, &share);
    return share > 0.0 ? (1.0 - share) * values[cell] + share * values[cell + 1] : values[cell];
}

/* The torque that the teeth carry: the load without what friction holds; its elements move on. */
static double torque_of_teeth(struct compensator_memory *m, double angle, double speed, double load,
                              double temperature) {
    double way = given(m->angle) ? angle - m->angle : 0.0;
    double dry = COULOMB + LOAD_SHARE * size_of(load);
    double rest = dry + STRIBECK;
    double sliding, warmth, bound, stiffness, total = 0.0;
    int i;
    m->angle = angle;
    if (rest <= 0.0) {
        return load - VISCOUS * speed;
    }
    sliding = dry + STRIBECK * on_line(STRIBECK_SPEED, STRIBECK_SHARE, STRIBECK_SPEEDS, size_of(speed));
    warmth = on_line(WARMTH_TEMPERATURE, WARMTH, WARMTHS, temperature);
    bound = PRESLIDING_ANGLE * warmth * sliding / (rest * FRICTION_ELEMENTS);
    for (i = 0; i < FRICTION_ELEMENTS; i++) {
        double most = bound * (i + 1);
        m->strains[i] = smaller(larger(m->strains[i] + way, -most), most);
        total += m->strains[i];
    }
    stiffness = 2.0 * rest / (PRESLIDING_ANGLE * (FRICTION_ELEMENTS + 1));
    return load - stiffness * total - VISCOUS * speed;
}

static struct state state_of(double torque, double temperature) {
    struct state found;
    double u, v, p, q, r, s;
    int i = between(TEMPERATURE, TEMPERATURES, temperature, &u), j = between(TORQUE, TORQUES, torque, &v);
    int low = i * TORQUES + j, high = (i + 1 < TEMPERATURES ? i + 1 : TEMPERATURES - 1) * TORQUES + j, n;
    p = (1.0 - u) * (1.0 - v);
    q = (1.0 - u) * v;
    r = u * (1.0 - v);
    s = u * v;
#define AT(VALUES) (p * (VALUES)[low] + q * (VALUES)[low + 1] + r * (VALUES)[high] + s * (VALUES)[high + 1])
    found.torque = torque;
    found.wound = COMPLIANCE * torque;
    found.mean = AT(MEAN);
    found.flank = (1.0 - v) * FLANK[j] + v * FLANK[j + 1];
    found.shares[FUNCTIONS] = 0.0; /* of none, but C has no arrays without a number */
    for (n = 0; n < FUNCTIONS; n++) {
        found.shares[n] = (p * SHARE[low][n] + q * SHARE[low + 1][n] + r * SHARE[high][n] + s * SHARE[high + 1][n])
            * SCALE[n];
    }
    found.variance = AT(VARIANCE);
    found.ripple = AT(RIPPLE_VARIANCE);
#undef AT
    return found;
}

static int step_of(const struct spline *spline, int knot) {
    return spline->small != 0 ? spline->small[knot] : spline->large[knot];
}

/* What the ideal crank angle makes of the deviation (rad), and where asked for its derivative. */
static double ripple_of(const struct state *state, double crank, double *slope) {
    double value = 0.0, steep = 0.0;
    double turn = crank / PERIOD, whole;
    int n;
    if (size_of(turn) < MOST_TURNS) {
        whole = (double)(int64_t)turn;
        turn -= whole > turn ? whole - 1.0 : whole;
    } else {
        turn = 0.0;
    }
    for (n = 0; n < FUNCTIONS; n++) {
        const struct spline *spline = &SPLINE[n];
        int knots = spline->knots, knot, a, b, d, e, third, second, first; /* whole numbers of 19 bits at most */
        double place = turn * knots, s, share = state->shares[n];
        knot = (int)place;
        knot = knot < knots - 1 ? knot : knots - 1;
        s = place - knot;
        a = step_of(spline, knot > 0 ? knot - 1 : knots - 1);
        b = step_of(spline, knot);
        d = step_of(spline, knot + 1 < knots ? knot + 1 : knot + 1 - knots);
        e = step_of(spline, knot + 2 < knots ? knot + 2 : knot + 2 - knots);
        third = e - a + 3 * (b - d);
        second = 3 * (a + d - 2 * b);
        first = 3 * (d - a);
        value += share * (((third * s + second) * s + first) * s + (a + 4 * b + d));
        if (slope != 0) {
            steep += share * knots * ((3 * third * s + 2 * second) * s + first);
        }
    }
    if (slope != 0) {
        *slope = steep / (6.0 * PERIOD);
    }
    return value / 6.0;
}

/* What measurements and what was known before say together; returns the last gain's variance. */
static double solve(struct compensator_memory *m, double variance) {
    double lower[10], right[4], weight = 1.0 / variance; /* on the diagonal of lower its inverse */
    int i, j, k;
    for (i = 0; i < 4; i++) {
        int row = i * (i + 1) / 2;
        right[i] = KNOWN[i] * m->products[i] * weight + EXPECTED[i] / KNOWN[i];
        for (j = 0; j <= i; j++) {
            int column = j * (j + 1) / 2;
            double total = KNOWN[i] * KNOWN[j] * m->moments[row + j] * weight + (i == j ? 1.0 : 0.0);
            for (k = 0; k < j; k++) {
                total -= lower[row + k] * lower[column + k];
            }
            lower[row + j] = i == j ? 1.0 / sqrt(larger(total, 1.0)) : total * lower[column + j];
        }
        for (k = 0; k < i; k++) {
            right[i] -= lower[row + k] * right[k];
        }
        right[i] *= lower[row + i];
    }
    for (i = 3; i >= 0; i--) {
        for (k = i + 1; k < 4; k++) {
            right[i] -= lower[k * (k + 1) / 2 + i] * right[k];
        }
        right[i] *= lower[i * (i + 1) / 2 + i];
    }
    for (i = 0; i < 4; i++) {
        m->learned[i] = KNOWN[i] * right[i];
    }
    return KNOWN[3] * KNOWN[3] * lower[9] * lower[9];
}

/* Take a measurement in; returns whether it can be one of this drive. */
static int learn(struct compensator_memory *m, const struct state *state, double motor_angle, double output_angle) {
    double measured = output_angle - motor_angle / RATIO;
    double rows[4], targets[4], crank, way, kept, expected, variance, off, weight, far, sure, g;
    int known = given(m->index), first = !given(m->output), i, j, n = 0;
    if (size_of(measured) > LARGEST_TRANSMISSION_ERROR) {
        return 0;
    }
    crank = (output_angle - m->applied[0] - m->applied[2] * state->wound) * CRANK_RATIO;
    rows[0] = 1.0;
    rows[1] = state->flank;
    rows[2] = state->wound + state->mean;
    rows[3] = known ? ripple_of(state, crank + m->index, 0) : 0.0;
    way = first ? 0.0 : size_of(CRANK_RATIO * (output_angle - m->output));
    m->output = output_angle;
    kept = larger(0.0, 1.0 - way / MEMORY);
    expected = state->variance + SENSOR * SENSOR + (known ? 0.0 : state->ripple);
    variance = (FIRST * expected + kept * m->left) / (FIRST + kept * m->count);
    off = measured - (m->learned[0] * rows[0] + m->learned[1] * rows[1] + m->learned[2] * rows[2]
                      + m->learned[3] * rows[3]);
    m->settled = size_of(state->flank) >= SURE_FLANK ? m->settled + way : 0.0;
    weight = m->settled < SETTLED ? 0.0 : first ? 1.0 : smaller(1.0, way / CORRELATION);
    weight *= smaller(1.0, (LEAST_VARIANCE + SENSOR * SENSOR) / (state->variance + SENSOR * SENSOR));
    far = size_of(off) / (OUTLIER * sqrt(variance));
    if (far > 1.0) {
        weight /= far;
    }
    m->count = kept * m->count + weight;
    m->left = kept * m->left + weight * off * off;
    for (i = 0; i < 4; i++) {
        for (j = 0; j <= i; j++) {
            m->moments[n] = kept * m->moments[n] + weight * rows[i] * rows[j];
            n++;
        }
        m->products[i] = kept * m->products[i] + weight * rows[i] * measured;
    }
    sure = solve(m, variance);
    g = m->learned[3];
    targets[0] = m->learned[0];
    targets[1] = m->learned[1];
    targets[2] = smaller(larger(m->learned[2], 0.0), LARGEST_GAIN);
    targets[3] = smaller(g > 0.0 ? g * g * g / (g * g + sure) : 0.0, LARGEST_GAIN);
    for (i = 0; i < 4; i++) {
        double most = way * (i < 2 ? ANGLE_RATE : GAIN_RATE);
        m->applied[i] += smaller(larger(targets[i] - m->applied[i], -most), most);
    }
    return 1;
}

void compensator_start(struct compensator_memory *memory, double index) {
    struct compensator_memory fresh = {0};
    int i;
    fresh.index = given(index) ? index : COMPENSATOR_NONE;
    fresh.angle = fresh.output = COMPENSATOR_NONE;
    fresh.settled = SETTLED;
    for (i = 0; i < 4; i++) {
        fresh.applied[i] = fresh.learned[i] = EXPECTED[i];
    }
    *memory = fresh;
}

struct compensator_command compensator_step(struct compensator_memory *memory, double desired_angle,
                                            double desired_speed, double load_torque, double temperature,
                                            double motor_angle, double output_angle) {
    struct compensator_memory *m = memory;
    struct compensator_command found;
    struct state state;
    double ripple = 0.0, slope = 0.0, wound, gain, angle, expected, variance;
    int inside, plausible = 1, known = given(m->index);
    if (!given(desired_angle) || !given(desired_speed) || !given(load_torque) || !given(temperature)) {
        found.motor_angle = RATIO * (given(desired_angle) ? desired_angle : given(m->angle) ? m->angle : 0.0);
        found.motor_speed = found.gain = 0.0;
        found.band = LARGEST;
        found.holds = 0;
        return found;
    }
    state = state_of(torque_of_teeth(m, desired_angle, desired_speed, load_torque, temperature), temperature);
    inside = size_of(state.torque) <= TORQUE[TORQUES - 1];
    if (inside && given(motor_angle) && given(output_angle)) {
        plausible = learn(m, &state, motor_angle, output_angle);
    }
    wound = m->applied[2];
    gain = known ? m->applied[3] : 0.0;
    angle = desired_angle - m->applied[0] - wound * state.wound;
    if (known) {
        ripple = ripple_of(&state, angle * CRANK_RATIO + m->index, &slope);
    }
    expected = state.variance + (known ? 0.0 : state.ripple);
    variance = (FIRST * expected + m->left) / (FIRST + m->count);
    found.motor_angle = RATIO * (angle - m->applied[1] * state.flank - wound * state.mean - gain * ripple);
    found.motor_speed = RATIO * desired_speed * (1.0 - gain * CRANK_RATIO * slope);
    found.band = sqrt(variance);
    found.gain = gain;
    found.holds = plausible && inside
        && !(m->count > ENOUGH && variance > ALARM * ALARM * (expected + SENSOR * SENSOR));
    return found;
}
