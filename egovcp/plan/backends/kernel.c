/* Layers of the planning network on rows of candidates, in 8-bit integers.
 *
 * A wide input row x (K numbers) is kept as x = scale * (u - zero) + offset with u in 0..255: zero and
 * offset belong to its kind, scale to the row. Weights are w = weight_scale[n] * i, i in -127..127,
 * in blocks [N/16][K/4][16][4] of which one vector register holds the last two axes. Few, exact
 * inputs (the action above all) stay in float32. One thread, no state, no allocation. */
#include <math.h>
#include <stdint.h>
#include <string.h>
#if defined(__AVX512VNNI__)
#include <immintrin.h>
#endif

enum { BLOCK = 8, LANES = 16, WIDEST = 1024 };

typedef struct {
    int32_t inputs;       /* K, a multiple of 4; 0: there is no such input */
    const int8_t *weight; /* [N/16][K/4][16][4] */
    const float *scale;   /* [N] */
    const int32_t *start; /* [N] -zero * sum of the column's integers */
    const float *shift;   /* [N] offset * sum of the column's weights */
} Wide;

typedef struct {
    int32_t outputs; /* N, a multiple of 16 */
    Wide wide[2];
    int32_t narrow;             /* inputs in float32 */
    const float *narrow_weight; /* [narrow][N] */
    const float *gamma, *beta;  /* [N] of the normalisation */
    float epsilon;
    int32_t last;             /* outputs of a linear layer on top, a multiple of 16; 0: none */
    const float *last_weight; /* [N][last] */
    const float *last_bias;   /* [last] */
} Layer;

typedef struct {
    const uint8_t *values; /* [rows][K] */
    const float *scale;    /* [rows] */
} Bytes;

typedef float Floats __attribute__((vector_size(4 * LANES)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));

static inline Floats load(const float *x) {
    Floats v;
    memcpy(&v, x, sizeof v);
    return v;
}

static inline void store(float *x, Floats v) { memcpy(x, &v, sizeof v); }

static inline Floats larger(Floats a, Floats b) {
#if defined(__AVX512F__)
    return (Floats)_mm512_max_ps((__m512)a, (__m512)b);
#else
    Ints first = a > b;
    return (Floats)((first & (Ints)a) | (~first & (Ints)b));
#endif
}

static inline Floats smaller(Floats a, Floats b) {
#if defined(__AVX512F__)
    return (Floats)_mm512_min_ps((__m512)a, (__m512)b);
#else
    return -larger(-a, -b);
#endif
}

static inline Floats absolute(Floats a) { return (Floats)((Ints)a & 0x7fffffff); }

static inline float total(Floats v) {
#if defined(__AVX512F__)
    return _mm512_reduce_add_ps((__m512)v);
#else
    float sum = 0.0f;
    for (int i = 0; i < LANES; i++) sum += v[i];
    return sum;
#endif
}

/* 1 / x of normal numbers. */
static inline Floats reciprocal(Floats x) {
#if defined(__AVX512F__)
    Floats guess = (Floats)_mm512_rcp14_ps((__m512)x);
    return guess * (2.0f - x * guess); /* one Newton step: 28 bits */
#else
    return 1.0f / x;
#endif
}

/* exp(x) within 5e-6 of its value; beyond what float32 holds, its least and largest powers of 2. */
static inline Floats exponential(Floats x) {
    Floats limit = (Floats){0} + 126.0f;
    x = smaller(larger(x * 1.44269504f, -limit), limit);
    Ints power = __builtin_convertvector(x + 127.5f, Ints); /* rounds x: it is positive here */
    Floats t = (x - __builtin_convertvector(power - 127, Floats)) * 0.693147181f;
    Floats series = 1.0f + t * (1.0f + t * (0.5f + t * (0.16666667f + t * (0.041666668f + t * 0.0083333338f))));
    return series * (Floats)(power << 23);
}

static inline Floats sigmoid(Floats x) { return reciprocal(1.0f + exponential(-x)); }

/* Dot products of a block of rows, its bytes in fours [K/4][BLOCK], with `columns` times 16 outputs. */
static inline __attribute__((always_inline)) void dots(const Wide *w, int n, int columns,
                                                       const int32_t *fours, Ints dot[][BLOCK]) {
    const int quads = w->inputs / 4;
    const int8_t *weight = w->weight + (int64_t)n * w->inputs;
    for (int c = 0; c < columns; c++) {
        Ints start;
        memcpy(&start, w->start + n + c * LANES, sizeof start);
        for (int r = 0; r < BLOCK; r++) dot[c][r] = start;
    }
    for (int q = 0; q < quads; q++)
        for (int c = 0; c < columns; c++) {
            const int8_t *four_by_lane = weight + ((int64_t)c * quads + q) * 4 * LANES;
#if defined(__AVX512VNNI__)
            const __m512i b = _mm512_loadu_si512(four_by_lane);
            for (int r = 0; r < BLOCK; r++)
                dot[c][r] = (Ints)_mm512_dpbusd_epi32(
                    (__m512i)dot[c][r], _mm512_set1_epi32(fours[q * BLOCK + r]), b);
#else
            for (int r = 0; r < BLOCK; r++) {
                const uint8_t *x = (const uint8_t *)(fours + q * BLOCK + r);
                for (int i = 0; i < LANES; i++)
                    for (int j = 0; j < 4; j++)
                        dot[c][r][i] += (int32_t)x[j] * four_by_lane[4 * i + j];
            }
#endif
        }
}

static inline __attribute__((always_inline)) void add_products(const Wide *w, int n, int columns,
                                                               int n_outputs, const int32_t *fours,
                                                               const float *scale, float *y) {
    Ints dot[2][BLOCK];
    dots(w, n, columns, fours, dot);
    for (int c = 0; c < columns; c++, n += LANES) {
        const Floats weight_scale = load(w->scale + n), shift = load(w->shift + n);
        for (int r = 0; r < BLOCK; r++) {
            float *out = y + (int64_t)r * n_outputs + n;
            Floats product = __builtin_convertvector(dot[c][r], Floats) * weight_scale;
            store(out, load(out) + scale[r] * product + shift);
        }
    }
}

/* y [BLOCK][N] += the product of `count` rows with one wide weight. */
static void wide_product(const Wide *w, int n_outputs, Bytes in, int row, int count, float *y) {
    int32_t fours[BLOCK * WIDEST / 4];
    float scale[BLOCK];
    for (int r = 0; r < BLOCK; r++) {
        const int from = row + (r < count ? r : 0); /* rows beyond the last repeat the first */
        const uint8_t *x = in.values + (int64_t)from * w->inputs;
        scale[r] = in.scale[from];
        for (int q = 0; q < w->inputs / 4; q++) memcpy(fours + q * BLOCK + r, x + 4 * q, 4);
    }
    int n = 0;
    for (; n + 2 * LANES <= n_outputs; n += 2 * LANES)
        add_products(w, n, 2, n_outputs, fours, scale, y);
    for (; n < n_outputs; n += LANES) add_products(w, n, 1, n_outputs, fours, scale, y);
}

/* y [BLOCK][N] += the product of `count` rows with the narrow weight. */
static void narrow_product(const Layer *l, const float *narrow, int row, int count, float *y) {
    const int n_outputs = l->outputs;
    const float *x[BLOCK];
    for (int r = 0; r < BLOCK; r++) x[r] = narrow + (int64_t)(row + (r < count ? r : 0)) * l->narrow;
    for (int n = 0; n < n_outputs; n += LANES) {
        Floats acc[BLOCK];
        for (int r = 0; r < BLOCK; r++) acc[r] = load(y + (int64_t)r * n_outputs + n);
        for (int k = 0; k < l->narrow; k++) {
            const Floats weight = load(l->narrow_weight + (int64_t)k * n_outputs + n);
            for (int r = 0; r < BLOCK; r++) acc[r] += x[r][k] * weight;
        }
        for (int r = 0; r < BLOCK; r++) store(y + (int64_t)r * n_outputs + n, acc[r]);
    }
}

/* y [BLOCK][N] = add + all products; rows from `count` on repeat the first. */
static void sums(const Layer *l, const Bytes *in, const float *narrow, const float *add, int row,
                 int count, float *y) {
    for (int r = 0; r < BLOCK; r++) {
        float *out = y + (int64_t)r * l->outputs;
        if (add) memcpy(out, add, l->outputs * sizeof(float));
        else memset(out, 0, l->outputs * sizeof(float));
    }
    for (int i = 0; i < 2; i++)
        if (l->wide[i].inputs && in[i].values)
            wide_product(&l->wide[i], l->outputs, in[i], row, count, y);
    if (l->narrow) narrow_product(l, narrow, row, count, y);
}

/* Means and reciprocal deviations of a block of rows of sums, as the layer normalises them. */
static void moments(const Layer *l, const float *y, float *mean, float *rate) {
    for (int r = 0; r < BLOCK; r++) {
        const float *from = y + (int64_t)r * l->outputs;
        Floats even = {0}, odd = {0};
        int i = 0;
        for (; i + 2 * LANES <= l->outputs; i += 2 * LANES) {
            even += load(from + i);
            odd += load(from + i + LANES);
        }
        if (i < l->outputs) even += load(from + i);
        mean[r] = total(even + odd) / (float)l->outputs;
    }
    for (int r = 0; r < BLOCK; r++) {
        const float *from = y + (int64_t)r * l->outputs;
        Floats squares = {0};
        for (int i = 0; i < l->outputs; i += LANES) {
            const Floats beside = load(from + i) - mean[r];
            squares += beside * beside;
        }
        rate[r] = 1.0f / sqrtf(total(squares) / (float)l->outputs + l->epsilon);
    }
}

static inline Floats normal(const Layer *l, const float *y, int i, float mean, float rate) {
    return (load(y + i) - mean) * rate * load(l->gamma + i) + load(l->beta + i);
}

/* One row as bytes, x = scale * (u - zero) + offset; `most` bounds x - offset, or |x| if zero > 0. */
static float to_bytes(const float *x, int count, float most, float zero, float offset, uint8_t *u) {
    most = most > 1e-6f ? most : 1e-6f;
    const float scale = most / (255.0f - zero), rate = 1.0f / scale;
    for (int n = 0; n < count; n += LANES) {
        Floats v = (load(x + n) - offset) * rate + (zero + 0.5f);
        v = smaller(larger(v, (Floats){0}), (Floats){0} + 255.0f);
        Ints whole = __builtin_convertvector(v, Ints);
#if defined(__AVX512F__)
        _mm_storeu_si128((__m128i *)(u + n), _mm512_cvtepi32_epi8((__m512i)whole));
#else
        for (int i = 0; i < LANES; i++) u[n + i] = (uint8_t)whole[i];
#endif
    }
    return scale;
}

static float highest(Floats v) {
#if defined(__AVX512F__)
    return _mm512_reduce_max_ps((__m512)v);
#else
    float most = v[0];
    for (int i = 1; i < LANES; i++) most = v[i] > most ? v[i] : most;
    return most;
#endif
}

/* A block of rows y [BLOCK][N] through the layer on top. */
static void last_layer(const Layer *l, const float *y, int row, int count, float *numbers) {
    for (int j = 0; j < l->last; j += LANES) {
        Floats acc[BLOCK];
        for (int r = 0; r < BLOCK; r++) acc[r] = load(l->last_bias + j);
        for (int n = 0; n < l->outputs; n++) {
            const Floats weight = load(l->last_weight + (int64_t)n * l->last + j);
            for (int r = 0; r < BLOCK; r++) acc[r] += y[r * l->outputs + n] * weight;
        }
        for (int r = 0; r < count; r++)
            store(numbers + (int64_t)(row + r) * l->last + j, acc[r]);
    }
}

/* Linear, LayerNorm, SiLU on rows; the result as bytes (`bytes`, `scale`) or, a linear layer further,
 * as numbers (`numbers` [rows][last]); either may be null. */
void hidden(const Layer *l, int rows, const uint8_t *values, const float *scales,
            const float *narrow, const float *add, float offset, uint8_t *bytes, float *scale,
            float *numbers) {
    float y[BLOCK * WIDEST] __attribute__((aligned(64)));
    float mean[BLOCK], rate[BLOCK];
    const Bytes in[2] = {{values, scales}, {0, 0}};
    for (int row = 0; row < rows; row += BLOCK) {
        const int count = rows - row < BLOCK ? rows - row : BLOCK;
        sums(l, in, narrow, add, row, count, y);
        moments(l, y, mean, rate);
        for (int r = 0; r < count; r++) {
            float *out = y + (int64_t)r * l->outputs;
            Floats most = {0};
            for (int i = 0; i < l->outputs; i += LANES) {
                Floats v = normal(l, out, i, mean[r], rate[r]);
                v *= sigmoid(v);
                store(out + i, v);
                most = larger(most, v);
            }
            if (bytes)
                scale[row + r] = to_bytes(out, l->outputs, highest(most) - offset, 0.0f, offset,
                                          bytes + (int64_t)(row + r) * l->outputs);
        }
        if (numbers) last_layer(l, y, row, count, numbers);
    }
}

/* The recurrence: gates from the layer's normalised sums (reset, candidate, update), h [rows][N/3]
 * (`stride` 0: one row for all) -> `next`, also as bytes. */
void recur(const Layer *l, int rows, const uint8_t *x, const float *x_scale, const uint8_t *hb,
           const float *h_scale, const float *add, const float *h, int stride, float *next,
           uint8_t *bytes, float *scale) {
    float y[BLOCK * WIDEST] __attribute__((aligned(64)));
    float mean[BLOCK], rate[BLOCK];
    const Bytes in[2] = {{x, x_scale}, {hb, h_scale}};
    const int size = l->outputs / 3;
    for (int row = 0; row < rows; row += BLOCK) {
        const int count = rows - row < BLOCK ? rows - row : BLOCK;
        sums(l, in, 0, add, row, count, y);
        moments(l, y, mean, rate);
        for (int r = 0; r < count; r++) {
            float *out = y + (int64_t)r * l->outputs, *to = next + (int64_t)(row + r) * size;
            const float *from = h + (int64_t)(row + r) * stride;
            Floats most = {0};
            for (int i = 0; i < size; i += LANES) {
                Floats reset = sigmoid(normal(l, out, i, mean[r], rate[r]));
                Floats candidate = normal(l, out, size + i, mean[r], rate[r]);
                Floats update = sigmoid(normal(l, out, 2 * size + i, mean[r], rate[r]));
                candidate = 2.0f * sigmoid(2.0f * reset * candidate) - 1.0f; /* tanh */
                Floats old = load(from + i), v = old + update * (candidate - old);
                store(to + i, v);
                most = larger(most, absolute(v));
            }
            scale[row + r] = to_bytes(to, size, highest(most), 128.0f, 0.0f, bytes + (int64_t)(row + r) * size);
        }
    }
}

/* out [rows][last] = add + x [rows][inputs] weight; add is one row for all, or null: what is in `out`. */
void linear(int rows, int inputs, const float *x, int last, const float *weight, const float *add,
            float *out) {
    for (int row = 0; row < rows; row += BLOCK) {
        const int count = rows - row < BLOCK ? rows - row : BLOCK;
        for (int j = 0; j < last; j += LANES) {
            Floats acc[BLOCK];
            const float *from[BLOCK];
            for (int r = 0; r < BLOCK; r++) {
                const int here = row + (r < count ? r : 0);
                acc[r] = load(add ? add + j : out + (int64_t)here * last + j);
                from[r] = x + (int64_t)here * inputs;
            }
            for (int k = 0; k < inputs; k++) {
                const Floats w = load(weight + (int64_t)k * last + j);
                for (int r = 0; r < BLOCK; r++) acc[r] += from[r][k] * w;
            }
            for (int r = 0; r < count; r++)
                store(out + (int64_t)(row + r) * last + j, acc[r]);
        }
    }
}
