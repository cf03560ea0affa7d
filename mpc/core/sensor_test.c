/* The sensor test distinguishes a faulty sensor from an unusual but honest motion. With each pose it compares, over windows
 * of time, the motions according to poses, wheels, gyro and commands with hypotheses. The honest ones: all sensors agree
 * within the effects of slip, slopes and loads; the wheels slip; the robot is held. One for each sensor: all others agree.
 * A sensor is no longer used once its hypothesis has been more likely than every honest one, by odds that follow from the
 * permitted rate of false alarms. */
#include <string.h>

#include "internal.h"

enum { SHORT, MIDDLE, LONG, WINDOWS };
enum { BY_WHEELS = 1 << DDMPC_OF_WHEELS, BY_GYRO = 1 << DDMPC_OF_YAW_RATE, BY_POSE = 1 << DDMPC_OF_POSE, SENSES = 3 };
enum { ABSOLUTE, SHARE };

static real square(real x) { return x * x; }

/* Compute a gain from two sums. No robot has a gain below the minimum, or a negative one. */
static real quotient(const real sums[2]) { return ddmpc_max(sums[0] / sums[1], R(0.1)); }

/* Compute the variance of a difference that has an absolute part and a part proportional to `size`. */
static real variance(const real deviation[2], real size)
{
    return square(deviation[ABSOLUTE]) + square(deviation[SHARE] * size);
}

void ddmpc_monitor_clear(ddmpc_controller *c)
{
    ddmpc_monitor *m = &c->monitor;
    memset(m, 0, sizeof *m);
    m->wheels.heard = m->gyro.heard = m->slipped = m->stood = -HUGE_VAL;
    m->body_by_wheels[1] = m->body_by_model[1] = m->wheels_by_model[1] = c->constants->gains[0];
    m->body_by_wheels[0] = c->constants->gains[0] / c->constants->wheel_yaw_ratio;
    m->body_by_model[0] = c->constants->gains[0];
    m->wheels_by_model[0] = c->constants->gains[0] * c->constants->wheel_yaw_ratio;
    m->widest[0] = m->widest[1] = R(1.0);
}

/* Return the stored motion that is `ago` entries older than the newest. */
static ddmpc_motion *past(ddmpc_monitor *m, int ago) { return &m->path[(m->newest + MONITORED - ago) % MONITORED]; }

void ddmpc_monitor_predict(ddmpc_controller *c, const real *newest)
{
    ddmpc_monitor *m = &c->monitor;
    const real half = R(0.5) * (real)c->constants->sample_time;
    real state[DDMPC_MAX_STATES], before[2], after[2];
    if (!c->constants->monitor)
        return;
    ddmpc_velocity_output(c, m->state, before, 0);
    ddmpc_velocity_step(c, m->state, newest, 0, state, 0, 0);
    memcpy(m->state, state, (size_t)STATES(c) * sizeof(real));
    ddmpc_velocity_output(c, state, after, 0);
    m->now.sum[MODEL_DISTANCE] += half * (before[0] + after[0]);
    m->now.sum[MODEL_TURN] += half * (before[1] + after[1]);
}

static void hear(ddmpc_hearing *heard, ddmpc_time silence, ddmpc_time t, const real *value, int count)
{
    const int paused = t - heard->heard > silence;
    int same = 1;
    for (int i = 0; i < count; i++)
        same = same && value[i] == heard->value[i];
    if (paused)
        heard->since = t;
    if (!same || paused)
        heard->changed = t;
    heard->heard = t;
    memcpy(heard->value, value, (size_t)count * sizeof(real));
}

/* Return whether a reading contradicts the commands for any plausible gain. */
static int is_doubtful(const ddmpc_constants *k, real reading, real model)
{
    return ddmpc_fabs(reading - model) > k->doubtful[ABSOLUTE] + k->doubtful[SHARE] * ddmpc_fabs(model);
}

void ddmpc_monitor_count(ddmpc_controller *c, int subject, int impossible)
{
    real *count = &c->monitor.impossible[subject];
    *count = c->constants->impossible[1] * *count + (real)impossible;
}

/* Return whether a sensor has recently given physically impossible readings: then its other readings are wrong, too. */
static int is_impossible(const ddmpc_controller *c, int subject)
{
    return c->monitor.impossible[subject] > c->constants->impossible[0];
}

int ddmpc_monitor_doubts(const ddmpc_controller *c, ddmpc_time t)
{
    const ddmpc_constants *k = c->constants;
    const ddmpc_monitor *m = &c->monitor;
    const ddmpc_time silence = (ddmpc_time)k->silence;
    real model[2];
    if (!k->monitor || t - m->stood <= R(2.0) * (ddmpc_time)k->windows[SHORT])
        return 0;
    ddmpc_velocity_output(c, m->state, model, 0);
    const real wheel_turn = quotient(m->wheels_by_model) * model[1], body_turn = quotient(m->body_by_model) * model[1];
    const int wheels = is_doubtful(k, m->wheels.value[0], model[0]) || is_doubtful(k, m->wheels.value[1], wheel_turn);
    const int gyro = is_doubtful(k, m->gyro.value[0], body_turn);
    const int wheels_repeat = t - m->wheels.heard <= silence && t - m->wheels.changed > silence;
    const int gyro_repeats = t - m->gyro.heard <= silence && t - m->gyro.changed > silence;
    /* The wheels turn as commanded, and the gyro has shown the opposite sign throughout. */
    const int gyro_opposes = m->turning[1] > k->gyro[ABSOLUTE] && m->turning[0] < R(-0.5) * m->turning[1];
    return ((wheels && wheels_repeat) || is_impossible(c, DDMPC_OF_WHEELS) ? BY_WHEELS : 0) |
           ((gyro && gyro_repeats) || gyro_opposes || is_impossible(c, DDMPC_OF_YAW_RATE) ? BY_GYRO : 0);
}

/* Subtract the present value of a sum from all its copies, so that single precision stays accurate. */
static void rebase(ddmpc_monitor *m, int i)
{
    if (!isfinite(m->now.sum[i])) {
        /* The sums are lost, and with them everything that was learned from them. */
        m->now.sum[i] = R(0.0);
        m->moves = m->poses = m->residuals = m->has_last = m->anchored = 0;
        m->apart = m->witness = m->settled = m->fits = m->turning[0] = m->turning[1] = R(0.0);
        memset(m->slip, 0, sizeof m->slip);
        memset(m->spread, 0, sizeof m->spread);
        memset(m->went, 0, sizeof m->went);
        return;
    }
    /* The heading loses whole turns only, because positions were summed up along it. */
    const real turn = R(2.0) * DDMPC_PI, off = i == HEADING ? turn * ddmpc_rint(m->now.sum[i] / turn) : m->now.sum[i];
    m->now.sum[i] -= off;
    m->frozen.sum[i] -= off;
    m->last_motion.sum[i] -= off;
    for (int k = 0; k < MONITORED; k++)
        m->path[k].sum[i] -= off;
    for (int k = 0; k < MONITORED_POSES; k++)
        m->pose[k].then.sum[i] -= off;
}

void ddmpc_monitor_move(ddmpc_controller *c, ddmpc_time t, const ddmpc_checked_twist *twist, int wheels, int twists)
{
    ddmpc_monitor *m = &c->monitor;
    const ddmpc_constants *k = c->constants;
    const real before[3] = {m->wheels.value[0], m->wheels.value[1], m->gyro.value[0]};
    const ddmpc_time silence = (ddmpc_time)k->silence;
    if (!k->monitor)
        return;
    if (wheels) {
        const real values[2] = {twist[0].value, twist[1].value};
        hear(&m->wheels, silence, t, values, 2);
    }
    if (twists > wheels)
        hear(&m->gyro, silence, t, &twist[wheels].value, 1);
    if (m->moves == 0)
        m->now.time = t;
    const real dt = (real)(t - m->now.time);
    if (m->moves > 0 && !(dt > R(0.0)))
        return;
    const real *newest = ddmpc_estimator_slip(c);
    const real share = m->moves > 0 ? ddmpc_min(dt / k->memory, R(1.0)) : R(1.0);
    for (int i = 0; i < SLIPS(c); i++)
        m->slip[i] += share * (newest[i] - m->slip[i]);
    const real *slip = m->slip, speed = R(0.5) * (before[0] + m->wheels.value[0]);
    const real wheel_turn = R(0.5) * dt * (before[1] + m->wheels.value[1]);
    const real gyro_turn = R(0.5) * dt * (before[2] + m->gyro.value[0]);
    /* The heading follows the gyro, or the wheels without one. */
    const int silent = t - m->gyro.heard > silence || (m->accused & BY_GYRO);
    const real turn = silent ? quotient(m->body_by_wheels) * wheel_turn : gyro_turn;
    real *sum = m->now.sum;
    if (dt > R(0.0)) {
        /* The slide of the floor is known in the frame of the poses: compute the motion there, then rotate it into the frame of
         * the sums. */
        const real theta = newest[POSE(c) + 2], rest = R(0.0), turned = sum[HEADING] - theta;
        const real model[2] = {speed - slip[V_OFFSET], turn / (dt * slip[OMEGA_GAIN] * slip[YAW_GAIN])};
        const real cosine = ddmpc_cos(turned), sine = ddmpc_sin(turned), *arguments[5] = {model, slip, &theta, &rest, &dt};
        real moved[3], *results[2] = {moved, 0};
        WITH_SLIP(c, move)(arguments, results, 0, 0, 0);
        sum[FORWARD] += cosine * moved[0] - sine * moved[1];
        sum[LEFT] += sine * moved[0] + cosine * moved[1];
    }
    real model_now[2];
    ddmpc_velocity_output(c, m->state, model_now, 0);
    if (m->wheels.value[1] * model_now[1] > R(0.0)) {
        const real left = ddmpc_max(R(1.0) - dt / k->memory, R(0.0)), both = m->gyro.value[0] * m->wheels.value[1];
        m->turning[0] = left * m->turning[0] + dt * both;
        m->turning[1] = left * m->turning[1] + dt * ddmpc_fabs(both);
    }
    sum[HEADING] += turn;
    sum[WHEEL_DISTANCE] += speed * dt;
    sum[WHEEL_TURN] += wheel_turn;
    sum[GYRO_TURN] += gyro_turn;
    sum[TURNED] += ddmpc_fabs(turn);
    m->now.time = t;
    const ddmpc_time reach = (ddmpc_time)(k->windows[LONG] + k->pose_spacing + k->latest + k->stamp_history);
    if (m->moves == 0 || t - past(m, 0)->time >= reach / (MONITORED - 2)) {
        m->newest = (m->newest + 1) % MONITORED;
        m->moves += m->moves < MONITORED;
        *past(m, 0) = m->now;
    }
    for (int i = 0; i < MOTIONS; i++)
        /* The negated comparison is also true for NaN, which must be removed. */
        if (!(ddmpc_fabs(sum[i]) <= k->far))
            rebase(m, i);
}

/* Interpolate the motion up to `time` between the stored instants; return 0 if they do not reach back so far. */
static int motion_at(ddmpc_monitor *m, ddmpc_time time, ddmpc_motion *motion)
{
    /* The newest instant that is not later than `time` lies between `low` and `high`. */
    int low = 0, high = m->moves - 1;
    if (high < 0)
        return 0;
    if (past(m, high)->time > time) {
        /* The robot was at rest before the first instant. */
        *motion = *past(m, high);
        motion->time = time;
        return m->moves < MONITORED;
    }
    /* The range is halved: seven rounds for MONITORED instants. */
    while (low < high) {
        const int middle = (low + high) / 2;
        if (past(m, middle)->time <= time)
            high = middle;
        else
            low = middle + 1;
    }
    const ddmpc_motion *before = past(m, low), *after = low > 0 ? past(m, low - 1) : &m->now;
    const ddmpc_time length = after->time - before->time;
    const real share = length > 0.0 ? ddmpc_min((real)((time - before->time) / length), R(1.0)) : R(0.0);
    motion->time = time;
    for (int i = 0; i < MOTIONS; i++)
        motion->sum[i] = before->sum[i] + share * (after->sum[i] - before->sum[i]);
    return 1;
}

/* Motion between two instants according to each sensor, in the frame of the heading halfway. */
typedef struct {
    real pose, wheels, model;            /* forward [m], by wheels and commands with the slip known */
    real left;                           /* lateral motion of the pose beyond dead reckoning [m] */
    real pose_turn, wheel_turn, gyro_turn, model_turn; /* turns of the body, with the gains learned so far [rad] */
    real turned;                         /* sum of turns to both sides [rad] */
    real chord, way;                     /* chord over the distance travelled; that distance by the wheels [m] */
    real heading;                        /* heading of the pose halfway [rad] */
    real late[2];                        /* change of the commanded motion if wheels respond later than modelled [m, rad] */
} motions;

static motions compare(const ddmpc_monitor *m, const ddmpc_motion *from, const ddmpc_motion *to, const real before[3],
                       const real after[3])
{
    motions by;
    real sum[MOTIONS];
    by.late[0] = by.late[1] = R(0.0);
    for (int i = 0; i < MOTIONS; i++)
        sum[i] = to->sum[i] - from->sum[i];
    /* A robot may turn fully within a window: the gyro tells the number of whole turns. */
    by.pose_turn = sum[HEADING] + ddmpc_wrap(after[2] - before[2] - sum[HEADING]);
    by.gyro_turn = sum[GYRO_TURN];
    by.wheel_turn = quotient(m->body_by_wheels) * sum[WHEEL_TURN];
    by.model_turn = quotient(m->body_by_model) * sum[MODEL_TURN];
    by.turned = ddmpc_max(sum[TURNED], ddmpc_max(ddmpc_fabs(by.gyro_turn), ddmpc_fabs(by.model_turn)));
    by.heading = before[2] + R(0.5) * by.pose_turn;
    const real reckoned = from->sum[HEADING] + R(0.5) * sum[HEADING];
    const real cosine[2] = {ddmpc_cos(by.heading), ddmpc_cos(reckoned)};
    const real sine[2] = {ddmpc_sin(by.heading), ddmpc_sin(reckoned)};
    const real dx = after[0] - before[0], dy = after[1] - before[1];
    by.pose = cosine[0] * dx + sine[0] * dy;
    by.wheels = cosine[1] * sum[FORWARD] + sine[1] * sum[LEFT];
    by.left = cosine[0] * dy - sine[0] * dx - (cosine[1] * sum[LEFT] - sine[1] * sum[FORWARD]);
    by.chord = ddmpc_fabs(by.wheels) < ddmpc_fabs(sum[WHEEL_DISTANCE]) ? ddmpc_fabs(by.wheels / sum[WHEEL_DISTANCE]) : R(1.0);
    by.way = sum[WHEEL_DISTANCE];
    by.model = by.wheels + by.chord * (sum[MODEL_DISTANCE] - sum[WHEEL_DISTANCE]);
    return by;
}

/* Squared deviations of one window: for the fault of each sensor, and for the best honest hypothesis. */
typedef struct {
    real fault[SENSES];    /* remaining with a fault of each sensor */
    int slips;             /* 1 if the best honest hypothesis is slip or a held robot */
    real honest;           /* remaining with the best honest hypothesis */
} verdict;

/* Squared deviations that remain with each hypothesis in one direction, turning or driving. */
typedef struct {
    real usual, slip, held, fault[SENSES];
} left_over;

/* Evaluate the hypotheses in one direction: body by pose `P` and gyro `G`, wheels by encoders `W` and commands `M`. A
   variance below zero marks a silent sensor. `apart` is the variance between body and wheels, `follow` that between wheels
   and commands. */
static left_over explain(const real value[4], const real noise[4], real apart, real follow)
{
    enum { P, G, W, M };
    const int pose = noise[P] >= R(0.0), gyro = noise[G] >= R(0.0), wheels = noise[W] >= R(0.0);
    left_over left;
    memset(&left, 0, sizeof left);
    const real body_noise = pose && gyro ? noise[P] * noise[G] / (noise[P] + noise[G]) : pose ? noise[P] : noise[G];
    const real body = pose && gyro ? (value[P] * noise[G] + value[G] * noise[P]) / (noise[P] + noise[G]) : value[pose ? P : G];
    const real wheel = wheels ? value[W] : value[M], wheel_noise = wheels ? noise[W] : follow;
    const real of_body = pose && gyro ? square(value[P] - value[G]) / (noise[P] + noise[G]) : R(0.0);
    const real of_wheels = wheels ? square(value[W] - value[M]) / (noise[W] + follow) : R(0.0);
    const real between = square(body - wheel) / (apart + body_noise + wheel_noise);
    left.usual = of_body + of_wheels + between;
    left.slip = of_body + of_wheels;
    left.held = of_body + (wheels ? between : R(0.0));
    left.fault[DDMPC_OF_WHEELS] = of_body + square(body - value[M]) / (apart + body_noise + follow);
    left.fault[DDMPC_OF_YAW_RATE] = of_wheels + (pose ? square(value[P] - wheel) / (apart + noise[P] + wheel_noise) : R(0.0));
    left.fault[DDMPC_OF_POSE] = of_wheels + (gyro ? square(value[G] - wheel) / (apart + noise[G] + wheel_noise) : R(0.0));
    return left;
}

/* Evaluate the hypotheses in a window of `duration` [s] with the sensors in `heard`, and the pose. */
static verdict weigh(const ddmpc_constants *k, const ddmpc_monitor *m, const motions *by, int heard, const real noise[2],
                     real duration)
{
    const int wheels = heard & BY_WHEELS, gyro = heard & BY_GYRO;
    const real turned = ddmpc_max(ddmpc_fabs(by->gyro_turn), ddmpc_fabs(by->model_turn));
    const real gone = ddmpc_max(ddmpc_fabs(by->pose), ddmpc_fabs(by->model));
    const real gyro_noise = square(k->gyro[ABSOLUTE] * duration) + square(k->gyro[SHARE] * by->gyro_turn);
    const real turn[4] = {by->pose_turn, by->gyro_turn, by->wheel_turn, by->model_turn};
    const real turn_noise[4] = {square(noise[1]), gyro ? gyro_noise : R(-1.0), wheels ? R(0.0) : R(-1.0), R(0.0)};
    const real way[4] = {by->pose, R(0.0), by->wheels, by->model};
    const real way_noise[4] = {square(noise[0]), R(-1.0), wheels ? R(0.0) : R(-1.0), R(0.0)};
    /* Gains are known the better, the more the robot has turned. */
    const real unsure = square(k->gains[3] * turned) * k->gains[0];
    /* The two turns of an S do not cancel if one side slips more than the other. */
    const real both = square(k->uneven * (by->turned - turned));
    const real apart = variance(k->slip_turning, turned) + unsure / m->body_by_wheels[1] + both;
    const real follow = variance(k->following, turned) + unsure / m->wheels_by_model[1] + square(by->late[1]) + both;
    const real off = variance(k->slip_driving, gone);
    const left_over a = explain(turn, turn_noise, apart, follow);
    const left_over b = explain(way, way_noise, off, variance(k->following, gone) + square(by->late[0]));
    /* Without the gyro the time of the turn is unknown: before or after the way, or throughout. */
    const real least = by->way * ddmpc_cos(R(0.5) * by->pose_turn);
    const real bent = ddmpc_max(ddmpc_min(by->pose, ddmpc_max(least, by->way)), ddmpc_min(least, by->way));
    const real free_way[4] = {by->pose, R(0.0), bent, by->model + bent - by->wheels};
    const left_over unbent = explain(free_way, way_noise, off, variance(k->following, gone) + square(by->late[0]));
    verdict result;
    result.honest = ddmpc_min(a.usual + b.usual, ddmpc_min(a.slip + b.slip + k->odds[0], a.held + b.held + k->odds[1]));
    for (int i = 0; i < SENSES; i++)
        /* The gyro does not measure driving. */
        result.fault[i] = a.fault[i] + (i == DDMPC_OF_YAW_RATE ? ddmpc_min(unbent.usual, unbent.slip + k->odds[0]) : b.fault[i]);
    result.slips = result.honest < a.usual + b.usual;
    return result;
}

/* Compute the squared deviations of poses that drift from dead reckoning more steadily than slopes or slip explain. */
static real drift(const ddmpc_constants *k, const motions *half, const motions *whole, real noise)
{
    const real spread = R(0.5) * square(noise) + square(R(0.5) * k->sliding[0] * whole->wheels) +
                        square(R(0.5) * k->sliding[1] * whole->turned) + square(k->slip_driving[ABSOLUTE]);
    /* A push or a correction is sudden: count the half of the window with the smaller drift. */
    const real half_off = half->pose - half->wheels, off = whole->pose - whole->wheels;
    const real cosine = ddmpc_cos(whole->heading - half->heading), sine = ddmpc_sin(whole->heading - half->heading);
    const real size = ddmpc_hypot(off, whole->left);
    const real along = half_off * (cosine * off - sine * whole->left) + half->left * (sine * off + cosine * whole->left);
    const real second = size > R(0.0) ? along / size : R(0.0), less = ddmpc_min(second, size - second);
    return less > R(0.0) ? R(2.0) * square(less) / spread : R(0.0);
}

/* Learn the scatter of poses beyond their stated covariance from second differences, which steady slip does not enter. */
static void learn_scatter(const ddmpc_constants *k, ddmpc_monitor *m, const ddmpc_checked_pose *pose, const motions *by)
{
    const real stated[2] = {R(0.5) * (pose->covariance[0][0] + pose->covariance[1][1]), pose->covariance[2][2]};
    const real off[3] = {by->pose - by->wheels, by->left, by->pose_turn - by->gyro_turn};
    real observed[2] = {R(0.0), R(0.0)};
    for (int i = 0; i < 3; i++) {
        /* Each holds 1 + 4 + 1 variances; the first two are along and across. */
        observed[i / 2] += square(off[i] - m->residual[i]) / (i < 2 ? R(12.0) : R(6.0));
        m->residual[i] = off[i];
    }
    if (m->residuals < (int)k->scatter[1])
        m->residuals++;
    if (m->residuals <= 2)
        return;
    const real share = ddmpc_max(k->scatter[0], R(1.0) / (real)m->residuals);
    for (int i = 0; i < 2; i++) {
        const real most = k->scatter[2] * ddmpc_max(m->scatter[i], R(1.0)), ratio = observed[i] / stated[i];
        /* A comparison instead of `min`, so that NaN is removed. */
        m->scatter[i] += share * ((ratio < most ? ratio : most) - m->scatter[i]);
    }
}

static void learn_gain(real sums[2], real surest, real by, real turn)
{
    sums[0] += by * turn;
    sums[1] += by * by;
    if (sums[1] > surest) {
        sums[0] *= surest / sums[1];
        sums[1] = surest;
    }
}

static ddmpc_time delay_of(const ddmpc_constants *k, int index)
{
    return (ddmpc_time)k->latest * index / (MONITORED_DELAYS - 1);
}

/* Compare motions between two instants that are earlier by a delay; return 0 if they are no longer stored. */
static int compare_late(const ddmpc_constants *k, ddmpc_monitor *m, const ddmpc_seen_pose *from, const ddmpc_motion *to,
                        ddmpc_time delay, const real pose[3], motions *by)
{
    ddmpc_motion first, last;
    if (!motion_at(m, from->then.time - delay, &first) || !motion_at(m, to->time - delay, &last))
        return 0;
    *by = compare(m, &first, &last, from->value, pose);
    const ddmpc_time later = (ddmpc_time)k->response_time;
    ddmpc_motion before, after;
    if (motion_at(m, first.time - later, &before) && motion_at(m, last.time - later, &after)) {
        by->late[0] = by->chord * (last.sum[MODEL_DISTANCE] - first.sum[MODEL_DISTANCE] - after.sum[MODEL_DISTANCE] + before.sum[MODEL_DISTANCE]);
        by->late[1] = by->model_turn - quotient(m->body_by_model) * (after.sum[MODEL_TURN] - before.sum[MODEL_TURN]);
    }
    return 1;
}

/* Learn the ratios of the turns of wheels, body and commands. */
static void learn_gains(const ddmpc_constants *k, ddmpc_monitor *m, const motions *by)
{
    const real turn = R(0.5) * (by->pose_turn + by->gyro_turn);
    const real wheels = by->wheel_turn / quotient(m->body_by_wheels);
    const real model = by->model_turn / quotient(m->body_by_model);
    /* A held robot teaches nothing about its body. */
    if (ddmpc_fabs(turn) >= k->held * ddmpc_fabs(wheels)) {
        learn_gain(m->body_by_wheels, k->gains[2], wheels, turn);
        learn_gain(m->body_by_model, k->gains[2], model, turn);
    }
    learn_gain(m->wheels_by_model, k->gains[2], model, wheels);
}

/* Learn the scale of the gyro from windows that a single scale explains. */
static void learn_spread(const ddmpc_constants *k, ddmpc_monitor *m, const motions *by, real noise)
{
    const real noise_of_turn = k->gyro[ABSOLUTE] + noise, weight = R(1.0) / square(noise_of_turn);
    const real pose = by->pose_turn, gyro = by->gyro_turn, scale = m->spread[4] > R(0.0) ? m->spread[5] / m->spread[4] : R(1.0);
    if (m->spread[3] > k->late[2] && ddmpc_fabs(pose - scale * gyro) > R(1.5) * noise_of_turn + k->uneven * ddmpc_fabs(pose))
        return;
    const real add[6] = {R(1.0), pose, gyro, square(pose), square(gyro), pose * gyro};
    for (int i = 0; i < 6; i++)
        m->spread[i] = k->late[1] * m->spread[i] + weight * add[i];
}

/* Return whether turns are taken from the wheels because there is no gyro. */
static int turns_by_wheels(const ddmpc_constants *k, const ddmpc_monitor *m)
{
    const ddmpc_time silence = (ddmpc_time)k->silence;
    return (m->now.time - m->gyro.heard > silence || m->unreal & BY_GYRO) && m->now.time - m->wheels.heard <= silence &&
           !(m->accused & BY_WHEELS);
}

/* Compute the turn between two instants by the gyro, or by the wheels without one. */
static real turned_between(const ddmpc_constants *k, const ddmpc_monitor *m, const ddmpc_motion *from, const ddmpc_motion *to)
{
    return turns_by_wheels(k, m) ? quotient(m->body_by_wheels) * (to->sum[WHEEL_TURN] - from->sum[WHEEL_TURN])
                                 : to->sum[GYRO_TURN] - from->sum[GYRO_TURN];
}

/* Learn the delay of poses. For each candidate delay a Kalman filter explains the heading of the poses minus that of the gyro
 * by an offset, a drifting bias and a share of the turn, so that neither bias nor scale is taken for a delay; all candidates
 * share one covariance. Driving does not reveal the delay, because tyres make a body follow its wheels late. Without a gyro the
 * turn of the wheels reveals only long delays, for the same reason. */
static void learn_delay(const ddmpc_constants *k, ddmpc_monitor *m, const ddmpc_motion *now, const real pose[3], real noise)
{
    const real dt = (real)(now->time - m->last_motion.time), turn = ddmpc_wrap(pose[2] - m->last.value[2]);
    const real left = ddmpc_max(R(1.0) - dt / k->delay_fit[5], R(0.0)), own = R(0.5) * square(noise) + square(k->delay_fit[3]);
    real off[MONITORED_DELAYS], low = HUGE_VAL, high = -HUGE_VAL, (*P)[3] = m->fit_covariance;
    ddmpc_motion then;
    const int wheels = turns_by_wheels(k, m);
    const int silent = !wheels && (m->now.time - m->gyro.changed > (ddmpc_time)k->silence || m->unreal & BY_GYRO);
    if (silent || (m->accused & BY_POSE) || !motion_at(m, now->time - (ddmpc_time)k->latest, &then))
        return;
    for (int j = 0; j < 3; j++)
        P[0][j] += dt * P[1][j] + turn * P[2][j];
    for (int j = 0; j < 3; j++)
        P[j][0] += dt * P[j][1] + turn * P[j][2];
    P[0][0] += dt * square(k->delay_fit[0]) + (wheels ? square(k->by_wheels[0]) * ddmpc_fabs(turn) : R(0.0));
    P[1][1] += dt * square(k->delay_fit[1]);
    const real all = P[0][0] + own, gain[3] = {P[0][0] / all, P[1][0] / all, P[2][0] / all};
    for (int i = 0; i < MONITORED_DELAYS; i++) {
        motion_at(m, now->time - delay_of(k, i), &then);
        m->fit[i][0] += dt * m->fit[i][1] + turn * m->fit[i][2];
        off[i] = turned_between(k, m, &then, now) - m->apart - m->fit[i][0];
        low = ddmpc_min(low, off[i]);
        high = ddmpc_max(high, off[i]);
    }
    /* No delay explains a jump: restart. An accused gyro may have any scale. */
    const real first[3] = {own, square(k->delay_fit[2]), square(wheels ? k->by_wheels[1] : m->accused & BY_GYRO ? k->delay_fit[7] : k->gyro[SHARE])};
    const int restart = !(m->fits > R(0.0)) || ddmpc_max(low, -high) > k->delay_fit[6] * ddmpc_sqrt(all);
    m->fits = restart ? R(1.0) : left * m->fits + R(1.0);
    int best = 1;
    for (int i = 0; i < MONITORED_DELAYS; i++) {
        m->misfit[i] = restart ? R(0.0) : left * m->misfit[i] + square(off[i]) / all;
        for (int j = 0; j < 3; j++)
            m->fit[i][j] = !restart ? m->fit[i][j] + gain[j] * off[i] : j == 0 ? m->fit[i][0] + off[i] : R(0.0);
        best = i > 1 && i < MONITORED_DELAYS - 1 && m->misfit[i] < m->misfit[best] ? i : best;
    }
    for (int i = 0; i < 9; i++)
        P[i / 3][i % 3] = !restart ? P[i / 3][i % 3] - gain[i / 3] * gain[i % 3] * all : i % 4 == 0 ? first[i / 4] : R(0.0);
    /* A parabola through the best three candidates gives the delay, and by its curvature the deviation, which is large in steady
     * motion. */
    const real *misfit = &m->misfit[best], slope = misfit[-1] - misfit[1], step = (real)delay_of(k, 1);
    const real curved = ddmpc_max(misfit[-1] - R(2.0) * misfit[0] + misfit[1], R(1e-6));
    const real delay = ddmpc_max(step * ((real)best + R(0.5) * slope / curved), R(0.0));
    const real scatter = ddmpc_max(misfit[0] / m->fits, R(1.0)), deviation = step * ddmpc_sqrt(R(2.0) * scatter / curved);
    const int sure = best < MONITORED_DELAYS - 2 && scatter < k->late[4] &&
                     deviation < ddmpc_max(k->delay_fit[4], m->accused & BY_GYRO ? R(0.0) : k->late[3] * delay);
    /* The turns of a sensor that has just failed may look late for a moment, and a new delay moves the whole estimate. */
    if (!sure || restart || (wheels && delay < k->by_wheels[2]))
        m->unsure = now->time;
    const int differs = ddmpc_fabs(delay - (real)m->delay) > k->late[0] * deviation;
    const int sharper = m->delay > 0.0 && deviation < m->delay_deviation;
    if (now->time - m->unsure >= (ddmpc_time)k->lasting && (differs || sharper)) {
        /* The scale of the gyro came from windows at the former delay. */
        if (differs)
            memset(m->spread, 0, sizeof m->spread);
        m->delay = (ddmpc_time)delay;
        m->delay_deviation = deviation;
    }
}

/* Return the sensors, as bits, that have reported without a pause since `time`. */
static int heard_since(const ddmpc_constants *k, const ddmpc_monitor *m, ddmpc_time time)
{
    const ddmpc_time silence = (ddmpc_time)k->silence;
    const int wheels = m->wheels.since <= time && m->now.time - m->wheels.heard <= silence;
    const int gyro = m->gyro.since <= time && m->now.time - m->gyro.heard <= silence;
    return (wheels ? BY_WHEELS : 0) | (gyro ? BY_GYRO : 0);
}

/* Return whether poses repeat themselves while two other sources report motion. */
static int is_frozen(ddmpc_controller *c, const real pose[3], const ddmpc_motion *now, const real noise[2])
{
    const ddmpc_constants *k = c->constants;
    ddmpc_monitor *m = &c->monitor;
    m->same++;
    for (int i = 0; i < 3; i++)
        if (pose[i] != m->last.value[i])
            m->same = 0;
    if (m->same == 0)
        m->frozen = *now;
    if (m->same < (int)k->often - 1)
        return 0;
    const motions by = compare(m, &m->frozen, now, pose, pose);
    const int heard = heard_since(k, m, m->frozen.time) & ~m->accused;
    const real far = k->frozen[0] + R(3.0) * noise[0], turned = k->frozen[1] + R(3.0) * noise[1];
    const int model = ddmpc_fabs(now->sum[MODEL_DISTANCE] - m->frozen.sum[MODEL_DISTANCE]) > far ||
                      ddmpc_fabs(by.model_turn) > turned;
    const int wheels = ddmpc_fabs(now->sum[WHEEL_DISTANCE] - m->frozen.sum[WHEEL_DISTANCE]) > far ||
                       ddmpc_fabs(by.wheel_turn) > turned;
    const int gyro = ddmpc_fabs(by.gyro_turn) > turned;
    return model + (wheels && (heard & BY_WHEELS)) + (gyro && (heard & BY_GYRO)) >= 2;
}

/* Return the newest stored pose at least `length` [s] older than `stamp`; 0 if there is none, or only a far older one. */
static const ddmpc_seen_pose *seen_before(const ddmpc_monitor *m, ddmpc_time stamp, ddmpc_time length)
{
    for (int ago = 0; ago < m->poses; ago++) {
        const ddmpc_seen_pose *stored = &m->pose[(m->newest_pose + MONITORED_POSES - ago) % MONITORED_POSES];
        if (stamp - stored->then.time >= length - 1e-9)
            return stamp - stored->then.time < 2.0 * length ? stored : 0;
    }
    return 0;
}

/* Evaluate each hypothesis at the delay of poses that suits it best, because late poses are no fault. For a faulty pose the
 * delay has no meaning, so the other sensors must agree at each of them. */
static verdict weigh_late(const ddmpc_constants *k, ddmpc_monitor *m, const ddmpc_seen_pose *from,
                          const ddmpc_motion *now, const real *pose, int heard, const real noise[2], int window)
{
    verdict least;
    int first = 1;
    real best = m->misfit[0];
    memset(&least, 0, sizeof least);
    for (int i = 1; i < MONITORED_DELAYS; i++)
        best = ddmpc_min(best, m->misfit[i]);
    for (int i = 0; i < MONITORED_DELAYS; i++) {
        motions by;
        /* Skip delays that are already excluded. */
        if (m->misfit[i] > best + k->late[5] || !compare_late(k, m, from, now, delay_of(k, i), pose, &by))
            continue;
        const verdict result = weigh(k, m, &by, heard, noise, k->windows[window]);
        if (first)
            least = result;
        for (int j = 0; j < SENSES; j++)
            least.fault[j] = j == DDMPC_OF_POSE ? ddmpc_max(least.fault[j], result.fault[j]) : ddmpc_min(least.fault[j], result.fault[j]);
        least.slips = result.honest < least.honest ? result.slips : least.slips;
        least.honest = ddmpc_min(least.honest, result.honest);
        first = 0;
    }
    return least;
}

/* Compute the course between two poses, relative to their heading halfway, and its variance; return 0 if it is too short. */
static int course(const ddmpc_constants *k, const ddmpc_seen_pose *from, const ddmpc_motion *to, const real pose[3], real noise,
                  real *direction, real *spread)
{
    const real dx = pose[0] - from->value[0], dy = pose[1] - from->value[1], way = ddmpc_hypot(dx, dy);
    const real distance = to->sum[WHEEL_DISTANCE] - from->then.sum[WHEEL_DISTANCE];
    if (!(way > R(4.0) * noise) || !(way > k->frozen[0]))
        return 0;
    const real turned = ddmpc_wrap(pose[2] - from->value[2]), heading = from->value[2] + R(0.5) * turned;
    *direction = ddmpc_wrap(ddmpc_atan2(dy, dx) - heading - (distance < R(0.0) ? DDMPC_PI : R(0.0)));
    /* The chord of a path that is no arc lies anywhere between both headings. */
    *spread = square(k->course[0]) + square(noise / way) + square(k->course[3] * turned) + square(R(0.5) * *direction);
    return ddmpc_fabs(turned) < k->course[4];
}

/* Decide by the course which heading is right if gyro and poses have diverged: the course turns with the right one. */
static void follow_course(const ddmpc_constants *k, ddmpc_monitor *m, const ddmpc_motion *now, const real pose[3], real noise)
{
    const ddmpc_seen_pose *from = seen_before(m, now->time, (ddmpc_time)k->windows[SHORT]);
    real direction, spread;
    if (!from || !course(k, from, now, pose, noise, &direction, &spread))
        return;
    m->directed = k->late[1] * m->directed + R(1.0) / spread;
    m->direction = ddmpc_wrap(m->direction + ddmpc_wrap(direction - m->direction) / (spread * m->directed));
    if (now->time >= m->next_pose) {
        m->witness *= k->late[1];
        m->settled *= k->late[1];
    }
    const real apart = m->apart - m->anchor[2], turned = ddmpc_wrap(direction - m->anchor[0]), all = spread + m->anchor[1];
    if (m->anchored && ddmpc_fabs(apart) > k->course[1]) {
        const real evidence = (square(ddmpc_wrap(turned - apart)) - square(turned)) / all, most = k->course[2];
        m->witness = ddmpc_max(ddmpc_min(m->settled + evidence, most), -most);
    }
    if (!m->anchored || ddmpc_fabs(apart) > R(3.0) * k->course[1]) {
        m->settled = R(0.5) * m->witness;
        m->anchored = 1;
        m->anchor[0] = direction;
        m->anchor[1] = spread;
        m->anchor[2] = m->apart;
    }
}

/* Compute the squared deviations of poses that move sideways in two windows in a row: a push acts only once. */
static real sideways(const ddmpc_constants *k, ddmpc_monitor *m, const ddmpc_seen_pose *from, const ddmpc_motion *now,
                     const real pose[3], real noise)
{
    const ddmpc_seen_pose *middle = seen_before(m, now->time, (ddmpc_time)k->windows[SHORT]);
    motions by[2];
    if (!middle || middle == from || !compare_late(k, m, from, &middle->then, m->delay, middle->value, &by[0]) ||
        !compare_late(k, m, middle, now, m->delay, pose, &by[1]) || !(by[0].left * by[1].left + by[0].pose * by[1].pose > R(0.0)))
        return R(0.0);
    real least = HUGE_VAL;
    for (int i = 0; i < 2; i++) {
        /* No floor moves a robot against its wheels and its commands, backwards either. */
        const real back = by[i].pose * by[i].wheels < R(0.0) && by[i].model * by[i].wheels > R(0.0) ? square(by[i].pose) : R(0.0);
        const real way = ddmpc_hypot(by[i].pose, by[i].left), distance = ddmpc_fabs(by[i].wheels);
        /* A sliding floor does not carry a robot as far as its wheels go. */
        if (!(ddmpc_fabs(way - distance) < R(2.0) * (noise + k->slip_driving[SHARE] * distance)))
            return R(0.0);
        least = ddmpc_min(least, (square(by[i].left) + back) / (square(noise) + variance(k->sideways, by[i].wheels) + square(k->sliding[1] * by[i].turned)));
    }
    return R(2.0) * least;
}

/* Return whether the gyro differs from poses by a constant scale: neither a bias nor a faulty pose does. */
static int is_scaled(const ddmpc_constants *k, const ddmpc_monitor *m)
{
    const real *sum = m->spread, weights = ddmpc_max(sum[0], R(1e-9));
    const real pose = sum[3] - square(sum[1]) / weights, gyro = sum[4] - square(sum[2]) / weights;
    const real both = sum[5] - sum[1] * sum[2] / weights;
    return pose > k->late[2] && both > k->scaled[0] * gyro && ddmpc_fabs(both - gyro) > k->scaled[1] * gyro &&
           pose * gyro - square(both) < k->scaled[2] * pose * gyro;
}

/* Compute the evidence that the wheels measure another distance than poses and commands, which agree, over recent motion. */
static real scaled(const ddmpc_constants *k, const ddmpc_monitor *m)
{
    if (!(m->went[3] > k->scales[0]))
        return R(0.0);
    const real wheels = m->went[1] / m->went[0], body = m->went[2] / m->went[0];
    const real follow = square((wheels - R(1.0)) / k->scales[2]), driven = square((body - R(1.0)) / k->scales[3]);
    return ddmpc_min(follow, square((wheels - body) / k->scales[1]) + driven) - driven;
}

/* Compute the evidence against each sensor from the motion up to this pose, and in `agreeing` the sensors that the others
 * confirm in motion. */
static void judge(ddmpc_controller *c, const ddmpc_checked_pose *pose, const ddmpc_motion *now, const real noise[2],
                  real evidence[SENSES], int *agreeing)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_monitor *m = &c->monitor;
    const int accused = m->accused, both = BY_WHEELS | BY_GYRO;
    motions half, whole;
    if (heard_since(k, m, now->time) & BY_GYRO)
        follow_course(k, m, now, pose->value, noise[0]);
    learn_delay(k, m, now, pose->value, noise[1]);
    for (int window = SHORT; window < WINDOWS; window++) {
        const ddmpc_seen_pose *from = seen_before(m, pose->stamp, (ddmpc_time)k->windows[window]);
        motions *by = window == LONG ? &whole : &half;
        if (!from || !compare_late(k, m, from, now, m->delay, pose->value, by))
            break;
        const int audible = heard_since(k, m, from->then.time - m->delay), heard = audible & ~accused;
        if (window == MIDDLE) {
            const ddmpc_seen_pose *oldest = seen_before(m, pose->stamp, (ddmpc_time)(R(2.0) * k->windows[SHORT]));
            if (oldest && heard & BY_WHEELS)
                evidence[DDMPC_OF_POSE] = ddmpc_max(evidence[DDMPC_OF_POSE], sideways(k, m, oldest, now, pose->value, noise[0]));
            continue;
        }
        verdict result = weigh_late(k, m, from, now, pose->value, heard, noise, window);
        result.fault[DDMPC_OF_POSE] += ddmpc_max(m->witness, R(0.0));
        result.fault[DDMPC_OF_YAW_RATE] += ddmpc_max(-m->witness, R(0.0));
        result.fault[DDMPC_OF_POSE] += is_scaled(k, m) ? k->scaled[3] : R(0.0);
        for (int i = 0; i < SENSES; i++)
            if ((heard | BY_POSE) & 1 << i)
                evidence[i] = ddmpc_max(evidence[i], result.honest - result.fault[i]);
        if (window == SHORT && pose->stamp >= m->next_pose) {
            const real way = by->model, left = R(1.0) - k->pose_spacing / k->memory;
            const real add[6] = {way * way, way * by->wheels, way * by->pose, k->pose_spacing / k->windows[SHORT] * ddmpc_fabs(way),
                                 square(by->pose_turn), by->pose_turn * by->wheel_turn / quotient(m->body_by_wheels)};
            for (int i = 0; i < 6; i++)
                m->went[i] = left * m->went[i] + add[i];
        }
        if (window == SHORT && heard & BY_WHEELS)
            evidence[DDMPC_OF_WHEELS] = ddmpc_max(evidence[DDMPC_OF_WHEELS], scaled(k, m));
        if (window == LONG) {
            m->creeping = square(by->pose_turn - by->gyro_turn) > square(noise[1]) + square(k->gyro[ABSOLUTE] * k->windows[LONG]);
            /* Dead reckoning uses wheels and gyro: it reveals a drift only if these agree with everything else. */
            if (heard == both && result.honest < k->plausible && pose->stamp - m->slipped > (ddmpc_time)k->memory)
                evidence[DDMPC_OF_POSE] = ddmpc_max(evidence[DDMPC_OF_POSE], drift(k, &half, &whole, noise[0]));
            continue;
        }
        const verdict with_accused = accused ? weigh(k, m, by, audible, noise, k->windows[window]) : result;
        const int moves = ddmpc_fabs(by->pose) > k->frozen[0] || ddmpc_fabs(by->pose_turn) > k->frozen[1];
        const int goes_along = square(by->wheels - by->pose) < square(noise[0]) + variance(k->slip_driving, by->pose);
        const int turns = ddmpc_max(ddmpc_fabs(by->pose_turn), ddmpc_fabs(by->gyro_turn)) > k->frozen[1];
        const real far = k->frozen[0] + R(2.0) * noise[0], turned = k->frozen[1] + R(2.0) * noise[1];
        const real gone = ddmpc_fabs(by->pose), went = ddmpc_fabs(by->pose_turn);
        const int commanded = ddmpc_fabs(by->model) - gone > k->frozen[0] || ddmpc_fabs(by->model_turn) - went > R(2.0) * k->frozen[1];
        if (commanded && !(gone > far || went > turned))
            m->stood = pose->stamp;
        if (with_accused.honest < k->plausible)
            *agreeing = (moves ? audible & ~(turns ? 0 : BY_GYRO) & ~(goes_along ? 0 : BY_WHEELS) : 0) | BY_POSE;
        if (result.slips)
            m->slipped = pose->stamp;
        const ddmpc_time changed = m->wheels.changed < m->gyro.changed ? m->wheels.changed : m->gyro.changed;
        const int alive = m->now.time - changed <= (ddmpc_time)k->silence;
        if (pose->stamp < m->next_pose)
            continue;
        const int alike = square(by->pose_turn - by->gyro_turn) < R(4.0) * (square(noise[1]) + square(k->gyro[ABSOLUTE]));
        if (!accused && alive && audible == both && alike && result.honest < k->plausible && !m->creeping)
            learn_gains(k, m, by);
        if (!((accused & BY_POSE) | (m->unreal & BY_GYRO)) && audible & BY_GYRO && m->now.time - m->gyro.changed <= (ddmpc_time)k->silence && ddmpc_min(result.honest, result.fault[DDMPC_OF_YAW_RATE]) < k->plausible)
            learn_spread(k, m, by, noise[1]);
    }
    /* A reading that repeats itself despite the commands, or at the end of its range, is no evidence against poses. */
    const int rests = m->now.time - m->gyro.changed > (ddmpc_time)k->silence && ddmpc_fabs(m->gyro.value[0]) > k->doubtful[ABSOLUTE];
    if ((ddmpc_monitor_doubts(c, m->now.time) | (rests ? BY_GYRO : 0)) & ~accused)
        evidence[DDMPC_OF_POSE] = R(0.0);
    /* Poses that are not used accuse no other sensor. */
    if (accused & BY_POSE)
        evidence[DDMPC_OF_WHEELS] = evidence[DDMPC_OF_YAW_RATE] = R(0.0);
}

/* Accuse sensors that have been contradicted for long enough, and trust those that have agreed for long enough. */
static void decide(ddmpc_controller *c, const real evidence[SENSES], int agreeing, ddmpc_time stamp, ddmpc_time passed)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_monitor *m = &c->monitor;
    const ddmpc_time now = m->now.time, silence = (ddmpc_time)k->silence;
    const int repeats[SENSES] = {now - m->wheels.changed > silence, now - m->gyro.changed > silence, m->same > 0};
    for (int i = 0; i < SENSES; i++) {
        const int bit = 1 << i;
        real strongest = R(0.0);
        for (int j = 0; j < SENSES; j++)
            strongest = j == i ? strongest : ddmpc_max(strongest, evidence[j]);
        /* The larger the contradiction, the more the faulty sensor must stand out: a third sensor tells little through gains
         * that one of the two has taught. */
        if (evidence[i] > k->enough && evidence[i] > strongest + k->margin + ddmpc_min(k->share[0] * strongest, k->share[1])) {
            if (m->contradictions[i]++ == 0)
                m->since[i] = stamp;
            const ddmpc_time lasting = stamp - m->since[i];
            m->agreed[i] = 0.0;
            if ((m->contradictions[i] < (int)k->often || lasting < (ddmpc_time)k->lasting) && lasting < (ddmpc_time)k->windows[SHORT])
                continue;
            if (!(m->accused & bit))
                m->repeating = repeats[i] ? m->repeating | bit : m->repeating & ~bit;
            m->accused |= bit;
        } else {
            m->contradictions[i] = 0;
            if ((m->accused & agreeing & bit) && !repeats[i] && !is_impossible(c, i))
                m->agreed[i] += passed;
            if (m->agreed[i] >= (ddmpc_time)k->monitor_trust) {
                m->accused &= ~bit;
                m->unreal &= ~bit;
                m->agreed[i] = 0.0;
            }
        }
    }
}

int ddmpc_monitor_judge(ddmpc_controller *c, const ddmpc_checked_pose *pose)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_monitor *m = &c->monitor;
    ddmpc_motion now;
    if (!k->monitor || !motion_at(m, pose->stamp, &now))
        return 0;
    const int before = m->accused;
    const real noise[2] = {
        ddmpc_sqrt((pose->covariance[0][0] + pose->covariance[1][1]) * ddmpc_max(m->scatter[0], R(1.0))),
        ddmpc_sqrt(R(2.0) * pose->covariance[2][2] * ddmpc_max(m->scatter[1], R(1.0)))};
    int frozen = 0, agreeing = 0;
    real evidence[SENSES] = {R(0.0), R(0.0), R(0.0)};
    if (m->has_last) {
        const ddmpc_time passed = pose->stamp - m->last.stamp;
        const motions by = compare(m, &m->last_motion, &now, m->last.value, pose->value);
        frozen = is_frozen(c, pose->value, &now, noise);
        /* A pose that moves further than any faulty sensor explains has jumped, which other code handles. */
        const real far = R(0.5) * k->frozen[0] + R(3.0) * noise[0] + ddmpc_fastest(k, 0) * (real)passed;
        const real turned = R(0.5) * k->frozen[1] + R(3.0) * noise[1] + ddmpc_fastest(k, 1) * (real)passed;
        if (!(ddmpc_hypot(by.pose - by.wheels, by.left) <= far && ddmpc_fabs(by.pose_turn - by.gyro_turn) <= turned))
            m->poses = m->residuals = m->anchored = 0;
        else if (passed <= R(0.25) && m->same == 0)
            learn_scatter(k, m, pose, &by);
        m->apart += turned_between(k, m, &m->last_motion, &now) - ddmpc_wrap(pose->value[2] - m->last.value[2]);
        judge(c, pose, &now, noise, evidence, &agreeing);
        decide(c, evidence, agreeing, pose->stamp, passed < 0.25 ? passed : 0.25);
    } else {
        m->frozen = now;
    }
    for (int i = 0; i < DDMPC_OF_POSE; i++)
        if (is_impossible(c, i))
            m->unreal |= 1 << i;
    m->accused |= m->unreal;
    if (frozen) {
        m->accused |= BY_POSE;
        m->repeating |= BY_POSE;
        m->agreed[DDMPC_OF_POSE] = 0.0;
    }
    if (m->accused & ~before) {
        /* Discard the delay, which a faulty sensor has taught. */
        memset(m->misfit, 0, sizeof m->misfit);
        memset(m->spread, 0, sizeof m->spread);
        m->fits = R(0.0);
        m->delay = 0.0;
    }
    if (m->poses == 0 || pose->stamp >= m->next_pose) {
        m->newest_pose = (m->newest_pose + 1) % MONITORED_POSES;
        m->poses += m->poses < MONITORED_POSES;
        memcpy(m->pose[m->newest_pose].value, pose->value, sizeof pose->value);
        m->pose[m->newest_pose].then = now;
        m->next_pose = pose->stamp + (ddmpc_time)k->pose_spacing - 1e-6;
    }
    m->last = *pose;
    m->last_motion = now;
    m->has_last = 1;
    return m->accused & ~before;
}

static real widening(const ddmpc_constants *k, real scatter)
{
    return scatter > k->scatter[3] ? ddmpc_min(scatter, k->scatter[4]) : R(1.0);
}

void ddmpc_monitor_widen(ddmpc_controller *c, ddmpc_checked_pose *pose)
{
    ddmpc_monitor *m = &c->monitor;
    real by[2];
    for (int i = 0; i < 2; i++) {
        const real wide = widening(c->constants, m->scatter[i]);
        /* The present belief came from poses that were trusted too much. */
        pose->doubt[i] = wide > m->widest[i] ? ddmpc_sqrt(wide / m->widest[i]) : R(1.0);
        m->widest[i] = ddmpc_max(wide, m->widest[i]);
        by[i] = ddmpc_sqrt(wide);
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            pose->covariance[i][j] *= by[i / 2] * by[j / 2];
}

ddmpc_time ddmpc_monitor_delay(const ddmpc_controller *c) { return c->monitor.delay; }

void ddmpc_monitor_report(ddmpc_controller *c)
{
    const ddmpc_monitor *m = &c->monitor;
    ddmpc_result *result = &c->result;
    const real ratio = c->constants->wheel_yaw_ratio, most = c->constants->monitor_turn_ratio;
    const real wheels = quotient(m->wheels_by_model) / ratio, body = quotient(m->body_by_wheels) * ratio;
    result->reasons |= (unsigned int)m->accused * DDMPC_WHEELS_ACCUSED;
    result->repeating = m->repeating & m->accused;
    result->unreal = m->unreal;
    result->pose_scatter = ddmpc_sqrt(ddmpc_max(m->scatter[0], m->scatter[1]));
    result->pose_delay = (real)m->delay;
    result->reads[0] = m->spread[3] > R(0.0) ? m->spread[5] / m->spread[3] : R(0.0);
    result->reads[1] = ddmpc_fabs(m->went[2]) > R(0.0) ? m->went[1] / m->went[2] : R(0.0);
    result->reads[2] = m->went[4] > R(0.0) ? m->went[5] / m->went[4] : R(0.0);
    result->direction = m->direction;
    result->turn_ratio[0] = wheels;
    result->turn_ratio[1] = body;
    if (square(result->pose_scatter) > c->constants->scatter[3])
        result->reasons |= DDMPC_POSES_SCATTER;
    if (m->delay > 0.015)
        result->reasons |= DDMPC_POSES_LATE;
    if (m->body_by_wheels[1] > c->constants->gains[1] && m->wheels_by_model[1] > c->constants->gains[1] &&
        !(wheels < most && wheels * most > R(1.0) && body < most && body * most > R(1.0)))
        result->reasons |= DDMPC_TURNS_OTHERWISE;
}
