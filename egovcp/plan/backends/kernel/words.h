/* Activations in words: 16-bit fixed point, 32 numbers a vector.
 *
 * A word of a hidden layer is x * UNIT; one of the state h, or of tanh, x * 2^15. Functions are
 * pieces of straight lines between NODES places (`tables.py`), of which a word picks one: within 8e-4
 * of their values for SiLU, 2e-4 for tanh. A byte tells no more than 4e-3. */
#pragma once
#include "vectors.h"

enum { UNIT = 2048, NODES = 64, LEAST_SILU = 571 }; /* in words, negative */

typedef struct {
    Words value[2], slope[2];
} Lines;

/* From [2][NODES]: the values at the nodes, and half of what a piece rises. */
INLINE Lines lines_of(const int16_t *table) {
    return (Lines){{load_words(table), load_words(table + WORDS)},
                   {load_words(table + NODES), load_words(table + NODES + WORDS)}};
}

/* The entries at `index`, of which the last six bits count. */
INLINE Words entries(const Words table[2], Words index) {
#if defined(WIDE_VECTORS)
    return (Words)_mm512_permutex2var_epi16((__m512i)table[0], (__m512i)index, (__m512i)table[1]);
#else
    Words v;
    for (int i = 0; i < WORDS; i++) {
        const int at = index[i] & (NODES - 1);
        v[i] = table[at / WORDS][at % WORDS];
    }
    return v;
#endif
}

/* The function of |a|, whose nodes are 2^bits apart; beyond the last one it is as there. */
INLINE Words on_lines(Lines l, Words far, const int bits) {
    const int below = 65536 - (NODES << bits); /* so that far places saturate */
    const Words node = right(sum_of_unsigned(far, all(below + (1 << (bits - 1)))), bits);
    return entries(l.value, node) + product(entries(l.slope, node), left(far, 16 - bits));
}

/* x in UNIT -> SiLU(x) = max(x, 0) + SiLU(-|x|) in UNIT. */
INLINE Words silu(Lines l, Words x) { return larger(x, all(0)) + on_lines(l, absolute(x), 8); }

/* x in 2^13 -> tanh(x) in 2^15. */
INLINE Words tanh_of(Lines l, Words x) {
    const Words v = on_lines(l, absolute(x), 9);
#if defined(WIDE_VECTORS)
    const __mmask32 negative = _mm512_movepi16_mask((__m512i)x);
    return (Words)_mm512_mask_sub_epi16((__m512i)v, negative, _mm512_setzero_si512(), (__m512i)v);
#else
    const Words negative = x < 0;
    return (v ^ negative) - negative;
#endif
}

/* A row of a hidden layer as bytes x = scale * u - LEAST_SILU / UNIT; `most` bounds its words. */
INLINE float bytes_of_hidden(const int16_t *x, int count, int most, uint8_t *u) {
    const int above = most + LEAST_SILU, rate = (int)(255.0f * 65536.0f / (float)above);
    const Words start = all(LEAST_SILU + above / 510), times = all(rate); /* + half a byte */
    for (int n = 0; n < count; n += 2 * WORDS)
        store_bytes(u + n, product_of_unsigned(load_words(x + n) + start, times),
                    product_of_unsigned(load_words(x + n + WORDS) + start, times));
    return 65536.0f / (float)(UNIT * rate);
}

/* A row of h as bytes x = scale * (u - 128); `most` bounds its words. */
INLINE float bytes_of_state(const int16_t *x, int count, int most, uint8_t *u) {
    const int rate = (int)(127.0f * 32768.0f / (float)(most > 128 ? most : 128));
    const Words zero = all(128), times = all(rate);
    for (int n = 0; n < count; n += 2 * WORDS)
        store_bytes(u + n, zero + product(load_words(x + n), times),
                    zero + product(load_words(x + n + WORDS), times));
    return 1.0f / (float)rate;
}
