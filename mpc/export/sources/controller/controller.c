/* One tick straight down from measurement to command, and what happens when a part of it fails. */
#include "ddmpc.h"

#include <string.h>

#include "command_limits.h"
#include "planner.h"
#include "progress.h"

/* A spline through timed poses may ring a little over its limit. */
#define SPEED_EXCESS R(1.01)

static void forget(ddmpc_controller *c)
{
    ddmpc_estimator_forget(&c->estimator);
    ddmpc_planner_reset(c);
    ddmpc_clock_restart(&c->clock);
    c->plan_age = -1;
    c->has_result = c->has_driven = c->latched = c->finished = 0;
}

void ddmpc_init(ddmpc_controller *c)
{
    memset(c, 0, sizeof *c);
    ddmpc_reset(c);
}

void ddmpc_reset(ddmpc_controller *c)
{
    ddmpc_estimator_init(&c->estimator);
    forget(c);
    c->last[0] = c->last[1] = R(0.0);
}

static int keeps_limits(const ddmpc_reference *reference)
{
    for (ddmpc_time t = 0.0; t <= reference->duration; t += ddmpc_this_settings.sample_time) {
        real pose[3], twist[2];
        reference->sample(reference->context, t, pose, twist);
        for (int channel = 0; channel < 2; channel++)
            if (!(ddmpc_fabs(twist[channel]) <= SPEED_EXCESS * ddmpc_this_tracking.largest_command[channel]))
                return 0;
    }
    return 1;
}

int ddmpc_start(ddmpc_controller *c, const ddmpc_reference *reference, ddmpc_time t0)
{
    if (!isfinite(t0) || !isfinite(reference->duration) || !keeps_limits(reference))
        return 0;
    forget(c);
    c->reference = *reference;
    c->t0 = t0;
    c->has_reference = 1;
    return 1;
}

/* The command ramps to zero. */
static void ramp(const ddmpc_controller *c, ddmpc_result *result)
{
    const real zero[2] = {R(0.0), R(0.0)};
    ddmpc_clip_command(zero, c->last, result->command);
}

static void brake(ddmpc_controller *c, ddmpc_result *result, unsigned int reason, int failure)
{
    result->reasons |= reason;
    c->plan_age = -1;
    ddmpc_planner_reset(c);
    /* Waiting for the first pose is no failure to be latched. */
    c->latched = c->latched || (failure && c->has_driven && ddmpc_this_settings.resume <= R(0.0));
    ramp(c, result);
    result->mode = result->command[0] != R(0.0) || result->command[1] != R(0.0) ? DDMPC_BRAKING : DDMPC_STOPPED;
}

static void stand(ddmpc_result *result)
{
    result->command[0] = result->command[1] = R(0.0);
    result->mode = DDMPC_STOPPED;
}

/* What the robot really got, as far as it lies inside the limits: from outside them there is no slew back. */
static void take_slew_base(ddmpc_controller *c)
{
    for (int channel = 0; channel < 2; channel++) {
        real got = c->estimator.commands[DDMPC_COMMANDS - 1][channel];
        real largest = ddmpc_max(ddmpc_this_tracking.largest_command[channel], ddmpc_fabs(c->last[channel]));
        c->last[channel] = ddmpc_min(ddmpc_max(got, -largest), largest);
    }
}

/* Take the robot to be where its rejected poses agree it is, once it has been told to stand. */
static int restart_elsewhere(ddmpc_controller *c)
{
    for (int k = DDMPC_COMMANDS - DDMPC_MEMORY; k < DDMPC_COMMANDS; k++)
        if (c->estimator.commands[k][0] != R(0.0) || c->estimator.commands[k][1] != R(0.0))
            return 0;
    return ddmpc_this_settings.resume > R(0.0) && ddmpc_estimator_restart_elsewhere(&ddmpc_this_estimation, &c->estimator);
}

static void track(ddmpc_controller *c, ddmpc_time time, ddmpc_result *result)
{
    int usable = (int)ddmpc_min(ddmpc_this_settings.max_reused_ticks, (real)(DDMPC_STEPS - 1));
    if (ddmpc_planner_plan(c, time, &result->solver)) {
        c->plan_age = 0;
        result->mode = DDMPC_TRACKING;
    } else {
        result->reasons |= DDMPC_SOLVE_FAILED;
        if (c->plan_age < 0 || ++c->plan_age > usable) {
            brake(c, result, 0, 1);
            return;
        }
        result->mode = DDMPC_REUSED_PLAN;
    }
    ddmpc_clip_command(c->plan + 2 * c->plan_age, c->last, result->command);
}

static void take_estimate(ddmpc_controller *c)
{
    c->result.has_estimate = ddmpc_estimator_ready(&c->estimator);
    if (c->result.has_estimate)
        ddmpc_estimator_estimate(&ddmpc_this_estimation, &c->estimator, &c->result.estimate);
}

static void new_tick(ddmpc_controller *c, ddmpc_time t, const ddmpc_input *input, ddmpc_result *result)
{
    ddmpc_time time = t - c->t0;
    if (input->has_sent) {
        if (!ddmpc_estimator_correct_sent(&ddmpc_this_estimation, &c->estimator, input->sent))
            result->reasons |= DDMPC_SENT_REJECTED;
        take_slew_base(c);
    }
    ddmpc_estimator_advance(&ddmpc_this_estimation, &c->estimator, t);
    ddmpc_estimator_update(&ddmpc_this_estimation, &c->estimator, t, &input->measurement, &result->notes);
    if (input->request != DDMPC_DRIVE) {
        brake(c, result, DDMPC_HELD, input->request == DDMPC_STOP_AS_FAILURE);
        return;
    }
    if (!ddmpc_estimator_ready(&c->estimator)) {
        brake(c, result, DDMPC_NO_POSE, 1);
        return;
    }
    if (ddmpc_estimator_moved(&c->estimator) && !restart_elsewhere(c)) {
        brake(c, result, DDMPC_ELSEWHERE, 1);
        return;
    }
    take_estimate(c);
    const real *pose = c->result.estimate.mean + DDMPC_POSE;
    if (!(isfinite(pose[0]) && isfinite(pose[1]) && isfinite(pose[2]))) {
        ddmpc_estimator_forget(&c->estimator);
        brake(c, result, DDMPC_LOST, 1);
    } else if (c->result.estimate.pose_age > ddmpc_this_settings.max_pose_age) {
        brake(c, result, DDMPC_OLD_POSE, 1);
    } else if (c->latched) {
        brake(c, result, DDMPC_LATCHED, 1);
    } else if (ddmpc_is_finished(c, time, result)) {
        ramp(c, result);
        result->mode = DDMPC_FINISHED;
    } else if (ddmpc_near_reference(c, time)) {
        track(c, time, result);
    } else {
        brake(c, result, DDMPC_TOO_FAR, 1);
    }
}

/* Brake: this tick tells nothing. Where the clock leapt, stand: a base without commands has stopped itself. */
static void lost_time(ddmpc_controller *c, ddmpc_tick_kind kind, ddmpc_result *result)
{
    unsigned int reason = kind == DDMPC_TICK_FAULTY ? DDMPC_TIME_FAULTY
                          : kind == DDMPC_TICK_LEAPT ? DDMPC_TIME_LEAPT
                                                     : DDMPC_TIME_PAUSED;
    brake(c, result, reason, 1);
    if (kind == DDMPC_TICK_PAUSED)
        ddmpc_estimator_init(&c->estimator);
    if (kind != DDMPC_TICK_FAULTY)
        stand(result);
}

static void clear(ddmpc_result *result)
{
    const ddmpc_report not_run = {DDMPC_QP_NOT_RUN, 0, R(0.0), R(0.0), 0, 0};
    result->solver = not_run;
    result->reasons = 0;
    result->notes.count = 0;
    result->has_estimate = 0;
}

void ddmpc_step(ddmpc_controller *c, ddmpc_time t, const ddmpc_input *input, ddmpc_result *result)
{
    ddmpc_result *now = &c->result;
    if (!c->has_reference) {
        clear(now);
        stand(now);
        now->reasons = DDMPC_NO_REFERENCE;
        *result = *now;
        return;
    }
    ddmpc_tick_kind kind = ddmpc_clock_judge(&c->clock, t);
    if (kind == DDMPC_TICK_REPEATED && c->has_result) {
        now->notes.count = 0;
        ddmpc_estimator_update(&ddmpc_this_estimation, &c->estimator, t, &input->measurement, &now->notes);
        now->reasons = DDMPC_TIME_REPEATED | (now->notes.count ? DDMPC_MEASUREMENT_REJECTED : 0u);
        *result = *now;
        return;
    }
    clear(now);
    if (kind == DDMPC_TICK_NEW) {
        new_tick(c, t, input, now);
        ddmpc_estimator_append(&c->estimator, now->command);
    } else {
        lost_time(c, kind, now);
        /* No interval of the model begins here: the command in force since the last tick has changed. */
        ddmpc_estimator_correct_last(&c->estimator, now->command);
    }
    if (now->notes.count)
        now->reasons |= DDMPC_MEASUREMENT_REJECTED;
    memcpy(c->last, now->command, sizeof c->last);
    c->has_driven = c->has_driven || now->mode == DDMPC_TRACKING;
    take_estimate(c);
    c->has_result = 1;
    *result = *now;
}
