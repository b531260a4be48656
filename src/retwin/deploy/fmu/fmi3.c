/* The co-simulation interface of FMI 3.0 of a twin, which stands above this text with TOKEN. */

#include <stdio.h>

typedef struct {
    Twin twin;
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
} Instance;

/* The status of a function, with a message where something is wrong. */
static fmi3Status answer(Instance *of, const char *function, const char *wrong)
{
    char message[256];
    if (wrong && of && of->log) {
        snprintf(message, sizeof message, "%s: %s", function, wrong);
        of->log(of->environment, fmi3Error, "logStatusError", message);
    }
    return wrong ? fmi3Error : fmi3OK;
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

/* Functions that read or write the values of a type. */
#define ACCESS(NAME, VALUES, FUNCTION)                                                              \
    fmi3Status fmi3##NAME(fmi3Instance c, const fmi3ValueReference vr[], size_t n, VALUES value[],  \
                          size_t m)                                                                \
    {                                                                                              \
        if (m != n)                                                                                \
            return answer(c, __func__, "one value for each reference is expected");                \
        return answer(c, __func__, FUNCTION(&((Instance *)c)->twin, vr, n, value));                \
    }

ACCESS(GetFloat64, fmi3Float64, get_reals)
ACCESS(SetFloat64, const fmi3Float64, set_reals)
ACCESS(GetInt32, fmi3Int32, get_integers)
ACCESS(SetInt32, const fmi3Int32, set_integers)
ACCESS(GetBoolean, fmi3Boolean, get_booleans)
ACCESS(SetBoolean, const fmi3Boolean, set_booleans)

/* Types of which there are no variables. */
static const char *none(Twin *twin, const uint32_t vr[], size_t n, const void *value)
{
    (void)twin, (void)vr, (void)value;
    return n ? "there are no such variables" : NULL;
}

#define ABSENT(KIND)                                                                                \
    ACCESS(Get##KIND, fmi3##KIND, none)                                                            \
    ACCESS(Set##KIND, const fmi3##KIND, none)

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
    return answer(c, __func__, copy(&((Instance *)c)->twin, state));
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state)
{
    if (!state)
        return answer(c, __func__, "no state");
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
    void *to = bytes;
    return answer(c, __func__, size < sizeof(Twin) ? "too few bytes" : copy(state, &to));
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size,
                                   fmi3FMUState *state)
{
    return answer(c, __func__, size != sizeof(Twin) ? "a state of another model" : copy(bytes, state));
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_set,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early,
                      fmi3Float64 *last)
{
    Instance *of = c;
    const char *wrong = step_to(&of->twin, time, step);
    (void)no_set;
    *event = *terminate = *early = false;
    *last = wrong ? time : time + step;
    if (!wrong && of->twin.outside && !of->twin.warned++ && of->log)
        of->log(of->environment, fmi3Warning, "logStatusWarning", LEFT);
    return answer(c, __func__, wrong);
}

/* What a model without events, clocks and continuous states does not have; the parameters are those
   of the standard, in its order. */
#define MISSING(NAME, PARAMETERS, ...)                                                              \
    fmi3Status fmi3##NAME PARAMETERS                                                               \
    {                                                                                              \
        __VA_ARGS__;                                                                               \
        return answer(c, __func__, "not provided");                                                \
    }

MISSING(EnterEventMode, (fmi3Instance c), (void)0)
MISSING(GetBinary, (fmi3Instance c, const fmi3ValueReference a[], size_t b, size_t d[],
        fmi3Binary e[], size_t f), (void)a, (void)b, (void)d, (void)e, (void)f)
MISSING(GetClock, (fmi3Instance c, const fmi3ValueReference a[], size_t b, fmi3Clock d[]), (void)a,
        (void)b, (void)d)
MISSING(SetBinary, (fmi3Instance c, const fmi3ValueReference a[], size_t b, const size_t d[],
        const fmi3Binary e[], size_t f), (void)a, (void)b, (void)d, (void)e, (void)f)
MISSING(SetClock, (fmi3Instance c, const fmi3ValueReference a[], size_t b, const fmi3Clock d[]),
        (void)a, (void)b, (void)d)
MISSING(GetNumberOfVariableDependencies, (fmi3Instance c, fmi3ValueReference a, size_t *b), (void)a,
        (void)b)
MISSING(GetVariableDependencies, (fmi3Instance c, fmi3ValueReference a, size_t b[],
        fmi3ValueReference d[], size_t e[], fmi3DependencyKind f[], size_t g), (void)a, (void)b,
        (void)d, (void)e, (void)f, (void)g)
MISSING(GetDirectionalDerivative, (fmi3Instance c, const fmi3ValueReference a[], size_t b,
        const fmi3ValueReference d[], size_t e, const fmi3Float64 f[], size_t g, fmi3Float64 h[],
        size_t i), (void)a, (void)b, (void)d, (void)e, (void)f, (void)g, (void)h, (void)i)
MISSING(GetAdjointDerivative, (fmi3Instance c, const fmi3ValueReference a[], size_t b,
        const fmi3ValueReference d[], size_t e, const fmi3Float64 f[], size_t g, fmi3Float64 h[],
        size_t i), (void)a, (void)b, (void)d, (void)e, (void)f, (void)g, (void)h, (void)i)
MISSING(EnterConfigurationMode, (fmi3Instance c), (void)0)
MISSING(ExitConfigurationMode, (fmi3Instance c), (void)0)
MISSING(GetIntervalDecimal, (fmi3Instance c, const fmi3ValueReference a[], size_t b,
        fmi3Float64 d[], fmi3IntervalQualifier e[]), (void)a, (void)b, (void)d, (void)e)
MISSING(GetIntervalFraction, (fmi3Instance c, const fmi3ValueReference a[], size_t b,
        fmi3UInt64 d[], fmi3UInt64 e[], fmi3IntervalQualifier f[]), (void)a, (void)b, (void)d,
        (void)e, (void)f)
MISSING(GetShiftDecimal, (fmi3Instance c, const fmi3ValueReference a[], size_t b, fmi3Float64 d[]),
        (void)a, (void)b, (void)d)
MISSING(GetShiftFraction, (fmi3Instance c, const fmi3ValueReference a[], size_t b, fmi3UInt64 d[],
        fmi3UInt64 e[]), (void)a, (void)b, (void)d, (void)e)
MISSING(SetIntervalDecimal, (fmi3Instance c, const fmi3ValueReference a[], size_t b,
        const fmi3Float64 d[]), (void)a, (void)b, (void)d)
MISSING(SetIntervalFraction, (fmi3Instance c, const fmi3ValueReference a[], size_t b,
        const fmi3UInt64 d[], const fmi3UInt64 e[]), (void)a, (void)b, (void)d, (void)e)
MISSING(SetShiftDecimal, (fmi3Instance c, const fmi3ValueReference a[], size_t b,
        const fmi3Float64 d[]), (void)a, (void)b, (void)d)
MISSING(SetShiftFraction, (fmi3Instance c, const fmi3ValueReference a[], size_t b,
        const fmi3UInt64 d[], const fmi3UInt64 e[]), (void)a, (void)b, (void)d, (void)e)
MISSING(EvaluateDiscreteStates, (fmi3Instance c), (void)0)
MISSING(UpdateDiscreteStates, (fmi3Instance c, fmi3Boolean *a, fmi3Boolean *b, fmi3Boolean *d,
        fmi3Boolean *e, fmi3Boolean *f, fmi3Float64 *g), (void)a, (void)b, (void)d, (void)e,
        (void)f, (void)g)
MISSING(EnterContinuousTimeMode, (fmi3Instance c), (void)0)
MISSING(CompletedIntegratorStep, (fmi3Instance c, fmi3Boolean a, fmi3Boolean *b, fmi3Boolean *d),
        (void)a, (void)b, (void)d)
MISSING(SetTime, (fmi3Instance c, fmi3Float64 a), (void)a)
MISSING(SetContinuousStates, (fmi3Instance c, const fmi3Float64 a[], size_t b), (void)a, (void)b)
MISSING(GetContinuousStateDerivatives, (fmi3Instance c, fmi3Float64 a[], size_t b), (void)a,
        (void)b)
MISSING(GetEventIndicators, (fmi3Instance c, fmi3Float64 a[], size_t b), (void)a, (void)b)
MISSING(GetContinuousStates, (fmi3Instance c, fmi3Float64 a[], size_t b), (void)a, (void)b)
MISSING(GetNominalsOfContinuousStates, (fmi3Instance c, fmi3Float64 a[], size_t b), (void)a,
        (void)b)
MISSING(GetNumberOfEventIndicators, (fmi3Instance c, size_t *a), (void)a)
MISSING(GetNumberOfContinuousStates, (fmi3Instance c, size_t *a), (void)a)
MISSING(EnterStepMode, (fmi3Instance c), (void)0)
MISSING(GetOutputDerivatives, (fmi3Instance c, const fmi3ValueReference a[], size_t b,
        const fmi3Int32 d[], fmi3Float64 e[], size_t f), (void)a, (void)b, (void)d, (void)e,
        (void)f)
MISSING(ActivateModelPartition, (fmi3Instance c, fmi3ValueReference a, fmi3Float64 b), (void)a,
        (void)b)
