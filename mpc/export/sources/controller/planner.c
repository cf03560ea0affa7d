#include "planner.h"

#include <string.h>

#include "command_limits.h"

void ddmpc_planner_reset(ddmpc_controller *controller)
{
    controller->has_guess = 0;
    ddmpc_solver_reset(&controller->solver);
}

static void look(ddmpc_controller *controller, ddmpc_time time)
{
    ddmpc_situation *now = &controller->situation;
    const ddmpc_reference *reference = &controller->reference;
    memcpy(now->mean, controller->result.estimate.mean, sizeof now->mean);
    memcpy(now->past, controller->estimator.commands + DDMPC_COMMANDS - DDMPC_PAST, sizeof now->past);
    memcpy(now->last_command, controller->last, sizeof now->last_command);
    for (int k = 0; k < DDMPC_SAMPLES; k++)
        reference->sample(reference->context, time + k * ddmpc_this_settings.sample_time, now->reference[k], now->twist[k]);
}

static void guess_from_feed_forward(ddmpc_controller *controller)
{
    for (int k = 0; k < DDMPC_STEPS; k++)
        for (int channel = 0; channel < 2; channel++) {
            real box = ddmpc_command_bound(channel, controller->last[channel], k + 1);
            real wanted = controller->tick.feed_forward[k][channel];
            controller->guess[2 * k + channel] = ddmpc_min(ddmpc_max(wanted, -box), box);
        }
    controller->has_guess = 1;
}

static int all_finite(const real plan[DDMPC_INPUTS])
{
    int good = 1;
    for (int k = 0; k < DDMPC_INPUTS; k++)
        good &= isfinite(plan[k]) != 0;
    return good;
}

int ddmpc_planner_plan(ddmpc_controller *controller, ddmpc_time time, ddmpc_report *report)
{
    real plan[DDMPC_INPUTS];
    const ddmpc_tracking *tracking = &ddmpc_this_tracking;
    ddmpc_problem problem = {tracking, &controller->tick, &controller->work, &controller->qp};
    look(controller, time);
    ddmpc_begin(tracking, &controller->situation, &controller->tick);
    if (!controller->has_guess)
        guess_from_feed_forward(controller);
    ddmpc_condense(tracking, &controller->tick, controller->guess, &controller->work, &controller->qp);
    ddmpc_solve(&controller->solver, &problem, controller->guess, plan, report);
    if (!ddmpc_usable(report->status) || !all_finite(plan)) {
        ddmpc_planner_reset(controller);
        return 0;
    }
    memcpy(controller->plan, plan, sizeof plan);
    memcpy(controller->guess, plan + 2, sizeof plan - 2 * sizeof *plan);
    memcpy(controller->guess + DDMPC_INPUTS - 2, plan + DDMPC_INPUTS - 2, 2 * sizeof *plan);
    return 1;
}
