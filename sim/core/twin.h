/* The simulated robot between two control ticks: link, firmware, motor drivers, motors, encoders, and the steps of the
 * physics between them. SI units; wheels are front left, front right, rear left, rear right. What the numbers mean and
 * where they come from is said in sim/plants, by the classes of the same names.
 *
 * Sums and products are rounded one by one, in the order in which they are written: the same bits on every processor. */
#ifndef TWIN_H
#define TWIN_H

/* Commands that arrive a fixed time after they were sent. */
typedef struct {
  double dead_time;
  double *arrivals; /* [room] when those under way arrive, from `first` on, around the end to the beginning */
  double *commands; /* [room][2] */
  int room, first, count;
  double acting[2]; /* that has arrived last */
} twin_link;

/* The firmware: a first-order lag per channel, then set-points in whole pulses per second. */
typedef struct {
  double decay[2];
  double to_pulses[8]; /* [4][2] */
  double pulse;
  double state[2];
} twin_shaper;

/* Speeds from encoder counts. */
typedef struct {
  double angle_gain, speed_gain;
  double pulse, step;
  double phase[4];
  double angle[4];
  double speed[4];
} twin_observer;

/* Velocity loops of the drivers, and the torque-speed lines of the motors. */
typedef struct {
  double proportional, integral; /* gains; the integral one over a step */
  double no_load_speed, rest_speed;
  double stall_torque[4];
  double torque_limit; /* by the drivers' limit of the current */
  double supply;
  double sum[4]; /* the integrators */
} twin_loops;

/* The body in MuJoCo. */
typedef struct {
  const void *model;
  void *data;
  void (*step)(const void *model, void *data); /* mj_step */
  double *position;     /* [11] x, y, z, quaternion, wheel angles */
  double *velocity;     /* [10] of the same, without the quaternion's fourth */
  double *torque;       /* [4] */
  double largest;       /* magnitude beyond which the simulation counts as diverged */
  double least_upright; /* cosine of the lean from which there is no coming back */
  double yaw;           /* unwrapped */
} twin_chassis;

typedef struct {
  twin_link *link;
  twin_shaper *shaper;
  twin_observer *observer;
  twin_loops *loops;
  twin_chassis *chassis;
  double *motors; /* [steps][2][4] torques during each step, speeds at its end */
} twin;

enum { TWIN_SOUND = 0, TWIN_DIVERGED = 1, TWIN_TIPPED = 2 };

/* Send a command [2]; returns 0 where there is no room for one more. */
int twin_send(twin_link *link, double time, const double *command);
/* Mean of the arrived command [2] over [start, end]. */
void twin_arrived(twin_link *link, double start, double end, double *mean);
/* Set-points [4] for the command [2] that acts during this step. */
void twin_shape(twin_shaper *shaper, const double *command, double *set_points);
/* Read the counters at the wheels' angles [4]. */
void twin_observe(twin_observer *observer, const double *angles);
/* Reset the observer to wheels that have always been at rest at angle zero. */
void twin_observe_rest(twin_observer *observer);
/* Torques [4] for wanted, estimated and true speeds [4]. */
void twin_torque(twin_loops *loops, const double *set_points, const double *estimates, const double *speeds, double *torques);
/* Advance the physics by one step under torques [4]; return the state of the body. */
int twin_move(twin_chassis *chassis, const double *torques);

/* Torques [4] that the motors give from `start` to `end`, one step of the physics. */
void twin_drive(twin *t, double start, double end, double *torques);
/* That step under torques [4], and the encoders after it. */
int twin_step(twin *t, const double *torques);
/* All steps between the instants edges [steps + 1]; poses [steps + 1][3] get x, y, theta at each of them. */
int twin_advance(twin *t, int steps, const double *edges, double *poses);

#endif
