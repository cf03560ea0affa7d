/* A network on past commands as velocity model: forward pass over the window, and backward pass for the gradient.
 *
 * This file contains only algebra; the equations of the units and their derivatives are generated from
 * models/lstm_cell.py. Inner loops run over units, which are adjacent in memory. */
#include "network.h"

#include <string.h>

#include "core.h"
#include "ddmpc_network_formulas.h"

enum { ENTER, KEEP, CANDIDATE, LEAVE, GATES };
/* Derivatives of a unit at a sample: derivatives of the cell by the gates and by the previous cell, and derivatives of
 * the output by the output gate and by the cell. */
enum { BY_ENTER, BY_KEEP, BY_CANDIDATE, BY_CELL, OUT_BY_LEAVE, OUT_BY_CELL };

typedef struct {
    int samples, units, dense;       /* T, H, D */
    int unit_row, dense_row, in_row; /* P, Q, Z */
    const real *gates, *gate_offset, *gates_transposed;
    const real *layer, *layer_offset, *layer_transposed;
    const real *outputs, *output_offset;
} network;

static int round_up(int count) { return (count + DDMPC_BLOCK - 1) / DDMPC_BLOCK * DDMPC_BLOCK; }

static network read_network(const real *p)
{
    network n;
    n.samples = (int)p[0];
    n.units = (int)p[1];
    n.dense = (int)p[2];
    n.unit_row = round_up(n.units);
    n.dense_row = round_up(n.dense);
    n.in_row = round_up(n.units + 2);
    n.gates = p + 3;
    n.gate_offset = n.gates + (n.units + 2) * GATES * n.unit_row;
    n.gates_transposed = n.gate_offset + GATES * n.unit_row;
    n.layer = n.gates_transposed + GATES * n.unit_row * n.in_row;
    n.layer_offset = n.layer + n.units * n.dense_row;
    n.layer_transposed = n.layer_offset + n.dense_row;
    n.outputs = n.layer_transposed + n.dense * n.unit_row;
    n.output_offset = n.outputs + 2 * n.dense_row;
    return n;
}

/* sum (columns) += left (rows) times matrix (rows, columns), columns being whole blocks. */
static inline void add_product(const real *restrict left, const real *restrict matrix, int rows, int columns,
                               real *restrict sum)
{
    for (int first = 0; first < columns; first += DDMPC_BLOCK) {
        /* The compiler keeps a local copy in registers. */
        real block[DDMPC_BLOCK];
#pragma GCC unroll 32
        for (int j = 0; j < DDMPC_BLOCK; j++)
            block[j] = sum[first + j];
        for (int k = 0; k < rows; k++) {
            const real *restrict row = matrix + k * columns + first;
#pragma GCC unroll 32
            for (int j = 0; j < DDMPC_BLOCK; j++)
                block[j] += left[k] * row[j];
        }
#pragma GCC unroll 32
        for (int j = 0; j < DDMPC_BLOCK; j++)
            sum[first + j] = block[j];
    }
}

/* Advance cells and outputs of all units by one sample, from the sums of their gates; if `gradient`, write their
 * derivatives to `stored`. */
static inline void advance_units(int row, const real *restrict sums, real *restrict cell, real *restrict output,
                                 real *restrict stored, int gradient)
{
#pragma GCC ivdep
    for (int j = 0; j < row; j++) {
        const real enter = sums[j], keep = sums[row + j], candidate = sums[2 * row + j], leave = sums[3 * row + j];
        const real before = cell[j];
        real after, out, by_before[4], by_now[2];
        const real *into_cell[4] = {&enter, &keep, &candidate, &before};
        real *from_cell[2] = {&after, gradient ? by_before : 0};
        ddmpc_f_cell(into_cell, from_cell);
        const real *into_hidden[2] = {&leave, &after};
        real *from_hidden[2] = {&out, gradient ? by_now : 0};
        ddmpc_f_hidden(into_hidden, from_hidden);
        cell[j] = after;
        output[j] = out;
        if (gradient) {
            stored[BY_ENTER * row + j] = by_before[0];
            stored[BY_KEEP * row + j] = by_before[1];
            stored[BY_CANDIDATE * row + j] = by_before[2];
            stored[BY_CELL * row + j] = by_before[3];
            stored[OUT_BY_LEAVE * row + j] = by_now[0];
            stored[OUT_BY_CELL * row + j] = by_now[1];
        }
    }
}

static inline void activate(int row, real *restrict sums, real *restrict slope)
{
#pragma GCC ivdep
    for (int j = 0; j < row; j++) {
        const real x = sums[j];
        real y, by_x;
        const real *arguments[1] = {&x};
        real *results[2] = {&y, &by_x};
        ddmpc_f_dense(arguments, results);
        sums[j] = y;
        slope[j] = by_x;
    }
}

/* Propagate derivatives of an output back through one sample, to the sums of the gates and to the previous cell. */
static inline void propagate_back(int row, const real *restrict stored, const real *restrict by_output,
                                  real *restrict by_cell, real *restrict by_sums)
{
    for (int j = 0; j < row; j++) {
        const real cell = by_cell[j] + by_output[j] * stored[OUT_BY_CELL * row + j];
        by_sums[ENTER * row + j] = cell * stored[BY_ENTER * row + j];
        by_sums[KEEP * row + j] = cell * stored[BY_KEEP * row + j];
        by_sums[CANDIDATE * row + j] = cell * stored[BY_CANDIDATE * row + j];
        by_sums[LEAVE * row + j] = by_output[j] * stored[OUT_BY_LEAVE * row + j];
        by_cell[j] = cell * stored[BY_CELL * row + j];
    }
}

/* Compute row `output` of the gradient by the window, which is stored column by column; `stored` and `slope` come
 * from the forward pass. */
static void compute_gradient_row(const network *n, int output, const real *stored, const real *slope, real *memory,
                                 real *gradient)
{
    const int P = n->unit_row, Z = n->in_row;
    real *by_sums = memory, *by_cell = by_sums + GATES * P, *by_in = by_cell + P, *by_layer = by_in + Z;
    for (int j = 0; j < n->dense_row; j++)
        by_layer[j] = n->outputs[output * n->dense_row + j] * slope[j];
    memset(by_cell, 0, (size_t)(P + Z) * sizeof(real));
    add_product(by_layer, n->layer_transposed, n->dense, P, by_in);
    for (int t = n->samples - 1; t >= 0; t--) {
        propagate_back(P, stored + t * DDMPC_STORED * P, by_in, by_cell, by_sums);
        memset(by_in, 0, (size_t)Z * sizeof(real));
        add_product(by_sums, n->gates_transposed, GATES * P, Z, by_in);
        for (int channel = 0; channel < 2; channel++) {
            gradient[output + 2 * (2 * t + channel)] = by_in[n->units + channel];
            by_in[n->units + channel] = R(0.0);
        }
    }
}

int ddmpc_network_step(const real **arguments, real **results, long long *iw, real *w, int memory)
{
    const network n = read_network(arguments[2]);
    const real *window = arguments[1];
    const int P = n.unit_row, gradient = results[2] != 0;
    real *in = w, *cell = in + n.in_row, *sums = cell + P, *layer = sums + GATES * P, *slope = layer + n.dense_row;
    real *rest = slope + n.dense_row, *stored = rest + GATES * P + P + n.in_row + n.dense_row;
    (void)iw, (void)memory;
    memset(in, 0, (size_t)(n.in_row + P) * sizeof(real));
    for (int t = 0; t < n.samples; t++) {
        memcpy(in + n.units, window + 2 * t, 2 * sizeof(real));
        memcpy(sums, n.gate_offset, (size_t)(GATES * P) * sizeof(real));
        add_product(in, n.gates, n.units + 2, GATES * P, sums);
        if (gradient)
            advance_units(P, sums, cell, in, stored + t * DDMPC_STORED * P, 1);
        else
            advance_units(P, sums, cell, in, 0, 0);
    }
    memcpy(layer, n.layer_offset, (size_t)n.dense_row * sizeof(real));
    add_product(in, n.layer, n.units, n.dense_row, layer);
    activate(n.dense_row, layer, slope);
    for (int output = 0; output < 2; output++) {
        real sum = n.output_offset[output];
        for (int j = 0; j < n.dense; j++)
            sum += n.outputs[output * n.dense_row + j] * layer[j];
        results[0][output] = sum;
        if (gradient)
            compute_gradient_row(&n, output, stored, slope, rest, results[2]);
    }
    /* The output depends only on the window, so the derivatives by the state are zero. */
    if (results[1])
        memset(results[1], 0, 4 * sizeof(real));
    return 0;
}

int ddmpc_network_output(const real **arguments, real **results, long long *iw, real *w, int memory)
{
    (void)iw, (void)w, (void)memory;
    memcpy(results[0], arguments[0], 2 * sizeof(real));
    if (results[1]) {
        results[1][0] = results[1][3] = R(1.0);
        results[1][1] = results[1][2] = R(0.0);
    }
    return 0;
}
