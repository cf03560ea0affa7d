/* Estimation of pose, twist and slip from delayed measurements at several rates: an extended Kalman filter with a short
 * history, into which each measurement is inserted at its stamp. */
#include <string.h>

#include "internal.h"

static ddmpc_node *node_at(const ddmpc_controller *c, int index)
{
    return &c->estimator.node[(c->estimator.first + index) % HISTORY(c)];
}

static ddmpc_node *newest(const ddmpc_controller *c) { return node_at(c, c->estimator.nodes - 1); }

/* Return the command sent `ticks_ago`. */
static real *sent(const ddmpc_controller *c, int ticks_ago)
{
    return c->estimator.commands + 2 * (COMMANDS(c) - 1 - ticks_ago);
}

/* Append a node to the history; the oldest node of a full history is discarded. */
static ddmpc_node *append_node(ddmpc_controller *c, ddmpc_time time)
{
    ddmpc_estimator *estimator = &c->estimator;
    if (estimator->nodes == HISTORY(c))
        estimator->first = (estimator->first + 1) % HISTORY(c);
    else
        estimator->nodes++;
    ddmpc_node *node = newest(c);
    node->time = time;
    node->poses = node->twists = 0;
    return node;
}

void ddmpc_estimator_clear(ddmpc_controller *c)
{
    memset(c->estimator.commands, 0, (size_t)(2 * COMMANDS(c)) * sizeof(real));
    ddmpc_estimator_forget(c);
}

void ddmpc_estimator_forget(ddmpc_controller *c)
{
    ddmpc_estimator *estimator = &c->estimator;
    estimator->first = estimator->nodes = estimator->jumps = 0;
    estimator->accepted_stamp = estimator->pose_stamp = -HUGE_VAL;
    estimator->wheels_stamp = estimator->yaw_rate_stamp = -HUGE_VAL;
    estimator->too_old = 0.0;
    /* Before the first pose, a single overdue pose is sufficient for poses to count as rare. */
    estimator->overdue = 1;
    estimator->rare = 0;
    estimator->last_wheels[0] = estimator->last_wheels[1] = estimator->last_yaw_rate = R(0.0);
    for (int i = 0; i < DDMPC_SENSORS; i++)
        estimator->innovations[i] = (real)NAN;
    ddmpc_monitor_clear(c);
}

int ddmpc_estimator_state(const ddmpc_controller *c)
{
    return (c->estimator.nodes > 0 ? READY : 0) | (c->estimator.jumps >= AGREEING ? MOVED : 0);
}

const real *ddmpc_estimator_slip(const ddmpc_controller *c) { return newest(c)->posterior.mean + STATES(c); }

void ddmpc_estimator_append(ddmpc_controller *c, const real command[2])
{
    real *commands = c->estimator.commands;
    const real copy[2] = {command[0], command[1]}; /* `command` may point into `commands` */
    memmove(commands, commands + 2, (size_t)(2 * (COMMANDS(c) - 1)) * sizeof(real));
    ddmpc_estimator_correct_last(c, copy);
}

void ddmpc_estimator_correct_last(ddmpc_controller *c, const real command[2])
{
    memcpy(sent(c, 0), command, 2 * sizeof(real));
}

void ddmpc_estimator_replace_commands(ddmpc_controller *c, const real *commands, int count)
{
    const int stored = ddmpc_min_int(count, COMMANDS(c));
    memcpy(sent(c, stored - 1), commands + 2 * (count - stored), (size_t)(2 * stored) * sizeof(real));
}

int ddmpc_estimator_correct_sent(ddmpc_controller *c, const real received[2])
{
    const ddmpc_constants *k = c->constants;
    for (int i = 0; i < 2; i++)
        /* The negated comparison also rejects NaN. */
        if (!(ddmpc_fabs(received[i]) <=
              k->sent_rounding * ddmpc_max(k->largest_command[2 * i + (received[i] < R(0.0))], ddmpc_fabs(c->last[i]))))
            return 0;
    ddmpc_estimator_correct_last(c, received);
    return 1;
}

void ddmpc_estimator_advance(ddmpc_controller *c, ddmpc_time t)
{
    const ddmpc_time dt = c->constants->sample_time;
    if (c->estimator.nodes == 0)
        return;
    const double elapsed = rint((t - newest(c)->time) / dt);
    const int steps = elapsed > 1.0 ? (int)elapsed : 1;
    for (int missing = steps - 1; missing >= 0; missing--) {
        /* No command was computed for a missed sample, so the base has continued with the last command. */
        if (missing < steps - 1)
            ddmpc_estimator_append(c, sent(c, 0));
        const ddmpc_belief *before = &newest(c)->posterior;
        ddmpc_node *node = append_node(c, t - missing * dt);
        ddmpc_filter_predict(c, before, sent(c, 0), &node->prior);
        ddmpc_copy_belief(c, &node->posterior, &node->prior);
        ddmpc_monitor_predict(c, sent(c, 0));
    }
}

/* Return the index of the last node that is not after `time`; 0 if `time` is before the history. */
static int node_before(const ddmpc_controller *c, ddmpc_time time)
{
    for (int index = c->estimator.nodes - 1; index > 0; index--)
        if (node_at(c, index)->time <= time + 1e-9)
            return index;
    return 0;
}

/* Repeat the filter from the node `first` to the newest. */
static void filter_from(ddmpc_controller *c, int first)
{
    ddmpc_estimator *estimator = &c->estimator;
    for (int index = first; index < estimator->nodes; index++) {
        ddmpc_node *node = node_at(c, index);
        if (index > first)
            ddmpc_filter_predict(c, &node_at(c, index - 1)->posterior, sent(c, estimator->nodes - 1 - index),
                                 &node->prior);
        ddmpc_copy_belief(c, &node->posterior, &node->prior);
        for (int i = 0; i < node->twists; i++) {
            const ddmpc_checked_twist *twist = &node->twist[i];
            const real offset = (real)(twist->stamp - node->time);
            estimator->innovations[twist->sensor] = ddmpc_filter_correct_twist(c, &node->posterior, twist, offset);
        }
        for (int i = 0; i < node->poses; i++) {
            const real offset = (real)(node->pose[i].stamp - node->time);
            estimator->innovations[POSE_SENSOR] =
                ddmpc_filter_correct_pose(c, &node->posterior, &node->pose[i], offset);
        }
    }
}

/* Remove the measurements of faulty sensors (`excluded`, bits by subject) from the history. */
static void remove_measurements(ddmpc_controller *c, int excluded)
{
    for (int index = 0; index < c->estimator.nodes; index++) {
        ddmpc_node *node = node_at(c, index);
        int count = 0;
        for (int i = 0; i < node->twists; i++) {
            const int subject = node->twist[i].sensor == YAW_RATE ? DDMPC_OF_YAW_RATE : DDMPC_OF_WHEELS;
            if (!(excluded & 1 << subject))
                node->twist[count++] = node->twist[i];
        }
        node->twists = count;
        if (excluded & 1 << DDMPC_OF_POSE)
            node->poses = 0;
    }
}

/* Compute the belief without a pose of a robot that has responded to the commands as the model predicts. The standard
   deviation of the speed is equal to the speed, because the robot may be at rest; a speed of zero is certain. */
static void initial_belief(const ddmpc_controller *c, ddmpc_belief *belief)
{
    const ddmpc_constants *constants = c->constants;
    const int n = STATES(c), Z = BELIEF(c);
    real state[DDMPC_MAX_STATES], next[DDMPC_MAX_STATES], output[2];
    for (int i = 0; i < n; i++) {
        state[i] = R(0.0);
        for (int channel = 0; channel < 2; channel++)
            /* The command before the oldest command that acts in the first interval. */
            state[i] += constants->settled[2 * i + channel] * sent(c, HISTORY(c) + DELAY(c, channel) + 1)[channel];
    }
    for (int ticks_ago = HISTORY(c); ticks_ago >= 0; ticks_ago--) {
        ddmpc_velocity_step(c, state, sent(c, ticks_ago), 0, next, 0, 0);
        memcpy(state, next, (size_t)n * sizeof(real));
    }
    memset(belief->mean, 0, (size_t)Z * sizeof(real));
    memset(belief->covariance, 0, (size_t)(Z * Z) * sizeof(real));
    memset(belief->rate, 0, sizeof belief->rate);
    memset(belief->surprised, 0, sizeof belief->surprised);
    memcpy(belief->mean, state, (size_t)n * sizeof(real));
    memcpy(belief->mean + n, constants->prior, (size_t)SLIPS(c) * sizeof(real));
    belief->mean[n + GYRO_BIAS(c)] = constants->prior[CURVED_SLIPS];
    ddmpc_velocity_output(c, state, output, 0);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            for (int channel = 0; channel < 2; channel++)
                belief->covariance[i * Z + j] += constants->settled[2 * i + channel] * output[channel] *
                                                 output[channel] * constants->settled[2 * j + channel];
    for (int i = 0; i < POSE(c); i++) {
        const real uncertainty = constants->uncertainty[i < SLIPS(c) ? i : CURVED_SLIPS + i - SLIPS(c)];
        belief->covariance[(n + i) * (Z + 1)] = uncertainty * uncertainty;
    }
}

/* Remove poses whose delay was wrong by `change` [s], and reset the slip and the delays that were learned from them. */
static void reset_slip(ddmpc_controller *c, real change)
{
    const int n = STATES(c), Z = BELIEF(c);
    ddmpc_belief *oldest = &node_at(c, 0)->prior, *initial = &newest(c)->posterior;
    remove_measurements(c, 1 << DDMPC_OF_POSE);
    initial_belief(c, initial);
    for (int i = n; i < n + POSE(c); i++) {
        oldest->mean[i] = initial->mean[i];
        for (int j = 0; j < Z; j++)
            oldest->covariance[i * Z + j] = oldest->covariance[j * Z + i] = initial->covariance[i * Z + j];
    }
    for (int i = 0; i < 3; i++)
        oldest->covariance[(n + POSE(c) + i) * (Z + 1)] +=
            ddmpc_fastest(c->constants, i / 2) * change * ddmpc_fastest(c->constants, i / 2) * change;
}

/* Restart the history with one node at `pose`; all other states are those of `motion`. */
static void start(ddmpc_controller *c, ddmpc_time t, const ddmpc_checked_pose *pose, const ddmpc_belief *motion)
{
    /* `motion` may be in the history, so copy it to the first node before the other nodes are discarded. */
    if (motion != &c->estimator.node[0].prior)
        ddmpc_copy_belief(c, &c->estimator.node[0].prior, motion);
    c->estimator.first = c->estimator.nodes = 0;
    ddmpc_node *node = append_node(c, t);
    ddmpc_filter_place(c, &node->prior, pose);
    ddmpc_copy_belief(c, &node->posterior, &node->prior);
    ddmpc_accept_pose(c, pose);
}

int ddmpc_estimator_update(ddmpc_controller *c, ddmpc_time t, const ddmpc_input *input)
{
    ddmpc_checked_pose pose;
    ddmpc_checked_twist twist[3];
    ddmpc_estimator *estimator = &c->estimator;
    const int has_pose = ddmpc_check_pose(c, t, &input->pose, &pose);
    const int wheels = ddmpc_check_wheels(c, t, &input->wheels, twist);
    const int twists = wheels + ddmpc_check_yaw_rate(c, t, &input->yaw_rate, twist + wheels);
    if (estimator->nodes == 0) {
        if (has_pose) {
            initial_belief(c, &estimator->node[0].prior);
            start(c, t, &pose, &estimator->node[0].prior);
        }
        return ddmpc_estimator_state(c);
    }
    int first = estimator->nodes;
    /* `first` is the earliest node that changes in this tick; the filter is repeated from there. The delay is stored
     * before the sensor test may change it. */
    const ddmpc_time delay = ddmpc_monitor_delay(c);
    ddmpc_monitor_move(c, t, twist, wheels, twists);
    const int newly_excluded = has_pose ? ddmpc_monitor_check_pose(c, &pose) : 0;
    const real change = (real)(ddmpc_monitor_delay(c) - delay);
    const int unused = c->monitor.excluded | ddmpc_monitor_doubtful_sensors(c, t);
    if (has_pose) {
        ddmpc_monitor_enlarge_covariance(c, &pose);
        /* The pose is older than its stamp by the delay that the monitor has estimated from the motion. */
        pose.stamp -= ddmpc_monitor_delay(c);
    }
    /* Earlier readings of a newly excluded sensor have affected the whole history. */
    if (newly_excluded) {
        remove_measurements(c, newly_excluded);
        first = 0;
    }
    if (ddmpc_fabs(change) > c->constants->delay_fit[4]) {
        reset_slip(c, change);
        first = 0;
    }
    for (int i = 0; i < twists; i++) {
        if (unused & 1 << (i < wheels ? DDMPC_OF_WHEELS : DDMPC_OF_YAW_RATE))
            continue;
        const ddmpc_time half = 0.5 * c->constants->sample_time;
        /* A twist is inserted at the nearest tick, to which it is extrapolated by the rate. A pose is inserted at the
         * last tick before it, from which the filter predicts forward. */
        const int index = node_before(c, twist[i].stamp + half);
        ddmpc_node *node = node_at(c, index);
        /* Skip measurements from before the history. */
        if (twist[i].stamp < node->time - half - 1e-9)
            continue;
        if (node->twists == MAX_TWISTS) {
            ddmpc_reject(&c->result, i < wheels ? DDMPC_OF_WHEELS : DDMPC_OF_YAW_RATE, DDMPC_TOO_MANY, R(0.0), R(0.0));
            continue;
        }
        node->twist[node->twists++] = twist[i];
        first = ddmpc_min_int(first, index);
    }
    if (has_pose && !(unused & 1 << DDMPC_OF_POSE)) {
        const int index = node_before(c, pose.stamp);
        ddmpc_node *node = node_at(c, index);
        real expected[3];
        ddmpc_filter_pose_at(c, &node->posterior, (real)(pose.stamp - node->time), expected);
        /* Late poses from before a drive are all at its first node; they leave room for a pose of its own time. */
        const int is_before = pose.stamp < node->time - 1e-9;
        if (node->poses >= MAX_POSES - is_before) {
            if (!is_before)
                ddmpc_reject(&c->result, DDMPC_OF_POSE, DDMPC_TOO_MANY, R(0.0), R(0.0));
        } else if (ddmpc_pose_passes(c, &pose, expected)) {
            node->pose[node->poses++] = pose;
            first = ddmpc_min_int(first, index);
        }
    }
    filter_from(c, first);
    return ddmpc_estimator_state(c);
}

int ddmpc_estimator_restart_elsewhere(ddmpc_controller *c)
{
    if (!(ddmpc_estimator_state(c) & MOVED))
        return 0;
    const ddmpc_checked_pose pose = c->estimator.jump_poses[c->estimator.jumps - 1];
    const ddmpc_node *last = newest(c);
    start(c, last->time, &pose, &last->posterior);
    return 1;
}

/* Reduce the part of `mean` that is due to the difference of the states `group` from their prior. The part is removed
   completely if the difference is at most `noise` squared deviations, and less with more evidence. `doubt` is an
   additional variance of a single state that is not part of the filter. The filter is not changed. */
static void discount(const ddmpc_controller *c, const ddmpc_belief *belief, const int *group, int count, real noise,
                     real doubt, real *mean)
{
    const int n = STATES(c), Z = BELIEF(c);
    const real *P = belief->covariance;
    real L[4][4], solution[4], squared = R(0.0);
    for (int i = 0; i < count; i++) {
        const int row = n + group[i];
        real residual = belief->mean[row] - (group[i] < SLIPS(c) ? c->constants->prior[group[i]] : R(0.0));
        for (int j = 0; j <= i; j++) {
            real sum = P[row * Z + n + group[j]];
            for (int k = 0; k < j; k++)
                sum -= L[i][k] * L[j][k];
            /* The variance of a state that is not estimated is zero. */
            L[i][j] = i == j ? ddmpc_sqrt(ddmpc_max(sum, R(0.0))) : L[j][j] > R(0.0) ? sum / L[j][j] : R(0.0);
        }
        for (int j = 0; j < i; j++)
            residual -= L[i][j] * solution[j];
        solution[i] = L[i][i] > R(0.0) ? residual / L[i][i] : R(0.0);
        squared += solution[i] * solution[i];
    }
    for (int i = count - 1; i >= 0; i--) {
        for (int j = i + 1; j < count; j++)
            solution[i] -= L[j][i] * solution[j];
        solution[i] = L[i][i] > R(0.0) ? solution[i] / L[i][i] : R(0.0);
    }
    if (count == 1)
        squared *= L[0][0] * L[0][0] / ddmpc_max(L[0][0] * L[0][0] + doubt, R(1e-12));
    real share = squared > noise ? noise / squared : R(1.0);
    if (*group == OMEGA_GAIN)
        /* The share is squared, since otherwise a part of the error of a wrong track ratio would remain. */
        share *= share;
    for (int j = 0; j < count; j++)
        for (int i = 0; i < Z; i++)
            mean[i] -= share * solution[j] * P[i * Z + n + group[j]];
}

/* Reduce slip and delays in the mean for the controller according to their evidence. */
static void discount_by_evidence(const ddmpc_controller *c, const ddmpc_belief *belief, real *mean)
{
    const int groups[4][4] = {{TURN_AHEAD, TURN_LEFT, SLIDE_X, SLIDE_Y}, {OMEGA_GAIN}, {DELAYS(c)}, {DELAYS(c) + 1}};
    for (int i = 0; i < 4; i++)
        discount(c, belief, groups[i], i == 0 ? 4 : 1, c->constants->evidence[i],
                 i == 0 ? R(0.0) : c->constants->doubt[i > 1], mean);
    ddmpc_filter_bound(c, mean);
}

void ddmpc_estimator_estimate(ddmpc_controller *c)
{
    const ddmpc_node *node = newest(c);
    const ddmpc_belief *belief = &node->posterior;
    const int Z = BELIEF(c);
    ddmpc_estimate *estimate = &c->result.estimate;
    estimate->time = node->time;
    *estimate->pose_age = (real)(node->time - c->estimator.accepted_stamp);
    memcpy(estimate->mean, belief->mean, (size_t)Z * sizeof(real));
    discount_by_evidence(c, belief, estimate->mean);
    for (int i = 0; i < Z; i++)
        estimate->deviation[i] = ddmpc_sqrt(ddmpc_max(belief->covariance[i * (Z + 1)], R(0.0)));
    ddmpc_filter_twist(c, belief->mean, estimate->twist);
    ddmpc_filter_twist_deviation(c, belief, estimate->twist_deviation);
    memcpy(estimate->innovations, c->estimator.innovations, sizeof c->estimator.innovations);
}

int ddmpc_newest_belief(const ddmpc_controller *c, real *mean, real *covariance, real *pending_commands)
{
    if (!(ddmpc_estimator_state(c) & READY))
        return 0;
    const ddmpc_belief *belief = &newest(c)->posterior;
    const int Z = BELIEF(c), W = WINDOW(c);
    memcpy(mean, belief->mean, (size_t)Z * sizeof(real));
    memcpy(covariance, belief->covariance, (size_t)(Z * Z) * sizeof(real));
    memcpy(pending_commands, sent(c, W), (size_t)(2 * W) * sizeof(real));
    return 1;
}

void ddmpc_predict_belief(const ddmpc_controller *c, const real *commands, real *mean, real *covariance,
                          real *mean_after, real *covariance_after)
{
    const ddmpc_belief belief = {mean, covariance, {R(0.0)}, {0}};
    ddmpc_belief prediction = {mean_after, covariance_after, {R(0.0)}, {0}};
    ddmpc_filter_predict(c, &belief, commands + 2 * WINDOW(c), &prediction);
}
