#include "relax.h"

#include <string.h>

enum { N = DDMPC_STEPS, INPUTS = DDMPC_INPUTS, LANES = DDMPC_LANES };

/* Numbers beyond this are no robot's. */
#define LARGEST R(1e15)

/* Whether every number is one: of H the diagonal, which bounds the rest of a positive definite matrix. */
static int is_sound(const ddmpc_tick *tick, const ddmpc_qp *qp)
{
    int sound = 1;
    for (int i = 0; i < INPUTS; i++)
        /* Not the other way round: NaN must fail. */
        sound &= ddmpc_fabs(qp->H[i][i]) < LARGEST && ddmpc_fabs(qp->g[i]) < LARGEST && qp->box[i] < LARGEST;
    for (int c = 0; c < 2; c++)
        sound &= ddmpc_fabs(tick->last_command[c]) < LARGEST;
    for (int kind = 0; kind < DDMPC_SOFT; kind++)
        for (int k = 0; k < N; k++)
            sound &= ddmpc_fabs(qp->soft_upper[kind][k]) < LARGEST;
    return sound;
}

/* The corner of a row of blocks: U'U = S, for as many columns as there are; 0 if S is not positive definite. */
static int factorise_corner(real S[LANES][LANES], int count)
{
    for (int p = 0; p < count; p++) {
        if (!(S[p][p] > R(0.0)))
            return 0;
        const real root = ddmpc_sqrt(S[p][p]), inverse = R(1.0) / root;
        S[p][p] = root;
        for (int j = p + 1; j < count; j++)
            S[p][j] *= inverse;
        for (int i = p + 1; i < count; i++)
            for (int j = i; j < count; j++)
                S[i][j] -= S[p][i] * S[p][j];
    }
    return 1;
}

/* H = U'U by rows of blocks; what lies left of the diagonal stays zero. */
static int factorise(const ddmpc_qp *qp, real *U)
{
    memset(U, 0, (INPUTS * INPUTS + LANES) * sizeof(real));
    for (int j = 0; j < INPUTS; j += LANES) {
        const int rows = INPUTS - j < LANES ? INPUTS - j : LANES;
        real corner[LANES][LANES], inverse[LANES];
        for (int i = j; i < INPUTS; i += LANES) {
            const int columns = INPUTS - i < LANES ? INPUTS - i : LANES;
            real sum[LANES][LANES];
            memset(sum, 0, sizeof sum);
            /* Beyond a last block that is not whole this reads on into the next row; nobody looks at the result. */
            ddmpc_tile(U + j, U + i, j, INPUTS, sum);
            for (int a = 0; a < rows; a++)
                for (int b = 0; b < columns; b++)
                    sum[a][b] = qp->H[j + a][i + b] - sum[a][b];
            if (i == j) {
                memcpy(corner, sum, sizeof corner);
                if (!factorise_corner(corner, rows))
                    return 0;
                for (int a = 0; a < rows; a++) {
                    inverse[a] = R(1.0) / corner[a][a];
                    memcpy(U + (j + a) * INPUTS + j + a, corner[a] + a, (size_t)(rows - a) * sizeof(real));
                }
                continue;
            }
            for (int a = 0; a < rows; a++) {
                for (int p = 0; p < a; p++)
                    for (int b = 0; b < LANES; b++)
                        sum[a][b] -= corner[p][a] * sum[p][b];
                for (int b = 0; b < LANES; b++)
                    sum[a][b] *= inverse[a];
                memcpy(U + (j + a) * INPUTS + i, sum[a], (size_t)columns * sizeof(real));
            }
        }
    }
    return 1;
}

/* a'b in several sums side by side, which one order of adding would forbid. */
static real long_dot(const real *a, const real *b, int count)
{
    real sum[LANES] = {R(0.0)};
    int i = 0;
    for (; i + LANES <= count; i += LANES)
        for (int lane = 0; lane < LANES; lane++)
            sum[lane] += a[i + lane] * b[i + lane];
    for (; i < count; i++)
        sum[0] += a[i] * b[i];
    for (int lane = 1; lane < LANES; lane++)
        sum[0] += sum[lane];
    return sum[0];
}

ddmpc_relax_status ddmpc_relax(const ddmpc_tick *tick, const ddmpc_qp *qp, ddmpc_relaxed *relaxed)
{
    const real *U = relaxed->factor;
    real *x = relaxed->plan;
    if (!is_sound(tick, qp))
        return DDMPC_NOT_FINITE;
    if (!factorise(qp, relaxed->factor))
        return DDMPC_NOT_CONVEX;
    for (int i = 0; i < INPUTS; i++)
        x[i] = -qp->g[i];
    for (int k = 0; k < INPUTS; k++) {
        x[k] /= U[k * INPUTS + k];
        for (int i = k + 1; i < INPUTS; i++)
            x[i] -= U[k * INPUTS + i] * x[k];
    }
    for (int k = INPUTS - 1; k >= 0; k--)
        x[k] = (x[k] - long_dot(U + k * INPUTS + k + 1, x + k + 1, INPUTS - 1 - k)) / U[k * INPUTS + k];
    relaxed->residual = R(0.0);
    for (int i = 0; i < INPUTS; i++)
        relaxed->residual = ddmpc_max(relaxed->residual, ddmpc_fabs(long_dot(qp->H[i], x, INPUTS) + qp->g[i]));
    return DDMPC_RELAXED;
}

int ddmpc_broken(const ddmpc_tracking *constants, const ddmpc_tick *tick, const ddmpc_workspace *work,
                 const ddmpc_qp *qp, const real plan[INPUTS], real slack)
{
    real values[DDMPC_SOFT][N];
    int broken = 0;
    for (int c = 0; c < 2; c++) {
        int outside = 0, steep = 0;
        real before = tick->last_command[c];
        for (int i = c; i < INPUTS; i += 2) {
            /* Not the other way round: NaN breaks every limit. */
            outside |= !(ddmpc_fabs(plan[i]) <= qp->box[i] + slack);
            steep |= !(ddmpc_fabs(plan[i] - before) <= constants->slew[c] + slack);
            before = plan[i];
        }
        broken |= (outside ? DDMPC_BROKEN_COMMAND << c : 0) | (steep ? DDMPC_BROKEN_INCREMENT << c : 0);
    }
    ddmpc_soft_values(constants, tick, work, plan, values);
    for (int kind = 0; kind < DDMPC_SOFT; kind++) {
        int exceeded = 0;
        for (int k = 0; k < N; k++)
            exceeded |= !(values[kind][k] <= qp->soft_upper[kind][k] + slack &&
                          values[kind][k] >= qp->soft_lower[kind][k] - slack);
        broken |= exceeded ? DDMPC_BROKEN_SOFT << kind : 0;
    }
    return broken;
}

ddmpc_relax_status ddmpc_condense_and_relax(const ddmpc_tracking *constants, const ddmpc_tick *tick,
                                            const real plan[INPUTS], ddmpc_workspace *work, ddmpc_qp *qp,
                                            ddmpc_relaxed *relaxed, int *broken)
{
    ddmpc_condense(constants, tick, plan, work, qp);
    const ddmpc_relax_status status = ddmpc_relax(tick, qp, relaxed);
    *broken = status == DDMPC_RELAXED ? ddmpc_broken(constants, tick, work, qp, relaxed->plan, R(0.0)) : 0;
    return status;
}

unsigned long ddmpc_relaxed_size(void)
{
    return (unsigned long)sizeof(ddmpc_relaxed);
}
