#include "least_distance.h"

#include <string.h>

enum { N = DDMPC_STEPS, INPUTS = DDMPC_INPUTS };

/* sum += the rows first to last - 1 of the upper triangular `triangle`, each times its weight. */
static void add_rows(const real *restrict weight, const real (*restrict triangle)[INPUTS], int first, int last,
                     real *restrict sum)
{
    int k = first;
    /* Four at a time: each sum is loaded and stored once for them. What lies left of the diagonal is zero. */
    for (; k + 4 <= last; k += 4) {
        const real a = weight[k], b = weight[k + 1], c = weight[k + 2], d = weight[k + 3];
        for (int j = k; j < INPUTS; j++)
            sum[j] += a * triangle[k][j] + b * triangle[k + 1][j] + c * triangle[k + 2][j] + d * triangle[k + 3][j];
    }
    for (; k < last; k++)
        for (int j = k; j < INPUTS; j++)
            sum[j] += weight[k] * triangle[k][j];
}

static void invert(const real *U, real inverse[INPUTS][INPUTS])
{
    for (int i = INPUTS - 1; i >= 0; i--) {
        const real *row = U + i * INPUTS;
        const real diagonal = R(1.0) / row[i];
        for (int j = i + 1; j < INPUTS; j++)
            inverse[i][j] = R(0.0);
        add_rows(row, (const real(*)[INPUTS])inverse, i + 1, INPUTS, inverse[i]);
        for (int j = i + 1; j < INPUTS; j++)
            inverse[i][j] *= -diagonal;
        inverse[i][i] = diagonal;
    }
}

/* Range or increments of one channel. */
static void hard_rows(int kind, const real inverse[INPUTS][INPUTS], real (*rows)[INPUTS])
{
    const int channel = kind % 2, increments = kind / 2;
    for (int k = 0; k < N; k++) {
        const real *now = inverse[2 * k + channel];
        if (!increments || k == 0) {
            memcpy(rows[k], now, INPUTS * sizeof(real));
            continue;
        }
        const real *before = inverse[2 * (k - 1) + channel];
        for (int j = 0; j < INPUTS; j++)
            rows[k][j] = now[j] - before[j];
    }
}

static void hard_bounds(int kind, const ddmpc_tracking *constants, const ddmpc_tick *tick, const ddmpc_qp *qp,
                        const real plan[INPUTS], real upper[N], real lower[N])
{
    const int channel = kind % 2, increments = kind / 2;
    for (int k = 0; k < N; k++) {
        const int at = 2 * k + channel;
        const real before = k == 0 ? tick->last_command[channel] : plan[at - 2];
        const real value = increments ? plan[at] - before : plan[at];
        const real limit = increments ? constants->slew[channel] : qp->box[at];
        upper[k] = limit - value;
        lower[k] = -limit - value;
    }
}

void ddmpc_to_least_distance(const ddmpc_tracking *constants, const ddmpc_tick *tick, const ddmpc_workspace *work,
                             const ddmpc_qp *qp, const ddmpc_relaxed *relaxed, int kinds, ddmpc_least_distance *problem)
{
    real values[DDMPC_SOFT][N];
    real(*rows)[INPUTS] = problem->rows;
    real *upper = problem->upper, *lower = problem->lower;
    invert(relaxed->factor, problem->inverse);
    if (kinds >> DDMPC_HARD)
        ddmpc_soft_values(constants, tick, work, relaxed->plan, values);
    for (int kind = 0; kind < DDMPC_KINDS; kind++) {
        const int soft = kind - DDMPC_HARD;
        if (!(kinds >> kind & 1))
            continue;
        if (soft < 0) {
            hard_rows(kind, (const real(*)[INPUTS])problem->inverse, rows);
            hard_bounds(kind, constants, tick, qp, relaxed->plan, upper, lower);
        } else {
            ddmpc_soft_rows(constants, tick, work, soft, problem->soft);
            memset(rows, 0, N * INPUTS * sizeof(real));
            for (int k = 0; k < N; k++) {
                /* Step k answers to the commands before it only. */
                add_rows(problem->soft[k], (const real(*)[INPUTS])problem->inverse, 0, 2 * (k + 1), rows[k]);
                upper[k] = qp->soft_upper[soft][k] - values[soft][k];
                lower[k] = qp->soft_lower[soft][k] - values[soft][k];
            }
        }
        rows += N;
        upper += N;
        lower += N;
    }
}

void ddmpc_row_flags(int kinds, const real multipliers[DDMPC_KINDS][N], real price, int *flags)
{
    for (int kind = 0; kind < DDMPC_KINDS; kind++) {
        const int soft = kind >= DDMPC_HARD;
        if (!(kinds >> kind & 1))
            continue;
        for (int k = 0; k < N; k++) {
            const real pressing = multipliers[kind][k];
            const int active = pressing < R(0.0) ? DDMPC_ACTIVE | DDMPC_LOWER : pressing > R(0.0) ? DDMPC_ACTIVE : 0;
            *flags++ = active | (soft ? DDMPC_IS_SOFT : 0) |
                       (active && soft && ddmpc_fabs(pressing) < price ? DDMPC_KEPT : 0);
        }
    }
}

int ddmpc_from_least_distance(const ddmpc_relaxed *relaxed, int kinds, const real z[INPUTS], const real *pressing,
                              ddmpc_least_distance *problem)
{
    real dual[INPUTS];
    int row = 0, active = 0;
    for (int i = 0; i < INPUTS; i++) {
        problem->plan[i] = relaxed->plan[i];
        for (int j = i; j < INPUTS; j++)
            problem->plan[i] += problem->inverse[i][j] * z[j];
        dual[i] = z[i];
    }
    problem->primal = problem->dual = R(0.0);
    memset(problem->multipliers, 0, sizeof problem->multipliers);
    for (int kind = 0; kind < DDMPC_KINDS; kind++) {
        if (!(kinds >> kind & 1))
            continue;
        for (int k = 0; k < N; k++, row++) {
            const real *own = problem->rows[row];
            real value = R(0.0);
            problem->multipliers[kind][k] = pressing[row];
            if (pressing[row] != R(0.0)) {
                active |= 1 << kind;
                for (int j = 0; j < INPUTS; j++)
                    dual[j] += pressing[row] * own[j];
            }
            if (kind >= DDMPC_HARD)
                continue;
            for (int j = 0; j < INPUTS; j++)
                value += own[j] * z[j];
            problem->primal = ddmpc_max(
                problem->primal, ddmpc_max(value - problem->upper[row], problem->lower[row] - value));
        }
    }
    for (int j = 0; j < INPUTS; j++)
        problem->dual = ddmpc_max(problem->dual, ddmpc_fabs(dual[j]));
    return active;
}

unsigned long ddmpc_least_distance_size(void)
{
    return (unsigned long)sizeof(ddmpc_least_distance);
}
