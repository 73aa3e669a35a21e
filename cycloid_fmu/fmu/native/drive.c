#include "drive.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* As in variables.py, losses.py and compliant_model.py. */
static const double FRICTION_DISPLACEMENT = 2e-5, LOSS_SPEED = 1e-2, FARTHEST = 0.01, SUB_STEP = 0.2;
static const double CRANK_STEP = 0.02, DEVIATION_STEP = 5e-6, SAME = 1e-11, CLOSE = 1e-15;
static const double MOST_SUB_STEPS = 20000.0;
static const double NO_PLAY = 1e-13;            /* rad */
static const double LEAST_COMPLIANCE = 1e-12; /* rad/(N.m): between nodes a table may have none */
static const double RATED = 0.4;     /* of the last load of the tables */
static const char BLOB_MAGIC[16] = "cycloid native\n";
static const double TWO_PI = 6.283185307179586;
static const double STEP = 1e-13, DIFFERENCE = 1e-6; /* of a reducer's crank: last step, and for its torque's change */
enum { BLOB_VERSION = 2 };

enum field {
    CRANK_ANGLE, CRANK_SPEED, CRANK_TORQUE, OUTPUT_ANGLE, OUTPUT_SPEED, OUTPUT_TORQUE, TRANSMISSION_ERROR, BACKLASH,
    TORSIONAL_STIFFNESS, MAX_CONTACT_PRESSURE, CONTACT_COUNT, FRICTION_TORQUE, SERIES_COMPLIANCE, POWER_LOSS,
    BACKLASH_ON, ELASTIC_ENERGY, DISSIPATED_ENERGY, MESH_DAMPING, LARGEST_STEP, OUTPUT_INERTIA, TIME, PIN_FORCE,
    PIN_PRESSURE, FIELDS, LOSS = FIELDS
};
static const char *const NAMES[FIELDS] = {
    "flange_a.phi", "flange_a.w", "flange_a.tau", "flange_b.phi", "flange_b.w", "flange_b.tau", "transmission_error",
    "backlash", "torsional_stiffness", "max_contact_pressure", "contact_count", "friction_torque", "series_compliance",
    "power_loss", "backlash_on", "elastic_energy", "dissipated_energy", "mesh_damping", "largest_step",
    "output_inertia", "time", "pin_force", "pin_pressure",
};

static int refuse(char message[MESSAGE_SIZE], const char *format, double value, double limit) {
    snprintf(message, MESSAGE_SIZE, format, value, limit);
    return 1;
}

static int kinematic(const struct drive *drive) {
    return drive->table->offers == INTERFACE_KINEMATIC;
}

/* ---- losses ---- */

static int check_losses(const struct drive *drive, char message[MESSAGE_SIZE]) {
    int i, j;
    for (i = 0; i < drive->rows; i++) {
        const double *row = drive->state.loss + i * LOSS_COLUMNS;
        if (i == 0 ? row[0] != 0.0 : !(row[0] > row[-LOSS_COLUMNS])) {
            return refuse(message, "loss_table[%.0f,1] = %g: speeds must ascend from 0.", i + 1, row[0]);
        }
        if (!(row[1] > 0.0 && row[1] <= 1.0)) {
            return refuse(message, "loss_table[%.0f,2] = %g: an efficiency lies above 0 and not above 1.", i + 1, row[1]);
        }
        if (!(row[2] >= 0.0 && row[2] <= 1.0)) {
            return refuse(message, "loss_table[%.0f,3] = %g: an efficiency lies between 0 and 1.", i + 1, row[2]);
        }
        for (j = 3; j < LOSS_COLUMNS; j++) {
            if (!(row[j] >= 0.0)) {
                return refuse(message, "loss_table[%.0f,4] or its neighbour = %g: a friction torque must not be below 0.",
                              i + 1, row[j]);
            }
        }
    }
    return 0;
}

static int dissipative(const struct drive *drive) {
    int i, found = drive->state.mesh_damping > 0.0;
    for (i = 0; i < drive->rows; i++) {
        const double *row = drive->state.loss + i * LOSS_COLUMNS;
        found |= row[1] != 1.0 || row[2] != 1.0 || row[3] != 0.0 || row[4] != 0.0;
    }
    return found;
}

static double loss_torque(const struct drive *drive, double torque) {
    double speed = drive->state.crank_speed, size = fabs(speed), at[LOSS_COLUMNS], lost, ramp;
    const double *rows = drive->state.loss;
    int i, j, last = drive->rows - 1;
    if (speed == 0.0 || drive->rows == 0) {
        return 0.0;
    }
    memcpy(at, rows + last * LOSS_COLUMNS, sizeof at);
    for (i = 0; i < last; i++) {
        const double *below = rows + i * LOSS_COLUMNS, *above = below + LOSS_COLUMNS;
        if (size < above[0]) {
            double share = (size - below[0]) / (above[0] - below[0]);
            for (j = 1; j < LOSS_COLUMNS; j++) {
                at[j] = below[j] + share * (above[j] - below[j]);
            }
            break;
        }
    }
    if (torque * speed >= 0.0) {
        lost = fabs(torque) * (1.0 / at[1] - 1.0) + at[3];
    } else {
        lost = fabs(torque) * (1.0 - at[2]) + at[4];
    }
    ramp = size / LOSS_SPEED;
    return copysign(lost * (ramp < 1.0 ? ramp : 1.0), speed);
}

/* ---- contacts ---- */

static const struct side *side_of(const struct drive *drive, double direction) {
    return &drive->table->side[direction > 0.0 ? 0 : 1];
}

/* The ends of the play, mirrored, and what `backlash_on` takes from both. */
struct play {
    struct loaded end[2];
    double width, offset, offset_rate;
};

static struct play play_at(const struct drive *drive, const struct place *place) {
    struct play play;
    play.end[0] = table_at_node(&drive->table->side[0], place, 0);
    play.end[1] = table_at_node(&drive->table->side[1], place, 0);
    play.width = play.end[0].deviation + play.end[1].deviation;
    play.offset = play.offset_rate = 0.0;
    if (play.width <= NO_PLAY) {
        play.width = 0.0;
    } else if (drive->state.backlash_on == 0.0) {
        play.offset = 0.5 * play.width;
        play.offset_rate = 0.5 * (play.end[0].rate + play.end[1].rate);
    }
    return play;
}

/* Torque of the crank from the contacts: the energy's derivative at fixed output. */
static double crank_torque_at(const struct drive *drive, const struct place *place, double load, double side,
                              double offset_rate, double *energy) {
    double rate;
    table_energy(side_of(drive, side), place, load, energy, &rate);
    return table_rest_torque(drive->table, place) - side * load / drive->table->ratio - (rate - offset_rate * load);
}

static double stiffness_at(const struct drive *drive, const struct place *place, double load, double side, double play) {
    double compliance;
    if (load > 0.0) {
        compliance = table_at(side_of(drive, side), place, load).compliance;
    } else if (play > 0.0) {
        return 0.0;
    } else {
        compliance = table_at_node(side_of(drive, 1.0), place, 0).compliance;
    }
    return 1.0 / (compliance > LEAST_COMPLIANCE ? compliance : LEAST_COMPLIANCE);
}

static int press(const struct drive *drive, double crank_angle, double deviation, struct pressed *found,
                 char message[MESSAGE_SIZE]) {
    struct place place;
    struct play play;
    double series = drive->state.series_compliance, energy;
    if (!(deviation > -FARTHEST && deviation < FARTHEST)) {
        return refuse(message, "flange_b.phi is %g rad from flange_a.phi/ratio: it must stay within %g rad.", deviation,
                      FARTHEST);
    }
    place = table_place(drive->table, crank_angle);
    play = play_at(drive, &place);
    found->side = deviation > play.end[0].deviation - play.offset ? 1.0 : -1.0;
    found->load = table_load(side_of(drive, found->side), &place, found->side * deviation, play.offset, series);
    if (!(found->load < HUGE_VAL)) {
        const struct side *side = side_of(drive, found->side);
        return refuse(message, "flange_b.phi is %g rad from flange_a.phi/ratio, where the torque is beyond the %g N.m "
                      "of the FMU's table: build it with a larger rated torque.", deviation, side->load[side->loads - 1]);
    }
    found->by_angle = crank_torque_at(drive, &place, found->load, found->side, play.offset_rate, &energy);
    found->by_rotation = found->side * found->load;
    found->energy = found->load * (found->side * deviation + play.offset) - energy
        - 0.5 * series * found->load * found->load + table_rest_energy(drive->table, &place);
    found->stiffness = stiffness_at(drive, &place, found->load, found->side, play.width);
    return 0;
}

/* ---- the kinematic interface ---- */

static const struct place *placed(struct drive *drive) {
    if (!drive->placed) {
        drive->place = table_place(drive->table, kinematic(drive) ? drive->state.placed : drive->state.crank_angle);
        drive->placed = 1;
        drive->at_load = 0.0;
    }
    return &drive->place;
}

/* The gear's deviation at a torque, less the play that does not act; at torque 0 the given end of the play. */
static int gear_elastic(struct drive *drive, const struct play *play, double torque, double end, double *deviation,
                   char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double side = torque == 0.0 ? (end < 0.0 ? -1.0 : 1.0) : copysign(1.0, torque), load = fabs(torque);
    const struct side *table = side_of(drive, side);
    if (!(load <= table->load[table->loads - 1])) {
        return refuse(message, "flange_b.tau and friction_torque make %g N.m: the FMU's table reaches %g N.m; build it with "
                      "a larger rated torque.", torque, table->load[table->loads - 1]);
    }
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
    return 0;
}

/* ---- the first stage of an RV reducer: as in reducer_model.py ---- */

static double sun_play(const struct drive *drive) {
    return drive->state.backlash_on != 0.0 ? drive->table->sun_play : 0.0;
}

/* Half of what the sun's and the bearings' play are at the output. */
static double outer_play(const struct drive *drive) {
    return drive->state.backlash_on == 0.0 ? 0.0
        : 0.5 * (sun_play(drive) / drive->ratio + drive->s * drive->table->bearing_play);
}

/* Put the crank where the sun and an output that deviates so have it, the sun's play on the given side. */
static struct play turn_crank(struct drive *drive, double deviation, double side) {
    struct state *s = &drive->state;
    double turns = s->crank_angle / (TWO_PI * drive->ratio), reduced = TWO_PI * drive->ratio * (turns - floor(turns));
    s->placed = reduced * drive->table->ratio / drive->ratio + drive->a * deviation
        - 0.5 * drive->b * side * sun_play(drive);
    drive->placed = 0;
    return play_at(drive, placed(drive));
}

static double offset_of(const struct play *play, double side) {
    return side * play->offset;
}

static int reducer_elastic(struct drive *drive, double torque, double end, double *deviation,
                           char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double side = torque == 0.0 ? end : copysign(1.0, torque), outer = side * outer_play(drive), energy;
    double crank_torque = (1.0 - drive->s) / drive->a * torque;
    int i;
    s->loose = 0.0;
    *deviation = outer + drive->s * s->gear;
    for (i = 0; i < 50; i++) {
        struct play play = turn_crank(drive, *deviation, side);
        double gear, following, before = crank_torque;
        if (gear_elastic(drive, &play, torque == 0.0 ? 0.0 : torque - drive->a * crank_torque, end, &gear, message)) {
            return 1;
        }
        s->gear = gear + offset_of(&play, torque == 0.0 ? end : s->side);
        following = outer + drive->s * (s->gear - offset_of(&play, side));
        if (s->load > 0.0 || play.width == 0.0) {
            crank_torque = crank_torque_at(drive, &drive->place, s->load, s->side < 0.0 ? -1.0 : 1.0, play.offset_rate,
                                           &energy);
        }
        gear = fabs(following - *deviation);
        *deviation = following;
        if (gear < STEP && fabs(crank_torque - before) <= 1e-12 * fabs(torque)) {
            break;
        }
    }
    return 0;
}

static void reducer_hold(struct drive *drive, double deviation) {
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
    s->load = table_load(side_of(drive, side), &drive->place, side * (deviation - side * outer) / drive->s, play.offset,
                         s->series_compliance / (drive->s * drive->s));
    s->gear = side * (s->load < HUGE_VAL ? table_at(side_of(drive, side), &drive->place, s->load).deviation : 0.0);
}

/* What the output turns with the crank: the flank under load, or the one that is pushed, carries it. */
static double carried_rate(struct drive *drive, const struct place *place, const struct play *play) {
    const struct state *s = &drive->state;
    double side = s->side < 0.0 ? -1.0 : 1.0, rate;
    if (s->load > 0.0) {
        rate = side * (table_at(side_of(drive, side), place, s->load).rate - play->offset_rate);
    } else if (s->backlash_on == 0.0 || play->width == 0.0) {
        rate = play->end[0].rate - play->offset_rate;
    } else {
        rate = s->pushed < 0.0 ? -play->end[1].rate : play->end[0].rate;
    }
    return rate + 1.0 / drive->table->ratio;
}

/* What the gear's deviation changes with the crank, less the play that does not act; and how stiff the teeth are. */
static double gear_rate(struct drive *drive, double *stiffness) {
    const struct state *s = &drive->state;
    const struct place *place = placed(drive);
    struct play play = play_at(drive, place);
    double side = s->side < 0.0 ? -1.0 : 1.0;
    *stiffness = s->loose != 0.0 ? 0.0 : stiffness_at(drive, place, s->load, side, play.width);
    return carried_rate(drive, place, &play);
}

/* Change of the crank's torque with its angle at constant torque on the gear. */
static double crank_torque_rate(struct drive *drive) {
    const struct state *s = &drive->state;
    double found[2], energy;
    int i;
    for (i = 0; i < 2; i++) {
        struct place place = table_place(drive->table, s->placed + (i == 0 ? -DIFFERENCE : DIFFERENCE));
        struct play play = play_at(drive, &place);
        found[i] = crank_torque_at(drive, &place, s->load, s->side < 0.0 ? -1.0 : 1.0, play.offset_rate, &energy);
    }
    return (found[1] - found[0]) / (2.0 * DIFFERENCE);
}

static double reducer_speed(struct drive *drive) {
    const struct state *s = &drive->state;
    double stiffness, rate;
    if (s->crank_speed == 0.0 || s->pushed == 0.0) {
        return 0.0;
    }
    rate = gear_rate(drive, &stiffness);
    if (stiffness > 0.0) {
        rate -= drive->a * crank_torque_rate(drive) / ((1.0 - drive->a * rate) * stiffness);
    }
    return -s->crank_speed * rate * drive->b / (1.0 - drive->a * rate);
}

static double reducer_stiffness(struct drive *drive) {
    double stiffness, turned = 1.0 - drive->a * gear_rate(drive, &stiffness);
    if (stiffness <= 0.0) {
        return 0.0;
    }
    stiffness = stiffness * turned * turned + drive->a * drive->a * crank_torque_rate(drive);
    return 1.0 / (1.0 / stiffness + drive->state.series_compliance);
}

static double reducer_backlash(const struct drive *drive) {
    const struct state *s = &drive->state;
    double outer = outer_play(drive), ends[2];
    int side, i;
    for (side = 0; side < 2; side++) {
        double x = s->gear;
        for (i = 0; i < 50; i++) {
            double theta = s->placed + drive->a * ((side == 0 ? -outer : outer) + drive->s * (x - s->gear)), end;
            struct place place = table_place(drive->table, theta);
            struct play play = play_at(drive, &place);
            if (play.width == 0.0) {
                return 2.0 * outer;
            }
            end = side == 0 ? -play.end[1].deviation : play.end[0].deviation;
            if (fabs(end - x) < STEP) {
                x = end;
                break;
            }
            x = end;
        }
        ends[side] = x;
    }
    return 2.0 * outer + drive->s * (ends[1] - ends[0]);
}

/* ---- both ---- */

/* The flange's deviation at a torque; at torque 0 the given end of the play. */
static int elastic(struct drive *drive, const struct play *play, double torque, double end, double *deviation,
                   char message[MESSAGE_SIZE]) {
    int failed = drive->b > 0.0 ? reducer_elastic(drive, torque, end, deviation, message)
                                : gear_elastic(drive, play, torque, end, deviation, message);
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
    s->load = table_load(side_of(drive, s->side), &drive->place, s->side * deviation, play->offset, s->series_compliance);
}

static int follow_torque(struct drive *drive, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double ideal = s->crank_angle / drive->ratio, deviation = 0.0, low = 0.0, high = 0.0;
    struct play play;
    int failed;
    memset(&play, 0, sizeof play);
    if (drive->b == 0.0) { /* a reducer's crank is turned where its place is found */
        s->placed = s->crank_angle;
        drive->placed = 0;
        placed(drive);
        if (s->torque == 0.0 || s->friction_torque != 0.0 || s->backlash_on == 0.0) {
            play = play_at(drive, &drive->place);
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
        failed = refuse(message, "flange_b.tau = %g N.m, flange_a.phi = %g rad: the output can't be found there.", s->torque, s->crank_angle);
    }
    s->settled = 1.0;
    s->output_angle = ideal + deviation;
    s->deviation = deviation;
    return failed;
}

static double driving_torque(struct drive *drive) {
    const struct place *place = placed(drive);
    struct play play = play_at(drive, place);
    double energy, torque;
    if (drive->state.load == 0.0 && (play.width > 0.0 || drive->state.loose != 0.0)) {
        return 0.0;
    }
    torque = crank_torque_at(drive, place, drive->state.load, drive->state.side < 0.0 ? -1.0 : 1.0, play.offset_rate,
                             &energy);
    return drive->b > 0.0 ? -drive->b * torque : torque;
}

static double carried_speed(struct drive *drive) {
    const struct state *s = &drive->state;
    const struct place *place = placed(drive);
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
            drive->at = table_at(side_of(drive, side), place, s->load);
            drive->at_load = side * s->load;
        }
        return s->crank_speed * (side * drive->at.rate + 1.0 / drive->table->ratio);
    }
    play = play_at(drive, place);
    return s->crank_speed * carried_rate(drive, place, &play);
}

/* ---- the compliant interface ---- */

static double clipped(double value, double limit) {
    return value > limit ? limit : value < -limit ? -limit : value;
}

static double damping_of(const struct drive *drive, double contacts, double speed) {
    double torque = drive->state.mesh_damping * fabs(speed);
    return copysign(torque < fabs(contacts) ? torque : fabs(contacts), speed);
}

/* Move the friction's bristle by a way of the output: work done on it, and what of it is lost. */
static double rub(struct drive *drive, double way, double *lost) {
    struct state *s = &drive->state;
    double before = s->bristle, friction = s->friction_torque;
    if (friction == 0.0) { /* where it acts anew it begins unstrained, without energy */
        s->bristle = *lost = 0.0;
        return 0.0;
    }
    s->bristle = clipped(before + way, FRICTION_DISPLACEMENT);
    *lost = friction * fabs(before + way - s->bristle);
    return 0.5 * friction / FRICTION_DISPLACEMENT * (s->bristle * s->bristle - before * before) + *lost;
}

/* How far friction is strained at the present output angle; more than it can be while it slides. */
static double strained(const struct state *s) {
    return s->bristle + (s->output_angle - s->seen);
}

static int solve(struct drive *drive, char message[MESSAGE_SIZE]) {
    const struct state *s = &drive->state;
    double ratio = drive->table->ratio;
    if (drive->solved) {
        return 0;
    }
    if (press(drive, s->crank_angle, s->output_angle - s->crank_angle / ratio, &drive->pressed, message)) {
        return 1;
    }
    drive->damping = damping_of(drive, drive->pressed.by_rotation, s->output_speed - s->crank_speed / ratio);
    drive->strain = clipped(strained(s) / FRICTION_DISPLACEMENT, 1.0);
    drive->loss_torque = loss_torque(drive, drive->pressed.by_angle - drive->damping / ratio);
    drive->solved = 1;
    return 0;
}

static double power(const struct drive *drive) {
    const struct state *s = &drive->state;
    return drive->loss_torque * s->crank_speed
        + drive->damping * (s->output_speed - s->crank_speed / drive->table->ratio);
}

/* Both flanges move on at their speeds. */
static int move_flanges(struct drive *drive, double step, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double crank = s->crank_angle, output = s->output_angle, lost, all, before = 0.0;
    double crank_way = s->crank_speed * step, way = s->output_speed * step;
    int count = 1, i, lossy = dissipative(drive);
    rub(drive, output - s->seen, &all);
    s->seen = output;
    if (lossy) {
        double parts = fmax(fabs(crank_way) / CRANK_STEP, fabs(way - crank_way / drive->table->ratio) / DEVIATION_STEP);
        count = parts < 1.0 ? 1 : parts < 100.0 ? (int)ceil(parts) : 100;
        drive->solved = 0;
        if (solve(drive, message)) {
            return 1;
        }
        before = power(drive);
    }
    for (i = 1; i <= count; i++) {
        rub(drive, way / count, &lost);
        all += lost;
        s->seen = s->output_angle = output + way * i / count;
        s->crank_angle = crank + crank_way * i / count;
        drive->solved = 0;
        if (lossy) {
            double after;
            if (solve(drive, message)) {
                return 1;
            }
            after = power(drive);
            all += 0.5 * (before + after) * step / count;
            before = after;
        }
    }
    s->dissipated_energy += all;
    return 0;
}

/* One sub-step of the output's inertia: the mean torque is the energy's difference over the way, so nothing is gained. */
static int swing(struct drive *drive, double part, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double ideal = s->crank_angle / drive->table->ratio, turning = s->crank_speed / drive->table->ratio;
    double start = s->output_angle, speed = s->output_speed, bristle = s->bristle, inertia = s->output_inertia;
    double way, lost = 0.0, damping = 0.0;
    struct pressed before, after;
    int i;
    if (press(drive, s->crank_angle, start - ideal, &before, message)) {
        return 1;
    }
    after = before;
    way = part * speed + 0.5 * part * part / inertia * (s->torque - before.by_rotation);
    for (i = 0; i < 30; i++) {
        double mean, work, friction, missing, stiff, change;
        int far = fabs(way) > SAME;
        if (press(drive, s->crank_angle, start + way - ideal, &after, message)) {
            return 1;
        }
        mean = far ? (after.energy - before.energy) / way : 0.5 * (before.by_rotation + after.by_rotation);
        damping = damping_of(drive, mean, way / part - turning);
        s->bristle = bristle;
        work = rub(drive, way, &lost);
        friction = far ? work / way : s->friction_torque * bristle / FRICTION_DISPLACEMENT;
        missing = s->torque - mean - damping - friction - 2.0 * inertia * (way - part * speed) / (part * part);
        stiff = 0.5 * fmax(before.stiffness, after.stiffness) + s->mesh_damping / part;
        change = missing / (2.0 * inertia / (part * part) + stiff);
        if (fabs(change) <= CLOSE + 1e-10 * fabs(way)) {
            break;
        }
        way += change;
    }
    s->seen = s->output_angle = start + way;
    s->output_speed = 2.0 * way / part - speed;
    s->dissipated_energy += lost + damping * (way - turning * part)
        + loss_torque(drive, after.by_angle - damping / drive->table->ratio) * s->crank_speed * part;
    return 0;
}

static int move_inertia(struct drive *drive, double step, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    const struct side *side = &drive->table->side[0];
    struct place place = table_place(drive->table, 0.0);
    double crank = s->crank_angle, count, stiffness, i;
    stiffness = stiffness_at(drive, &place, RATED * side->load[side->loads - 1], 1.0, 0.0);
    stiffness = 1.0 / (1.0 / stiffness + s->series_compliance) + s->friction_torque / FRICTION_DISPLACEMENT;
    count = fmax(1.0, ceil(step * sqrt(stiffness / s->output_inertia) / SUB_STEP));
    if (!(count <= MOST_SUB_STEPS)) {
        return refuse(message, "output_inertia = %g kg.m2: so small a one swings more than %g sub-steps in this step.",
                      s->output_inertia, MOST_SUB_STEPS);
    }
    for (i = 0.0; i < count && step > 0.0; i += 1.0) {
        s->crank_angle = crank + s->crank_speed * step * (i + 0.5) / count;
        if (swing(drive, step / count, message)) {
            return 1;
        }
    }
    s->crank_angle = crank + s->crank_speed * step;
    return 0;
}

/* ---- stepping ---- */

static int move(struct drive *drive, double step, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    drive->placed = drive->solved = 0;
    if (kinematic(drive)) {
        return follow_torque(drive, message);
    }
    if (drive->table->offers == INTERFACE_INERTIA ? move_inertia(drive, step, message)
                                                     : move_flanges(drive, step, message)) {
        return 1;
    }
    drive->placed = drive->solved = 0;
    if (!(fabs(s->crank_angle) < HUGE_VAL && fabs(s->output_angle) < HUGE_VAL && fabs(s->dissipated_energy) < HUGE_VAL
          && fabs(s->output_speed) < HUGE_VAL)) {
        return refuse(message, "flange_a.w = %g rad/s: the flanges leave the range of numbers in a step of %g s.",
                      s->crank_speed, step);
    }
    return solve(drive, message);
}

static int guarded(struct drive *drive, double step, char message[MESSAGE_SIZE]) {
    struct state kept;
    int failed;
    memcpy(&kept, &drive->state, offsetof(struct state, loss)); /* a step leaves the losses */
    failed = move(drive, step, message);
    if (failed) {
        memcpy(&drive->state, &kept, offsetof(struct state, loss));
        drive->placed = drive->solved = 0;
    }
    return failed;
}

int drive_step(struct drive *drive, double time, double step, char message[MESSAGE_SIZE]) {
    double largest = drive->state.largest_step;
    if (!(step >= 0.0 && step < HUGE_VAL)) {
        return refuse(message, "a step of %g s: it must be finite and not below %g.", step, 0.0);
    }
    if (!kinematic(drive) && step > largest * (1.0 + 1e-9)) {
        return refuse(message, "a step of %g s: largest_step is %g s.", step, largest);
    }
    if (!(fabs(time + step) < HUGE_VAL)) {
        return refuse(message, "a step from the time %g s over %g s: both must be finite.", time, step);
    }
    if (guarded(drive, step, message)) {
        return 1;
    }
    drive->state.time = time + step;
    return 0;
}

/* With an inertia the drive starts at rest on its load, without friction's history. */
static int rest_on_load(struct drive *drive, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double friction = s->friction_torque, speed;
    int failed;
    s->friction_torque = s->settled = 0.0;
    failed = follow_torque(drive, message);
    drive->placed = 1;
    speed = failed ? 0.0 : carried_speed(drive);
    s->friction_torque = friction;
    s->output_speed = speed;
    return failed;
}

int drive_start(struct drive *drive, char message[MESSAGE_SIZE]) {
    struct state kept = drive->state;
    int failed = check_losses(drive, message);
    drive->initializing = 0;
    drive->placed = drive->solved = 0;
    drive->state.settled = drive->state.bristle = drive->state.dissipated_energy = 0.0;
    if (!failed && drive->table->offers == INTERFACE_INERTIA) {
        failed = rest_on_load(drive, message);
    }
    drive->state.seen = drive->state.output_angle;
    failed = failed || guarded(drive, 0.0, message);
    if (failed) {
        drive->state = kept;
        drive->placed = drive->solved = 0;
    }
    return failed;
}

/* ---- variables ---- */

static double *stored(struct drive *drive, const struct variable *variable) {
    struct state *s = &drive->state;
    switch (variable->field) {
    case CRANK_ANGLE: return &s->crank_angle;
    case CRANK_SPEED: return &s->crank_speed;
    case OUTPUT_ANGLE: return &s->output_angle;
    case OUTPUT_SPEED: return &s->output_speed;
    case OUTPUT_TORQUE: return &s->torque;
    case FRICTION_TORQUE: return &s->friction_torque;
    case SERIES_COMPLIANCE: return &s->series_compliance;
    case BACKLASH_ON: return &s->backlash_on;
    case MESH_DAMPING: return &s->mesh_damping;
    case LARGEST_STEP: return &s->largest_step;
    case OUTPUT_INERTIA: return &s->output_inertia;
    case TIME: return &s->time;
    case LOSS: return &s->loss[variable->row * LOSS_COLUMNS + variable->column];
    default: return NULL;
    }
}

void drive_reset(struct drive *drive) {
    uint32_t i;
    memset(&drive->state, 0, sizeof drive->state);
    drive->initializing = 1;
    drive->placed = drive->solved = 0;
    for (i = 0; i < drive->table->variables; i++) {
        const struct variable *v = &drive->table->variable[i];
        double *value = stored(drive, v);
        if (value != NULL && v->causality != CAUSALITY_OUTPUT && v->size > 0) {
            *value = v->start[0];
        }
    }
}

int drive_open(struct drive *drive, struct table *table, char message[MESSAGE_SIZE]) {
    uint32_t i;
    int k;
    memset(drive, 0, sizeof *drive);
    drive->table = table;
    drive->ratio = table->ratio;
    if (table->sun_teeth > 0.0) {
        drive->b = table->sun_teeth / table->planet_teeth;
        drive->a = 1.0 + drive->b;
        drive->s = 1.0 / (1.0 - drive->a / table->ratio);
        drive->ratio = -table->ratio / (drive->b * drive->s);
    }
    for (i = 0; i < table->variables; i++) {
        struct variable *v = &table->variable[i];
        v->field = -1;
        for (k = 0; k < FIELDS; k++) {
            if (strcmp(v->name, NAMES[k]) == 0) {
                v->field = k;
            }
        }
        if ((v->field == PIN_FORCE || v->field == PIN_PRESSURE)
            && (table->pins == NULL || v->size != pins_count(table->pins))) {
            snprintf(message, MESSAGE_SIZE, "%.100s: the table does not hold the pins of this variable.", v->name);
            return 1;
        }
        if (sscanf(v->name, "loss_table[%d,%d]", &v->row, &v->column) == 2) {
            v->field = LOSS;
            v->row -= 1;
            v->column -= 1;
            if (v->row < 0 || v->row >= MOST_ROWS || v->column < 0 || v->column >= LOSS_COLUMNS) {
                snprintf(message, MESSAGE_SIZE, "%.100s: a loss table has at most %d rows here.", v->name, MOST_ROWS);
                return 1;
            }
            drive->rows = v->row + 1 > drive->rows ? v->row + 1 : drive->rows;
        }
    }
    drive_reset(drive);
    return 0;
}

int drive_set(struct drive *drive, const struct variable *variable, const double *values, char message[MESSAGE_SIZE]) {
    double *value = stored(drive, variable);
    size_t i;
    for (i = 0; variable->baked && i < variable->size; i++) {
        if (values[i] != variable->start[i]) {
            snprintf(message, MESSAGE_SIZE, "%.100s = %g: this FMU holds it in its tables, made for %g; build the FMU again "
                     "with it, or use the FMU in Python, where it is tunable.", variable->name, values[i],
                     variable->start[i]);
            return 1;
        }
    }
    if (variable->baked) {
        return 0;
    }
    if (value == NULL || variable->causality == CAUSALITY_OUTPUT || variable->causality == CAUSALITY_INDEPENDENT) {
        snprintf(message, MESSAGE_SIZE, "%.100s can't be set: it is an output.", variable->name);
        return 1;
    }
    if (variable->fixed && !drive->initializing) {
        snprintf(message, MESSAGE_SIZE, "%.100s can't be set after initialization.", variable->name);
        return 1;
    }
    if (!(values[0] >= variable->least && values[0] <= variable->most && fabs(values[0]) < HUGE_VAL)) {
        snprintf(message, MESSAGE_SIZE, "%.100s = %g: it must be finite and lie between %g and %g.", variable->name,
                 values[0], variable->least, variable->most);
        return 1;
    }
    *value = values[0];
    drive->solved = 0;
    if (!kinematic(drive)) {
        drive->placed = 0;
    }
    return 0;
}

/* How much the teeth carry, and on which side; 0 where nothing touches. */
static int teeth_press(struct drive *drive, double *load, double *side) {
    const struct state *s = &drive->state;
    *load = kinematic(drive) ? s->load : drive->pressed.load;
    *side = (kinematic(drive) ? s->side : drive->pressed.side) < 0.0 ? -1.0 : 1.0;
    return *load > 0.0 || (s->loose == 0.0 && play_at(drive, placed(drive)).width == 0.0);
}

/* Forces or pressures of all pins. Which of the two is asked for first, and how often, is of no effect on them. */
static int pin_loads(struct drive *drive, int field, double *values, char message[MESSAGE_SIZE]) {
    struct pins *pins = drive->table->pins;
    double load, side, deviation, crank_angle = kinematic(drive) ? drive->state.placed : drive->state.crank_angle;
    size_t size = pins_count(pins) * sizeof *values;
    if (!teeth_press(drive, &load, &side)) {
        memset(values, 0, size);
        return 0;
    }
    deviation = side * (load > 0.0 ? table_at(side_of(drive, side), placed(drive), load)
                                   : table_at_node(side_of(drive, side), placed(drive), 0)).deviation;
    if (pins_solve(pins, crank_angle, side * load, deviation)) {
        return refuse(message, "the contacts of single pins can't be solved at a crank angle of %g rad, under a torque of "
                      "%g N.m.", crank_angle, side * load);
    }
    memcpy(values, field == PIN_FORCE ? pins->force : pins->pressure, size);
    return 0;
}

static double output(struct drive *drive, int field) {
    struct state *s = &drive->state;
    const struct place *place = placed(drive);
    int still = kinematic(drive);
    double torque, ratio = drive->table->ratio, load, side;
    int pressed = teeth_press(drive, &load, &side);
    switch (field) {
    case CRANK_TORQUE:
        if (still) {
            torque = driving_torque(drive);
            return torque + loss_torque(drive, torque);
        }
        return drive->pressed.by_angle - drive->damping / ratio + drive->loss_torque;
    case OUTPUT_ANGLE: return s->output_angle;
    case OUTPUT_SPEED: return still ? carried_speed(drive) : s->output_speed;
    case OUTPUT_TORQUE: return drive->pressed.by_rotation + drive->damping + s->friction_torque * drive->strain;
    case TRANSMISSION_ERROR: return still ? s->deviation : s->output_angle - s->crank_angle / ratio;
    case BACKLASH:
        return s->backlash_on == 0.0 ? 0.0 : drive->b > 0.0 ? reducer_backlash(drive) : play_at(drive, place).width;
    case TORSIONAL_STIFFNESS: {
        double stiffness;
        if (drive->b > 0.0) {
            return reducer_stiffness(drive);
        }
        stiffness = stiffness_at(drive, place, load, side, load > 0.0 ? 0.0 : play_at(drive, place).width);
        return stiffness > 0.0 ? 1.0 / (1.0 / stiffness + s->series_compliance) : 0.0;
    }
    case MAX_CONTACT_PRESSURE:
    case CONTACT_COUNT: {
        struct place told;
        if (!pressed) {
            return 0.0;
        }
        told = table_told_place(drive->table, still ? s->placed : s->crank_angle);
        return field == CONTACT_COUNT ? table_contact_count(side_of(drive, side), &told, load)
                                      : table_pressure(side_of(drive, side), &told, load);
    }
    case POWER_LOSS:
        if (still) {
            return loss_torque(drive, driving_torque(drive)) * s->crank_speed
                + s->friction_torque * fabs(carried_speed(drive));
        }
        return power(drive)
            + (fabs(strained(s)) >= FRICTION_DISPLACEMENT ? s->friction_torque * fabs(s->output_speed) : 0.0);
    case ELASTIC_ENERGY:
        return drive->pressed.energy
            + 0.5 * s->friction_torque * FRICTION_DISPLACEMENT * drive->strain * drive->strain;
    case DISSIPATED_ENERGY: return s->dissipated_energy;
    default: return 0.0;
    }
}

/* All values of an output. */
static int outputs(struct drive *drive, const struct variable *variable, double *values, char message[MESSAGE_SIZE]) {
    if (variable->field == PIN_FORCE || variable->field == PIN_PRESSURE) {
        return pin_loads(drive, variable->field, values, message);
    }
    values[0] = output(drive, variable->field);
    return 0;
}

int drive_get(struct drive *drive, const struct variable *variable, double *values, char message[MESSAGE_SIZE]) {
    double *value = variable->causality == CAUSALITY_OUTPUT ? NULL : stored(drive, variable);
    if (value != NULL) {
        values[0] = *value;
        return 0;
    }
    if (variable->baked) {
        memcpy(values, variable->start, variable->size * sizeof *values);
        return 0;
    }
    if (variable->field < 0) {
        snprintf(message, MESSAGE_SIZE, "%.100s is not in this FMU's tables.", variable->name);
        return 1;
    }
    if (drive->initializing) {
        /* Outputs of initialization follow what is set: they are found without keeping anything. */
        struct state kept = drive->state;
        int failed = drive_start(drive, message) || outputs(drive, variable, values, message);
        drive->state = kept;
        drive->initializing = 1;
        drive->placed = drive->solved = 0;
        if (failed) {
            return 1;
        }
    } else {
        if ((!kinematic(drive) && solve(drive, message)) || outputs(drive, variable, values, message)) {
            return 1;
        }
    }
    if (!(fabs(values[0]) < HUGE_VAL)) {
        snprintf(message, MESSAGE_SIZE, "%.100s is beyond the range of numbers at these inputs.", variable->name);
        return 1;
    }
    return 0;
}

/* ---- the state as bytes ---- */

static void put(unsigned char *at, uint64_t value) {
    int i;
    for (i = 0; i < 8; i++) {
        at[i] = (unsigned char)(value >> (8 * i));
    }
}

static uint64_t get(const unsigned char *at) {
    uint64_t value = 0;
    int i;
    for (i = 0; i < 8; i++) {
        value |= (uint64_t)at[i] << (8 * i);
    }
    return value;
}

enum { NUMBERS = sizeof(struct state) / sizeof(double) };

size_t drive_state_size(void) {
    return BLOB_HEAD + 8 * (NUMBERS + 1);
}

void drive_state_write(const struct drive *drive, unsigned char *blob) {
    const char *numbers = (const char *)&drive->state;
    unsigned char *body = blob + BLOB_HEAD;
    int i;
    for (i = 0; i < NUMBERS; i++) {
        uint64_t bits;
        memcpy(&bits, numbers + 8 * i, 8);
        put(body + 8 * i, bits);
    }
    put(body + 8 * NUMBERS, (uint64_t)drive->initializing);
    memcpy(blob, BLOB_MAGIC, sizeof BLOB_MAGIC);
    put(blob + 16, BLOB_VERSION);
    put(blob + 24, drive_state_size());
    put(blob + 32, drive->table->hash);
    put(blob + 40, table_hash(body, drive_state_size() - BLOB_HEAD));
}

int drive_state_check(const struct drive *drive, const unsigned char *blob, size_t size, char message[MESSAGE_SIZE]) {
    const char *wrong = NULL;
    if (blob == NULL || size < BLOB_HEAD || memcmp(blob, BLOB_MAGIC, sizeof BLOB_MAGIC) != 0) {
        wrong = "these bytes are not the state of a native cycloid drive";
    } else if (get(blob + 16) != BLOB_VERSION) {
        wrong = "this state is of another version than this FMU reads";
    } else if (get(blob + 24) != drive_state_size() || size != drive_state_size()
               || get(blob + 40) != table_hash(blob + BLOB_HEAD, size - BLOB_HEAD)) {
        wrong = "this state is damaged: its size or hash does not fit";
    } else if (get(blob + 32) != drive->table->hash) {
        wrong = "this state belongs to another drive: it was taken from an FMU with other tables";
    }
    if (wrong != NULL) {
        snprintf(message, MESSAGE_SIZE, "%s.", wrong);
    }
    return wrong != NULL;
}

void drive_state_read(struct drive *drive, const unsigned char *blob) {
    char *numbers = (char *)&drive->state;
    const unsigned char *body = blob + BLOB_HEAD;
    int i;
    for (i = 0; i < NUMBERS; i++) {
        uint64_t bits = get(body + 8 * i);
        memcpy(numbers + 8 * i, &bits, 8);
    }
    drive->initializing = get(body + 8 * NUMBERS) != 0;
    drive->placed = drive->solved = 0;
}
