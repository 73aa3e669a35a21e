/* Model Exchange: the drive as a differential equation whose solver is the host's. */
#include "drive.h"

#include <math.h>

/* The states in the model description's order. The deviation is one in place of the output's angle: what presses the
   contacts is millionths of that. */
int exchange_states(const struct drive *drive, int fields[MOST_STATES]) {
    int count = 0;
    if (drive_kinematic(drive)) {
        return 0;
    }
    if (drive->table->offers == INTERFACE_INERTIA) {
        if (drive->state.crank_inertia > 0.0) {
            fields[count++] = CRANK_ANGLE;
            fields[count++] = CRANK_SPEED;
        }
        fields[count++] = TRANSMISSION_ERROR;
        fields[count++] = OUTPUT_SPEED;
    }
    fields[count++] = FRICTION_STRAIN;
    fields[count++] = DISSIPATED_ENERGY;
    return count;
}

/* Everything that follows from inputs and states; kept until one of them is set. */
int exchange_solve(struct drive *drive, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    if (drive->solved) {
        return 0;
    }
    if (drive_kinematic(drive)) {
        s->output_angle = s->held;
        drive->solved = !kinematic_follow(drive, message);
        return !drive->solved;
    }
    if (drive->table->offers == INTERFACE_INERTIA) {
        s->turned = s->crank_angle;
        s->output_angle = s->deviation + s->turned / drive->ratio;
        drive->placed = 0;
    }
    s->seen = s->output_angle;
    if (compliant_solve(drive, message)) {
        return 1;
    }
    s->mean_torque = drive->pressed.by_angle - drive->damping / drive->ratio + drive->loss_torque;
    s->mean_loss = exchange_rate(drive, DISSIPATED_ENERGY);
    s->outside = 0.0;
    return 0;
}

/* Derivative of a state by time. */
double exchange_rate(const struct drive *drive, int field) {
    const struct state *s = &drive->state;
    const double ratio = drive->ratio;
    const int slides = drive->exchange ? s->sliding != 0.0
                                       : friction_strain(s) * s->output_speed > 0.0
                                             && fabs(friction_strain(s)) >= FRICTION_DISPLACEMENT;
    switch (field) {
    case CRANK_ANGLE: return s->crank_speed;
    case CRANK_SPEED:
        return (s->crank_torque - drive->pressed.by_angle + drive->damping / ratio - drive->loss_torque) / s->crank_inertia;
    case TRANSMISSION_ERROR: return s->output_speed - s->crank_speed / ratio;
    case OUTPUT_SPEED:
        return (s->torque - drive->pressed.by_rotation - drive->damping - s->friction_torque * drive->strain)
            / s->output_inertia;
    case FRICTION_STRAIN: return slides || s->friction_torque == 0.0 ? 0.0 : s->output_speed;
    case DISSIPATED_ENERGY:
        return compliant_power(drive) + (slides ? s->friction_torque * fabs(s->output_speed) : 0.0);
    default: return 0.0;
    }
}

/* Where an indicator goes through zero: a flank begins or ends to touch, the losses' torque no longer goes to zero with
   the crank's speed, a torque leaves the tables, the friction sticks or slides. Of the kinematic interface, whose output
   jumps from flank to flank: the torque, with and less the friction, turns round. */
void exchange_indicators(struct drive *drive, double found[EVENT_INDICATORS]) {
    const struct state *s = &drive->state;
    const int still = drive_kinematic(drive);
    const double load = still ? s->load : drive->pressed.load, side = still ? s->side : drive->pressed.side;
    found[2] = drive->rows > 0 ? fabs(s->crank_speed) - LOSS_SPEED : 1.0;
    found[3] = teeth_side(drive, side)->reach - load;
    if (still) {
        found[0] = s->torque + s->friction_torque;
        found[1] = s->torque - s->friction_torque;
        found[4] = 1.0;
    } else {
        struct play play = teeth_play(drive, drive_place(drive));
        double deviation = s->output_angle - drive_angle(drive) / drive->ratio;
        found[0] = deviation - (play.end[0].deviation - play.offset);
        found[1] = deviation + (play.end[1].deviation - play.offset);
        found[4] = s->friction_torque == 0.0 ? 1.0
            : s->sliding == 0.0              ? FRICTION_DISPLACEMENT - fabs(s->bristle)
                                             : s->sliding * s->output_speed;
    }
}

/* Whether the friction sticks where it should slide or slides where it should stick. */
static double sliding(const struct state *s) {
    if (s->friction_torque == 0.0 || fabs(s->bristle) < FRICTION_DISPLACEMENT * (1.0 - STEP_TOLERANCE)
        || !(s->bristle * s->output_speed > 0.0)) {
        return 0.0;
    }
    return copysign(1.0, s->bristle);
}

/* At the end of a step of the host's solver, or at an event: what happened until here stays. Returns whether the
   friction's mode is another than it should be, which is mended at events alone. */
int exchange_keep(struct drive *drive, int event) {
    struct state *s = &drive->state;
    double now;
    if (drive_kinematic(drive)) {
        s->held = s->output_angle;
        return 0;
    }
    now = sliding(s);
    if (now == s->sliding) {
        return 0;
    }
    if (event) {
        s->sliding = now;
        s->bristle = now != 0.0 ? now * FRICTION_DISPLACEMENT : s->bristle;
        drive->solved = 0;
    }
    return 1;
}
