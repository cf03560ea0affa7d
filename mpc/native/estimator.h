/* Estimates pose, twist and slip from measurements that arrive at several rates and late: an extended Kalman filter
 * with a short history, in which a late measurement is entered at its stamp.
 *
 * No allocation, no globals. The constants of one robot are in `ddmpc_estimation`, everything that changes in
 * `ddmpc_estimator`; both are plain data. ddmpc_sizes.h is generated for one controller and defines
 *
 *     DDMPC_STATES        order n of the velocity model
 *     DDMPC_DELAY_V, DDMPC_DELAY_OMEGA    dead time of each channel in whole samples
 *     DDMPC_HISTORY       ticks that the history holds
 */
#ifndef DDMPC_ESTIMATOR_H
#define DDMPC_ESTIMATOR_H

#include "ddmpc_sizes.h"
#include "real.h"

/* The filter's state: n velocity states, then these. */
enum {
    DDMPC_V_OFFSET = DDMPC_STATES, /* forward speed of the wheels that the model does not explain [m/s] */
    DDMPC_OMEGA_GAIN,              /* yaw rate of wheels over model [-] */
    DDMPC_LONGITUDINAL_GAIN,       /* forward speed of body over wheels [-] */
    DDMPC_YAW_GAIN,                /* yaw rate of body over wheels [-] */
    DDMPC_SIDE_SLIP,               /* lateral speed, outward, over v omega [s] */
    DDMPC_GYRO_BIAS,               /* [rad/s] */
    DDMPC_POSE,                    /* x, y [m], theta [rad] */
    DDMPC_BELIEF = DDMPC_POSE + 3
};

enum { DDMPC_SLIPS = DDMPC_POSE - DDMPC_V_OFFSET };

/* Sensors, as they are counted in `surprised` and `innovations`. */
enum { DDMPC_WHEEL_SPEED, DDMPC_WHEEL_YAW_RATE, DDMPC_YAW_RATE, DDMPC_POSE_SENSOR, DDMPC_SENSORS };

enum {
    DDMPC_LONGEST_DELAY = DDMPC_DELAY_V > DDMPC_DELAY_OMEGA ? DDMPC_DELAY_V : DDMPC_DELAY_OMEGA,
    DDMPC_MEMORY = DDMPC_LONGEST_DELAY + 1,
    DDMPC_COMMANDS = DDMPC_MEMORY + DDMPC_HISTORY + 2, /* commands that are remembered */
    DDMPC_TWISTS = 12,  /* numbers of wheels and gyro that one tick of the history holds */
    DDMPC_POSES = 4,    /* poses that it holds */
    DDMPC_AGREEING = 3, /* poses in a row that contradict the estimate but agree with each other are no outliers */
    DDMPC_NOTES = 8
};

/* What is constant for one robot. Every field is `real`: mpc/compiled/constants.py fills them in this order. */
typedef struct {
    real dt;                                                   /* sample time [s] */
    real A[DDMPC_STATES][DDMPC_STATES];                        /* x+ = A x + B0 u[k - delay] + B1 u[k - delay - 1] */
    real B0[DDMPC_STATES][2], B1[DDMPC_STATES][2];
    real C[2][DDMPC_STATES];                                   /* (v, omega) = C x */
    real mean_output[2][DDMPC_STATES];                         /* C (1 + A) / 2 */
    real settled[DDMPC_STATES][2];                             /* state after a unit command for ever */
    real noise[DDMPC_STATES][DDMPC_STATES];                    /* process noise of one sample */
    real pose_noise[3];
    real drift[DDMPC_SLIPS], uncertainty[DDMPC_SLIPS];         /* variance per sample; deviation at the start */
    real wheel_yaw_ratio;                                      /* yaw rate by encoders over that of the model */
    real surprise, patience;                                   /* limit [-], and how long it may last [samples] */
    real least_yaw_rate, least_speed, least_gain, most_gain;
    real history;                                              /* oldest stamp that is taken [s] */
    real pose_variance[3];                                     /* where a pose states no covariance */
    real twist_variance[3];                                    /* wheel speed, wheel yaw rate, yaw rate */
    real largest_twist[3], largest_twist_jump[3];
    real largest_position_jump, largest_heading_jump;
} ddmpc_estimation;

/* One message. Whatever could not be read as numbers is NaN, and is rejected as such. */
typedef struct {
    ddmpc_time stamp;
    real value[3];
    real covariance[9]; /* rows of a k x k matrix for k values */
    int present, has_covariance;
} ddmpc_stamped;

/* What arrived since the last tick. */
typedef struct {
    ddmpc_stamped pose;     /* x, y [m], theta [rad] */
    ddmpc_stamped wheels;   /* v [m/s], omega [rad/s] by encoders and geometric track */
    ddmpc_stamped yaw_rate; /* of the gyro [rad/s] */
} ddmpc_measurement;

/* Why something was rejected; `a` and `b` are the numbers that belong to it. */
typedef enum {
    DDMPC_NO_FAULT,
    DDMPC_NOT_NUMBERS,        /* not finite */
    DDMPC_BAD_COVARIANCE,     /* not symmetric and positive definite, or too large */
    DDMPC_BAD_STAMP,          /* not finite */
    DDMPC_IN_FUTURE,          /* by a [s] */
    DDMPC_NOT_NEWER,          /* than the one before */
    DDMPC_TOO_OLD,            /* a [s] */
    DDMPC_TOO_LARGE,          /* a is more than b */
    DDMPC_JUMPS,              /* from a to b; a pose by a [m] and b [rad] */
    DDMPC_TOO_MANY            /* within one sample */
} ddmpc_fault;

typedef enum { DDMPC_OF_WHEELS, DDMPC_OF_YAW_RATE, DDMPC_OF_POSE } ddmpc_subject;

typedef struct {
    real a, b;
    int subject, fault;
} ddmpc_note;

typedef struct {
    ddmpc_note note[DDMPC_NOTES];
    int count;
} ddmpc_notes;

typedef struct {
    real mean[DDMPC_BELIEF];
    real covariance[DDMPC_BELIEF][DDMPC_BELIEF];
    int surprised[DDMPC_SENSORS]; /* samples since the sensor's innovations have been too large; 0: they are not */
} ddmpc_belief;

typedef struct {
    real value, variance;
    int sensor;
} ddmpc_checked_twist;

typedef struct {
    ddmpc_time stamp;
    real value[3], covariance[3][3];
} ddmpc_checked_pose;

/* One tick of the history: the belief before and after its measurements. */
typedef struct {
    ddmpc_time time;
    ddmpc_belief prior, posterior;
    ddmpc_checked_pose pose[DDMPC_POSES];
    ddmpc_checked_twist twist[DDMPC_TWISTS];
    int poses, twists;
} ddmpc_node;

typedef struct {
    real commands[DDMPC_COMMANDS][2]; /* sent, newest last */
    real innovations[DDMPC_SENSORS];  /* newest squared innovation over its variance; NaN: none yet */
    ddmpc_time accepted_stamp, pose_stamp, wheels_stamp, yaw_rate_stamp;
    real last_wheels[2], last_yaw_rate;
    ddmpc_checked_pose jumped[DDMPC_AGREEING];
    int jumps;        /* poses in `jumped` */
    int first, nodes; /* of the history, a ring */
    ddmpc_node node[DDMPC_HISTORY];
} ddmpc_estimator;

/* The newest estimate; as long as `real` is double, all of it is double. */
typedef struct {
    ddmpc_time time;
    real pose_age; /* time since the stamp of the last accepted pose [s] */
    real mean[DDMPC_BELIEF], deviation[DDMPC_BELIEF];
    real twist[2], twist_deviation[2]; /* of the body, slip included [m/s, rad/s] */
    real innovations[DDMPC_SENSORS];
} ddmpc_estimate;

/* Bits: there is an estimate; poses agree with each other but not with it. */
enum { DDMPC_READY = 1, DDMPC_MOVED = 2 };

/* A robot that stands still and of which nothing is known. */
void ddmpc_estimator_init(ddmpc_estimator *estimator);
/* Drop the estimate, as before the first pose; commands on their way stay. */
void ddmpc_estimator_forget(ddmpc_estimator *estimator);
/* Whether there is an estimate. */
int ddmpc_estimator_ready(const ddmpc_estimator *estimator);
/* Whether poses agree with each other but not with the estimate. */
int ddmpc_estimator_moved(const ddmpc_estimator *estimator);
/* Enter the command sent at this tick; replace the newest one by what the robot got. */
void ddmpc_estimator_append(ddmpc_estimator *estimator, const real command[2]);
void ddmpc_estimator_correct_last(ddmpc_estimator *estimator, const real command[2]);
/* Believe what the robot says it got at the last tick; 0 if it cannot be. */
int ddmpc_estimator_correct_sent(const ddmpc_estimation *constants, ddmpc_estimator *estimator, const real sent[2]);
/* Predict to the tick at `t`; missed ticks are made up for with the last command. */
void ddmpc_estimator_advance(const ddmpc_estimation *constants, ddmpc_estimator *estimator, ddmpc_time t);
/* Take in what arrived; `notes` says what was rejected. Returns DDMPC_READY and DDMPC_MOVED. */
int ddmpc_estimator_update(const ddmpc_estimation *constants, ddmpc_estimator *estimator, ddmpc_time t,
                           const ddmpc_measurement *measurement, ddmpc_notes *notes);
/* Believe that the robot is where the poses that jumped agree it is; 0 if they do not. */
int ddmpc_estimator_restart_elsewhere(const ddmpc_estimation *constants, ddmpc_estimator *estimator);
/* The newest estimate; only once ready. */
void ddmpc_estimator_estimate(const ddmpc_estimation *constants, const ddmpc_estimator *estimator,
                              ddmpc_estimate *estimate);

/* Sizes in bytes, for callers that allocate without this header. */
unsigned long ddmpc_estimation_size(void);
unsigned long ddmpc_estimator_size(void);

#endif
