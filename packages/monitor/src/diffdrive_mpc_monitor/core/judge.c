#include <math.h>
#include <string.h>

#include "judge.h"

enum { V, OMEGA };
enum { BY_WHEELS, BY_GYRO };
enum { DISTANCE, HEADING };
enum { X, Y, THETA };

/* Filter weight of one interval in the mean interval of commands [-]. */
#define INTERVAL_WEIGHT 0.05
/* Minimum intervals between entries of the command buffer and of the track [s]. */
#define COMMAND_SPACING 0.004
#define TRACK_SPACING 0.015
/* Upper bound of a time step [s]. */
#define MAX_STEP 1.0
/* Number of lags after which a robot is at rest [-]. */
#define REST_LAGS 3.0
/* Lower bound of the time between two poses of a reference [s]. */
#define MIN_INTERVAL 1e-9
/* Tolerance for rounding errors. */
#define ROUNDING 1e-9

static double absolute(double x) { return x < 0.0 ? -x : x; }

static double max_of(double a, double b) { return a > b ? a : b; }

static double min_of(double a, double b) { return a < b ? a : b; }

/* Return 1 for a finite number; volatile makes the test robust against -ffast-math. */
static int is_finite(double x)
{
    volatile double difference = x - x;
    return difference == 0.0;
}

static double wrapped(double angle) { return angle - 6.283185307179586 * floor(angle / 6.283185307179586 + 0.5); }

static int moves(const ddmon_rules *rules, const double twist[2])
{
    return absolute(twist[V]) > rules->commands_standing_v || absolute(twist[OMEGA]) > rules->commands_standing_omega;
}

/* Update a rule. A rule that is violated for longer than `lasting` stops the robot; the first such rule is latched. */
static void judge_rule(ddmon_judge *j, int rule, double value, double limit, int broken, double lasting)
{
    if (!broken) {
        j->broken[rule] = 0;
        return;
    }
    if (!j->broken[rule])
        j->since[rule] = j->now;
    j->broken[rule] = 1;
    j->value[rule] = value;
    j->limit[rule] = limit;
    if (j->verdict.rule == DDMON_NOTHING && j->now - j->since[rule] >= lasting - ROUNDING) {
        ddmon_verdict verdict = {rule, j->now, value, limit};
        j->verdict = verdict;
        j->output_at = j->now;
    }
}

static void check_max(ddmon_judge *j, int rule, double value, double limit, double lasting)
{
    /* A value that is not finite also violates the rule. */
    judge_rule(j, rule, value, limit, !(value <= limit), lasting);
}

/* Advance the clock. If it was set back, discard all data with time stamps. */
static void advance_clock(ddmon_judge *j, double now)
{
    if (now >= j->now - j->rules->sensors_ahead) {
        j->now = max_of(j->now, now);
        return;
    }
    judge_rule(j, DDMON_CLOCK, j->now - now, j->rules->sensors_ahead, 1, 0.0);
    if (!is_finite(now))
        return;
    j->now = j->start = j->answered = j->free_at = j->path_at = j->output_at = j->command_at = j->may_move_since = now;
    j->has_odometry = j->has_pose = j->has_gyro = j->placed = j->has_command_stamp = 0;
    j->ways = j->tracks = 0;
    j->driven = 0.0;
    memset(j->unexplained, 0, sizeof j->unexplained);
    memset(j->broken, 0, sizeof j->broken);
    memset(j->crept, 0, sizeof j->crept);
    j->moved_at = now;
}

void ddmon_init(ddmon_judge *j, const ddmon_rules *rules, double now)
{
    memset(j, 0, sizeof *j);
    j->rules = rules;
    j->now = j->start = now;
    j->may_move = -1;
    j->answered = j->free_at = j->path_at = now;
    j->pace = 0.5 * (rules->commands_slowest + rules->commands_quickest);
}

/* Allow the robot to return to its path; `away_time` limits the duration. */
static void allow_return(ddmon_judge *j)
{
    j->returning = 1;
    j->away_at = j->now;
}

int ddmon_reference(ddmon_judge *j, double now, const ddmon_point *path, int points)
{
    const ddmon_rules *rules = j->rules;
    int is_valid = points >= 0;
    advance_clock(j, now);
    for (int k = 0; k < points && is_valid; k++) {
        const ddmon_point *p = path + k;
        is_valid = is_finite(p->t) && is_finite(p->x) && is_finite(p->y) && is_finite(p->theta);
        if (is_valid && k) {
            double time = p->t - p[-1].t, turn = absolute(wrapped(p->theta - p[-1].theta));
            is_valid = time > 0.0 && hypot(p->x - p[-1].x, p->y - p[-1].y) <= rules->commands_v * time + ROUNDING &&
                       turn <= rules->commands_omega * time + ROUNDING;
        }
    }
    j->path = is_valid && points ? path : 0;
    j->points = is_valid ? points : 0;
    /* The reference may start away from the robot. */
    allow_return(j);
    j->away_at = j->now - rules->path_lasting;
    judge_rule(j, DDMON_BAD_REFERENCE, 0.0, 0.0, !is_valid, 0.0);
    return is_valid;
}

/* Move a pose along an arc. */
static void move_along_arc(double pose[3], double length, double turn)
{
    double middle = pose[THETA] + 0.5 * turn;
    pose[X] += length * cos(middle);
    pose[Y] += length * sin(middle);
    pose[THETA] += turn;
}

/* Weight of a new value in one step of a first-order filter. */
static double filter_weight(double step, double time) { return step / (time + step); }

/* Integrate the motion since the previous odometry by wheels and gyro. */
static void integrate_motion(ddmon_judge *j, double stamp, double step, double v, double omega)
{
    double *sum = j->summed;
    int last = j->track_last;
    if (j->has_gyro && j->rules->sensors_gyro_age > 0.0)
        omega = j->gyro;
    move_along_arc(sum, v * step, omega * step);
    move_along_arc(j->place, v * step, omega * step);
    for (int i = 0; i < 3; i++)
        j->unexplained[i] -= filter_weight(step, j->rules->agreement_window) * j->unexplained[i];
    j->driven += absolute(v) * step - filter_weight(step, j->rules->agreement_window) * j->driven;
    if (j->tracks && stamp - j->track_at[last] < TRACK_SPACING)
        return;
    last = j->tracks ? (last + 1) % DDMON_TRACK : 0;
    j->track_at[last] = stamp;
    for (int i = 0; i < 3; i++)
        j->track[i][last] = sum[i];
    j->track_last = last;
    if (j->tracks < DDMON_TRACK)
        j->tracks++;
}

/* Interpolate the integrated motion at time `t`. Returns 0 if the track no longer covers it. */
static int motion_at(const ddmon_judge *j, double t, double sum[3])
{
    for (int back = 0; back < j->tracks; back++) {
        int k = (j->track_last - back + DDMON_TRACK) % DDMON_TRACK;
        if (j->track_at[k] > t + ROUNDING)
            continue;
        int next = (k + 1) % DDMON_TRACK;
        double fraction = back ? (t - j->track_at[k]) / (j->track_at[next] - j->track_at[k]) : 0.0;
        for (int i = 0; i < 3; i++)
            sum[i] = j->track[i][k] + (back ? fraction * (j->track[i][next] - j->track[i][k]) : 0.0);
        return 1;
    }
    return 0;
}

/* Check the response to commands. The bounds rise immediately with pending commands, and fall with the maximum lag. */
static void judge_response(ddmon_judge *j, int channel, int by, double measured, int rule)
{
    const ddmon_rules *rules = j->rules;
    double lag = channel == V ? rules->answer_lag_v : rules->answer_lag_omega;
    double gain = channel == V ? rules->answer_gain_v : rules->answer_gain_omega;
    double margin = channel == V ? rules->answer_margin_v : rules->answer_margin_omega;
    double step = min_of(max_of(j->now - j->answered, 0.0), MAX_STEP), maximum = 0.0, minimum = 0.0;
    for (int back = 0; back < j->ways; back++) {
        int k = (j->way - back + DDMON_COMMANDS) % DDMON_COMMANDS;
        maximum = max_of(maximum, gain * j->way_most[channel][k]);
        minimum = min_of(minimum, gain * j->way_least[channel][k]);
        if (j->way_at[k] < j->now - rules->answer_dead_time)
            break; /* this command acted until the next one */
    }
    double *high = &j->high[by][channel], *low = &j->low[by][channel], fall = filter_weight(step, lag);
    *high = maximum > *high ? maximum : *high + fall * (maximum - *high);
    *low = minimum < *low ? minimum : *low + fall * (minimum - *low);
    int above = measured > *high + margin, below = measured < *low - margin;
    judge_rule(j, rule, measured, above ? *high + margin : *low - margin, above || below, rules->answer_lasting);
}

static void judge_responses(ddmon_judge *j)
{
    int gyro = j->has_gyro && j->rules->sensors_gyro_age > 0.0;
    double standing = j->rules->commands_standing_v;
    if (!j->sent || absolute(j->output[V]) <= standing || absolute(j->wheels[V]) > standing)
        j->free_at = j->now;
    judge_response(j, V, BY_WHEELS, j->wheels[V], DDMON_ANSWER_V);
    judge_response(j, OMEGA, gyro ? BY_GYRO : BY_WHEELS, gyro ? j->gyro : j->wheels[OMEGA], DDMON_ANSWER_OMEGA);
    j->answered = j->now;
}

/* Return 1 for a usable stamp, which is not in the future and newer than the last one. */
static int is_usable_stamp(const ddmon_judge *j, double stamp, int known, double last)
{
    return is_finite(stamp) && stamp <= j->now + j->rules->sensors_ahead && (!known || stamp > last);
}

/* Compare the turns of gyro and wheels over the window, both through the same first-order filter. */
static void compare_gyro(ddmon_judge *j, double step)
{
    const ddmon_rules *rules = j->rules;
    double window = rules->agreement_window, weight = filter_weight(step, window);
    if (!(j->has_gyro && rules->sensors_gyro_age > 0.0))
        return;
    j->slow_wheels += weight * (j->wheels[OMEGA] - j->slow_wheels);
    j->slow_gyro += weight * (j->gyro - j->slow_gyro);
    double turn = window * j->slow_gyro, high = window * rules->agreement_gyro_gain * j->slow_wheels;
    double low = window * rules->agreement_gyro_least * j->slow_wheels;
    double top = max_of(high, low) + rules->agreement_gyro_turn;
    double bottom = min_of(high, low) - rules->agreement_gyro_turn;
    judge_rule(j, DDMON_GYRO_WHEELS, turn, turn > top ? top : bottom, turn > top || turn < bottom,
               rules->agreement_lasting);
}

/* Update the pose of the robot, which wheels and gyro predict and poses correct. Corrections within the window are motion
   that wheels and gyro do not explain: an external motion, or a contradiction between sensors. */
static void correct_pose(ddmon_judge *j, double step)
{
    const ddmon_rules *rules = j->rules;
    double past[3], current[3] = {j->pose[X], j->pose[Y], j->pose[THETA]}, *unexplained = j->unexplained;
    if (motion_at(j, j->pose_stamp, past)) {
        double turned = j->pose[THETA] - past[THETA], c = cos(turned), s = sin(turned);
        double x = j->summed[X] - past[X], y = j->summed[Y] - past[Y];
        current[X] += c * x - s * y;
        current[Y] += s * x + c * y;
        current[THETA] += j->summed[THETA] - past[THETA];
    }
    if (!j->placed)
        memcpy(j->place, current, sizeof current);
    j->placed = 1;
    for (int i = 0; i < 3; i++) {
        double error = i == THETA ? wrapped(current[i] - j->place[i]) : current[i] - j->place[i];
        double correction = filter_weight(step, rules->agreement_blend) * error;
        current[i] = unexplained[i] + error; /* includes the remaining error */
        j->place[i] += correction;
        unexplained[i] += correction;
    }
    check_max(j, DDMON_POSE_JUMPS, hypot(current[X], current[Y]),
              rules->agreement_distance + rules->agreement_distance_share * j->driven, rules->agreement_lasting);
    check_max(j, DDMON_POSE_TURNS, absolute(current[THETA]), rules->agreement_turn, rules->agreement_lasting);
}

/* Check the motion of the wheels while the controller reports standstill and the robot should be at rest. Only the wheels
   are used, because poses can jump and a gyro drifts. */
static void judge_rest(ddmon_judge *j, double step)
{
    const ddmon_rules *rules = j->rules;
    double moved_at = min_of(j->moved_at, j->may_move_since + rules->commands_stop_within);
    double lag = max_of(rules->answer_lag_v, rules->answer_lag_omega);
    int at_rest = j->now - moved_at > rules->answer_dead_time + REST_LAGS * lag;
    for (int i = 0; i < 2; i++)
        j->crept[i] = j->rests && at_rest ? j->crept[i] + step * j->wheels[i] : 0.0;
    check_max(j, DDMON_CREEPS, absolute(j->crept[V]), rules->commands_rest_distance, 0.0);
    check_max(j, DDMON_TURNS_AT_REST, absolute(j->crept[OMEGA]), rules->commands_rest_turn, 0.0);
}

void ddmon_odometry(ddmon_judge *j, double now, double stamp, double v, double omega, double x, double y, double theta)
{
    advance_clock(j, now);
    if (!(is_usable_stamp(j, stamp, j->has_odometry, j->odometry_stamp) && is_finite(v) && is_finite(omega) &&
          is_finite(x) && is_finite(y) && is_finite(theta)))
        return; /* the last odometry ages */
    double step = j->has_odometry ? min_of(max_of(stamp - j->odometry_stamp, 0.0), MAX_STEP) : 0.0;
    integrate_motion(j, stamp, step, v, omega);
    j->has_odometry = 1;
    j->odometry_stamp = stamp;
    j->wheels[V] = v;
    j->wheels[OMEGA] = omega;
    if (!(j->rules->sensors_pose_age > 0.0)) {
        j->place[X] = x;
        j->place[Y] = y;
        j->place[THETA] = theta;
        j->placed = 1;
    }
    judge_responses(j);
    compare_gyro(j, step);
    judge_rest(j, step);
}

void ddmon_gyro(ddmon_judge *j, double now, double stamp, double omega)
{
    advance_clock(j, now);
    if (!(is_usable_stamp(j, stamp, j->has_gyro, j->gyro_stamp) && is_finite(omega)))
        return;
    j->has_gyro = 1;
    j->gyro_stamp = stamp;
    j->gyro = omega;
}

void ddmon_pose(ddmon_judge *j, double now, double stamp, double x, double y, double theta)
{
    advance_clock(j, now);
    if (!(j->rules->sensors_pose_age > 0.0 && is_usable_stamp(j, stamp, j->has_pose, j->pose_stamp) && is_finite(x) &&
          is_finite(y) && is_finite(theta)))
        return;
    double step = j->has_pose ? min_of(stamp - j->pose_stamp, MAX_STEP) : 0.0;
    j->has_pose = 1;
    j->pose_stamp = stamp;
    j->pose[X] = x;
    j->pose[Y] = y;
    j->pose[THETA] = theta;
    correct_pose(j, step);
}

void ddmon_says(ddmon_judge *j, double now, int drives)
{
    advance_clock(j, now);
    if (j->may_move != drives)
        j->may_move_since = j->now;
    /* The reference advanced while the robot stood, until the controller publishes it again. */
    if (j->may_move == 0 && drives)
        allow_return(j);
    /* A robot that has not driven yet may be moved by hand. */
    if (drives || j->may_move == 1)
        j->rests = !drives;
    j->may_move = drives;
}

void ddmon_outside(ddmon_judge *j, double now, int verdict)
{
    advance_clock(j, now);
    judge_rule(j, DDMON_OUTSIDE, 0.0, 0.0, verdict, 0.0);
}

/* Compute the distance of a pose from the path section that the reference covers from `start` to `end` [s], and its angle
   to the headings of the part within the distance `close`. */
static void compare_section(const ddmon_judge *j, const double pose[3], double start, double end, double close,
                            double error[2])
{
    const ddmon_point *path = j->path;
    int last = j->points - 1;
    double heading = HUGE_VAL;
    error[DISTANCE] = HUGE_VAL;
    /* The reference is at rest before its first and after its last pose. */
    start = min_of(start, path[last].t);
    end = max_of(end, path[0].t);
    for (int k = 0; k <= last; k++) {
        const ddmon_point *p = path + k, *q = path + (k < last ? k + 1 : k);
        if (q->t < start || p->t > end)
            continue;
        /* part of the segment that is due between `start` and `end` */
        double time = max_of(q->t - p->t, MIN_INTERVAL), from = max_of((start - p->t) / time, 0.0);
        double to = min_of((end - p->t) / time, 1.0), dx = q->x - p->x, dy = q->y - p->y;
        double length = dx * dx + dy * dy, turn = wrapped(q->theta - p->theta) * (to - from);
        double fraction = length > 0.0 ? ((pose[X] - p->x) * dx + (pose[Y] - p->y) * dy) / length : 0.0;
        fraction = min_of(max_of(fraction, from), to);
        double distance = hypot(pose[X] - p->x - fraction * dx, pose[Y] - p->y - fraction * dy);
        error[DISTANCE] = min_of(error[DISTANCE], distance);
        if (distance <= close) {
            /* angle to the range of headings of this part */
            double off = wrapped(pose[THETA] - p->theta - wrapped(q->theta - p->theta) * 0.5 * (from + to));
            heading = min_of(heading, max_of(absolute(off) - 0.5 * absolute(turn), 0.0));
        }
    }
    error[HEADING] = heading < HUGE_VAL ? heading : 0.0;
}

/* Predict the pose at rest if the robot braked now; it may still accelerate to the sent command. Returns the time to reach
   this pose at constant speed, by which the reference may be late. */
static double predict_rest_pose(const ddmon_judge *j, double rest[3])
{
    int gyro = j->has_gyro && j->rules->sensors_gyro_age > 0.0;
    double sent = j->sent ? j->output[V] : 0.0, v = absolute(sent) > absolute(j->wheels[V]) ? sent : j->wheels[V];
    double time = j->rules->path_reaction + 0.5 * absolute(v) / j->rules->commands_v_braking;
    memcpy(rest, j->place, sizeof j->place);
    move_along_arc(rest, v * time, time * (gyro ? j->gyro : j->wheels[OMEGA]));
    return time;
}

/* Check that the robot is near its path and on time, both now and at the pose at rest after braking. Motion that neither
   wheels nor gyro explain is tolerated, because the controller does not cause it. For a limited time, a robot may return to
   its path after an external motion, a blocked motion or a standstill, or if its reference starts is_away. */
static void judge_path(ddmon_judge *j)
{
    const ddmon_rules *rules = j->rules;
    int moved = j->sent && moves(rules, j->output), bound = j->path && j->placed && (moved || j->may_move == 1);
    double away[2] = {0.0, 0.0}, ahead[2] = {0.0, 0.0}, rest[3], step = min_of(j->now - j->path_at, MAX_STEP);
    double unexplained = hypot(j->unexplained[X], j->unexplained[Y]);
    j->path_at = j->now;
    judge_rule(j, DDMON_NO_REFERENCE, 0.0, 0.0, moved && !j->path, rules->path_grace);
    if (bound) {
        compare_section(j, j->place, j->now - rules->path_late, j->now + rules->path_early, rules->path_distance, away);
        int is_away = away[DISTANCE] > rules->path_distance;
        int is_blocked = j->now - j->free_at > rules->answer_dead_time + rules->answer_lasting;
        if (is_away && (is_blocked || unexplained > rules->path_distance))
            allow_return(j);
        if (is_away)
            j->away_at = j->now;
        /* The timer counts up away from the path, and down near it. So a robot that does not return runs out of time, even
           if external motion or new references occur meanwhile. */
        if (!is_away || j->away_for <= rules->returning_within)
            j->away_for = max_of(j->away_for + (is_away ? step : -step), 0.0);
        if (j->now - j->away_at >= rules->path_lasting || j->away_for > rules->returning_within)
            j->returning = 0;
        double time = predict_rest_pose(j, rest), late = j->returning ? rules->returning_late : rules->path_late;
        double early = j->returning ? rules->returning_early : rules->path_early;
        compare_section(j, rest, j->now - late, j->now + time + early, HUGE_VAL, ahead);
    }
    int strict = bound && !j->returning;
    double far = strict ? rules->path_far + unexplained : rules->returning_distance;
    check_max(j, DDMON_STRAYS, strict ? away[DISTANCE] : 0.0, rules->path_distance, rules->path_lasting);
    check_max(j, DDMON_OFF_PATH, ahead[DISTANCE], far, rules->path_far_lasting);
    check_max(j, DDMON_OFF_HEADING, strict ? away[HEADING] : 0.0, rules->path_heading, rules->path_far_lasting);
}

static void judge_ages(ddmon_judge *j)
{
    const ddmon_rules *rules = j->rules;
    int moved = j->sent && moves(rules, j->output);
    double odometry = j->now - (j->has_odometry ? j->odometry_stamp : j->start);
    double pose = j->now - (j->has_pose ? j->pose_stamp : j->start);
    double gyro = j->now - (j->has_gyro ? j->gyro_stamp : j->start);
    check_max(j, DDMON_ODOMETRY, moved ? odometry : 0.0, rules->sensors_odometry_age, 0.0);
    check_max(j, DDMON_POSE, moved && rules->sensors_pose_age > 0.0 ? pose : 0.0, rules->sensors_pose_age, 0.0);
    check_max(j, DDMON_GYRO, moved && rules->sensors_gyro_age > 0.0 ? gyro : 0.0, rules->sensors_gyro_age, 0.0);
}

/* Check the rules that can be violated without new input. */
static void judge_time(ddmon_judge *j)
{
    const ddmon_rules *rules = j->rules;
    int moved = j->sent && moves(rules, j->output), latched = j->verdict.rule != DDMON_NOTHING;
    if (latched)
        moved = 0;
    check_max(j, DDMON_SILENT, moved ? j->now - j->command_at : 0.0, rules->commands_silence, 0.0);
    int must_stand = j->may_move == 0 && j->now - j->may_move_since > rules->commands_stop_within;
    judge_rule(j, DDMON_NOT_TO_MOVE, j->now - j->may_move_since, rules->commands_stop_within, moved && must_stand,
               rules->path_grace);
    judge_ages(j);
    judge_path(j);
}

/* Compute the command after a violation: zero, reached at the braking limits if commands still have their normal effect. */
static void brake(ddmon_judge *j)
{
    const ddmon_rules *rules = j->rules;
    double step = min_of(max_of(j->now - j->output_at, 0.0), MAX_STEP);
    double slew[2] = {rules->commands_v_braking * step, rules->commands_omega_braking * step};
    int rule = j->verdict.rule;
    int has_effect = rule != DDMON_ANSWER_V && rule != DDMON_ANSWER_OMEGA && rule != DDMON_GYRO_WHEELS &&
                     rule != DDMON_ODOMETRY && rule != DDMON_OUTSIDE;
    for (int i = 0; i < 2; i++) {
        double magnitude = has_effect ? max_of(absolute(j->output[i]) - slew[i], 0.0) : 0.0;
        j->output[i] = j->output[i] < 0.0 ? -magnitude : magnitude;
    }
    j->output_at = j->now;
}

/* Send a command, which is pending until the maximum dead time has passed. */
static void send(ddmon_judge *j, const double twist[2])
{
    int k = j->way;
    if (!j->ways || j->now - j->way_at[k] >= COMMAND_SPACING) {
        k = j->ways ? (k + 1) % DDMON_COMMANDS : 0;
        j->way_at[k] = j->now;
        for (int i = 0; i < 2; i++)
            j->way_most[i][k] = j->way_least[i][k] = twist[i];
        j->way = k;
        if (j->ways < DDMON_COMMANDS)
            j->ways++;
    }
    for (int i = 0; i < 2; i++) {
        j->way_most[i][k] = max_of(j->way_most[i][k], twist[i]);
        j->way_least[i][k] = min_of(j->way_least[i][k], twist[i]);
        j->output[i] = twist[i];
    }
    j->sent = 1;
    j->output_at = j->now;
    if (moves(j->rules, twist))
        j->moved_at = j->now;
}

static void judge_slew(ddmon_judge *j, const double twist[2], double step)
{
    const ddmon_rules *rules = j->rules;
    const double away[2] = {rules->commands_v_slew, rules->commands_omega_slew};
    const double towards[2] = {rules->commands_v_braking, rules->commands_omega_braking};
    for (int i = 0; i < 2; i++) {
        double *followed = &j->followed[i], change = twist[i] - *followed;
        int is_decrease = twist[i] * *followed >= 0.0 && absolute(twist[i]) < absolute(*followed);
        double slew = is_decrease ? max_of(away[i], towards[i]) : away[i], max_change = slew * step;
        *followed += min_of(max_of(change, -max_change), max_change);
        check_max(j, i == V ? DDMON_SLEW : DDMON_YAW_SLEW, absolute(twist[i] - *followed),
                  slew * rules->commands_jitter, 0.0);
    }
}

/* Check the mean interval of commands: short enough while the robot moves, and never too short. */
static void judge_interval(ddmon_judge *j, int moved)
{
    const ddmon_rules *rules = j->rules;
    if (j->commanded && j->sent && moves(rules, j->output))
        j->pace += INTERVAL_WEIGHT * (min_of(j->now - j->command_at, MAX_STEP) - j->pace);
    else
        j->pace = 0.5 * (rules->commands_slowest + rules->commands_quickest);
    check_max(j, DDMON_SLOW, moved ? j->pace : 0.0, rules->commands_slowest, 0.0);
    judge_rule(j, DDMON_FLOOD, j->pace, rules->commands_quickest, j->pace < rules->commands_quickest, 0.0);
}

static void judge_stamp(ddmon_judge *j, double stamp, int moved)
{
    const ddmon_rules *rules = j->rules;
    int known = stamp != 0.0;
    double ahead = known ? stamp - j->now : 0.0;
    check_max(j, DDMON_OLD_COMMAND, moved && known ? -ahead : 0.0, rules->commands_oldest, 0.0);
    check_max(j, DDMON_COMMAND_AHEAD, moved && known ? ahead : 0.0, rules->sensors_ahead, 0.0);
    check_max(j, DDMON_COMMAND_ORDER, moved && known && j->has_command_stamp ? j->command_stamp - stamp : 0.0, 0.0,
              0.0);
    if (known && is_finite(stamp)) {
        j->command_stamp = stamp;
        j->has_command_stamp = 1;
    }
}

void ddmon_command(ddmon_judge *j, double now, double stamp, double v, double omega, double out[2])
{
    const ddmon_rules *rules = j->rules;
    const double twist[2] = {v, omega};
    int finite = is_finite(v) && is_finite(omega);
    advance_clock(j, now);
    judge_rule(j, DDMON_NOT_FINITE, 0.0, 0.0, !finite, 0.0);
    if (finite) {
        int moved = moves(rules, twist);
        int has_stamp = stamp != 0.0 && j->has_command_stamp && is_finite(stamp);
        double step = has_stamp ? stamp - j->command_stamp : j->now - j->command_at;
        step = j->commanded ? min_of(max_of(step, 0.0), MAX_STEP) : 0.0;
        double speed = v < 0.0 && rules->commands_v_reverse > 0.0 ? rules->commands_v_reverse : rules->commands_v;
        double turn =
            omega < 0.0 && rules->commands_omega_right > 0.0 ? rules->commands_omega_right : rules->commands_omega;
        check_max(j, DDMON_SPEED, absolute(v), speed * (1.0 + ROUNDING), 0.0);
        check_max(j, DDMON_YAW_RATE, absolute(omega), turn * (1.0 + ROUNDING), 0.0);
        judge_stamp(j, stamp, moved);
        judge_interval(j, moved);
        if (v == 0.0 && omega == 0.0) {
            /* A command of zero is always accepted. */
            j->followed[V] = j->followed[OMEGA] = 0.0;
            j->broken[DDMON_SLEW] = j->broken[DDMON_YAW_SLEW] = 0;
        } else
            judge_slew(j, twist, step);
        j->command[V] = v;
        j->command[OMEGA] = omega;
    }
    j->commanded = 1;
    j->command_at = j->now;
    if (j->verdict.rule == DDMON_NOTHING) {
        send(j, twist);
        judge_time(j);
    }
    if (j->verdict.rule != DDMON_NOTHING) {
        brake(j);
        send(j, (const double[2]){j->output[V], j->output[OMEGA]});
    }
    out[V] = j->output[V];
    out[OMEGA] = j->output[OMEGA];
}

int ddmon_tick(ddmon_judge *j, double now, double out[2])
{
    advance_clock(j, now);
    judge_time(j);
    if (j->verdict.rule == DDMON_NOTHING)
        return 0;
    brake(j);
    send(j, (const double[2]){j->output[V], j->output[OMEGA]});
    out[V] = j->output[V];
    out[OMEGA] = j->output[OMEGA];
    return 1;
}

ddmon_verdict ddmon_reset(ddmon_judge *j, double now)
{
    ddmon_verdict verdict = {DDMON_NOTHING, 0.0, 0.0, 0.0};
    double away[2] = {0.0, 0.0};
    advance_clock(j, now);
    verdict.at = j->now;
    /* A zero command ends violations by commands; all other rules must hold for the present measurements. */
    if (j->commanded && moves(j->rules, j->command) && j->now - j->command_at <= j->rules->commands_silence) {
        verdict.rule = DDMON_STILL_MOVED;
        return verdict;
    }
    const int measured[] = {DDMON_ANSWER_V,   DDMON_ANSWER_OMEGA, DDMON_GYRO_WHEELS,
                            DDMON_POSE_JUMPS, DDMON_POSE_TURNS,   DDMON_OUTSIDE};
    for (unsigned i = 0; i < sizeof measured / sizeof *measured; i++) {
        if (j->broken[measured[i]]) {
            verdict.rule = measured[i];
            verdict.value = j->value[verdict.rule];
            verdict.limit = j->limit[verdict.rule];
            return verdict;
        }
    }
    const struct {
        int rule, has;
        double stamp, limit;
    } ages[] = {{DDMON_ODOMETRY, j->has_odometry, j->odometry_stamp, j->rules->sensors_odometry_age},
                {DDMON_POSE, j->has_pose, j->pose_stamp, j->rules->sensors_pose_age},
                {DDMON_GYRO, j->has_gyro, j->gyro_stamp, j->rules->sensors_gyro_age}};
    for (int i = 0; i < 3; i++) {
        double age = j->now - (ages[i].has ? ages[i].stamp : j->start);
        if ((i == 0 || ages[i].limit > 0.0) && age > ages[i].limit) {
            verdict.rule = ages[i].rule;
            verdict.value = age;
            verdict.limit = ages[i].limit;
            return verdict;
        }
    }
    if (moves(j->rules, j->wheels)) {
        verdict.rule = DDMON_ANSWER_V;
        verdict.value = j->wheels[V];
        verdict.limit = j->rules->commands_standing_v;
        return verdict;
    }
    if (j->path && j->placed)
        compare_section(j, j->place, j->now - j->rules->returning_late, j->now + j->rules->returning_early, HUGE_VAL,
                        away);
    int lost = away[DISTANCE] > j->rules->returning_distance;
    memset(j->broken, 0, sizeof j->broken);
    memset(&j->verdict, 0, sizeof j->verdict);
    memset(j->high, 0, sizeof j->high);
    memset(j->low, 0, sizeof j->low);
    j->followed[V] = j->followed[OMEGA] = j->output[V] = j->output[OMEGA] = 0.0;
    j->command[V] = j->command[OMEGA] = 0.0;
    j->has_command_stamp = j->ways = j->commanded = j->sent = 0;
    j->slow_wheels = j->slow_gyro = 0.0;
    memset(j->unexplained, 0, sizeof j->unexplained);
    memset(j->crept, 0, sizeof j->crept);
    j->driven = j->away_for = 0.0;
    allow_return(j);
    j->pace = 0.5 * (j->rules->commands_slowest + j->rules->commands_quickest);
    if (lost) {
        j->path = 0;
        j->points = 0;
    }
    return verdict;
}

static const char *const MESSAGES[DDMON_RULES][2] = {
    [DDMON_NOTHING] = {"no violation", ""},
    [DDMON_NOT_FINITE] = {"a command is not finite", ""},
    [DDMON_SPEED] = {"a command is too fast", "m/s"},
    [DDMON_YAW_RATE] = {"a command turns too fast", "rad/s"},
    [DDMON_SLEW] = {"v of the commands jumps", "m/s"},
    [DDMON_YAW_SLEW] = {"omega of the commands jumps", "rad/s"},
    [DDMON_SILENT] = {"no command while the robot moves", "s"},
    [DDMON_SLOW] = {"the rate of commands is too low", "s"},
    [DDMON_FLOOD] = {"the rate of commands is too high", "s"},
    [DDMON_OLD_COMMAND] = {"a command is old", "s"},
    [DDMON_COMMAND_AHEAD] = {"the stamp of a command is in the future", "s"},
    [DDMON_COMMAND_ORDER] = {"the stamp of a command is older than the previous one", "s"},
    [DDMON_NOT_TO_MOVE] = {"the controller reports standstill, and commands motion", "s"},
    [DDMON_CREEPS] = {"the controller reports standstill, and the robot moves", "m"},
    [DDMON_TURNS_AT_REST] = {"the controller reports standstill, and the robot turns", "rad"},
    [DDMON_NO_REFERENCE] = {"the robot moves without a reference", ""},
    [DDMON_BAD_REFERENCE] = {"the reference jumps, is faster than the limits of commands, or is not finite", ""},
    [DDMON_STRAYS] = {"the robot is away from its path, late or early", "m"},
    [DDMON_OFF_PATH] = {"the robot is off its path", "m"},
    [DDMON_OFF_HEADING] = {"the heading of the robot differs from its path", "rad"},
    [DDMON_ODOMETRY] = {"odometry is old", "s"},
    [DDMON_POSE] = {"the pose is old", "s"},
    [DDMON_GYRO] = {"the yaw rate of the gyro is old", "s"},
    [DDMON_POSE_JUMPS] = {"poses and odometry disagree about the distance", "m"},
    [DDMON_POSE_TURNS] = {"poses and odometry disagree about the turn", "rad"},
    [DDMON_GYRO_WHEELS] = {"gyro and wheels disagree", "rad"},
    [DDMON_ANSWER_V] = {"the speed does not follow the commands", "m/s"},
    [DDMON_ANSWER_OMEGA] = {"the yaw rate does not follow the commands", "rad/s"},
    [DDMON_OUTSIDE] = {"another node commands the base or publishes an input", ""},
    [DDMON_CLOCK] = {"the clock was set back", "s"},
    [DDMON_STILL_MOVED] = {"commands still move the robot", ""},
};

const char *ddmon_words(int rule) { return rule >= 0 && rule < DDMON_RULES ? MESSAGES[rule][0] : "an unknown rule"; }

const char *ddmon_unit(int rule) { return rule >= 0 && rule < DDMON_RULES ? MESSAGES[rule][1] : ""; }
