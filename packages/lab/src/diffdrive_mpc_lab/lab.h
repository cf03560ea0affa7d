/* The laboratory: two robots with sensors, the controller that drives one of them, and regulated pure pursuit, which
 * drives the other. All numbers come from Python (numbers.py); lab_numbers.[ch] and lab_plant.[ch] are
 * generated. */
#ifndef LAB_H
#define LAB_H

#include "core.h"
#include "lab_numbers.h"

enum { LAB_STATES = 64, LAB_PAST = 64, LAB_FLIGHT = 64, LAB_PATCHES = 16 };

/* The velocity model of the robot, sampled: x+ = A x + B0 u[k - delay] + B1 u[k - delay - 1], (v, omega) = C x. */
typedef struct {
    int states, delay[2];
    const double *A, *B0, *B1, *C;
} lab_model;

/* Standard normal and uniform numbers that NumPy drew for a seed; after `count` rows they begin again. */
typedef struct {
    int count;
    const double *pose, *gyro, *encoders, *losses; /* [count][3], [count], [count][4], [count] */
} lab_noise;

/* A round piece of another floor. */
typedef struct {
    double x, y, radius;
} lab_patch;

/* World of both robots. */
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

/* State of a robot: its motion, and its sensors with pending measurements. */
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
/* Collect the sensor data since the last call. */
void robot_measure(lab_robot_state *robot, const lab_world *world, ddmpc_input *input);
/* Send a command, and let one sample pass. */
void robot_advance(lab_robot_state *robot, const lab_world *world, const double command[2]);

/* Regulated pure pursuit, as bench/peers/rpp.py states it. */
enum { RPP_POSES = 8192 };
typedef struct {
    const lab_rpp *parameters;
    int count, nearest, near_goal, finished, has_pose;
    double path[RPP_POSES][3], along[RPP_POSES];
    double pose[3], twist[2], wish[2], last[2], next;
} rpp_peer;

void rpp_start(rpp_peer *peer, const lab_rpp *parameters, const ddmpc_reference *reference);
/* The command for the tick at `t`, inside range and slew of the peer's limits. */
void rpp_step(rpp_peer *peer, double t, double sample_time, const ddmpc_input *input);
/* Return the distance of a pose from the path. */
double rpp_distance(const rpp_peer *peer, const double pose[3]);

/* Report for the page after each tick, by the names of these fields. */
typedef struct {
    double time;
    double pose[3], estimate[3], reference[3], peer[3];
    double command[2], twist[3], peer_command[2], peer_twist[3];
    double mode, reasons, has_estimate, has_plan, iterations, peer_finished;
    double error, peer_error; /* to the reference at that time; the peer, which keeps no times: to its path */
    double counted, square_sum, largest; /* statistics of the error up to the end of the reference */
    double controller_seconds, ticks;
    double duration;
} lab_report;

#endif
