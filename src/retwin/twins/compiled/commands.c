/* Ramps and holds, biased references, and extremes; `ramps.py`, `faults.py` and `command_range.py` in
   `retwin.twins` are the same in numpy, to the last digit, and explain them. */
#define LANES 256 /* values that are compared with as many others at once, whole samples of them */

static i64 bounded(double t, i64 low, i64 high)
{
    return t < low ? low : t > high ? high : (i64)t;
}

/* One ramp of `change` over `span` samples from `onset` on is added to samples `begin` to `end`. */
static void ramp(float *out, i64 d, i64 begin, i64 end, double level, double change, double onset,
                 double span)
{
    for (i64 k = begin; k < end; k++) {
        double share = (k - onset) / span;
        share = share < 0.0 ? 0.0 : share > 1.0 ? 1.0 : share;
        out[k * d] = (float)(level + change * share);
    }
}

/* Commands (n, T, d) from start (n, d), levels and spans (n, M, d) and onsets (n, M), NaN for none.
   A ramp that begins before the one before it has ended is not for this function: 0 in `done`. */
EXPORT void ramps(i64 n, i64 steps, i64 segments, i64 d, double unused, const double *start,
                  const double *levels, const double *spans, const double *onsets, float *out,
                  unsigned char *done)
{
    (void)unused;
    for (i64 row = 0; row < n; row++) {
        done[row] = 1;
        for (i64 c = 0; c < d; c++) {
            double level = start[row * d + c], before = level;
            i64 filled = 0;
            for (i64 m = 0; m < segments; m++) {
                i64 at = (row * segments + m) * d + c;
                double onset = onsets[row * segments + m], change = levels[at] - before;
                before = levels[at];
                if (isnan(onset)) continue;
                i64 begin = bounded(ceil(onset), 0, steps);
                i64 end = bounded(ceil(onset + spans[at]), begin, steps);
                if (begin < filled) done[row] = 0;
                for (; filled < begin; filled++) out[filled * d + c] = (float)level;
                ramp(out + c, d, filled, end, level, change, onset, spans[at]);
                filled = end > filled ? end : filled;
                level += change;
            }
            for (; filled < steps; filled++) out[filled * d + c] = (float)level;
        }
        out += steps * d;
    }
}

/* As numpy.interp of one command (T,) at a fractional sample. */
static double interpolated(const float *command, i64 steps, i64 d, double t)
{
    if (t <= 0.0) return command[0];
    if (t >= steps - 1) return command[(steps - 1) * d];
    i64 k = (i64)t;
    double left = command[k * d], slope = command[(k + 1) * d] - left;
    return slope * (t - k) + left;
}

/* The bias of one actuator of each trajectory, from level to level as its command goes, is added to
   `out` (n, T, d); an actuator below 0 is none. */
EXPORT void biases(i64 n, i64 steps, i64 segments, i64 d, double unused, const i64 *actuators,
                   const double *start, const double *settle, const i64 *count,
                   const double *levels, const float *commands, float *out)
{
    (void)unused;
    for (i64 row = 0; row < n; row++) {
        i64 actuator = actuators[row], offset = row * steps * d + actuator;
        if (actuator < 0) continue;
        const float *clean = commands + offset;
        float *biased = out + offset;
        double before = 0.0, held = 0.0;
        i64 filled = 0;
        for (i64 m = 0; m < count[row]; m++) {
            i64 at = row * segments + m;
            double begin = start[at], end = settle[at], level = levels[at];
            double first = interpolated(clean, steps, d, begin);
            double last = interpolated(clean, steps, d, end);
            double length = end - begin > 1.0 ? end - begin : 1.0;
            i64 from = bounded(ceil(begin), 0, steps);
            i64 to = bounded(ceil(first != last ? end : begin + length), from, steps);
            for (; filled < from; filled++)
                biased[filled * d] = (float)(clean[filled * d] + held);
            for (i64 k = from; k < to; k++) {
                double share = first != last ? (clean[k * d] - first) / (last - first)
                                             : (k - begin) / length;
                share = share < 0.0 ? 0.0 : share > 1.0 ? 1.0 : share;
                biased[k * d] = (float)(clean[k * d] + (before + (level - before) * share));
            }
            filled = to;
            held = before + (level - before);
            before = level;
        }
        for (; filled < steps; filled++) biased[filled * d] = (float)(clean[filled * d] + held);
    }
}

/* Least and greatest value and greatest change by one sample, (n, d) each, of values (n, T, d) with
   d up to LANES. Of a trajectory with NaN, `done` is 0. */
EXPORT void extremes(i64 n, i64 steps, i64 d, double unused, const float *values, float *least,
                     float *greatest, float *change, unsigned char *done)
{
    (void)unused;
    i64 lanes = LANES / d * d, size = steps * d;
    for (i64 row = 0; row < n; row++, values += size) {
        float low[LANES], high[LANES], step[LANES];
        int unknown = 0;
        for (i64 j = 0; j < lanes; j++) {
            low[j] = high[j] = values[j % d];
            step[j] = 0.0f;
        }
        i64 i = 0;
        for (; i + lanes + d <= size; i += lanes) {
            const float *here = values + i, *next = here + d;
            for (i64 j = 0; j < lanes; j++) {
                float value = here[j], moved = fabsf(next[j] - value);
                low[j] = value < low[j] ? value : low[j];
                high[j] = value > high[j] ? value : high[j];
                step[j] = moved > step[j] ? moved : step[j];
                unknown |= value != value;
            }
        }
        for (; i < size; i++) {
            float value = values[i], moved = i + d < size ? fabsf(values[i + d] - value) : 0.0f;
            i64 c = i % d;
            low[c] = value < low[c] ? value : low[c];
            high[c] = value > high[c] ? value : high[c];
            step[c] = moved > step[c] ? moved : step[c];
            unknown |= value != value;
        }
        for (i64 j = d; j < lanes; j++) {
            i64 c = j % d;
            low[c] = low[j] < low[c] ? low[j] : low[c];
            high[c] = high[j] > high[c] ? high[j] : high[c];
            step[c] = step[j] > step[c] ? step[j] : step[c];
        }
        memcpy(least + row * d, low, d * sizeof(float));
        memcpy(greatest + row * d, high, d * sizeof(float));
        memcpy(change + row * d, step, d * sizeof(float));
        done[row] = !unknown;
    }
}
