/* FMI 3.0: Model Exchange and Co-Simulation. */
#include <stdlib.h>
#include <string.h>

#if defined(__clang__)
#pragma clang diagnostic ignored "-Wstrict-prototypes" /* of FMI's own header */
#endif
#include "fmi3Functions.h"

#define VERSION fmi3
typedef fmi3Instance fmi3Handle;
typedef fmi3Float64 fmi3Number;
#include "fmi_common.h"

static void log_message(struct instance *instance, int status, const char *message) {
    fmi3LogMessageCallback callback = (fmi3LogMessageCallback)instance->callback3;
    if (callback != NULL) {
        callback(instance->environment, (fmi3Status)status,
                 status == STATUS_WARNING ? "logStatusWarning" : "logStatusError", message);
    }
}

static struct instance *opened(fmi3String name, fmi3String token, fmi3String resources, void *environment,
                               fmi3LogMessageCallback callback, int exchange, int events, int early,
                               const char *refused) {
    struct instance *instance = calloc(1, sizeof *instance);
    int failed;
    if (instance == NULL) {
        return NULL;
    }
    instance->log = log_message;
    instance->environment = environment;
    instance->callback3 = (void (*)(void))callback;
    if (refused != NULL) {
        failed = instance_refuse(instance, STATUS_ERROR, "this FMU is none for %s.", refused);
    } else {
        instance->events = events;
        failed = instance_open(instance, name, token, resources, exchange, early);
    }
    if (failed) {
        instance_close(instance);
        return NULL;
    }
    return instance;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean eventModeUsed, fmi3Boolean earlyReturnAllowed,
                                         const fmi3ValueReference required[], size_t n,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback callback,
                                         fmi3IntermediateUpdateCallback intermediateUpdate) {
    (void)visible, (void)logging, (void)required, (void)n, (void)intermediateUpdate;
    return opened(name, token, resources, environment, callback, 0, eventModeUsed, eventModeUsed && earlyReturnAllowed, NULL);
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback callback) {
    (void)visible, (void)logging;
    return opened(name, token, resources, environment, callback, 1, 1, 0, NULL);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                               fmi3Boolean visible, fmi3Boolean logging,
                                               fmi3InstanceEnvironment environment, fmi3LogMessageCallback callback,
                                               fmi3ClockUpdateCallback clockUpdate, fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock) {
    (void)visible, (void)logging, (void)clockUpdate, (void)lock, (void)unlock;
    return opened(name, token, resources, environment, callback, 0, 0, 0, "Scheduled Execution");
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean toleranceDefined, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean stopDefined, fmi3Float64 stop) {
    (void)toleranceDefined, (void)tolerance, (void)stopDefined, (void)stop;
    return (fmi3Status)instance_initialize(c, start);
}

static int too_few(struct instance *instance) {
    return instance_refuse(instance, STATUS_ERROR, "the number of values is not that of the variables.");
}

#define ACCESS(TYPE, KIND)                                                                                             \
    fmi3Status fmi3Get##TYPE(fmi3Instance c, const fmi3ValueReference references[], size_t n, fmi3##TYPE values[],     \
                             size_t nValues) {                                                                         \
        if (n != nValues) {                                                                                            \
            return (fmi3Status)too_few(c);                                                                             \
        }                                                                                                              \
        GET_ALL(fmi3##TYPE, KIND)                                                                                      \
    }                                                                                                                  \
    fmi3Status fmi3Set##TYPE(fmi3Instance c, const fmi3ValueReference references[], size_t n,                          \
                             const fmi3##TYPE values[], size_t nValues) {                                              \
        if (n != nValues) {                                                                                            \
            return (fmi3Status)too_few(c);                                                                             \
        }                                                                                                              \
        SET_ALL(KIND)                                                                                                  \
    }

ACCESS(Float64, KIND_REAL)
ACCESS(Int32, KIND_INTEGER)
ACCESS(Boolean, KIND_BOOLEAN)

static fmi3Status absent(struct instance *instance, const char *what) {
    return (fmi3Status)instance_refuse(instance, STATUS_ERROR, "this FMU has no %s.", what);
}

#define ABSENT(NAME, PARAMETERS, WHAT)                                                                                 \
    fmi3Status NAME PARAMETERS {                                                                                       \
        return absent(c, WHAT);                                                                                        \
    }
#define ABSENT_TYPE(TYPE)                                                                                              \
    fmi3Status fmi3Get##TYPE(fmi3Instance c, const fmi3ValueReference references[], size_t n, fmi3##TYPE values[],     \
                             size_t nValues) {                                                                         \
        return n == 0 ? fmi3OK : absent(c, #TYPE " variables");                                                        \
    }                                                                                                                  \
    fmi3Status fmi3Set##TYPE(fmi3Instance c, const fmi3ValueReference references[], size_t n,                          \
                             const fmi3##TYPE values[], size_t nValues) {                                              \
        return n == 0 ? fmi3OK : absent(c, #TYPE " variables");                                                        \
    }

#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#elif defined(_MSC_VER)
#pragma warning(disable : 4100)
#endif
ABSENT_TYPE(Float32)
ABSENT_TYPE(Int8)
ABSENT_TYPE(UInt8)
ABSENT_TYPE(Int16)
ABSENT_TYPE(UInt16)
ABSENT_TYPE(UInt32)
ABSENT_TYPE(Int64)
ABSENT_TYPE(UInt64)
ABSENT(fmi3EnterConfigurationMode, (fmi3Instance c), "configuration mode")
ABSENT(fmi3ExitConfigurationMode, (fmi3Instance c), "configuration mode")
ABSENT(fmi3GetIntervalDecimal, (fmi3Instance c, const fmi3ValueReference references[], size_t n, fmi3Float64
       intervals[], fmi3IntervalQualifier qualifiers[]), "clocks")
ABSENT(fmi3GetIntervalFraction, (fmi3Instance c, const fmi3ValueReference references[], size_t n, fmi3UInt64
       counters[], fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[]), "clocks")
ABSENT(fmi3GetShiftDecimal, (fmi3Instance c, const fmi3ValueReference references[], size_t n, fmi3Float64 shifts[]),
       "clocks")
ABSENT(fmi3GetShiftFraction, (fmi3Instance c, const fmi3ValueReference references[], size_t n, fmi3UInt64 counters[],
       fmi3UInt64 resolutions[]), "clocks")
ABSENT(fmi3SetIntervalDecimal, (fmi3Instance c, const fmi3ValueReference references[], size_t n, const fmi3Float64
       intervals[]), "clocks")
ABSENT(fmi3SetIntervalFraction, (fmi3Instance c, const fmi3ValueReference references[], size_t n, const fmi3UInt64
       counters[], const fmi3UInt64 resolutions[]), "clocks")
ABSENT(fmi3SetShiftDecimal, (fmi3Instance c, const fmi3ValueReference references[], size_t n, const fmi3Float64
       shifts[]), "clocks")
ABSENT(fmi3SetShiftFraction, (fmi3Instance c, const fmi3ValueReference references[], size_t n, const fmi3UInt64
       counters[], const fmi3UInt64 resolutions[]), "clocks")
ABSENT(fmi3EvaluateDiscreteStates, (fmi3Instance c), "event mode")
ABSENT(fmi3GetOutputDerivatives, (fmi3Instance c, const fmi3ValueReference references[], size_t n, const fmi3Int32
       orders[], fmi3Float64 values[], size_t nValues), "derivatives")
ABSENT(fmi3ActivateModelPartition, (fmi3Instance c, fmi3ValueReference clockReference, fmi3Float64 activationTime),
       "clocks")
ABSENT(fmi3GetNumberOfVariableDependencies, (fmi3Instance c, fmi3ValueReference valueReference, size_t
       *nDependencies), "changing dependencies")
ABSENT(fmi3GetVariableDependencies, (fmi3Instance c, fmi3ValueReference dependent, size_t elementIndicesOfDependent[],
       fmi3ValueReference independents[], size_t elementIndicesOfIndependents[], fmi3DependencyKind dependencyKinds[],
       size_t nDependencies), "changing dependencies")
ABSENT(fmi3GetString, (fmi3Instance c, const fmi3ValueReference references[], size_t n, fmi3String values[], size_t
       nValues), "string variables")
ABSENT(fmi3SetString, (fmi3Instance c, const fmi3ValueReference references[], size_t n, const fmi3String values[],
       size_t nValues), "string variables")
ABSENT(fmi3GetBinary, (fmi3Instance c, const fmi3ValueReference references[], size_t n, size_t valueSizes[],
       fmi3Binary values[], size_t nValues), "binary variables")
ABSENT(fmi3SetBinary, (fmi3Instance c, const fmi3ValueReference references[], size_t n, const size_t valueSizes[],
       const fmi3Binary values[], size_t nValues), "binary variables")
ABSENT(fmi3GetClock, (fmi3Instance c, const fmi3ValueReference references[], size_t n, fmi3Clock values[]), "clocks")
ABSENT(fmi3SetClock, (fmi3Instance c, const fmi3ValueReference references[], size_t n, const fmi3Clock values[]),
       "clocks")

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *discreteStatesNeedUpdate,
                                    fmi3Boolean *terminateSimulation, fmi3Boolean *nominalsOfContinuousStatesChanged,
                                    fmi3Boolean *valuesOfContinuousStatesChanged, fmi3Boolean *nextEventTimeDefined,
                                    fmi3Float64 *nextEventTime) {
    *discreteStatesNeedUpdate = *terminateSimulation = *nominalsOfContinuousStatesChanged = fmi3False;
    *nextEventTimeDefined = fmi3False;
    *nextEventTime = 0.0;
    *valuesOfContinuousStatesChanged = instance_exchanges(c) != 0;
    return (fmi3Status)instance_update(c);
}

fmi3Status fmi3EnterStepMode(fmi3Instance c) {
    return (fmi3Status)instance_enter(c, STEPPING);
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 derivatives[], size_t nContinuousStates) {
    return (fmi3Status)instance_rates(c, derivatives, nContinuousStates);
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *nEventIndicators) {
    *nEventIndicators = instance_exchanges(c) ? EVENT_INDICATORS : 0;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *nContinuousStates) {
    *nContinuousStates = instance_state_count(c);
    return fmi3OK;
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknowns[], size_t nUnknowns,
                                        const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[],
                                        size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity) {
    if (nSeed != nKnowns || nSensitivity != nUnknowns) {
        return (fmi3Status)too_few(c);
    }
    return (fmi3Status)instance_derivatives(c, unknowns, nUnknowns, knowns, nKnowns, seed, sensitivity, 0);
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference unknowns[], size_t nUnknowns,
                                    const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[],
                                    size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity) {
    if (nSeed != nUnknowns || nSensitivity != nKnowns) {
        return (fmi3Status)too_few(c);
    }
    return (fmi3Status)instance_derivatives(c, unknowns, nUnknowns, knowns, nKnowns, seed, sensitivity, 1);
}

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) {
    return (fmi3Status)instance_state(c, state);
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) {
    return (fmi3Status)instance_restore(c, state);
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) {
    return (fmi3Status)instance_state_free(state);
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) {
    *size = instance_state_size(c);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
    return (fmi3Status)instance_state_to_bytes(c, state, bytes, size);
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
    return (fmi3Status)instance_state_from_bytes(c, bytes, size, state);
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 step, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                      fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn,
                      fmi3Float64 *lastSuccessfulTime) {
    int status = instance_step(c, time, step);
    *earlyReturn = instance_early(c) != 0;
    *eventHandlingNeeded = instance_event(c) != 0;
    *terminateSimulation = fmi3False;
    *lastSuccessfulTime = *instance_time(c);
    return (fmi3Status)status;
}
