/* The compliant interface: both flanges with prescribed motion, or inertias inside; or the rotor's inside and the arm in the
   host, of which each step takes angle, speed, inertia and torque (docs/theory/joint.md). Contacts, series compliance and
   friction store one energy E(θ, φ_b) whose derivatives are the torques, so a closed cycle gains no energy; damping, losses
   and sliding friction only dissipate. Between communication points the flanges continue at their speeds, so that the
   torques at the end of a step are not a step late. The motion of inertias inside is solved in sub-steps that conserve the
   energy balance (a discrete gradient: O. Gonzalez, Time integration and discrete Hamiltonian systems, J. Nonlinear Sci. 6,
   1996). */
#include "drive.h"

#include <math.h>
#include <string.h>

static double damping_of(const struct drive *drive, double contacts, double speed) {
    double torque = drive->state.mesh_damping * fabs(speed);
    return copysign(torque < fabs(contacts) ? torque : fabs(contacts), speed);
}

int compliant_solve(struct drive *drive, char message[MESSAGE_SIZE]) {
    const struct state *s = &drive->state;
    double ratio = drive->ratio;
    if (drive->solved) {
        return 0;
    }
    if (teeth_press(drive, drive_angle(drive), s->output_angle - drive_angle(drive) / ratio, &drive->pressed, message)) {
        return 1;
    }
    drive->damping = damping_of(drive, drive->pressed.by_rotation, s->output_speed - s->crank_speed / ratio);
    drive->solved = 1;
    return 0;
}

double compliant_power(const struct drive *drive) {
    const struct state *s = &drive->state;
    return drive->damping * (s->output_speed - s->crank_speed / drive->ratio);
}

double compliant_load(const struct drive *drive, int flange) {
    return flange == OUTPUT ? drive->pressed.by_rotation : drive->pressed.by_angle - drive->damping / drive->ratio;
}

/* Rotation of a flange since friction has followed it. */
double compliant_way(const struct drive *drive, int flange) {
    const struct state *s = &drive->state;
    return flange == OUTPUT ? s->output_angle - s->seen : drive_angle(drive) - s->crank_seen;
}

/* Friction at the present angle and speed, which may have been set since the last step. */
struct rubbing compliant_rubbing(const struct drive *drive, int flange) {
    const struct state *s = &drive->state;
    return friction_press(drive, flange, compliant_way(drive, flange), flange == OUTPUT ? s->output_speed : s->crank_speed,
                          compliant_load(drive, flange), PRESLIDING_TIME);
}

static void move_on(struct drive *drive, int flange, double way, double time, double load) {
    double following[FRICTION_ELEMENTS];
    struct slid slid = friction_rub(drive, flange, way, time, load, following);
    memcpy(drive->state.strain[flange], following, sizeof following);
    drive->state.dissipated_energy += slid.lost;
}

/* The torques of the teeth at both flanges; friction follows the angles that were set since the last step. */
static int follow(struct drive *drive, double load[2], char message[MESSAGE_SIZE]) {
    int flange;
    drive->solved = 0;
    if (compliant_solve(drive, message)) {
        return 1;
    }
    for (flange = INPUT; flange <= OUTPUT; flange++) {
        const double way = compliant_way(drive, flange);
        load[flange] = compliant_load(drive, flange);
        if (drive->rubs[flange] && way != 0.0) {
            move_on(drive, flange, way, 0.0, load[flange]);
        }
    }
    return 0;
}

/* Move both flanges at constant speed; the dissipation is summed over parts of the step. */
int compliant_move(struct drive *drive, double step, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    const double crank = s->crank_angle, output = s->output_angle;
    double before = 0.0, load[2] = {0.0, 0.0};
    const double way[2] = {s->crank_speed * step, s->output_speed * step};
    int count = 1, i, flange, rubs = drive->rubs[INPUT] || drive->rubs[OUTPUT], damped = s->mesh_damping > 0.0;
    if (rubs || damped) {
        double chunks = fmax(1.0, ceil(step / s->largest_step * (1.0 - STEP_TOLERANCE)));
        double parts = fmax(fabs(way[INPUT]) / CRANK_STEP,
                            fabs(way[OUTPUT] - way[INPUT] / drive->ratio) / TRANSMISSION_ERROR_STEP);
        parts = fmax(chunks, ceil(fmin(parts, chunks * MOST_PARTS)));
        if (parts > MOST_SUB_STEPS) {
            return drive_refuse(message, "a step of %g s is divided into more than %g parts: make it shorter.", step,
                          MOST_SUB_STEPS);
        }
        count = (int)parts;
        if (follow(drive, load, message)) {
            return 1;
        }
        before = compliant_power(drive);
    }
    for (i = 1; i <= count; i++) {
        s->seen = s->output_angle = output + way[OUTPUT] * i / count;
        s->crank_seen = s->crank_angle = crank + way[INPUT] * i / count;
        drive->solved = 0;
        if (rubs || damped) {
            double after;
            if (compliant_solve(drive, message)) {
                return 1;
            }
            for (flange = INPUT; flange <= OUTPUT; flange++) {
                double following = compliant_load(drive, flange);
                if (drive->rubs[flange]) {
                    move_on(drive, flange, way[flange] / count, step / count, 0.5 * (load[flange] + following));
                }
                load[flange] = following;
            }
            after = compliant_power(drive);
            s->dissipated_energy += 0.5 * (before + after) * step / count;
            before = after;
        }
    }
    return 0;
}

/* Mean of a derivative over a displacement, from the difference of the function, and the change of this mean with the end
   of the displacement. If the displacement is too short for a difference, it is the mean of both ends. */
struct mean {
    double value, slope;
};

static struct mean mean_over(double way, double shortest, double difference, double at_start, double at_end, double slope) {
    struct mean result;
    if (fabs(way) > shortest) {
        result.value = difference / way;
        result.slope = (at_end - result.value) / way;
    } else {
        result.value = 0.5 * (at_start + at_end);
        result.slope = 0.5 * slope;
    }
    return result;
}

static double by_phase(const struct drive *drive, const struct pressed *at) {
    return at->by_angle + at->by_rotation / drive->ratio;
}

/* A sub-step: torques on output and crank, that on the crank less by `servo` times its displacement; displacements of crank
   and output; stored energy at half the crank's displacement, before and after the change of the transmission error, and at
   the end; mean torques. */
struct swing {
    double load, drives, servo;
    double turn, way, damping, crank_torque;
    struct slid rubbed[2]; /* friction at crank and output, with its strains at the end in `strain` */
    double strain[2][FRICTION_ELEMENTS];
    struct pressed before, after, end;
};

enum { SWUNG, FAILED, TOO_LONG };

/* One sub-step by the implicit midpoint rule with mean derivatives: the crank moves by half its displacement at constant
   transmission error, then the transmission error changes, then the crank moves by the other half. The work done is the
   energy stored and dissipated, so no energy is gained. Without an inertia the crank's displacement is given. */
static int swing(struct drive *drive, double part, struct pressed *at, struct swing *w, char message[MESSAGE_SIZE]) {
    const struct state *s = &drive->state;
    const double ratio = drive->ratio, start = s->turned;
    const double a = 2.0 * s->crank_inertia / (part * part), b = 2.0 * s->output_inertia / (part * part);
    const double transmission_error = s->output_angle - start / ratio;
    const int held = s->crank_inertia == 0.0;
    double change, change_a = 0.0, share;
    int i, last = 0;
    memset(w->rubbed, 0, sizeof w->rubbed);
    memcpy(w->strain, s->strain, sizeof w->strain);
    w->way = part * s->output_speed + (w->load - at->by_rotation) / b;
    if (!held) {
        w->turn = part * s->crank_speed + (w->drives - w->servo * part * s->crank_speed - at->by_angle) / a;
    }
    for (i = 0; i < MOST_ITERATIONS; i++) {
        struct mean contact, crank;
        double off = w->way - w->turn / ratio, damped, k, q, r, missing, missing_a;
        if ((i == 0 || !held) && teeth_press(drive, start + 0.5 * w->turn, transmission_error, &w->before, message)) {
            return FAILED;
        }
        if (teeth_press(drive, start + 0.5 * w->turn, transmission_error + off, &w->after, message)
            || ((!held || last) && teeth_press(drive, start + w->turn, transmission_error + off, &w->end, message))) {
            return FAILED;
        }
        contact = mean_over(off, SAME_PLACE, w->after.energy - w->before.energy, w->before.by_rotation, w->after.by_rotation,
                            fmax(w->before.stiffness, w->after.stiffness));
        w->damping = damping_of(drive, contact.value, off / part);
        damped = fabs(w->damping) < fabs(contact.value) ? s->mesh_damping / part
                                                        : copysign(contact.slope, off * contact.value);
        if (drive->rubs[OUTPUT]) {
            w->rubbed[OUTPUT] = friction_rub(drive, OUTPUT, w->way, part, contact.value, w->strain[OUTPUT]);
        }
        k = contact.slope + damped;
        r = b + w->rubbed[OUTPUT].slope + k;
        missing = w->load - contact.value - w->damping - w->rubbed[OUTPUT].torque
            - b * (w->way - part * s->output_speed);
        if (!held || last) {
            crank = mean_over(w->turn, SAME_PLACE * fabs(ratio), w->before.energy - at->energy + w->end.energy - w->after.energy,
                              by_phase(drive, at), by_phase(drive, &w->end), 0.0);
            w->crank_torque = crank.value - (contact.value + w->damping) / ratio;
            if (drive->rubs[INPUT]) {
                w->rubbed[INPUT] = friction_rub(drive, INPUT, w->turn, part, w->crank_torque, w->strain[INPUT]);
            }
        }
        if (last) {
            return SWUNG;
        }
        if (held) {
            change = missing / r;
        } else {
            missing_a = w->drives - w->servo * w->turn - w->crank_torque - w->rubbed[INPUT].torque
                - a * (w->turn - part * s->crank_speed);
            q = a + w->servo + w->rubbed[INPUT].slope;
            k /= ratio;
            missing /= q * r + (r - k * ratio) * k / ratio;
            missing_a /= q * r + (r - k * ratio) * k / ratio;
            change = missing * (q + k / ratio) + missing_a * k;
            change_a = missing_a * r + missing * k;
        }
        share = ldexp(LAST_SHARE, i < MOST_DOUBLED ? i : MOST_DOUBLED);
        last = fabs(change) <= LAST_CHANGE + share * fabs(w->way)
            && fabs(change_a) <= LAST_CHANGE * fabs(ratio) + share * fabs(w->turn);
        w->way += change;
        w->turn += change_a;
    }
    return TOO_LONG;
}

/* The longest sub-step: a share of the shortest period of oscillation and of the mesh period. */
static double longest(const struct drive *drive, double crank_speed) {
    const struct state *s = &drive->state;
    const double ratio = drive->ratio;
    const double stiffness = 1.0 / (1.0 / drive->contacts.stiffness + s->series_compliance);
    double swing;
    swing = (stiffness + FRICTION_ELEMENTS * drive->element[OUTPUT]) / s->output_inertia;
    if (s->crank_inertia > 0.0) {
        swing += (stiffness / (ratio * ratio) + FRICTION_ELEMENTS * drive->element[INPUT]) / s->crank_inertia;
    }
    crank_speed *= drive->table->ratio / drive->ratio; /* of the cycloid stage's crank */
    return fmin(s->largest_step, fmin(SUB_STEP / sqrt(swing), MESH_STEP / fmax(fabs(crank_speed), 1e-30)));
}

/* Step with inertias inside, which move under their torques and the contacts between them. Without an inertia the crank
   moves from its last angle to that of its angle and speed inputs. */
int compliant_swing(struct drive *drive, double step, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    const double ratio = drive->ratio;
    const int held = s->crank_inertia == 0.0;
    const double goal = s->crank_angle + s->crank_speed * step, before = s->dissipated_energy;
    const double speed_before = s->output_speed, crank_before = s->crank_angle, crank_speed_before = s->crank_speed;
    double remaining = step, work = 0.0, count = 0.0, rest = 1.0, load[2];
    struct pressed at;
    if (step > 0.0 && !(s->output_inertia > 0.0)) {
        return drive_refuse(message, "arm_inertia = %g: before a step set it to the arm's inertia at flange_b, above %g kg.m2.",
                            s->output_inertia, 0.0);
    }
    if (held && step == 0.0) {
        s->turned = s->crank_angle;
    }
    if (follow(drive, load, message)) {
        return 1;
    }
    at = drive->pressed;
    s->outside = 0.0;
    while (remaining > 0.0) {
        double speed = held ? (goal - s->turned) / remaining : s->crank_speed;
        double parts = fmax(ceil(remaining / longest(drive, speed) * (1.0 - STEP_TOLERANCE)), rest), part = remaining / parts;
        struct swing w;
        int result;
        if (!(++count <= MOST_SUB_STEPS && parts <= MOST_SUB_STEPS)) {
            return drive_refuse(message, "a step of %g s is divided into more than %g parts: it is too long for so fast a motion "
                          "or so small an inertia.", step, MOST_SUB_STEPS);
        }
        w.turn = speed * part;
        w.load = s->torque + s->torque_rate * (step - remaining + 0.5 * part);
        w.drives = s->crank_torque - s->motor_stiffness * (s->turned - crank_before) + s->motor_damping * crank_speed_before;
        w.servo = 0.5 * s->motor_stiffness + s->motor_damping / part;
        result = swing(drive, part, &at, &w, message);
        if (result == FAILED) {
            return 1;
        }
        if (result == TOO_LONG) {
            rest = 2.0 * parts;
            continue;
        }
        rest = fmax(1.0, parts - 1.0);
        work += (w.crank_torque + w.rubbed[INPUT].torque) * part;
        memcpy(s->strain, w.strain, sizeof s->strain);
        s->turned = parts > 1.0 || !held ? s->turned + w.turn : goal;
        s->seen = s->output_angle = s->output_angle + w.way;
        s->output_speed = 2.0 * w.way / part - s->output_speed;
        if (!held) {
            s->crank_speed = 2.0 * w.turn / part - s->crank_speed;
        }
        s->dissipated_energy += w.rubbed[OUTPUT].lost + w.damping * (w.way - w.turn / ratio) + w.rubbed[INPUT].lost;
        s->outside = s->outside != 0.0 || teeth_outside(drive, w.end.torque) ? 1.0 : 0.0;
        remaining = parts > 1.0 ? remaining - part : 0.0;
        drive->impact = w.end.torque != 0.0 && (at.torque == 0.0 || (at.torque > 0.0) != (w.end.torque > 0.0));
        at = w.end;
        if (drive->impact && drive->early) {
            break;
        }
    }
    s->crank_angle = s->crank_seen = s->turned;
    drive->remaining = remaining;
    if (step > remaining) {
        s->mean_torque = work / (step - remaining);
        s->mean_output = s->torque + 0.5 * s->torque_rate * (step - remaining)
            - s->output_inertia * (s->output_speed - speed_before) / (step - remaining);
        s->mean_loss = (s->dissipated_energy - before) / (step - remaining);
    }
    return 0;
}
