/* One real-time iteration a tick: linearise along the shifted plan, solve, keep the plan. */
#ifndef DDMPC_PLANNER_H
#define DDMPC_PLANNER_H

#include "ddmpc.h"

/* Forget the last plan's continuation and the solver's warm start. */
void ddmpc_planner_reset(ddmpc_controller *controller);

/* Make the plan at `time` [s] of the reference; returns whether it may be driven. */
int ddmpc_planner_plan(ddmpc_controller *controller, ddmpc_time time, ddmpc_report *report);

#endif
