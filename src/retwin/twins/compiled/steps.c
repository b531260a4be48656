/* A traced model from sample to sample. Above this text stand the sizes NX, NU, NP, NY, the number NQ
 * of parameters with start values, DISCRETE, and the model: slope, slope_jacobian, output and
 * output_jacobian. Commands come as cubic polynomials between samples, c[4][NU]. */

typedef void (*slope_of)(const double *z, const double *u, const double *p, double *dz);

static void command(const double *c, double s, double *u)
{
    for (int i = 0; i < NU; i++)
        u[i] = c[i] + s * (c[NU + i] + s * (c[2 * NU + i] + s * c[3 * NU + i]));
}

/* The state with its derivatives by `columns` numbers, z = x[NX], S[NX][columns], the first of which
 * are the model's parameters where `parameters` is not 0: dS = f_x S + f_p. */
static void slope_with(const double *restrict z, const double *u, const double *p,
                       double *restrict dz, int columns, int parameters)
{
    double fx[NX * NX], fp[NX * NP + 1];
    slope_jacobian(z, u, p, dz, fx, fp);
    for (int i = 0; i < NX; i++) {
        double *sum = dz + NX + i * columns;
        for (int q = 0; q < columns; q++)
            sum[q] = 0.0;
        for (int q = 0; parameters && q < NP; q++)
            sum[q] = fp[i * NP + q];
        for (int j = 0; j < NX; j++) {
            const double factor = fx[i * NX + j], *own = z + NX + j * columns;
            if (factor != 0.0) /* most equations have few of the states */
                for (int q = 0; q < columns; q++)
                    sum[q] += factor * own[q];
        }
    }
}

static void slope_by_all(const double *z, const double *u, const double *p, double *dz)
{
    slope_with(z, u, p, dz, NQ, 1);
}

static void slope_by_state(const double *z, const double *u, const double *p, double *dz)
{
    slope_with(z, u, p, dz, NX, 0);
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
