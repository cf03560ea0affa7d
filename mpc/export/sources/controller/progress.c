#include "progress.h"

#include "constants.h"

static real distance_to(const ddmpc_controller *c, const real pose[3])
{
    const real *here = c->result.estimate.mean + DDMPC_POSE;
    return ddmpc_hypot(here[0] - pose[0], here[1] - pose[1]);
}

int ddmpc_is_finished(ddmpc_controller *c, ddmpc_time time, ddmpc_result *result)
{
    real pose[3], twist[2];
    const real *moving = c->result.estimate.twist;
    ddmpc_time duration = c->reference.duration;
    if (c->finished || time < duration)
        return c->finished;
    c->reference.sample(c->reference.context, duration, pose, twist);
    int settled = distance_to(c, pose) <= ddmpc_this_settings.finish_position &&
                  ddmpc_fabs(moving[0]) <= ddmpc_this_settings.finish_speed &&
                  ddmpc_fabs(moving[1]) <= ddmpc_this_settings.finish_speed;
    int late = time >= duration + ddmpc_this_settings.finish_timeout;
    if (late && !settled)
        result->reasons |= DDMPC_NOT_AT_REST;
    c->finished = settled || late;
    return c->finished;
}

int ddmpc_near_reference(const ddmpc_controller *c, ddmpc_time time)
{
    real pose[3], twist[2];
    c->reference.sample(c->reference.context, time, pose, twist);
    return distance_to(c, pose) <= ddmpc_this_settings.max_position_error; /* false for NaN, too */
}
