/* The function block that MATIEC made C of, for Python: inputs as a row of numbers, outputs likewise. */
#include "iec_std_lib.h"

TIME __CURRENT_TIME;
BOOL __DEBUG;

#include "POUS.h"

#include "POUS.c"

static JOINT block;

void start(double index, double probability) {
    JOINT_init__(&block, 0);
    __SET_VAR(block., INDEX, , index);
    __SET_VAR(block., INDEX_PROBABILITY, , probability);
}

void step(const double row[6], int measured, double found[5]) {
    __SET_VAR(block., DESIRED_ANGLE, , row[0]);
    __SET_VAR(block., DESIRED_SPEED, , row[1]);
    __SET_VAR(block., LOAD_TORQUE, , row[2]);
    __SET_VAR(block., TEMPERATURE, , row[3]);
    __SET_VAR(block., MOTOR_ANGLE_MEASURED, , row[4]);
    __SET_VAR(block., OUTPUT_ANGLE_MEASURED, , row[5]);
    __SET_VAR(block., OUTPUT_MEASURED, , measured);
    JOINT_body__(&block);
    found[0] = __GET_VAR(block.MOTOR_ANGLE, );
    found[1] = __GET_VAR(block.MOTOR_SPEED, );
    found[2] = __GET_VAR(block.BAND, );
    found[3] = __GET_VAR(block.GAIN, );
    found[4] = __GET_VAR(block.HOLDS, );
}
