/* Log densities of measured outputs by the extended Kalman filter of a traced model, for many
 * variants of one record. Above this text stand the sizes NX, NU, NP, NY, LANES and DISCRETE, and
 * the model: slope_jacobian and output_jacobian, with derivatives by the states.
 *
 * LANES variants are computed at a time. Every array has a last axis of that length, so that each
 * operation is one instruction of the processor for several of them. What the variants have in
 * common with the record before they first differ from it is computed once. */

#include <stdlib.h>

#define EACH for (int l = 0; l < LANES; l++)
#define AT(i) ((i) * LANES + l)
#define SIZE (NX * (1 + NX))

/* Commands, process variances, outputs, whether these were measured, and what is added to one of
 * the parameters, of each variant in a group. */
typedef struct {
    const double *c[LANES], *q[LANES], *y[LANES], *seen[LANES], *change[LANES];
} inputs;

/* The states before a sample is measured, their covariance, and sums over the earlier samples. */
typedef struct {
    double x[NX * LANES], P[NX * NX * LANES], *sums;
} position;

static void commands_at(const inputs *in, long long t, double s, double *u)
{
    for (int i = 0; i < NU; i++)
        EACH {
            const double *c = in->c[l] + 4 * NU * t + i;
            u[AT(i)] = c[0] + s * (c[NU] + s * (c[2 * NU] + s * c[3 * NU]));
        }
}

/* Slopes of the states z[NX] and of their derivatives z[NX + NX * NX] by those at the sample. */
static void slopes_of(const double *z, const double *u, const double *p, double *dz)
{
    double fx[NX * NX * LANES];
    slope_jacobian(z, u, p, dz, fx);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) {
            double sum[LANES];
            EACH sum[l] = 0.0;
            for (int k = 0; k < NX; k++)
                EACH sum[l] += fx[AT(i * NX + k)] * z[AT(NX + k * NX + j)];
            EACH dz[AT(NX + i * NX + j)] = sum[l];
        }
}

static void advance(const inputs *in, long long t, const double *p, double period,
                    long long substeps, double *z)
{
    double u[(NU + 1) * LANES], k[4][SIZE * LANES], at[SIZE * LANES];
    if (DISCRETE) {
        commands_at(in, t, 0.0, u);
        slopes_of(z, u, p, k[0]);
        for (int i = 0; i < SIZE; i++)
            EACH z[AT(i)] = k[0][AT(i)];
        return;
    }
    const double h = period / (double)substeps;
    for (long long step = 0; step < substeps; step++) {
        for (int stage = 0; stage < 4; stage++) {
            const double shift = stage == 0 ? 0.0 : stage == 3 ? 1.0 : 0.5;
            if (stage != 2)
                commands_at(in, t, ((double)step + shift) / (double)substeps, u);
            for (int i = 0; i < SIZE; i++)
                EACH at[AT(i)] = stage == 0 ? z[AT(i)] : z[AT(i)] + shift * h * k[stage - 1][AT(i)];
            slopes_of(at, u, p, k[stage]);
        }
        for (int i = 0; i < SIZE; i++)
            EACH z[AT(i)] += h / 6.0 * (k[0][AT(i)] + 2.0 * k[1][AT(i)] + 2.0 * k[2][AT(i)] + k[3][AT(i)]);
    }
}

/* Add the terms of a sample to the sums: of the squares of the errors, of the logarithms of the
 * variances, of the products of the slopes with the errors, and of the slopes with each other, all
 * whitened. `slopes`[NY][width]; `white` has room for one sample's. */
static void add(const double *mean, const double *covariance, const inputs *in, long long t,
                const double *slopes, long long width, double *white, double *sums)
{
    double L[NY * NY * LANES], error[NY * LANES], known[NY * LANES], determinant[LANES];
    EACH determinant[l] = 1.0;
    for (int a = 0; a < NY; a++)
        EACH known[AT(a)] = in->seen[l][NY * t + a] != 0.0 ? 1.0 : 0.0;
    for (int a = 0; a < NY; a++) {
        /* An output that was not measured has variance 1 and no error. */
        for (int b = 0; b <= a; b++) {
            double sum[LANES];
            EACH {
                const double both = known[AT(a)] * known[AT(b)];
                sum[l] = both != 0.0 ? covariance[AT(a * NY + b)] : (double)(a == b);
            }
            for (int k = 0; k < b; k++)
                EACH sum[l] -= L[AT(a * NY + k)] * L[AT(b * NY + k)];
            if (b < a)
                EACH L[AT(a * NY + b)] = sum[l] / L[AT(b * NY + b)];
            else
                EACH {
                    L[AT(a * NY + a)] = sqrt(sum[l]);
                    determinant[l] *= sum[l];
                }
        }
        double own[LANES];
        EACH own[l] = known[AT(a)] != 0.0 ? in->y[l][NY * t + a] - mean[AT(a)] : 0.0 * mean[AT(a)];
        for (int b = 0; b < a; b++)
            EACH own[l] -= L[AT(a * NY + b)] * error[AT(b)];
        EACH {
            error[AT(a)] = own[l] / L[AT(a * NY + a)];
            sums[AT(0)] += error[AT(a)] * error[AT(a)];
        }
        for (long long i = 0; i < width; i++) {
            double *made = white + (a * width + i) * LANES;
            EACH made[l] = known[AT(a)] * slopes[a * width + i];
            for (int b = 0; b < a; b++)
                EACH made[l] -= L[AT(a * NY + b)] * white[(b * width + i) * LANES + l];
            EACH made[l] /= L[AT(a * NY + a)];
        }
    }
    EACH sums[AT(1)] += log(determinant[l]);
    double *sum = sums + 2 * LANES;
    for (long long i = 0; i < width; i++, sum += LANES)
        for (int a = 0; a < NY; a++)
            EACH sum[l] += white[(a * width + i) * LANES + l] * error[AT(a)];
    for (long long i = 0; i < width; i++)
        for (long long j = 0; j <= i; j++, sum += LANES)
            for (int a = 0; a < NY; a++)
                EACH sum[l] += white[(a * width + i) * LANES + l] * white[(a * width + j) * LANES + l];
}

/* The lower factor S[NX][NX] of P = S S^T; columns are 0 where P is singular. */
static void factor(const double *P, double *S)
{
    for (int j = 0; j < NX; j++)
        for (int i = 0; i < NX; i++) {
            double sum[LANES];
            EACH sum[l] = i < j ? 0.0 : P[AT(i * NX + j)];
            for (int k = 0; k < j && i >= j; k++)
                EACH sum[l] -= S[AT(i * NX + k)] * S[AT(j * NX + k)];
            if (i == j)
                EACH sum[l] = sum[l] <= 0.0 ? 0.0 : sqrt(sum[l]);
            if (i > j)
                EACH sum[l] = S[AT(j * NX + j)] == 0.0 ? 0.0 : sum[l] / S[AT(j * NX + j)];
            EACH S[AT(i * NX + j)] = sum[l];
        }
}

/* The filter from the sample `first` until before `last`. Covariances are updated by their factors, as
 * in the filter of one record. */
static void follow(position *now, const inputs *in, long long first, long long last,
                   long long samples, long long substeps, double period, const double *p,
                   const double *r, const double *slopes, long long width, long long parameter,
                   double *white)
{
    double z[SIZE * LANES], u[(NU + 1) * LANES], hx[NY * NX * LANES], mean[NY * LANES];
    double covariance[NY * NY * LANES], FP[NX * NX * LANES], own[(NP + 1) * LANES];
    double S[NX * NX * LANES], HS[NY * NX * LANES], f[NX * LANES], g[NX * LANES];
    double *x = now->x, *P = now->P, *F = z + NX * LANES;
    for (long long t = first; t < last; t++) {
        for (int i = 0; i < NP; i++)
            EACH own[AT(i)] = p[i];
        EACH if (in->change[l])
            own[AT(parameter)] += in->change[l][t];
        commands_at(in, t, 0.0, u);
        for (int i = 0; i < NX; i++)
            EACH z[AT(i)] = x[AT(i)];
        output_jacobian(z, u, own, mean, hx);
        factor(P, S);
        for (int a = 0; a < NY; a++)
            for (int j = 0; j < NX; j++) {
                EACH HS[AT(a * NX + j)] = 0.0;
                for (int i = 0; i < NX; i++)
                    EACH HS[AT(a * NX + j)] += hx[AT(a * NX + i)] * S[AT(i * NX + j)];
            }
        for (int a = 0; a < NY; a++)
            for (int b = 0; b < NY; b++) {
                double sum[LANES];
                EACH sum[l] = a == b ? r[a] : 0.0;
                for (int j = 0; j < NX; j++)
                    EACH sum[l] += HS[AT(a * NX + j)] * HS[AT(b * NX + j)];
                EACH covariance[AT(a * NY + b)] = sum[l];
            }
        add(mean, covariance, in, t, slopes + NY * width * t, width, white, now->sums);
        for (int a = 0; a < NY; a++) {
            double variance[LANES], error[LANES], gain[LANES], narrowed[LANES];
            EACH {
                variance[l] = r[a];
                error[l] = in->y[l][NY * t + a] - mean[AT(a)];
            }
            for (int i = 0; i < NX; i++) {
                EACH f[AT(i)] = 0.0;
                for (int k = 0; k < NX; k++)
                    EACH f[AT(i)] += hx[AT(a * NX + k)] * S[AT(k * NX + i)];
                EACH {
                    variance[l] += f[AT(i)] * f[AT(i)];
                    error[l] -= hx[AT(a * NX + i)] * (x[AT(i)] - z[AT(i)]);
                }
            }
            EACH {
                const int used = in->seen[l][NY * t + a] != 0.0;
                gain[l] = used ? error[l] / variance[l] : 0.0;
                narrowed[l] = used ? 1.0 / (variance[l] + sqrt(r[a] * variance[l])) : 0.0;
            }
            for (int i = 0; i < NX; i++) {
                EACH g[AT(i)] = 0.0;
                for (int j = 0; j < NX; j++)
                    EACH g[AT(i)] += S[AT(i * NX + j)] * f[AT(j)];
                EACH x[AT(i)] += g[AT(i)] * gain[l];
                for (int j = 0; j < NX; j++)
                    EACH S[AT(i * NX + j)] -= g[AT(i)] * f[AT(j)] * narrowed[l];
            }
        }
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < NX; j++) {
                EACH P[AT(i * NX + j)] = 0.0;
                for (int k = 0; k < NX; k++)
                    EACH P[AT(i * NX + j)] += S[AT(i * NX + k)] * S[AT(j * NX + k)];
            }
        if (t + 1 == samples)
            return;
        for (int i = 0; i < NX; i++)
            EACH z[AT(i)] = x[AT(i)];
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < NX; j++)
                EACH F[AT(i * NX + j)] = i == j ? 1.0 : 0.0;
        advance(in, t, own, period, substeps, z);
        for (int i = 0; i < NX; i++) {
            EACH x[AT(i)] = z[AT(i)];
            for (int j = 0; j < NX; j++) {
                EACH FP[AT(i * NX + j)] = 0.0;
                for (int k = 0; k < NX; k++)
                    EACH FP[AT(i * NX + j)] += F[AT(i * NX + k)] * P[AT(k * NX + j)];
            }
        }
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < NX; j++) {
                double sum[LANES];
                EACH sum[l] = i == j ? in->q[l][NX * t + i] : 0.0;
                for (int k = 0; k < NX; k++)
                    EACH sum[l] += FP[AT(i * NX + k)] * F[AT(j * NX + k)];
                EACH P[AT(i * NX + j)] = sum[l];
            }
    }
}

/* The record: parameters p[NP], start[NX] with its covariance spread[NX][NX], measurement variances
 * r[NY], slopes[samples][NY][width], commands c0[samples][4][NU], process variances
 * q0[samples][NX], outputs y0[samples][NY] and whether they were measured, seen0[samples][NY].
 * The n variants: first[n], a sample before which each is as the record, in order; and c, q, y and
 * seen as those of the record, and change[n][samples] of the parameter of that number, where they
 * differ from the record's, NULL where none does. To made[n][2 + width + width (width + 1) / 2], the sums
 * of `add`; NaN without memory. */
EXPORT void likelihood(long long n, long long samples, long long substeps, long long width,
                       long long parameter, double period, const double *p, const double *start,
                       const double *spread, const double *r, const double *slopes, const double *c0, const double *q0,
                       const double *y0, const double *seen0, const long long *first,
                       const double *c, const double *q, const double *y, const double *seen,
                       const double *change, double *made)
{
    const long long count = 2 + width + width * (width + 1) / 2;
    const size_t size = (size_t)count * LANES;
    double *room = malloc((2 * size + (size_t)(NY * width + 1) * LANES) * sizeof(double));
    if (!room) {
        for (long long i = 0; i < n * count; i++)
            made[i] = NAN;
        return;
    }
    double *white = room + 2 * size;
    position record = {.sums = room}, now;
    inputs common, own;
    for (size_t i = 0; i < size; i++)
        record.sums[i] = 0.0;
    for (int i = 0; i < NX; i++)
        EACH record.x[AT(i)] = start[i];
    for (int i = 0; i < NX * NX; i++)
        EACH record.P[AT(i)] = spread[i];
    EACH {
        common.c[l] = c0, common.q[l] = q0, common.y[l] = y0, common.seen[l] = seen0;
        common.change[l] = NULL;
    }
    long long done = 0;
    for (long long row = 0; row < n; row += LANES) {
        if (first[row] > done) {
            follow(&record, &common, done, first[row], samples, substeps, period, p, r, slopes,
                   width, parameter, white);
            done = first[row];
        }
        EACH {
            const long long i = (row + l < n ? row + l : n - 1) * samples;
            own.c[l] = c ? c + 4 * NU * i : c0;
            own.q[l] = q ? q + NX * i : q0;
            own.y[l] = y ? y + NY * i : y0;
            own.seen[l] = seen ? seen + NY * i : seen0;
            own.change[l] = change ? change + i : NULL;
        }
        now = record;
        now.sums = room + size;
        for (size_t i = 0; i < size; i++)
            now.sums[i] = record.sums[i];
        follow(&now, &own, done, samples, samples, substeps, period, p, r, slopes, width,
               parameter, white);
        for (int l = 0; l < LANES && row + l < n; l++)
            for (long long i = 0; i < count; i++)
                made[(row + l) * count + i] = now.sums[AT(i)];
    }
    free(room);
}
