#include "estimator.h"

#include <string.h>

#include "checks.h"
#include "filter.h"

enum { N = DDMPC_STATES };

static ddmpc_node *node_at(ddmpc_estimator *estimator, int index)
{
    return &estimator->node[(estimator->first + index) % DDMPC_HISTORY];
}

static ddmpc_node *newest(ddmpc_estimator *estimator)
{
    return node_at(estimator, estimator->nodes - 1);
}

/* A new node at the end of the history, which drops its oldest where it is full. */
static ddmpc_node *grow(ddmpc_estimator *estimator, ddmpc_time time)
{
    if (estimator->nodes == DDMPC_HISTORY)
        estimator->first = (estimator->first + 1) % DDMPC_HISTORY;
    else
        estimator->nodes++;
    ddmpc_node *node = newest(estimator);
    node->time = time;
    node->poses = node->twists = 0;
    return node;
}

void ddmpc_estimator_init(ddmpc_estimator *estimator)
{
    memset(estimator->commands, 0, sizeof estimator->commands);
    ddmpc_estimator_forget(estimator);
}

void ddmpc_estimator_forget(ddmpc_estimator *estimator)
{
    estimator->first = estimator->nodes = estimator->jumps = 0;
    estimator->accepted_stamp = estimator->pose_stamp = -HUGE_VAL;
    estimator->wheels_stamp = estimator->yaw_rate_stamp = -HUGE_VAL;
    estimator->last_wheels[0] = estimator->last_wheels[1] = estimator->last_yaw_rate = R(0.0);
    for (int i = 0; i < DDMPC_SENSORS; i++)
        estimator->innovations[i] = (real)NAN;
}

int ddmpc_estimator_ready(const ddmpc_estimator *estimator)
{
    return estimator->nodes > 0;
}

int ddmpc_estimator_moved(const ddmpc_estimator *estimator)
{
    return estimator->jumps >= DDMPC_AGREEING;
}

void ddmpc_estimator_append(ddmpc_estimator *estimator, const real command[2])
{
    memmove(estimator->commands, estimator->commands + 1, (DDMPC_COMMANDS - 1) * sizeof estimator->commands[0]);
    ddmpc_estimator_correct_last(estimator, command);
}

void ddmpc_estimator_correct_last(ddmpc_estimator *estimator, const real command[2])
{
    memcpy(estimator->commands[DDMPC_COMMANDS - 1], command, sizeof estimator->commands[0]);
}

int ddmpc_estimator_correct_sent(const ddmpc_estimation *constants, ddmpc_estimator *estimator, const real sent[2])
{
    for (int c = 0; c < 2; c++)
        /* Not the other way round: NaN must not pass. */
        if (!(ddmpc_fabs(sent[c]) <= constants->largest_twist[c]))
            return 0;
    ddmpc_estimator_correct_last(estimator, sent);
    return 1;
}

/* u[k - delay] and u[k - delay - 1] for the interval that the command sent `ticks_ago` began. */
static void acting(const ddmpc_estimator *estimator, int ticks_ago, real recent[2], real older[2])
{
    const int delay[2] = {DDMPC_DELAY_V, DDMPC_DELAY_OMEGA};
    for (int c = 0; c < 2; c++) {
        const int row = DDMPC_COMMANDS - 1 - ticks_ago - delay[c];
        recent[c] = estimator->commands[row][c];
        older[c] = estimator->commands[row - 1][c];
    }
}

static void predict(const ddmpc_estimation *constants, const ddmpc_estimator *estimator, const ddmpc_belief *before,
                    int ticks_ago, ddmpc_belief *after)
{
    real recent[2], older[2];
    acting(estimator, ticks_ago, recent, older);
    ddmpc_filter_predict(constants, before, recent, older, after);
}

void ddmpc_estimator_advance(const ddmpc_estimation *constants, ddmpc_estimator *estimator, ddmpc_time t)
{
    if (estimator->nodes == 0)
        return;
    const double passed = rint((t - newest(estimator)->time) / (double)constants->dt);
    const int steps = passed > 1.0 ? (int)passed : 1;
    for (int missing = steps - 1; missing >= 0; missing--) {
        if (missing < steps - 1)
            ddmpc_estimator_append(estimator, estimator->commands[DDMPC_COMMANDS - 1]);
        const ddmpc_belief *before = &newest(estimator)->posterior;
        ddmpc_node *node = grow(estimator, t - missing * (double)constants->dt);
        predict(constants, estimator, before, 0, &node->prior);
        node->posterior = node->prior;
    }
}

/* Index of the last node not after `time`; the first where the history does not reach back so far. */
static int node_before(ddmpc_estimator *estimator, ddmpc_time time)
{
    for (int index = estimator->nodes - 1; index > 0; index--)
        if (node_at(estimator, index)->time <= time + 1e-9)
            return index;
    return 0;
}

/* Filter again from the node `first` to the newest. */
static void filter_from(const ddmpc_estimation *constants, ddmpc_estimator *estimator, int first)
{
    for (int index = first; index < estimator->nodes; index++) {
        ddmpc_node *node = node_at(estimator, index);
        if (index > first)
            predict(constants, estimator, &node_at(estimator, index - 1)->posterior, estimator->nodes - 1 - index,
                    &node->prior);
        node->posterior = node->prior;
        for (int i = 0; i < node->twists; i++) {
            const ddmpc_checked_twist *twist = &node->twist[i];
            estimator->innovations[twist->sensor] = ddmpc_filter_correct_twist(constants, &node->posterior, twist);
        }
        for (int i = 0; i < node->poses; i++) {
            const real ahead = (real)(node->pose[i].stamp - node->time);
            estimator->innovations[DDMPC_POSE_SENSOR] =
                ddmpc_filter_correct_pose(constants, &node->posterior, &node->pose[i], ahead);
        }
    }
}

/* A robot that obeys the commands sent so far as the model says, somewhere. Its speed is as uncertain as if it might
   as well stand; that of a robot at rest is certain. */
static void moving(const ddmpc_estimation *constants, const ddmpc_estimator *estimator, ddmpc_belief *belief)
{
    real recent[2], older[2], state[N], next[N], output[2] = {R(0.0), R(0.0)};
    acting(estimator, DDMPC_HISTORY, recent, older);
    for (int i = 0; i < N; i++)
        state[i] = constants->settled[i][0] * older[0] + constants->settled[i][1] * older[1];
    for (int ticks_ago = DDMPC_HISTORY; ticks_ago >= 0; ticks_ago--) {
        acting(estimator, ticks_ago, recent, older);
        for (int i = 0; i < N; i++) {
            next[i] = R(0.0);
            for (int j = 0; j < N; j++)
                next[i] += constants->A[i][j] * state[j];
            for (int c = 0; c < 2; c++)
                next[i] += constants->B0[i][c] * recent[c] + constants->B1[i][c] * older[c];
        }
        memcpy(state, next, sizeof state);
    }
    memset(belief, 0, sizeof *belief);
    memcpy(belief->mean, state, sizeof state);
    for (int i = DDMPC_OMEGA_GAIN; i < DDMPC_SIDE_SLIP; i++)
        belief->mean[i] = R(1.0);
    for (int c = 0; c < 2; c++)
        for (int i = 0; i < N; i++)
            output[c] += constants->C[c][i] * state[i];
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++)
            for (int c = 0; c < 2; c++)
                belief->covariance[i][j] +=
                    constants->settled[i][c] * output[c] * output[c] * constants->settled[j][c];
    for (int i = 0; i < DDMPC_SLIPS; i++)
        belief->covariance[N + i][N + i] = constants->uncertainty[i] * constants->uncertainty[i];
}

/* A history of one node, which is at `pose` with the motion that its prior holds. */
static void start(ddmpc_estimator *estimator, ddmpc_time t, const ddmpc_checked_pose *pose, const ddmpc_belief *motion)
{
    /* `motion` may lie in the history: it moves to the first node before the rest is dropped. */
    memmove(&estimator->node[0].prior, motion, sizeof *motion);
    estimator->first = estimator->nodes = 0;
    ddmpc_node *node = grow(estimator, t);
    ddmpc_filter_place(&node->prior, pose);
    node->posterior = node->prior;
    ddmpc_accept_pose(estimator, pose);
}

static int least(int a, int b)
{
    return a < b ? a : b;
}

static int state(const ddmpc_estimator *estimator)
{
    return (ddmpc_estimator_ready(estimator) ? DDMPC_READY : 0) | (ddmpc_estimator_moved(estimator) ? DDMPC_MOVED : 0);
}

int ddmpc_estimator_update(const ddmpc_estimation *constants, ddmpc_estimator *estimator, ddmpc_time t,
                           const ddmpc_measurement *measurement, ddmpc_notes *notes)
{
    ddmpc_checked_pose pose;
    ddmpc_checked_twist twist[3];
    notes->count = 0;
    const int has_pose = ddmpc_check_pose(constants, estimator, t, &measurement->pose, &pose, notes);
    const int wheels = ddmpc_check_wheels(constants, estimator, t, &measurement->wheels, twist, notes);
    const int twists =
        wheels + ddmpc_check_yaw_rate(constants, estimator, t, &measurement->yaw_rate, twist + wheels, notes);
    if (estimator->nodes == 0) {
        if (has_pose) {
            moving(constants, estimator, &estimator->node[0].prior);
            start(estimator, t, &pose, &estimator->node[0].prior);
        }
        return state(estimator);
    }
    int first = estimator->nodes;
    for (int i = 0; i < twists; i++) {
        /* At the nearest tick: within half a sample a twist changes little. */
        const ddmpc_time stamp = i < wheels ? measurement->wheels.stamp : measurement->yaw_rate.stamp;
        const int index = node_before(estimator, stamp + 0.5 * (double)constants->dt);
        ddmpc_node *node = node_at(estimator, index);
        if (node->twists == DDMPC_TWISTS) {
            ddmpc_reject(notes, i < wheels ? DDMPC_OF_WHEELS : DDMPC_OF_YAW_RATE, DDMPC_TOO_MANY, R(0.0), R(0.0));
            continue;
        }
        node->twist[node->twists++] = twist[i];
        first = least(first, index);
    }
    if (has_pose) {
        const int index = node_before(estimator, pose.stamp);
        ddmpc_node *node = node_at(estimator, index);
        real expected[3];
        ddmpc_filter_pose_at(constants, &node->posterior, (real)(pose.stamp - node->time), expected);
        if (node->poses == DDMPC_POSES) {
            ddmpc_reject(notes, DDMPC_OF_POSE, DDMPC_TOO_MANY, R(0.0), R(0.0));
        } else if (ddmpc_pose_passes(constants, estimator, &pose, expected, notes)) {
            node->pose[node->poses++] = pose;
            first = least(first, index);
        }
    }
    filter_from(constants, estimator, first);
    return state(estimator);
}

int ddmpc_estimator_restart_elsewhere(const ddmpc_estimation *constants, ddmpc_estimator *estimator)
{
    (void)constants;
    if (!ddmpc_estimator_moved(estimator))
        return 0;
    const ddmpc_checked_pose pose = estimator->jumped[estimator->jumps - 1];
    const ddmpc_node *last = newest(estimator);
    start(estimator, last->time, &pose, &last->posterior);
    return 1;
}

void ddmpc_estimator_estimate(const ddmpc_estimation *constants, const ddmpc_estimator *estimator,
                              ddmpc_estimate *estimate)
{
    const ddmpc_node *node = &estimator->node[(estimator->first + estimator->nodes - 1) % DDMPC_HISTORY];
    const ddmpc_belief *belief = &node->posterior;
    estimate->time = node->time;
    estimate->pose_age = (real)(node->time - estimator->accepted_stamp);
    memcpy(estimate->mean, belief->mean, sizeof estimate->mean);
    for (int i = 0; i < DDMPC_BELIEF; i++)
        estimate->deviation[i] = ddmpc_sqrt(ddmpc_max(belief->covariance[i][i], R(0.0)));
    ddmpc_filter_twist(constants, belief->mean, estimate->twist);
    ddmpc_filter_twist_deviation(constants, belief, estimate->twist_deviation);
    memcpy(estimate->innovations, estimator->innovations, sizeof estimate->innovations);
}

unsigned long ddmpc_estimation_size(void)
{
    return (unsigned long)sizeof(ddmpc_estimation);
}

unsigned long ddmpc_estimator_size(void)
{
    return (unsigned long)sizeof(ddmpc_estimator);
}
