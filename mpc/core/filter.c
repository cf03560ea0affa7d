/* Steps of the extended Kalman filter over one sample. The state is z = (x, slip, gyro bias, delays, pose): the n states
 * of the velocity model, the parameters of the difference between the model's twist and the actual twist, the gyro's
 * bias, the unknown delays of both commands, and x, y, theta. This file contains only algebra: the motion, the sensors
 * and their gradients are generated from mpc/problem/formulas.py.
 *
 *     predict   z = f(z, u),  P = F P F' + Q          F the gradient of f, Q the noise of a sample
 *     correct   S = H P H' + R,  K = P H' / S,  z += K (measured - h(z)),  P -= K S K'
 *
 * Slip and bias are constant in f, so only corrections change them. They are observable because they couple to the pose
 * through F and to the sensors through H, so a pose also corrects slip. Readings with independent noise are processed
 * sequentially, which needs no matrix inverse; a pose is processed as a whole, since its covariance is full.
 *
 * estimator.c calls these steps, and repeats them from the stamp of a delayed measurement on. */
#include <string.h>

#include "internal.h"

static real dot(const real *a, const real *b, int count)
{
    real sum = R(0.0);
    for (int i = 0; i < count; i++)
        sum += a[i] * b[i];
    return sum;
}

void ddmpc_copy_belief(const ddmpc_controller *c, ddmpc_belief *to, const ddmpc_belief *from)
{
    const int Z = BELIEF(c);
    memmove(to->mean, from->mean, (size_t)Z * sizeof(real));
    memmove(to->covariance, from->covariance, (size_t)(Z * Z) * sizeof(real));
    memcpy(to->rate, from->rate, sizeof to->rate);
    memcpy(to->surprised, from->surprised, sizeof to->surprised);
}

/* Compute the twist of the body, and its gradient by the filter's state (2, Z). */
static void twist_now(const ddmpc_controller *c, const real *mean, real twist[2], real (*gradient)[MAX_BELIEF])
{
    const int n = STATES(c);
    real y[2], rows[2 * DDMPC_MAX_STATES], J[2 * (2 + DDMPC_MAX_SLIPS)];
    ddmpc_velocity_output(c, mean, y, rows);
    const real *arguments[2] = {y, mean + n};
    real *results[2] = {twist, J};
    WITH_SLIP(c, twist)(arguments, results, 0, 0, 0);
    if (!gradient)
        return;
    memset(gradient, 0, 2 * sizeof *gradient);
    for (int i = 0; i < 2; i++) {
        for (int j = 0; j < n; j++)
            gradient[i][j] = J[i] * rows[j] + J[i + 2] * rows[n + j];
        for (int j = 0; j < SLIPS(c); j++)
            gradient[i][n + j] = J[i + 2 * (2 + j)];
    }
}

void ddmpc_filter_twist(const ddmpc_controller *c, const real *mean, real twist[2]) { twist_now(c, mean, twist, 0); }

/* Compute P h. P is symmetric, so its rows are used as columns; most entries of h are zero. */
static void times(const ddmpc_controller *c, const ddmpc_belief *belief, const real *h, real *out)
{
    const int Z = BELIEF(c);
    const real *row = belief->covariance;
    memset(out, 0, (size_t)Z * sizeof(real));
    for (int j = 0; j < Z; j++, row += Z)
        if (h[j] != R(0.0))
            for (int i = 0; i < Z; i++)
                out[i] += row[i] * h[j];
}

void ddmpc_filter_twist_deviation(const ddmpc_controller *c, const ddmpc_belief *belief, real deviation[2])
{
    real twist[2], gradient[2][MAX_BELIEF], product[MAX_BELIEF];
    twist_now(c, belief->mean, twist, gradient);
    for (int i = 0; i < 2; i++) {
        times(c, belief, gradient[i], product);
        deviation[i] = ddmpc_sqrt(ddmpc_max(dot(gradient[i], product, BELIEF(c)), R(0.0)));
    }
}

/* Pose with its gradient by the filter's state. */
typedef struct {
    real pose[3], twist[2], by[3][MAX_BELIEF];
} moved_pose;

/* Move the body over `dt` with the model's output `y`, whose gradient by the states is (2, n) and by the delays (2,
 * 2), and the forward `acceleration`. */
static void move(const ddmpc_controller *c, const real *z, const real y[2], const real *rows, const real *by_delay,
                 real acceleration, real dt, moved_pose *moved)
{
    const int n = STATES(c), S = SLIPS(c), pose = n + POSE(c);
    const real *start = z + pose;
    real displacement[3], J[3 * (3 + DDMPC_MAX_SLIPS)];
    const real *arguments[5] = {y, z + n, start + 2, &acceleration, &dt};
    real *results[2] = {displacement, J};
    WITH_SLIP(c, move)(arguments, results, 0, 0, 0);
    memset(moved->by, 0, sizeof moved->by);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < n; j++)
            moved->by[i][j] = J[i] * rows[j] + J[i + 3] * rows[n + j];
        for (int j = 0; j < S; j++)
            moved->by[i][n + j] = J[i + 3 * (2 + j)];
        for (int j = 0; by_delay && j < 2; j++)
            moved->by[i][n + DELAYS(c) + j] = J[i] * by_delay[j] + J[i + 3] * by_delay[2 + j];
        /* The displacement depends on the heading at the start; the new pose also depends on the start pose. */
        moved->by[i][pose + 2] = J[i + 3 * (2 + S)];
        moved->by[i][pose + i] += R(1.0);
        moved->pose[i] = start[i] + displacement[i];
    }
}

static void move_from(const ddmpc_controller *c, const real *z, real dt, moved_pose *moved)
{
    real y[2], rows[2 * DDMPC_MAX_STATES];
    ddmpc_velocity_output(c, z, y, rows);
    move(c, z, y, rows, 0, R(0.0), dt, moved);
}

void ddmpc_filter_pose_at(const ddmpc_controller *c, const ddmpc_belief *belief, real ahead, real pose[3])
{
    moved_pose moved;
    move_from(c, belief->mean, ahead, &moved);
    memcpy(pose, moved.pose, sizeof moved.pose);
}

/* Compute F P F' for F = (A D 0; 0 1 0; G), whose block rows are those of the states, of slip, bias and delays, and of
 * the pose. Only blocks that change are computed, and each pair of symmetric entries once. D (n, 2) is the gradient by
 * the delays. */
static void propagate(const ddmpc_controller *c, const moved_pose *moved, const real *A, const real *D,
                      const real *covariance, real *out)
{
    const int n = STATES(c), Z = BELIEF(c), pose = n + POSE(c), delays = n + DELAYS(c);
    real top[DDMPC_MAX_STATES][MAX_BELIEF], bottom[3][MAX_BELIEF];
    for (int i = 0; i < n; i++) {
        memset(top[i], 0, (size_t)Z * sizeof(real));
        for (int k = 0; k < n; k++)
            for (int j = 0; j < Z; j++)
                top[i][j] += A[i * n + k] * covariance[k * Z + j];
        for (int k = 0; k < 2; k++)
            for (int j = 0; j < Z; j++)
                top[i][j] += D[2 * i + k] * covariance[(delays + k) * Z + j];
    }
    for (int i = 0; i < 3; i++) {
        memset(bottom[i], 0, (size_t)Z * sizeof(real));
        for (int k = 0; k < Z; k++)
            for (int j = 0; j < Z; j++)
                bottom[i][j] += moved->by[i][k] * covariance[k * Z + j];
    }
    memcpy(out, covariance, (size_t)(Z * Z) * sizeof(real));
    for (int i = 0; i < n; i++) {
        for (int j = 0; j <= i; j++)
            out[i * Z + j] = out[j * Z + i] = dot(A + j * n, top[i], n) + dot(D + 2 * j, top[i] + delays, 2);
        for (int j = n; j < pose; j++)
            out[i * Z + j] = out[j * Z + i] = top[i][j];
    }
    for (int i = 0; i < 3; i++) {
        const int row = pose + i;
        for (int j = 0; j < n; j++)
            out[row * Z + j] = out[j * Z + row] = dot(A + j * n, bottom[i], n) + dot(D + 2 * j, bottom[i] + delays, 2);
        for (int j = n; j < pose; j++)
            out[row * Z + j] = out[j * Z + row] = bottom[i][j];
        for (int j = 0; j <= i; j++)
            out[row * Z + pose + j] = out[(pose + j) * Z + row] = dot(moved->by[j], bottom[i], Z);
    }
}

/* Compute the mean output of the model over the sample from z to the states x+, with its gradient by the states (2, n),
 * its rate, and the body's mean twist. The arc of the mean twist is more accurate than the arc of the twist at the start.
 * Returns the body's forward acceleration. Derivatives by acceleration and rate are neglected, since their effect is
 * small. */
static real mean_output(const ddmpc_controller *c, const real *z, const real *next_state, const real *A, real y[2],
                        real *rows, real rate[2], real twist[2])
{
    const int n = STATES(c);
    real next_output[2], next_rows[2 * DDMPC_MAX_STATES], start[2], end[2];
    ddmpc_velocity_output(c, z, y, rows);
    ddmpc_velocity_output(c, next_state, next_output, next_rows);
    const real *arguments[2][2] = {{y, z + n}, {next_output, z + n}};
    real *results[2][2] = {{start, 0}, {end, 0}};
    for (int i = 0; i < 2; i++)
        WITH_SLIP(c, twist)(arguments[i], results[i], 0, 0, 0);
    for (int i = 0; i < 2; i++) {
        rate[i] = (next_output[i] - y[i]) / (real)c->constants->sample_time;
        y[i] = R(0.5) * (y[i] + next_output[i]);
        twist[i] = R(0.5) * (start[i] + end[i]);
        for (int j = 0; j < n; j++) {
            /* The output at the end depends on the states at the start through the model's step, by the chain rule. */
            real by_start = R(0.0);
            for (int k = 0; NONLINEAR(c) && k < n; k++)
                by_start += next_rows[i * n + k] * A[k * n + j];
            rows[i * n + j] =
                NONLINEAR(c) ? R(0.5) * (rows[i * n + j] + by_start) : c->constants->mean_output[i * n + j];
        }
    }
    return (end[0] - start[0]) / (real)c->constants->sample_time;
}

void ddmpc_filter_carry(const ddmpc_controller *c, const real *mean, const real *newest, real *next_mean)
{
    const int n = STATES(c), pose = n + POSE(c);
    real state[DDMPC_MAX_STATES], y[2], rows[2 * DDMPC_MAX_STATES], rate[2], twist[2];
    real by_state[DDMPC_MAX_STATES * DDMPC_MAX_STATES];
    moved_pose moved;
    ddmpc_velocity_step(c, mean, newest, mean + n + DELAYS(c), state, NONLINEAR(c) ? by_state : 0, 0);
    const real acceleration = mean_output(c, mean, state, by_state, y, rows, rate, twist);
    move(c, mean, y, rows, 0, acceleration, (real)c->constants->sample_time, &moved);
    memcpy(next_mean, state, (size_t)n * sizeof(real));
    memcpy(next_mean + n, mean + n, (size_t)POSE(c) * sizeof(real));
    memcpy(next_mean + pose, moved.pose, sizeof moved.pose);
}

void ddmpc_filter_predict(const ddmpc_controller *c, const ddmpc_belief *belief, const real *newest,
                          ddmpc_belief *prediction)
{
    const ddmpc_constants *k = c->constants;
    const int n = STATES(c), Z = BELIEF(c), S = SLIPS(c), pose = n + POSE(c);
    const real *z = belief->mean, *delays = z + n + DELAYS(c);
    real state[DDMPC_MAX_STATES], y[2], rows[2 * DDMPC_MAX_STATES], twist[2];
    real by_state[DDMPC_MAX_STATES * DDMPC_MAX_STATES], D[2 * DDMPC_MAX_STATES] = {R(0.0)}, by_delay[4] = {R(0.0)};
    const real *A = NONLINEAR(c) ? by_state : k->A;
    moved_pose moved;
    ddmpc_velocity_step(c, z, newest, delays, state, NONLINEAR(c) ? by_state : 0, 0);
    const real acceleration = mean_output(c, z, state, A, y, rows, prediction->rate, twist);
    if (SPARE(c) > 0) {
        ddmpc_velocity_by_delay(c, newest, delays, D);
        /* The factor 1/2, since y is the mean of the outputs at both ends, and delays affect only the end. */
        for (int i = 0; i < 4; i++)
            for (int j = 0; j < n; j++)
                by_delay[i] += R(0.5) * k->C[i / 2 * n + j] * D[2 * j + i % 2];
    }
    move(c, z, y, rows, by_delay, acceleration, (real)k->sample_time, &moved);
    propagate(c, &moved, A, D, belief->covariance, prediction->covariance);

    /* Add Q. Noise acts on the input of the model, and thereby on the states through B0 + B1
     * (mpc/problem/constants.py). */
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            prediction->covariance[i * Z + j] += k->noise[i * n + j];
    for (int i = 0; i < 3; i++)
        prediction->covariance[(pose + i) * (Z + 1)] += k->pose_noise[i];
    /* A parameter is observable only in some motions: a gain while its channel moves, side-slip in curves. In other
     * motions its uncertainty must not increase, since measurement noise would then make its estimate drift. */
    const int turning = ddmpc_fabs(twist[1]) >= k->min_yaw_rate;
    const int driving = ddmpc_fabs(twist[0]) >= k->min_speed;
    const int cornering = turning && driving;
    /* Entries are in the order of the slips in internal.h. */
    const int observable[CURVED_SLIPS] = {1,       turning, driving, turning, cornering, turning,   turning, cornering,
                                          turning, turning, driving, driving, cornering, cornering, turning};
    for (int i = 0; i < S; i++)
        if (observable[i])
            prediction->covariance[(n + i) * (Z + 1)] += k->drift[i];
    prediction->covariance[(n + S) * (Z + 1)] += k->drift[CURVED_SLIPS];
    for (int i = 0; i < 2; i++)
        if (i ? turning : driving)
            prediction->covariance[(n + DELAYS(c) + i) * (Z + 1)] += k->drift[CURVED_SLIPS + 1 + i];

    memcpy(prediction->mean + n, z + n, (size_t)POSE(c) * sizeof(real));
    memcpy(prediction->mean, state, (size_t)n * sizeof(real));
    memcpy(prediction->mean + pose, moved.pose, sizeof moved.pose);
    for (int i = 0; i < DDMPC_SENSORS; i++)
        /* The count is in samples, not in readings, since `patience` is a duration that is valid at any sensor rate. */
        prediction->surprised[i] = belief->surprised[i] + (belief->surprised[i] > 0);
}

/* Count consecutive large innovations of a sensor; return 1 while they are treated as an external disturbance. A
 * disturbance ends soon, whereas a wrong parameter causes large innovations until it is corrected. After `patience`
 * samples, large innovations therefore correct the parameters. */
static int count_surprise(const ddmpc_controller *c, ddmpc_belief *belief, int sensor, real normalised)
{
    if (!(normalised > c->constants->surprise)) {
        belief->surprised[sensor] = 0;
        return 0;
    }
    if (belief->surprised[sensor] < 1)
        belief->surprised[sensor] = 1;
    return (real)belief->surprised[sensor] <= c->constants->patience;
}

/* Set the filter gain to zero for states that the measurement must not change. */
static void freeze(const ddmpc_controller *c, const real *z, int is_disturbed, real *gain, int columns)
{
    const int n = STATES(c);
    real twist[2];
    if (is_disturbed) {
        /* During a disturbance, the innovation corrects velocity and pose, but not slip and delays. */
        memset(gain + n * columns, 0, (size_t)(POSE(c) * columns) * sizeof(real));
        return;
    }
    ddmpc_filter_twist(c, z, twist);
    if (ddmpc_fabs(twist[1]) < c->constants->min_yaw_rate) {
        /* On a straight path, friction holds the robot against small turning commands, which therefore carry no
         * information about gains and delay. */
        memset(gain + (n + DELAYS(c) + 1) * columns, 0, (size_t)columns * sizeof(real));
        memset(gain + (n + OMEGA_GAIN) * columns, 0, (size_t)columns * sizeof(real));
        memset(gain + (n + YAW_GAIN) * columns, 0, (size_t)columns * sizeof(real));
        if (CURVED(c))
            memset(gain + (n + YAW_COUPLING) * columns, 0, (size_t)(2 * columns) * sizeof(real));
    }
}

void ddmpc_filter_bound(const ddmpc_controller *c, real *z)
{
    const real *min_slip = c->constants->min_slip, *max_slip = c->constants->max_slip;
    real *slip = z + STATES(c);
    for (int i = 0; i < SLIPS(c); i++) {
        /* Comparisons preserve NaN, in contrast to min and max, so that an invalid estimate is detected and reset. */
        if (slip[i] < min_slip[i])
            slip[i] = min_slip[i];
        if (slip[i] > max_slip[i])
            slip[i] = max_slip[i];
    }
    for (int i = 0; i < 2; i++) {
        real *delay = slip + DELAYS(c) + i;
        if (*delay < R(0.0))
            *delay = R(0.0);
        if (*delay > (real)SPARE(c) * (real)c->constants->sample_time)
            *delay = (real)SPARE(c) * (real)c->constants->sample_time;
    }
}

/* Correct a belief by a reading with the gradient `h`, the `innovation` and the `variance`; PHt is P h. */
static void correct_scalar(const ddmpc_controller *c, ddmpc_belief *belief, const real *h, real innovation,
                           real variance, int is_disturbed, const real *PHt)
{
    const int Z = BELIEF(c);
    const real S = dot(h, PHt, Z) + variance;
    real gain[MAX_BELIEF], half[MAX_BELIEF], *row = belief->covariance;
    for (int i = 0; i < Z; i++)
        gain[i] = PHt[i] / S;
    freeze(c, belief->mean, is_disturbed, gain, 1);
    for (int i = 0; i < Z; i++) {
        belief->mean[i] += gain[i] * innovation;
        half[i] = PHt[i] - R(0.5) * S * gain[i];
    }
    ddmpc_filter_bound(c, belief->mean);
    /* P -= K (P h)' + (P h) K' - K S K', the Joseph form, is valid for any gain; P -= K S K' requires the optimal gain,
     * which `freeze` has changed. With half = P h - K S / 2 the Joseph form is one symmetric update. */
    for (int i = 0; i < Z; i++, row += Z)
        for (int j = 0; j < Z; j++)
            row[j] -= gain[i] * half[j] + half[i] * gain[j];
}

/* Compute the expected reading of wheels or gyro `ahead` [s] after the belief's time, and its gradient by the state. */
static real expected_reading(const ddmpc_controller *c, const ddmpc_belief *belief, int sensor, real ahead, real *h)
{
    const int n = STATES(c), S = SLIPS(c);
    const real *z = belief->mean;
    real y[2], rows[2 * DDMPC_MAX_STATES], reading[3], J[3 * (3 + DDMPC_MAX_SLIPS)];
    ddmpc_velocity_output(c, z, y, rows);
    for (int i = 0; i < 2; i++)
        /* Extrapolate to the time of the reading. The gradient treats the rate as constant. */
        y[i] += ahead * belief->rate[i];
    const real *arguments[4] = {y, z + n, z + n + GYRO_BIAS(c), &c->constants->wheel_yaw_ratio};
    real *results[2] = {reading, J};
    WITH_SLIP(c, sensors)(arguments, results, 0, 0, 0);
    memset(h, 0, (size_t)BELIEF(c) * sizeof(real));
    for (int j = 0; j < n; j++)
        h[j] = J[sensor] * rows[j] + J[sensor + 3] * rows[n + j];
    /* The loop includes S, the index of the gyro bias after the slips. */
    for (int j = 0; j <= S; j++)
        h[n + j] = J[sensor + 3 * (2 + j)];
    return reading[sensor];
}

real ddmpc_filter_correct_twist(const ddmpc_controller *c, ddmpc_belief *belief, const ddmpc_checked_twist *measured,
                                real ahead)
{
    const int n = STATES(c), Z = BELIEF(c);
    const real *settled = c->constants->settled;
    real h[MAX_BELIEF], PHt[MAX_BELIEF];
    const real innovation = measured->value - expected_reading(c, belief, measured->sensor, ahead, h);
    times(c, belief, h, PHt);
    const real normalised = innovation * innovation / (dot(h, PHt, Z) + measured->variance);
    const int is_disturbed = count_surprise(c, belief, measured->sensor, normalised);
    if (is_disturbed) {
        /* Add the covariance of a constant disturbance of the command that is as large as the innovation, so that the
         * states follow the reading. */
        const int channel = measured->sensor == WHEEL_SPEED ? 0 : 1;
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++)
                belief->covariance[i * Z + j] +=
                    innovation * innovation * (settled[2 * i + channel] * settled[2 * j + channel]);
        times(c, belief, h, PHt);
    }
    correct_scalar(c, belief, h, innovation, measured->variance, is_disturbed, PHt);
    return normalised;
}

/* P H' and S = H P H' + covariance for a pose, and the factors of S = L D L', without square roots. */
typedef struct {
    real PHt[MAX_BELIEF][3], S[3][3];
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

/* Compute x = S^-1 b. */
static void divide(const expectation *f, const real b[3], real x[3])
{
    const real y1 = b[1] - f->l10 * b[0], y2 = b[2] - f->l20 * b[0] - f->l21 * y1;
    x[2] = y2 / f->d[2];
    x[1] = y1 / f->d[1] - f->l21 * x[2];
    x[0] = b[0] / f->d[0] - f->l10 * x[1] - f->l20 * x[2];
}

static void expect(const ddmpc_controller *c, const ddmpc_belief *belief, const moved_pose *moved,
                   const ddmpc_checked_pose *pose, expectation *expected)
{
    const int Z = BELIEF(c);
    real product[3][MAX_BELIEF];
    for (int i = 0; i < 3; i++)
        times(c, belief, moved->by[i], product[i]);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j <= i; j++)
            expected->S[i][j] = expected->S[j][i] = dot(moved->by[i], product[j], Z) + pose->covariance[i][j];
    for (int k = 0; k < Z; k++)
        for (int i = 0; i < 3; i++)
            expected->PHt[k][i] = product[i][k];
    factorise(expected);
}

/* Scale the deviations of position and heading without a change of correlations. */
static void inflate_pose_covariance(const ddmpc_controller *c, ddmpc_belief *belief, const real by[2])
{
    const int Z = BELIEF(c), first = STATES(c) + POSE(c);
    if (!(by[0] > R(1.0) || by[1] > R(1.0)))
        return;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < Z; j++) {
            belief->covariance[(first + i) * Z + j] *= by[i / 2];
            belief->covariance[j * Z + first + i] *= by[i / 2];
        }
}

real ddmpc_filter_correct_pose(const ddmpc_controller *c, ddmpc_belief *belief, const ddmpc_checked_pose *pose,
                               real ahead)
{
    const int n = STATES(c), Z = BELIEF(c);
    real innovation[3], solved[3], gain[MAX_BELIEF][3], half[MAX_BELIEF][3];
    moved_pose moved;
    expectation f;
    inflate_pose_covariance(c, belief, pose->doubt);
    move_from(c, belief->mean, ahead, &moved);
    for (int i = 0; i < 3; i++)
        innovation[i] = pose->value[i] - moved.pose[i];
    /* Headings are unwrapped, so their difference is wrapped. */
    innovation[2] = ddmpc_wrap(innovation[2]);
    expect(c, belief, &moved, pose, &f);
    divide(&f, innovation, solved);
    /* Mean over the three values, so that the limit for single readings applies. */
    const real normalised = dot(innovation, solved, 3) / R(3.0);
    /* A pose that is inconsistent with the belief indicates that an external force has moved the robot. The estimate then
     * follows the pose, and slip stays constant unless the inconsistency persists. */
    const int is_disturbed = count_surprise(c, belief, POSE_SENSOR, normalised);
    if (is_disturbed) {
        for (int i = 0; i < 3; i++)
            belief->covariance[(n + POSE(c) + i) * (Z + 1)] += innovation[i] * innovation[i];
        expect(c, belief, &moved, pose, &f);
    }
    for (int i = 0; i < Z; i++)
        divide(&f, f.PHt[i], gain[i]);
    freeze(c, belief->mean, is_disturbed, gain[0], 3);
    for (int i = 0; i < Z; i++)
        for (int k = 0; k < 3; k++) {
            belief->mean[i] += gain[i][k] * innovation[k];
            half[i][k] = f.PHt[i][k] - R(0.5) * dot(gain[i], f.S[k], 3);
        }
    ddmpc_filter_bound(c, belief->mean);
    for (int i = 0; i < Z; i++)
        for (int j = 0; j <= i; j++)
            belief->covariance[i * Z + j] = belief->covariance[j * Z + i] =
                belief->covariance[i * Z + j] - (dot(gain[i], half[j], 3) + dot(half[i], gain[j], 3));
    return normalised;
}

void ddmpc_filter_place(const ddmpc_controller *c, ddmpc_belief *belief, const ddmpc_checked_pose *pose)
{
    /* The new pose is independent of the estimate, so its correlations are zero; velocity and slip are kept. */
    const int Z = BELIEF(c), first = STATES(c) + POSE(c);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < first; j++)
            belief->covariance[(first + i) * Z + j] = belief->covariance[j * Z + first + i] = R(0.0);
        for (int j = 0; j < 3; j++)
            belief->covariance[(first + i) * Z + first + j] = pose->covariance[i][j];
        belief->mean[first + i] = pose->value[i];
    }
    memset(belief->surprised, 0, sizeof belief->surprised);
}
