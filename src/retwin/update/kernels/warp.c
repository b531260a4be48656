/* Warped time, effective commands and records of sampled values; see `warp.py`,
   `effective_commands.py` and `sampled_sensor.py` in `retwin.update.corrections`, which are the
   same in torch and explain it. */
#define STILL 1e-6

typedef struct {
    i64 segments, count, last;       /* at most, those that exist, and the last knot */
    const double *start, *settle;
    double *source, *target;         /* (2 segments,), the knots */
} warp;

static warp warped_time(i64 segments, i64 count, const double *start, const double *settle,
                        const double *z, i64 width, double *knots)
{
    warp w = {segments, count, count ? 2 * count - 1 : 0, start, settle, knots,
              knots + 2 * segments};
    for (i64 m = 0; m < segments; m++) {
        double delay = m < count ? z[m * width] : 0.0;
        w.source[2 * m] = start[m];
        w.source[2 * m + 1] = settle[m];
        for (i64 k = 2 * m; k < 2 * m + 2; k++) {
            w.target[k] = w.source[k] + delay;
            if (k && w.target[k] < w.target[k - 1]) w.target[k] = w.target[k - 1];
        }
    }
    return w;
}

/* The number of rising `values` (n,) that are not above t. */
static i64 not_above(const double *values, i64 n, double t)
{
    i64 k = 0;
    while (k < n && values[k] <= t) k++;
    return k;
}

/* The knot before t, the one after it, and the place between them, from 0 to 1. */
static double between(warp w, double t, i64 *before, i64 *after)
{
    i64 right = not_above(w.target, 2 * w.segments, t);
    right = right < w.last + 1 ? right : w.last + 1;
    *before = right ? right - 1 : 0;
    *after = right < w.last ? right : w.last;
    double length = w.target[*after] - w.target[*before];
    double share = (t - w.target[*before]) / (length > 1e-9 ? length : 1e-9);
    return share < 0.0 ? 0.0 : share > 1.0 ? 1.0 : share;
}

static double source_time(warp w, double t, i64 before, i64 after, double share)
{
    double time = w.source[before] + share * (w.source[after] - w.source[before]);
    if (t < w.target[0]) time += t - w.target[0];
    if (t > w.target[w.last]) time += t - w.target[w.last];
    return time;
}

/* A path (T, d) at a fractional sample, held beyond its ends. */
static void interpolated(const double *path, i64 steps, i64 d, double t, double *out)
{
    t = t < 0.0 ? 0.0 : t > steps - 1 ? steps - 1 : t;
    i64 below = (i64)t;
    if (below > steps - 2) below = steps > 1 ? steps - 2 : 0;
    double share = t - below;
    const double *left = path + below * d, *right = steps > 1 ? left + d : left;
    for (i64 c = 0; c < d; c++) out[c] = left[c] + share * (right[c] - left[c]);
}

static const double *doubled(i64 n, const float *from, double *to)
{
    for (i64 k = 0; k < n; k++) to[k] = from[k];
    return to;
}

/* The path delayed and offset by z (M, 1 + d), at every sample. */
EXPORT void delayed(i64 n, i64 steps, i64 segments, i64 d, double unused, const float *path,
                    const double *start, const double *settle, const i64 *count, const float *z,
                    float *out)
{
    i64 width = segments * (1 + d);
    double *knots = malloc((4 * segments + d + width + steps * d) * sizeof(double));
    double *value = knots + 4 * segments, *own = value + d, *whole_path = own + width;
    (void)unused;
    for (i64 row = 0; row < n; row++, start += segments, settle += segments) {
        doubled(width, z + row * width, own);
        doubled(steps * d, path + row * steps * d, whole_path);
        warp w = warped_time(segments, count[row], start, settle, own, 1 + d, knots);
        for (i64 k = 0; k < steps; k++, out += d) {
            i64 before, after;
            double share = between(w, k, &before, &after);
            interpolated(whole_path, steps, d, source_time(w, k, before, after, share), value);
            /* A knot has the offset of its segment if it is the settling, of the one before if not. */
            i64 a = (before + 1) / 2 - 1, b = (after + 1) / 2 - 1;
            for (i64 c = 0; c < d; c++) {
                double left = before ? own[a * (1 + d) + 1 + c] : 0.0;
                double right = after ? own[b * (1 + d) + 1 + c] : 0.0;
                out[c] = (float)(value[c] + left + share * (right - left));
            }
        }
    }
    free(knots);
}

typedef struct {
    i64 steps, width;
    const double *reference;
    const double *size;                  /* (d_u,), the largest command of each actuator */
    double *first, *last, *error;        /* (M, d_u) twice, and (1 + M, d_u) */
} actuators;

/* Commands at the ends of the segments, and the error of every actuator after each. */
static void errors(actuators a, warp w, const double *z)
{
    i64 d = a.width;
    for (i64 c = 0; c < d; c++) a.error[c] = 0.0;
    for (i64 m = 0; m < w.segments; m++, z += 1 + 2 * d) {
        interpolated(a.reference, a.steps, d, w.start[m], a.first + m * d);
        interpolated(a.reference, a.steps, d, w.settle[m], a.last + m * d);
        for (i64 c = 0; c < d; c++) {
            double stays = a.first[m * d + c] + a.error[m * d + c] - a.last[m * d + c];
            double offset = z[1 + c], missed = z[1 + d + c];
            a.error[(m + 1) * d + c] = offset + missed * (stays - offset);
        }
    }
}

/* The effective commands (d_u,) at a time of actuators that no fault holds. */
static void moving(actuators a, warp w, double t, double *out)
{
    i64 d = a.width, before, after;
    if (!w.segments) {
        interpolated(a.reference, a.steps, d, t, out);
        return;
    }
    double share = between(w, t, &before, &after);
    double source = source_time(w, t, before, after, share);
    interpolated(a.reference, a.steps, d, source, out);
    i64 index = not_above(w.start, w.segments, source);
    index = index < w.count ? index : w.count;
    if (!index) return;
    i64 m = index - 1;
    double begin = w.start[m], end = w.settle[m], length = end - begin;
    for (i64 c = 0; c < d; c++) {
        double from = a.first[m * d + c], span = a.last[m * d + c] - from, covered;
        if (fabs(span) > STILL * a.size[c])
            covered = (out[c] - from) / span;
        else
            covered = (source - begin) / (length > 1e-9 ? length : 1e-9);
        covered = covered < 0.0 ? 0.0 : covered > 1.0 ? 1.0 : covered;
        if (source >= end) covered = 1.0;
        double early = a.error[m * d + c], late = a.error[(m + 1) * d + c];
        out[c] += early + covered * (late - early);
    }
}

/* Room for the doubles of one trajectory: knots, ends of the segments, errors, held commands. */
static i64 doubles_of(i64 segments, i64 d) { return 4 * segments + (3 * segments + 1 + d) * d; }

/* The effective commands (S, d_u) of one trajectory at times (S,), held from `frozen` (d_u,) on. */
static void effective(actuators a, i64 segments, i64 count, const double *start,
                      const double *settle, const double *z, const double *frozen, i64 samples,
                      const double *times, double *room, double *out)
{
    i64 d = a.width;
    double *held = room + 4 * segments + (3 * segments + 1) * d;
    warp w = warped_time(segments, count, start, settle, z, 1 + 2 * d, room);
    a.first = room + 4 * segments;
    a.last = a.first + segments * d;
    a.error = a.last + segments * d;
    errors(a, w, z);
    for (i64 c = 0; c < d; c++)
        if (frozen[c] <= times[samples - 1]) moving(a, w, frozen[c], held + c * d);
    for (i64 k = 0; k < samples; k++, out += d) {
        moving(a, w, times[k], out);
        for (i64 c = 0; c < d; c++)
            if (times[k] >= frozen[c]) out[c] = held[c * d + c];
    }
}

/* Effective commands (n, S, d_u); row i of the others has row source[i] of the reference. The
   times of a row are in order. */
EXPORT void commands(i64 n, i64 steps, i64 segments, i64 samples, i64 d, double unused,
                     const double *size, const double *reference, const i64 *source,
                     const double *start, const double *settle, const i64 *count, const double *z,
                     const double *frozen, const double *times, double *out)
{
    double *room = malloc(doubles_of(segments, d) * sizeof(double));
    (void)unused;
    for (i64 row = 0; row < n; row++) {
        actuators a = {steps, d, reference + source[row] * steps * d, size, 0, 0, 0};
        effective(a, segments, count[row], start + row * segments, settle + row * segments,
                  z + row * segments * (1 + 2 * d), frozen + row * d, samples,
                  times + row * samples, room, out + row * samples * d);
    }
    free(room);
}

/* The network's outputs (n, S, d_y) for the effective commands at times `when` (n, S), in order. */
EXPORT void executed(i64 n, i64 steps, i64 segments, i64 samples, double unused, const i64 *widths,
                     const float *numbers, const double *size, const float *reference,
                     const double *start, const double *settle, const i64 *count, const float *z,
                     const double *frozen, const double *when, float *out)
{
    network net = unpacked(widths, numbers);
    i64 d = net.widths[0], outputs = net.widths[net.layers], all = GROUP * samples;
    i64 width = segments * (1 + 2 * d);
    void *scratch = malloc(scratch_bytes(net));
    double *room = malloc((doubles_of(segments, d) + width + (steps + samples) * d) * sizeof(double));
    double *own = room + doubles_of(segments, d), *sent = own + width, *now = sent + steps * d;
    float *points = malloc(all * (d + outputs) * sizeof(float)), *values = points + all * d;
    i64 *place = malloc(all * sizeof(i64));
    (void)unused;
    for (i64 done = 0; done < n; done += GROUP) {
        i64 rows = n - done < GROUP ? n - done : GROUP, different = 0;
        for (i64 row = done; row < done + rows; row++) {
            actuators a = {steps, d, doubled(steps * d, reference + row * steps * d, sent), size,
                           0, 0, 0};
            effective(a, segments, count[row], start + row * segments, settle + row * segments,
                      doubled(width, z + row * width, own), frozen + row * d, samples,
                      when + row * samples, room, now);
            for (i64 k = 0; k < samples; k++) {
                float *point = points + different * d;
                for (i64 c = 0; c < d; c++) point[c] = (float)now[k * d + c];
                different += !(k && !memcmp(point, point - d, d * sizeof(float)));
                place[(row - done) * samples + k] = different - 1;
            }
        }
        evaluate(net, different, points, values, scratch);
        for (i64 k = 0; k < rows * samples; k++, out += outputs)
            memcpy(out, values + place[k] * outputs, outputs * sizeof(float));
    }
    free(place);
    free(points);
    free(room);
    free(scratch);
}

/* The record (n, T, d) of values (n, R, d), the first at sample `phase` (n,), joined linearly. */
EXPORT void joined(i64 n, i64 steps, i64 samples, i64 every, i64 d, double unused,
                   const float *values, const i64 *phase, float *out)
{
    (void)unused;
    for (i64 row = 0; row < n; row++, values += samples * d) {
        i64 last = (steps - 1 - phase[row]) / every;
        for (i64 t = 0; t < steps; t++, out += d) {
            i64 since = t > phase[row] ? t - phase[row] : 0, k = since / every;
            i64 following = k + 1 < last ? k + 1 : last;
            float share = (float)(since % every) / every;
            const float *left = values + k * d, *right = values + following * d;
            for (i64 c = 0; c < d; c++) out[c] = left[c] + share * (right[c] - left[c]);
        }
    }
}
