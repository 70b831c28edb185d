/* Layers of a block of candidates. */
#pragma once
#include "gemm.h"

typedef struct { /* of a layer; null: not there, or in the sums that it starts from */
    const Bytes *wide, *beside;
    const Few *few;
    int few_inputs;    /* of the layer's, from the first */
    const float *from; /* [N], shared by all rows */
} Inputs;

static const float ZEROS[WIDEST];

/* y [ROWS][N] = the sum of the products with all inputs. */
static void sums(const Layer *l, Inputs in, float *y) {
    const float *from = in.from ? in.from : ZEROS;
    int stride = 0;
    if (in.few && l->few.inputs) {
        narrow_product(&l->few, in.few_inputs, l->outputs, in.few, from, y);
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
            squares[r] = fused(v, v, squares[r]);
        }
    for (int r = 0; r < ROWS; r++) rate[r] = total(squares[r]);
    for (int r = 0; r < ROWS; r++) rate[r] = 1.0f / sqrtf(rate[r] / (float)l->outputs + l->epsilon);
}

/* 32 sums of a row, normalised, as words. */
INLINE Words normal(const float *y, Floats rate, const float *gamma, const float *beta) {
    return words_of(fused(load(y) * rate, load(gamma), load(beta)),
                    fused(load(y + LANES) * rate, load(gamma + LANES), load(beta + LANES)));
}

/* Linear, LayerNorm, SiLU: x [ROWS][N] in words, and as bytes if they are wanted. */
static void hidden(const Network *net, const Layer *l, Inputs in, Fixed *x, Bytes *bytes) {
    float y[(ROWS + 1) * WIDEST] __attribute__((aligned(64))), rate[ROWS];
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
    float y[(ROWS + 1) * WIDEST] __attribute__((aligned(64))), rate[ROWS];
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
            const Words twice = sum(gate[1], product(reset, gate[1])); /* of UNIT; 2^13 is 4 UNIT */
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
