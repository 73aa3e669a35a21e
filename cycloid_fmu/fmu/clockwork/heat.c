/* The drive as one heat capacity at the temperature of its oil: C dT/dt = P + Q - (T - T_0)/R, with the power P of friction,
   damping and losses, the heat flow Q into the drive, and the resistance R to surroundings at T_0. */
#include "drive.h"

#include <math.h>
#include <stdio.h>

int heat_stored(const struct drive *drive) {
    return drive->state.heat_capacity > 0.0;
}

double heat_rate(const struct drive *drive, double power) {
    const struct state *s = &drive->state;
    return (power + s->heat_flow - (s->temperature - s->ambient_temperature) / s->thermal_resistance) / s->heat_capacity;
}

/* Exact where power, heat flow and surroundings are constant over the step. */
int heat_step(struct drive *drive, double power, double step, char message[MESSAGE_SIZE]) {
    struct state *s = &drive->state;
    const double time = s->thermal_resistance * s->heat_capacity;
    s->temperature -= heat_rate(drive, power) * time * expm1(-step / time);
    if (!(s->temperature >= COLDEST && s->temperature <= HOTTEST)) {
        snprintf(message, MESSAGE_SIZE, "heat_port.T = %g K at the end of the step: it must lie between %g and %g K.",
                 s->temperature, COLDEST, HOTTEST);
        return 1;
    }
    return 0;
}
