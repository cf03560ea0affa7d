/* The fence: a rectangle that the robot must not leave. The robot brakes as soon as its stopping path, with braking
 * from the next tick on, would leave the rectangle reduced by its margin. The stopping path is predicted by the
 * velocity model with the pending commands, the estimated slip and the braking ramp. */
#include <string.h>

#include "internal.h"

void ddmpc_fence_clear(ddmpc_controller *c)
{
    c->left_fence = 0;
    c->allowed = (real)HUGE_VAL;
}

void ddmpc_fence_place(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    const real *middle = k->fence_middle;
    real start[3] = {R(0.0), R(0.0), R(0.0)}, twist[2], arc_length;
    if (k->fence_at_start)
        c->reference.sample(c->reference.context, 0.0, start, twist, &arc_length);
    const real cosine = ddmpc_cos(start[2]), sine = ddmpc_sin(start[2]);
    c->fence[0] = start[0] + cosine * middle[0] - sine * middle[1];
    c->fence[1] = start[1] + sine * middle[0] + cosine * middle[1];
    c->fence[2] = start[2] + middle[2];
}

/* Distance of a position outside the fence [m]; negative inside. */
static real distance_outside(const ddmpc_controller *c, const real *place)
{
    const real cosine = ddmpc_cos(c->fence[2]), sine = ddmpc_sin(c->fence[2]);
    const real dx = place[0] - c->fence[0], dy = place[1] - c->fence[1];
    const real along = ddmpc_fabs(cosine * dx + sine * dy) - c->constants->fence_reach[0];
    const real across = ddmpc_fabs(cosine * dy - sine * dx) - c->constants->fence_reach[1];
    return along > across ? along : across;
}

/* Return 1 if any pending command is not zero. */
static int is_commanded(const real *commands, int count)
{
    for (int i = 0; i < 2 * count; i++)
        if (commands[i] != R(0.0))
            return 1;
    return 0;
}

/* Reduce a command by one sample of braking. */
static void brake_command(const ddmpc_constants *k, real command[2])
{
    for (int i = 0; i < 2; i++) {
        const real reduced = ddmpc_fabs(command[i]) - k->braking[i];
        command[i] = !(reduced > R(0.0)) ? R(0.0) : command[i] < R(0.0) ? -reduced : reduced;
    }
}

/* Maximum number of simulated braking samples, unless braking from the maximum command takes longer. It bounds the
 * duration of a tick if another node has sent an arbitrarily large command. */
#define MAX_RAMP R(1000.0)

/* Number of samples in which braking reduces a command to zero. */
static real braking_samples(const ddmpc_constants *k, const real command[2])
{
    return ddmpc_max(ddmpc_fabs(command[0]) / k->braking[0], ddmpc_fabs(command[1]) / k->braking[1]);
}

/* Maximum distance outside the fence on the stopping path [m], if this tick repeats the last command before braking. */
static real stopping_distance_outside(const ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    const int window = WINDOW(c) + 1, Z = BELIEF(c);
    real commands[2 * (DDMPC_MAX_WINDOW + 1)], means[2][MAX_BELIEF], y[2];
    real *mean = means[0], *next_mean = means[1], *newest = commands + 2 * (window - 1);
    real max_distance = distance_outside(c, c->result.estimate.mean + STATES(c) + POSE(c));
    const real max_command[2] = {ddmpc_fastest(k, 0), ddmpc_fastest(k, 1)};
    const real ramps = ddmpc_min(braking_samples(k, c->last), ddmpc_max(braking_samples(k, max_command), MAX_RAMP));
    /* After the ramp, the pending commands still act, and the robot then coasts to a standstill. */
    const int max_samples = (int)ramps + window + (int)(k->fence_rolls_on / k->sample_time);
    memcpy(commands, c->estimator.commands + 2 * (COMMANDS(c) - window), sizeof(real) * (size_t)(2 * window));
    memcpy(mean, c->result.estimate.mean, sizeof(real) * (size_t)Z);
    real command[2] = {c->last[0], c->last[1]};
    for (int i = 0; i < max_samples; i++) {
        memmove(commands, commands + 2, sizeof(real) * (size_t)(2 * (window - 1)));
        memcpy(newest, command, sizeof command);
        ddmpc_filter_carry(c, mean, newest, next_mean);
        const real out = distance_outside(c, next_mean + STATES(c) + POSE(c));
        if (!(out <= max_distance)) /* also true for NaN */
            max_distance = out;
        ddmpc_velocity_output(c, next_mean, y, 0);
        if (!is_commanded(commands, window) && ddmpc_fabs(y[0]) < k->fence_rest)
            break;
        real *swapped = mean;
        mean = next_mean;
        next_mean = swapped;
        brake_command(k, command);
    }
    return max_distance;
}

int ddmpc_fence_is_respected(ddmpc_controller *c)
{
    if (!c->constants->fence)
        return 1;
    /* A robot that starts outside the fence may return to the inside, but must not move further away. */
    const real outside = ddmpc_max(distance_outside(c, c->result.estimate.mean + STATES(c) + POSE(c)), R(0.0));
    c->allowed = ddmpc_min(c->allowed, outside);
    const real limit = c->allowed > R(0.0) ? c->allowed + c->constants->fence_play : R(0.0);
    c->left_fence = c->left_fence || !(stopping_distance_outside(c) <= limit);
    return !c->left_fence;
}
