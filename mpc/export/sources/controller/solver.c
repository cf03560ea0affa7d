#include "solver.h"

#include <string.h>

#include "ddmpc_hard_workspace.h"
#include "ddmpc_soft_workspace.h"
#include "osqp.h"
#include "soft_slots.h"

/* An unused row of OSQP's. */
#define UNBOUNDED_ROW R(1e15)
/* A soft limit that is nearer than this may soon matter [m/s, rad/s, m]. */
#define NEAR R(0.02)
/* Solves of one tick, each with the soft limits that the one before exceeded. */
#define ROUNDS 6

int ddmpc_usable(ddmpc_status status) { return status == DDMPC_QP_SOLVED || status == DDMPC_QP_SOLVED_INACCURATELY; }

void ddmpc_solver_reset(ddmpc_solver *solver)
{
    solver->slots = 0;
    for (int row = 0; row < DDMPC_SOFT_ROWS; row++)
        solver->dual[row] = R(0.0);
    memset(solver->multiplier, 0, sizeof solver->multiplier);
}

static real soft_bound(const ddmpc_qp *qp, const ddmpc_slot *slot)
{
    return slot->side > 0 ? qp->soft_upper[slot->kind][slot->step] : -qp->soft_lower[slot->kind][slot->step];
}

static void fill_hard(ddmpc_solver *solver, const ddmpc_problem *problem, const real start[DDMPC_INPUTS])
{
    const ddmpc_qp *qp = problem->qp;
    real *entry = solver->triangle;
    for (int column = 0; column < DDMPC_INPUTS; column++) {
        for (int row = 0; row <= column; row++)
            *entry++ = qp->H[row][column];
        solver->gradient[column] = qp->g[column];
        solver->start[column] = start[column];
        real box = qp->box[column] * ddmpc_this_settings.row_scale[column];
        solver->upper[column] = box;
        solver->lower[column] = -box;
    }
    for (int k = 0; k < DDMPC_INPUTS; k++) {
        real scale = ddmpc_this_settings.row_scale[DDMPC_INPUTS + k], slew = problem->tracking->slew[k % 2];
        real base = k < 2 ? problem->tick->last_command[k] : R(0.0);
        solver->upper[DDMPC_INPUTS + k] = scale * (base + slew);
        solver->lower[DDMPC_INPUTS + k] = scale * (base - slew);
    }
}

/* The row of one slot in the matrix of constraints; none where `row` is null. */
static void fill_row(ddmpc_solver *solver, int slot, const real *row, real scale, real side)
{
    real *at = solver->entries;
    for (int k = 0; k < DDMPC_INPUTS; k++) {
        int hard = k + 2 < DDMPC_INPUTS ? 3 : 2;
        at[hard + slot] = row ? side * scale * row[k] : R(0.0);
        at += hard + DDMPC_SLOTS;
    }
    at[2 * slot] = -scale;
}

/* The rows of soft limits, one to a slot, and of their slacks: scale (side row U - slack) <= scale bound. */
static void fill_soft(ddmpc_solver *solver, const ddmpc_problem *problem)
{
    const real linear = ddmpc_this_settings.soft_linear, quadratic = ddmpc_this_settings.soft_quadratic;
    int kind = -1;
    for (int i = 0; i < DDMPC_SLOTS; i++) {
        int limit = DDMPC_HARD_ROWS + i, bound = limit + DDMPC_SLOTS, used = i < solver->slots;
        real scale = R(1.0), slack = R(0.0), multiplier = R(0.0), upper = UNBOUNDED_ROW;
        if (used) {
            const ddmpc_slot *slot = &solver->slot[i];
            if (slot->kind != kind) {
                kind = slot->kind;
                ddmpc_soft_rows(problem->tracking, problem->tick, problem->work, kind, solver->rows);
            }
            scale = ddmpc_this_settings.soft_scale[kind];
            multiplier = ddmpc_max((real)slot->side * solver->multiplier[kind][slot->step], R(0.0));
            upper = soft_bound(problem->qp, slot);
            for (int k = 0; k < DDMPC_INPUTS; k++)
                slack += (real)slot->side * solver->rows[slot->step][k] * solver->start[k];
            slack = ddmpc_max(slack - upper, R(0.0));
            fill_row(solver, i, solver->rows[slot->step], scale, (real)slot->side);
        } else {
            fill_row(solver, i, 0, scale, R(0.0));
        }
        solver->triangle[DDMPC_TRIANGLE + i] = quadratic;
        solver->gradient[DDMPC_INPUTS + i] = linear;
        solver->start[DDMPC_INPUTS + i] = slack;
        solver->lower[limit] = -UNBOUNDED_ROW;
        solver->upper[limit] = used ? scale * upper : UNBOUNDED_ROW;
        solver->lower[bound] = R(0.0);
        solver->upper[bound] = UNBOUNDED_ROW;
        solver->dual[limit] = multiplier / scale;
        /* Where the cost of the slack does not depend on it. */
        solver->dual[bound] = (multiplier - linear - quadratic * slack) / ddmpc_this_settings.slack_scale;
    }
}

/* Remember what the soft limits weigh in the solution; those of the hard ones stay in `dual`. */
static void keep_multipliers(ddmpc_solver *solver)
{
    memset(solver->multiplier, 0, sizeof solver->multiplier);
    for (int i = 0; i < solver->slots; i++) {
        const ddmpc_slot *slot = &solver->slot[i];
        real scale = ddmpc_this_settings.soft_scale[slot->kind];
        solver->multiplier[slot->kind][slot->step] = (real)slot->side * scale * solver->dual[DDMPC_HARD_ROWS + i];
    }
}

/* What does not change of the matrix of constraints. */
static void fill_entries(ddmpc_solver *solver)
{
    real *at = solver->entries;
    for (int k = 0; k < DDMPC_INPUTS; k++) {
        *at++ = ddmpc_this_settings.row_scale[k];
        *at++ = ddmpc_this_settings.row_scale[DDMPC_INPUTS + k];
        if (k + 2 < DDMPC_INPUTS)
            *at++ = -ddmpc_this_settings.row_scale[DDMPC_INPUTS + k + 2];
        at += DDMPC_SLOTS;
    }
    for (int i = 0; i < DDMPC_SLOTS; i++)
        at[2 * i + 1] = ddmpc_this_settings.slack_scale;
}

static ddmpc_status status_of(OSQPInt status)
{
    switch (status) {
    case OSQP_SOLVED: return DDMPC_QP_SOLVED;
    case OSQP_SOLVED_INACCURATE: return DDMPC_QP_SOLVED_INACCURATELY;
    case OSQP_MAX_ITER_REACHED: return DDMPC_QP_MAX_ITERATIONS;
    case OSQP_PRIMAL_INFEASIBLE:
    case OSQP_PRIMAL_INFEASIBLE_INACCURATE: return DDMPC_QP_INFEASIBLE;
    case OSQP_DUAL_INFEASIBLE:
    case OSQP_DUAL_INFEASIBLE_INACCURATE: return DDMPC_QP_UNBOUNDED;
    case OSQP_NON_CVX: return DDMPC_QP_NOT_CONVEX;
    default: return DDMPC_QP_NOT_RUN;
    }
}

static void run(ddmpc_solver *solver, OSQPSolver *osqp, real plan[DDMPC_INPUTS], ddmpc_report *report)
{
    int soft = osqp == &ddmpc_soft_solver, rows = soft ? DDMPC_SOFT_ROWS : DDMPC_HARD_ROWS;
    OSQPInt fault = osqp_update_data_vec(osqp, solver->gradient, solver->lower, solver->upper);
    fault = fault || osqp_update_data_mat(osqp, solver->triangle, OSQP_NULL,
                                          soft ? DDMPC_TRIANGLE + DDMPC_SLOTS : DDMPC_TRIANGLE,
                                          soft ? solver->entries : OSQP_NULL, OSQP_NULL, soft ? DDMPC_ENTRIES : 0);
    fault = fault || osqp_warm_start(osqp, solver->start, solver->dual);
    osqp->settings->max_iter = DDMPC_ITERATION_LIMIT - report->iterations;
    if (fault || osqp_solve(osqp)) {
        report->status = DDMPC_QP_REFUSED;
        return;
    }
    report->status = status_of(osqp->info->status_val);
    report->iterations += (int)osqp->info->iter;
    report->primal_residual = osqp->info->prim_res;
    report->dual_residual = osqp->info->dual_res;
    for (int row = 0; row < rows; row++)
        solver->dual[row] = osqp->solution->y[row];
    report->soft_limits = soft ? solver->slots : 0;
    for (int k = 0; k < DDMPC_INPUTS; k++)
        plan[k] = osqp->solution->x[k];
}

/* The multipliers of the last tick move a step ahead, like the plan. */
static void shift_dual(ddmpc_solver *solver)
{
    for (int block = 0; block < DDMPC_HARD_ROWS; block += DDMPC_INPUTS)
        for (int k = 0; k + 2 < DDMPC_INPUTS; k++)
            solver->dual[block + k] = solver->dual[block + k + 2];
    for (int kind = 0; kind < DDMPC_SOFT; kind++)
        for (int step = 0; step + 1 < DDMPC_STEPS; step++)
            solver->multiplier[kind][step] = solver->multiplier[kind][step + 1];
}

void ddmpc_solve(ddmpc_solver *solver, const ddmpc_problem *problem, const real guess[DDMPC_INPUTS],
                 real plan[DDMPC_INPUTS], ddmpc_report *report)
{
    const real margin = ddmpc_this_settings.soft_slack;
    ddmpc_report fresh = {DDMPC_QP_NOT_FINITE, 0, R(0.0), R(0.0), 0, 0};
    *report = fresh;
    solver->slots = 0;
    ddmpc_relax_status relaxed = ddmpc_relax(problem->tick, problem->qp, &solver->relaxed);
    if (relaxed != DDMPC_RELAXED) {
        report->status = relaxed == DDMPC_NOT_CONVEX ? DDMPC_QP_NOT_CONVEX : DDMPC_QP_NOT_FINITE;
        return;
    }
    memcpy(plan, solver->relaxed.plan, sizeof solver->relaxed.plan);
    if (!ddmpc_broken(problem->tracking, problem->tick, problem->work, problem->qp, plan, margin)) {
        ddmpc_solver_reset(solver);
        report->status = DDMPC_QP_SOLVED;
        report->dual_residual = solver->relaxed.residual;
        return;
    }
    /* The soft limits that matter are first of all those that the last plan, a step ahead, is near. */
    solver->slots = 0;
    ddmpc_give_slots(solver, problem, guess, -NEAR, &report->left_out);
    shift_dual(solver);
    fill_entries(solver);
    const real *start = guess;
    for (int round = 0; round < ROUNDS; round++) {
        fill_hard(solver, problem, start);
        if (solver->slots)
            fill_soft(solver, problem);
        run(solver, solver->slots ? &ddmpc_soft_solver : &ddmpc_hard_solver, plan, report);
        if (!ddmpc_usable(report->status))
            return;
        keep_multipliers(solver);
        int exceeded = ddmpc_give_slots(solver, problem, plan, margin, &report->left_out);
        if (report->left_out) {
            ddmpc_free_idle_slots(solver);
            exceeded += ddmpc_give_slots(solver, problem, plan, margin, &report->left_out);
        }
        /* Where there are fewer slots than limits that matter, another round would only exchange them. */
        if (!exceeded || report->left_out || report->iterations >= DDMPC_ITERATION_LIMIT)
            return;
        start = plan;
    }
}
