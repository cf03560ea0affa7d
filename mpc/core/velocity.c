/* The velocity model over one sample: either a linear model with dead time, or a nonlinear function with its Jacobian.
 * The linear model is x+ = A x + B0 u[k - d] + B1 u[k - d - 1], y = C x, where d is the dead time of v and of omega in
 * whole samples, and B0 and B1 represent its fractional part. models/structures defines the models, and mpc/problem
 * provides their constants. */
#include <string.h>

#include "internal.h"

/* Size of a Newton step after which the error is negligible, since the method converges quadratically, in units of
 * states and commands [m/s, rad/s]. */
static const real SMALL_STEP = R(1e-4);
enum { NEWTON_STEPS = 8 };

/* Whole samples of a delay; 0 for NaN, which must not become an index. */
static int whole_samples(real samples) { return samples > R(0.0) ? (int)samples : 0; }

real ddmpc_delayed(const real *sent, real samples)
{
    const int whole = whole_samples(samples);
    const real fraction = samples - (real)whole, command = sent[-2 * whole];
    /* The older command is read only if it is needed, since it may be outside the stored commands. */
    return fraction > R(0.0) ? command + fraction * (sent[-2 * whole - 2] - command) : command;
}

static void linear_step(const ddmpc_controller *c, const real *x, const real *newest, const real *delays,
                        real *next_state)
{
    const ddmpc_constants *k = c->constants;
    const int n = STATES(c);
    real recent[2], older[2];
    for (int channel = 0; channel < 2; channel++) {
        const real *acting = newest - 2 * DELAY(c, channel) + channel;
        const real samples = delays ? delays[channel] / (real)k->sample_time : R(0.0);
        recent[channel] = ddmpc_delayed(acting, samples);
        /* The previous command still acts during the fractional part of the dead time (B1). */
        older[channel] = ddmpc_delayed(acting - 2, samples);
    }
    for (int i = 0; i < n; i++) {
        real sum = R(0.0);
        for (int j = 0; j < n; j++)
            sum += k->A[i * n + j] * x[j];
        for (int j = 0; j < 2; j++)
            sum += k->B0[2 * i + j] * recent[j] + k->B1[2 * i + j] * older[j];
        next_state[i] = sum;
    }
}

void ddmpc_velocity_by_delay(const ddmpc_controller *c, const real *newest, const real *delays, real *by_delay)
{
    const ddmpc_constants *k = c->constants;
    const real dt = (real)k->sample_time;
    for (int channel = 0; channel < 2; channel++) {
        const real *acting = newest - 2 * (DELAY(c, channel) + whole_samples(delays[channel] / dt)) + channel;
        /* Slope of the interpolation in ddmpc_delayed, from each command to its predecessor. */
        const real recent = (acting[-2] - acting[0]) / dt, older = (acting[-4] - acting[-2]) / dt;
        for (int i = 0; i < STATES(c); i++)
            by_delay[2 * i + channel] = k->B0[2 * i + channel] * recent + k->B1[2 * i + channel] * older;
    }
}

void ddmpc_velocity_step(const ddmpc_controller *c, const real *x, const real *newest, const real *delays,
                         real *next_state, real *by_state, real *by_window)
{
    const int n = STATES(c);
    if (!NONLINEAR(c)) {
        linear_step(c, x, newest, delays, next_state);
        if (by_state)
            memcpy(by_state, c->constants->A, (size_t)(n * n) * sizeof(real));
        return;
    }
    real columns[DDMPC_MAX_STATES * DDMPC_MAX_STATES];
    const real *arguments[3] = {x, newest - 2 * WINDOW(c), c->constants->model_parameters};
    real *results[3] = {next_state, by_state ? columns : 0, by_window};
    c->functions.step(arguments, results, 0, c->problem.work, 0);
    if (by_state)
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++)
                by_state[i * n + j] = columns[i + n * j];
}

/* Set up the equations of a Newton step towards a steady state and its command: the state is constant, and the output
 * is `target`. The last columns are the residual, and the right-hand sides for derivatives by `target`. */
static void set_up_steady_state_equations(const ddmpc_controller *c, const real target[2], const real *state,
                                          const real command[2])
{
    const int n = STATES(c), columns = n + 5;
    real *held = c->problem.held, *by_window = c->problem.by_window, *rows = c->problem.settling;
    real next_state[DDMPC_MAX_STATES], y[2], by_output[2 * DDMPC_MAX_STATES];
    real by_state[DDMPC_MAX_STATES * DDMPC_MAX_STATES];
    for (int i = 0; i < 2 * (WINDOW(c) + 1); i++)
        held[i] = command[i % 2];
    ddmpc_velocity_step(c, state, held + 2 * WINDOW(c), 0, next_state, by_state, by_window);
    ddmpc_velocity_output(c, state, y, by_output);
    memset(rows, 0, (size_t)((n + 2) * columns) * sizeof(real));
    for (int i = 0; i < n; i++) {
        real *row = rows + i * columns;
        for (int j = 0; j < n; j++)
            row[j] = by_state[i * n + j] - (i == j ? R(1.0) : R(0.0));
        /* All commands of the window are equal, so the derivatives of each channel add up. */
        for (int j = 0; j < 2 * (WINDOW(c) + 1); j++)
            row[n + j % 2] += by_window[i + n * j];
        row[n + 2] = state[i] - next_state[i];
    }
    for (int i = 0; i < 2; i++) {
        real *row = rows + (n + i) * columns;
        memcpy(row, by_output + i * n, (size_t)n * sizeof(real));
        row[n + 2] = target[i] - y[i];
        row[n + 3 + i] = R(1.0);
    }
}

/* Gaussian elimination with row pivots; solutions replace the columns after the first `count`. Returns 0 if the
 * matrix is singular. */
static int eliminate(real *rows, int count, int columns)
{
    for (int p = 0; p < count; p++) {
        int pivot = p;
        for (int i = p + 1; i < count; i++)
            if (ddmpc_fabs(rows[i * columns + p]) > ddmpc_fabs(rows[pivot * columns + p]))
                pivot = i;
        /* Negated so that NaN fails. */
        if (!(ddmpc_fabs(rows[pivot * columns + p]) > R(0.0)))
            return 0;
        for (int j = p; j < columns; j++) {
            const real swapped = rows[p * columns + j];
            rows[p * columns + j] = rows[pivot * columns + j];
            rows[pivot * columns + j] = swapped;
        }
        for (int i = 0; i < count; i++) {
            const real factor = i == p ? R(0.0) : rows[i * columns + p] / rows[p * columns + p];
            for (int j = p; factor != R(0.0) && j < columns; j++)
                rows[i * columns + j] -= factor * rows[p * columns + j];
        }
    }
    for (int i = 0; i < count; i++)
        for (int j = count; j < columns; j++)
            rows[i * columns + j] /= rows[i * columns + i];
    return 1;
}

int ddmpc_velocity_settle(const ddmpc_controller *c, const real target[2], ddmpc_settled *settled)
{
    const int n = STATES(c), columns = n + 5;
    const real *rows = c->problem.settling, *limit = c->constants->largest_twist;
    real *unknowns[2] = {settled->state, settled->command};
    if (!settled->exists)
        memset(settled, 0, sizeof *settled);
    /* Start from the last solution, extrapolated by its derivative by the output. */
    for (int i = 0; i < n + 2; i++)
        for (int j = 0; j < 2; j++)
            unknowns[i >= n][i >= n ? i - n : i] += settled->by_output[2 * i + j] * (target[j] - settled->output[j]);
    memcpy(settled->output, target, sizeof settled->output);
    settled->exists = 0;
    for (int iteration = 0; iteration < NEWTON_STEPS && !settled->exists; iteration++) {
        set_up_steady_state_equations(c, target, settled->state, settled->command);
        if (!eliminate(c->problem.settling, n + 2, columns))
            return 0;
        real max_change = R(0.0);
        for (int i = 0; i < n + 2; i++) {
            const real *solved = rows + i * columns + n + 2;
            unknowns[i >= n][i >= n ? i - n : i] += solved[0];
            max_change = ddmpc_max(max_change, ddmpc_fabs(solved[0]));
            memcpy(settled->by_output + 2 * i, solved + 1, 2 * sizeof(real));
        }
        for (int i = 0; i < 2; i++)
            /* Negated so that NaN fails. */
            if (!(ddmpc_fabs(settled->command[i]) <= limit[i]))
                return 0;
        settled->exists = max_change <= SMALL_STEP;
    }
    return settled->exists;
}

void ddmpc_velocity_output(const ddmpc_controller *c, const real *x, real y[2], real *gradient)
{
    const int n = STATES(c);
    const real *C = c->constants->C;
    if (NONLINEAR(c)) {
        real columns[2 * DDMPC_MAX_STATES];
        const real *arguments[1] = {x};
        real *results[2] = {y, columns};
        c->functions.output(arguments, results, 0, 0, 0);
        for (int i = 0; gradient && i < 2; i++)
            for (int j = 0; j < n; j++)
                gradient[i * n + j] = columns[i + 2 * j];
        return;
    }
    for (int i = 0; i < 2; i++) {
        y[i] = R(0.0);
        for (int j = 0; j < n; j++)
            y[i] += C[i * n + j] * x[j];
    }
    if (gradient)
        memcpy(gradient, C, (size_t)(2 * n) * sizeof(real));
}
