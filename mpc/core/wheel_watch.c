/* Wheels at their speed or force limit: which wheel falls short of the speed that reference and commands demand, and
 * what speed it attains. Speeds are at the rim: v + b omega on the right, v - b omega on the left; b is half the track.
 * mpc/config/sensor_test.yaml explains the numbers of the test. */
#include <string.h>

#include "internal.h"

/* Speeds of the right and left wheels at the rim for a twist of the body. */
static void rims(const ddmpc_controller *c, const real *twist, real rim[2])
{
    real parameters[DDMPC_MOST_SLIPS + 1], value[SHIPPED_SOFT];
    const real nowhere[4] = {R(0.0), R(0.0), R(0.0), R(0.0)};
    const real *arguments[5] = {nowhere, twist, 0, nowhere, parameters};
    real *results[2] = {value, 0};
    memcpy(parameters, c->result.estimate.mean + STATES(c), (size_t)SLIPS(c) * sizeof(real));
    parameters[SLIPS(c)] = c->constants->half_track;
    WITH_SLIP(c, soft)(arguments, results, 0, 0, 0);
    rim[0] = value[2];
    rim[1] = value[3];
}

/* The smallest and largest speeds that commands have demanded of each wheel, in the directions `sign`, and the
 * largest |v| that they have demanded of the robot: over the last lag plus short_for, or plus 4/3 of the lag where
 * that is longer, since slow wheels that are still accelerating do not fall short. Returns 0 if the stored commands
 * do not reach back that far. v and omega count separately, since they show after different lags: the wheel inside a
 * turn that begins while the robot speeds up is slower than any pair demands. Wheels turn as the model states: the
 * body slips, not they. In a turn on the spot they may also turn with the estimated gain; elsewhere a saturated wheel
 * has the same effect on the estimate as a smaller gain. */
static int demanded_speeds(const ddmpc_controller *c, const real sign[2], real least[2], real most[2],
                           real *forward_most)
{
    const real *G = c->constants->inverse_gain, *slip = c->result.estimate.mean + STATES(c);
    const real determinant = G[0] * G[3] - G[1] * G[2], gain = c->on_spot ? slip[OMEGA_GAIN] * slip[YAW_GAIN] : R(1.0);
    const int newest = COMMANDS(c) - 1;
    const int steady = (int)(c->constants->short_for / (real)c->constants->sample_time), settling = 4 * LONGEST_LAG(c) / 3;
    const int since = LONGEST_LAG(c) + (steady > settling ? steady : settling);
    if (since > newest)
        return 0;
    real low[2][2], high[2][2];
    for (int i = 0; i < 4; i++) {
        low[i / 2][i % 2] = (real)HUGE_VAL;
        high[i / 2][i % 2] = -(real)HUGE_VAL;
    }
    *forward_most = R(0.0);
    for (int ago = 0; ago <= since; ago++) {
        const real *u = c->estimator.commands + 2 * (newest - ago);
        const real forward = (G[3] * u[0] - G[2] * u[1]) / determinant;
        const real turning = c->constants->half_track * (G[0] * u[1] - G[1] * u[0]) / determinant;
        *forward_most = ddmpc_max(*forward_most, ddmpc_fabs(forward));
        for (int i = 0; i < 2; i++) {
            const real along = sign[i] * forward, plain = i ? -sign[i] * turning : sign[i] * turning;
            low[i][0] = ddmpc_min(low[i][0], along);
            high[i][0] = ddmpc_max(high[i][0], along);
            low[i][1] = ddmpc_min(low[i][1], ddmpc_min(plain, gain * plain));
            high[i][1] = ddmpc_max(high[i][1], ddmpc_max(plain, gain * plain));
        }
    }
    for (int i = 0; i < 2; i++) {
        least[i] = low[i][0] + low[i][1];
        most[i] = high[i][0] + high[i][1];
    }
    return 1;
}

/* The wheel that falls furthest short of what reference and commands demand (`demanded`, in its direction); -1: none. A
   wheel that hardly turns is blocked or dead, and one being stopped passes through all speeds: neither counts. Of two
   that fall short alike it is the one that did before. */
static int short_wheel(const ddmpc_controller *c, const real by_reference[2], const real read[2], real *demanded)
{
    const ddmpc_constants *k = c->constants;
    const real sign[2] = {by_reference[0] < R(0.0) ? R(-1.0) : R(1.0), by_reference[1] < R(0.0) ? R(-1.0) : R(1.0)};
    real least[2], most[2], forward, worst = R(0.0);
    int wheel = -1;
    if (!demanded_speeds(c, sign, least, most, &forward))
        return -1;
    /* One wheel at its end takes half of what it lacks from the forward speed, another yaw gain takes nothing. */
    const real slower = c->on_spot ? (real)HUGE_VAL : forward - R(0.5) * ddmpc_fabs(c->rim[0] + c->rim[1]);
    for (int i = 0; i < 2; i++) {
        const real along = sign[i] * c->rim[i], wanted = ddmpc_min(sign[i] * by_reference[i], least[i]);
        const real lacks = wanted - along, rank = lacks + (i == c->short_wheel ? k->short_by[0] : R(0.0));
        /* Wheels that turn faster than demanded follow the commands of another node. */
        if (along > most[i] + k->short_by[0])
            return -1;
        if (along > k->stuck * wanted && lacks > k->short_by[1] * wanted && lacks > k->short_by[0] && rank > worst &&
            slower > k->slower * lacks && ddmpc_fabs(read[i] - c->rim[i]) < k->steady * wanted) {
            worst = rank;
            wheel = i;
            *demanded = least[i];
        }
    }
    return wheel;
}

/* Return 1 if a larger command gave `wheel` no more speed; a wheel with merely a different gain would speed up. */
static int gains_nothing(ddmpc_controller *c, int wheel, real demanded)
{
    const ddmpc_constants *k = c->constants;
    const real speed = ddmpc_fabs(c->rim[wheel]), more = demanded - c->tried, gained = speed - c->tried_speed;
    if (wheel != c->short_wheel || more < R(0.0) || (more > k->trial[0] * demanded && gained > k->trial[1] * more)) {
        c->short_wheel = wheel;
        c->tried = demanded;
        c->tried_speed = speed;
        return 0;
    }
    return more > k->trial[0] * demanded;
}

static void drop_limit(ddmpc_controller *c) { c->reach = c->rim_reach = (real)HUGE_VAL; }

/* The largest rim speed of the wheels that the reference needs over the horizon. */
static real needed_speed(const ddmpc_controller *c)
{
    const real lever = c->constants->half_track / c->result.estimate.mean[STATES(c) + YAW_GAIN];
    real most = R(0.0);
    for (int i = 0; i <= STEPS(c); i++) {
        const real *twist = c->reference_twist + 2 * i;
        most = ddmpc_max(most, ddmpc_fabs(twist[0]) + lever * ddmpc_fabs(twist[1]));
    }
    return most;
}

/* Wheels at their speed or force limit slow the reference down. The speed that they attain is learned from their
 * encoders (on slippery floors the estimate trusts the gyro more). A reference that is slowed for longer than `retry`
 * may demand more and more: a wheel that follows ends the limit, for one that does not it is learned again. */
void ddmpc_watch_wheels(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    const real *wanted = c->reference_twist + 2;
    const real *wheels = c->estimator.last_wheels, turning = k->half_track * wheels[1] / k->wheel_yaw_ratio;
    const real read[2] = {wheels[0] + turning, wheels[0] - turning}, needed = needed_speed(c);
    const int on_spot = ddmpc_fabs(wanted[0]) < k->on_spot * k->half_track * ddmpc_fabs(wanted[1]);
    real by_reference[2], demanded = R(0.0);
    int wheel = -1;
    for (int i = 0; i < 2; i++)
        c->rim[i] += k->smoothed * (read[i] - c->rim[i]);
    /* A limit learned in a turn on the spot does not apply elsewhere, and vice versa. */
    if (c->on_spot != on_spot) {
        drop_limit(c);
        c->tried = (real)HUGE_VAL;
    }
    c->on_spot = on_spot;
    /* Wheels that answer with another gain fall short of the model, too, but the robot keeps up with its reference. */
    const ddmpc_stray stray = ddmpc_stray_from(c, c->reference_pose + 3, wanted);
    const int behind = stray.late > k->astray[0] || ddmpc_fabs(stray.across) > k->astray[1] * k->band || stray.outside;
    if (k->wheel_limits && (behind || isfinite(c->rim_reach)) && c->plan_age == 0 &&
        c->last_tick - c->estimator.wheels_stamp < (ddmpc_time)k->short_for) {
        rims(c, wanted, by_reference);
        wheel = short_wheel(c, by_reference, read, &demanded);
    }
    if (wheel >= 0 && gains_nothing(c, wheel, demanded)) {
        c->rim_reach = ddmpc_fabs(c->rim[wheel]);
        c->slowed = R(0.0);
    } else if (needed > k->slowed * c->reach) {
        c->slowed += (real)k->sample_time;
    }
    const real growth = k->regain[0] * c->rim_reach + k->regain[1];
    c->reach = c->rim_reach + (c->slowed > k->retry ? growth * (c->slowed - k->retry) : R(0.0));
    /* Drop the limit if the wheel turns faster after all, if the path needs much less, or while the encoders count as
     * faulty. */
    const int faster = ddmpc_fabs(c->rim[c->short_wheel]) > c->rim_reach * (R(1.0) + k->short_by[1]) + k->short_by[0];
    if (!k->wheel_limits || faster || needed < k->far_below * c->rim_reach || !(c->rim_reach < k->soft_upper[2]) ||
        c->result.reasons & DDMPC_WHEELS_ACCUSED)
        drop_limit(c);
    c->result.reach = c->reach;
}
