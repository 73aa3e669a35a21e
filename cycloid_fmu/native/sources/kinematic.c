/* The kinematic interface. */
#include "drive.h"

#include <math.h>
#include <string.h>

const struct place *drive_place(struct drive *drive) {
    if (!drive->placed) {
        double crank = drive_kinematic(drive) || drive->resting ? drive->state.placed
            : drive->b > 0.0 ? drive->pressed.crank : drive_angle(drive);
        drive->place = table_place(drive->table, crank);
        drive->placed = 1;
        drive->at_load = 0.0;
    }
    return &drive->place;
}

/* The gear's deviation at a torque, less the play that does not act; at torque 0 the given end of the play. */
int kinematic_gear(struct drive *drive, const struct play *play, double torque, double end, double *deviation,
                   char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double side = torque == 0.0 ? (end < 0.0 ? -1.0 : 1.0) : copysign(1.0, torque), load = fabs(torque);
    const struct side *table = teeth_side(drive, side);
    s->load = load;
    s->side = torque == 0.0 ? end : side;
    if (torque == 0.0) {
        double middle = 0.5 * (play->end[0].deviation - play->end[1].deviation);
        *deviation = middle + end * (0.5 * play->width - play->offset);
        return 0;
    }
    drive->at = table_at(table, &drive->place, load);
    drive->at_load = side * load;
    *deviation = side * (drive->at.deviation - play->offset);
    if (!(fabs(*deviation) < LARGEST_TRANSMISSION_ERROR)) {
        return drive_refuse(message, "flange_b.tau and friction_torque make %g N.m, which turns the output by more than %g rad.",
                      torque, LARGEST_TRANSMISSION_ERROR);
    }
    return 0;
}

/* What the output turns with the crank: the flank under load, or the one that is pushed, carries it. */
double kinematic_rate(struct drive *drive, const struct place *place, const struct play *play) {
    const struct state *s = &drive->state;
    double side = s->side < 0.0 ? -1.0 : 1.0, rate;
    if (s->load > 0.0) {
        rate = side * (table_at(teeth_side(drive, side), place, s->load).rate - play->offset_rate);
    } else if (s->backlash_on == 0.0 || play->width == 0.0) {
        rate = play->end[0].rate - play->offset_rate;
    } else {
        rate = s->pushed < 0.0 ? -play->end[1].rate : play->end[0].rate;
    }
    return rate + 1.0 / drive->table->ratio;
}

/* The flange's deviation at a torque; at torque 0 the given end of the play. */
static int elastic(struct drive *drive, const struct play *play, double torque, double end, double *deviation,
                   char message[MESSAGE_SIZE]) {
    int failed = drive->b > 0.0 ? reducer_elastic(drive, torque, end, deviation, message)
                                : kinematic_gear(drive, play, torque, end, deviation, message);
    *deviation += drive->state.series_compliance * torque;
    return failed;
}

static void hold(struct drive *drive, const struct play *play, double deviation) {
    struct state *s = &drive->state;
    if (drive->b > 0.0) {
        reducer_hold(drive, deviation);
        return;
    }
    s->side = deviation > play->end[0].deviation - play->offset ? 1.0 : -1.0;
    s->load = table_load(teeth_side(drive, s->side), &drive->place, s->side * deviation, play->offset, s->series_compliance);
}

int kinematic_follow(struct drive *drive, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double ideal = s->crank_angle / drive->ratio, deviation = 0.0, low = 0.0, high = 0.0;
    struct play play;
    int failed;
    memset(&play, 0, sizeof play);
    if (drive->b == 0.0) { /* a reducer's crank is turned where its place is found */
        s->placed = s->crank_angle;
        drive->placed = 0;
        drive_place(drive);
        if (s->torque == 0.0 || s->friction_torque != 0.0 || s->backlash_on == 0.0) {
            play = teeth_play(drive, &drive->place);
        }
    }
    if (s->settled == 0.0 || (s->friction_torque == 0.0 && s->torque != 0.0)) {
        failed = elastic(drive, &play, s->torque, 0.0, &deviation, message);
        s->pushed = s->torque != 0.0 ? 1.0 : 0.0;
    } else {
        double before = s->output_angle - ideal;
        deviation = before;
        s->pushed = 0.0;
        failed = elastic(drive, &play, s->torque + s->friction_torque, 1.0, &high, message);
        if (!failed && before > high) {
            deviation = high;
            s->pushed = 1.0;
        } else if (!failed) {
            failed = elastic(drive, &play, s->torque - s->friction_torque, -1.0, &low, message);
            if (before < low) {
                deviation = low;
                s->pushed = -1.0;
            } else if (low == high) {
                deviation = low;
            } else if (!failed) {
                hold(drive, &play, before);
            }
        }
    }
    if (!failed && !(fabs(deviation) < HUGE_VAL && fabs(ideal) < HUGE_VAL && s->load < HUGE_VAL)) {
        failed = drive_refuse(message, "flange_b.tau = %g N.m, flange_a.phi = %g rad: the output can't be found there.", s->torque, s->crank_angle);
    }
    s->settled = 1.0;
    s->output_angle = ideal + deviation;
    s->deviation = deviation;
    return failed;
}

double kinematic_crank_torque(struct drive *drive) {
    const struct place *place = drive_place(drive);
    struct play play = teeth_play(drive, place);
    double energy, torque;
    if (drive->state.load == 0.0 && (play.width > 0.0 || drive->state.loose != 0.0)) {
        return 0.0;
    }
    torque = teeth_crank_torque(drive, place, drive->state.load, drive->state.side < 0.0 ? -1.0 : 1.0, play.offset_rate,
                             &energy);
    return drive->b > 0.0 ? -drive->b * torque : torque;
}

double kinematic_speed(struct drive *drive) {
    const struct state *s = &drive->state;
    const struct place *place = drive_place(drive);
    struct play play;
    double side = s->side < 0.0 ? -1.0 : 1.0;
    if (drive->b > 0.0) {
        return reducer_speed(drive);
    }
    if (s->crank_speed == 0.0 || (s->pushed == 0.0 && (s->backlash_on != 0.0 || s->friction_torque > 0.0))) {
        return 0.0;
    }
    if (s->load > 0.0 && s->backlash_on != 0.0) {
        if (drive->at_load != side * s->load) {
            drive->at = table_at(teeth_side(drive, side), place, s->load);
            drive->at_load = side * s->load;
        }
        return s->crank_speed * (side * drive->at.rate + 1.0 / drive->table->ratio);
    }
    play = teeth_play(drive, place);
    return s->crank_speed * kinematic_rate(drive, place, &play);
}
