/* Which soft limits take part in a tick's quadratic program: there are few slots, and few limits that matter. */
#ifndef DDMPC_SOFT_SLOTS_H
#define DDMPC_SOFT_SLOTS_H

#include "solver.h"

/* Give slots to soft limits that `plan` exceeds by more than `margin`. After ddmpc_condense.

   Returns how many got one; `left_out` says how many did not. */
int ddmpc_give_slots(ddmpc_solver *solver, const ddmpc_problem *problem, const real plan[DDMPC_INPUTS], real margin,
                     int *left_out);

/* Take their slots from soft limits that the last solution does not lean on. */
void ddmpc_free_idle_slots(ddmpc_solver *solver);

#endif
