/* The extended Kalman filter's steps over one sample; see mpc/kalman.py. */
#ifndef DDMPC_FILTER_H
#define DDMPC_FILTER_H

#include "arc.h"
#include "estimator.h"

/* (2) v [m/s], omega [rad/s] of the body. */
void ddmpc_filter_twist(const ddmpc_estimation *constants, const real mean[DDMPC_BELIEF], real twist[2]);
/* (2) standard deviations of the same. */
void ddmpc_filter_twist_deviation(const ddmpc_estimation *constants, const ddmpc_belief *belief, real deviation[2]);
/* The pose `ahead` seconds after the belief, at constant twist. */
void ddmpc_filter_pose_at(const ddmpc_estimation *constants, const ddmpc_belief *belief, real ahead, real pose[3]);
/* One sample on under the delayed commands. */
void ddmpc_filter_predict(const ddmpc_estimation *constants, const ddmpc_belief *before, const real recent[2],
                          const real older[2], ddmpc_belief *after);
/* Take in a number of the wheels or the gyro; returns the squared innovation over its variance. */
real ddmpc_filter_correct_twist(const ddmpc_estimation *constants, ddmpc_belief *belief,
                                const ddmpc_checked_twist *twist);
/* Take in a pose that was true `ahead` seconds after the belief; returns the squared innovation over its variance. */
real ddmpc_filter_correct_pose(const ddmpc_estimation *constants, ddmpc_belief *belief,
                               const ddmpc_checked_pose *pose, real ahead);
/* The same motion at a pose that is known to its covariance. */
void ddmpc_filter_place(ddmpc_belief *belief, const ddmpc_checked_pose *pose);

#endif
