/* Drives the core with whatever may happen, under AddressSanitizer and UndefinedBehaviorSanitizer: `fuzz_core SEED`.
 *
 * Sizes go from the smallest to the largest that the core holds. Numbers that are none, huge ones, clocks that repeat,
 * leap and run backwards, restarts in the middle of a tick, targets and answers that are nonsense: every command has to
 * be finite, inside its range and inside slew or braking all the same. Between the arrays that the core lays out are
 * gaps that nobody may touch, see DDMPC_GUARD in memory.c. */
#include <float.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "internal.h"

static uint64_t state;

/* Marsaglia's xorshift, Journal of Statistical Software 8(14), 2003. */
static uint64_t draw(void)
{
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return state;
}

static int below(int count) { return (int)(draw() % (uint64_t)count); }

static int once_in(int count) { return below(count) == 0; }

static double uniform(double low, double high) { return low + (high - low) * (double)(draw() >> 11) / 9007199254740992.0; }

/* Mostly `value`; else a number that nobody expects. */
static double spoilt(double value, int seldom)
{
    const double odd[] = {NAN,     INFINITY, -INFINITY, DBL_MAX, -DBL_MAX, 1e300, -1e154, 1e30,
                          -1e15,   1e9,      4e3,       -50.0,   DBL_MIN,  5e-324, 0.0,    -0.0};
    return once_in(seldom) ? odd[below(sizeof odd / sizeof odd[0])] : value;
}

/* Mostly `value`; else one that a schema allows, too: many times as much or as little, or none. */
static real wild(double value, int seldom)
{
    if (!once_in(seldom))
        return (real)value;
    return once_in(6) ? R(0.0) : (real)(value * pow(10.0, uniform(-9.0, 9.0)));
}

static void fail(const char *message, const ddmpc_result *result)
{
    fprintf(stderr, "%s: command %g %g, mode %d, reasons %u\n", message, (double)result->command[0],
            (double)result->command[1], result->mode, result->reasons);
    abort();
}

/* One set of sizes, with terms of the user. */
typedef struct {
    const char *name;
    ddmpc_sizes sizes;
    ddmpc_term term[4];
    int ticks;
} subject;

static int nonlinear_states, nonlinear_window, nonlinear_work;

/* Values of a term of `rows` rows: how far the robot is from points, what it does, the parameters. */
static int term_of(int rows, const real **arguments, real **results)
{
    const real *pose = arguments[0], *twist = arguments[1], *command = arguments[2], *parameters = arguments[4];
    real *value = results[0], *gradient = results[1];
    memset(gradient, 0, (size_t)(rows * TERM_INPUTS) * sizeof(real));
    for (int r = 0; r < rows; r++) {
        const real lever = R(0.1) * (real)(r + 1);
        value[r] = parameters[0] + ddmpc_sin(pose[0] + lever) + lever * pose[2] * twist[1] + command[r % 2];
        gradient[r] = ddmpc_cos(pose[0] + lever);
        gradient[r + 2 * rows] = lever * twist[1];
        gradient[r + 4 * rows] = lever * pose[2];
        gradient[r + (5 + r % 2) * rows] = R(1.0);
    }
    return 0;
}

static int one_row(const real **a, real **r, long long *iw, real *w, int m) { return (void)iw, (void)w, (void)m, term_of(1, a, r); }

static int three_rows(const real **a, real **r, long long *iw, real *w, int m) { return (void)iw, (void)w, (void)m, term_of(3, a, r); }

static int many_rows(const real **a, real **r, long long *iw, real *w, int m) { return (void)iw, (void)w, (void)m, term_of(24, a, r); }

/* A lag that saturates in all states, on the oldest and the newest command of the window. */
static int step(const real **arguments, real **results, long long *iw, real *w, int m)
{
    const int n = nonlinear_states, W = nonlinear_window;
    const real *x = arguments[0], *oldest = arguments[1], *newest = oldest + 2 * W;
    real *after = results[0], *by_state = results[1], *by_window = results[2];
    (void)iw, (void)m;
    for (int i = 0; i < nonlinear_work; i++)
        w[i] = x[0];
    if (by_state)
        memset(by_state, 0, (size_t)(n * n) * sizeof(real));
    if (by_window)
        memset(by_window, 0, (size_t)(n * 2 * (W + 1)) * sizeof(real));
    for (int i = 0; i < n; i++) {
        const int channel = i % 2;
        const real push = tanh(R(0.5) * (oldest[channel] + newest[channel]) - x[i]);
        const real slope = R(0.2) * (R(1.0) - push * push);
        after[i] = x[i] + R(0.2) * push;
        if (by_state)
            by_state[i + n * i] = R(1.0) - slope;
        if (by_window) {
            by_window[i + n * channel] += R(0.5) * slope;
            by_window[i + n * (2 * W + channel)] += R(0.5) * slope;
        }
    }
    return 0;
}

static int output(const real **arguments, real **results, long long *iw, real *w, int m)
{
    const int n = nonlinear_states;
    (void)iw, (void)w, (void)m;
    memset(results[1], 0, (size_t)(2 * n) * sizeof(real));
    for (int i = 0; i < 2; i++) {
        const int from = i < n ? i : 0;
        results[0][i] = arguments[0][from];
        results[1][i + 2 * from] = R(1.0);
    }
    return 0;
}

static real *array(long count) { return calloc((size_t)(count ? count : 1), sizeof(real)); }

/* A linear model of lags, and all that is rolled out from it: what mpc/problem/constants.py does for real ones. */
static void fill_model(const ddmpc_sizes *s, ddmpc_constants *k)
{
    const int n = s->states, N = s->steps, W = s->window, width = (2 * N + PADDING - 1) / PADDING * PADDING;
    const int delay[2] = {s->delay_v, s->delay_omega};
    real *A = array(n * n), *B0 = array(2 * n), *B1 = array(2 * n), *C = array(2 * n), *mean = array(2 * n);
    real *settled = array(2 * n), *noise = array(n * n), *from_state = array((N + 1) * 2 * n);
    real *from_past = array((long)(N + 1) * 4 * W), *response = array(4 * (N + 1)), *twist_row = array(4 * width);
    real *mean_row = array(4 * width), *heading_row = array(2 * width), *hessian = array(4 * N * N);
    real *weight = array(N);
    for (int i = 0; i < n; i++) {
        const int channel = i % 2;
        const real pole = A[i * n + i] = (real)uniform(0.5, 0.95);
        B0[2 * i + channel] = R(0.4) * (R(1.0) - pole);
        B1[2 * i + channel] = R(0.6) * (R(1.0) - pole);
        settled[2 * i + channel] = R(1.0);
        noise[i * n + i] = R(1e-4);
        C[(n > 1 ? channel : 0) * n + i] += R(2.0) / (real)(n > 1 ? n : 2);
        if (n == 1)
            C[1] = R(0.3);
    }
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < n; j++)
            mean[i * n + j] = R(0.5) * C[i * n + j] * (R(1.0) + A[j * n + j]);
    for (int channel = 0; channel < 2; channel++)
        for (int j = 0; j < n; j++) {
            real power = R(1.0), after = R(0.0), past = R(0.0), before = R(0.0);
            for (int m = 0; m <= N; m++) {
                from_state[(2 * m + channel) * n + j] = C[channel * n + j] * power;
                power *= A[j * n + j];
            }
            /* m samples after a command for one sample in each input, from the dead time on. */
            for (int input = 0; input < 2; input++) {
                after = before = R(0.0);
                for (int m = 0; m <= N + W; m++) {
                    const int since = m - 1 - delay[input];
                    past = since == 0 ? B0[2 * j + input] : since == 1 ? B1[2 * j + input] : R(0.0);
                    after = A[j * n + j] * before + past;
                    if (m <= N)
                        response[(2 * channel + input) * (N + 1) + m] += C[channel * n + j] * after;
                    before = after;
                }
                /* Only the remaining part of a command in flight acts after the current state. */
                for (int w = 0; w < W; w++) {
                    before = R(0.0);
                    for (int m = 1; m <= N; m++) {
                        const int since = m - 1 - delay[input] + (W - w);
                        past = since == 0 ? B0[2 * j + input] : since == 1 ? B1[2 * j + input] : R(0.0);
                        before = A[j * n + j] * before + past;
                        from_past[((2 * m + channel) * W + w) * 2 + input] += C[channel * n + j] * before;
                    }
                }
            }
        }
    k->sample_time = 0.02;
    for (int j = 0; j < N; j++)
        for (int input = 0; input < 2; input++) {
            real heading = R(0.0);
            for (int channel = 0; channel < 2; channel++) {
                const real *r = response + (2 * channel + input) * (N + 1);
                twist_row[channel * 2 * width + 2 * j + input] = r[N - j];
                mean_row[channel * 2 * width + 2 * j + input] = R(0.5) * (r[N - j] + r[N - 1 - j]);
            }
            for (int m = 1; m <= N - j; m++)
                heading += R(0.01) * (response[(2 + input) * (N + 1) + m] + response[(2 + input) * (N + 1) + m - 1]);
            heading_row[2 * j + input] = heading;
        }
    for (int i = 0; i < N; i++)
        weight[i] = i == N - 1 ? R(200.0) : R(20.0);
    for (int m = 1; m <= N; m++)
        for (int i = 0; i < 2 * m; i++)
            for (int j = 0; j < 2 * m; j++)
                hessian[i * 2 * N + j] += weight[m - 1] * heading_row[2 * (N - m) + i] * heading_row[2 * (N - m) + j];
    k->A = A, k->B0 = B0, k->B1 = B1, k->C = C, k->mean_output = mean, k->settled = settled, k->noise = noise;
    k->from_state = from_state, k->from_past = from_past, k->response = response, k->twist_row = twist_row;
    k->mean_row = mean_row, k->heading_row = heading_row, k->heading_hessian = hessian;
    k->along = k->across = k->heading = weight;
}

static void free_model(const ddmpc_constants *k)
{
    const real *arrays[] = {k->A,         k->B0,       k->B1,          k->C,        k->mean_output,     k->settled,
                            k->noise,     k->from_state, k->from_past, k->response, k->twist_row,       k->mean_row,
                            k->heading_row, k->heading_hessian, k->along, k->soft_upper, k->soft_lower};
    for (size_t i = 0; i < sizeof arrays / sizeof arrays[0]; i++)
        free((void *)arrays[i]);
}

static ddmpc_constants make_constants(const ddmpc_sizes *s)
{
    ddmpc_constants k;
    /* Every other robot is an ordinary one but for what is drawn below. */
    const int seldom = once_in(2) ? 1000000 : 8;
    real *upper = array(s->soft), *lower = array(s->soft);
    memset(&k, 0, sizeof k);
    fill_model(s, &k);
    k.longest_pause = s->history * k.sample_time;
    for (int i = 0; i <= CURVED_SLIPS; i++) {
        const int gain = i >= OMEGA_GAIN && i <= YAW_GAIN;
        if (i < CURVED_SLIPS) {
            k.min_slip[i] = gain ? R(0.3) : i < FLAT_SLIPS ? -(real)INFINITY : R(-0.5);
            k.max_slip[i] = gain ? R(1.5) : i < FLAT_SLIPS ? (real)INFINITY : R(0.5);
        }
        k.prior[i] = gain ? R(1.0) : R(0.0);
        k.drift[i] = wild(1e-5, seldom);
        k.uncertainty[i] = wild(0.1, seldom);
    }
    for (int i = 0; i < 2 && s->spare > 0; i++)
        k.uncertainty[CURVED_SLIPS + 1 + i] = wild(0.05, seldom);
    for (int i = 0; i < 4; i++)
        k.evidence[i] = wild(9.0, seldom);
    k.doubt[0] = k.doubt[1] = wild(1e-4, seldom);
    k.prior[4] = k.prior[7] = R(0.05);
    for (int i = 0; i < 3; i++) {
        k.pose_noise[i] = wild(1e-6, seldom);
        k.pose_variance[i] = k.twist_variance[i] = wild(1e-4, seldom) + R(1e-12);
        k.largest_twist[i] = wild(4.0, seldom);
        k.largest_twist_jump[i] = wild(2.0, seldom);
        k.sensor_delay[i] = uniform(0.0, 0.02);
    }
    k.wheel_yaw_ratio = k.sensor_scale[0] = k.sensor_scale[1] = R(1.2);
    k.min_turn_radius = s->turns ? R(0.7) : R(0.0);
    k.min_commanded_radius = s->command_turns ? R(0.9) : R(0.0);
    k.surprise = R(9.0);
    k.patience = R(10.0);
    k.min_yaw_rate = k.min_speed = R(0.05);
    k.stamp_history = (real)(0.8 * k.longest_pause);
    k.monitor = 1;
    k.enough = (real)uniform(1.0, 30.0);
    const real windows[3] = {R(0.5), R(1.5), R(3.0)};
    memcpy(k.windows, windows, sizeof windows);
    k.silence = k.pose_spacing = k.lasting = k.response_time = R(0.1);
    k.latest = R(0.3);
    const real late[6] = {R(3.0), R(0.99), R(60.0), R(0.1), R(1.5), R(300.0)}, by_wheels[3] = {R(0.01), R(0.3), R(0.06)};
    const real delay_fit[8] = {R(0.001), R(0.01), R(0.05), R(0.002), R(0.01), R(20.0), R(5.0), R(2.0)};
    memcpy(k.late, late, sizeof late);
    memcpy(k.by_wheels, by_wheels, sizeof by_wheels);
    memcpy(k.delay_fit, delay_fit, sizeof delay_fit);
    k.often = k.margin = R(3.0);
    for (int i = 0; i < 2; i++) {
        k.gyro[i] = R(0.02);
        k.slip_turning[i] = k.slip_driving[i] = k.following[i] = k.sliding[i] = k.frozen[i] = k.doubtful[i] = R(0.1);
        k.odds[i] = R(6.0);
    }
    k.plausible = R(12.0);
    k.memory = R(5.0);
    k.held = R(0.2);
    k.far = R(64.0);
    k.unsure = R(3.0);
    k.doubtful_band = R(0.75);
    k.carried[0] = R(1.5), k.carried[1] = R(1.0);
    k.astray[0] = R(0.6), k.astray[1] = R(0.5);
    k.short_by[0] = R(0.04), k.short_by[1] = R(0.08);
    k.short_for = k.steady = k.smoothed = R(0.2);
    k.stuck = k.trial[1] = R(0.3);
    k.trial[0] = R(0.01);
    k.slowed = R(0.75);
    k.retry = R(0.7);
    k.regain[0] = R(0.6);
    k.regain[1] = R(0.2);
    k.on_spot = k.far_below = R(0.5);
    k.wheel_limits = 1;
    k.late[0] = R(16.0);
    k.late[1] = R(0.99);
    const real gains[4] = {R(0.2), R(6.0), R(8.0), R(0.5)}, scatter[5] = {R(0.04), R(25.0), R(9.0), R(6.25), R(400.0)};
    memcpy(k.gains, gains, sizeof gains);
    memcpy(k.scatter, scatter, sizeof scatter);
    k.monitor_turn_ratio = R(1.5);
    k.monitor_trust = (real)uniform(0.1, 1.0);
    k.largest_position_jump = k.largest_heading_jump = R(0.5);
    for (int i = 0; i < 2; i++) {
        k.command_weight[i] = wild(5.0, seldom);
        k.increment_weight[i] = wild(10.0, seldom) + R(1e-12);
        k.inverse_gain[3 * i] = R(1.0);
        k.lag_rest[i] = R(0.3);
        for (int side = 2 * i; side < 2 * i + 2; side++) {
            k.largest_command[side] = wild(uniform(0.5, 1.0 + i), seldom) + R(1e-12);
            k.slew[side] = wild(uniform(0.001, 0.1), seldom) + R(1e-12);
        }
        k.braking[i] = wild(uniform(0.01, 0.1), seldom) + R(0.004);
    }
    k.price = wild(50.0, seldom) + R(1e-12);
    k.price_slope = wild(50.0, seldom) + R(1e-12);
    for (int i = 0; i < s->soft; i++) {
        upper[i] = wild(uniform(0.1, 1.5), seldom);
        lower[i] = -upper[i];
    }
    k.soft_upper = upper, k.soft_lower = lower;
    k.half_track = R(0.3);
    k.slack = R(1e-6);
    k.active_set = once_in(4) ? below(5) : 400;
    k.forced = once_in(8);
    k.max_missed = below(4);
    k.max_pose_age = wild(0.5, seldom);
    k.dead_reckoning = wild(2.0, seldom);
    k.max_position_error = wild(5.0, seldom);
    k.fence = once_in(3);
    k.fence_at_start = once_in(2);
    k.fence_reach[0] = R(2.0), k.fence_reach[1] = R(1.0);
    k.finish_position = k.finish_speed = wild(0.02, seldom);
    k.finish_timeout = wild(2.0, seldom);
    k.max_reused_ticks = below(6);
    k.resume = !once_in(4);
    k.resume_within = once_in(3) ? wild(1.0, seldom) : R(100.0);
    k.reentry = once_in(2);
    k.band = wild(0.3, seldom), k.heading_band = wild(1.0, seldom);
    k.wait = wild(0.1, seldom) + R(1e-12), k.heading_wait = wild(0.5, seldom) + R(1e-12);
    k.behind = k.ahead = R(0.2);
    k.standing = k.turning = R(0.01);
    return k;
}

static void sample_reference(const void *context, ddmpc_time time, real pose[3], real twist[2], real *arc_length)
{
    const double t = time < 0.0 ? 0.0 : time > 1e6 ? 1e6 : time;
    (void)context;
    pose[0] = (real)spoilt(0.4 * t, 3000);
    pose[1] = (real)spoilt(0.3 * sin(t), 3000);
    pose[2] = (real)atan2(0.3 * cos(t), 0.4);
    twist[0] = (real)spoilt(0.5, 3000);
    twist[1] = (real)(0.3 * cos(t));
    *arc_length = (real)(0.5 * t);
}

/* A message with `count` values near `value`. */
static void fill_message(ddmpc_stamped *message, ddmpc_time t, const double *value, int count, double noise)
{
    memset(message, 0, sizeof *message);
    message->present = !once_in(5);
    message->stamp = spoilt(t - (once_in(3) ? uniform(0.0, 0.4) : 0.0), 60);
    message->has_covariance = once_in(3);
    for (int i = 0; i < count; i++)
        message->value[i] = (real)spoilt(value[i] + uniform(-noise, noise) + (once_in(80) ? 3.0 : 0.0), 80);
    for (int i = 0; i < 9; i++)
        message->covariance[i] = (real)spoilt(i % (count + 1) == 0 ? 1e-3 : 0.0, 80);
}

/* Slew counts from the controller's own `last` command, whatever the base says it got. */
static void check(const ddmpc_result *result, const ddmpc_constants *k, const real last[2])
{
    for (int i = 0; i < 2; i++) {
        const real command = result->command[i], rounding = R(1e-12) * (R(1.0) + ddmpc_fabs(last[i]));
        const int brakes = result->mode == DDMPC_BRAKING || result->mode == DDMPC_FINISHED;
        const real grows = brakes ? k->braking[i] : k->slew[2 * i], falls = brakes ? k->braking[i] : k->slew[2 * i + 1];
        const real size = ddmpc_fabs(last[i]);
        /* The command along the direction of the last one, and past zero in what is left of the tick. */
        const real along = last[i] < R(0.0) ? -command : command;
        const real smallest = size > falls ? size - falls : -grows * (R(1.0) - size / falls);
        const real ahead = k->largest_command[2 * i + (last[i] < R(0.0))], behind = k->largest_command[2 * i + !(last[i] < R(0.0))];
        if (!isfinite(command))
            fail("not finite", result);
        if (result->reasons & DDMPC_TIME_REPEATED) {
            /* After ddmpc_set_applied_commands what was sent is another; who stands goes on to stand. */
            if (command != (result->mode == DDMPC_STOPPED ? R(0.0) : last[i]))
                fail("a repeated tick changes the command", result);
            continue;
        }
        if (result->mode == DDMPC_STOPPED) {
            if (command != R(0.0))
                fail("stopped, and moves", result);
            continue;
        }
        if (along > ddmpc_max(ahead, smallest) + rounding || along < -behind - rounding)
            fail("outside its range", result);
        if (along > size + grows + rounding || along < smallest - rounding)
            fail("faster than slew or braking", result);
        if (brakes && ddmpc_fabs(command) > ddmpc_fabs(last[i]))
            fail("brakes, and speeds up", result);
    }
    if (result->mode < DDMPC_TRACKING || result->mode > DDMPC_FINISHED || result->notes > DDMPC_NOTES)
        fail("no such mode", result);
}

/* Answer a request of the core in the middle of a tick; return 1 if the tick is done. */
static int go_on(ddmpc_controller *c, const ddmpc_sizes *s, int pending)
{
    const int rows = (HARD + s->soft) * s->steps, choice = below(12);
    const int samples = ddmpc_samples(c);
    if (choice == 0)
        return 0;
    if (choice == 1)
        return ddmpc_give_up(c) == DDMPC_DONE;
    if (pending == DDMPC_NEEDS_TARGET) {
        real *poses = array(3 * samples), *twists = array(2 * samples), arc_length;
        const int seldom = once_in(3) ? 10 : 100000;
        if (choice == 2) {
            pending = ddmpc_too_far(c, (real)spoilt(2.0, 3));
        } else {
            for (int i = 0; i < samples; i++) {
                sample_reference(0, c->last_tick + 0.02 * i, poses + 3 * i, twists + 2 * i, &arc_length);
                poses[3 * i] = (real)spoilt(poses[3 * i], seldom);
            }
            pending = ddmpc_track(c, poses, twists, (real)uniform(0.0, 1.0));
        }
        free(poses);
        free(twists);
    }
    if (pending == DDMPC_NEEDS_BACKEND) {
        const int seldom = once_in(2) ? 20 : 100000;
        const ddmpc_report report = {below(DDMPC_QP_NOT_RUN + 1), DDMPC_BACKEND, 7, 1, 0, R(0.0), R(0.0), 0};
        real *plan = array(2 * s->steps), *multipliers = array(rows);
        int *broken = calloc((size_t)(HARD + s->soft), sizeof(int));
        real *soft = array((long)2 * s->steps * s->steps);
        for (int i = 0; i < 2 * s->steps; i++)
            plan[i] = (real)spoilt(uniform(-1.0, 1.0), seldom);
        for (int i = 0; i < rows; i++)
            multipliers[i] = once_in(20) ? (real)spoilt(uniform(-60.0, 60.0), seldom) : R(0.0);
        ddmpc_violated_kinds(c, plan, R(1e-6), broken);
        ddmpc_soft_rows(c, HARD + below(s->soft), soft);
        pending = ddmpc_answer(c, plan, multipliers, &report);
        free(plan);
        free(multipliers);
        free(broken);
        free(soft);
    }
    return pending == DDMPC_DONE;
}

typedef struct {
    double t, reference_time, pose[3], twist[2];
} robot;

static void fill_input(ddmpc_input *input, const robot *r)
{
    const double wheels[2] = {r->twist[0], 1.2 * r->twist[1]};
    fill_message(&input->pose, r->t, r->pose, 3, 0.01);
    fill_message(&input->wheels, r->t, wheels, 2, 0.02);
    fill_message(&input->yaw_rate, r->t, r->twist + 1, 1, 0.02);
    input->has_sent = once_in(6);
    for (int i = 0; i < 2; i++)
        input->sent[i] = (real)spoilt(r->twist[i], 6);
    input->request = once_in(40) ? 1 + below(3) : DDMPC_DRIVE;
    input->reference_time = spoilt(r->reference_time, 200);
    input->on_time = !once_in(8);
    input->deadline = once_in(20) ? spoilt(1e-9, 4) : 0.0;
    input->most_iterations = once_in(20) ? below(4) - 1 : 0;
    input->is_late = once_in(6);
}

/* The time of the next tick: mostly one sample on. */
static double next_time(double t)
{
    switch (below(60)) {
    case 0: return t;
    case 1: return t + 0.003;
    case 2: return t - uniform(0.0, 0.1);
    case 3: return t + uniform(0.02, 0.6);
    case 4: return t + 100.0;
    case 5: return spoilt(t, 1);
    default: return t + uniform(0.018, 0.022);
    }
}

/* At the start of the reference. */
static void put_at_start(robot *r)
{
    r->reference_time = r->pose[0] = r->pose[1] = r->twist[0] = r->twist[1] = 0.0;
    r->pose[2] = 0.6;
}

static void disturb(ddmpc_controller *c, const ddmpc_sizes *s, const ddmpc_constants *constants, robot *r)
{
    const ddmpc_reference reference = {sample_reference, 0, spoilt(20.0, 4)};
    const double t0 = spoilt(r->t, 4);
    const real sent[4] = {(real)uniform(-2.0, 2.0), (real)uniform(-2.0, 2.0), (real)uniform(-0.5, 0.5), (real)uniform(-0.5, 0.5)};
    real *parameters = ddmpc_parameters(c);
    switch (below(200)) {
    case 6: /* somebody else has driven, for longer than it looks back or for a tick */
        if (!ddmpc_set_applied_commands(c, sent, 1 + below(2)))
            abort();
        break;
    case 0: ddmpc_reset(c); break;
    case 1: ddmpc_forget(c); break;
    case 7: ddmpc_resume(c); break;
    case 2:
        if (ddmpc_start(c, &reference, t0) != (isfinite(t0) && isfinite(reference.duration)))
            abort();
        put_at_start(r);
        break;
    case 3: ddmpc_configure(c, constants + below(2)); break;
    case 4:
        for (int i = 0; i < (s->steps + 1) * s->parameters; i++)
            parameters[i] = (real)spoilt(uniform(-1.0, 1.0), 30);
        break;
    case 5: { /* the reference laid elsewhere, whose clock goes on, or another one */
        const int same = !once_in(4);
        const double from = same ? c->t0 : t0;
        if (!ddmpc_switch_reference(c, &reference, from))
            break;
        if (!isfinite(from) || !isfinite(reference.duration))
            abort();
        if (!same)
            put_at_start(r);
        break;
    }
    default: break;
    }
}

/* Somebody else has driven for a while: for nothing, a tick, and longer than is remembered. It draws nothing at random. */
static void overrule(ddmpc_controller *c, double t, ddmpc_input *input)
{
    static real sent[2 * 2000];
    const int counts[] = {0, 1, 3, 2000};
    for (int i = 0; i < 2 * 2000; i++)
        sent[i] = (real)(0.2 * sin(0.01 * i));
    for (int k = 0; k < 4; k++) {
        if (!ddmpc_set_applied_commands(c, sent, counts[k]))
            abort();
        ddmpc_step(c, t + 0.02 * (k + 1), input);
        ddmpc_give_up(c);
    }
    sent[1] = (real)NAN;
    if (ddmpc_set_applied_commands(c, sent, 1))
        abort();
}

static void drive(const subject *tested)
{
    const ddmpc_sizes *s = &tested->sizes;
    const ddmpc_constants constants[2] = {make_constants(s), make_constants(s)};
    const ddmpc_functions functions = {step, output, tested->term};
    const ddmpc_reference reference = {sample_reference, 0, 20.0};
    /* Exactly as much as the core asks for. */
    real *reals = malloc((size_t)ddmpc_reals(s) * sizeof(real));
    int *ints = malloc((size_t)ddmpc_ints(s) * sizeof(int)), counts[5] = {0}, ways[4] = {0};
    void *nodes = calloc((size_t)s->history, ddmpc_node_bytes());
    ddmpc_controller *c = malloc(ddmpc_controller_bytes());
    robot r = {0.0, 0.0, {0.0, 0.0, 0.0}, {0.0, 0.0}};
    ddmpc_input input;
    nonlinear_states = s->states;
    nonlinear_window = s->window;
    nonlinear_work = s->work;
    memset(&input, 0, sizeof input);
    if (!ddmpc_init(c, s, constants, &functions, reals, ints, nodes))
        abort();
    ddmpc_step(c, 0.0, &input);
    check(ddmpc_result_of(c), constants, (const real[2]){R(0.0), R(0.0)});
    ddmpc_start(c, &reference, 0.0);
    put_at_start(&r);
    for (int k = 0; k < tested->ticks; k++) {
        const double t = next_time(r.t), dt = isfinite(t) && fabs(t - r.t) < 1.0 ? t - r.t : 0.0;
        disturb(c, s, constants, &r);
        /* A clock that leaps stays there, or is set right again. */
        r.t = fabs(t) < 1e10 && (fabs(t - r.t) < 1.0 || once_in(2)) ? t : r.t;
        r.reference_time += dt;
        for (int i = 0; i < 2; i++)
            r.twist[i] += 0.2 * (ddmpc_last_command(c)[i] - r.twist[i]);
        r.pose[0] += dt * r.twist[0] * cos(r.pose[2]);
        r.pose[1] += dt * r.twist[0] * sin(r.pose[2]);
        r.pose[2] += dt * r.twist[1];
        fill_input(&input, &r);
        /* A tick that nobody went on with ends when the next begins, and that is checked with it. */
        const int open = c->pending != DDMPC_DONE;
        if (open)
            ddmpc_give_up(c);
        const real last[2] = {ddmpc_last_command(c)[0], ddmpc_last_command(c)[1]};
        int pending = ddmpc_step(c, t, &input);
        int done = pending == DDMPC_DONE || go_on(c, s, pending);
        if (!done)
            continue;
        const ddmpc_result *result = ddmpc_result_of(c);
        check(result, c->constants, last);
        counts[result->mode]++;
        ways[result->solver.path]++;
    }
    ddmpc_give_up(c);
    overrule(c, r.t, &input);
    printf("%-20s %5d ticks: tracking %d, reused %d, braking %d, stopped %d, finished %d; unlimited %d, active set %d, "
           "backend %d\n", tested->name, tested->ticks, counts[0], counts[1], counts[2], counts[3], counts[4], ways[1],
           ways[2], ways[3]);
    for (int i = 0; i < 2; i++)
        free_model(constants + i);
    DDMPC_RELEASE(reals, (size_t)ddmpc_reals(s) * sizeof(real));
    free(reals);
    free(ints);
    free(nodes);
    free(c);
}

static void check_bounds(void)
{
    const ddmpc_sizes good = {3, 2, 0, 1, 2, 4, 1, 0, 0, SHIPPED_SOFT, 0, 0, 0, 0, FLAT_SLIPS, 0, 0, 0, 0, 38};
    ddmpc_controller *c = malloc(ddmpc_controller_bytes());
    for (int field = 0; field < 11; field++)
        for (int bad = 0; bad < 3; bad++) {
            ddmpc_sizes sizes = good;
            (&sizes.steps)[field] = bad == 0 ? -1 : bad == 1 ? 100000 : -2147483647;
            /* These fields have no fixed maximum; only memory bounds them. */
            if (bad == 1 && (field == 5 || field == 6 || field == 7 || field == 8 || field == 10))
                continue;
            if (ddmpc_reals(&sizes) != 0 || ddmpc_init(c, &sizes, 0, 0, 0, 0, 0))
                abort();
        }
    free(c);
}

int main(int count, char **words)
{
    const subject subjects[] = {
        {"smallest", {1, 1, 0, 0, 1, 2, 0, 0, 0, 5, 0, 0, 0, 0, FLAT_SLIPS, 0, 0, 0, 0, 2}, {{0, 0, 0, 0}}, 3000},
        {"curved, turns", {5, 2, 1, 0, 2, 4, 0, 1, 0, 7, 0, 0, 0, 2, CURVED_SLIPS, 0, 0, 0, 0, 42}, {{0, 0, 0, 0}}, 3000},
        {"curved, function", {6, 3, 0, 0, 3, 4, 0, 0, 1, 6, 2, 2, 1, 0, CURVED_SLIPS, 0, 0, 0, 0, 13}, {{one_row, 1, 0, 0}, {one_row, 1, 1, 1}}, 2000},
        {"smallest, function", {1, 1, 0, 0, 1, 2, 0, 0, 1, 6, 2, 2, 1, 0, FLAT_SLIPS, 0, 0, 0, 0, 34}, {{one_row, 1, 0, 0}, {one_row, 1, 1, 1}}, 2000},
        {"usual", {15, 2, 1, 2, 8, 16, 4, 3, 0, 5, 0, 0, 0, 0, FLAT_SLIPS, 0, 0, 0, 3, 62}, {{0, 0, 0, 0}}, 3000},
        {"eight states, terms", {9, 8, 3, 2, 8, 16, 0, 9, 3, 8, 2, 2, 0, 0, FLAT_SLIPS, 0, 0, 0, 2, 20}, {{three_rows, 3, 0, 0}, {three_rows, 3, 1, 1}}, 1500},
        {"function, terms", {12, 3, 0, 0, 4, 10, 2, 2, 1, 8, 2, 3, 1, 0, FLAT_SLIPS, 0, 7, 0, 0, 56}, {{one_row, 1, 0, 1}, {three_rows, 3, 1, 2}}, 800},
        {"more window than horizon", {4, 2, 20, 30, 32, 40, 1, 1, 0, 5, 0, 0, 0, 0, FLAT_SLIPS, 0, 0, 0, 0, 40}, {{0, 0, 0, 0}}, 1000},
        {"largest", {200, 64, 490, 500, 512, 16, 60, 3, 3, 29, 2, 2, 0, 0, FLAT_SLIPS, 0, 0, 0, 10, 432}, {{three_rows, 3, 0, 0}, {many_rows, 24, 1, 1}}, 14},
        {"largest, function", {200, 64, 0, 0, 512, 16, 3, 60, 3, 29, 2, 2, 1, 0, CURVED_SLIPS, 0, 0, 0, 0, 432}, {{three_rows, 3, 0, 0}, {many_rows, 24, 1, 1}}, 5},
        {"turns, commanded", {8, 2, 1, 2, 12, 8, 1, 1, 0, 9, 0, 0, 0, 2, FLAT_SLIPS, 0, 0, 2, 7, 48}, {{0, 0, 0, 0}}, 3000},
    };
    state = count > 1 ? strtoull(words[1], 0, 10) : 1;
    state = state * 0x9E3779B97F4A7C15u + 1;
    check_bounds();
    /* A second word makes the drives shorter by that factor. */
    int share = count > 2 ? atoi(words[2]) : 1;
    for (size_t i = 0; i < sizeof subjects / sizeof subjects[0]; i++) {
        subject shorter = subjects[i];
        shorter.ticks = 1 + (shorter.ticks - 1) / share;
        drive(&shorter);
    }
    return 0;
}
