/* Networks from sample to sample, in double precision. Each reads its weights in the order of their
 * use and returns where they end; what it remembers lies in `memory`, and `first` is not 0 at the
 * first sample. Above this text stand WIDEST, the widest layer, and USES_MLP, ... for each kind. */

/* out = W in + b, with W[to][from]; b[to] follows it where `bias` is not 0. */
static const float *dense(const float *w, int bias, int from, int to, const double *in, double *out)
{
    const float *b = w + (size_t)from * (size_t)to;
    for (int i = 0; i < to; i++, w += from) {
        double sum = bias ? b[i] : 0.0;
        for (int j = 0; j < from; j++)
            sum += w[j] * in[j];
        out[i] = sum;
    }
    return bias ? b + to : b;
}

static double logistic(double x)
{
    return 1.0 / (1.0 + exp(-x));
}

static void silu(int size, double *x)
{
    for (int i = 0; i < size; i++)
        x[i] *= logistic(x[i]);
}

#ifdef USES_MLP
/* Dense layers, widths[0] to widths[layers]. */
static const float *mlp(const float *w, int layers, const int *widths, const double *in,
                        double *memory, int first, double *out)
{
    double state[WIDEST], made[WIDEST];
    (void)memory, (void)first;
    memcpy(state, in, (size_t)widths[0] * sizeof *in);
    for (int i = 0; i + 1 < layers; i++) {
        w = dense(w, 1, widths[i], widths[i + 1], state, made);
        silu(widths[i + 1], made);
        memcpy(state, made, (size_t)widths[i + 1] * sizeof *made);
    }
    return dense(w, 1, widths[layers - 1], widths[layers], state, out);
}
#endif

#ifdef USES_LSTM
/* memory[layers][2][hidden], h and c of each layer; gates in the order input, forget, cell, output. */
static const float *lstm(const float *w, int from, int hidden, int layers, int to, const double *in,
                         double *memory, int first, double *out)
{
    double both[WIDEST], gates[WIDEST];
    const double *below = in;
    (void)first;
    for (int layer = 0, width = from; layer < layers; layer++, width = hidden, memory += 2 * hidden) {
        double *h = memory, *c = memory + hidden;
        memcpy(both, below, (size_t)width * sizeof *both);
        memcpy(both + width, h, (size_t)hidden * sizeof *both);
        w = dense(w, 1, width + hidden, 4 * hidden, both, gates);
        for (int i = 0; i < hidden; i++) {
            c[i] = logistic(gates[hidden + i]) * c[i]
                   + logistic(gates[i]) * tanh(gates[2 * hidden + i]);
            h[i] = logistic(gates[3 * hidden + i]) * tanh(c[i]);
        }
        below = h;
    }
    memcpy(both, below, (size_t)hidden * sizeof *both);
    w = dense(w, 1, from, hidden, in, both + hidden);
    w = dense(w, 1, 2 * hidden, hidden, both, gates);
    silu(hidden, gates);
    return dense(w, 1, hidden, to, gates, out);
}
#endif

#ifdef USES_TCN
/* memory: of each level its last (kernel - 1) 2^level states, the oldest first. */
static const float *tcn(const float *w, int from, int channels, int kernel, int levels, int to,
                        const double *in, double *memory, int first, double *out)
{
    double state[WIDEST], window[WIDEST], made[WIDEST], mixed[WIDEST];
    size_t size = (size_t)channels;
    w = dense(w, 1, from, channels, in, state);
    for (int level = 0; level < levels; level++) {
        size_t dilation = (size_t)1 << level, past = (size_t)(kernel - 1) * dilation;
        for (size_t i = 0; first && i < past; i++)
            memcpy(memory + i * size, state, size * sizeof *state);
        for (size_t tap = 0; tap + 1 < (size_t)kernel; tap++)
            memcpy(window + tap * size, memory + tap * dilation * size, size * sizeof *state);
        memcpy(window + (size_t)(kernel - 1) * size, state, size * sizeof *state);
        if (past > 0) {
            memmove(memory, memory + size, (past - 1) * size * sizeof *state);
            memcpy(memory + (past - 1) * size, state, size * sizeof *state);
        }
        w = dense(w, 1, kernel * channels, channels, window, made);
        silu(channels, made);
        w = dense(w, 1, channels, channels, made, mixed);
        for (int i = 0; i < channels; i++)
            state[i] += mixed[i];
        memory += past * size;
    }
    silu(channels, state);
    return dense(w, 1, channels, to, state, out);
}
#endif

#ifdef USES_STATE_SPACE
/* memory[states]; the weights begin with the first states and their inverse time constants. */
static const float *state_space(const float *w, int from, int states, int hidden, int to,
                                const double *in, double *memory, int first, double *out)
{
    double entered[WIDEST], now[WIDEST], inside[WIDEST], moved[WIDEST];
    const float *inverse_times = w + states;
    for (int i = 0; first && i < states; i++)
        memory[i] = w[i];
    w = dense(w + 2 * states, 1, states, hidden, memory, inside);
    silu(hidden, inside);
    w = dense(w, 1, hidden, to, inside, out);
    w = dense(w, 0, states, to, memory, moved);
    for (int i = 0; i < to; i++)
        out[i] += moved[i];
    w = dense(w, 1, from, states + hidden, in, entered);
    w = dense(w, 0, states, states + hidden, memory, now);
    for (int i = 0; i < hidden; i++)
        inside[i] = tanh(entered[states + i] + now[states + i]);
    w = dense(w, 0, hidden, states, inside, moved);
    for (int i = 0; i < states; i++)
        memory[i] += inverse_times[i] * (entered[i] + now[i] + moved[i]);
    return w;
}
#endif
