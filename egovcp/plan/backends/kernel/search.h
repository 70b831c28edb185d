/* The steps of the cross-entropy method between two evaluations, as in `egovcp.plan.optimisers`. */
#pragma once
#include "vectors.h"

INLINE float clamped(float x) { return x < -1.0f ? -1.0f : x > 1.0f ? 1.0f : x; }

/* deltas [robots][plans][size] around mean and std [robots][size], from noise [plans][size]; the first
 * candidate is the mean itself, the second is zero. */
void draw(int32_t robots, int32_t plans, int32_t size, const float *mean, const float *std,
          const float *noise, float *deltas) {
    for (int e = 0; e < robots; e++, mean += size, std += size) {
        float *first = deltas;
        for (int64_t i = 0; i < plans; i++, deltas += size)
            for (int j = 0; j < size; j++) deltas[j] = clamped(mean[j] + std[j] * noise[i * size + j]);
        for (int j = 0; j < size; j++) first[j] = clamped(mean[j]);
        if (plans > 1) memset(first + size, 0, size * sizeof(float));
    }
}

/* actions [robots][plans][steps][size] of walks from `start` [robots][size] by deltas of that shape. */
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
                    /* NaN is the second operand, which min and max return */
                    const __m512 inside = _mm512_max_ps(-wall, _mm512_min_ps(wall, x));
                    x = _mm512_sub_ps(_mm512_add_ps(inside, inside), x);
                    _mm512_mask_storeu_ps(actions, lanes, x);
                }
                continue;
            }
#endif
            for (int k = 0; k < steps; k++, deltas += size, actions += size)
                for (int j = 0; j < size; j++) {
                    const float x = (k > 0 ? actions[j - size] : start[j]) + eta * deltas[j];
                    actions[j] = 2.0f * clamped(x) - x;
                }
        }
}

/* Indices of the `count` largest of values [plans], best first; of equal ones, the earlier. */
static void top_indices(const float *values, int32_t plans, int32_t count, int32_t *index) {
    int known = 0;
    for (int i = 0; i < plans; i++) {
        if (known == count && !(values[i] > values[index[count - 1]])) continue;
        int at = known < count ? known++ : count - 1;
        for (; at > 0 && values[i] > values[index[at - 1]]; at--) index[at] = index[at - 1];
        index[at] = i;
    }
}

/* Mean and deviation [size] of the first `count` elites [count][size], the latter at least `least`. */
static void moments(const float *elites, int32_t count, int32_t size, float least, float *mean,
                    float *std) {
    memset(mean, 0, size * sizeof(float));
    memset(std, 0, size * sizeof(float));
    for (int i = 0; i < count; i++)
        for (int j = 0; j < size; j++) mean[j] += elites[i * size + j];
    for (int j = 0; j < size; j++) mean[j] /= (float)count;
    for (int i = 0; i < count; i++)
        for (int j = 0; j < size; j++) {
            const float off = elites[i * size + j] - mean[j];
            std[j] += off * off;
        }
    for (int j = 0; j < size; j++) {
        const float deviation = sqrtf(std[j] / (float)count);
        std[j] = deviation > least ? deviation : least;
    }
}

/* Update from deltas [robots][plans][size] and `values` [robots][plans] (-inf if not finite): the elites, best
 * first, their values `top`, the mean of these, and mean and deviation of the elites with finite values; if
 * there are none, both stay unchanged. */
void update(int32_t robots, int32_t plans, int32_t size, int32_t count, float least, const float *deltas,
           const float *values, float *elites, float *top, float *value, float *mean, float *std) {
    for (int e = 0; e < robots; e++) {
        int32_t index[count];
        int usable = 0;
        float sum = 0.0f;
        top_indices(values, plans, count, index);
        for (int i = 0; i < count; i++) {
            memcpy(elites + i * size, deltas + (int64_t)index[i] * size, size * sizeof(float));
            top[i] = values[index[i]];
            if (top[i] > -INFINITY) sum += top[i], usable++;
        }
        value[e] = usable ? sum / (float)usable : -INFINITY;
        if (usable) moments(elites, usable, size, least, mean, std);
        deltas += (int64_t)plans * size, values += plans, elites += count * size, top += count;
        mean += size, std += size;
    }
}
