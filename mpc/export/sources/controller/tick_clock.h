/* The times at which the controller is called, and what may be wrong with them. */
#ifndef DDMPC_TICK_CLOCK_H
#define DDMPC_TICK_CLOCK_H

#include "real.h"

typedef enum {
    DDMPC_TICK_NEW,      /* the next tick, perhaps after some that were missed */
    DDMPC_TICK_REPEATED, /* less than half a sample after the last tick: too soon for a new command */
    DDMPC_TICK_LEAPT,    /* long after the last tick: a pause, or a glitch of the clock; the next tick will tell */
    DDMPC_TICK_PAUSED,   /* a pause so long that nothing is known any more */
    DDMPC_TICK_FAULTY    /* its time cannot be used */
} ddmpc_tick_kind;

typedef struct {
    ddmpc_time last, leap;
    int has_last, has_leap;
} ddmpc_clock;

/* Take the next tick as the first. */
void ddmpc_clock_restart(ddmpc_clock *clock);

/* What the call at `t` [s] is. */
ddmpc_tick_kind ddmpc_clock_judge(ddmpc_clock *clock, ddmpc_time t);

#endif
