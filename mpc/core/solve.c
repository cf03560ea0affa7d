/* Solution of the tick's quadratic program. In most ticks no limit is active: the unconstrained minimiser satisfies all
 * limits and is the solution. Otherwise the active-set method starts from the limits that were active at the last tick,
 * and verifies its solution by the multipliers. If the method stops at its bounds, the plan satisfies ranges and slew. If
 * rounding errors prevent a solution, ddmpc_solve returns DDMPC_NEEDS_BACKEND: Python solves with DAQP or OSQP
 * (mpc/solver/backend.py) and continues with ddmpc_answer; an export, which has no backend, uses the failure ladder.
 * H = R'R is factorised by a blocked Cholesky method. */
#include <string.h>

#include "active_rows.h"
#include "internal.h"

/* Return 1 if all numbers are finite; of H only the diagonal is checked, which bounds a positive definite matrix. */
static int is_valid(const ddmpc_controller *c)
{
    const ddmpc_problem *p = &c->problem;
    const int inputs = INPUTS(c);
    int is_finite = 1;
    for (int i = 0; i < inputs; i++)
        /* Negated so that NaN fails. */
        is_finite &= ddmpc_fabs(p->H[i * inputs + i]) < DDMPC_LARGEST && ddmpc_fabs(p->g[i]) < DDMPC_LARGEST;
    for (int i = 0; i < KINDS(c) * STEPS(c); i++)
        is_finite &= p->upper[i] >= p->lower[i] && (i >= HARD * STEPS(c) || p->upper[i] < DDMPC_LARGEST);
    return is_finite;
}

/* Factorise R'R = S in the diagonal block of `count` columns; returns 0 if S is not positive definite. */
static int factorise_corner(real S[DDMPC_LANES][DDMPC_LANES], int count)
{
    for (int p = 0; p < count; p++) {
        if (!(S[p][p] > R(0.0)))
            return 0;
        const real root = ddmpc_sqrt(S[p][p]), inverse = R(1.0) / root;
        S[p][p] = root;
        for (int j = p + 1; j < count; j++)
            S[p][j] *= inverse;
        for (int i = p + 1; i < count; i++)
            for (int j = i; j < count; j++)
                S[i][j] -= S[p][i] * S[p][j];
    }
    return 1;
}

/* Factorise H = R'R by rows of blocks; entries below the diagonal stay zero. Returns 0 if H is not positive definite. */
static int factorise(const real *H, int inputs, real *factor)
{
    enum { LANES = DDMPC_LANES };
    memset(factor, 0, (size_t)(inputs * inputs + LANES) * sizeof(real));
    for (int j = 0; j < inputs; j += LANES) {
        const int rows = inputs - j < LANES ? inputs - j : LANES;
        real corner[LANES][LANES], inverse[LANES];
        for (int i = j; i < inputs; i += LANES) {
            const int columns = inputs - i < LANES ? inputs - i : LANES;
            real sum[LANES][LANES];
            memset(sum, 0, sizeof sum);
            /* In an incomplete last block this reads into the next row; the surplus results are not used. */
            ddmpc_tile(factor + j, factor + i, j, inputs, sum);
            for (int a = 0; a < rows; a++)
                for (int b = 0; b < columns; b++)
                    sum[a][b] = H[(j + a) * inputs + i + b] - sum[a][b];
            if (i == j) {
                memcpy(corner, sum, sizeof corner);
                if (!factorise_corner(corner, rows))
                    return 0;
                for (int a = 0; a < rows; a++) {
                    inverse[a] = R(1.0) / corner[a][a];
                    memcpy(factor + (j + a) * inputs + j + a, corner[a] + a, (size_t)(rows - a) * sizeof(real));
                }
                continue;
            }
            for (int a = 0; a < rows; a++) {
                for (int p = 0; p < a; p++)
                    for (int b = 0; b < LANES; b++)
                        sum[a][b] -= corner[p][a] * sum[p][b];
                for (int b = 0; b < LANES; b++)
                    sum[a][b] *= inverse[a];
                memcpy(factor + (j + a) * inputs + i, sum[a], (size_t)columns * sizeof(real));
            }
        }
    }
    return 1;
}

/* a'b in several partial sums: a compiler must not reorder a single sum, and therefore could not vectorise it. */
static inline real long_dot(const real *a, const real *b, int count)
{
    real sum[DDMPC_LANES] = {R(0.0)};
    int i = 0;
    for (; i + DDMPC_LANES <= count; i += DDMPC_LANES)
        for (int lane = 0; lane < DDMPC_LANES; lane++)
            sum[lane] += a[i + lane] * b[i + lane];
    for (; i < count; i++)
        sum[0] += a[i] * b[i];
    for (int lane = 1; lane < DDMPC_LANES; lane++)
        sum[0] += sum[lane];
    return sum[0];
}

/* x = -H^-1 g; returns the maximum absolute entry of H x + g. */
static real minimise(const real *H, const real *g, const real *factor, int inputs, real *x)
{
    real residual = R(0.0);
    for (int i = 0; i < inputs; i++)
        x[i] = -g[i];
    for (int k = 0; k < inputs; k++) {
        x[k] /= factor[k * inputs + k];
        for (int i = k + 1; i < inputs; i++)
            x[i] -= factor[k * inputs + i] * x[k];
    }
    for (int k = inputs - 1; k >= 0; k--)
        x[k] = (x[k] - long_dot(factor + k * inputs + k + 1, x + k + 1, inputs - 1 - k)) / factor[k * inputs + k];
    for (int i = 0; i < inputs; i++)
        residual = ddmpc_max(residual, ddmpc_fabs(long_dot(H + i * inputs, x, inputs) + g[i]));
    return residual;
}

void ddmpc_violated_kinds(const ddmpc_controller *c, const real *plan, real margin, int *violated)
{
    const ddmpc_problem *p = &c->problem;
    const int N = STEPS(c);
    ddmpc_limit_values(c, plan, p->values);
    for (int kind = 0; kind < KINDS(c); kind++) {
        violated[kind] = 0;
        for (int i = kind * N; i < (kind + 1) * N; i++)
            /* Negated so that NaN violates every limit. */
            violated[kind] |= !(p->values[i] <= p->upper[i] + margin && p->values[i] >= p->lower[i] - margin);
    }
}

void ddmpc_soft_rows(const ddmpc_controller *c, int kind, real *rows)
{
    int first, last;
    for (int k = 0; k < STEPS(c); k++)
        ddmpc_limit_row(c, kind * STEPS(c) + k, rows + k * INPUTS(c), &first, &last);
}

ddmpc_program ddmpc_program_of(const ddmpc_controller *c)
{
    const ddmpc_problem *p = &c->problem;
    const ddmpc_program program = {
        p->H,    p->g,   p->lower,        p->upper, p->guess,      p->multipliers, p->active_kinds,
        p->last, p->aim, p->feed_forward, p->ahead, p->soft_value, p->fed_before,  p->late};
    return program;
}

void ddmpc_linearise_again(ddmpc_controller *c, const real *plan)
{
    real shifted[2 * DDMPC_MAX_STEPS], *guess = c->problem.guess, *commands = c->estimator.commands;
    const size_t plan_bytes = (size_t)INPUTS(c) * sizeof(real),
                 line_bytes = (size_t)(2 * (COMMANDS(c) - 1)) * sizeof(real);
    const real command[2] = {commands[2 * COMMANDS(c) - 2], commands[2 * COMMANDS(c) - 1]};
    memcpy(shifted, guess, plan_bytes);
    memcpy(guess, plan, plan_bytes);
    /* At the first linearisation, the command of this tick was not pending yet. */
    memmove(commands + 2, commands, line_bytes);
    ddmpc_problem_linearise(c);
    ddmpc_problem_condense(c);
    ddmpc_problem_limit(c);
    memmove(commands, commands + 2, line_bytes);
    ddmpc_estimator_correct_last(c, command);
    memcpy(guess, shifted, plan_bytes);
}

void ddmpc_solver_reset(ddmpc_controller *c)
{
    c->problem.has_guess = 0;
    memset(c->problem.multipliers, 0, (size_t)(KINDS(c) * STEPS(c)) * sizeof(real));
}

/* Shift the multipliers of the last tick by one step, like the plan. */
static void shift_multipliers(ddmpc_controller *c)
{
    const int N = STEPS(c);
    for (int kind = 0; kind < KINDS(c); kind++) {
        real *row = c->problem.multipliers + kind * N;
        memmove(row, row + 1, (size_t)(N - 1) * sizeof(real));
    }
}

/* Mark the kinds with nonzero multipliers, in addition to the kinds that the unconstrained minimiser violates. */
static void mark_active_kinds(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    for (int i = 0; i < KINDS(c) * STEPS(c); i++)
        p->active_kinds[i / STEPS(c)] |= p->multipliers[i] != R(0.0);
}

/* Clip a plan to ranges and slew, command by command. */
static void clip_to_hard_limits(const ddmpc_controller *c, real *plan)
{
    const ddmpc_problem *p = &c->problem;
    const int N = STEPS(c);
    for (int channel = 0; channel < 2; channel++) {
        real previous = R(0.0);
        for (int k = 0; k < N; k++) {
            const int range = channel * N + k, slew = (2 + channel) * N + k;
            const real lower = ddmpc_max(p->lower[range], previous + p->lower[slew]);
            const real upper = ddmpc_min(p->upper[range], previous + p->upper[slew]);
            previous = plan[2 * k + channel] = ddmpc_min(ddmpc_max(plan[2 * k + channel], lower), upper);
        }
    }
}

/* Cost of a plan relative to the unconstrained minimiser, including the penalties of exceeded soft limits. */
static real cost_of(ddmpc_controller *c, const real *plan)
{
    ddmpc_problem *p = &c->problem;
    const int inputs = INPUTS(c);
    real displacement[2 * DDMPC_MAX_STEPS], sum = R(0.0);
    for (int i = 0; i < inputs; i++)
        displacement[i] = plan[i] - p->minimiser[i];
    for (int i = 0; i < inputs; i++) {
        /* Relative to its minimum, the quadratic cost is |R (plan - minimiser)|^2 / 2, since H = R'R. */
        const real z = long_dot(p->factor + i * inputs + i, displacement + i, inputs - i);
        sum += R(0.5) * z * z;
    }
    ddmpc_limit_values(c, plan, p->values);
    for (int i = HARD * STEPS(c); i < KINDS(c) * STEPS(c); i++) {
        const real excess = ddmpc_max(ddmpc_max(p->values[i] - p->upper[i], p->lower[i] - p->values[i]), R(0.0));
        sum += c->constants->price * excess + R(0.5) * c->constants->price_slope * excess * excess;
    }
    return sum;
}

/* Use the last iterate of a stopped active set, or the rest of the last plan if its cost is lower, clipped to ranges and
 * slew. An unfinished iterate may be worse than the last plan, which was optimal at its tick. */
static void use_unfinished_iterate(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    real last_plan[2 * DDMPC_MAX_STEPS];
    const size_t size = (size_t)INPUTS(c) * sizeof(real);
    memcpy(last_plan, p->guess, size);
    clip_to_hard_limits(c, last_plan);
    clip_to_hard_limits(c, p->plan);
    /* Negated so that an iterate with a NaN cost is not used. */
    if (!(cost_of(c, p->plan) <= cost_of(c, last_plan)))
        memcpy(p->plan, last_plan, size);
}

static int find_active_set(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    ddmpc_report *report = &c->result.solver;
    const int rows = KINDS(c) * STEPS(c), hard = HARD * STEPS(c);
    const ddmpc_limited_problem problem = {INPUTS(c),
                                           rows,
                                           hard,
                                           p->factor,
                                           p->minimiser,
                                           p->lower,
                                           p->upper,
                                           c->constants->price,
                                           c->constants->price_slope,
                                           ddmpc_limit_values,
                                           ddmpc_limit_row,
                                           c,
                                           c->constants->slack,
                                           c->max_iterations,
                                           ddmpc_limited_allowance(INPUTS(c), rows, MAX_ACTIVE(c)),
                                           c->deadline};
    /* The solve modifies a copy, since a failed solve clears its multipliers, which a backend still needs. */
    memcpy(p->values, p->multipliers, (size_t)rows * sizeof(real));
    const ddmpc_limited_result solved = ddmpc_solve_limited(&problem, &c->limited, p->values, p->plan);
    report->iterations = solved.iterations;
    report->operations = solved.operations;
    if (solved.status != DDMPC_PROVEN && solved.status != DDMPC_UNFINISHED)
        return 0;
    memcpy(p->multipliers, p->values, (size_t)rows * sizeof(real));
    report->status = DDMPC_QP_SOLVED;
    report->path = DDMPC_ACTIVE_SET;
    report->primal_residual = solved.primal;
    report->dual_residual = solved.dual;
    if (solved.status == DDMPC_UNFINISHED) {
        report->status = solved.late ? DDMPC_QP_STOPPED_IN_TIME : DDMPC_QP_STOPPED;
        report->primal_residual = R(0.0);
        /* The clipped plan satisfies the hard limits; its distance from the optimum is unknown. */
        report->dual_residual = (real)NAN;
        use_unfinished_iterate(c);
    }
    for (int i = hard; i < rows; i++)
        report->soft_limits |= p->multipliers[i] != R(0.0);
    return 1;
}

long long ddmpc_operations_bound(int steps, int kinds, int max_active)
{
    return ddmpc_limited_bound(2 * steps, kinds * steps, max_active);
}

int ddmpc_solve(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    ddmpc_report *report = &c->result.solver;
    int violated = 0;
    /* The status of a failure is set before the step that may fail. */
    report->status = DDMPC_QP_NOT_FINITE;
    if (!is_valid(c))
        return DDMPC_DONE;
    report->status = DDMPC_QP_NOT_CONVEX;
    if (!factorise(p->H, INPUTS(c), p->factor))
        return DDMPC_DONE;
    const real residual = minimise(p->H, p->g, p->factor, INPUTS(c), p->minimiser);
    ddmpc_violated_kinds(c, p->minimiser, R(0.0), p->active_kinds);
    for (int kind = 0; kind < KINDS(c); kind++)
        violated |= p->active_kinds[kind];
    report->status = DDMPC_QP_NOT_RUN;
    if (!violated && !c->constants->forced) {
        memcpy(p->plan, p->minimiser, (size_t)INPUTS(c) * sizeof(real));
        memset(p->multipliers, 0, (size_t)(KINDS(c) * STEPS(c)) * sizeof(real));
        report->status = DDMPC_QP_SOLVED;
        report->path = DDMPC_UNLIMITED;
        report->primal_residual = R(0.0);
        report->dual_residual = residual;
        return DDMPC_DONE;
    }
    shift_multipliers(c);
    if (c->constants->active_set > 0 && !c->constants->forced && find_active_set(c))
        return DDMPC_DONE;
    mark_active_kinds(c);
    return DDMPC_NEEDS_BACKEND;
}
