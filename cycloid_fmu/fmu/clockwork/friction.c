/* Friction of a flange, with the formulas of cycloid_fmu/fmu/friction.py: the sliding torque, and the elements that hold
   before sliding. */
#include "drive.h"

#include <math.h>
#include <string.h>

/* Share of the first element in the sliding torque; the others have two, three, ... times this share. */
static const double SHARE = 2.0 / (FRICTION_ELEMENTS * (FRICTION_ELEMENTS + 1.0));

static double clipped(double value, double least, double most) {
    return value < least ? least : value > most ? most : value;
}

static double warmth(const struct drive *drive, int flange) {
    const struct friction *law = &drive->state.friction[flange];
    return law->temperature_coefficient == 0.0
        ? 1.0 : exp(-law->temperature_coefficient * (drive->state.temperature - law->reference_temperature));
}

double friction_viscous(const struct drive *drive, int flange) {
    double torque = drive->state.friction[flange].viscous;
    return torque > 0.0 ? torque * warmth(drive, flange) : 0.0;
}

/* At the reference temperature; `ripples`: at the present crank angle, else in the mean over a turn. */
static struct yields cold_yields(const struct drive *drive, int flange, double load, double speed, int ripples) {
    const struct friction *law = &drive->state.friction[flange];
    double torque = law->coulomb + law->load_share * fabs(load);
    struct yields result;
    if (law->stribeck > 0.0) {
        double share = speed / law->stribeck_speed;
        torque += law->stribeck * exp(-fmin(share * share, 700.0));
    }
    result.low = result.high = torque;
    if (flange == INPUT && drive->lossy) {
        const double reduced = speed * losses_thinning(drive);
        const double low = losses_torque(drive, reduced, -load), high = losses_torque(drive, reduced, load);
        result.low += ripples ? fmax(low + losses_ripple(drive, reduced, load, -1.0), 0.0) : low;
        result.high += ripples ? fmax(high + losses_ripple(drive, reduced, load, 1.0), 0.0) : high;
    }
    return result;
}

struct yields friction_yields(const struct drive *drive, int flange, double load, double speed) {
    struct yields result = cold_yields(drive, flange, load, speed, 1);
    double warm = warmth(drive, flange);
    result.low *= warm;
    result.high *= warm;
    return result;
}

/* Values that follow from the laws; elements with a new stiffness start unstrained, their stored energy is dissipated. */
void friction_settle(struct drive *drive) {
    int flange, i;
    drive->lossy = losses_take(drive);
    for (flange = INPUT; flange <= OUTPUT; flange++) {
        double load = flange == INPUT ? drive->rated / drive->ratio : drive->rated;
        struct yields most = cold_yields(drive, flange, load, 0.0, 0);
        double stiffness = 2.0 * fmax(most.low, most.high)
            / (drive->state.friction[flange].presliding_angle * (FRICTION_ELEMENTS + 1));
        if (stiffness != drive->element[flange]) {
            for (i = 0; i < FRICTION_ELEMENTS; i++) {
                double *strain = &drive->state.strain[flange][i];
                drive->state.dissipated_energy += 0.5 * drive->element[flange] * *strain * *strain;
                *strain = 0.0;
            }
        }
        drive->element[flange] = stiffness;
        drive->rubs[flange] = stiffness > 0.0 || drive->state.friction[flange].viscous > 0.0;
    }
}

/* Move the elements by a displacement in a time; their strains at the end are in `following`. */
struct slid friction_slide(const double strain[FRICTION_ELEMENTS], double following[FRICTION_ELEMENTS], double way, double time,
                           double stiffness, struct yields yields) {
    struct slid result = {0.0, 0.0, 0.0};
    double damping = time > 0.0 ? stiffness * PRESLIDING_TIME / time : 0.0;
    double low = SHARE * yields.low / stiffness, high = SHARE * yields.high / stiffness;
    double bound = SHARE * (way > 0.0 ? yields.high : -yields.low);
    int i;
    for (i = 0; i < FRICTION_ELEMENTS; i++) {
        double least = -(i + 1) * low, most = (i + 1) * high;
        double start = clipped(strain[i], least, most), end = start + way, stuck, mean, change, damped, room;
        if (least <= end && end <= most) {
            stuck = way;
            mean = stiffness * (start + 0.5 * way);
            change = 0.5 * stiffness;
        } else {
            end = way > 0.0 ? most : least;
            stuck = end - start;
            change = stuck / way;
            change *= 0.5 * stiffness * change;
            mean = stiffness * end - change * way;
        }
        damped = damping * stuck;
        room = (i + 1) * bound - mean;
        if (fabs(damped) >= fabs(room)) {
            damped = room;
            change = 0.0;
        } else if (stuck == way) {
            change += damping;
        }
        result.torque += mean + damped;
        result.slope += change;
        result.lost += 0.5 * stiffness * (strain[i] * strain[i] - start * start) + stiffness * end * (way - stuck)
            + damped * way;
        following[i] = end;
    }
    return result;
}

/* Friction over a displacement in a time, under a load of the teeth; only `following` is written. */
struct slid friction_rub(const struct drive *drive, int flange, double way, double time, double load,
                         double following[FRICTION_ELEMENTS]) {
    double speed = time > 0.0 ? way / time : 0.0, stiffness = drive->element[flange], drag = friction_viscous(drive, flange);
    struct slid result = {0.0, 0.0, 0.0};
    if (stiffness > 0.0) {
        result = friction_slide(drive->state.strain[flange], following, way, time, stiffness,
                               friction_yields(drive, flange, load, speed));
    } else {
        memcpy(following, drive->state.strain[flange], sizeof drive->state.strain[flange]);
    }
    if (drag > 0.0 && time > 0.0) {
        result.torque += drag * speed;
        result.slope += drag / time;
        result.lost += drag * speed * way;
    }
    return result;
}

double friction_held(const struct drive *drive, int flange, double way, double load, double speed,
                     double following[FRICTION_ELEMENTS], double *slope) {
    double stiffness = drive->element[flange], torque = 0.0;
    struct yields yields = friction_yields(drive, flange, load, speed);
    double low = SHARE * yields.low / stiffness, high = SHARE * yields.high / stiffness;
    int i;
    *slope = 0.0;
    for (i = 0; i < FRICTION_ELEMENTS; i++) {
        double least = -(i + 1) * low, most = (i + 1) * high;
        double end = clipped(drive->state.strain[flange][i], least, most) + way;
        *slope += least < end && end < most ? stiffness : 0.0;
        following[i] = clipped(end, least, most);
        torque += following[i];
    }
    return stiffness * torque;
}

struct rubbing friction_press(const struct drive *drive, int flange, double way, double speed, double load, double time) {
    double stiffness = drive->element[flange], damped = stiffness * time * speed, drag = friction_viscous(drive, flange) * speed;
    struct rubbing result = {0.0, 0.0, 0.0};
    struct yields yields;
    int i;
    if (!drive->rubs[flange]) {
        return result;
    }
    result.torque = drag;
    result.power = drag * speed;
    if (stiffness == 0.0) {
        return result;
    }
    yields = friction_yields(drive, flange, load, speed);
    for (i = 0; i < FRICTION_ELEMENTS; i++) {
        double least = -(i + 1) * SHARE * yields.low, most = (i + 1) * SHARE * yields.high;
        double elastic = clipped(stiffness * (drive->state.strain[flange][i] + way), least, most);
        double reached = elastic + damped, torque = clipped(reached, least, most), held;
        double near = FRICTION_ROUNDING * (most - least);
        int slides = speed > 0.0 ? reached >= most - near : reached <= least + near;
        result.torque += torque;
        result.power += speed * (slides ? torque : damped);
        held = way == 0.0 ? drive->state.strain[flange][i] : elastic / stiffness; /* not dissipated yet if it yields less */
        result.stored += 0.5 * stiffness * held * held;
    }
    return result;
}

double friction_strained(const struct drive *drive, int flange) {
    double sum = 0.0;
    int i;
    for (i = 0; i < FRICTION_ELEMENTS; i++) {
        sum += drive->state.strain[flange][i];
    }
    return drive->element[flange] * sum;
}

double friction_flow(const struct drive *drive, int flange, double speed, double load, double rate[FRICTION_ELEMENTS]) {
    const struct yields yields = friction_yields(drive, flange, load, speed);
    double stiffness = drive->element[flange], stored = 0.0;
    double back = 1.0 / YIELDING_TIME + fabs(speed) / (YIELDING_SHARE * drive->state.friction[flange].presliding_angle);
    int i;
    for (i = 0; i < FRICTION_ELEMENTS; i++) {
        double strain = drive->state.strain[flange][i], share = (i + 1) * SHARE / stiffness;
        rate[i] = stiffness == 0.0
            ? 0.0 : speed - (strain - clipped(strain, -share * yields.low, share * yields.high)) * back;
        stored += stiffness * strain * rate[i];
    }
    return stored;
}
