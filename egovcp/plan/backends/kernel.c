/* Imagination and value of candidate plans, in 8-bit integers: the planning network of `network.py`.
 *
 * A block of ROWS candidates goes through all steps of the horizon before the next one starts, so that
 * what they carry stays in the fastest cache; threads take blocks from a common counter.
 *
 * A wide input row x (K numbers) is kept as x = scale * (u - zero) + offset with u in 0..255: zero and
 * offset belong to its kind, scale to the row. Weights are w = weight_scale[n] * i, i in -127..127,
 * in blocks [N/16][K/4][16][4] of which one vector register holds the last two axes, and one tile of
 * AMX the last three for 64 of the inputs. Few, exact inputs (the action above all) stay in float32.
 * The weights of a normalised layer are centred (their mean over the outputs is zero), and so are its
 * sums. No state, no allocation. */
#include <math.h>
#include <stdint.h>
#include <string.h>
#if defined(__AMX_INT8__) && !defined(WITHOUT_TILES)
#define TILES 1
#endif
#if defined(__AVX512VNNI__) || defined(TILES)
#include <immintrin.h>
#endif

enum { LANES = 16, WIDEST = 1024, MOST_FEW = 128, TOLD = 4 };
#if defined(TILES)
enum { ROWS = 16, COLUMNS = 4, DEPTH = 64 }; /* a tile: rows, and inputs; and tiles that sum up */
#else
enum { ROWS = 8, COLUMNS = 3, DEPTH = 4 };
#endif

typedef float Floats __attribute__((vector_size(4 * LANES)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));

typedef struct {
    int32_t inputs;       /* K, a multiple of DEPTH; 0: there is no such input */
    const int8_t *weight; /* [N/16][K/4][16][4] */
    const float *scale;   /* [N] */
    const int32_t *start; /* [N] -zero * sum of the column's integers */
    const float *shift;   /* [N] offset * sum of the column's weights */
} Wide;

typedef struct {
    int32_t inputs;      /* K; 0: there is no such input */
    const float *weight; /* [K][N] */
} Narrow;

typedef struct {
    int32_t outputs; /* N, a multiple of 16 */
    Wide wide, beside; /* h and z; or a hidden layer, and h */
    Narrow few, action;
    const float *gamma, *beta; /* [N] of the normalisation */
    float epsilon;
} Layer;

typedef struct {
    int32_t inputs, outputs; /* outputs: 1 or a multiple of 16; 0: there is no such layer */
    const float *weight;     /* [inputs][outputs] */
    const float *bias;       /* [outputs] */
} Linear;

typedef struct {
    Layer first, second;
    Linear top;
} Mlp;

typedef struct {
    Linear reduce_h, reduce_z; /* to what `state` reads in place of h and z, if there are any */
    Mlp state;
} Head;

typedef struct {
    int32_t hidden, latent, actions, heads;
    Layer mix, gru, prior, termination, told;
    Wide prior_top;         /* [outputs] means, then raw deviations if they are wanted */
    const float *prior_bias; /* [MOST_FEW] */
    int32_t prior_outputs;  /* a multiple of 16 */
    Linear termination_top, told_top;
    float min_std;
    const Head *head; /* [heads] */
    Mlp passing;      /* reads what is on its way, is added to each head; none if its top has no outputs */
} Network;

typedef struct {
    const float *h;      /* [hidden] */
    const float *mix;    /* sums of the first layers that do not depend on the candidate */
    const float *gates;
    const float *const *values; /* of the heads */
    const float *passing;       /* of what they share */
    const float *told;          /* [steps][TOLD] what is on its way, if it is followed; else null */
} Root;

typedef struct {
    uint8_t values[ROWS][WIDEST];
    float scale[ROWS];
} Bytes;

typedef struct {
    float values[ROWS][MOST_FEW];
} Few;

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

static inline float highest(Floats v) {
#if defined(__AVX512F__)
    return _mm512_reduce_max_ps((__m512)v);
#else
    float most = v[0];
    for (int i = 1; i < LANES; i++) most = v[i] > most ? v[i] : most;
    return most;
#endif
}

/* 1 / (1 + exp(-x)) within 2e-4 of its value: a byte tells no more than 4e-3. */
static inline Floats sigmoid(Floats x) {
    x *= -1.44269504f;
#if defined(__AVX512F__)
    const Floats whole = (Floats)_mm512_roundscale_ps((__m512)x, 0);
#else
    const Floats most = (Floats){0} + 126.0f;
    x = -larger(-larger(x, -most), -most);
    const Ints power = __builtin_convertvector(x + 127.5f, Ints); /* rounds x: it is positive here */
    const Floats whole = __builtin_convertvector(power - 127, Floats);
#endif
    const Floats t = x - whole;
    Floats series = 1.0f + t * (0.6932829f + t * (0.24221037f + t * 0.05500858f)); /* 2^t */
#if defined(__AVX512F__)
    series = (Floats)_mm512_scalef_ps((__m512)series, (__m512)whole);
    return (Floats)_mm512_rcp14_ps((__m512)(1.0f + series));
#else
    return 1.0f / (1.0f + series * (Floats)(power << 23));
#endif
}

static inline float one_sigmoid(float x) { return 1.0f / (1.0f + expf(-x)); }

#if defined(TILES)
/* Tiles are whole: 16 rows of 64 bytes. The thread that calls has them until it releases them. */
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

/* Dot products of a block of rows with `columns` (COLUMNS or 1) times 16 outputs from `n` on. */
static inline __attribute__((always_inline)) void dots(const Wide *w, int n, int columns,
                                                       const Bytes *in, Ints dot[][ROWS]) {
    const int8_t *weight = w->weight + (int64_t)n * w->inputs;
    const int column = LANES * w->inputs, tile = LANES * DEPTH, each = 4 * LANES;
    _tile_loadd(0, w->start + n, 0); /* the same for all rows */
    if (columns > 1) {
        _tile_loadd(1, w->start + n + LANES, 0);
        _tile_loadd(2, w->start + n + 2 * LANES, 0);
        _tile_loadd(3, w->start + n + 3 * LANES, 0);
    }
    for (int k = 0; k < w->inputs; k += DEPTH, weight += tile) {
        _tile_loadd(4, in->values[0] + k, WIDEST);
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

/* Dot products of a block of rows with `columns` times 16 outputs from `n` on. */
static inline __attribute__((always_inline)) void dots(const Wide *w, int n, int columns,
                                                       const Bytes *in, Ints dot[][ROWS]) {
    const int quads = w->inputs / 4;
    const int8_t *weight = w->weight + (int64_t)n * w->inputs;
    for (int c = 0; c < columns; c++) {
        Ints start;
        memcpy(&start, w->start + n + c * LANES, sizeof start);
        for (int r = 0; r < ROWS; r++) dot[c][r] = start;
    }
    for (int q = 0; q < quads; q++) {
#if defined(__AVX512VNNI__)
        __m512i b[COLUMNS];
        for (int c = 0; c < columns; c++)
            b[c] = _mm512_loadu_si512(weight + ((int64_t)c * quads + q) * 4 * LANES);
        for (int r = 0; r < ROWS; r++) {
            int32_t four;
            memcpy(&four, in->values[r] + 4 * q, sizeof four);
            const __m512i x = _mm512_set1_epi32(four);
            for (int c = 0; c < columns; c++)
                dot[c][r] = (Ints)_mm512_dpbusd_epi32((__m512i)dot[c][r], x, b[c]);
        }
#else
        for (int c = 0; c < columns; c++) {
            const int8_t *four_by_lane = weight + ((int64_t)c * quads + q) * 4 * LANES;
            for (int r = 0; r < ROWS; r++)
                for (int i = 0; i < LANES; i++)
                    for (int j = 0; j < 4; j++)
                        dot[c][r][i] += (int32_t)in->values[r][4 * q + j] * four_by_lane[4 * i + j];
        }
#endif
    }
}
#endif

static inline __attribute__((always_inline)) void columns_of_product(const Wide *w, int n, int columns,
                                                                     const Bytes *in, const float *from,
                                                                     int from_stride, float *y,
                                                                     int stride) {
    Ints dot[COLUMNS][ROWS];
    dots(w, n, columns, in, dot);
    for (int c = 0; c < columns; c++, n += LANES) {
        const Floats weight_scale = load(w->scale + n), shift = load(w->shift + n);
        for (int r = 0; r < ROWS; r++) {
            const Floats product = __builtin_convertvector(dot[c][r], Floats) * weight_scale;
            store(y + r * stride + n, load(from + r * from_stride + n) + shift + in->scale[r] * product);
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

/* y [ROWS][N] = from + x [ROWS][x_stride] weight. */
static void narrow_product(const float *weight, int inputs, int outputs, const float *x, int x_stride,
                           const float *from, int from_stride, float *y) {
    for (int n = 0; n < outputs; n += LANES) {
        Floats acc[ROWS];
        for (int r = 0; r < ROWS; r++) acc[r] = load(from + r * from_stride + n);
        for (int k = 0; k < inputs; k++) {
            const Floats w = load(weight + (int64_t)k * outputs + n);
            for (int r = 0; r < ROWS; r++) acc[r] += x[r * x_stride + k] * w;
        }
        for (int r = 0; r < ROWS; r++) store(y + r * outputs + n, acc[r]);
    }
}

typedef struct { /* of a layer; null: not there, or in the sums that it starts from */
    const Bytes *wide, *beside;
    const Few *few;
    const float *action; /* [ROWS][actions] */
    const float *from;   /* [N], shared by all rows */
} Inputs;

static const float ZEROS[WIDEST];

/* y [ROWS][N] = the sum of the products with all inputs. */
static void sums(const Layer *l, Inputs in, float *y) {
    const float *from = in.from ? in.from : ZEROS;
    int stride = 0;
    if (in.action && l->action.inputs) {
        narrow_product(l->action.weight, l->action.inputs, l->outputs, in.action, l->action.inputs, from,
                       stride, y);
        from = y, stride = l->outputs;
    }
    if (in.few && l->few.inputs) {
        narrow_product(l->few.weight, l->few.inputs, l->outputs, in.few->values[0], MOST_FEW, from, stride,
                       y);
        from = y, stride = l->outputs;
    }
    if (in.beside && l->beside.inputs) {
        wide_product(&l->beside, l->outputs, in.beside, from, stride, y);
        from = y, stride = l->outputs;
    }
    if (in.wide && l->wide.inputs) wide_product(&l->wide, l->outputs, in.wide, from, stride, y);
}

/* Reciprocal deviations of a block of centred sums, as the layer normalises them. */
static inline void rates(const Layer *l, const float *y, float *rate) {
    Floats squares[ROWS] = {{0}};
    for (int i = 0; i < l->outputs; i += LANES)
        for (int r = 0; r < ROWS; r++) {
            const Floats v = load(y + r * l->outputs + i);
            squares[r] += v * v;
        }
    for (int r = 0; r < ROWS; r++) rate[r] = total(squares[r]);
    for (int r = 0; r < ROWS; r++) rate[r] = 1.0f / sqrtf(rate[r] / (float)l->outputs + l->epsilon);
}

/* One row as bytes, x = scale * (u - zero) + offset; `most` bounds x - offset, or |x| if zero > 0. */
static inline float to_bytes(const float *x, int count, float most, float zero, float offset, uint8_t *u) {
    most = most > 1e-6f ? most : 1e-6f;
    const float scale = most / (255.0f - zero), rate = 1.0f / scale, shift = zero - offset * rate;
    for (int n = 0; n < count; n += LANES) {
        const Floats v = load(x + n) * rate + shift;
#if defined(__AVX512F__)
        const __m512i whole = _mm512_cvtps_epi32((__m512)larger(v, (Floats){0}));
        _mm_storeu_si128((__m128i *)(u + n), _mm512_cvtusepi32_epi8(whole));
#else
        for (int i = 0; i < LANES; i++) {
            const float rounded = v[i] + 0.5f;
            u[n + i] = rounded <= 0.0f ? 0 : rounded >= 255.0f ? 255 : (uint8_t)rounded;
        }
#endif
    }
    return scale;
}

static const float LEAST_SILU = -0.27846456f; /* bytes of hidden layers count from there */

/* Linear, LayerNorm, SiLU: y [ROWS][N], and as bytes if they are wanted. */
static void hidden(const Layer *l, Inputs in, float *y, Bytes *bytes) {
    const int n = l->outputs;
    float rate[ROWS];
    Floats most[ROWS] = {{0}};
    sums(l, in, y);
    rates(l, y, rate);
    for (int i = 0; i < n; i += LANES) {
        const Floats gamma = load(l->gamma + i), beta = load(l->beta + i);
        for (int r = 0; r < ROWS; r++) {
            Floats v = load(y + r * n + i) * rate[r] * gamma + beta;
            v *= sigmoid(v);
            store(y + r * n + i, v);
            most[r] = larger(most[r], v);
        }
    }
    for (int r = 0; bytes && r < ROWS; r++)
        bytes->scale[r] = to_bytes(y + r * n, n, highest(most[r]) - LEAST_SILU, 0.0f, LEAST_SILU,
                                   bytes->values[r]);
}

/* The recurrence: gates (reset, candidate, update) from the layer's normalised sums; h [ROWS][N/3]
 * from `before` (stride 0: one row for all), also as bytes. */
static void recur(const Layer *l, Inputs in, const float *before, int stride, float *h, Bytes *bytes) {
    float y[ROWS * WIDEST] __attribute__((aligned(64))), rate[ROWS];
    const int size = l->outputs / 3;
    Floats most[ROWS] = {{0}};
    sums(l, in, y);
    rates(l, y, rate);
    for (int i = 0; i < size; i += LANES) {
        Floats gamma[3], beta[3];
        for (int g = 0; g < 3; g++)
            gamma[g] = load(l->gamma + g * size + i), beta[g] = load(l->beta + g * size + i);
        for (int r = 0; r < ROWS; r++) {
            Floats gate[3];
            for (int g = 0; g < 3; g++)
                gate[g] = load(y + r * l->outputs + g * size + i) * rate[r] * gamma[g] + beta[g];
            const Floats new = 2.0f * sigmoid(2.0f * sigmoid(gate[0]) * gate[1]) - 1.0f; /* tanh */
            const Floats old = load(before + r * stride + i), v = old + sigmoid(gate[2]) * (new - old);
            store(h + r * size + i, v);
            most[r] = larger(most[r], absolute(v));
        }
    }
    for (int r = 0; r < ROWS; r++)
        bytes->scale[r] = to_bytes(h + r * size, size, highest(most[r]), 128.0f, 0.0f, bytes->values[r]);
}

/* out [ROWS][out_stride] += x [ROWS][inputs] weight + bias. */
static void linear(const Linear *l, const float *x, float *out, int out_stride) {
    if (l->outputs == 1) {
        for (int r = 0; r < ROWS; r++) {
            Floats sum = {0};
            for (int n = 0; n < l->inputs; n += LANES)
                sum += load(x + r * l->inputs + n) * load(l->weight + n);
            out[r * out_stride] += total(sum) + l->bias[0];
        }
        return;
    }
    for (int j = 0; j < l->outputs; j += LANES) {
        Floats acc[ROWS];
        for (int r = 0; r < ROWS; r++) acc[r] = load(out + r * out_stride + j) + load(l->bias + j);
        for (int n = 0; n < l->inputs; n++) {
            const Floats weight = load(l->weight + (int64_t)n * l->outputs + j);
            for (int r = 0; r < ROWS; r++) acc[r] += x[r * l->inputs + n] * weight;
        }
        for (int r = 0; r < ROWS; r++) store(out + r * out_stride + j, acc[r]);
    }
}

/* z [ROWS][latent] of the prior, with noise [latent] or (null) its mean; also as bytes. */
static void next_z(const Network *net, const Bytes *h, const float *noise, float *z, Bytes *bytes) {
    float y[ROWS * WIDEST] __attribute__((aligned(64))), out[ROWS * MOST_FEW];
    const int latent = net->latent, outputs = net->prior_outputs;
    Bytes between;
    hidden(&net->prior, (Inputs){.wide = h}, y, &between);
    wide_product(&net->prior_top, outputs, &between, net->prior_bias, 0, out);
    for (int r = 0; r < ROWS; r++) {
        float padded[MOST_FEW] = {0}, most = 0.0f;
        for (int i = 0; i < latent; i++) {
            float v = out[r * outputs + i];
            if (noise) {
                const float raw = out[r * outputs + latent + i] + 0.54f;
                v += (log1pf(expf(-fabsf(raw))) + (raw > 0.0f ? raw : 0.0f) + net->min_std) * noise[i];
            }
            z[r * latent + i] = padded[i] = v;
            most = fabsf(v) > most ? fabsf(v) : most;
        }
        bytes->scale[r] = to_bytes(padded, latent, most, 128.0f, 0.0f, bytes->values[r]);
    }
}

/* What is on its way: its probability, and that times where and when. */
static void tell(const Network *net, const Bytes *h, const Bytes *z, Few *told) {
    float y[ROWS * WIDEST] __attribute__((aligned(64)));
    Few out = {{{0}}};
    hidden(&net->told, (Inputs){.wide = h, .beside = z}, y, 0);
    linear(&net->told_top, y, out.values[0], MOST_FEW);
    for (int r = 0; r < ROWS; r++) {
        const float coming = one_sigmoid(out.values[r][3]);
        told->values[r][0] = coming;
        for (int i = 0; i < 3; i++) told->values[r][1 + i] = coming * out.values[r][i];
    }
}

/* q [ROWS][stride] += the outputs of a network of two hidden layers. */
static void mlp(const Mlp *m, Inputs in, float *q, int stride) {
    float y[ROWS * WIDEST] __attribute__((aligned(64)));
    Bytes bytes;
    hidden(&m->first, in, y, &bytes);
    hidden(&m->second, (Inputs){.wide = &bytes}, y, 0);
    linear(&m->top, y, q, stride);
}

/* Everything of a block: actions [ROWS][steps][actions] -> q [ROWS][steps][heads][width], zero before,
 * and the log-odds of a failure, dead [ROWS][steps]. */
static void block(const Network *net, const Root *root, int steps, const float *actions, const float *noise,
                  float *q, int width, float *dead) {
    float h[ROWS * WIDEST] __attribute__((aligned(64))), y[ROWS * WIDEST] __attribute__((aligned(64)));
    float z[ROWS * MOST_FEW], action[ROWS * MOST_FEW];
    Bytes h_bytes, z_bytes, x;
    Few told;
    const int per_step = net->heads * width, q_stride = steps * per_step;
    for (int k = 0; k < steps; k++) {
        for (int r = 0; r < ROWS; r++)
            memcpy(action + r * net->actions, actions + (r * steps + k) * net->actions,
                   net->actions * sizeof(float));
        if (k > 0) { /* x was made from the action before */
            if (k == 1)
                recur(&net->gru, (Inputs){.wide = &x, .from = root->gates}, root->h, 0, h, &h_bytes);
            else
                recur(&net->gru, (Inputs){.wide = &x, .beside = &h_bytes}, h, net->hidden, h, &h_bytes);
            next_z(net, &h_bytes, noise ? noise + (k - 1) * net->latent : 0, z, &z_bytes);
            if (root->told)
                for (int r = 0; r < ROWS; r++)
                    memcpy(told.values[r], root->told + k * TOLD, TOLD * sizeof(float));
            else if (net->told_top.outputs)
                tell(net, &h_bytes, &z_bytes, &told);
        }
        const int shared = net->passing.top.outputs;
        float both[ROWS * MOST_FEW] = {0}; /* what the heads share, [ROWS][width] */
        if (shared) {
            Inputs in = {.action = action};
            if (k == 0) in.from = root->passing;
            else in.few = &told;
            mlp(&net->passing, in, both, width);
        }
        for (int i = 0; i < net->heads; i++) {
            const Head *head = net->head + i;
            float *to = q + k * per_step + i * width;
            Inputs in = {.action = action};
            Few reduced = {{{0}}};
            if (k == 0) {
                in.from = root->values[i];
            } else if (head->reduce_h.outputs) {
                linear(&head->reduce_h, h, reduced.values[0], MOST_FEW);
                linear(&head->reduce_z, z, reduced.values[0], MOST_FEW);
                in.few = &reduced;
            } else {
                in.wide = &h_bytes, in.beside = &z_bytes;
            }
            mlp(&head->state, in, to, q_stride);
            for (int r = 0; shared && r < ROWS; r++)
                for (int j = 0; j < width; j++) to[r * q_stride + j] += both[r * width + j];
        }
        if (k == steps - 1) break; /* nothing follows the last step */
        if (k > 0) {
            hidden(&net->termination, (Inputs){.wide = &h_bytes, .beside = &z_bytes}, y, 0);
            linear(&net->termination_top, y, dead + k, steps);
        }
        const Inputs in = {.action = action, .beside = k > 0 ? &z_bytes : 0, .from = k > 0 ? 0 : root->mix};
        hidden(&net->mix, in, y, &x);
    }
}

/* How many inputs a wide product takes at once; weights are filled up to that with zeros. */
int32_t depth(void) { return DEPTH; }

/* Plans of one robot: actions [rows][steps][actions], noise [steps - 1][latent] or null -> q
 * [rows][steps][heads][width] and dead [rows][steps] (of steps 1 to steps - 2), both zero before.
 * Threads that share `next` share the blocks. */
void judge(const Network *net, const Root *root, int rows, int steps, const float *actions,
           const float *noise, int width, float *q, float *dead, int32_t *next) {
    const int per_row = steps * net->actions, q_row = steps * net->heads * width;
    take_tiles();
    for (;;) {
        const int row = __atomic_fetch_add(next, ROWS, __ATOMIC_RELAXED);
        if (row >= rows) break;
        if (row + ROWS <= rows) {
            block(net, root, steps, actions + (int64_t)row * per_row, noise, q + (int64_t)row * q_row, width,
                  dead + (int64_t)row * steps);
            continue;
        }
        float some[ROWS * per_row], some_q[ROWS * q_row], some_dead[ROWS * steps];
        const int count = rows - row;
        memset(some_q, 0, sizeof some_q);
        memset(some_dead, 0, sizeof some_dead);
        for (int r = 0; r < ROWS; r++) /* rows beyond the last repeat the first */
            memcpy(some + r * per_row, actions + (int64_t)(row + (r < count ? r : 0)) * per_row,
                   per_row * sizeof(float));
        block(net, root, steps, some, noise, some_q, width, some_dead);
        memcpy(q + (int64_t)row * q_row, some_q, count * q_row * sizeof(float));
        memcpy(dead + (int64_t)row * steps, some_dead, count * steps * sizeof(float));
    }
    release_tiles();
}
