/* The active set: the two methods that active_set.h names, and the proof of what they find. Every loop is over rows or inputs, or
 * is bounded where it stands; each system that is solved counts as an iteration, of which there are `most_iterations`. */
/* for clock_gettime, which C99 alone does not know */
#define _POSIX_C_SOURCE 199309L
#include "active_set.h"

#include <float.h>
#include <string.h>

#include "active_rows.h"
#include "clock.h"

enum {
    MOST_ROUNDS = 12,     /* of the primal-dual method; it ends after one to three, or not at all */
    PATIENCE = 2,         /* rounds in which fewer rows have to be wrong */
    MOST_STALLS = 20,     /* times that the dual objective need not rise: rounding, no more */
    MOST_REFINEMENTS = 3, /* of one solution */
    MOST_WORK = 6,          /* starts with all rows pressing, and factorisations, whose operations a tick may take */
    FEW = DDMPC_LANES     /* rows that are let in at once by the dual method: one block of columns */
};

/* By the number type: its rounding; steps that are none beside the largest; the share of a multiplier within which it is
   reached; and the share of the largest term that the gradient of the Lagrangian may keep. */
#ifdef DDMPC_FLOAT
static const real EPSILON = FLT_EPSILON, NEGLIGIBLE = R(1e-3), REACHED = R(1e-5), STATIONARY = R(3e-4);
#else
static const real EPSILON = DBL_EPSILON, NEGLIGIBLE = R(1e-7), REACHED = R(1e-10), STATIONARY = R(1e-8);
#endif
/* Roundings that a sum over a plan adds up to. */
static const real ROUNDINGS = R(16.0);

/* The range of a multiplier on the piece of its row. */
typedef struct {
    real low, high;
} range;

static range piece_of(const ddmpc_rows *rows, int position)
{
    const real price = rows->problem->price;
    const int exceeded = ddmpc_is_exceeded(rows, position);
    const real near = exceeded ? price : R(0.0);
    const real far = exceeded || !ddmpc_is_soft(rows, position) ? DDMPC_LARGEST : price;
    const range above = {near, far}, below = {-far, -near};
    return ddmpc_is_above(rows, position) ? above : below;
}

static real within(range piece, real multiplier)
{
    return ddmpc_min(ddmpc_max(multiplier, piece.low), piece.high);
}

/* How much a value may be beyond its limit. */
static real tolerance(const ddmpc_rows *rows, int row)
{
    return rows->problem->slack + ROUNDINGS * EPSILON * (rows->largest_input + ddmpc_fabs(rows->start[row]));
}

/* Replace the values in `now` by what is beyond a limit and its tolerance: positive above the upper one, negative below
 * the lower one, else zero. `broken` says whether there are such rows, hard ones and soft ones. Returns whether all are
 * numbers. */
static int survey(ddmpc_rows *rows, int broken[2])
{
    const real *restrict upper = rows->problem->upper, *restrict lower = rows->problem->lower;
    const real *restrict start = rows->start;
    const real slack = rows->problem->slack + ROUNDINGS * EPSILON * rows->largest_input;
    real *restrict now = rows->now;
    int sound = 1;
    broken[0] = broken[1] = 0;
    rows->primal = R(0.0);
    for (int i = 0; i < rows->problem->hard; i++)
        rows->primal = ddmpc_max(rows->primal, ddmpc_max(now[i] - upper[i], lower[i] - now[i]));
    for (int i = 0; i < rows->m; i++) {
        const real allowed = slack + ROUNDINGS * EPSILON * ddmpc_fabs(start[i]);
        const real above = now[i] - upper[i] - allowed, below = lower[i] - now[i] - allowed;
        sound &= ddmpc_fabs(now[i]) < DDMPC_LARGEST;
        now[i] = ddmpc_max(above, R(0.0)) - ddmpc_max(below, R(0.0));
    }
    for (int i = 0; i < rows->problem->hard; i++)
        broken[0] |= now[i] != R(0.0);
    for (int i = rows->problem->hard; i < rows->m; i++)
        broken[1] |= now[i] != R(0.0);
    return sound;
}

/* The `most` worst of the rows in `entering` first, as many as there are. */
static int worst_of(ddmpc_rows *rows, int count, int most)
{
    int *entering = rows->entering;
    for (int i = 0; i < most && i < count; i++)
        for (int j = i + 1; j < count; j++)
            if (ddmpc_fabs(rows->now[entering[j]]) > ddmpc_fabs(rows->now[entering[i]])) {
                const int worse = entering[j];
                entering[j] = entering[i];
                entering[i] = worse;
            }
    return count < most ? count : most;
}

/* Let rows press that are broken and do not press yet: all, or the worst of each run of rows side by side that are
 * broken on the same side, which mostly mends the others, and of these a few. Returns how many rows are broken; with
 * `entered` 0 if there is no room for any of them. */
static int enter_broken(ddmpc_rows *rows, int all, int *entered)
{
    const real *now = rows->now;
    int broken = 0, count = 0, worst = -1;
    for (int row = 0; row <= rows->m; row++) {
        const real beyond = row < rows->m && rows->state[row] == DDMPC_FREE ? now[row] : R(0.0);
        if (worst >= 0 && (all || row == rows->problem->hard || !(beyond * now[worst] > R(0.0)))) {
            if (count < rows->slots)
                rows->entering[count++] = worst;
            worst = -1;
        }
        if (beyond == R(0.0))
            continue;
        broken++;
        if (worst < 0 || ddmpc_fabs(beyond) > ddmpc_fabs(now[worst]))
            worst = row;
    }
    const int room = rows->most_active - rows->active;
    rows->work += rows->m + count * (all ? count : FEW);
    count = worst_of(rows, count, all || room < FEW ? room : FEW);
    for (int i = 0; i < count; i++)
        rows->state[rows->entering[i]] = now[rows->entering[i]] > R(0.0) ? DDMPC_KEPT : -DDMPC_KEPT;
    ddmpc_enter_rows(rows, count);
    *entered = count;
    return broken;
}

/* Whether active rows are where their multipliers say, to within their tolerance, or `exactly`: to within the rounding of
 * the plan. Leaves what is missing in `step`. */
static int is_met(ddmpc_rows *rows, const real *plan, int exactly)
{
    const ddmpc_limited_problem *problem = rows->problem;
    real largest = R(0.0);
    int met = 1;
    for (int k = 0; exactly && k < rows->n; k++)
        largest = ddmpc_max(largest, ddmpc_fabs(plan[k]));
    for (int i = 0; i < rows->active; i++) {
        const int row = ddmpc_row_at(rows, i);
        const range piece = piece_of(rows, i);
        real wanted = rows->state[row] > 0 ? problem->upper[row] : problem->lower[row];
        if (ddmpc_is_exceeded(rows, i))
            wanted += (rows->multiplier[i] - (rows->state[row] > 0 ? piece.low : piece.high)) / problem->slope;
        rows->step[i] = rows->now[row] - wanted;
        const real rounding = ROUNDINGS * EPSILON * (largest + ddmpc_fabs(rows->now[row]));
        met &= ddmpc_fabs(rows->step[i]) <= (exactly ? rounding : tolerance(rows, row));
    }
    return met;
}

/* Bring active rows to where their multipliers say, in MOST_REFINEMENTS rounds at most. The plan is moved by the changes of
 * the multipliers: a sum over large multipliers would round it anew each time. Returns whether rows are within tolerance. */
static int refine(ddmpc_rows *rows, real *plan, int exactly)
{
    int met = is_met(rows, plan, exactly);
    for (int round = 0; !met && round < (exactly ? 1 : MOST_REFINEMENTS) && rows->factored == rows->active; round++) {
        ddmpc_solve_step(rows);
        for (int i = 0; i < rows->active; i++) {
            const real before = rows->multiplier[i], multiplier = before + rows->step[i];
            rows->multiplier[i] = within(piece_of(rows, i), multiplier);
            /* The plan still takes a step that a large multiplier rounds away. */
            if (rows->multiplier[i] != multiplier)
                rows->step[i] = rows->multiplier[i] - before;
        }
        ddmpc_move_plan(rows, rows->step, plan, plan);
        met = is_met(rows, plan, exactly);
    }
    return met || (exactly && is_met(rows, plan, 0));
}

/* Whether there may be no further iteration. */
static int is_over(ddmpc_rows *rows, int iterations)
{
    const ddmpc_limited_problem *problem = rows->problem;
    if (iterations > 0 && isfinite(problem->deadline))
        rows->late |= ddmpc_now() > problem->deadline;
    return rows->late || iterations >= problem->most_iterations || rows->work >= rows->most_work;
}

/* Steps of the primal-dual active set method: what pulls leaves, what is broken comes, all at once. For hard rows only:
 * soft ones make it go round in circles. Returns whether that ended at the solution. */
static int change_many(ddmpc_rows *rows, int *iterations, real *plan)
{
    int best = rows->m + 1, patience = PATIENCE, entered;
    for (int round = 0; round < MOST_ROUNDS && !is_over(rows, *iterations); round++) {
        int wrong = 0, broken[2];
        ++*iterations;
        if (ddmpc_factorise_rows(rows, 1) < 0)
            return 0;
        ddmpc_solve_rows(rows);
        memcpy(rows->multiplier, rows->wanted, (size_t)rows->active * sizeof(real));
        for (int i = rows->active - 1; i >= 0; i--)
            if (rows->pivot[i] == R(0.0))
                ddmpc_leave_row(rows, i);
        ddmpc_move_plan(rows, rows->multiplier, rows->problem->minimiser, plan);
        for (int i = 0; i < rows->active; i++)
            wrong += rows->multiplier[i] != within(piece_of(rows, i), rows->multiplier[i]);
        const int met = wrong == 0 && refine(rows, plan, 1);
        if (!survey(rows, broken) || broken[1])
            return 0;
        for (int i = rows->active - 1; i >= 0; i--)
            if (rows->multiplier[i] != within(piece_of(rows, i), rows->multiplier[i]))
                ddmpc_leave_row(rows, i);
        if (broken[0])
            wrong += enter_broken(rows, 1, &entered);
        if (wrong == 0)
            return met;
        if (wrong < best) {
            best = wrong;
            patience = PATIENCE;
        } else if (--patience == 0) {
            return 0;
        }
    }
    return 0;
}

/* Where a solution that rounding has spoilt would rather be stopped: the row of which least is left beside those before
 * it. Else the number of active rows. */
static int find_weak_row(const ddmpc_rows *rows)
{
    real sum = R(0.0), largest = R(0.0), room = R(0.0), least = R(1.0);
    int weak = rows->active;
    for (int i = 0; i < rows->active; i++) {
        const real size = ddmpc_sqrt(rows->gram[rows->order[i] * (rows->slots + 1)]);
        largest = ddmpc_max(largest, size);
        sum += size * ddmpc_fabs(rows->wanted[i]);
        room = ddmpc_max(room, ddmpc_fabs(ddmpc_room(rows, i)));
    }
    if (EPSILON * largest * sum <= rows->problem->slack + R(0.01) * room)
        return rows->active;
    for (int i = 0; i < rows->active; i++) {
        const real left = R(1.0) / (rows->pivot[i] * rows->pivot[i] * rows->gram[rows->order[i] * (rows->slots + 1)]);
        if (left < least) {
            least = left;
            weak = i;
        }
    }
    return weak;
}

/* How fast the dual rises along `step`; what is negligible of it becomes zero. */
static real find_rise(ddmpc_rows *rows)
{
    real *step = rows->step, largest = R(0.0), rise = R(0.0);
    for (int i = 0; i < rows->active; i++)
        largest = ddmpc_max(largest, ddmpc_fabs(step[i]));
    for (int i = 0; i < rows->active; i++) {
        const real *gram = rows->gram + rows->order[i] * rows->slots;
        real slope = -ddmpc_room(rows, i);
        if (ddmpc_fabs(step[i]) <= NEGLIGIBLE * largest) {
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

typedef enum { NO_STEP, TO_THE_TOP, ENDLESS, WEAK } way;

/* The way to the maximum of the dual on the active rows into `step`, and how far that is; where a row depends on others,
 * or nearly, along what moves no plan. `rise` is how fast the dual rises. NO_STEP if numbers ran out. */
static way find_step(ddmpc_rows *rows, real *length, real *rise)
{
    const int got = ddmpc_factorise_rows(rows, 0);
    int along = got;
    if (got < 0)
        return NO_STEP;
    if (got == rows->active) {
        ddmpc_solve_rows(rows);
        along = find_weak_row(rows);
        if (along == rows->active) {
            for (int i = 0; i < rows->active; i++) {
                const real step = rows->wanted[i] - rows->multiplier[i];
                /* What rounding leaves of a step must not stop all others: it would be switched to and fro. */
                rows->step[i] = ddmpc_fabs(step) > REACHED * ddmpc_fabs(rows->wanted[i]) ? step : R(0.0);
            }
            *length = R(1.0);
            return TO_THE_TOP;
        }
    }
    ddmpc_null_step(rows, along);
    *rise = find_rise(rows);
    if (*rise < R(0.0))
        for (int i = 0; i <= along; i++)
            rows->step[i] = -rows->step[i];
    *rise = ddmpc_fabs(*rise);
    *length = DDMPC_LARGEST;
    if (got < rows->active)
        return ENDLESS;
    *length = *rise * rows->pivot[along] * rows->pivot[along];
    return WEAK;
}

/* The first row whose multiplier leaves its piece within `length` along `step`; -1 if none does. */
static int find_block(const ddmpc_rows *rows, real *length)
{
    int block = -1;
    for (int i = 0; i < rows->active; i++) {
        const real step = rows->step[i];
        const range piece = piece_of(rows, i);
        const real bound = step < R(0.0) ? piece.low : piece.high;
        if (step == R(0.0) || ddmpc_fabs(bound) == DDMPC_LARGEST)
            continue;
        const real reach = ddmpc_max((bound - rows->multiplier[i]) / step, R(0.0));
        if (reach < *length) {
            *length = reach;
            block = i;
        }
    }
    return block;
}

/* Whether the rows of a step without end contradict each other, even if each gives way by the slack: only hard rows do. */
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

typedef enum { SETTLED, RAN_OUT, ASTRAY, UNBOUNDED } outcome;

/* From multipliers on their pieces climb to the maximum of the dual on the active rows, or a part of them. */
static outcome settle(ddmpc_rows *rows, int *iterations)
{
    /* Each round solves a system: it ends after `most_iterations` of them at the latest. */
    for (;;) {
        real length = R(0.0), rise = R(0.0); /* find_step sets what its answer needs */
        if (is_over(rows, *iterations))
            return RAN_OUT;
        ++*iterations;
        const way next = find_step(rows, &length, &rise);
        int block = next == NO_STEP ? -1 : find_block(rows, &length);
        if (block < 0 && next == TO_THE_TOP) {
            for (int i = 0; i < rows->active; i++)
                rows->multiplier[i] = within(piece_of(rows, i), rows->wanted[i]);
            return SETTLED;
        }
        if (block < 0 && next == ENDLESS) {
            if (contradicts(rows, rise))
                return UNBOUNDED;
            /* As high everywhere: the other way something blocks. */
            for (int i = 0; i < rows->active; i++)
                rows->step[i] = -rows->step[i];
            block = find_block(rows, &length);
        }
        if (block < 0)
            return ASTRAY;
        const range piece = piece_of(rows, block);
        const int falls = rows->step[block] < R(0.0), above = ddmpc_is_above(rows, block);
        for (int i = 0; i < rows->active; i++)
            rows->multiplier[i] = within(piece_of(rows, i), rows->multiplier[i] + length * rows->step[i]);
        rows->multiplier[block] = falls ? piece.low : piece.high;
        if (falls == above && !ddmpc_is_exceeded(rows, block))
            ddmpc_leave_row(rows, block);
        else
            ddmpc_switch_piece(rows, block);
    }
}

/* The dual objective where the system is solved. */
static real height(const ddmpc_rows *rows)
{
    const real price = rows->problem->price;
    real sum = R(0.0);
    for (int i = 0; i < rows->active; i++) {
        sum -= rows->multiplier[i] * ddmpc_room(rows, i);
        if (ddmpc_is_exceeded(rows, i))
            sum -= price * price / rows->problem->slope;
    }
    return R(0.5) * sum;
}

/* The dual method: settle, let broken rows press, settle, ... */
static ddmpc_limited_status climb(ddmpc_rows *rows, int *iterations, real *plan)
{
    real highest = -DDMPC_LARGEST;
    /* Each round settles, and so takes an iteration, of which there are `most_iterations`. */
    for (int stalls = 0; stalls < MOST_STALLS;) {
        const outcome end = settle(rows, iterations);
        int entered, broken[2];
        if (end == UNBOUNDED || end == ASTRAY)
            return end == UNBOUNDED ? DDMPC_INFEASIBLE : DDMPC_NOT_PROVEN;
        ddmpc_move_plan(rows, rows->multiplier, rows->problem->minimiser, plan);
        if (end == RAN_OUT)
            return DDMPC_UNFINISHED;
        if (!refine(rows, plan, 0))
            return DDMPC_NOT_PROVEN;
        if (!survey(rows, broken))
            return DDMPC_NOT_PROVEN;
        const real reached = height(rows);
        stalls = reached > highest ? 0 : stalls + 1;
        highest = ddmpc_max(highest, reached);
        if (!(broken[0] || broken[1]) || enter_broken(rows, 0, &entered) == 0) {
            rows->problem->values(rows->problem->context, plan, rows->now);
            rows->work += 8 * rows->m;
            return refine(rows, plan, 1) && survey(rows, broken) ? DDMPC_PROVEN : DDMPC_NOT_PROVEN;
        }
        if (entered == 0)
            return DDMPC_UNFINISHED;
    }
    return DDMPC_NOT_PROVEN;
}

/* Begin with the rows whose multipliers are not zero, and no others. */
static void warm_start(ddmpc_rows *rows, const real *multipliers)
{
    const ddmpc_limited_problem *problem = rows->problem;
    int count = 0;
    /* One row less each time, of `most_active`. */
    while (rows->active > 0)
        ddmpc_leave_row(rows, rows->active - 1);
    for (int row = 0; row < rows->m && count < rows->most_active; row++) {
        const real size = ddmpc_fabs(multipliers[row]);
        /* Not the other way round: NaN is nothing to begin with. */
        if (!(size > R(0.0) && size < DDMPC_LARGEST))
            continue;
        const int piece = row >= problem->hard && size > problem->price ? DDMPC_EXCEEDED : DDMPC_KEPT;
        rows->state[row] = multipliers[row] > R(0.0) ? piece : -piece;
        rows->entering[count++] = row;
    }
    ddmpc_enter_rows(rows, count);
    for (int i = 0; i < count; i++)
        rows->multiplier[i] = multipliers[ddmpc_row_at(rows, i)];
}

/* How large the numbers are whose sum is R'R (U - U0), largest entry. */
static real size_of_gradient(const ddmpc_rows *rows, const real *plan)
{
    const ddmpc_limited_problem *problem = rows->problem;
    real *restrict size = rows->z, largest = R(0.0);
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
        largest = ddmpc_max(largest, size[k]);
    return largest;
}

/* Fill residuals and multipliers from the plan; returns whether the cost is stationary, as far as rounding tells. */
static int is_stationary(ddmpc_rows *rows, const real *plan, real *multipliers, ddmpc_limited_result *result)
{
    const ddmpc_limited_problem *problem = rows->problem;
    const int n = rows->n;
    real *restrict gradient = rows->batch, *restrict moved = rows->batch + n;
    real largest = R(0.0), allowed = R(0.0), dual = R(0.0);
    rows->work += n * (2 * n + rows->active) + rows->m;
    for (int k = 0; k < n; k++) {
        moved[k] = plan[k] - problem->minimiser[k];
        gradient[k] = R(0.0);
    }
    for (int k = 0; k < n; k++) {
        const real *restrict row = problem->factor + k * n;
        const real sum = ddmpc_long_dot(row + k, moved + k, n - k);
        for (int i = k; i < n; i++)
            gradient[i] += row[i] * sum;
    }
    memset(multipliers, 0, (size_t)rows->m * sizeof(real));
    for (int i = 0; i < rows->active; i++) {
        const int row = ddmpc_row_at(rows, i), above = ddmpc_is_above(rows, i);
        int first = 0, last = n;
        real multiplier = rows->multiplier[i], give = R(0.0), *restrict line = rows->line;
        problem->row(problem->context, row, line, &first, &last);
        multipliers[row] = multiplier;
        if (ddmpc_is_exceeded(rows, i)) {
            /* The price is that of the plan as it is. */
            const real value = ddmpc_long_dot(line + first, plan + first, last - first);
            multiplier = above ? problem->price + problem->slope * (value - problem->upper[row])
                               : -problem->price + problem->slope * (value - problem->lower[row]);
            give = problem->slope * tolerance(rows, row);
        }
        for (int k = first; k < last; k++) {
            gradient[k] += multiplier * line[k];
            largest = ddmpc_max(largest, ddmpc_fabs(line[k]) * ddmpc_fabs(multiplier));
            allowed = ddmpc_max(allowed, ddmpc_fabs(line[k]) * give);
        }
    }
    int sound = 1;
    for (int k = 0; k < n; k++) {
        sound &= ddmpc_fabs(gradient[k]) < DDMPC_LARGEST;
        dual = ddmpc_max(dual, ddmpc_fabs(gradient[k]));
    }
    result->dual = dual;
    allowed += STATIONARY * largest;
    return sound && (dual <= allowed || dual <= allowed + ROUNDINGS * EPSILON * size_of_gradient(rows, plan));
}

/* Fill multipliers with those that were reached; returns whether they and the plan are numbers. */
static int is_left_usable(const ddmpc_rows *rows, const real *plan, real *multipliers)
{
    int sound = 1;
    memset(multipliers, 0, (size_t)rows->m * sizeof(real));
    for (int i = 0; i < rows->active; i++) {
        multipliers[ddmpc_row_at(rows, i)] = rows->multiplier[i];
        sound &= ddmpc_fabs(rows->multiplier[i]) < DDMPC_LARGEST;
    }
    for (int k = 0; k < rows->n; k++)
        sound &= ddmpc_fabs(plan[k]) < DDMPC_LARGEST;
    return sound;
}

/* What the limits must be for there to be a problem. */
static ddmpc_limited_status check_limits(const ddmpc_limited_problem *problem)
{
    int sound = 1, crossed = 0;
    for (int row = 0; row < problem->rows; row++) {
        const int kept = problem->lower[row] <= problem->upper[row];
        crossed |= row < problem->hard && problem->lower[row] > problem->upper[row] + R(2.0) * problem->slack;
        sound &= kept && problem->lower[row] < DDMPC_LARGEST && problem->upper[row] > -DDMPC_LARGEST;
    }
    if (problem->rows > problem->hard)
        sound &= problem->price >= R(0.0) && problem->price < DDMPC_LARGEST && problem->slope > R(0.0) &&
                 problem->slope < DDMPC_LARGEST;
    return crossed ? DDMPC_INFEASIBLE : sound ? DDMPC_PROVEN : DDMPC_NOT_PROVEN;
}

ddmpc_limited_result ddmpc_solve_limited(const ddmpc_limited_problem *problem, const ddmpc_limited_memory *memory,
                                         real *multipliers, real *plan)
{
    ddmpc_limited_result result = {DDMPC_NOT_PROVEN, 0, 0, 0, 0, R(0.0), R(0.0)};
    ddmpc_rows rows;
    result.status = check_limits(problem);
    if (result.status == DDMPC_PROVEN && !ddmpc_begin_rows(&rows, problem, memory))
        result.status = DDMPC_NOT_PROVEN;
    if (result.status == DDMPC_PROVEN) {
        int soft = 0;
        rows.most_work = problem->most_operations;
        warm_start(&rows, multipliers);
        for (int i = 0; i < rows.active; i++)
            soft |= ddmpc_is_soft(&rows, i);
        if (soft || !change_many(&rows, &result.iterations, plan)) {
            warm_start(&rows, multipliers);
            result.status = climb(&rows, &result.iterations, plan);
        }
        result.active = rows.active;
        result.primal = rows.primal;
        result.late = rows.late;
        if (result.status == DDMPC_PROVEN && !is_stationary(&rows, plan, multipliers, &result))
            result.status = DDMPC_NOT_PROVEN;
        if (result.status == DDMPC_UNFINISHED && !is_left_usable(&rows, plan, multipliers))
            result.status = DDMPC_NOT_PROVEN;
        result.operations = rows.work;
    }
    if (result.status != DDMPC_PROVEN && result.status != DDMPC_UNFINISHED) {
        memset(multipliers, 0, (size_t)problem->rows * sizeof(real));
        memcpy(plan, problem->minimiser, (size_t)problem->inputs * sizeof(real));
    }
    return result;
}

/* Operations of the greatest parts: a factorisation, a start with all rows pressing, a refinement, a round of the
 * primal-dual method, and one of the dual method with what follows where it has settled. */
typedef struct {
    ddmpc_count factor, start, refined, many, settled;
} parts;

static parts parts_of(int n, int m, int slots)
{
    enum { LANES = DDMPC_LANES };
    const ddmpc_count blocks = slots / LANES, square = (ddmpc_count)slots * slots;
    const ddmpc_count column = ddmpc_column_operations(n, slots) + slots, plan = ddmpc_plan_operations(n, m, slots);
    parts p;
    /* A block of rows is done with the ones before it, for each block of columns from it on. */
    p.factor = LANES * LANES * LANES * blocks * (blocks + 1) * (blocks + 2) / 6 + square + 16 * slots;
    p.start = slots * column;
    p.refined = 8 * m + MOST_REFINEMENTS * (2 * square + plan);
    p.many = p.factor + square + plan + p.refined + m + square + p.start;
    p.settled = p.factor + 3 * square + plan + p.refined + m + FEW * (slots + column);
    return p;
}

ddmpc_count ddmpc_limited_most(int inputs, int rows, int most_active)
{
    const parts p = parts_of(inputs, rows, DDMPC_LIMITED_SLOTS(most_active));
    return MOST_WORK * (p.start + p.factor);
}

ddmpc_count ddmpc_limited_bound(int inputs, int rows, int most_active)
{
    const int slots = DDMPC_LIMITED_SLOTS(most_active);
    const parts p = parts_of(inputs, rows, slots);
    const ddmpc_count round = p.many > p.settled ? p.many : p.settled;
    /* After the last round the plan is found once more, or refined, and the cost is looked at. */
    const ddmpc_count end = p.refined + 2 * ddmpc_plan_operations(inputs, rows, slots);
    return MOST_WORK * (p.start + p.factor) + 2 * p.start + round + end;
}

unsigned long ddmpc_limited_reals(int inputs, int rows, int most_active)
{
    return (unsigned long)DDMPC_LIMITED_REALS(inputs, rows, most_active);
}

unsigned long ddmpc_limited_ints(int inputs, int rows, int most_active)
{
    (void)inputs;
    return (unsigned long)DDMPC_LIMITED_INTS(inputs, rows, most_active);
}
