/* The active set: the two methods of active_set.h, and the proof of optimality of their result.
 *
 * Both methods assume a set of active limits, which hold with equality, and solve the linear system of their multipliers.
 * The multiplier of a limit is the derivative of the cost by a relaxation of the limit. Its sign and size determine
 * whether the assumption is right:
 *
 *     hard limit           0 <= multiplier             else the limit must leave the active set
 *     soft limit, kept     0 <= multiplier <= price    else exceeding the limit is cheaper
 *     soft limit, exceeded price <= multiplier         and grows by `slope` per unit of excess
 *
 * These ranges are the pieces of a row. At a lower limit all signs are reversed. The active set of the last tick,
 * shifted by one step, is usually almost right, so a solve is cheap.
 *
 * The duration of a tick must be bounded, so every loop runs over rows or inputs, or has a separate bound; each solved
 * system counts as one of `max_iterations`. */
/* for clock_gettime, which C99 alone does not declare */
#define _POSIX_C_SOURCE 199309L
#include "active_set.h"

#include <float.h>
#include <string.h>

#include "active_rows.h"
#include "clock.h"

enum {
    MAX_ROUNDS = 12,     /* iterations of the primal-dual method, which ends after one to three, or cycles */
    MAX_UNIMPROVED = 2,  /* iterations without a decrease of the number of wrong rows */
    MAX_STALLS = 20,     /* iterations without an increase of the dual objective, which only rounding can cause */
    MAX_REFINEMENTS = 3, /* iterative refinements of a solution */
    MAX_WORK = 6, /* maximum operations of a tick, in full starts with factorisation, see ddmpc_limited_allowance */
    BATCH = DDMPC_LANES /* rows that the dual method activates at once: a block of columns costs as much as one */
};

/* For each number type: rounding error; relative size of a negligible step; tolerated relative error of a multiplier; and
 * tolerated gradient of the Lagrangian relative to its maximum term. */
#ifdef DDMPC_FLOAT
static const real EPSILON = FLT_EPSILON, STEP_TOLERANCE = R(1e-3), MULTIPLIER_TOLERANCE = R(1e-5),
                  GRADIENT_TOLERANCE = R(3e-4);
#else
static const real EPSILON = DBL_EPSILON, STEP_TOLERANCE = R(1e-7), MULTIPLIER_TOLERANCE = R(1e-10),
                  GRADIENT_TOLERANCE = R(1e-8);
#endif
/* Accumulated rounding errors of a sum over a plan, as a multiple of EPSILON. */
static const real ROUNDING_FACTOR = R(16.0);

/* Range of a multiplier on the piece of its row. */
typedef struct {
    real low, high;
} range;

static range piece_at(const ddmpc_rows *rows, int position)
{
    const real price = rows->problem->price;
    const int exceeded = ddmpc_is_exceeded(rows, position);
    const real near = exceeded ? price : R(0.0);
    const real far = exceeded || !ddmpc_is_soft(rows, position) ? DDMPC_LARGEST : price;
    const range above = {near, far}, below = {-far, -near};
    return ddmpc_is_above(rows, position) ? above : below;
}

static real clamp_to(range piece, real multiplier) { return ddmpc_min(ddmpc_max(multiplier, piece.low), piece.high); }

/* Tolerated excess of a value over its limit: the slack of the problem, and rounding errors of the value. */
static real tolerance(const ddmpc_rows *rows, int row)
{
    return rows->problem->slack + ROUNDING_FACTOR * EPSILON * (rows->max_input + ddmpc_fabs(rows->start[row]));
}

/* Replace the values in `values` by their excess over limit and tolerance: positive above the upper limit, negative
 * below the lower one, and zero otherwise. `violated` is set to 1 if any hard row (first entry) or soft row (second) is
 * violated. Returns 1 if all values are finite. */
static int find_violations(ddmpc_rows *rows, int violated[2])
{
    const real *restrict upper = rows->problem->upper, *restrict lower = rows->problem->lower;
    const real *restrict start = rows->start;
    const real slack = rows->problem->slack + ROUNDING_FACTOR * EPSILON * rows->max_input;
    real *restrict values = rows->values;
    int is_finite = 1;
    violated[0] = violated[1] = 0;
    rows->primal = R(0.0);
    for (int i = 0; i < rows->problem->hard; i++)
        rows->primal = ddmpc_max(rows->primal, ddmpc_max(values[i] - upper[i], lower[i] - values[i]));
    for (int i = 0; i < rows->m; i++) {
        const real allowed = slack + ROUNDING_FACTOR * EPSILON * ddmpc_fabs(start[i]);
        const real above = values[i] - upper[i] - allowed, below = lower[i] - values[i] - allowed;
        is_finite &= ddmpc_fabs(values[i]) < DDMPC_LARGEST;
        values[i] = ddmpc_max(above, R(0.0)) - ddmpc_max(below, R(0.0));
    }
    for (int i = 0; i < rows->problem->hard; i++)
        violated[0] |= values[i] != R(0.0);
    for (int i = rows->problem->hard; i < rows->m; i++)
        violated[1] |= values[i] != R(0.0);
    return is_finite;
}

/* Move the `limit` worst rows to the front of `entering`; return their number. */
static int select_worst(ddmpc_rows *rows, int count, int limit)
{
    int *entering = rows->entering;
    for (int i = 0; i < limit && i < count; i++)
        for (int j = i + 1; j < count; j++)
            if (ddmpc_fabs(rows->values[entering[j]]) > ddmpc_fabs(rows->values[entering[i]])) {
                const int worse = entering[j];
                entering[j] = entering[i];
                entering[i] = worse;
            }
    return count < limit ? count : limit;
}

/* Activate violated rows: all of them, or a batch of the worst rows, one for each run of adjacent rows that are violated
 * on the same side. Adjacent samples of a limit change together, so one active row usually corrects its run, and a
 * smaller set is cheaper and rarely dependent. Returns the number of violated rows; `entered` is 0 if no row can be
 * activated because `max_active` is reached. */
static int enter_violated(ddmpc_rows *rows, int all, int *entered)
{
    const real *values = rows->values;
    int violated = 0, count = 0, worst = -1;
    /* The loop includes one step after the last row, which ends its run. */
    for (int row = 0; row <= rows->m; row++) {
        const real excess = row < rows->m && rows->state[row] == DDMPC_FREE ? values[row] : R(0.0);
        if (worst >= 0 && (all || row == rows->problem->hard || !(excess * values[worst] > R(0.0)))) {
            if (count < rows->slots)
                rows->entering[count++] = worst;
            worst = -1;
        }
        if (excess == R(0.0))
            continue;
        violated++;
        if (worst < 0 || ddmpc_fabs(excess) > ddmpc_fabs(values[worst]))
            worst = row;
    }
    const int free_rows = rows->max_active - rows->active;
    rows->work += rows->m + count * (all ? count : BATCH);
    count = select_worst(rows, count, all || free_rows < BATCH ? free_rows : BATCH);
    for (int i = 0; i < count; i++)
        rows->state[rows->entering[i]] = values[rows->entering[i]] > R(0.0) ? DDMPC_AT_BOUND : -DDMPC_AT_BOUND;
    ddmpc_enter_rows(rows, count);
    *entered = count;
    return violated;
}

/* Return 1 if the active rows have the values required by their multipliers: within the tolerance of the rows or, if
 * `exactly`, within the rounding error of the plan. Writes the differences to `step`. */
static int has_required_values(ddmpc_rows *rows, const real *plan, int exactly)
{
    const ddmpc_limited_problem *problem = rows->problem;
    real max_command = R(0.0);
    int is_met = 1;
    for (int k = 0; exactly && k < rows->n; k++)
        max_command = ddmpc_max(max_command, ddmpc_fabs(plan[k]));
    for (int i = 0; i < rows->active; i++) {
        const int row = ddmpc_row_at(rows, i);
        const range piece = piece_at(rows, i);
        real required = rows->state[row] > 0 ? problem->upper[row] : problem->lower[row];
        if (ddmpc_is_exceeded(rows, i))
            /* At the required excess over the bound, the derivative of the penalty is equal to the multiplier. */
            required += (rows->multiplier[i] - (rows->state[row] > 0 ? piece.low : piece.high)) / problem->slope;
        rows->step[i] = rows->values[row] - required;
        const real rounding = ROUNDING_FACTOR * EPSILON * (max_command + ddmpc_fabs(rows->values[row]));
        is_met &= ddmpc_fabs(rows->step[i]) <= (exactly ? rounding : tolerance(rows, row));
    }
    return is_met;
}

/* Refine the solution until the active rows have the values required by their multipliers, in at most MAX_REFINEMENTS
 * iterations. Only the changes of the multipliers move the plan, since a new sum over large multipliers would repeat
 * their rounding errors. Returns 1 if the rows are within tolerance. */
static int refine(ddmpc_rows *rows, real *plan, int exactly)
{
    int is_met = has_required_values(rows, plan, exactly);
    for (int round = 0; !is_met && round < (exactly ? 1 : MAX_REFINEMENTS) && rows->factored == rows->active; round++) {
        ddmpc_solve_step(rows);
        for (int i = 0; i < rows->active; i++) {
            const real before = rows->multiplier[i], multiplier = before + rows->step[i];
            rows->multiplier[i] = clamp_to(piece_at(rows, i), multiplier);
            /* A step that is lost in the rounding of a large multiplier still moves the plan, but not beyond the
             * piece. */
            if (rows->multiplier[i] != multiplier)
                rows->step[i] = rows->multiplier[i] - before;
        }
        ddmpc_move_plan(rows, rows->step, plan, plan);
        is_met = has_required_values(rows, plan, exactly);
    }
    /* The exact test only causes an additional refinement; the result depends on the tolerance of the rows. */
    return is_met || (exactly && has_required_values(rows, plan, 0));
}

/* Return 1 if a bound is reached: time, iterations or operations. */
static int is_budget_spent(ddmpc_rows *rows, int iterations)
{
    const ddmpc_limited_problem *problem = rows->problem;
    if (iterations > 0 && isfinite(problem->deadline))
        rows->late |= ddmpc_now() > problem->deadline;
    return rows->late || iterations >= problem->max_iterations || rows->work >= rows->max_work;
}

/* Run the primal-dual active-set method: in each round all rows with a wrong multiplier leave, and all violated rows
 * enter. It is used for hard rows only, since it cycles with soft rows. Returns 1 if it ended at the solution. */
static int run_primal_dual(ddmpc_rows *rows, int *iterations, real *plan)
{
    int best = rows->m + 1, remaining = MAX_UNIMPROVED, entered;
    for (int round = 0; round < MAX_ROUNDS && !is_budget_spent(rows, *iterations); round++) {
        int wrong = 0, violated[2];
        ++*iterations;
        if (ddmpc_factorise_rows(rows, 1) < 0)
            return 0;
        ddmpc_solve_rows(rows);
        memcpy(rows->multiplier, rows->solution, (size_t)rows->active * sizeof(real));
        /* The multiplier of a dependent row is not unique. Rows leave in descending order, since the positions of the
         * following rows change. */
        for (int i = rows->active - 1; i >= 0; i--)
            if (rows->pivot[i] == R(0.0))
                ddmpc_leave_row(rows, i);
        ddmpc_move_plan(rows, rows->multiplier, rows->problem->minimiser, plan);
        for (int i = 0; i < rows->active; i++)
            wrong += rows->multiplier[i] != clamp_to(piece_at(rows, i), rows->multiplier[i]);
        /* The refinement precedes find_violations, which replaces the values at the plan by their excess. */
        const int is_met = wrong == 0 && refine(rows, plan, 1);
        /* The dual method handles violated soft rows. */
        if (!find_violations(rows, violated) || violated[1])
            return 0;
        for (int i = rows->active - 1; i >= 0; i--)
            if (rows->multiplier[i] != clamp_to(piece_at(rows, i), rows->multiplier[i]))
                ddmpc_leave_row(rows, i);
        if (violated[0])
            wrong += enter_violated(rows, 1, &entered);
        if (wrong == 0)
            return is_met;
        if (wrong < best) {
            best = wrong;
            remaining = MAX_UNIMPROVED;
        } else if (--remaining == 0) {
            return 0;
        }
    }
    return 0;
}

/* Find the row that makes the system ill-conditioned: the row with the minimum remainder after elimination of the previous
 * rows. Returns the number of active rows if the rounding error of the solution is acceptable. */
static int find_weak_row(const ddmpc_rows *rows)
{
    real sum = R(0.0), max_size = R(0.0), max_distance = R(0.0), min_remainder = R(1.0);
    int weak = rows->active;
    for (int i = 0; i < rows->active; i++) {
        const real size = ddmpc_sqrt(rows->gram[rows->order[i] * (rows->slots + 1)]);
        max_size = ddmpc_max(max_size, size);
        sum += size * ddmpc_fabs(rows->solution[i]);
        max_distance = ddmpc_max(max_distance, ddmpc_fabs(ddmpc_bound_distance(rows, i)));
    }
    /* The left side bounds the rounding error of a value at the plan. */
    if (EPSILON * max_size * sum <= rows->problem->slack + R(0.01) * max_distance)
        return rows->active;
    for (int i = 0; i < rows->active; i++) {
        const real remainder =
            R(1.0) / (rows->pivot[i] * rows->pivot[i] * rows->gram[rows->order[i] * (rows->slots + 1)]);
        if (remainder < min_remainder) {
            min_remainder = remainder;
            weak = i;
        }
    }
    return weak;
}

/* Compute the slope of the dual objective along `step`, and set negligible entries of `step` to zero. */
static real find_rise(ddmpc_rows *rows)
{
    real *step = rows->step, max_step = R(0.0), rise = R(0.0);
    for (int i = 0; i < rows->active; i++)
        max_step = ddmpc_max(max_step, ddmpc_fabs(step[i]));
    for (int i = 0; i < rows->active; i++) {
        const real *gram = rows->gram + rows->order[i] * rows->slots;
        /* Gradient of the dual by this multiplier: -d - (G + E) lambda, see active_rows.h. */
        real slope = -ddmpc_bound_distance(rows, i);
        if (ddmpc_fabs(step[i]) <= STEP_TOLERANCE * max_step) {
            step[i] = R(0.0);
            continue;
        }
        for (int j = 0; j < rows->active; j++)
            slope -= gram[rows->order[j]] * rows->multiplier[j];
        if (ddmpc_is_exceeded(rows, i))
            slope -= rows->multiplier[i] / rows->problem->slope;
        rise += slope * step[i];
    }
    rows->work += rows->active * rows->active;
    return rise;
}

/* Kinds of steps: no step because of overflow; step to the maximum of the dual on the active rows; unbounded step along
 * dependent rows; step along a row that is nearly dependent. */
typedef enum { NO_STEP, FULL_STEP, UNBOUNDED_STEP, WEAK_ROW } step_kind;

/* Compute the step to the maximum of the dual on the active rows, with its `length`. If a row depends on others, or
 * nearly so, the step is along the combination of rows that does not move the plan. `rise` is the slope of the dual
 * along it. */
static step_kind find_step(ddmpc_rows *rows, real *length, real *rise)
{
    const int factored = ddmpc_factorise_rows(rows, 0);
    int along = factored;
    if (factored < 0)
        return NO_STEP;
    if (factored == rows->active) {
        ddmpc_solve_rows(rows);
        along = find_weak_row(rows);
        if (along == rows->active) {
            for (int i = 0; i < rows->active; i++) {
                const real step = rows->solution[i] - rows->multiplier[i];
                /* A step as small as rounding errors must not block the steps of all other rows, since its row would
                 * switch pieces repeatedly. */
                rows->step[i] = ddmpc_fabs(step) > MULTIPLIER_TOLERANCE * ddmpc_fabs(rows->solution[i]) ? step : R(0.0);
            }
            *length = R(1.0);
            return FULL_STEP;
        }
    }
    ddmpc_null_step(rows, along);
    *rise = find_rise(rows);
    if (*rise < R(0.0))
        for (int i = 0; i <= along; i++)
            rows->step[i] = -rows->step[i];
    *rise = ddmpc_fabs(*rise);
    *length = DDMPC_LARGEST;
    /* A dependent row has no curvature: the dual is linear along the step. */
    if (factored < rows->active)
        return UNBOUNDED_STEP;
    /* The curvature along the step is the remainder of the row `along` after elimination, 1 / pivot^2. */
    *length = *rise * rows->pivot[along] * rows->pivot[along];
    return WEAK_ROW;
}

/* Find the first row whose multiplier leaves its piece within `length` along `step`, and reduce `length` to that point.
 * Returns -1 if no multiplier leaves its piece. */
static int find_blocking_row(const ddmpc_rows *rows, real *length)
{
    int blocking_row = -1;
    for (int i = 0; i < rows->active; i++) {
        const real step = rows->step[i];
        const range piece = piece_at(rows, i);
        const real bound = step < R(0.0) ? piece.low : piece.high;
        if (step == R(0.0) || ddmpc_fabs(bound) == DDMPC_LARGEST)
            continue;
        const real reach = ddmpc_max((bound - rows->multiplier[i]) / step, R(0.0));
        if (reach < *length) {
            *length = reach;
            blocking_row = i;
        }
    }
    return blocking_row;
}

/* Return 1 if the rows of an unbounded step contradict each other, even if each is relaxed by its tolerance. Soft rows
 * cannot be contradictory, since they may be exceeded. */
static int contradicts(const ddmpc_rows *rows, real rise)
{
    real total = R(0.0);
    for (int i = 0; i < rows->active; i++) {
        if (rows->step[i] != R(0.0) && ddmpc_is_soft(rows, i))
            return 0;
        total += ddmpc_fabs(rows->step[i]) * tolerance(rows, ddmpc_row_at(rows, i));
    }
    return rise > total;
}

typedef enum { AT_MAXIMUM, OUT_OF_BUDGET, FAILED, UNBOUNDED } outcome;

/* Move the multipliers, which are on their pieces, to the maximum of the dual on the active rows or a subset of them.
 * Every step keeps all multipliers on their pieces: a row that would leave its piece ends the step, and either leaves
 * the active set or changes its piece. */
static outcome maximise_dual(ddmpc_rows *rows, int *iterations)
{
    /* Each iteration solves a system, so the loop ends after at most `max_iterations`. */
    for (;;) {
        real length = R(0.0), rise = R(0.0); /* set by find_step */
        if (is_budget_spent(rows, *iterations))
            return OUT_OF_BUDGET;
        ++*iterations;
        const step_kind kind = find_step(rows, &length, &rise);
        int blocking_row = kind == NO_STEP ? -1 : find_blocking_row(rows, &length);
        if (blocking_row < 0 && kind == FULL_STEP) {
            for (int i = 0; i < rows->active; i++)
                rows->multiplier[i] = clamp_to(piece_at(rows, i), rows->solution[i]);
            return AT_MAXIMUM;
        }
        if (blocking_row < 0 && kind == UNBOUNDED_STEP) {
            if (contradicts(rows, rise))
                return UNBOUNDED;
            /* The dual is constant along this step, so use the opposite direction, in which a row blocks the step. */
            for (int i = 0; i < rows->active; i++)
                rows->step[i] = -rows->step[i];
            blocking_row = find_blocking_row(rows, &length);
        }
        if (blocking_row < 0)
            return FAILED;
        const range piece = piece_at(rows, blocking_row);
        const int is_decreasing = rows->step[blocking_row] < R(0.0), above = ddmpc_is_above(rows, blocking_row);
        for (int i = 0; i < rows->active; i++)
            rows->multiplier[i] = clamp_to(piece_at(rows, i), rows->multiplier[i] + length * rows->step[i]);
        rows->multiplier[blocking_row] = is_decreasing ? piece.low : piece.high;
        /* At zero a limit becomes inactive; at the price a soft limit starts or stops being exceeded. */
        if (is_decreasing == above && !ddmpc_is_exceeded(rows, blocking_row))
            ddmpc_leave_row(rows, blocking_row);
        else
            ddmpc_switch_piece(rows, blocking_row);
    }
}

/* Return the dual objective at a solution of the system. */
static real dual_objective(const ddmpc_rows *rows)
{
    const real price = rows->problem->price;
    real sum = R(0.0);
    for (int i = 0; i < rows->active; i++) {
        sum -= rows->multiplier[i] * ddmpc_bound_distance(rows, i);
        if (ddmpc_is_exceeded(rows, i))
            sum -= price * price / rows->problem->slope;
    }
    return R(0.5) * sum;
}

/* Run the dual method: maximise the dual on the active rows, activate violated rows, and repeat. The dual objective
 * increases in every iteration, so no active set can recur, and the method ends at the solution. */
static ddmpc_limited_status run_dual(ddmpc_rows *rows, int *iterations, real *plan)
{
    real max_objective = -DDMPC_LARGEST;
    /* Each iteration uses at least one of `max_iterations`, so the loop is bounded. */
    for (int stalls = 0; stalls < MAX_STALLS;) {
        const outcome end = maximise_dual(rows, iterations);
        int entered, violated[2];
        if (end == UNBOUNDED || end == FAILED)
            return end == UNBOUNDED ? DDMPC_INFEASIBLE : DDMPC_NOT_PROVEN;
        ddmpc_move_plan(rows, rows->multiplier, rows->problem->minimiser, plan);
        if (end == OUT_OF_BUDGET)
            return DDMPC_UNFINISHED;
        if (!refine(rows, plan, 0))
            return DDMPC_NOT_PROVEN;
        if (!find_violations(rows, violated))
            return DDMPC_NOT_PROVEN;
        const real objective = dual_objective(rows);
        stalls = objective > max_objective ? 0 : stalls + 1;
        max_objective = ddmpc_max(max_objective, objective);
        if (!(violated[0] || violated[1]) || enter_violated(rows, 0, &entered) == 0) {
            /* No row is violated. Check the final plan with new values, since `find_violations` has overwritten them. */
            rows->problem->values(rows->problem->context, plan, rows->values);
            rows->work += 8 * rows->m;
            return refine(rows, plan, 1) && find_violations(rows, violated) ? DDMPC_PROVEN : DDMPC_NOT_PROVEN;
        }
        if (entered == 0)
            return DDMPC_UNFINISHED;
    }
    return DDMPC_NOT_PROVEN;
}

/* Start with the rows whose multipliers are not zero as the active set. */
static void warm_start(ddmpc_rows *rows, const real *multipliers)
{
    const ddmpc_limited_problem *problem = rows->problem;
    int count = 0;
    /* Each iteration removes one of at most `max_active` rows. */
    while (rows->active > 0)
        ddmpc_leave_row(rows, rows->active - 1);
    for (int row = 0; row < rows->m && count < rows->max_active; row++) {
        const real size = ddmpc_fabs(multipliers[row]);
        /* Negated so that a NaN multiplier is skipped. */
        if (!(size > R(0.0) && size < DDMPC_LARGEST))
            continue;
        const int piece = row >= problem->hard && size > problem->price ? DDMPC_EXCEEDED : DDMPC_AT_BOUND;
        rows->state[row] = multipliers[row] > R(0.0) ? piece : -piece;
        rows->entering[count++] = row;
    }
    ddmpc_enter_rows(rows, count);
    for (int i = 0; i < count; i++)
        rows->multiplier[i] = multipliers[ddmpc_row_at(rows, i)];
}

/* Return the maximum sum of absolute terms in R'R (U - U0), which bounds its rounding error. */
static real max_gradient_terms(const ddmpc_rows *rows, const real *plan)
{
    const ddmpc_limited_problem *problem = rows->problem;
    real *restrict size = rows->z, maximum = R(0.0);
    memset(size, 0, (size_t)rows->n * sizeof(real));
    for (int k = 0; k < rows->n; k++) {
        const real *restrict row = problem->factor + k * rows->n;
        real sum = R(0.0);
        for (int i = k; i < rows->n; i++)
            sum += ddmpc_fabs(row[i]) * (ddmpc_fabs(plan[i]) + ddmpc_fabs(problem->minimiser[i]));
        for (int i = k; i < rows->n; i++)
            size[i] += ddmpc_fabs(row[i]) * sum;
    }
    for (int k = 0; k < rows->n; k++)
        maximum = ddmpc_max(maximum, size[k]);
    return maximum;
}

/* Compute residuals and multipliers from the plan; return 1 if the Lagrangian is stationary within rounding errors. This
 * proves optimality independently of the method: limits are satisfied, multipliers have the right sign, and the gradient
 * is zero. */
static int is_stationary(ddmpc_rows *rows, const real *plan, real *multipliers, ddmpc_limited_result *result)
{
    const ddmpc_limited_problem *problem = rows->problem;
    const int n = rows->n;
    real *restrict gradient = rows->batch, *restrict displacement = rows->batch + n;
    real max_term = R(0.0), allowed = R(0.0), dual = R(0.0);
    rows->work += n * (2 * n + rows->active) + rows->m;
    for (int k = 0; k < n; k++) {
        displacement[k] = plan[k] - problem->minimiser[k];
        gradient[k] = R(0.0);
    }
    for (int k = 0; k < n; k++) {
        const real *restrict row = problem->factor + k * n;
        const real sum = ddmpc_long_dot(row + k, displacement + k, n - k);
        for (int i = k; i < n; i++)
            gradient[i] += row[i] * sum;
    }
    memset(multipliers, 0, (size_t)rows->m * sizeof(real));
    for (int i = 0; i < rows->active; i++) {
        const int row = ddmpc_row_at(rows, i), above = ddmpc_is_above(rows, i);
        int first = 0, last = n;
        real multiplier = rows->multiplier[i], allowance = R(0.0), *restrict line = rows->line;
        problem->row(problem->context, row, line, &first, &last);
        multipliers[row] = multiplier;
        if (ddmpc_is_exceeded(rows, i)) {
            /* Compute the penalty at the plan, not at the value that the multiplier implies. */
            const real value = ddmpc_long_dot(line + first, plan + first, last - first);
            multiplier = above ? problem->price + problem->slope * (value - problem->upper[row])
                               : -problem->price + problem->slope * (value - problem->lower[row]);
            allowance = problem->slope * tolerance(rows, row);
        }
        for (int k = first; k < last; k++) {
            gradient[k] += multiplier * line[k];
            max_term = ddmpc_max(max_term, ddmpc_fabs(line[k]) * ddmpc_fabs(multiplier));
            allowed = ddmpc_max(allowed, ddmpc_fabs(line[k]) * allowance);
        }
    }
    int is_finite = 1;
    for (int k = 0; k < n; k++) {
        is_finite &= ddmpc_fabs(gradient[k]) < DDMPC_LARGEST;
        dual = ddmpc_max(dual, ddmpc_fabs(gradient[k]));
    }
    result->dual = dual;
    allowed += GRADIENT_TOLERANCE * max_term;
    /* The bound of the rounding errors is as expensive as the gradient, so it is computed only if it is needed. */
    return is_finite &&
           (dual <= allowed || dual <= allowed + ROUNDING_FACTOR * EPSILON * max_gradient_terms(rows, plan));
}

/* Copy the current multipliers; return 1 if the multipliers and the plan are finite. */
static int copy_iterate(const ddmpc_rows *rows, const real *plan, real *multipliers)
{
    int is_finite = 1;
    memset(multipliers, 0, (size_t)rows->m * sizeof(real));
    for (int i = 0; i < rows->active; i++) {
        multipliers[ddmpc_row_at(rows, i)] = rows->multiplier[i];
        is_finite &= ddmpc_fabs(rows->multiplier[i]) < DDMPC_LARGEST;
    }
    for (int k = 0; k < rows->n; k++)
        is_finite &= ddmpc_fabs(plan[k]) < DDMPC_LARGEST;
    return is_finite;
}

/* Check that no lower limit is above its upper limit, and that penalties are finite. */
static ddmpc_limited_status check_limits(const ddmpc_limited_problem *problem)
{
    int is_valid = 1, is_infeasible = 0;
    for (int row = 0; row < problem->rows; row++) {
        const int ordered = problem->lower[row] <= problem->upper[row];
        /* Each of the two limits may be exceeded by slack. */
        is_infeasible |= row < problem->hard && problem->lower[row] > problem->upper[row] + R(2.0) * problem->slack;
        is_valid &= ordered && problem->lower[row] < DDMPC_LARGEST && problem->upper[row] > -DDMPC_LARGEST;
    }
    if (problem->rows > problem->hard)
        is_valid &= problem->price >= R(0.0) && problem->price < DDMPC_LARGEST && problem->slope > R(0.0) &&
                    problem->slope < DDMPC_LARGEST;
    return is_infeasible ? DDMPC_INFEASIBLE : is_valid ? DDMPC_PROVEN : DDMPC_NOT_PROVEN;
}

ddmpc_limited_result ddmpc_solve_limited(const ddmpc_limited_problem *problem, const ddmpc_limited_memory *memory,
                                         real *multipliers, real *plan)
{
    ddmpc_limited_result result = {DDMPC_NOT_PROVEN, 0, 0, 0, 0, R(0.0), R(0.0)};
    ddmpc_rows rows;
    result.status = check_limits(problem);
    if (result.status == DDMPC_PROVEN && !ddmpc_init_rows(&rows, problem, memory))
        result.status = DDMPC_NOT_PROVEN;
    if (result.status == DDMPC_PROVEN) {
        int soft = 0;
        rows.max_work = problem->max_operations;
        warm_start(&rows, multipliers);
        for (int i = 0; i < rows.active; i++)
            soft |= ddmpc_is_soft(&rows, i);
        /* Try the faster method first. Both methods start from the given multipliers, since a failed attempt leaves
         * arbitrary rows active. */
        if (soft || !run_primal_dual(&rows, &result.iterations, plan)) {
            warm_start(&rows, multipliers);
            result.status = run_dual(&rows, &result.iterations, plan);
        }
        result.active = rows.active;
        result.primal = rows.primal;
        result.late = rows.late;
        if (result.status == DDMPC_PROVEN && !is_stationary(&rows, plan, multipliers, &result))
            result.status = DDMPC_NOT_PROVEN;
        if (result.status == DDMPC_UNFINISHED && !copy_iterate(&rows, plan, multipliers))
            result.status = DDMPC_NOT_PROVEN;
        result.operations = rows.work;
    }
    if (result.status != DDMPC_PROVEN && result.status != DDMPC_UNFINISHED) {
        memset(multipliers, 0, (size_t)problem->rows * sizeof(real));
        memcpy(plan, problem->minimiser, (size_t)problem->inputs * sizeof(real));
    }
    return result;
}

/* Operations of the most expensive parts: a factorisation, a start with all rows active, a refinement, a round of the
 * primal-dual method, and a round of the dual method with the activation of violated rows. */
typedef struct {
    ddmpc_count factor, start, refinement, primal_dual_round, dual_round;
} parts;

static parts count_operations(int n, int m, int slots)
{
    enum { LANES = DDMPC_LANES };
    const ddmpc_count blocks = slots / LANES, square = (ddmpc_count)slots * slots;
    const ddmpc_count column = ddmpc_column_operations(n, slots) + slots, plan = ddmpc_plan_operations(n, m, slots);
    parts p;
    /* Each block of rows is multiplied with the previous ones, for each block of columns from it on. */
    p.factor = LANES * LANES * LANES * blocks * (blocks + 1) * (blocks + 2) / 6 + square + 16 * slots;
    p.start = slots * column;
    p.refinement = 8 * m + MAX_REFINEMENTS * (2 * square + plan);
    p.primal_dual_round = p.factor + square + plan + p.refinement + m + square + p.start;
    p.dual_round = p.factor + 3 * square + plan + p.refinement + m + BATCH * (slots + column);
    return p;
}

ddmpc_count ddmpc_limited_allowance(int inputs, int rows, int max_active)
{
    const parts p = count_operations(inputs, rows, DDMPC_LIMITED_SLOTS(max_active));
    return MAX_WORK * (p.start + p.factor);
}

ddmpc_count ddmpc_limited_bound(int inputs, int rows, int max_active)
{
    const int slots = DDMPC_LIMITED_SLOTS(max_active);
    const parts p = count_operations(inputs, rows, slots);
    const ddmpc_count round = p.primal_dual_round > p.dual_round ? p.primal_dual_round : p.dual_round;
    /* After the last round the plan is computed again or refined, and its optimality is checked. */
    const ddmpc_count end = p.refinement + 2 * ddmpc_plan_operations(inputs, rows, slots);
    return MAX_WORK * (p.start + p.factor) + 2 * p.start + round + end;
}

unsigned long ddmpc_limited_reals(int inputs, int rows, int max_active)
{
    return (unsigned long)DDMPC_LIMITED_REALS(inputs, rows, max_active);
}

unsigned long ddmpc_limited_ints(int inputs, int rows, int max_active)
{
    (void)inputs;
    return (unsigned long)DDMPC_LIMITED_INTS(inputs, rows, max_active);
}
