/* Active rows of ddmpc_solve_limited: the piece of the penalty on which each row lies, and the factorised linear system
 * of the multipliers, updated when rows enter and leave. Every loop runs over rows, inputs or lanes. */
#include "active_rows.h"

#include <string.h>

enum { LANES = DDMPC_LANES };

/* Minimum number of columns for which a batch is faster than single columns. */
enum { MIN_BATCH = 3 };

/* Share of the squared norm of a row that remains after elimination, below which the row counts as linearly dependent:
 * about 30 rounding errors in single precision, and 5000 in double precision, which has enough digits for a margin. */
#ifdef DDMPC_FLOAT
static const real DEPENDENCE_TOLERANCE = R(4e-6);
#else
static const real DEPENDENCE_TOLERANCE = R(1e-12);
#endif

int ddmpc_init_rows(ddmpc_rows *rows, const ddmpc_limited_problem *problem, const ddmpc_limited_memory *memory)
{
    const int n = problem->inputs, m = problem->rows, slots = DDMPC_LIMITED_SLOTS(memory->max_active);
    const int whole = ddmpc_whole_lanes(n);
    /* Blocks start at cache lines. */
    real *next = memory->reals + (64 - (size_t)memory->reals % 64) % 64 / sizeof(real);
    memset(rows, 0, sizeof *rows);
    rows->problem = problem;
    rows->n = n;
    rows->m = m;
    rows->slots = slots;
    rows->max_active = memory->max_active;
    rows->columns = next;
    rows->gram = rows->columns + n * slots;
    rows->factor = rows->gram + slots * slots;
    rows->batch = rows->factor + slots * slots;
    rows->inverse = rows->batch + n * LANES;
    rows->z = rows->inverse + whole;
    rows->line = rows->z + whole;
    rows->pivot = rows->line + whole;
    rows->partial = rows->pivot + slots;
    rows->solution = rows->partial + slots;
    rows->multiplier = rows->solution + slots;
    rows->step = rows->multiplier + slots;
    rows->slot_multipliers = rows->step + slots;
    rows->start = rows->slot_multipliers + slots;
    rows->values = rows->start + m;
    rows->slot_of = memory->ints;
    rows->state = rows->slot_of + m;
    rows->row_in = rows->state + m;
    rows->order = rows->row_in + slots;
    rows->entering = rows->order + slots;
    memset(rows->slot_of, 0, (size_t)m * sizeof(int));
    memset(rows->state, 0, (size_t)m * sizeof(int));
    memset(rows->z, 0, (size_t)whole * sizeof(real));
    for (int i = 0; i < n; i++) {
        const real diagonal = problem->factor[i * n + i];
        /* Negated, here and below, so that NaN fails. */
        if (!(diagonal > R(0.0) && diagonal < DDMPC_LARGEST && ddmpc_fabs(problem->minimiser[i]) < DDMPC_LARGEST))
            return 0;
        rows->inverse[i] = R(1.0) / diagonal;
        rows->max_input = ddmpc_max(rows->max_input, ddmpc_fabs(problem->minimiser[i]));
    }
    problem->values(problem->context, problem->minimiser, rows->start);
    int is_finite = 1;
    for (int i = 0; i < m; i++)
        is_finite &= ddmpc_fabs(rows->start[i]) < DDMPC_LARGEST;
    return is_finite;
}

static real sum_of_lanes(const real sum[LANES])
{
    real half[LANES / 2];
    for (int lane = 0; lane < LANES / 2; lane++)
        half[lane] = sum[lane] + sum[lane + LANES / 2];
    for (int count = LANES / 4; count > 0; count /= 2)
        for (int lane = 0; lane < count; lane++)
            half[lane] += half[lane + count];
    return half[0];
}

/* a'b for whole lanes, in several partial sums: a compiler may not reorder a single sum and so could not vectorise
 * it. */
static real dot(const real *restrict a, const real *restrict b, int count)
{
    real sum[LANES] = {R(0.0)};
    for (int i = 0; i < count; i += LANES)
#pragma GCC unroll 8
        for (int lane = 0; lane < LANES; lane++)
            sum[lane] += a[i + lane] * b[i + lane];
    return sum_of_lanes(sum);
}

real ddmpc_long_dot(const real *restrict a, const real *restrict b, int count)
{
    real sum[LANES] = {R(0.0)};
    int i = 0;
    for (; i + LANES <= count; i += LANES)
#pragma GCC unroll 8
        for (int lane = 0; lane < LANES; lane++)
            sum[lane] += a[i + lane] * b[i + lane];
    for (int lane = 0; i < count; i++, lane++)
        sum[lane] += a[i] * b[i];
    return sum_of_lanes(sum);
}

/* row -= weight * subtracted, over LANES. */
static inline void subtract(real *restrict row, real weight, const real *restrict subtracted)
{
    /* The compiler vectorises the loop as a whole only if it is not unrolled. */
#pragma GCC unroll 1
    for (int lane = 0; lane < LANES; lane++)
        row[lane] -= weight * subtracted[lane];
}

static inline void scale(real *restrict row, real weight)
{
#pragma GCC unroll 1
    for (int lane = 0; lane < LANES; lane++)
        row[lane] *= weight;
}

/* sum = left' right for blocks of LANES columns. */
static void cross(const real *restrict left, int left_stride, const real *restrict right, int right_stride, int rows,
                  real sum[LANES][LANES])
{
    real block[LANES][LANES];
    memset(block, 0, sizeof block);
    for (int row = 0; row < rows; row++, left += left_stride, right += right_stride)
#pragma GCC unroll 8
        for (int a = 0; a < LANES; a++)
#pragma GCC unroll 8
            for (int b = 0; b < LANES; b++)
                block[a][b] += left[a] * right[b];
    memcpy(sum, block, sizeof block);
}

/* x = U'^-1 x for an upper triangular U of `count` rows, with the inverses of its diagonal. Before the index `zero`, x is
 * zero; before the index `known`, a multiple of LANES, x is already solved. */
static void substitute(const real *restrict U, int stride, const real *restrict inverse, int count, int zero, int known,
                       real *restrict x)
{
    for (int i = known; i < count; i += LANES) {
        const int width = count - i < LANES ? count - i : LANES;
        real sum[2][LANES] = {{R(0.0)}};
        /* In an incomplete last block this reads into the next row; the surplus results are not used. */
        for (int k = zero / LANES * LANES; k < i; k += 2)
#pragma GCC unroll 2
            for (int half = 0; half < 2; half++)
#pragma GCC unroll 8
                for (int lane = 0; lane < LANES; lane++)
                    sum[half][lane] += x[k + half] * U[(k + half) * stride + i + lane];
        for (int a = 0; a < width; a++) {
            const real *row = U + (i + a) * stride + i;
            const real solved = x[i + a] = (x[i + a] - sum[0][a] - sum[1][a]) * inverse[i + a];
            for (int c = a + 1; c < width; c++)
                sum[0][c] += row[c] * solved;
        }
    }
}

/* x = R'^-1 x for LANES right-hand sides, (n, LANES), which are zero before row `first`. */
static void substitute_batch(const ddmpc_rows *rows, int first, real *x)
{
    const int n = rows->n, start = first / LANES * LANES;
    const real *factor = rows->problem->factor;
    for (int i = start; i < n; i += LANES) {
        const int width = n - i < LANES ? n - i : LANES;
        real sum[LANES][LANES];
        /* In an incomplete last block this reads into the next row; the surplus results are not used. */
        cross(factor + start * n + i, n, x + start * LANES, LANES, i - start, sum);
        for (int a = 0; a < width; a++) {
            real *solved = x + (i + a) * LANES;
            const real *row = factor + (i + a) * n + i;
            subtract(solved, R(1.0), sum[a]);
            scale(solved, rows->inverse[i + a]);
            for (int c = a + 1; c < width; c++)
                subtract(sum[c], -row[c], solved);
        }
    }
}

/* x = U^-1 x for the first `count` rows of an upper triangular U, with the inverses of its diagonal. x has whole
 * lanes. */
static void substitute_back(const real *U, int stride, const real *inverse, int count, real *x)
{
    const int whole = ddmpc_whole_lanes(count);
    /* x is zero beyond the last row, so the entries of U there are read without effect. */
    for (int k = count; k < whole; k++)
        x[k] = R(0.0);
    /* Blocks allow vectorised products with solved blocks; only the small triangles are sequential. */
    for (int start = whole - LANES; start >= 0; start -= LANES) {
        const int end = start + LANES, last = end < count ? end : count;
        if (end < whole)
            for (int k = start; k < last; k++)
                x[k] -= dot(U + k * stride + end, x + end, whole - end);
        for (int k = last - 1; k >= start; k--) {
            x[k] *= inverse[k];
            for (int i = start; i < k; i++)
                x[i] -= U[i * stride + k] * x[k];
        }
    }
}

void ddmpc_move_plan(ddmpc_rows *rows, const real *multipliers, const real *start, real *plan)
{
    const int n = rows->n;
    /* The multipliers of inactive rows are zero, so that products can run over all slots in whole lanes. */
    memset(rows->slot_multipliers, 0, (size_t)rows->padded_count * sizeof(real));
    for (int i = 0; i < rows->active; i++)
        rows->slot_multipliers[rows->order[i]] = multipliers[i];
    for (int k = 0; k < n; k++)
        rows->z[k] = dot(rows->columns + k * rows->slots, rows->slot_multipliers, rows->padded_count);
    /* `z` is now sum lambda_i v_i, the negative of z in active_rows.h; hence the minus below. */
    substitute_back(rows->problem->factor, n, rows->inverse, n, rows->z);
    for (int k = 0; k < n; k++)
        plan[k] = start[k] - rows->z[k];
    rows->problem->values(rows->problem->context, plan, rows->values);
    rows->work += ddmpc_plan_operations(n, rows->m, rows->padded_count);
}

/* Return a slot for `row`: an unused slot or, if there is none, the slot of an inactive row. */
static int take_slot(ddmpc_rows *rows, int row)
{
    int slot = rows->slot_count;
    if (slot < rows->slots) {
        rows->slot_count++;
    } else {
        /* The caller ensures that there are enough slots, so at least one slot belongs to an inactive row. */
        for (slot = 0; slot < rows->slots - 1 && rows->state[rows->row_in[slot]] != DDMPC_FREE; slot++)
            ;
        rows->work += rows->slots;
        rows->slot_of[rows->row_in[slot]] = 0;
    }
    /* Products run over whole lanes, including slots that are not used yet, which must be zero. */
    if (slot == rows->padded_count) {
        for (int k = 0; k < rows->n; k++)
            memset(rows->columns + k * rows->slots + slot, 0, LANES * sizeof(real));
        rows->padded_count += LANES;
    }
    rows->row_in[slot] = row;
    rows->slot_of[row] = slot + 1;
    return slot;
}

/* Compute the column v and the products v'v of the row in a slot. */
static void compute_column(ddmpc_rows *rows, int slot)
{
    const int n = rows->n, slots = rows->slots;
    int first = 0, last = n;
    real *restrict x = rows->z;
    rows->problem->row(rows->problem->context, rows->row_in[slot], rows->line, &first, &last);
    memset(x, 0, (size_t)n * sizeof(real));
    memcpy(x + first, rows->line + first, (size_t)(last - first) * sizeof(real));
    substitute(rows->problem->factor, n, rows->inverse, n, first, first / LANES * LANES, x);
    for (int k = 0; k < n; k++)
        rows->columns[k * slots + slot] = x[k];
    for (int block = 0; block < rows->padded_count; block += LANES) {
        real sum[LANES] = {R(0.0)};
        const real *restrict column = rows->columns + first * slots + block;
        for (int k = first; k < n; k++, column += slots)
#pragma GCC unroll 8
            for (int lane = 0; lane < LANES; lane++)
                sum[lane] += x[k] * column[lane];
        for (int lane = 0; lane < LANES; lane++)
            rows->gram[(block + lane) * slots + slot] = rows->gram[slot * slots + block + lane] = sum[lane];
    }
}

/* Compute columns and products of the rows in several slots at once. */
static void compute_batch(ddmpc_rows *rows, const int *batch_slots, int count)
{
    const int n = rows->n, slots = rows->slots;
    int min_first = n;
    memset(rows->batch, 0, (size_t)(n * LANES) * sizeof(real));
    for (int lane = 0; lane < count; lane++) {
        int first = 0, last = n;
        rows->problem->row(rows->problem->context, rows->row_in[batch_slots[lane]], rows->line, &first, &last);
        for (int k = first; k < last; k++)
            rows->batch[k * LANES + lane] = rows->line[k];
        min_first = first < min_first ? first : min_first;
    }
    substitute_batch(rows, min_first, rows->batch);
    for (int k = 0; k < n; k++)
        for (int lane = 0; lane < count; lane++)
            rows->columns[k * slots + batch_slots[lane]] = rows->batch[k * LANES + lane];
    for (int block = 0; block < rows->padded_count; block += LANES) {
        real sum[LANES][LANES];
        cross(rows->columns + min_first * slots + block, slots, rows->batch + min_first * LANES, LANES, n - min_first,
              sum);
        for (int a = 0; a < LANES; a++)
            for (int lane = 0; lane < count; lane++) {
                const int slot = batch_slots[lane];
                rows->gram[slot * slots + block + a] = rows->gram[(block + a) * slots + slot] = sum[a][lane];
            }
    }
}

static void compute_columns(ddmpc_rows *rows, const int *batch_slots, int count)
{
    /* A batch computes whole lanes, even if some are unused. */
    rows->work += (count >= MIN_BATCH ? LANES : count) * ddmpc_column_operations(rows->n, rows->padded_count);
    if (count >= MIN_BATCH)
        compute_batch(rows, batch_slots, count);
    else
        for (int i = 0; i < count; i++)
            compute_column(rows, batch_slots[i]);
}

void ddmpc_enter_rows(ddmpc_rows *rows, int count)
{
    int batch_slots[LANES], batch_count = 0;
    for (int i = 0; i < count; i++) {
        const int row = rows->entering[i];
        if (rows->slot_of[row] == 0) {
            batch_slots[batch_count++] = take_slot(rows, row);
            if (batch_count == LANES) {
                compute_columns(rows, batch_slots, batch_count);
                batch_count = 0;
            }
        }
        rows->multiplier[rows->active] = R(0.0);
        rows->order[rows->active++] = rows->slot_of[row] - 1;
    }
    compute_columns(rows, batch_slots, batch_count);
}

static void invalidate_factor(ddmpc_rows *rows, int position)
{
    rows->factored = rows->factored < position ? rows->factored : position;
}

void ddmpc_leave_row(ddmpc_rows *rows, int position)
{
    rows->state[ddmpc_row_at(rows, position)] = DDMPC_FREE;
    const size_t moved_count = (size_t)(--rows->active - position);
    memmove(rows->order + position, rows->order + position + 1, moved_count * sizeof(int));
    memmove(rows->multiplier + position, rows->multiplier + position + 1, moved_count * sizeof(real));
    invalidate_factor(rows, position);
}

void ddmpc_switch_piece(ddmpc_rows *rows, int position)
{
    int *state = rows->state + ddmpc_row_at(rows, position);
    const int piece = ddmpc_is_exceeded(rows, position) ? DDMPC_AT_BOUND : DDMPC_EXCEEDED;
    *state = *state > 0 ? piece : -piece;
    invalidate_factor(rows, position);
}

/* Factorise U'U = S in one block. A row is dependent on the previous ones if its pivot is small compared with its
 * diagonal `diagonal`; it becomes zero if `skip`, and ends the factorisation otherwise. Returns the number of
 * factorised rows, or -1 for numbers that are not finite. */
static int factorise_block(real S[LANES][LANES], const real *diagonal, int count, int skip, real *inverse)
{
    for (int p = 0; p < count; p++) {
        if (!(S[p][p] < DDMPC_LARGEST))
            return -1;
        if (!(S[p][p] > DEPENDENCE_TOLERANCE * diagonal[p])) {
            if (!skip)
                return p;
            inverse[p] = R(0.0);
        } else {
            inverse[p] = R(1.0) / ddmpc_sqrt(S[p][p]);
        }
        scale(S[p], inverse[p]);
        for (int i = p + 1; i < count; i++)
            subtract(S[i], S[p][i], S[p]);
    }
    return count;
}

int ddmpc_factorise_rows(ddmpc_rows *rows, int skip)
{
    /* Blocks are factorised as a whole: the first invalid block may begin with valid rows. */
    const int k = rows->active, from = rows->factored / LANES * LANES, slots = rows->slots;
    rows->work += k * (k + 16);
    real *U = rows->factor, *diagonal = rows->step;
    /* An incomplete last block is padded with an arbitrary row. */
    for (int i = k; i < ddmpc_whole_lanes(k); i++)
        rows->order[i] = rows->order[0];
    for (int i = from; i < k; i++) {
        /* `step` is free until the next step is computed. The diagonal is that of G + E. */
        diagonal[i] = rows->gram[rows->order[i] * (slots + 1)];
        if (ddmpc_is_exceeded(rows, i))
            diagonal[i] += R(1.0) / rows->problem->slope;
        rows->partial[i] = -ddmpc_bound_distance(rows, i);
        if (!(diagonal[i] < DDMPC_LARGEST && ddmpc_fabs(rows->partial[i]) < DDMPC_LARGEST))
            return -1;
    }
    for (int i = 0; i < k; i += LANES) {
        const int height = k - i < LANES ? k - i : LANES;
        real corner[LANES][LANES];
        for (int a = 0; a < height; a++)
            memcpy(corner[a], U + (i + a) * slots + i, sizeof corner[a]);
        /* Valid rows need only the columns of the invalid ones. */
        for (int j = i > from ? i : from; j < k; j += LANES) {
            real sum[LANES][LANES];
            int factorised = height;
            rows->work += (i + LANES) * (LANES * LANES);
            cross(U + i, slots, U + j, slots, i, sum);
            for (int a = 0; a < height; a++) {
                const real *restrict gram = rows->gram + rows->order[i + a] * slots;
                const int *restrict order = rows->order + j;
                for (int b = 0; b < LANES; b++)
                    sum[a][b] = gram[order[b]] - sum[a][b];
            }
            if (i == j) {
                for (int a = 0; a < height; a++)
                    /* Add E. */
                    sum[a][a] += diagonal[i + a] - rows->gram[rows->order[i + a] * (slots + 1)];
                factorised = factorise_block(sum, diagonal + i, height, skip, rows->pivot + i);
                memcpy(corner, sum, sizeof corner);
            } else {
                for (int a = 0; a < height; a++) {
                    for (int p = 0; p < a; p++)
                        subtract(sum[a], corner[p][a], sum[p]);
                    scale(sum[a], rows->pivot[i + a]);
                }
            }
            for (int a = 0; a < height; a++)
                memcpy(U + (i + a) * slots + j, sum[a], sizeof sum[a]);
            if (factorised < height) {
                substitute(U, slots, rows->pivot, i, 0, from, rows->partial);
                /* The block is incomplete, so the next factorisation starts with it again. */
                rows->factored = i;
                return factorised < 0 ? -1 : i + factorised;
            }
        }
    }
    substitute(U, slots, rows->pivot, k, 0, from, rows->partial);
    rows->factored = k;
    return k;
}

void ddmpc_solve_rows(ddmpc_rows *rows)
{
    rows->work += rows->active * rows->active;
    memcpy(rows->solution, rows->partial, (size_t)rows->active * sizeof(real));
    substitute_back(rows->factor, rows->slots, rows->pivot, rows->active, rows->solution);
}

void ddmpc_null_step(ddmpc_rows *rows, int position)
{
    real *step = rows->step;
    rows->work += position * position;
    for (int i = 0; i < position; i++)
        step[i] = -rows->factor[i * rows->slots + position];
    substitute_back(rows->factor, rows->slots, rows->pivot, position, step);
    for (int i = position; i < rows->active; i++)
        step[i] = i == position ? R(1.0) : R(0.0);
}

void ddmpc_solve_step(ddmpc_rows *rows)
{
    rows->work += 2 * rows->active * rows->active;
    substitute(rows->factor, rows->slots, rows->pivot, rows->active, 0, 0, rows->step);
    substitute_back(rows->factor, rows->slots, rows->pivot, rows->active, rows->step);
}
