/* What all candidates of a robot share: sums of first layers, computed once a plan. */
#pragma once
#include "network.h"

typedef struct {
    int32_t hidden, latent;
    int32_t gates, heads, mix; /* sums of each; `heads`: of Q and of the reward */
    const float *of_h;         /* [hidden][gates + heads] */
    const float *of_z;         /* [latent][heads + mix] */
} Start;

/* y [N] += x [K] weight [K][N]. */
static void add_product(int inputs, int outputs, const float *x, const float *weight, float *y) {
    for (int k = 0; k < inputs; k++, weight += outputs)
        for (int n = 0; n < outputs; n += LANES)
            store(y + n, fused(all_floats(x[k]), load(weight + n), load(y + n)));
}

/* h [hidden] in words [hidden + 16], and sums [gates + heads + mix] of it and of z [latent]; words and
 * sums are zero before. Returns 0, or what is not a number if the state is not. */
float start(const Start *s, const float *h, const float *z, int16_t *words, float *sums) {
    const Floats one = all_floats(32768.0f);
    float nothing = 0.0f;
    for (int i = 0; i < s->hidden; i += LANES) {
        const Words v = words_of(load(h + i) * one, all_floats(0.0f));
        memcpy(words + i, &v, LANES * sizeof(int16_t));
    }
    add_product(s->hidden, s->gates + s->heads, h, s->of_h, sums);
    add_product(s->latent, s->heads + s->mix, z, s->of_z, sums + s->gates);
    for (int i = 0; i < s->hidden; i++) nothing += 0.0f * h[i];
    for (int i = 0; i < s->latent; i++) nothing += 0.0f * z[i];
    return nothing;
}
