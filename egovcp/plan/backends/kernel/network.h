/* Description of a network (`library.py` has the same structures), and rows of a block. */
#pragma once
#include "fixed_point.h"

enum { MAX_WIDE = 1024, MAX_NARROW = 128, NARROW_STRIDE = MAX_NARROW + LANES };
#if defined(TILES)
enum { ROWS = 16, COLUMNS = 4, DEPTH = 64 }; /* rows and inputs of a tile; tiles of sums */
#elif defined(HALF_VECTORS)
enum { ROWS = 8, COLUMNS = 1, DEPTH = 4 }; /* sums of a block in half of the registers */
#else
enum { ROWS = 8, COLUMNS = 2, DEPTH = 4 };
#endif
#if defined(HALF_VECTORS)
enum { GROUP = 2 }; /* inputs per lane of an instruction */
#else
enum { GROUP = 4 };
#endif

typedef struct {
    int32_t inputs;       /* K, a multiple of DEPTH; 0: no such input */
    const int8_t *weight; /* [N/LANES][K/GROUP][LANES][GROUP] */
    const float *scale;   /* [N] */
    const int32_t *start; /* [N] -zero * sum of the column's integers */
    const float *shift;   /* [N] offset * sum of the column's weights */
} Wide;

typedef struct {
    int32_t inputs;      /* K; 0: no such input */
    const float *weight; /* [K][N] */
} Narrow;

typedef struct {
    int32_t outputs;           /* N, a multiple of 16 */
    Wide wide, second;         /* h and z; or a hidden layer, and h */
    Narrow narrow;             /* the action first */
    const float *gamma, *beta; /* [N + 16] of the normalisation, in fixed point */
    float epsilon;
} Layer;

typedef struct { /* one output, from fixed point; no sum exceeds 32 bits */
    int32_t inputs;
    const int16_t *weight; /* [inputs padded to 32] */
    float scale, bias;
} Dot;

typedef struct { /* many outputs, from the bytes of a hidden layer */
    int32_t outputs; /* a multiple of 16 */
    Wide wide;
    const float *bias; /* [outputs] */
} Top;

typedef struct { /* two hidden layers over h, z and the action, with one output or with many */
    Layer first, second;
    Dot scalar_top;
    Top vector_top; /* if it has outputs */
} Head;

typedef struct { /* conversion of the outputs of the heads to V */
    int32_t objective; /* an `Objective` */
    int32_t rule;      /* a `Rule` */
    int32_t bins;      /* of the distribution whose logits are the outputs of Q; 0: Q is the one output */
    const float *bin_values; /* [bins padded to 16] */
    float mean, std, floor, threshold, discount;
} Readout;

enum Objective { VALUE, REWARD, TD };
enum Rule { PAPER, SHIFT, SURVIVAL };

typedef struct {
    int32_t hidden, latent, actions;
    Layer mix, gru, prior, termination;
    Top prior_top; /* means, then raw deviations if z is sampled */
    Dot termination_top;
    float min_std;
    Head value;
    Head reward; /* only if the objective adds up rewards */
    const int16_t *silu, *tanh; /* [2][NODES] each, see `Lines` */
    Readout readout;
} Network;

typedef struct {
    const int16_t *h;    /* [hidden + 16] fixed point */
    const float *mix;    /* sums of the first layers that do not depend on the candidate */
    const float *gates;
    const float *value;
    const float *reward;
    float nan_or_zero; /* NaN if the state is not finite, which bytes cannot represent */
} SharedPrefix;

typedef struct {
    Byte values[ROWS][MAX_WIDE];
    float scale[ROWS];
} Bytes;

typedef struct {
    int16_t values[ROWS][MAX_WIDE];
} Fixed;

typedef struct {
    float values[ROWS][NARROW_STRIDE];
} NarrowRows;
