/* The controller of this program: what an application calls, beside core.h. There is one, in static memory of exactly
 * the size that its configuration needs. */
#ifndef DDMPC_H
#define DDMPC_H

#include "core.h"

/* Generated data of this controller: its numbers, the user's functions, and the defaults of their parameters. */
extern const ddmpc_sizes ddmpc_this_sizes;
extern const ddmpc_constants ddmpc_this_constants;
extern const ddmpc_functions ddmpc_this_functions;
extern const real ddmpc_this_defaults[];

/* The controller as new: for a robot that stands still, without a reference. Parameters of the user's functions are at
   their defaults; ddmpc_parameters says where they are to be changed. */
ddmpc_controller *ddmpc_open(void);

/* A trajectory in closed form as a reference. */
ddmpc_reference ddmpc_reference_of(const ddmpc_trajectory *trajectory);

/* Track `reference` from now on; its time 0 is `t0` [s] on the clock of ddmpc_tick. The robot may be moving. Looks at
   the whole reference once, sample by sample. Returns 0, and changes nothing, if `t0` or the duration is not finite, or
   the reference is faster than the limits. */
int ddmpc_follow(ddmpc_controller *controller, const ddmpc_reference *reference, ddmpc_time t0);

/* Decide the command for the tick at `t` [s] from what arrived since the last one. `reference_time` and `on_time` of the
   input need not be set: the reference does not wait. Where the active set proves no solution the solve has failed, and
   the ladder acts; to have a backend of your own instead, call ddmpc_step, and ddmpc_answer where it says
   DDMPC_NEEDS_BACKEND. The result is valid until the next tick. */
const ddmpc_result *ddmpc_tick(ddmpc_controller *controller, ddmpc_time t, const ddmpc_input *input);

#endif
