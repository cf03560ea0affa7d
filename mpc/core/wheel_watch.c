/* Detection of wheels at their speed or force limit: wheels that are slower than reference and commands demand, and the
 * speed that they attain. Speeds are rim speeds: v + b omega on the right, v - b omega on the left; b is half the track.
 * mpc/config/sensor_test.yaml documents the thresholds. */
#include <string.h>

#include "internal.h"

/* Compute the rim speeds of the right and left wheels for a twist of the body. */
static void rim_speeds(const ddmpc_controller *c, const real *twist, real rim[2])
{
    real parameters[DDMPC_MAX_SLIPS + 1], value[BUILT_IN_SOFT];
    const real origin[4] = {R(0.0), R(0.0), R(0.0), R(0.0)};
    const real *arguments[5] = {origin, twist, 0, origin, parameters};
    real *results[2] = {value, 0};
    memcpy(parameters, c->result.estimate.mean + STATES(c), (size_t)SLIPS(c) * sizeof(real));
    parameters[SLIPS(c)] = c->constants->half_track;
    WITH_SLIP(c, soft)(arguments, results, 0, 0, 0);
    rim[0] = value[2];
    rim[1] = value[3];
}

/* Compute the minimum and maximum speeds that commands have demanded of each wheel, in the directions `sign`, and the
 * maximum |v|. The period is the last lag plus short_for, or plus 4/3 of the lag if this is longer, since slow wheels
 * that still accelerate have no deficit. Returns 0 if the stored commands do not cover this period. The extremes of v and
 * omega are computed separately, since v and omega have different lags: if a turn starts while the robot accelerates, the
 * inner wheel is slower than any single command demands. Wheels turn as the model predicts, since slip affects only the
 * body. In a turn on the spot, wheels may also turn with the estimated gain. In other motions this is not considered,
 * since a saturated wheel has the same effect on the estimate as a smaller gain. */
static int demanded_speeds(const ddmpc_controller *c, const real sign[2], real lowest[2], real highest[2],
                           real *max_forward)
{
    const real *G = c->constants->inverse_gain, *slip = c->result.estimate.mean + STATES(c);
    const real determinant = G[0] * G[3] - G[1] * G[2], gain = c->on_spot ? slip[OMEGA_GAIN] * slip[YAW_GAIN] : R(1.0);
    const int newest = COMMANDS(c) - 1;
    const int steady = (int)(c->constants->short_for / (real)c->constants->sample_time),
              settling = 4 * LONGEST_LAG(c) / 3;
    const int samples = LONGEST_LAG(c) + (steady > settling ? steady : settling);
    if (samples > newest)
        return 0;
    real low[2][2], high[2][2];
    for (int i = 0; i < 4; i++) {
        low[i / 2][i % 2] = (real)HUGE_VAL;
        high[i / 2][i % 2] = -(real)HUGE_VAL;
    }
    *max_forward = R(0.0);
    for (int age = 0; age <= samples; age++) {
        const real *u = c->estimator.commands + 2 * (newest - age);
        const real forward = (G[3] * u[0] - G[2] * u[1]) / determinant;
        const real turning = c->constants->half_track * (G[0] * u[1] - G[1] * u[0]) / determinant;
        *max_forward = ddmpc_max(*max_forward, ddmpc_fabs(forward));
        for (int i = 0; i < 2; i++) {
            const real along = sign[i] * forward, plain = i ? -sign[i] * turning : sign[i] * turning;
            low[i][0] = ddmpc_min(low[i][0], along);
            high[i][0] = ddmpc_max(high[i][0], along);
            low[i][1] = ddmpc_min(low[i][1], ddmpc_min(plain, gain * plain));
            high[i][1] = ddmpc_max(high[i][1], ddmpc_max(plain, gain * plain));
        }
    }
    for (int i = 0; i < 2; i++) {
        lowest[i] = low[i][0] + low[i][1];
        highest[i] = high[i][0] + high[i][1];
    }
    return 1;
}

/* Return the wheel with the largest deficit from the speed that reference and commands demand, or -1; `demanded` is the
   commanded speed in the wheel's direction. A wheel that hardly turns is blocked or faulty, and a wheel that stops passes
   through all speeds, so both are ignored. With similar deficits the previous wheel is returned. */
static int saturated_wheel(const ddmpc_controller *c, const real by_reference[2], const real read[2], real *demanded)
{
    const ddmpc_constants *k = c->constants;
    const real sign[2] = {by_reference[0] < R(0.0) ? R(-1.0) : R(1.0), by_reference[1] < R(0.0) ? R(-1.0) : R(1.0)};
    real lowest[2], highest[2], forward, max_rank = R(0.0);
    int wheel = -1;
    if (!demanded_speeds(c, sign, lowest, highest, &forward))
        return -1;
    /* A saturated wheel reduces the forward speed by half its deficit; a different yaw gain does not reduce it. */
    const real slower = c->on_spot ? (real)HUGE_VAL : forward - R(0.5) * ddmpc_fabs(c->rim[0] + c->rim[1]);
    for (int i = 0; i < 2; i++) {
        const real along = sign[i] * c->rim[i], target = ddmpc_min(sign[i] * by_reference[i], lowest[i]);
        const real deficit = target - along, rank = deficit + (i == c->saturated_wheel ? k->short_by[0] : R(0.0));
        /* Wheels that are faster than demanded follow the commands of another node. */
        if (along > highest[i] + k->short_by[0])
            return -1;
        if (along > k->stuck * target && deficit > k->short_by[1] * target && deficit > k->short_by[0] &&
            rank > max_rank && slower > k->slower * deficit && ddmpc_fabs(read[i] - c->rim[i]) < k->steady * target) {
            max_rank = rank;
            wheel = i;
            *demanded = lowest[i];
        }
    }
    return wheel;
}

/* Return 1 if a larger command has not accelerated `wheel`; a wheel with a different gain would accelerate. */
static int is_saturated(ddmpc_controller *c, int wheel, real demanded)
{
    const ddmpc_constants *k = c->constants;
    const real speed = ddmpc_fabs(c->rim[wheel]), more = demanded - c->trial_demand, gained = speed - c->trial_speed;
    if (wheel != c->saturated_wheel || more < R(0.0) ||
        (more > k->trial[0] * demanded && gained > k->trial[1] * more)) {
        c->saturated_wheel = wheel;
        c->trial_demand = demanded;
        c->trial_speed = speed;
        return 0;
    }
    return more > k->trial[0] * demanded;
}

static void drop_limit(ddmpc_controller *c) { c->reach = c->rim_reach = (real)HUGE_VAL; }

/* Maximum rim speed that the reference demands over the horizon [m/s]. */
static real needed_speed(const ddmpc_controller *c)
{
    const real lever = c->constants->half_track / c->result.estimate.mean[STATES(c) + YAW_GAIN];
    real highest = R(0.0);
    for (int i = 0; i <= STEPS(c); i++) {
        const real *twist = c->reference_twist + 2 * i;
        highest = ddmpc_max(highest, ddmpc_fabs(twist[0]) + lever * ddmpc_fabs(twist[1]));
    }
    return highest;
}

/* Slow the reference down while wheels are at their speed or force limit. The attained speed is learned from the
 * encoders, since on slippery surfaces the estimate relies more on the gyro. After the reference has been slowed down for
 * longer than `retry`, the limit is raised gradually: if the wheel follows, the limit is discarded; otherwise it is
 * learned again. */
void ddmpc_watch_wheels(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    const real *target = c->reference_twist + 2;
    const real *wheels = c->estimator.last_wheels, turning = k->half_track * wheels[1] / k->wheel_yaw_ratio;
    const real read[2] = {wheels[0] + turning, wheels[0] - turning}, needed = needed_speed(c);
    const int on_spot = ddmpc_fabs(target[0]) < k->on_spot * k->half_track * ddmpc_fabs(target[1]);
    real by_reference[2], demanded = R(0.0);
    int wheel = -1;
    for (int i = 0; i < 2; i++)
        c->rim[i] += k->smoothed * (read[i] - c->rim[i]);
    /* A limit that was learned in a turn on the spot does not apply to other motions, and vice versa. */
    if (c->on_spot != on_spot) {
        drop_limit(c);
        c->trial_demand = (real)HUGE_VAL;
    }
    c->on_spot = on_spot;
    /* Wheels with a different gain are also slower than the model, but the robot then keeps up with its reference. */
    const ddmpc_stray stray = ddmpc_stray_from(c, c->reference_pose + 3, target);
    const int behind = stray.late > k->astray[0] || ddmpc_fabs(stray.across) > k->astray[1] * k->band || stray.outside;
    if (k->wheel_limits && (behind || isfinite(c->rim_reach)) && c->plan_age == 0 &&
        c->last_tick - c->estimator.wheels_stamp < (ddmpc_time)k->short_for) {
        rim_speeds(c, target, by_reference);
        wheel = saturated_wheel(c, by_reference, read, &demanded);
    }
    if (wheel >= 0 && is_saturated(c, wheel, demanded)) {
        c->rim_reach = ddmpc_fabs(c->rim[wheel]);
        c->slowed = R(0.0);
    } else if (needed > k->slowed * c->reach) {
        c->slowed += (real)k->sample_time;
    }
    const real growth = k->regain[0] * c->rim_reach + k->regain[1];
    c->reach = c->rim_reach + (c->slowed > k->retry ? growth * (c->slowed - k->retry) : R(0.0));
    /* Discard the limit if the wheel is faster than the limit, if the path demands much less, or while the encoders are
     * excluded. */
    const int faster =
        ddmpc_fabs(c->rim[c->saturated_wheel]) > c->rim_reach * (R(1.0) + k->short_by[1]) + k->short_by[0];
    if (!k->wheel_limits || faster || needed < k->far_below * c->rim_reach || !(c->rim_reach < k->soft_upper[2]) ||
        c->result.reasons & DDMPC_WHEELS_EXCLUDED)
        drop_limit(c);
    c->result.reach = c->reach;
}
