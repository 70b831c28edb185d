/* What all candidates of a robot share: sums of first layers, computed once a plan. */
#pragma once
#include "network.h"

typedef struct {
    int32_t hidden, latent;
    int32_t gates, values, mix, passing; /* sums of each; `values` of all heads; 0: there is no such part */
    const float *of_h;    /* [hidden][gates + values] */
    const float *of_z;    /* [latent][values + mix] */
    const float *of_told; /* [TOLD][passing] */
} Start;

/* y [N] += x [K] weight [K][N]. */
static void add_product(int inputs, int outputs, const float *x, const float *weight, float *y) {
    for (int k = 0; k < inputs; k++, weight += outputs)
        for (int n = 0; n < outputs; n += LANES)
            store(y + n, fused(all_floats(x[k]), load(weight + n), load(y + n)));
}

/* h [hidden] in words [hidden + 16], and sums [gates + values + mix + passing] of it, of z [latent] and
 * of what is on its way, told [TOLD]; words and sums are zero before. Returns 0, or what is not a number
 * if the state is not. */
float start(const Start *s, const float *h, const float *z, const float *told, int16_t *words,
            float *sums) {
    const Floats one = all_floats(32768.0f);
    float nothing = 0.0f;
    for (int i = 0; i < s->hidden; i += LANES) {
        const Words v = words_of(load(h + i) * one, all_floats(0.0f));
        memcpy(words + i, &v, LANES * sizeof(int16_t));
    }
    add_product(s->hidden, s->gates + s->values, h, s->of_h, sums);
    sums += s->gates;
    add_product(s->latent, s->values + s->mix, z, s->of_z, sums);
    sums += s->values + s->mix;
    if (s->passing) add_product(TOLD, s->passing, told, s->of_told, sums);
    for (int i = 0; i < s->hidden; i++) nothing += 0.0f * h[i];
    for (int i = 0; i < s->latent; i++) nothing += 0.0f * z[i];
    return nothing;
}
