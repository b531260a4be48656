/* A twin as an FMU, from sample to sample. Above this text stand the model with its
 * steps, variables.c, random.c, and
 *
 *   NR                    columns of FACTOR
 *   NV                    real variables, by value reference
 *   SUBSTEPS, PERIOD      steps of the integration per sample, sample period in s
 *   LINEAR                1 if commands are straight lines between samples, 0 if they are held
 *   NI, ND                commands, and those of them with a dead time: DELAYED[ND] are their
 *   DEAD[ND], LONGEST[ND] indices, these those of the parameters, and the longest in s; the NU
 *   PAST                  commands of the model are those of `delayed` in Python; samples kept
 *   VALUES[NQ], PLACE[NQ] parameters and start values, and their value references, -1 for none
 *   FACTOR[NQ][NR]        of the covariance of these, FACTOR FACTOR^T
 *   START[NX]             deviations by which starts differ between instances
 *   PROCESS[NX], NOISE[NY] variances of process and measurement noise
 *   WIDENING[NY]          factors of the deviations from the mean
 *   CONSTANT[NY]          deviations that are the same at all times; 0 for scaled ones
 *
 * and, where there was a calibration, RANGED and
 *
 *   LEAST[NX + NI], GREATEST[NX + NI] values beyond which states and commands are outside of it */

#define QUANTILE 1.6448536269514722

/* All that an instance is, so that its state is copied as bytes. */
typedef struct {
    double v[NV];                /* variables by value reference */
    double begin;                /* time of the first sample */
    double past[PAST][NI + 1];   /* commands of the samples before, the last one first */
    double z[NX * (1 + NQ)];     /* most probable states, and their derivatives by all values */
    double kicked[NX];           /* states with process noise */
    double P[NX * NX];           /* covariance of the states by process noise */
    double moves[NQ];            /* by how much the values differ in this instance */
    double error[NY];            /* measurement noise of the present sample */
    int64_t samples;             /* samples since the begin */
    uint64_t drawn;              /* random numbers so far */
    int32_t seed, noisy, begun, ready, outside, warned;
} Twin;

static double normal(Twin *twin)
{
    return gaussian(uniform((uint64_t)(uint32_t)twin->seed, twin->drawn++));
}

/* The values of parameters and starts, q[NQ]. */
static void present(const Twin *twin, double *q)
{
    for (int i = 0; i < NQ; i++)
        q[i] = PLACE[i] < 0 ? VALUES[i] : twin->v[PLACE[i]];
}

/* A command as the actuator executes it, so many samples back; before the first sample the first. */
static double executed(const Twin *twin, int i, int back)
{
    if (back > 0 && twin->samples > 0)
        return twin->past[back - 1][i];
    return twin->v[COMMAND + i] * (1.0 + twin->v[GAIN + i]);
}

/* The model's commands u[NU] so many samples back. Dead times that are not kept give NaN. */
static void commanded(const Twin *twin, const double *q, int back, double *u)
{
    for (int i = 0; i < NI; i++)
        u[i] = executed(twin, i, back);
    for (int k = 0; k < ND; k++) {
        const double delay = q[DEAD[k]];
        const int kept = delay >= 0.0 && delay <= LONGEST[k];
        const int whole = kept ? (int)floor(delay / PERIOD) : 0;
        const double now = executed(twin, DELAYED[k], back + whole);
        const double rise = executed(twin, DELAYED[k], back + whole + 1) - now;
        u[DELAYED[k]] = kept ? now - whole * rise : NAN;
        u[NI + k] = rise / PERIOD;
    }
}

/* Keep the present commands: as all the earlier ones too, at the first sample. */
static void keep(Twin *twin)
{
    double now[NI + 1];
    for (int i = 0; i < NI; i++)
        now[i] = executed(twin, i, 0);
    memmove(twin->past + 1, twin->past, (PAST - 1) * sizeof *twin->past);
    for (int back = 0; back < (twin->samples > 0 ? 1 : PAST); back++)
        memcpy(twin->past[back], now, NI * sizeof *now);
}

static void draw_error(Twin *twin)
{
    for (int i = 0; i < NY; i++)
        twin->error[i] = sqrt(NOISE[i]) * normal(twin);
}

/* An instance before its initialization. */
static void reset(Twin *twin)
{
    memset(twin, 0, sizeof *twin);
    for (int i = 0; i < NQ; i++)
        if (PLACE[i] >= 0)
            twin->v[PLACE[i]] = VALUES[i];
    for (int i = 0; i < NI; i++)
        twin->v[COMMAND + i] = FIRST[i];
}

/* The first sample: starts, and what differs in this instance. */
static void begin(Twin *twin)
{
    double q[NQ];
    present(twin, q);
    for (int i = 0; i < NX; i++) {
        twin->z[i] = twin->kicked[i] = q[NP + i];
        for (int k = 0; k < NQ; k++)
            twin->z[NX + i * NQ + k] = k == NP + i ? 1.0 : 0.0;
    }
    memset(twin->P, 0, sizeof twin->P);
    memset(twin->moves, 0, sizeof twin->moves);
    twin->drawn = 0;
    for (int r = 0; r < NR; r++) {
        double drawn = normal(twin);
        for (int k = 0; k < NQ; k++)
            twin->moves[k] += FACTOR[k * NR + r] * drawn;
    }
    for (int i = 0; i < NX; i++)
        twin->moves[NP + i] += START[i] * normal(twin);
    draw_error(twin);
    twin->samples = 0;
    twin->begun = 1;
    twin->ready = 0;
}

/* One sample on. */
static void next(Twin *twin)
{
    double q[NQ], c[4 * NU + 1] = {0}, u[NU + 1], F[NX * (1 + NX)], FP[NX * NX];
    present(twin, q);
    commanded(twin, q, 0, u);
    commanded(twin, q, LINEAR, c);
    for (int i = 0; i < NU; i++)
        c[NU + i] = u[i] - c[i];
    keep(twin);
    for (int i = 0; i < NX; i++) {
        F[i] = twin->z[i];
        for (int j = 0; j < NX; j++)
            F[NX + i * NX + j] = i == j ? 1.0 : 0.0;
    }
    advance(slope_by_state, NX * (1 + NX), c, q, PERIOD, SUBSTEPS, F);
    advance(slope_by_all, NX * (1 + NQ), c, q, PERIOD, SUBSTEPS, twin->z);
    advance(slope, NX, c, q, PERIOD, SUBSTEPS, twin->kicked);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) {
            FP[i * NX + j] = 0.0;
            for (int k = 0; k < NX; k++)
                FP[i * NX + j] += F[NX + i * NX + k] * twin->P[k * NX + j];
        }
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j < NX; j++) {
            twin->P[i * NX + j] = i == j ? PROCESS[i] : 0.0;
            for (int k = 0; k < NX; k++)
                twin->P[i * NX + j] += FP[i * NX + k] * F[NX + j * NX + k];
        }
        twin->kicked[i] += sqrt(PROCESS[i]) * normal(twin);
    }
    draw_error(twin);
    twin->ready = 0;
}

#ifdef RANGED
/* Whether the present states or commands leave the range of the calibration. */
static int outside(const Twin *twin)
{
    for (int i = 0; i < NX + NI; i++) {
        double value = i < NX ? twin->z[i] : twin->v[COMMAND + i - NX];
        if (value < LEAST[i] || value > GREATEST[i])
            return 1;
    }
    return 0;
}
#endif

/* Outputs at the present states and commands. */
static void evaluate(Twin *twin)
{
    double q[NQ], u[NU + 1], mean[NY], kicked[NY], hx[NY * NX], hp[NY * NP + 1];
    if (twin->ready)
        return;
    present(twin, q);
    commanded(twin, q, LINEAR, u);
    output(twin->kicked, u, q, kicked);
    output_jacobian(twin->z, u, q, mean, hx, hp);
    for (int i = 0; i < NY; i++) {
        double moved = 0.0, variance = NOISE[i], by[NQ];
        for (int k = 0; k < NQ; k++) {
            by[k] = k < NP ? hp[i * NP + k] : 0.0;
            for (int j = 0; j < NX; j++)
                by[k] += hx[i * NX + j] * twin->z[NX + j * NQ + k];
            moved += by[k] * twin->moves[k];
        }
        for (int r = 0; r < NR; r++) {
            double sum = 0.0;
            for (int k = 0; k < NQ; k++)
                sum += by[k] * FACTOR[k * NR + r];
            variance += sum * sum;
        }
        for (int j = 0; j < NX; j++) {
            variance += by[NP + j] * by[NP + j] * START[j] * START[j];
            for (int k = 0; k < NX; k++)
                variance += hx[i * NX + j] * twin->P[j * NX + k] * hx[i * NX + k];
        }
        double scale = CONSTANT[i] > 0.0 ? CONSTANT[i] / sqrt(variance) : WIDENING[i];
        double half = QUANTILE * scale * sqrt(variance), drawn = 0.0;
        if (twin->noisy)
            drawn = scale * (kicked[i] + twin->error[i] - mean[i] + moved);
        twin->v[MEAN + i] = mean[i];
        twin->v[LOW + i] = mean[i] - half;
        twin->v[HIGH + i] = mean[i] + half;
        twin->v[OUTPUT + i] = mean[i] + drawn + twin->v[BIAS + i];
    }
#ifdef RANGED
    twin->outside = outside(twin);
#endif
    twin->ready = 1;
}

/* On to a time; 0 if a state or an output is not finite. */
static int advance_to(Twin *twin, double time)
{
    if (!twin->begun)
        begin(twin);
    /* With straight lines, the first step only learns the command at its begin. */
    while (twin->begin + (double)(twin->samples + 1) * PERIOD <= time + 1e-6 * PERIOD) {
        if (!LINEAR || twin->samples > 0)
            next(twin);
        else
            keep(twin);
        twin->samples++;
        twin->ready = 0;
    }
    twin->v[0] = time;
    evaluate(twin);
    for (int i = 0; i < NX; i++)
        if (!isfinite(twin->z[i]))
            return 0;
    for (int i = 0; i < NY; i++)
        if (!isfinite(twin->v[OUTPUT + i]))
            return 0;
    return 1;
}

/* Whether a value reference may be set: a command, a fault, a parameter, or a start before begin. */
static int settable(const Twin *twin, uint32_t reference)
{
    if (reference >= NV || reference == 0 || (reference >= OUTPUT && reference < GAIN))
        return 0;
    for (int i = NP; i < NQ; i++)
        if ((int64_t)PLACE[i] == (int64_t)reference)
            return !twin->begun;
    return 1;
}
