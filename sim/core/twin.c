#include "twin.h"

#include <math.h>

static const double TURN = 6.283185307179586;

int twin_send(twin_link *link, double time, const double *command)
{
    int last;
    if (link->count == link->capacity)
        return 0;
    last = (link->first + link->count++) % link->capacity;
    link->arrivals[last] = time + link->dead_time;
    link->commands[2 * last] = command[0];
    link->commands[2 * last + 1] = command[1];
    return 1;
}

void twin_mean_command(twin_link *link, double start, double end, double *mean)
{
    double total[2] = {0.0, 0.0}, last_time = start;
    int i;
    while (link->count && link->arrivals[link->first] < end) {
        const double arrival = link->arrivals[link->first] < last_time ? last_time : link->arrivals[link->first];
        for (i = 0; i < 2; i++) {
            total[i] += (arrival - last_time) * link->effective[i];
            link->effective[i] = link->commands[2 * link->first + i];
        }
        last_time = arrival;
        link->first = (link->first + 1) % link->capacity;
        link->count--;
    }
    for (i = 0; i < 2; i++)
        mean[i] = last_time == start ? link->effective[i]
                                     : (total[i] + (end - last_time) * link->effective[i]) / (end - start);
}

void twin_shape(twin_shaper *shaper, const double *command, double *set_points)
{
    int i;
    for (i = 0; i < 2; i++)
        shaper->state[i] = command[i] + shaper->decay[i] * (shaper->state[i] - command[i]);
    /* Set-points are integers, so that a decaying command reaches exactly zero. */
    for (i = 0; i < 4; i++)
        set_points[i] =
            rint(shaper->to_pulses[2 * i] * shaper->state[0] + shaper->to_pulses[2 * i + 1] * shaper->state[1]) *
            shaper->pulse;
}

static double quantise_angle(const twin_observer *observer, int wheel, double angle)
{
    return floor(angle / observer->pulse + observer->phase[wheel]) * observer->pulse;
}

void twin_reset_observer(twin_observer *observer)
{
    int i;
    for (i = 0; i < 4; i++) {
        observer->angle[i] = quantise_angle(observer, i, 0.0);
        observer->speed[i] = 0.0;
    }
}

void twin_observe(twin_observer *observer, const double *angles)
{
    int i;
    for (i = 0; i < 4; i++) {
        const double predicted = observer->angle[i] + observer->step * observer->speed[i];
        const double error = quantise_angle(observer, i, angles[i]) - predicted;
        observer->angle[i] = predicted + observer->angle_gain * error;
        observer->speed[i] = observer->speed[i] + observer->speed_gain * error;
    }
}

void twin_torque(twin_loops *loops, const double *set_points, const double *estimates, const double *speeds,
                 double *torques)
{
    int i;
    for (i = 0; i < 4; i++) {
        const double error = set_points[i] - estimates[i];
        /* At a zero set-point the driver brakes and resets its integrator to avoid a limit cycle within one count. */
        const int is_resting = set_points[i] == 0.0 && fabs(estimates[i]) < loops->rest_speed;
        double requested, duty, requested_torque;
        if (is_resting)
            loops->integrator[i] = 0.0;
        requested = set_points[i] / loops->no_load_speed + loops->proportional_gain * error + loops->integrator[i];
        duty = is_resting ? 0.0 : requested < -1.0 ? -1.0 : requested > 1.0 ? 1.0 : requested;
        requested_torque = loops->stall_torque[i] * (loops->supply * duty - speeds[i] / loops->no_load_speed);
        torques[i] = requested_torque < -loops->torque_limit  ? -loops->torque_limit
                     : requested_torque > loops->torque_limit ? loops->torque_limit
                                                              : requested_torque;
        /* Anti-windup: integrators are frozen while duty or current is saturated. */
        if (duty == requested && torques[i] == requested_torque)
            loops->integrator[i] += loops->integral_gain * error;
    }
}

static int all_within(const double *values, int count, double limit)
{
    int i;
    for (i = 0; i < count; i++)
        if (!(fabs(values[i]) < limit)) /* negated so that NaN fails */
            return 0;
    return 1;
}

int twin_step_physics(twin_chassis *chassis, const double *torques)
{
    const double *q = chassis->position;
    double w, x, y, z, yaw;
    int i;
    for (i = 0; i < 4; i++)
        chassis->torque[i] = torques[i];
    chassis->step(chassis->model, chassis->data);
    if (!all_within(q, 11, chassis->max_state) || !all_within(chassis->velocity, 10, chassis->max_state))
        return TWIN_DIVERGED;
    w = q[3], x = q[4], y = q[5], z = q[6];
    if (1.0 - 2.0 * (x * x + y * y) < chassis->min_upright)
        return TWIN_TIPPED;
    yaw = atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
    chassis->yaw += remainder(yaw - chassis->yaw, TURN);
    return TWIN_OK;
}

void twin_drive(twin *t, double start, double end, double *torques)
{
    double command[2], set_points[4];
    twin_mean_command(t->link, start, end, command);
    twin_shape(t->shaper, command, set_points);
    twin_torque(t->loops, set_points, t->observer->speed, t->chassis->velocity + 6, torques);
}

int twin_step(twin *t, const double *torques)
{
    const int state = twin_step_physics(t->chassis, torques);
    if (state == TWIN_OK)
        twin_observe(t->observer, t->chassis->position + 7);
    return state;
}

static void store_motors(const twin_chassis *chassis, const double *torques, double *motors)
{
    int i;
    for (i = 0; i < 4; i++) {
        motors[i] = torques[i];
        motors[4 + i] = chassis->velocity[6 + i];
    }
}

static void store_pose(const twin_chassis *chassis, double *pose)
{
    pose[0] = chassis->position[0];
    pose[1] = chassis->position[1];
    pose[2] = chassis->yaw;
}

int twin_advance(twin *t, int steps, const double *edges, double *poses)
{
    double torques[4];
    int k, state;
    store_pose(t->chassis, poses);
    for (k = 0; k < steps; k++) {
        twin_drive(t, edges[k], edges[k + 1], torques);
        state = twin_step(t, torques);
        if (state != TWIN_OK)
            return state;
        store_pose(t->chassis, poses + 3 * (k + 1));
        store_motors(t->chassis, torques, t->motors + 8 * k);
    }
    return TWIN_OK;
}
