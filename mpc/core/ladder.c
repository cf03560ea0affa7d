/* The failure ladder, which selects the command of a tick. The command is the first command of a new plan. If the solve
 * fails, the rest of the last valid plan is used for a few ticks; then the robot brakes to a standstill. All commands
 * are within range and slew, and respect the minimum commanded radius. */
/* for clock_gettime, which C99 alone does not declare */
#define _POSIX_C_SOURCE 199309L
#include <limits.h>
#include <string.h>

#include "clock.h"
#include "internal.h"

/* Clip `requested` to `share` of the range and to the interval that is reachable from the last command; `step` contains
 * the slew of an increasing and of a decreasing command of each channel. */
static void clip(const ddmpc_controller *c, const real requested[2], real share, const real step[4], real command[2])
{
    for (int i = 0; i < 2; i++) {
        const real *max_command = c->constants->largest_command + 2 * i;
        real reach[2];
        ddmpc_reach(c->last[i], step + 2 * i, reach);
        /* Slew has priority over range, since the last command may be outside a range that was tightened. */
        const real upper = ddmpc_min(reach[1], ddmpc_max(reach[0], share * max_command[0]));
        const real lower = ddmpc_max(reach[0], ddmpc_min(reach[1], -share * max_command[1]));
        command[i] = ddmpc_min(ddmpc_max(requested[i], lower), upper);
    }
}

/* Limit a command within range and slew to min_commanded_radius, if it is configured. The yaw rate is reduced as far as
 * the slew allows. If this is not enough, the speed is increased, but not above that of the last command. Such a command
 * always exists if the last command satisfied the minimum radius. */
static void enforce_min_radius(ddmpc_controller *c, real share, real command[2])
{
    const real radius = c->constants->min_commanded_radius, v = ddmpc_fabs(command[0]), last = c->last[1];
    real turns[2], speeds[2];
    if (!COMMAND_TURNS(c) || !(ddmpc_fabs(command[1]) * radius > v))
        return;
    ddmpc_reach(last, c->constants->slew + 2, turns);
    const real max_yaw_rate = v / radius, requested = command[1];
    const real lower = ddmpc_max(turns[0], -max_yaw_rate), upper = ddmpc_min(turns[1], max_yaw_rate);
    if (lower <= upper) {
        command[1] = ddmpc_min(ddmpc_max(requested, lower), upper);
    } else {
        const int backwards = c->last[0] < R(0.0);
        command[1] = last < R(0.0) ? turns[1] : turns[0];
        ddmpc_reach(c->last[0], c->constants->slew, speeds);
        const real last_speed = ddmpc_fabs(c->last[0]), required_speed = radius * ddmpc_fabs(command[1]);
        const real min_speed = backwards ? -speeds[1] : speeds[0];
        const real max_speed = ddmpc_max(min_speed, share * c->constants->largest_command[backwards]);
        const real speed = ddmpc_min(required_speed, ddmpc_min(last_speed, max_speed));
        if (speed > v || (command[0] < R(0.0)) != backwards)
            command[0] = backwards ? -speed : speed;
    }
    if (ddmpc_fabs(requested - command[1]) > c->constants->turn_held_from[0])
        c->result.reasons |= DDMPC_TURN_HELD;
}

/* Report a path, or a path back to the reference, that turns more tightly than commands are allowed to. */
static void report_turn(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    const real *feed_forward = c->problem.feed_forward;
    if (COMMAND_TURNS(c) && ddmpc_fabs(feed_forward[1]) * k->min_commanded_radius >
                                k->turn_held_share * ddmpc_fabs(feed_forward[0]) + k->turn_held_from[1])
        c->result.reasons |= DDMPC_TURN_HELD;
}

/* Ramp the command to zero. */
void ddmpc_ramp(ddmpc_controller *c)
{
    const real zero[2] = {R(0.0), R(0.0)};
    const real *rates = c->constants->braking, braking[4] = {rates[0], rates[0], rates[1], rates[1]};
    clip(c, zero, R(1.0), braking, c->result.command);
    /* A rounding error at the end of the ramp is not a motion command. */
    for (int i = 0; i < 2; i++)
        if (ddmpc_fabs(c->result.command[i]) < R(1e-13))
            c->result.command[i] = R(0.0);
}

int ddmpc_brake(ddmpc_controller *c, unsigned int reason, ddmpc_stop stop)
{
    ddmpc_result *result = &c->result;
    result->reasons |= reason;
    result->has_plan = 0;
    c->plan_age = -1;
    /* After a missed deadline, the next solve continues from the last iterate. */
    if (reason != DDMPC_DEADLINES_MISSED)
        ddmpc_solver_reset(c);
    c->is_outage = stop == DDMPC_OUTAGE;
    const int lasting = c->is_outage && c->last_tick - c->sound_tick > c->constants->resume_within;
    /* After a long stop a person may be next to the robot, which must not start by itself. Before the first drive and
       after the end of the reference, there is no drive to resume. */
    if (c->has_driven && !c->finished && (stop == DDMPC_WAITS || lasting || (stop && !c->constants->resume)))
        c->latched = 1;
    if (c->latched)
        result->reasons |= DDMPC_LATCHED;
    ddmpc_ramp(c);
    result->mode = result->command[0] != R(0.0) || result->command[1] != R(0.0) ? DDMPC_BRAKING : DDMPC_STOPPED;
    return DDMPC_DONE;
}

void ddmpc_stand(ddmpc_controller *c)
{
    c->result.command[0] = c->result.command[1] = R(0.0);
    c->result.mode = DDMPC_STOPPED;
}

/* Store a plan; the guess of the next solve is the shifted plan, with the last command repeated. */
static void store_plan(ddmpc_controller *c)
{
    const int inputs = INPUTS(c);
    real *guess = c->problem.guess;
    memcpy(c->last_plan, c->problem.plan, (size_t)inputs * sizeof(real));
    memcpy(guess, c->last_plan + 2, (size_t)(inputs - 2) * sizeof(real));
    memcpy(guess + inputs - 2, c->last_plan + inputs - 2, 2 * sizeof(real));
    c->problem.has_guess = 1;
}

/* Accept a plan and use its first command. */
static int accept(ddmpc_controller *c)
{
    ddmpc_result *result = &c->result;
    const size_t size = (size_t)INPUTS(c) * sizeof(real);
    store_plan(c);
    ddmpc_problem_poses(c, c->last_plan, result->planned_poses);
    memcpy(result->planned_commands, c->last_plan, size);
    memcpy(result->aim, c->problem.aim, (size_t)(4 * (STEPS(c) + 1)) * sizeof(real));
    c->plan_age = 0;
    result->has_plan = 1;
    result->mode = DDMPC_TRACKING;
    clip(c, c->last_plan, c->share, c->constants->slew, result->command);
    enforce_min_radius(c, c->share, result->command);
    report_turn(c);
    return DDMPC_DONE;
}

/* Use the next command of the last valid plan for at most a few ticks; then brake. */
int ddmpc_reuse(ddmpc_controller *c)
{
    const int usable = c->constants->max_reused_ticks < STEPS(c) - 1 ? c->constants->max_reused_ticks : STEPS(c) - 1;
    c->result.reasons |= DDMPC_SOLVE_FAILED;
    ddmpc_solver_reset(c);
    if (c->plan_age < 0 || ++c->plan_age > usable)
        return ddmpc_brake(c, 0, DDMPC_FAILURE);
    c->result.mode = DDMPC_REUSED_PLAN;
    c->result.has_plan = 1;
    clip(c, c->last_plan + 2 * c->plan_age, R(1.0), c->constants->slew, c->result.command);
    enforce_min_radius(c, R(1.0), c->result.command);
    return DDMPC_DONE;
}

static int is_usable(int status)
{
    return status == DDMPC_QP_SOLVED || status == DDMPC_QP_SOLVED_INACCURATELY || status == DDMPC_QP_STOPPED ||
           status == DDMPC_QP_STOPPED_IN_TIME;
}

/* Count consecutive ticks that miss their deadline; return 1 if there are too many. A plan in time resets the count. */
static int misses_too_many(ddmpc_controller *c)
{
    const int is_late = c->result.solver.status == DDMPC_QP_TIME_LIMIT || c->is_late || ddmpc_now() > c->deadline;
    const int max_missed = c->constants->max_missed;
    c->missed = !is_late ? 0 : c->missed < INT_MAX ? c->missed + 1 : c->missed;
    c->result.solver.missed = c->missed;
    return max_missed > 0 && c->missed >= max_missed;
}

int ddmpc_use_plan(ddmpc_controller *c)
{
    real sum = R(0.0);
    for (int i = 0; i < INPUTS(c); i++)
        sum += c->problem.plan[i] * c->problem.plan[i];
    const int is_good = is_usable(c->result.solver.status) && isfinite(sum);
    if (!misses_too_many(c))
        return is_good ? accept(c) : ddmpc_reuse(c);
    /* The robot brakes, but the next solve continues from this plan. */
    if (is_good)
        store_plan(c);
    return ddmpc_brake(c, DDMPC_DEADLINES_MISSED, DDMPC_FAILURE);
}
