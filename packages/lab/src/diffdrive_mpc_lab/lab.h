/* The laboratory: two robots with sensors; this controller drives one, and regulated pure pursuit the other. All
 * parameters come from Python (numbers.py); lab_numbers.[ch] and lab_plant.[ch] are generated. */
#ifndef LAB_H
#define LAB_H

#include "core.h"
#include "lab_numbers.h"

enum { LAB_STATES = 64, LAB_PAST = 64, LAB_FLIGHT = 64, LAB_PATCHES = 16 };

/* Sampled velocity model of the robot: x+ = A x + B0 u[k - delay] + B1 u[k - delay - 1], (v, omega) = C x. */
typedef struct {
    int states, delay[2];
    const double *A, *B0, *B1, *C;
} lab_model;

/* Standard normal and uniform samples drawn by NumPy for a seed; they repeat after `count` rows. */
typedef struct {
    int count;
    const double *pose, *gyro, *encoders, *losses; /* [count][3], [count], [count][4], [count] */
} lab_noise;

/* Round patch of ice [m]. */
typedef struct {
    double x, y, radius;
} lab_patch;

/* Surface, sensors and model shared by both robots. */
typedef struct {
    lab_model model;
    lab_noise noise;
    lab_sensors sensors;
    lab_robot robot;
    lab_floor floor, ice;
    lab_patch patch[LAB_PATCHES];
    int patch_count, covered;
} lab_world;

typedef struct {
    double arrival, stamp, value[3];
} lab_late_pose;

/* State of a robot: motion, and sensors with the poses that have not arrived yet. */
typedef struct {
    long tick, next_pose;
    double pose[3], state[LAB_STATES], past[LAB_PAST][2]; /* past commands, newest first */
    double sent[2], body[3];
    int has_sent;
    long pose_draws, gyro_draws, encoder_draws, loss_draws;
    double gyro_bias, twist[2], yaw_rate;
    lab_late_pose flight[LAB_FLIGHT];
    int in_flight;
} lab_robot_state;

void robot_reset(lab_robot_state *robot, const lab_world *world, const double pose[3]);
/* Collect the sensor data since the previous call. */
void robot_measure(lab_robot_state *robot, const lab_world *world, ddmpc_input *input);
/* Send a command, and advance the robot by one sample. */
void robot_advance(lab_robot_state *robot, const lab_world *world, const double command[2]);

/* Regulated pure pursuit as in bench/peers/rpp.py. */
enum { RPP_POSES = 8192 };
typedef struct {
    const lab_rpp *parameters;
    int count, nearest, near_goal, finished, has_pose;
    double path[RPP_POSES][3], along[RPP_POSES];
    double pose[3], twist[2], wish[2], last[2], next;
} rpp_peer;

void rpp_start(rpp_peer *peer, const lab_rpp *parameters, const ddmpc_reference *reference);
/* Compute the command for the tick at `t`, clipped to the range and slew limits of the peer. */
void rpp_step(rpp_peer *peer, double t, double sample_time, const ddmpc_input *input);
/* Return the distance of a pose from the path. */
double rpp_distance(const rpp_peer *peer, const double pose[3]);

/* Report for the page after each tick; the page reads the fields by name. */
typedef struct {
    double time;
    double pose[3], estimate[3], reference[3], peer[3];
    double command[2], twist[3], peer_command[2], peer_twist[3];
    double mode, reasons, has_estimate, has_plan, iterations, peer_finished;
    double error,
        peer_error; /* distance from the reference at that time; for the peer, which has no time law: from its path */
    double counted, square_sum, largest; /* statistics of the error up to the end of the reference */
    double controller_seconds, ticks;
    double duration;
} lab_report;

#endif
