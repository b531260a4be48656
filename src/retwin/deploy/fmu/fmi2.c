/* The co-simulation interface of FMI 2.0 of a twin, which stands above this text with TOKEN. */

typedef struct {
    Twin twin;
    fmi2CallbackFunctions callbacks;
    char name[256];
} Instance;

/* The status of a function, with a message where something is wrong. */
static fmi2Status answer(Instance *of, const char *function, const char *wrong)
{
    if (wrong && of->callbacks.logger)
        of->callbacks.logger(of->callbacks.componentEnvironment, of->name, fmi2Error, "logStatusError",
                             "%s: %s", function, wrong);
    return wrong ? fmi2Error : fmi2OK;
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

/* Functions that read or write the values of a type. */
#define ACCESS(NAME, VALUES, FUNCTION)                                                              \
    fmi2Status fmi2##NAME(fmi2Component c, const fmi2ValueReference vr[], size_t n, VALUES value[]) \
    {                                                                                              \
        return answer(c, __func__, FUNCTION(&((Instance *)c)->twin, vr, n, value));                \
    }

ACCESS(GetReal, fmi2Real, get_reals)
ACCESS(SetReal, const fmi2Real, set_reals)
ACCESS(GetInteger, fmi2Integer, get_integers)
ACCESS(SetInteger, const fmi2Integer, set_integers)
ACCESS(GetBoolean, fmi2Boolean, get_booleans)
ACCESS(SetBoolean, const fmi2Boolean, set_booleans)

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    return answer(c, __func__, copy(&((Instance *)c)->twin, state));
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    if (!state)
        return answer(c, __func__, "no state");
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
    void *to = bytes;
    return answer(c, __func__, size < sizeof(Twin) ? "too few bytes" : copy(state, &to));
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *state)
{
    return answer(c, __func__, size != sizeof(Twin) ? "a state of another model" : copy(bytes, state));
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean no_set)
{
    Instance *of = c;
    const char *wrong = step_to(&of->twin, time, step);
    (void)no_set;
    if (!wrong && of->twin.outside && !of->twin.warned++ && of->callbacks.logger)
        of->callbacks.logger(of->callbacks.componentEnvironment, of->name, fmi2Warning,
                             "logStatusWarning", "%s", LEFT);
    return answer(c, __func__, wrong);
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    return answer(c, __func__, "no step is running");
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    if (kind != fmi2LastSuccessfulTime)
        return fmi2Discard;
    *value = ((Instance *)c)->twin.v[0];
    return fmi2OK;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    (void)c;
    if (kind != fmi2Terminated)
        return fmi2Discard;
    *value = fmi2False;
    return fmi2OK;
}

/* What a model without strings and derivatives does not have; the parameters are those of the
   standard, in its order. */
#define MISSING(NAME, PARAMETERS, RESULT, ...)                                                      \
    fmi2Status fmi2##NAME PARAMETERS                                                               \
    {                                                                                              \
        (void)c, __VA_ARGS__;                                                                      \
        return RESULT;                                                                             \
    }
#define NOT_PROVIDED answer(c, __func__, "not provided")

MISSING(GetString, (fmi2Component c, const fmi2ValueReference a[], size_t b, fmi2String d[]),
        b ? NOT_PROVIDED : fmi2OK, (void)a, (void)d)
MISSING(SetString, (fmi2Component c, const fmi2ValueReference a[], size_t b, const fmi2String d[]),
        b ? NOT_PROVIDED : fmi2OK, (void)a, (void)d)
MISSING(GetDirectionalDerivative, (fmi2Component c, const fmi2ValueReference a[], size_t b,
        const fmi2ValueReference d[], size_t e, const fmi2Real f[], fmi2Real g[]), NOT_PROVIDED,
        (void)a, (void)b, (void)d, (void)e, (void)f, (void)g)
MISSING(SetRealInputDerivatives, (fmi2Component c, const fmi2ValueReference a[], size_t b,
        const fmi2Integer d[], const fmi2Real e[]), b ? NOT_PROVIDED : fmi2OK, (void)a, (void)d,
        (void)e)
MISSING(GetRealOutputDerivatives, (fmi2Component c, const fmi2ValueReference a[], size_t b,
        const fmi2Integer d[], fmi2Real e[]), b ? NOT_PROVIDED : fmi2OK, (void)a, (void)d, (void)e)
MISSING(GetStatus, (fmi2Component c, const fmi2StatusKind a, fmi2Status *b), fmi2Discard, (void)a,
        (void)b)
MISSING(GetIntegerStatus, (fmi2Component c, const fmi2StatusKind a, fmi2Integer *b), fmi2Discard,
        (void)a, (void)b)
MISSING(GetStringStatus, (fmi2Component c, const fmi2StatusKind a, fmi2String *b), fmi2Discard,
        (void)a, (void)b)
