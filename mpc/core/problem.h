/* Jacobian rows of predicted values by the commands; shared by linearise.c, condense.c and limits.c. */
#ifndef DDMPC_PROBLEM_H
#define DDMPC_PROBLEM_H

#include "internal.h"

/* Response of a linear model to a plan, including the estimated extra delays of the commands. */
static inline ddmpc_response ddmpc_rows(const ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    const ddmpc_problem *p = &c->problem;
    const ddmpc_response configured = {k->response, k->twist_row, k->mean_row, k->heading_row, k->heading_hessian};
    const ddmpc_response late = {p->late_response, p->late_twist, p->late_mean, p->late_heading, p->late_hessian};
    return p->late[0] > R(0.0) || p->late[1] > R(0.0) ? late : configured;
}

/* Row of a linear model's output. All rows are shifted copies of the last row, so the result points into this row. */
static inline const real *ddmpc_model_row(const ddmpc_controller *c, int k, int channel)
{
    return ddmpc_rows(c).twist + channel * 2 * WIDTH(c) + 2 * (STEPS(c) - k);
}

/* Derivatives by the commands: twist of the model at the sample k, its mean over the arc k, heading at the sample k. */
static inline const real *ddmpc_twist_row(const ddmpc_controller *c, int k, int channel)
{
    if (ROWS(c))
        return c->problem.twist_rows + (2 * k + channel) * WIDTH(c);
    return ddmpc_model_row(c, k, channel);
}

static inline const real *ddmpc_mean_row(const ddmpc_controller *c, int k, int channel)
{
    if (ROWS(c))
        return c->problem.mean_rows + (2 * k + channel) * WIDTH(c);
    return ddmpc_rows(c).mean + channel * 2 * WIDTH(c) + 2 * (STEPS(c) - k - 1);
}

static inline const real *ddmpc_heading_row(const ddmpc_controller *c, int k)
{
    if (ROWS(c))
        return c->problem.heading_rows + k * WIDTH(c);
    return ddmpc_rows(c).heading + 2 * (STEPS(c) - k);
}

/* Forward speed of the body at the sample k under a plan that adds `by_plan`. */
static inline real ddmpc_speed_at(const ddmpc_controller *c, const real *by_plan, int k)
{
    const ddmpc_problem *p = &c->problem;
    return p->free_twist[2 * k] + p->gains[0] * by_plan[k] + p->turn_gain * by_plan[STEPS(c) + 1 + k];
}

static inline const real *ddmpc_parameters_at(const ddmpc_controller *c, int sample, const ddmpc_term *term)
{
    return c->parameters + sample * PARAMETERS(c) + term->first_parameter;
}

/* linearise.c */
/* Compute the effect of a plan on the model's twists at the samples, (2, N + 1). */
void ddmpc_add_plan(const ddmpc_controller *c, const real *plan, real *by_plan);
/* Compute the linearised effect of a plan on positions (2, N) at the samples 1 to N, and on headings (N + 1). */
void ddmpc_linear_moves(const ddmpc_controller *c, const real *by_plan, real *moves, real *headings);

/* condense.c */
/* Evaluate a function of (pose, twist, command, reference, parameters) at sample k + 1: value, then Jacobian. */
void ddmpc_call_term(const ddmpc_controller *c, ddmpc_function function, int k, int rows, const real *command,
                     const real *parameters, real *out);
/* Convert a gradient by pose, body twist and command to a gradient by pose, model output and command, by the chain rule.
 * The heading is then also that of the model, the integral of its omega. `step` is the distance between entries of
 * `by_body`. */
void ddmpc_through_slip(const ddmpc_problem *p, const real *by_body, int step, real gradient[TERM_INPUTS]);
/* Compute the Jacobian row by the commands of a value at sample k + 1, from its gradient by `ddmpc_through_slip`. */
void ddmpc_term_row(const ddmpc_controller *c, int k, const real gradient[TERM_INPUTS], real *row);

/* limits.c */
/* Return the maximum command at a step of the plan [m/s, rad/s]. */
real ddmpc_largest_command(const ddmpc_controller *c, int step, int channel, int side);

#endif
