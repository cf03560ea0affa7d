/* The velocity model over one sample: linear with dead time, or a function with its Jacobian. */
#include <string.h>

#include "internal.h"

static void linear_step(const ddmpc_controller *c, const real *x, const real *newest, real *after)
{
    const ddmpc_constants *k = c->constants;
    const int n = STATES(c);
    real recent[2], older[2];
    for (int channel = 0; channel < 2; channel++) {
        const real *acting = newest - 2 * DELAY(c, channel) + channel;
        recent[channel] = acting[0];
        older[channel] = acting[-2];
    }
    for (int i = 0; i < n; i++) {
        real sum = R(0.0);
        for (int j = 0; j < n; j++)
            sum += k->A[i * n + j] * x[j];
        for (int j = 0; j < 2; j++)
            sum += k->B0[2 * i + j] * recent[j] + k->B1[2 * i + j] * older[j];
        after[i] = sum;
    }
}

void ddmpc_velocity_step(const ddmpc_controller *c, const real *x, const real *newest, real *after, real *by_state,
                         real *scratch)
{
    const int n = STATES(c);
    if (!NONLINEAR(c)) {
        linear_step(c, x, newest, after);
        if (by_state)
            memcpy(by_state, c->constants->A, (size_t)(n * n) * sizeof(real));
        return;
    }
    const real *arguments[2] = {x, newest - 2 * WINDOW(c)};
    real *results[2] = {after, scratch};
    c->functions.step(arguments, results, 0, 0, 0);
    if (by_state)
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++)
                by_state[i * n + j] = scratch[i + n * j];
}

void ddmpc_velocity_output(const ddmpc_controller *c, const real *x, real y[2], real *gradient)
{
    const int n = STATES(c);
    const real *C = c->constants->C;
    if (NONLINEAR(c)) {
        real columns[2 * DDMPC_MOST_STATES];
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
