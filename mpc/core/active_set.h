/* A quadratic program with limits, solved exactly by active sets from the limits that pressed at the last tick.
 *
 *     minimise  |R (U - U0)|^2 / 2 + sum over soft rows of (price s + slope s^2 / 2)
 *     subject to  lower <= a_i U <= upper  for hard rows, and to within s >= 0 for soft ones
 *
 * R upper triangular with R'R the Hessian, U0 the minimiser without limits. First a few steps of the primal-dual
 * active set method (Hintermueller, Ito, Kunisch, SIAM Journal on Optimization 13(3), 2002), which changes many rows
 * at once and mostly ends after one to three, but may go round in circles; then the dual method (Goldfarb, Idnani,
 * Mathematical Programming 27, 1983), which climbs in the dual objective and therefore ends.
 *
 * No allocation, no globals: memory is given by the caller. Sizes are those of the call.
 */
#ifndef DDMPC_ACTIVE_SET_H
#define DDMPC_ACTIVE_SET_H

#include "tile.h"

/* A number of operations. */
typedef long long ddmpc_count;

/* Numbers are SI or the problem's own; the library looks at sizes only to tell rounding errors. */
typedef struct {
    int inputs, rows, hard;            /* n; m two-sided limits, of which the first `hard` are hard, the others soft */
    const real *factor, *minimiser;    /* R (n, n), row by row; what lies left of the diagonal is not read. U0 (n) */
    const real *lower, *upper;         /* (m) lower <= upper; infinite where there is none */
    real price, slope;                 /* of each unit beyond a soft limit: > 0 if there are soft rows */
    /* (m) a_i plan for all rows */
    void (*values)(const void *context, const real *plan, real *values);
    /* a_i (n) of one row, of which only [first, last) is read: the rest is zero */
    void (*row)(const void *context, int row, real *out, int *first, int *last);
    const void *context;
    real slack;                        /* by how much a limit may be exceeded; rounding errors come on top */
    int most_iterations;
    ddmpc_count most_operations;       /* no round begins after so many */
    ddmpc_time deadline;               /* by the clock of ddmpc_now [s]; infinite: none. One iteration there always is */
} ddmpc_limited_problem;

typedef enum {
    DDMPC_PROVEN,     /* limits are kept within slack, multipliers have the right sign, the cost is stationary */
    DDMPC_UNFINISHED, /* iterations, time or room for active rows ran out */
    DDMPC_NOT_PROVEN, /* rounding got in the way, or data are not finite */
    DDMPC_INFEASIBLE  /* the hard rows contradict each other by more than slack */
} ddmpc_limited_status;

typedef struct {
    ddmpc_limited_status status;
    int iterations; /* systems solved */
    int late;       /* whether the clock ended it */
    int active;     /* rows that press */
    ddmpc_count operations; /* what it took, counted as in `ddmpc_limited_bound` */
    real primal;    /* largest excess of a hard row */
    real dual;      /* largest entry of the gradient of the Lagrangian, computed from the plan */
} ddmpc_limited_result;

/* Memory for n inputs, m rows and `most_active` rows that press at once. That may be more than n: soft rows beyond
 * their limits do not take a direction away. */
typedef struct {
    int most_active;
    real *reals; /* (DDMPC_LIMITED_REALS) */
    int *ints;   /* (DDMPC_LIMITED_INTS) */
} ddmpc_limited_memory;

#define DDMPC_LIMITED_SLOTS(most_active) (((most_active) + DDMPC_LANES - 1) / DDMPC_LANES * DDMPC_LANES)
#define DDMPC_LIMITED_REALS(n, m, most_active)                                                                         \
    ((n) * (DDMPC_LIMITED_SLOTS(most_active) + DDMPC_LANES + 3) + 3 * DDMPC_LANES + 2 * (m) +                          \
     DDMPC_LIMITED_SLOTS(most_active) * (2 * DDMPC_LIMITED_SLOTS(most_active) + 6) + 16)
#define DDMPC_LIMITED_INTS(n, m, most_active) (2 * (m) + 3 * DDMPC_LIMITED_SLOTS(most_active))

/* How many reals and ints that is. */
unsigned long ddmpc_limited_reals(int inputs, int rows, int most_active);
unsigned long ddmpc_limited_ints(int inputs, int rows, int most_active);

/* Operations that a tick may take: those of six starts with all rows pressing and six factorisations. On the drives of
 * tests/mpc/hard_ticks.py robots that can by no means follow take at most a third of it. */
ddmpc_count ddmpc_limited_most(int inputs, int rows, int most_active);
/* Operations that no solve exceeds which may take these: two starts, a round that begins just before, and the plan at the end
 * come on top. Counted are multiplications of loops over rows and inputs, blocks as whole ones. */
ddmpc_count ddmpc_limited_bound(int inputs, int rows, int most_active);

/* Solve. `multipliers` (m): before, those of a problem like this one, or zeros; only their signs and whether they are
 * above the price count, and they may be wrong. After, those of the solution: positive at an upper bound, negative at
 * a lower one, and beyond the price where a soft limit is exceeded. `plan` (n) is the solution. Where the result is
 * DDMPC_UNFINISHED both are how far the dual method came: the plan may break limits. Else the plan is the minimiser, and
 * multipliers are zero. */
ddmpc_limited_result ddmpc_solve_limited(const ddmpc_limited_problem *problem, const ddmpc_limited_memory *memory,
                                         real *multipliers, real *plan);

#endif
