/* Simulated robot between two control ticks: link, firmware, motor drivers, motors, encoders and physics steps.
 * Units are SI units; the order of wheels is front left, front right, rear left, rear right. The classes of the same
 * names in sim/plants document the parameters and their sources.
 *
 * Each operation is rounded in source order, so that results are bitwise equal on all processors. */
#ifndef TWIN_H
#define TWIN_H

/* Link that delays commands by a dead time. */
typedef struct {
    double dead_time;
    double *arrivals; /* [capacity] arrival times of pending commands: ring buffer of `count` entries from `first` */
    double *commands; /* [capacity][2] */
    int capacity, first, count;
    double effective[2]; /* last command that has arrived */
} twin_link;

/* Firmware: a first-order lag per channel, followed by set-points in whole pulses per second. */
typedef struct {
    double decay[2];
    double to_pulses[8]; /* [4][2] */
    double pulse;
    double state[2];
} twin_shaper;

/* Observer of wheel speeds from encoder counts. */
typedef struct {
    double angle_gain, speed_gain;
    double pulse, step;
    double phase[4];
    double angle[4];
    double speed[4];
} twin_observer;

/* Velocity loops of the drivers, and torque-speed lines of the motors. */
typedef struct {
    double proportional_gain, integral_gain; /* the integral gain is per step */
    double no_load_speed, rest_speed;
    double stall_torque[4];
    double torque_limit;  /* due to the current limit of the drivers */
    double supply;        /* ratio of the supply voltage to the nominal voltage */
    double integrator[4]; /* states of the integrators */
} twin_loops;

/* Body in MuJoCo. */
typedef struct {
    const void *model;
    void *data;
    void (*step)(const void *model, void *data); /* mj_step */
    double *position;                            /* [11] x, y, z, quaternion, wheel angles */
    double *velocity;                            /* [10] velocity, angular velocity, wheel speeds */
    double *torque;                              /* [4] */
    double max_state;                            /* absolute value above which the simulation counts as diverged */
    double min_upright;                          /* cosine of the tilt above which the robot counts as tipped over */
    double yaw;                                  /* unwrapped yaw angle */
} twin_chassis;

typedef struct {
    twin_link *link;
    twin_shaper *shaper;
    twin_observer *observer;
    twin_loops *loops;
    twin_chassis *chassis;
    double *motors; /* [steps][2][4] torques during each step, and speeds at the end of the step */
} twin;

enum { TWIN_OK = 0, TWIN_DIVERGED = 1, TWIN_TIPPED = 2 };

/* Send a command [2]; return 0 if the buffer is full. */
int twin_send(twin_link *link, double time, const double *command);
/* Compute the mean of the effective command [2] over [start, end]. */
void twin_mean_command(twin_link *link, double start, double end, double *mean);
/* Compute set-points [4] for the effective command [2] during this step. */
void twin_shape(twin_shaper *shaper, const double *command, double *set_points);
/* Update the observer with the encoder counts for the wheel angles [4]. */
void twin_observe(twin_observer *observer, const double *angles);
/* Reset the observer to wheels at rest at angle zero. */
void twin_reset_observer(twin_observer *observer);
/* Compute torques [4] from set-points, estimated speeds and true speeds [4]. */
void twin_torque(twin_loops *loops, const double *set_points, const double *estimates, const double *speeds,
                 double *torques);
/* Advance the physics by one step under torques [4]; return the state of the body. */
int twin_step_physics(twin_chassis *chassis, const double *torques);

/* Compute the torques [4] of the motors for the physics step from `start` to `end`. */
void twin_drive(twin *t, double start, double end, double *torques);
/* Advance physics and observer by one step under torques [4]; return the state of the body. */
int twin_step(twin *t, const double *torques);
/* Advance the steps between the times edges [steps + 1]; store x, y, theta at each time in poses [steps + 1][3]. */
int twin_advance(twin *t, int steps, const double *edges, double *poses);

#endif
