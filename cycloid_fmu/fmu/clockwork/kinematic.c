/* The kinematic interface: a quasi-static drive. Friction and play form one rate-independent hysteresis: the output is
   where teeth and friction elements balance the torque. Once all elements slide, the output is carried along, at its
   position for torque - friction or torque + friction. At zero torque without friction these two limits are the ends of
   the play. */
#include "drive.h"

#include <math.h>
#include <string.h>

double kinematic_torque(const struct drive *drive) {
    return drive->state.side < 0.0 ? -drive->state.load : drive->state.load;
}

int kinematic_pressed(const struct drive *drive) {
    return drive->state.load > 0.0 || (drive->state.loose == 0.0 && teeth_width(drive, drive->state.placed) == 0.0);
}

int kinematic_gear(struct drive *drive, double torque, double end, double *transmission_error, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    struct loaded at;
    struct play play = {0.0, 0.0, 0.0, 0.0};
    s->load = fabs(torque);
    s->side = torque == 0.0 ? end : copysign(1.0, torque);
    if ((torque == 0.0 || s->backlash_on == 0.0) && teeth_play(drive, s->placed, &play, message)) {
        return 1;
    }
    if (torque == 0.0) {
        *transmission_error = 0.5 * (play.low + play.high) + end * (0.5 * play.width - play.offset);
        return 0;
    }
    if (teeth_refuse(drive->contacts.loaded(drive->contacts.self, s->placed, torque, &at), torque, message)) {
        return 1;
    }
    *transmission_error = at.transmission_error - s->side * play.offset;
    if (!(fabs(*transmission_error) < LARGEST_TRANSMISSION_ERROR)) {
        return drive_refuse(message, "flange_b.tau and friction_torque make %g N.m, which turns the output by more than %g rad.",
                      torque, LARGEST_TRANSMISSION_ERROR);
    }
    return 0;
}

/* That of the flank under load, or of the flank that pushes the output. */
double kinematic_rate(const struct drive *drive) {
    const struct state *s = &drive->state;
    const struct contacts *contacts = &drive->contacts;
    const double side = s->side < 0.0 ? -1.0 : 1.0;
    double rate;
    if (s->load > 0.0) {
        rate = contacts->rate(contacts->self, s->placed, kinematic_torque(drive)) - side * teeth_offset_rate(drive, s->placed);
    } else if (s->backlash_on != 0.0 && teeth_width(drive, s->placed) > 0.0) {
        rate = contacts->touch_rate(contacts->self, s->placed, s->pushed < 0.0 ? -1.0 : 1.0);
    } else if (kinematic_pressed(drive)) {
        rate = contacts->rate(contacts->self, s->placed, 0.0);
    } else {
        rate = contacts->touch_rate(contacts->self, s->placed, 1.0) - teeth_offset_rate(drive, s->placed);
    }
    return rate + 1.0 / drive->table->ratio;
}

/* The flange's transmission error at a torque; at zero torque the given end of the play. */
static int elastic(struct drive *drive, double torque, double end, double *transmission_error, char message[MESSAGE_SIZE]) {
    int failed = drive->b > 0.0 ? reducer_elastic(drive, torque, end, transmission_error, message)
                                : kinematic_gear(drive, torque, end, transmission_error, message);
    *transmission_error += drive->state.series_compliance * torque;
    return failed;
}

static int hold(struct drive *drive, double transmission_error, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double torque;
    if (drive->b > 0.0) {
        return reducer_hold(drive, transmission_error, message);
    }
    if (teeth_hold(drive, s->placed, transmission_error, s->series_compliance, &torque, message)) {
        return 1;
    }
    s->load = fabs(torque);
    s->side = torque < 0.0 ? -1.0 : 1.0;
    return 0;
}

/* The output at zero torque without friction: it stays at its position, limited to the ends of the play. */
static int floating(struct drive *drive, double before, double *transmission_error, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double low = 0.0, high = 0.0;
    int failed = elastic(drive, 0.0, 1.0, &high, message);
    *transmission_error = before;
    s->pushed = 0.0;
    if (!failed && before > high) {
        *transmission_error = high;
        s->pushed = 1.0;
    } else if (!failed) {
        failed = elastic(drive, 0.0, -1.0, &low, message);
        if (before < low) {
            *transmission_error = low;
            s->pushed = -1.0;
        } else if (low == high) {
            *transmission_error = low;
        } else if (!failed) {
            failed = hold(drive, before, message);
        }
    }
    return failed;
}

/* The ideal speed of the output, for its friction. */
static double pace(const struct drive *drive) {
    return drive->state.crank_speed / drive->ratio;
}

/* Friction of the output while all elements slide, with the share of the load of the teeth, |towards - friction|;
   `towards` is the torque on the output, positive in the direction of motion. */
static double sliding(const struct drive *drive, double towards) {
    double bare = friction_yields(drive, OUTPUT, 0.0, pace(drive)).high, result;
    double share = friction_yields(drive, OUTPUT, 1.0, pace(drive)).high - bare;
    result = (bare + share * towards) / (1.0 + share);
    return result <= towards ? result : (bare - share * towards) / (1.0 - fmin(share, MOST_LOAD_SHARE));
}

/* The root of an increasing function by Newton's method within bounds, with bisection where a step does not halve: it
   could alternate for ever between two sliding states. */
struct search {
    double at, low, high, before, step;
};

static struct search search_between(double low, double high, double start) {
    struct search search = {start < low ? low : start > high ? high : start, low, high, high - low, high - low};
    return search;
}

/* Continue with the function's value and slope; returns whether the last step was short enough. */
static int search_on(struct search *search, double value, double slope, double accuracy) {
    double following = slope > 0.0 ? search->at - value / slope : HUGE_VAL;
    if (value > 0.0) {
        search->high = search->at;
    } else {
        search->low = search->at;
    }
    if (!(search->low <= following && following <= search->high && fabs(2.0 * value) <= search->before * slope)) {
        following = 0.5 * (search->low + search->high);
    }
    search->before = search->step;
    search->step = fabs(following - search->at);
    if (search->step <= accuracy) {
        return 1;
    }
    search->at = following;
    return 0;
}

/* The output's transmission error with friction that held it `before`: M + f(displacement) = T, teeth M, friction f. If all
   elements slide, the friction follows from the torque. Otherwise it is in between: the teeth have one transmission error at
   T - f, which decreases with f, and the elements have one f at each transmission error, which increases with it. */
static int carried(struct drive *drive, double before, double *transmission_error, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    const double load = s->torque - friction_viscous(drive, OUTPUT) * pace(drive), stiffness = drive->element[OUTPUT];
    double following[FRICTION_ELEMENTS], slope, end, most, ends[2], place[2], borne[2], reached = 0.0;
    struct search search;
    int i, failed = 0;
    s->pushed = 1.0;
    if (stiffness == 0.0) {
        return load == 0.0 ? floating(drive, before, transmission_error, message)
                           : elastic(drive, load, 0.0, transmission_error, message);
    }
    ends[0] = -sliding(drive, -load);
    ends[1] = sliding(drive, load);
    most = fmax(-ends[0], ends[1]);
    for (i = 0; i < 2; i++) {
        const double side = i == 0 ? 1.0 : -1.0;
        if (elastic(drive, load - ends[i], side, transmission_error, message)) {
            return 1;
        }
        reached = friction_held(drive, OUTPUT, *transmission_error - before, load - ends[i], pace(drive), following, &slope);
        if (reached * ends[i] >= ends[i] * ends[i] * (1.0 - FRICTION_ROUNDING)
            && (*transmission_error - before) * side <= 0.0) {
            s->pushed = side;
            memcpy(s->strain[OUTPUT], following, sizeof following);
            return 0;
        }
    }
    if (ends[0] < load && load < ends[1]) {
        for (i = 0; i < 2; i++) {
            if (elastic(drive, 0.0, i == 0 ? -1.0 : 1.0, &place[i], message)) {
                return 1;
            }
            borne[i] = friction_held(drive, OUTPUT, place[i] - before, 0.0, pace(drive), following, &slope);
        }
        if (borne[0] <= load && load <= borne[1]) {
            search = search_between(place[0], place[1], before);
            for (i = 0; i < FRICTION_ITERATIONS; i++) {
                reached = friction_held(drive, OUTPUT, search.at - before, 0.0, pace(drive), following, &slope);
                *transmission_error = search.at;
                if (search_on(&search, reached - load, slope, FRICTION_ROUNDING * s->friction[OUTPUT].presliding_angle)) {
                    break;
                }
            }
            s->pushed = 0.0;
            memcpy(s->strain[OUTPUT], following, sizeof following);
            return hold(drive, *transmission_error, message);
        }
        ends[load > borne[1] ? 1 : 0] = load;
    }
    end = load == ends[0] ? -1.0 : 1.0;
    search = search_between(ends[0], ends[1], friction_strained(drive, OUTPUT));
    for (i = 0; i < FRICTION_ITERATIONS && !failed; i++) {
        const double force = search.at, torque = load - force, side = torque == 0.0 ? end : copysign(1.0, torque);
        double compliance = s->series_compliance, teeth;
        failed = elastic(drive, torque, side, transmission_error, message);
        reached = friction_held(drive, OUTPUT, *transmission_error - before, torque, pace(drive), following, &slope);
        if (failed) {
            break;
        }
        teeth = kinematic_pressed(drive) ? teeth_stiffness(drive, s->placed, kinematic_torque(drive)) : 0.0;
        compliance += teeth > 0.0 ? 1.0 / teeth : 0.0;
        s->pushed = copysign(1.0, torque);
        if (search_on(&search, force - reached, 1.0 + slope * compliance, FRICTION_SHARE * most)) {
            break;
        }
    }
    memcpy(s->strain[OUTPUT], following, sizeof following);
    return failed;
}

int kinematic_follow(struct drive *drive, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double ideal = s->crank_angle / drive->ratio, transmission_error = 0.0;
    int failed;
    if (!((friction_viscous(drive, INPUT) + friction_viscous(drive, OUTPUT)) * s->crank_speed * s->crank_speed < HUGE_VAL)) {
        return drive_refuse(message, "flange_a.w = %g rad/s: viscous friction is beyond the range of numbers.", s->crank_speed, 0.0);
    }
    if (drive->b == 0.0) { /* a reducer's crank is set where its position is solved */
        s->placed = s->crank_angle;
    }
    if (s->settled == 0.0 || (!drive->rubs[OUTPUT] && s->torque != 0.0)) {
        failed = elastic(drive, s->torque, 0.0, &transmission_error, message);
        s->pushed = s->torque != 0.0 ? 1.0 : 0.0;
    } else if (drive->rubs[OUTPUT]) {
        failed = carried(drive, s->output_angle - ideal, &transmission_error, message);
    } else {
        failed = floating(drive, s->output_angle - ideal, &transmission_error, message);
    }
    if (!failed && !(fabs(transmission_error) < HUGE_VAL && fabs(ideal) < HUGE_VAL && s->load < HUGE_VAL)) {
        failed = drive_refuse(message, "flange_b.tau = %g N.m, flange_a.phi = %g rad: the output can't be found there.", s->torque, s->crank_angle);
    }
    s->settled = 1.0;
    s->output_angle = ideal + transmission_error;
    s->transmission_error = transmission_error;
    if (drive->element[INPUT] > 0.0 && drive->rubs[INPUT] && !failed) {
        double following[FRICTION_ELEMENTS], slope;
        friction_held(drive, INPUT, s->crank_angle - s->crank_seen, kinematic_crank_torque(drive), s->crank_speed, following,
                      &slope);
        memcpy(s->strain[INPUT], following, sizeof following);
    }
    s->crank_seen = s->crank_angle;
    return failed;
}

/* Friction of a flange at the present speeds; `torque` is the torque of the teeth at the crank. */
struct rubbing kinematic_rubbing(struct drive *drive, int flange, double torque) {
    if (flange == INPUT) {
        return friction_press(drive, INPUT, 0.0, drive->state.crank_speed, torque, PRESLIDING_TIME);
    }
    return friction_press(drive, OUTPUT, 0.0, kinematic_speed(drive), drive->state.torque - friction_strained(drive, OUTPUT),
                          0.0);
}

double kinematic_power(struct drive *drive) {
    return (drive->rubs[INPUT] ? kinematic_rubbing(drive, INPUT, kinematic_crank_torque(drive)).power : 0.0)
        + (drive->rubs[OUTPUT] ? kinematic_rubbing(drive, OUTPUT, 0.0).power : 0.0);
}

/* Share of its ideal speed that the output keeps while friction elements hold; `speed` has the sign of the motion. */
double kinematic_yielding(struct drive *drive, double speed, double stiffness) {
    double following[FRICTION_ELEMENTS], slope;
    if (drive->element[OUTPUT] == 0.0 || !drive->rubs[OUTPUT] || stiffness <= 0.0) {
        return 1.0;
    }
    friction_held(drive, OUTPUT, copysign(FRICTION_ROUNDING, speed) * drive->state.friction[OUTPUT].presliding_angle,
                  drive->state.torque - friction_strained(drive, OUTPUT), pace(drive), following, &slope);
    return 1.0 / (1.0 + slope / stiffness);
}

double kinematic_crank_torque(struct drive *drive) {
    double torque;
    if (!kinematic_pressed(drive)) {
        return 0.0;
    }
    torque = teeth_crank_torque(drive, drive->state.placed, kinematic_torque(drive));
    return drive->b > 0.0 ? -drive->b * torque : torque;
}

double kinematic_speed(struct drive *drive) {
    const struct state *s = &drive->state;
    double speed;
    if (drive->b > 0.0) {
        return reducer_speed(drive);
    }
    if (s->crank_speed == 0.0 || (s->pushed == 0.0 && (s->backlash_on != 0.0 || drive->rubs[OUTPUT]))) {
        return 0.0;
    }
    speed = s->crank_speed * kinematic_rate(drive);
    return drive->rubs[OUTPUT] ? speed * kinematic_yielding(drive, speed, drive_stiffness(drive)) : speed;
}
