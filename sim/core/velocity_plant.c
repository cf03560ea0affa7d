#include "velocity_plant.h"

#include <float.h>
#include <math.h>
#include <string.h>

static const double PI = 3.141592653589793;
/* Constants of models/base_effects.py and models/slip_laws.py. */
static const double ROUNDING = 1e-9, MIN_RADICAND = 0.04;

static double clip(double value, double low, double high) { return fmin(fmax(value, low), high); }

/* models/two_sided.py, reached */
static double limit_rate(double last, double command, double rise, double fall)
{
    double low = last - (last > 0.0 ? fall : rise), high = last + (last < 0.0 ? fall : rise);
    if (last > 0.0 && low < 0.0)
        low *= rise / fall;
    if (last < 0.0 && high > 0.0)
        high *= rise / fall;
    return clip(command, low, high);
}

static double quantise_speed(const velocity_plant *p, double speed)
{
    const double limited = clip(speed, -p->max_wheel_speed, p->max_wheel_speed);
    return p->resolution == 0.0 ? limited
                                : copysign(floor(fabs(limited) / p->resolution + ROUNDING) * p->resolution, limited);
}

/* WheelCommand.apply */
static void apply_wheel_command(const velocity_plant *p, double *twist)
{
    const double half = 0.5 * p->track * twist[1];
    const double left = quantise_speed(p, twist[0] - half), right = quantise_speed(p, twist[0] + half);
    const double along_left = left == 0.0 && right != 0.0 ? clip(right, -p->coasting, p->coasting) : left;
    const double along_right = right == 0.0 && left != 0.0 ? clip(left, -p->coasting, p->coasting) : right;
    twist[0] = 0.5 * (along_left + along_right);
    twist[1] = (along_right - along_left) / p->track;
}

static void advance_dynamics(velocity_plant *p, const double *requested)
{
    const int n = p->order, last = p->memory;
    double *current = p->state, *next_state = p->state + n;
    int i, j;
    if (!n) {
        memcpy(p->wheels, p->next, sizeof p->wheels);
        return;
    }
    memmove(p->commands, p->commands + 2, (size_t)last * 2 * sizeof *p->commands);
    memcpy(p->commands + 2 * last, requested, 2 * sizeof *requested);
    for (i = 0; i < n; i++) {
        next_state[i] = 0.0;
        for (j = 0; j < n; j++)
            next_state[i] += p->A[n * i + j] * current[j];
        for (j = 0; j < 2; j++) {
            const double *command = p->commands + 2 * (last - p->delay[j]) + j;
            next_state[i] += p->B0[2 * i + j] * command[0] + p->B1[2 * i + j] * command[-2];
        }
    }
    memcpy(current, next_state, (size_t)n * sizeof *current);
    for (i = 0; i < 2; i++)
        for (p->wheels[i] = 0.0, j = 0; j < n; j++)
            p->wheels[i] += p->C[n * i + j] * current[j];
}

/* YawRelaxation.advance */
static double relax_yaw_rate(velocity_plant *p, double yaw_rate)
{
    const double side = (yaw_rate > 0.0) - (yaw_rate < 0.0), previous = p->strain;
    p->strain = side + (previous - side) * exp(-fabs(yaw_rate) * p->step_time / p->relaxation_angle);
    return yaw_rate - p->relaxation_angle * (p->strain - previous) / p->step_time;
}

static void compute_body(velocity_plant *p)
{
    p->body[0] = p->wheels[0];
    p->body[1] = p->relaxation_angle > 0.0 ? fabs(p->wheels[1]) * p->strain : p->wheels[1];
    p->body[1] += p->yaw_per_metre * p->body[0];
}

/* Add the unexplained motion to a twist [3] of the body for an output [2] of the model. */
static void add_unexplained(const velocity_plant *p, const double *output, double *twist)
{
    const double *row = p->rows + 3 * (p->tick % p->count);
    const double features[6] = {1.0, output[0], output[1], output[0] * output[1], p->rate[0], p->rate[1]};
    int i, j;
    for (i = 0; i < 3; i++) {
        double variance = 0.0;
        for (j = 0; j < 6; j++)
            variance += p->variance[6 * i + j] * fmin(features[j] * features[j], p->max_squares[j]);
        twist[i] += row[i] * sqrt(variance);
    }
    twist[0] -= p->traction_slip * fabs(output[1]) * p->rate[0];
    twist[2] += output[1] * (p->yaw_slip[0] + p->yaw_slip[1] * fmin(output[0] * output[0], p->max_squares[1]));
}

/* Compute the twist [3] of the body for an output [2] of the model: BodySlip.body and unexplained motion. */
static void compute_twist(const velocity_plant *p, const double *output, double *twist)
{
    double v = p->longitudinal_gain * output[0], omega = p->yaw_gain * output[1], lateral = 0.0;
    if (p->track_at_rest > 0.0) {
        /* The factor cancels, but its rounding is that of the Python implementation. */
        const double settled = p->track_at_rest * omega / p->track_at_rest;
        const double growth = p->track_growth / p->track_at_rest;
        omega = settled / (0.5 * (1.0 + sqrt(fmax(1.0 + 4.0 * growth * fabs(settled), MIN_RADICAND))));
    }
    if (p->has_polynomial) {
        const double *a = p->polynomial, v_c = v, w_c = omega;
        v = v_c + (a[0] * v_c + a[1] * w_c + a[2] * v_c * w_c);
        lateral = a[3] * v_c + a[4] * w_c + a[5] * v_c * w_c;
        omega = w_c + (a[6] * v_c + a[7] * w_c + a[8] * v_c * w_c);
    }
    twist[0] = v;
    twist[1] = lateral - p->side_slip * v * omega;
    twist[2] = omega;
    if (p->count)
        add_unexplained(p, output, twist);
}

/* models/pose.py, integrate_pose; a body with side-slip moves like a body that points in the direction of travel. */
static void integrate_pose(double *pose, const double *twist, double duration)
{
    const double forward = copysign(1.0, twist[0]), crab = atan2(forward * twist[1], fabs(twist[0]));
    const double speed = forward * hypot(twist[0], twist[1]), half = 0.5 * twist[2] * duration;
    const double product = PI * (half / PI), x = product == 0.0 ? DBL_EPSILON : product;
    const double reach = duration * (sin(x) / x), heading = pose[2] + crab + half;
    pose[0] += reach * (speed * cos(heading));
    pose[1] += reach * (speed * sin(heading));
    pose[2] = pose[2] + crab + twist[2] * duration - crab;
}

void velocity_plant_reset(velocity_plant *p)
{
    memset(p->state, 0, 2 * (size_t)p->order * sizeof *p->state);
    memset(p->commands, 0, 2 * (size_t)(p->memory + 1) * sizeof *p->commands);
    memset(p->limited_command, 0, sizeof p->limited_command);
    memset(p->rate, 0, sizeof p->rate);
    p->tick = p->has_sent = 0;
    p->strain = 0.0;
    memcpy(p->wheels, p->next, sizeof p->wheels);
    compute_body(p);
    compute_twist(p, p->body, p->twist);
}

void velocity_plant_advance(velocity_plant *p, const double *command)
{
    const double previous[2] = {p->body[0], p->body[1]};
    double unexplained[3] = {0.0, 0.0, 0.0};
    int step, i;
    for (step = 0; step < p->steps; step++) {
        double *arc = p->arcs + 6 * step, requested[2], mean[2];
        for (i = 0; i < 2; i++) {
            p->limited_command[i] = limit_rate(p->limited_command[i], clip(command[i], -p->lower[i], p->upper[i]),
                                               p->max_rise[i], p->max_fall[i]);
            requested[i] = p->limited_command[i];
            mean[i] = p->wheels[i];
        }
        if (p->track > 0.0)
            apply_wheel_command(p, requested);
        advance_dynamics(p, requested);
        for (i = 0; i < 2; i++)
            mean[i] = 0.5 * (mean[i] + p->wheels[i]);
        if (p->relaxation_angle > 0.0)
            mean[1] = relax_yaw_rate(p, mean[1]);
        mean[1] += p->yaw_per_metre * mean[0];
        memcpy(arc, p->pose, sizeof p->pose);
        compute_twist(p, mean, arc + 3);
        integrate_pose(p->pose, arc + 3, p->step_time);
    }
    compute_body(p);
    compute_twist(p, p->body, p->twist);
    /* Gyro and encoders measure the sample that has ended, so their readings precede the update of tick and rate,
     * which select the unexplained motion of the next sample. */
    p->yaw_rate = p->twist[2];
    if (p->count)
        add_unexplained(p, p->body, unexplained);
    for (i = 0; i < 2; i++)
        p->wheel_motion[i] = p->on_wheels[i] ? unexplained[2 * i] : 0.0;
    for (i = 0; i < 2; i++)
        p->rate[i] = (p->body[i] - previous[i]) / (p->steps * p->step_time);
    p->tick++;
    compute_twist(p, p->body, p->twist);
}

void velocity_plant_past_pose(const velocity_plant *p, double start, double time, double *pose)
{
    int step = p->steps - 1;
    while (step > 0 && start + step * p->step_time > time)
        step--;
    memcpy(pose, p->arcs + 6 * step, 3 * sizeof *pose);
    integrate_pose(pose, p->arcs + 6 * step + 3, time - (start + step * p->step_time));
}
