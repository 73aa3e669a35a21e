/* A cycloid drive and the rotor behind it, between two steps of a robot simulator that holds the arm. The rotor, the play,
   the wind-up and friction are integrated in sub-steps, with an arm of the inertia that the simulator has at this joint.
   Friction is that of the FMUs. All numbers are SI; angles in rad. Equations: docs/theory/joint.md. */
#include "drive.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#ifndef SOURCE_HASH
#define SOURCE_HASH ""
#endif
#ifdef _WIN32
#define JOINT_API __declspec(dllexport)
#else
#define JOINT_API __attribute__((visibility("default")))
#endif

enum {
    MOST_POINTS = 32, /* of the wind-up over torque */
    MOST_WAVES = 32,
    STATES = 2 + 2 * FRICTION_ELEMENTS,
    MOST_PARTS_OF_A_STEP = 10000,
    MOST_SOLUTIONS = 50
};
enum { REFUSED_NOT_FINITE = 1, REFUSED_TOO_MANY_PARTS, REFUSED_NUMBERS };
static const double PHASE = 0.3;                /* rad of the fastest oscillation in a sub-step */
static const double LONGEST_PART = 1.0 / 3000.0; /* s */
static const double LEAST_WAY = 1e-6;            /* of a way in the other direction */
static const double ROUNDING = 1e-13;           /* of the way */

struct wave {
    double order, amplitude, phase; /* amplitude sin(order angle/ratio + phase) */
};

struct waves {
    int count;
    struct wave wave[MOST_WAVES];
};

struct joint {
    struct drive drive; /* of which friction uses the laws, their elements and the loss table */
    double rotor_inertia, play, damping, step;
    int points;
    double torque[MOST_POINTS], windup[MOST_POINTS]; /* from 0 */
    struct waves error, loose; /* of the transmission error and the play */
    double stiffest;
    double angle, speed; /* of the rotor */
};

struct command {
    double torque, kp, kd, angle, speed;
};

/* Value and derivative with the rotor's angle. */
struct rate {
    double value, rate;
};

static struct rate waves_at(const struct waves *waves, double angle, double ratio) {
    struct rate result = {0.0, 0.0};
    int i;
    for (i = 0; i < waves->count; i++) {
        const struct wave *wave = &waves->wave[i];
        const double phase = wave->order * angle / ratio + wave->phase;
        result.value += wave->amplitude * sin(phase);
        result.rate += wave->amplitude * wave->order / ratio * cos(phase);
    }
    return result;
}

/* Torque at a wind-up above 0: linear between the points, and beyond the last as before it. */
static double elastic_torque(const struct joint *joint, double windup) {
    int i = 1;
    while (i < joint->points - 1 && windup > joint->windup[i]) {
        i++;
    }
    return joint->torque[i - 1] + (windup - joint->windup[i - 1]) * (joint->torque[i] - joint->torque[i - 1])
        / (joint->windup[i] - joint->windup[i - 1]);
}

/* Torque of the teeth on the rotor, and that by which they resist the arm. */
struct teeth {
    double rotor, arm;
};

static struct teeth teeth_between(const struct joint *joint, double angle, double speed, double arm, double arm_speed) {
    const double ratio = joint->drive.ratio;
    const struct rate error = waves_at(&joint->error, angle, ratio), loose = waves_at(&joint->loose, angle, ratio);
    const double deviation = arm - angle / ratio - error.value, side = deviation < 0.0 ? -1.0 : 1.0;
    const double gap = fmax(0.5 * (joint->play + loose.value), 0.0), windup = fabs(deviation) - gap;
    const double lever = 1.0 / ratio + error.rate;
    struct teeth result = {0.0, 0.0};
    if (windup > 0.0) {
        const double elastic = elastic_torque(joint, windup), rate = joint->damping * (arm_speed - speed * lever);
        result.arm = side * elastic + fmin(fmax(rate, -elastic), elastic);
        result.rotor = result.arm * lever + (gap > 0.0 ? 0.5 * elastic * loose.rate : 0.0);
    }
    return result;
}

/* Way of an inertia in a time, from a speed, under a torque, a drag and the friction of its flange: the mean of both speeds
   times the time. `strain` moves with it. The friction's mean torque is in `friction`. Friction rises with the way, ever less
   in either direction: from a way short of the solution Newton's method approaches it and never passes it. A step that
   changes the direction therefore begins again near 0. */
static double way_of(const struct joint *joint, int flange, double inertia, double torque, double drag, double speed,
                     double load, double time, double strain[FRICTION_ELEMENTS], double *friction) {
    const struct drive *drive = &joint->drive;
    const double stiffness = drive->element[flange], lubricant = friction_viscous(drive, flange);
    const double slope = 2.0 * inertia / (time * time) + (drag + lubricant) / time;
    const double wanted = torque + 2.0 * inertia * speed / time;
    double following[FRICTION_ELEMENTS], way = stiffness > 0.0 ? speed * time : wanted / slope, least = LEAST_WAY;
    struct slid slid = {0.0, 0.0, 0.0};
    if (stiffness > 0.0) {
        const struct yields yields = friction_yields(drive, flange, load, speed);
        int i;
        for (i = 0; i < MOST_SOLUTIONS; i++) {
            double next;
            slid = friction_slide(strain, following, way, time, stiffness, yields);
            next = way - (slope * way + slid.torque - wanted) / (slope + slid.slope);
            if (fabs(next - way) <= ROUNDING * (fabs(way) + fabs(wanted) / slope)) {
                break;
            }
            if (next * way < 0.0) {
                next *= least;
                least *= LEAST_WAY;
            }
            way = next;
        }
        memcpy(strain, following, sizeof following);
    }
    *friction = slid.torque + lubricant * way / time;
    return way;
}

static int parts_of(const struct joint *joint, double inertia) {
    const double ratio = joint->drive.ratio, held = FRICTION_ELEMENTS * joint->drive.element[OUTPUT];
    const double rotor = FRICTION_ELEMENTS * joint->drive.element[INPUT] / joint->rotor_inertia;
    const double teeth = joint->stiffest * (1.0 / (joint->rotor_inertia * ratio * ratio) + 1.0 / inertia);
    const double parts = ceil(joint->step / fmin(PHASE / sqrt(teeth + rotor + held / inertia), LONGEST_PART));
    return parts <= MOST_PARTS_OF_A_STEP ? (int)parts : 0;
}

JOINT_API const char *joint_drive_source(void) {
    return SOURCE_HASH;
}

JOINT_API size_t joint_drive_size(void) {
    return sizeof(struct joint);
}

static int take_waves(struct waves *waves, int count, const double *numbers) {
    waves->count = count;
    memcpy(waves->wave, numbers, (size_t)count * sizeof(struct wave));
    return 3 * count;
}

/* Take the numbers: ratio, rotor's inertia, play, damping, rated torque, step; Coulomb torque, Stribeck torque and speed,
   viscous torque and presliding angle of the motor, its two efficiencies; the same five of the output, its load share; the
   numbers of points (from 0, 0), orders of the transmission error, orders of the play; torque and wind-up of each point;
   order, amplitude and phase of each order. Python has checked them. */
JOINT_API int joint_drive_open(void *self, const double *numbers, size_t count) {
    struct joint *joint = self;
    struct drive *drive = &joint->drive;
    int flange, i, next = 22;
    const int points = (int)numbers[19], errors = (int)numbers[20], plays = (int)numbers[21];
    if (points < 2 || points > MOST_POINTS || errors < 0 || errors > MOST_WAVES || plays < 0 || plays > MOST_WAVES
        || count != (size_t)(22 + 2 * points + 3 * (errors + plays))) {
        return REFUSED_NUMBERS;
    }
    memset(joint, 0, sizeof *joint);
    drive->ratio = numbers[0];
    joint->rotor_inertia = numbers[1];
    joint->play = numbers[2];
    joint->damping = numbers[3];
    drive->rated = numbers[4];
    joint->step = numbers[5];
    for (flange = INPUT; flange <= OUTPUT; flange++) {
        const double *law = numbers + (flange == INPUT ? 6 : 13);
        struct friction *friction = &drive->state.friction[flange];
        friction->coulomb = law[0];
        friction->stribeck = law[1];
        friction->stribeck_speed = law[2];
        friction->viscous = law[3];
        friction->presliding_angle = law[4];
    }
    drive->state.friction[OUTPUT].load_share = numbers[18];
    drive->rows = 1;
    drive->state.loss[1] = numbers[11];
    drive->state.loss[2] = numbers[12];
    friction_settle(drive);
    joint->points = points;
    for (i = 0; i < points; i++) {
        joint->torque[i] = numbers[next++];
        joint->windup[i] = numbers[next++];
        if (i > 0) {
            joint->stiffest = fmax(joint->stiffest, (joint->torque[i] - joint->torque[i - 1])
                                       / (joint->windup[i] - joint->windup[i - 1]));
        }
    }
    next += take_waves(&joint->error, errors, numbers + next);
    take_waves(&joint->loose, plays, numbers + next);
    return 0;
}

/* The rotor's angle and speed, and the strains of both flanges. */
JOINT_API void joint_drive_save(const void *self, double state[STATES]) {
    const struct joint *joint = self;
    state[0] = joint->angle;
    state[1] = joint->speed;
    memcpy(state + 2, joint->drive.state.strain, sizeof joint->drive.state.strain);
}

JOINT_API void joint_drive_load(void *self, const double state[STATES]) {
    struct joint *joint = self;
    joint->angle = state[0];
    joint->speed = state[1];
    memcpy(joint->drive.state.strain, state + 2, sizeof joint->drive.state.strain);
}

/* Stiffness by which the drive may hold the arm, with that of friction before it slides. */
JOINT_API double joint_drive_stiffness(const void *self) {
    const struct joint *joint = self;
    return joint->stiffest + FRICTION_ELEMENTS * joint->drive.element[OUTPUT];
}

/* One step. `outside`: the arm's angle, speed and inertia, the torque of everything else on it and that torque's rate.
   `result`: mean torque on the arm, the arm's angle at the end, the motor's work, the number of sub-steps. Returns what it
   refuses, and then nothing has changed. */
JOINT_API int joint_drive_step(void *self, const double command[5], const double outside[5], double result[4]) {
    struct joint *joint = self;
    struct drive *drive = &joint->drive;
    const struct command to = {command[0], command[1], command[2], command[3], command[4]};
    const double inertia = outside[2];
    double arm = outside[0], arm_speed = outside[1], angle = joint->angle, speed = joint->speed, impulse = 0.0, work = 0.0;
    double strain[2][FRICTION_ELEMENTS], total = 0.0, time;
    int i, parts;
    for (i = 0; i < 5; i++) {
        total += command[i] + outside[i];
    }
    if (!isfinite(total)) {
        return REFUSED_NOT_FINITE;
    }
    parts = parts_of(joint, inertia);
    if (parts == 0) {
        return REFUSED_TOO_MANY_PARTS;
    }
    time = joint->step / parts;
    memcpy(strain, drive->state.strain, sizeof strain);
    for (i = 0; i < parts; i++) {
        const double middle = angle + 0.5 * time * speed, arm_middle = arm + 0.5 * time * arm_speed;
        const struct teeth teeth = teeth_between(joint, middle, speed, arm_middle, arm_speed);
        const double asked = to.torque + to.kp * (to.angle - middle) + to.kd * to.speed;
        const double other = outside[3] + outside[4] * (i + 0.5) * time;
        double friction[2], way, arm_way;
        way = way_of(joint, INPUT, joint->rotor_inertia, asked + teeth.rotor, to.kd, speed, -teeth.rotor, time,
                     strain[INPUT], &friction[INPUT]);
        arm_way = way_of(joint, OUTPUT, inertia, other - teeth.arm, 0.0, arm_speed, teeth.arm, time, strain[OUTPUT],
                         &friction[OUTPUT]);
        work += (asked - to.kd * way / time) * way;
        impulse -= time * (teeth.arm + friction[OUTPUT]);
        angle += way;
        arm += arm_way;
        speed = 2.0 * way / time - speed;
        arm_speed = 2.0 * arm_way / time - arm_speed;
    }
    if (!isfinite(angle + speed + arm + impulse)) {
        return REFUSED_NOT_FINITE;
    }
    joint->angle = angle;
    joint->speed = speed;
    memcpy(drive->state.strain, strain, sizeof strain);
    result[0] = impulse / joint->step;
    result[1] = arm;
    result[2] = work;
    result[3] = parts;
    return 0;
}

/* Drives at hinges of a simulator, with the addresses of its arrays. */
struct hinge {
    void *joint;
    size_t speed, angle; /* numbers in the simulator's arrays */
    const double *command;
    double *result;
};

struct scene {
    size_t drives, speeds, pushes;
    struct hinge *hinge;
    /* Generalized forces: passive ones, those of inertia and gravity (on the other side), of actuators and constraints, and
       applied ones, among them the drives'; the numbers of forces on bodies. */
    const double *passive, *bias, *actuated, *constrained, *pushed;
    double *applied, *angle;
    const double *speed;
    double *before, *rates_of; /* of the smooth forces: those of the last step, and 1/step at the drives, else 0 */
    double *forces; /* rows over the speeds: all forces, the rates of smooth ones, a unit torque of each drive */
    const double *solved; /* accelerations by each row of `forces` */
};

/* Fill the first two rows of `forces`; returns whether a force acts on a body, which they lack. */
JOINT_API int joint_drive_read(const struct scene *scene) {
    double *all = scene->forces, *rates = all + scene->speeds;
    size_t i;
    for (i = 0; i < scene->speeds; i++) {
        const double smooth = scene->passive[i] - scene->bias[i];
        rates[i] = (smooth - scene->before[i]) * scene->rates_of[i];
        scene->before[i] = smooth;
        all[i] = smooth + scene->applied[i] + scene->actuated[i] + scene->constrained[i];
    }
    for (i = 0; i < scene->pushes; i++) {
        if (scene->pushed[i] != 0.0) {
            return 1;
        }
    }
    return 0;
}

/* Move the drives by a step. The applied forces have their torques, extrapolated by half a step. Returns what is refused. */
JOINT_API int joint_drive_move(const struct scene *scene) {
    const double *solved = scene->solved, *rates = scene->forces + scene->speeds;
    size_t k;
    for (k = 0; k < scene->drives; k++) {
        const struct hinge *hinge = &scene->hinge[k];
        const size_t dof = hinge->speed;
        const double inertia = 1.0 / solved[(k + 2) * scene->speeds + dof];
        const double outside[5] = {scene->angle[hinge->angle], scene->speed[dof], inertia,
                                   inertia * solved[dof] - scene->applied[dof], inertia * solved[scene->speeds + dof]};
        const int refused = joint_drive_step(hinge->joint, hinge->command, outside, hinge->result);
        if (refused) {
            return refused;
        }
    }
    for (k = 0; k < scene->drives; k++) {
        const struct hinge *hinge = &scene->hinge[k];
        const double step = ((const struct joint *)hinge->joint)->step;
        scene->applied[hinge->speed] = hinge->result[0] + 0.5 * step * rates[hinge->speed];
    }
    return 0;
}

/* After the simulator's step: the arms' angles, and the mean torques alone. */
JOINT_API void joint_drive_place(const struct scene *scene) {
    size_t k;
    for (k = 0; k < scene->drives; k++) {
        scene->angle[scene->hinge[k].angle] = scene->hinge[k].result[1];
        scene->applied[scene->hinge[k].speed] = scene->hinge[k].result[0];
    }
}

/* Of the FMU's tables, whose checks these sources contain as well. */
int drive_refuse(char message[MESSAGE_SIZE], const char *format, double value, double limit) {
    (void)message;
    (void)format;
    (void)value;
    (void)limit;
    return 1;
}
