/* Contacts by tables, with the last place and result, which are only for speed. */
#ifndef CYCLOID_TABLE_CONTACTS_H
#define CYCLOID_TABLE_CONTACTS_H

#include "contacts.h"
#include "table.h"

struct table_contacts {
    const struct table *table;
    double crank_angle, torque, turned; /* of `place`, `at` and `crank_torque`; NAN for none */
    struct place place;
    struct interpolated at;
    double crank_torque;
};

struct contacts table_contacts(struct table_contacts *self, const struct table *table);

#endif
