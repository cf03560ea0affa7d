/* Where the robot is along its reference: near it, or at its end. */
#ifndef DDMPC_PROGRESS_H
#define DDMPC_PROGRESS_H

#include "ddmpc.h"

/* Whether the robot rests at the end of its reference, or has had the time to; what is finished stays so. */
int ddmpc_is_finished(ddmpc_controller *controller, ddmpc_time time, ddmpc_result *result);

/* Whether the robot is as near to where the reference is at `time` as failure.max_position_error asks. */
int ddmpc_near_reference(const ddmpc_controller *controller, ddmpc_time time);

#endif
