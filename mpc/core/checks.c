/* Plausibility checks of measurements: stamps, finite numbers, ranges and jumps. The result contains a note on each
 * rejected measurement, which the filter does not use. Thresholds are in mpc/config/core_thresholds.yaml; maximum values
 * and jumps are in the group `estimator` of the configuration. */
#include <string.h>

#include "internal.h"

void ddmpc_reject(ddmpc_result *result, int subject, int fault, real a, real b)
{
    if (result->notes < DDMPC_NOTES) {
        const ddmpc_note note = {a, b, subject, fault};
        result->note[result->notes++] = note;
    }
}

static int all_finite(const real *values, int count)
{
    for (int i = 0; i < count; i++)
        if (!isfinite(values[i]))
            return 0;
    return 1;
}

/* Return 1 if the k x k `entries` form a symmetric positive definite matrix, by the signs of the pivots of an
 * elimination. */
static int is_valid_covariance(const ddmpc_constants *constants, const real *entries, int k)
{
    real work[9];
    if (!all_finite(entries, k * k))
        return 0;
    for (int i = 0; i < k * k; i++) {
        const int mirrored = i % k * k + i / k;
        if (ddmpc_fabs(entries[i]) > constants->largest_variance)
            return 0;
        if (ddmpc_fabs(entries[i] - entries[mirrored]) > constants->largest_asymmetry * ddmpc_fabs(entries[i]))
            return 0;
        work[i] = entries[i];
    }
    for (int p = 0; p < k; p++) {
        if (!(work[p * k + p] > R(0.0)))
            return 0;
        for (int i = p + 1; i < k; i++)
            for (int j = p + 1; j <= i; j++)
                work[i * k + j] -= work[i * k + p] * work[j * k + p] / work[p * k + p];
    }
    return 1;
}

/* Check a stamp of `subject` at tick `t`, with the previous stamp `last`; return the fault, and the value for its message
 * in `number`. */
static int stamp_fault(const ddmpc_constants *constants, int subject, ddmpc_time stamp, ddmpc_time t, ddmpc_time last,
                       real *number)
{
    const ddmpc_time age = t - stamp;
    if (!isfinite(stamp))
        return DDMPC_BAD_STAMP;
    *number = (real)age;
    if (age < -constants->clock_error) {
        *number = (real)-age;
        return DDMPC_IN_FUTURE;
    }
    if (stamp <= last)
        return DDMPC_NOT_NEWER;
    *number += (real)constants->sensor_delay[subject];
    if (age + constants->sensor_delay[subject] > (ddmpc_time)constants->stamp_history)
        return DDMPC_TOO_OLD;
    return DDMPC_NO_FAULT;
}

int ddmpc_check_pose(ddmpc_controller *c, ddmpc_time t, const ddmpc_stamped *pose, ddmpc_checked_pose *checked)
{
    const ddmpc_constants *constants = c->constants;
    ddmpc_estimator *estimator = &c->estimator;
    real number = R(0.0);
    if (!pose->present)
        return 0;
    int fault = stamp_fault(constants, DDMPC_OF_POSE, pose->stamp, t, estimator->pose_stamp, &number);
    if (!all_finite(pose->value, 3))
        fault = DDMPC_NOT_NUMBERS;
    else if (pose->has_covariance && !is_valid_covariance(constants, pose->covariance, 3))
        fault = DDMPC_BAD_COVARIANCE;
    if (fault == DDMPC_TOO_OLD)
        estimator->too_old = (ddmpc_time)number;
    if (fault != DDMPC_NO_FAULT) {
        ddmpc_reject(&c->result, DDMPC_OF_POSE, fault, number, R(0.0));
        return 0;
    }
    estimator->pose_stamp = checked->stated = pose->stamp;
    checked->stamp = pose->stamp - constants->sensor_delay[DDMPC_OF_POSE];
    memcpy(checked->value, pose->value, sizeof checked->value);
    checked->value[2] -= constants->sensor_heading;
    checked->doubt[0] = checked->doubt[1] = R(1.0);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            checked->covariance[i][j] = pose->has_covariance ? pose->covariance[3 * i + j]
                                        : i == j             ? constants->pose_variance[i]
                                                             : R(0.0);
    return 1;
}

/* Check a message with the readings of `count` sensors, starting with the sensor `first`. */
static int check_twist(ddmpc_controller *c, int subject, int first, int count, ddmpc_time *last_stamp, real *last,
                       ddmpc_time t, const ddmpc_stamped *stamped, ddmpc_checked_twist *checked)
{
    const ddmpc_constants *constants = c->constants;
    real a = R(0.0), b = R(0.0), value[2];
    if (!stamped->present)
        return 0;
    for (int i = 0; i < count; i++)
        value[i] = stamped->value[i] / constants->sensor_scale[first + i];
    int fault = stamp_fault(constants, subject, stamped->stamp, t, *last_stamp, &a);
    if (!all_finite(stamped->value, count)) {
        fault = DDMPC_NOT_NUMBERS;
    } else {
        /* Find the first number out of range; the loop has at most `count` iterations. */
        int excess = 0;
        while (excess < count && !(ddmpc_fabs(value[excess]) > constants->largest_twist[first + excess]))
            excess++;
        if (excess < count) {
            fault = DDMPC_TOO_LARGE;
            a = value[excess];
            b = constants->largest_twist[first + excess];
        } else if (stamped->has_covariance && !is_valid_covariance(constants, stamped->covariance, count)) {
            fault = DDMPC_BAD_COVARIANCE;
        }
    }
    for (int i = 0; i < count && fault == DDMPC_NO_FAULT; i++)
        /* The speed of a robot that hits a wall jumps but then stays constant, so the next sample is accepted. */
        if (ddmpc_fabs(value[i] - last[i]) > constants->largest_twist_jump[first + i]) {
            fault = DDMPC_JUMPS;
            a = last[i];
            b = value[i];
        }
    if (fault == DDMPC_NO_FAULT || fault == DDMPC_JUMPS) {
        *last_stamp = stamped->stamp;
        memcpy(last, value, (size_t)count * sizeof(real));
    }
    ddmpc_monitor_count(c, subject, fault == DDMPC_TOO_LARGE || fault == DDMPC_JUMPS);
    if (fault != DDMPC_NO_FAULT) {
        ddmpc_reject(&c->result, subject, fault, a, b);
        return 0;
    }
    for (int i = 0; i < count; i++) {
        checked[i].sensor = first + i;
        checked[i].stamp = stamped->stamp - constants->sensor_delay[subject];
        const real scale = constants->sensor_scale[first + i];
        checked[i].value = value[i];
        checked[i].variance = stamped->has_covariance ? stamped->covariance[i * (count + 1)] / (scale * scale)
                                                      : constants->twist_variance[first + i];
    }
    return count;
}

int ddmpc_check_wheels(ddmpc_controller *c, ddmpc_time t, const ddmpc_stamped *wheels, ddmpc_checked_twist checked[2])
{
    return check_twist(c, DDMPC_OF_WHEELS, WHEEL_SPEED, 2, &c->estimator.wheels_stamp, c->estimator.last_wheels, t,
                       wheels, checked);
}

int ddmpc_check_yaw_rate(ddmpc_controller *c, ddmpc_time t, const ddmpc_stamped *rate, ddmpc_checked_twist checked[1])
{
    return check_twist(c, DDMPC_OF_YAW_RATE, YAW_RATE, 1, &c->estimator.yaw_rate_stamp, &c->estimator.last_yaw_rate, t,
                       rate, checked);
}

static int differs(const ddmpc_constants *constants, const real value[3], const real expected[3])
{
    const real distance = ddmpc_hypot(value[0] - expected[0], value[1] - expected[1]);
    const real turn = ddmpc_fabs(ddmpc_wrap(value[2] - expected[2]));
    /* Negated so that NaN counts as different. */
    return !(distance <= constants->largest_position_jump && turn <= constants->largest_heading_jump);
}

int ddmpc_pose_passes(ddmpc_controller *c, const ddmpc_checked_pose *pose, const real expected[3])
{
    const ddmpc_constants *constants = c->constants;
    ddmpc_estimator *estimator = &c->estimator;
    if (!differs(constants, pose->value, expected)) {
        ddmpc_accept_pose(c, pose);
        return 1;
    }
    if (estimator->jumps > 0 && differs(constants, pose->value, estimator->jump_poses[estimator->jumps - 1].value))
        estimator->jumps = 0;
    if (estimator->jumps == AGREEING) {
        memmove(estimator->jump_poses, estimator->jump_poses + 1, (AGREEING - 1) * sizeof estimator->jump_poses[0]);
        estimator->jumps--;
    }
    estimator->jump_poses[estimator->jumps++] = *pose;
    ddmpc_reject(&c->result, DDMPC_OF_POSE, DDMPC_JUMPS,
                 ddmpc_hypot(pose->value[0] - expected[0], pose->value[1] - expected[1]),
                 ddmpc_fabs(ddmpc_wrap(pose->value[2] - expected[2])));
    return 0;
}

/* Check whether the previous pose was older than max_pose_age when this pose arrived. If this happens again within
 * rated_poses poses, poses count as too rare; a single occurrence is a drop-out. */
static void update_pose_rate(ddmpc_controller *c, ddmpc_time stamp)
{
    ddmpc_estimator *estimator = &c->estimator;
    const ddmpc_time interval = stamp - estimator->accepted_stamp, latency = c->last_tick - stamp;
    const ddmpc_time oldest = interval + latency - c->constants->sample_time;
    if (!isfinite(interval))
        return;
    const int overdue = oldest > (ddmpc_time)c->constants->max_pose_age;
    if (overdue) {
        estimator->pose_interval = interval;
        estimator->pose_latency = latency;
        estimator->rare = estimator->rare || estimator->overdue != 0;
    }
    estimator->overdue = (estimator->overdue << 1 | (unsigned int)overdue) & ((1U << c->constants->rated_poses) - 1U);
    estimator->rare = estimator->rare && estimator->overdue != 0;
}

void ddmpc_accept_pose(ddmpc_controller *c, const ddmpc_checked_pose *pose)
{
    /* Use the stamp of the message: an estimated delay must not make a pose too old. */
    update_pose_rate(c, pose->stated);
    c->estimator.accepted_stamp = pose->stated;
    c->estimator.too_old = 0.0;
    c->estimator.jumps = 0;
}
