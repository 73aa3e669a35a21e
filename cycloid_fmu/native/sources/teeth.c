#include "drive.h"

#include <math.h>
#include <stdio.h>

const struct side *teeth_side(const struct drive *drive, double direction) {
    return &drive->table->side[direction > 0.0 ? 0 : 1];
}

int teeth_outside(const struct drive *drive, double load, double side) {
    return load > teeth_side(drive, side)->reach;
}

struct play teeth_play(const struct drive *drive, const struct place *place) {
    struct play play;
    play.end[0] = table_at_node(&drive->table->side[0], place, 0);
    play.end[1] = table_at_node(&drive->table->side[1], place, 0);
    play.width = play.end[0].deviation + play.end[1].deviation;
    play.offset = play.offset_rate = 0.0;
    if (play.width <= NO_PLAY) {
        play.width = 0.0;
    } else if (drive->state.backlash_on == 0.0) {
        play.offset = 0.5 * play.width;
        play.offset_rate = 0.5 * (play.end[0].rate + play.end[1].rate);
    }
    return play;
}

/* Torque of the crank from the contacts: the energy's derivative at fixed output. */
double teeth_crank_torque(const struct drive *drive, const struct place *place, double load, double side,
                              double offset_rate, double *energy) {
    double rate;
    table_energy(teeth_side(drive, side), place, load, energy, &rate);
    return table_rest_torque(drive->table, place) - side * load / drive->table->ratio - (rate - offset_rate * load);
}

double teeth_stiffness(const struct drive *drive, const struct place *place, double load, double side, double play) {
    double compliance;
    if (load > 0.0) {
        compliance = table_at(teeth_side(drive, side), place, load).compliance;
    } else if (play > 0.0) {
        return 0.0;
    } else {
        compliance = table_at_node(teeth_side(drive, 1.0), place, 0).compliance;
    }
    return 1.0 / (compliance > LEAST_COMPLIANCE ? compliance : LEAST_COMPLIANCE);
}

void teeth_press_gear(const struct drive *drive, double crank_angle, double deviation, double series,
                      struct pressed *found) {
    struct place place = table_place(drive->table, crank_angle);
    struct play play = teeth_play(drive, &place);
    double energy;
    found->side = deviation > play.end[0].deviation - play.offset ? 1.0 : -1.0;
    found->load = table_load(teeth_side(drive, found->side), &place, found->side * deviation, play.offset, series);
    found->by_angle = teeth_crank_torque(drive, &place, found->load, found->side, play.offset_rate, &energy);
    found->by_rotation = found->side * found->load;
    found->energy = found->load * (found->side * deviation + play.offset) - energy
        - 0.5 * series * found->load * found->load + table_rest_energy(drive->table, &place);
    found->stiffness = teeth_stiffness(drive, &place, found->load, found->side, play.width);
    found->crank = crank_angle;
    found->deviation = deviation - series * found->by_rotation;
}

int teeth_press(const struct drive *drive, double crank_angle, double deviation, struct pressed *found,
                char message[MESSAGE_SIZE]) {
    if (!(deviation > -LARGEST_TRANSMISSION_ERROR && deviation < LARGEST_TRANSMISSION_ERROR)) {
        if (drive->table->offers == INTERFACE_COMPLIANT && drive->step > SUGGESTED_STEP) {
            snprintf(message, MESSAGE_SIZE,
                     "flange_b.phi is %g rad from flange_a.phi/ratio after a step of %g s: it must stay within %g rad; make shorter "
                     "steps (%g s is suggested), or build the FMU with the inertias inside (--output-inertia, --crank-inertia).",
                     deviation, drive->step, LARGEST_TRANSMISSION_ERROR, SUGGESTED_STEP);
            return 1;
        }
        return drive_refuse(message, "flange_b.phi is %g rad from flange_a.phi/ratio: it must stay within %g rad.", deviation,
                      LARGEST_TRANSMISSION_ERROR);
    }
    if (drive->b > 0.0) {
        reducer_press(drive, crank_angle, deviation, found);
    } else {
        teeth_press_gear(drive, crank_angle, deviation, drive->state.series_compliance, found);
    }
    return 0;
}
