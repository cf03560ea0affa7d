/* Layout of a controller in memory that the caller provides: sizes, and the start of each array. The core does not
 * allocate memory. */
#include <string.h>

#include "internal.h"

/* Tests add gaps between arrays to detect access out of bounds. */
#ifndef DDMPC_GAP
#define DDMPC_GAP 0
#define DDMPC_GUARD(address, bytes) ((void)(address))
#endif

/* Memory that is assigned to arrays in sequence; if the pointers are NULL, only the sizes are counted. */
typedef struct {
    real *reals;
    int *ints;
    long real_count, int_count;
} memory;

static real *reals(memory *m, long count)
{
    real *array = m->reals ? m->reals + m->real_count : 0;
    m->real_count += count + DDMPC_GAP;
    if (array)
        DDMPC_GUARD(array + count, DDMPC_GAP * sizeof(real));
    return array;
}

static int *ints(memory *m, long count)
{
    int *array = m->ints ? m->ints + m->int_count : 0;
    m->int_count += count;
    return array;
}

static void assign_estimator(ddmpc_controller *c, memory *m)
{
    const long Z = BELIEF(c);
    c->estimator.commands = reals(m, 2 * COMMANDS(c));
    for (int k = 0; k < HISTORY(c); k++) {
        ddmpc_belief beliefs[2];
        for (int i = 0; i < 2; i++) {
            beliefs[i].mean = reals(m, Z);
            beliefs[i].covariance = reals(m, Z * Z);
        }
        if (m->reals) {
            c->estimator.node[k].prior = beliefs[0];
            c->estimator.node[k].posterior = beliefs[1];
        }
    }
}

static void assign_problem(ddmpc_controller *c, memory *m)
{
    ddmpc_problem *p = &c->problem;
    const long N = STEPS(c), n = STATES(c), inputs = INPUTS(c), width = WIDTH(c), soft = SOFT(c), kinds = KINDS(c);
    const long rows = soft > RESIDUALS(c) ? soft : RESIDUALS(c);
    p->ahead = reals(m, N);
    if (SPARE(c)) {
        p->late_response = reals(m, 4 * (N + 1));
        p->late_twist = reals(m, 4 * width);
        p->late_mean = reals(m, 4 * width);
        p->late_heading = reals(m, 2 * width);
        p->late_hessian = reals(m, inputs * inputs);
    }
    p->free_twist = reals(m, 2 * (N + 1));
    p->aim = reals(m, 4 * (N + 1));
    p->feed_forward = reals(m, 2 * N);
    p->free_output = reals(m, 2 * (N + 1));
    p->by_plan = reals(m, 2 * (N + 1));
    if (ROWS(c)) {
        p->twist_rows = reals(m, (N + 1) * 2 * width);
        p->mean_rows = reals(m, N * 2 * width);
        p->heading_rows = reals(m, (N + 1) * width);
        p->model_output = reals(m, 2 * (N + 1));
    }
    if (NONLINEAR(c)) {
        p->sensitivity = reals(m, 2 * n * width);
        p->by_window = reals(m, n * 2 * (WINDOW(c) + 1));
        p->held = reals(m, 2 * (WINDOW(c) + 1));
        p->settling = reals(m, (n + 2) * (n + 5));
        p->work = reals(m, WORK(c));
    }
    p->poses = reals(m, 3 * (N + 1));
    p->arc = reals(m, 8 * N);
    p->cosine = reals(m, N);
    p->sine = reals(m, N);
    p->stack = reals(m, N * STACKED(c) * width);
    p->position = reals(m, N * 2 * width);
    p->moves = reals(m, 2 * width);
    p->gradient = reals(m, width);
    p->soft_value = reals(m, soft * N);
    p->soft_gradient = reals(m, soft * N * TERM_INPUTS);
    p->term = reals(m, rows * (1 + TERM_INPUTS));
    p->H = reals(m, inputs * inputs);
    p->g = reals(m, inputs);
    p->lower = reals(m, kinds * N);
    p->upper = reals(m, kinds * N);
    p->guess = reals(m, inputs);
    p->minimiser = reals(m, inputs);
    p->factor = reals(m, inputs * inputs + DDMPC_LANES);
    p->multipliers = reals(m, kinds * N);
    p->values = reals(m, kinds * N);
    p->plan = reals(m, inputs);
    p->active_kinds = ints(m, kinds);
}

static void assign_memory(ddmpc_controller *c, memory *m)
{
    const long N = STEPS(c);
    ddmpc_result *result = &c->result;
    assign_estimator(c, m);
    assign_problem(c, m);
    c->last_plan = reals(m, 2 * N);
    c->parameters = reals(m, (N + 1) * PARAMETERS(c));
    c->reference_pose = reals(m, 3 * SAMPLES(c));
    c->reference_twist = reals(m, 2 * SAMPLES(c));
    result->command = reals(m, 2);
    result->estimate.mean = reals(m, BELIEF(c));
    result->estimate.deviation = reals(m, BELIEF(c));
    result->estimate.twist = reals(m, 2);
    result->estimate.twist_deviation = reals(m, 2);
    result->estimate.innovations = reals(m, DDMPC_SENSORS);
    result->estimate.pose_age = reals(m, 1);
    result->planned_poses = reals(m, 3 * (N + 1));
    result->planned_commands = reals(m, 2 * N);
    result->aim = reals(m, 4 * (N + 1));
    const int rows = KINDS(c) * (int)N;
    c->limited.max_active = MAX_ACTIVE(c);
    c->limited.reals = reals(m, DDMPC_LIMITED_REALS((long)INPUTS(c), (long)rows, (long)MAX_ACTIVE(c)));
    c->limited.ints = ints(m, DDMPC_LIMITED_INTS((long)INPUTS(c), (long)rows, (long)MAX_ACTIVE(c)));
}

/* Return 1 if local arrays of fixed size are large enough for these sizes. */
static int fits(const ddmpc_sizes *s)
{
    return s->steps >= 1 && s->steps <= DDMPC_MAX_STEPS && s->states >= 1 && s->states <= DDMPC_MAX_STATES &&
           s->window >= 1 && s->window <= DDMPC_MAX_WINDOW && s->delay_v >= 0 && s->delay_v < s->window &&
           s->delay_omega >= 0 && s->delay_omega < s->window && s->history >= 2 && s->lag_v >= 0 && s->lag_omega >= 0 &&
           (s->turns == 0 || s->turns == TURN_ROWS) && (s->command_turns == 0 || s->command_turns == TURN_ROWS) &&
           (s->slips == FLAT_SLIPS || s->slips == CURVED_SLIPS) &&
           s->soft >= BUILT_IN_SOFT + s->turns + s->command_turns && s->soft + HARD <= DDMPC_MAX_KINDS &&
           s->residuals >= 0 && s->max_active >= 2 * s->steps && s->terms >= 0 && s->parameters >= 0 &&
           s->model_parameters >= 0 && s->work >= 0;
}

static memory count_memory(const ddmpc_sizes *sizes)
{
    ddmpc_controller c;
    memory m = {0, 0, 0, 0};
    memset(&c, 0, sizeof c);
    c.sizes = *sizes;
    if (fits(sizes))
        assign_memory(&c, &m);
    return m;
}

long ddmpc_reals(const ddmpc_sizes *sizes) { return count_memory(sizes).real_count; }

long ddmpc_ints(const ddmpc_sizes *sizes) { return count_memory(sizes).int_count; }

unsigned long ddmpc_node_bytes(void) { return (unsigned long)sizeof(ddmpc_node); }

unsigned long ddmpc_controller_bytes(void) { return (unsigned long)sizeof(ddmpc_controller); }

int ddmpc_init(ddmpc_controller *controller, const ddmpc_sizes *sizes, const ddmpc_constants *constants,
               const ddmpc_functions *functions, real *real_memory, int *int_memory, void *nodes)
{
    memory m = {real_memory, int_memory, 0, 0};
    if (!fits(sizes))
        return 0;
    memset(controller, 0, sizeof *controller);
    memset(real_memory, 0, (size_t)ddmpc_reals(sizes) * sizeof(real));
    memset(int_memory, 0, (size_t)ddmpc_ints(sizes) * sizeof(int));
    controller->sizes = *sizes;
    controller->constants = constants;
    if (functions)
        controller->functions = *functions;
    controller->estimator.node = (ddmpc_node *)nodes;
    assign_memory(controller, &m);
    ddmpc_reset(controller);
    return 1;
}
