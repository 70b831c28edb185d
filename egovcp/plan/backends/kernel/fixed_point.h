/* Activations in 16-bit fixed point (words).
 *
 * Hidden layers have the unit HIDDEN_ONE, h and tanh 2^15. Functions are piecewise linear between NODES
 * nodes (`integer_network.py`), with errors below 8e-4 for SiLU and 2e-4 for tanh; a byte resolves 4e-3. */
#pragma once
#include "vectors.h"

enum { HIDDEN_ONE = 2048, NODES = 64, LEAST_SILU = 571 }; /* in words, negative */

/* NODES words. */
typedef struct {
#if defined(HALF_VECTORS)
    __m256i bytes[4]; /* of 16 nodes each: low bytes, then high bytes */
#else
    Words node[NODES / WORDS];
#endif
} Table;

typedef struct {
    Table value, slope;
} Lines;

INLINE Table table_of(const int16_t *node) {
    Table t;
#if defined(HALF_VECTORS)
    for (int i = 0; i < 4; i++) {
        uint8_t bytes[2][16];
        for (int j = 0; j < 16; j++)
            bytes[0][j] = (uint8_t)node[16 * i + j], bytes[1][j] = (uint8_t)(node[16 * i + j] >> 8);
        memcpy(t.bytes + i, bytes, sizeof bytes);
    }
#else
    for (int i = 0; i < NODES / WORDS; i++) t.node[i] = load_words(node + i * WORDS);
#endif
    return t;
}

/* From [2][NODES]: values at the nodes, and half the rise of each piece. */
INLINE Lines lines_of(const int16_t *table) { return (Lines){table_of(table), table_of(table + NODES)}; }

/* The entries at the last six bits of `index`. */
INLINE Words entries(const Table *t, Words index) {
#if defined(WIDE_VECTORS)
    return (Words)_mm512_permutex2var_epi16((__m512i)t->node[0], (__m512i)index, (__m512i)t->node[1]);
#elif defined(HALF_VECTORS)
    /* Bytes are looked up where the index is less than 16, and are zero where its highest bit is set. */
    const __m256i words = _mm256_and_si256((__m256i)index, _mm256_set1_epi16(NODES - 1));
    const __m256i at = _mm256_permute4x64_epi64(_mm256_packus_epi16(words, words), 0x88);
    __m256i each = _mm256_setzero_si256();
    for (int i = 0; i < 4; i++) {
        const __m256i from = _mm256_xor_si256(at, _mm256_set1_epi8((char)(16 * i)));
        const __m256i here = _mm256_adds_epu8(from, _mm256_set1_epi8(0x70));
        each = _mm256_or_si256(each, _mm256_shuffle_epi8(t->bytes[i], here));
    }
    const __m256i other = _mm256_permute2x128_si256(each, each, 1);
    return (Words)_mm256_permute2x128_si256(_mm256_unpacklo_epi8(each, other),
                                            _mm256_unpackhi_epi8(each, other), 0x20);
#else
    Words v;
    for (int i = 0; i < WORDS; i++) {
        const int at = index[i] & (NODES - 1);
        v[i] = t->node[at / WORDS][at % WORDS];
    }
    return v;
#endif
}

/* The function of |a| with nodes 2^bits apart; constant beyond the last one. */
INLINE Words on_lines(Lines l, Words far, const int bits) {
    const int below = 65536 - (NODES << bits); /* saturates beyond the last node */
    const Words node = right(sum_of_unsigned(far, all(below + (1 << (bits - 1)))), bits);
    return entries(&l.value, node) + product(entries(&l.slope, node), left(far, 16 - bits));
}

/* x in HIDDEN_ONE -> SiLU(x) = max(x, 0) + SiLU(-|x|) in HIDDEN_ONE. */
INLINE Words silu(Lines l, Words x) { return larger(x, all(0)) + on_lines(l, absolute(x), 8); }

/* x in 2^13 -> tanh(x) in 2^15. */
INLINE Words tanh_of(Lines l, Words x) {
    const Words v = on_lines(l, absolute(x), 9);
#if defined(WIDE_VECTORS)
    const __mmask32 negative = _mm512_movepi16_mask((__m512i)x);
    return (Words)_mm512_mask_sub_epi16((__m512i)v, negative, _mm512_setzero_si512(), (__m512i)v);
#elif defined(HALF_VECTORS)
    return (Words)_mm256_sign_epi16((__m256i)v, (__m256i)x); /* 0 for 0 */
#else
    const Words negative = x < 0;
    return (v ^ negative) - negative;
#endif
}

/* A row of a hidden layer as bytes x = scale * u - LEAST_SILU / HIDDEN_ONE; `most` bounds its words. */
INLINE float bytes_of_hidden(const int16_t *x, int count, int most, Byte *u) {
    const int above = most + LEAST_SILU, rate = (int)(255.0f * 65536.0f / (float)above);
    const Words start = all(LEAST_SILU + above / 510), times = all(rate); /* + half a byte */
    for (int n = 0; n < count; n += 2 * WORDS)
        store_bytes(u + n, product_of_unsigned(load_words(x + n) + start, times),
                    product_of_unsigned(load_words(x + n + WORDS) + start, times));
    return 65536.0f / (float)(HIDDEN_ONE * rate);
}

/* A row of h as bytes x = scale * (u - 128); `most` bounds its words. */
INLINE float bytes_of_state(const int16_t *x, int count, int most, Byte *u) {
    const int rate = (int)(127.0f * 32768.0f / (float)(most > 128 ? most : 128));
    const Words zero = all(128), times = all(rate);
    for (int n = 0; n < count; n += 2 * WORDS)
        store_bytes(u + n, zero + product(load_words(x + n), times),
                    zero + product(load_words(x + n + WORDS), times));
    return 1.0f / (float)rate;
}
