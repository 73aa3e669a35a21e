/* The first stage of an RV reducer: as in cycloid_fmu/fmu/reducer_model.py. */
#include "drive.h"

#include <math.h>

static const double TWO_PI = 6.283185307179586;

static double sun_play(const struct drive *drive) {
    return drive->state.backlash_on != 0.0 ? drive->table->sun_play : 0.0;
}

/* Half the play of sun and bearings, at the output. */
static double outer_play(const struct drive *drive) {
    return drive->state.backlash_on == 0.0 ? 0.0
        : 0.5 * (sun_play(drive) / drive->ratio + drive->s * drive->table->bearing_play);
}

/* The crank angle for an angle of the sun and a deviation of the output, with the sun's play on the given side. */
static double crank_at(const struct drive *drive, double sun_angle, double deviation, double side) {
    double turns = sun_angle / (TWO_PI * drive->ratio), reduced = TWO_PI * drive->ratio * (turns - floor(turns));
    return reduced * drive->table->ratio / drive->ratio + drive->a * deviation
        - 0.5 * drive->b * side * sun_play(drive);
}

static struct play turn_crank(struct drive *drive, double deviation, double side) {
    struct state *s = &drive->state;
    s->placed = crank_at(drive, s->crank_angle, deviation, side);
    drive->placed = 0;
    return teeth_play(drive, drive_place(drive));
}

static double offset_of(const struct play *play, double side) {
    return side * play->offset;
}

int reducer_elastic(struct drive *drive, double torque, double end, double *deviation,
                           char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double side = torque == 0.0 ? end : copysign(1.0, torque), outer = side * outer_play(drive), energy;
    double crank_torque = (1.0 - drive->s) / drive->a * torque;
    int i;
    s->loose = 0.0;
    *deviation = outer + drive->s * s->gear;
    for (i = 0; i < STAGE_ITERATIONS; i++) {
        struct play play = turn_crank(drive, *deviation, side);
        double gear, following, before = crank_torque;
        if (kinematic_gear(drive, &play, torque == 0.0 ? 0.0 : torque - drive->a * crank_torque, end, &gear, message)) {
            return 1;
        }
        s->gear = gear + offset_of(&play, torque == 0.0 ? end : s->side);
        following = outer + drive->s * (s->gear - offset_of(&play, side));
        if (s->load > 0.0 || play.width == 0.0) {
            crank_torque = teeth_crank_torque(drive, &drive->place, s->load, s->side < 0.0 ? -1.0 : 1.0, play.offset_rate,
                                           &energy);
        }
        gear = fabs(following - *deviation);
        *deviation = following;
        if (gear < STAGE_STEP && fabs(crank_torque - before) <= STAGE_SHARE * fabs(torque)) {
            break;
        }
    }
    return 0;
}

void reducer_hold(struct drive *drive, double deviation) {
    struct state *s = &drive->state;
    struct play play = turn_crank(drive, deviation, 0.0);
    double low = -play.end[1].deviation, high = play.end[0].deviation, side, outer = outer_play(drive);
    if (play.width == 0.0 || s->backlash_on == 0.0) {
        low = high = 0.5 * (low + high);
    }
    side = deviation > drive->s * high ? 1.0 : -1.0;
    if ((drive->s * low <= deviation && deviation <= drive->s * high)
        || fabs(deviation - drive->s * (side > 0.0 ? high : low)) <= outer) {
        double gear = deviation / drive->s;
        s->gear = gear < low ? low : gear > high ? high : gear;
        s->load = 0.0;
        s->loose = 1.0;
        return;
    }
    play = turn_crank(drive, deviation, side);
    s->side = side;
    s->loose = 0.0;
    s->load = table_load(teeth_side(drive, side), &drive->place, side * (deviation - side * outer) / drive->s, play.offset,
                         s->series_compliance / (drive->s * drive->s));
    s->gear = side * (s->load < HUGE_VAL ? table_at(teeth_side(drive, side), &drive->place, s->load).deviation : 0.0);
}

/* Rate of the gear's deviation with the crank, without the play if it is off; and the stiffness of the teeth. */
static double gear_rate(struct drive *drive, double *stiffness) {
    const struct state *s = &drive->state;
    const struct place *place = drive_place(drive);
    struct play play = teeth_play(drive, place);
    double side = s->side < 0.0 ? -1.0 : 1.0;
    *stiffness = s->loose != 0.0 ? 0.0 : teeth_stiffness(drive, place, s->load, side, play.width);
    return kinematic_rate(drive, place, &play);
}

/* Derivative of the crank's torque with respect to its angle, at constant torque on the gear. */
static double crank_torque_rate(struct drive *drive) {
    const struct state *s = &drive->state;
    double found[2], energy;
    int i;
    for (i = 0; i < 2; i++) {
        struct place place = table_place(drive->table, s->placed + (i == 0 ? -STAGE_DIFFERENCE : STAGE_DIFFERENCE));
        struct play play = teeth_play(drive, &place);
        found[i] = teeth_crank_torque(drive, &place, s->load, s->side < 0.0 ? -1.0 : 1.0, play.offset_rate, &energy);
    }
    return (found[1] - found[0]) / (2.0 * STAGE_DIFFERENCE);
}

double reducer_speed(struct drive *drive) {
    const struct state *s = &drive->state;
    double stiffness, rate;
    if (s->crank_speed == 0.0 || s->pushed == 0.0) {
        return 0.0;
    }
    rate = gear_rate(drive, &stiffness);
    if (stiffness > 0.0) {
        rate -= drive->a * crank_torque_rate(drive) / ((1.0 - drive->a * rate) * stiffness);
    }
    rate *= -s->crank_speed * drive->b / (1.0 - drive->a * rate);
    return drive->rubs[OUTPUT] ? rate * kinematic_yielding(drive, rate, reducer_stiffness(drive)) : rate;
}

double reducer_stiffness(struct drive *drive) {
    double stiffness, turned = 1.0 - drive->a * gear_rate(drive, &stiffness);
    if (stiffness <= 0.0) {
        return 0.0;
    }
    stiffness = stiffness * turned * turned + drive->a * drive->a * crank_torque_rate(drive);
    return 1.0 / (1.0 / stiffness + drive->state.series_compliance);
}

double reducer_backlash(const struct drive *drive, double crank, double gear) {
    double outer = outer_play(drive), ends[2];
    int side, i;
    for (side = 0; side < 2; side++) {
        double x = gear;
        for (i = 0; i < STAGE_ITERATIONS; i++) {
            double theta = crank + drive->a * ((side == 0 ? -outer : outer) + drive->s * (x - gear)), end;
            struct place place = table_place(drive->table, theta);
            struct play play = teeth_play(drive, &place);
            if (play.width == 0.0) {
                return 2.0 * outer;
            }
            end = side == 0 ? -play.end[1].deviation : play.end[0].deviation;
            if (fabs(end - x) < STAGE_STEP) {
                x = end;
                break;
            }
            x = end;
        }
        ends[side] = x;
    }
    return 2.0 * outer + drive->s * (ends[1] - ends[0]);
}

/* Contacts at given flange angles with the plays of the gears at a relative position (-1 to 1); returns the derivative of
   the energy with respect to this position. */
static double within_plays(const struct drive *drive, double sun_angle, double deviation, double side,
                           struct pressed *found) {
    double outer = outer_play(drive), by_crank, gear;
    teeth_press_gear(drive, crank_at(drive, sun_angle, deviation, side), (deviation - side * outer) / drive->s,
                     drive->state.series_compliance / (drive->s * drive->s), found);
    gear = found->by_rotation;
    by_crank = found->by_angle + gear / drive->table->ratio; /* at the same deviation of the gear */
    found->by_angle *= -drive->b;
    found->by_rotation = gear / drive->s + drive->a * by_crank;
    found->stiffness /= drive->s * drive->s;
    return -0.5 * drive->b * sun_play(drive) * by_crank - outer / drive->s * gear;
}

/* The crank has no mass, so it is at the minimum of the energy: at an end of the plays, or without contact. */
void reducer_press(const struct drive *drive, double sun_angle, double deviation, struct pressed *found) {
    double first = deviation >= 0.0 ? 1.0 : -1.0, a = -first, b = first, rate, rate_a, rate_b, start;
    struct pressed other;
    int i;
    if (outer_play(drive) == 0.0) {
        within_plays(drive, sun_angle, deviation, drive->state.backlash_on != 0.0 ? first : 0.0, found);
        return;
    }
    rate_b = within_plays(drive, sun_angle, deviation, first, found);
    if (first * rate_b < 0.0) {
        return;
    }
    rate_a = within_plays(drive, sun_angle, deviation, -first, &other);
    if (-first * rate_a < 0.0 || other.load == 0.0) {
        *found = other;
        return;
    }
    if (found->load == 0.0) {
        return;
    }
    /* Interference between free plays: the minimum of the energy. */
    start = fabs(rate_b);
    for (i = 0; i < STAGE_ITERATIONS; i++) {
        double at = (a * rate_b - b * rate_a) / (rate_b - rate_a);
        at = fmin(fmax(at, fmin(a, b)), fmax(a, b));
        rate = within_plays(drive, sun_angle, deviation, at, found);
        if (fabs(rate) <= STAGE_SHARE * start || fabs(b - a) < STAGE_SHARE) {
            return;
        }
        if ((rate > 0.0) == (rate_a > 0.0)) {
            rate_b *= 0.5;
        } else {
            b = a;
            rate_b = 0.5 * rate_a;
        }
        a = at;
        rate_a = rate;
    }
}

double reducer_pressed_stiffness(const struct drive *drive) {
    const struct pressed *at = &drive->pressed;
    struct place place = table_place(drive->table, at->crank);
    struct play play = teeth_play(drive, &place);
    double stiffness = teeth_stiffness(drive, &place, at->load, at->side, play.width);
    double turned = 1.0 - drive->a / drive->table->ratio;
    if (stiffness <= 0.0) {
        return 0.0;
    }
    turned -= drive->a * at->side * (table_at(teeth_side(drive, at->side), &place, at->load).rate - play.offset_rate);
    return 1.0 / (1.0 / (stiffness * turned * turned) + drive->state.series_compliance);
}
