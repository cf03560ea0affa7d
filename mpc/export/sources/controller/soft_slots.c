#include "soft_slots.h"

static int has_slot(const ddmpc_solver *solver, int kind, int step, int side)
{
    for (int i = 0; i < solver->slots; i++)
        if (solver->slot[i].kind == kind && solver->slot[i].step == step && solver->slot[i].side == side)
            return 1;
    return 0;
}

int ddmpc_give_slots(ddmpc_solver *solver, const ddmpc_problem *problem, const real plan[DDMPC_INPUTS], real margin,
                     int *left_out)
{
    int given = 0;
    *left_out = 0;
    ddmpc_soft_values(problem->tracking, problem->tick, problem->work, plan, solver->values);
    for (int kind = 0; kind < DDMPC_SOFT; kind++) {
        for (int step = 0; step < DDMPC_STEPS; step++) {
            real value = solver->values[kind][step];
            int above = value > problem->qp->soft_upper[kind][step] + margin;
            int below = value < problem->qp->soft_lower[kind][step] - margin;
            if (above == below || has_slot(solver, kind, step, above - below))
                continue;
            if (solver->slots < DDMPC_SLOTS) {
                ddmpc_slot slot = {kind, step, above - below};
                solver->slot[solver->slots++] = slot;
                given++;
            } else {
                ++*left_out;
            }
        }
    }
    return given;
}

void ddmpc_free_idle_slots(ddmpc_solver *solver)
{
    int kept = 0;
    for (int i = 0; i < solver->slots; i++)
        if (ddmpc_fabs(solver->multiplier[solver->slot[i].kind][solver->slot[i].step]) > ddmpc_this_settings.soft_slack)
            solver->slot[kept++] = solver->slot[i];
    solver->slots = kept;
}
