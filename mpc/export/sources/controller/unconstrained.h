/* The minimiser of a quadratic program without its constraints: if it keeps them all, it solves the program. */
#ifndef DDMPC_UNCONSTRAINED_H
#define DDMPC_UNCONSTRAINED_H

#include "condense.h"

/* Solve H U = -g by Cholesky's factorisation, which is left in the lower triangle of `factor`.

   Returns 0 if H is not positive definite, or not finite. */
int ddmpc_unconstrained(const ddmpc_qp *qp, real factor[DDMPC_INPUTS][DDMPC_INPUTS], real plan[DDMPC_INPUTS]);

#endif
