/* What both interfaces, of FMI 2.0 and 3.0, do to a twin. A twin and the type Boolean stand above this
 * text, one of the interfaces below. A text that is returned says what is wrong; NULL is nothing. */

#include <stdlib.h>

#define LEFT                                                                                        \
    "commands or states are outside the training range; the outputs there are extrapolated"
#define UNKNOWN "unknown value reference"

/* The outputs at the present sample, also before the begin. */
static void refresh(Twin *twin)
{
    if (!twin->begun)
        begin(twin), twin->begun = 0;
    evaluate(twin);
}

static const char *get_reals(Twin *twin, const uint32_t vr[], size_t n, double value[])
{
    refresh(twin);
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= NV)
            return UNKNOWN;
        value[i] = twin->v[vr[i]];
    }
    return NULL;
}

static const char *set_reals(Twin *twin, const uint32_t vr[], size_t n, const double value[])
{
    for (size_t i = 0; i < n; i++) {
        if (!settable(twin, vr[i]))
            return "this variable cannot be set now";
        if (!isfinite(value[i]))
            return "a value that is not finite";
        twin->v[vr[i]] = value[i];
    }
    twin->ready = 0;
    return NULL;
}

static const char *get_integers(Twin *twin, const uint32_t vr[], size_t n, int32_t value[])
{
    for (size_t i = 0; i < n; i++) {
        if (vr[i] != SEED)
            return UNKNOWN;
        value[i] = twin->seed;
    }
    return NULL;
}

static const char *set_integers(Twin *twin, const uint32_t vr[], size_t n, const int32_t value[])
{
    for (size_t i = 0; i < n; i++) {
        if (vr[i] != SEED || twin->begun)
            return "only the seed can be set, before the begin";
        twin->seed = value[i];
    }
    return NULL;
}

static const char *get_booleans(Twin *twin, const uint32_t vr[], size_t n, Boolean value[])
{
    for (size_t i = 0; i < n; i++) {
        if (vr[i] == NOISY)
            value[i] = twin->noisy != 0;
#ifdef RANGED
        else if (vr[i] == OUTSIDE)
            refresh(twin), value[i] = twin->outside != 0;
#endif
        else
            return UNKNOWN;
    }
    return NULL;
}

static const char *set_booleans(Twin *twin, const uint32_t vr[], size_t n, const Boolean value[])
{
    for (size_t i = 0; i < n; i++) {
        if (vr[i] != NOISY)
            return "this variable cannot be set";
        twin->noisy = value[i] ? 1 : 0;
    }
    twin->ready = 0;
    return NULL;
}

/* A copy of an instance or of its bytes, into a state that is made if there is none. */
static const char *copy(const void *twin, void **state)
{
    if (!*state && !(*state = malloc(sizeof(Twin))))
        return "no memory";
    memcpy(*state, twin, sizeof(Twin));
    return NULL;
}

static const char *step_to(Twin *twin, double time, double step)
{
    if (!(step > 0.0))
        return "a step that is not positive";
    return advance_to(twin, time + step) ? NULL : "the states do not stay finite";
}
