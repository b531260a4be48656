/* The network along piecewise-linear commands; see `retwin.update.piecewise_linear`, which is the
   same in torch and explains it. Here a ramp gets as many points as its length in standard units
   suggests, and more until the last coefficients are small. */
#define GROUP 8 /* trajectories that are evaluated together, to fill whole blocks of the network */
#define MAX_POINTS 24
#define MIN_POINTS 5
#define ROUNDING (4.0f * 1.1920929e-7f)
#define STRIDE 4
#define AT_ONCE 16
#define PI 3.14159265358979323846

typedef struct {
    i64 begin, length, points; /* points: 1 for a hold, `length` where each sample is evaluated */
} piece;

static inline float rounding(float a, float b)
{
    a = fabsf(a);
    b = fabsf(b);
    return ROUNDING * (a > b ? a : b);
}

/* Marks of one trajectory: 1 where a linear piece begins, 2 where commands differ from before. */
static void marked(i64 steps, i64 d, const float *u, unsigned char *mark, unsigned char *each)
{
    i64 end = (steps - 1) * d;
    for (i64 i = d; i < end; i++) {
        float before = u[i - d], now = u[i], after = u[i + d];
        each[i] = (fabsf((after - now) - (now - before)) > rounding(before, after))
                  | (now != before) << 1;
    }
    for (i64 i = end; i < end + d; i++) each[i] = 1 | (u[i] != u[i - d]) << 1;
    mark[0] = 1;
    for (i64 k = 1; k < steps; k++) {
        mark[k] = 0;
        for (i64 c = 0; c < d; c++) mark[k] |= each[k * d + c];
    }
    mark[steps - 1] |= 1;
}

/* Number of points for a piece of a trajectory. */
static i64 first_points(network net, const float *u, i64 d, const unsigned char *mark, i64 begin,
                        i64 n, float density)
{
    int held = 1;
    for (i64 k = begin + 1; k < begin + n; k++) held &= !(mark[k] & 2);
    if (held) return 1;
    const float *start = u + begin * d, *stop = start + n * d;
    float farthest = 0.0f;
    for (i64 c = 0; c < d; c++) {
        float distance = fabsf(stop[c] - start[c]) / net.scale[c];
        farthest = distance > farthest ? distance : farthest;
    }
    i64 points = MIN_POINTS + (i64)ceilf(density * farthest);
    points = points < MAX_POINTS ? points : MAX_POINTS;
    if (points >= n) return n;
    for (i64 k = 0; k < n; k += STRIDE)
        for (i64 c = 0; c < d; c++) {
            float chord = start[c] + (float)k / n * (stop[c] - start[c]);
            if (fabsf(start[k * d + c] - chord) > rounding(start[c], stop[c])) return n;
        }
    return points;
}

/* Chebyshev points of every number of points, rising from -1 to 1. */
typedef double places[MAX_POINTS + 1][MAX_POINTS];

static void placed_all(places x)
{
    for (i64 n = 1; n <= MAX_POINTS; n++)
        for (i64 k = 0; k < n; k++) x[n][k] = -cos(PI * (k + 0.5) / n);
}

/* Commands at the points of a piece, which are appended to `points`. */
static float *placed(piece p, const float *u, i64 d, places x, float *points)
{
    const float *start = u + p.begin * d, *stop = start + p.length * d;
    if (p.points == 1 || p.points == p.length) {
        memcpy(points, start, p.points * d * sizeof(float));
        return points + p.points * d;
    }
    for (i64 k = 0; k < p.points; k++) {
        float at = (float)(0.5 + 0.5 * x[p.points][k]);
        for (i64 c = 0; c < d; c++) *points++ = start[c] + at * (stop[c] - start[c]);
    }
    return points;
}

/* Chebyshev coefficients a (n,) of the polynomial through values at the points. */
static void coefficients(i64 n, const double *x, const float *values, i64 d, double *a)
{
    for (i64 m = 0; m < n; m++) a[m] = 0.0;
    for (i64 k = 0; k < n; k++) {
        double value = values[k * d] * 2.0 / n, t = 1.0, following = x[k];
        for (i64 m = 0; m < n; m++) {
            a[m] += value * t;
            double after = 2.0 * x[k] * following - t;
            t = following;
            following = after;
        }
    }
    a[0] *= 0.5;
}

/* The polynomial at `length` places evenly from -1 on, by Clenshaw's recurrence, AT_ONCE together. */
static void polynomial(i64 n, const double *a, i64 length, i64 d, float *y)
{
    for (i64 begin = 0; begin < length; begin += AT_ONCE) {
        double x[AT_ONCE], b1[AT_ONCE], b2[AT_ONCE];
        for (int k = 0; k < AT_ONCE; k++) {
            x[k] = 4.0 * (begin + k) / length - 2.0;
            b1[k] = b2[k] = 0.0;
        }
        for (i64 m = n - 1; m > 0; m--)
            for (int k = 0; k < AT_ONCE; k++) {
                double b0 = a[m] + x[k] * b1[k] - b2[k];
                b2[k] = b1[k];
                b1[k] = b0;
            }
        for (int k = 0; k < AT_ONCE && begin + k < length; k++)
            y[(begin + k) * d] = (float)(a[0] + 0.5 * x[k] * b1[k] - b2[k]);
    }
}

/* Outputs at all samples of a piece, from the values at its points; 0 if these are too few. */
static int filled(piece p, i64 d, const float *values, places x, const float *tolerance, float *y)
{
    y += p.begin * d;
    if (p.points == p.length) {
        memcpy(y, values, p.length * d * sizeof(float));
        return 1;
    }
    if (p.points == 1) {
        for (i64 k = 0; k < p.length; k++)
            for (i64 c = 0; c < d; c++) y[k * d + c] = values[c];
        return 1;
    }
    for (i64 c = 0; c < d; c++) {
        double a[MAX_POINTS];
        i64 n = p.points;
        coefficients(n, x[n], values + c, d, a);
        if (fabs(a[n - 1]) > tolerance[c] || fabs(a[n - 2]) > tolerance[c]) return 0;
        polynomial(n, a, p.length, d, y + c);
    }
    return 1;
}

/* Outputs (n, T, d_y) of commands (n, T, d_u). `tolerance` is that of the coefficients, (d_y,). */
EXPORT void pieces(i64 n, i64 steps, double density, const i64 *widths, const float *numbers,
                   const float *tolerance, const float *u, float *y)
{
    network net = unpacked(widths, numbers);
    i64 in = net.widths[0], out = net.widths[net.layers];
    places x;
    placed_all(x);
    void *scratch = malloc(scratch_bytes(net));
    float *points = malloc(GROUP * steps * in * sizeof(float));
    float *values = malloc(GROUP * steps * out * sizeof(float));
    piece *all = malloc(GROUP * steps * sizeof(piece));
    unsigned char *mark = malloc(steps * (1 + in));
    for (i64 first = 0; first < n; first += GROUP, u += GROUP * steps * in, y += GROUP * steps * out) {
        i64 rows = (n - first < GROUP ? n - first : GROUP), count = 0, left = 0;
        for (i64 row = 0; row < rows; row++) {
            const float *own = u + row * steps * in;
            marked(steps, in, own, mark, mark + steps);
            for (i64 begin = 0, end; begin < steps; begin = end) {
                for (end = begin + 1; end < steps && !(mark[end] & 1);) end++;
                i64 wanted = first_points(net, own, in, mark, begin, end - begin, (float)density);
                all[count++] = (piece){begin + row * steps, end - begin, wanted};
            }
        }
        while (count) {
            float *end = points;
            for (i64 k = 0; k < count; k++) end = placed(all[k], u, in, x, end);
            evaluate(net, (end - points) / in, points, values, scratch);
            const float *value = values;
            left = 0;
            for (i64 k = 0; k < count; k++) {
                piece p = all[k];
                if (!filled(p, out, value, x, tolerance, y)) {
                    i64 more = p.points < MAX_POINTS ? p.points + p.points / 2 : p.length;
                    more = more < MAX_POINTS || more == p.length ? more : MAX_POINTS;
                    all[left++] = (piece){p.begin, p.length, more < p.length ? more : p.length};
                }
                value += p.points * out;
            }
            count = left;
        }
    }
    free(mark);
    free(all);
    free(values);
    free(points);
    free(scratch);
}
