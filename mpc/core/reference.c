/* Sampling of references in closed form: exact arcs with piecewise constant acceleration, and cubic pieces in time.
 * mpc/trajectories builds the tables; mpc/problem/formulas.py defines the motion along a piece. */
#include "internal.h"

static ddmpc_time clamp(ddmpc_time t, ddmpc_time duration)
{
    /* Comparisons preserve NaN, in contrast to min and max. */
    return t < 0.0 ? 0.0 : t > duration ? duration : t;
}

/* Index of the last of `count` breaks at or before `t`; at least 0. */
static int piece_at(const ddmpc_time *breaks, int count, ddmpc_time t)
{
    int low = 0, high = count;
    /* Bisection: the number of iterations is the number of binary digits of `count`. */
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (breaks[middle] <= t)
            low = middle;
        else
            high = middle;
    }
    return low;
}

void ddmpc_sample_one(const void *context, ddmpc_time time, real pose[3], real twist[2], real *arc_length)
{
    const ddmpc_trajectory *trajectory = (const ddmpc_trajectory *)context;
    const int rows = trajectory->cubic ? 16 : 10, pieces = trajectory->pieces;
    const ddmpc_time t = clamp(time, trajectory->duration);
    const int piece = piece_at(trajectory->breaks, pieces, t);
    const real tau = (real)(t - trajectory->breaks[piece]);
    real column[16];
    for (int i = 0; i < rows; i++)
        column[i] = trajectory->table[i * pieces + piece];
    const real *arguments[2] = {&tau, column};
    real *results[3] = {pose, twist, arc_length};
    if (trajectory->cubic)
        ddmpc_f_spline_piece(arguments, results, 0, 0, 0);
    else
        ddmpc_f_arc_piece(arguments, results, 0, 0, 0);
    if (trajectory->cubic && time != t)
        twist[0] = twist[1] = R(0.0);
    const real turn = (real)trajectory->motion[2], x = pose[0], y = pose[1];
    const real cosine = ddmpc_cos(turn), sine = ddmpc_sin(turn);
    pose[0] = (real)trajectory->motion[0] + cosine * x - sine * y;
    pose[1] = (real)trajectory->motion[1] + sine * x + cosine * y;
    pose[2] += turn;
}

void ddmpc_sample(const ddmpc_trajectory *trajectory, const ddmpc_time *times, int count, real *pose, real *twist,
                  real *arc_length)
{
    for (int k = 0; k < count; k++)
        ddmpc_sample_one(trajectory, times[k], pose + 3 * k, twist + 2 * k, arc_length + k);
}
