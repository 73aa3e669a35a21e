#include "drive.h"

#include <math.h>
#include <string.h>

int losses_check(const struct drive *drive, char message[MESSAGE_SIZE]) {
    int i, j;
    if (drive->state.viscosity_100 > drive->state.viscosity_40) {
        return drive_refuse(message, "lubricant.viscosity_100 = %g m2/s: it must not be above viscosity_40 = %g m2/s.",
                            drive->state.viscosity_100, drive->state.viscosity_40);
    }
    for (i = 0; i < drive->rows; i++) {
        const double *row = drive->state.loss + i * LOSS_COLUMNS;
        if (i == 0 ? row[0] != 0.0 : !(row[0] > row[-LOSS_COLUMNS])) {
            return drive_refuse(message, "loss_table[%.0f,1] = %g: speeds must ascend from 0.", i + 1, row[0]);
        }
        if (!(row[1] > 0.0 && row[1] <= 1.0)) {
            return drive_refuse(message, "loss_table[%.0f,2] = %g: an efficiency lies above 0 and not above 1.", i + 1, row[1]);
        }
        if (!(row[2] >= 0.0 && row[2] <= 1.0)) {
            return drive_refuse(message, "loss_table[%.0f,3] = %g: an efficiency lies between 0 and 1.", i + 1, row[2]);
        }
        for (j = 3; j < LOSS_COLUMNS; j++) {
            if (!(row[j] >= 0.0)) {
                return drive_refuse(message, "loss_table[%.0f,4] or its neighbour = %g: a friction torque must not be below 0.",
                              i + 1, row[j]);
            }
        }
    }
    return 0;
}

int losses_take(const struct drive *drive) {
    int i, result = 0;
    for (i = 0; i < drive->rows; i++) {
        const double *row = drive->state.loss + i * LOSS_COLUMNS;
        result |= row[1] != 1.0 || row[2] != 1.0 || row[3] != 0.0 || row[4] != 0.0;
    }
    return result;
}

/* lg(ν + 0.7) of the lubricant at a temperature, ν in mm²/s (ASTM D341). */
static double thickness(const struct state *s, double temperature) {
    const double at_40 = log10(log10(1e6 * s->viscosity_40 + 0.7)), at_100 = log10(log10(1e6 * s->viscosity_100 + 0.7));
    return pow(10.0, at_40 + (at_100 - at_40) * log10(temperature / 313.15) / log10(373.15 / 313.15));
}

/* Viscosity over that at which the table is stated. What a lubricant does depends on speed times viscosity alone. */
double losses_thinning(const struct drive *drive) {
    const struct state *s = &drive->state;
    if (s->viscosity_40 == 0.0 || s->temperature == s->lubricant_temperature) {
        return 1.0;
    }
    return (pow(10.0, thickness(s, s->temperature)) - 0.7) / (pow(10.0, thickness(s, s->lubricant_temperature)) - 0.7);
}

/* Sliding friction torque at flange_a against its motion, as `Modelica.Mechanics.Rotational.Components.LossyGear` of the
   Modelica Standard Library 4.0: with τ = `asked` the torque of the teeth, with the sign of the motion, flange_a needs
   (τ + τ_bf1)/η_mf1 while it drives and η_mf2 (τ + τ_bf2) while flange_b does. Which one drives follows from flange_a's
   torque without the bearings' part, Modelica's `tau_bf_a`. The stuck mode is that of friction.c. */
double losses_torque(const struct drive *drive, double speed, double asked) {
    double size = fabs(speed), at[LOSS_COLUMNS], bearing;
    const double *rows = drive->state.loss;
    int i, j, last = drive->rows - 1;
    memcpy(at, rows + last * LOSS_COLUMNS, sizeof at);
    for (i = 0; i < last; i++) {
        const double *below = rows + i * LOSS_COLUMNS, *above = below + LOSS_COLUMNS;
        if (size < above[0]) {
            double share = (size - below[0]) / (above[0] - below[0]);
            for (j = 1; j < LOSS_COLUMNS; j++) {
                at[j] = below[j] + share * (above[j] - below[j]);
            }
            break;
        }
    }
    bearing = at[1] == 1.0 && at[2] == 1.0 ? 0.5 * at[3] : (at[3] - at[4]) * at[2] / (at[1] * at[2] - 1.0);
    if (asked >= at[1] * bearing - at[3]) {
        return (asked + at[3]) / at[1] - asked;
    }
    return at[2] * (asked + at[4]) - asked;
}

/* The crank angle of the cycloid stage; behind a first stage that moves, ideally. */
static double ripple_crank(const struct drive *drive) {
    const struct state *s = &drive->state;
    if (drive->table->offers == INTERFACE_KINEMATIC || drive->resting) {
        return s->placed;
    }
    return (drive->table->offers == INTERFACE_COMPLIANT ? s->crank_angle : s->turned) * drive->table->ratio / drive->ratio;
}

/* The upper of two nodes about a value, of a list that ascends from 0, and its share; as at the last one above it. */
static uint32_t node_above(const double *nodes, uint32_t count, double value, double *share) {
    uint32_t above = 1;
    while (above + 1 < count && value > nodes[above]) {
        above++;
    }
    *share = fmin((value - nodes[above - 1]) / (nodes[above] - nodes[above - 1]), 1.0);
    return above;
}

double losses_ripple(const struct drive *drive, double reduced, double load, double direction) {
    const struct ripple *ripple = drive->ripple;
    const int flank = load < 0.0, driven = load * direction < 0.0;
    double crank, fast, much, result = 0.0;
    uint32_t i, j, k, above;
    if (ripple == NULL) {
        return 0.0;
    }
    crank = ripple_crank(drive);
    i = node_above(ripple->speed, ripple->speeds, fabs(reduced), &fast);
    j = node_above(ripple->load, ripple->loads, fabs(load), &much);
    for (k = 0; k < ripple->orders; k++) {
        const double turn = ripple->order[k] * crank;
        double part[2];
        int of;
        for (of = 0; of < 2; of++) {
            double at_speed[2]; /* the slower one, the faster one */
            for (above = 0; above < 2; above++) {
                const double low = ripple->part[i - 1 + above][flank][driven][j - 1][k][of];
                const double high = ripple->part[i - 1 + above][flank][driven][j][k][of];
                at_speed[above] = low + much * (high - low);
            }
            part[of] = at_speed[0] + fast * (at_speed[1] - at_speed[0]);
        }
        result += part[0] * cos(turn) + part[1] * sin(turn);
    }
    return result;
}
