/* Drives a robot that obeys its velocity model exactly along the exported trajectory, with exact sensors. */
#include <stdio.h>

#include "constants.h"
#include "ddmpc.h"
#include "trajectory.h"

/* The robot: states of the velocity model, commands on their way, pose. */
typedef struct {
    real state[DDMPC_STATES];
    real sent[DDMPC_MEMORY + 1][2]; /* newest last */
    real pose[3], twist[2];
} robot;

static void move(robot *r, const real command[2])
{
    const ddmpc_estimation *model = &ddmpc_this_estimation;
    const int delay[2] = {DDMPC_DELAY_V, DDMPC_DELAY_OMEGA};
    real next[DDMPC_STATES], before[2] = {r->twist[0], r->twist[1]};
    for (int k = 0; k < DDMPC_MEMORY; k++)
        for (int channel = 0; channel < 2; channel++)
            r->sent[k][channel] = r->sent[k + 1][channel];
    for (int channel = 0; channel < 2; channel++)
        r->sent[DDMPC_MEMORY][channel] = command[channel];
    for (int i = 0; i < DDMPC_STATES; i++) {
        next[i] = R(0.0);
        for (int j = 0; j < DDMPC_STATES; j++)
            next[i] += model->A[i][j] * r->state[j];
        for (int channel = 0; channel < 2; channel++) {
            int newest = DDMPC_MEMORY - delay[channel];
            next[i] += model->B0[i][channel] * r->sent[newest][channel];
            next[i] += model->B1[i][channel] * r->sent[newest - 1][channel];
        }
    }
    for (int i = 0; i < DDMPC_STATES; i++)
        r->state[i] = next[i];
    for (int channel = 0; channel < 2; channel++) {
        r->twist[channel] = R(0.0);
        for (int i = 0; i < DDMPC_STATES; i++)
            r->twist[channel] += model->C[channel][i] * next[i];
    }
    real v = R(0.5) * (before[0] + r->twist[0]), turn = R(0.5) * (before[1] + r->twist[1]) * model->dt;
    real half = r->pose[2] + R(0.5) * turn, u = R(0.5) * turn;
    real chord = v * model->dt * (ddmpc_fabs(u) < R(1e-3) ? R(1.0) - u * u / R(6.0) : ddmpc_sin(u) / u);
    r->pose[0] += chord * ddmpc_cos(half);
    r->pose[1] += chord * ddmpc_sin(half);
    r->pose[2] += turn;
}

static void measure(const robot *r, ddmpc_time t, ddmpc_measurement *m)
{
    for (int i = 0; i < 3; i++)
        m->pose.value[i] = r->pose[i];
    m->wheels.value[0] = r->twist[0];
    m->wheels.value[1] = ddmpc_this_estimation.wheel_yaw_ratio * r->twist[1];
    m->yaw_rate.value[0] = r->twist[1];
    m->pose.stamp = m->wheels.stamp = m->yaw_rate.stamp = t;
    m->pose.present = m->wheels.present = m->yaw_rate.present = 1;
}

int main(void)
{
    static ddmpc_controller controller;
    static ddmpc_result result;
    static robot robot;
    ddmpc_reference reference = ddmpc_table_reference(&DDMPC_TRAJECTORY);
    ddmpc_input input = {0};
    real target[3], twist[2], worst = R(0.0);

    reference.sample(reference.context, 0.0, robot.pose, twist);
    ddmpc_init(&controller);
    if (!ddmpc_start(&controller, &reference, 0.0)) {
        puts("the reference is faster than the limits");
        return 1;
    }
    for (int k = 0; result.mode != DDMPC_FINISHED && k < 1000000; k++) {
        ddmpc_time t = k * ddmpc_this_settings.sample_time;
        measure(&robot, t, &input.measurement);
        ddmpc_step(&controller, t, &input, &result);
        reference.sample(reference.context, t, target, twist);
        real error = ddmpc_hypot(robot.pose[0] - target[0], robot.pose[1] - target[1]);
        worst = ddmpc_max(worst, error);
        if (k % 50 == 0)
            printf("%6.2f s  v_ref %6.3f m/s  omega_ref %6.3f rad/s  mode %d  %3d iterations  error %.4f m\n", t,
                   (double)result.command[0], (double)result.command[1], (int)result.mode, result.solver.iterations,
                   (double)error);
        move(&robot, result.command);
    }
    printf("%s, largest error %.4f m\n", result.mode == DDMPC_FINISHED ? "finished" : "not finished", (double)worst);
    return result.mode != DDMPC_FINISHED;
}
