/* The compliant interface. */
#include "drive.h"

#include <math.h>

static const double RATED = 0.4; /* of the last load of the tables */

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
double friction_strain(const struct state *s) {
    return s->bristle + (s->output_angle - s->seen);
}

int compliant_solve(struct drive *drive, char message[MESSAGE_SIZE]) {
    const struct state *s = &drive->state;
    double ratio = drive->table->ratio;
    if (drive->solved) {
        return 0;
    }
    if (teeth_press(drive, s->crank_angle, s->output_angle - s->crank_angle / ratio, &drive->pressed, message)) {
        return 1;
    }
    drive->damping = damping_of(drive, drive->pressed.by_rotation, s->output_speed - s->crank_speed / ratio);
    drive->strain = clipped(friction_strain(s) / FRICTION_DISPLACEMENT, 1.0);
    drive->loss_torque = losses_torque(drive, drive->pressed.by_angle - drive->damping / ratio);
    drive->solved = 1;
    return 0;
}

double compliant_power(const struct drive *drive) {
    const struct state *s = &drive->state;
    return drive->loss_torque * s->crank_speed
        + drive->damping * (s->output_speed - s->crank_speed / drive->table->ratio);
}

/* Both flanges move on at their speeds. */
int compliant_move(struct drive *drive, double step, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    double crank = s->crank_angle, output = s->output_angle, lost, all, before = 0.0;
    double crank_way = s->crank_speed * step, way = s->output_speed * step;
    int count = 1, i, lossy = losses_dissipate(drive);
    rub(drive, output - s->seen, &all);
    s->seen = output;
    if (lossy) {
        double parts = fmax(fabs(crank_way) / CRANK_STEP, fabs(way - crank_way / drive->table->ratio) / DEVIATION_STEP);
        count = parts < 1.0 ? 1 : parts < MOST_PARTS ? (int)ceil(parts) : MOST_PARTS;
        drive->solved = 0;
        if (compliant_solve(drive, message)) {
            return 1;
        }
        before = compliant_power(drive);
    }
    for (i = 1; i <= count; i++) {
        rub(drive, way / count, &lost);
        all += lost;
        s->seen = s->output_angle = output + way * i / count;
        s->crank_angle = crank + crank_way * i / count;
        drive->solved = 0;
        if (lossy) {
            double after;
            if (compliant_solve(drive, message)) {
                return 1;
            }
            after = compliant_power(drive);
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
    if (teeth_press(drive, s->crank_angle, start - ideal, &before, message)) {
        return 1;
    }
    after = before;
    way = part * speed + 0.5 * part * part / inertia * (s->torque - before.by_rotation);
    for (i = 0; i < MOST_ITERATIONS; i++) {
        double mean, work, friction, missing, stiff, change;
        int far = fabs(way) > SAME_PLACE;
        if (teeth_press(drive, s->crank_angle, start + way - ideal, &after, message)) {
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
        if (fabs(change) <= LAST_CHANGE + LAST_SHARE * fabs(way)) {
            break;
        }
        way += change;
    }
    s->seen = s->output_angle = start + way;
    s->output_speed = 2.0 * way / part - speed;
    s->dissipated_energy += lost + damping * (way - turning * part)
        + losses_torque(drive, after.by_angle - damping / drive->table->ratio) * s->crank_speed * part;
    return 0;
}

int compliant_swing(struct drive *drive, double step, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    const struct side *side = &drive->table->side[0];
    struct place place = table_place(drive->table, 0.0);
    double crank = s->crank_angle, count, stiffness, i;
    stiffness = teeth_stiffness(drive, &place, RATED * side->load[side->loads - 1], 1.0, 0.0);
    stiffness = 1.0 / (1.0 / stiffness + s->series_compliance) + s->friction_torque / FRICTION_DISPLACEMENT;
    count = fmax(1.0, ceil(step * sqrt(stiffness / s->output_inertia) / SUB_STEP));
    if (!(count <= MOST_SUB_STEPS)) {
        return drive_refuse(message, "output_inertia = %g kg.m2: so small a one swings more than %g sub-steps in this step.",
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
