#include "unconstrained.h"

static int factorise(const ddmpc_qp *qp, real L[DDMPC_INPUTS][DDMPC_INPUTS])
{
    for (int row = 0; row < DDMPC_INPUTS; row++) {
        for (int column = 0; column <= row; column++) {
            real rest = qp->H[row][column];
            for (int k = 0; k < column; k++)
                rest -= L[row][k] * L[column][k];
            if (column < row)
                L[row][column] = rest / L[column][column];
            else if (rest > R(0.0)) /* false for NaN, too */
                L[row][row] = ddmpc_sqrt(rest);
            else
                return 0;
        }
    }
    return 1;
}

int ddmpc_unconstrained(const ddmpc_qp *qp, real factor[DDMPC_INPUTS][DDMPC_INPUTS], real plan[DDMPC_INPUTS])
{
    if (!factorise(qp, factor))
        return 0;
    for (int row = 0; row < DDMPC_INPUTS; row++) {
        real rest = -qp->g[row];
        for (int k = 0; k < row; k++)
            rest -= factor[row][k] * plan[k];
        plan[row] = rest / factor[row][row];
    }
    for (int row = DDMPC_INPUTS - 1; row >= 0; row--) {
        plan[row] /= factor[row][row];
        for (int k = 0; k < row; k++)
            plan[k] -= factor[row][k] * plan[row];
    }
    return 1;
}
