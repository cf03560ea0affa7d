/* References in closed form, sampled: exact arcs with piecewise constant acceleration, and cubic pieces in time. See
 * mpc/trajectories/arcs.py and spline.py, whose tables these are. */
#ifndef DDMPC_REFERENCE_H
#define DDMPC_REFERENCE_H

#include "real.h"

/* Where samples go: pose (count, 3), twist (count, 2), arc length (count). */
typedef struct {
    real *pose, *twist, *arc_length;
} ddmpc_samples;

/* `table` is (10, phases). Before 0 the reference rests at its start, after `duration` at its end. NaN as a time gives
   NaN. */
void ddmpc_sample_arcs(const ddmpc_time *breaks, const real *table, int phases, ddmpc_time duration,
                       const ddmpc_time *times, int count, const ddmpc_samples *samples);
/* `breaks` has pieces + 1 entries, `table` is (16, pieces). */
void ddmpc_sample_spline(const ddmpc_time *breaks, const real *table, int pieces, ddmpc_time duration,
                         const ddmpc_time *times, int count, const ddmpc_samples *samples);

#endif
