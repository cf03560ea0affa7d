/* Number type of the core: double, or float if DDMPC_FLOAT is defined. */
#ifndef DDMPC_REAL_H
#define DDMPC_REAL_H

#include <math.h>

#include "ddmpc_sizes.h" /* defines DDMPC_EXPORT, sizes and DDMPC_FLOAT in an export; empty otherwise */

#ifdef DDMPC_FLOAT
typedef float real;
#define R(number) number##f
#define ddmpc_sin sinf
#define ddmpc_cos cosf
#define ddmpc_atan atanf
#define ddmpc_sqrt sqrtf
#define ddmpc_fabs fabsf
#define ddmpc_floor floorf
#define ddmpc_rint rintf
#define ddmpc_hypot hypotf
#define ddmpc_atan2 atan2f
#else
typedef double real;
#define R(number) number
#define ddmpc_sin sin
#define ddmpc_cos cos
#define ddmpc_atan atan
#define ddmpc_sqrt sqrt
#define ddmpc_fabs fabs
#define ddmpc_floor floor
#define ddmpc_rint rint
#define ddmpc_hypot hypot
#define ddmpc_atan2 atan2
#endif

/* Times are always double: after an hour, float has a resolution of 0.2 ms only. */
typedef double ddmpc_time;

#define DDMPC_PI R(3.14159265358979323846)

static inline real ddmpc_max(real a, real b) { return a > b ? a : b; }
static inline int ddmpc_min_int(int a, int b) { return a < b ? a : b; }
static inline real ddmpc_min(real a, real b) { return a < b ? a : b; }

/* Wrap `angle` [rad] to [-pi, pi). */
static inline real ddmpc_wrap(real angle)
{
    return angle - R(2.0) * DDMPC_PI * ddmpc_floor((angle + DDMPC_PI) / (R(2.0) * DDMPC_PI));
}

/* tanh without branches or calls, so that loops over it vectorise: a Pade approximant of tanh(x / 8), followed by three
   applications of the double-argument formula. Accurate to a few units in the last place in both precisions. */
static inline real ddmpc_tanh(real x)
{
    const real limit = R(20.0);
    const real clipped = x > limit ? limit : x < -limit ? -limit : x;
    const real y = R(0.125) * clipped, s = y * y, per = R(1.0) / R(135135.0);
    real top = y * (R(1.0) + s * (R(17325.0) + s * (R(378.0) + s)) * per);
    real bottom = R(1.0) + s * (R(62370.0) + s * (R(3150.0) + s * R(28.0))) * per;
    for (int i = 0; i < 3; i++) {
        const real twice = R(2.0) * top * bottom;
        bottom = top * top + bottom * bottom;
        top = twice;
    }
    return top / bottom;
}

#endif
