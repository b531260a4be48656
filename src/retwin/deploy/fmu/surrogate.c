/* A surrogate with a residual as an FMU: additive at each sample, or delays and offsets by actuators.c.
 * Above this text stand the networks, the variables and the random numbers, and
 *
 *   SURROGATE(w, in, memory, first, out)  the network of the surrogate, which remembers REMEMBERED
 *   SURROGATE_WEIGHTS, PERIOD, FIRST[NU]  its weights, sample period in s, commands before any given
 *   BEFORE_MEAN[NU] ... AFTER_SCALE[NY]   its units
 *
 * and, where there is a residual model, MEMBERS networks ENCODER of FEATURES features, which remember
 * ENCODED each, with mixtures of COMPONENTS, see SequenceResidual:
 *
 *   ENCODER_WEIGHTS[MEMBERS * PER_MEMBER] its weights, those of the mixture last
 *   PAST_MEAN[NU + NY] ... LIMIT[NY]      its units, calibration and bounds
 *   PERSISTENCE[1 + NY]                   correlation of the noise from sample to sample, that which
 *                                         selects components first
 *
 * and, where the commands of the training are known, RANGED and
 *
 *   LEAST[NU], GREATEST[NU], FASTEST[NU]  values, and change from sample to sample, beyond which a
 *                                         command is outside of them
 */

#ifdef DRAWS
#define MEMORY ((1 + ENSEMBLE) * MEMBER)
#elif defined MEMBERS
#define MEMORY (2 * REMEMBERED + MEMBERS * ENCODED + 1 + NY)
#else
#define MEMORY (REMEMBERED + 1)
#endif

/* All that an instance is, so that its state is copied as bytes. */
typedef struct {
    double v[NV];          /* variables by value reference */
    double begin;          /* time of the first sample */
    double before[MEMORY]; /* what all networks remember, and the noise, before the present sample */
    double after[MEMORY];  /* after it */
    double last[NU + 1];   /* commands of the sample before */
    int64_t samples;       /* samples since the begin */
    int32_t seed, noisy, begun, ready, outside, warned;
} Twin;

/* Outputs y[NY] of the surrogate for commands u[NU]. */
static void respond(const double *u, double *memory, int first, double *y)
{
    double in[NU + 1];
    for (int i = 0; i < NU; i++)
        in[i] = (u[i] - BEFORE_MEAN[i]) / BEFORE_SCALE[i];
    SURROGATE(SURROGATE_WEIGHTS, in, memory, first, y);
    for (int i = 0; i < NY; i++)
        y[i] = AFTER_MEAN[i] + AFTER_SCALE[i] * y[i];
}

#ifdef DRAWS
/* Outputs y[NY] for commands u[NU], with one of the draws. */
static void corrected(const Twin *twin, int row, uint64_t seed, const double *u, double *memory,
                      double *y)
{
    double *state = memory + REMEMBERED, *history = state + 3 * NU + 1;
    int first = twin->samples == 0;
#ifdef AT_OUTPUTS
    respond(u, memory, first, y);
    delay(row, y, history, first);
#else
    double commands[NU + 1];
    memcpy(commands, u, NU * sizeof *u);
    follow(row, seed, (uint64_t)twin->samples, commands, state, first);
    delay(row, commands, history, first);
    respond(commands, memory, first, y);
#endif
    (void)seed;
}

static int ascending(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* Drawn outputs, and mean and quantiles of those of the first draws. */
static void distribution(Twin *twin, const double *u, double *drawn, double *mean, double *low,
                         double *high)
{
    double all[ENSEMBLE][NY], sorted[ENSEMBLE];
    uint64_t seed = (uint64_t)(uint32_t)twin->seed;
    corrected(twin, (int)(DRAWS * uniform(seed, 0)), seed, u, twin->after, drawn);
    for (int m = 0; m < ENSEMBLE; m++)
        corrected(twin, m, ~(uint64_t)m, u, twin->after + (1 + m) * MEMBER, all[m]);
    for (int i = 0; i < NY; i++) {
        mean[i] = 0.0;
        for (int m = 0; m < ENSEMBLE; m++)
            mean[i] += (sorted[m] = all[m][i]) / ENSEMBLE;
        qsort(sorted, ENSEMBLE, sizeof *sorted, ascending);
        double place = 0.05 * (ENSEMBLE - 1);
        int k = (int)place, top = ENSEMBLE - 1;
        low[i] = sorted[k] + (place - k) * (sorted[k + 1] - sorted[k]);
        high[i] = sorted[top - k] + (place - k) * (sorted[top - k - 1] - sorted[top - k]);
    }
}
#endif

#ifdef MEMBERS
/* A mixture of Gaussians. */
typedef struct {
    double weight[COMPONENTS], mean[COMPONENTS][NY], factor[COMPONENTS][NY][NY];
} Mixture;

static void softmax(int size, double *x)
{
    double largest = x[0], sum = 0.0;
    for (int i = 1; i < size; i++)
        largest = fmax(largest, x[i]);
    for (int i = 0; i < size; i++)
        sum += x[i] = exp(x[i] - largest);
    for (int i = 0; i < size; i++)
        x[i] /= sum;
}

/* The distribution of the residual by one network, for in[NU + NY], the past in standard units. */
static void predict(int member, const double *in, double *memory, int first, Mixture *made)
{
    enum { EACH = 1 + NY + NY * (NY + 1) / 2 };
    double features[FEATURES], raw[COMPONENTS * EACH];
    const float *w = ENCODER_WEIGHTS + (size_t)member * PER_MEMBER;
    w = ENCODER(w, in, memory, first, features);
    silu(FEATURES, features);
    dense(w, 1, FEATURES, COMPONENTS * EACH, features, raw);
    for (int k = 0; k < COMPONENTS; k++)
        made->weight[k] = raw[k * EACH];
    softmax(COMPONENTS, made->weight);
    for (int k = 0; k < COMPONENTS; k++) {
        const double *own = raw + k * EACH + 1, *lower = own + NY;
        for (int i = 0; i < NY; i++) {
            made->mean[k][i] = SHIFT[i] + SCALE[i] * own[i];
            for (int j = 0; j < NY; j++) {
                double value = j > i ? 0.0 : *lower++;
                if (i == j)
                    value = FLOOR + (value > 20.0 ? value : log1p(exp(value)));
                made->factor[k][i][j] = SPREAD[i] * SCALE[i] * value;
            }
        }
    }
    for (int i = 0; i < NY; i++) {
        double mean = 0.0;
        for (int k = 0; k < COMPONENTS; k++)
            mean += made->weight[k] * made->mean[k][i];
        for (int k = 0; k < COMPONENTS; k++)
            made->mean[k][i] -= (1.0 - TRUST[i]) * (mean - SHIFT[i]);
    }
}

static double bounded(double z, int i)
{
    return fmin(fmax(z, -LIMIT[i]), LIMIT[i]);
}

/* A draw of z[NY] from a mixture by noise[1 + NY], standard normal. */
static void draw(const Mixture *from, const double *noise, double *z)
{
    double level = 0.5 * erfc(-noise[0] / SQRT2), sum = from->weight[0];
    int k = 0;
    while (k + 1 < COMPONENTS && level >= sum)
        sum += from->weight[++k];
    for (int i = 0; i < NY; i++) {
        z[i] = from->mean[k][i];
        for (int j = 0; j <= i; j++)
            z[i] += from->factor[k][i][j] * noise[1 + j];
    }
}

/* The quantile at `level` of output i of the mixture of all members, by bisection. */
static double quantile(const Mixture *members, int i, double level)
{
    double deviation[MEMBERS][COMPONENTS], low = INFINITY, high = -INFINITY;
    for (int m = 0; m < MEMBERS; m++)
        for (int k = 0; k < COMPONENTS; k++) {
            double sum = 0.0, mean = members[m].mean[k][i];
            for (int j = 0; j <= i; j++)
                sum += members[m].factor[k][i][j] * members[m].factor[k][i][j];
            deviation[m][k] = sqrt(sum);
            low = fmin(low, mean - 2.0 * deviation[m][k]);
            high = fmax(high, mean + 2.0 * deviation[m][k]);
        }
    for (int halving = 0; halving < 50; halving++) {
        double middle = 0.5 * (low + high), below = 0.0;
        for (int m = 0; m < MEMBERS; m++)
            for (int k = 0; k < COMPONENTS; k++)
                below += members[m].weight[k] / MEMBERS * 0.5
                         * erfc((members[m].mean[k][i] - middle) / (SQRT2 * deviation[m][k] + 1e-300));
        if (below < level)
            low = middle;
        else
            high = middle;
    }
    return 0.5 * (low + high);
}

/* The residual at the present sample: drawn z[NY], mean and quantiles. */
static void residual(Twin *twin, const double *u, const double *nominal, double *z, double *mean,
                     double *low, double *high)
{
    double in[NU + NY], *memory = twin->after + 2 * REMEMBERED, *noise = memory + MEMBERS * ENCODED;
    Mixture members[MEMBERS];
    uint64_t seed = (uint64_t)(uint32_t)twin->seed;
    uint64_t drawn = 1 + (uint64_t)twin->samples * (1 + NY);
    for (int i = 0; i < NU + NY; i++)
        in[i] = ((i < NU ? u[i] : nominal[i - NU]) - PAST_MEAN[i]) / PAST_SCALE[i];
    for (int m = 0; m < MEMBERS; m++)
        predict(m, in, memory + m * ENCODED, twin->samples == 0, &members[m]);
    for (int i = 0; i < 1 + NY; i++) {
        double fresh = gaussian(uniform(seed, drawn + (uint64_t)i)), a = PERSISTENCE[i];
        noise[i] = twin->samples ? a * noise[i] + sqrt(1.0 - a * a) * fresh : fresh;
    }
    draw(&members[(int)(MEMBERS * uniform(seed, 0))], noise, z);
    for (int i = 0; i < NY; i++) {
        mean[i] = 0.0;
        for (int m = 0; m < MEMBERS; m++)
            for (int k = 0; k < COMPONENTS; k++)
                mean[i] += members[m].weight[k] / MEMBERS * members[m].mean[k][i];
        z[i] = bounded(z[i], i);
        mean[i] = bounded(mean[i], i);
        low[i] = bounded(quantile(members, i, 0.05), i);
        high[i] = bounded(quantile(members, i, 0.95), i);
    }
}
#endif

/* An instance before its initialization. */
static void reset(Twin *twin)
{
    memset(twin, 0, sizeof *twin);
    memcpy(twin->v + COMMAND, FIRST, NU * sizeof *FIRST);
}

/* The first sample. */
static void begin(Twin *twin)
{
    memset(twin->before, 0, sizeof twin->before);
    twin->samples = 0;
    twin->begun = 1;
    twin->ready = 0;
}

#ifdef RANGED
/* Whether the present commands leave the range of training. */
static int outside(const Twin *twin)
{
    for (int i = 0; i < NU; i++) {
        double u = twin->v[COMMAND + i];
        if (u < LEAST[i] || u > GREATEST[i])
            return 1;
        if (twin->samples && fabs(u - twin->last[i]) > FASTEST[i])
            return 1;
    }
    return 0;
}
#endif

/* Outputs at the present sample, for the present commands. */
static void evaluate(Twin *twin)
{
    double executed[NU + 1], path[NY] = {0}, z[NY] = {0};
    double mean[NY] = {0}, low[NY] = {0}, high[NY] = {0};
    if (twin->ready)
        return;
    memcpy(twin->after, twin->before, sizeof twin->after);
    for (int i = 0; i < NU; i++)
        executed[i] = twin->v[COMMAND + i] * (1.0 + twin->v[GAIN + i]);
#ifdef DRAWS
    distribution(twin, executed, z, mean, low, high);
#else
    respond(executed, twin->after, twin->samples == 0, path);
#endif
#ifdef MEMBERS
    /* Faults act on the commands; the residual is that of the commands without them. */
    double nominal[NY];
    respond(twin->v + COMMAND, twin->after + REMEMBERED, twin->samples == 0, nominal);
    residual(twin, twin->v + COMMAND, nominal, z, mean, low, high);
#endif
    for (int i = 0; i < NY; i++) {
        twin->v[MEAN + i] = path[i] + mean[i];
        twin->v[LOW + i] = path[i] + low[i];
        twin->v[HIGH + i] = path[i] + high[i];
        twin->v[OUTPUT + i] = path[i] + (twin->noisy ? z[i] : mean[i]) + twin->v[BIAS + i];
    }
#ifdef RANGED
    twin->outside = outside(twin);
#endif
    twin->ready = 1;
}

/* On to a time; 0 if an output is not finite. */
static int advance_to(Twin *twin, double time)
{
    if (!twin->begun)
        begin(twin);
    while (twin->begin + (double)(twin->samples + 1) * PERIOD <= time + 1e-6 * PERIOD) {
        evaluate(twin);
        memcpy(twin->before, twin->after, sizeof twin->before);
        memcpy(twin->last, twin->v + COMMAND, NU * sizeof *twin->last);
        twin->samples++;
        twin->ready = 0;
    }
    twin->v[0] = time;
    evaluate(twin);
    for (int i = 0; i < NY; i++)
        if (!isfinite(twin->v[OUTPUT + i]))
            return 0;
    return 1;
}

/* Whether a value reference may be set: a command or a fault. */
static int settable(const Twin *twin, uint32_t reference)
{
    (void)twin;
    return (reference >= COMMAND && reference < OUTPUT) || (reference >= GAIN && reference < NV);
}
