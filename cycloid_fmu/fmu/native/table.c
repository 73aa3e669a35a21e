#include "table.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#define WIN32_LEAN_AND_MEAN
#include <windows.h>
#endif

static const char MAGIC[8] = {'c', 'y', 'c', 'l', 't', 'a', 'b', '\n'};
enum { VERSION = 4, HEAD = 32 };
static const double LARGEST_FILE = 1e9;
static const double CLOSE = 1e-9; /* of a cell: a step this short is the last */

struct reader {
    const unsigned char *at, *end;
    int failed;
};

static const unsigned char *take(struct reader *reader, size_t size) {
    const unsigned char *taken = reader->at;
    if (reader->failed || (size_t)(reader->end - reader->at) < size) {
        reader->failed = 1;
        return NULL;
    }
    reader->at += size;
    return taken;
}

static uint64_t whole(struct reader *reader, size_t bytes) {
    const unsigned char *taken = take(reader, bytes);
    uint64_t value = 0;
    size_t i;
    for (i = 0; taken != NULL && i < bytes; i++) {
        value |= (uint64_t)taken[i] << (8 * i);
    }
    return value;
}

static double number(struct reader *reader) {
    uint64_t bits = whole(reader, 8);
    double value;
    memcpy(&value, &bits, 8);
    return value;
}

static void *allocate(struct reader *reader, size_t count, size_t size) {
    void *memory = reader->failed ? NULL : calloc(count > 0 ? count : 1, size);
    if (memory == NULL) {
        reader->failed = 1;
    }
    return memory;
}

static char *text(struct reader *reader) {
    size_t size = (size_t)whole(reader, 2);
    const unsigned char *taken = take(reader, size);
    char *copy = allocate(reader, size + 1, 1);
    if (copy != NULL && taken != NULL) {
        memcpy(copy, taken, size);
    }
    return copy;
}

uint64_t table_hash(const unsigned char *data, size_t size) {
    uint64_t found = 0xcbf29ce484222325u;
    size_t i;
    for (i = 0; i < size; i += 8) {
        uint64_t word = 0;
        size_t k, left = size - i < 8 ? size - i : 8;
        for (k = 0; k < left; k++) {
            word |= (uint64_t)data[i + k] << (8 * k);
        }
        found = (found ^ word) * 0x100000001b3u;
    }
    return found;
}

/* One channel: the whole steps of each angle from first or second differences. */
static double channel(struct reader *reader, uint32_t angles, int order, int64_t *steps) {
    double step = number(reader);
    size_t size = (size_t)whole(reader, 4);
    struct reader part = {reader->at, reader->at + size, 0};
    uint64_t value = 0, slope = 0;
    uint32_t i;
    if (take(reader, size) == NULL || !(step > 0.0 && step < HUGE_VAL)) {
        reader->failed = 1;
        return 0.0;
    }
    for (i = 0; i < angles; i++) {
        uint64_t folded = 0;
        int shift = 0, more = 1;
        while (more && shift < 64) {
            uint64_t group = whole(&part, 1);
            folded |= (group & 127u) << shift;
            shift += 7;
            more = (group & 128u) != 0;
        }
        slope = (order > 1 ? slope : 0) + ((folded >> 1) ^ (~(folded & 1u) + 1u));
        value += slope;
        steps[i] = (int64_t)value;
    }
    reader->failed |= part.failed || part.at != part.end;
    return step;
}

static float *channels(struct reader *reader, uint32_t angles, uint32_t loads, int order, int64_t *steps) {
    float *values = allocate(reader, (size_t)angles * loads, sizeof *values);
    uint32_t j, i;
    for (j = 0; j < loads && !reader->failed; j++) {
        double step = channel(reader, angles, order, steps);
        for (i = 0; i < angles && !reader->failed; i++) {
            values[(size_t)i * loads + j] = (float)((double)steps[i] * step);
            if (!(fabsf(values[(size_t)i * loads + j]) < 1e30f)) {
                reader->failed = 1;
            }
        }
    }
    return values;
}

static void read_loads(struct reader *reader, uint32_t count, double *load) {
    uint32_t j;
    for (j = 0; j < count; j++) {
        load[j] = number(reader);
        if (!(j == 0 ? load[j] == 0.0 : load[j] > load[j - 1] && load[j] < HUGE_VAL)) {
            reader->failed = 1;
        }
    }
}

static void read_side(struct reader *reader, const struct table *table, struct side *side, int64_t *steps) {
    float *counts;
    size_t i;
    read_loads(reader, side->loads, side->load);
    read_loads(reader, side->told_loads, side->told_load);
    if (side->load[side->loads - 1] != side->told_load[side->told_loads - 1]) {
        reader->failed = 1;
    }
    side->deviation = channels(reader, table->angles, side->loads, 2, steps);
    side->compliance = channels(reader, table->angles, side->loads, 1, steps);
    counts = channels(reader, table->told_angles, side->told_loads, 1, steps);
    side->contact_count = allocate(reader, (size_t)table->told_angles * side->told_loads, 1);
    for (i = 0; !reader->failed && i < (size_t)table->told_angles * side->told_loads; i++) {
        if (counts[i] < 0.0f || counts[i] > 255.0f) {
            reader->failed = 1;
        } else {
            side->contact_count[i] = (uint8_t)counts[i];
        }
    }
    free(counts);
    side->pressure = channels(reader, table->told_angles, side->told_loads, 1, steps);
}

/* The torque's mean is taken off: a crank turned round gives no energy. Its integral is the energy at the nodes. */
static void read_rest(struct reader *reader, struct table *table, int64_t *steps) {
    uint32_t n = table->angles, i;
    double step = channel(reader, n, 2, steps), mean = 0.0, least = 0.0, width = table->period / n;
    int any = 0;
    for (i = 0; i < n && !reader->failed; i++) {
        any |= steps[i] != 0;
        mean += (double)steps[i] * step / n;
    }
    if (!any || reader->failed) {
        return;
    }
    table->rest_torque = allocate(reader, n, sizeof *table->rest_torque);
    table->rest_energy = allocate(reader, n, sizeof *table->rest_energy);
    if (reader->failed) {
        return;
    }
    for (i = 0; i < n; i++) {
        table->rest_torque[i] = (double)steps[i] * step - mean;
    }
    for (i = 1; i < n; i++) {
        const double *c = table->rest_torque;
        double mass = c[(i + n - 2) % n] + 11.0 * c[i - 1] + 11.0 * c[i] + c[(i + 1) % n];
        table->rest_energy[i] = table->rest_energy[i - 1] + width * mass / 24.0;
        least = table->rest_energy[i] < least ? table->rest_energy[i] : least;
    }
    for (i = 0; i < n; i++) {
        table->rest_energy[i] -= least;
    }
}

/* Numbers that are all finite. */
static double *numbers(struct reader *reader, size_t count) {
    double *values;
    size_t i;
    if (count > (size_t)(reader->end - reader->at) / 8) {
        reader->failed = 1;
    }
    values = allocate(reader, count, sizeof *values);
    for (i = 0; i < count && !reader->failed; i++) {
        values[i] = number(reader);
        reader->failed |= !(fabs(values[i]) < 1e30);
    }
    return values;
}

static float *short_numbers(struct reader *reader, size_t count) {
    float *values;
    size_t i;
    if (count > (size_t)(reader->end - reader->at) / 4) {
        reader->failed = 1;
    }
    values = allocate(reader, count, sizeof *values);
    for (i = 0; i < count && !reader->failed; i++) {
        uint32_t bits = (uint32_t)whole(reader, 4);
        memcpy(&values[i], &bits, 4);
        reader->failed |= !(fabsf(values[i]) < 1e30f);
    }
    return values;
}

static int ascending(const struct reader *reader, const double *values, size_t count) {
    size_t i;
    for (i = 1; i < count && !reader->failed; i++) {
        if (!(values[i] > values[i - 1])) {
            return 0;
        }
    }
    return 1;
}

static void read_deviations(struct reader *reader, struct pins *pins) {
    size_t flanks = (size_t)pins->discs * pins->slices * pins->teeth * pins->points;
    size_t surfaces = (size_t)pins->slices * (pins->teeth + 1) * pins->elements;
    pins->alpha = numbers(reader, pins->points);
    pins->flank_x = numbers(reader, pins->points);
    pins->flank_y = numbers(reader, pins->points);
    pins->normal_x = numbers(reader, pins->points);
    pins->normal_y = numbers(reader, pins->points);
    pins->gear_deviation = short_numbers(reader, flanks);
    pins->pin_deviation = short_numbers(reader, surfaces);
    if (pins->curved) {
        pins->gear_curvature = short_numbers(reader, flanks);
        pins->pin_curvature = short_numbers(reader, surfaces);
    }
    reader->failed |= !ascending(reader, pins->alpha, pins->points);
}

/* What pins.c solves; nothing where no variable needs it. */
static struct pins *read_pins(struct reader *reader) {
    uint32_t *counts[7], i;
    double *scalars[11];
    struct pins *pins = allocate(reader, 1, sizeof *pins);
    uint64_t size = whole(reader, 8);
    if (pins == NULL || size == 0) {
        free(pins);
        return NULL;
    }
    if (size != (uint64_t)(reader->end - reader->at)) {
        reader->failed = 1;
        return pins;
    }
    counts[0] = &pins->discs, counts[1] = &pins->slices, counts[2] = &pins->teeth, counts[3] = &pins->ring;
    counts[4] = &pins->points, counts[5] = &pins->elements, counts[6] = &pins->curved;
    for (i = 0; i < 7; i++) {
        *counts[i] = (uint32_t)whole(reader, 4);
        reader->failed |= *counts[i] > 100000 || (i < 3 && *counts[i] == 0);
    }
    scalars[0] = &pins->circle_radius, scalars[1] = &pins->generating_radius;
    scalars[2] = &pins->generating_eccentricity, scalars[3] = &pins->eccentricity, scalars[4] = &pins->slice_width;
    scalars[5] = &pins->compliance_gear, scalars[6] = &pins->compliance_pin, scalars[7] = &pins->largest_log_radius;
    scalars[8] = &pins->root_phase, scalars[9] = &pins->root_margin, scalars[10] = &pins->largest_deviation;
    for (i = 0; i < 11; i++) {
        *scalars[i] = number(reader);
        reader->failed |= !(fabs(*scalars[i]) < 1e30 || i == 7);
    }
    if ((double)pins->discs * pins->slices * (pins->teeth + 1.0) * (pins->points + pins->elements + 1.0) > 1e8
        || (pins->points > 0 && (pins->points < 3 || pins->elements < 2))) {
        reader->failed = 1;
    }
    pins->x = numbers(reader, pins->teeth + 1);
    pins->y = numbers(reader, pins->teeth + 1);
    pins->radius = numbers(reader, pins->teeth + 1);
    pins->tooth_turn = numbers(reader, (size_t)pins->discs * pins->teeth);
    pins->crank_phase = numbers(reader, pins->discs);
    pins->centre_x = numbers(reader, pins->slices);
    pins->centre_y = numbers(reader, pins->slices);
    if (pins->points > 0) {
        read_deviations(reader, pins);
    }
    pins->contacts = allocate(reader, pins_contacts(pins), sizeof *pins->contacts);
    pins->force = allocate(reader, pins_count(pins), sizeof *pins->force);
    pins->pressure = allocate(reader, pins_count(pins), sizeof *pins->pressure);
    return pins;
}

static void free_pins(struct pins *pins) {
    if (pins == NULL) {
        return;
    }
    free(pins->x);
    free(pins->y);
    free(pins->radius);
    free(pins->tooth_turn);
    free(pins->crank_phase);
    free(pins->centre_x);
    free(pins->centre_y);
    free(pins->alpha);
    free(pins->flank_x);
    free(pins->flank_y);
    free(pins->normal_x);
    free(pins->normal_y);
    free(pins->gear_deviation);
    free(pins->pin_deviation);
    free(pins->gear_curvature);
    free(pins->pin_curvature);
    free(pins->contacts);
    free(pins->force);
    free(pins->pressure);
    free(pins);
}

static void read_body(struct reader *reader, struct table *table) {
    uint32_t i, k;
    int64_t *steps;
    table->token = text(reader);
    table->offers = (uint32_t)whole(reader, 4);
    table->variables = (uint32_t)whole(reader, 4);
    if (table->offers > INTERFACE_INERTIA || table->variables > 100000) {
        reader->failed = 1;
    }
    table->variable = allocate(reader, table->variables, sizeof *table->variable);
    for (i = 0; i < table->variables && !reader->failed; i++) {
        struct variable *v = &table->variable[i];
        v->name = text(reader);
        v->kind = (int)whole(reader, 1);
        v->causality = (int)whole(reader, 1);
        v->baked = (int)whole(reader, 1);
        v->fixed = (int)whole(reader, 1);
        v->least = number(reader);
        v->most = number(reader);
        v->size = (size_t)whole(reader, 4);
        if (v->size > (size_t)(reader->end - reader->at) / 8) {
            reader->failed = 1;
        }
        v->start = allocate(reader, v->size, sizeof *v->start);
        for (k = 0; k < v->size && !reader->failed; k++) {
            v->start[k] = number(reader);
        }
    }
    table->ratio = number(reader);
    table->period = number(reader);
    table->allowed = number(reader);
    table->sun_teeth = number(reader);
    table->planet_teeth = number(reader);
    table->sun_play = number(reader);
    table->bearing_play = number(reader);
    table->angles = (uint32_t)whole(reader, 4);
    table->told_angles = (uint32_t)whole(reader, 4);
    for (k = 0; k < 2; k++) {
        struct side *side = &table->side[k];
        side->loads = (uint32_t)whole(reader, 4);
        side->told_loads = (uint32_t)whole(reader, 4);
        if (side->loads < 2 || side->loads > MOST_LOADS || side->told_loads < 2
            || side->told_loads > MOST_LOADS) {
            reader->failed = 1;
        }
    }
    if (!(table->sun_teeth >= 0.0 && table->sun_teeth < 1e6 && table->planet_teeth >= 0.0 && table->planet_teeth < 1e9
          && (table->sun_teeth == 0.0 || table->planet_teeth > 0.0) && fabs(table->sun_play) < 10.0
          && fabs(table->bearing_play) < 1.0)) {
        reader->failed = 1;
    }
    if (!(fabs(table->ratio) >= 1.0 && table->period > 0.0 && table->period < 1e6 && table->told_angles >= 4
          && table->told_angles <= table->angles && table->angles <= 100000000u)) {
        reader->failed = 1;
    }
    steps = allocate(reader, table->angles, sizeof *steps);
    for (k = 0; k < 2 && !reader->failed; k++) {
        read_side(reader, table, &table->side[k], steps);
    }
    if (!reader->failed) {
        read_rest(reader, table, steps);
    }
    free(steps);
    table->pins = read_pins(reader);
    reader->failed |= reader->at != reader->end;
}

static FILE *open_utf8(const char *path) {
#ifdef _WIN32
    FILE *file = NULL;
    int size = MultiByteToWideChar(CP_UTF8, 0, path, -1, NULL, 0);
    wchar_t *wide = size > 0 ? calloc((size_t)size, sizeof *wide) : NULL;
    if (wide != NULL && MultiByteToWideChar(CP_UTF8, 0, path, -1, wide, size) > 0) {
        file = _wfopen(wide, L"rb");
    }
    free(wide);
    return file;
#else
    return fopen(path, "rb");
#endif
}

static unsigned char *contents(const char *path, size_t *size) {
    FILE *file = open_utf8(path);
    unsigned char *data = NULL;
    long length = -1;
    if (file == NULL) {
        return NULL;
    }
    if (fseek(file, 0, SEEK_END) == 0) {
        length = ftell(file);
    }
    if (length >= 0 && (double)length < LARGEST_FILE && fseek(file, 0, SEEK_SET) == 0) {
        data = malloc((size_t)length + 1);
    }
    if (data != NULL && fread(data, 1, (size_t)length, file) != (size_t)length) {
        free(data);
        data = NULL;
    }
    fclose(file);
    *size = data != NULL ? (size_t)length : 0;
    return data;
}

struct table *table_read(const char *path, char message[MESSAGE_SIZE]) {
    size_t size = 0;
    unsigned char *data = contents(path, &size);
    struct reader reader = {data, data + size, 0};
    struct table *table = NULL;
    const char *wrong = NULL;
    uint64_t version, stated, hash;
    if (data == NULL) {
        snprintf(message, MESSAGE_SIZE, "%.300s: the table can't be read.", path);
        return NULL;
    }
    if (size < HEAD || memcmp(take(&reader, sizeof MAGIC), MAGIC, sizeof MAGIC) != 0) {
        wrong = "this is not a table of a cycloid drive";
    } else {
        version = whole(&reader, 4);
        whole(&reader, 4);
        stated = whole(&reader, 8);
        hash = whole(&reader, 8);
        if (version != VERSION) {
            wrong = "the table is of another version than this FMU reads; build the FMU again";
        } else if (stated != size || hash != table_hash(data + HEAD, size - HEAD)) {
            wrong = "the table is damaged: its size or hash does not fit";
        } else {
            table = calloc(1, sizeof *table);
            if (table != NULL) {
                table->hash = hash;
                read_body(&reader, table);
            }
            if (table == NULL || reader.failed) {
                wrong = "the table is damaged, or there is not enough memory for it";
                table_free(table);
                table = NULL;
            }
        }
    }
    free(data);
    if (wrong != NULL) {
        snprintf(message, MESSAGE_SIZE, "%.300s: %s.", path, wrong);
    }
    return table;
}

void table_free(struct table *table) {
    uint32_t i;
    if (table == NULL) {
        return;
    }
    for (i = 0; table->variable != NULL && i < table->variables; i++) {
        free(table->variable[i].name);
        free(table->variable[i].start);
    }
    for (i = 0; i < 2; i++) {
        free(table->side[i].deviation);
        free(table->side[i].compliance);
        free(table->side[i].pressure);
        free(table->side[i].contact_count);
    }
    free(table->variable);
    free(table->token);
    free(table->rest_torque);
    free(table->rest_energy);
    free_pins(table->pins);
    free(table);
}

static struct place place_among(double period, uint32_t angles, double crank_angle) {
    double turns = crank_angle / period, n = angles;
    double at = (turns - floor(turns)) * n, s;
    uint32_t first = (uint32_t)at;
    struct place place;
    int i;
    s = at - first;
    first = first >= angles ? 0 : first;
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

struct place table_told_place(const struct table *table, double crank_angle) {
    return place_among(table->period, table->told_angles, crank_angle);
}

static double blend(const float *values, uint32_t loads, const struct place *place, uint32_t load,
                    const double weight[4]) {
    double sum = 0.0;
    int i;
    for (i = 0; i < 4; i++) {
        sum += weight[i] * (double)values[(size_t)place->node[i] * loads + load];
    }
    return sum;
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

/* Hermite's cubic between two values and slopes. */
static double hermite(double u, double h, double a, double b, double ca, double cb) {
    double v = 1.0 - u;
    return (1.0 + 2.0 * u) * v * v * a + (3.0 - 2.0 * u) * u * u * b + h * u * v * (v * ca - u * cb);
}

static double hermite_slope(double u, double h, double a, double b, double ca, double cb) {
    double v = 1.0 - u;
    return 6.0 * u * v * (b - a) / h + v * (1.0 - 3.0 * u) * ca + u * (3.0 * u - 2.0) * cb;
}

struct loaded table_at(const struct side *side, const struct place *place, double load) {
    uint32_t j = cell_of(side->load, side->loads, load), i;
    double h = side->load[j + 1] - side->load[j], u = (load - side->load[j]) / h;
    double a = 0.0, b = 0.0, ca = 0.0, cb = 0.0, ra = 0.0, rb = 0.0, rca = 0.0, rcb = 0.0;
    struct loaded found;
    for (i = 0; i < 4; i++) {
        const float *x = side->deviation + (size_t)place->node[i] * side->loads + j;
        const float *c = side->compliance + (size_t)place->node[i] * side->loads + j;
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
    found.deviation = hermite(u, h, a, b, ca, cb);
    found.compliance = hermite_slope(u, h, a, b, ca, cb);
    found.rate = hermite(u, h, ra, rb, rca, rcb);
    return found;
}

struct loaded table_at_node(const struct side *side, const struct place *place, uint32_t node) {
    struct loaded found;
    found.deviation = blend(side->deviation, side->loads, place, node, place->weight);
    found.rate = blend(side->deviation, side->loads, place, node, place->rate);
    found.compliance = blend(side->compliance, side->loads, place, node, place->weight);
    return found;
}

double table_load(const struct side *side, const struct place *place, double deviation, double offset, double series) {
    uint32_t low = 0, high = side->loads - 1, step;
    double a, b, ca, cb, h, left = 0.0, right = 1.0, u, goal = deviation + offset;
    a = blend(side->deviation, side->loads, place, low, place->weight);
    b = blend(side->deviation, side->loads, place, high, place->weight) + series * side->load[high];
    if (goal <= a) {
        return 0.0;
    }
    if (!(goal <= b)) {
        return HUGE_VAL;
    }
    while (high - low > 1) {
        uint32_t middle = (low + high) / 2;
        double at = blend(side->deviation, side->loads, place, middle, place->weight) + series * side->load[middle];
        if (at <= goal) {
            low = middle;
            a = at;
        } else {
            high = middle;
            b = at;
        }
    }
    h = side->load[high] - side->load[low];
    ca = blend(side->compliance, side->loads, place, low, place->weight) + series;
    cb = blend(side->compliance, side->loads, place, high, place->weight) + series;
    u = b > a ? (goal - a) / (b - a) : 0.0;
    for (step = 0; step < 60; step++) {
        double short_ = goal - hermite(u, h, a, b, ca, cb), slope = h * hermite_slope(u, h, a, b, ca, cb), next;
        if (fabs(short_) < CLOSE * slope) { /* Newton's next error is the square of this step: below rounding */
            u += short_ / slope;
            return side->load[low] + (u < 0.0 ? 0.0 : u > 1.0 ? 1.0 : u) * h;
        }
        if (short_ > 0.0) {
            left = u;
        } else {
            right = u;
        }
        next = slope > 0.0 ? u + short_ / slope : HUGE_VAL;
        u = next >= left && next <= right ? next : 0.5 * (left + right);
    }
    return side->load[low] + u * h;
}

void table_energy(const struct side *side, const struct place *place, double load, double *energy, double *rate) {
    uint32_t cell = cell_of(side->load, side->loads, load), i, j;
    double of_deviation[MOST_LOADS], of_compliance[MOST_LOADS];
    double h = side->load[cell + 1] - side->load[cell], u = (load - side->load[cell]) / h, u2 = u * u;
    memset(of_deviation, 0, (cell + 2) * sizeof *of_deviation);
    memset(of_compliance, 0, (cell + 2) * sizeof *of_compliance);
    for (j = 0; j < cell; j++) {
        double width = side->load[j + 1] - side->load[j];
        of_deviation[j] += 0.5 * width;
        of_deviation[j + 1] += 0.5 * width;
        of_compliance[j] += width * width / 12.0;
        of_compliance[j + 1] -= width * width / 12.0;
    }
    of_deviation[cell] += h * (u - u2 * u + 0.5 * u2 * u2);
    of_deviation[cell + 1] += h * (u2 * u - 0.5 * u2 * u2);
    of_compliance[cell] += h * h * (0.5 * u2 - 2.0 / 3.0 * u2 * u + 0.25 * u2 * u2);
    of_compliance[cell + 1] += h * h * (0.25 * u2 * u2 - u2 * u / 3.0);
    *energy = *rate = 0.0;
    for (i = 0; i < 4; i++) {
        const float *x = side->deviation + (size_t)place->node[i] * side->loads;
        const float *c = side->compliance + (size_t)place->node[i] * side->loads;
        double sum = 0.0;
        for (j = 0; j < cell + 2; j++) {
            sum += of_deviation[j] * (double)x[j] + of_compliance[j] * (double)c[j];
        }
        *energy += place->weight[i] * sum;
        *rate += place->rate[i] * sum;
    }
}

double table_pressure(const struct side *side, const struct place *told, double load) {
    uint32_t loads = side->told_loads, j = cell_of(side->told_load, loads, load);
    double u = (load - side->told_load[j]) / (side->told_load[j + 1] - side->told_load[j]);
    double low = blend(side->pressure, loads, told, j, told->weight);
    double high = blend(side->pressure, loads, told, j + 1, told->weight);
    double square = (1.0 - u) * low + u * high;
    return square > 0.0 ? sqrt(square) : 0.0;
}

int table_contact_count(const struct side *side, const struct place *told, double load) {
    uint32_t loads = side->told_loads, j = cell_of(side->told_load, loads, load);
    uint32_t nearest = 2.0 * load > side->told_load[j] + side->told_load[j + 1] || j == 0 ? j + 1 : j;
    return side->contact_count[(size_t)told->node[told->share < 0.5 ? 1 : 2] * loads + nearest];
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
