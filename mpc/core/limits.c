/* Limits of the quadratic program, one row per kind and sample, in the order of `lower` and `upper`. Hard limits: range
 * of v and omega, slew of v and omega. Soft limits: predicted twist, wheels, corridor, turn radii, and user-defined
 * terms. Soft limits are linearised along the guess, like the rest of the problem. */
#include <string.h>

#include "problem.h"

void ddmpc_reach(real last, const real step[2], real interval[2])
{
    const real rise = step[0], fall = step[1];
    interval[0] = last > R(0.0) ? last - fall : last - rise;
    interval[1] = last < R(0.0) ? last + fall : last + rise;
    /* After the command has passed zero, its absolute value increases, so the other rate applies. */
    if (last > R(0.0) && interval[0] < R(0.0))
        interval[0] *= rise / fall;
    if (last < R(0.0) && interval[1] > R(0.0))
        interval[1] *= rise / fall;
}

real ddmpc_fastest(const ddmpc_constants *k, int channel)
{
    return ddmpc_max(k->largest_command[2 * channel], k->largest_command[2 * channel + 1]);
}

real ddmpc_largest_command(const ddmpc_controller *c, int step, int channel, int side)
{
    /* If a limit was tightened below the last command, the bound approaches it at a slew that all rows permit. */
    const real *slew = c->constants->slew + 2 * channel;
    const real last = side ? -c->problem.last[channel] : c->problem.last[channel];
    const real reachable = last - (real)(step + 1) * ddmpc_min(slew[0], slew[1]);
    return ddmpc_max(reachable, c->constants->largest_command[2 * channel + side]);
}

static void bound_commands(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    const int N = STEPS(c);
    for (int channel = 0; channel < 2; channel++) {
        const real *slew = c->constants->slew + 2 * channel;
        real reach[2], *lower = p->lower + (2 + channel) * N, *upper = p->upper + (2 + channel) * N;
        ddmpc_reach(p->last[channel], slew, reach);
        /* The first increment is relative to zero (see ddmpc_limit_values), so its bounds are those of the command. */
        lower[0] = reach[0];
        upper[0] = reach[1];
        for (int k = 1; k < N; k++) {
            /* Take the sign of the previous command from the shifted plan. */
            const real before = p->guess[2 * (k - 1) + channel];
            lower[k] = before > R(0.0) ? -slew[1] : -slew[0];
            upper[k] = before < R(0.0) ? slew[1] : slew[0];
        }
        for (int k = 0; k < N; k++) {
            p->upper[channel * N + k] = ddmpc_largest_command(c, k, channel, 0);
            p->lower[channel * N + k] = -ddmpc_largest_command(c, k, channel, 1);
        }
    }
}

/* Direction of the reference at sample k: 1 forwards, -1 backwards. At standstill it is the next direction up to the
   sample `end`, or the previous direction if there is none. */
static real direction_at(const ddmpc_controller *c, int k, int end)
{
    const real *v = c->reference_twist;
    int moving = k;
    /* Each loop has at most as many iterations as there are samples. */
    while (moving < end && ddmpc_fabs(v[2 * moving]) <= c->constants->standing)
        moving++;
    while (moving > 0 && ddmpc_fabs(v[2 * moving]) <= c->constants->standing)
        moving--;
    return v[2 * moving] < R(0.0) ? R(-1.0) : R(1.0);
}

/* Direction of the reference at the time when command k acts, one lag later. */
static real commanded_direction(const ddmpc_controller *c, int k)
{
    return direction_at(c, k + LAG(c, 0), SAMPLES(c) - 1);
}

void ddmpc_directions(const ddmpc_controller *c, real *directions)
{
    for (int k = 0; k < STEPS(c); k++) {
        directions[k] = direction_at(c, k + 1, STEPS(c));
        directions[STEPS(c) + k] = commanded_direction(c, k);
    }
}

/* Kinds of soft limit with a common function, which computes their values and gradients. */
typedef struct {
    ddmpc_function function;
    int rows, first;
    real radius;            /* minimum turn radius, which has upper limits only [m]; 0: another kind of limit */
    int commanded;          /* 1 if the radius is that of the command, 0 if it is that of the body */
    const ddmpc_term *term; /* term of the user; NULL for a built-in limit */
} soft_group;

/* Evaluate the function of a group at sample k + 1, or at the current state if k = -1, into `problem.term`. */
static void evaluate_group(const ddmpc_controller *c, const soft_group *group, int k)
{
    const ddmpc_problem *p = &c->problem;
    real parameters[DDMPC_MAX_SLIPS + 1];
    if (group->radius > R(0.0)) {
        parameters[0] = group->radius;
        /* At the current state, the sign of the last command defines the direction. */
        if (group->commanded)
            parameters[1] = k >= 0 ? commanded_direction(c, k) : p->last[0] < R(0.0) ? R(-1.0) : R(1.0);
        else
            parameters[1] = direction_at(c, k + 1, STEPS(c));
    } else {
        memcpy(parameters, p->slip, (size_t)SLIPS(c) * sizeof(real));
        parameters[SLIPS(c)] = c->constants->half_track;
    }
    ddmpc_call_term(c, group->function, k, group->rows, k < 0 ? p->last : p->guess + 2 * k,
                    group->term ? ddmpc_parameters_at(c, k + 1, group->term) : parameters, p->term);
}

/* Contribution of a plan at sample k + 1 to a quantity whose gradient is from `ddmpc_through_slip`. */
static real value_of(const real *gradient, int k, int N, const real *moves, const real *headings, const real *by_plan,
                     const real *plan)
{
    return gradient[0] * moves[k] + gradient[1] * moves[N + k] + gradient[2] * headings[k + 1] +
           gradient[3] * by_plan[k + 1] + gradient[4] * by_plan[N + 1 + k + 1] + gradient[5] * plan[2 * k] +
           gradient[6] * plan[2 * k + 1];
}

/* Compute the bounds of the soft limits of one function. If the robot already exceeds a built-in limit, the current
   value becomes the limit, since tracking the reference reduces the excess. A user-defined limit is never changed, since
   it may be the only reason for the robot to reduce the excess. */
static void set_soft_bounds(ddmpc_controller *c, const soft_group *group, const real *moves, const real *headings)
{
    ddmpc_problem *p = &c->problem;
    const int N = STEPS(c), rows = group->rows;
    if (!group->term)
        evaluate_group(c, group, -1);
    for (int r = 0; r < rows; r++) {
        const int kind = group->first + r;
        if (group->radius > R(0.0)) {
            p->upper[(HARD + kind) * N] = ddmpc_max(R(0.0), p->term[r]);
            p->lower[(HARD + kind) * N] = -(real)INFINITY;
            continue;
        }
        /* Rows 2 and 3 are the rim speeds, which a learned limit of the wheels also bounds. */
        const int wheel = !group->term && (r == 2 || r == 3);
        const real up = wheel ? ddmpc_min(c->constants->soft_upper[kind], c->reach) : c->constants->soft_upper[kind];
        const real down = wheel ? -up : c->constants->soft_lower[kind];
        const real magnitude = ddmpc_fabs(p->term[r]);
        p->upper[(HARD + kind) * N] = group->term ? up : ddmpc_max(up, magnitude);
        p->lower[(HARD + kind) * N] = group->term ? down : ddmpc_min(down, -magnitude);
    }
    for (int k = 0; k < N; k++) {
        evaluate_group(c, group, k);
        for (int r = 0; r < rows; r++) {
            const int kind = group->first + r;
            real *gradient = p->soft_gradient + (kind * N + k) * TERM_INPUTS;
            ddmpc_through_slip(p, p->term + rows + r, rows, gradient);
            const real by_plan = value_of(gradient, k, N, moves, headings, p->by_plan, p->guess);
            p->soft_value[kind * N + k] = p->term[r] - by_plan;
        }
    }
    for (int r = 0; r < rows; r++) {
        const int kind = group->first + r;
        real *upper = p->upper + (HARD + kind) * N, *lower = p->lower + (HARD + kind) * N;
        /* The loop is backwards, since entry 0 contains the common bound until the last iteration. */
        for (int k = N - 1; k >= 0; k--) {
            upper[k] = upper[0] - p->soft_value[kind * N + k];
            lower[k] = lower[0] - p->soft_value[kind * N + k];
        }
    }
}

static void bound_soft_values(ddmpc_controller *c)
{
    real moves[2 * DDMPC_MAX_STEPS], headings[DDMPC_MAX_STEPS + 1];
    soft_group group = {WITH_SLIP(c, soft), BUILT_IN_SOFT, 0, R(0.0), 0, 0};
    ddmpc_linear_moves(c, c->problem.by_plan, moves, headings);
    set_soft_bounds(c, &group, moves, headings);
    if (TURNS(c)) {
        group = (soft_group){ddmpc_f_turn, TURN_ROWS, BUILT_IN_SOFT, c->constants->min_turn_radius, 0, 0};
        set_soft_bounds(c, &group, moves, headings);
    }
    if (COMMAND_TURNS(c)) {
        const int first = group.first + group.rows;
        group = (soft_group){ddmpc_f_command_turn, TURN_ROWS, first, c->constants->min_commanded_radius, 1, 0};
        set_soft_bounds(c, &group, moves, headings);
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
        set_soft_bounds(c, &group, moves, headings);
    }
}

void ddmpc_problem_limit(ddmpc_controller *c)
{
    bound_commands(c);
    bound_soft_values(c);
}

/* The values are comparable with `lower` and `upper`, which exclude the constant part of the limited quantities. */
void ddmpc_limit_values(const void *context, const real *plan, real *values)
{
    const ddmpc_controller *c = (const ddmpc_controller *)context;
    const ddmpc_problem *p = &c->problem;
    const int N = STEPS(c);
    real by_plan[2 * (DDMPC_MAX_STEPS + 1)], moves[2 * DDMPC_MAX_STEPS], headings[DDMPC_MAX_STEPS + 1];
    ddmpc_add_plan(c, plan, by_plan);
    ddmpc_linear_moves(c, by_plan, moves, headings);
    for (int channel = 0; channel < 2; channel++) {
        real previous = R(0.0);
        for (int k = 0; k < N; k++) {
            const real command = plan[2 * k + channel];
            values[channel * N + k] = command;
            values[(2 + channel) * N + k] = command - previous;
            previous = command;
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
        ddmpc_term_row(c, k, c->problem.soft_gradient + ((kind - HARD) * N + k) * TERM_INPUTS, row);
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
