/* Products of blocks with few columns, the inner loop of condensing and factorising. */
#ifndef DDMPC_TILE_H
#define DDMPC_TILE_H

#include "real.h"

/* Number of columns processed at once, chosen so that a block fits into the registers of the processor. */
#ifdef DDMPC_EXPORT
enum { DDMPC_LANES = 4 };
#else
enum { DDMPC_LANES = 8 };
#endif

/* Round `count` up to a multiple of DDMPC_LANES. */
static inline int ddmpc_whole_lanes(int count) { return (count + DDMPC_LANES - 1) / DDMPC_LANES * DDMPC_LANES; }

/* sum += left' right for two blocks of DDMPC_LANES columns and `rows` rows, which lie `stride` apart. */
static inline void ddmpc_tile(const real *left, const real *right, int rows, int stride,
                              real sum[DDMPC_LANES][DDMPC_LANES])
{
    /* The compiler keeps a local copy in registers. */
    real block[DDMPC_LANES][DDMPC_LANES];
    for (int a = 0; a < DDMPC_LANES; a++)
        for (int b = 0; b < DDMPC_LANES; b++)
            block[a][b] = sum[a][b];
    for (int row = 0; row < rows; row++, left += stride, right += stride)
#pragma GCC unroll 8
        for (int a = 0; a < DDMPC_LANES; a++)
#pragma GCC unroll 8
            for (int b = 0; b < DDMPC_LANES; b++)
                block[a][b] += left[a] * right[b];
    for (int a = 0; a < DDMPC_LANES; a++)
        for (int b = 0; b < DDMPC_LANES; b++)
            sum[a][b] = block[a][b];
}

#endif
