/* The condensed problem as a least-distance problem: with H = U'U and plan = minimiser + inverse(U) z the cost is
 * |z|^2 / 2, and limits become rows: lower <= rows z <= upper. For an active-set solver, which needs no factor then. */
#ifndef DDMPC_LEAST_DISTANCE_H
#define DDMPC_LEAST_DISTANCE_H

#include "relax.h"

enum {
    DDMPC_HARD = 4, /* kinds of hard limit: v_ref, omega_ref, and their increments */
    DDMPC_KINDS = DDMPC_HARD + DDMPC_SOFT
};

/* How a row begins: DAQP's numbers. A soft limit that presses with less than its price is kept. */
enum { DDMPC_ACTIVE = 1, DDMPC_LOWER = 2, DDMPC_IS_SOFT = 8, DDMPC_KEPT = 32 };

/* All zero before the first use. */
typedef struct {
    real plan[DDMPC_INPUTS];
    real primal, dual; /* residuals: largest excess of a hard limit, largest entry of |z + rows' pressing| */
    real multipliers[DDMPC_KINDS][DDMPC_STEPS]; /* zero for kinds that are left out */
    real upper[DDMPC_KINDS * DDMPC_STEPS], lower[DDMPC_KINDS * DDMPC_STEPS];
    real rows[DDMPC_KINDS * DDMPC_STEPS][DDMPC_INPUTS];
    real inverse[DDMPC_INPUTS][DDMPC_INPUTS]; /* upper triangular */
    real soft[DDMPC_STEPS][DDMPC_INPUTS];
} ddmpc_least_distance;

/* Rows and bounds of the kinds of limit whose bits are set in `kinds`, ascending. After ddmpc_relax. */
void ddmpc_to_least_distance(const ddmpc_tracking *constants, const ddmpc_tick *tick, const ddmpc_workspace *work,
                             const ddmpc_qp *qp, const ddmpc_relaxed *relaxed, int kinds, ddmpc_least_distance *problem);
/* How its rows begin, where a solution with these multipliers is near; `price` is that of a unit beyond a soft limit. */
void ddmpc_row_flags(int kinds, const real multipliers[DDMPC_KINDS][DDMPC_STEPS], real price, int *flags);
/* Plan, residuals and multipliers of the solution z, on which the rows press with `pressing`; returns the kinds that
 * press, as bits. */
int ddmpc_from_least_distance(const ddmpc_relaxed *relaxed, int kinds, const real z[DDMPC_INPUTS],
                              const real *pressing, ddmpc_least_distance *problem);

unsigned long ddmpc_least_distance_size(void);

#endif
