#include <math.h>
#include <string.h>

#include "judge.h"

enum { V, OMEGA };
enum { BY_WHEELS, BY_GYRO };
enum { DISTANCE, HEADING };
enum { X, Y, THETA };

/* A mean over about so many commands says how they come. */
#define PACE_SHARE 0.05
/* Time that commands and tracks are kept apart, at most [s]. */
#define COMMAND_SPACING 0.004
#define TRACK_SPACING 0.015
/* A step is never longer for a slew [s]. */
#define LONGEST_STEP 1.0
/* Lags after which a robot has rolled out [-]. */
#define ROLL_OUT_LAGS 3.0
/* Two poses of a reference are further apart in time [s]. */
#define TINY 1e-9
/* Rounding of a sum of samples [-]. */
#define ROUNDING 1e-9

static double absolute(double x) { return x < 0.0 ? -x : x; }

static double larger(double a, double b) { return a > b ? a : b; }

static double smaller(double a, double b) { return a < b ? a : b; }

/* Also with compilers that take numbers for finite: by the bits of what is stored. */
static int is_finite(double x)
{
    volatile double difference = x - x;
    return difference == 0.0;
}

static double wrapped(double angle)
{
    return angle - 6.283185307179586 * floor(angle / 6.283185307179586 + 0.5);
}

static int moves(const ddmon_rules *rules, const double twist[2])
{
    return absolute(twist[V]) > rules->commands_standing_v || absolute(twist[OMEGA]) > rules->commands_standing_omega;
}

/* A rule as it is found now: one that is broken for longer than `lasting` stops the robot, the first for good. */
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

static void at_most(ddmon_judge *j, int rule, double value, double limit, double lasting)
{
    /* Values that are not finite break the rule, too. */
    judge_rule(j, rule, value, limit, !(value <= limit), lasting);
}

/* Time passes. Where the clock was set back, nothing that has a stamp means anything any more. */
static void go_on(ddmon_judge *j, double now)
{
    if (now >= j->now - j->rules->sensors_ahead) {
        j->now = larger(j->now, now);
        return;
    }
    judge_rule(j, DDMON_CLOCK, j->now - now, j->rules->sensors_ahead, 1, 0.0);
    if (!is_finite(now))
        return;
    j->now = j->began = j->answered = j->free_at = j->path_at = j->output_at = j->command_at = j->may_move_since = now;
    j->has_odometry = j->has_pose = j->has_gyro = j->placed = j->stamped = 0;
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
    j->now = j->began = now;
    j->may_move = -1;
    j->answered = j->free_at = j->path_at = now;
    j->pace = 0.5 * (rules->commands_slowest + rules->commands_quickest);
}

/* The robot may be away from its path and return; for how long, `away_for` bounds. */
static void let_return(ddmon_judge *j)
{
    j->returning = 1;
    j->away_at = j->now;
}

int ddmon_reference(ddmon_judge *j, double now, const ddmon_point *path, int points)
{
    const ddmon_rules *rules = j->rules;
    int sound = points >= 0;
    go_on(j, now);
    for (int k = 0; k < points && sound; k++) {
        const ddmon_point *p = path + k;
        sound = is_finite(p->t) && is_finite(p->x) && is_finite(p->y) && is_finite(p->theta);
        if (sound && k) {
            double time = p->t - p[-1].t, turn = absolute(wrapped(p->theta - p[-1].theta));
            sound = time > 0.0 && hypot(p->x - p[-1].x, p->y - p[-1].y) <= rules->commands_v * time + ROUNDING &&
                    turn <= rules->commands_omega * time + ROUNDING;
        }
    }
    j->path = sound && points ? path : 0;
    j->points = sound ? points : 0;
    /* It may begin away from the robot. */
    let_return(j);
    j->away_at = j->now - rules->path_lasting;
    judge_rule(j, DDMON_BAD_REFERENCE, 0.0, 0.0, !sound, 0.0);
    return sound;
}

/* A pose further along an arc. */
static void carry(double pose[3], double length, double turn)
{
    double middle = pose[THETA] + 0.5 * turn;
    pose[X] += length * cos(middle);
    pose[Y] += length * sin(middle);
    pose[THETA] += turn;
}

/* Share of a new value in one step of a first-order filter. */
static double share_of(double step, double time) { return step / (time + step); }

/* Integrate the motion since the last odometry by wheels and gyro. */
static void sum_up(ddmon_judge *j, double stamp, double step, double v, double omega)
{
    double *sum = j->summed;
    int last = j->track_last;
    if (j->has_gyro && j->rules->sensors_gyro_age > 0.0)
        omega = j->gyro;
    carry(sum, v * step, omega * step);
    carry(j->place, v * step, omega * step);
    for (int i = 0; i < 3; i++)
        j->unexplained[i] -= share_of(step, j->rules->agreement_window) * j->unexplained[i];
    j->driven += absolute(v) * step - share_of(step, j->rules->agreement_window) * j->driven;
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

/* Motion summed up to an instant; 0 where it is not known any more. */
static int summed_at(const ddmon_judge *j, double t, double sum[3])
{
    for (int back = 0; back < j->tracks; back++) {
        int k = (j->track_last - back + DDMON_TRACK) % DDMON_TRACK;
        if (j->track_at[k] > t + ROUNDING)
            continue;
        int next = (k + 1) % DDMON_TRACK;
        double share = back ? (t - j->track_at[k]) / (j->track_at[next] - j->track_at[k]) : 0.0;
        for (int i = 0; i < 3; i++)
            sum[i] = j->track[i][k] + (back ? share * (j->track[i][next] - j->track[i][k]) : 0.0);
        return 1;
    }
    return 0;
}

/* Judge the response to commands. Its bounds rise with pending commands at once, and fall with the slowest lag. */
static void judge_response(ddmon_judge *j, int channel, int by, double measured, int rule)
{
    const ddmon_rules *rules = j->rules;
    double lag = channel == V ? rules->answer_lag_v : rules->answer_lag_omega;
    double gain = channel == V ? rules->answer_gain_v : rules->answer_gain_omega;
    double margin = channel == V ? rules->answer_margin_v : rules->answer_margin_omega;
    double step = smaller(larger(j->now - j->answered, 0.0), LONGEST_STEP), most = 0.0, least = 0.0;
    for (int back = 0; back < j->ways; back++) {
        int k = (j->way - back + DDMON_COMMANDS) % DDMON_COMMANDS;
        most = larger(most, gain * j->way_most[channel][k]);
        least = smaller(least, gain * j->way_least[channel][k]);
        if (j->way_at[k] < j->now - rules->answer_dead_time)
            break; /* it held until the next one came */
    }
    double *high = &j->high[by][channel], *low = &j->low[by][channel], fall = share_of(step, lag);
    *high = most > *high ? most : *high + fall * (most - *high);
    *low = least < *low ? least : *low + fall * (least - *low);
    int above = measured > *high + margin, below = measured < *low - margin;
    judge_rule(j, rule, measured, above ? *high + margin : *low - margin, above || below, rules->answer_lasting);
}

static void judge_answer(ddmon_judge *j)
{
    int gyro = j->has_gyro && j->rules->sensors_gyro_age > 0.0;
    double standing = j->rules->commands_standing_v;
    if (!j->sent || absolute(j->output[V]) <= standing || absolute(j->wheels[V]) > standing)
        j->free_at = j->now;
    judge_response(j, V, BY_WHEELS, j->wheels[V], DDMON_ANSWER_V);
    judge_response(j, OMEGA, gyro ? BY_GYRO : BY_WHEELS, gyro ? j->gyro : j->wheels[OMEGA], DDMON_ANSWER_OMEGA);
    j->answered = j->now;
}

/* Return 1 for a usable stamp: it is not in the future, and newer than the last. */
static int usable(const ddmon_judge *j, double stamp, int known, double last)
{
    return is_finite(stamp) && stamp <= j->now + j->rules->sensors_ahead && (!known || stamp > last);
}

/* Turns of gyro and wheels, both through the same filter of the window's length. */
static void compare_gyro(ddmon_judge *j, double step)
{
    const ddmon_rules *rules = j->rules;
    double window = rules->agreement_window, share = share_of(step, window);
    if (!(j->has_gyro && rules->sensors_gyro_age > 0.0))
        return;
    j->slow_wheels += share * (j->wheels[OMEGA] - j->slow_wheels);
    j->slow_gyro += share * (j->gyro - j->slow_gyro);
    double turn = window * j->slow_gyro, most = window * rules->agreement_gyro_gain * j->slow_wheels;
    double least = window * rules->agreement_gyro_least * j->slow_wheels;
    double top = larger(most, least) + rules->agreement_gyro_turn;
    double bottom = smaller(most, least) - rules->agreement_gyro_turn;
    judge_rule(j, DDMON_GYRO_WHEELS, turn, turn > top ? top : bottom, turn > top || turn < bottom,
               rules->agreement_lasting);
}

/* Update the place of the robot: wheels and gyro move it, and poses correct it. Corrections within the window are motion
   that wheels and gyro do not explain: something else moved the robot, or they contradict the poses. */
static void correct_place(ddmon_judge *j, double step)
{
    const ddmon_rules *rules = j->rules;
    double then[3], current[3] = {j->pose[X], j->pose[Y], j->pose[THETA]}, *unexplained = j->unexplained;
    if (summed_at(j, j->pose_stamp, then)) {
        double turned = j->pose[THETA] - then[THETA], c = cos(turned), s = sin(turned);
        double x = j->summed[X] - then[X], y = j->summed[Y] - then[Y];
        current[X] += c * x - s * y;
        current[Y] += s * x + c * y;
        current[THETA] += j->summed[THETA] - then[THETA];
    }
    if (!j->placed)
        memcpy(j->place, current, sizeof current);
    j->placed = 1;
    for (int i = 0; i < 3; i++) {
        double apart = i == THETA ? wrapped(current[i] - j->place[i]) : current[i] - j->place[i];
        double correction = share_of(step, rules->agreement_blend) * apart;
        current[i] = unexplained[i] + apart; /* also what is not corrected yet */
        j->place[i] += correction;
        unexplained[i] += correction;
    }
    at_most(j, DDMON_POSE_JUMPS, hypot(current[X], current[Y]),
            rules->agreement_distance + rules->agreement_distance_share * j->driven, rules->agreement_lasting);
    at_most(j, DDMON_POSE_TURNS, absolute(current[THETA]), rules->agreement_turn, rules->agreement_lasting);
}

/* Motion of the wheels while the controller says that it stands, once the robot has rolled out. Poses may jump and a gyro
   drifts; wheels at rest do neither. */
static void judge_rest(ddmon_judge *j, double step)
{
    const ddmon_rules *rules = j->rules;
    double moved_at = smaller(j->moved_at, j->may_move_since + rules->commands_stop_within);
    double lag = larger(rules->answer_lag_v, rules->answer_lag_omega);
    int rolled_out = j->now - moved_at > rules->answer_dead_time + ROLL_OUT_LAGS * lag;
    for (int i = 0; i < 2; i++)
        j->crept[i] = j->rests && rolled_out ? j->crept[i] + step * j->wheels[i] : 0.0;
    at_most(j, DDMON_CREEPS, absolute(j->crept[V]), rules->commands_rest_distance, 0.0);
    at_most(j, DDMON_TURNS_AT_REST, absolute(j->crept[OMEGA]), rules->commands_rest_turn, 0.0);
}

void ddmon_odometry(ddmon_judge *j, double now, double stamp, double v, double omega, double x, double y, double theta)
{
    go_on(j, now);
    if (!(usable(j, stamp, j->has_odometry, j->odometry_stamp) && is_finite(v) && is_finite(omega) && is_finite(x) &&
          is_finite(y) && is_finite(theta)))
        return; /* it ages */
    double step = j->has_odometry ? smaller(larger(stamp - j->odometry_stamp, 0.0), LONGEST_STEP) : 0.0;
    sum_up(j, stamp, step, v, omega);
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
    judge_answer(j);
    compare_gyro(j, step);
    judge_rest(j, step);
}

void ddmon_gyro(ddmon_judge *j, double now, double stamp, double omega)
{
    go_on(j, now);
    if (!(usable(j, stamp, j->has_gyro, j->gyro_stamp) && is_finite(omega)))
        return;
    j->has_gyro = 1;
    j->gyro_stamp = stamp;
    j->gyro = omega;
}

void ddmon_pose(ddmon_judge *j, double now, double stamp, double x, double y, double theta)
{
    go_on(j, now);
    if (!(j->rules->sensors_pose_age > 0.0 && usable(j, stamp, j->has_pose, j->pose_stamp) && is_finite(x) && is_finite(y) && is_finite(theta)))
        return;
    double step = j->has_pose ? smaller(stamp - j->pose_stamp, LONGEST_STEP) : 0.0;
    j->has_pose = 1;
    j->pose_stamp = stamp;
    j->pose[X] = x;
    j->pose[Y] = y;
    j->pose[THETA] = theta;
    correct_place(j, step);
}

void ddmon_says(ddmon_judge *j, double now, int drives)
{
    go_on(j, now);
    if (j->may_move != drives)
        j->may_move_since = j->now;
    /* The reference moved on while the robot stood, until the controller publishes it again. */
    if (j->may_move == 0 && drives)
        let_return(j);
    /* A robot that has not driven yet may be pushed to its place. */
    if (drives || j->may_move == 1)
        j->rests = !drives;
    j->may_move = drives;
}

void ddmon_outside(ddmon_judge *j, double now, int wrong)
{
    go_on(j, now);
    judge_rule(j, DDMON_OUTSIDE, 0.0, 0.0, wrong, 0.0);
}

/* Compute the distance of a pose from the stretch of path that the reference covers from `start` to `end`, and its angle to
   the headings of the part within `close`. */
static void compare_stretch(const ddmon_judge *j, const double pose[3], double start, double end, double close, double away[2])
{
    const ddmon_point *path = j->path;
    int last = j->points - 1;
    double heading = HUGE_VAL;
    away[DISTANCE] = HUGE_VAL;
    /* Before its first and after its last pose the reference rests there. */
    start = smaller(start, path[last].t);
    end = larger(end, path[0].t);
    for (int k = 0; k <= last; k++) {
        const ddmon_point *p = path + k, *q = path + (k < last ? k + 1 : k);
        if (q->t < start || p->t > end)
            continue;
        /* the part between both ends that is due in that time */
        double time = larger(q->t - p->t, TINY), from = larger((start - p->t) / time, 0.0);
        double to = smaller((end - p->t) / time, 1.0), dx = q->x - p->x, dy = q->y - p->y;
        double length = dx * dx + dy * dy, turn = wrapped(q->theta - p->theta) * (to - from);
        double share = length > 0.0 ? ((pose[X] - p->x) * dx + (pose[Y] - p->y) * dy) / length : 0.0;
        share = smaller(larger(share, from), to);
        double distance = hypot(pose[X] - p->x - share * dx, pose[Y] - p->y - share * dy);
        away[DISTANCE] = smaller(away[DISTANCE], distance);
        if (distance <= close) {
            /* from the arc of headings between the two */
            double off = wrapped(pose[THETA] - p->theta - wrapped(q->theta - p->theta) * 0.5 * (from + to));
            heading = smaller(heading, larger(absolute(off) - 0.5 * absolute(turn), 0.0));
        }
    }
    away[HEADING] = heading < HUGE_VAL ? heading : 0.0;
}

/* Predict the place of rest if the robot braked now; it may still accelerate to the sent command. Returns the time to that
   place at the present speed without braking, by which the reference may be late there. */
static double place_at_rest(const ddmon_judge *j, double rest[3])
{
    int gyro = j->has_gyro && j->rules->sensors_gyro_age > 0.0;
    double sent = j->sent ? j->output[V] : 0.0, v = absolute(sent) > absolute(j->wheels[V]) ? sent : j->wheels[V];
    double time = j->rules->path_reaction + 0.5 * absolute(v) / j->rules->commands_v_braking;
    memcpy(rest, j->place, sizeof j->place);
    carry(rest, v * time, time * (gyro ? j->gyro : j->wheels[OMEGA]));
    return time;
}

/* The robot is near its path and on time: now, and where it would stand if it braked now. Motion that neither wheels nor
   gyro explain is no fault of the controller: that is allowed for. A robot may return for a limited time where something
   moved it, where it does not move though it is told to, where it stood, and where its reference begins elsewhere. */
static void judge_path(ddmon_judge *j)
{
    const ddmon_rules *rules = j->rules;
    int moved = j->sent && moves(rules, j->output), bound = j->path && j->placed && (moved || j->may_move == 1);
    double away[2] = {0.0, 0.0}, ahead[2] = {0.0, 0.0}, rest[3], step = smaller(j->now - j->path_at, LONGEST_STEP);
    double unexplained = hypot(j->unexplained[X], j->unexplained[Y]);
    j->path_at = j->now;
    judge_rule(j, DDMON_NO_REFERENCE, 0.0, 0.0, moved && !j->path, rules->path_grace);
    if (bound) {
        compare_stretch(j, j->place, j->now - rules->path_late, j->now + rules->path_early, rules->path_distance, away);
        int elsewhere = away[DISTANCE] > rules->path_distance;
        int held = j->now - j->free_at > rules->answer_dead_time + rules->answer_lasting;
        if (elsewhere && (held || unexplained > rules->path_distance))
            let_return(j);
        if (elsewhere)
            j->away_at = j->now;
        /* Time elsewhere counts up, time near its path down: a robot that does not return has used up its time,
           whatever moves it or is sent to it meanwhile. */
        if (!elsewhere || j->away_for <= rules->returning_within)
            j->away_for = larger(j->away_for + (elsewhere ? step : -step), 0.0);
        if (j->now - j->away_at >= rules->path_lasting || j->away_for > rules->returning_within)
            j->returning = 0;
        double time = place_at_rest(j, rest), late = j->returning ? rules->returning_late : rules->path_late;
        double early = j->returning ? rules->returning_early : rules->path_early;
        compare_stretch(j, rest, j->now - late, j->now + time + early, HUGE_VAL, ahead);
    }
    int strict = bound && !j->returning;
    double far = strict ? rules->path_far + unexplained : rules->returning_distance;
    at_most(j, DDMON_STRAYS, strict ? away[DISTANCE] : 0.0, rules->path_distance, rules->path_lasting);
    at_most(j, DDMON_OFF_PATH, ahead[DISTANCE], far, rules->path_far_lasting);
    at_most(j, DDMON_OFF_HEADING, strict ? away[HEADING] : 0.0, rules->path_heading, rules->path_far_lasting);
}

static void judge_ages(ddmon_judge *j)
{
    const ddmon_rules *rules = j->rules;
    int moved = j->sent && moves(rules, j->output);
    double odometry = j->now - (j->has_odometry ? j->odometry_stamp : j->began);
    double pose = j->now - (j->has_pose ? j->pose_stamp : j->began);
    double gyro = j->now - (j->has_gyro ? j->gyro_stamp : j->began);
    at_most(j, DDMON_ODOMETRY, moved ? odometry : 0.0, rules->sensors_odometry_age, 0.0);
    at_most(j, DDMON_POSE, moved && rules->sensors_pose_age > 0.0 ? pose : 0.0, rules->sensors_pose_age, 0.0);
    at_most(j, DDMON_GYRO, moved && rules->sensors_gyro_age > 0.0 ? gyro : 0.0, rules->sensors_gyro_age, 0.0);
}

/* Everything that goes wrong by itself as time passes. */
static void judge_time(ddmon_judge *j)
{
    const ddmon_rules *rules = j->rules;
    int moved = j->sent && moves(rules, j->output), latched = j->verdict.rule != DDMON_NOTHING;
    if (latched)
        moved = 0;
    at_most(j, DDMON_SILENT, moved ? j->now - j->command_at : 0.0, rules->commands_silence, 0.0);
    int must_stand = j->may_move == 0 && j->now - j->may_move_since > rules->commands_stop_within;
    judge_rule(j, DDMON_NOT_TO_MOVE, j->now - j->may_move_since, rules->commands_stop_within, moved && must_stand, rules->path_grace);
    judge_ages(j);
    judge_path(j);
}

/* Compute the command after a violation: zero, at the braking limits if commands still have their normal effect. */
static void brake(ddmon_judge *j)
{
    const ddmon_rules *rules = j->rules;
    double step = smaller(larger(j->now - j->output_at, 0.0), LONGEST_STEP);
    double slew[2] = {rules->commands_v_braking * step, rules->commands_omega_braking * step};
    int rule = j->verdict.rule;
    int meant = rule != DDMON_ANSWER_V && rule != DDMON_ANSWER_OMEGA && rule != DDMON_GYRO_WHEELS &&
                rule != DDMON_ODOMETRY && rule != DDMON_OUTSIDE;
    for (int i = 0; i < 2; i++) {
        double left = meant ? larger(absolute(j->output[i]) - slew[i], 0.0) : 0.0;
        j->output[i] = j->output[i] < 0.0 ? -left : left;
    }
    j->output_at = j->now;
}

/* Send a command; it stays pending until the longest dead time has passed. */
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
        j->way_most[i][k] = larger(j->way_most[i][k], twist[i]);
        j->way_least[i][k] = smaller(j->way_least[i][k], twist[i]);
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
        int smaller_one = twist[i] * *followed >= 0.0 && absolute(twist[i]) < absolute(*followed);
        double slew = smaller_one ? larger(away[i], towards[i]) : away[i], most = slew * step;
        *followed += smaller(larger(change, -most), most);
        at_most(j, i == V ? DDMON_SLEW : DDMON_YAW_SLEW, absolute(twist[i] - *followed), slew * rules->commands_jitter,
                0.0);
    }
}

/* Judge the rate of commands: high enough while the robot moves, and never a flood. */
static void judge_pace(ddmon_judge *j, int moved)
{
    const ddmon_rules *rules = j->rules;
    if (j->commanded && j->sent && moves(rules, j->output))
        j->pace += PACE_SHARE * (smaller(j->now - j->command_at, LONGEST_STEP) - j->pace);
    else
        j->pace = 0.5 * (rules->commands_slowest + rules->commands_quickest);
    at_most(j, DDMON_SLOW, moved ? j->pace : 0.0, rules->commands_slowest, 0.0);
    judge_rule(j, DDMON_FLOOD, j->pace, rules->commands_quickest, j->pace < rules->commands_quickest, 0.0);
}

static void judge_stamp(ddmon_judge *j, double stamp, int moved)
{
    const ddmon_rules *rules = j->rules;
    int known = stamp != 0.0;
    double ahead = known ? stamp - j->now : 0.0;
    at_most(j, DDMON_OLD_COMMAND, moved && known ? -ahead : 0.0, rules->commands_oldest, 0.0);
    at_most(j, DDMON_COMMAND_AHEAD, moved && known ? ahead : 0.0, rules->sensors_ahead, 0.0);
    at_most(j, DDMON_COMMAND_ORDER, moved && known && j->stamped ? j->command_stamp - stamp : 0.0, 0.0, 0.0);
    if (known && is_finite(stamp)) {
        j->command_stamp = stamp;
        j->stamped = 1;
    }
}

void ddmon_command(ddmon_judge *j, double now, double stamp, double v, double omega, double out[2])
{
    const ddmon_rules *rules = j->rules;
    const double twist[2] = {v, omega};
    int finite = is_finite(v) && is_finite(omega);
    go_on(j, now);
    judge_rule(j, DDMON_NOT_FINITE, 0.0, 0.0, !finite, 0.0);
    if (finite) {
        int moved = moves(rules, twist);
        int has_stamp = stamp != 0.0 && j->stamped && is_finite(stamp);
        double step = has_stamp ? stamp - j->command_stamp : j->now - j->command_at;
        step = j->commanded ? smaller(larger(step, 0.0), LONGEST_STEP) : 0.0;
        double speed = v < 0.0 && rules->commands_v_reverse > 0.0 ? rules->commands_v_reverse : rules->commands_v;
        double turn = omega < 0.0 && rules->commands_omega_right > 0.0 ? rules->commands_omega_right : rules->commands_omega;
        at_most(j, DDMON_SPEED, absolute(v), speed * (1.0 + ROUNDING), 0.0);
        at_most(j, DDMON_YAW_RATE, absolute(omega), turn * (1.0 + ROUNDING), 0.0);
        judge_stamp(j, stamp, moved);
        judge_pace(j, moved);
        if (v == 0.0 && omega == 0.0) {
            /* To stand is never refused, however suddenly. */
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
    go_on(j, now);
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
    ddmon_verdict wrong = {DDMON_NOTHING, 0.0, 0.0, 0.0};
    double away[2] = {0.0, 0.0};
    go_on(j, now);
    wrong.at = j->now;
    /* Violations by commands end with commands of zero; all other rules must hold for the present measurements. */
    if (j->commanded && moves(j->rules, j->command) && j->now - j->command_at <= j->rules->commands_silence) {
        wrong.rule = DDMON_STILL_MOVED;
        return wrong;
    }
    const int measured[] = {DDMON_ANSWER_V, DDMON_ANSWER_OMEGA, DDMON_GYRO_WHEELS, DDMON_POSE_JUMPS, DDMON_POSE_TURNS,
                            DDMON_OUTSIDE};
    for (unsigned i = 0; i < sizeof measured / sizeof *measured; i++) {
        if (j->broken[measured[i]]) {
            wrong.rule = measured[i];
            wrong.value = j->value[wrong.rule];
            wrong.limit = j->limit[wrong.rule];
            return wrong;
        }
    }
    const struct {
        int rule, has;
        double stamp, most;
    } ages[] = {{DDMON_ODOMETRY, j->has_odometry, j->odometry_stamp, j->rules->sensors_odometry_age},
                {DDMON_POSE, j->has_pose, j->pose_stamp, j->rules->sensors_pose_age},
                {DDMON_GYRO, j->has_gyro, j->gyro_stamp, j->rules->sensors_gyro_age}};
    for (int i = 0; i < 3; i++) {
        double age = j->now - (ages[i].has ? ages[i].stamp : j->began);
        if ((i == 0 || ages[i].most > 0.0) && age > ages[i].most) {
            wrong.rule = ages[i].rule;
            wrong.value = age;
            wrong.limit = ages[i].most;
            return wrong;
        }
    }
    if (moves(j->rules, j->wheels)) {
        wrong.rule = DDMON_ANSWER_V;
        wrong.value = j->wheels[V];
        wrong.limit = j->rules->commands_standing_v;
        return wrong;
    }
    if (j->path && j->placed)
        compare_stretch(j, j->place, j->now - j->rules->returning_late, j->now + j->rules->returning_early, HUGE_VAL, away);
    int lost = away[DISTANCE] > j->rules->returning_distance;
    memset(j->broken, 0, sizeof j->broken);
    memset(&j->verdict, 0, sizeof j->verdict);
    memset(j->high, 0, sizeof j->high);
    memset(j->low, 0, sizeof j->low);
    j->followed[V] = j->followed[OMEGA] = j->output[V] = j->output[OMEGA] = 0.0;
    j->command[V] = j->command[OMEGA] = 0.0;
    j->stamped = j->ways = j->commanded = j->sent = 0;
    j->slow_wheels = j->slow_gyro = 0.0;
    memset(j->unexplained, 0, sizeof j->unexplained);
    memset(j->crept, 0, sizeof j->crept);
    j->driven = j->away_for = 0.0;
    let_return(j);
    j->pace = 0.5 * (j->rules->commands_slowest + j->rules->commands_quickest);
    if (lost) {
        j->path = 0;
        j->points = 0;
    }
    return wrong;
}

static const char *const WORDS[DDMON_RULES][2] = {
    [DDMON_NOTHING] = {"all is well", ""},
    [DDMON_NOT_FINITE] = {"a command is not finite", ""},
    [DDMON_SPEED] = {"a command is too fast", "m/s"},
    [DDMON_YAW_RATE] = {"a command turns too fast", "rad/s"},
    [DDMON_SLEW] = {"v of the commands jumps", "m/s"},
    [DDMON_YAW_SLEW] = {"omega of the commands jumps", "rad/s"},
    [DDMON_SILENT] = {"no command while the robot is moved", "s"},
    [DDMON_SLOW] = {"commands come too rarely", "s"},
    [DDMON_FLOOD] = {"commands come too often", "s"},
    [DDMON_OLD_COMMAND] = {"a command is old", "s"},
    [DDMON_COMMAND_AHEAD] = {"the stamp of a command is in the future", "s"},
    [DDMON_COMMAND_ORDER] = {"a command is older than the one before", "s"},
    [DDMON_NOT_TO_MOVE] = {"the controller says that it stands, and commands motion", "s"},
    [DDMON_CREEPS] = {"the controller says that it stands, and the robot moves", "m"},
    [DDMON_TURNS_AT_REST] = {"the controller says that it stands, and the robot turns", "rad"},
    [DDMON_NO_REFERENCE] = {"the robot is moved without a reference", ""},
    [DDMON_BAD_REFERENCE] = {"the reference jumps, is faster than commands may be, or is not finite", ""},
    [DDMON_STRAYS] = {"the robot is beside its path, late or early", "m"},
    [DDMON_OFF_PATH] = {"the robot is off its path", "m"},
    [DDMON_OFF_HEADING] = {"the robot heads elsewhere than its path", "rad"},
    [DDMON_ODOMETRY] = {"odometry is old", "s"},
    [DDMON_POSE] = {"the pose is old", "s"},
    [DDMON_GYRO] = {"the yaw rate of the gyro is old", "s"},
    [DDMON_POSE_JUMPS] = {"poses and odometry disagree about the way", "m"},
    [DDMON_POSE_TURNS] = {"poses and odometry disagree about the turn", "rad"},
    [DDMON_GYRO_WHEELS] = {"gyro and wheels disagree", "rad"},
    [DDMON_ANSWER_V] = {"the robot does not drive as it is told", "m/s"},
    [DDMON_ANSWER_OMEGA] = {"the robot does not turn as it is told", "rad/s"},
    [DDMON_OUTSIDE] = {"somebody else commands the base or shares an input", ""},
    [DDMON_CLOCK] = {"the clock went back", "s"},
    [DDMON_STILL_MOVED] = {"commands still move the robot", ""},
};

const char *ddmon_words(int rule) { return rule >= 0 && rule < DDMON_RULES ? WORDS[rule][0] : "an unknown rule"; }

const char *ddmon_unit(int rule) { return rule >= 0 && rule < DDMON_RULES ? WORDS[rule][1] : ""; }
