#include "drive.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "blob.h"

enum { NUMBERS = sizeof(struct state) / sizeof(double) };
static const struct blob_kind STATE = {"cycloid native\n", STATE_VERSION, "native cycloid drive",
                                       "this state belongs to another drive: it was taken from an FMU with other tables."};

int drive_refuse(char message[MESSAGE_SIZE], const char *format, double value, double limit) {
    snprintf(message, MESSAGE_SIZE, format, value, limit);
    return 1;
}

int drive_kinematic(const struct drive *drive) {
    return drive->table->offers == INTERFACE_KINEMATIC;
}

int drive_swings(const struct drive *drive) {
    return drive->table->offers == INTERFACE_INERTIA || drive->table->offers == INTERFACE_ROTOR;
}

double drive_angle(const struct drive *drive) {
    const struct state *s = &drive->state;
    return drive_kinematic(drive) ? s->placed : drive_swings(drive) ? s->turned : s->crank_angle;
}

double drive_crank_angle(const struct drive *drive) {
    return drive_kinematic(drive) || drive->resting ? drive->state.placed : drive->pressed.crank;
}

static int move_flanges(struct drive *drive, double step, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    drive->solved = 0;
    if (drive_kinematic(drive)) {
        return kinematic_follow(drive, message);
    }
    if (drive_swings(drive) ? compliant_swing(drive, step, message) : compliant_move(drive, step, message)) {
        return 1;
    }
    s->support_angle += s->support_speed * step;
    drive->solved = 0;
    if (!(fabs(s->crank_angle) < HUGE_VAL && fabs(s->output_angle) < HUGE_VAL && fabs(s->dissipated_energy) < HUGE_VAL
          && fabs(s->output_speed) < HUGE_VAL)) {
        return drive_refuse(message, "flange_a.w = %g rad/s: the flanges leave the range of numbers in a step of %g s.",
                      s->crank_speed, step);
    }
    return compliant_solve(drive, message);
}

static int move(struct drive *drive, double step, char message[MESSAGE_SIZE]) {
    const double before = drive->state.dissipated_energy;
    double length, power;
    if (move_flanges(drive, step, message)) {
        return 1;
    }
    length = step - drive->remaining;
    if (!heat_stored(drive) || !(length > 0.0)) {
        return 0;
    }
    power = drive_kinematic(drive) ? kinematic_power(drive) : (drive->state.dissipated_energy - before) / length;
    return heat_step(drive, power, length, message);
}

static int guarded(struct drive *drive, double step, char message[MESSAGE_SIZE]) {
    struct state before;
    int failed;
    /* A step does not change parameters, nor the fields that the kinematic interface does not have. */
    size_t size = drive_kinematic(drive) ? offsetof(struct state, seen) : offsetof(struct state, crank_torque);
    memcpy(&before, &drive->state, size);
    if (drive->contacts.begin != NULL) {
        drive->contacts.begin(drive->contacts.self);
    }
    failed = move(drive, step, message);
    if (failed) {
        memcpy(&drive->state, &before, size);
        if (drive->contacts.undo != NULL) {
            drive->contacts.undo(drive->contacts.self);
        }
        drive->solved = 0;
    }
    return failed;
}

int drive_step(struct drive *drive, double time, double step, char message[MESSAGE_SIZE]) {
    int failed;
    if (!(step >= 0.0 && step < HUGE_VAL)) {
        return drive_refuse(message, "a step of %g s: it must be finite and not below %g.", step, 0.0);
    }
    if (!(fabs(time + step) < HUGE_VAL)) {
        return drive_refuse(message, "a step from the time %g s over %g s: both must be finite.", time, step);
    }
    drive->impact = 0;
    drive->remaining = 0.0;
    drive->step = step;
    failed = guarded(drive, step, message);
    drive->step = 0.0;
    if (failed) {
        drive->impact = 0;
        drive->remaining = 0.0;
        return 1;
    }
    drive->state.time = time + step - drive->remaining;
    return 0;
}

/* With an inertia the drive starts at rest under its load, without a history of friction. */
static int rest_on_load(struct drive *drive, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    const int rubs[2] = {drive->rubs[INPUT], drive->rubs[OUTPUT]};
    double speed;
    int failed, i;
    s->settled = 0.0;
    drive->rubs[INPUT] = drive->rubs[OUTPUT] = 0;
    drive->resting = 1;
    failed = kinematic_follow(drive, message);
    speed = failed ? 0.0 : kinematic_speed(drive);
    drive->resting = 0;
    for (i = 0; !failed && s->torque != 0.0 && i < 5; i++) {
        /* The torque of the stored energy differs slightly from that of the quasi-static balance: with exact contacts
           (docs/theory/fmu.md), and where a compliance in series changes the angle of a reducer's crank. */
        failed = teeth_press(drive, s->turned, s->output_angle - s->turned / drive->ratio, &drive->pressed, message);
        if (!failed && drive->pressed.stiffness > 0.0) {
            s->output_angle += (s->torque - drive->pressed.by_rotation)
                * (1.0 / drive->pressed.stiffness + s->series_compliance);
        }
    }
    memcpy(drive->rubs, rubs, sizeof rubs);
    s->output_speed = speed;
    return failed;
}

int drive_start(struct drive *drive, char message[MESSAGE_SIZE]) {
    struct state before = drive->state;
    int failed = losses_check(drive, message);
    drive->initializing = 0;
    drive->solved = 0;
    memset(drive->state.strain, 0, sizeof drive->state.strain);
    drive->state.settled = drive->state.dissipated_energy = 0.0;
    if (heat_stored(drive)) {
        drive->state.temperature = drive->state.temperature_start;
    }
    if (!failed && drive_swings(drive)) {
        struct state *s = &drive->state;
        if (s->crank_inertia > 0.0) {
            s->crank_angle = s->crank_angle_start;
            s->crank_speed = s->crank_speed_start;
        }
        s->turned = s->crank_angle;
        failed = drive->table->offers == INTERFACE_INERTIA && rest_on_load(drive, message);
    }
    drive->state.seen = drive->state.output_angle;
    drive->state.crank_seen = drive->state.crank_angle;
    failed = failed || guarded(drive, 0.0, message);
    if (!failed && drive_swings(drive)) {
        const struct rubbing crank = compliant_rubbing(drive, INPUT), output = compliant_rubbing(drive, OUTPUT);
        drive->state.mean_torque = drive->pressed.by_angle - drive->damping / drive->ratio + crank.torque;
        drive->state.mean_loss = compliant_power(drive) + crank.power + output.power;
        drive->state.mean_output = drive->table->offers == INTERFACE_INERTIA
            ? drive->state.torque : drive->pressed.by_rotation + drive->damping + output.torque;
    }
    exchange_keep(drive);
    if (!drive_kinematic(drive)) {
        drive->state.transmission_error = drive->state.output_angle - drive_angle(drive) / drive->ratio;
    }
    if (failed) {
        drive->state = before;
        drive->solved = 0;
    }
    return failed;
}

/* ---- variables ---- */

double *drive_stored(struct state *s, const struct variable *variable) {
    switch (variable->field) {
    case CRANK_ANGLE: return &s->crank_angle;
    case CRANK_SPEED: return &s->crank_speed;
    case CRANK_TORQUE: return &s->crank_torque;
    case OUTPUT_ANGLE: return &s->output_angle;
    case OUTPUT_SPEED: return &s->output_speed;
    case TORQUE: return &s->torque;
    case TEMPERATURE: return &s->temperature;
    case HEAT_CAPACITY: return &s->heat_capacity;
    case THERMAL_RESISTANCE: return &s->thermal_resistance;
    case AMBIENT_TEMPERATURE: return &s->ambient_temperature;
    case HEAT_FLOW: return &s->heat_flow;
    case TEMPERATURE_START: return &s->temperature_start;
    case LUBRICANT_VISCOSITY_40: return &s->viscosity_40;
    case LUBRICANT_VISCOSITY_100: return &s->viscosity_100;
    case LUBRICANT_TEMPERATURE: return &s->lubricant_temperature;
    case SERIES_COMPLIANCE: return &s->series_compliance;
    case BACKLASH_ON: return &s->backlash_on;
    case MESH_DAMPING: return &s->mesh_damping;
    case LARGEST_STEP: return &s->largest_step;
    case OUTPUT_INERTIA: return &s->output_inertia;
    case CRANK_INERTIA: return &s->crank_inertia;
    case CRANK_ANGLE_START: return &s->crank_angle_start;
    case CRANK_SPEED_START: return &s->crank_speed_start;
    case ARM_TORQUE_RATE: return &s->torque_rate;
    case MOTOR_STIFFNESS: return &s->motor_stiffness;
    case MOTOR_DAMPING: return &s->motor_damping;
    case SUPPORT_ANGLE: return &s->support_angle;
    case SUPPORT_SPEED: return &s->support_speed;
    case TRANSMISSION_ERROR: return &s->transmission_error;
    case DISSIPATED_ENERGY: return &s->dissipated_energy;
    case TIME: return &s->time;
    default: break;
    }
    if (variable->field >= INPUT_FRICTION_STRAIN_1 && variable->field < INPUT_FRICTION_STRAIN_RATE_1) {
        return &s->strain[INPUT][0] + (variable->field - INPUT_FRICTION_STRAIN_1);
    }
    if (variable->field >= INPUT_FRICTION_COULOMB && variable->field < LOSS_TABLE) {
        return &s->friction[INPUT].coulomb + (variable->field - INPUT_FRICTION_COULOMB);
    }
    return variable->field >= LOSS_TABLE ? &s->loss[variable->field - LOSS_TABLE] : NULL;
}

/* Contribution of the housing to a variable. */
static double of_housing(const struct drive *drive, int field) {
    switch (field) {
    case CRANK_ANGLE:
    case CRANK_ANGLE_START:
    case OUTPUT_ANGLE: return drive->state.support_angle;
    case CRANK_SPEED:
    case CRANK_SPEED_START:
    case OUTPUT_SPEED: return drive->state.support_speed;
    default: return 0.0;
    }
}

/* Convert everything that does not move with the housing to another angle and speed of the housing. */
static void turn_housing(struct drive *drive, double angle, double speed) {
    struct state *s = &drive->state;
    s->crank_angle -= angle;
    s->crank_speed -= speed;
    s->crank_angle_start -= angle;
    s->crank_speed_start -= speed;
    if (!drive_kinematic(drive)) {
        s->turned -= angle;
        s->output_angle -= angle;
        s->output_speed -= speed;
    }
}

void drive_reset(struct drive *drive) {
    uint32_t i;
    memset(&drive->state, 0, sizeof drive->state);
    drive->initializing = 1;
    drive->solved = 0;
    for (i = 0; i < drive->table->variables; i++) {
        const struct variable *v = &drive->table->variable[i];
        double *value = drive_stored(&drive->state, v);
        if (value != NULL && v->causality != CAUSALITY_OUTPUT && v->causality != CAUSALITY_LOCAL) {
            *value = v->start;
        }
    }
    friction_settle(drive);
}

void drive_open(struct drive *drive, struct table *table) {
    uint32_t i;
    memset(drive, 0, sizeof *drive);
    drive->table = table;
    if (table->angles > 0) {
        drive->contacts = table_contacts(&drive->tables, table);
    }
    drive->ratio = table->ratio;
    drive->ripple = table->ripple.orders > 0 ? &table->ripple : NULL;
    drive->rated = UNRATED_LOAD;
    if (table->sun_teeth > 0.0) {
        drive->b = table->sun_teeth / table->planet_teeth;
        drive->a = 1.0 + drive->b;
        drive->s = 1.0 / (1.0 - drive->a / table->ratio);
        drive->ratio = -table->ratio / (drive->b * drive->s);
    }
    for (i = 0; i < table->variables; i++) {
        int row = (table->variable[i].field - LOSS_TABLE) / LOSS_COLUMNS + 1;
        drive->rows = table->variable[i].field >= LOSS_TABLE && row > drive->rows ? row : drive->rows;
        if (strcmp(table->variable[i].name, "rated_torque") == 0) {
            drive->rated = table->variable[i].start;
        }
    }
    drive_reset(drive);
}

int drive_set(struct drive *drive, const struct variable *variable, double value, char message[MESSAGE_SIZE]) {
    double *stored = drive_stored(&drive->state, variable);
    if (variable->baked && value != variable->start) {
        snprintf(message, MESSAGE_SIZE, "%.100s = %g: this FMU holds it in its tables, made for %g; build the FMU again "
                 "with it, or use the FMU in Python, where it is tunable.", variable->name, value, variable->start);
        return 1;
    }
    if (variable->baked) {
        return 0;
    }
    if (stored == NULL || (variable->causality != CAUSALITY_INPUT && variable->causality != CAUSALITY_PARAMETER)) {
        snprintf(message, MESSAGE_SIZE, "%.100s can't be set: it is an output.", variable->name);
        return 1;
    }
    if (variable->fixed && !drive->initializing) {
        snprintf(message, MESSAGE_SIZE, "%.100s can't be set after initialization.", variable->name);
        return 1;
    }
    if (!(value >= variable->least && value <= variable->most && fabs(value) < HUGE_VAL)) {
        int limited = variable->least > -HUGE_VAL || variable->most < HUGE_VAL;
        snprintf(message, MESSAGE_SIZE, limited ? "%.100s = %g: it must be finite and lie between %g and %g."
                                                : "%.100s = %g: it must be finite.",
                 variable->name, value, variable->least, variable->most);
        return 1;
    }
    if (variable->field == SUPPORT_ANGLE || variable->field == SUPPORT_SPEED) {
        double change = value - *stored;
        turn_housing(drive, variable->field == SUPPORT_ANGLE ? change : 0.0, variable->field == SUPPORT_SPEED ? change : 0.0);
    }
    *stored = value - of_housing(drive, variable->field);
    if (variable->field >= INPUT_FRICTION_COULOMB) {
        friction_settle(drive);
    }
    drive->solved = 0;
    return 0;
}

/* Torque of the teeth on the gear; returns whether there is contact. */
static int contacts_torque(struct drive *drive, double *torque) {
    *torque = drive_kinematic(drive) || drive->resting ? kinematic_torque(drive) : drive->pressed.torque;
    return drive_kinematic(drive) || drive->resting ? kinematic_pressed(drive) : drive->pressed.stiffness > 0.0;
}

double drive_stiffness(struct drive *drive) {
    double torque, stiffness;
    if (drive->b > 0.0) {
        return drive_kinematic(drive) || drive->resting ? reducer_stiffness(drive) : reducer_pressed_stiffness(drive);
    }
    if (!contacts_torque(drive, &torque)) {
        return 0.0;
    }
    stiffness = drive_kinematic(drive) || drive->resting ? teeth_stiffness(drive, drive_crank_angle(drive), torque)
                                                          : drive->pressed.stiffness;
    return stiffness > 0.0 ? 1.0 / (1.0 / stiffness + drive->state.series_compliance) : 0.0;
}

int drive_outside(const struct drive *drive) {
    const struct state *s = &drive->state;
    if (drive_kinematic(drive)) {
        return teeth_outside(drive, kinematic_torque(drive));
    }
    return s->outside != 0.0 || (drive->solved && teeth_outside(drive, drive->pressed.torque));
}

static double output(struct drive *drive, int field) {
    struct state *s = &drive->state;
    int still = drive_kinematic(drive);
    double torque, ratio = drive->ratio;
    switch (field) {
    case CRANK_TORQUE:
        if (still) {
            torque = kinematic_crank_torque(drive);
            return torque + kinematic_rubbing(drive, INPUT, torque).torque;
        }
        if (drive_swings(drive)) {
            return s->mean_torque;
        }
        return drive->pressed.by_angle - drive->damping / ratio + compliant_rubbing(drive, INPUT).torque;
    case CRANK_ANGLE: return drive_angle(drive) + s->support_angle;
    case CRANK_SPEED: return s->crank_speed + s->support_speed;
    case OUTPUT_ANGLE: return s->output_angle + s->support_angle;
    case ARM_ANGLE: return s->seen + s->support_angle;
    case OUTPUT_SPEED: return (still ? kinematic_speed(drive) : s->output_speed) + s->support_speed;
    case SUPPORT_TORQUE:
        return -(output(drive, CRANK_TORQUE) + (still ? s->torque : output(drive, TORQUE)));
    case TORQUE:
        if (drive_swings(drive) && !drive->exchange) {
            return s->mean_output;
        }
        return drive->pressed.by_rotation + drive->damping + compliant_rubbing(drive, OUTPUT).torque;
    case TRANSMISSION_ERROR: return still ? s->transmission_error : s->output_angle - drive_angle(drive) / ratio;
    case BACKLASH:
        return s->backlash_on == 0.0 ? 0.0 : drive->b == 0.0 ? teeth_width(drive, drive_crank_angle(drive))
            : still ? reducer_backlash(drive, s->placed, s->gear)
                    : reducer_backlash(drive, drive->pressed.crank, drive->pressed.transmission_error);
    case TORSIONAL_STIFFNESS: return drive_stiffness(drive);
    case MAX_CONTACT_PRESSURE:
    case CONTACT_COUNT: {
        double count, pressure;
        if (!contacts_torque(drive, &torque)) {
            return 0.0;
        }
        drive->contacts.sharing(drive->contacts.self, drive_crank_angle(drive), torque, &count, &pressure);
        return field == CONTACT_COUNT ? count : pressure;
    }
    case POWER_LOSS:
        if (still) {
            return kinematic_power(drive);
        }
        if (drive_swings(drive)) {
            return s->mean_loss;
        }
        return drive->exchange ? exchange_rate(drive, DISSIPATED_ENERGY)
                               : compliant_power(drive) + compliant_rubbing(drive, INPUT).power
                                     + compliant_rubbing(drive, OUTPUT).power;
    case TEMPERATURE: return s->temperature;
    case TEMPERATURE_RATE: return exchange_rate(drive, TEMPERATURE);
    case OUTSIDE_RANGE: return drive_outside(drive);
    case ELASTIC_ENERGY:
        return drive->pressed.energy + compliant_rubbing(drive, INPUT).stored + compliant_rubbing(drive, OUTPUT).stored;
    case DISSIPATED_ENERGY: return s->dissipated_energy;
    case CRANK_ACCELERATION: return exchange_rate(drive, CRANK_SPEED);
    case OUTPUT_ACCELERATION: return exchange_rate(drive, OUTPUT_SPEED);
    case TRANSMISSION_ERROR_RATE: return exchange_rate(drive, TRANSMISSION_ERROR);
    default: {
        double indicators[EVENT_INDICATORS];
        const int strain = field - INPUT_FRICTION_STRAIN_RATE_1, indicator = field - EVENT_INDICATOR_1;
        if (strain >= 0 && strain < 2 * FRICTION_ELEMENTS) {
            return exchange_rate(drive, strain + INPUT_FRICTION_STRAIN_1);
        }
        if (indicator < 0 || indicator >= EVENT_INDICATORS) {
            return HUGE_VAL; /* no output: the table was not made by this package */
        }
        exchange_indicators(drive, indicators);
        return indicators[indicator];
    }
    }
}

int drive_get(struct drive *drive, const struct variable *variable, double *value, char message[MESSAGE_SIZE]) {
    const double *stored = variable->causality == CAUSALITY_OUTPUT ? NULL : drive_stored(&drive->state, variable);
    if (stored != NULL || variable->baked) {
        *value = stored != NULL ? *stored + of_housing(drive, variable->field) : variable->start;
        return 0;
    }
    if (drive->initializing) {
        /* During initialization outputs follow the values that were set: computed without a change of the state. */
        struct state before = drive->state;
        int failed = drive_start(drive, message);
        *value = failed ? 0.0 : output(drive, variable->field);
        drive->state = before;
        drive->initializing = 1;
        drive->solved = 0;
        if (failed) {
            return 1;
        }
    } else {
        if (drive->exchange ? exchange_solve(drive, message) : !drive_kinematic(drive) && compliant_solve(drive, message)) {
            return 1;
        }
        *value = output(drive, variable->field);
    }
    if (!(fabs(*value) < HUGE_VAL)) {
        snprintf(message, MESSAGE_SIZE, "%.100s is beyond the range of numbers at these inputs.", variable->name);
        return 1;
    }
    return 0;
}

/* ---- the state as bytes ---- */

size_t drive_state_size(void) {
    return blob_size(NUMBERS);
}

void drive_state_write(const struct drive *drive, unsigned char *blob) {
    blob_write(blob, &STATE, drive->table->checksum, &drive->state, NUMBERS,
               (uint64_t)drive->initializing | (uint64_t)drive->exchange << 1);
}

void drive_state_seal(unsigned char *blob) {
    blob_seal(blob, drive_state_size());
}

int drive_state_check(const struct drive *drive, const unsigned char *blob, size_t size, int sealed,
                      char message[MESSAGE_SIZE]) {
    if (blob_check(blob, size, &STATE, drive->table->checksum, NUMBERS, sealed, message)) {
        return 1;
    }
    if ((blob_flags(blob, NUMBERS) >> 1 != 0) != drive->exchange) {
        snprintf(message, MESSAGE_SIZE,
                 "this state is of the other interface: Co-Simulation and Model Exchange have their own.");
        return 1;
    }
    return 0;
}

void drive_state_read(struct drive *drive, const unsigned char *blob) {
    struct state before;
    blob_read(blob, &drive->state, NUMBERS);
    drive->initializing = (blob_flags(blob, NUMBERS) & 1) != 0;
    before = drive->state;
    friction_settle(drive);
    drive->state = before;
    drive->solved = 0;
}
