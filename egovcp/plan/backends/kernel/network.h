/* What Python says of a network (`library.py` has the same structures), and what a block carries. */
#pragma once
#include "fixed_point.h"

enum { WIDEST = 1024, MOST_FEW = 128, FEW_STRIDE = MOST_FEW + LANES };
#if defined(TILES)
enum { ROWS = 16, COLUMNS = 4, DEPTH = 64 }; /* a tile: rows, and inputs; and tiles that sum up */
#elif defined(HALF_VECTORS)
enum { ROWS = 8, COLUMNS = 1, DEPTH = 4 }; /* sums of a block of rows in half of the registers */
#else
enum { ROWS = 8, COLUMNS = 2, DEPTH = 4 };
#endif
#if defined(HALF_VECTORS)
enum { GROUP = 2 }; /* inputs that an instruction multiplies and adds up */
#else
enum { GROUP = 4 };
#endif

typedef struct {
    int32_t inputs;       /* K, a multiple of DEPTH; 0: there is no such input */
    const int8_t *weight; /* [N/LANES][K/GROUP][LANES][GROUP] */
    const float *scale;   /* [N] */
    const int32_t *start; /* [N] -zero * sum of the column's integers */
    const float *shift;   /* [N] offset * sum of the column's weights */
} Wide;

typedef struct {
    int32_t inputs;      /* K; 0: there is no such input */
    const float *weight; /* [K][N] */
} Narrow;

typedef struct {
    int32_t outputs;           /* N, a multiple of 16 */
    Wide wide, beside;         /* h and z; or a hidden layer, and h */
    Narrow few;                /* the action first */
    const float *gamma, *beta; /* [N + 16] of the normalisation, in words */
    float epsilon;
} Layer;

typedef struct { /* one output, from words; weights in words, of which no sum leaves 32 bits */
    int32_t inputs;
    const int16_t *weight; /* [inputs filled up to 32] */
    float scale, bias;
} Dot;

typedef struct { /* many outputs, from the bytes of a hidden layer */
    int32_t outputs; /* a multiple of 16 */
    Wide wide;
    const float *bias; /* [outputs] */
} Top;

typedef struct { /* two hidden layers over h, z and the action, with one output or with many */
    Layer first, second;
    Dot one;
    Top many; /* if it has outputs */
} Head;

typedef struct { /* from the outputs of the heads to J */
    int32_t objective; /* what is added up: as `Objective` */
    int32_t rule;      /* after a failure: as `Rule` */
    int32_t bins;      /* of the distribution whose logits are the outputs of Q; 0: Q is the one output */
    const float *each; /* [bins filled up to 16] their values */
    float mean, std, floor, threshold, discount;
} Reading;

enum Objective { VALUE, REWARD, TD };
enum Rule { PAPER, SHIFT, SURVIVAL };

typedef struct {
    int32_t hidden, latent, actions;
    Layer mix, gru, prior, termination;
    Top prior_top; /* means, then raw deviations if they are wanted */
    Dot termination_top;
    float min_std;
    Head value;
    Head reward; /* only if the objective adds up rewards */
    const int16_t *silu, *tanh; /* [2][NODES] each, see `Lines` */
    Reading reading;
} Network;

typedef struct {
    const int16_t *h;    /* [hidden + 16] words */
    const float *mix;    /* sums of the first layers that do not depend on the candidate */
    const float *gates;
    const float *value;
    const float *reward;
    float nothing; /* 0, or not a number where the state is not: bytes know no such thing */
} SharedPrefix;

typedef struct {
    Byte values[ROWS][WIDEST];
    float scale[ROWS];
} Bytes;

typedef struct {
    int16_t values[ROWS][WIDEST];
} Fixed;

typedef struct {
    float values[ROWS][FEW_STRIDE];
} Few;
