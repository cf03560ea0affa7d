/* Clock for the duration and the deadline of a solve [s]. An export makes no system calls, so it has no clock unless the
 * application provides a function with -DDDMPC_NOW=function. */
#ifndef DDMPC_CLOCK_H
#define DDMPC_CLOCK_H

#include "real.h"

#if defined(DDMPC_NOW)
ddmpc_time DDMPC_NOW(void);
static inline ddmpc_time ddmpc_now(void) { return DDMPC_NOW(); }
#elif defined(DDMPC_EXPORT)
static inline ddmpc_time ddmpc_now(void) { return (ddmpc_time)NAN; }
#else
#include <time.h>
static inline ddmpc_time ddmpc_now(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (ddmpc_time)now.tv_sec + 1e-9 * (ddmpc_time)now.tv_nsec;
}
#endif

#endif
