/* Application interface of the exported controller, in addition to core.h. A program has one controller, in static memory
 * of the size that its configuration requires. */
#ifndef DDMPC_H
#define DDMPC_H

#include "core.h"

/* Generated data of this controller: sizes, constants, functions, and defaults of the parameters of user functions. */
extern const ddmpc_sizes ddmpc_this_sizes;
extern const ddmpc_constants ddmpc_this_constants;
extern const ddmpc_functions ddmpc_this_functions;
extern const real ddmpc_this_defaults[];

/* Initialise the controller for a robot at rest, without a reference, and return it. Parameters of the user's functions
   have their default values; ddmpc_parameters returns the address at which to change them. */
ddmpc_controller *ddmpc_open(void);

/* Return a trajectory in closed form as a reference. */
ddmpc_reference ddmpc_reference_of(const ddmpc_trajectory *trajectory);

/* Start tracking `reference`; its time 0 is `t0` [s] on the clock of ddmpc_tick. The robot may be moving. Checks every
   sample of the reference. Returns 0, and changes nothing, if `t0` or the duration is not finite, or the reference
   exceeds the limits. */
int ddmpc_follow(ddmpc_controller *controller, const ddmpc_reference *reference, ddmpc_time t0);

/* Compute the command for the tick at `t` [s] from the measurements since the previous tick. `reference_time` and
   `on_time` of the input are ignored: the reference does not wait. If the active set finds no proven solution, the solve
   fails and the failure ladder selects the command. To use another solver as backend, call ddmpc_step instead, and
   ddmpc_answer if the status is DDMPC_NEEDS_BACKEND. The result is valid until the next tick. */
const ddmpc_result *ddmpc_tick(ddmpc_controller *controller, ddmpc_time t, const ddmpc_input *input);

#endif
