#include "tick_clock.h"

#include "constants.h"

void ddmpc_clock_restart(ddmpc_clock *clock) { clock->has_last = clock->has_leap = 0; }

ddmpc_tick_kind ddmpc_clock_judge(ddmpc_clock *clock, ddmpc_time t)
{
    int had_leap = clock->has_leap;
    clock->has_leap = 0;
    if (!isfinite(t))
        return DDMPC_TICK_FAULTY;
    if (clock->has_last) {
        ddmpc_time gap = t - clock->last;
        if (gap < 0.0)
            return DDMPC_TICK_FAULTY;
        if (gap < 0.5 * ddmpc_this_settings.sample_time)
            return DDMPC_TICK_REPEATED;
        if (gap > ddmpc_this_settings.longest_pause) {
            ddmpc_time since_leap = t - clock->leap;
            /* One leap may be a glitch of the clock; a second tick right after it shows that it was none. */
            if (!had_leap || !(since_leap > 0.0 && since_leap <= ddmpc_this_settings.longest_pause)) {
                clock->leap = t;
                clock->has_leap = 1;
                return DDMPC_TICK_LEAPT;
            }
            clock->last = t;
            return DDMPC_TICK_PAUSED;
        }
    }
    clock->last = t;
    clock->has_last = 1;
    return DDMPC_TICK_NEW;
}
