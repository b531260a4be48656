/* Effective commands and the Jacobian of a memoryless network's outputs by delays and offsets of
   segments; see `_linearised` in `retwin.update.corrections.commands.problem`, which is the same in
   torch and explains it. */

typedef struct {
    i64 steps, segments, samples, d;
    int own;                       /* whether every actuator has a delay of its own */
    const double *size;            /* (d,) */
    const double *columns;         /* (d, T) with delays of their own, else (T, d): the reference */
    const double *start, *settle;  /* (M,) */
    i64 count;
    const double *frozen, *times;  /* (d,), (S,) */
    double *room, *z, *some;       /* working space */
    i64 *first, *end;              /* (M,), the samples that each segment's latent variables move */
} executor;

/* Widens the samples that a step of a segment's latent variables moves by those of one actuator, or
   of all: from the knot before it, to the end of the next segment if what is before is forgotten
   there. `target` (2 M,) are the knots. */
static void reached(executor e, const double *target, const double *missed, double step)
{
    double last = e.times[e.samples - 1];
    int lasting = 0;
    for (i64 c = 0; c < e.d; c++) lasting |= e.frozen[c] <= last;
    for (i64 m = 0; m < e.count; m++) {
        i64 first = 0, end = e.samples, next = m + 1;
        if (m)
            while (first < e.samples && e.times[first] < target[2 * m - 1]) first++;
        int forgotten = next < e.count && !lasting;
        for (i64 c = 0; c < e.d && forgotten; c++) forgotten = missed[next * e.d + c] == 0.0;
        if (forgotten) {
            double settled = target[2 * next + 1];
            /* A segment that waits for the one before is moved with it, and so may those after. */
            forgotten = settled > target[2 * next] && settled > target[2 * m + 1] + step;
            if (forgotten)
                while (end > first && e.times[end - 1] >= settled) end--;
        }
        e.first[m] = first < e.first[m] ? first : e.first[m];
        e.end[m] = end > e.end[m] ? end : e.end[m];
    }
}

/* The commands (S, d_u) at the samples from `first` to before `end`; the others stay. With a `step`
   above 0, what one of that size moves is found. */
static void executed_commands(executor e, const double *x, const double *missed, i64 first, i64 end,
                              double step, double *out)
{
    if (end <= first) return;
    i64 d = e.d, width = 1 + d + (e.own ? d : 0), each = e.own ? 1 : d;
    for (i64 c = 0; c < d; c += each) {
        for (i64 m = 0; m < e.segments; m++) {
            const double *of = x + m * width;
            double *z = e.z + m * (1 + 2 * each);
            z[0] = of[0] + (e.own ? of[1 + d + c] : 0.0);
            for (i64 k = 0; k < each; k++) {
                z[1 + k] = of[1 + c + k];
                z[1 + each + k] = missed[m * d + c + k];
            }
        }
        actuators a = {e.steps, each, e.columns + (e.own ? c * e.steps : 0), e.size + c, 0, 0, 0};
        effective(a, e.segments, e.count, e.start, e.settle, e.z, e.frozen + c, end - first,
                  e.times + first, e.room, e.own ? e.some : out + first * d);
        if (step > 0.0) reached(e, e.room + 2 * e.segments, missed, step);
        if (e.own)
            for (i64 k = first; k < end; k++) out[k * d + c] = e.some[k - first];
    }
}

/* Of one row: the network's outputs and Jacobian at the commands that differ from the sample before,
   in single precision, and the `place` of each sample among them. */
static void different(network net, i64 samples, const double *now, float *points, i64 *place,
                      float *outputs, float *by_command, void *scratch)
{
    i64 d = net.widths[0], count = 0;
    for (i64 k = 0; k < samples; k++) {
        float *point = points + count * d;
        for (i64 c = 0; c < d; c++) point[c] = (float)now[k * d + c];
        count += !(k && !memcmp(point, point - d, d * sizeof(float)));
        place[k] = count - 1;
    }
    sloped(net, count, points, outputs, by_command, scratch);
}

/* Outputs (n, S, d_y) and their Jacobian (n, S, d_y, P) by x (n, P), both in `unit`. The times of a
   row are in order. */
EXPORT void linearised(i64 n, i64 steps, i64 segments, i64 samples, i64 own, double step,
                       const i64 *widths, const float *numbers, const double *size,
                       const double *unit, const double *reference, const double *start,
                       const double *settle, const i64 *count, const double *x,
                       const double *missed, const double *frozen, const double *times,
                       double *found, double *jacobian)
{
    network net = unpacked(widths, numbers);
    i64 d = net.widths[0], outputs = net.widths[net.layers], all = samples * d;
    i64 width = 1 + d + (own ? d : 0), latent = segments * width;
    double *room = malloc((doubles_of(segments, d) + segments * (1 + 2 * d) + samples + 3 * all
                           + latent + steps * d) * sizeof(double));
    double *z = room + doubles_of(segments, d), *some = z + segments * (1 + 2 * d);
    double *now = some + samples, *late = now + all, *off = late + all;
    double *moved = off + all, *columns = moved + latent;
    float *values = malloc((samples * outputs * (1 + d) + all) * sizeof(float));
    float *by_command = values + samples * outputs, *points = by_command + samples * outputs * d;
    void *scratch = malloc(sloped_bytes(net));
    i64 *ends = malloc((2 * segments + samples + 1) * sizeof(i64)), *at = ends + 2 * segments;
    for (i64 row = 0; row < n; row++, reference += steps * d, x += latent) {
        if (own)
            for (i64 t = 0; t < steps; t++)
                for (i64 c = 0; c < d; c++) columns[c * steps + t] = reference[t * d + c];
        executor e = {steps, segments, samples, d, (int)own, size, own ? columns : reference,
                      start + row * segments, settle + row * segments, count[row],
                      frozen + row * d, times + row * samples, room, z, some, ends,
                      ends + segments};
        const double *without = missed + row * segments * d;
        for (i64 m = 0; m < segments; m++) {
            e.first[m] = samples;
            e.end[m] = 0;
        }
        executed_commands(e, x, without, 0, samples, step, now);
        different(net, samples, now, points, at, values, by_command, scratch);
        for (i64 k = 0; k < samples; k++, found += outputs)
            for (i64 o = 0; o < outputs; o++) found[o] = values[at[k] * outputs + o] / unit[o];
        memcpy(moved, x, latent * sizeof(double));
        memset(jacobian, 0, samples * outputs * latent * sizeof(double));
        for (i64 m = 0; m < e.count; m++) {
            double *here = moved + m * width;
            here[0] += step;
            executed_commands(e, moved, without, e.first[m], e.end[m], 0.0, late);
            here[0] = x[m * width];
            for (i64 c = 0; c < d; c++) here[1 + c] += step;
            executed_commands(e, moved, without, e.first[m], e.end[m], 0.0, off);
            for (i64 c = 0; c < d; c++) here[1 + c] = x[m * width + 1 + c];
            for (i64 k = e.first[m]; k < e.end[m]; k++)
                for (i64 o = 0; o < outputs; o++) {
                    const float *slope = by_command + (at[k] * outputs + o) * d;
                    double *to = jacobian + (k * outputs + o) * latent + m * width;
                    for (i64 c = 0; c < d; c++) {
                        double by = slope[c] / unit[o], from = now[k * d + c];
                        double delay = by * ((late[k * d + c] - from) / step);
                        to[0] += delay;
                        to[1 + c] = by * ((off[k * d + c] - from) / step);
                        if (own) to[1 + d + c] = delay;
                    }
                }
        }
        jacobian += samples * outputs * latent;
    }
    free(ends);
    free(scratch);
    free(values);
    free(room);
}
