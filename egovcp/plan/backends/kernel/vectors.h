/* Vectors of LANES floats or twice as many 16-bit numbers (words): AVX-512, AVX2, or portable. */
#pragma once
#include <math.h>
#include <stdint.h>
#include <string.h>
#if defined(__AMX_INT8__) && !defined(WITHOUT_AMX)
#define TILES 1
#endif
#if defined(__AVX512VNNI__) && defined(__AVX512BW__)
#define WIDE_VECTORS 1 /* of 512 bits */
#elif defined(__AVX2__) && defined(__FMA__)
#define HALF_VECTORS 1 /* of 256 bits */
#endif
#if defined(WIDE_VECTORS) || defined(HALF_VECTORS) || defined(TILES)
#include <immintrin.h>
#endif
#define INLINE static inline __attribute__((always_inline))

#if defined(WIDE_VECTORS)
#define SIMD(name) _mm512_##name
typedef __m512i Integers;
typedef __m512 Numbers;
#elif defined(HALF_VECTORS)
#define SIMD(name) _mm256_##name
typedef __m256i Integers;
typedef __m256 Numbers;
#endif

#if defined(HALF_VECTORS)
enum { LANES = 8 };
#else
enum { LANES = 16 };
#endif
enum { WORDS = 2 * LANES };

typedef float Floats __attribute__((vector_size(4 * LANES)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));
typedef int16_t Words __attribute__((vector_size(2 * WORDS)));

INLINE Floats load(const float *x) {
    Floats v;
    memcpy(&v, x, sizeof v);
    return v;
}

INLINE void store(float *x, Floats v) { memcpy(x, &v, sizeof v); }

INLINE Words load_words(const int16_t *x) {
    Words v;
    memcpy(&v, x, sizeof v);
    return v;
}

INLINE void store_words(int16_t *x, Words v) { memcpy(x, &v, sizeof v); }

/* a b + c, rounded once where the processor can. */
INLINE Floats fused(Floats a, Floats b, Floats c) {
#if defined(SIMD)
    return (Floats)SIMD(fmadd_ps)((Numbers)a, (Numbers)b, (Numbers)c);
#else
    return a * b + c;
#endif
}

INLINE Floats all_floats(float x) { return (Floats){0} + x; }

INLINE float total(Floats v) {
#if defined(WIDE_VECTORS)
    return _mm512_reduce_add_ps((__m512)v);
#elif defined(HALF_VECTORS)
    __m128 four = _mm_add_ps(_mm256_castps256_ps128((__m256)v), _mm256_extractf128_ps((__m256)v, 1));
    four = _mm_add_ps(four, _mm_movehl_ps(four, four));
    return _mm_cvtss_f32(_mm_add_ss(four, _mm_movehdup_ps(four)));
#else
    float sum = 0.0f;
    for (int i = 0; i < LANES; i++) sum += v[i];
    return sum;
#endif
}

/* The largest of |x| [count], and at least `least`. */
INLINE float farthest(const float *x, int count, float least) {
#if defined(WIDE_VECTORS)
    __m512 most = _mm512_set1_ps(least);
    for (int i = 0; i < count; i += LANES) {
        const __mmask16 lanes = count - i < LANES ? (1u << (count - i)) - 1u : 0xffffu;
        most = _mm512_max_ps(most, _mm512_abs_ps(_mm512_maskz_loadu_ps(lanes, x + i)));
    }
    return _mm512_reduce_max_ps(most);
#else
    for (int i = 0; i < count; i++) least = fabsf(x[i]) > least ? fabsf(x[i]) : least;
    return least;
#endif
}

/* The largest of x [count]. */
INLINE float largest(const float *x, int count) {
#if defined(WIDE_VECTORS)
    __m512 most = _mm512_set1_ps(x[0]);
    for (int i = 0; i < count; i += LANES) {
        const __mmask16 lanes = count - i < LANES ? (1u << (count - i)) - 1u : 0xffffu;
        most = _mm512_mask_max_ps(most, lanes, most, _mm512_maskz_loadu_ps(lanes, x + i));
    }
    return _mm512_reduce_max_ps(most);
#else
    float most = x[0];
    for (int i = 1; i < count; i++) most = x[i] > most ? x[i] : most;
    return most;
#endif
}

/* The first `count` lanes, the others zero. */
INLINE Floats first_floats(Floats v, int count) {
#if defined(WIDE_VECTORS)
    return (Floats)_mm512_maskz_mov_ps((1u << count) - 1u, (__m512)v);
#else
    for (int i = count; i < LANES; i++) v[i] = 0.0f;
    return v;
#endif
}

/* exp(x) of x <= 0, to 1e-7; x is limited to -80. */
INLINE Floats exponential(Floats x) {
    const Ints far = x < -80.0f;
    x = (Floats)((far & (Ints)all_floats(-80.0f)) | (~far & (Ints)x));
    const Floats power = x * 1.44269504f; /* of two */
    const Ints whole = __builtin_convertvector(power - 0.5f, Ints); /* rounded; none is positive */
    const Floats f = (power - __builtin_convertvector(whole, Floats)) * 0.69314718f;
    static const float SERIES[] = {1.0f, 1.0f, 1.0f / 2, 1.0f / 6, 1.0f / 24, 1.0f / 120, 1.0f / 720};
    Floats sum = all_floats(SERIES[6]);
    for (int k = 5; k >= 0; k--) sum = fused(sum, f, all_floats(SERIES[k]));
    return sum * (Floats)((whole + 127) << 23);
}

/* Rounded to words, with saturation. */
INLINE Words words_of(Floats a, Floats b) {
#if defined(WIDE_VECTORS)
    const __m512i each =
        _mm512_packs_epi32(_mm512_cvtps_epi32((__m512)a), _mm512_cvtps_epi32((__m512)b));
    return (Words)_mm512_permutexvar_epi64(_mm512_setr_epi64(0, 2, 4, 6, 1, 3, 5, 7), each);
#elif defined(HALF_VECTORS)
    const __m256i each =
        _mm256_packs_epi32(_mm256_cvtps_epi32((__m256)a), _mm256_cvtps_epi32((__m256)b));
    return (Words)_mm256_permute4x64_epi64(each, 0xd8);
#else
    Words v;
    for (int i = 0; i < WORDS; i++) {
        const float x = i < LANES ? a[i] : b[i - LANES];
        v[i] = !(x > -32768.0f) ? -32768 : x > 32767.0f ? 32767 : (int16_t)lrintf(x);
    }
    return v;
#endif
}

/* The first `count` lanes, the others zero. */
INLINE Words first(Words v, int count) {
#if defined(WIDE_VECTORS)
    return (Words)_mm512_maskz_mov_epi16((1u << count) - 1u, (__m512i)v);
#else
    for (int i = count; i < WORDS; i++) v[i] = 0;
    return v;
#endif
}

INLINE Words larger(Words a, Words b) {
#if defined(SIMD)
    return (Words)SIMD(max_epi16)((Integers)a, (Integers)b);
#else
    const Words this = a > b;
    return (a & this) | (b & ~this);
#endif
}

/* -32768 stays; as an unsigned word it is 32768. */
INLINE Words absolute(Words a) {
#if defined(SIMD)
    return (Words)SIMD(abs_epi16)((Integers)a);
#else
    const Words negative = a < 0;
    return (a ^ negative) - negative;
#endif
}

/* a + b with saturation. */
INLINE Words sum(Words a, Words b) {
#if defined(SIMD)
    return (Words)SIMD(adds_epi16)((Integers)a, (Integers)b);
#else
    for (int i = 0; i < WORDS; i++) {
        const int v = a[i] + b[i];
        a[i] = v < -32768 ? -32768 : v > 32767 ? 32767 : v;
    }
    return a;
#endif
}

/* The same of unsigned words. */
INLINE Words sum_of_unsigned(Words a, Words b) {
#if defined(SIMD)
    return (Words)SIMD(adds_epu16)((Integers)a, (Integers)b);
#else
    for (int i = 0; i < WORDS; i++) {
        const int v = (uint16_t)a[i] + (uint16_t)b[i];
        a[i] = (int16_t)(uint16_t)(v > 65535 ? 65535 : v);
    }
    return a;
#endif
}

/* a b / 2^15, rounded. */
INLINE Words product(Words a, Words b) {
#if defined(SIMD)
    return (Words)SIMD(mulhrs_epi16)((Integers)a, (Integers)b);
#else
    for (int i = 0; i < WORDS; i++) a[i] = (int16_t)((a[i] * b[i] + (1 << 14)) >> 15);
    return a;
#endif
}

/* a b / 2^16 of unsigned words, rounded down. */
INLINE Words product_of_unsigned(Words a, Words b) {
#if defined(SIMD)
    return (Words)SIMD(mulhi_epu16)((Integers)a, (Integers)b);
#else
    for (int i = 0; i < WORDS; i++)
        a[i] = (int16_t)(uint16_t)(((uint32_t)(uint16_t)a[i] * (uint16_t)b[i]) >> 16);
    return a;
#endif
}

/* sum + a b, each lane of two neighbours. */
INLINE Ints pairs(Ints sum, Words a, Words b) {
#if defined(WIDE_VECTORS)
    return (Ints)_mm512_dpwssd_epi32((__m512i)sum, (__m512i)a, (__m512i)b);
#elif defined(HALF_VECTORS)
    return sum + (Ints)_mm256_madd_epi16((__m256i)a, (__m256i)b);
#else
    for (int i = 0; i < LANES; i++) sum[i] += a[2 * i] * b[2 * i] + a[2 * i + 1] * b[2 * i + 1];
    return sum;
#endif
}

/* Two words, repeated. */
INLINE Words repeated(const int16_t *x) {
    int32_t both;
    memcpy(&both, x, sizeof both);
    return (Words)((Ints){0} + both);
}

INLINE Words halved(Words a, int times) {
#if defined(SIMD)
    return (Words)SIMD(srai_epi16)((Integers)a, times);
#else
    return a >> times;
#endif
}

/* Shift of unsigned words. */
INLINE Words left(Words a, int bits) {
    typedef uint16_t Unsigned __attribute__((vector_size(2 * WORDS)));
    return (Words)((Unsigned)a << bits);
}

INLINE Words right(Words a, int bits) {
    typedef uint16_t Unsigned __attribute__((vector_size(2 * WORDS)));
    return (Words)((Unsigned)a >> bits);
}

INLINE Words all(int x) { return (Words){0} + (int16_t)x; }

/* The largest; none is negative. */
INLINE int highest(Words v) {
#if defined(WIDE_VECTORS)
    const __m256i half = _mm256_max_epi16(_mm512_castsi512_si256((__m512i)v),
                                          _mm512_extracti64x4_epi64((__m512i)v, 1));
#elif defined(HALF_VECTORS)
    const __m256i half = (__m256i)v;
#endif
#if defined(SIMD)
    const __m128i eight =
        _mm_max_epi16(_mm256_castsi256_si128(half), _mm256_extracti128_si256(half, 1));
    const __m128i lacking = _mm_minpos_epu16(_mm_sub_epi16(_mm_set1_epi16(0x7fff), eight));
    return 0x7fff - (_mm_cvtsi128_si32(lacking) & 0xffff);
#else
    int most = 0;
    for (int i = 0; i < WORDS; i++) most = v[i] > most ? v[i] : most;
    return most;
#endif
}

/* An unsigned 8-bit number, as `dots` reads it: AVX2 multiplies words. */
#if defined(HALF_VECTORS)
typedef int16_t Byte;
#else
typedef uint8_t Byte;
#endif

/* Two vectors of words as bytes, with saturation. */
INLINE void store_bytes(Byte *u, Words a, Words b) {
#if defined(WIDE_VECTORS)
    const __m512i each = _mm512_packus_epi16((__m512i)a, (__m512i)b);
    _mm512_storeu_si512(u,
                        _mm512_permutexvar_epi64(_mm512_setr_epi64(0, 2, 4, 6, 1, 3, 5, 7), each));
#elif defined(HALF_VECTORS)
    const __m256i least = _mm256_setzero_si256(), most = _mm256_set1_epi16(255);
    store_words(u, (Words)_mm256_min_epi16(_mm256_max_epi16((__m256i)a, least), most));
    store_words(u + WORDS, (Words)_mm256_min_epi16(_mm256_max_epi16((__m256i)b, least), most));
#else
    for (int i = 0; i < 2 * WORDS; i++) {
        const int x = i < WORDS ? a[i] : b[i - WORDS];
        u[i] = x < 0 ? 0 : x > 255 ? 255 : (uint8_t)x;
    }
#endif
}
