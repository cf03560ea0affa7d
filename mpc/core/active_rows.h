/* The rows that press in ddmpc_solve_limited, and the linear system that their multipliers solve.
 *
 * With z = R (U - U0) the cost is |z|^2 / 2, row i becomes v_i = R'^-1 a_i, and z = -sum lambda_i v_i. Active rows are
 * where their multipliers say if
 *
 *     (G + E) lambda = -room,    G_ij = v_i'v_j,    room_i = bound - a_i U0,
 *
 * and for soft rows beyond their limit, where bound is exceeded by s = (|lambda| - price) / slope, E_ii = 1 / slope and
 * the room is less by price / slope.
 */
#ifndef DDMPC_ACTIVE_ROWS_H
#define DDMPC_ACTIVE_ROWS_H

#include "active_set.h"


/* How a row stands; the sign of its state is its side: above at the upper bound, below at the lower one. */
enum { DDMPC_FREE = 0, DDMPC_KEPT = 1, DDMPC_EXCEEDED = 2 };

/* Numbers beyond this are no robot's. */
#define DDMPC_LARGEST R(1e15)

typedef struct {
    const ddmpc_limited_problem *problem;
    int n, m, slots, most_active;
    int taken, used;    /* slots that were ever taken; the same in whole lanes */
    int active;         /* rows that press */
    int late;           /* whether the deadline has passed */
    ddmpc_count work, most_work; /* operations so far, and at most, see ddmpc_limited_bound */
    int factored;       /* of these, in their order, the first for which the factor holds */
    real largest_input; /* of U0 */
    real primal;        /* largest excess of a hard row at the plan */
    real *columns;      /* (n, slots) v of the row in each slot; kept for rows that left, they often come back */
    real *gram;         /* (slots, slots) v'v */
    real *factor;       /* (slots, slots) upper triangular: U'U = G + E of the active rows, in their order */
    real *batch;        /* (n, LANES) */
    real *inverse;      /* (n) of R's diagonal */
    real *z, *line;     /* (n, in whole lanes) */
    real *start;        /* (m) values at U0 */
    real *now;          /* (m) values at the plan; then how much they are beyond their limits, see survey */
    real *pivot;        /* (slots) inverses of U's diagonal; 0 for rows that depend on others */
    real *partial;      /* (slots) U'^-1 of the right-hand side */
    real *wanted;       /* (slots) multipliers that solve the system */
    real *multiplier;   /* (slots) multipliers that were reached */
    real *step;         /* (slots) */
    real *spread;       /* (slots) multipliers by slot */
    int *slot_of;       /* (m) slot + 1 of a row, or 0 */
    int *state;         /* (m) */
    int *row_in;        /* (slots) */
    int *order;         /* (slots) slots of the active rows */
    int *entering;      /* (slots) rows that are to press */
} ddmpc_rows;

/* All rows free. Returns 0 if the data are no numbers. */
int ddmpc_begin_rows(ddmpc_rows *rows, const ddmpc_limited_problem *problem, const ddmpc_limited_memory *memory);
/* Let the first `count` rows of `entering` press, whose states are set, with multipliers of zero. There is room. */
void ddmpc_enter_rows(ddmpc_rows *rows, int count);
void ddmpc_leave_row(ddmpc_rows *rows, int position);
/* A soft row goes over to the other piece of its penalty. */
void ddmpc_switch_piece(ddmpc_rows *rows, int position);
/* Factorise the system, from the first row on for which that is not done. Rows that depend on those before them are
 * left out, with a pivot of zero, if `skip`; else the first of them ends it: the factor holds up to it. Returns how many
 * rows it got through; -1 where numbers are none. */
int ddmpc_factorise_rows(ddmpc_rows *rows, int skip);
/* Solve for `wanted`, after factorising. */
void ddmpc_solve_rows(ddmpc_rows *rows);
/* What adds to the others nothing: factor column `position` on the rows before it, into `step`. */
void ddmpc_null_step(ddmpc_rows *rows, int position);
/* Solve for `step` with itself as right-hand side. */
void ddmpc_solve_step(ddmpc_rows *rows);
/* The plan that is `multipliers` of the active rows away from `start`, and the values of all rows there, into `now`. */
void ddmpc_move_plan(ddmpc_rows *rows, const real *multipliers, const real *start, real *plan);

/* a'b in several sums side by side, which one order of adding would forbid. */
real ddmpc_long_dot(const real *restrict a, const real *restrict b, int count);

/* Operations of one column v with its products, and of a plan with the values of all rows; `used` slots are taken. */
static inline ddmpc_count ddmpc_column_operations(int n, int used)
{
    return n * (n / 2 + used + 8);
}

static inline ddmpc_count ddmpc_plan_operations(int n, int m, int used)
{
    return n * (n + n / 2 + used) + 8 * m;
}

static inline int ddmpc_row_at(const ddmpc_rows *rows, int position)
{
    return rows->row_in[rows->order[position]];
}

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

/* The room of an active row, see above. */
static inline real ddmpc_room(const ddmpc_rows *rows, int position)
{
    const ddmpc_limited_problem *problem = rows->problem;
    const int row = ddmpc_row_at(rows, position), above = rows->state[row] > 0;
    const real room = (above ? problem->upper : problem->lower)[row] - rows->start[row];
    if (!ddmpc_is_exceeded(rows, position))
        return room;
    return above ? room - problem->price / problem->slope : room + problem->price / problem->slope;
}

#endif
