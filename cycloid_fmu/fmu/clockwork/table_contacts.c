/* Contacts by tables. */
#include "table_contacts.h"

#include <math.h>

static const struct side *side_of(const struct table_contacts *contacts, double torque) {
    return &contacts->table->side[torque > 0.0 ? 0 : 1];
}

static const struct place *place_at(struct table_contacts *contacts, double crank_angle) {
    if (!(contacts->crank_angle == crank_angle)) {
        contacts->place = table_place(contacts->table, crank_angle);
        contacts->crank_angle = crank_angle;
        contacts->torque = contacts->turned = NAN;
    }
    return &contacts->place;
}

/* Mirrored like the sides; at zero torque the positive one. */
static struct interpolated at_torque(struct table_contacts *contacts, double crank_angle, double torque) {
    const struct place *place = place_at(contacts, crank_angle);
    if (!(contacts->torque == torque)) {
        contacts->at = torque == 0.0 ? table_at_node(&contacts->table->side[0], place, 0)
                                     : table_at(side_of(contacts, torque), place, fabs(torque));
        contacts->torque = torque;
    }
    return contacts->at;
}

static double mirrored(double torque, double value) {
    return torque < 0.0 ? -value : value;
}

static int play(void *self, double crank_angle, double ends[2]) {
    struct table_contacts *contacts = self;
    const struct place *place = place_at(contacts, crank_angle);
    ends[0] = -table_at_node(&contacts->table->side[1], place, 0).transmission_error;
    ends[1] = table_at_node(&contacts->table->side[0], place, 0).transmission_error;
    if (ends[1] - ends[0] <= NO_PLAY) {
        ends[0] = ends[1] = 0.5 * (ends[0] + ends[1]);
    }
    return CONTACTS_SOLVED;
}

static double touch_rate(void *self, double crank_angle, double side) {
    struct table_contacts *contacts = self;
    return mirrored(side, table_at_node(side_of(contacts, side), place_at(contacts, crank_angle), 0).rate);
}

static int loaded(void *self, double crank_angle, double torque, struct loaded *result) {
    const struct interpolated at = at_torque(self, crank_angle, torque);
    result->transmission_error = mirrored(torque, at.transmission_error);
    result->compliance = at.compliance > LEAST_COMPLIANCE ? at.compliance : LEAST_COMPLIANCE;
    return CONTACTS_SOLVED;
}

static double rate(void *self, double crank_angle, double torque) {
    return mirrored(torque, at_torque(self, crank_angle, torque).rate);
}

static double torque_of_crank(const struct table *table, const struct place *place, double torque, double energy_rate) {
    return table_rest_torque(table, place) - torque / table->ratio - energy_rate;
}

/* The energy's derivative at fixed output. */
static double crank_torque(void *self, double crank_angle, double torque) {
    struct table_contacts *contacts = self;
    const struct place *place = place_at(contacts, crank_angle);
    if (!(contacts->turned == torque)) {
        double energy, energy_rate;
        table_energy(side_of(contacts, torque), place, fabs(torque), &energy, &energy_rate);
        contacts->crank_torque = torque_of_crank(contacts->table, place, torque, energy_rate);
        contacts->turned = torque;
    }
    return contacts->crank_torque;
}

static double torque_at(struct table_contacts *contacts, double crank_angle, double transmission_error, double series) {
    const struct place *place = place_at(contacts, crank_angle);
    const double side = transmission_error > table_at_node(&contacts->table->side[0], place, 0).transmission_error ? 1.0 : -1.0;
    return side * table_load(side_of(contacts, side), place, side * transmission_error, series);
}

static int held(void *self, double crank_angle, double transmission_error, double series, double *torque) {
    *torque = torque_at(self, crank_angle, transmission_error, series);
    return CONTACTS_SOLVED;
}

static int press(void *self, double crank_angle, double transmission_error, double series, struct pressed *pressed) {
    struct table_contacts *contacts = self;
    const struct table *table = contacts->table;
    const double torque = torque_at(contacts, crank_angle, transmission_error, series);
    double energy, energy_rate, ends[2];
    table_energy(side_of(contacts, torque), &contacts->place, fabs(torque), &energy, &energy_rate);
    pressed->by_angle = torque_of_crank(table, &contacts->place, torque, energy_rate);
    pressed->by_rotation = torque;
    pressed->energy = torque * transmission_error - energy - 0.5 * series * torque * torque
        + table_rest_energy(table, &contacts->place);
    pressed->stiffness = 0.0;
    play(self, crank_angle, ends);
    if (torque != 0.0 || ends[0] == ends[1]) {
        struct loaded at;
        loaded(self, crank_angle, torque, &at);
        pressed->stiffness = 1.0 / at.compliance;
    }
    return CONTACTS_SOLVED;
}

static void sharing(void *self, double crank_angle, double torque, double *count, double *pressure) {
    const struct table_contacts *contacts = self;
    const struct place place = table_pressure_place(contacts->table, crank_angle);
    *count = table_contact_count(side_of(contacts, torque), &place, fabs(torque));
    *pressure = table_pressure(side_of(contacts, torque), &place, fabs(torque));
}

static void bending(void *self, double crank_angle, double torque, struct bending *result) {
    struct table_contacts *contacts = self;
    const struct table *table = contacts->table;
    const struct place turning = table_turning(table, place_at(contacts, crank_angle));
    const struct interpolated at = table_at(side_of(contacts, torque), &turning, fabs(torque));
    double energy_rate, curvature;
    table_energy(side_of(contacts, torque), &turning, fabs(torque), &energy_rate, &curvature);
    result->rate = mirrored(torque, at.rate);
    result->compliance = at.compliance;
    result->crank_torque = table_rest_torque(table, &turning) - curvature;
    result->offset = 0.5 * (table_at_node(&table->side[0], &turning, 0).rate + table_at_node(&table->side[1], &turning, 0).rate);
}

struct contacts table_contacts(struct table_contacts *self, const struct table *table) {
    struct contacts contacts = {0};
    struct loaded most;
    int i;
    self->table = table;
    self->crank_angle = NAN;
    contacts.self = self;
    contacts.play = play;
    contacts.touch_rate = touch_rate;
    contacts.loaded = loaded;
    contacts.rate = rate;
    contacts.crank_torque = crank_torque;
    contacts.held = held;
    contacts.press = press;
    contacts.sharing = sharing;
    contacts.bending = bending;
    for (i = 0; i < 2; i++) {
        contacts.reach[i] = table->side[i].reach;
    }
    loaded(self, 0.0, contacts.reach[0], &most);
    contacts.stiffness = 1.0 / most.compliance;
    return contacts;
}
