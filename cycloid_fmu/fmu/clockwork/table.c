#include "table.h"

#include <math.h>
#include <string.h>

static struct place place_among(double period, uint32_t angles, double crank_angle) {
    double turns = crank_angle / period, n = angles;
    double at = (turns - floor(turns)) * n, s;
    uint32_t first;
    struct place place;
    int i;
    at = at >= n ? 0.0 : at; /* rounded up to the next period */
    first = at < n ? (uint32_t)at : 0; /* not of an angle that is no number, whose weights are none either */
    s = at - first;
    place.share = s;
    place.weight[0] = (1.0 - s) * (1.0 - s) * (1.0 - s) / 6.0;
    place.weight[1] = (3.0 * s * s * s - 6.0 * s * s + 4.0) / 6.0;
    place.weight[2] = (1.0 + 3.0 * s + 3.0 * s * s - 3.0 * s * s * s) / 6.0;
    place.weight[3] = s * s * s / 6.0;
    place.rate[0] = -0.5 * (1.0 - s) * (1.0 - s);
    place.rate[1] = 1.5 * s * s - 2.0 * s;
    place.rate[2] = 0.5 + s - 1.5 * s * s;
    place.rate[3] = 0.5 * s * s;
    for (i = 0; i < 4; i++) {
        uint32_t node = first + (uint32_t)i;
        place.rate[i] *= n / period;
        node = node == 0 ? angles - 1 : node - 1;
        place.node[i] = node >= angles ? node - angles : node;
    }
    return place;
}

struct place table_place(const struct table *table, double crank_angle) {
    return place_among(table->period, table->angles, crank_angle);
}

struct place table_pressure_place(const struct table *table, double crank_angle) {
    return place_among(table->period, table->pressure_angles, crank_angle);
}

struct place table_turning(const struct table *table, const struct place *place) {
    const double s = place->share, n = table->angles / table->period;
    struct place result = *place;
    int i;
    for (i = 0; i < 4; i++) {
        result.weight[i] = place->rate[i];
    }
    result.rate[0] = (1.0 - s) * n * n;
    result.rate[1] = (3.0 * s - 2.0) * n * n;
    result.rate[2] = (1.0 - 3.0 * s) * n * n;
    result.rate[3] = s * n * n;
    return result;
}

/* Sum of the weights: 1, or 0 for those of a derivative, in which the base value cancels. */
static double whole(const double weight[4]) {
    return (weight[0] + weight[3]) + (weight[1] + weight[2]);
}

static double blend(const struct side *side, const struct place *place, uint32_t load, const double weight[4]) {
    double sum = 0.0;
    int i;
    for (i = 0; i < 4; i++) {
        sum += weight[i] * (double)side->transmission_error[(size_t)place->node[i] * side->loads + load];
    }
    return whole(weight) * side->base[load] + side->step[load] * sum;
}

static double transmission_error_at(const struct side *side, const struct place *place, uint32_t load) {
    return blend(side, place, load, place->weight);
}

static double blend_steps(const uint16_t *values, const double *step, uint32_t loads, const struct place *place,
                          uint32_t load) {
    double sum = 0.0;
    int i;
    for (i = 0; i < 4; i++) {
        sum += place->weight[i] * (double)values[(size_t)place->node[i] * loads + load];
    }
    return step[load] * sum;
}

static double compliance_at(const struct side *side, const struct place *place, uint32_t load) {
    return blend_steps(side->compliance, side->compliance_step, side->loads, place, load);
}

static uint32_t cell_of(const double *loads, uint32_t count, double load) {
    uint32_t low = 0;
    count--;
    while (count > 1) {
        uint32_t half = count / 2;
        low = loads[low + half] <= load ? low + half : low;
        count -= half;
    }
    return low;
}

/* Cubic Hermite interpolation between two values and slopes. */
static double hermite(double u, double h, double a, double b, double ca, double cb) {
    double v = 1.0 - u;
    return (1.0 + 2.0 * u) * v * v * a + (3.0 - 2.0 * u) * u * u * b + h * u * v * (v * ca - u * cb);
}

static double hermite_slope(double u, double h, double a, double b, double ca, double cb) {
    double v = 1.0 - u;
    return 6.0 * u * v * (b - a) / h + v * (1.0 - 3.0 * u) * ca + u * (3.0 * u - 2.0) * cb;
}

struct interpolated table_at(const struct side *side, const struct place *place, double load) {
    uint32_t j = cell_of(side->load, side->loads, load), i;
    double h = side->load[j + 1] - side->load[j], u = (load - side->load[j]) / h;
    double a = 0.0, b = 0.0, ca = 0.0, cb = 0.0, ra = 0.0, rb = 0.0, rca = 0.0, rcb = 0.0;
    struct interpolated result;
    for (i = 0; i < 4; i++) {
        const int16_t *x = side->transmission_error + (size_t)place->node[i] * side->loads + j;
        const uint16_t *c = side->compliance + (size_t)place->node[i] * side->loads + j;
        double w = place->weight[i], r = place->rate[i];
        a += w * (double)x[0];
        b += w * (double)x[1];
        ca += w * (double)c[0];
        cb += w * (double)c[1];
        ra += r * (double)x[0];
        rb += r * (double)x[1];
        rca += r * (double)c[0];
        rcb += r * (double)c[1];
    }
    a = whole(place->weight) * side->base[j] + side->step[j] * a;
    b = whole(place->weight) * side->base[j + 1] + side->step[j + 1] * b;
    ra *= side->step[j];
    rb *= side->step[j + 1];
    ca *= side->compliance_step[j];
    cb *= side->compliance_step[j + 1];
    rca *= side->compliance_step[j];
    rcb *= side->compliance_step[j + 1];
    if (u > 1.0) { /* beyond the last load */
        result.transmission_error = b + (load - side->load[j + 1]) * cb;
        result.compliance = cb;
        result.rate = rb + (load - side->load[j + 1]) * rcb;
        return result;
    }
    result.transmission_error = hermite(u, h, a, b, ca, cb);
    result.compliance = hermite_slope(u, h, a, b, ca, cb);
    result.rate = hermite(u, h, ra, rb, rca, rcb);
    return result;
}

struct interpolated table_at_node(const struct side *side, const struct place *place, uint32_t node) {
    struct interpolated result;
    result.transmission_error = transmission_error_at(side, place, node);
    result.rate = blend(side, place, node, place->rate);
    result.compliance = compliance_at(side, place, node);
    return result;
}

double table_load(const struct side *side, const struct place *place, double goal, double series) {
    uint32_t low = 0, high = side->loads - 1, step;
    double a, b, ca, cb, h, lower = 0.0, upper = 1.0, u;
    a = transmission_error_at(side, place, low);
    b = transmission_error_at(side, place, high) + series * side->load[high];
    if (goal <= a) {
        return 0.0;
    }
    if (goal > b) {
        double compliance = compliance_at(side, place, high) + series;
        return side->load[high] + (goal - b) / (compliance > LEAST_COMPLIANCE ? compliance : LEAST_COMPLIANCE);
    }
    while (high - low > 1) {
        uint32_t middle = (low + high) / 2;
        double at = transmission_error_at(side, place, middle) + series * side->load[middle];
        if (at <= goal) {
            low = middle;
            a = at;
        } else {
            high = middle;
            b = at;
        }
    }
    h = side->load[high] - side->load[low];
    ca = compliance_at(side, place, low) + series;
    cb = compliance_at(side, place, high) + series;
    u = b > a ? (goal - a) / (b - a) : 0.0;
    for (step = 0; step < 60; step++) {
        double short_ = goal - hermite(u, h, a, b, ca, cb), slope = h * hermite_slope(u, h, a, b, ca, cb), next;
        if (fabs(short_) < LAST_CELL_SHARE * slope) { /* Newton's next error is its square: below rounding */
            u += short_ / slope;
            return side->load[low] + (u < 0.0 ? 0.0 : u > 1.0 ? 1.0 : u) * h;
        }
        if (short_ > 0.0) {
            lower = u;
        } else {
            upper = u;
        }
        next = slope > 0.0 ? u + short_ / slope : HUGE_VAL;
        u = next >= lower && next <= upper ? next : 0.5 * (lower + upper);
    }
    return side->load[low] + u * h;
}

void table_energy(const struct side *side, const struct place *place, double load, double *energy, double *rate) {
    uint32_t cell = cell_of(side->load, side->loads, load), i, j;
    double of_transmission_error[MOST_LOADS], of_compliance[MOST_LOADS];
    double h = side->load[cell + 1] - side->load[cell], beyond = load - side->load[side->loads - 1];
    double u = beyond > 0.0 ? 1.0 : (load - side->load[cell]) / h, u2 = u * u;
    memset(of_transmission_error, 0, (cell + 2) * sizeof *of_transmission_error);
    memset(of_compliance, 0, (cell + 2) * sizeof *of_compliance);
    for (j = 0; j < cell; j++) {
        double width = side->load[j + 1] - side->load[j];
        of_transmission_error[j] += 0.5 * width;
        of_transmission_error[j + 1] += 0.5 * width;
        of_compliance[j] += width * width / 12.0;
        of_compliance[j + 1] -= width * width / 12.0;
    }
    of_transmission_error[cell] += h * (u - u2 * u + 0.5 * u2 * u2);
    of_transmission_error[cell + 1] += h * (u2 * u - 0.5 * u2 * u2);
    of_compliance[cell] += h * h * (0.5 * u2 - 2.0 / 3.0 * u2 * u + 0.25 * u2 * u2);
    of_compliance[cell + 1] += h * h * (0.25 * u2 * u2 - u2 * u / 3.0);
    if (beyond > 0.0) {
        of_transmission_error[cell + 1] += beyond;
        of_compliance[cell + 1] += 0.5 * beyond * beyond;
    }
    *energy = *rate = 0.0;
    for (j = 0; j < cell + 2; j++) {
        *energy += whole(place->weight) * of_transmission_error[j] * side->base[j];
        of_transmission_error[j] *= side->step[j];
        of_compliance[j] *= side->compliance_step[j];
    }
    for (i = 0; i < 4; i++) {
        const int16_t *x = side->transmission_error + (size_t)place->node[i] * side->loads;
        const uint16_t *c = side->compliance + (size_t)place->node[i] * side->loads;
        double sum = 0.0;
        for (j = 0; j < cell + 2; j++) {
            sum += of_transmission_error[j] * (double)x[j] + of_compliance[j] * (double)c[j];
        }
        *energy += place->weight[i] * sum;
        *rate += place->rate[i] * sum;
    }
}

double table_pressure(const struct side *side, const struct place *place, double load) {
    uint32_t loads = side->pressure_loads, j = cell_of(side->pressure_load, loads, load);
    double u = (load - side->pressure_load[j]) / (side->pressure_load[j + 1] - side->pressure_load[j]);
    double low = blend_steps(side->pressure, side->pressure_step, loads, place, j);
    double high = blend_steps(side->pressure, side->pressure_step, loads, place, j + 1);
    double square = (1.0 - u) * low + u * high;
    return square > 0.0 ? sqrt(square) : 0.0;
}

int table_contact_count(const struct side *side, const struct place *place, double load) {
    uint32_t loads = side->pressure_loads, j = cell_of(side->pressure_load, loads, load);
    uint32_t nearest = 2.0 * load > side->pressure_load[j] + side->pressure_load[j + 1] || j == 0 ? j + 1 : j;
    return side->contact_count[(size_t)place->node[place->share < 0.5 ? 1 : 2] * loads + nearest];
}

double table_rest_torque(const struct table *table, const struct place *place) {
    double sum = 0.0;
    int i;
    for (i = 0; table->rest_torque != NULL && i < 4; i++) {
        sum += place->weight[i] * table->rest_torque[place->node[i]];
    }
    return sum;
}

double table_rest_energy(const struct table *table, const struct place *place) {
    double s = place->share, t, sum;
    const double *c = table->rest_torque;
    if (c == NULL) {
        return 0.0;
    }
    t = 1.0 - s;
    sum = (1.0 - t * t * t * t) * c[place->node[0]];
    sum += (3.0 * s * s * s * s - 8.0 * s * s * s + 16.0 * s) * c[place->node[1]];
    sum += (4.0 * s + 6.0 * s * s + 4.0 * s * s * s - 3.0 * s * s * s * s) * c[place->node[2]];
    sum += s * s * s * s * c[place->node[3]];
    return table->rest_energy[place->node[1]] + table->period / table->angles * sum / 24.0;
}
