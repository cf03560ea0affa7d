/* Active rows of ddmpc_solve_limited, and the linear system of their multipliers.
 *
 * With z = R (U - U0) the cost is |z|^2 / 2, row i becomes v_i = R'^-1 a_i, and z = -sum lambda_i v_i. Active rows
 * hold with equality if
 *
 *     (G + E) lambda = -d,    G_ij = v_i'v_j,    d_i = bound - a_i U0,
 *
 * A soft row beyond its limit exceeds the bound by s = (|lambda| - price) / slope. For such a row E_ii = 1 / slope,
 * and d_i is reduced by price / slope; E is zero for all other rows.
 * */
#ifndef DDMPC_ACTIVE_ROWS_H
#define DDMPC_ACTIVE_ROWS_H

#include "active_set.h"

/* State of a row: inactive, at its bound, or beyond a soft bound. The sign is the side: positive at the upper bound. */
enum { DDMPC_FREE = 0, DDMPC_AT_BOUND = 1, DDMPC_EXCEEDED = 2 };

/* Numbers above this value are not physical and count as overflow. */
#define DDMPC_LARGEST R(1e15)

typedef struct {
    const ddmpc_limited_problem *problem;
    int n, m, slots, max_active;
    int slot_count, padded_count; /* slots with a row, and this number rounded up to whole lanes */
    int active;                   /* number of active rows */
    int late;                     /* 1 after the deadline has passed */
    ddmpc_count work, max_work;   /* operations so far, and their limit, see ddmpc_limited_bound */
    int factored;                 /* leading active rows for which the factor is valid */
    real max_input;               /* maximum absolute entry of U0 */
    real primal;                  /* maximum excess of a hard row at the plan */
    real *columns;    /* (n, slots) v of the row in each slot; kept after a row has left, since it often returns */
    real *gram;       /* (slots, slots) v'v */
    real *factor;     /* (slots, slots) upper triangular: U'U = G + E of the active rows, in their order */
    real *batch;      /* (n, LANES) */
    real *inverse;    /* (n) of R's diagonal */
    real *z, *line;   /* (n, in whole lanes) */
    real *start;      /* (m) values at U0 */
    real *values;     /* (m) values at the plan; after `find_violations` the excess over their limits */
    real *pivot;      /* (slots) inverses of U's diagonal; 0 for dependent rows */
    real *partial;    /* (slots) U'^-1 of the right-hand side */
    real *solution;   /* (slots) solution of the system */
    real *multiplier; /* (slots) current multipliers */
    real *step;       /* (slots) change of the multipliers */
    real *slot_multipliers; /* (slots) multipliers in the order of the slots */
    int *slot_of;           /* (m) slot + 1 of a row, or 0 */
    int *state;             /* (m) state of each row, DDMPC_FREE and so on */
    int *row_in;            /* (slots) row of each slot */
    int *order;             /* (slots) slots of the active rows */
    int *entering;          /* (slots) rows that become active next */
} ddmpc_rows;

/* Start with all rows inactive. Returns 0 if the data are not finite. */
int ddmpc_init_rows(ddmpc_rows *rows, const ddmpc_limited_problem *problem, const ddmpc_limited_memory *memory);
/* Activate the first `count` rows of `entering` with multipliers of zero. The caller must set their states and ensure
 * that there are enough slots. */
void ddmpc_enter_rows(ddmpc_rows *rows, int count);
void ddmpc_leave_row(ddmpc_rows *rows, int position);
/* Move a soft row to the other piece of its penalty. */
void ddmpc_switch_piece(ddmpc_rows *rows, int position);
/* Factorise the system from the first row for which the factor is invalid. If `skip`, the pivot of a dependent row is
 * zero; otherwise the first dependent row ends the factorisation, and the factor is valid up to this row. Returns the
 * number of factorised rows, or -1 for numbers that are not finite. */
int ddmpc_factorise_rows(ddmpc_rows *rows, int skip);
/* Solve the factorised system for `solution`. */
void ddmpc_solve_rows(ddmpc_rows *rows);
/* Compute into `step` the combination that expresses the dependent row `position` by the previous rows, so that the
 * plan does not move along it. */
void ddmpc_null_step(ddmpc_rows *rows, int position);
/* Solve for `step` with itself as right-hand side. */
void ddmpc_solve_step(ddmpc_rows *rows);
/* Compute the plan for `multipliers` of the active rows, relative to the plan `start`, and store the values of all rows
 * at that plan in `values`. */
void ddmpc_move_plan(ddmpc_rows *rows, const real *multipliers, const real *start, real *plan);

/* a'b in several partial sums: a compiler must not reorder a single sum, and therefore could not vectorise it. */
real ddmpc_long_dot(const real *restrict a, const real *restrict b, int count);

/* Operations for one column v with its products, and for a plan with the values of all rows, with `slots` slots. */
static inline ddmpc_count ddmpc_column_operations(int n, int slots) { return n * (n / 2 + slots + 8); }

static inline ddmpc_count ddmpc_plan_operations(int n, int m, int slots) { return n * (n + n / 2 + slots) + 8 * m; }

static inline int ddmpc_row_at(const ddmpc_rows *rows, int position) { return rows->row_in[rows->order[position]]; }

static inline int ddmpc_is_above(const ddmpc_rows *rows, int position)
{
    return rows->state[ddmpc_row_at(rows, position)] > 0;
}

static inline int ddmpc_is_soft(const ddmpc_rows *rows, int position)
{
    return ddmpc_row_at(rows, position) >= rows->problem->hard;
}

static inline int ddmpc_is_exceeded(const ddmpc_rows *rows, int position)
{
    const int state = rows->state[ddmpc_row_at(rows, position)];
    return state == DDMPC_EXCEEDED || state == -DDMPC_EXCEEDED;
}

/* Distance d_i of the bound of an active row, as defined above. */
static inline real ddmpc_bound_distance(const ddmpc_rows *rows, int position)
{
    const ddmpc_limited_problem *problem = rows->problem;
    const int row = ddmpc_row_at(rows, position), above = rows->state[row] > 0;
    const real distance = (above ? problem->upper : problem->lower)[row] - rows->start[row];
    if (!ddmpc_is_exceeded(rows, position))
        return distance;
    return above ? distance - problem->price / problem->slope : distance + problem->price / problem->slope;
}

#endif
