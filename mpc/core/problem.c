/* The tracking problem linearised along a guess and condensed to a small dense quadratic program in the commands
 * U = (v_ref[0], omega_ref[0], v_ref[1], ...).
 *
 * Of a linear model twists and headings answer to commands as a linear time-invariant system does, so their matrices are
 * Toeplitz, and one row stands for all; a nonlinear one is linearised along the guess, and has a row for each sample. So
 * is curved slip: then outputs and rows are those of the body's twist itself, and no gain lies beyond them.
 * Step k answers to the commands before it only, and what is zero is left out. Only algebra stands here: motion, errors
 * and limits with their gradients are generated from mpc/problem/formulas.py, or are the user's. */
#include <string.h>

#include "internal.h"

/* The model's own row, where it is linear. */
static const real *model_row(const ddmpc_controller *c, int k, int channel)
{
    return c->constants->twist_row + channel * 2 * WIDTH(c) + 2 * (STEPS(c) - k);
}

/* Rows by the commands: twist of the model at the sample k, its mean over the arc k, heading at the sample k. */
static const real *twist_row(const ddmpc_controller *c, int k, int channel)
{
    if (ROWS(c))
        return c->problem.twist_rows + (2 * k + channel) * WIDTH(c);
    return model_row(c, k, channel);
}

static const real *mean_row(const ddmpc_controller *c, int k, int channel)
{
    if (ROWS(c))
        return c->problem.mean_rows + (2 * k + channel) * WIDTH(c);
    return c->constants->mean_row + channel * 2 * WIDTH(c) + 2 * (STEPS(c) - k - 1);
}

static const real *heading_row(const ddmpc_controller *c, int k)
{
    if (ROWS(c))
        return c->problem.heading_rows + k * WIDTH(c);
    return c->constants->heading_row + 2 * (STEPS(c) - k);
}

/* The command that a nonlinear model needs for a twist of the body, where it has one; its gain at rest gave `command`.
   `last` is where it settles at the sample before, near which this one is sought; most often it is the same. */
static void settle(const ddmpc_controller *c, const real wanted[2], ddmpc_settled *last, real command[2])
{
    static const real no_gain[4] = {R(1.0), R(0.0), R(0.0), R(1.0)};
    real y[2];
    const real *arguments[3] = {wanted, c->problem.slip, no_gain};
    real *results[1] = {y};
    WITH_SLIP(c, feed_forward)(arguments, results, 0, 0, 0);
    const int same = last->found && y[0] == last->output[0] && y[1] == last->output[1];
    if (same || ddmpc_velocity_settle(c, y, last))
        memcpy(command, last->command, sizeof last->command);
}

/* What to aim at, and the commands that would keep the reference's twist, one lag ahead. */
static void look_ahead(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_problem *p = &c->problem;
    const real two_pi = R(2.0) * DDMPC_PI;
    /* The estimate counts its turns itself: meet it on the turn it is on. */
    const real turns = two_pi * ddmpc_rint((p->pose[2] - c->reference_pose[2]) / two_pi);
    for (int i = 0; i <= STEPS(c); i++) {
        const real *pose = c->reference_pose + 3 * i;
        const real turned[3] = {pose[0], pose[1], pose[2] + turns};
        const real *arguments[3] = {turned, c->reference_twist + 2 * i, p->slip};
        real *results[1] = {p->aim + 4 * i};
        WITH_SLIP(c, aim)(arguments, results, 0, 0, 0);
    }
    ddmpc_settled last;
    last.found = 0;
    for (int i = 0; i < STEPS(c); i++) {
        real wanted[2];
        for (int channel = 0; channel < 2; channel++) {
            const real *now = c->reference_twist + 2 * (i + LAG(c, channel)) + channel;
            wanted[channel] = now[0] + k->lag_rest[channel] * (now[2] - now[0]);
        }
        const real *arguments[3] = {wanted, p->slip, k->inverse_gain};
        real *results[1] = {p->feed_forward + 2 * i};
        WITH_SLIP(c, feed_forward)(arguments, results, 0, 0, 0);
        if (NONLINEAR(c))
            settle(c, wanted, &last, p->feed_forward + 2 * i);
    }
}

/* Twist of the body for the model's free output, and what a plan adds per unit of the model's: slip is affine. Where it
   is not, the outputs are the body's already. */
static void free_twists(ddmpc_controller *c)
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
    p->gains[0] = J[0];
    p->gains[1] = J[3];
    p->turn_gain = J[2];
}

/* Forward speed of the body at the sample k under a plan that adds `by_plan`. */
static real speed_at(const ddmpc_controller *c, const real *by_plan, int k)
{
    const ddmpc_problem *p = &c->problem;
    return p->free_twist[2 * k] + p->gains[0] * by_plan[k] + p->turn_gain * by_plan[STEPS(c) + 1 + k];
}

/* Where the robot turns about along the guess. It stays there when the plan is sought: an acceleration moves it too
   little to be worth a gradient. */
static void find_turning_points(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    for (int k = 0; k < STEPS(c); k++) {
        const real gain = speed_at(c, p->by_plan, k + 1) - speed_at(c, p->by_plan, k);
        const real acceleration = gain / (real)c->constants->sample_time;
        const real *arguments[2] = {p->slip, &acceleration};
        real *results[1] = {p->ahead + k};
        WITH_SLIP(c, turning_point)(arguments, results, 0, 0, 0);
    }
}

void ddmpc_problem_begin(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    const int n = STATES(c), past = 2 * WINDOW(c);
    const real *z = c->result.estimate.mean, *commands = ddmpc_commands(c);
    ddmpc_problem *p = &c->problem;
    memcpy(p->pose, z + n + POSE(c), sizeof p->pose);
    memcpy(p->slip, z + n, (size_t)SLIPS(c) * sizeof(real));
    memcpy(p->last, c->last, sizeof p->last);
    look_ahead(c);
    if (NONLINEAR(c))
        return;
    real *said = CURVED(c) ? p->said : p->free_output;
    for (int i = 0; i < 2 * (STEPS(c) + 1); i++) {
        const real *from_state = k->from_state + i * n, *from_past = k->from_past + i * past;
        real free = R(0.0);
        for (int j = 0; j < n; j++)
            free += from_state[j] * z[j];
        for (int j = 0; j < past; j++)
            free += from_past[j] * commands[j];
        said[i] = free;
    }
    if (!CURVED(c))
        free_twists(c);
}

static real box(const ddmpc_controller *c, int step, int channel)
{
    /* A limit that was tightened below the last command is reached at the slew limit. */
    const real reachable = ddmpc_fabs(c->problem.last[channel]) - (real)(step + 1) * c->constants->slew[channel];
    return ddmpc_max(reachable, c->constants->largest_command[channel]);
}

void ddmpc_problem_guess(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    for (int i = 0; i < INPUTS(c); i++) {
        const real most = box(c, i / 2, i % 2);
        p->guess[i] = ddmpc_min(ddmpc_max(p->feed_forward[i], -most), most);
    }
    p->has_guess = 1;
}

/* What a plan adds to the twists of a linear model at the samples: a convolution. */
static void convolve(const real *response, const real *plan, int N, real *by_plan)
{
    memset(by_plan, 0, (size_t)(2 * (N + 1)) * sizeof(real));
    for (int channel = 0; channel < 2; channel++) {
        const real *to_v = response + 2 * channel * (N + 1), *to_omega = to_v + N + 1;
        real *sum = by_plan + channel * (N + 1);
        for (int j = 0; j < N; j++) {
            const real v = plan[2 * j], omega = plan[2 * j + 1];
            for (int m = 1; m <= N - j; m++)
                sum[j + m] += to_v[m] * v + to_omega[m] * omega;
        }
    }
}

/* The same from rows. */
static void add_rows(const ddmpc_controller *c, const real *plan, real *by_plan)
{
    const int N = STEPS(c);
    for (int channel = 0; channel < 2; channel++)
        for (int k = 0; k <= N; k++) {
            const real *row = twist_row(c, k, channel);
            real sum = R(0.0);
            for (int j = 0; j < 2 * k; j++)
                sum += row[j] * plan[j];
            by_plan[channel * (N + 1) + k] = sum;
        }
}

static void add_plan(const ddmpc_controller *c, const real *plan, real *by_plan)
{
    if (ROWS(c))
        add_rows(c, plan, by_plan);
    else
        convolve(c->constants->response, plan, STEPS(c), by_plan);
}

/* The outputs (2) of a nonlinear model at the samples under `plan`; `rows` says whether to keep its rows, too. */
static void run_model(ddmpc_controller *c, const real *plan, real *outputs, int rows)
{
    ddmpc_problem *p = &c->problem;
    const int n = STATES(c), N = STEPS(c), W = WINDOW(c), width = WIDTH(c);
    real line[2 * (DDMPC_MOST_WINDOW + DDMPC_MOST_STEPS)], state[DDMPC_MOST_STATES], next[DDMPC_MOST_STATES];
    real by_state[DDMPC_MOST_STATES * DDMPC_MOST_STATES], by_output[2 * DDMPC_MOST_STATES];
    real *now = p->sensitivity, *after = p->sensitivity + n * width;
    memcpy(line, ddmpc_commands(c), (size_t)(2 * W) * sizeof(real));
    memcpy(line + 2 * W, plan, (size_t)(2 * N) * sizeof(real));
    memcpy(state, c->result.estimate.mean, (size_t)n * sizeof(real));
    memset(now, 0, (size_t)(n * width) * sizeof(real));
    for (int k = 0; k <= N; k++) {
        ddmpc_velocity_output(c, state, outputs + 2 * k, by_output);
        for (int channel = 0; rows && channel < 2; channel++) {
            real *row = p->twist_rows + (2 * k + channel) * width;
            memset(row, 0, (size_t)width * sizeof(real));
            for (int i = 0; i < n; i++)
                for (int j = 0; j < 2 * k; j++)
                    row[j] += by_output[channel * n + i] * now[i * width + j];
        }
        if (k == N)
            break;
        ddmpc_velocity_step(c, state, line + 2 * (W + k), next, rows ? by_state : 0, rows ? p->by_window : 0);
        memcpy(state, next, (size_t)n * sizeof(real));
        if (!rows)
            continue;
        memset(after, 0, (size_t)(n * width) * sizeof(real));
        for (int i = 0; i < n; i++) {
            for (int m = 0; m < n; m++)
                for (int j = 0; j < 2 * k; j++)
                    after[i * width + j] += by_state[i * n + m] * now[m * width + j];
            /* The window's commands from the first of the plan on. */
            for (int w = k < W ? W - k : 0; w <= W; w++)
                for (int channel = 0; channel < 2; channel++)
                    after[i * width + 2 * (k - W + w) + channel] += p->by_window[i + n * (2 * w + channel)];
        }
        real *swapped = now;
        now = after;
        after = swapped;
    }
}

/* The same of a linear model. */
static void run_linear_model(ddmpc_controller *c, const real *plan, real *outputs, int rows)
{
    ddmpc_problem *p = &c->problem;
    const int N = STEPS(c), width = WIDTH(c);
    real added[2 * (DDMPC_MOST_STEPS + 1)];
    convolve(c->constants->response, plan, N, added);
    for (int i = 0; i < 2 * (N + 1); i++)
        outputs[i] = p->said[i] + added[(i % 2) * (N + 1) + i / 2];
    for (int k = 0; rows && k <= N; k++)
        for (int channel = 0; channel < 2; channel++) {
            real *row = p->twist_rows + (2 * k + channel) * width;
            memset(row, 0, (size_t)width * sizeof(real));
            memcpy(row, model_row(c, k, channel), (size_t)(2 * k) * sizeof(real));
        }
}

/* From what the model says to the body's twist. */
static void curve(ddmpc_controller *c, real *outputs, int rows)
{
    ddmpc_problem *p = &c->problem;
    const int width = WIDTH(c);
    for (int k = 0; k <= STEPS(c); k++) {
        real twist[2], J[2 * (2 + DDMPC_MOST_SLIPS)];
        const real *arguments[2] = {outputs + 2 * k, p->slip};
        real *results[2] = {twist, rows ? J : 0};
        WITH_SLIP(c, twist)(arguments, results, 0, 0, 0);
        memcpy(outputs + 2 * k, twist, sizeof twist);
        real *v = p->twist_rows + 2 * k * width, *omega = v + width;
        for (int j = 0; rows && j < 2 * k; j++) {
            const real says[2] = {v[j], omega[j]};
            v[j] = J[0] * says[0] + J[2] * says[1];
            omega[j] = J[1] * says[0] + J[3] * says[1];
        }
    }
}

static void run(ddmpc_controller *c, const real *plan, real *outputs, int rows)
{
    if (NONLINEAR(c))
        run_model(c, plan, outputs, rows);
    else
        run_linear_model(c, plan, outputs, rows);
    if (CURVED(c))
        curve(c, outputs, rows);
}

/* Linearise along the guess: rows, and what the output would be without a plan. */
static void linearise(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    const int N = STEPS(c), width = WIDTH(c);
    const real dt = (real)c->constants->sample_time;
    run(c, p->guess, p->free_output, 1);
    add_rows(c, p->guess, p->by_plan);
    for (int i = 0; i < 2 * (N + 1); i++)
        p->free_output[i] -= p->by_plan[(i % 2) * (N + 1) + i / 2];
    memset(p->heading_rows, 0, (size_t)width * sizeof(real));
    for (int k = 0; k < N; k++)
        for (int j = 0; j < width; j++) {
            for (int channel = 0; channel < 2; channel++)
                p->mean_rows[(2 * k + channel) * width + j] =
                    R(0.5) * (twist_row(c, k, channel)[j] + twist_row(c, k + 1, channel)[j]);
            p->heading_rows[(k + 1) * width + j] =
                p->heading_rows[k * width + j] + dt * p->mean_rows[(2 * k + 1) * width + j];
        }
    free_twists(c);
}

/* Poses by exact arcs, from the twists that the plan adds; with their gradients where `arcs` is given. */
static void roll_out(const ddmpc_controller *c, const real *by_plan, real *arcs, real *poses)
{
    const ddmpc_problem *p = &c->problem;
    const int N = STEPS(c);
    const real dt = (real)c->constants->sample_time, v_gain = p->gains[0], omega_gain = p->gains[1];
    real speed = speed_at(c, by_plan, 0);
    memcpy(poses, p->pose, sizeof p->pose);
    for (int k = 0; k < N; k++) {
        const real *free = p->free_twist + 2 * k, *at = poses + 3 * k;
        const real *omega = by_plan + N + 1 + k, next = speed_at(c, by_plan, k + 1);
        const real mean_v = R(0.5) * (speed + next);
        const real mean_omega = R(0.5) * (free[1] + free[3] + omega_gain * (omega[0] + omega[1]));
        real move[2], J[2 * 3];
        const real *arguments[6] = {at + 2, &mean_v, &mean_omega, p->slip, p->ahead + k, &dt};
        real *results[2] = {move, arcs ? J : 0};
        WITH_SLIP(c, arc)(arguments, results, 0, 0, 0);
        speed = next;
        poses[3 * k + 3] = at[0] + move[0];
        poses[3 * k + 4] = at[1] + move[1];
        poses[3 * k + 5] = at[2] + dt * mean_omega;
        for (int i = 0; arcs && i < 2; i++) {
            arcs[i * N + k] = move[i];
            arcs[(2 + 3 * i) * N + k] = v_gain * J[i];
            arcs[(3 + 3 * i) * N + k] = omega_gain * J[i + 2] + p->turn_gain * J[i];
            arcs[(4 + 3 * i) * N + k] = omega_gain * J[i + 4];
        }
    }
}

void ddmpc_problem_poses(ddmpc_controller *c, const real *plan, real *poses)
{
    ddmpc_problem *p = &c->problem;
    const int N = STEPS(c);
    add_plan(c, plan, p->by_plan);
    if (ROWS(c)) {
        real outputs[2 * (DDMPC_MOST_STEPS + 1)];
        run(c, plan, outputs, 0);
        /* Not linearised: what the plan really adds. */
        for (int i = 0; i < 2 * (N + 1); i++)
            p->by_plan[(i % 2) * (N + 1) + i / 2] = outputs[i] - p->free_output[i];
    }
    roll_out(c, p->by_plan, 0, poses);
}

/* Displacements (2, N) at the samples 1 to N that the linearised arcs owe to a plan, and its headings (N + 1). */
static void linear_moves(const ddmpc_controller *c, const real *by_plan, real *moves, real *headings)
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

/* Displacement of one arc per unit of mean v, mean omega and heading before it; heading of the path, roots of the
   weights and weighted residuals at its end. */
typedef struct {
    real x[3], y[3];
    real cosine, sine, along, across;
    real along_residual, across_residual, heading_residual;
} row_weights;

/* The rows of one sample: positions, errors along and across, and their part of the gradient. The compiler is told that
   nothing overlaps, and so works on whole lanes. */
static void fill_row(int count, const row_weights *w, const real *restrict mean_v,
                               const real *restrict mean_omega, const real *restrict before,
                               const real *restrict after, real *restrict moves_x, real *restrict moves_y,
                               real *restrict x, real *restrict y, real *restrict along, real *restrict across,
                               real *restrict gradient)
{
    const row_weights r = *w;
    for (int j = 0; j < count; j++) {
        const real move_x = moves_x[j] + r.x[0] * mean_v[j] + r.x[1] * mean_omega[j] + r.x[2] * before[j];
        const real move_y = moves_y[j] + r.y[0] * mean_v[j] + r.y[1] * mean_omega[j] + r.y[2] * before[j];
        const real ahead = r.along * (r.cosine * move_x + r.sine * move_y);
        const real beside = r.across * (r.cosine * move_y - r.sine * move_x);
        moves_x[j] = x[j] = move_x;
        moves_y[j] = y[j] = move_y;
        along[j] = ahead;
        across[j] = beside;
        gradient[j] += r.along_residual * ahead + r.across_residual * beside + r.heading_residual * after[j];
    }
}

/* A gradient by pose, twist of the body and command, made one by what the model says instead of the twist; the heading
   counts as turned by the model, too. `step` lies between its entries. */
static void through_slip(const ddmpc_problem *p, const real *by_body, int step, real gradient[TERM_INPUTS])
{
    for (int i = 0; i < TERM_INPUTS; i++)
        gradient[i] = by_body[step * i];
    gradient[4] = p->gains[1] * gradient[4] + p->turn_gain * gradient[3];
    gradient[3] *= p->gains[0];
    gradient[2] *= p->gains[1];
}

/* The row by the commands of something at sample k + 1 whose gradient is that of `through_slip`. */
static void term_row(const ddmpc_controller *c, int k, const real gradient[TERM_INPUTS], real *row)
{
    const ddmpc_problem *p = &c->problem;
    const int width = WIDTH(c), count = 2 * (k + 1);
    const real *x = p->position + 2 * k * width, *y = x + width;
    const real *heading = heading_row(c, k + 1), *v = twist_row(c, k + 1, 0), *omega = twist_row(c, k + 1, 1);
    for (int j = 0; j < count; j++)
        row[j] = gradient[0] * x[j] + gradient[1] * y[j] + gradient[2] * heading[j] + gradient[3] * v[j] +
                 gradient[4] * omega[j];
    row[count - 2] += gradient[5];
    row[count - 1] += gradient[6];
}

/* What a function of (pose, twist, command, reference, parameters) says at sample k + 1: value, then Jacobian. */
static void call_term(const ddmpc_controller *c, ddmpc_function function, int k, int rows, const real *command,
                      const real *parameters, real *out)
{
    const ddmpc_problem *p = &c->problem;
    /* No command acts at once: what is now does not hang on the plan. */
    const real twist[2] = {speed_at(c, p->by_plan, k + 1),
                           p->free_twist[2 * k + 3] + p->gains[1] * p->by_plan[STEPS(c) + 2 + k]};
    const real *arguments[5] = {p->poses + 3 * (k + 1), twist, command, p->aim + 4 * (k + 1), parameters};
    real *results[2] = {out, out + rows};
    function(arguments, results, 0, 0, 0);
}

static const real *parameters_at(const ddmpc_controller *c, int sample, const ddmpc_term *term)
{
    return c->parameters + sample * PARAMETERS(c) + term->first_parameter;
}

static real dot(const real *a, const real *b, int count)
{
    real sum = R(0.0);
    for (int i = 0; i < count; i++)
        sum += a[i] * b[i];
    return sum;
}

/* Rows of the user's residuals at sample k + 1 behind those along and across, and their part of the gradient. */
static void fill_residuals(ddmpc_controller *c, int k)
{
    ddmpc_problem *p = &c->problem;
    const int width = WIDTH(c), count = 2 * (k + 1);
    real *row = p->stack + (k * STACKED(c) + 2) * width;
    for (int t = 0; t < TERMS(c); t++) {
        const ddmpc_term *term = c->functions.terms + t;
        if (term->soft)
            continue;
        call_term(c, term->function, k, term->rows, p->guess + 2 * k, parameters_at(c, k + 1, term), p->term);
        for (int r = 0; r < term->rows; r++, row += width) {
            real gradient[TERM_INPUTS];
            through_slip(p, p->term + term->rows + r, term->rows, gradient);
            memset(row, 0, (size_t)width * sizeof(real));
            term_row(c, k, gradient, row);
            const real residual = p->term[r] - dot(row, p->guess, count);
            for (int j = 0; j < count; j++)
                p->gradient[j] += residual * row[j];
        }
    }
}

/* Rows of the errors along and across at the samples 1 to N, and with the residuals of the plan their gradient. */
static void fill_rows(ddmpc_controller *c)
{
    const ddmpc_constants *constants = c->constants;
    ddmpc_problem *p = &c->problem;
    const int N = STEPS(c), width = WIDTH(c);
    const real omega_gain = p->gains[1];
    real moves[2 * DDMPC_MOST_STEPS], headings[DDMPC_MOST_STEPS + 1];
    linear_moves(c, p->by_plan, moves, headings);
    memset(p->moves, 0, (size_t)(2 * width) * sizeof(real));
    memset(p->gradient, 0, (size_t)width * sizeof(real));
    for (int k = 0; k < N; k++) {
        real error[3], J[3 * TERM_INPUTS];
        const real *arguments[5] = {p->poses + 3 * (k + 1), 0, 0, p->aim + 4 * (k + 1), 0};
        real *results[2] = {error, J};
        ddmpc_f_errors(arguments, results, 0, 0, 0);
        const real cosine = p->cosine[k] = J[0], sine = p->sine[k] = J[3];
        /* The error less what the plan itself has brought about: the error at a plan of zeros, linearised here. */
        const real along = error[0] - (cosine * moves[k] + sine * moves[N + k]);
        const real across = error[1] - (cosine * moves[N + k] - sine * moves[k]);
        const real turned = error[2] - omega_gain * headings[k + 1];
        real *stack = p->stack + k * STACKED(c) * width, *position = p->position + 2 * k * width;
        const row_weights weights = {
            {p->arc[2 * N + k], p->arc[3 * N + k], p->arc[4 * N + k]},
            {p->arc[5 * N + k], p->arc[6 * N + k], p->arc[7 * N + k]},
            cosine, sine, constants->along[k], constants->across[k],
            constants->along[k] * along, constants->across[k] * across, omega_gain * constants->heading[k] * turned,
        };
        fill_row(ddmpc_whole_lanes(2 * (k + 1)), &weights, mean_row(c, k, 0), mean_row(c, k, 1), heading_row(c, k),
                 heading_row(c, k + 1), p->moves, p->moves + width, position, position + width, stack, stack + width,
                 p->gradient);
        if (RESIDUALS(c))
            fill_residuals(c, k);
        if (ROWS(c)) {
            real *row = stack + (STACKED(c) - 1) * width;
            const real root = omega_gain * ddmpc_sqrt(constants->heading[k]);
            for (int j = 0; j < width; j++)
                row[j] = root * heading_row(c, k + 1)[j];
        }
    }
}

/* The rows' squares, tile by tile. A row is zero beyond the commands that it answers to. */
static void square_stack(const real *stack, int steps, int stacked, int width, int inputs, real *H)
{
    for (int i = 0; i < inputs; i += DDMPC_LANES) {
        const int first = stacked * (i / 2);
        const real *left = stack + first * width + i;
        for (int j = 0; j <= i; j += DDMPC_LANES) {
            real sum[DDMPC_LANES][DDMPC_LANES];
            memset(sum, 0, sizeof sum);
            ddmpc_tile(left, stack + first * width + j, stacked * steps - first, width, sum);
            const int rows = inputs - i < DDMPC_LANES ? inputs - i : DDMPC_LANES;
            const int columns = inputs - j < DDMPC_LANES ? inputs - j : DDMPC_LANES;
            for (int a = 0; a < rows; a++)
                for (int b = 0; b < columns; b++)
                    H[(i + a) * inputs + j + b] = sum[a][b];
        }
    }
}

/* H: the rows' squares and what is constant. */
static void fill_hessian(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_problem *p = &c->problem;
    const int inputs = INPUTS(c);
    const real scale = p->gains[1] * p->gains[1];
    square_stack(p->stack, STEPS(c), STACKED(c), WIDTH(c), inputs, p->H);
    for (int i = 0; i < inputs; i++) {
        real *row = p->H + i * inputs;
        for (int j = 0; !ROWS(c) && j <= i; j++)
            row[j] += scale * k->heading_hessian[i * inputs + j];
        const real increment = k->increment_weight[i % 2];
        row[i] += k->command_weight[i % 2] + (i < inputs - 2 ? R(2.0) : R(1.0)) * increment;
        if (i >= 2)
            row[i - 2] -= increment;
        for (int j = 0; j < i; j++)
            p->H[j * inputs + i] = row[j];
    }
}

static void fill_gradient(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_problem *p = &c->problem;
    for (int i = 0; i < INPUTS(c); i++)
        p->g[i] = p->gradient[i] - k->command_weight[i % 2] * p->feed_forward[i];
    for (int channel = 0; channel < 2; channel++)
        p->g[channel] -= k->increment_weight[channel] * p->last[channel];
}

static void bound_commands(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    const int N = STEPS(c);
    for (int channel = 0; channel < 2; channel++)
        for (int k = 0; k < N; k++) {
            const real most = box(c, k, channel), slew = c->constants->slew[channel];
            const real base = k == 0 ? p->last[channel] : R(0.0);
            p->upper[channel * N + k] = most;
            p->lower[channel * N + k] = -most;
            p->upper[(2 + channel) * N + k] = base + slew;
            p->lower[(2 + channel) * N + k] = base - slew;
        }
}

/* Where the reference drives at sample k: 1 forwards, -1 backwards; where it stands, as it does next up to the sample
   `end`, or did last. */
static real direction_at(const ddmpc_controller *c, int k, int end)
{
    const real *v = c->reference_twist;
    int at = k;
    while (at < end && ddmpc_fabs(v[2 * at]) <= c->constants->standing)
        at++;
    while (at > 0 && ddmpc_fabs(v[2 * at]) <= c->constants->standing)
        at--;
    return v[2 * at] < R(0.0) ? R(-1.0) : R(1.0);
}

/* One kind of soft limit at sample k + 1, or now (k = -1): its value and gradient. */
typedef struct {
    ddmpc_function function;
    int rows, first;
    real radius;            /* the least of a turn that it keeps, from above only [m]; 0: it is about something else */
    int commanded;          /* whether that turn is the command's, and not the body's */
    const ddmpc_term *term; /* of the user; none for the shipped ones */
} soft_group;

static void soft_at(const ddmpc_controller *c, const soft_group *group, int k)
{
    const ddmpc_problem *p = &c->problem;
    real shipped[DDMPC_MOST_SLIPS + 1];
    if (group->radius > R(0.0)) {
        shipped[0] = group->radius;
        /* A command acts a lag later; what is so of the last one is its own. */
        if (group->commanded)
            shipped[1] = k >= 0            ? direction_at(c, k + LAG(c, 0), SAMPLES(c) - 1)
                         : p->last[0] < R(0.0) ? R(-1.0)
                                               : R(1.0);
        else
            shipped[1] = direction_at(c, k + 1, STEPS(c));
    } else {
        memcpy(shipped, p->slip, (size_t)SLIPS(c) * sizeof(real));
        shipped[SLIPS(c)] = c->constants->half_track;
    }
    call_term(c, group->function, k, group->rows, k < 0 ? p->last : p->guess + 2 * k,
              group->term ? parameters_at(c, k + 1, group->term) : shipped, p->term);
}

/* What a plan adds to something at sample k + 1 whose gradient is that of `through_slip`. */
static real value_of(const real *gradient, int k, int N, const real *moves, const real *headings, const real *by_plan,
                     const real *plan)
{
    return gradient[0] * moves[k] + gradient[1] * moves[N + k] + gradient[2] * headings[k + 1] +
           gradient[3] * by_plan[k + 1] + gradient[4] * by_plan[N + 1 + k + 1] + gradient[5] * plan[2 * k] +
           gradient[6] * plan[2 * k + 1];
}

/* Soft limits of one function. Where the robot is beyond a shipped limit already, its present value is the limit: back
   inside leads the reference. Nothing else may lead back inside a limit of the user, so those stand as they are given. */
static void limit_softly(ddmpc_controller *c, const soft_group *group, const real *moves, const real *headings)
{
    ddmpc_problem *p = &c->problem;
    const int N = STEPS(c), rows = group->rows;
    if (!group->term)
        soft_at(c, group, -1);
    for (int r = 0; r < rows; r++) {
        const int kind = group->first + r;
        if (group->radius > R(0.0)) {
            p->upper[(HARD + kind) * N] = ddmpc_max(R(0.0), p->term[r]);
            p->lower[(HARD + kind) * N] = -(real)INFINITY;
            continue;
        }
        const int wheel = !group->term && (r == 2 || r == 3);
        const real up = wheel ? ddmpc_min(c->constants->soft_upper[kind], c->rim_reach) : c->constants->soft_upper[kind];
        const real down = wheel ? -up : c->constants->soft_lower[kind];
        const real now = ddmpc_fabs(p->term[r]);
        p->upper[(HARD + kind) * N] = group->term ? up : ddmpc_max(up, now);
        p->lower[(HARD + kind) * N] = group->term ? down : ddmpc_min(down, -now);
    }
    for (int k = 0; k < N; k++) {
        soft_at(c, group, k);
        for (int r = 0; r < rows; r++) {
            const int kind = group->first + r;
            real *gradient = p->soft_gradient + (kind * N + k) * TERM_INPUTS;
            through_slip(p, p->term + rows + r, rows, gradient);
            const real by_plan = value_of(gradient, k, N, moves, headings, p->by_plan, p->guess);
            p->soft_value[kind * N + k] = p->term[r] - by_plan;
        }
    }
    for (int r = 0; r < rows; r++) {
        const int kind = group->first + r;
        real *upper = p->upper + (HARD + kind) * N, *lower = p->lower + (HARD + kind) * N;
        for (int k = N - 1; k >= 0; k--) {
            upper[k] = upper[0] - p->soft_value[kind * N + k];
            lower[k] = lower[0] - p->soft_value[kind * N + k];
        }
    }
}

static void bound_softly(ddmpc_controller *c)
{
    real moves[2 * DDMPC_MOST_STEPS], headings[DDMPC_MOST_STEPS + 1];
    soft_group group = {WITH_SLIP(c, soft), SHIPPED_SOFT, 0, R(0.0), 0, 0};
    linear_moves(c, c->problem.by_plan, moves, headings);
    limit_softly(c, &group, moves, headings);
    if (TURNS(c)) {
        group = (soft_group){ddmpc_f_turn, TURN_ROWS, SHIPPED_SOFT, c->constants->min_turn_radius, 0, 0};
        limit_softly(c, &group, moves, headings);
    }
    if (COMMAND_TURNS(c)) {
        const int first = group.first + group.rows;
        group = (soft_group){ddmpc_f_command_turn, TURN_ROWS, first, c->constants->min_commanded_radius, 1, 0};
        limit_softly(c, &group, moves, headings);
    }
    group.radius = R(0.0);
    for (int t = 0; t < TERMS(c); t++) {
        const ddmpc_term *term = c->functions.terms + t;
        if (!term->soft)
            continue;
        group.first += group.rows;
        group.rows = term->rows;
        group.function = term->function;
        group.term = term;
        limit_softly(c, &group, moves, headings);
    }
}

void ddmpc_problem_condense(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    if (ROWS(c))
        linearise(c);
    else
        add_plan(c, p->guess, p->by_plan);
    find_turning_points(c);
    roll_out(c, p->by_plan, p->arc, p->poses);
    fill_rows(c);
    fill_hessian(c);
    fill_gradient(c);
    bound_commands(c);
    bound_softly(c);
}

/* What limits are about, as far as it is linear in `plan` (4 + K, N): to be compared with lower and upper. */
void ddmpc_limit_values(const void *context, const real *plan, real *values)
{
    const ddmpc_controller *c = (const ddmpc_controller *)context;
    const ddmpc_problem *p = &c->problem;
    const int N = STEPS(c);
    real by_plan[2 * (DDMPC_MOST_STEPS + 1)], moves[2 * DDMPC_MOST_STEPS], headings[DDMPC_MOST_STEPS + 1];
    add_plan(c, plan, by_plan);
    linear_moves(c, by_plan, moves, headings);
    for (int channel = 0; channel < 2; channel++) {
        real before = R(0.0);
        for (int k = 0; k < N; k++) {
            const real now = plan[2 * k + channel];
            values[channel * N + k] = now;
            values[(2 + channel) * N + k] = now - before;
            before = now;
        }
    }
    for (int kind = 0; kind < SOFT(c); kind++) {
        real *out = values + (HARD + kind) * N;
        const real *gradient = p->soft_gradient + kind * N * TERM_INPUTS;
        for (int k = 0; k < N; k++, gradient += TERM_INPUTS)
            out[k] = value_of(gradient, k, N, moves, headings, by_plan, plan);
    }
}

void ddmpc_limit_row(const void *context, int index, real *row, int *first, int *last)
{
    const ddmpc_controller *c = (const ddmpc_controller *)context;
    const int N = STEPS(c), kind = index / N, k = index % N, at = 2 * k + kind % 2;
    memset(row, 0, (size_t)INPUTS(c) * sizeof(real));
    if (kind >= HARD) {
        term_row(c, k, c->problem.soft_gradient + ((kind - HARD) * N + k) * TERM_INPUTS, row);
        *first = 0;
        *last = 2 * (k + 1);
        return;
    }
    row[at] = R(1.0);
    *first = at;
    *last = at + 1;
    if (kind >= 2 && k > 0) {
        row[at - 2] = R(-1.0);
        *first = at - 2;
    }
}
