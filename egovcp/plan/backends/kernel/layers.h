/* Layers of a block of candidates: products with weights, activations, and shared prefixes. */
#pragma once
#include "network.h"

#if defined(TILES)
/* Configures tiles of 16 rows of 64 bytes for the calling thread. */
static void take_tiles(void) {
    struct {
        uint8_t palette, start, reserved[14];
        uint16_t bytes[16];
        uint8_t rows[16];
    } tiles __attribute__((aligned(64))) = {.palette = 1};
    for (int i = 0; i < 8; i++) tiles.bytes[i] = 4 * LANES, tiles.rows[i] = ROWS;
    _tile_loadconfig(&tiles);
}

static void release_tiles(void) { _tile_release(); }

/* Dot products of a block of rows with `columns` (COLUMNS or 1) times LANES outputs, starting at `n`. */
INLINE void dots(const Wide *w, int n, int columns, const Bytes *in, Ints dot[][ROWS]) {
    const int8_t *weight = w->weight + (int64_t)n * w->inputs;
    const int column = LANES * w->inputs, tile = LANES * DEPTH, each = 4 * LANES;
    _tile_loadd(0, w->start + n, 0); /* the same for all rows */
    if (columns > 1) {
        _tile_loadd(1, w->start + n + LANES, 0);
        _tile_loadd(2, w->start + n + 2 * LANES, 0);
        _tile_loadd(3, w->start + n + 3 * LANES, 0);
    }
    for (int k = 0; k < w->inputs; k += DEPTH, weight += tile) {
        _tile_loadd(4, in->values[0] + k, MAX_WIDE);
        _tile_loadd(5, weight, each);
        _tile_dpbusd(0, 4, 5);
        if (columns > 1) {
            _tile_loadd(6, weight + column, each);
            _tile_dpbusd(1, 4, 6);
            _tile_loadd(7, weight + 2 * column, each);
            _tile_dpbusd(2, 4, 7);
            _tile_loadd(5, weight + 3 * column, each);
            _tile_dpbusd(3, 4, 5);
        }
    }
    _tile_stored(0, dot[0], each);
    if (columns > 1) {
        _tile_stored(1, dot[1], each);
        _tile_stored(2, dot[2], each);
        _tile_stored(3, dot[3], each);
    }
}
#else
static void take_tiles(void) {}

static void release_tiles(void) {}

/* Dot products of a block of rows with `columns` times LANES outputs, starting at `n`. */
INLINE void dots(const Wide *w, int n, int columns, const Bytes *in, Ints dot[][ROWS]) {
    const int groups = w->inputs / GROUP;
    const int8_t *weight = w->weight + (int64_t)n * w->inputs;
    for (int c = 0; c < columns; c++) {
        Ints start;
        memcpy(&start, w->start + n + c * LANES, sizeof start);
        for (int r = 0; r < ROWS; r++) dot[c][r] = start;
    }
    for (int g = 0; g < groups; g++) {
#if defined(WIDE_VECTORS)
        __m512i b[COLUMNS];
        for (int c = 0; c < columns; c++)
            b[c] = _mm512_loadu_si512(weight + ((int64_t)c * groups + g) * GROUP * LANES);
        for (int r = 0; r < ROWS; r++) {
            int32_t four;
            memcpy(&four, in->values[r] + GROUP * g, sizeof four);
            const __m512i x = _mm512_set1_epi32(four);
            for (int c = 0; c < columns; c++)
                dot[c][r] = (Ints)_mm512_dpbusd_epi32((__m512i)dot[c][r], x, b[c]);
        }
#elif defined(HALF_VECTORS)
        for (int c = 0; c < columns; c++) {
            const int8_t *two_by_lane = weight + ((int64_t)c * groups + g) * GROUP * LANES;
            const __m256i b = _mm256_cvtepi8_epi16(_mm_loadu_si128((const __m128i *)two_by_lane));
            for (int r = 0; r < ROWS; r++)
                dot[c][r] = pairs(dot[c][r], repeated(in->values[r] + GROUP * g), (Words)b);
        }
#else
        for (int c = 0; c < columns; c++) {
            const int8_t *group_by_lane = weight + ((int64_t)c * groups + g) * GROUP * LANES;
            for (int r = 0; r < ROWS; r++)
                for (int i = 0; i < LANES; i++)
                    for (int j = 0; j < GROUP; j++)
                        dot[c][r][i] +=
                            (int32_t)in->values[r][GROUP * g + j] * group_by_lane[GROUP * i + j];
        }
#endif
    }
}
#endif

INLINE void columns_of_product(const Wide *w, int n, int columns, const Bytes *in, const float *from,
                               int from_stride, float *y, int stride) {
    Ints dot[COLUMNS][ROWS];
    dots(w, n, columns, in, dot);
    for (int c = 0; c < columns; c++, n += LANES) {
        const Floats weight_scale = load(w->scale + n), shift = load(w->shift + n);
        for (int r = 0; r < ROWS; r++) {
            const Floats product = __builtin_convertvector(dot[c][r], Floats) * weight_scale;
            const Floats start = load(from + r * from_stride + n) + shift;
            store(y + r * stride + n, fused(all_floats(in->scale[r]), product, start));
        }
    }
}

/* y [ROWS][N] = from + the product with a wide weight. */
static void wide_product(const Wide *w, int outputs, const Bytes *in, const float *from, int from_stride,
                         float *y) {
    int n = 0;
    for (; n + COLUMNS * LANES <= outputs; n += COLUMNS * LANES)
        columns_of_product(w, n, COLUMNS, in, from, from_stride, y, outputs);
    for (; n < outputs; n += LANES) columns_of_product(w, n, 1, in, from, from_stride, y, outputs);
}

enum { NARROW_COLUMNS = COLUMNS > 1 ? 2 : 1 };

INLINE void columns_of_narrow(const Narrow *w, int inputs, int outputs, int n, int columns,
                              const NarrowRows *x, const float *from, float *y) {
    Floats acc[NARROW_COLUMNS][ROWS];
    for (int c = 0; c < columns; c++)
        for (int r = 0; r < ROWS; r++) acc[c][r] = load(from + n + c * LANES);
    for (int k = 0; k < inputs; k++) {
        const float *weight = w->weight + (int64_t)k * outputs + n;
        for (int r = 0; r < ROWS; r++)
            for (int c = 0; c < columns; c++)
                acc[c][r] = fused(all_floats(x->values[r][k]), load(weight + c * LANES), acc[c][r]);
    }
    for (int c = 0; c < columns; c++)
        for (int r = 0; r < ROWS; r++) store(y + r * outputs + n + c * LANES, acc[c][r]);
}

/* y [ROWS][N] = from [N] + the product of the first `inputs` inputs with their weights. */
static void narrow_product(const Narrow *w, int inputs, int outputs, const NarrowRows *x,
                           const float *from, float *y) {
    int n = 0;
    for (; n + NARROW_COLUMNS * LANES <= outputs; n += NARROW_COLUMNS * LANES)
        columns_of_narrow(w, inputs, outputs, n, NARROW_COLUMNS, x, from, y);
    for (; n < outputs; n += LANES) columns_of_narrow(w, inputs, outputs, n, 1, x, from, y);
}

typedef struct { /* inputs of a layer; null: none, or included in `from` */
    const Bytes *wide, *second;
    const NarrowRows *narrow;
    int narrow_inputs; /* number of the narrow inputs that are used, from the first */
    const float *from; /* [N] partial sums, shared by all rows */
} Inputs;

static const float ZEROS[MAX_WIDE];

/* y [ROWS][N] = the sum of the products with all inputs. */
static void sums(const Layer *l, Inputs in, float *y) {
    const float *from = in.from ? in.from : ZEROS;
    int stride = 0;
    if (in.narrow && l->narrow.inputs) {
        narrow_product(&l->narrow, in.narrow_inputs, l->outputs, in.narrow, from, y);
        from = y, stride = l->outputs;
    }
    if (in.second && l->second.inputs) {
        wide_product(&l->second, l->outputs, in.second, from, stride, y);
        from = y, stride = l->outputs;
    }
    if (in.wide && l->wide.inputs) wide_product(&l->wide, l->outputs, in.wide, from, stride, y);
}

/* Reciprocal standard deviations of a block of centred sums. */
static inline void rates(const Layer *l, const float *y, float *rate) {
    Floats squares[ROWS] = {{0}};
    for (int i = 0; i < l->outputs; i += LANES)
        for (int r = 0; r < ROWS; r++) {
            const Floats v = load(y + r * l->outputs + i);
            squares[r] = fused(v, v, squares[r]);
        }
    for (int r = 0; r < ROWS; r++) rate[r] = total(squares[r]);
    for (int r = 0; r < ROWS; r++) rate[r] = 1.0f / sqrtf(rate[r] / (float)l->outputs + l->epsilon);
}

/* 32 sums of a row, normalised, in fixed point. */
INLINE Words normal(const float *y, Floats rate, const float *gamma, const float *beta) {
    return words_of(fused(load(y) * rate, load(gamma), load(beta)),
                    fused(load(y + LANES) * rate, load(gamma + LANES), load(beta + LANES)));
}

/* Linear, LayerNorm, SiLU: x [ROWS][N] in fixed point, and as bytes unless `bytes` is null. */
static void hidden(const Network *net, const Layer *l, Inputs in, Fixed *x, Bytes *bytes) {
    float y[(ROWS + 1) * MAX_WIDE] __attribute__((aligned(64))), rate[ROWS];
    const Lines lines = lines_of(net->silu);
    const float *gamma = l->gamma, *beta = l->beta;
    const int n = l->outputs;
    sums(l, in, y);
    rates(l, y, rate);
    for (int r = 0; r < ROWS; r++) {
        const Floats times = all_floats(rate[r]);
        Words most = all(0);
        for (int i = 0; i < n; i += WORDS) {
            Words v = silu(lines, normal(y + r * n + i, times, gamma + i, beta + i));
            if (i + WORDS > n) v = first(v, n - i);
            store_words(x->values[r] + i, v);
            most = larger(most, v);
        }
        if (bytes) bytes->scale[r] = bytes_of_hidden(x->values[r], n, highest(most), bytes->values[r]);
    }
}

/* The recurrence: gates (reset, candidate, update) from the layer's normalised sums; h [ROWS][N/3]
 * from `before` (stride 0: one row for all), also as bytes. A gate is 1/2 + tanh(x / 2) / 2. */
static void recur(const Network *net, Inputs in, const int16_t *before, int stride, Fixed *h,
                  Bytes *bytes) {
    float y[(ROWS + 1) * MAX_WIDE] __attribute__((aligned(64))), rate[ROWS];
    const Layer *l = &net->gru;
    const Lines lines = lines_of(net->tanh);
    const float *gamma = l->gamma, *beta = l->beta;
    const int size = net->hidden;
    sums(l, in, y);
    rates(l, y, rate);
    for (int r = 0; r < ROWS; r++) {
        const float *row = y + r * l->outputs;
        const Floats times = all_floats(rate[r]);
        Words most = all(0);
        for (int i = 0; i < size; i += WORDS) {
            Words gate[3];
            for (int g = 0; g < 3; g++)
                gate[g] = normal(row + g * size + i, times, gamma + g * size + i, beta + g * size + i);
            const Words reset = tanh_of(lines, gate[0]), update = tanh_of(lines, gate[2]);
            const Words twice = sum(gate[1], product(reset, gate[1])); /* 2^13 is 4 HIDDEN_ONE */
            const Words new = halved(tanh_of(lines, sum(twice, twice)), 1);
            const Words old = halved(load_words(before + r * stride + i), 1);
            Words v = larger(sum(sum(old, new), product(update, new - old)), all(-32767));
            if (i + WORDS > size) v = first(v, size - i);
            store_words(h->values[r] + i, v);
            most = larger(most, absolute(v));
        }
        bytes->scale[r] = bytes_of_state(h->values[r], size, highest(most), bytes->values[r]);
    }
}

/* out [ROWS] = x weight + bias. */
static void dot_product(const Dot *d, const Fixed *x, float *out) {
    for (int r = 0; r < ROWS; r++) {
        Ints sum = {0};
        for (int n = 0; n < d->inputs; n += WORDS)
            sum = pairs(sum, load_words(x->values[r] + n), load_words(d->weight + n));
        out[r] = total(__builtin_convertvector(sum, Floats)) * d->scale + d->bias;
    }
}

/* out [ROWS][outputs] = x weight + bias. */
static void top_product(const Top *t, const Bytes *x, float *out) {
    wide_product(&t->wide, t->outputs, x, t->bias, 0, out);
}

/* Sums of first layers that all candidates of a robot share, computed once per plan. */
typedef struct {
    int32_t hidden, latent;
    int32_t gates, heads, mix; /* sums of each; `heads`: of Q and of the reward */
    const float *h_weights;    /* [hidden][gates + heads] */
    const float *z_weights;    /* [latent][heads + mix] */
} PrefixWeights;

/* y [N] += x [K] weight [K][N]. */
static void add_product(int inputs, int outputs, const float *x, const float *weight, float *y) {
    for (int k = 0; k < inputs; k++, weight += outputs)
        for (int n = 0; n < outputs; n += LANES)
            store(y + n, fused(all_floats(x[k]), load(weight + n), load(y + n)));
}

/* h [hidden] in fixed point [hidden + 16], and the sums [gates + heads + mix] of h and z [latent], which
 * are zero on entry. Returns 0, or NaN if the state is not finite. */
float shared_prefix(const PrefixWeights *s, const float *h, const float *z, int16_t *words, float *sums) {
    const Floats one = all_floats(32768.0f);
    float nan_or_zero = 0.0f;
    for (int i = 0; i < s->hidden; i += LANES) {
        const Words v = words_of(load(h + i) * one, all_floats(0.0f));
        memcpy(words + i, &v, LANES * sizeof(int16_t));
    }
    add_product(s->hidden, s->gates + s->heads, h, s->h_weights, sums);
    add_product(s->latent, s->heads + s->mix, z, s->z_weights, sums + s->gates);
    for (int i = 0; i < s->hidden; i++) nan_or_zero += 0.0f * h[i];
    for (int i = 0; i < s->latent; i++) nan_or_zero += 0.0f * z[i];
    return nan_or_zero;
}
