/* What the parts of the core share: sizes, memory, and the steps of a tick. */
#ifndef DDMPC_INTERNAL_H
#define DDMPC_INTERNAL_H

#include "active_set.h"
#include "core.h"
#include "ddmpc_formulas.h"
#include "tile.h"

/* Sizes are numbers that come with a controller; an export knows them when it is compiled, and is quicker for it. */
#ifdef DDMPC_EXPORT
#define DDMPC_MOST_STEPS DDMPC_STEPS
#define DDMPC_MOST_STATES DDMPC_STATES
#define DDMPC_MOST_WINDOW DDMPC_WINDOW
#define DDMPC_MOST_KINDS (4 + DDMPC_SOFT)
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
#define PRESSING(c) DDMPC_PRESSING
#define DDMPC_MOST_SLIPS DDMPC_SLIPS
#define SLIPS(c) DDMPC_SLIPS
#define WORK(c) DDMPC_WORK
#define SPARE(c) DDMPC_SPARE
#else
/* The most that is held: for local memory, and for bounds on what is given. */
#define DDMPC_MOST_STEPS 200
#define DDMPC_MOST_STATES 64
#define DDMPC_MOST_WINDOW 512
#define DDMPC_MOST_KINDS 64
#define DDMPC_MOST_SLIPS 15
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
#define PRESSING(c) ((c)->sizes.pressing)
#define SLIPS(c) ((c)->sizes.slips)
#define WORK(c) ((c)->sizes.work)
#define SPARE(c) ((c)->sizes.spare)
#endif

/* The filter's state: n velocity states, slip, the gyro's bias and the pose; slips are counted from n, in the order of the
   fields of Slip (mpc/problem/slip.py). What to touch for another one: docs/recipes.md. */
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
/* Whether the body's twist is curved in what the model says; then rows are linearised at each sample. */
#define CURVED(c) (SLIPS(c) > FLAT_SLIPS)
#define ROWS(c) (NONLINEAR(c) || CURVED(c))
/* A formula for the slip that this controller has. */
#define WITH_SLIP(c, name) (CURVED(c) ? ddmpc_f_##name##_curved : ddmpc_f_##name)
#define GYRO_BIAS(c) SLIPS(c)
/* Delays of v and omega that the model lacks, and the pose. */
#define DELAYS(c) (SLIPS(c) + 1)
#define POSE(c) (SLIPS(c) + 3)
#define BELIEF(c) (STATES(c) + SLIPS(c) + 6)
#define MOST_BELIEF (DDMPC_MOST_STATES + DDMPC_MOST_SLIPS + 6)
#define INPUTS(c) (2 * STEPS(c))
/* Rows of commands are padded with zeros, to whole lanes on every machine. */
enum { PADDING = 8 };
#define WIDTH(c) ((INPUTS(c) + PADDING - 1) / PADDING * PADDING)
/* Rows of residuals in the stack at each sample: along, across, the user's, and with rows of its own the heading. */
#define STACKED(c) (2 + RESIDUALS(c) + ROWS(c))
#define LONGEST_LAG(c) (LAG(c, 0) > LAG(c, 1) ? LAG(c, 0) : LAG(c, 1))
#define SAMPLES(c) (STEPS(c) + 1 + LONGEST_LAG(c) + SPARE(c))
/* Commands that are remembered. */
#define COMMANDS(c) (WINDOW(c) + HISTORY(c) + 2)
enum { HARD = 4, SHIPPED_SOFT = 5, TURN_ROWS = 2, TERM_INPUTS = 7 };
#define KINDS(c) (HARD + SOFT(c))

enum { WHEEL_SPEED, WHEEL_YAW_RATE, YAW_RATE, POSE_SENSOR };
enum {
    MOST_TWISTS = 12, /* numbers of wheels and gyro that one tick of the history holds */
    MOST_POSES = 4,   /* poses that it holds */
    AGREEING = 3      /* poses in a row that contradict the estimate but agree with each other are no outliers */
};

typedef struct {
    real *mean;        /* [Z] */
    real *covariance;  /* [Z][Z] */
    real rate[2];      /* change of the model's output over the sample before, by time [m/s^2, rad/s^2] */
    int surprised[DDMPC_SENSORS]; /* samples since the sensor's innovations have been too large; 0: they are not */
} ddmpc_belief;

typedef struct {
    ddmpc_time stamp; /* instant of the motion that it tells [s] */
    real value, variance;
    int sensor;
} ddmpc_checked_twist;

typedef struct {
    ddmpc_time stamp, stated; /* when it was true, and what its message says of that */
    real value[3], covariance[3][3];
    real doubt[2]; /* by how much the belief before it was too sure of position and heading, in deviations */
} ddmpc_checked_pose;

/* One tick of the history: the belief before and after its measurements. */
typedef struct {
    ddmpc_time time;
    ddmpc_belief prior, posterior;
    ddmpc_checked_pose pose[MOST_POSES];
    ddmpc_checked_twist twist[MOST_TWISTS];
    int poses, twists;
} ddmpc_node;

typedef struct {
    real *commands; /* [COMMANDS][2] sent, newest last */
    real innovations[DDMPC_SENSORS];
    ddmpc_time accepted_stamp, pose_stamp, wheels_stamp, yaw_rate_stamp;
    ddmpc_time pose_interval, pose_latency; /* of the last pose that came too late for max_pose_age */
    ddmpc_time too_old;                     /* age of the pose that the history did not reach; 0 once one is accepted */
    unsigned int overdue;                   /* which of the last poses came too late for max_pose_age, newest first */
    int rare;                               /* whether that is how they come */
    real last_wheels[2], last_yaw_rate;
    ddmpc_checked_pose jumped[AGREEING];
    int jumps;        /* poses in `jumped` */
    int first, nodes; /* of the history, a ring */
    ddmpc_node *node; /* [H] */
} ddmpc_estimator;

/* Sums of motion since some instant: dead reckoning by wheels and gyro [m, rad], and what each says of its own. */
enum { FORWARD, LEFT, HEADING, WHEEL_DISTANCE, WHEEL_TURN, GYRO_TURN, TURNED, MODEL_DISTANCE, MODEL_TURN, MOTIONS };
enum {
    MONITORED = 96,       /* instants at which the monitor keeps the motion */
    MONITORED_POSES = 36, /* poses that it keeps */
    MONITORED_DELAYS = 13 /* delays of poses that it weighs */
};

typedef struct {
    ddmpc_time time;
    real sum[MOTIONS];
} ddmpc_motion;

typedef struct {
    ddmpc_motion then;
    real value[3];
} ddmpc_seen_pose;

/* A sensor's newest value, when it came, since when it has come without a pause, and when it last changed. */
typedef struct {
    ddmpc_time heard, since, changed;
    real value[2];
} ddmpc_hearing;

typedef struct {
    ddmpc_motion now, path[MONITORED];     /* a ring of `moves` */
    ddmpc_seen_pose pose[MONITORED_POSES]; /* a ring of `poses` */
    int newest, moves, newest_pose, poses;
    ddmpc_hearing wheels, gyro;
    real state[DDMPC_MOST_STATES];  /* of the model that nobody corrects */
    real slip[DDMPC_MOST_SLIPS];                /* as it was a while ago */
    ddmpc_checked_pose last;        /* if one was `seen` */
    ddmpc_motion last_motion;       /* up to it */
    ddmpc_motion frozen;            /* up to the first pose that is like it; `same` came since */
    int seen, same;
    ddmpc_time next_pose;           /* when one is kept again */
    real residual[3], scatter[2];   /* of poses against dead reckoning; their variance over the one stated */
    real widest[2]; /* the widening of poses so far */
    int residuals;
    real body_by_wheels[2], body_by_model[2], wheels_by_model[2]; /* of turning, as quotients of sums */
    real misfit[MONITORED_DELAYS];  /* of poses, were they so late */
    real fit[MONITORED_DELAYS][3], fit_covariance[3][3]; /* heading of poses less the gyro's at that delay: offset [rad], bias [rad/s], share of the turn */
    real fits, delay_deviation;     /* fitted poses, older ones count less; standard deviation of the delay below [s] */
    real spread[6];                 /* weights of turns, times those by poses, by the gyro, both squared, and their product */
    ddmpc_time unsure;              /* when the delay was last not sure [s] */
    ddmpc_time delay;               /* by which they are later than stamped, as far as motion says so [s] */
    int creeping;                   /* whether poses and gyro begin to differ */
    ddmpc_time slipped, stood;      /* when wheels last slipped; when poses last said that it stands though it is told to move */
    real impossible[2];             /* readings of wheels and gyro that no robot has, of late */
    real turning[2];                /* sums of gyro times wheels while these turn as told, with sign and by size [rad^2/s] */
    real direction, directed;       /* mean angle from the heading of poses to their way [rad], and its weights */
    real apart, anchor[3];          /* turn of the gyro less that of poses in all [rad]; direction, its variance and that turn at an earlier course */
    int anchored;
    real witness, settled;          /* squared deviations by which the course tells that the heading of poses is right, below 0 the gyro; up to the anchor */
    real went[6];                   /* sums over windows: of the way told, squared, and times that of wheels and poses [m^2]; its size [m]; of turns by
                                       poses, squared, and times those by wheels [rad^2] */
    int contradictions[3];          /* in a row, by subject */
    ddmpc_time since[3], agreed[3]; /* when they began [s], for how long there have been none [s] */
    int accused, repeating, unreal; /* bits 1 << subject */
} ddmpc_monitor;

/* Response of a linear model to a plan; see the fields of ddmpc_constants with these names. */
typedef struct {
    const real *response, *twist, *mean, *heading, *heading_hessian;
} ddmpc_response;

/* The tick's problem, linearised along the guess. */
typedef struct {
    real pose[3], slip[DDMPC_MOST_SLIPS], last[2];
    real late[2]; /* delays that the plan reckons with [samples] */
    real *late_response, *late_twist, *late_mean, *late_heading, *late_hessian; /* response with these delays */
    int is_stale; /* 1 if `late_hessian` belongs to other delays */
    real gains[2], turn_gain; /* of the body's v and omega by the model's; of its v by the model's omega */
    real *free_twist;   /* [N+1][2] of the body, if the plan were zero */
    real *ahead;        /* [N] turning point of each arc along the guess [m] */
    real *aim;          /* [N+1][4] */
    real *feed_forward; /* [N][2] */
    real fed_before[2]; /* feed-forward of the last tick, by the slip of this one */
    real *free_output;  /* [N+1][2] of the model, if the plan were zero */
    real *by_plan;      /* [2][N+1] what a plan adds to that */
    /* Of a nonlinear model or curved slip: rows of twist, mean twist and heading at each sample, and its states and Jacobians. */
    real *twist_rows;   /* [N+1][2][width] */
    real *mean_rows;    /* [N][2][width] */
    real *heading_rows; /* [N+1][width] */
    real *said;         /* [N+1][2] of a linear model with curved slip, if the plan were zero */
    real *sensitivity;  /* [2][n][width] */
    real *by_window;     /* [n][2(W+1)] Jacobian of a step, column by column */
    real *held;          /* [2(W+1)] a command for ever */
    real *work;          /* memory of the model's step */
    real *settling;      /* [n+2][n+5] what a Newton step solves */
    real *poses;        /* [N+1][3] along the guess */
    real *arc;          /* [8][N] displacement of each arc; its gradient by the model's twist and heading: of x, of y */
    real *cosine, *sine; /* [N] of the path's heading at the samples 1 to N */
    real *stack;        /* [N STACKED][width] weighted rows of the residuals */
    real *position;     /* [N][2][width] rows of x and y */
    real *moves;        /* [2][width] */
    real *gradient;     /* [width] */
    real *soft_value;   /* [K][N] of what has soft limits, if the plan were zero */
    real *soft_gradient; /* [K][N][7] by pose, what the model says, and command */
    real *term;         /* [8 K or 8 R] what a function of the user gives */
    real *H, *g;        /* [2N][2N], [2N] */
    real *lower, *upper; /* [4+K][N] */
    real *guess;        /* [2N] */
    real *minimiser;    /* [2N] without limits */
    real *factor;       /* [2N][2N] R of H = R'R, upper triangular */
    real *multipliers;  /* [4+K][N] at the last tick, a step ahead */
    real *values;       /* [4+K][N] */
    real *plan;         /* [2N] */
    int *pressing;      /* [4+K] */
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
    real last[2];         /* the command that slew counts from */
    real *kept;           /* [2N] the last good plan */
    int plan_age;         /* ticks since it was made; -1: there is none */
    int has_reference, has_result, has_driven, latched, finished, pending;
    int is_outage;         /* 1 while this tick brakes for want of measurements */
    ddmpc_time sound_tick; /* time of the last tick that did not [s] */
    ddmpc_time deadline; /* of this tick's solve, see ddmpc_input; infinite: none */
    int most_iterations, is_late; /* see ddmpc_input */
    int missed;          /* see ddmpc_report */
    real share;
    /* fence */
    real fence[3]; /* its middle in the frame of poses [m, m, rad] */
    real allowed;  /* how far outside the robot may be: where it was least far since it started [m] */
    int left_fence;
    real rim[2];           /* smoothed speeds of the right and left wheels by their encoders [m/s] */
    int short_one;         /* the wheel that falls short of what is asked */
    real tried, tried_speed; /* what it was asked when that began, and its speed then [m/s] */
    real carried;          /* by which it may be off its path, or late, after turns on the spot [m] */
    real known, doubt;     /* variance of the position by the last fresh pose [m^2]; what is lost of it since, in bands [-] */
    int on_spot;           /* 1 while the reference turns on the spot */
    real reach, rim_reach; /* rim speed of the wheels that may be demanded, and that they attained [m/s] */
    real slowed;           /* time that the reference has been slowed since they attained it [s] */
    real *parameters;     /* [N+1][P] */
    real *reference_pose; /* [SAMPLES][3] */
    real *reference_twist; /* [SAMPLES][2] */
    ddmpc_result result;
};

/* checks.c */
void ddmpc_reject(ddmpc_result *result, int subject, int fault, real a, real b);
int ddmpc_check_pose(ddmpc_controller *c, ddmpc_time t, const ddmpc_stamped *pose, ddmpc_checked_pose *checked);
/* Wheels or gyro, as so many checked numbers; 0 and a note if they cannot be used. */
int ddmpc_check_wheels(ddmpc_controller *c, ddmpc_time t, const ddmpc_stamped *wheels, ddmpc_checked_twist checked[2]);
int ddmpc_check_yaw_rate(ddmpc_controller *c, ddmpc_time t, const ddmpc_stamped *rate, ddmpc_checked_twist checked[1]);
/* Whether `pose` lies near the `expected` one; if not it is remembered, and noted. */
int ddmpc_pose_passes(ddmpc_controller *c, const ddmpc_checked_pose *pose, const real expected[3]);
/* Count `pose` as believed, which clears the memory of jumps. */
void ddmpc_accept_pose(ddmpc_controller *c, const ddmpc_checked_pose *pose);

/* velocity.c: the velocity model over one sample. */
/* x+ under the command window that ends with the commands at `newest` (2), and their predecessors before it in memory. A
   linear model gets them `late` (2) [s] later; NULL: at once.
   Its Jacobian where asked for: by x (n, n), row by row; and of a nonlinear model by the window, column by column. */
void ddmpc_velocity_step(const ddmpc_controller *c, const real *x, const real *newest, const real *late, real *after,
                         real *by_state, real *by_window);
/* Gradient (n, 2) of x+ by `late`. */
void ddmpc_velocity_by_delay(const ddmpc_controller *c, const real *newest, const real *late, real *by_delay);
/* The command that acts `samples` after it was sent; `sent` is the newest, of one channel. */
real ddmpc_delayed(const real *sent, real samples);
/* Where a nonlinear model settles: at this output, in this state, under this command, and what these two owe to the output;
   all zero at first, or where there was none. */
typedef struct {
    real output[2], state[DDMPC_MOST_STATES], command[2], by_output[2 * (DDMPC_MOST_STATES + 2)];
    int exists;
} ddmpc_settled;
/* Where it settles at the output `wanted`, near where it did. Returns 0 if there is none near it. */
int ddmpc_velocity_settle(const ddmpc_controller *c, const real wanted[2], ddmpc_settled *at);
/* (v, omega) of the model and its gradient (2, n), row by row. */
void ddmpc_velocity_output(const ddmpc_controller *c, const real *x, real y[2], real *gradient);

/* filter.c */
void ddmpc_filter_twist(const ddmpc_controller *c, const real *mean, real twist[2]);
void ddmpc_filter_twist_deviation(const ddmpc_controller *c, const ddmpc_belief *belief, real deviation[2]);
void ddmpc_filter_pose_at(const ddmpc_controller *c, const ddmpc_belief *belief, real ahead, real pose[3]);
/* One sample on under the commands up to `newest`; of the mean (Z) alone, and of the whole belief. */
void ddmpc_filter_carry(const ddmpc_controller *c, const real *mean, const real *newest, real *after);
void ddmpc_filter_predict(const ddmpc_controller *c, const ddmpc_belief *before, const real *newest,
                          ddmpc_belief *after);
/* A number of wheels or gyro, or a pose, that was true `ahead` [s] of the belief. */
real ddmpc_filter_correct_twist(const ddmpc_controller *c, ddmpc_belief *belief, const ddmpc_checked_twist *twist,
                                real ahead);
real ddmpc_filter_correct_pose(const ddmpc_controller *c, ddmpc_belief *belief, const ddmpc_checked_pose *pose,
                               real ahead);
/* Gains, curved slip and delays of the state `z` within what is possible. */
void ddmpc_filter_bound(const ddmpc_controller *c, real *z);
void ddmpc_filter_place(const ddmpc_controller *c, ddmpc_belief *belief, const ddmpc_checked_pose *pose);
void ddmpc_copy_belief(const ddmpc_controller *c, ddmpc_belief *to, const ddmpc_belief *from);

/* estimator.c */
enum { READY = 1, MOVED = 2 };
void ddmpc_estimator_clear(ddmpc_controller *c);
void ddmpc_estimator_forget(ddmpc_controller *c);
void ddmpc_estimator_append(ddmpc_controller *c, const real command[2]);
void ddmpc_estimator_correct_last(ddmpc_controller *c, const real command[2]);
/* The newest `count` commands, as far as so many are remembered. */
void ddmpc_estimator_overrule(ddmpc_controller *c, const real *commands, int count);
int ddmpc_estimator_correct_sent(ddmpc_controller *c, const real sent[2]);
void ddmpc_estimator_advance(ddmpc_controller *c, ddmpc_time t);
int ddmpc_estimator_update(ddmpc_controller *c, ddmpc_time t, const ddmpc_input *input);
int ddmpc_estimator_state(const ddmpc_controller *c);
const real *ddmpc_estimator_slip(const ddmpc_controller *c);
int ddmpc_estimator_restart_elsewhere(ddmpc_controller *c);
void ddmpc_estimator_estimate(ddmpc_controller *c);

/* fence.c */
/* As nobody has left it yet. */
void ddmpc_fence_clear(ddmpc_controller *c);
/* Place it for the reference that is tracked from now on. */
void ddmpc_fence_place(ddmpc_controller *c);
/* Whether the robot has stayed inside so far, and would come to rest inside; only with an estimate. */
int ddmpc_fence_holds(ddmpc_controller *c);

/* sensor_test.c */
void ddmpc_monitor_clear(ddmpc_controller *c);
/* One sample on by the commands sent, as a robot that nothing disturbs. */
void ddmpc_monitor_predict(ddmpc_controller *c, const real *newest);
/* The motion up to `t` by what wheels and gyro read, of `twists` checked numbers the first `wheels` by wheels. */
void ddmpc_monitor_move(ddmpc_controller *c, ddmpc_time t, const ddmpc_checked_twist *twist, int wheels, int twists);
/* Sensors, as bits by subject, that repeat themselves to the last digit where the commands say something else. Such readings
   are not used, but where poses say that the robot stands against its commands: then it is held, and they are right. */
void ddmpc_monitor_count(ddmpc_controller *c, int subject, int impossible);
int ddmpc_monitor_doubts(const ddmpc_controller *c, ddmpc_time t);
/* Compare what all say of the motion up to a pose; returns who is accused from now on, as bits by subject. */
int ddmpc_monitor_judge(ddmpc_controller *c, const ddmpc_checked_pose *pose);
/* Give a pose the covariance that it has, where it states far too little. */
void ddmpc_monitor_widen(ddmpc_controller *c, ddmpc_checked_pose *pose);
/* By how much poses are later than their stamps [s]. */
ddmpc_time ddmpc_monitor_delay(const ddmpc_controller *c);
/* Say in the result what was found. */
void ddmpc_monitor_report(ddmpc_controller *c);

/* linearise.c, condense.c, limits.c: the tick's problem, in this order. */
void ddmpc_problem_begin(ddmpc_controller *c);
void ddmpc_problem_guess(ddmpc_controller *c);
void ddmpc_problem_linearise(ddmpc_controller *c);
void ddmpc_problem_condense(ddmpc_controller *c);
void ddmpc_problem_limit(ddmpc_controller *c);
/* The interval that a command reaches in one sample: its size grows by step[0] and falls by step[1]. Past zero it grows
   again, in the rest of the sample. */
void ddmpc_reach(real last, const real step[2], real interval[2]);
/* The largest command of a channel on either side [m/s, rad/s]. */
real ddmpc_fastest(const ddmpc_constants *k, int channel);
/* The poses that follow from `plan`, by exact arcs. */
void ddmpc_problem_poses(ddmpc_controller *c, const real *plan, real *poses);

/* What limits are about, as far as it is linear in `plan` (4 + K, N), and one row of it; `context` is the controller. */
void ddmpc_limit_values(const void *context, const real *plan, real *values);
void ddmpc_limit_row(const void *context, int index, real *row, int *first, int *last);

/* ladder.c */
/* Take over the plan that was found if it may be driven, else go down the ladder; DDMPC_DONE. */
int ddmpc_use_plan(ddmpc_controller *c);
/* The rest of the last good plan, for a few ticks; then braking. */
int ddmpc_reuse(ddmpc_controller *c);
/* The command ramps to zero for `reason`; a `failure` may latch. */
/* Consequences of a stop: the robot continues by itself; it does unless `resume` is off; it does within `resume_within`;
   it waits for ddmpc_start or ddmpc_resume. */
typedef enum { DDMPC_NO_FAILURE, DDMPC_FAILURE, DDMPC_OUTAGE, DDMPC_WAITS } ddmpc_stop;
int ddmpc_brake(ddmpc_controller *c, unsigned int reason, ddmpc_stop stop);
void ddmpc_ramp(ddmpc_controller *c);
/* Zero at once. */
void ddmpc_stand(ddmpc_controller *c);

/* wheel_watch.c */
void ddmpc_watch_wheels(ddmpc_controller *c);

/* solve.c */
/* Without limits, then with the active set; DDMPC_DONE or DDMPC_NEEDS_BACKEND, with the report filled. */
int ddmpc_solve(ddmpc_controller *c);
void ddmpc_solver_reset(ddmpc_controller *c);

#endif
