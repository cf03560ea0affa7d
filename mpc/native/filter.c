#include "filter.h"

#include <string.h>

enum { N = DDMPC_STATES, Z = DDMPC_BELIEF };

/* Twist of the body, and its gradient: by states, then as named. */
typedef struct {
    real v, omega;
    real v_by_state[N], omega_by_state[N];
    real v_by_offset, v_by_gain, omega_by_wheel_gain, omega_by_yaw_gain;
} body_twist;

static real dot(const real a[N], const real b[N])
{
    real sum = R(0.0);
    for (int i = 0; i < N; i++)
        sum += a[i] * b[i];
    return sum;
}

/* For the output of the model, v and omega, which answers to the states with these rows. */
static body_twist twist_of(const real z[Z], real v, real omega, const real v_row[N], const real omega_row[N])
{
    const real wheels = v + z[DDMPC_V_OFFSET], gain = z[DDMPC_OMEGA_GAIN] * z[DDMPC_YAW_GAIN];
    body_twist twist;
    twist.v = z[DDMPC_LONGITUDINAL_GAIN] * wheels;
    twist.omega = gain * omega;
    for (int i = 0; i < N; i++) {
        twist.v_by_state[i] = z[DDMPC_LONGITUDINAL_GAIN] * v_row[i];
        twist.omega_by_state[i] = gain * omega_row[i];
    }
    twist.v_by_offset = z[DDMPC_LONGITUDINAL_GAIN];
    twist.v_by_gain = wheels;
    twist.omega_by_wheel_gain = z[DDMPC_YAW_GAIN] * omega;
    twist.omega_by_yaw_gain = z[DDMPC_OMEGA_GAIN] * omega;
    return twist;
}

static body_twist twist_now(const ddmpc_estimation *constants, const real z[Z])
{
    const real *v_row = constants->C[0], *omega_row = constants->C[1];
    return twist_of(z, dot(v_row, z), dot(omega_row, z), v_row, omega_row);
}

void ddmpc_filter_twist(const ddmpc_estimation *constants, const real mean[Z], real twist[2])
{
    const body_twist now = twist_now(constants, mean);
    twist[0] = now.v;
    twist[1] = now.omega;
}

static void v_gradient(const body_twist *twist, real row[Z])
{
    memset(row, 0, Z * sizeof(real));
    memcpy(row, twist->v_by_state, N * sizeof(real));
    row[DDMPC_V_OFFSET] = twist->v_by_offset;
    row[DDMPC_LONGITUDINAL_GAIN] = twist->v_by_gain;
}

static void omega_gradient(const body_twist *twist, real row[Z])
{
    memset(row, 0, Z * sizeof(real));
    memcpy(row, twist->omega_by_state, N * sizeof(real));
    row[DDMPC_OMEGA_GAIN] = twist->omega_by_wheel_gain;
    row[DDMPC_YAW_GAIN] = twist->omega_by_yaw_gain;
}

/* P h; P is symmetric. */
static void times(const ddmpc_belief *belief, const real h[Z], real out[Z])
{
    memset(out, 0, Z * sizeof(real));
    for (int j = 0; j < Z; j++)
        for (int i = 0; i < Z; i++)
            out[i] += belief->covariance[j][i] * h[j];
}

static real dot_belief(const real a[Z], const real b[Z])
{
    real sum = R(0.0);
    for (int i = 0; i < Z; i++)
        sum += a[i] * b[i];
    return sum;
}

void ddmpc_filter_twist_deviation(const ddmpc_estimation *constants, const ddmpc_belief *belief, real deviation[2])
{
    const body_twist now = twist_now(constants, belief->mean);
    real row[Z], product[Z];
    v_gradient(&now, row);
    times(belief, row, product);
    deviation[0] = ddmpc_sqrt(ddmpc_max(dot_belief(row, product), R(0.0)));
    omega_gradient(&now, row);
    times(belief, row, product);
    deviation[1] = ddmpc_sqrt(ddmpc_max(dot_belief(row, product), R(0.0)));
}

/* A pose and its gradient by the filter's state. */
typedef struct {
    real pose[3], by[3][Z];
} moved_pose;

/* Where the body is after `dt`. */
static moved_pose move(const real z[Z], const body_twist *twist, real dt)
{
    const real *at = z + DDMPC_POSE;
    const ddmpc_arc arc = ddmpc_arc_along(at[2], twist->v, twist->omega, dt, z[DDMPC_SIDE_SLIP]);
    real by_v[Z], by_omega[Z];
    moved_pose moved;
    v_gradient(twist, by_v);
    omega_gradient(twist, by_omega);
    for (int j = 0; j < Z; j++) {
        moved.by[0][j] = arc.by_v[0] * by_v[j] + arc.by_omega[0] * by_omega[j];
        moved.by[1][j] = arc.by_v[1] * by_v[j] + arc.by_omega[1] * by_omega[j];
        moved.by[2][j] = dt * by_omega[j];
    }
    moved.by[0][DDMPC_SIDE_SLIP] += arc.by_side_slip[0];
    moved.by[1][DDMPC_SIDE_SLIP] += arc.by_side_slip[1];
    for (int i = 0; i < 3; i++)
        moved.by[i][DDMPC_POSE + i] = R(1.0);
    moved.by[0][DDMPC_POSE + 2] = -arc.dy;
    moved.by[1][DDMPC_POSE + 2] = arc.dx;
    moved.pose[0] = at[0] + arc.dx;
    moved.pose[1] = at[1] + arc.dy;
    moved.pose[2] = at[2] + arc.dtheta;
    return moved;
}

void ddmpc_filter_pose_at(const ddmpc_estimation *constants, const ddmpc_belief *belief, real ahead, real pose[3])
{
    const real *z = belief->mean;
    const body_twist now = twist_now(constants, z);
    const ddmpc_arc arc = ddmpc_arc_along(z[DDMPC_POSE + 2], now.v, now.omega, ahead, z[DDMPC_SIDE_SLIP]);
    pose[0] = z[DDMPC_POSE] + arc.dx;
    pose[1] = z[DDMPC_POSE + 1] + arc.dy;
    pose[2] = z[DDMPC_POSE + 2] + arc.dtheta;
}

/* F P F' for F = (A 0 0; 0 1 0; G), of which only the blocks that change are computed. */
static void propagate(const ddmpc_estimation *constants, const moved_pose *moved, const ddmpc_belief *before,
                      real out[Z][Z])
{
    real top[N][Z], bottom[3][Z];
    memset(top, 0, sizeof top);
    for (int i = 0; i < N; i++)
        for (int k = 0; k < N; k++)
            for (int j = 0; j < Z; j++)
                top[i][j] += constants->A[i][k] * before->covariance[k][j];
    memset(bottom, 0, sizeof bottom);
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < Z; k++)
            for (int j = 0; j < Z; j++)
                bottom[i][j] += moved->by[i][k] * before->covariance[k][j];
    memcpy(out, before->covariance, Z * Z * sizeof(real));
    for (int i = 0; i < N; i++) {
        for (int j = 0; j <= i; j++)
            out[i][j] = out[j][i] = dot(constants->A[j], top[i]);
        for (int j = N; j < DDMPC_POSE; j++)
            out[i][j] = out[j][i] = top[i][j];
    }
    for (int i = 0; i < 3; i++) {
        const int row = DDMPC_POSE + i;
        for (int j = 0; j < N; j++)
            out[row][j] = out[j][row] = dot(constants->A[j], bottom[i]);
        for (int j = N; j < DDMPC_POSE; j++)
            out[row][j] = out[j][row] = bottom[i][j];
        for (int j = 0; j <= i; j++)
            out[row][DDMPC_POSE + j] = out[DDMPC_POSE + j][row] = dot_belief(moved->by[j], bottom[i]);
    }
}

void ddmpc_filter_predict(const ddmpc_estimation *constants, const ddmpc_belief *before, const real recent[2],
                          const real older[2], ddmpc_belief *after)
{
    const real *z = before->mean;
    real state[N], middle[N];
    for (int i = 0; i < N; i++) {
        state[i] = dot(constants->A[i], z);
        for (int c = 0; c < 2; c++)
            state[i] += constants->B0[i][c] * recent[c] + constants->B1[i][c] * older[c];
        middle[i] = R(0.5) * (z[i] + state[i]);
    }
    const body_twist twist = twist_of(z, dot(constants->C[0], middle), dot(constants->C[1], middle),
                                      constants->mean_output[0], constants->mean_output[1]);
    const moved_pose moved = move(z, &twist, constants->dt);
    propagate(constants, &moved, before, after->covariance);

    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++)
            after->covariance[i][j] += constants->noise[i][j];
    for (int i = 0; i < 3; i++)
        after->covariance[DDMPC_POSE + i][DDMPC_POSE + i] += constants->pose_noise[i];
    /* A gain shows only while its channel moves: without news its uncertainty must not grow. */
    const int turning = ddmpc_fabs(twist.omega) >= constants->least_yaw_rate;
    const int driving = ddmpc_fabs(twist.v) >= constants->least_speed;
    const int moving[DDMPC_SLIPS] = {1, turning, driving, turning, turning && driving, 1};
    for (int i = 0; i < DDMPC_SLIPS; i++)
        if (moving[i])
            after->covariance[N + i][N + i] += constants->drift[i];

    memcpy(after->mean, state, sizeof state);
    memcpy(after->mean + N, z + N, DDMPC_SLIPS * sizeof(real));
    memcpy(after->mean + DDMPC_POSE, moved.pose, sizeof moved.pose);
    for (int i = 0; i < DDMPC_SENSORS; i++)
        after->surprised[i] = before->surprised[i] + (before->surprised[i] > 0);
}

/* Count an innovation; whether it tells of something other than slip, which does not last. */
static int judge(const ddmpc_estimation *constants, ddmpc_belief *belief, int sensor, real normalised)
{
    if (!(normalised > constants->surprise)) {
        belief->surprised[sensor] = 0;
        return 0;
    }
    if (belief->surprised[sensor] < 1)
        belief->surprised[sensor] = 1;
    return (real)belief->surprised[sensor] <= constants->patience;
}

/* A gain is zero for what the measurement may not change. */
static void freeze(const ddmpc_estimation *constants, const real z[Z], int pushed, real *gain, int columns)
{
    real twist[2];
    if (pushed) {
        /* The robot does not do as told, for a reason that is none of slip: velocity and pose take it all. */
        memset(gain + N * columns, 0, (size_t)(DDMPC_SLIPS * columns) * sizeof(real));
        return;
    }
    ddmpc_filter_twist(constants, z, twist);
    if (ddmpc_fabs(twist[1]) < constants->least_yaw_rate) {
        memset(gain + DDMPC_OMEGA_GAIN * columns, 0, (size_t)columns * sizeof(real));
        memset(gain + DDMPC_YAW_GAIN * columns, 0, (size_t)columns * sizeof(real));
    }
}

static void bound(const ddmpc_estimation *constants, real z[Z])
{
    for (int i = DDMPC_OMEGA_GAIN; i < DDMPC_SIDE_SLIP; i++) {
        /* Not by min and max: NaN must stay NaN. */
        if (z[i] < constants->least_gain)
            z[i] = constants->least_gain;
        if (z[i] > constants->most_gain)
            z[i] = constants->most_gain;
    }
}

static void correct_scalar(const ddmpc_estimation *constants, ddmpc_belief *belief, const real h[Z], real innovation,
                           real variance, int pushed, real PHt[Z])
{
    const real S = dot_belief(h, PHt) + variance;
    real gain[Z], half[Z];
    for (int i = 0; i < Z; i++)
        gain[i] = PHt[i] / S;
    freeze(constants, belief->mean, pushed, gain, 1);
    for (int i = 0; i < Z; i++) {
        belief->mean[i] += gain[i] * innovation;
        half[i] = PHt[i] - R(0.5) * S * gain[i];
    }
    bound(constants, belief->mean);
    /* Joseph's form: right for any gain, optimal or not. */
    for (int i = 0; i < Z; i++)
        for (int j = 0; j < Z; j++)
            belief->covariance[i][j] -= gain[i] * half[j] + half[i] * gain[j];
}

real ddmpc_filter_correct_twist(const ddmpc_estimation *constants, ddmpc_belief *belief,
                                const ddmpc_checked_twist *measured)
{
    const real *z = belief->mean;
    const real ratio = constants->wheel_yaw_ratio;
    real h[Z], PHt[Z], expected;
    if (measured->sensor == DDMPC_YAW_RATE) {
        const body_twist twist = twist_now(constants, z);
        omega_gradient(&twist, h);
        h[DDMPC_GYRO_BIAS] = R(1.0);
        expected = twist.omega + z[DDMPC_GYRO_BIAS];
    } else {
        memset(h, 0, sizeof h);
        if (measured->sensor == DDMPC_WHEEL_SPEED) {
            memcpy(h, constants->C[0], N * sizeof(real));
            h[DDMPC_V_OFFSET] = R(1.0);
            expected = dot(constants->C[0], z) + z[DDMPC_V_OFFSET];
        } else {
            const real output = dot(constants->C[1], z), gain = z[DDMPC_OMEGA_GAIN];
            for (int i = 0; i < N; i++)
                h[i] = ratio * gain * constants->C[1][i];
            h[DDMPC_OMEGA_GAIN] = ratio * output;
            expected = ratio * gain * output;
        }
    }
    const real innovation = measured->value - expected;
    times(belief, h, PHt);
    const real normalised = innovation * innovation / (dot_belief(h, PHt) + measured->variance);
    const int pushed = judge(constants, belief, measured->sensor, normalised);
    if (pushed) {
        const int channel = measured->sensor == DDMPC_WHEEL_SPEED ? 0 : 1;
        for (int i = 0; i < N; i++)
            for (int j = 0; j < N; j++)
                belief->covariance[i][j] +=
                    innovation * innovation * (constants->settled[i][channel] * constants->settled[j][channel]);
        times(belief, h, PHt);
    }
    correct_scalar(constants, belief, h, innovation, measured->variance, pushed, PHt);
    return normalised;
}

/* P H' and S = H P H' + covariance for a pose, and the factors of S = L D L'. */
typedef struct {
    real PHt[Z][3], S[3][3];
    real l10, l20, l21, d[3];
} expectation;

static void factorise(expectation *f)
{
    f->d[0] = f->S[0][0];
    f->l10 = f->S[1][0] / f->d[0];
    f->l20 = f->S[2][0] / f->d[0];
    f->d[1] = f->S[1][1] - f->l10 * f->S[1][0];
    const real below = f->S[2][1] - f->l20 * f->S[1][0];
    f->l21 = below / f->d[1];
    f->d[2] = f->S[2][2] - f->l20 * f->S[2][0] - f->l21 * below;
}

/* x = S^-1 b */
static void divide(const expectation *f, const real b[3], real x[3])
{
    const real y1 = b[1] - f->l10 * b[0], y2 = b[2] - f->l20 * b[0] - f->l21 * y1;
    x[2] = y2 / f->d[2];
    x[1] = y1 / f->d[1] - f->l21 * x[2];
    x[0] = b[0] / f->d[0] - f->l10 * x[1] - f->l20 * x[2];
}

static expectation expect(const ddmpc_belief *belief, const moved_pose *moved, const ddmpc_checked_pose *pose)
{
    expectation found;
    real product[3][Z];
    for (int i = 0; i < 3; i++)
        times(belief, moved->by[i], product[i]);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j <= i; j++)
            found.S[i][j] = found.S[j][i] = dot_belief(moved->by[i], product[j]) + pose->covariance[i][j];
    for (int k = 0; k < Z; k++)
        for (int i = 0; i < 3; i++)
            found.PHt[k][i] = product[i][k];
    factorise(&found);
    return found;
}

real ddmpc_filter_correct_pose(const ddmpc_estimation *constants, ddmpc_belief *belief,
                               const ddmpc_checked_pose *pose, real ahead)
{
    real innovation[3], solved[3], gain[Z][3], half[Z][3];
    const body_twist twist = twist_now(constants, belief->mean);
    const moved_pose moved = move(belief->mean, &twist, ahead);
    for (int i = 0; i < 3; i++)
        innovation[i] = pose->value[i] - moved.pose[i];
    innovation[2] = ddmpc_wrap(innovation[2]);
    expectation f = expect(belief, &moved, pose);
    divide(&f, innovation, solved);
    const real normalised =
        (innovation[0] * solved[0] + innovation[1] * solved[1] + innovation[2] * solved[2]) / R(3.0);
    /* A pose that the belief cannot explain says that something moved the robot: then the pose is believed, and nothing
       is learned from it about slip, unless that goes on. */
    const int pushed = judge(constants, belief, DDMPC_POSE_SENSOR, normalised);
    if (pushed) {
        for (int i = 0; i < 3; i++)
            belief->covariance[DDMPC_POSE + i][DDMPC_POSE + i] += innovation[i] * innovation[i];
        f = expect(belief, &moved, pose);
    }
    for (int i = 0; i < Z; i++)
        divide(&f, f.PHt[i], gain[i]);
    freeze(constants, belief->mean, pushed, gain[0], 3);
    for (int i = 0; i < Z; i++)
        for (int k = 0; k < 3; k++) {
            belief->mean[i] += gain[i][k] * innovation[k];
            half[i][k] = f.PHt[i][k] -
                         R(0.5) * (gain[i][0] * f.S[0][k] + gain[i][1] * f.S[1][k] + gain[i][2] * f.S[2][k]);
        }
    bound(constants, belief->mean);
    for (int i = 0; i < Z; i++)
        for (int j = 0; j <= i; j++) {
            real change = R(0.0);
            for (int k = 0; k < 3; k++)
                change += gain[i][k] * half[j][k] + half[i][k] * gain[j][k];
            belief->covariance[i][j] = belief->covariance[j][i] = belief->covariance[i][j] - change;
        }
    return normalised;
}

void ddmpc_filter_place(ddmpc_belief *belief, const ddmpc_checked_pose *pose)
{
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < DDMPC_POSE; j++)
            belief->covariance[DDMPC_POSE + i][j] = belief->covariance[j][DDMPC_POSE + i] = R(0.0);
        for (int j = 0; j < 3; j++)
            belief->covariance[DDMPC_POSE + i][DDMPC_POSE + j] = pose->covariance[i][j];
        belief->mean[DDMPC_POSE + i] = pose->value[i];
    }
    memset(belief->surprised, 0, sizeof belief->surprised);
}
