/* Directional derivatives: of the contacts from the derivatives of the tables, of the other outputs by differences of the
   outputs. */
#include "drive.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

/* Response of the contacts: derivatives of their load, of the crank's torque, and of the mean rate over all loads. */
struct answer {
    double load, crank_torque, rate;
};

/* For a change of the crank angle: at a given change of the load, or (`stiffness` above 0) of the output's angle. */
static struct answer answer_of(struct drive *drive, double load, double side, double stiffness, double angle, double way) {
    const struct contacts *contacts = &drive->contacts;
    const double crank_angle = drive_crank_angle(drive), torque = side < 0.0 ? -load : load;
    struct bending bending;
    double lever;
    struct answer result;
    contacts->bending(contacts->self, crank_angle, torque, &bending);
    if (drive->state.backlash_on != 0.0 || teeth_width(drive, crank_angle) == 0.0) {
        bending.offset = 0.0;
    }
    lever = -side / drive->table->ratio - side * contacts->rate(contacts->self, crank_angle, torque)
        + teeth_offset_rate(drive, crank_angle);
    result.load = way;
    if (stiffness > 0.0) {
        result.load = stiffness * (side * way + lever * angle);
    }
    result.crank_torque = (bending.crank_torque + bending.offset * load) * angle + lever * result.load;
    result.rate = (bending.rate - side * bending.offset) * angle + side * bending.compliance * result.load;
    return result;
}

/* Derivative of a flange's friction torque, by a difference; `way`, `speed` and `load` are the rates of these. */
static double rubbing_going(const struct drive *drive, int flange, const struct state *go, double way, double speed,
                            double load) {
    const struct state *s = &drive->state;
    double at = flange == INPUT ? s->crank_speed : s->output_speed, bears = compliant_load(drive, flange);
    double size, passed, torque[2];
    int i, j;
    passed = compliant_way(drive, flange);
    if (!drive->rubs[flange]) {
        return 0.0;
    }
    size = fmax(fabs(speed) / fmax(fabs(at), DIFFERENCE_SPEED), fabs(load) / fmax(fabs(bears), 1.0));
    size = fmax(size, fmax(fabs(way) / s->friction[flange].presliding_angle, fabs(go->temperature)));
    size = drive->ripple == NULL ? size : fmax(size, fabs(go->crank_angle));
    for (i = 0; i < FRICTION_ELEMENTS; i++) {
        size = fmax(size, fabs(go->strain[flange][i]) / s->friction[flange].presliding_angle);
    }
    for (j = 0; j < 2 && size > 0.0; j++) {
        struct drive moved = *drive;
        double h = (j == 0 ? -DIFFERENCE_SHARE : DIFFERENCE_SHARE) / size;
        for (i = 0; i < FRICTION_ELEMENTS; i++) {
            moved.state.strain[flange][i] += h * (go->strain[flange][i] + way);
        }
        moved.state.temperature += h * go->temperature;
        moved.state.crank_angle += h * go->crank_angle;
        moved.state.turned += h * go->crank_angle;
        torque[j] = friction_press(&moved, flange, passed, at + h * speed, bears + h * load, PRESLIDING_TIME).torque;
    }
    return size > 0.0 ? 0.5 * (torque[1] - torque[0]) * size / DIFFERENCE_SHARE : 0.0;
}

/* Returns 1 if the output is not one of these. */
static int of_kinematic(struct drive *drive, int field, const struct state *go, double *value) {
    const struct state *s = &drive->state;
    const double ratio = drive->ratio, side = s->side < 0.0 ? -1.0 : 1.0;
    const int stands = s->pushed == 0.0, loose = s->load == 0.0;
    double rate, transmission_error;
    struct answer answer;
    if (drive->rubs[OUTPUT] || (drive->rubs[INPUT] && field == CRANK_TORQUE)) {
        return 1;
    }
    rate = kinematic_rate(drive);
    if (stands) {
        double stiffness = loose ? 0.0 : 1.0 / (1.0 / teeth_stiffness(drive, s->placed, kinematic_torque(drive)) + s->series_compliance);
        answer = answer_of(drive, s->load, side, stiffness, go->crank_angle, 0.0);
        transmission_error = -go->crank_angle / ratio;
    } else {
        double load = loose ? 0.0 : side * go->torque;
        answer = answer_of(drive, s->load, side, 0.0, go->crank_angle, load);
        transmission_error = (rate - 1.0 / ratio) * go->crank_angle
                + (loose ? 0.0 : (1.0 / teeth_stiffness(drive, s->placed, kinematic_torque(drive)) + s->series_compliance) * go->torque);
    }
    switch (field) {
    case TRANSMISSION_ERROR: *value = transmission_error; return 0;
    case OUTPUT_ANGLE: *value = transmission_error + go->crank_angle / ratio; return 0;
    case OUTPUT_SPEED: *value = stands ? 0.0 : rate * go->crank_speed + s->crank_speed * answer.rate; return 0;
    case CRANK_TORQUE:
        if (!kinematic_pressed(drive)) {
            *value = 0.0;
            return 0;
        }
        *value = answer.crank_torque;
        return 0;
    default: return 1;
    }
}

static int of_compliant(struct drive *drive, int field, const struct state *go, double *value) {
    const struct state *s = &drive->state;
    const struct pressed *p = &drive->pressed;
    const double ratio = drive->ratio, slip = s->output_speed - s->crank_speed / ratio;
    const int inside = drive->table->offers == INTERFACE_INERTIA;
    /* With inertias inside, the state is the transmission error. */
    const double output = inside ? go->transmission_error + go->crank_angle / ratio : go->output_angle;
    const double turn = drive->exchange ? 0.0 : go->crank_angle, way = drive->exchange ? 0.0 : output;
    double side = p->torque == 0.0 ? 0.0 : p->torque < 0.0 ? -1.0 : 1.0, damping, friction, torque, loss, stiffness;
    struct answer answer;
    int i;
    stiffness = side != 0.0 ? 1.0 / (1.0 / p->stiffness + s->series_compliance) : 0.0;
    answer = answer_of(drive, fabs(p->torque), p->torque < 0.0 ? -1.0 : 1.0, stiffness, go->crank_angle, side != 0.0 ? output : 0.0);
    damping = fabs(drive->damping) < fabs(p->by_rotation) ? s->mesh_damping * (go->output_speed - go->crank_speed / ratio)
                                                          : copysign(answer.load, slip);
    damping = s->mesh_damping > 0.0 ? damping : 0.0;
    friction = rubbing_going(drive, OUTPUT, go, way, go->output_speed, side * answer.load);
    torque = answer.crank_torque - damping / ratio;
    loss = rubbing_going(drive, INPUT, go, turn, go->crank_speed, torque);
    switch (field) {
    case OUTPUT_ANGLE: *value = output; return 0;
    case OUTPUT_SPEED: *value = go->output_speed; return 0;
    case CRANK_ANGLE: *value = go->crank_angle; return 0;
    case CRANK_SPEED: *value = go->crank_speed; return 0;
    case TRANSMISSION_ERROR: *value = output - go->crank_angle / ratio; return 0;
    case TRANSMISSION_ERROR_RATE: *value = go->output_speed - go->crank_speed / ratio; return 0;
    case CRANK_TORQUE: *value = torque + loss; return 0;
    case TORQUE: *value = side * answer.load + damping + friction; return 0;
    case CRANK_ACCELERATION: *value = (go->crank_torque - torque - loss) / s->crank_inertia; return 0;
    case OUTPUT_ACCELERATION:
        *value = (go->torque - side * answer.load - damping - friction) / s->output_inertia;
        return 0;
    case ELASTIC_ENERGY:
        if (!drive->exchange && (drive->rubs[INPUT] || drive->rubs[OUTPUT])) {
            return 1;
        }
        *value = p->by_angle * go->crank_angle + p->by_rotation * output;
        for (i = 0; i < FRICTION_ELEMENTS; i++) {
            *value += drive->element[INPUT] * s->strain[INPUT][i] * go->strain[INPUT][i];
            *value += drive->element[OUTPUT] * s->strain[OUTPUT][i] * go->strain[OUTPUT][i];
        }
        return 0;
    default: return 1;
    }
}

/* By a central difference of the outputs. */
static int by_difference(const struct drive *drive, const struct variable *unknown, const struct state *go, double size,
                         double *value, char message[MESSAGE_SIZE]) {
    double result[2];
    int i;
    for (i = 0; i < 2; i++) {
        struct drive moved = *drive;
        const double *along = (const double *)go;
        double *at = (double *)&moved.state, h = i == 0 ? -1.0 / size : 1.0 / size;
        size_t j;
        for (j = 0; j < sizeof moved.state / sizeof *at; j++) {
            at[j] += h * along[j];
        }
        moved.solved = 0;
        if (!moved.initializing && !moved.exchange && drive_kinematic(&moved) && kinematic_follow(&moved, message)) {
            return 1;
        }
        if (drive_get(&moved, unknown, &result[i], message)) {
            return 1;
        }
    }
    *value = 0.5 * (result[1] - result[0]) * size;
    return 0;
}

/* Step of a known for a difference. */
static double reach_of(const struct variable *known) {
    switch (known->field) {
    case OUTPUT_ANGLE:
    case TRANSMISSION_ERROR: return DIFFERENCE_ROTATION;
    default: return DIFFERENCE_SHARE * known->nominal;
    }
}

/* Whether a variable may be a known: an input, a parameter, or a state of Model Exchange, which are stored. */
static int movable(const struct drive *drive, struct state *along, const struct variable *known) {
    int fields[MOST_STATES], count = drive->exchange ? exchange_states(drive, fields) : 0, i;
    if (drive_stored(along, known) == NULL) {
        return 0;
    }
    for (i = 0; i < count; i++) {
        if (fields[i] == known->field) {
            return 1;
        }
    }
    return known->causality == CAUSALITY_INPUT
        || (known->causality == CAUSALITY_PARAMETER && !known->baked);
}

void derivative_begin(struct direction *direction) {
    memset(direction, 0, sizeof *direction);
}

int derivative_seed(const struct drive *drive, struct direction *direction, const struct variable *known, double seed,
                    char message[MESSAGE_SIZE]) {
    if (!movable(drive, &direction->along, known)) {
        snprintf(message, MESSAGE_SIZE, "%.100s is no input, parameter or state, so nothing has a derivative by it.", known->name);
        return 1;
    }
    *drive_stored(&direction->along, known) += seed;
    direction->size = fmax(direction->size, fabs(seed) / reach_of(known));
    direction->parameters |= known->causality == CAUSALITY_PARAMETER;
    return 0;
}

int derivative_of(struct drive *drive, const struct direction *direction, const struct variable *unknown, double *value,
                  char message[MESSAGE_SIZE]) {
    *value = 0.0;
    if (unknown->kind != KIND_REAL || direction->size == 0.0) {
        return 0;
    }
    if (!drive->initializing && !direction->parameters && drive->b == 0.0 && drive->contacts.bending != NULL) {
        int failed = drive->exchange ? exchange_solve(drive, message)
                                     : !drive_kinematic(drive) && compliant_solve(drive, message);
        if (failed) {
            return 1;
        }
        if (!drive->exchange && drive_swings(drive)
            && (drive->table->offers == INTERFACE_INERTIA || unknown->field == TORQUE)) {
            return 0; /* outputs belong to the last step */
        }
        failed = drive_kinematic(drive) ? of_kinematic(drive, unknown->field, &direction->along, value)
                                        : of_compliant(drive, unknown->field, &direction->along, value);
        if (!failed) {
            return 0;
        }
    }
    return by_difference(drive, unknown, &direction->along, direction->size, value, message);
}
