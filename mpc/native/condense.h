/* The tracking problem linearised along a plan and condensed to a small dense quadratic program in the commands
 * U = (v_ref[0], omega_ref[0], v_ref[1], ...).
 *
 * No allocation, no globals. The constants of one controller are in `ddmpc_tracking`. Twists and headings answer to
 * commands as a linear time-invariant system does, so their matrices are Toeplitz, and one response stands for each;
 * step k answers to the commands before it only, and what is zero is left out. ddmpc_sizes.h is generated and defines
 *
 *     DDMPC_STEPS         horizon N
 *     DDMPC_STATES        order n of the velocity model
 *     DDMPC_DELAY_V, DDMPC_DELAY_OMEGA    dead time of each channel in whole samples
 *     DDMPC_LAG_V, DDMPC_LAG_OMEGA        whole samples by which the feed-forward looks ahead
 */
#ifndef DDMPC_CONDENSE_H
#define DDMPC_CONDENSE_H

#include "ddmpc_sizes.h"
#include "real.h"
#include "tile.h"

enum {
    DDMPC_INPUTS = 2 * DDMPC_STEPS,
    /* rows of commands are padded with zeros to whole lanes */
    DDMPC_WIDTH = (DDMPC_INPUTS + DDMPC_LANES - 1) / DDMPC_LANES * DDMPC_LANES,
    DDMPC_PAST = (DDMPC_DELAY_V > DDMPC_DELAY_OMEGA ? DDMPC_DELAY_V : DDMPC_DELAY_OMEGA) + 1,
    DDMPC_LONGEST_LAG = DDMPC_LAG_V > DDMPC_LAG_OMEGA ? DDMPC_LAG_V : DDMPC_LAG_OMEGA,
    DDMPC_SAMPLES = DDMPC_STEPS + 1 + DDMPC_LONGEST_LAG /* of the reference, from now on */
};

/* Kinds of soft limit: v, omega, speed of the right and of the left wheels at the rim, distance across the path. */
enum { DDMPC_SOFT_V, DDMPC_SOFT_OMEGA, DDMPC_SOFT_RIGHT, DDMPC_SOFT_LEFT, DDMPC_SOFT_ACROSS, DDMPC_SOFT };

/* What is constant for one controller. Every field is `real`: mpc/compiled/constants.py fills them in this order. */
typedef struct {
    real dt;
    real from_state[DDMPC_STEPS + 1][2][DDMPC_STATES];  /* twists at the samples, from the state now */
    real from_past[DDMPC_STEPS + 1][2][DDMPC_PAST][2];  /* and from the commands on their way, oldest first */
    /* twist m samples after a unit command: [of v, omega][to v_ref, omega_ref][m], nothing at m = 0 */
    real response[2][2][DDMPC_STEPS + 1];
    /* rows of the matrices of mean v, mean omega and heading, newest command first, padded with zeros: the row of arc
       or sample k begins at 2 (N - k), with k = 1 for the first that answers to the first command */
    real mean_row[2][2 * DDMPC_WIDTH];
    real heading_row[2 * DDMPC_WIDTH];
    real heading_hessian[DDMPC_INPUTS][DDMPC_INPUTS];   /* of the heading errors, for a gain of 1 */
    real along[DDMPC_STEPS], across[DDMPC_STEPS];       /* roots of the weights of the errors at the samples 1 to N */
    real heading[DDMPC_STEPS];                          /* weights of the heading errors */
    real command_weight[2], increment_weight[2];
    real lean_along, lean_heading;                      /* weights by which lagging is traded against turning */
    real largest_command[2], slew[2];                   /* hard: [m/s, rad/s], and per sample */
    real soft_limit[DDMPC_SOFT];
    real half_track;                                    /* [m] */
    real inverse_gain[2][2], lag_rest[2];               /* feed-forward; lag beyond the whole samples [samples] */
} ddmpc_tracking;

/* What a tick begins with. */
typedef struct {
    real mean[DDMPC_STATES + 9];      /* of the estimator: states, slip, gyro bias, pose */
    real past[DDMPC_PAST][2];         /* commands on their way, oldest first */
    real last_command[2];             /* from which slew counts */
    real reference[DDMPC_SAMPLES][3]; /* poses, theta unwrapped but on any turn */
    real twist[DDMPC_SAMPLES][2];
} ddmpc_situation;

/* The data of one optimal control problem, see mpc/tick.py. */
typedef struct {
    real pose[3];
    real free_twist[DDMPC_STEPS + 1][2];
    real gains[2];
    real side_slip;
    real reference[DDMPC_STEPS + 1][3];
    real heading[DDMPC_STEPS + 1];
    real feed_forward[DDMPC_STEPS][2];
    real last_command[2];
} ddmpc_tick;

/* Minimise U'HU/2 + g'U + penalty(soft U) subject to |U| <= box and |increments| <= slew. */
typedef struct {
    real H[DDMPC_INPUTS][DDMPC_INPUTS]; /* symmetric, all of it filled */
    real g[DDMPC_INPUTS];
    real box[DDMPC_INPUTS];
    real soft_lower[DDMPC_SOFT][DDMPC_STEPS], soft_upper[DDMPC_SOFT][DDMPC_STEPS];
} ddmpc_qp;

/* What one call leaves for the next of the same tick; all zero before the first. */
typedef struct {
    real plan_twist[2][DDMPC_STEPS + 1];         /* of the model, from the plan alone */
    real poses[DDMPC_STEPS + 1][3];              /* that follow from the plan linearised along */
    real arc[8][DDMPC_STEPS];                    /* displacement x, y of each arc; then its gradient by the twist and the
                                                    heading of the model: of x by v, omega, theta; of y */
    real cosine[DDMPC_STEPS], sine[DDMPC_STEPS]; /* of the path's heading at the samples 1 to N */
    real stack[2 * DDMPC_STEPS][DDMPC_WIDTH];    /* weighted rows of the errors along and across, by turns */
    real across[DDMPC_STEPS][DDMPC_WIDTH];       /* rows of the distance across the path */
    real moves[2][DDMPC_WIDTH];
    real gradient[DDMPC_WIDTH];
} ddmpc_workspace;

/* Turn the reference to the estimate, lean into the curve, feed forward, and predict without a plan. */
void ddmpc_begin(const ddmpc_tracking *constants, const ddmpc_situation *situation, ddmpc_tick *tick);
/* The poses that follow from `plan`, by exact arcs. */
void ddmpc_poses(const ddmpc_tracking *constants, const ddmpc_tick *tick, const real plan[DDMPC_INPUTS],
                 real poses[DDMPC_STEPS + 1][3]);
/* Linearise along `plan` and condense. */
void ddmpc_condense(const ddmpc_tracking *constants, const ddmpc_tick *tick, const real plan[DDMPC_INPUTS],
                    ddmpc_workspace *work, ddmpc_qp *qp);
/* Of what has soft limits, the part that is linear in `plan`: to be compared with soft_lower and soft_upper of the QP.
   After ddmpc_condense. */
void ddmpc_soft_values(const ddmpc_tracking *constants, const ddmpc_tick *tick, const ddmpc_workspace *work,
                       const real plan[DDMPC_INPUTS], real values[DDMPC_SOFT][DDMPC_STEPS]);
/* The rows of that linear part for one kind of soft limit. After ddmpc_condense. */
void ddmpc_soft_rows(const ddmpc_tracking *constants, const ddmpc_tick *tick, const ddmpc_workspace *work, int kind,
                     real rows[DDMPC_STEPS][DDMPC_INPUTS]);

unsigned long ddmpc_tracking_size(void);
unsigned long ddmpc_workspace_size(void);

#endif
