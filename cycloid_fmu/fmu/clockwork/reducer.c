/* An RV reducer: the drive with an involute stage before it and its crank bearings (docs/theory/reducer.md).

   The sun turns the planets, the planets the cranks, and the cycloid discs turn the carrier, in which the planets are
   mounted: so the crank angle is θ = a φ_b - b (φ_a + δ) with b = z_1/z_2, a = 1 + b and δ the sun's position within its
   play, and depends on the output angle that it causes. With s = 1/(1 + a/z_c) the transmission error is φ_b - φ_a/i = δ/i
   + s (x(θ) - β), with x that of the gear at its own torque and β the carrier's position in the crank bearings. Virtual
   work gives the torques: T = M + a τ at the output and -b τ at the sun, with M at the gear and τ at the crank. Between
   two flanges the energy is the cycloid stage's E(θ, φ) under this change of coordinates. */
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

/* The crank angle for an angle of the sun and a transmission error of the output, with the sun's play on the given side. */
static double crank_at(const struct drive *drive, double sun_angle, double transmission_error, double side) {
    double turns = sun_angle / (TWO_PI * drive->ratio), reduced = TWO_PI * drive->ratio * (turns - floor(turns));
    return reduced * drive->table->ratio / drive->ratio + drive->a * transmission_error
        - 0.5 * drive->b * side * sun_play(drive);
}

static void turn_crank(struct drive *drive, double transmission_error, double side) {
    drive->state.placed = crank_at(drive, drive->state.crank_angle, transmission_error, side);
}

static int offset_of(struct drive *drive, double side, double *offset, char message[MESSAGE_SIZE]) {
    struct play play = {0.0, 0.0, 0.0, 0.0};
    int failed = drive->state.backlash_on == 0.0 && teeth_play(drive, drive->state.placed, &play, message);
    *offset = side * play.offset;
    return failed;
}

int reducer_elastic(struct drive *drive, double torque, double end, double *transmission_error, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double side = torque == 0.0 ? end : copysign(1.0, torque), outer = side * outer_play(drive);
    double crank_torque = (1.0 - drive->s) / drive->a * torque, offset = 0.0;
    int i;
    s->loose = 0.0;
    *transmission_error = outer + drive->s * s->gear;
    for (i = 0; i < STAGE_ITERATIONS; i++) {
        double gear, following, before = crank_torque, own;
        turn_crank(drive, *transmission_error, side);
        if (kinematic_gear(drive, torque == 0.0 ? 0.0 : torque - drive->a * crank_torque, end, &gear, message)
            || offset_of(drive, torque == 0.0 ? end : s->side, &own, message) || offset_of(drive, side, &offset, message)) {
            return 1;
        }
        s->gear = gear + own;
        following = outer + drive->s * (s->gear - offset);
        if (kinematic_pressed(drive)) {
            crank_torque = teeth_crank_torque(drive, s->placed, kinematic_torque(drive));
        }
        gear = fabs(following - *transmission_error);
        *transmission_error = following;
        if (gear < STAGE_STEP && fabs(crank_torque - before) <= STAGE_SHARE * fabs(torque)) {
            break;
        }
    }
    return 0;
}

int reducer_hold(struct drive *drive, double transmission_error, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    struct play play;
    struct loaded at;
    double low, high, side, outer = outer_play(drive), torque;
    turn_crank(drive, transmission_error, 0.0);
    if (teeth_play(drive, s->placed, &play, message)) {
        return 1;
    }
    low = play.low + play.offset;
    high = play.high - play.offset;
    side = transmission_error > drive->s * high ? 1.0 : -1.0;
    if ((drive->s * low <= transmission_error && transmission_error <= drive->s * high)
        || fabs(transmission_error - drive->s * (side > 0.0 ? high : low)) <= outer) {
        double gear = transmission_error / drive->s;
        s->gear = gear < low ? low : gear > high ? high : gear;
        s->load = 0.0;
        s->loose = 1.0;
        return 0;
    }
    turn_crank(drive, transmission_error, side);
    s->loose = 0.0;
    if (teeth_hold(drive, s->placed, (transmission_error - side * outer) / drive->s,
                   s->series_compliance / (drive->s * drive->s), &torque, message)) {
        return 1;
    }
    s->side = side;
    s->load = fabs(torque);
    s->gear = 0.0;
    if (s->load < HUGE_VAL) {
        if (teeth_refuse(drive->contacts.loaded(drive->contacts.self, s->placed, torque, &at), torque, message)) {
            return 1;
        }
        s->gear = at.transmission_error;
    }
    return 0;
}

/* Rate of the gear's transmission error with the crank, without the play if it is off; and the stiffness of the teeth. */
static double gear_rate(struct drive *drive, double *stiffness) {
    const struct state *s = &drive->state;
    *stiffness = kinematic_pressed(drive) ? teeth_stiffness(drive, s->placed, kinematic_torque(drive)) : 0.0;
    return kinematic_rate(drive);
}

/* Derivative of the crank's torque with respect to its angle, at constant torque on the gear. */
static double crank_torque_rate(struct drive *drive) {
    const struct contacts *contacts = &drive->contacts;
    const double angle = drive->state.placed, torque = kinematic_torque(drive);
    double torques[2];
    int i;
    if (contacts->begin != NULL) {
        contacts->begin(contacts->self);
    }
    for (i = 0; i < 2; i++) {
        torques[i] = teeth_crank_torque(drive, angle + (i == 0 ? -STAGE_DIFFERENCE : STAGE_DIFFERENCE), torque);
    }
    if (contacts->undo != NULL) {
        contacts->undo(contacts->self);
    }
    return (torques[1] - torques[0]) / (2.0 * STAGE_DIFFERENCE);
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

double reducer_backlash(const struct drive *drive, double crank_angle, double gear) {
    double outer = outer_play(drive), ends[2];
    int side, i;
    for (side = 0; side < 2; side++) {
        double x = gear;
        for (i = 0; i < STAGE_ITERATIONS; i++) {
            double theta = crank_angle + drive->a * ((side == 0 ? -outer : outer) + drive->s * (x - gear)), end, ways[2];
            if (drive->contacts.play(drive->contacts.self, theta, ways) != CONTACTS_SOLVED) {
                return NAN;
            }
            if (ways[0] == ways[1]) {
                return 2.0 * outer;
            }
            end = ways[side];
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
static int within_plays(const struct drive *drive, double sun_angle, double transmission_error, double side,
                        struct pressed *pressed, double *rate, char message[MESSAGE_SIZE]) {
    double outer = outer_play(drive), by_crank, gear;
    if (teeth_press_gear(drive, crank_at(drive, sun_angle, transmission_error, side),
                         (transmission_error - side * outer) / drive->s,
                         drive->state.series_compliance / (drive->s * drive->s), pressed, message)) {
        return 1;
    }
    gear = pressed->by_rotation;
    by_crank = pressed->by_angle + gear / drive->table->ratio; /* at the same transmission error of the gear */
    pressed->by_angle *= -drive->b;
    pressed->by_rotation = gear / drive->s + drive->a * by_crank;
    pressed->stiffness /= drive->s * drive->s;
    *rate = -0.5 * drive->b * sun_play(drive) * by_crank - outer / drive->s * gear;
    return 0;
}

/* The crank has no mass, so it is at the minimum of the energy: at an end of the plays, or without contact. */
int reducer_press(const struct drive *drive, double sun_angle, double transmission_error, struct pressed *pressed,
                  char message[MESSAGE_SIZE]) {
    double first = transmission_error >= 0.0 ? 1.0 : -1.0, a = -first, b = first, rate, rate_a, rate_b, start;
    const double free = drive->contacts.free_energy;
    struct pressed other;
    int i;
    if (outer_play(drive) == 0.0) {
        return within_plays(drive, sun_angle, transmission_error, drive->state.backlash_on != 0.0 ? first : 0.0, pressed, &rate,
                            message);
    }
    if (within_plays(drive, sun_angle, transmission_error, first, pressed, &rate_b, message)) {
        return 1;
    }
    if (first * rate_b < 0.0) {
        return 0;
    }
    if (within_plays(drive, sun_angle, transmission_error, -first, &other, &rate_a, message)) {
        return 1;
    }
    if (-first * rate_a < 0.0 || (other.energy <= free && other.energy <= pressed->energy)) {
        *pressed = other;
        return 0;
    }
    if (pressed->energy <= free) {
        return 0;
    }
    /* Interference between free plays: the minimum of the energy. */
    start = fabs(rate_b);
    for (i = 0; i < STAGE_ITERATIONS; i++) {
        double at = (a * rate_b - b * rate_a) / (rate_b - rate_a);
        at = fmin(fmax(at, fmin(a, b)), fmax(a, b));
        if (within_plays(drive, sun_angle, transmission_error, at, pressed, &rate, message)) {
            return 1;
        }
        if (fabs(rate) <= STAGE_SHARE * start || fabs(b - a) < STAGE_SHARE) {
            return 0;
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
    return 0;
}

double reducer_pressed_stiffness(const struct drive *drive) {
    const struct pressed *at = &drive->pressed;
    const struct contacts *contacts = &drive->contacts;
    double turned = 1.0 - drive->a / drive->table->ratio, rate;
    if (at->stiffness <= 0.0) {
        return 0.0;
    }
    rate = contacts->rate(contacts->self, at->crank, at->torque);
    rate -= (at->torque < 0.0 ? -1.0 : 1.0) * teeth_offset_rate(drive, at->crank);
    turned -= drive->a * rate;
    return 1.0 / (1.0 / (at->stiffness * drive->s * drive->s * turned * turned) + drive->state.series_compliance);
}
