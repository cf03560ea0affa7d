/* A tick from measurement to command: clock of the ticks, conditions for driving, and order of the parts. ladder.c
 * selects the command after a failure. The duration of a tick is bounded: each part runs once, and its loops are
 * bounded.
 *
 * Order of a new tick (new_tick): correct the stored commands, predict, measure, check the conditions for driving,
 * sample the reference, then set up and solve the optimisation problem (track). docs/how-it-works.md has the formulas
 * in this order. Two steps may need the caller: a target for a robot that is off its path or late, and a backend
 * solver. The tick then returns, and a later call of this file continues it. */
/* for clock_gettime, which C99 alone does not declare */
#define _POSIX_C_SOURCE 199309L
#include <string.h>

#include "clock.h"
#include "internal.h"

/* Reset the state of a drive. Commands in the estimator are kept, since the robot may still be executing them. */
static void reset_drive(ddmpc_controller *c)
{
    ddmpc_estimator_forget(c);
    ddmpc_fence_clear(c);
    ddmpc_solver_reset(c);
    c->has_last_tick = c->has_leap = 0;
    c->plan_age = -1;
    c->has_result = c->has_driven = c->latched = c->finished = c->is_outage = c->missed = 0;
    c->rim[0] = c->rim[1] = c->carried = c->doubt = c->known = c->slowed = R(0.0);
    c->reference_twist[0] = c->reference_twist[1] = R(0.0);
    c->saturated_wheel = c->on_spot = 0;
    c->trial_demand = (real)HUGE_VAL;
    c->reach = c->rim_reach = (real)HUGE_VAL;
    /* A tick that waits for its caller belongs to the previous drive: ddmpc_track and ddmpc_answer must not
     * complete it. */
    c->pending = DDMPC_DONE;
}

void ddmpc_reset(ddmpc_controller *c)
{
    ddmpc_estimator_clear(c);
    reset_drive(c);
    c->last[0] = c->last[1] = R(0.0);
}

void ddmpc_forget(ddmpc_controller *c) { reset_drive(c); }

void ddmpc_configure(ddmpc_controller *c, const ddmpc_constants *constants)
{
    c->constants = constants;
    /* The delayed response was computed with the former constants; zero delays make update_delayed_response repeat it. */
    c->problem.late[0] = c->problem.late[1] = R(0.0);
    c->problem.is_stale = 1;
}

int ddmpc_start(ddmpc_controller *c, const ddmpc_reference *reference, ddmpc_time t0)
{
    if (!isfinite(t0) || !isfinite(reference->duration))
        return 0;
    reset_drive(c);
    c->reference = *reference;
    c->t0 = t0;
    c->has_reference = 1;
    /* The fence may be relative to the start of the reference, which is therefore stored first. */
    ddmpc_fence_place(c);
    return 1;
}

int ddmpc_switch_reference(ddmpc_controller *c, const ddmpc_reference *reference, ddmpc_time t0)
{
    if (!c->has_reference || !isfinite(t0) || !isfinite(reference->duration))
        return 0;
    /* A different reference is not finished. A moved copy of a finished reference stays finished; otherwise a drifting
     * frame would start the robot again. */
    c->finished = c->finished && t0 == c->t0;
    c->reference = *reference;
    c->t0 = t0;
    return 1;
}

void ddmpc_resume(ddmpc_controller *c)
{
    c->latched = 0;
    c->sound_tick = c->last_tick;
}

int ddmpc_is_latched(const ddmpc_controller *c) { return c->latched; }

typedef enum { TICK_NEW, TICK_REPEATED, TICK_LEAPT, TICK_PAUSED, TICK_FAULTY } tick_kind;

/* Classify a call at `t` relative to the last tick. A call within half a sample repeats the last tick: the model is
 * discrete, so a second prediction step in one period would be ahead of the robot. */
static tick_kind tick_kind_at(const ddmpc_controller *c, ddmpc_time t)
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
    /* A single leap may be a glitch of the clock. A second tick at the new time confirms that the time has passed. */
    return c->has_leap && since_leap > 0.0 && since_leap <= k->longest_pause ? TICK_PAUSED : TICK_LEAPT;
}

int ddmpc_is_new_tick(const ddmpc_controller *c, ddmpc_time t) { return tick_kind_at(c, t) == TICK_NEW; }

static tick_kind classify_tick(ddmpc_controller *c, ddmpc_time t)
{
    const tick_kind kind = tick_kind_at(c, t);
    /* After a leap, `last_tick` is kept, so that a glitch at a single tick has no effect. */
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

static void update_result_estimate(ddmpc_controller *c)
{
    c->result.has_estimate = ddmpc_estimator_state(c) & READY;
    if (c->result.has_estimate)
        ddmpc_estimator_estimate(c);
}

static const real *pose_of(const ddmpc_controller *c) { return c->result.estimate.mean + STATES(c) + POSE(c); }

static real distance_to(const ddmpc_controller *c, const real pose[3])
{
    const real *robot = pose_of(c);
    return ddmpc_hypot(robot[0] - pose[0], robot[1] - pose[1]);
}

/* Restart the estimate at the pose on which the rejected poses agree, if all pending commands are zero: the robot is
 * then at rest, and a belief with zero velocity is valid. Returns the distance between both estimates [m]; negative if
 * a restart is not possible. */
static real restart_elsewhere(ddmpc_controller *c)
{
    /* The oldest commands act only if there are unknown delays, so they are ignored. */
    const real *commands = ddmpc_commands(c);
    for (int i = SPARE(c) ? 2 * (SPARE(c) + 1) : 0; i < 2 * WINDOW(c); i++)
        if (commands[i] != R(0.0))
            return R(-1.0);
    update_result_estimate(c);
    const real before[3] = {pose_of(c)[0], pose_of(c)[1], pose_of(c)[2]};
    if (!c->constants->resume || !ddmpc_estimator_restart_elsewhere(c))
        return R(-1.0);
    update_result_estimate(c);
    return distance_to(c, before);
}

/* Return 1 if the robot is at rest at the end of its reference, or finish_timeout has passed. The result stays 1, so
 * that noise of the estimated speed does not start the robot again. */
static int is_finished(ddmpc_controller *c, ddmpc_time time)
{
    const ddmpc_constants *k = c->constants;
    const real *moving = c->result.estimate.twist;
    const ddmpc_time duration = c->reference.duration;
    real pose[3], twist[2], arc_length;
    /* Negated so that a NaN time does not finish the drive. */
    if (c->finished || !(time >= duration))
        return c->finished;
    c->reference.sample(c->reference.context, duration, pose, twist, &arc_length);
    const real distance = distance_to(c, pose);
    const int is_settled = distance <= k->finish_position && ddmpc_fabs(moving[0]) <= k->finish_speed &&
                           ddmpc_fabs(moving[1]) <= k->finish_speed;
    const int is_overdue = time >= duration + (ddmpc_time)k->finish_timeout;
    if (is_overdue && !is_settled) {
        c->result.reasons |= DDMPC_NOT_AT_REST;
        c->result.distance = distance;
    }
    c->finished = is_settled || is_overdue;
    return c->finished;
}

ddmpc_stray ddmpc_stray_from(const ddmpc_controller *c, const real *pose, const real *twist)
{
    const ddmpc_constants *k = c->constants;
    /* The deviation refers to the path, so the target heading is that of the path, without a correction for side-slip. */
    const real path_reference[4] = {pose[0], pose[1], pose[2], pose[2]};
    real error[3];
    const real *arguments[5] = {pose_of(c), 0, 0, path_reference, 0};
    real *results[2] = {error, 0};
    ddmpc_stray stray;
    ddmpc_f_errors(arguments, results, 0, 0, 0);
    stray.along = error[0];
    stray.across = error[1];
    stray.heading = ddmpc_wrap(error[2]);
    /* Deviations are in the frame of the reference; a robot that drives backwards is late if it is ahead in that
     * frame. */
    const real v = twist[0], omega = twist[1];
    const int backwards = v<R(0.0), driving = ddmpc_fabs(v)> k->standing;
    const real ahead = backwards ? -stray.along : stray.along;
    /* A robot with an uncertain pose stays on its path: the uncertainty widens the band. */
    const real *deviation = c->result.estimate.deviation + STATES(c) + POSE(c);
    const real band = c->carried + ddmpc_max(k->band, k->unsure * ddmpc_hypot(deviation[0], deviation[1]));
    stray.outside = ddmpc_fabs(stray.across) > band || ddmpc_fabs(stray.heading) > k->heading_band ||
                    !(-k->behind <= ahead && ahead <= k->ahead);
    if (driving) {
        stray.late = -ahead / k->wait;
    } else {
        /* A reference at standstill or in a turn on the spot has no direction along which a delay could be measured, so
         * it waits until the robot has arrived. */
        const real turning = !(ddmpc_fabs(omega) > k->turning) ? R(0.0)
                             : omega < R(0.0)                  ? stray.heading
                                                               : -stray.heading;
        const real away = ddmpc_max(ddmpc_hypot(stray.along, stray.across) - c->carried, R(0.0));
        stray.late = ddmpc_max(away / k->wait, turning / k->heading_wait);
    }
    /* The reference slows down as the uncertainty of the position grows. */
    const real excess = (c->doubt - k->doubtful_band) / (R(1.0) - k->doubtful_band);
    stray.late = ddmpc_max(stray.late, R(1.0) + excess);
    return stray;
}

static void sample_reference(ddmpc_controller *c, ddmpc_time time)
{
    const real *delays = c->result.estimate.mean + STATES(c) + DELAYS(c);
    const real max_delay = ddmpc_max(delays[0], delays[1]) / (real)c->constants->sample_time;
    /* The feed-forward interpolates at the sum of the lag and the estimated delay ahead, which limits the number of
     * samples. */
    const int count = STEPS(c) + 3 + LONGEST_LAG(c) + (int)max_delay;
    real arc_length;
    for (int i = 0; i < SAMPLES(c) && i < count; i++)
        c->reference.sample(c->reference.context, time + i * c->constants->sample_time, c->reference_pose + 3 * i,
                            c->reference_twist + 2 * i, &arc_length);
}

/* Set up and solve the problem for the reference samples, then use the plan. Each step depends on the previous steps:
 * the free motion and the targets (begin), a plan along which to linearise (guess), Jacobians along this plan
 * (linearise), the cost as a function of the commands (condense), and the limits in the same variables (limit). The
 * guess is the shifted last plan. At the start and after a failure it is the feed-forward, since a linearisation far
 * from the solution would require more than one iteration. */
static int track(ddmpc_controller *c)
{
    const ddmpc_time start = ddmpc_now();
    ddmpc_problem_begin(c);
    if (!c->problem.has_guess)
        ddmpc_problem_guess(c);
    ddmpc_problem_linearise(c);
    ddmpc_problem_condense(c);
    ddmpc_problem_limit(c);
    const int pending = ddmpc_solve(c);
    c->result.solve_time = ddmpc_now() - start;
    return pending == DDMPC_NEEDS_BACKEND ? pending : ddmpc_use_plan(c);
}

/* Tolerate the displacement in a turn on the spot. A turning robot moves due to the offset of its turning point and due
 * to its slide. The controller cannot prevent this displacement, which must not cause a return to the path or a wait. */
static void tolerate_turn_displacement(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    /* Use the slip of the filter, since the estimate of the controller ignores slip until there is enough evidence. */
    const real *slip = ddmpc_estimator_slip(c), *twist = c->reference_twist;
    const real offset = ddmpc_hypot(slip[TURN_AHEAD], slip[TURN_LEFT]),
               slide = ddmpc_hypot(slip[SLIDE_X], slip[SLIDE_Y]);
    /* The tolerance decays while the robot returns to its path. */
    c->carried *= R(1.0) - ddmpc_min((real)k->sample_time / k->carried[1], R(1.0));
    if (ddmpc_fabs(twist[0]) <= k->standing && ddmpc_fabs(twist[1]) > k->turning)
        c->carried = ddmpc_max(c->carried, k->carried[0] * (offset + slide));
}

/* Follow the reference if the robot is on its path and on time; otherwise request a target from the caller. */
static int track_reference(ddmpc_controller *c, const ddmpc_input *input)
{
    if (!input->on_time)
        return DDMPC_NEEDS_TARGET;
    sample_reference(c, input->reference_time);
    if (!c->constants->reentry) {
        const real distance = distance_to(c, c->reference_pose);
        if (distance <= c->constants->max_position_error) /* also false for NaN */
            return track(c);
        c->result.distance = distance;
        return ddmpc_brake(c, DDMPC_TOO_FAR, DDMPC_OUTAGE);
    }
    const ddmpc_stray stray = ddmpc_stray_from(c, c->reference_pose, c->reference_twist);
    /* A limit on the rim speed (reach) also needs a target, because it slows the clock of the reference. */
    return stray.outside || !(stray.late <= R(1.0)) || isfinite(c->reach) ? DDMPC_NEEDS_TARGET : track(c);
}

/* Return `reason`, combined with DDMPC_POSES_TOO_OLD if poses arrive but are too old. */
static unsigned int with_too_old(const ddmpc_controller *c, unsigned int reason)
{
    return c->estimator.too_old > 0.0 ? reason | DDMPC_POSES_TOO_OLD : reason;
}

/* Report poses that are too rare or too late for max_pose_age. */
static void report_rate(ddmpc_controller *c)
{
    const ddmpc_estimator *estimator = &c->estimator;
    c->result.pose_interval = (real)estimator->pose_interval;
    c->result.pose_latency = (real)(estimator->too_old > 0.0 ? estimator->too_old : estimator->pose_latency);
    if (estimator->rare)
        c->result.reasons |= DDMPC_POSES_RARE;
}

/* Return 1 if wheels and gyro can replace missing poses: for a limited time, and while the uncertainty of the position
 * is within the band. */
static int is_dead_reckoning_valid(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    const ddmpc_time wheels = c->monitor.wheels.arrival, gyro = c->monitor.gyro.arrival,
                     oldest = wheels < gyro ? wheels : gyro;
    const real *deviation = c->result.estimate.deviation + STATES(c) + POSE(c);
    const real variance = deviation[0] * deviation[0] + deviation[1] * deviation[1];
    const real age = *c->result.estimate.pose_age;
    /* Only the additional uncertainty without poses counts, since the uncertainty with poses is normal. */
    if (age <= k->max_pose_age) {
        c->known = variance;
        c->doubt = R(0.0);
    } else {
        c->doubt = k->unsure * ddmpc_sqrt(ddmpc_max(variance - c->known, R(0.0))) / k->band;
    }
    if (!(k->dead_reckoning > R(0.0)) || c->last_tick - oldest > (ddmpc_time)k->silence)
        return 0;
    if (c->monitor.excluded || ddmpc_monitor_doubtful_sensors(c, c->last_tick))
        return 0;
    return age <= k->dead_reckoning && c->doubt <= R(1.0);
}

/* Return 1 if the last accepted pose is too old, or if poses are so rare that it will be too old before the next pose.
 * In the second case the robot would otherwise stop and start repeatedly. */
static int is_pose_too_old(ddmpc_controller *c)
{
    const ddmpc_estimator *estimator = &c->estimator;
    const int rare = estimator->rare;
    if (is_dead_reckoning_valid(c)) {
        c->result.reasons &= ~(unsigned int)DDMPC_POSES_RARE;
        return 0;
    }
    /* If poses are rare, this is reported instead of their age, unless no more poses arrive. */
    const ddmpc_time usual_age = rare ? estimator->pose_interval + estimator->pose_latency : 0.0;
    if (*c->result.estimate.pose_age > c->constants->max_pose_age + (real)usual_age)
        c->result.reasons |= with_too_old(c, DDMPC_OLD_POSE);
    return rare || c->result.reasons & DDMPC_OLD_POSE;
}

static ddmpc_stop stop_for_request(int request)
{
    return request == DDMPC_PAUSE ? DDMPC_NO_FAILURE : request == DDMPC_STOP_AND_WAIT ? DDMPC_WAITS : DDMPC_OUTAGE;
}

static int new_tick(ddmpc_controller *c, ddmpc_time t, const ddmpc_input *input)
{
    ddmpc_result *result = &c->result;
    /* Correct the last command first, since the prediction over the last sample must use the command of the base. */
    if (input->has_sent) {
        if (!ddmpc_estimator_correct_sent(c, input->sent))
            result->reasons |= DDMPC_SENT_REJECTED;
    }
    /* Predict even without measurements and during stops, since delayed measurements are inserted into this history. */
    ddmpc_estimator_advance(c, t);
    const int state = ddmpc_estimator_update(c, t, input);
    ddmpc_monitor_report(c);
    report_rate(c);
    /* Conditions for driving. The first unmet condition stops the robot and is the reported reason: requests precede
     * faults, and missing data precede faults that are derived from data. */
    if (input->request != DDMPC_DRIVE)
        return ddmpc_brake(c, DDMPC_HELD, stop_for_request(input->request));
    if (!(state & READY))
        return ddmpc_brake(c, with_too_old(c, DDMPC_NO_POSE), DDMPC_OUTAGE);
    if (state & MOVED) {
        const real jump = restart_elsewhere(c);
        if (jump < R(0.0))
            return ddmpc_brake(c, DDMPC_ELSEWHERE, DDMPC_FAILURE);
        /* The robot was displaced during a drive, so it must not start by itself at the new position. */
        if (c->has_driven && !(jump <= c->constants->max_position_error))
            return ddmpc_brake(c, DDMPC_ELSEWHERE, DDMPC_WAITS);
    }
    update_result_estimate(c);
    const real *pose = pose_of(c);
    if (!(isfinite(pose[0]) && isfinite(pose[1]) && isfinite(pose[2]))) {
        ddmpc_estimator_forget(c);
        result->has_estimate = 0;
        return ddmpc_brake(c, DDMPC_LOST, DDMPC_FAILURE);
    }
    /* Without poses, the position is not corrected. Wheels or a gyro that are excluded only reduce the accuracy. */
    if (result->reasons & DDMPC_POSE_EXCLUDED)
        return ddmpc_brake(c, 0, DDMPC_FAILURE);
    if (is_pose_too_old(c))
        return ddmpc_brake(c, 0, result->reasons & DDMPC_OLD_POSE ? DDMPC_OUTAGE : DDMPC_FAILURE);
    if (!ddmpc_fence_is_respected(c))
        return ddmpc_brake(c, DDMPC_LEFT_FENCE, DDMPC_FAILURE);
    if (c->latched)
        return ddmpc_brake(c, DDMPC_LATCHED, DDMPC_FAILURE);
    /* These steps come after the checks, since they learn from the motion of a robot that tracks its reference. */
    tolerate_turn_displacement(c);
    ddmpc_watch_wheels(c);
    if (is_finished(c, input->reference_time)) {
        ddmpc_ramp(c);
        result->mode = DDMPC_FINISHED;
        return DDMPC_DONE;
    }
    return track_reference(c, input);
}

/* Brake because the time of this tick is invalid. After a leap or a pause of the clock, the command is zero immediately:
 * the command timeout of the base has stopped the robot, and a ramp from the last command would start it again. */
static void brake_after_time_fault(ddmpc_controller *c, tick_kind kind)
{
    const unsigned int reason = kind == TICK_FAULTY  ? DDMPC_TIME_FAULTY
                                : kind == TICK_LEAPT ? DDMPC_TIME_LEAPT
                                                     : DDMPC_TIME_PAUSED;
    /* A single leap forward may be a glitch of the clock, so it does not latch. */
    const ddmpc_time gap = c->result.gap, limit = c->constants->resume_within;
    const int leapt = (kind == TICK_PAUSED && gap > limit) || gap < -limit;
    ddmpc_brake(c, reason, leapt ? DDMPC_WAITS : DDMPC_FAILURE);
    if (kind == TICK_PAUSED)
        ddmpc_estimator_clear(c);
    if (kind != TICK_FAULTY)
        ddmpc_stand(c);
}

/* Clear the parts of a result that are not written at every tick. */
static void clear(ddmpc_result *result)
{
    const ddmpc_report not_run = {DDMPC_QP_NOT_RUN, DDMPC_NO_METHOD, 0, 0, 0, (real)NAN, (real)NAN, 0};
    result->solver = not_run;
    result->solve_time = (ddmpc_time)NAN;
    result->reasons = 0;
    result->notes = result->repeating = result->implausible = 0;
    result->has_estimate = result->has_plan = 0;
}

/* Finish a tick: store its command for the next prediction and for the slew limit. */
static int finish_tick(ddmpc_controller *c, int pending, int is_new)
{
    c->pending = pending;
    if (pending != DDMPC_DONE)
        return pending;
    if (!c->is_outage)
        c->sound_tick = c->last_tick;
    c->is_outage = 0;
    if (is_new)
        ddmpc_estimator_append(c, c->result.command);
    else
        /* No new sample of the model has started, so replace the command of the last tick. */
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
        ddmpc_stand(c);
        c->result.reasons = DDMPC_NO_REFERENCE;
        return DDMPC_DONE;
    }
    /* A previous tick that the caller did not complete counts as a failed solve, and its command is stored. */
    ddmpc_give_up(c);
    const tick_kind kind = classify_tick(c, t);
    if (kind == TICK_REPEATED && c->has_result) {
        /* The call may have new measurements, which are inserted into existing nodes of the history without a step. */
        c->result.notes = 0;
        ddmpc_estimator_update(c, t, input);
        c->result.reasons = DDMPC_TIME_REPEATED;
        /* Repeat the last command, which the application may have replaced, since any other command would jump. While
         * STOPPED, the command is zero, and the slew limit then starts from zero. */
        if (c->result.mode != DDMPC_STOPPED)
            memcpy(c->result.command, c->last, sizeof c->last);
        else
            finish_tick(c, DDMPC_DONE, 0);
        return DDMPC_DONE;
    }
    clear(&c->result);
    c->share = R(1.0);
    c->deadline = input->deadline > 0.0 ? input->deadline : (ddmpc_time)INFINITY;
    c->max_iterations = input->most_iterations > 0 ? input->most_iterations : c->constants->active_set;
    c->is_late = input->is_late;
    if (kind == TICK_NEW) {
        const int pending = new_tick(c, t, input);
        /* Some returns of new_tick precede its estimate, but the result must have an estimate while the robot brakes. */
        if (!c->result.has_estimate)
            update_result_estimate(c);
        return finish_tick(c, pending, 1);
    }
    brake_after_time_fault(c, kind);
    update_result_estimate(c);
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
    return finish_tick(c, ddmpc_brake(c, DDMPC_TOO_FAR, DDMPC_OUTAGE), 1);
}

int ddmpc_answer(ddmpc_controller *c, const real *plan, const real *multipliers, const ddmpc_report *report)
{
    if (c->pending != DDMPC_NEEDS_BACKEND)
        return c->pending;
    memcpy(c->problem.plan, plan, (size_t)INPUTS(c) * sizeof(real));
    memcpy(c->problem.multipliers, multipliers, (size_t)(KINDS(c) * STEPS(c)) * sizeof(real));
    const long long operations = c->result.solver.operations;
    c->result.solver = *report;
    c->result.solver.operations = operations; /* operations of the active set before the backend */
    return finish_tick(c, ddmpc_use_plan(c), 1);
}

int ddmpc_give_up(ddmpc_controller *c)
{
    return c->pending == DDMPC_DONE ? DDMPC_DONE : finish_tick(c, ddmpc_reuse(c), 1);
}

int ddmpc_set_applied_commands(ddmpc_controller *c, const real *commands, int count)
{
    for (int i = 0; i < 2 * count; i++)
        if (!isfinite(commands[i]))
            return 0;
    if (count < 1)
        return 1;
    ddmpc_estimator_replace_commands(c, commands, count);
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

const real *ddmpc_commands(const ddmpc_controller *c) { return c->estimator.commands + 2 * (COMMANDS(c) - WINDOW(c)); }
