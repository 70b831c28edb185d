/* Products of a block of candidates with a weight. */
#pragma once
#include "network.h"

#if defined(TILES)
/* Tiles are whole: 16 rows of 64 bytes. The thread that calls has them until it releases them. */
static void take_tiles(void) {
    struct {
        uint8_t palette, start, reserved[14];
        uint16_t bytes[16];
        uint8_t rows[16];
    } tiles __attribute__((aligned(64))) = {.palette = 1};
    for (int i = 0; i < 8; i++) tiles.bytes[i] = 4 * LANES, tiles.rows[i] = ROWS;
    _tile_loadconfig(&tiles);
}

static void release_tiles(void) { _tile_release(); }

/* Dot products of a block of rows with `columns` (COLUMNS or 1) times LANES outputs from `n` on. */
INLINE void dots(const Wide *w, int n, int columns, const Bytes *in, Ints dot[][ROWS]) {
    const int8_t *weight = w->weight + (int64_t)n * w->inputs;
    const int column = LANES * w->inputs, tile = LANES * DEPTH, each = 4 * LANES;
    _tile_loadd(0, w->start + n, 0); /* the same for all rows */
    if (columns > 1) {
        _tile_loadd(1, w->start + n + LANES, 0);
        _tile_loadd(2, w->start + n + 2 * LANES, 0);
        _tile_loadd(3, w->start + n + 3 * LANES, 0);
    }
    for (int k = 0; k < w->inputs; k += DEPTH, weight += tile) {
        _tile_loadd(4, in->values[0] + k, WIDEST);
        _tile_loadd(5, weight, each);
        _tile_dpbusd(0, 4, 5);
        if (columns > 1) {
            _tile_loadd(6, weight + column, each);
            _tile_dpbusd(1, 4, 6);
            _tile_loadd(7, weight + 2 * column, each);
            _tile_dpbusd(2, 4, 7);
            _tile_loadd(5, weight + 3 * column, each);
            _tile_dpbusd(3, 4, 5);
        }
    }
    _tile_stored(0, dot[0], each);
    if (columns > 1) {
        _tile_stored(1, dot[1], each);
        _tile_stored(2, dot[2], each);
        _tile_stored(3, dot[3], each);
    }
}
#else
static void take_tiles(void) {}

static void release_tiles(void) {}

/* Dot products of a block of rows with `columns` times LANES outputs from `n` on. */
INLINE void dots(const Wide *w, int n, int columns, const Bytes *in, Ints dot[][ROWS]) {
    const int groups = w->inputs / GROUP;
    const int8_t *weight = w->weight + (int64_t)n * w->inputs;
    for (int c = 0; c < columns; c++) {
        Ints start;
        memcpy(&start, w->start + n + c * LANES, sizeof start);
        for (int r = 0; r < ROWS; r++) dot[c][r] = start;
    }
    for (int g = 0; g < groups; g++) {
#if defined(WIDE_VECTORS)
        __m512i b[COLUMNS];
        for (int c = 0; c < columns; c++)
            b[c] = _mm512_loadu_si512(weight + ((int64_t)c * groups + g) * GROUP * LANES);
        for (int r = 0; r < ROWS; r++) {
            int32_t four;
            memcpy(&four, in->values[r] + GROUP * g, sizeof four);
            const __m512i x = _mm512_set1_epi32(four);
            for (int c = 0; c < columns; c++)
                dot[c][r] = (Ints)_mm512_dpbusd_epi32((__m512i)dot[c][r], x, b[c]);
        }
#elif defined(HALF_VECTORS)
        for (int c = 0; c < columns; c++) {
            const int8_t *two_by_lane = weight + ((int64_t)c * groups + g) * GROUP * LANES;
            const __m256i b = _mm256_cvtepi8_epi16(_mm_loadu_si128((const __m128i *)two_by_lane));
            for (int r = 0; r < ROWS; r++)
                dot[c][r] = pairs(dot[c][r], again(in->values[r] + GROUP * g), (Words)b);
        }
#else
        for (int c = 0; c < columns; c++) {
            const int8_t *group_by_lane = weight + ((int64_t)c * groups + g) * GROUP * LANES;
            for (int r = 0; r < ROWS; r++)
                for (int i = 0; i < LANES; i++)
                    for (int j = 0; j < GROUP; j++)
                        dot[c][r][i] +=
                            (int32_t)in->values[r][GROUP * g + j] * group_by_lane[GROUP * i + j];
        }
#endif
    }
}
#endif

INLINE void columns_of_product(const Wide *w, int n, int columns, const Bytes *in, const float *from,
                               int from_stride, float *y, int stride) {
    Ints dot[COLUMNS][ROWS];
    dots(w, n, columns, in, dot);
    for (int c = 0; c < columns; c++, n += LANES) {
        const Floats weight_scale = load(w->scale + n), shift = load(w->shift + n);
        for (int r = 0; r < ROWS; r++) {
            const Floats product = __builtin_convertvector(dot[c][r], Floats) * weight_scale;
            const Floats start = load(from + r * from_stride + n) + shift;
            store(y + r * stride + n, fused(all_floats(in->scale[r]), product, start));
        }
    }
}

/* y [ROWS][N] = from + the product with a wide weight. */
static void wide_product(const Wide *w, int outputs, const Bytes *in, const float *from, int from_stride,
                         float *y) {
    int n = 0;
    for (; n + COLUMNS * LANES <= outputs; n += COLUMNS * LANES)
        columns_of_product(w, n, COLUMNS, in, from, from_stride, y, outputs);
    for (; n < outputs; n += LANES) columns_of_product(w, n, 1, in, from, from_stride, y, outputs);
}

enum { NARROW_COLUMNS = COLUMNS > 1 ? 2 : 1 };

INLINE void columns_of_narrow(const Narrow *w, int inputs, int outputs, int n, int columns, const Few *x,
                              const float *from, float *y) {
    Floats acc[NARROW_COLUMNS][ROWS];
    for (int c = 0; c < columns; c++)
        for (int r = 0; r < ROWS; r++) acc[c][r] = load(from + n + c * LANES);
    for (int k = 0; k < inputs; k++) {
        const float *weight = w->weight + (int64_t)k * outputs + n;
        for (int r = 0; r < ROWS; r++)
            for (int c = 0; c < columns; c++)
                acc[c][r] = fused(all_floats(x->values[r][k]), load(weight + c * LANES), acc[c][r]);
    }
    for (int c = 0; c < columns; c++)
        for (int r = 0; r < ROWS; r++) store(y + r * outputs + n + c * LANES, acc[c][r]);
}

/* y [ROWS][N] = from [N] + the product of the first inputs with their weights. */
static void narrow_product(const Narrow *w, int inputs, int outputs, const Few *x, const float *from,
                           float *y) {
    int n = 0;
    for (; n + NARROW_COLUMNS * LANES <= outputs; n += NARROW_COLUMNS * LANES)
        columns_of_narrow(w, inputs, outputs, n, NARROW_COLUMNS, x, from, y);
    for (; n < outputs; n += LANES) columns_of_narrow(w, inputs, outputs, n, 1, x, from, y);
}
