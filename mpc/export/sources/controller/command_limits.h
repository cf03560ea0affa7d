/* Hard bounds of the command: range and slew, against the last command sent. */
#ifndef DDMPC_COMMAND_LIMITS_H
#define DDMPC_COMMAND_LIMITS_H

#include "real.h"

/* Bound on |command| of a channel `steps` after `last`: one tightened below it is reached at the slew limit. */
real ddmpc_command_bound(int channel, real last, int steps);

/* The nearest command inside range and slew. */
void ddmpc_clip_command(const real command[2], const real last[2], real clipped[2]);

#endif
