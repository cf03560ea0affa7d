/* Internal interface of the parts of the core: sizes, memory, and the steps of a tick. */
#ifndef DDMPC_INTERNAL_H
#define DDMPC_INTERNAL_H

#include "active_set.h"
#include "core.h"
#include "ddmpc_formulas.h"
#include "tile.h"

/* Sizes are fields of a controller. In an export they are constants, so that the compiler can unroll loops. */
#ifdef DDMPC_EXPORT
#define DDMPC_MAX_STEPS DDMPC_STEPS
#define DDMPC_MAX_STATES DDMPC_STATES
#define DDMPC_MAX_WINDOW DDMPC_WINDOW
#define DDMPC_MAX_KINDS (4 + DDMPC_SOFT)
#define STEPS(c) DDMPC_STEPS
#define STATES(c) DDMPC_STATES
#define DELAY(c, channel) ((channel) ? DDMPC_DELAY_OMEGA : DDMPC_DELAY_V)
#define LAG(c, channel) ((channel) ? DDMPC_LAG_OMEGA : DDMPC_LAG_V)
#define WINDOW(c) DDMPC_WINDOW
#define HISTORY(c) DDMPC_HISTORY
#define RESIDUALS(c) DDMPC_RESIDUALS
#define SOFT(c) DDMPC_SOFT
#define TERMS(c) DDMPC_TERMS
#define PARAMETERS(c) DDMPC_PARAMETERS
#define NONLINEAR(c) DDMPC_NONLINEAR
#define TURNS(c) DDMPC_TURNS
#define COMMAND_TURNS(c) DDMPC_COMMAND_TURNS
#define MAX_ACTIVE(c) DDMPC_MAX_ACTIVE
#define DDMPC_MAX_SLIPS DDMPC_SLIPS
#define SLIPS(c) DDMPC_SLIPS
#define WORK(c) DDMPC_WORK
#define SPARE(c) DDMPC_SPARE
#else
/* Maximum sizes, for local arrays and for checks of the configured sizes. */
#define DDMPC_MAX_STEPS 200
#define DDMPC_MAX_STATES 64
#define DDMPC_MAX_WINDOW 512
#define DDMPC_MAX_KINDS 64
#define DDMPC_MAX_SLIPS 15
#define STEPS(c) ((c)->sizes.steps)
#define STATES(c) ((c)->sizes.states)
#define DELAY(c, channel) ((channel) ? (c)->sizes.delay_omega : (c)->sizes.delay_v)
#define LAG(c, channel) ((channel) ? (c)->sizes.lag_omega : (c)->sizes.lag_v)
#define WINDOW(c) ((c)->sizes.window)
#define HISTORY(c) ((c)->sizes.history)
#define RESIDUALS(c) ((c)->sizes.residuals)
#define SOFT(c) ((c)->sizes.soft)
#define TERMS(c) ((c)->sizes.terms)
#define PARAMETERS(c) ((c)->sizes.parameters)
#define NONLINEAR(c) ((c)->sizes.nonlinear)
#define TURNS(c) ((c)->sizes.turns)
#define COMMAND_TURNS(c) ((c)->sizes.command_turns)
#define MAX_ACTIVE(c) ((c)->sizes.max_active)
#define SLIPS(c) ((c)->sizes.slips)
#define WORK(c) ((c)->sizes.work)
#define SPARE(c) ((c)->sizes.spare)
#endif

/* The filter's state: n velocity states, slip, gyro bias, delays and pose. Slips start at n, in the order of the fields
 * of Slip (mpc/problem/slip.py). docs/recipes.md lists the steps to add a slip parameter. */
enum {
    V_OFFSET,
    OMEGA_GAIN,
    LONGITUDINAL_GAIN,
    YAW_GAIN,
    SIDE_SLIP,
    TURN_AHEAD,
    TURN_LEFT,
    LOAD_SHIFT,
    SLIDE_X,
    SLIDE_Y,
    FLAT_SLIPS,
    CRAB = FLAT_SLIPS,
    VEER,
    FORWARD_COUPLING,
    YAW_COUPLING,
    TRACK_GROWTH,
    CURVED_SLIPS
};
/* 1 if the body's twist is a nonlinear function of the model's output, which is then linearised at each sample. */
#define CURVED(c) (SLIPS(c) > FLAT_SLIPS)
#define ROWS(c) (NONLINEAR(c) || CURVED(c))
/* Formula for the number of slips of this controller. */
#define WITH_SLIP(c, name) (CURVED(c) ? ddmpc_f_##name##_curved : ddmpc_f_##name)
#define GYRO_BIAS(c) SLIPS(c)
/* Indices of the unknown delays of v and omega, and of the pose, relative to n. */
#define DELAYS(c) (SLIPS(c) + 1)
#define POSE(c) (SLIPS(c) + 3)
#define BELIEF(c) (STATES(c) + SLIPS(c) + 6)
#define MAX_BELIEF (DDMPC_MAX_STATES + DDMPC_MAX_SLIPS + 6)
#define INPUTS(c) (2 * STEPS(c))
/* Rows of commands are padded with zeros to a multiple of the maximum number of lanes. */
enum { PADDING = 8 };
#define WIDTH(c) ((INPUTS(c) + PADDING - 1) / PADDING * PADDING)
/* Rows of residuals in the stack at each sample: along, across, user-defined residuals, and the heading unless its
 * Hessian is constant. */
#define STACKED(c) (2 + RESIDUALS(c) + ROWS(c))
#define LONGEST_LAG(c) (LAG(c, 0) > LAG(c, 1) ? LAG(c, 0) : LAG(c, 1))
#define SAMPLES(c) (STEPS(c) + 1 + LONGEST_LAG(c) + SPARE(c))
/* Number of stored commands. */
#define COMMANDS(c) (WINDOW(c) + HISTORY(c) + 2)
enum { HARD = 4, BUILT_IN_SOFT = 5, TURN_ROWS = 2, TERM_INPUTS = 7 };
#define KINDS(c) (HARD + SOFT(c))

enum { WHEEL_SPEED, WHEEL_YAW_RATE, YAW_RATE, POSE_SENSOR };
enum {
    MAX_TWISTS = 12, /* maximum readings of wheels and gyro in one tick of the history */
    MAX_POSES = 4,   /* maximum poses in one tick of the history */
    AGREEING = 3     /* number of consecutive poses that agree with each other and override the estimate */
};

typedef struct {
    real *mean;                   /* [Z] */
    real *covariance;             /* [Z][Z] */
    real rate[2];                 /* rate of the model's output over the previous sample [m/s^2, rad/s^2] */
    int surprised[DDMPC_SENSORS]; /* samples since the sensor's innovations exceeded the limit; 0: within the limit */
} ddmpc_belief;

typedef struct {
    ddmpc_time stamp; /* time of the measured motion [s] */
    real value, variance;
    int sensor;
} ddmpc_checked_twist;

typedef struct {
    ddmpc_time stamp, stated; /* time of the measured pose, and the stamp of its message */
    real value[3], covariance[3][3];
    real doubt[2]; /* factors on the prior deviations of position and heading, for an overconfident belief */
} ddmpc_checked_pose;

/* One tick of the history: the belief before and after its measurements. */
typedef struct {
    ddmpc_time time;
    ddmpc_belief prior, posterior;
    ddmpc_checked_pose pose[MAX_POSES];
    ddmpc_checked_twist twist[MAX_TWISTS];
    int poses, twists;
} ddmpc_node;

typedef struct {
    real *commands; /* [COMMANDS][2] sent, newest last */
    real innovations[DDMPC_SENSORS];
    ddmpc_time accepted_stamp, pose_stamp, wheels_stamp, yaw_rate_stamp;
    ddmpc_time pose_interval, pose_latency; /* interval and latency of the last pose that exceeded max_pose_age [s] */
    ddmpc_time too_old;   /* age of the last pose if it was older than the history [s]; 0 after an accepted pose */
    unsigned int overdue; /* bits of the last poses, newest first: 1 if the pose was too late for max_pose_age */
    int rare;             /* 1 if poses are regularly too late */
    real last_wheels[2], last_yaw_rate;
    ddmpc_checked_pose jump_poses[AGREEING];
    int jumps;        /* poses in `jump_poses` */
    int first, nodes; /* start and length of the history, a ring buffer */
    ddmpc_node *node; /* [H] */
} ddmpc_estimator;

/* Integrals of motion: dead reckoning from wheels and gyro [m, rad], and the motion by each single sensor. */
enum { FORWARD, LEFT, HEADING, WHEEL_DISTANCE, WHEEL_TURN, GYRO_TURN, TURNED, MODEL_DISTANCE, MODEL_TURN, MOTIONS };
enum {
    MONITORED = 96,       /* maximum number of stored motions */
    MONITORED_POSES = 36, /* maximum number of stored poses */
    MONITORED_DELAYS = 13 /* number of candidate delays of poses */
};

typedef struct {
    ddmpc_time time;
    real sum[MOTIONS];
} ddmpc_motion;

typedef struct {
    ddmpc_motion motion;
    real value[3];
} ddmpc_stored_pose;

/* Newest reading of a sensor: time of its arrival, start of the uninterrupted arrival, time of the last change, value. */
typedef struct {
    ddmpc_time arrival, first_arrival, last_change;
    real value[2];
} ddmpc_last_reading;

typedef struct {
    ddmpc_motion current, path[MONITORED];   /* a ring of `moves` */
    ddmpc_stored_pose pose[MONITORED_POSES]; /* a ring of `poses` */
    int newest, moves, newest_pose, poses;
    ddmpc_last_reading wheels, gyro;
    real state[DDMPC_MAX_STATES]; /* state of the model without corrections */
    real slip[DDMPC_MAX_SLIPS];   /* earlier estimate of the slip */
    ddmpc_checked_pose last;      /* newest pose; valid if `has_last` */
    ddmpc_motion last_motion;     /* motion up to the newest pose */
    ddmpc_motion frozen;          /* motion up to the first of `same` consecutive equal poses */
    int has_last, same;
    ddmpc_time next_pose;         /* earliest stamp of the next stored pose [s] */
    real residual[3], scatter[2]; /* error of poses relative to dead reckoning; its variance over the stated variance */
    real max_scatter[2];          /* maximum scatter of poses so far, for position and heading */
    int residuals;
    real body_by_wheels[2], body_by_model[2], wheels_by_model[2]; /* turn ratios, each as numerator and denominator */
    real misfit[MONITORED_DELAYS];                                /* misfit of poses for each candidate delay */
    real fit[MONITORED_DELAYS][3], fit_covariance[3][3]; /* fit of the heading of poses minus the gyro's at each delay:
                                                          * offset [rad], bias [rad/s], share of the turn */
    real fits, delay_deviation; /* number of fitted poses, with forgetting; standard deviation of `delay` [s] */
    real gyro_sums[6];       /* weighted sums of 1, turn by poses, turn by the gyro, both squared, and their product */
    ddmpc_time uncertain_at; /* last time at which the delay was uncertain [s] */
    ddmpc_time delay;        /* age of poses at their stamps, estimated from motion [s] */
    int is_diverging;        /* 1 if poses and gyro start to differ */
    ddmpc_time slipped_at,
        blocked_at;     /* times of the last wheel slip, and of the last pose at rest despite a command [s] */
    real impossible[2]; /* recent impossible readings of wheels and gyro, with forgetting */
    real turning[2];    /* sums of gyro times wheels while wheels follow the commands: signed, absolute [rad^2/s] */
    real direction, direction_weight; /* mean angle from the heading of poses to their course [rad], and its weight */
    real turn_difference;             /* total turn of the gyro minus total turn of the poses [rad] */
    real anchor[3]; /* direction, its variance and `turn_difference` at an earlier course, valid if `has_anchor` */
    int has_anchor;
    /* evidence of the course in squared deviations, > 0 in favour of poses, < 0 of the gyro; its value at the anchor */
    real course_evidence, anchor_evidence;
    /* sums over windows: commanded distance squared, times that of wheels, times that of poses [m^2]; absolute
     * commanded distance [m]; turns by poses squared, and times those by wheels [rad^2] */
    real wheel_sums[6];
    int contradictions[3];                                /* number of consecutive contradictions, by subject */
    ddmpc_time contradiction_start[3], agreement_time[3]; /* [s]; time without a contradiction [s] */
    int excluded, repeating, implausible;                 /* bits 1 << subject, see the fields of ddmpc_result */
} ddmpc_monitor;

/* Response of a linear model to a plan, as in the fields of ddmpc_constants with these names. */
typedef struct {
    const real *response, *twist, *mean, *heading, *heading_hessian;
} ddmpc_response;

/* The tick's problem, linearised along the guess. */
typedef struct {
    real pose[3], slip[DDMPC_MAX_SLIPS], last[2];
    real late[2]; /* delays of the commands in the prediction [samples] */
    real *late_response, *late_twist, *late_mean, *late_heading, *late_hessian; /* response with the delays `late` */
    int is_stale;             /* 1 if `late_hessian` was computed for other delays */
    real gains[2], turn_gain; /* derivatives of the body's v and omega by the model's, and of the body's v by omega */
    real *free_twist;         /* [N+1][2] twist of the body for a zero plan */
    real *ahead;              /* [N] turning point of each arc along the guess [m] */
    real *aim;                /* [N+1][4] */
    real *feed_forward;       /* [N][2] */
    real fed_before[2];       /* feed-forward of the last tick, computed with the slip of this tick */
    real *free_output;        /* [N+1][2] output of the model for a zero plan */
    real *by_plan;            /* [2][N+1] effect of a plan on the model's output */
    /* For a nonlinear model or curved slip: rows of twist, mean twist and heading at each sample, states and
     * Jacobians. */
    real *twist_rows;   /* [N+1][2][width] */
    real *mean_rows;    /* [N][2][width] */
    real *heading_rows; /* [N+1][width] */
    real *model_output; /* [N+1][2] output of a linear model with curved slip for a zero plan */
    real *sensitivity;  /* [2][n][width] */
    real *by_window;    /* [n][2(W+1)] Jacobian of a step, in column-major order */
    real *held;         /* [2(W+1)] window of a constant command */
    real *work;         /* memory for the model's step */
    real *settling;     /* [n+2][n+5] equations of a Newton step */
    real *poses;        /* [N+1][3] along the guess */
    real *arc; /* [8][N] displacement x, y of each arc; gradients of x and of y by the model's twist and heading */
    real *cosine, *sine; /* [N] cosine and sine of the path's heading at the samples 1 to N */
    real *stack;         /* [N STACKED][width] weighted rows of the residuals */
    real *position;      /* [N][2][width] rows of x and y */
    real *moves;         /* [2][width] */
    real *gradient;      /* [width] */
    real *soft_value;    /* [K][N] values with soft limits for a zero plan */
    real *soft_gradient; /* [K][N][7] derivatives by pose, model output and command */
    real *term;          /* [8 K or 8 R] value and gradient of a user function */
    real *H, *g;         /* [2N][2N], [2N] */
    real *lower, *upper; /* [4+K][N] */
    real *guess;         /* [2N] */
    real *minimiser;     /* [2N] minimiser without limits */
    real *factor;        /* [2N][2N] R of H = R'R, upper triangular */
    real *multipliers;   /* [4+K][N] of the last tick, shifted by one step */
    real *values;        /* [4+K][N] */
    real *plan;          /* [2N] */
    int *active_kinds;   /* [4+K] see ddmpc_program */
    int has_guess;
} ddmpc_problem;

struct ddmpc_controller {
    ddmpc_sizes sizes;
    const ddmpc_constants *constants;
    ddmpc_functions functions;
    ddmpc_estimator estimator;
    ddmpc_monitor monitor;
    ddmpc_problem problem;
    ddmpc_limited_memory limited;
    ddmpc_reference reference;
    ddmpc_time t0;
    /* clock of the ticks */
    ddmpc_time last_tick, leap;
    int has_last_tick, has_leap;
    /* ladder */
    real last[2];    /* last command, to which slew is relative */
    real *last_plan; /* [2N] last valid plan */
    int plan_age;    /* ticks since it was computed; -1: no plan */
    int has_reference, has_result, has_driven, latched, finished, pending;
    int is_outage;               /* 1 if this tick brakes because measurements are missing */
    ddmpc_time sound_tick;       /* time of the last tick without such an outage [s] */
    ddmpc_time deadline;         /* deadline of this tick's solve, see ddmpc_input; infinite: none */
    int max_iterations, is_late; /* see ddmpc_input */
    int missed;                  /* see ddmpc_report */
    real share;
    /* fence */
    real fence[3]; /* centre of the fence in the frame of poses [m, m, rad] */
    real allowed;  /* permitted distance outside the fence: the minimum since the start [m] */
    int left_fence;
    real rim[2];                    /* smoothed speeds of the right and left wheels by their encoders [m/s] */
    int saturated_wheel;            /* index of the wheel that is slower than its demand */
    real trial_demand, trial_speed; /* demand and speed of `saturated_wheel` at the start of the deficit [m/s] */
    real carried;                   /* tolerated displacement after turns on the spot [m] */
    real known, doubt;     /* position variance at the last recent pose [m^2]; uncertainty added since, in bands [-] */
    int on_spot;           /* 1 while the reference turns on the spot */
    real reach, rim_reach; /* permitted rim speed of the wheels, and the speed that they attained [m/s] */
    real slowed;           /* time for which the reference has been slowed down since `rim_reach` was learned [s] */
    real *parameters;      /* [N+1][P] */
    real *reference_pose;  /* [SAMPLES][3] */
    real *reference_twist; /* [SAMPLES][2] */
    ddmpc_result result;
};

/* checks.c */
void ddmpc_reject(ddmpc_result *result, int subject, int fault, real a, real b);
int ddmpc_check_pose(ddmpc_controller *c, ddmpc_time t, const ddmpc_stamped *pose, ddmpc_checked_pose *checked);
/* Check wheels or gyro; return the number of checked readings, or 0 with a note if they are unusable. */
int ddmpc_check_wheels(ddmpc_controller *c, ddmpc_time t, const ddmpc_stamped *wheels, ddmpc_checked_twist checked[2]);
int ddmpc_check_yaw_rate(ddmpc_controller *c, ddmpc_time t, const ddmpc_stamped *rate, ddmpc_checked_twist checked[1]);
/* Return 1 if `pose` is near the pose `expected`; otherwise store `pose` as a jump, with a note. */
int ddmpc_pose_passes(ddmpc_controller *c, const ddmpc_checked_pose *pose, const real expected[3]);
/* Accept `pose`, which clears the stored jumps. */
void ddmpc_accept_pose(ddmpc_controller *c, const ddmpc_checked_pose *pose);

/* velocity.c: the velocity model over one sample. */
/* Compute x+ for the command window that ends at `newest` (2), with older commands before it in memory. For a linear
 * model the commands have the extra `delays` (2) [s]; NULL: no extra delay. On request, compute also the Jacobian by x (n, n)
 * in row-major order, and for a nonlinear model the Jacobian by the window in column-major order. */
void ddmpc_velocity_step(const ddmpc_controller *c, const real *x, const real *newest, const real *delays,
                         real *next_state, real *by_state, real *by_window);
/* Compute the gradient (n, 2) of x+ by `delays`. */
void ddmpc_velocity_by_delay(const ddmpc_controller *c, const real *newest, const real *delays, real *by_delay);
/* Interpolate the command of one channel that was sent `samples` before the newest one at `sent`. */
real ddmpc_delayed(const real *sent, real samples);
/* Steady state of a nonlinear model: output, state, command, and derivatives of state and command by the output; all
 * zero at first and after a failed search. */
typedef struct {
    real output[2], state[DDMPC_MAX_STATES], command[2], by_output[2 * (DDMPC_MAX_STATES + 2)];
    int exists;
} ddmpc_settled;
/* Find the steady state with the output `target` near the last steady state. Returns 0 if no such state is found. */
int ddmpc_velocity_settle(const ddmpc_controller *c, const real target[2], ddmpc_settled *settled);
/* Compute (v, omega) of the model, and its gradient (2, n) in row-major order. */
void ddmpc_velocity_output(const ddmpc_controller *c, const real *x, real y[2], real *gradient);

/* filter.c */
void ddmpc_filter_twist(const ddmpc_controller *c, const real *mean, real twist[2]);
void ddmpc_filter_twist_deviation(const ddmpc_controller *c, const ddmpc_belief *belief, real deviation[2]);
void ddmpc_filter_pose_at(const ddmpc_controller *c, const ddmpc_belief *belief, real ahead, real pose[3]);
/* Predict one sample with the commands up to `newest`: the mean (Z) alone, or the full belief. */
void ddmpc_filter_carry(const ddmpc_controller *c, const real *mean, const real *newest, real *next_mean);
void ddmpc_filter_predict(const ddmpc_controller *c, const ddmpc_belief *belief, const real *newest,
                          ddmpc_belief *prediction);
/* Correct a belief by a reading of wheels or gyro, or by a pose, measured `ahead` [s] after the belief's time. Returns
 * the squared innovation over its variance. */
real ddmpc_filter_correct_twist(const ddmpc_controller *c, ddmpc_belief *belief, const ddmpc_checked_twist *twist,
                                real ahead);
real ddmpc_filter_correct_pose(const ddmpc_controller *c, ddmpc_belief *belief, const ddmpc_checked_pose *pose,
                               real ahead);
/* Clip gains, curved slip and delays of the state `z` to their bounds. */
void ddmpc_filter_bound(const ddmpc_controller *c, real *z);
void ddmpc_filter_place(const ddmpc_controller *c, ddmpc_belief *belief, const ddmpc_checked_pose *pose);
void ddmpc_copy_belief(const ddmpc_controller *c, ddmpc_belief *to, const ddmpc_belief *from);

/* estimator.c */
enum { READY = 1, MOVED = 2 };
void ddmpc_estimator_clear(ddmpc_controller *c);
void ddmpc_estimator_forget(ddmpc_controller *c);
void ddmpc_estimator_append(ddmpc_controller *c, const real command[2]);
void ddmpc_estimator_correct_last(ddmpc_controller *c, const real command[2]);
/* Replace the newest `count` commands, or as many as are stored. */
void ddmpc_estimator_replace_commands(ddmpc_controller *c, const real *commands, int count);
int ddmpc_estimator_correct_sent(ddmpc_controller *c, const real sent[2]);
void ddmpc_estimator_advance(ddmpc_controller *c, ddmpc_time t);
int ddmpc_estimator_update(ddmpc_controller *c, ddmpc_time t, const ddmpc_input *input);
int ddmpc_estimator_state(const ddmpc_controller *c);
const real *ddmpc_estimator_slip(const ddmpc_controller *c);
int ddmpc_estimator_restart_elsewhere(ddmpc_controller *c);
void ddmpc_estimator_estimate(ddmpc_controller *c);

/* fence.c */
/* Reset the fence: the robot counts as inside. */
void ddmpc_fence_clear(ddmpc_controller *c);
/* Place the fence for a new reference. */
void ddmpc_fence_place(ddmpc_controller *c);
/* Return 1 if the robot is inside the fence and would come to rest inside; requires an estimate. */
int ddmpc_fence_is_respected(ddmpc_controller *c);

/* sensor_test.c */
void ddmpc_monitor_clear(ddmpc_controller *c);
/* Predict one sample from the sent commands, for an undisturbed robot. */
void ddmpc_monitor_predict(ddmpc_controller *c, const real *newest);
/* Integrate the motion up to `t` from wheels and gyro; the first `wheels` of the `twists` readings are from the wheels. */
void ddmpc_monitor_move(ddmpc_controller *c, ddmpc_time t, const ddmpc_checked_twist *twist, int wheels, int twists);
/* Update a sensor's count of impossible readings, with forgetting; `impossible` is 1 for such a reading. */
void ddmpc_monitor_count(ddmpc_controller *c, int subject, int impossible);
int ddmpc_monitor_doubtful_sensors(const ddmpc_controller *c, ddmpc_time t);
/* Compare all sensors over the motion up to a pose; return the newly excluded sensors, as bits by subject. */
int ddmpc_monitor_check_pose(ddmpc_controller *c, const ddmpc_checked_pose *pose);
/* Enlarge the covariance of a pose if the stated covariance is far too small. */
void ddmpc_monitor_enlarge_covariance(ddmpc_controller *c, ddmpc_checked_pose *pose);
/* Return the age of poses at their stamps [s]. */
ddmpc_time ddmpc_monitor_delay(const ddmpc_controller *c);
/* Write the state of the sensor test to the result. */
void ddmpc_monitor_report(ddmpc_controller *c);

/* linearise.c, condense.c, limits.c: the tick's problem, in this order. */
void ddmpc_problem_begin(ddmpc_controller *c);
void ddmpc_problem_guess(ddmpc_controller *c);
void ddmpc_problem_linearise(ddmpc_controller *c);
void ddmpc_problem_condense(ddmpc_controller *c);
void ddmpc_problem_limit(ddmpc_controller *c);
/* Compute the interval that a command can reach in one sample: its absolute value grows by at most step[0] and falls by
 * at most step[1]. A command that passes zero grows during the rest of the sample. */
void ddmpc_reach(real last, const real step[2], real interval[2]);
/* Return the maximum command of a channel in either direction [m/s, rad/s]. */
real ddmpc_fastest(const ddmpc_constants *k, int channel);
/* Compute the poses under `plan`, by exact arcs. */
void ddmpc_problem_poses(ddmpc_controller *c, const real *plan, real *poses);

/* Compute the part of the limited values (4 + K, N) that is linear in `plan`, or one row of its matrix; `context` is the
 * controller. */
void ddmpc_limit_values(const void *context, const real *plan, real *values);
void ddmpc_limit_row(const void *context, int index, real *row, int *first, int *last);

/* ladder.c */
/* Use the plan of the solver, or the next step of the failure ladder if the plan is unusable; returns DDMPC_DONE. */
int ddmpc_use_plan(ddmpc_controller *c);
/* Use the rest of the last valid plan for a few ticks, then brake. */
int ddmpc_reuse(ddmpc_controller *c);
/* Kind of a stop, which determines when the robot continues by itself: always; only with `resume`; only within
 * `resume_within`; or not before ddmpc_start or ddmpc_resume. */
typedef enum { DDMPC_NO_FAILURE, DDMPC_FAILURE, DDMPC_OUTAGE, DDMPC_WAITS } ddmpc_stop;
/* Ramp the command to zero for `reason`. */
int ddmpc_brake(ddmpc_controller *c, unsigned int reason, ddmpc_stop stop);
void ddmpc_ramp(ddmpc_controller *c);
/* Set the command to zero immediately, without a ramp. */
void ddmpc_stand(ddmpc_controller *c);

/* wheel_watch.c */
void ddmpc_watch_wheels(ddmpc_controller *c);

/* solve.c */
/* Solve without limits, then with the active set; return DDMPC_DONE or DDMPC_NEEDS_BACKEND, with the report filled. */
int ddmpc_solve(ddmpc_controller *c);
void ddmpc_solver_reset(ddmpc_controller *c);

#endif
