/* The exact arc of a body that moves with constant twist, and its gradient; see models/pose.py. */
#ifndef DDMPC_ARC_H
#define DDMPC_ARC_H

#include "real.h"

typedef struct {
    real dx, dy, dtheta;         /* displacement */
    real by_v[2], by_omega[2];   /* gradient of (dx, dy); theta answers to omega with dt, to nothing else */
    real by_side_slip[2];
} ddmpc_arc;

/* sin(x)/x and its slope are replaced by their series below this |x|: what is left out lies below 1e-17. Single
   precision needs it further out, where the slope's difference has lost no more digits than the series drops. */
#ifdef DDMPC_FLOAT
#define DDMPC_SERIES_LIMIT R(0.2)
#else
#define DDMPC_SERIES_LIMIT R(0.01)
#endif

/* From heading `theta`. The gradient by theta is (-dy, dx). */
static inline ddmpc_arc ddmpc_arc_along(real theta, real v, real omega, real dt, real side_slip)
{
    const real half = R(0.5) * omega * dt, square = half * half;
    real sinc, slope;
    if (ddmpc_fabs(half) < DDMPC_SERIES_LIMIT) {
        sinc = R(1.0) - square / R(6.0) * (R(1.0) - square / R(20.0) * (R(1.0) - square / R(42.0)));
        slope = -half / R(3.0) * (R(1.0) - square / R(10.0) * (R(1.0) - square / R(28.0)));
    } else {
        sinc = ddmpc_sin(half) / half;
        slope = (ddmpc_cos(half) - sinc) / half;
    }
    const real c = ddmpc_cos(theta + half), s = ddmpc_sin(theta + half);
    const real chord = v * dt * sinc, crab = side_slip * omega;
    const real along = c + crab * s, across = s - crab * c;
    const real turn = R(0.5) * dt * chord, stretch = R(0.5) * dt * v * dt * slope;
    ddmpc_arc arc;
    arc.dx = chord * along;
    arc.dy = chord * across;
    arc.dtheta = omega * dt;
    arc.by_v[0] = dt * sinc * along;
    arc.by_v[1] = dt * sinc * across;
    arc.by_omega[0] = stretch * along - turn * across + chord * side_slip * s;
    arc.by_omega[1] = stretch * across + turn * along - chord * side_slip * c;
    arc.by_side_slip[0] = chord * omega * s;
    arc.by_side_slip[1] = -chord * omega * c;
    return arc;
}

#endif
