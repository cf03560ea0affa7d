/* What is fixed in this controller; the values are generated. */
#ifndef DDMPC_CONSTANTS_H
#define DDMPC_CONSTANTS_H

#include "condense.h"
#include "estimator.h"

/* Of the solver, the failure ladder and the finish; mpc/export/constants.py fills them by name. */
typedef struct {
    double sample_time, longest_pause;         /* [s]; longer without a tick, the history cannot make up for it */
    real max_pose_age, max_position_error;     /* [s], [m] */
    real finish_position, finish_speed, finish_timeout; /* [m], [m/s, rad/s], [s] */
    real max_reused_ticks, resume;             /* whole numbers */
    real soft_linear, soft_quadratic;          /* penalties on what exceeds a soft limit */
    real soft_slack;                           /* what exceeds it by less is the solver's own residual */
    real row_scale[2 * DDMPC_INPUTS];          /* of box and slew: unit length in the metric of the inverse Hessian */
    real soft_scale[DDMPC_SOFT], slack_scale;  /* of the soft limits, and of their slacks */
} ddmpc_settings;

extern const ddmpc_estimation ddmpc_this_estimation;
extern const ddmpc_tracking ddmpc_this_tracking;
extern const ddmpc_settings ddmpc_this_settings;

#endif
