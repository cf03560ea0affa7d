/* Public interface of the controller's tick, from measurement to command.
 *
 * The core has no allocations and no global variables: the caller provides constants, memory and functions. Python
 * parses this file, so names and layouts are declared only here. The comment after a pointer states the shape of its
 * array in brackets, which Python checks against the sizes:
 *
 *     n states, N steps, W window, H history, P parameters, K kinds of soft limit, S slips, Q parameters of a nonlinear
 *     model, width = 2 N padded to a multiple of 8
 * */
#ifndef DDMPC_CORE_H
#define DDMPC_CORE_H

#include "real.h"

/* Sizes of one controller; an export also defines them as macros in ddmpc_sizes.h. */
typedef struct {
    int steps;                /* N, horizon, at most DDMPC_MAX_STEPS */
    int states;               /* n, order of the velocity model, at most DDMPC_MAX_STATES */
    int delay_v, delay_omega; /* dead time of each channel in whole samples; 0 for a nonlinear model */
    int window;               /* W, number of past commands that affect future motion */
    int history;              /* H, number of past ticks that the estimator stores */
    int lag_v, lag_omega;     /* lead of the feed-forward in whole samples */
    int residuals;            /* rows of user-defined residuals at a sample */
    int soft;                 /* K, kinds of soft limit: five built-in kinds, turn radii, then user-defined kinds */
    int terms;                /* number of user functions */
    int parameters;           /* P, stage parameters of all user functions */
    int nonlinear;            /* 1 if the velocity model is a function */
    int turns;                /* kinds of soft limit for the minimum turn radius: 2, or 0 if it is not configured */
    int slips;                /* S, number of estimated slips: 10, or 15 with curved slip */
    int model_parameters;     /* Q, parameters of a nonlinear model */
    int work;                 /* number of reals of memory that a nonlinear model needs */
    int command_turns; /* kinds of soft limit for the minimum commanded radius: 2, or 0 if it is not configured */
    int spare;         /* maximum unknown delay that a linear model compensates [samples] */
    int max_active;    /* maximum number of active limits: one per command, and exceeded soft limits */
} ddmpc_sizes;

/* CasADi's signature: arguments in, results out. */
typedef int (*ddmpc_function)(const real **arguments, real **results, long long *iw, real *w, int memory);

/* A function of (pose, twist, command, reference, parameters) to (value, Jacobian by pose, twist and command). */
typedef struct {
    ddmpc_function function;
    int rows, soft;      /* rows of its value; 1 if they are limited, 0 if their squares are added to the cost */
    int first_parameter; /* index of its first parameter among the stage parameters */
} ddmpc_term;

/* Constants of one controller. */
typedef struct {
    ddmpc_time sample_time, longest_pause; /* [s] */

    /* velocity model: x+ = A x + B0 u[k - delay] + B1 u[k - delay - 1], (v, omega) = C x */
    const real *A;                /* [n][n] */
    const real *B0;               /* [n][2] */
    const real *B1;               /* [n][2] */
    const real *C;                /* [2][n] */
    const real *mean_output;      /* [2][n] C (1 + A) / 2 */
    const real *settled;          /* [n][2] steady state under a constant unit command */
    const real *model_parameters; /* [Q] of a nonlinear model */

    /* estimator */
    const real *noise; /* [n][n] process noise of one sample */
    real pose_noise[3];
    real prior[18], uncertainty[18], drift[18]; /* mean, deviation, variance per sample: slips, gyro bias, delays */
    real evidence[4]; /* squared deviations up to which slides, omega gain, delay of v, delay of omega count as noise */
    real doubt[2];    /* prior variances of the model's omega gain, and of its lags [s^2] */
    real min_slip[15], max_slip[15]; /* bounds of the estimated slip */
    real wheel_yaw_ratio;            /* ratio of the yaw rate by encoders to that of the model */
    real surprise, patience;         /* limit of the squared innovation [-], and its maximum duration [samples] */
    real min_yaw_rate, min_speed;
    real stamp_history;         /* maximum age of an accepted stamp [s] */
    real pose_variance[3];      /* for a pose without covariance */
    real twist_variance[3];     /* wheel speed, wheel yaw rate, yaw rate */
    ddmpc_time sensor_delay[3]; /* by subject: age of a reading at its stamp [s] */
    real sensor_scale[3];       /* ratio of reading to true value, with sign: wheel speed, wheel yaw rate, yaw rate */
    real sensor_heading;        /* offset of the heading in poses from that of the robot [rad] */
    real largest_twist[3], largest_twist_jump[3];
    real largest_position_jump, largest_heading_jump;
    /* fields of mpc/config/core_thresholds.yaml with these names */
    ddmpc_time clock_error;
    real largest_variance, largest_asymmetry, sent_rounding;
    int rated_poses;

    /* monitor of the sensors */
    int monitor; /* 1 if the monitor is enabled */
    real enough; /* evidence against a sensor above which the sensor is not used, in squared deviations */
    /* fields of mpc/config/sensor_test.yaml with these names, for the sensor test */
    real windows[3], silence, pose_spacing, latest, lasting, often;
    real gyro[2], slip_turning[2], slip_driving[2], following[2], response_time, uneven, sliding[2], frozen[2], odds[2];
    real doubtful[2], course[5], sideways[2], scales[4], margin, share[2], plausible, memory, gains[4], held,
        scatter[5];
    real late[6], delay_fit[8], by_wheels[3], scaled[4], impossible[2], far;
    /* fields for wheels at their speed limit, and for displacements at which the robot stays on its path */
    real astray[2], unsure, doubtful_band, carried[2], short_by[2], short_for, slower, stuck, steady, trial[2];
    real smoothed, slowed, retry, regain[2];
    real on_spot, far_below;
    int wheel_limits;        /* 1 if the speed limit of the wheels is learned */
    real monitor_turn_ratio; /* turn ratio above which the configured tracks count as wrong [-] */
    real monitor_trust;      /* time for which a sensor must agree before it is used again [s] */

    /* prediction of a linear model: twists at the samples, from the current state and the pending commands */
    const real *from_state; /* [N+1][2][n] */
    const real *from_past;  /* [N+1][2][W][2] oldest command first */
    const real *response;   /* [2][2][N+1] of v, omega to v_ref, omega_ref: m samples after a unit command */
    /* last rows of the matrices of twist, mean twist and heading, padded with zeros; all other rows are shifted copies */
    const real *twist_row;       /* [2][2*width] */
    const real *mean_row;        /* [2][2*width] */
    const real *heading_row;     /* [2*width] */
    const real *heading_hessian; /* [2*N][2*N] of the heading errors, for a yaw gain of 1 */

    /* cost */
    const real *along;   /* [N] roots of the weights of the errors at the samples 1 to N */
    const real *across;  /* [N] */
    const real *heading; /* [N] weights */
    real command_weight[2], increment_weight[2];
    real inverse_gain[4], lag_rest[2]; /* feed-forward: column-major; fractional part of the lag [samples] */
    real price, price_slope;           /* linear and quadratic penalty per unit of soft-limit violation */

    /* limits */
    /* maximum commands forward, in reverse, left, right [m/s, rad/s]; slew per sample of increasing |v|, decreasing |v|,
     * increasing |omega|, decreasing |omega|; braking ramp of v and omega per sample */
    real largest_command[4], slew[4], braking[2];
    const real *soft_upper;    /* [K] */
    const real *soft_lower;    /* [K] */
    real half_track;           /* [m] */
    real min_turn_radius;      /* [m]; 0: none */
    real min_commanded_radius; /* [m]; 0: none */

    /* solution */
    real slack;     /* excess over a limit that the active set tolerates */
    int active_set; /* maximum iterations of the active set at a tick; 0: backend only */
    int forced;     /* 1 if the backend solves every tick */
    int max_missed; /* number of consecutive missed deadlines after which the robot brakes; 0: never */

    /* ladder */
    real max_pose_age, dead_reckoning, max_position_error;
    int fence, fence_at_start; /* 1 if there is a fence; 1 if its middle is relative to the start of the reference */
    real fence_middle[3];      /* [m, m, rad] */
    real fence_reach[2];       /* half of length and width, less the margin [m] */
    /* fields of mpc/config/core_thresholds.yaml with these names */
    real fence_play, fence_rest;
    ddmpc_time fence_rolls_on;
    real turn_held_from[2], turn_held_share;
    real finish_position, finish_speed, finish_timeout;
    int max_reused_ticks, resume;
    ddmpc_time resume_within; /* [s] */

    /* bounds within which the robot counts as on its path and on time; otherwise the caller provides the target */
    int reentry;
    real band, heading_band, wait, heading_wait;
    real behind, ahead;     /* [m] a robot further behind or ahead counts as displaced */
    real standing, turning; /* speeds below which a reference counts as standing, or as not turning [m/s, rad/s] */
} ddmpc_constants;

/* User-defined functions. */
typedef struct {
    /* Nonlinear model. step: (x, window, model parameters) to (x+, Jacobian by x, Jacobian by window), with `work` reals
       of memory; output: x to (twist, Jacobian). The pointer of an unused Jacobian is NULL. */
    ddmpc_function step, output;
    const ddmpc_term *terms;
} ddmpc_functions;

/* Message of a sensor. Values that are not numbers are stored as NaN, which the core rejects. */
typedef struct {
    ddmpc_time stamp;
    real value[3];
    real covariance[9]; /* rows of a k x k matrix for k values */
    int present, has_covariance;
} ddmpc_stamped;

/* Requests of the application in addition to the reference. A pause does not count as a failure. After a failure,
   `resume` and `resume_within` determine whether the robot continues. After DDMPC_STOP_AND_WAIT the robot always waits
   for ddmpc_start or ddmpc_resume. */
typedef enum { DDMPC_DRIVE, DDMPC_PAUSE, DDMPC_STOP_AS_FAILURE, DDMPC_STOP_AND_WAIT } ddmpc_request;

/* Input of a tick. `present` and `has_sent` are zero if no new value has arrived. */
typedef struct {
    ddmpc_stamped pose;     /* x, y [m], theta [rad] */
    ddmpc_stamped wheels;   /* v [m/s], omega [rad/s] by encoders and geometric track */
    ddmpc_stamped yaw_rate; /* yaw rate of the gyro [rad/s] */
    real sent[2];           /* command that the robot received in the last tick */
    int has_sent;
    int request;
    /* clock of the reference: its time at this tick [s], and 1 if it equals that of the controller */
    ddmpc_time reference_time;
    int on_time;
    /* bounds of this tick's active set: deadline on the clock of `solve_time` [s], 0: none; maximum number of
     * iterations, 0: as configured */
    ddmpc_time deadline;
    int most_iterations;
    int is_late; /* 1: the tick counts as late, independent of the clock, as in a replay of a late tick */
} ddmpc_input;

/* Reasons for rejecting a measurement; `a` and `b` are numbers for the message. */
typedef enum {
    DDMPC_NO_FAULT,
    DDMPC_NOT_NUMBERS,    /* a value is not finite */
    DDMPC_BAD_COVARIANCE, /* a covariance is not symmetric and positive definite, or too large */
    DDMPC_BAD_STAMP,      /* the stamp is not finite */
    DDMPC_IN_FUTURE,      /* the stamp is in the future by a [s] */
    DDMPC_NOT_NEWER,      /* the stamp is not newer than the previous one */
    DDMPC_TOO_OLD,        /* the age is a [s] */
    DDMPC_TOO_LARGE,      /* a exceeds b */
    DDMPC_JUMPS,          /* a reading jumps from a to b; a pose by a [m] and b [rad] */
    DDMPC_TOO_MANY        /* more messages in a sample than the history can store */
} ddmpc_fault;

typedef enum { DDMPC_OF_WHEELS, DDMPC_OF_YAW_RATE, DDMPC_OF_POSE } ddmpc_subject;

typedef struct {
    real a, b;
    int subject, fault;
} ddmpc_note;

typedef enum {
    DDMPC_TRACKING,    /* the command is the first command of a new plan */
    DDMPC_REUSED_PLAN, /* the solve failed; the command is from the rest of the last valid plan */
    DDMPC_BRAKING,     /* the command ramps to zero */
    DDMPC_STOPPED,     /* the command is zero */
    DDMPC_FINISHED     /* the end of the reference is reached; the command ramps to zero and stays zero */
} ddmpc_mode;

/* Reasons for the result, as bits. */
enum {
    DDMPC_NO_REFERENCE = 1,
    DDMPC_NO_POSE = 2,             /* no pose has arrived yet */
    DDMPC_ELSEWHERE = 4,           /* consecutive poses agree on a position away from the estimate */
    DDMPC_LOST = 8,                /* the estimate is not finite; it restarts */
    DDMPC_OLD_POSE = 16,           /* no pose was accepted for longer than max_pose_age */
    DDMPC_LATCHED = 32,            /* stopped after a failure; call start or resume to continue */
    DDMPC_TOO_FAR = 64,            /* `distance` from the reference exceeds max_position_error */
    DDMPC_SOLVE_FAILED = 128,      /* see the report for the reason */
    DDMPC_NOT_AT_REST = 256,       /* finished by finish_timeout, at `distance` from the end */
    DDMPC_SENT_REJECTED = 512,     /* `sent` is not finite or exceeds the limits */
    DDMPC_HELD = 1024,             /* the application requested a stop */
    DDMPC_TIME_FAULTY = 2048,      /* time is not finite, or runs backwards */
    DDMPC_TIME_REPEATED = 4096,    /* too soon after the last tick; its command is repeated */
    DDMPC_TIME_LEAPT = 8192,       /* no tick for too long: a pause, or a glitch of the clock */
    DDMPC_TIME_PAUSED = 16384,     /* a pause after which the estimate restarts */
    DDMPC_WHEELS_EXCLUDED = 32768, /* the other sensors contradict this sensor, which is not used; see ddmpc_subject */
    DDMPC_YAW_RATE_EXCLUDED = 65536,
    DDMPC_POSE_EXCLUDED = 131072,
    DDMPC_POSES_SCATTER = 262144,    /* poses scatter far more than their covariance states, and have a lower weight */
    DDMPC_POSES_LATE = 524288,       /* poses are older than their stamps */
    DDMPC_TURNS_OTHERWISE = 1048576, /* the turn ratio of the robot contradicts its configured tracks */
    DDMPC_POSES_RARE = 2097152, /* poses are too rare or late for max_pose_age, see `pose_interval`, `pose_latency` */
    DDMPC_POSES_TOO_OLD = 4194304,     /* all poses are older than the history and rejected; see `pose_latency` */
    DDMPC_LEFT_FENCE = 8388608,        /* the stopping path left the fence; call start or reset to continue */
    DDMPC_TURN_HELD = 16777216,        /* the path turns more tightly than the minimum commanded radius allows */
    DDMPC_DEADLINES_MISSED = 134217728 /* `max_missed` consecutive ticks, including this one, missed their deadline */
};

typedef enum {
    DDMPC_QP_SOLVED,
    DDMPC_QP_SOLVED_INACCURATELY, /* solved with a looser tolerance */
    DDMPC_QP_MAX_ITERATIONS,
    DDMPC_QP_TIME_LIMIT,
    DDMPC_QP_INFEASIBLE,
    DDMPC_QP_UNBOUNDED,
    DDMPC_QP_NOT_CONVEX,
    DDMPC_QP_NOT_FINITE, /* the problem's data are not finite, or too large to be plausible */
    DDMPC_QP_NOT_RUN,
    DDMPC_QP_STOPPED,        /* active set stopped at its bounds; only ranges and slew are certainly satisfied */
    DDMPC_QP_STOPPED_IN_TIME /* active set stopped at its deadline; only ranges and slew are certainly satisfied */
} ddmpc_solver_status;

/* Method that produced the plan. */
typedef enum { DDMPC_NO_METHOD, DDMPC_UNLIMITED, DDMPC_ACTIVE_SET, DDMPC_BACKEND } ddmpc_path;

typedef struct {
    int status, path;
    int iterations;  /* iterations of all solves in the tick; 0 without active limits: the solution is then exact */
    int soft_limits; /* 1 if soft limits were active */
    long long operations; /* operations of the active set, counted as in ddmpc_limited_bound */
    real primal_residual, dual_residual;
    int missed; /* consecutive ticks, including this one, whose solve was stopped by the deadline or ended after it */
} ddmpc_report;

enum { DDMPC_NOTES = 8, DDMPC_SENSORS = 4 };

/* Newest estimate. The filter's state consists of the model's states, slip (v_offset, omega_gain, longitudinal_gain,
 * yaw_gain, side_slip, turn_ahead, turn_left, load_shift, slide_x, slide_y; with curved slip also crab, veer,
 * forward_coupling, yaw_coupling, track_growth), gyro bias, delays of v and omega and pose. */
typedef struct {
    real *mean;            /* [n+S+6] */
    real *deviation;       /* [n+S+6] */
    real *twist;           /* [2] of the body, including slip [m/s, rad/s] */
    real *twist_deviation; /* [2] */
    real *innovations;     /* [4] newest squared innovation over its variance, by sensor; NaN: none yet */
    real *pose_age;        /* [1] time since the stamp of the last accepted pose [s] */
    ddmpc_time time;
} ddmpc_estimate;

typedef struct {
    real *command; /* [2] v_ref [m/s], omega_ref [rad/s]; finite and within range and slew */
    int mode;
    unsigned int reasons;
    int has_estimate, has_plan;
    int notes; /* number of rejected measurements */
    ddmpc_note note[DDMPC_NOTES];
    int repeating;      /* excluded sensors that repeat the same reading, as bits 1 << ddmpc_subject */
    int implausible;    /* excluded sensors with impossible readings, as bits */
    real pose_scatter;  /* scatter of poses relative to their stated deviation, see DDMPC_POSES_SCATTER [-] */
    real pose_delay;    /* age of poses at their stamps, see DDMPC_POSES_LATE [s] */
    real pose_interval; /* interval between the stamps of accepted poses, see DDMPC_POSES_RARE [s] */
    real pose_latency;  /* time from a pose's stamp to its arrival, see DDMPC_POSES_RARE and DDMPC_POSES_TOO_OLD [s] */
    real reads[3];      /* turn by gyro, distance and turn by wheels, each divided by that of poses [-]; 0: unknown */
    real direction;     /* angle from the heading of poses to their last direction of motion [rad] */
    real turn_ratio[2]; /* yaw rate ratio of wheels to commands, body to wheels, see DDMPC_TURNS_OTHERWISE [-] */
    ddmpc_report solver;
    ddmpc_time solve_time; /* time to linearise, condense and solve, without a backend; NaN: nothing was solved [s] */
    real distance;         /* [m], see DDMPC_TOO_FAR */
    real reach;            /* maximum rim speed that the wheels attain; infinity if no limit is known [m/s] */
    ddmpc_time gap;        /* time since the last tick [s] */
    ddmpc_estimate estimate;
    /* Plan that contains the command. */
    real *planned_poses;    /* [N+1][3] */
    real *planned_commands; /* [N][2] */
    real *aim;              /* [N+1][4] target poses, and target headings corrected for side-slip */
} ddmpc_result;

/* Deviation of the robot from a reference pose [m, m, rad]; its delay, in units of the lag at which the reference
 * waits; and 1 if the robot is outside the band. */
typedef struct {
    real along, across, heading, late;
    int outside;
} ddmpc_stray;

/* Timed reference, whose function returns pose, twist and arc length at `time`. */
typedef struct {
    void (*sample)(const void *context, ddmpc_time time, real pose[3], real twist[2], real *arc_length);
    const void *context;
    ddmpc_time duration;
} ddmpc_reference;

/* Reference in closed form: table (10, pieces) of arcs or (16, pieces) of cubics, with `pieces` or `pieces` + 1 breaks;
   see mpc/trajectories. It is rotated and then translated by `motion`. */
typedef struct {
    const ddmpc_time *breaks;
    const real *table;
    int pieces, cubic;
    ddmpc_time duration;
    ddmpc_time motion[3];
} ddmpc_trajectory;

/* Nonlinear model in the core: a network on past commands, see network.h. */
int ddmpc_network_step(const real **arguments, real **results, long long *iw, real *w, int memory);
int ddmpc_network_output(const real **arguments, real **results, long long *iw, real *w, int memory);

typedef struct ddmpc_controller ddmpc_controller;

/* Remaining work after a call of ddmpc_step. */
typedef enum {
    DDMPC_DONE,
    DDMPC_NEEDS_TARGET, /* off the path or late: call ddmpc_track or ddmpc_too_far */
    DDMPC_NEEDS_BACKEND /* the active set has not proven a solution: call ddmpc_answer */
} ddmpc_pending;

/* Memory of a controller of these sizes in addition to `ddmpc_controller`: counts of real and int numbers, and the
 * bytes of a history node. */
long ddmpc_reals(const ddmpc_sizes *sizes);
long ddmpc_ints(const ddmpc_sizes *sizes);
unsigned long ddmpc_node_bytes(void);
unsigned long ddmpc_controller_bytes(void);

/* Initialise a controller for a robot at rest, in memory of at least these sizes. Returns 0 if a size is out of
 * bounds. */
int ddmpc_init(ddmpc_controller *controller, const ddmpc_sizes *sizes, const ddmpc_constants *constants,
               const ddmpc_functions *functions, real *reals, int *ints, void *nodes);
/* Replace the constants by constants of the same sizes. The sizes of an export are fixed. */
void ddmpc_configure(ddmpc_controller *controller, const ddmpc_constants *constants);
/* Start to track `reference`, whose time 0 is `t0` [s]. The robot may be moving. Returns 0, and changes nothing, if `t0`
   or the duration is not finite. */
int ddmpc_start(ddmpc_controller *controller, const ddmpc_reference *reference, ddmpc_time t0);
/* Replace the current reference during a drive, for example by a moved copy. Time 0 of `reference` is `t0` [s].
 * Estimate, plan and fence are kept. Returns 0, and changes nothing, if there is no current reference, or if `t0` or the
 * duration is not finite. */
int ddmpc_switch_reference(ddmpc_controller *controller, const ddmpc_reference *reference, ddmpc_time t0);
/* Continue along the reference after a latched failure, see ddmpc_is_latched. */
void ddmpc_resume(ddmpc_controller *controller);
/* Return 1 while the robot waits for ddmpc_start or ddmpc_resume. */
int ddmpc_is_latched(const ddmpc_controller *controller);
/* Reset estimate, plan and commands, for a robot at rest. The reference is kept. */
void ddmpc_reset(ddmpc_controller *controller);
/* Reset the estimate and the plan; pending commands are kept. */
void ddmpc_forget(ddmpc_controller *controller);

/* Replace the last `count` commands by `commands` (count, 2), oldest first, which another node sent to the robot. The
 * estimate, the pending commands and the slew limit of the next tick use the new commands. Returns 0, and changes
 * nothing, if a command is not finite. */
int ddmpc_set_applied_commands(ddmpc_controller *controller, const real *commands, int count);

/* Return 1 if a call at `t` would be a new tick: not too soon after the last tick, not after a pause, and not at an
 * invalid time. */
int ddmpc_is_new_tick(const ddmpc_controller *controller, ddmpc_time t);
/* Compute the command for the tick at `t` [s]; returns the remaining work as a ddmpc_pending. */
int ddmpc_step(ddmpc_controller *controller, ddmpc_time t, const ddmpc_input *input);
/* Continue with a target: `samples` poses (3) and twists (2) from the current tick on, and the share of the limits that
 * the command may use. */
int ddmpc_track(ddmpc_controller *controller, const real *poses, const real *twists, real share);
/* Continue with a robot that is `distance` [m] from its path, which is too far. */
int ddmpc_too_far(ddmpc_controller *controller, real distance);
/* Continue with a backend's solution: `plan` (2 N) and multipliers (4 + K, N) of the limits, positive at upper
 * bounds. */
int ddmpc_answer(ddmpc_controller *controller, const real *plan, const real *multipliers, const ddmpc_report *report);
/* Continue without a target or a solution: the solve counts as failed, and the failure ladder selects the command. */
int ddmpc_give_up(ddmpc_controller *controller);

/* Return the number of reference samples in a target. */
int ddmpc_samples(const ddmpc_controller *controller);
/* Return the result of the tick, valid until the next tick. */
const ddmpc_result *ddmpc_result_of(const ddmpc_controller *controller);
/* Return the stage parameters (N + 1, P) of the user's functions; write to them between two ticks. */
real *ddmpc_parameters(ddmpc_controller *controller);
/* Compare the estimate, which must exist, with a pose (3) with twist (2). */
ddmpc_stray ddmpc_stray_from(const ddmpc_controller *controller, const real *pose, const real *twist);
/* Copy the filter's belief at the newest tick: mean (n+S+6) and covariance (n+S+6, n+S+6), and the commands (W, 2)
 * pending before the command of that tick, oldest first. Returns 0, and writes nothing, without an estimate. */
int ddmpc_newest_belief(const ddmpc_controller *controller, real *mean, real *covariance, real *pending);
/* Predict a belief one sample later without measurements; the last of `commands` (W+1, 2) is sent at the start of the
 * sample. Arrays must not overlap. */
void ddmpc_predict_belief(const ddmpc_controller *controller, const real *commands, real *mean, real *covariance,
                          real *mean_after, real *covariance_after);
/* Return the last sent command, and the pending commands (W, 2), oldest first. */
const real *ddmpc_last_command(const ddmpc_controller *controller);
const real *ddmpc_commands(const ddmpc_controller *controller);

/* The tick's quadratic program: minimise U'HU/2 + g'U + penalty of soft-limit violations. */
typedef struct {
    const real *H;            /* [2*N][2*N] */
    const real *g;            /* [2*N] */
    const real *lower;        /* [4+K][N] by kind: v_ref, omega_ref, their increments, then the kinds of soft limit */
    const real *upper;        /* [4+K][N] */
    const real *guess;        /* [2*N] */
    const real *multipliers;  /* [4+K][N] initial guess */
    const int *active_kinds;  /* [4+K] 1: kind active at the last tick, or violated by the unconstrained minimiser */
    const real *last_command; /* [2] */
    const real *aim;          /* [N+1][4] */
    const real *feed_forward; /* [N][2] */
    const real *ahead;        /* [N] distance of the turning point ahead of the origin on each arc of the guess [m] */
    const real *soft_value;   /* [K][N] values with soft limits for a zero plan, subtracted from the bounds */
    const real *fed_before;   /* [2] feed-forward of the last tick */
    const real *late;         /* [2] delays of the commands in the prediction [samples] */
} ddmpc_program;
/* Return an upper bound of the active set's operations in a tick, from the horizon, the number of kinds of limit
 * (including four hard kinds) and the maximum number of active limits. Operations are multiplications in loops;
 * incomplete blocks count as complete. */
long long ddmpc_operations_bound(int steps, int kinds, int max_active);
ddmpc_program ddmpc_program_of(const ddmpc_controller *controller);
/* Linearise the program of the last tick, which must have a plan, along `plan` [2*N]. The next tick is not affected. */
void ddmpc_linearise_again(ddmpc_controller *controller, const real *plan);
/* Compute the rows (N, 2 N) of one kind of soft limit, from kind 4 on. */
void ddmpc_soft_rows(const ddmpc_controller *controller, int kind, real *rows);
/* Compute the directions of travel (2, N) for radius limits, 1 or -1: of the body at the end of each step, and of the
 * step's command. */
void ddmpc_directions(const ddmpc_controller *controller, real *directions);
/* Set `violated` (4 + K) to 1 for each kind of limit that `plan` violates by more than `margin`. */
void ddmpc_violated_kinds(const ddmpc_controller *controller, const real *plan, real margin, int *violated);

/* Sample a closed-form reference at `times`: pose (count, 3), twist (count, 2), arc length (count). */
void ddmpc_sample(const ddmpc_trajectory *trajectory, const ddmpc_time *times, int count, real *pose, real *twist,
                  real *arc_length);
/* Sample one time with the signature of `ddmpc_reference`. */
void ddmpc_sample_one(const void *trajectory, ddmpc_time time, real pose[3], real twist[2], real *arc_length);

#endif
