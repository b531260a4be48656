/* A dense network with SiLU activations, in single precision: BLOCK inputs at a time, so that their
   activations stay in the processor's nearest cache. `network.py` packs its weights. */

/* As many as a register holds: gcc keeps longer vectors in memory, which takes 20 times as long. */
#if defined __AVX512F__
#define LANES 16
#elif defined __AVX__
#define LANES 8
#else
#define LANES 4
#endif
#define VECTORS 2
#define BLOCK (LANES * VECTORS)
#define OUTPUTS 6 /* outputs of a layer that are computed together, in registers */

typedef float vector __attribute__((vector_size(4 * LANES)));
typedef int whole __attribute__((vector_size(4 * LANES)));

typedef struct {
    i64 layers;
    const i64 *widths;                                  /* layers + 1 */
    const float *mean, *scale, *out_mean, *out_scale;   /* standardisation */
    const float *weights;
    i64 widest;
} network;

static network unpacked(const i64 *widths, const float *numbers)
{
    i64 layers = widths[0], inputs = widths[1], outputs = widths[1 + layers], widest = 0;
    for (i64 i = 1; i <= layers + 1; i++) {
        i64 padded = (widths[i] + OUTPUTS - 1) / OUTPUTS * OUTPUTS;
        widest = padded > widest ? padded : widest;
    }
    const float *out = numbers + 2 * inputs;
    network net = {layers, widths + 1, numbers, numbers + inputs, out, out + outputs,
                   out + 2 * outputs, widest};
    return net;
}

/* 1 / (1 + exp(-x)); exp by a polynomial of the part of the exponent below one half. */
static inline vector sigmoid(vector x)
{
    const float magic = 12582912.0f; /* 1.5 * 2^23: the sum's last bits are the nearest integer */
    vector e = -x, one = x * 0.0f + 1.0f;
    vector high = one * 87.0f, low = one * -87.0f;
    e = (vector)(((whole)e & (e < high)) | ((whole)high & ~(e < high)));
    e = (vector)(((whole)e & (e > low)) | ((whole)low & ~(e > low)));
    vector shifted = e * 1.44269504f + magic, n = shifted - magic;
    vector r = e - n * 0.693145752f - n * 1.42860677e-6f;
    vector p = 1.98756912e-4f * r + 1.39819994e-3f;
    p = p * r + 8.33345205e-3f;
    p = p * r + 4.16657962e-2f;
    p = p * r + 0.166666657f;
    p = p * r + 0.5f;
    p = p * r * r + r + 1.0f;
    whole exponent = ((whole)shifted - 0x4B400000) << 23;
    return one / (one + (vector)((whole)p + exponent));
}

enum kind { ACTIVATED, LINEAR, TANGENT }; /* the last without the constant term */

/* Inputs x (in, BLOCK) to outputs y (out, BLOCK), both rounded up to whole groups of OUTPUTS. */
static void layer(const float *w, i64 in, i64 out, const float *x, float *y, enum kind kind)
{
    float constant = kind == TANGENT ? 0.0f : 1.0f;
    for (i64 j = 0; j < out; j += OUTPUTS, w += OUTPUTS * (in + 1)) {
        vector sum[OUTPUTS][VECTORS];
        for (int o = 0; o < OUTPUTS; o++)
            for (int k = 0; k < VECTORS; k++) sum[o][k] = (vector){0} + constant * w[OUTPUTS * in + o];
        const float *row = w;
        for (i64 i = 0; i < in; i++, row += OUTPUTS) {
            const vector *value = (const vector *)(x + i * BLOCK);
            for (int o = 0; o < OUTPUTS; o++)
                for (int k = 0; k < VECTORS; k++) sum[o][k] += value[k] * row[o];
        }
        for (int o = 0; o < OUTPUTS; o++)
            for (int k = 0; k < VECTORS; k++)
                ((vector *)(y + (j + o) * BLOCK))[k] =
                    kind == ACTIVATED ? sum[o][k] * sigmoid(sum[o][k]) : sum[o][k];
    }
}

static size_t scratch_bytes(network net) { return 2 * net.widest * BLOCK * sizeof(float) + 64; }

/* Commands in standard units (d_u, BLOCK); the last of fewer than BLOCK is repeated. */
static void standardised(network net, i64 count, const float *u, float *x)
{
    i64 inputs = net.widths[0];
    for (i64 c = 0; c < inputs; c++)
        for (i64 k = 0; k < BLOCK; k++)
            x[c * BLOCK + k] =
                (u[(k < count ? k : count - 1) * inputs + c] - net.mean[c]) / net.scale[c];
}

/* Outputs (m, d_y) of commands (m, d_u). */
static void evaluate(network net, i64 m, const float *u, float *y, void *scratch)
{
    float *a = (float *)(((size_t)scratch + 63) & ~(size_t)63), *b = a + net.widest * BLOCK;
    i64 inputs = net.widths[0], outputs = net.widths[net.layers];
    for (i64 begin = 0; begin < m; begin += BLOCK) {
        i64 count = m - begin < BLOCK ? m - begin : BLOCK;
        standardised(net, count, u + begin * inputs, a);
        const float *w = net.weights;
        for (i64 l = 0; l < net.layers; l++) {
            i64 in = net.widths[l], out = net.widths[l + 1];
            layer(w, in, out, a, b, l + 1 == net.layers ? LINEAR : ACTIVATED);
            w += (out + OUTPUTS - 1) / OUTPUTS * OUTPUTS * (in + 1);
            float *other = a;
            a = b;
            b = other;
        }
        for (i64 k = 0; k < count; k++)
            for (i64 c = 0; c < outputs; c++)
                y[(begin + k) * outputs + c] =
                    a[c * BLOCK + k] * net.out_scale[c] + net.out_mean[c];
    }
}

/* The derivative of x sigmoid(x) times tangents t (d, widest, BLOCK), and x sigmoid(x) itself. */
static void activated(i64 out, i64 d, i64 widest, float *x, float *t)
{
    for (i64 j = 0; j < out * VECTORS; j++) {
        vector value = ((vector *)x)[j], share = sigmoid(value), one = value * 0.0f + 1.0f;
        vector slope = share * (one + value * (one - share));
        ((vector *)x)[j] = value * share;
        for (i64 c = 0; c < d; c++) ((vector *)(t + c * widest * BLOCK))[j] *= slope;
    }
}

static size_t sloped_bytes(network net)
{
    return 2 * (1 + net.widths[0]) * net.widest * BLOCK * sizeof(float) + 64;
}

/* Outputs (m, d_y) of commands (m, d_u), and their Jacobians (m, d_y, d_u), in forward mode. */
static void sloped(network net, i64 m, const float *u, float *y, float *jacobian, void *scratch)
{
    i64 d = net.widths[0], outputs = net.widths[net.layers], size = net.widest * BLOCK;
    float *a = (float *)(((size_t)scratch + 63) & ~(size_t)63), *b = a + (1 + d) * size;
    for (i64 begin = 0; begin < m; begin += BLOCK) {
        i64 count = m - begin < BLOCK ? m - begin : BLOCK;
        standardised(net, count, u + begin * d, a);
        memset(a + size, 0, d * size * sizeof(float));
        for (i64 c = 0; c < d; c++)
            for (i64 k = 0; k < BLOCK; k++) a[(1 + c) * size + c * BLOCK + k] = 1.0f / net.scale[c];
        const float *w = net.weights;
        for (i64 l = 0; l < net.layers; l++) {
            i64 in = net.widths[l], out = net.widths[l + 1];
            i64 padded = (out + OUTPUTS - 1) / OUTPUTS * OUTPUTS;
            layer(w, in, out, a, b, LINEAR);
            for (i64 c = 1; c <= d; c++) layer(w, in, out, a + c * size, b + c * size, TANGENT);
            if (l + 1 < net.layers) activated(padded, d, net.widest, b, b + size);
            w += padded * (in + 1);
            float *other = a;
            a = b;
            b = other;
        }
        for (i64 k = 0; k < count; k++)
            for (i64 o = 0; o < outputs; o++) {
                i64 at = (begin + k) * outputs + o;
                y[at] = a[o * BLOCK + k] * net.out_scale[o] + net.out_mean[o];
                for (i64 c = 0; c < d; c++)
                    jacobian[at * d + c] = a[(1 + c) * size + o * BLOCK + k] * net.out_scale[o];
            }
    }
}

EXPORT void slopes(i64 m, double unused, const i64 *widths, const float *numbers, const float *u,
                   float *y, float *jacobian)
{
    network net = unpacked(widths, numbers);
    void *scratch = malloc(sloped_bytes(net));
    (void)unused;
    sloped(net, m, u, y, jacobian, scratch);
    free(scratch);
}
