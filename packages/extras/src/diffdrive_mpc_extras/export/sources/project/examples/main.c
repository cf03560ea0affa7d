/* Example: drive a robot that follows its velocity model exactly along the exported trajectory, with exact sensors. */
#include <stdio.h>
#include <string.h>

#include "ddmpc.h"
#include "internal.h" /* for the prediction model of the controller */
#include "trajectory.h"

enum { COMMANDS = DDMPC_WINDOW + 1 };

/* Simulated robot: states of the velocity model, commands within the dead time, pose and twist. */
typedef struct {
    real state[DDMPC_STATES];
    real commands[COMMANDS][2]; /* newest last */
    real pose[3], twist[2];
} robot;

static void move(const ddmpc_controller *model, robot *r, const real command[2])
{
    /* No slip: the gains are one, the other coefficients zero. */
    const real slip[FLAT_SLIPS] = {R(0.0), R(1.0), R(1.0), R(1.0)};
    const real dt = (real)ddmpc_this_constants.sample_time, acceleration = R(0.0);
    static real next[DDMPC_STATES], jacobian[DDMPC_STATES * (DDMPC_STATES + 2 * COMMANDS)];
    real twist[2], mean[2], displacement[3];
    memmove(r->commands, r->commands + 1, (COMMANDS - 1) * sizeof r->commands[0]);
    memcpy(r->commands[COMMANDS - 1], command, sizeof r->commands[0]);
    ddmpc_velocity_step(model, r->state, r->commands[COMMANDS - 1], 0, next, 0, jacobian);
    memcpy(r->state, next, sizeof next);
    ddmpc_velocity_output(model, r->state, twist, 0);
    for (int channel = 0; channel < 2; channel++)
        mean[channel] = R(0.5) * (r->twist[channel] + twist[channel]);
    const real *arguments[5] = {mean, slip, r->pose + 2, &acceleration, &dt};
    real *results[2] = {displacement, 0};
    ddmpc_f_move(arguments, results, 0, 0, 0);
    for (int i = 0; i < 3; i++)
        r->pose[i] += displacement[i];
    memcpy(r->twist, twist, sizeof twist);
}

static void measure(const robot *r, ddmpc_time t, ddmpc_input *input)
{
    memcpy(input->pose.value, r->pose, sizeof r->pose);
    input->wheels.value[0] = r->twist[0];
    input->wheels.value[1] = ddmpc_this_constants.wheel_yaw_ratio * r->twist[1];
    input->yaw_rate.value[0] = r->twist[1];
    input->pose.stamp = input->wheels.stamp = input->yaw_rate.stamp = t;
    input->pose.present = input->wheels.present = input->yaw_rate.present = 1;
}

int main(void)
{
    static robot robot;
    static ddmpc_input input;
    const ddmpc_reference reference = ddmpc_reference_of(&DDMPC_TRAJECTORY);
    ddmpc_controller *controller = ddmpc_open();
    real target[3], twist[2], arc_length, max_error = R(0.0);
    int mode = DDMPC_STOPPED;

    reference.sample(reference.context, 0.0, robot.pose, twist, &arc_length);
    if (!ddmpc_follow(controller, &reference, 0.0)) {
        puts("the reference exceeds the limits");
        return 1;
    }
    for (int k = 0; mode != DDMPC_FINISHED && k < 1000000; k++) {
        const ddmpc_time t = k * ddmpc_this_constants.sample_time;
        measure(&robot, t, &input);
        const ddmpc_result *result = ddmpc_tick(controller, t, &input);
        reference.sample(reference.context, t, target, twist, &arc_length);
        const real error = ddmpc_hypot(robot.pose[0] - target[0], robot.pose[1] - target[1]);
        max_error = ddmpc_max(max_error, error);
        mode = result->mode;
        if (k % 50 == 0)
            printf("%6.2f s  v_ref %6.3f m/s  omega_ref %6.3f rad/s  mode %d  %3d iterations  error %.4f m\n", t,
                   (double)result->command[0], (double)result->command[1], mode, result->solver.iterations,
                   (double)error);
        move(controller, &robot, result->command);
    }
    printf("%s, maximum error %.4f m\n", mode == DDMPC_FINISHED ? "finished" : "not finished", (double)max_error);
    return mode != DDMPC_FINISHED;
}
