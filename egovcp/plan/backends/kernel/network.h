/* What Python says of a network (`library.py` has the same structures), and what a block carries. */
#pragma once
#include "words.h"

enum { WIDEST = 1024, MOST_FEW = 128, TOLD = 4, FEW_STRIDE = MOST_FEW + LANES };
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

typedef struct { /* of few outputs, from words; weights in words, of which no sum leaves 32 bits */
    int32_t inputs, outputs; /* outputs: 1 or a multiple of 16; 0: there is no such layer */
    const int16_t *weight;   /* [outputs/LANES][inputs/2][LANES][2]; of one output [inputs filled up to 32] */
    const float *scale;      /* [outputs] of a sum of products */
    const float *bias;       /* [outputs] */
} Linear;

typedef struct {
    Layer first, second;
    Linear top;
} Mlp;

typedef struct {
    Linear reduce_h; /* to what `state` reads in place of h and z, if it does */
    Narrow reduce_z;
    Mlp state;
} Head;

typedef struct { /* from what heads say to J */
    int32_t objective; /* what is added up: as `Objective` */
    int32_t rule;      /* after a failure: as `Rule` */
    int32_t lowest;    /* of several heads; else their mean */
    int32_t bins;      /* of the distribution whose log-odds a head's outputs are; 0: its one output is Q */
    const float *each; /* [bins filled up to 16] their values */
    float mean, std, floor, threshold, discount;
} Reading;

enum Objective { VALUE, REWARD, TD };
enum Rule { PAPER, SHIFT, SURVIVAL };

typedef struct {
    int32_t hidden, latent, actions, heads;
    Layer mix, gru, prior, termination, told;
    Wide prior_top;         /* [outputs] means, then raw deviations if they are wanted */
    const float *prior_bias; /* [MOST_FEW] */
    int32_t prior_outputs;  /* a multiple of 16 */
    Linear termination_top, told_top;
    float min_std;
    const Head *head; /* [heads] of Q */
    Head reward;      /* if it is foreseen */
    Mlp passing;      /* reads what is on its way, is added to each head; none if its top has no outputs */
    const int16_t *silu, *tanh; /* [2][NODES] each, see `Lines` */
    Reading reading;
} Network;

typedef struct {
    const int16_t *h;    /* [hidden + 16] words */
    const float *mix;    /* sums of the first layers that do not depend on the candidate */
    const float *gates;
    const float *const *values; /* of the heads, then of the reward's */
    const float *passing;       /* of what they share */
    const float *told;          /* [steps][TOLD] what is on its way, if it is followed; else null */
    float nothing;              /* 0, or not a number where the state is not: bytes know no such thing */
} Root;

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
