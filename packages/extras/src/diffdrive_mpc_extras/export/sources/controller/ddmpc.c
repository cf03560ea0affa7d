#include "ddmpc.h"

#include "internal.h"

/* Tolerance for splines through timed poses, which may overshoot the limit slightly. */
#define SPEED_TOLERANCE R(1.01)

static ddmpc_controller controller;
static real reals[DDMPC_REALS];
static int ints[DDMPC_INTS];
static ddmpc_node nodes[DDMPC_HISTORY];

ddmpc_controller *ddmpc_open(void)
{
    ddmpc_init(&controller, &ddmpc_this_sizes, &ddmpc_this_constants, &ddmpc_this_functions, reals, ints, nodes);
    for (int i = 0; i < (DDMPC_STEPS + 1) * DDMPC_PARAMETERS; i++)
        controller.parameters[i] = ddmpc_this_defaults[i % (DDMPC_PARAMETERS + !DDMPC_PARAMETERS)];
    return &controller;
}

ddmpc_reference ddmpc_reference_of(const ddmpc_trajectory *trajectory)
{
    const ddmpc_reference reference = {ddmpc_sample_one, trajectory, trajectory->duration};
    return reference;
}

static int is_within_limits(const ddmpc_controller *c, const ddmpc_reference *reference)
{
    for (ddmpc_time t = 0.0; t <= reference->duration; t += c->constants->sample_time) {
        real pose[3], twist[2], arc_length;
        reference->sample(reference->context, t, pose, twist, &arc_length);
        for (int channel = 0; channel < 2; channel++)
            if (!(ddmpc_fabs(twist[channel]) <=
                  SPEED_TOLERANCE * c->constants->largest_command[2 * channel + (twist[channel] < R(0.0))]))
                return 0;
    }
    return 1;
}

int ddmpc_follow(ddmpc_controller *c, const ddmpc_reference *reference, ddmpc_time t0)
{
    return isfinite(reference->duration) && is_within_limits(c, reference) && ddmpc_start(c, reference, t0);
}

const ddmpc_result *ddmpc_tick(ddmpc_controller *c, ddmpc_time t, const ddmpc_input *input)
{
    ddmpc_input timed_input = *input;
    timed_input.reference_time = t - c->t0;
    timed_input.on_time = 1;
    ddmpc_step(c, t, &timed_input);
    ddmpc_give_up(c);
    return ddmpc_result_of(c);
}
