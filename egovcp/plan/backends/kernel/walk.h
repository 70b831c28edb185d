/* The action process of `process.py`, to the same bits. */
#pragma once
#include "vectors.h"

INLINE float folded(float x) { return 2.0f * (x < -1.0f ? -1.0f : x > 1.0f ? 1.0f : x) - x; }

/* actions [robots][plans][steps][size] from `start` [robots][size] by deltas of the same shape. */
void walk(int32_t robots, int32_t plans, int32_t steps, int32_t size, float eta, const float *start,
          const float *deltas, float *actions) {
    for (int e = 0; e < robots; e++, start += size)
        for (int i = 0; i < plans; i++) {
#if defined(WIDE_VECTORS)
            if (size <= LANES) { /* a step is a vector */
                const __mmask16 lanes = (1u << size) - 1u;
                const __m512 wall = _mm512_set1_ps(1.0f), rate = _mm512_set1_ps(eta);
                __m512 x = _mm512_maskz_loadu_ps(lanes, start);
                for (int k = 0; k < steps; k++, deltas += size, actions += size) {
                    x = _mm512_add_ps(x, _mm512_mul_ps(rate, _mm512_maskz_loadu_ps(lanes, deltas)));
                    /* what is not a number is the second of two, and comes out */
                    const __m512 inside = _mm512_max_ps(-wall, _mm512_min_ps(wall, x));
                    x = _mm512_sub_ps(_mm512_add_ps(inside, inside), x);
                    _mm512_mask_storeu_ps(actions, lanes, x);
                }
                continue;
            }
#endif
            for (int k = 0; k < steps; k++, deltas += size, actions += size)
                for (int j = 0; j < size; j++)
                    actions[j] = folded((k > 0 ? actions[j - size] : start[j]) + eta * deltas[j]);
        }
}
