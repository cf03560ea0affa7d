#include "command_limits.h"

#include "constants.h"

real ddmpc_command_bound(int channel, real last, int steps)
{
    real reachable = ddmpc_fabs(last) - ddmpc_this_tracking.slew[channel] * (real)steps;
    return ddmpc_max(reachable, ddmpc_this_tracking.largest_command[channel]);
}

void ddmpc_clip_command(const real command[2], const real last[2], real clipped[2])
{
    for (int channel = 0; channel < 2; channel++) {
        real box = ddmpc_command_bound(channel, last[channel], 1), slew = ddmpc_this_tracking.slew[channel];
        real lower = ddmpc_max(last[channel] - slew, -box), upper = ddmpc_min(last[channel] + slew, box);
        clipped[channel] = ddmpc_min(ddmpc_max(command[channel], lower), upper);
    }
}
