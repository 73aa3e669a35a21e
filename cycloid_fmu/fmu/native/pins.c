#include "pins.h"

#include <math.h>

/* As in contact.py and transmission.py. */
static const double FOOT_STEP = 1e-11;          /* m */
static const double LINEAR_STEP = 1e-9;         /* rad */
static const double LARGEST_STEP = 1e-3;        /* rad */
static const double BOUNDED = 2e-6, CLEAR = 5e-7; /* m */
static const double CONFORMAL = 0.1, UNBALANCED = 0.2;
static const double PI = 3.141592653589793;

size_t pins_count(const struct pins *pins) {
    return (size_t)pins->discs * (pins->teeth + 1);
}

size_t pins_contacts(const struct pins *pins) {
    return 2 * pins_count(pins) * pins->slices;
}

/* ---- the foot of a pin on the path of the generating pin ---- */

/* Tangency f(alpha) = (P - T).T', its derivative, and P, T'/(i e^(i alpha)) and P - T turned by -alpha. */
struct tangency {
    double f, slope, qx, qy, bx, by, dx, dy, cosine, sine;
};

static struct tangency tangency_at(const struct pins *pins, double px, double py, double alpha) {
    struct tangency t;
    double radius = pins->circle_radius, e = pins->generating_eccentricity, count = pins->teeth + 1.0;
    double c = cos(pins->teeth * alpha), s = sin(pins->teeth * alpha), cx, cy;
    t.cosine = cos(alpha);
    t.sine = sin(alpha);
    t.qx = px * t.cosine + py * t.sine;
    t.qy = py * t.cosine - px * t.sine;
    t.bx = radius - e * count * c;
    t.by = -e * count * s;
    t.dx = t.qx - (radius - e * c);
    t.dy = t.qy + e * s;
    cx = radius - e * count * count * c;
    cy = -e * count * count * s;
    t.f = t.dy * t.bx - t.dx * t.by;
    t.slope = -(t.dx * cx + t.dy * cy) - (t.bx * t.bx + t.by * t.by);
    return t;
}

/* Tangent point on the tooth between two roots, downhill from `alpha`, where it is then; 0 where there is none. */
static int find_foot(const struct pins *pins, double px, double py, double lower, double upper, double *alpha,
                     struct tangency *state) {
    double low = lower, high = upper;
    int low_known = 0, high_known = 0, i;
    *alpha = fmin(fmax(*alpha, lower), upper);
    *state = tangency_at(pins, px, py, *alpha);
    for (i = 0; i < 80; i++) {
        double step;
        if (state->slope < 0.0) {
            step = -state->f / state->slope;
            if (fabs(step) * sqrt(state->bx * state->bx + state->by * state->by) < FOOT_STEP) {
                return 1;
            }
        } else {
            step = copysign(0.15 * (upper - lower), state->f);
        }
        if (state->f > 0.0) {
            low = *alpha;
            low_known = 1;
        } else {
            high = *alpha;
            high_known = 1;
        }
        if (low >= high) {
            return 0;
        }
        *alpha += step;
        if (*alpha <= low) {
            *alpha = low_known ? 0.5 * (low + high) : lower;
        } else if (*alpha >= high) {
            *alpha = high_known ? 0.5 * (low + high) : upper;
        }
        *state = tangency_at(pins, px, py, *alpha);
    }
    return 1;
}

static double path_curvature(const struct pins *pins, double bx, double speed) {
    double radius = pins->circle_radius, count = pins->teeth + 1.0, ez = pins->generating_eccentricity * count;
    return (radius * radius + ez * ez * count - (count + 1.0) * radius * (radius - bx)) / (speed * speed * speed);
}

/* Gap, arm and their rates where a pin is nearest the flank's point of a state; `radius` is the generating pin's, less
   what the flank is raised there, and (ox, oy) the gear's centre in its own frame. */
static void write_contact(const struct pins *pins, struct contact *contact, const struct tangency *t, double radius,
                          double pin_radius, double ox, double oy) {
    double speed2 = t->bx * t->bx + t->by * t->by, speed = sqrt(speed2), teeth = pins->teeth;
    double wx = t->dx + radius * t->bx / speed, wy = t->dy + radius * t->by / speed;
    double distance = sqrt(wx * wx + wy * wy), nx = wx / distance, ny = wy / distance;
    double qx = t->qx, qy = t->qy, sign = -1.0, lever, inside;
    double stretch = -t->slope / speed2, kappa = path_curvature(pins, t->bx, speed);
    if (pins->ring) {
        qx += ox * t->cosine + oy * t->sine;
        qy += oy * t->cosine - ox * t->sine;
        sign = 1.0;
    }
    lever = qx * nx + qy * ny;
    inside = 1.0 / (1.0 - radius * kappa);
    contact->gap = distance - pin_radius;
    contact->foot_rate = sign * lever / (speed * stretch);
    contact->arm = sign * (qy * nx - qx * ny);
    contact->arm_rate = lever - lever * lever * kappa / stretch;
    contact->curvature = kappa * inside;
    contact->curvature_rate = -pins->circle_radius * teeth * t->by * ((teeth + 2.0) / speed - 3.0 * kappa) / speed2
        * inside * inside;
}

/* ---- flanks and pins with deviations ---- */

/* One pin before one tooth, both turned to tooth 0: the pin's axis, the direction from it to the pin circle's centre,
   and the deviations of the two. */
struct facing {
    const struct pins *pins;
    const float *gear, *gear_bend, *pin, *pin_bend;
    double gx, gy, fx, fy, pin_radius;
};

/* Place on the pin of a direction, in elements from the first one's middle. */
static double pin_place(const struct facing *facing, double vx, double vy) {
    double across = facing->fx * vy - facing->fy * vx, ahead = facing->fx * vx + facing->fy * vy;
    return (atan2(across, ahead) / PI + 0.5) * facing->pins->elements - 0.5;
}

static double on_pin(const struct facing *facing, const float *values, double place) {
    double low = floor(place), share;
    uint32_t first;
    low = low > 0.0 ? low : 0.0;
    first = low < facing->pins->elements - 2.0 ? (uint32_t)low : facing->pins->elements - 2;
    share = fmin(fmax(place - first, 0.0), 1.0);
    return (1.0 - share) * (double)values[first] + share * (double)values[first + 1];
}

/* Gap at one of the flank's points, nominal and with the deviations, and the place on the pin that faces it. */
static double raised_gap(const struct facing *facing, uint32_t point, double *nominal, double *seen) {
    const struct pins *pins = facing->pins;
    double vx = pins->flank_x[point] - facing->gx, vy = pins->flank_y[point] - facing->gy;
    double height = (double)facing->gear[point];
    *nominal = sqrt(vx * vx + vy * vy) - facing->pin_radius;
    vx += height * pins->normal_x[point];
    vy += height * pins->normal_y[point];
    *seen = pin_place(facing, vx, vy);
    return sqrt(vx * vx + vy * vy) - facing->pin_radius - on_pin(facing, facing->pin, *seen);
}

/* Place on the pin that faces a raised point of the flank. */
static double facing_place(const struct facing *facing, const struct tangency *t, double height) {
    double speed = sqrt(t->bx * t->bx + t->by * t->by), radius = facing->pins->generating_radius - height;
    double wx = -t->dx - radius * t->bx / speed, wy = -t->dy - radius * t->by / speed;
    return pin_place(facing, wx * t->cosine - wy * t->sine, wx * t->sine + wy * t->cosine);
}

struct closest {
    double gap, alpha, gear_height, pin_height;
};

/* Smallest gap between two neighbouring points of the flank, which see the given places on the pin. Between these the
   pin's deviation bends at the middle of each of its elements, so the piece is divided there. */
static struct closest closest_on_piece(const struct facing *facing, uint32_t piece, double first, double last) {
    const struct pins *pins = facing->pins;
    double a = pins->alpha[piece], b = pins->alpha[piece + 1], start = (double)facing->gear[piece];
    double rise = ((double)facing->gear[piece + 1] - start) / (b - a), high = a, right = first;
    struct closest best = {HUGE_VAL, a, start, 0.0};
    uint32_t part;
    for (part = 0; part <= pins->elements + 1 && high < b; part++) {
        double low = high, left = right, pin_rise, at;
        int i;
        right = last > left ? floor(left) + 1.0 : ceil(left) - 1.0;
        if ((right - last) * (last - first) >= 0.0) {
            high = b;
            right = last;
        } else {
            double each = (b - a) / (last - first);
            struct tangency t;
            high = a + (right - first) * each;
            t = tangency_at(pins, facing->gx, facing->gy, high);
            high += (right - facing_place(facing, &t, start + rise * (high - a))) * each;
            high = fmin(fmax(high, low), b);
        }
        pin_rise = (on_pin(facing, facing->pin, right) - on_pin(facing, facing->pin, left))
            / fmax(high - low, 1e-3 * (b - a));
        at = 0.5 * (low + high);
        for (i = 0; i < 8; i++) {
            struct tangency t = tangency_at(pins, facing->gx, facing->gy, at);
            double height = start + rise * (at - a), radius = pins->generating_radius - height;
            double pin_height = on_pin(facing, facing->pin, facing_place(facing, &t, height));
            double speed = sqrt(t.bx * t.bx + t.by * t.by);
            double wx = t.dx + radius * t.bx / speed, wy = t.dy + radius * t.by / speed;
            double distance = sqrt(wx * wx + wy * wy), gap = distance - facing->pin_radius - pin_height;
            double shrink = (1.0 - radius * path_curvature(pins, t.bx, speed)) / distance;
            double fall = -t.f * shrink - rise * (wx * t.bx + wy * t.by) / (speed * distance);
            double bend = -t.slope * shrink, step, next;
            if (gap < best.gap) {
                best.gap = gap;
                best.alpha = at;
                best.gear_height = height;
                best.pin_height = pin_height;
            }
            step = bend > 0.0 ? -(fall - pin_rise) / bend : copysign(b - a, pin_rise - fall);
            next = fmin(fmax(at + step, low), high);
            if (fabs(next - at) < 1e-9 * (b - a)) {
                break;
            }
            at = next;
        }
    }
    return best;
}

/* The first of ascending values that is not below the given one. */
static uint32_t first_from(const double *values, uint32_t count, double value) {
    uint32_t low = 0;
    while (count > 0) {
        uint32_t half = count / 2;
        if (values[low + half] < value) {
            low += half + 1;
            count -= half + 1;
        } else {
            count = half;
        }
    }
    return low;
}

static double added_curvature(const struct facing *facing, double alpha, double seen) {
    const struct pins *pins = facing->pins;
    uint32_t after = first_from(pins->alpha, pins->points, alpha);
    double share;
    after = after < 1 ? 1 : after < pins->points ? after : pins->points - 1;
    share = (alpha - pins->alpha[after - 1]) / (pins->alpha[after] - pins->alpha[after - 1]);
    return (1.0 - share) * (double)facing->gear_bend[after - 1] + share * (double)facing->gear_bend[after]
        + on_pin(facing, facing->pin_bend, seen);
}

/* Move a contact just solved on nominal surfaces, at tooth 0's `alpha`, to where those with deviations come closest:
   outwards from there until the nominal ones stand farther apart than any deviation can make up for. */
static void raise_contact(const struct facing *facing, struct contact *contact, double base, double alpha, double px,
                          double py, double ox, double oy) {
    const struct pins *pins = facing->pins;
    uint32_t middle = first_from(pins->alpha, pins->points, alpha);
    double arc, sag, pin_radius = facing->pin_radius;
    struct closest best = {HUGE_VAL, 0.0, 0.0, 0.0};
    struct tangency t;
    int direction;
    if (contact->gap - pins->largest_deviation > BOUNDED) {
        contact->gap -= pins->largest_deviation;
        return;
    }
    middle = middle < 1 ? 1 : middle < pins->points - 2 ? middle : pins->points - 2;
    arc = hypot(pins->flank_x[middle + 1] - pins->flank_x[middle], pins->flank_y[middle + 1] - pins->flank_y[middle]);
    /* Twice what a piece's middle may come closer than its ends. */
    sag = 0.25 * arc * arc * fabs(1.0 / pin_radius + contact->curvature);
    for (direction = -1; direction <= 1; direction += 2) {
        uint32_t point = middle;
        double nominal, seen, raised = raised_gap(facing, point, &nominal, &seen);
        while (direction < 0 ? point > 0 : point + 1 < pins->points) {
            double last_raised = raised, last_seen = seen;
            if (point != middle && nominal - pins->largest_deviation > best.gap) {
                break;
            }
            point = direction < 0 ? point - 1 : point + 1;
            raised = raised_gap(facing, point, &nominal, &seen);
            if (fmin(raised, last_raised) - sag < best.gap) {
                struct closest found = direction > 0 ? closest_on_piece(facing, point - 1, last_seen, seen)
                                                     : closest_on_piece(facing, point, seen, last_seen);
                best = found.gap < best.gap ? found : best;
            }
        }
    }
    t = tangency_at(pins, px, py, base + best.alpha);
    write_contact(pins, contact, &t, pins->generating_radius - best.gear_height, pin_radius + best.pin_height, ox, oy);
    if (pins->curved) {
        struct tangency on_first = tangency_at(pins, facing->gx, facing->gy, best.alpha);
        double added = added_curvature(facing, best.alpha, facing_place(facing, &on_first, best.gear_height));
        contact->curvature += fmax(added, (CONFORMAL - 1.0) * (1.0 / pin_radius + contact->curvature));
    }
}

/* ---- all pins ---- */

/* Where a disc and the ring stand: seen from the gear, but for `turned`, by which the ring stands ahead of it. */
struct pose {
    uint32_t disc;
    double turned, cosine, sine; /* of `turned` */
    double shift;                /* from a pin's direction to its conjugate point */
    double gear_cosine, gear_sine, eccentric_x, eccentric_y; /* the eccentricity, seen from the housing */
};

static struct pose pose_of(const struct pins *pins, uint32_t disc, double crank_angle, double deviation) {
    struct pose pose;
    double teeth = pins->teeth, phase = pins->crank_phase[disc], crank = crank_angle + phase;
    double ring = pins->ring ? crank_angle / (teeth + 1.0) + deviation : 0.0;
    double gear = pins->ring ? -phase / teeth : deviation - crank / teeth;
    pose.disc = disc;
    pose.turned = ring - gear;
    pose.cosine = cos(pose.turned);
    pose.sine = sin(pose.turned);
    pose.shift = (crank - ring) / teeth;
    pose.gear_cosine = cos(gear);
    pose.gear_sine = sin(gear);
    pose.eccentric_x = pins->eccentricity * cos(crank);
    pose.eccentric_y = pins->eccentricity * sin(crank);
    return pose;
}

static uint32_t number_of(double tooth, uint32_t teeth) {
    double rest = tooth - teeth * floor(tooth / teeth);
    return rest >= 0.0 && rest < teeth ? (uint32_t)rest : 0;
}

/* Nominal distance of the pin's axis from the path where the foot was found, else infinity. */
static double place_on_tooth(const struct pins *pins, const struct pose *pose, uint32_t pin, uint32_t slice,
                             double tooth, int inside, double conjugate, double start, double deviation,
                             struct contact *contact) {
    uint32_t number = number_of(tooth, pins->teeth), teeth = pins->teeth;
    double turn = pins->tooth_turn[(size_t)pose->disc * teeth + number], pitch = 2.0 * PI / teeth;
    double base = tooth * pitch, beyond = (tooth + 1.0) * pitch, alpha = start, c, s;
    double ux = pose->eccentric_x + pins->centre_x[slice], uy = pose->eccentric_y + pins->centre_y[slice];
    double ox = ux * pose->gear_cosine + uy * pose->gear_sine, oy = uy * pose->gear_cosine - ux * pose->gear_sine;
    double px = pins->x[pin] * pose->cosine - pins->y[pin] * pose->sine - ox;
    double py = pins->x[pin] * pose->sine + pins->y[pin] * pose->cosine - oy, qx;
    struct tangency state;
    contact->gap = HUGE_VAL;
    contact->at = deviation;
    c = 1.0 - 0.5 * turn * turn;
    s = turn * (1.0 - turn * turn / 6.0);
    qx = px * c + py * s;
    py = py * c - px * s;
    px = qx;
    if (!find_foot(pins, px, py, base, beyond, &alpha, &state) || (!inside && !(base < alpha && alpha < beyond))) {
        return HUGE_VAL;
    }
    contact->foot = alpha - conjugate;
    write_contact(pins, contact, &state, pins->generating_radius, pins->radius[pin], ox, oy);
    if (pins->points > 0) {
        double at = 2.0 * PI * pin / (teeth + 1.0) + pose->turned - turn - base, cb = cos(base), sb = sin(base);
        size_t flank = (((size_t)pose->disc * pins->slices + slice) * teeth + number) * pins->points;
        size_t surface = ((size_t)slice * (teeth + 1) + pin) * pins->elements;
        struct facing facing;
        facing.pins = pins;
        facing.gear = pins->gear_deviation + flank;
        facing.pin = pins->pin_deviation + surface;
        facing.gear_bend = pins->curved ? pins->gear_curvature + flank : NULL;
        facing.pin_bend = pins->curved ? pins->pin_curvature + surface : NULL;
        facing.gx = px * cb + py * sb;
        facing.gy = py * cb - px * sb;
        facing.fx = -cos(at);
        facing.fy = -sin(at);
        facing.pin_radius = pins->radius[pin];
        raise_contact(&facing, contact, base, alpha - base, px, py, ox, oy);
    }
    return (state.dx * state.bx + state.dy * state.by) / sqrt(state.bx * state.bx + state.by * state.by);
}

/* Contacts of a pin on its conjugate tooth and on the one across the nearest root, from the feet found before. */
static void place_pin(const struct pins *pins, const struct pose *pose, uint32_t pin, uint32_t slice, double deviation,
                      int cold, struct contact both[2]) {
    double pitch = 2.0 * PI / pins->teeth, conjugate = 2.0 * PI * pin / (pins->teeth + 1.0) + pose->shift;
    double tooth = floor(conjugate / pitch), along = conjugate / pitch - tooth, inwards = along < 0.5 ? 1.0 : -1.0;
    double root = (along < 0.5 ? tooth : tooth + 1.0) * pitch, reach = inwards * pins->root_phase / pins->teeth;
    double radius = pins->circle_radius, count = pins->teeth + 1.0, k = pins->generating_eccentricity * count / radius;
    double root_radius = radius * (1.0 - k) * (1.0 - k) / fmax(count * k - 1.0, 1e-9) - pins->root_margin;
    double root_margin = pins->root_margin / (radius * (1.0 - k)), other = tooth - inwards, start, distance;
    int near = 2.0 * PI * fmin(along, 1.0 - along) < pins->root_phase, known = !cold && both[0].gap < HUGE_VAL;
    start = known ? conjugate + both[0].foot : near ? root + reach : conjugate;
    if (known && !(tooth * pitch <= start && start <= (tooth + 1.0) * pitch)) {
        start = near ? root + reach : conjugate;
    }
    distance = place_on_tooth(pins, pose, pin, slice, tooth, 1, conjugate, start, deviation, &both[0]);
    /* Within the root's curvature radius a point has one foot only, unless that is so close to the root that the step
       between the two teeth decides. */
    if (!near || (distance < root_radius && fabs(conjugate + both[0].foot - root) > root_margin)) {
        both[1].gap = HUGE_VAL;
        both[1].at = deviation;
        return;
    }
    start = !cold && both[1].gap < HUGE_VAL ? conjugate + both[1].foot : root - reach;
    if (!(other * pitch < start && start < (other + 1.0) * pitch)) {
        start = root - reach;
    }
    place_on_tooth(pins, pose, pin, slice, other, 0, conjugate, start, deviation, &both[1]);
}

static void place(struct pins *pins, double crank_angle, double deviation, int cold) {
    struct contact *both = pins->contacts;
    uint32_t disc, slice, pin;
    for (disc = 0; disc < pins->discs; disc++) {
        struct pose pose = pose_of(pins, disc, crank_angle, deviation);
        for (slice = 0; slice < pins->slices; slice++) {
            for (pin = 0; pin <= pins->teeth; pin++, both += 2) {
                /* No place of a gear is farther from its axis than two of its radii, so no gap changes faster. */
                double passed = 2.0 * pins->circle_radius * fabs(deviation - both[0].at);
                if (cold || !(both[0].gap - passed > CLEAR) || !(both[1].gap - passed > CLEAR)) {
                    place_pin(pins, &pose, pin, slice, deviation, cold, both);
                }
            }
        }
    }
}

/* ---- forces ---- */

/* Hertz's line contact at a given approach, continued along its tangent where the law bends over. */
static void press(const struct pins *pins, struct contact *contact, double pin_radius) {
    double both = pins->compliance_gear + pins->compliance_pin, curvature = contact->curvature, approach = -contact->gap;
    double equivalent = 1.0 / fmax(fabs(1.0 / pin_radius + curvature), 1e-9);
    double log_radius = fmin(1.0 / fmax(fabs(curvature), 1e-12), pins->largest_log_radius);
    double kappa = both / (PI * pins->slice_width), share = pins->compliance_gear / both, target = approach / kappa;
    double h = 2.0 * (share * log(4.0 * log_radius) + (1.0 - share) * log(4.0 * pin_radius)) - 1.0
        - log(4.0 * equivalent * kappa);
    double force = contact->force > 0.0 ? contact->force : target / fmax(h - log(target) + 2.0, 2.0);
    double q = 0.0, change = 0.0, before = 0.0, limit, bending;
    int i;
    for (i = 0; i < 30; i++) {
        double next;
        q = fmax(h - log(force), 1.5);
        next = (target - force) / (q - 1.0);
        before = force;
        force = next <= 0.0 ? 0.5 * force : next;
        change = fabs(force - before);
        if (change <= 1e-6 * force) {
            break;
        }
    }
    q -= (force - before) / force;
    limit = q < 3.0 || change > 1e-5 * force ? exp(h - 2.0) : HUGE_VAL;
    if (target >= 2.0 * limit) {
        contact->force = target - limit;
        contact->stiffness = 1.0 / kappa;
        contact->force_by_curvature = 0.0;
        return;
    }
    bending = 1.0 / (1.0 / pin_radius + curvature);
    if (log_radius < pins->largest_log_radius) {
        bending -= 2.0 * share / curvature;
    }
    contact->force = force;
    contact->stiffness = 1.0 / (kappa * (q - 1.0));
    contact->force_by_curvature = -force * bending / (q - 1.0);
}

/* Torque that the contacts balance, and its derivative by the deviation. */
static double load(struct pins *pins, double *stiffness) {
    double torque = 0.0;
    size_t i, count = pins_contacts(pins);
    *stiffness = 0.0;
    for (i = 0; i < count; i++) {
        struct contact *c = &pins->contacts[i];
        if (!(c->gap < 0.0)) {
            c->force = 0.0;
            continue;
        }
        press(pins, c, pins->radius[i / 2 % (pins->teeth + 1)]);
        torque += c->force * c->arm;
        *stiffness += c->stiffness * c->arm * c->arm + c->force * c->arm_rate
            + c->force_by_curvature * c->curvature_rate * c->foot_rate * c->arm;
    }
    return torque;
}

/* Rotation in a direction at which the first flank touches, to second order. */
static double to_touch(const struct pins *pins, double deviation, double direction) {
    double best = HUGE_VAL;
    size_t i, count = pins_contacts(pins);
    for (i = 0; i < count; i++) {
        const struct contact *c = &pins->contacts[i];
        double since = deviation - c->at, gap = c->gap - since * (c->arm + 0.5 * since * c->arm_rate);
        double arm = direction * (c->arm + since * c->arm_rate), inside = arm * arm + 2.0 * c->arm_rate * gap;
        if (c->gap < HUGE_VAL && (arm > 0.0 || (gap > 1e-9 && c->arm_rate > 0.0)) && (inside >= 0.0 || gap <= 0.0)) {
            best = fmin(best, 2.0 * gap / (arm + sqrt(fmax(inside, 0.0))));
        }
    }
    return best;
}

/* Newton's method inside a bracket; 1 where the contacts do not come to balance the torque. */
static int balance(struct pins *pins, double crank_angle, double torque, double deviation) {
    double low = -HUGE_VAL, high = HUGE_VAL, stiffness = 0.0, carried = 0.0;
    size_t k, count = pins_contacts(pins);
    int i;
    for (i = 0; i < 100; i++) {
        double missing, step;
        place(pins, crank_angle, deviation, i == 0);
        carried = load(pins, &stiffness);
        missing = torque - carried;
        if (missing == 0.0 && stiffness == 0.0) {
            return 0;
        }
        if (missing > 0.0) {
            low = deviation;
        } else {
            high = deviation;
        }
        if (stiffness > 0.0) {
            step = missing / stiffness;
        } else {
            double direction = copysign(1.0, missing);
            step = direction * (fmax(to_touch(pins, deviation, direction), 0.0) + 1e-6);
        }
        step = fmin(fmax(step, -LARGEST_STEP), LARGEST_STEP);
        if (fabs(step) < LINEAR_STEP) {
            for (k = 0; k < count; k++) {
                struct contact *c = &pins->contacts[k];
                c->force = c->force > 0.0 ? c->force + c->stiffness * c->arm * step : 0.0;
            }
            break;
        }
        deviation = low < deviation + step && deviation + step < high ? deviation + step : 0.5 * (low + high);
    }
    return !(fabs(deviation) < 1.0)
        || (torque != 0.0 && !(stiffness > 0.0) && !(fabs(carried - torque) <= UNBALANCED * fabs(torque)));
}

int pins_solve(struct pins *pins, double crank_angle, double torque, double deviation) {
    double both = pins->compliance_gear + pins->compliance_pin;
    size_t i, pin, count = pins_contacts(pins), stride = 2 * (size_t)pins->slices * (pins->teeth + 1);
    /* After this all stands again; a reduced angle keeps its digits. */
    crank_angle = fmod(crank_angle, 2.0 * PI * (pins->ring ? pins->teeth + 1.0 : pins->teeth));
    if (pins->solved && pins->crank_angle == crank_angle && pins->torque == torque) {
        return 0;
    }
    pins->solved = 0;
    for (i = 0; i < count; i++) {
        pins->contacts[i].force = 0.0;
    }
    if (balance(pins, crank_angle, torque, deviation)) {
        return 1;
    }
    for (i = 0; i < pins_count(pins); i++) {
        pins->force[i] = pins->pressure[i] = 0.0;
    }
    for (i = 0; i < count; i++) {
        const struct contact *c = &pins->contacts[i];
        if (c->force > 0.0) {
            double radius = pins->radius[i / 2 % (pins->teeth + 1)], width = pins->slice_width;
            double equivalent = 1.0 / fmax(fabs(1.0 / radius + c->curvature), 1e-9);
            double half = sqrt(4.0 * c->force * equivalent * both / (PI * width));
            pin = i / stride * (pins->teeth + 1) + i / 2 % (pins->teeth + 1);
            pins->force[pin] += c->force;
            pins->pressure[pin] = fmax(pins->pressure[pin], 2.0 * c->force / (PI * half * width));
        }
    }
    pins->crank_angle = crank_angle;
    pins->torque = torque;
    pins->solved = 1;
    return 0;
}
