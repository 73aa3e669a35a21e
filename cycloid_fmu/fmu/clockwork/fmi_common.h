/* What both versions of FMI have in the same form. The including file defines VERSION, fmi2 or fmi3, and the types
   fmi2Handle or fmi3Handle of an instance, fmi2Number or fmi3Number of a real number. There is no guard: each version includes
   it once. */
#include "instance.h"

#define JOINED(A, B) A##B
#define NAMED(A, B) JOINED(A, B)
#define FMI(NAME) NAMED(VERSION, NAME)
#define AS_STATUS(STATUS) ((FMI(Status))(STATUS))

/* Bodies of the functions that get and set variables of a kind. */
#define GET_ALL(TYPE, KIND)                                                                                            \
    size_t i;                                                                                                          \
    for (i = 0; i < n; i++) {                                                                                          \
        const struct variable *variable = instance_variable(c, references[i], KIND);                                   \
        double value;                                                                                                  \
        if (variable == NULL || instance_get(c, variable, &value) != STATUS_OK) {                                      \
            return AS_STATUS(STATUS_ERROR);                                                                            \
        }                                                                                                              \
        values[i] = (TYPE)value;                                                                                       \
    }                                                                                                                  \
    return AS_STATUS(STATUS_OK);

#define SET_ALL(KIND)                                                                                                  \
    size_t i;                                                                                                          \
    int status = STATUS_OK;                                                                                            \
    for (i = 0; i < n; i++) {                                                                                          \
        const struct variable *variable = instance_variable(c, references[i], KIND);                                   \
        if (variable == NULL || instance_set(c, variable, (double)values[i]) != STATUS_OK) {                           \
            status = STATUS_ERROR;                                                                                     \
        }                                                                                                              \
    }                                                                                                                  \
    return AS_STATUS(status);

const char *FMI(GetVersion)(void) {
    return FMI(Version);
}

FMI(Status) FMI(SetDebugLogging)(FMI(Handle) c, FMI(Boolean) on, size_t n, const FMI(String) categories[]) {
    (void)c, (void)on, (void)n, (void)categories; /* refusals and the one warning are always logged */
    return AS_STATUS(STATUS_OK);
}

void FMI(FreeInstance)(FMI(Handle) c) {
    instance_close(c);
}

FMI(Status) FMI(ExitInitializationMode)(FMI(Handle) c) {
    return AS_STATUS(instance_start(c));
}

FMI(Status) FMI(Terminate)(FMI(Handle) c) {
    return AS_STATUS(instance_terminate(c));
}

FMI(Status) FMI(Reset)(FMI(Handle) c) {
    return AS_STATUS(instance_reset(c));
}

FMI(Status) FMI(EnterEventMode)(FMI(Handle) c) {
    return AS_STATUS(instance_enter(c, EVENT));
}

FMI(Status) FMI(EnterContinuousTimeMode)(FMI(Handle) c) {
    return AS_STATUS(instance_enter(c, CONTINUOUS));
}

FMI(Status) FMI(CompletedIntegratorStep)(FMI(Handle) c, FMI(Boolean) noSetFMUStatePriorToCurrentPoint,
                                         FMI(Boolean) *enterEventMode, FMI(Boolean) *terminateSimulation) {
    (void)noSetFMUStatePriorToCurrentPoint;
    *enterEventMode = *terminateSimulation = 0;
    return AS_STATUS(instance_completed(c));
}

FMI(Status) FMI(SetTime)(FMI(Handle) c, FMI(Number) time) {
    return AS_STATUS(instance_set_time(c, time));
}

FMI(Status) FMI(SetContinuousStates)(FMI(Handle) c, const FMI(Number) states[], size_t count) {
    return AS_STATUS(instance_set_states(c, states, count));
}

FMI(Status) FMI(GetContinuousStates)(FMI(Handle) c, FMI(Number) states[], size_t count) {
    return AS_STATUS(instance_states(c, states, count));
}

FMI(Status) FMI(GetNominalsOfContinuousStates)(FMI(Handle) c, FMI(Number) nominals[], size_t count) {
    return AS_STATUS(instance_nominals(c, nominals, count));
}

FMI(Status) FMI(GetEventIndicators)(FMI(Handle) c, FMI(Number) indicators[], size_t count) {
    return AS_STATUS(instance_indicators(c, indicators, count));
}
