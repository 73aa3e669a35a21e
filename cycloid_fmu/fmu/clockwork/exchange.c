/* Model Exchange: the drive as a differential equation for the host's solver. */
#include "drive.h"

#include <math.h>
#include <string.h>

/* The states in the order of the model description. The transmission error is a state instead of the output's angle,
   because the deflection of the contacts is millionths of that angle. */
int exchange_states(const struct drive *drive, int fields[MOST_STATES]) {
    int count = 0, i;
    if (drive_kinematic(drive)) {
        fields[0] = TEMPERATURE;
        return heat_stored(drive);
    }
    if (drive->state.crank_inertia > 0.0) {
        fields[count++] = CRANK_ANGLE;
        fields[count++] = CRANK_SPEED;
    }
    if (drive->table->offers == INTERFACE_INERTIA) {
        fields[count++] = TRANSMISSION_ERROR;
        fields[count++] = OUTPUT_SPEED;
    }
    for (i = 0; i < 2 * FRICTION_ELEMENTS; i++) {
        fields[count++] = INPUT_FRICTION_STRAIN_1 + i;
    }
    fields[count++] = DISSIPATED_ENERGY;
    if (heat_stored(drive)) {
        fields[count++] = TEMPERATURE;
    }
    return count;
}

/* Everything that follows from inputs and states; valid until one of them is set. */
int exchange_solve(struct drive *drive, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    if (drive->solved) {
        return 0;
    }
    if (drive_kinematic(drive)) {
        s->output_angle = s->held;
        s->crank_seen = s->held_crank;
        memcpy(s->strain, s->held_strain, sizeof s->strain);
        drive->solved = !kinematic_follow(drive, message);
        return !drive->solved;
    }
    s->turned = s->crank_angle;
    if (drive->table->offers == INTERFACE_INERTIA) {
        s->output_angle = s->transmission_error + s->turned / drive->ratio;
    }
    s->seen = s->output_angle;
    s->crank_seen = s->crank_angle;
    if (compliant_solve(drive, message)) {
        return 1;
    }
    s->mean_torque = drive->pressed.by_angle - drive->damping / drive->ratio
        + compliant_rubbing(drive, INPUT).torque;
    s->mean_loss = exchange_rate(drive, DISSIPATED_ENERGY);
    s->outside = 0.0;
    return 0;
}

static double speed_at(const struct drive *drive, int flange) {
    return flange == INPUT ? drive->state.crank_speed : drive->state.output_speed;
}

/* Time derivative of a state. */
double exchange_rate(struct drive *drive, int field) {
    const struct state *s = &drive->state;
    double rate[FRICTION_ELEMENTS], result;
    int flange = field >= INPUT_FRICTION_STRAIN_1 + FRICTION_ELEMENTS ? OUTPUT : INPUT;
    switch (field) {
    case CRANK_ANGLE: return s->crank_speed;
    case CRANK_SPEED:
        return (s->crank_torque - compliant_load(drive, INPUT) - compliant_rubbing(drive, INPUT).torque) / s->crank_inertia;
    case TRANSMISSION_ERROR: return s->output_speed - s->crank_speed / drive->ratio;
    case OUTPUT_SPEED:
        return (s->torque - drive->pressed.by_rotation - drive->damping - compliant_rubbing(drive, OUTPUT).torque)
            / s->output_inertia;
    case DISSIPATED_ENERGY:
        result = compliant_power(drive);
        for (flange = INPUT; flange <= OUTPUT; flange++) {
            if (drive->rubs[flange]) {
                result += compliant_rubbing(drive, flange).torque * speed_at(drive, flange)
                    - friction_flow(drive, flange, speed_at(drive, flange), compliant_load(drive, flange), rate);
            }
        }
        return result;
    case TEMPERATURE:
        return heat_rate(drive, drive_kinematic(drive) ? kinematic_power(drive) : exchange_rate(drive, DISSIPATED_ENERGY));
    default:
        friction_flow(drive, flange, speed_at(drive, flange), compliant_load(drive, flange), rate);
        return rate[(field - INPUT_FRICTION_STRAIN_1) % FRICTION_ELEMENTS];
    }
}

/* An indicator passes zero when a flank comes into or out of contact, a torque leaves the tables, or a flange with friction
   reverses. In the kinematic interface, whose output jumps from flank to flank: when the torque reverses. */
void exchange_indicators(struct drive *drive, double result[EVENT_INDICATORS]) {
    const struct state *s = &drive->state;
    const int still = drive_kinematic(drive);
    const double torque = still ? kinematic_torque(drive) : drive->pressed.torque;
    result[2] = drive->contacts.reach[torque > 0.0 ? 0 : 1] - fabs(torque);
    result[3] = drive->rubs[INPUT] ? s->crank_speed : 1.0;
    if (still) {
        result[0] = s->torque;
        result[1] = result[4] = 1.0;
    } else if (drive->b > 0.0) {
        result[0] = result[1] = 1.0; /* contacts behind a first stage also begin at the ends of its plays: no own event */
        result[4] = drive->rubs[OUTPUT] ? s->output_speed : 1.0;
    } else {
        char message[MESSAGE_SIZE];
        struct play play;
        double transmission_error = s->output_angle - drive_angle(drive) / drive->ratio;
        teeth_play(drive, drive_angle(drive), &play, message);
        result[0] = transmission_error - (play.high - play.offset);
        result[1] = transmission_error - (play.low + play.offset);
        result[4] = drive->rubs[OUTPUT] ? s->output_speed : 1.0;
    }
}

/* At the end of a step of the host's solver, and at an event: accept what happened so far. */
void exchange_keep(struct drive *drive) {
    struct state *s = &drive->state;
    if (drive_kinematic(drive)) {
        s->held = s->output_angle;
        s->held_crank = s->crank_seen;
        memcpy(s->held_strain, s->strain, sizeof s->strain);
    }
}
