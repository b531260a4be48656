/* A damped Gauss-Newton step of many rows, in double precision; see `gauss_newton_step` in
   `solver.py` and `Noise` in `noise.py`, which are the same in torch and explain it. Columns of the
   Jacobian that are zero at a sample are passed over: outputs depend on few segments at a time. */

typedef struct {
    i64 samples, outputs, size;
    double freedom;
    double *variance;   /* (K, d) */
    double *count;      /* (K,) */
    i64 *first, *end;   /* (K,), the columns of the Jacobian that are not zero */
} row;

/* Variance of every sample, and how many independent ones it is worth. */
static void measured_once(row r, i64 scales, const double *scale, const double *thinning,
                          const i64 *group, const double *measured, const double *common,
                          const double *block)
{
    for (i64 k = 0; k < r.samples; k++) {
        const double *own = scale + group[k] * scales;
        double ratio = 0.0;
        for (i64 c = 0; c < r.outputs; c++) {
            double square = own[scales > 1 ? c : 0] * own[scales > 1 ? c : 0];
            double error = common ? common[k * r.outputs + c] : 0.0;
            r.variance[k * r.outputs + c] = square + error;
            ratio += error / square / r.outputs;
        }
        double thinned = thinning[group[k]];
        r.count[k] = common ? measured[k] * (1.0 + ratio) / (thinned + block[k] * ratio)
                            : measured[k] / thinned;
    }
}

static void columns(row r, const double *jacobian)
{
    for (i64 k = 0; k < r.samples; k++) {
        i64 first = r.size, end = 0;
        for (i64 c = 0; c < r.outputs; c++) {
            const double *own = jacobian + (k * r.outputs + c) * r.size;
            i64 i = 0, j = r.size;
            while (i < first && own[i] == 0.0) i++;
            while (j > end && own[j - 1] == 0.0) j--;
            if (i < first) first = i;
            if (j > end) end = j;
        }
        r.first[k] = first;
        r.end[k] = end;
    }
}

static double square_of(row r, i64 k, const double *left)
{
    double square = 0.0;
    for (i64 c = 0; c < r.outputs; c++) {
        double own = left[k * r.outputs + c];
        square += own * own / r.variance[k * r.outputs + c];
    }
    return square;
}

/* The upper triangle of the curvature a (P, P) and the slope b (P,), of the measured outputs. */
static void accumulated(row r, const double *residual, const double *jacobian, const double *left,
                        double *restrict a, double *restrict b)
{
    for (i64 k = 0; k < r.samples; k++) {
        if (r.count[k] == 0.0) continue;
        double weight = (r.freedom + r.outputs) / (r.freedom + square_of(r, k, left)) * r.count[k];
        i64 first = r.first[k], end = r.end[k];
        for (i64 c = 0; c < r.outputs; c++) {
            i64 at = k * r.outputs + c;
            const double *own = jacobian + at * r.size;
            double precision = weight / r.variance[at], error = residual[at];
            for (i64 i = first; i < end; i++) {
                double share = precision * own[i];
                if (share == 0.0) continue;
                b[i] += share * error;
                for (i64 j = i; j < end; j++) a[i * r.size + j] += share * own[j];
            }
        }
    }
}

/* The Cholesky factor of a, of which the upper triangle is given and overwritten, after it is scaled
   to a unit diagonal by `unit` (P,); 0 if a is not positive definite. */
static int factorised(i64 size, double *a, double *unit)
{
    for (i64 i = 0; i < size; i++) unit[i] = sqrt(a[i * size + i]);
    for (i64 i = 0; i < size; i++)
        for (i64 j = i; j < size; j++) a[i * size + j] /= unit[i] * unit[j];
    for (i64 i = 0; i < size; i++) {
        double *own = a + i * size;
        if (!(own[i] > 0.0)) return 0;
        double pivot = 1.0 / sqrt(own[i]);
        for (i64 j = i; j < size; j++) own[j] *= pivot;
        for (i64 k = i + 1; k < size; k++)
            for (i64 j = k; j < size; j++) a[k * size + j] -= own[k] * own[j];
    }
    return 1;
}

/* The solution of a x = b, written over b, from the factor of a; 0 if it is not finite. */
static int solved(i64 size, const double *a, double *b, const double *unit)
{
    for (i64 i = 0; i < size; i++) {
        b[i] = b[i] / unit[i] / a[i * size + i];
        for (i64 j = i + 1; j < size; j++) b[j] -= a[i * size + j] * b[i] * unit[j];
    }
    for (i64 i = size - 1; i >= 0; i--) {
        for (i64 j = i + 1; j < size; j++) b[i] -= a[i * size + j] * b[j];
        b[i] /= a[i * size + i];
        if (!isfinite(b[i])) return 0;
    }
    for (i64 i = 0; i < size; i++) b[i] /= unit[i];
    return 1;
}

static double log_determinant_of(i64 size, const double *a, const double *unit)
{
    double sum = 0.0;
    for (i64 i = 0; i < size; i++) sum += 2.0 * log(a[i * size + i] * unit[i]);
    return sum;
}

/* What is left of the residual after a move (P,). */
static void after(row r, const double *residual, const double *jacobian, const double *move,
                  double *left)
{
    for (i64 k = 0; k < r.samples; k++)
        for (i64 c = 0; c < r.outputs; c++) {
            const double *own = jacobian + (k * r.outputs + c) * r.size;
            double predicted = 0.0;
            for (i64 i = r.first[k]; i < r.end[k]; i++) predicted += own[i] * move[i];
            left[k * r.outputs + c] = residual[k * r.outputs + c] - predicted;
        }
}

/* Minus the log posterior, up to the density of noise and prior at 0. */
static double objective_of(row r, const double *left, const double *x, const double *mean,
                           const double *precision)
{
    double total = 0.0, both = r.freedom + r.outputs;
    for (i64 k = 0; k < r.samples; k++)
        if (r.count[k] != 0.0)
            total += 0.5 * both * log1p(square_of(r, k, left) / r.freedom) * r.count[k];
    for (i64 i = 0; i < r.size; i++) {
        double slope = 0.0;
        for (i64 j = 0; j < r.size; j++) slope += precision[i * r.size + j] * (x[j] - mean[j]);
        total += 0.5 * slope * (x[i] - mean[i]);
    }
    return total;
}

/* Objectives (n,) at x (n, P), with the residuals (n, K, d) there. */
EXPORT void objectives(i64 n, i64 samples, i64 outputs, i64 size, i64 scales, double freedom,
                       const double *scale, const double *thinning, const i64 *group,
                       const double *measured, const double *common, const double *block,
                       const double *residual, const double *x, const double *mean,
                       const double *precision, double *objective)
{
    i64 all = samples * outputs;
    double *room = malloc((all + samples) * sizeof(double));
    row r = {samples, outputs, size, freedom, room, room + all, 0, 0};
    for (i64 m = 0; m < n; m++) {
        measured_once(r, scales, scale, thinning, group + m * samples, measured + m * samples,
                      common ? common + m * all : 0, block ? block + m * samples : 0);
        objective[m] = objective_of(r, residual + m * all, x + m * size, mean + m * size,
                                    precision + m * size * size);
    }
    free(room);
}

static double bounded(double value, double low, double high)
{
    return value < low ? low : value > high ? high : value;
}

/* Steps from x (n, P) on: where they end, the objective that is predicted there, the curvature before
   the step and the logarithm of its determinant; `done` is 0 for a row whose equations could not be solved. */
EXPORT void gauss_newton(i64 n, i64 samples, i64 outputs, i64 size, i64 scales, i64 rounds,
                         double freedom, const double *scale, const double *thinning,
                         const double *lower, const double *upper, const double *largest,
                         const i64 *group, const double *measured, const double *common,
                         const double *block, const double *residual, const double *jacobian,
                         const double *x, const double *mean, const double *precision,
                         const double *damping, double *there, double *objective,
                         double *curvature, double *determinant, unsigned char *done)
{
    i64 all = samples * outputs, square = size * size;
    double *room = malloc((2 * all + samples + square + 3 * size) * sizeof(double));
    double *left = room + all, *a = left + all + samples, *b = a + square, *unit = b + size;
    double *gradient = unit + size;
    i64 *ends = malloc(2 * samples * sizeof(i64));
    row r = {samples, outputs, size, freedom, room, left + all, ends, ends + samples};
    for (i64 m = 0; m < n; m++) {
        measured_once(r, scales, scale, thinning, group, measured, common, block);
        columns(r, jacobian);
        memcpy(left, residual, all * sizeof(double));
        for (i64 i = 0; i < size; i++) {
            gradient[i] = 0.0;
            for (i64 j = 0; j < size; j++) gradient[i] += precision[i * size + j] * (x[j] - mean[j]);
        }
        done[m] = 1;
        for (i64 round = 0; round < rounds && done[m]; round++) {
            memcpy(a, precision, square * sizeof(double));
            for (i64 i = 0; i < size; i++) b[i] = -gradient[i];
            accumulated(r, residual, jacobian, left, a, b);
            if (!round) {
                for (i64 i = 0; i < size; i++)
                    for (i64 j = i; j < size; j++)
                        curvature[i * size + j] = curvature[j * size + i] = a[i * size + j];
                if (!(done[m] = (unsigned char)factorised(size, a, unit))) break;
                determinant[m] = log_determinant_of(size, a, unit);
                memcpy(a, curvature, square * sizeof(double));
            }
            if (damping)
                for (i64 i = 0; i < size; i++) a[i * size + i] *= 1.0 + damping[m];
            done[m] = factorised(size, a, unit) && solved(size, a, b, unit);
            after(r, residual, jacobian, b, left);
        }
        for (i64 i = 0; i < size; i++) {
            double move = bounded(b[i], -largest[i], largest[i]);
            there[i] = bounded(x[i] + move, lower[i], upper[i]);
            b[i] = there[i] - x[i];
        }
        after(r, residual, jacobian, b, left);
        objective[m] = objective_of(r, left, there, mean, precision);
        group += samples;
        measured += samples;
        common = common ? common + all : common;
        block = block ? block + samples : block;
        residual += all;
        jacobian += all * size;
        x += size;
        mean += size;
        precision += square;
        there += size;
        curvature += square;
    }
    free(ends);
    free(room);
}
