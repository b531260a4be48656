/* Simulation of a traced model, which stands above this text with its steps. */

/* The parameters p[NP] at the present sample, by what the next of `changes` adds; NULL for none. */
static const double *at_present(const double *p, const double **changes, double *changed)
{
    if (!*changes)
        return p;
    for (int i = 0; i < NP; i++)
        changed[i] = p[i] + *(*changes)++;
    return changed;
}

/* c[n][samples][4][NU], p[n][NP], start[n][NX] to y[n][samples][NY], x[n][samples][NX]. What
 * `kicks`[n][samples][NX] adds to the states after each sample is process noise, NULL for none;
 * `changes`[n][samples][NP] are added to the parameters until the next sample, NULL for none. */
EXPORT void simulate(long long n, long long samples, long long substeps, double period,
                     const double *c, const double *p, const double *start, const double *kicks,
                     const double *changes, double *y, double *x)
{
    double z[NX], u[NU + 1], changed[NP + 1];
    for (long long row = 0; row < n; row++, p += NP, start += NX) {
        for (int i = 0; i < NX; i++)
            z[i] = start[i];
        for (long long t = 0; t < samples; t++, c += 4 * NU, y += NY, x += NX) {
            const double *now = at_present(p, &changes, changed);
            command(c, 0.0, u);
            output(z, u, now, y);
            for (int i = 0; i < NX; i++)
                x[i] = z[i];
            if (t + 1 < samples)
                advance(slope, NX, c, now, period, substeps, z);
            for (int i = 0; kicks && i < NX; i++)
                z[i] += *kicks++;
        }
    }
}

/* The same with dy[n][samples][NY][NQ], derivatives by parameters and then start values. */
EXPORT void sensitivities(long long n, long long samples, long long substeps, double period,
                          const double *c, const double *p, const double *start, double *y,
                          double *dy)
{
    double z[NX * (1 + NQ)], u[NU + 1], hx[NY * NX], hp[NY * NP + 1];
    for (long long row = 0; row < n; row++, p += NP, start += NX) {
        for (int i = 0; i < NX; i++) {
            z[i] = start[i];
            for (int q = 0; q < NQ; q++)
                z[NX + i * NQ + q] = q == NP + i ? 1.0 : 0.0;
        }
        for (long long t = 0; t < samples; t++, c += 4 * NU, y += NY) {
            command(c, 0.0, u);
            output_jacobian(z, u, p, y, hx, hp);
            for (int i = 0; i < NY; i++)
                for (int q = 0; q < NQ; q++, dy++) {
                    *dy = q < NP ? hp[i * NP + q] : 0.0;
                    for (int j = 0; j < NX; j++)
                        *dy += hx[i * NX + j] * z[NX + j * NQ + q];
                }
            if (t + 1 < samples)
                advance(slope_by_all, NX * (1 + NQ), c, p, period, substeps, z);
        }
    }
}

/* The lower factor S of P = S S^T; columns are 0 where P is singular. */
static void factor(double P[NX][NX], double S[NX][NX])
{
    for (int j = 0; j < NX; j++)
        for (int i = 0; i < NX; i++) {
            double sum = i < j ? 0.0 : P[i][j];
            for (int k = 0; k < j && i >= j; k++)
                sum -= S[i][k] * S[j][k];
            if (i == j)
                sum = sum <= 0.0 ? 0.0 : sqrt(sum);
            S[i][j] = i <= j ? sum : S[j][j] == 0.0 ? 0.0 : sum / S[j][j];
        }
}

/* Extended Kalman filter, with factors of covariances, which stay positive however exact outputs are
 * (Potter's update; Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, section
 * II.8). Variances of the measurement noise r[NY], and of the process noise
 * q[n][samples][NX] after each sample; covariance of the states spread[n][NX][NX], at the first sample
 * before it is measured, which becomes that after the last one; outputs with an error of more than
 * *gate standard deviations are not used; measured y[n][samples][NY], of which seen[n][samples][NY] is not 0; to
 * mean[n][samples][NY] and covariance[n][samples][NY][NY] of y given all earlier samples, and to
 * x[n][samples][NX] given these and the present one; `changes` as for `simulate`. */
EXPORT void filter(long long n, long long samples, long long substeps, double period,
                   const double *r, const double *gate, const double *c, const double *p,
                   const double *start, const double *q, const double *y, const double *seen,
                   const double *changes, double *spread, double *mean, double *covariance,
                   double *x)
{
    double z[NX * (1 + NX)], u[NU + 1], hx[NY * NX], hp[NY * NP + 1], P[NX][NX], FP[NX][NX];
    double changed[NP + 1], S[NX][NX], HS[NY][NX], f[NX], g[NX];
    double *F = z + NX;
    for (long long row = 0; row < n; row++, p += NP, start += NX) {
        for (int i = 0; i < NX; i++) {
            z[i] = start[i];
            for (int j = 0; j < NX; j++)
                P[i][j] = spread[i * NX + j];
        }
        for (long long t = 0; t < samples; t++) {
            const double *now = at_present(p, &changes, changed);
            command(c, 0.0, u);
            output_jacobian(z, u, now, mean, hx, hp);
            factor(P, S);
            for (int a = 0; a < NY; a++)
                for (int j = 0; j < NX; j++) {
                    HS[a][j] = 0.0;
                    for (int i = 0; i < NX; i++)
                        HS[a][j] += hx[a * NX + i] * S[i][j];
                }
            for (int a = 0; a < NY; a++)
                for (int b = 0; b < NY; b++) {
                    double sum = a == b ? r[a] : 0.0;
                    for (int j = 0; j < NX; j++)
                        sum += HS[a][j] * HS[b][j];
                    covariance[a * NY + b] = sum;
                }
            for (int i = 0; i < NX; i++)
                x[i] = z[i];
            int used = 0;
            for (int a = 0; a < NY; a++) {
                if (!seen[a])
                    continue;
                double variance = r[a], error = y[a] - mean[a];
                for (int i = 0; i < NX; i++) {
                    f[i] = 0.0;
                    for (int k = 0; k < NX; k++)
                        f[i] += hx[a * NX + k] * S[k][i];
                    variance += f[i] * f[i];
                    error -= hx[a * NX + i] * (x[i] - z[i]);
                }
                if (fabs(error) > *gate * sqrt(variance))
                    continue;
                used = 1;
                for (int i = 0; i < NX; i++) {
                    g[i] = 0.0;
                    for (int j = 0; j < NX; j++)
                        g[i] += S[i][j] * f[j];
                    x[i] += g[i] * error / variance;
                    for (int j = 0; j < NX; j++)
                        S[i][j] -= g[i] * f[j] / (variance + sqrt(r[a] * variance));
                }
            }
            for (int i = 0; used && i < NX; i++)
                for (int j = 0; j < NX; j++) {
                    P[i][j] = 0.0;
                    for (int k = 0; k < NX; k++)
                        P[i][j] += S[i][k] * S[j][k];
                }
            if (t + 1 < samples) {
                for (int i = 0; i < NX; i++) {
                    z[i] = x[i];
                    for (int j = 0; j < NX; j++)
                        F[i * NX + j] = i == j ? 1.0 : 0.0;
                }
                advance(slope_by_state, NX * (1 + NX), c, now, period, substeps, z);
                for (int i = 0; i < NX; i++)
                    for (int j = 0; j < NX; j++) {
                        FP[i][j] = 0.0;
                        for (int k = 0; k < NX; k++)
                            FP[i][j] += F[i * NX + k] * P[k][j];
                    }
                for (int i = 0; i < NX; i++)
                    for (int j = 0; j < NX; j++) {
                        P[i][j] = i == j ? q[i] : 0.0;
                        for (int k = 0; k < NX; k++)
                            P[i][j] += FP[i][k] * F[j * NX + k];
                    }
            }
            c += 4 * NU, q += NX, y += NY, seen += NY, mean += NY, covariance += NY * NY, x += NX;
        }
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < NX; j++)
                *spread++ = P[i][j];
    }
}
