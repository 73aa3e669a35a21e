#include "exact_contacts.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { LOADED, PLAY }; /* groups of blocks */

static size_t size_of(const struct exact_contacts *contacts, int group) {
    size_t size = 0, i;
    for (i = 0; i < contacts->problem.counts[group]; i++) {
        size += (size_t)contacts->problem.sizes[group][i];
    }
    return size;
}

static void copy_out(const struct exact_contacts *contacts, int group, unsigned char *bytes) {
    size_t i;
    for (i = 0; i < contacts->problem.counts[group]; i++) {
        memcpy(bytes, contacts->problem.blocks[group][i], (size_t)contacts->problem.sizes[group][i]);
        bytes += contacts->problem.sizes[group][i];
    }
}

static void copy_in(struct exact_contacts *contacts, int group, const unsigned char *bytes) {
    size_t i;
    for (i = 0; i < contacts->problem.counts[group]; i++) {
        memcpy(contacts->problem.blocks[group][i], bytes, (size_t)contacts->problem.sizes[group][i]);
        bytes += contacts->problem.sizes[group][i];
    }
}

size_t exact_size(const struct exact_contacts *contacts) {
    return sizeof contacts->last + size_of(contacts, LOADED) + size_of(contacts, PLAY);
}

void exact_save(const struct exact_contacts *contacts, unsigned char *bytes) {
    memcpy(bytes, &contacts->last, sizeof contacts->last);
    bytes += sizeof contacts->last;
    copy_out(contacts, LOADED, bytes);
    copy_out(contacts, PLAY, bytes + size_of(contacts, LOADED));
}

void exact_restore(struct exact_contacts *contacts, const unsigned char *bytes) {
    memcpy(&contacts->last, bytes, sizeof contacts->last);
    bytes += sizeof contacts->last;
    copy_in(contacts, LOADED, bytes);
    copy_in(contacts, PLAY, bytes + size_of(contacts, LOADED));
}

static unsigned char *saved(const struct exact_contacts *contacts, int group) {
    return contacts->before + (group == PLAY ? size_of(contacts, LOADED) : 0);
}

static void begin(void *self) {
    struct exact_contacts *contacts = self;
    contacts->last_before = contacts->last;
    contacts->changed[LOADED] = contacts->changed[PLAY] = 0;
}

static void undo(void *self) {
    struct exact_contacts *contacts = self;
    int group;
    contacts->last = contacts->last_before;
    for (group = LOADED; group <= PLAY; group++) {
        if (contacts->changed[group]) {
            copy_in(contacts, group, saved(contacts, group));
        }
    }
}

static void change(struct exact_contacts *contacts, int group) {
    if (!contacts->changed[group]) {
        copy_out(contacts, group, saved(contacts, group));
        contacts->changed[group] = 1;
    }
}

static int solve(struct exact_contacts *contacts, int operation, double crank_angle, double a, double b,
                 double result[MOST_RESULTS]) {
    const struct exact_problem *problem = &contacts->problem;
    const int of_play = operation == SOLVE_PLAY || operation == SOLVE_TOUCH;
    change(contacts, of_play ? PLAY : LOADED);
    if (!of_play && problem->tangent > 0.0 && operation != SOLVE_PRESS
        && !(operation == SOLVE_LOAD && fabs(a) >= problem->tangent)) {
        change(contacts, PLAY);
    }
    crank_angle -= problem->period * floor(crank_angle / problem->period);
    return (int)problem->solve(problem->box, operation, crank_angle, a, b, result);
}

/* The solution of the blocks under load; NAN for none while it is sought. */
static int solve_loaded(struct exact_contacts *contacts, int operation, double crank_angle, double a, double b,
                        double result[MOST_RESULTS]) {
    struct exact_solution *last = &contacts->last;
    int status;
    last->crank_angle = last->held_at = NAN;
    status = solve(contacts, operation, crank_angle, a, b, result);
    if (status == CONTACTS_SOLVED) {
        last->crank_angle = crank_angle;
        last->transmission_error = result[0];
        last->stiffness = result[1];
        last->torque = result[2];
        last->turned = last->shared = 0.0;
    }
    return status;
}

static int stand(struct exact_contacts *contacts, double crank_angle, double torque) {
    double result[MOST_RESULTS];
    return contacts->last.crank_angle == crank_angle && contacts->last.torque == torque
        ? CONTACTS_SOLVED : solve_loaded(contacts, SOLVE_LOAD, crank_angle, torque, 0.0, result);
}

static int turn(struct exact_contacts *contacts, double crank_angle, double torque) {
    struct exact_solution *last = &contacts->last;
    double result[MOST_RESULTS];
    int status = stand(contacts, crank_angle, torque);
    if (status == CONTACTS_SOLVED && last->turned == 0.0) {
        status = solve(contacts, SOLVE_TURN, crank_angle, 0.0, 0.0, result);
        last->crank_torque = result[0];
        last->rate = isnan(result[1]) ? 0.0 : result[1]; /* nothing moves the output */
        last->turned = 1.0;
    }
    return status;
}

static int play(void *self, double crank_angle, double ends[2]) {
    struct exact_contacts *contacts = self;
    struct exact_solution *last = &contacts->last;
    double result[MOST_RESULTS];
    int status = CONTACTS_SOLVED;
    if (!(last->play_angle == crank_angle)) {
        status = solve(contacts, SOLVE_PLAY, crank_angle, 0.0, 0.0, result);
        last->play_angle = status == CONTACTS_SOLVED ? crank_angle : NAN;
        memcpy(last->ends, result, sizeof last->ends);
    }
    memcpy(ends, last->ends, sizeof last->ends);
    return status;
}

static double touch_rate(void *self, double crank_angle, double side) {
    struct exact_contacts *contacts = self;
    double result[MOST_RESULTS], ends[2];
    if (play(self, crank_angle, ends) != CONTACTS_SOLVED
        || solve(contacts, SOLVE_TOUCH, crank_angle, ends[side > 0.0], side, result) != CONTACTS_SOLVED) {
        return NAN;
    }
    return (isnan(result[0]) ? 0.0 : result[0]) - 1.0 / contacts->problem.ratio;
}

static int loaded(void *self, double crank_angle, double torque, struct loaded *result) {
    struct exact_contacts *contacts = self;
    int status = stand(contacts, crank_angle, torque);
    result->transmission_error = contacts->last.transmission_error;
    result->compliance = contacts->last.stiffness > 0.0 ? 1.0 / contacts->last.stiffness : HUGE_VAL;
    return status;
}

static double rate(void *self, double crank_angle, double torque) {
    struct exact_contacts *contacts = self;
    return turn(contacts, crank_angle, torque) == CONTACTS_SOLVED ? contacts->last.rate - 1.0 / contacts->problem.ratio : NAN;
}

static double crank_torque(void *self, double crank_angle, double torque) {
    struct exact_contacts *contacts = self;
    return turn(contacts, crank_angle, torque) == CONTACTS_SOLVED ? contacts->last.crank_torque : NAN;
}

static int held(void *self, double crank_angle, double transmission_error, double series, double *torque) {
    double result[MOST_RESULTS];
    int status = solve_loaded(self, SOLVE_HOLD, crank_angle, transmission_error, series, result);
    *torque = result[2];
    return status;
}

static int press(void *self, double crank_angle, double transmission_error, double series, struct pressed *pressed) {
    struct exact_contacts *contacts = self;
    struct exact_solution *last = &contacts->last;
    double result[MOST_RESULTS];
    int status = CONTACTS_SOLVED;
    if (!(last->crank_angle == crank_angle && last->held_at == transmission_error && last->series == series)) {
        status = solve_loaded(contacts, SOLVE_PRESS, crank_angle, transmission_error, series, result);
        last->held_at = transmission_error;
        last->series = series;
        last->energy = result[3];
        last->by_angle = result[4];
    }
    pressed->energy = last->energy;
    pressed->by_angle = last->by_angle;
    pressed->by_rotation = last->torque;
    pressed->stiffness = last->stiffness;
    return status;
}

static void sharing(void *self, double crank_angle, double torque, double *count, double *pressure) {
    struct exact_contacts *contacts = self;
    struct exact_solution *last = &contacts->last;
    double result[MOST_RESULTS];
    *count = *pressure = NAN;
    if (stand(contacts, crank_angle, torque) != CONTACTS_SOLVED) {
        return;
    }
    if (last->shared == 0.0) {
        solve(contacts, SOLVE_SHARE, crank_angle, 0.0, 0.0, result);
        last->count = result[0];
        last->pressure = result[1];
        last->shared = 1.0;
    }
    *count = last->count;
    *pressure = last->pressure;
}

int exact_open(struct exact_contacts *self, const struct exact_problem *problem, struct contacts *contacts) {
    memset(self, 0, sizeof *self);
    memset(contacts, 0, sizeof *contacts);
    self->problem = *problem;
    self->last.crank_angle = self->last.held_at = self->last.play_angle = NAN;
    self->before = malloc(exact_size(self));
    contacts->self = self;
    contacts->reach[0] = contacts->reach[1] = HUGE_VAL;
    contacts->stiffness = problem->stiffness;
    contacts->free_energy = problem->free_energy;
    contacts->play = play;
    contacts->touch_rate = touch_rate;
    contacts->loaded = loaded;
    contacts->rate = rate;
    contacts->crank_torque = crank_torque;
    contacts->held = held;
    contacts->press = press;
    contacts->sharing = sharing;
    contacts->begin = begin;
    contacts->undo = undo;
    return self->before == NULL;
}

void exact_close(struct exact_contacts *self) {
    free(self->before);
    self->before = NULL;
}
