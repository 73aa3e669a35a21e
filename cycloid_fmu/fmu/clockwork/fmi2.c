/* FMI 2.0: Model Exchange and Co-Simulation. */
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"
#include "format.h"

#define VERSION fmi2
typedef fmi2Component fmi2Handle;
typedef fmi2Real fmi2Number;
#include "fmi_common.h"

#ifdef SOURCE_HASH
FMI2_Export const char cycloid_sources[] = SOURCE_HASH; /* by which a library of other sources is recognised */
#endif

static void log_message(struct instance *instance, int status, const char *message) {
    const fmi2CallbackFunctions *functions = instance->callback;
    char format[2 * MESSAGE_SIZE];
    format_of(message, format, sizeof format);
    if (functions != NULL && functions->logger != NULL) {
        functions->logger(functions->componentEnvironment, instance->name, (fmi2Status)status,
                          status == STATUS_WARNING ? "logStatusWarning" : "logStatusError", format);
    }
}

const char *fmi2GetTypesPlatform(void) {
    return fmi2TypesPlatform;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    struct instance *instance = calloc(1, sizeof *instance);
    (void)visible, (void)logging;
    if (instance == NULL) {
        return NULL;
    }
    instance->log = log_message;
    instance->callback = (void *)functions;
    if (instance_open(instance, name, guid, resources, type == fmi2ModelExchange, 0) != STATUS_OK) {
        instance_close(instance);
        return NULL;
    }
    return instance;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance, fmi2Real start,
                               fmi2Boolean stopDefined, fmi2Real stop) {
    (void)toleranceDefined, (void)tolerance, (void)stopDefined, (void)stop;
    *instance_time(c) = start;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    return (fmi2Status)instance_initialize(c, *instance_time(c));
}

#define GETTER(NAME, TYPE, KIND)                                                                                       \
    fmi2Status NAME(fmi2Component c, const fmi2ValueReference references[], size_t n, TYPE values[]) {                 \
        GET_ALL(TYPE, KIND)                                                                                            \
    }

#define SETTER(NAME, TYPE, KIND)                                                                                       \
    fmi2Status NAME(fmi2Component c, const fmi2ValueReference references[], size_t n, const TYPE values[]) {           \
        SET_ALL(KIND)                                                                                                  \
    }

GETTER(fmi2GetReal, fmi2Real, KIND_REAL)
GETTER(fmi2GetInteger, fmi2Integer, KIND_INTEGER)
GETTER(fmi2GetBoolean, fmi2Boolean, KIND_BOOLEAN)
SETTER(fmi2SetReal, fmi2Real, KIND_REAL)
SETTER(fmi2SetInteger, fmi2Integer, KIND_INTEGER)
SETTER(fmi2SetBoolean, fmi2Boolean, KIND_BOOLEAN)

static fmi2Status absent(struct instance *instance, size_t count, const char *what) {
    return count == 0 ? fmi2OK : (fmi2Status)instance_refuse(instance, STATUS_ERROR, "this FMU has no %s.", what);
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference references[], size_t n, fmi2String values[]) {
    (void)references, (void)values;
    return absent(c, n, "string variables");
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference references[], size_t n, const fmi2String values[]) {
    (void)references, (void)values;
    return absent(c, n, "string variables");
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    return (fmi2Status)instance_state(c, state);
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    return (fmi2Status)instance_restore(c, state);
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    (void)c;
    return (fmi2Status)instance_state_free(state);
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
    (void)state;
    *size = instance_state_size(c);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    return (fmi2Status)instance_state_to_bytes(c, state, (unsigned char *)bytes, size);
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    return (fmi2Status)instance_state_from_bytes(c, (const unsigned char *)bytes, size, state);
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[], size_t nUnknowns,
                                        const fmi2ValueReference knowns[], size_t nKnowns, const fmi2Real seeds[],
                                        fmi2Real derivatives[]) {
    return (fmi2Status)instance_derivatives(c, unknowns, nUnknowns, knowns, nKnowns, seeds, derivatives, 0);
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    info->newDiscreteStatesNeeded = info->terminateSimulation = info->nominalsOfContinuousStatesChanged = fmi2False;
    info->nextEventTimeDefined = fmi2False;
    info->valuesOfContinuousStatesChanged = fmi2True;
    return (fmi2Status)instance_update(c);
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx) {
    return (fmi2Status)instance_rates(c, derivatives, nx);
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference references[], size_t n,
                                       const fmi2Integer orders[], const fmi2Real values[]) {
    (void)references, (void)orders, (void)values;
    return absent(c, n, "derivatives of inputs");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference references[], size_t n,
                                        const fmi2Integer orders[], fmi2Real values[]) {
    (void)references, (void)orders, (void)values;
    return absent(c, n, "derivatives of outputs");
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
    (void)noSetFMUStatePriorToCurrentPoint;
    return (fmi2Status)instance_step(c, time, step);
}

fmi2Status fmi2CancelStep(fmi2Component c) {
    return (fmi2Status)instance_refuse(c, STATUS_ERROR, "no step is under way: they are made at once.");
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value) {
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    if (kind != fmi2LastSuccessfulTime) {
        return fmi2Discard;
    }
    *value = *instance_time(c);
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value) {
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
    (void)c;
    if (kind != fmi2Terminated) {
        return fmi2Discard;
    }
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value) {
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}
