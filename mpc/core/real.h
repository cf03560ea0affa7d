/* The number type of everything here: double, or float where DDMPC_FLOAT is defined. */
#ifndef DDMPC_REAL_H
#define DDMPC_REAL_H

#include <math.h>

#include "ddmpc_sizes.h" /* of an export: DDMPC_EXPORT, its sizes, and DDMPC_FLOAT, if it is float; else empty */

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
#endif

/* Instants stay double: a float counts hours in steps of milliseconds. */
typedef double ddmpc_time;

#define DDMPC_PI R(3.14159265358979323846)

static inline real ddmpc_max(real a, real b) { return a > b ? a : b; }
static inline real ddmpc_min(real a, real b) { return a < b ? a : b; }

/* `angle` [rad] in [-pi, pi). */
static inline real ddmpc_wrap(real angle)
{
    return angle - R(2.0) * DDMPC_PI * ddmpc_floor((angle + DDMPC_PI) / (R(2.0) * DDMPC_PI));
}

#endif
