/* Linearisation of the tracking problem along a guess: response of twists, headings and poses of the robot to the
 * commands U = (v_ref[0], omega_ref[0], v_ref[1], ...).
 *
 * Twists and headings of a linear model respond as a linear time-invariant system. Their matrices are Toeplitz, so one
 * row represents all: y[k] = C A^k x + sum over j of C A^(k-1-j) B u[j], where x includes the commands in the dead
 * time. A nonlinear model is linearised along the guess and has a row for each sample. Curved slip is treated in the
 * same way: outputs and rows are then those of the body's twist, and the gains are 1. Poses are computed by exact arcs.
 * Motion, slip and target headings, with their gradients, are generated from mpc/problem/formulas.py. */
#include <string.h>

#include "problem.h"

/* Replace `command`, which was computed with the gain at rest, by the command for which the steady state of a nonlinear
   model has the body's twist `target`, if it exists. The search starts from `last`, the solution at the previous
   sample, which is usually close. */
static void find_steady_command(const ddmpc_controller *c, const real target[2], ddmpc_settled *last, real command[2])
{
    static const real no_gain[4] = {R(1.0), R(0.0), R(0.0), R(1.0)};
    real y[2];
    const real *arguments[3] = {target, c->problem.slip, no_gain};
    real *results[1] = {y};
    WITH_SLIP(c, feed_forward)(arguments, results, 0, 0, 0);
    const int same = last->exists && y[0] == last->output[0] && y[1] == last->output[1];
    if (same || ddmpc_velocity_settle(c, y, last))
        memcpy(command, last->command, sizeof last->command);
}

/* Compute the target poses, and the feed-forward from the last tick on: the commands for the reference's twist one lag
 * later. */
static void compute_targets(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_problem *p = &c->problem;
    const real two_pi = R(2.0) * DDMPC_PI;
    /* The estimated heading is unwrapped: shift the reference's heading to the same revolution. */
    const real turns = two_pi * ddmpc_rint((p->pose[2] - c->reference_pose[2]) / two_pi);
    for (int i = 0; i <= STEPS(c); i++) {
        const real *pose = c->reference_pose + 3 * i, *twist = c->reference_twist + 2 * i;
        const real unwrapped[3] = {pose[0], pose[1], pose[2] + turns};
        /* The last sample has the acceleration of the previous sample. */
        const real *from = i < SAMPLES(c) - 1 ? twist : twist - 2;
        const real acceleration = (from[2] - from[0]) / (real)k->sample_time;
        const real *arguments[4] = {unwrapped, twist, p->slip, &acceleration};
        real *results[1] = {p->aim + 4 * i};
        WITH_SLIP(c, aim)(arguments, results, 0, 0, 0);
    }
    ddmpc_settled last;
    last.exists = 0;
    /* Step -1 is the feed-forward of the last command, which is the base of the first increment in the cost. */
    for (int i = -1; i < STEPS(c); i++) {
        real target[2], *command = i < 0 ? p->fed_before : p->feed_forward + 2 * i;
        for (int channel = 0; channel < 2; channel++) {
            const real ahead = (real)(i + LAG(c, channel)) + k->lag_rest[channel] + p->late[channel];
            const real sample = ddmpc_max(ahead, R(0.0));
            const int whole = ddmpc_min_int((int)sample, SAMPLES(c) - 2);
            const real *current = c->reference_twist + 2 * whole + channel;
            target[channel] = current[0] + (sample - (real)whole) * (current[2] - current[0]);
        }
        const real *arguments[3] = {target, p->slip, k->inverse_gain};
        real *results[1] = {command};
        WITH_SLIP(c, feed_forward)(arguments, results, 0, 0, 0);
        if (NONLINEAR(c))
            find_steady_command(c, target, &last, command);
    }
}

/* Compute the body's twist for the model's free output, and the gains from the model's twist to the body's twist, which
   are constant for flat slip. With curved slip, the outputs are already those of the body. */
static void compute_free_twists(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    real J[2 * (2 + FLAT_SLIPS)];
    if (CURVED(c)) {
        memcpy(p->free_twist, p->free_output, (size_t)(2 * (STEPS(c) + 1)) * sizeof(real));
        p->gains[0] = p->gains[1] = R(1.0);
        p->turn_gain = R(0.0);
        return;
    }
    for (int k = 0; k <= STEPS(c); k++) {
        const real *arguments[2] = {p->free_output + 2 * k, p->slip};
        real *results[2] = {p->free_twist + 2 * k, J};
        ddmpc_f_twist(arguments, results, 0, 0, 0);
    }
    /* J is stored by columns. With flat slip the yaw rate does not depend on the forward speed, so J[1] is zero. */
    p->gains[0] = J[0];
    p->gains[1] = J[3];
    p->turn_gain = J[2];
}

/* Compute the turning points of the robot along the guess. The solver treats them as constant, since they depend only
   slightly on the acceleration. */
static void compute_turning_points(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    for (int k = 0; k < STEPS(c); k++) {
        const real gain = ddmpc_speed_at(c, p->by_plan, k + 1) - ddmpc_speed_at(c, p->by_plan, k);
        const real acceleration = gain / (real)c->constants->sample_time;
        const real *arguments[2] = {p->slip, &acceleration};
        real *results[1] = {p->ahead + k};
        WITH_SLIP(c, turning_point)(arguments, results, 0, 0, 0);
    }
}

/* Compute the effect of the first `count` commands of a plan on the twists of a linear model, by a convolution. */
static void convolve(const real *response, const real *plan, int count, int N, real *by_plan)
{
    memset(by_plan, 0, (size_t)(2 * (N + 1)) * sizeof(real));
    for (int channel = 0; channel < 2; channel++) {
        const real *to_v = response + 2 * channel * (N + 1), *to_omega = to_v + N + 1;
        real *sum = by_plan + channel * (N + 1);
        for (int j = 0; j < count; j++) {
            const real v = plan[2 * j], omega = plan[2 * j + 1];
            for (int m = 1; m <= N - j; m++)
                sum[j + m] += to_v[m] * v + to_omega[m] * omega;
        }
    }
}

/* Delay a row by `late` samples with linear interpolation. The result has `count` entries; the row has `known` entries
   and is zero beyond. `step` is 1 if later entries of the row belong to earlier times, and -1 otherwise. */
static void delay(const real *row, int known, int stride, int step, real samples, int count, real *out)
{
    const int whole = (int)samples;
    const real fraction = samples - (real)whole;
    for (int j = 0; j < count; j++) {
        const int first = j + step * whole, second = first + step;
        const real value = first >= 0 && first < known ? row[stride * first] : R(0.0);
        const real second_value = second >= 0 && second < known ? row[stride * second] : R(0.0);
        out[stride * j] = value + fraction * (second_value - value);
    }
}

/* Compute the model's response to plans whose commands have the estimated delays. Delays are rounded to milliseconds, so
   that the response rarely changes. */
static void update_delayed_response(ddmpc_controller *c, const real *delays)
{
    ddmpc_problem *p = &c->problem;
    const ddmpc_constants *k = c->constants;
    const int N = STEPS(c), row = 2 * WIDTH(c);
    real samples[2];
    for (int i = 0; i < 2; i++)
        samples[i] = R(1e-3) * ddmpc_rint(R(1e3) * delays[i]) / (real)k->sample_time;
    if (samples[0] == p->late[0] && samples[1] == p->late[1])
        return;
    memcpy(p->late, samples, sizeof samples);
    p->is_stale = 1;
    for (int i = 0; i < 2; i++) {
        for (int output = 0; output < 2; output++) {
            const int response = (2 * output + i) * (N + 1), first = output * row + i;
            delay(k->response + response, N + 1, 1, -1, samples[i], N + 1, p->late_response + response);
            delay(k->twist_row + first, N, 2, 1, samples[i], N, p->late_twist + first);
            delay(k->mean_row + first, N, 2, 1, samples[i], N, p->late_mean + first);
        }
        delay(k->heading_row + i, N, 2, 1, samples[i], N, p->late_heading + i);
    }
}

/* Delay the past commands (W + N, 2) by the estimated delays, from the first command of the window to the last command
   that acts during the plan. Returns the number of past commands that act during the plan. */
static int delay_commands(const ddmpc_controller *c, real *line)
{
    const real *samples = c->problem.late;
    const int W = WINDOW(c), active_count = ddmpc_min_int(STEPS(c), 1 + (int)ddmpc_max(samples[0], samples[1]));
    for (int i = 0; i < 2; i++)
        delay(ddmpc_commands(c) + i, W, 2, -1, samples[i], W + active_count, line + i);
    return active_count;
}

void ddmpc_problem_begin(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    const int n = STATES(c), past = 2 * WINDOW(c), N = STEPS(c);
    const real *z = c->result.estimate.mean;
    real line[2 * (DDMPC_MAX_WINDOW + DDMPC_MAX_STEPS)], past_response[2 * (DDMPC_MAX_STEPS + 1)];
    ddmpc_problem *p = &c->problem;
    if (SPARE(c))
        update_delayed_response(c, z + n + DELAYS(c));
    memcpy(p->pose, z + n + POSE(c), sizeof p->pose);
    memcpy(p->slip, z + n, (size_t)SLIPS(c) * sizeof(real));
    memcpy(p->last, c->last, sizeof p->last);
    compute_targets(c);
    if (NONLINEAR(c))
        return;
    real *free_output = CURVED(c) ? p->model_output : p->free_output;
    const int active_count = delay_commands(c, line);
    /* Past commands that act only during the plan have the same response as commands of the plan. */
    convolve(k->response, line + past, active_count, N, past_response);
    for (int i = 0; i < 2 * (STEPS(c) + 1); i++) {
        const real *from_state = k->from_state + i * n, *from_past = k->from_past + i * past;
        real free = R(0.0);
        for (int j = 0; j < n; j++)
            free += from_state[j] * z[j];
        for (int j = 0; j < past; j++)
            free += from_past[j] * line[j];
        free_output[i] = free + past_response[(i % 2) * (N + 1) + i / 2];
    }
    if (!CURVED(c))
        compute_free_twists(c);
}

void ddmpc_problem_guess(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    for (int i = 0; i < INPUTS(c); i++) {
        const real upper = ddmpc_largest_command(c, i / 2, i % 2, 0),
                   lower = -ddmpc_largest_command(c, i / 2, i % 2, 1);
        p->guess[i] = ddmpc_min(ddmpc_max(p->feed_forward[i], lower), upper);
    }
    p->has_guess = 1;
}

/* Compute the effect of a plan on the twists from their Jacobian rows. */
static void add_rows(const ddmpc_controller *c, const real *plan, real *by_plan)
{
    const int N = STEPS(c);
    for (int channel = 0; channel < 2; channel++)
        for (int k = 0; k <= N; k++) {
            const real *row = ddmpc_twist_row(c, k, channel);
            real sum = R(0.0);
            for (int j = 0; j < 2 * k; j++)
                sum += row[j] * plan[j];
            by_plan[channel * (N + 1) + k] = sum;
        }
}

void ddmpc_add_plan(const ddmpc_controller *c, const real *plan, real *by_plan)
{
    if (ROWS(c))
        add_rows(c, plan, by_plan);
    else
        convolve(ddmpc_rows(c).response, plan, STEPS(c), STEPS(c), by_plan);
}

/* Simulate a nonlinear model under `plan`: compute its outputs (2) at the samples and, if `rows`, its Jacobian rows. */
static void simulate_model(ddmpc_controller *c, const real *plan, real *outputs, int rows)
{
    ddmpc_problem *p = &c->problem;
    const int n = STATES(c), N = STEPS(c), W = WINDOW(c), width = WIDTH(c);
    real line[2 * (DDMPC_MAX_WINDOW + DDMPC_MAX_STEPS)], state[DDMPC_MAX_STATES], next[DDMPC_MAX_STATES];
    real by_state[DDMPC_MAX_STATES * DDMPC_MAX_STATES], by_output[2 * DDMPC_MAX_STATES];
    real *sensitivity = p->sensitivity, *next_sensitivity = p->sensitivity + n * width;
    memcpy(line, ddmpc_commands(c), (size_t)(2 * W) * sizeof(real));
    memcpy(line + 2 * W, plan, (size_t)(2 * N) * sizeof(real));
    memcpy(state, c->result.estimate.mean, (size_t)n * sizeof(real));
    memset(sensitivity, 0, (size_t)(n * width) * sizeof(real));
    for (int k = 0; k <= N; k++) {
        ddmpc_velocity_output(c, state, outputs + 2 * k, by_output);
        for (int channel = 0; rows && channel < 2; channel++) {
            real *row = p->twist_rows + (2 * k + channel) * width;
            memset(row, 0, (size_t)width * sizeof(real));
            for (int i = 0; i < n; i++)
                for (int j = 0; j < 2 * k; j++)
                    row[j] += by_output[channel * n + i] * sensitivity[i * width + j];
        }
        if (k == N)
            break;
        ddmpc_velocity_step(c, state, line + 2 * (W + k), 0, next, rows ? by_state : 0, rows ? p->by_window : 0);
        memcpy(state, next, (size_t)n * sizeof(real));
        if (!rows)
            continue;
        memset(next_sensitivity, 0, (size_t)(n * width) * sizeof(real));
        for (int i = 0; i < n; i++) {
            for (int m = 0; m < n; m++)
                for (int j = 0; j < 2 * k; j++)
                    next_sensitivity[i * width + j] += by_state[i * n + m] * sensitivity[m * width + j];
            /* Add the effect of the commands of the window that belong to the plan. */
            for (int w = k < W ? W - k : 0; w <= W; w++)
                for (int channel = 0; channel < 2; channel++)
                    next_sensitivity[i * width + 2 * (k - W + w) + channel] += p->by_window[i + n * (2 * w + channel)];
        }
        real *swapped = sensitivity;
        sensitivity = next_sensitivity;
        next_sensitivity = swapped;
    }
}

/* Simulate a linear model under `plan`: compute its outputs and, if `rows`, its Jacobian rows. */
static void simulate_linear_model(ddmpc_controller *c, const real *plan, real *outputs, int rows)
{
    ddmpc_problem *p = &c->problem;
    const int N = STEPS(c), width = WIDTH(c);
    real by_plan[2 * (DDMPC_MAX_STEPS + 1)];
    convolve(ddmpc_rows(c).response, plan, N, N, by_plan);
    for (int i = 0; i < 2 * (N + 1); i++)
        outputs[i] = p->model_output[i] + by_plan[(i % 2) * (N + 1) + i / 2];
    for (int k = 0; rows && k <= N; k++)
        for (int channel = 0; channel < 2; channel++) {
            real *row = p->twist_rows + (2 * k + channel) * width;
            memset(row, 0, (size_t)width * sizeof(real));
            memcpy(row, ddmpc_model_row(c, k, channel), (size_t)(2 * k) * sizeof(real));
        }
}

/* Convert the outputs and rows of the model to outputs and rows of the body's twist. */
static void apply_curved_slip(ddmpc_controller *c, real *outputs, int rows)
{
    ddmpc_problem *p = &c->problem;
    const int width = WIDTH(c);
    for (int k = 0; k <= STEPS(c); k++) {
        real twist[2], J[2 * (2 + DDMPC_MAX_SLIPS)];
        const real *arguments[2] = {outputs + 2 * k, p->slip};
        real *results[2] = {twist, rows ? J : 0};
        WITH_SLIP(c, twist)(arguments, results, 0, 0, 0);
        memcpy(outputs + 2 * k, twist, sizeof twist);
        real *v = p->twist_rows + 2 * k * width, *omega = v + width;
        for (int j = 0; rows && j < 2 * k; j++) {
            const real by_model[2] = {v[j], omega[j]};
            v[j] = J[0] * by_model[0] + J[2] * by_model[1];
            omega[j] = J[1] * by_model[0] + J[3] * by_model[1];
        }
    }
}

static void simulate(ddmpc_controller *c, const real *plan, real *outputs, int rows)
{
    if (NONLINEAR(c))
        simulate_model(c, plan, outputs, rows);
    else
        simulate_linear_model(c, plan, outputs, rows);
    if (CURVED(c))
        apply_curved_slip(c, outputs, rows);
}

/* Compute the rows along the guess, and the linearised output for a zero plan. */
static void linearise_rows(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    const int N = STEPS(c), width = WIDTH(c);
    const real dt = (real)c->constants->sample_time;
    simulate(c, p->guess, p->free_output, 1);
    /* Subtract the linear effect of the guess, so that the linearised output is exact at the guess. */
    add_rows(c, p->guess, p->by_plan);
    for (int i = 0; i < 2 * (N + 1); i++)
        p->free_output[i] -= p->by_plan[(i % 2) * (N + 1) + i / 2];
    memset(p->heading_rows, 0, (size_t)width * sizeof(real));
    for (int k = 0; k < N; k++)
        for (int j = 0; j < width; j++) {
            for (int channel = 0; channel < 2; channel++)
                p->mean_rows[(2 * k + channel) * width + j] =
                    R(0.5) * (ddmpc_twist_row(c, k, channel)[j] + ddmpc_twist_row(c, k + 1, channel)[j]);
            p->heading_rows[(k + 1) * width + j] =
                p->heading_rows[k * width + j] + dt * p->mean_rows[(2 * k + 1) * width + j];
        }
    compute_free_twists(c);
}

/* Compute poses by exact arcs from the plan's effect on the twists; if `arcs` is not NULL, also compute gradients. */
static void roll_out(const ddmpc_controller *c, const real *by_plan, real *arcs, real *poses)
{
    const ddmpc_problem *p = &c->problem;
    const int N = STEPS(c);
    const real dt = (real)c->constants->sample_time, v_gain = p->gains[0], omega_gain = p->gains[1];
    real speed = ddmpc_speed_at(c, by_plan, 0);
    memcpy(poses, p->pose, sizeof p->pose);
    for (int k = 0; k < N; k++) {
        const real *free = p->free_twist + 2 * k, *pose = poses + 3 * k;
        const real *omega = by_plan + N + 1 + k, next_speed = ddmpc_speed_at(c, by_plan, k + 1);
        const real mean_v = R(0.5) * (speed + next_speed);
        const real mean_omega = R(0.5) * (free[1] + free[3] + omega_gain * (omega[0] + omega[1]));
        real displacement[2], J[2 * 3];
        const real *arguments[6] = {pose + 2, &mean_v, &mean_omega, p->slip, p->ahead + k, &dt};
        real *results[2] = {displacement, arcs ? J : 0};
        WITH_SLIP(c, arc)(arguments, results, 0, 0, 0);
        speed = next_speed;
        poses[3 * k + 3] = pose[0] + displacement[0];
        poses[3 * k + 4] = pose[1] + displacement[1];
        poses[3 * k + 5] = pose[2] + dt * mean_omega;
        for (int i = 0; arcs && i < 2; i++) {
            arcs[i * N + k] = displacement[i];
            arcs[(2 + 3 * i) * N + k] = v_gain * J[i];
            arcs[(3 + 3 * i) * N + k] = omega_gain * J[i + 2] + p->turn_gain * J[i];
            /* ddmpc_linear_moves integrates headings without this gain, so the derivative must include it. */
            arcs[(4 + 3 * i) * N + k] = omega_gain * J[i + 4];
        }
    }
}

void ddmpc_problem_poses(ddmpc_controller *c, const real *plan, real *poses)
{
    ddmpc_problem *p = &c->problem;
    const int N = STEPS(c);
    ddmpc_add_plan(c, plan, p->by_plan);
    if (ROWS(c)) {
        real outputs[2 * (DDMPC_MAX_STEPS + 1)];
        simulate(c, plan, outputs, 0);
        /* Use the exact effect of the plan instead of the linearised effect. */
        for (int i = 0; i < 2 * (N + 1); i++)
            p->by_plan[(i % 2) * (N + 1) + i / 2] = outputs[i] - p->free_output[i];
    }
    roll_out(c, p->by_plan, 0, poses);
}

void ddmpc_linear_moves(const ddmpc_controller *c, const real *by_plan, real *moves, real *headings)
{
    const int N = STEPS(c);
    const real *arc = c->problem.arc, *v_added = by_plan, *omega_added = by_plan + N + 1;
    const real dt = (real)c->constants->sample_time;
    real x = R(0.0), y = R(0.0);
    headings[0] = R(0.0);
    for (int k = 0; k < N; k++) {
        const real v = R(0.5) * (v_added[k] + v_added[k + 1]);
        const real omega = R(0.5) * (omega_added[k] + omega_added[k + 1]);
        x += arc[2 * N + k] * v + arc[3 * N + k] * omega + arc[4 * N + k] * headings[k];
        y += arc[5 * N + k] * v + arc[6 * N + k] * omega + arc[7 * N + k] * headings[k];
        headings[k + 1] = headings[k] + dt * omega;
        moves[k] = x;
        moves[N + k] = y;
    }
}

void ddmpc_problem_linearise(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    if (ROWS(c))
        linearise_rows(c);
    else
        ddmpc_add_plan(c, p->guess, p->by_plan);
    compute_turning_points(c);
    roll_out(c, p->by_plan, p->arc, p->poses);
}
