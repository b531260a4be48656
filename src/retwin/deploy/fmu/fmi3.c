/* The co-simulation interface of FMI 3.0 of a twin, which stands above this text with TOKEN. */

#include <stdlib.h>
#include "fmi3Functions.h"

typedef struct {
    Twin twin;
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
} Instance;

static fmi3Status refused(Instance *of, const char *message)
{
    if (of && of->log)
        of->log(of->environment, fmi3Error, "logStatusError", message);
    return fmi3Error;
}

/* A message at the first sample that is outside the range of training. */
static void warn(Instance *of)
{
    if (of->twin.outside && !of->twin.warned++ && of->log)
        of->log(of->environment, fmi3Warning, "logStatusWarning", LEFT);
}

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String names[])
{
    (void)c, (void)on, (void)n, (void)names;
    return fmi3OK;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean on,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)on, (void)environment, (void)log;
    return NULL;
}

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean on,
    fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference required[], size_t n,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
    fmi3IntermediateUpdateCallback update)
{
    (void)name, (void)resources, (void)visible, (void)on, (void)events, (void)early, (void)required;
    (void)n, (void)update;
    if (!token || strcmp(token, TOKEN) != 0)
        return NULL;
    Instance *made = calloc(1, sizeof *made);
    if (!made)
        return NULL;
    made->log = log;
    made->environment = environment;
    reset(&made->twin);
    return made;
}

fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean on,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3ClockUpdateCallback update,
    fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)on, (void)environment, (void)log;
    (void)update, (void)lock, (void)unlock;
    return NULL;
}

void fmi3FreeInstance(fmi3Instance c)
{
    free(c);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean tolerance, fmi3Float64 value,
                                       fmi3Float64 start, fmi3Boolean stops, fmi3Float64 stop)
{
    (void)tolerance, (void)value, (void)stops, (void)stop;
    Twin *twin = &((Instance *)c)->twin;
    twin->begin = twin->v[0] = start;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    begin(&((Instance *)c)->twin);
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance c)
{
    reset(&((Instance *)c)->twin);
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance c)
{
    (void)c;
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                          fmi3Float64 value[], size_t m)
{
    Twin *twin = &((Instance *)c)->twin;
    if (m != n)
        return refused(c, "fmi3GetFloat64: one value for each reference is expected");
    if (!twin->begun)
        begin(twin), twin->begun = 0;
    evaluate(twin);
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= NV)
            return refused(c, "fmi3GetFloat64: unknown value reference");
        value[i] = twin->v[vr[i]];
    }
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                          const fmi3Float64 value[], size_t m)
{
    Twin *twin = &((Instance *)c)->twin;
    if (m != n)
        return refused(c, "fmi3SetFloat64: one value for each reference is expected");
    for (size_t i = 0; i < n; i++) {
        if (!settable(twin, vr[i]))
            return refused(c, "fmi3SetFloat64: this variable cannot be set now");
        if (!isfinite(value[i]))
            return refused(c, "fmi3SetFloat64: a value that is not finite");
        twin->v[vr[i]] = value[i];
    }
    twin->ready = 0;
    return fmi3OK;
}

fmi3Status fmi3GetInt32(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Int32 value[],
                        size_t m)
{
    for (size_t i = 0; i < n; i++) {
        if (vr[i] != SEED || m != n)
            return refused(c, "fmi3GetInt32: unknown value reference");
        value[i] = ((Instance *)c)->twin.seed;
    }
    return fmi3OK;
}

fmi3Status fmi3SetInt32(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                        const fmi3Int32 value[], size_t m)
{
    Twin *twin = &((Instance *)c)->twin;
    for (size_t i = 0; i < n; i++) {
        if (vr[i] != SEED || m != n || twin->begun)
            return refused(c, "fmi3SetInt32: only the seed can be set, before the begin");
        twin->seed = value[i];
    }
    return fmi3OK;
}

fmi3Status fmi3GetBoolean(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                          fmi3Boolean value[], size_t m)
{
    for (size_t i = 0; i < n; i++) {
        int found = flag(&((Instance *)c)->twin, vr[i]);
        if (found < 0 || m != n)
            return refused(c, "fmi3GetBoolean: unknown value reference");
        value[i] = found != 0;
    }
    return fmi3OK;
}

fmi3Status fmi3SetBoolean(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                          const fmi3Boolean value[], size_t m)
{
    Twin *twin = &((Instance *)c)->twin;
    for (size_t i = 0; i < n; i++) {
        if (vr[i] != NOISY || m != n)
            return refused(c, "fmi3SetBoolean: this variable cannot be set");
        twin->noisy = value[i] ? 1 : 0;
    }
    twin->ready = 0;
    return fmi3OK;
}

/* Types of which there are no variables. */
#define ABSENT(KIND)                                                                                \
    fmi3Status fmi3Get##KIND(fmi3Instance c, const fmi3ValueReference vr[], size_t n,              \
                             fmi3##KIND value[], size_t m)                                         \
    {                                                                                              \
        (void)vr, (void)value, (void)m;                                                            \
        return n ? refused(c, "fmi3Get" #KIND ": there are no such variables") : fmi3OK;           \
    }                                                                                              \
    fmi3Status fmi3Set##KIND(fmi3Instance c, const fmi3ValueReference vr[], size_t n,              \
                             const fmi3##KIND value[], size_t m)                                   \
    {                                                                                              \
        (void)vr, (void)value, (void)m;                                                            \
        return n ? refused(c, "fmi3Set" #KIND ": there are no such variables") : fmi3OK;           \
    }

ABSENT(Float32)
ABSENT(Int8)
ABSENT(UInt8)
ABSENT(Int16)
ABSENT(UInt16)
ABSENT(UInt32)
ABSENT(Int64)
ABSENT(UInt64)
ABSENT(String)

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state)
{
    if (!*state && !(*state = malloc(sizeof(Twin))))
        return refused(c, "fmi3GetFMUState: no memory");
    memcpy(*state, &((Instance *)c)->twin, sizeof(Twin));
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state)
{
    if (!state)
        return refused(c, "fmi3SetFMUState: no state");
    memcpy(&((Instance *)c)->twin, state, sizeof(Twin));
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size)
{
    (void)c, (void)state;
    *size = sizeof(Twin);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    if (size < sizeof(Twin))
        return refused(c, "fmi3SerializeFMUState: too few bytes");
    memcpy(bytes, state, sizeof(Twin));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size,
                                   fmi3FMUState *state)
{
    if (size != sizeof(Twin))
        return refused(c, "fmi3DeserializeFMUState: a state of another model");
    if (!*state && !(*state = malloc(sizeof(Twin))))
        return refused(c, "fmi3DeserializeFMUState: no memory");
    memcpy(*state, bytes, sizeof(Twin));
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_set,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early,
                      fmi3Float64 *last)
{
    (void)no_set;
    *event = *terminate = *early = false;
    *last = time;
    if (!(step > 0.0))
        return refused(c, "fmi3DoStep: a step that is not positive");
    if (!advance_to(&((Instance *)c)->twin, time + step))
        return refused(c, "fmi3DoStep: the states do not stay finite");
    warn(c);
    *last = time + step;
    return fmi3OK;
}

/* What a model without events, clocks and continuous states does not have. */

fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    return refused(c, "fmi3EnterEventMode: not provided");
}

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, size_t valueSizes[], fmi3Binary values[],
                         size_t nValues)
{
    (void)valueReferences, (void)nValueReferences, (void)valueSizes, (void)values, (void)nValues;
    return refused(c, "fmi3GetBinary: not provided");
}

fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, fmi3Clock values[])
{
    (void)valueReferences, (void)nValueReferences, (void)values;
    return refused(c, "fmi3GetClock: not provided");
}

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, const size_t valueSizes[],
                         const fmi3Binary values[], size_t nValues)
{
    (void)valueReferences, (void)nValueReferences, (void)valueSizes, (void)values, (void)nValues;
    return refused(c, "fmi3SetBinary: not provided");
}

fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, const fmi3Clock values[])
{
    (void)valueReferences, (void)nValueReferences, (void)values;
    return refused(c, "fmi3SetClock: not provided");
}

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference valueReference,
                                               size_t* nDependencies)
{
    (void)valueReference, (void)nDependencies;
    return refused(c, "fmi3GetNumberOfVariableDependencies: not provided");
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference dependent,
                                       size_t elementIndicesOfDependent[],
                                       fmi3ValueReference independents[],
                                       size_t elementIndicesOfIndependents[],
                                       fmi3DependencyKind dependencyKinds[],
                                       size_t nDependencies)
{
    (void)dependent, (void)elementIndicesOfDependent, (void)independents;
    (void)elementIndicesOfIndependents, (void)dependencyKinds, (void)nDependencies;
    return refused(c, "fmi3GetVariableDependencies: not provided");
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknowns[],
                                        size_t nUnknowns, const fmi3ValueReference knowns[],
                                        size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
                                        fmi3Float64 sensitivity[], size_t nSensitivity)
{
    (void)unknowns, (void)nUnknowns, (void)knowns, (void)nKnowns, (void)seed, (void)nSeed;
    (void)sensitivity, (void)nSensitivity;
    return refused(c, "fmi3GetDirectionalDerivative: not provided");
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference unknowns[],
                                    size_t nUnknowns, const fmi3ValueReference knowns[],
                                    size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
                                    fmi3Float64 sensitivity[], size_t nSensitivity)
{
    (void)unknowns, (void)nUnknowns, (void)knowns, (void)nKnowns, (void)seed, (void)nSeed;
    (void)sensitivity, (void)nSensitivity;
    return refused(c, "fmi3GetAdjointDerivative: not provided");
}

fmi3Status fmi3EnterConfigurationMode(fmi3Instance c)
{
    return refused(c, "fmi3EnterConfigurationMode: not provided");
}

fmi3Status fmi3ExitConfigurationMode(fmi3Instance c)
{
    return refused(c, "fmi3ExitConfigurationMode: not provided");
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, const fmi3ValueReference valueReferences[],
                                  size_t nValueReferences, fmi3Float64 intervals[],
                                  fmi3IntervalQualifier qualifiers[])
{
    (void)valueReferences, (void)nValueReferences, (void)intervals, (void)qualifiers;
    return refused(c, "fmi3GetIntervalDecimal: not provided");
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance c, const fmi3ValueReference valueReferences[],
                                   size_t nValueReferences, fmi3UInt64 counters[],
                                   fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[])
{
    (void)valueReferences, (void)nValueReferences, (void)counters, (void)resolutions;
    (void)qualifiers;
    return refused(c, "fmi3GetIntervalFraction: not provided");
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance c, const fmi3ValueReference valueReferences[],
                               size_t nValueReferences, fmi3Float64 shifts[])
{
    (void)valueReferences, (void)nValueReferences, (void)shifts;
    return refused(c, "fmi3GetShiftDecimal: not provided");
}

fmi3Status fmi3GetShiftFraction(fmi3Instance c, const fmi3ValueReference valueReferences[],
                                size_t nValueReferences, fmi3UInt64 counters[],
                                fmi3UInt64 resolutions[])
{
    (void)valueReferences, (void)nValueReferences, (void)counters, (void)resolutions;
    return refused(c, "fmi3GetShiftFraction: not provided");
}

fmi3Status fmi3SetIntervalDecimal(fmi3Instance c, const fmi3ValueReference valueReferences[],
                                  size_t nValueReferences, const fmi3Float64 intervals[])
{
    (void)valueReferences, (void)nValueReferences, (void)intervals;
    return refused(c, "fmi3SetIntervalDecimal: not provided");
}

fmi3Status fmi3SetIntervalFraction(fmi3Instance c, const fmi3ValueReference valueReferences[],
                                   size_t nValueReferences, const fmi3UInt64 counters[],
                                   const fmi3UInt64 resolutions[])
{
    (void)valueReferences, (void)nValueReferences, (void)counters, (void)resolutions;
    return refused(c, "fmi3SetIntervalFraction: not provided");
}

fmi3Status fmi3SetShiftDecimal(fmi3Instance c, const fmi3ValueReference valueReferences[],
                               size_t nValueReferences, const fmi3Float64 shifts[])
{
    (void)valueReferences, (void)nValueReferences, (void)shifts;
    return refused(c, "fmi3SetShiftDecimal: not provided");
}

fmi3Status fmi3SetShiftFraction(fmi3Instance c, const fmi3ValueReference valueReferences[],
                                size_t nValueReferences, const fmi3UInt64 counters[],
                                const fmi3UInt64 resolutions[])
{
    (void)valueReferences, (void)nValueReferences, (void)counters, (void)resolutions;
    return refused(c, "fmi3SetShiftFraction: not provided");
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c)
{
    return refused(c, "fmi3EvaluateDiscreteStates: not provided");
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean* discreteStatesNeedUpdate,
                                    fmi3Boolean* terminateSimulation,
                                    fmi3Boolean* nominalsOfContinuousStatesChanged,
                                    fmi3Boolean* valuesOfContinuousStatesChanged,
                                    fmi3Boolean* nextEventTimeDefined,
                                    fmi3Float64* nextEventTime)
{
    (void)discreteStatesNeedUpdate, (void)terminateSimulation;
    (void)nominalsOfContinuousStatesChanged, (void)valuesOfContinuousStatesChanged;
    (void)nextEventTimeDefined, (void)nextEventTime;
    return refused(c, "fmi3UpdateDiscreteStates: not provided");
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c)
{
    return refused(c, "fmi3EnterContinuousTimeMode: not provided");
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c,
                                       fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi3Boolean* enterEventMode,
                                       fmi3Boolean* terminateSimulation)
{
    (void)noSetFMUStatePriorToCurrentPoint, (void)enterEventMode, (void)terminateSimulation;
    return refused(c, "fmi3CompletedIntegratorStep: not provided");
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time)
{
    (void)time;
    return refused(c, "fmi3SetTime: not provided");
}

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 continuousStates[],
                                   size_t nContinuousStates)
{
    (void)continuousStates, (void)nContinuousStates;
    return refused(c, "fmi3SetContinuousStates: not provided");
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 derivatives[],
                                             size_t nContinuousStates)
{
    (void)derivatives, (void)nContinuousStates;
    return refused(c, "fmi3GetContinuousStateDerivatives: not provided");
}

fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 eventIndicators[],
                                  size_t nEventIndicators)
{
    (void)eventIndicators, (void)nEventIndicators;
    return refused(c, "fmi3GetEventIndicators: not provided");
}

fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 continuousStates[],
                                   size_t nContinuousStates)
{
    (void)continuousStates, (void)nContinuousStates;
    return refused(c, "fmi3GetContinuousStates: not provided");
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominals[],
                                             size_t nContinuousStates)
{
    (void)nominals, (void)nContinuousStates;
    return refused(c, "fmi3GetNominalsOfContinuousStates: not provided");
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t* nEventIndicators)
{
    (void)nEventIndicators;
    return refused(c, "fmi3GetNumberOfEventIndicators: not provided");
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t* nContinuousStates)
{
    (void)nContinuousStates;
    return refused(c, "fmi3GetNumberOfContinuousStates: not provided");
}

fmi3Status fmi3EnterStepMode(fmi3Instance c)
{
    return refused(c, "fmi3EnterStepMode: not provided");
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference valueReferences[],
                                    size_t nValueReferences, const fmi3Int32 orders[],
                                    fmi3Float64 values[], size_t nValues)
{
    (void)valueReferences, (void)nValueReferences, (void)orders, (void)values, (void)nValues;
    return refused(c, "fmi3GetOutputDerivatives: not provided");
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference clockReference,
                                      fmi3Float64 activationTime)
{
    (void)clockReference, (void)activationTime;
    return refused(c, "fmi3ActivateModelPartition: not provided");
}
