/* The co-simulation interface of FMI 2.0 of a twin, which stands above this text with TOKEN. */

#include <stdlib.h>
#include "fmi2Functions.h"

typedef struct {
    Twin twin;
    fmi2CallbackFunctions callbacks;
    char name[256];
} Instance;

static fmi2Status refused(Instance *of, const char *message)
{
    if (of->callbacks.logger)
        of->callbacks.logger(of->callbacks.componentEnvironment, of->name, fmi2Error, "logStatusError",
                             "%s", message);
    return fmi2Error;
}

/* A message at the first sample that is outside the range of training. */
static void warn(Instance *of)
{
    if (of->twin.outside && !of->twin.warned++ && of->callbacks.logger)
        of->callbacks.logger(of->callbacks.componentEnvironment, of->name, fmi2Warning,
                             "logStatusWarning", "%s", LEFT);
}

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String names[])
{
    (void)c, (void)on, (void)n, (void)names;
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
                              fmi2Boolean on)
{
    (void)resources, (void)visible, (void)on;
    if (type != fmi2CoSimulation || !guid || strcmp(guid, TOKEN) != 0)
        return NULL;
    Instance *made = calloc(1, sizeof *made);
    if (!made)
        return NULL;
    if (callbacks)
        made->callbacks = *callbacks;
    if (name)
        strncpy(made->name, name, sizeof made->name - 1);
    reset(&made->twin);
    return made;
}

void fmi2FreeInstance(fmi2Component c)
{
    free(c);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance, fmi2Real value, fmi2Real start,
                               fmi2Boolean stops, fmi2Real stop)
{
    (void)tolerance, (void)value, (void)stops, (void)stop;
    Twin *twin = &((Instance *)c)->twin;
    twin->begin = twin->v[0] = start;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    begin(&((Instance *)c)->twin);
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    reset(&((Instance *)c)->twin);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[])
{
    Twin *twin = &((Instance *)c)->twin;
    if (!twin->begun)
        begin(twin), twin->begun = 0;
    evaluate(twin);
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= NV)
            return refused(c, "fmi2GetReal: unknown value reference");
        value[i] = twin->v[vr[i]];
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                       const fmi2Real value[])
{
    Twin *twin = &((Instance *)c)->twin;
    for (size_t i = 0; i < n; i++) {
        if (!settable(twin, vr[i]))
            return refused(c, "fmi2SetReal: this variable cannot be set now");
        if (!isfinite(value[i]))
            return refused(c, "fmi2SetReal: a value that is not finite");
        twin->v[vr[i]] = value[i];
    }
    twin->ready = 0;
    return fmi2OK;
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          fmi2Integer value[])
{
    for (size_t i = 0; i < n; i++) {
        if (vr[i] != SEED)
            return refused(c, "fmi2GetInteger: unknown value reference");
        value[i] = ((Instance *)c)->twin.seed;
    }
    return fmi2OK;
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          const fmi2Integer value[])
{
    Twin *twin = &((Instance *)c)->twin;
    for (size_t i = 0; i < n; i++) {
        if (vr[i] != SEED || twin->begun)
            return refused(c, "fmi2SetInteger: only the seed can be set, before the begin");
        twin->seed = value[i];
    }
    return fmi2OK;
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          fmi2Boolean value[])
{
    for (size_t i = 0; i < n; i++) {
        int found = flag(&((Instance *)c)->twin, vr[i]);
        if (found < 0)
            return refused(c, "fmi2GetBoolean: unknown value reference");
        value[i] = found ? fmi2True : fmi2False;
    }
    return fmi2OK;
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          const fmi2Boolean value[])
{
    Twin *twin = &((Instance *)c)->twin;
    for (size_t i = 0; i < n; i++) {
        if (vr[i] != NOISY)
            return refused(c, "fmi2SetBoolean: this variable cannot be set");
        twin->noisy = value[i] != fmi2False;
    }
    twin->ready = 0;
    return fmi2OK;
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2String value[])
{
    (void)vr, (void)value;
    return n ? refused(c, "fmi2GetString: there are no strings") : fmi2OK;
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                         const fmi2String value[])
{
    (void)vr, (void)value;
    return n ? refused(c, "fmi2SetString: there are no strings") : fmi2OK;
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    if (!*state && !(*state = malloc(sizeof(Twin))))
        return refused(c, "fmi2GetFMUstate: no memory");
    memcpy(*state, &((Instance *)c)->twin, sizeof(Twin));
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    if (!state)
        return refused(c, "fmi2SetFMUstate: no state");
    memcpy(&((Instance *)c)->twin, state, sizeof(Twin));
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    (void)c, (void)state;
    *size = sizeof(Twin);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    if (size < sizeof(Twin))
        return refused(c, "fmi2SerializeFMUstate: too few bytes");
    memcpy(bytes, state, sizeof(Twin));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *state)
{
    if (size != sizeof(Twin))
        return refused(c, "fmi2DeSerializeFMUstate: a state of another model");
    if (!*state && !(*state = malloc(sizeof(Twin))))
        return refused(c, "fmi2DeSerializeFMUstate: no memory");
    memcpy(*state, bytes, sizeof(Twin));
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t n,
                                        const fmi2ValueReference known[], size_t m,
                                        const fmi2Real by[], fmi2Real value[])
{
    (void)unknown, (void)n, (void)known, (void)m, (void)by, (void)value;
    return refused(c, "fmi2GetDirectionalDerivative: not provided");
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                       const fmi2Integer order[], const fmi2Real value[])
{
    (void)vr, (void)order, (void)value;
    return n ? refused(c, "fmi2SetRealInputDerivatives: not provided") : fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                        const fmi2Integer order[], fmi2Real value[])
{
    (void)vr, (void)order, (void)value;
    return n ? refused(c, "fmi2GetRealOutputDerivatives: not provided") : fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean no_set)
{
    (void)no_set;
    if (!(step > 0.0))
        return refused(c, "fmi2DoStep: a step that is not positive");
    if (!advance_to(&((Instance *)c)->twin, time + step))
        return refused(c, "fmi2DoStep: the states do not stay finite");
    warn(c);
    return fmi2OK;
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    return refused(c, "fmi2CancelStep: no step is running");
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    if (kind != fmi2LastSuccessfulTime)
        return fmi2Discard;
    *value = ((Instance *)c)->twin.v[0];
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    if (kind != fmi2Terminated)
        return fmi2Discard;
    (void)c;
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}
