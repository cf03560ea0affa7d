#include "reference.h"

static ddmpc_time clamp(ddmpc_time t, ddmpc_time duration)
{
    /* Not by min and max: NaN must stay NaN. */
    return t < 0.0 ? 0.0 : t > duration ? duration : t;
}

/* Index of the last of `count` breaks that is not after `t`; at least 0. */
static int piece_at(const ddmpc_time *breaks, int count, ddmpc_time t)
{
    int low = 0, high = count;
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (breaks[middle] <= t)
            low = middle;
        else
            high = middle;
    }
    return low;
}

void ddmpc_sample_arcs(const ddmpc_time *breaks, const real *table, int phases, ddmpc_time duration,
                       const ddmpc_time *times, int count, const ddmpc_samples *samples)
{
    for (int k = 0; k < count; k++) {
        const ddmpc_time t = clamp(times[k], duration);
        const int phase = piece_at(breaks, phases, t);
        const real *column = table + phase;
        const real tau = (real)(t - breaks[phase]);
        const real x = column[phases], y = column[2 * phases], theta = column[3 * phases];
        const real forward = column[5 * phases], turn = column[6 * phases];
        const real rate = column[8 * phases], gain = column[9 * phases] * tau;
        const real progress = column[7 * phases] + (rate + gain) * tau, speed = rate + R(2.0) * gain;
        const real travelled = forward * progress, half = R(0.5) * turn * progress, direction = theta + half;
        const real chord = half == R(0.0) ? travelled : travelled * (ddmpc_sin(half) / half);
        real *pose = samples->pose + 3 * k, *twist = samples->twist + 2 * k;
        pose[0] = x + chord * ddmpc_cos(direction);
        pose[1] = y + chord * ddmpc_sin(direction);
        pose[2] = direction + half;
        twist[0] = forward * speed;
        twist[1] = turn * speed;
        samples->arc_length[k] = column[4 * phases] + ddmpc_fabs(travelled);
    }
}

void ddmpc_sample_spline(const ddmpc_time *breaks, const real *table, int pieces, ddmpc_time duration,
                         const ddmpc_time *times, int count, const ddmpc_samples *samples)
{
    for (int k = 0; k < count; k++) {
        const ddmpc_time t = clamp(times[k], duration);
        const int piece = piece_at(breaks, pieces, t);
        const real tau = (real)(t - breaks[piece]);
        real value[4], rate[4];
        for (int i = 0; i < 4; i++) {
            const real *column = table + piece;
            const real cubic = column[i * pieces], square = column[(4 + i) * pieces];
            const real linear = column[(8 + i) * pieces], constant = column[(12 + i) * pieces];
            value[i] = ((cubic * tau + square) * tau + linear) * tau + constant;
            rate[i] = (R(3.0) * cubic * tau + R(2.0) * square) * tau + linear;
        }
        real *pose = samples->pose + 3 * k, *twist = samples->twist + 2 * k;
        for (int i = 0; i < 3; i++)
            pose[i] = value[i];
        const int inside = times[k] == t;
        twist[0] = inside ? rate[0] * ddmpc_cos(value[2]) + rate[1] * ddmpc_sin(value[2]) : R(0.0);
        twist[1] = inside ? rate[2] : R(0.0);
        samples->arc_length[k] = value[3];
    }
}
