/* The controller's tick, from measurement to command: what callers see of it.
 *
 * No allocation, no globals: constants, memory and functions are given by the caller. Python reads this text as it
 * stands, so names and layouts cross the border by themselves; a bracket behind a pointer is the shape of what it points
 * to, and is checked against the sizes:
 *
 *     n states, N steps, W window, H history, P parameters, K kinds of soft limit, S slips, Q parameters of a nonlinear
 *     model, width = 2 N padded to a multiple of 8
 */
#ifndef DDMPC_CORE_H
#define DDMPC_CORE_H

#include "real.h"

/* Sizes of one controller; an export defines them as macros, too, in ddmpc_sizes.h. */
typedef struct {
    int steps;               /* horizon N, at most DDMPC_MOST_STEPS */
    int states;              /* order n of the velocity model, at most DDMPC_MOST_STATES */
    int delay_v, delay_omega; /* dead time of each channel in whole samples; of a nonlinear model 0 */
    int window;              /* W, commands that still act on the future */
    int history;             /* H, ticks that the estimator looks back */
    int lag_v, lag_omega;    /* whole samples by which the feed-forward looks ahead */
    int residuals;           /* rows of the user's residuals at a sample */
    int soft;                /* K, kinds of soft limit: five shipped ones, those of turns, then the user's */
    int terms;               /* functions of the user */
    int parameters;          /* P, stage parameters of all of them */
    int nonlinear;           /* whether the velocity model is a function */
    int turns;               /* kinds of soft limit that keep the least turn radius: 2, or 0 without one */
    int slips;               /* S, slips that are estimated: 10, or with those that curve the twist 15 */
    int model_parameters;    /* Q, numbers that it is given */
    int work;                /* reals of memory that it needs */
    int command_turns;       /* kinds of soft limit that keep the least commanded radius: 2, or 0 without one */
    int spare;               /* samples of unknown delay that a linear model makes up for */
    int pressing;            /* limits that may press at once: as many as there are commands, and soft ones that give way */
} ddmpc_sizes;

/* CasADi's signature: arguments in, results out. */
typedef int (*ddmpc_function)(const real **arguments, real **results, long long *iw, real *w, int memory);

/* A function of (pose, twist, command, reference, parameters) to (value, Jacobian by pose, twist and command). */
typedef struct {
    ddmpc_function function;
    int rows, soft;        /* of its value; whether they are limited, rather than squared and added to the cost */
    int first_parameter;   /* where its own begin among the stage parameters */
} ddmpc_term;

/* What is constant for one controller. */
typedef struct {
    ddmpc_time sample_time, longest_pause;                /* [s] */

    /* velocity model: x+ = A x + B0 u[k - delay] + B1 u[k - delay - 1], (v, omega) = C x */
    const real *A;             /* [n][n] */
    const real *B0;            /* [n][2] */
    const real *B1;            /* [n][2] */
    const real *C;             /* [2][n] */
    const real *mean_output;   /* [2][n] C (1 + A) / 2 */
    const real *settled;       /* [n][2] state after a unit command for ever */
    const real *model_parameters; /* [Q] of a nonlinear model */

    /* estimator */
    const real *noise;         /* [n][n] process noise of one sample */
    real pose_noise[3];
    real prior[18], uncertainty[18], drift[18]; /* of 15 slips, gyro bias and delays: start, its deviation, variance per sample */
    real evidence[4]; /* squared deviations up to which slides, omega gain, delay of v, delay of omega count as noise */
    real doubt[2]; /* variances of the model's own omega gain, and of its lags [s^2] */
    real least_slip[15], most_slip[15];         /* they are never believed beyond */
    real wheel_yaw_ratio;            /* yaw rate by encoders over that of the model */
    real surprise, patience;         /* limit [-], and how long it may last [samples] */
    real min_yaw_rate, min_speed;
    real stamp_history;              /* oldest stamp that is taken [s] */
    real pose_variance[3];           /* where a pose states no covariance */
    real twist_variance[3];          /* wheel speed, wheel yaw rate, yaw rate */
    ddmpc_time sensor_delay[3];      /* by subject: by how much older than its stamp a reading is [s] */
    real sensor_scale[3];            /* reading over what is, with its sign: wheel speed, wheel yaw rate, yaw rate */
    real sensor_heading;             /* by which headings of poses are ahead of the robot [rad] */
    real largest_twist[3], largest_twist_jump[3];
    real largest_position_jump, largest_heading_jump;
    /* see mpc/config/core_thresholds.yaml, by these names */
    ddmpc_time clock_error;
    real largest_variance, largest_asymmetry, sent_rounding;
    int rated_poses;

    /* monitor of the sensors */
    int monitor;                     /* whether it judges */
    real enough;                     /* evidence from which a sensor is given up, in squared deviations */
    /* of the test: see mpc/config/sensor_test.yaml, by these names */
    real windows[3], silence, pose_spacing, latest, lasting, often;
    real gyro[2], slip_turning[2], slip_driving[2], following[2], answer, uneven, sliding[2], frozen[2], odds[2];
    real doubtful[2], course[5], sideways[2], scales[4], margin, share[2], plausible, memory, gains[4], held, scatter[5], late[6], delay_fit[8], by_wheels[3], scaled[4], impossible[2], far;
    /* of wheels at the end of their speed, and of what is no reason to leave the path */
    real astray[2], unsure, doubtful_band, carried[2], short_by[2], short_for, slower, stuck, steady, trial[2], smoothed, slowed, retry, regain[2];
    real on_spot, far_below;
    int wheel_limits;                /* whether the speed at the end of the wheels is learned */
    real monitor_turn_ratio;         /* factor of turning beyond which the tracks are doubted [-] */
    real monitor_trust;              /* how long one has to agree before it is believed again [s] */

    /* prediction of a linear model: twists at the samples, from the state now and the commands on their way */
    const real *from_state;     /* [N+1][2][n] */
    const real *from_past;      /* [N+1][2][W][2] oldest command first */
    const real *response;       /* [2][2][N+1] of v, omega to v_ref, omega_ref: m samples after a unit command */
    /* last rows of the matrices of twist, mean twist and heading, padded with zeros: any other row begins further on */
    const real *twist_row;      /* [2][2*width] */
    const real *mean_row;       /* [2][2*width] */
    const real *heading_row;    /* [2*width] */
    const real *heading_hessian; /* [2*N][2*N] of the heading errors, for a gain of 1 */

    /* cost */
    const real *along;          /* [N] roots of the weights of the errors at the samples 1 to N */
    const real *across;         /* [N] */
    const real *heading;        /* [N] weights */
    real command_weight[2], increment_weight[2];
    real inverse_gain[4], lag_rest[2]; /* feed-forward: column by column; lag beyond the whole samples [samples] */
    real price, price_slope;         /* of each unit beyond a soft limit, exact and quadratic */

    /* limits */
    /* forward, in reverse, left, right [m/s, rad/s]; of v and of omega per sample, for a size that grows and falls; of a
       ramp to zero */
    real largest_command[4], slew[4], braking[2];
    const real *soft_upper;     /* [K] */
    const real *soft_lower;     /* [K] */
    real half_track;            /* [m] */
    real min_turn_radius;     /* [m]; 0: none */
    real min_commanded_radius; /* [m]; 0: none */

    /* solution */
    real slack;                 /* by how much the active set may exceed a limit */
    int active_set;             /* most iterations of the active set at a tick; 0: straight to the backend */
    int forced;                 /* whether the backend is asked at every tick */
    int max_missed;             /* ticks in a row that miss their deadline, from which on the robot brakes; 0: never */

    /* ladder */
    real max_pose_age, dead_reckoning, max_position_error;
    int fence, fence_at_start; /* whether there is one, and whether its middle is seen from where the reference begins */
    real fence_middle[3];      /* [m, m, rad] */
    real fence_reach[2];       /* half of length and width, less the margin [m] */
    /* see mpc/config/core_thresholds.yaml, by these names */
    real fence_play, fence_rest;
    ddmpc_time fence_rolls_on;
    real turn_held_from[2], turn_held_share;
    real finish_position, finish_speed, finish_timeout;
    int max_reused_ticks, resume;
    ddmpc_time resume_within; /* [s] */

    /* when the robot counts as on its path and on time; else somebody else has to say what to track */
    int reentry;
    real band, heading_band, wait, heading_wait;
    real behind, ahead;     /* [m] further behind or ahead than this it was moved */
    real standing, turning; /* slower than this a reference stands, or does not turn [m/s, rad/s] */
} ddmpc_constants;

/* Functions beside the shipped ones. */
typedef struct {
    /* Nonlinear model: (x, window, its parameters) to (x+, its Jacobian by x, and by the window), in memory of `work`
       reals; x to (twist, Jacobian). A Jacobian that is not wanted is NULL. */
    ddmpc_function step, output;
    const ddmpc_term *terms;
} ddmpc_functions;

/* One message. Whatever could not be read as numbers is NaN, and is rejected as such. */
typedef struct {
    ddmpc_time stamp;
    real value[3];
    real covariance[9]; /* rows of a k x k matrix for k values */
    int present, has_covariance;
} ddmpc_stamped;

/* Requests of the application beside the reference. A pause is no failure; after a failure `resume` and `resume_within`
   decide; after the last of these requests the robot waits for ddmpc_start or ddmpc_resume in any case. */
typedef enum { DDMPC_DRIVE, DDMPC_PAUSE, DDMPC_STOP_AS_FAILURE, DDMPC_STOP_AND_WAIT } ddmpc_request;

/* What one tick begins with. Leave `present` and `has_sent` zero where nothing is new. */
typedef struct {
    ddmpc_stamped pose;     /* x, y [m], theta [rad] */
    ddmpc_stamped wheels;   /* v [m/s], omega [rad/s] by encoders and geometric track */
    ddmpc_stamped yaw_rate; /* of the gyro [rad/s] */
    real sent[2];           /* what the robot really got last tick */
    int has_sent;
    int request;
    /* the reference's own clock: its time at this tick [s], and whether it runs with the controller's */
    ddmpc_time reference_time;
    int on_time;
    /* bounds of this tick's active set: by the clock of the solve time [s], 0: none; and iterations, 0: as configured */
    ddmpc_time deadline;
    int most_iterations;
    int is_late; /* the tick counts as one that missed its deadline, whatever the clock says: to repeat one that did */
} ddmpc_input;

/* Why a measurement was rejected; `a` and `b` are the numbers that belong to it. */
typedef enum {
    DDMPC_NO_FAULT,
    DDMPC_NOT_NUMBERS,    /* not finite */
    DDMPC_BAD_COVARIANCE, /* not symmetric and positive definite, or too large */
    DDMPC_BAD_STAMP,      /* not finite */
    DDMPC_IN_FUTURE,      /* by a [s] */
    DDMPC_NOT_NEWER,      /* than the one before */
    DDMPC_TOO_OLD,        /* a [s] */
    DDMPC_TOO_LARGE,      /* a is more than b */
    DDMPC_JUMPS,          /* from a to b; a pose by a [m] and b [rad] */
    DDMPC_TOO_MANY        /* within one sample */
} ddmpc_fault;

typedef enum { DDMPC_OF_WHEELS, DDMPC_OF_YAW_RATE, DDMPC_OF_POSE } ddmpc_subject;

typedef struct {
    real a, b;
    int subject, fault;
} ddmpc_note;

typedef enum {
    DDMPC_TRACKING,    /* the command is the first of a fresh plan */
    DDMPC_REUSED_PLAN, /* the solve failed: the rest of the last good plan */
    DDMPC_BRAKING,     /* ramps to zero */
    DDMPC_STOPPED,     /* zero */
    DDMPC_FINISHED     /* the end of the reference is reached; ramps to zero and stays there */
} ddmpc_mode;

/* Bits that say why. */
enum {
    DDMPC_NO_REFERENCE = 1,
    DDMPC_NO_POSE = 2,               /* none has arrived yet */
    DDMPC_ELSEWHERE = 4,             /* poses agree that the robot is somewhere else */
    DDMPC_LOST = 8,                  /* the estimate is not finite; it starts anew */
    DDMPC_OLD_POSE = 16,             /* no pose was accepted for longer than max_pose_age */
    DDMPC_LATCHED = 32,              /* stopped after a failure; call start or resume to drive on */
    DDMPC_TOO_FAR = 64,              /* from the reference: max_position_error; `distance` says how far */
    DDMPC_SOLVE_FAILED = 128,        /* the report says why */
    DDMPC_NOT_AT_REST = 256,         /* finished by finish_timeout, at `distance` from the end */
    DDMPC_SENT_REJECTED = 512,       /* it is not a command inside the limits */
    DDMPC_HELD = 1024,               /* the application asked it to stand */
    DDMPC_TIME_FAULTY = 2048,        /* not finite, or running backwards */
    DDMPC_TIME_REPEATED = 4096,      /* too soon after the last tick; its command is repeated */
    DDMPC_TIME_LEAPT = 8192,         /* no tick for too long: a pause, or a glitch of the clock */
    DDMPC_TIME_PAUSED = 16384,       /* so long that the estimate starts anew */
    DDMPC_WHEELS_ACCUSED = 32768,    /* the others contradict this sensor, and it is not used; in ddmpc_subject's order */
    DDMPC_YAW_RATE_ACCUSED = 65536,
    DDMPC_POSE_ACCUSED = 131072,
    DDMPC_POSES_SCATTER = 262144,    /* far more than they state; they count for less */
    DDMPC_POSES_LATE = 524288,       /* later than they are stamped */
    DDMPC_TURNS_OTHERWISE = 1048576, /* the robot turns by another factor than its tracks say */
    DDMPC_POSES_RARE = 2097152,      /* too rare and too late for max_pose_age; `pose_interval` and `pose_latency` */
    DDMPC_POSES_TOO_OLD = 4194304,   /* none is accepted: they come later than the history reaches back; `pose_latency` */
    DDMPC_LEFT_FENCE = 8388608,      /* the way to rest left it; call start or reset to drive on */
    DDMPC_TURN_HELD = 16777216,      /* the command is held to the least commanded radius where the path turns tighter */
    DDMPC_DEADLINES_MISSED = 134217728 /* by `max_missed` ticks in a row, this one included */
};

typedef enum {
    DDMPC_QP_SOLVED,
    DDMPC_QP_SOLVED_INACCURATELY, /* only to a looser tolerance */
    DDMPC_QP_MAX_ITERATIONS,
    DDMPC_QP_TIME_LIMIT,
    DDMPC_QP_INFEASIBLE,
    DDMPC_QP_UNBOUNDED,
    DDMPC_QP_NOT_CONVEX,
    DDMPC_QP_NOT_FINITE, /* the problem's data are not finite, or too large to be real */
    DDMPC_QP_NOT_RUN,
    DDMPC_QP_STOPPED,        /* the active set, by iterations, operations or room: ranges and slew are kept */
    DDMPC_QP_STOPPED_IN_TIME /* the same, by the deadline */
} ddmpc_solver_status;

/* The way that led to the plan. */
typedef enum { DDMPC_NO_WAY, DDMPC_UNLIMITED, DDMPC_ACTIVE_SET, DDMPC_BACKEND } ddmpc_path;

typedef struct {
    int status, path;
    int iterations;  /* of all solves of the tick; 0 where no limit is active: that solution is exact */
    int soft_limits; /* whether soft limits took part */
    long long operations; /* of the active set, counted as in ddmpc_limited_bound */
    real primal_residual, dual_residual;
    int missed; /* ticks in a row, this one included, whose solve was cut off by the clock or ended after the deadline */
} ddmpc_report;

enum { DDMPC_NOTES = 8, DDMPC_SENSORS = 4 };

/* The newest estimate; the filter's state is the states, slip (v_offset, omega_gain, longitudinal_gain, yaw_gain,
   side_slip, turn_ahead, turn_left, load_shift, slide_x, slide_y; where it is curved crab, veer, forward_coupling, yaw_coupling,
   track_growth), gyro bias, delays of v and omega and pose. */
typedef struct {
    real *mean;            /* [n+S+6] */
    real *deviation;       /* [n+S+6] */
    real *twist;           /* [2] of the body, slip included [m/s, rad/s] */
    real *twist_deviation; /* [2] */
    real *innovations;     /* [4] newest squared innovation over its variance; NaN: none yet */
    real *pose_age;        /* [1] time since the stamp of the last accepted pose [s] */
    ddmpc_time time;
} ddmpc_estimate;

typedef struct {
    real *command; /* [2] v_ref [m/s], omega_ref [rad/s]; finite and inside range and slew */
    int mode;
    unsigned int reasons;
    int has_estimate, has_plan;
    int notes; /* measurements that were rejected */
    ddmpc_note note[DDMPC_NOTES];
    int repeating;      /* accused sensors that repeat themselves, as bits 1 << ddmpc_subject */
    int unreal;         /* those that give readings that no robot has */
    real pose_scatter;  /* of poses over what they state, see DDMPC_POSES_SCATTER [-] */
    real pose_delay;    /* by which poses are later than stamped, see DDMPC_POSES_LATE [s] */
    real pose_interval; /* between the stamps of accepted poses, see DDMPC_POSES_RARE [s] */
    real pose_latency;  /* from a pose's stamp to its arrival, see DDMPC_POSES_RARE and DDMPC_POSES_TOO_OLD [s] */
    real reads[3];      /* turn by the gyro, way and turn by wheels over those by poses [-]; 0 where not known */
    real direction;     /* angle from the heading of poses to their last way [rad] */
    real turn_ratio[2]; /* turning of wheels over commands and of body over wheels, see DDMPC_TURNS_OTHERWISE [-] */
    ddmpc_report solver;
    ddmpc_time solve_time; /* to linearise, condense and solve, a backend's not counted; NaN: nothing was solved [s] */
    real distance;   /* [m], see DDMPC_TOO_FAR */
    real reach;      /* rim speed beyond which the wheels fall short of what is demanded; infinity: none [m/s] */
    ddmpc_time gap;  /* since the last tick [s] */
    ddmpc_estimate estimate;
    /* The plan that the command comes from. */
    real *planned_poses;    /* [N+1][3] */
    real *planned_commands; /* [N][2] */
    real *aim;              /* [N+1][4] poses that it tracks, and the heading to hold */
} ddmpc_result;

/* How the robot lies to a reference pose; by how much it is late, in units of the lag from which the reference waits;
   whether it is outside the band. */
typedef struct {
    real along, across, heading, late;
    int outside;
} ddmpc_stray;

/* A timed reference; samples pose, twist and arc length at `time`. */
typedef struct {
    void (*sample)(const void *context, ddmpc_time time, real pose[3], real twist[2], real *arc_length);
    const void *context;
    ddmpc_time duration;
} ddmpc_reference;

/* A reference in closed form: (10, pieces) of arcs or (16, pieces) of cubics, with `pieces` or `pieces` + 1 breaks;
   see mpc/trajectories. Turned and then moved by `motion`. */
typedef struct {
    const ddmpc_time *breaks;
    const real *table;
    int pieces, cubic;
    ddmpc_time duration;
    ddmpc_time motion[3];
} ddmpc_trajectory;

/* Nonlinear models that the core brings: a network on past commands, see network.h. */
int ddmpc_network_step(const real **arguments, real **results, long long *iw, real *w, int memory);
int ddmpc_network_output(const real **arguments, real **results, long long *iw, real *w, int memory);

typedef struct ddmpc_controller ddmpc_controller;

/* What a call of ddmpc_step leaves to do. */
typedef enum {
    DDMPC_DONE,
    DDMPC_NEEDS_TARGET, /* off the path or off its time: call ddmpc_track or ddmpc_too_far */
    DDMPC_NEEDS_BACKEND /* no way of our own has proven a solution: call ddmpc_answer */
} ddmpc_pending;

/* Memory that a controller of these sizes needs beside `ddmpc_controller`, in numbers of type real and int, and history
   nodes. */
long ddmpc_reals(const ddmpc_sizes *sizes);
long ddmpc_ints(const ddmpc_sizes *sizes);
unsigned long ddmpc_node_bytes(void);
unsigned long ddmpc_controller_bytes(void);

/* Be as new, for a robot that stands still, in memory of at least those sizes. Returns 0 if a size is out of bounds. */
int ddmpc_init(ddmpc_controller *controller, const ddmpc_sizes *sizes, const ddmpc_constants *constants,
               const ddmpc_functions *functions, real *reals, int *ints, void *nodes);
/* Use other constants of the same sizes from now on. An export keeps its own. */
void ddmpc_configure(ddmpc_controller *controller, const ddmpc_constants *constants);
/* Track `reference` from now on; its time 0 is `t0` [s]. The robot may be moving. Returns 0, and changes nothing, if
   `t0` or the duration is not finite. */
int ddmpc_start(ddmpc_controller *controller, const ddmpc_reference *reference, ddmpc_time t0);
/* Go on along `reference` in the place of the one under way: that one laid elsewhere, or another one. Its time 0 is `t0`
   [s]. Estimate, plan and fence stay. Returns 0, and changes nothing, if there is none under way, or `t0` or the duration
   is not finite. */
int ddmpc_relay(ddmpc_controller *controller, const ddmpc_reference *reference, ddmpc_time t0);
/* Continue along the reference after a failure that left the robot waiting. */
void ddmpc_resume(ddmpc_controller *controller);
/* Return 1 while the robot waits for ddmpc_start or ddmpc_resume. */
int ddmpc_is_latched(const ddmpc_controller *controller);
/* Forget estimate, plan and commands, for a robot that stands still. The reference stays. */
void ddmpc_reset(ddmpc_controller *controller);
/* Forget the estimate and the plan, keep the commands on their way. */
void ddmpc_forget(ddmpc_controller *controller);

/* Take what was sent from `commands` (count, 2), oldest first, in place of the last so many: somebody else decided. The next
   tick builds on them: estimate, what is on its way, slew. Returns 0, and changes nothing, if one is not finite. */
int ddmpc_overrule(ddmpc_controller *controller, const real *commands, int count);

/* Whether a call at `t` would be a new tick: not too soon after the last one, nor after a pause, nor at a faulty time. */
int ddmpc_is_new_tick(const ddmpc_controller *controller, ddmpc_time t);
/* Decide the command for the tick at `t` [s]; see ddmpc_pending for what it may leave to do. */
int ddmpc_step(ddmpc_controller *controller, ddmpc_time t, const ddmpc_input *input);
/* Go on with a target: `samples` poses (3) and twists (2) from now on, and the share of the limits that may be used. */
int ddmpc_track(ddmpc_controller *controller, const real *poses, const real *twists, real share);
/* Go on with the robot too far from its path, by `distance` [m]. */
int ddmpc_too_far(ddmpc_controller *controller, real distance);
/* Go on with what a backend found: `plan` (2 N) and the multipliers (4 + K, N) of the limits, positive at upper bounds. */
int ddmpc_answer(ddmpc_controller *controller, const real *plan, const real *multipliers, const ddmpc_report *report);
/* Go on without a target or an answer: a failed solve, and the ladder acts. */
int ddmpc_give_up(ddmpc_controller *controller);

/* Number of reference samples that a target has. */
int ddmpc_samples(const ddmpc_controller *controller);
/* The result of the tick, valid until the next. */
const ddmpc_result *ddmpc_result_of(const ddmpc_controller *controller);
/* Stage parameters (N + 1, P) of the user's functions; write them between two ticks. */
real *ddmpc_parameters(ddmpc_controller *controller);
/* How the estimate lies to a pose (3) with twist (2); only with an estimate. */
ddmpc_stray ddmpc_stray_from(const ddmpc_controller *controller, const real *pose, const real *twist);
/* The filter's belief at the newest tick: mean (n+S+4) and covariance (n+S+4, n+S+4), and the commands (W, 2) that were on
   their way before that tick's own, oldest first. Returns 0, and writes nothing, if there is no estimate. */
int ddmpc_believed(const ddmpc_controller *controller, real *mean, real *covariance, real *on_their_way);
/* A belief one sample later, if nothing is measured meanwhile; of `commands` (W+1, 2) the last is sent as the sample
   begins. Nothing may lie where something else does. */
void ddmpc_foresee(const ddmpc_controller *controller, const real *commands, real *mean, real *covariance,
                   real *mean_after, real *covariance_after);
/* The last command sent, and the commands (W, 2) on their way, oldest first. */
const real *ddmpc_last_command(const ddmpc_controller *controller);
const real *ddmpc_commands(const ddmpc_controller *controller);

/* The tick's quadratic program: minimise U'HU/2 + g'U + price of what exceeds soft limits. */
typedef struct {
    const real *H;     /* [2*N][2*N] */
    const real *g;     /* [2*N] */
    const real *lower; /* [4+K][N] by kind: v_ref, omega_ref, their increments, then the kinds of soft limit */
    const real *upper; /* [4+K][N] */
    const real *guess; /* [2*N] */
    const real *multipliers; /* [4+K][N] near the solution */
    const int *pressing;     /* [4+K] kinds that pressed at the last tick, or that the minimiser without limits breaks */
    const real *last_command; /* [2] */
    const real *aim;          /* [N+1][4] */
    const real *feed_forward; /* [N][2] */
    const real *ahead;        /* [N] how far ahead of its origin the robot turns on each arc along the guess [m] */
    const real *soft_value;   /* [K][N] of what has soft limits, if the plan were zero: bounds are less this */
    const real *fed_before;   /* [2] feed-forward of the last tick */
    const real *late;         /* [2] delays that the plan reckons with [samples] */
} ddmpc_program;
/* Operations of the active set that no tick exceeds: multiplications of its loops, blocks as whole ones; for a horizon, kinds
   of limit, four of them hard, and limits that may press at once. */
long long ddmpc_operations_bound(int steps, int kinds, int pressing);
ddmpc_program ddmpc_program_of(const ddmpc_controller *controller);
/* The program of the last tick, which has a plan, once more: linearised along `plan` [2*N]. The next tick is unchanged. */
void ddmpc_linearise_again(ddmpc_controller *controller, const real *plan);
/* The rows (N, 2 N) of one kind of soft limit, of kind 4 on. */
void ddmpc_soft_rows(const ddmpc_controller *controller, int kind, real *rows);
/* Directions of travel (2, N), 1 or -1, of the body at the end of each step and of its command, for limits of the radius. */
void ddmpc_directions(const ddmpc_controller *controller, real *directions);
/* Which kinds (4 + K) `plan` exceeds by more than `margin`. */
void ddmpc_broken(const ddmpc_controller *controller, const real *plan, real margin, int *broken);

/* Reference poses in closed form, many at once: pose (count, 3), twist (count, 2), arc length (count). */
void ddmpc_sample(const ddmpc_trajectory *trajectory, const ddmpc_time *times, int count, real *pose, real *twist,
                  real *arc_length);
/* The same as a `ddmpc_reference` samples it. */
void ddmpc_sample_one(const void *trajectory, ddmpc_time time, real pose[3], real twist[2], real *arc_length);

#endif
