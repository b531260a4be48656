/* Simulation of a traced model. Above this text stand the sizes NX, NU, NP, NY, the number NQ of
 * parameters with start values, DISCRETE, and the model: slope, slope_jacobian, output and
 * output_jacobian. Commands come as cubic polynomials between samples, c[4][NU]. */

typedef void (*slope_of)(const double *z, const double *u, const double *p, double *dz);

static void command(const double *c, double s, double *u)
{
    for (int i = 0; i < NU; i++)
        u[i] = c[i] + s * (c[NU + i] + s * (c[2 * NU + i] + s * c[3 * NU + i]));
}

/* The state with its sensitivities, z = x[NX], S[NX][NQ]: dS = f_x S + f_q. */
static void slope_sensitive(const double *z, const double *u, const double *p, double *dz)
{
    double fx[NX * NX], fp[NX * NP + 1];
    slope_jacobian(z, u, p, dz, fx, fp);
    for (int i = 0; i < NX; i++)
        for (int q = 0; q < NQ; q++) {
            double sum = q < NP ? fp[i * NP + q] : 0.0;
            for (int j = 0; j < NX; j++)
                sum += fx[i * NX + j] * z[NX + j * NQ + q];
            dz[NX + i * NQ + q] = sum;
        }
}

/* One sample: the model's own step, or Runge-Kutta steps of fourth order. */
static void advance(slope_of f, int size, const double *c, const double *p, double period,
                    long long substeps, double *z)
{
    double u[NU + 1], k[4][NX * (1 + NQ)], at[NX * (1 + NQ)];
    if (DISCRETE) {
        command(c, 0.0, u);
        f(z, u, p, k[0]);
        for (int i = 0; i < size; i++)
            z[i] = k[0][i];
        return;
    }
    double h = period / (double)substeps;
    for (long long step = 0; step < substeps; step++) {
        for (int stage = 0; stage < 4; stage++) {
            double shift = stage == 0 ? 0.0 : stage == 3 ? 1.0 : 0.5;
            if (stage != 2)
                command(c, ((double)step + shift) / (double)substeps, u);
            for (int i = 0; i < size; i++)
                at[i] = stage == 0 ? z[i] : z[i] + shift * h * k[stage - 1][i];
            f(at, u, p, k[stage]);
        }
        for (int i = 0; i < size; i++)
            z[i] += h / 6.0 * (k[0][i] + 2.0 * k[1][i] + 2.0 * k[2][i] + k[3][i]);
    }
}

/* c[n][samples][4][NU], p[n][NP], start[n][NX] to y[n][samples][NY], x[n][samples][NX]. */
EXPORT void simulate(long long n, long long samples, long long substeps, double period,
                     const double *c, const double *p, const double *start, double *y, double *x)
{
    double z[NX], u[NU + 1];
    for (long long row = 0; row < n; row++, p += NP, start += NX) {
        for (int i = 0; i < NX; i++)
            z[i] = start[i];
        for (long long t = 0; t < samples; t++, c += 4 * NU, y += NY, x += NX) {
            command(c, 0.0, u);
            output(z, u, p, y);
            for (int i = 0; i < NX; i++)
                x[i] = z[i];
            if (t + 1 < samples)
                advance(slope, NX, c, p, period, substeps, z);
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
                advance(slope_sensitive, NX * (1 + NQ), c, p, period, substeps, z);
        }
    }
}
