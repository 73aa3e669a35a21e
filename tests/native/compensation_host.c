/* Steps of a compensator through a sequence that is compiled in; prints each command's bits. With TIMED: times them, an
   empty call first. */
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#if defined(TIMED)
#include <time.h>
#endif

#include "joint.h"
#include "sequence.h"

static struct joint_command step(struct joint_memory *memory, const double *row) {
    return joint_step(memory, row[0], row[1], row[2], row[3], row[4], row[5]);
}

static void bits(double value) {
    uint64_t whole;
    memcpy(&whole, &value, sizeof whole);
    fprintf(stdout, "%08x%08x ", (unsigned)(whole >> 32), (unsigned)(whole & 0xffffffffu));
}

int main(void) {
    struct joint_memory memory;
    int i;
    joint_start(&memory, INDEX, PROBABILITY);
#if defined(TIMED)
    {
        static double spent[ROWS + 1];
        double sum = 0.0;
        int round;
        for (i = 0; i <= ROWS; i++) {
            spent[i] = 1e9;
        }
        for (round = 0; round < TIMED; round++) { /* the same way each time; the least of each is without interruptions */
            joint_start(&memory, INDEX, PROBABILITY);
            for (i = 0; i <= ROWS; i++) {
                struct timespec from, to;
                double taken;
                clock_gettime(CLOCK_MONOTONIC, &from);
                sum += i > 0 ? step(&memory, SEQUENCE[i - 1]).motor_angle : 0.0;
                clock_gettime(CLOCK_MONOTONIC, &to);
                taken = 1e9 * (double)(to.tv_sec - from.tv_sec) + (double)(to.tv_nsec - from.tv_nsec);
                spent[i] = taken < spent[i] ? taken : spent[i];
            }
        }
        for (i = 0; i <= ROWS; i++) {
            fprintf(stdout, "%g\n", spent[i]);
        }
        return sum == 0.1;
    }
#endif
    for (i = 0; i < ROWS; i++) {
        struct joint_command found = step(&memory, SEQUENCE[i]);
        bits(found.motor_angle), bits(found.motor_speed), bits(found.band), bits(found.gain);
        fprintf(stdout, "%d\n", found.holds);
    }
    return 0;
}
