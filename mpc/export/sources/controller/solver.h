/* Solves the tick's quadratic program with OSQP: problems of fixed size, and soft limits only where they matter. */
#ifndef DDMPC_SOLVER_H
#define DDMPC_SOLVER_H

#include "condense.h"
#include "constants.h"
#include "relax.h"

typedef enum {
    DDMPC_QP_SOLVED,
    DDMPC_QP_SOLVED_INACCURATELY, /* only to a looser tolerance */
    DDMPC_QP_MAX_ITERATIONS,
    DDMPC_QP_INFEASIBLE,
    DDMPC_QP_UNBOUNDED,
    DDMPC_QP_NOT_CONVEX,
    DDMPC_QP_NOT_FINITE, /* the problem's data are not finite, or too large to be real */
    DDMPC_QP_REFUSED,    /* OSQP does not take the data */
    DDMPC_QP_NOT_RUN
} ddmpc_status;

typedef struct {
    ddmpc_status status;
    int iterations; /* of all solves of the tick; 0 where no constraint is active: that solution is exact */
    real primal_residual, dual_residual;
    int soft_limits; /* that took part */
    int left_out;    /* soft limits that are exceeded, but for which there was no slot */
} ddmpc_report;

enum {
    DDMPC_HARD_ROWS = 2 * DDMPC_INPUTS,
    DDMPC_SOFT_ROWS = DDMPC_HARD_ROWS + 2 * DDMPC_SLOTS,
    DDMPC_VARIABLES = DDMPC_INPUTS + DDMPC_SLOTS,
    DDMPC_TRIANGLE = DDMPC_INPUTS * (DDMPC_INPUTS + 1) / 2,
    DDMPC_ENTRIES = 3 * DDMPC_INPUTS - 2 + DDMPC_SLOTS * (DDMPC_INPUTS + 2)
};

/* One soft limit of one step on one side. */
typedef struct {
    int kind, step, side; /* side: 1 upwards, -1 downwards */
} ddmpc_slot;

/* OSQP's own work space is global, so there is one solver to a program. */
typedef struct {
    ddmpc_slot slot[DDMPC_SLOTS];
    int slots;
    real dual[DDMPC_SOFT_ROWS];
    real multiplier[DDMPC_SOFT][DDMPC_STEPS]; /* of soft limits, positive upwards */
    ddmpc_relaxed relaxed;
    real triangle[DDMPC_TRIANGLE + DDMPC_SLOTS];
    real gradient[DDMPC_VARIABLES], start[DDMPC_VARIABLES];
    real lower[DDMPC_SOFT_ROWS], upper[DDMPC_SOFT_ROWS];
    real entries[DDMPC_ENTRIES];
    real rows[DDMPC_STEPS][DDMPC_INPUTS];
    real values[DDMPC_SOFT][DDMPC_STEPS];
} ddmpc_solver;

/* The tick's problem, as ddmpc_condense leaves it. */
typedef struct {
    const ddmpc_tracking *tracking;
    const ddmpc_tick *tick;
    const ddmpc_workspace *work;
    const ddmpc_qp *qp;
} ddmpc_problem;

/* Whether a command may be taken from a solution of this status. */
int ddmpc_usable(ddmpc_status status);

/* Forget every earlier solve, so that no bad iterate is carried on. */
void ddmpc_solver_reset(ddmpc_solver *solver);

/* Solve, starting from the plan `guess`. `plan` means nothing unless the report's status is usable. */
void ddmpc_solve(ddmpc_solver *solver, const ddmpc_problem *problem, const real guess[DDMPC_INPUTS],
                 real plan[DDMPC_INPUTS], ddmpc_report *report);

#endif
