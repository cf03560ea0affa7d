#include "condense.h"

#include <string.h>

#include "arc.h"

enum { N = DDMPC_STEPS, INPUTS = DDMPC_INPUTS, LANES = DDMPC_LANES };

/* Places of the slip in the estimator's mean. */
enum { V_OFFSET = DDMPC_STATES, OMEGA_GAIN, LONGITUDINAL_GAIN, YAW_GAIN, SIDE_SLIP, POSE = DDMPC_STATES + 6 };

/* How a robot that side-slips follows the curve: turned into it, and a little late; see mpc/lean.py. */
static void lean(const ddmpc_tracking *constants, const ddmpc_situation *situation, ddmpc_tick *tick)
{
    const real two_pi = R(2.0) * DDMPC_PI;
    const real turns =
        two_pi * ddmpc_rint((situation->mean[POSE + 2] - situation->reference[0][2]) / two_pi);
    for (int k = 0; k <= N; k++) {
        const real *pose = situation->reference[k];
        const real v = situation->twist[k][0], omega = situation->twist[k][1], theta = pose[2] + turns;
        const real lead = ddmpc_atan(tick->side_slip * omega);
        const real cost = constants->lean_along * v * v + constants->lean_heading * omega * omega;
        const real pull = cost > R(0.0) ? constants->lean_heading * lead * omega / cost : R(0.0);
        const real lag = pull * v;
        tick->reference[k][0] = pose[0] - lag * ddmpc_cos(theta);
        tick->reference[k][1] = pose[1] - lag * ddmpc_sin(theta);
        tick->reference[k][2] = theta - pull * omega;
        tick->heading[k] = tick->reference[k][2] + lead;
    }
}

/* Commands that would keep the reference's twist, one lag ahead; see mpc/feed_forward.py. */
static void feed_forward(const ddmpc_tracking *constants, const ddmpc_situation *situation, real v_offset,
                         ddmpc_tick *tick)
{
    const int lag[2] = {DDMPC_LAG_V, DDMPC_LAG_OMEGA};
    const real offset[2] = {v_offset, R(0.0)};
    for (int k = 0; k < N; k++) {
        real wanted[2];
        for (int c = 0; c < 2; c++) {
            const real now = situation->twist[k + lag[c]][c], after = situation->twist[k + lag[c] + 1][c];
            wanted[c] = (now + constants->lag_rest[c] * (after - now)) / tick->gains[c] - offset[c];
        }
        for (int c = 0; c < 2; c++)
            tick->feed_forward[k][c] =
                constants->inverse_gain[c][0] * wanted[0] + constants->inverse_gain[c][1] * wanted[1];
    }
}

void ddmpc_begin(const ddmpc_tracking *constants, const ddmpc_situation *situation, ddmpc_tick *tick)
{
    const real *z = situation->mean;
    const real offset[2] = {z[V_OFFSET], R(0.0)};
    memcpy(tick->pose, z + POSE, sizeof tick->pose);
    memcpy(tick->last_command, situation->last_command, sizeof tick->last_command);
    tick->gains[0] = z[LONGITUDINAL_GAIN];
    tick->gains[1] = z[OMEGA_GAIN] * z[YAW_GAIN];
    tick->side_slip = z[SIDE_SLIP];
    for (int k = 0; k <= N; k++)
        for (int c = 0; c < 2; c++) {
            real free = offset[c];
            for (int i = 0; i < DDMPC_STATES; i++)
                free += constants->from_state[k][c][i] * z[i];
            for (int p = 0; p < DDMPC_PAST; p++)
                for (int d = 0; d < 2; d++)
                    free += constants->from_past[k][c][p][d] * situation->past[p][d];
            tick->free_twist[k][c] = tick->gains[c] * free;
        }
    lean(constants, situation, tick);
    feed_forward(constants, situation, z[V_OFFSET], tick);
}

/* What the plan adds to the model's twists at the samples: a convolution. */
static void answer(const ddmpc_tracking *constants, const real plan[INPUTS], real twist[2][N + 1])
{
    memset(twist, 0, 2 * (N + 1) * sizeof(real));
    for (int c = 0; c < 2; c++)
        for (int j = 0; j < N; j++) {
            const real v = plan[2 * j], omega = plan[2 * j + 1];
            for (int m = 1; m <= N - j; m++)
                twist[c][j + m] += constants->response[c][0][m] * v + constants->response[c][1][m] * omega;
        }
}

/* Poses by exact arcs, from the twists that the plan adds. */
static void roll_out(const ddmpc_tracking *constants, const ddmpc_tick *tick, real by_plan[2][N + 1],
                     real arc[8][N], real poses[N + 1][3])
{
    const real dt = constants->dt, v_gain = tick->gains[0], omega_gain = tick->gains[1];
    real mean_v[N], mean_omega[N];
    memcpy(poses[0], tick->pose, sizeof poses[0]);
    for (int k = 0; k < N; k++) {
        mean_v[k] = R(0.5) * (tick->free_twist[k][0] + tick->free_twist[k + 1][0] +
                              v_gain * (by_plan[0][k] + by_plan[0][k + 1]));
        mean_omega[k] = R(0.5) * (tick->free_twist[k][1] + tick->free_twist[k + 1][1] +
                                  omega_gain * (by_plan[1][k] + by_plan[1][k + 1]));
        poses[k + 1][2] = poses[k][2] + dt * mean_omega[k];
    }
    for (int k = 0; k < N; k++) {
        const ddmpc_arc along = ddmpc_arc_along(poses[k][2], mean_v[k], mean_omega[k], dt, tick->side_slip);
        arc[0][k] = along.dx;
        arc[1][k] = along.dy;
        for (int i = 0; i < 2; i++) {
            arc[2 + 3 * i][k] = v_gain * along.by_v[i];
            arc[3 + 3 * i][k] = omega_gain * along.by_omega[i];
        }
        arc[4][k] = -omega_gain * along.dy;
        arc[7][k] = omega_gain * along.dx;
        poses[k + 1][0] = poses[k][0] + along.dx;
        poses[k + 1][1] = poses[k][1] + along.dy;
    }
}

void ddmpc_poses(const ddmpc_tracking *constants, const ddmpc_tick *tick, const real plan[INPUTS], real poses[N + 1][3])
{
    real by_plan[2][N + 1], arc[8][N];
    answer(constants, plan, by_plan);
    roll_out(constants, tick, by_plan, arc, poses);
}

/* Displacements (2) at the samples 1 to N that the linearised arcs owe to a plan, and its headings. */
static void linear_moves(const ddmpc_tracking *constants, const ddmpc_workspace *work, real by_plan[2][N + 1],
                         real moves[2][N], real headings[N + 1])
{
    real x = R(0.0), y = R(0.0);
    headings[0] = R(0.0);
    for (int k = 0; k < N; k++) {
        const real v = R(0.5) * (by_plan[0][k] + by_plan[0][k + 1]);
        const real omega = R(0.5) * (by_plan[1][k] + by_plan[1][k + 1]);
        x += work->arc[2][k] * v + work->arc[3][k] * omega + work->arc[4][k] * headings[k];
        y += work->arc[5][k] * v + work->arc[6][k] * omega + work->arc[7][k] * headings[k];
        headings[k + 1] = headings[k] + constants->dt * omega;
        moves[0][k] = x;
        moves[1][k] = y;
    }
}

/* Displacement of one arc per unit of mean v, mean omega and heading before it; heading of the path, roots of the
   weights and weighted residuals at its end. */
typedef struct {
    real x[3], y[3];
    real cosine, sine, along, across;
    real along_residual, across_residual, heading_residual;
} row_weights;

/* The rows of one sample: positions, errors along and across, and their part of the gradient. The compiler is told that
   nothing overlaps, and so works on whole lanes. */
static void fill_row(int count, const row_weights *w, const real *restrict mean_v, const real *restrict mean_omega,
                     const real *restrict before, const real *restrict after, real *restrict x, real *restrict y,
                     real *restrict aside, real *restrict along, real *restrict across, real *restrict gradient)
{
    const row_weights r = *w;
    for (int j = 0; j < count; j++) {
        const real move_x = x[j] + r.x[0] * mean_v[j] + r.x[1] * mean_omega[j] + r.x[2] * before[j];
        const real move_y = y[j] + r.y[0] * mean_v[j] + r.y[1] * mean_omega[j] + r.y[2] * before[j];
        const real ahead = r.along * (r.cosine * move_x + r.sine * move_y);
        const real beside = r.cosine * move_y - r.sine * move_x, weighted = r.across * beside;
        x[j] = move_x;
        y[j] = move_y;
        aside[j] = beside;
        along[j] = ahead;
        across[j] = weighted;
        gradient[j] += r.along_residual * ahead + r.across_residual * weighted + r.heading_residual * after[j];
    }
}

/* Rows of the errors along and across at the samples 1 to N, and with the residuals of the plan their gradient. */
static void fill_rows(const ddmpc_tracking *constants, ddmpc_workspace *work, const real along_residual[N],
                      const real across_residual[N], const real heading_residual[N])
{
    memset(work->moves, 0, sizeof work->moves);
    memset(work->gradient, 0, sizeof work->gradient);
    for (int k = 0; k < N; k++) {
        const real *after = constants->heading_row + 2 * (N - k - 1);
        const row_weights weights = {
            {work->arc[2][k], work->arc[3][k], work->arc[4][k]},
            {work->arc[5][k], work->arc[6][k], work->arc[7][k]},
            work->cosine[k], work->sine[k], constants->along[k], constants->across[k],
            along_residual[k], across_residual[k], heading_residual[k],
        };
        fill_row(ddmpc_whole_lanes(2 * (k + 1)), &weights, constants->mean_row[0] + 2 * (N - k - 1),
                 constants->mean_row[1] + 2 * (N - k - 1), after + 2, after, work->moves[0], work->moves[1],
                 work->across[k], work->stack[2 * k], work->stack[2 * k + 1], work->gradient);
    }
}

/* H: the rows' squares, tile by tile, and what is constant. A row is zero beyond the commands that it answers to. */
static void fill_hessian(const ddmpc_tracking *constants, const ddmpc_workspace *work, real scale, ddmpc_qp *qp)
{
    for (int i = 0; i < INPUTS; i += LANES)
        for (int j = 0; j <= i; j += LANES) {
            real sum[LANES][LANES];
            memset(sum, 0, sizeof sum);
            ddmpc_tile(work->stack[i] + i, work->stack[i] + j, 2 * N - i, DDMPC_WIDTH, sum);
            const int rows = INPUTS - i < LANES ? INPUTS - i : LANES;
            const int columns = INPUTS - j < LANES ? INPUTS - j : LANES;
            for (int a = 0; a < rows; a++)
                for (int b = 0; b < columns; b++)
                    qp->H[i + a][j + b] = sum[a][b] + scale * constants->heading_hessian[i + a][j + b];
            for (int b = 0; b < columns; b++)
                for (int a = 0; a < rows; a++)
                    qp->H[j + b][i + a] = qp->H[i + a][j + b];
        }
    for (int i = 0; i < INPUTS; i++) {
        const real increment = constants->increment_weight[i % 2];
        qp->H[i][i] += constants->command_weight[i % 2] + (i < INPUTS - 2 ? R(2.0) : R(1.0)) * increment;
        if (i >= 2) {
            qp->H[i][i - 2] -= increment;
            qp->H[i - 2][i] = qp->H[i][i - 2];
        }
    }
}

/* What has soft limits, from a twist of the body: v, omega, and the speeds of right and left wheels at the rim, which do
   not slip as the body does. */
static void soft_twists(const ddmpc_tracking *constants, const real gains[2], const real twist[2], real soft[4])
{
    const real v = twist[0] / gains[0], turn = constants->half_track * twist[1] / gains[1];
    soft[0] = twist[0];
    soft[1] = twist[1];
    soft[2] = v + turn;
    soft[3] = v - turn;
}

/* Bounds of the soft rows. Where the robot is beyond a limit already, its present value is the limit. */
static void bound_softly(const ddmpc_tracking *constants, const ddmpc_tick *tick, const real across[N], ddmpc_qp *qp)
{
    const real *here = tick->reference[0];
    real limit[DDMPC_SOFT], now[DDMPC_SOFT], offset[DDMPC_SOFT];
    soft_twists(constants, tick->gains, tick->free_twist[0], now);
    now[DDMPC_SOFT_ACROSS] =
        ddmpc_cos(here[2]) * (tick->pose[1] - here[1]) - ddmpc_sin(here[2]) * (tick->pose[0] - here[0]);
    for (int kind = 0; kind < DDMPC_SOFT; kind++)
        limit[kind] = ddmpc_max(constants->soft_limit[kind], ddmpc_fabs(now[kind]));
    for (int k = 0; k < N; k++) {
        soft_twists(constants, tick->gains, tick->free_twist[k + 1], offset);
        offset[DDMPC_SOFT_ACROSS] = across[k];
        for (int kind = 0; kind < DDMPC_SOFT; kind++) {
            qp->soft_lower[kind][k] = -limit[kind] - offset[kind];
            qp->soft_upper[kind][k] = limit[kind] - offset[kind];
        }
    }
}

void ddmpc_condense(const ddmpc_tracking *constants, const ddmpc_tick *tick, const real plan[INPUTS],
                    ddmpc_workspace *work, ddmpc_qp *qp)
{
    const real omega_gain = tick->gains[1];
    real moves[2][N], headings[N + 1], along_residual[N], across_residual[N], heading_residual[N], across[N];
    answer(constants, plan, work->plan_twist);
    roll_out(constants, tick, work->plan_twist, work->arc, work->poses);
    linear_moves(constants, work, work->plan_twist, moves, headings);
    for (int k = 0; k < N; k++) {
        const real *at = work->poses[k + 1], *wanted = tick->reference[k + 1];
        const real c = work->cosine[k] = ddmpc_cos(wanted[2]), s = work->sine[k] = ddmpc_sin(wanted[2]);
        /* The error less what the plan itself has brought about: the error at a plan of zeros, linearised here. */
        const real x = at[0] - wanted[0] - moves[0][k], y = at[1] - wanted[1] - moves[1][k];
        const real turned = at[2] - tick->heading[k + 1] - omega_gain * headings[k + 1];
        across[k] = c * y - s * x;
        along_residual[k] = constants->along[k] * (c * x + s * y);
        across_residual[k] = constants->across[k] * across[k];
        heading_residual[k] = omega_gain * constants->heading[k] * turned;
    }
    fill_rows(constants, work, along_residual, across_residual, heading_residual);
    fill_hessian(constants, work, omega_gain * omega_gain, qp);
    for (int i = 0; i < INPUTS; i++) {
        const int c = i % 2;
        const real reachable = ddmpc_fabs(tick->last_command[c]) - (real)(i / 2 + 1) * constants->slew[c];
        qp->g[i] = work->gradient[i] - constants->command_weight[c] * tick->feed_forward[i / 2][c];
        qp->box[i] = ddmpc_max(reachable, constants->largest_command[c]);
    }
    for (int c = 0; c < 2; c++)
        qp->g[c] -= constants->increment_weight[c] * tick->last_command[c];
    bound_softly(constants, tick, across, qp);
}

void ddmpc_soft_values(const ddmpc_tracking *constants, const ddmpc_tick *tick, const ddmpc_workspace *work,
                       const real plan[INPUTS], real values[DDMPC_SOFT][N])
{
    real by_plan[2][N + 1], moves[2][N], headings[N + 1];
    answer(constants, plan, by_plan);
    linear_moves(constants, work, by_plan, moves, headings);
    for (int k = 0; k < N; k++) {
        const real v = by_plan[0][k + 1], turn = constants->half_track * by_plan[1][k + 1];
        values[DDMPC_SOFT_V][k] = tick->gains[0] * v;
        values[DDMPC_SOFT_OMEGA][k] = tick->gains[1] * by_plan[1][k + 1];
        values[DDMPC_SOFT_RIGHT][k] = v + turn;
        values[DDMPC_SOFT_LEFT][k] = v - turn;
        values[DDMPC_SOFT_ACROSS][k] = work->cosine[k] * moves[1][k] - work->sine[k] * moves[0][k];
    }
}

void ddmpc_soft_rows(const ddmpc_tracking *constants, const ddmpc_tick *tick, const ddmpc_workspace *work, int kind,
                     real rows[N][INPUTS])
{
    const real half = constants->half_track;
    const real weight[4][2] = {
        {tick->gains[0], R(0.0)}, {R(0.0), tick->gains[1]}, {R(1.0), half}, {R(1.0), -half}};
    memset(rows, 0, N * INPUTS * sizeof(real));
    for (int k = 0; k < N; k++) {
        if (kind == DDMPC_SOFT_ACROSS) {
            memcpy(rows[k], work->across[k], (size_t)(2 * (k + 1)) * sizeof(real));
            continue;
        }
        for (int j = 0; j <= k; j++)
            for (int d = 0; d < 2; d++)
                rows[k][2 * j + d] = weight[kind][0] * constants->response[0][d][k + 1 - j] +
                                     weight[kind][1] * constants->response[1][d][k + 1 - j];
    }
}

unsigned long ddmpc_tracking_size(void)
{
    return (unsigned long)sizeof(ddmpc_tracking);
}

unsigned long ddmpc_workspace_size(void)
{
    return (unsigned long)sizeof(ddmpc_workspace);
}
