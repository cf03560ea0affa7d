/* Condensing: the cost of the linearised problem as a dense quadratic program in the commands alone,
 *
 *     minimise  U' H U / 2 + g' U,   H = S' S + constant terms,
 *
 * where S stacks the rows of the errors along, across and in heading, and of user-defined residuals: their derivatives
 * by the commands U, times the roots of their weights. S is the matrix J of docs/how-it-works.md, and H its
 * Gauss-Newton Hessian.
 *
 * The predicted states are eliminated: with N = 30 the program has 60 variables, independent of the order of the model.
 * The variables are the commands, not changes of the guess, so the contribution of the guess is subtracted from every
 * residual: g is then the gradient at U = 0, and limits need no shift.
 *
 * Sample k + 1 depends only on the commands 0 to k. Products skip the zeros of later commands, which saves about half of
 * the operations. Errors and their gradients are generated from mpc/problem/formulas.py or from user functions. */
#include <string.h>

#include "problem.h"
#include "tile.h"

/* Derivatives of one arc's displacement by mean v, mean omega and the heading at its start; cosine and sine of the
 * path's heading, roots of the weights, and residuals times these roots at the end of the arc. */
typedef struct {
    real x[3], y[3];
    real cosine, sine, along, across;
    real along_residual, across_residual, heading_residual;
} row_weights;

/* Fill the rows of one sample: positions, errors along and across, and their part of the gradient. Positions
 * accumulate over the arcs in `moves`. `restrict` states that the arrays do not overlap, without which the compiler
 * would not vectorise the loop. */
static void fill_row(int count, const row_weights *w, const real *restrict mean_v, const real *restrict mean_omega,
                     const real *restrict before, const real *restrict after, real *restrict moves_x,
                     real *restrict moves_y, real *restrict x, real *restrict y, real *restrict along,
                     real *restrict across, real *restrict gradient)
{
    const row_weights r = *w;
    for (int j = 0; j < count; j++) {
        const real move_x = moves_x[j] + r.x[0] * mean_v[j] + r.x[1] * mean_omega[j] + r.x[2] * before[j];
        const real move_y = moves_y[j] + r.y[0] * mean_v[j] + r.y[1] * mean_omega[j] + r.y[2] * before[j];
        const real ahead = r.along * (r.cosine * move_x + r.sine * move_y);
        const real sideways = r.across * (r.cosine * move_y - r.sine * move_x);
        moves_x[j] = x[j] = move_x;
        moves_y[j] = y[j] = move_y;
        along[j] = ahead;
        across[j] = sideways;
        gradient[j] += r.along_residual * ahead + r.across_residual * sideways + r.heading_residual * after[j];
    }
}

void ddmpc_through_slip(const ddmpc_problem *p, const real *by_body, int step, real gradient[TERM_INPUTS])
{
    for (int i = 0; i < TERM_INPUTS; i++)
        gradient[i] = by_body[step * i];
    /* Entries are x, y, heading, v, omega and the two commands. The body's v also depends on the model's omega
     * (turn_gain), and the model's heading is the integral of its omega. */
    gradient[4] = p->gains[1] * gradient[4] + p->turn_gain * gradient[3];
    gradient[3] *= p->gains[0];
    gradient[2] *= p->gains[1];
}

void ddmpc_term_row(const ddmpc_controller *c, int k, const real gradient[TERM_INPUTS], real *row)
{
    const ddmpc_problem *p = &c->problem;
    const int width = WIDTH(c), count = 2 * (k + 1);
    const real *x = p->position + 2 * k * width, *y = x + width;
    const real *v = ddmpc_twist_row(c, k + 1, 0), *omega = ddmpc_twist_row(c, k + 1, 1);
    const real *heading = ddmpc_heading_row(c, k + 1);
    for (int j = 0; j < count; j++)
        row[j] = gradient[0] * x[j] + gradient[1] * y[j] + gradient[2] * heading[j] + gradient[3] * v[j] +
                 gradient[4] * omega[j];
    /* A term may also depend directly on the command of its own step. */
    row[count - 2] += gradient[5];
    row[count - 1] += gradient[6];
}

void ddmpc_call_term(const ddmpc_controller *c, ddmpc_function function, int k, int rows, const real *command,
                     const real *parameters, real *out)
{
    const ddmpc_problem *p = &c->problem;
    /* No command acts immediately, so the current state (k = -1) does not depend on the plan. */
    const real twist[2] = {ddmpc_speed_at(c, p->by_plan, k + 1),
                           p->free_twist[2 * k + 3] + p->gains[1] * p->by_plan[STEPS(c) + 2 + k]};
    const real *arguments[5] = {p->poses + 3 * (k + 1), twist, command, p->aim + 4 * (k + 1), parameters};
    real *results[2] = {out, out + rows};
    function(arguments, results, 0, 0, 0);
}

static real dot(const real *a, const real *b, int count)
{
    real sum = R(0.0);
    for (int i = 0; i < count; i++)
        sum += a[i] * b[i];
    return sum;
}

/* Fill the rows of user-defined residuals at sample k + 1, after the rows along and across, and their part of the
 * gradient. User-defined functions include their weights. */
static void fill_residuals(ddmpc_controller *c, int k)
{
    ddmpc_problem *p = &c->problem;
    const int width = WIDTH(c), count = 2 * (k + 1);
    real *row = p->stack + (k * STACKED(c) + 2) * width;
    for (int t = 0; t < TERMS(c); t++) {
        const ddmpc_term *term = c->functions.terms + t;
        /* Functions with soft limits are not part of the cost; limits.c evaluates them. */
        if (term->soft)
            continue;
        ddmpc_call_term(c, term->function, k, term->rows, p->guess + 2 * k, ddmpc_parameters_at(c, k + 1, term),
                        p->term);
        for (int r = 0; r < term->rows; r++, row += width) {
            real gradient[TERM_INPUTS];
            ddmpc_through_slip(p, p->term + term->rows + r, term->rows, gradient);
            memset(row, 0, (size_t)width * sizeof(real));
            ddmpc_term_row(c, k, gradient, row);
            /* Remove the contribution of the guess, see the head of this file. */
            const real residual = p->term[r] - dot(row, p->guess, count);
            for (int j = 0; j < count; j++)
                p->gradient[j] += residual * row[j];
        }
    }
}

/* Fill the rows of the errors along and across at the samples 1 to N, and the gradient of the cost of all errors. */
static void fill_rows(ddmpc_controller *c)
{
    const ddmpc_constants *constants = c->constants;
    ddmpc_problem *p = &c->problem;
    const int N = STEPS(c), width = WIDTH(c);
    const real omega_gain = p->gains[1];
    real moves[2 * DDMPC_MAX_STEPS], headings[DDMPC_MAX_STEPS + 1];
    ddmpc_linear_moves(c, p->by_plan, moves, headings);
    /* The current position does not depend on the plan, so the accumulated rows start at zero. */
    memset(p->moves, 0, (size_t)(2 * width) * sizeof(real));
    memset(p->gradient, 0, (size_t)width * sizeof(real));
    for (int k = 0; k < N; k++) {
        real error[3], J[3 * TERM_INPUTS];
        const real *arguments[5] = {p->poses + 3 * (k + 1), 0, 0, p->aim + 4 * (k + 1), 0};
        real *results[2] = {error, J};
        ddmpc_f_errors(arguments, results, 0, 0, 0);
        /* J is column-major: its first column is the derivative by x, the second by y. */
        const real cosine = p->cosine[k] = J[0], sine = p->sine[k] = J[3];
        /* Error at a zero plan, linearised along the guess: the error minus the contribution of the guess. */
        const real along = error[0] - (cosine * moves[k] + sine * moves[N + k]);
        const real across = error[1] - (cosine * moves[N + k] - sine * moves[k]);
        const real heading_error = error[2] - omega_gain * headings[k + 1];
        real *stack = p->stack + k * STACKED(c) * width, *position = p->position + 2 * k * width;
        const row_weights weights = {
            {p->arc[2 * N + k], p->arc[3 * N + k], p->arc[4 * N + k]},
            {p->arc[5 * N + k], p->arc[6 * N + k], p->arc[7 * N + k]},
            cosine,
            sine,
            constants->along[k],
            constants->across[k],
            constants->along[k] * along,
            constants->across[k] * across,
            /* Weights along and across are roots, one in the row and one in the residual. The heading row `after` is not
             * weighted, so its residual has the full weight. */
            omega_gain * constants->heading[k] * heading_error,
        };
        /* The count is rounded up to whole lanes; the additional entries are zeros of the padding. */
        fill_row(ddmpc_whole_lanes(2 * (k + 1)), &weights, ddmpc_mean_row(c, k, 0), ddmpc_mean_row(c, k, 1),
                 ddmpc_heading_row(c, k), ddmpc_heading_row(c, k + 1), p->moves, p->moves + width, position,
                 position + width, stack, stack + width, p->gradient);
        if (RESIDUALS(c))
            fill_residuals(c, k);
        /* The heading rows of a linear model do not change, so their part of H is constant (heading_hessian). Other
         * models need the rows in the stack. */
        if (ROWS(c)) {
            real *row = stack + (STACKED(c) - 1) * width;
            const real root = omega_gain * ddmpc_sqrt(constants->heading[k]);
            for (int j = 0; j < width; j++)
                row[j] = root * ddmpc_heading_row(c, k + 1)[j];
        }
    }
}

/* Compute the lower triangle of S'S, tile by tile. Column i is zero in the samples before its command, i / 2, so the
 * product starts at that sample. The tiles keep partial sums in registers; this product is the largest part of
 * condensing. */
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

/* Fill H: S'S, the constant Hessian of the headings, and the weights of commands and increments. */
static void fill_hessian(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_problem *p = &c->problem;
    const int inputs = INPUTS(c);
    const real scale = p->gains[1] * p->gains[1], *heading_hessian = ddmpc_rows(c).heading_hessian;
    square_stack(p->stack, STEPS(c), STACKED(c), WIDTH(c), inputs, p->H);
    for (int i = 0; i < inputs; i++) {
        real *row = p->H + i * inputs;
        /* The constant Hessian is valid for a gain of 1 from the heading of the model to the heading of the body. */
        for (int j = 0; !ROWS(c) && j <= i; j++)
            row[j] += scale * heading_hessian[i * inputs + j];
        /* |u_k - u_(k-1)|^2 couples neighbours: 2 on the diagonal, 1 at the last command, which has no successor, and
         * -1 off the diagonal. Channels alternate, so the neighbour is two columns away. */
        const real increment = k->increment_weight[i % 2];
        row[i] += k->command_weight[i % 2] + (i < inputs - 2 ? R(2.0) : R(1.0)) * increment;
        if (i >= 2)
            row[i - 2] -= increment;
        /* Also fill the other triangle, since the residual of `minimise` and the backends read whole rows. */
        for (int j = 0; j < i; j++)
            p->H[j * inputs + i] = row[j];
    }
}

/* Fill g: the gradient of the errors, and the parts of commands and increments relative to the feed-forward. */
static void fill_gradient(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_problem *p = &c->problem;
    const real *feed_forward = p->feed_forward;
    const int inputs = INPUTS(c);
    for (int i = 0; i < inputs; i++) {
        const int channel = i % 2;
        /* Increments are relative to those of the feed-forward, so that a ramp of the reference has no cost. */
        const real into = feed_forward[i] - (i < 2 ? p->fed_before[channel] : feed_forward[i - 2]);
        const real out = i < inputs - 2 ? feed_forward[i + 2] - feed_forward[i] : R(0.0);
        p->g[i] =
            p->gradient[i] - k->command_weight[channel] * feed_forward[i] - k->increment_weight[channel] * (into - out);
    }
    /* The first increment is relative to the last sent command. */
    for (int channel = 0; channel < 2; channel++)
        p->g[channel] -= k->increment_weight[channel] * p->last[channel];
}

/* Compute the Hessian of the headings after the estimated delays have changed. */
static void square_headings(ddmpc_controller *c)
{
    ddmpc_problem *p = &c->problem;
    const int N = STEPS(c), width = WIDTH(c);
    memset(p->stack, 0, (size_t)(N * width) * sizeof(real));
    for (int k = 1; k <= N; k++) {
        const real root = ddmpc_sqrt(c->constants->heading[k - 1]), *row = ddmpc_heading_row(c, k);
        for (int j = 0; j < 2 * k; j++)
            p->stack[(k - 1) * width + j] = root * row[j];
    }
    square_stack(p->stack, N, 1, width, INPUTS(c), p->late_hessian);
    p->is_stale = 0;
}

void ddmpc_problem_condense(ddmpc_controller *c)
{
    /* This step precedes fill_rows, since it uses the stack as scratch memory. Without an extra delay, the configured
     * Hessian is used, so `late_hessian` may remain stale. */
    if (c->problem.is_stale && !ROWS(c) && ddmpc_rows(c).heading_hessian == c->problem.late_hessian)
        square_headings(c);
    fill_rows(c);
    fill_hessian(c);
    fill_gradient(c);
}
