/* Which measurements may be believed: stamps, numbers, ranges and jumps; see mpc/measurement_check.py. */
#ifndef DDMPC_CHECKS_H
#define DDMPC_CHECKS_H

#include "estimator.h"

/* Say that something was rejected. */
void ddmpc_reject(ddmpc_notes *notes, int subject, int fault, real a, real b);
/* The pose in checked form; 0 and a note if it cannot be used. */
int ddmpc_check_pose(const ddmpc_estimation *constants, ddmpc_estimator *estimator, ddmpc_time t,
                     const ddmpc_stamped *pose, ddmpc_checked_pose *checked, ddmpc_notes *notes);
/* Wheels or gyro, as so many checked numbers with their stamp; 0 and a note if they cannot be used. */
int ddmpc_check_wheels(const ddmpc_estimation *constants, ddmpc_estimator *estimator, ddmpc_time t,
                       const ddmpc_stamped *wheels, ddmpc_checked_twist checked[2], ddmpc_notes *notes);
int ddmpc_check_yaw_rate(const ddmpc_estimation *constants, ddmpc_estimator *estimator, ddmpc_time t,
                         const ddmpc_stamped *yaw_rate, ddmpc_checked_twist checked[1], ddmpc_notes *notes);
/* Whether `pose` lies near the `expected` one; if not it is remembered, and noted. */
int ddmpc_pose_passes(const ddmpc_estimation *constants, ddmpc_estimator *estimator, const ddmpc_checked_pose *pose,
                      const real expected[3], ddmpc_notes *notes);
/* Count `pose` as believed, which clears the memory of jumps. */
void ddmpc_accept_pose(ddmpc_estimator *estimator, const ddmpc_checked_pose *pose);

#endif
