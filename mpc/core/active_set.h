/* Exact solution of a quadratic program with limits by active-set methods, warm-started from the limits that were active
 * at the last tick.
 *
 *     minimise  |R (U - U0)|^2 / 2 + sum over soft rows of (price s + slope s^2 / 2)
 *     subject to  lower <= a_i U <= upper  for hard rows, and lower - s <= a_i U <= upper + s, s >= 0 for soft rows
 *
 * R is upper triangular with R'R the Hessian, and U0 is the unconstrained minimiser. The first method is the primal-dual
 * active-set method (Hintermueller, Ito, Kunisch, SIAM Journal on Optimization 13(3), 2002): it changes many rows at once
 * and usually converges in one to three iterations, but may cycle. The second is the dual method (Goldfarb, Idnani,
 * Mathematical Programming 27, 1983): it increases the dual objective in each iteration and therefore terminates.
 *
 * There are no allocations and no global variables: the caller provides memory and sizes.
 * */
#ifndef DDMPC_ACTIVE_SET_H
#define DDMPC_ACTIVE_SET_H

#include "tile.h"

/* Number of operations. */
typedef long long ddmpc_count;

/* The caller defines the units; the solver uses magnitudes only to estimate rounding errors. */
typedef struct {
    int inputs, rows, hard;         /* n; m two-sided limits, of which the first `hard` are hard, the others soft */
    const real *factor, *minimiser; /* R (n, n), row by row; the part below the diagonal is not read; U0 (n) */
    const real *lower, *upper;      /* (m) lower <= upper; infinite without a limit */
    real price, slope;              /* penalty per unit beyond a soft limit, and its slope: > 0 with soft rows */
    /* (m) a_i plan for all rows */
    void (*values)(const void *context, const real *plan, real *values);
    /* a_i (n) of one row; only [first, last) is read, the rest is zero */
    void (*row)(const void *context, int row, real *out, int *first, int *last);
    const void *context;
    real slack; /* tolerated excess over a limit, in addition to rounding errors */
    int max_iterations;
    ddmpc_count max_operations; /* number of operations after which no iteration starts */
    ddmpc_time deadline;        /* on the clock of ddmpc_now [s]; infinite: none. The first iteration always runs */
} ddmpc_limited_problem;

typedef enum {
    DDMPC_PROVEN,     /* limits are kept within slack, multipliers have the right sign, the cost is stationary */
    DDMPC_UNFINISHED, /* stopped at the bound of iterations, time, operations or active rows */
    DDMPC_NOT_PROVEN, /* rounding errors prevent a proof, or data are not finite */
    DDMPC_INFEASIBLE  /* the hard rows contradict each other by more than slack */
} ddmpc_limited_status;

typedef struct {
    ddmpc_limited_status status;
    int iterations;         /* number of solved systems */
    int late;               /* 1 if the deadline stopped the solve */
    int active;             /* number of active rows */
    ddmpc_count operations; /* operations used, counted as in `ddmpc_limited_bound` */
    real primal;            /* maximum excess of a hard row */
    real dual;              /* maximum entry of the gradient of the Lagrangian, computed from the plan */
} ddmpc_limited_result;

/* Memory for n inputs, m rows and at most `max_active` active rows. More than n can be active, since a soft row
 * beyond its limit does not fix a direction of the plan. */
typedef struct {
    int max_active;
    real *reals; /* (DDMPC_LIMITED_REALS) */
    int *ints;   /* (DDMPC_LIMITED_INTS) */
} ddmpc_limited_memory;

#define DDMPC_LIMITED_SLOTS(max_active) (((max_active) + DDMPC_LANES - 1) / DDMPC_LANES * DDMPC_LANES)
#define DDMPC_LIMITED_REALS(n, m, max_active)                                                                          \
    ((n) * (DDMPC_LIMITED_SLOTS(max_active) + DDMPC_LANES + 3) + 3 * DDMPC_LANES + 2 * (m) +                           \
     DDMPC_LIMITED_SLOTS(max_active) * (2 * DDMPC_LIMITED_SLOTS(max_active) + 6) + 16)
#define DDMPC_LIMITED_INTS(n, m, max_active) (2 * (m) + 3 * DDMPC_LIMITED_SLOTS(max_active))

/* Numbers of reals and ints of `ddmpc_limited_memory`. */
unsigned long ddmpc_limited_reals(int inputs, int rows, int max_active);
unsigned long ddmpc_limited_ints(int inputs, int rows, int max_active);

/* Maximum number of operations in a tick: those of six starts with all rows active and six factorisations. The hardest
 * ticks of tests/mpc/hard_ticks.py, whose robots cannot follow their references, need at most a third of it. */
ddmpc_count ddmpc_limited_allowance(int inputs, int rows, int max_active);
/* Upper bound of the operations of a solve with this allowance: it adds two starts, an iteration that starts just below
 * the allowance, and the final plan. Multiplications in loops over rows and inputs are counted; an incomplete block
 * counts as a complete block. */
ddmpc_count ddmpc_limited_bound(int inputs, int rows, int max_active);

/* Solve the program. On entry `multipliers` (m) are an initial guess, such as those of the last tick, or zeros: only
 * their signs and whether they exceed the price matter. On exit they are the multipliers of the solution: positive at
 * an upper bound, negative at a lower bound, and larger than the price if a soft limit is exceeded. `plan` (n) is
 * the solution. After DDMPC_UNFINISHED both are the last iterate of the dual method, and the plan may violate limits.
 * After any other failure the plan is the unconstrained minimiser, and the multipliers are zero. */
ddmpc_limited_result ddmpc_solve_limited(const ddmpc_limited_problem *problem, const ddmpc_limited_memory *memory,
                                         real *multipliers, real *plan);

#endif
