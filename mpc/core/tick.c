/* One tick straight down from measurement to command, and what happens when a part of it fails. */
/* for clock_gettime, which C99 alone does not know */
#define _POSIX_C_SOURCE 199309L
#include <string.h>

#include "clock.h"
#include "internal.h"

/* From so much on it is said that a turn is held to the least radius [rad/s, m/s]. */
#define HELD_TURN R(0.05)
#define LEAST_TURN R(0.01)

static void forget(ddmpc_controller *c)
{
    ddmpc_estimator_forget(c);
    ddmpc_fence_clear(c);
    ddmpc_solver_reset(c);
    c->has_last_tick = c->has_leap = 0;
    c->plan_age = -1;
    c->has_result = c->has_driven = c->latched = c->finished = 0;
    c->rim[0] = c->rim[1] = c->carried = c->doubt = c->known = R(0.0);
    c->reference_twist[0] = c->reference_twist[1] = R(0.0);
    c->short_one = 0;
    c->tried = (real)HUGE_VAL;
    c->reach = c->rim_reach = (real)HUGE_VAL;
    c->pending = DDMPC_DONE;
}

void ddmpc_reset(ddmpc_controller *c)
{
    ddmpc_estimator_clear(c);
    forget(c);
    c->last[0] = c->last[1] = R(0.0);
}

void ddmpc_forget(ddmpc_controller *c) { forget(c); }

int ddmpc_configure(ddmpc_controller *c, const ddmpc_constants *constants, const ddmpc_sizes *sizes)
{
    const int delay[2] = {sizes->delay_v, sizes->delay_omega}, lag[2] = {sizes->lag_v, sizes->lag_omega};
    for (int i = 0; i < 2; i++)
        if (delay[i] < 0 || delay[i] >= WINDOW(c) || lag[i] < 0 || lag[i] > c->most_lag)
            return 0;
    c->constants = constants;
    c->sizes.delay_v = delay[0];
    c->sizes.delay_omega = delay[1];
    c->sizes.lag_v = lag[0];
    c->sizes.lag_omega = lag[1];
    return 1;
}

int ddmpc_start(ddmpc_controller *c, const ddmpc_reference *reference, ddmpc_time t0)
{
    if (!isfinite(t0) || !isfinite(reference->duration))
        return 0;
    forget(c);
    c->reference = *reference;
    c->t0 = t0;
    c->has_reference = 1;
    ddmpc_fence_place(c);
    return 1;
}

int ddmpc_relay(ddmpc_controller *c, const ddmpc_reference *reference, ddmpc_time t0)
{
    if (!c->has_reference || !isfinite(t0) || !isfinite(reference->duration))
        return 0;
    /* Another one is not finished because the one before was. */
    c->finished = c->finished && t0 == c->t0;
    c->reference = *reference;
    c->t0 = t0;
    return 1;
}

/* The nearest command inside `share` of range, and inside `step` of the last one. */
static void clip(const ddmpc_controller *c, const real wanted[2], real share, const real step[2], real command[2])
{
    for (int i = 0; i < 2; i++) {
        const real last = c->last[i], reachable = ddmpc_fabs(last) - step[i];
        const real most = ddmpc_max(reachable, share * c->constants->largest_command[i]);
        const real lower = ddmpc_max(last - step[i], -most), upper = ddmpc_min(last + step[i], most);
        command[i] = ddmpc_min(ddmpc_max(wanted[i], lower), upper);
    }
}

/* Turn a command inside range and slew no tighter than the least commanded radius, if there is one. Its yaw rate gives
 * way, as far as `step` allows; where that is not enough its speed is held, but never raised above that of the last one:
 * so slew is kept, and after a command that turned no tighter there is always one. */
static void widen(ddmpc_controller *c, real share, const real step[2], real command[2])
{
    const real radius = c->constants->min_commanded_radius, v = ddmpc_fabs(command[0]), last = c->last[1];
    if (!COMMAND_TURNS(c) || !(ddmpc_fabs(command[1]) * radius > v))
        return;
    const real widest = v / radius, asked = command[1];
    const real lower = ddmpc_max(last - step[1], -widest), upper = ddmpc_min(last + step[1], widest);
    if (lower <= upper) {
        command[1] = ddmpc_min(ddmpc_max(asked, lower), upper);
    } else {
        const real before = ddmpc_fabs(c->last[0]), needed = radius * (ddmpc_fabs(last) - step[1]);
        const real most = ddmpc_max(before - step[0], share * c->constants->largest_command[0]);
        const real held = ddmpc_min(needed, ddmpc_min(before, most));
        command[1] = last < R(0.0) ? last + step[1] : last - step[1];
        if (held > v || (command[0] < R(0.0)) != (c->last[0] < R(0.0)))
            command[0] = c->last[0] < R(0.0) ? -held : held;
    }
    if (ddmpc_fabs(asked - command[1]) > HELD_TURN)
        c->result.reasons |= DDMPC_TURN_HELD;
}

/* Say whether the path itself, or the way back to it, turns tighter than commands may. */
static void report_turn(ddmpc_controller *c)
{
    const real *asked = c->problem.feed_forward;
    if (COMMAND_TURNS(c) &&
        ddmpc_fabs(asked[1]) * c->constants->min_commanded_radius > R(1.01) * ddmpc_fabs(asked[0]) + LEAST_TURN)
        c->result.reasons |= DDMPC_TURN_HELD;
}

/* The command ramps to zero. */
static void ramp(ddmpc_controller *c)
{
    const real zero[2] = {R(0.0), R(0.0)};
    clip(c, zero, R(1.0), c->constants->braking, c->result.command);
    /* What rounding leaves of the last step is no motion. */
    for (int i = 0; i < 2; i++)
        if (ddmpc_fabs(c->result.command[i]) < R(1e-13))
            c->result.command[i] = R(0.0);
}

static int brake(ddmpc_controller *c, unsigned int reason, int failure)
{
    ddmpc_result *result = &c->result;
    result->reasons |= reason;
    result->has_plan = 0;
    c->plan_age = -1;
    ddmpc_solver_reset(c);
    /* Waiting for the first pose is no failure to be latched. */
    c->latched = c->latched || (failure && c->has_driven && !c->constants->resume);
    ramp(c);
    result->mode = result->command[0] != R(0.0) || result->command[1] != R(0.0) ? DDMPC_BRAKING : DDMPC_STOPPED;
    return DDMPC_DONE;
}

static void stand(ddmpc_controller *c)
{
    c->result.command[0] = c->result.command[1] = R(0.0);
    c->result.mode = DDMPC_STOPPED;
}

typedef enum { TICK_NEW, TICK_REPEATED, TICK_LEAPT, TICK_PAUSED, TICK_FAULTY } tick_kind;

/* What a call at `t` is, against the last one. */
static tick_kind look_at(const ddmpc_controller *c, ddmpc_time t)
{
    const ddmpc_constants *k = c->constants;
    const ddmpc_time gap = t - c->last_tick, since_leap = t - c->leap;
    if (!isfinite(t))
        return TICK_FAULTY;
    if (!c->has_last_tick)
        return TICK_NEW;
    if (gap < 0.0)
        return TICK_FAULTY;
    if (gap < 0.5 * k->sample_time)
        return TICK_REPEATED;
    if (gap <= k->longest_pause)
        return TICK_NEW;
    /* One leap may be a glitch of the clock; a second tick right after it shows that it was none. */
    return c->has_leap && since_leap > 0.0 && since_leap <= k->longest_pause ? TICK_PAUSED : TICK_LEAPT;
}

int ddmpc_is_new_tick(const ddmpc_controller *c, ddmpc_time t) { return look_at(c, t) == TICK_NEW; }

static tick_kind judge(ddmpc_controller *c, ddmpc_time t)
{
    const tick_kind kind = look_at(c, t);
    c->result.gap = t - c->last_tick;
    c->has_leap = kind == TICK_LEAPT;
    if (kind == TICK_LEAPT)
        c->leap = t;
    if (kind == TICK_NEW || kind == TICK_PAUSED) {
        c->last_tick = t;
        c->has_last_tick = 1;
    }
    return kind;
}

/* Take the robot to be where its rejected poses agree it is, once it has been told to stand. */
static int restart_elsewhere(ddmpc_controller *c)
{
    const real *commands = ddmpc_commands(c);
    for (int i = 0; i < 2 * WINDOW(c); i++)
        if (commands[i] != R(0.0))
            return 0;
    return c->constants->resume && ddmpc_estimator_restart_elsewhere(c);
}

static void take_estimate(ddmpc_controller *c)
{
    c->result.has_estimate = ddmpc_estimator_state(c) & READY;
    if (c->result.has_estimate)
        ddmpc_estimator_estimate(c);
}

static const real *pose_of(const ddmpc_controller *c)
{
    return c->result.estimate.mean + STATES(c) + POSE(c);
}

static real distance_to(const ddmpc_controller *c, const real pose[3])
{
    const real *here = pose_of(c);
    return ddmpc_hypot(here[0] - pose[0], here[1] - pose[1]);
}

/* Whether the robot rests at the end of its reference, or has had the time to; what is finished stays so. */
static int is_finished(ddmpc_controller *c, ddmpc_time time)
{
    const ddmpc_constants *k = c->constants;
    const real *moving = c->result.estimate.twist;
    const ddmpc_time duration = c->reference.duration;
    real pose[3], twist[2], arc_length;
    if (c->finished || !(time >= duration))
        return c->finished;
    c->reference.sample(c->reference.context, duration, pose, twist, &arc_length);
    const real distance = distance_to(c, pose);
    const int settled = distance <= k->finish_position && ddmpc_fabs(moving[0]) <= k->finish_speed &&
                        ddmpc_fabs(moving[1]) <= k->finish_speed;
    const int late = time >= duration + (ddmpc_time)k->finish_timeout;
    if (late && !settled) {
        c->result.reasons |= DDMPC_NOT_AT_REST;
        c->result.distance = distance;
    }
    c->finished = settled || late;
    return c->finished;
}

ddmpc_stray ddmpc_stray_from(const ddmpc_controller *c, const real *pose, const real *twist)
{
    const ddmpc_constants *k = c->constants;
    const real followed[4] = {pose[0], pose[1], pose[2], pose[2]};
    real error[3];
    const real *arguments[5] = {pose_of(c), 0, 0, followed, 0};
    real *results[2] = {error, 0};
    ddmpc_stray stray;
    ddmpc_f_errors(arguments, results, 0, 0, 0);
    stray.along = error[0];
    stray.across = error[1];
    stray.heading = ddmpc_wrap(error[2]);
    const real v = twist[0], omega = twist[1];
    const int backwards = v < R(0.0), driving = ddmpc_fabs(v) > k->standing;
    const real ahead = backwards ? -stray.along : stray.along;
    /* What is not known of the pose is no reason to leave the path for. */
    const real *deviation = c->result.estimate.deviation + STATES(c) + POSE(c);
    const real band = c->carried + ddmpc_max(k->band, k->unsure * ddmpc_hypot(deviation[0], deviation[1]));
    stray.outside = ddmpc_fabs(stray.across) > band || ddmpc_fabs(stray.heading) > k->heading_band ||
                    !(-k->behind <= ahead && ahead <= k->ahead);
    if (driving) {
        stray.late = -ahead / k->wait;
    } else {
        /* It stands, or turns on the spot: then the robot has to arrive first. */
        const real turning = !(ddmpc_fabs(omega) > k->turning) ? R(0.0)
                             : omega < R(0.0)                  ? stray.heading
                                                               : -stray.heading;
        const real away = ddmpc_max(ddmpc_hypot(stray.along, stray.across) - c->carried, R(0.0));
        stray.late = ddmpc_max(away / k->wait, turning / k->heading_wait);
    }
    /* The less it knows of its position, the slower it drives. */
    const real beyond = (c->doubt - k->doubtful_band) / (R(1.0) - k->doubtful_band);
    stray.late = ddmpc_max(stray.late, R(1.0) + beyond);
    return stray;
}

static void sample_reference(ddmpc_controller *c, ddmpc_time time)
{
    real arc_length;
    for (int i = 0; i < SAMPLES(c); i++)
        c->reference.sample(c->reference.context, time + i * c->constants->sample_time, c->reference_pose + 3 * i,
                            c->reference_twist + 2 * i, &arc_length);
}

static void shift_guess(ddmpc_controller *c)
{
    const int inputs = INPUTS(c);
    real *guess = c->problem.guess;
    memcpy(guess, c->kept + 2, (size_t)(inputs - 2) * sizeof(real));
    memcpy(guess + inputs - 2, c->kept + inputs - 2, 2 * sizeof(real));
    c->problem.has_guess = 1;
}

/* Take over a plan that may be driven. */
static int accept(ddmpc_controller *c)
{
    ddmpc_result *result = &c->result;
    const size_t size = (size_t)INPUTS(c) * sizeof(real);
    memcpy(c->kept, c->problem.plan, size);
    ddmpc_problem_poses(c, c->kept, result->planned_poses);
    memcpy(result->planned_commands, c->kept, size);
    memcpy(result->aim, c->problem.aim, (size_t)(4 * (STEPS(c) + 1)) * sizeof(real));
    shift_guess(c);
    c->plan_age = 0;
    result->has_plan = 1;
    result->mode = DDMPC_TRACKING;
    clip(c, c->kept, c->share, c->constants->slew, result->command);
    widen(c, c->share, c->constants->slew, result->command);
    report_turn(c);
    return DDMPC_DONE;
}

/* The rest of the last good plan, a few ticks at most. */
static int reuse(ddmpc_controller *c)
{
    const int usable = c->constants->max_reused_ticks < STEPS(c) - 1 ? c->constants->max_reused_ticks : STEPS(c) - 1;
    c->result.reasons |= DDMPC_SOLVE_FAILED;
    ddmpc_solver_reset(c);
    if (c->plan_age < 0 || ++c->plan_age > usable)
        return brake(c, 0, 1);
    c->result.mode = DDMPC_REUSED_PLAN;
    c->result.has_plan = 1;
    clip(c, c->kept + 2 * c->plan_age, R(1.0), c->constants->slew, c->result.command);
    widen(c, R(1.0), c->constants->slew, c->result.command);
    return DDMPC_DONE;
}

static int is_usable(int status) { return status == DDMPC_QP_SOLVED || status == DDMPC_QP_SOLVED_INACCURATELY; }

static int use(ddmpc_controller *c)
{
    real sum = R(0.0);
    for (int i = 0; i < INPUTS(c); i++)
        sum += c->problem.plan[i] * c->problem.plan[i];
    return is_usable(c->result.solver.status) && isfinite(sum) ? accept(c) : reuse(c);
}

static int track(ddmpc_controller *c)
{
    const ddmpc_time began = ddmpc_now();
    ddmpc_problem_begin(c);
    if (!c->problem.has_guess)
        ddmpc_problem_guess(c);
    ddmpc_problem_condense(c);
    const int pending = ddmpc_solve(c);
    c->result.solve_time = ddmpc_now() - began;
    return pending == DDMPC_NEEDS_BACKEND ? pending : use(c);
}

/* Speeds of the right and left wheels at the rim for a twist of the body. */
static void rims(const ddmpc_controller *c, const real *twist, real rim[2])
{
    real parameters[DDMPC_MOST_SLIPS + 1], value[SHIPPED_SOFT];
    const real nowhere[4] = {R(0.0), R(0.0), R(0.0), R(0.0)};
    const real *arguments[5] = {nowhere, twist, 0, nowhere, parameters};
    real *results[2] = {value, 0};
    memcpy(parameters, c->result.estimate.mean + STATES(c), (size_t)SLIPS(c) * sizeof(real));
    parameters[SLIPS(c)] = c->constants->half_track;
    WITH_SLIP(c, soft)(arguments, results, 0, 0, 0);
    rim[0] = value[2];
    rim[1] = value[3];
}

/* The least and the most that commands have asked of each wheel since a while before their lag, in the directions
 * `sign`; 0 where that is longer ago than commands are remembered. */
static int asked_for(const ddmpc_controller *c, const real sign[2], real least[2], real most[2])
{
    const real *G = c->constants->inverse_gain, determinant = G[0] * G[3] - G[1] * G[2];
    const int lag = LAG(c, 0) > LAG(c, 1) ? LAG(c, 0) : LAG(c, 1), newest = COMMANDS(c) - 1;
    const int since = lag + (int)(c->constants->short_for / (real)c->constants->sample_time);
    if (since > newest)
        return 0;
    for (int ago = 0; ago <= since; ago++) {
        const real *u = c->estimator.commands + 2 * (newest - ago);
        const real forward = (G[3] * u[0] - G[2] * u[1]) / determinant;
        const real turning = c->constants->half_track * (G[0] * u[1] - G[1] * u[0]) / determinant;
        /* Wheels turn as the model says: the body slips, not they. */
        const real rim[2] = {sign[0] * (forward + turning), sign[1] * (forward - turning)};
        for (int i = 0; i < 2; i++) {
            least[i] = ago == 0 ? rim[i] : ddmpc_min(least[i], rim[i]);
            most[i] = ago == 0 ? rim[i] : ddmpc_max(most[i], rim[i]);
        }
    }
    return 1;
}

/* The wheel that falls the furthest short of what its reference and the commands ask (`asked`, in its direction); -1: none.
   One that hardly turns is held, or dead; one that is just being stopped passes by all speeds. */
static int short_wheel(const ddmpc_controller *c, const real by_reference[2], const real read[2], real *asked)
{
    const ddmpc_constants *k = c->constants;
    const real sign[2] = {by_reference[0] < R(0.0) ? R(-1.0) : R(1.0), by_reference[1] < R(0.0) ? R(-1.0) : R(1.0)};
    real least[2], most[2], worst = R(0.0);
    int found = -1;
    if (!asked_for(c, sign, least, most))
        return -1;
    for (int i = 0; i < 2; i++) {
        const real along = sign[i] * c->rim[i], wanted = ddmpc_min(sign[i] * by_reference[i], least[i]);
        const real lacks = wanted - along;
        /* Wheels that turn faster than asked follow somebody else's commands. */
        if (along > most[i] + k->short_by[0])
            return -1;
        if (along > k->stuck * wanted && lacks > k->short_by[1] * wanted && lacks > k->short_by[0] && lacks > worst &&
            ddmpc_fabs(read[i] - c->rim[i]) < k->steady * wanted) {
            worst = lacks;
            found = i;
            *asked = least[i];
        }
    }
    return found;
}

/* A robot that turns on the spot moves by what it turns about and by its slide, whatever the controller does: so far it is
   no reason to leave the path or to wait, nor for the time that it takes to come back. */
static void carry(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    const real *slip = c->result.estimate.mean + STATES(c), *twist = c->reference_twist;
    const real turned_about = ddmpc_hypot(slip[TURN_AHEAD], slip[TURN_LEFT]), slide = ddmpc_hypot(slip[SLIDE_X], slip[SLIDE_Y]);
    c->carried *= R(1.0) - ddmpc_min((real)k->sample_time / k->carried[1], R(1.0));
    if (ddmpc_fabs(twist[0]) <= k->standing && ddmpc_fabs(twist[1]) > k->turning)
        c->carried = ddmpc_max(c->carried, k->carried[0] * (turned_about + slide));
}

/* Whether more command has given the wheel `found` no more speed: a wheel that only answers with another gain does gain. */
static int gains_nothing(ddmpc_controller *c, int found, real asked)
{
    const ddmpc_constants *k = c->constants;
    const real speed = ddmpc_fabs(c->rim[found]), more = asked - c->tried, gained = speed - c->tried_speed;
    if (found != c->short_one || more < R(0.0) || (more > k->trial[0] * asked && gained > k->trial[1] * more)) {
        c->short_one = found;
        c->tried = asked;
        c->tried_speed = speed;
        return 0;
    }
    return more > k->trial[0] * asked;
}

/* Wheels at the end of their speed, or of their force, hold the reference up. What they reach is learned from their encoders
 * (on slippery floors the estimate trusts the gyro more), and slowly forgotten. */
static void watch_wheels(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    const real dt = (real)k->sample_time, *wanted = c->reference_twist + 2;
    const real *wheels = c->estimator.last_wheels, turning = k->half_track * wheels[1] / k->wheel_yaw_ratio;
    const real read[2] = {wheels[0] + turning, wheels[0] - turning};
    real by_reference[2], asked = R(0.0);
    int found = -1;
    for (int i = 0; i < 2; i++)
        c->rim[i] += k->smoothed * (read[i] - c->rim[i]);
    /* Wheels that answer with another gain fall short of the model, too, but the robot keeps up with its reference. */
    const ddmpc_stray stray = ddmpc_stray_from(c, c->reference_pose + 3, wanted);
    const int behind = stray.late > k->astray[0] || ddmpc_fabs(stray.across) > k->astray[1] * k->band || stray.outside;
    if (behind && c->plan_age == 0 && c->last_tick - c->estimator.wheels_stamp < (ddmpc_time)k->short_for) {
        rims(c, wanted, by_reference);
        found = short_wheel(c, by_reference, read, &asked);
    }
    if (found >= 0 && gains_nothing(c, found, asked)) {
        c->rim_reach = ddmpc_fabs(c->rim[found]);
        c->reach = ddmpc_fabs(c->rim[found] / by_reference[found]) *
                   (ddmpc_fabs(wanted[0]) + k->half_track * ddmpc_fabs(wanted[1]));
    } else {
        c->rim_reach *= R(1.0) + k->regain * dt;
        c->reach *= R(1.0) + k->regain * dt;
    }
    /* Wheels that turn faster after all, or are not believed, say nothing of their end. */
    const int faster = ddmpc_fabs(c->rim[c->short_one]) > c->rim_reach * (R(1.0) + k->short_by[1]) + k->short_by[0];
    if (faster || !(c->rim_reach < k->soft_upper[2]) || c->result.reasons & DDMPC_WHEELS_ACCUSED)
        c->reach = c->rim_reach = (real)HUGE_VAL;
    c->result.reach = c->reach;
}

/* Follow the reference where the robot is on its path and on time; otherwise somebody has to say what to do. */
static int follow(ddmpc_controller *c, const ddmpc_input *input)
{
    if (!input->on_time)
        return DDMPC_NEEDS_TARGET;
    sample_reference(c, input->reference_time);
    if (!c->constants->reentry) {
        const real distance = distance_to(c, c->reference_pose);
        if (distance <= c->constants->max_position_error) /* false for NaN, too */
            return track(c);
        c->result.distance = distance;
        return brake(c, DDMPC_TOO_FAR, 1);
    }
    const ddmpc_stray stray = ddmpc_stray_from(c, c->reference_pose, c->reference_twist);
    /* Before its start the reference rests, and the robot with it. */
    return stray.outside || !(stray.late <= R(1.0)) || isfinite(c->reach) ? DDMPC_NEEDS_TARGET : track(c);
}

/* `reason`, and whether poses come but are too old. */
static unsigned int missing(const ddmpc_controller *c, unsigned int reason)
{
    return c->estimator.too_old > 0.0 ? reason | DDMPC_POSES_TOO_OLD : reason;
}

/* Say whether poses come too seldom or too late for max_pose_age. */
static void report_rate(ddmpc_controller *c)
{
    const ddmpc_estimator *estimator = &c->estimator;
    c->result.pose_interval = (real)estimator->pose_interval;
    c->result.pose_latency = (real)(estimator->too_old > 0.0 ? estimator->too_old : estimator->pose_latency);
    if (estimator->rare)
        c->result.reasons |= DDMPC_POSES_RARE;
}

/* Whether wheels and gyro stand in for poses that stay away: for a while, as long as the position is known to the band. */
static int is_bridged(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    const ddmpc_time wheels = c->monitor.wheels.heard, gyro = c->monitor.gyro.heard, heard = wheels < gyro ? wheels : gyro;
    const real *deviation = c->result.estimate.deviation + STATES(c) + POSE(c);
    const real variance = deviation[0] * deviation[0] + deviation[1] * deviation[1];
    const real age = *c->result.estimate.pose_age;
    if (age <= k->max_pose_age) {
        c->known = variance;
        c->doubt = R(0.0);
    } else {
        c->doubt = k->unsure * ddmpc_sqrt(ddmpc_max(variance - c->known, R(0.0))) / k->band;
    }
    if (!(k->dead_reckoning > R(0.0)) || c->last_tick - heard > (ddmpc_time)k->silence)
        return 0;
    if (c->monitor.accused || ddmpc_monitor_doubts(c, c->last_tick))
        return 0;
    return age <= k->dead_reckoning && c->doubt <= R(1.0);
}

/* Whether the last accepted pose is too old, or will be before the next: to drive from one to the other is to lurch. */
static int has_old_pose(ddmpc_controller *c)
{
    const ddmpc_estimator *estimator = &c->estimator;
    const int rare = estimator->rare;
    if (is_bridged(c)) {
        c->result.reasons &= ~(unsigned int)DDMPC_POSES_RARE;
        return 0;
    }
    /* Where poses are rare that is said, and their age only when none comes at all. */
    const ddmpc_time usual = rare ? estimator->pose_interval + estimator->pose_latency : 0.0;
    if (*c->result.estimate.pose_age > c->constants->max_pose_age + (real)usual)
        c->result.reasons |= missing(c, DDMPC_OLD_POSE);
    return rare || c->result.reasons & DDMPC_OLD_POSE;
}

static int new_tick(ddmpc_controller *c, ddmpc_time t, const ddmpc_input *input)
{
    ddmpc_result *result = &c->result;
    if (input->has_sent) {
        if (!ddmpc_estimator_correct_sent(c, input->sent))
            result->reasons |= DDMPC_SENT_REJECTED;
    }
    ddmpc_estimator_advance(c, t);
    const int state = ddmpc_estimator_update(c, t, input);
    ddmpc_monitor_report(c);
    report_rate(c);
    if (input->request != DDMPC_DRIVE)
        return brake(c, DDMPC_HELD, input->request == DDMPC_STOP_AS_FAILURE);
    if (!(state & READY))
        return brake(c, missing(c, DDMPC_NO_POSE), 1);
    if ((state & MOVED) && !restart_elsewhere(c))
        return brake(c, DDMPC_ELSEWHERE, 1);
    take_estimate(c);
    const real *pose = pose_of(c);
    if (!(isfinite(pose[0]) && isfinite(pose[1]) && isfinite(pose[2]))) {
        ddmpc_estimator_forget(c);
        result->has_estimate = 0;
        return brake(c, DDMPC_LOST, 1);
    }
    if (result->reasons & DDMPC_POSE_ACCUSED)
        return brake(c, 0, 1);
    if (has_old_pose(c))
        return brake(c, 0, 1);
    if (!ddmpc_fence_holds(c))
        return brake(c, DDMPC_LEFT_FENCE, 1);
    if (c->latched)
        return brake(c, DDMPC_LATCHED, 1);
    carry(c);
    watch_wheels(c);
    if (is_finished(c, input->reference_time)) {
        ramp(c);
        result->mode = DDMPC_FINISHED;
        return DDMPC_DONE;
    }
    return follow(c, input);
}

/* Brake: this tick tells nothing. Where the clock leapt, stand: a base without commands has stopped itself. */
static void lose_time(ddmpc_controller *c, tick_kind kind)
{
    const unsigned int reason = kind == TICK_FAULTY  ? DDMPC_TIME_FAULTY
                                : kind == TICK_LEAPT ? DDMPC_TIME_LEAPT
                                                     : DDMPC_TIME_PAUSED;
    brake(c, reason, 1);
    if (kind == TICK_PAUSED)
        ddmpc_estimator_clear(c);
    if (kind != TICK_FAULTY)
        stand(c);
}

static void clear(ddmpc_result *result)
{
    const ddmpc_report not_run = {DDMPC_QP_NOT_RUN, DDMPC_NO_WAY, 0, 0, (real)NAN, (real)NAN};
    result->solver = not_run;
    result->solve_time = (ddmpc_time)NAN;
    result->reasons = 0;
    result->notes = result->repeating = 0;
    result->has_estimate = result->has_plan = 0;
}

/* Enter the command of a tick that is done. */
static int finish_tick(ddmpc_controller *c, int pending, int is_new)
{
    c->pending = pending;
    if (pending != DDMPC_DONE)
        return pending;
    if (is_new)
        ddmpc_estimator_append(c, c->result.command);
    else
        /* No interval of the model begins here: the command in force since the last tick has changed. */
        ddmpc_estimator_correct_last(c, c->result.command);
    memcpy(c->last, c->result.command, sizeof c->last);
    c->has_driven = c->has_driven || c->result.mode == DDMPC_TRACKING;
    c->has_result = 1;
    return DDMPC_DONE;
}

int ddmpc_step(ddmpc_controller *c, ddmpc_time t, const ddmpc_input *input)
{
    if (!c->has_reference) {
        clear(&c->result);
        stand(c);
        c->result.reasons = DDMPC_NO_REFERENCE;
        return DDMPC_DONE;
    }
    /* A tick that nobody went on with has no plan. */
    ddmpc_give_up(c);
    const tick_kind kind = judge(c, t);
    if (kind == TICK_REPEATED && c->has_result) {
        c->result.notes = 0;
        ddmpc_estimator_update(c, t, input);
        c->result.reasons = DDMPC_TIME_REPEATED;
        /* What was sent, if somebody else has decided that meanwhile: to repeat another would be a leap. */
        if (c->result.mode != DDMPC_STOPPED)
            memcpy(c->result.command, c->last, sizeof c->last);
        return DDMPC_DONE;
    }
    clear(&c->result);
    c->share = R(1.0);
    if (kind == TICK_NEW) {
        const int pending = new_tick(c, t, input);
        if (!c->result.has_estimate)
            take_estimate(c);
        return finish_tick(c, pending, 1);
    }
    lose_time(c, kind);
    take_estimate(c);
    return finish_tick(c, DDMPC_DONE, 0);
}

int ddmpc_track(ddmpc_controller *c, const real *poses, const real *twists, real share)
{
    if (c->pending != DDMPC_NEEDS_TARGET)
        return c->pending;
    memcpy(c->reference_pose, poses, (size_t)(3 * SAMPLES(c)) * sizeof(real));
    memcpy(c->reference_twist, twists, (size_t)(2 * SAMPLES(c)) * sizeof(real));
    c->share = share;
    return finish_tick(c, track(c), 1);
}

int ddmpc_too_far(ddmpc_controller *c, real distance)
{
    if (c->pending != DDMPC_NEEDS_TARGET)
        return c->pending;
    c->result.distance = distance;
    return finish_tick(c, brake(c, DDMPC_TOO_FAR, 1), 1);
}

int ddmpc_answer(ddmpc_controller *c, const real *plan, const real *multipliers, const ddmpc_report *report)
{
    if (c->pending != DDMPC_NEEDS_BACKEND)
        return c->pending;
    memcpy(c->problem.plan, plan, (size_t)INPUTS(c) * sizeof(real));
    memcpy(c->problem.multipliers, multipliers, (size_t)(KINDS(c) * STEPS(c)) * sizeof(real));
    c->result.solver = *report;
    return finish_tick(c, use(c), 1);
}

int ddmpc_give_up(ddmpc_controller *c) { return c->pending == DDMPC_DONE ? DDMPC_DONE : finish_tick(c, reuse(c), 1); }

int ddmpc_overrule(ddmpc_controller *c, const real *commands, int count)
{
    for (int i = 0; i < 2 * count; i++)
        if (!isfinite(commands[i]))
            return 0;
    if (count < 1)
        return 1;
    ddmpc_estimator_overrule(c, commands, count);
    memcpy(c->last, commands + 2 * (count - 1), sizeof c->last);
    return 1;
}

int ddmpc_samples(const ddmpc_controller *c)
{
    (void)c;
    return SAMPLES(c);
}

const ddmpc_result *ddmpc_result_of(const ddmpc_controller *c) { return &c->result; }

real *ddmpc_parameters(ddmpc_controller *c) { return c->parameters; }

const real *ddmpc_last_command(const ddmpc_controller *c) { return c->last; }

const real *ddmpc_commands(const ddmpc_controller *c)
{
    return c->estimator.commands + 2 * (COMMANDS(c) - WINDOW(c));
}
