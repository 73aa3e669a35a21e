/* The contacts as the drive uses them: with the play taken out if `backlash_on` is false, and behind the first stage. */
#include "drive.h"

#include <math.h>
#include <stdio.h>

int teeth_outside(const struct drive *drive, double torque) {
    return fabs(torque) > drive->contacts.reach[torque > 0.0 ? 0 : 1];
}

int teeth_refuse(int status, double torque, char message[MESSAGE_SIZE]) {
    if (status == CONTACTS_UNBALANCED) {
        drive_refuse(message, "flange_b.tau = %g N.m: no contacts of this drive can balance it.", torque, 0.0);
    } else if (status != CONTACTS_SOLVED) {
        snprintf(message, MESSAGE_SIZE, "the contacts could not be solved at these flange angles.");
    }
    return status != CONTACTS_SOLVED;
}

static int solve_play(const struct drive *drive, double crank_angle, struct play *play) {
    double ends[2];
    int status = drive->contacts.play(drive->contacts.self, crank_angle, ends);
    play->low = ends[0];
    play->high = ends[1];
    play->width = play->high - play->low;
    play->offset = drive->state.backlash_on == 0.0 ? 0.5 * play->width : 0.0;
    return status;
}

int teeth_play(const struct drive *drive, double crank_angle, struct play *play, char message[MESSAGE_SIZE]) {
    return teeth_refuse(solve_play(drive, crank_angle, play), 0.0, message);
}

double teeth_width(const struct drive *drive, double crank_angle) {
    struct play play;
    return solve_play(drive, crank_angle, &play) == CONTACTS_SOLVED ? play.width : NAN;
}

double teeth_offset_rate(const struct drive *drive, double crank_angle) {
    const struct contacts *contacts = &drive->contacts;
    if (drive->state.backlash_on != 0.0 || teeth_width(drive, crank_angle) == 0.0) {
        return 0.0;
    }
    return 0.5 * (contacts->touch_rate(contacts->self, crank_angle, 1.0)
                  - contacts->touch_rate(contacts->self, crank_angle, -1.0));
}

/* Without its play, the gear is moved and pressed by its play as well. */
double teeth_crank_torque(const struct drive *drive, double crank_angle, double torque) {
    return drive->contacts.crank_torque(drive->contacts.self, crank_angle, torque)
        + teeth_offset_rate(drive, crank_angle) * fabs(torque);
}

double teeth_stiffness(const struct drive *drive, double crank_angle, double torque) {
    struct loaded at;
    int status = drive->contacts.loaded(drive->contacts.self, crank_angle, torque, &at);
    return status == CONTACTS_SOLVED ? 1.0 / at.compliance : NAN;
}

/* The contacts' transmission error for that of the gear, on the side (±1) on which they are. */
static int contacts_transmission_error(const struct drive *drive, double crank_angle, double *transmission_error, double *side,
                              char message[MESSAGE_SIZE]) {
    struct play play;
    *side = 0.0;
    if (drive->state.backlash_on != 0.0) {
        return 0;
    }
    if (teeth_play(drive, crank_angle, &play, message)) {
        return 1;
    }
    *side = *transmission_error > play.high - play.offset ? 1.0 : -1.0;
    *transmission_error += *side * play.offset;
    return 0;
}

int teeth_hold(const struct drive *drive, double crank_angle, double transmission_error, double series, double *torque,
               char message[MESSAGE_SIZE]) {
    double side;
    if (contacts_transmission_error(drive, crank_angle, &transmission_error, &side, message)) {
        return 1;
    }
    return teeth_refuse(drive->contacts.held(drive->contacts.self, crank_angle, transmission_error, series, torque), 0.0,
                        message);
}

int teeth_press_gear(const struct drive *drive, double crank_angle, double transmission_error, double series,
                     struct pressed *pressed, char message[MESSAGE_SIZE]) {
    double contacts = transmission_error, side;
    int status;
    if (contacts_transmission_error(drive, crank_angle, &contacts, &side, message)) {
        return 1;
    }
    status = drive->contacts.press(drive->contacts.self, crank_angle, contacts, series, pressed);
    if (teeth_refuse(status, 0.0, message)) {
        return 1;
    }
    if (side != 0.0) {
        pressed->by_angle += side * teeth_offset_rate(drive, crank_angle) * pressed->by_rotation;
    }
    pressed->torque = pressed->by_rotation;
    pressed->crank = crank_angle;
    pressed->transmission_error = transmission_error - series * pressed->by_rotation;
    return 0;
}

int teeth_press(const struct drive *drive, double crank_angle, double transmission_error, struct pressed *pressed,
                char message[MESSAGE_SIZE]) {
    if (!(transmission_error > -LARGEST_TRANSMISSION_ERROR && transmission_error < LARGEST_TRANSMISSION_ERROR)) {
        if (drive->table->offers == INTERFACE_COMPLIANT && drive->step > SUGGESTED_STEP) {
            snprintf(message, MESSAGE_SIZE,
                     "flange_b.phi is %g rad from flange_a.phi/ratio after a step of %g s: it must stay within %g rad; make shorter "
                     "steps (%g s is suggested), or build the FMU with the inertias inside (--output-inertia, --crank-inertia).",
                     transmission_error, drive->step, LARGEST_TRANSMISSION_ERROR, SUGGESTED_STEP);
            return 1;
        }
        return drive_refuse(message, "flange_b.phi is %g rad from flange_a.phi/ratio: it must stay within %g rad.",
                            transmission_error, LARGEST_TRANSMISSION_ERROR);
    }
    if (drive->b > 0.0) {
        return reducer_press(drive, crank_angle, transmission_error, pressed, message);
    }
    return teeth_press_gear(drive, crank_angle, transmission_error, drive->state.series_compliance, pressed, message);
}
