/* Finds the sensor that the others contradict: motion by poses, wheels, gyro and the commands sent is compared over
 * windows of time, whenever a pose comes. Two that agree with each other outvote a third. The commands are no sensor:
 * a robot may be held, pushed or slip, so what they promise counts only beside what a sensor says. */
#include <string.h>

#include "internal.h"

enum { SHORT, MIDDLE, LONG, WINDOWS };

/* Windows over which motion is compared, the last two for what creeps [s]. */
static const ddmpc_time WINDOW_LENGTH[WINDOWS] = {0.5, 1.5, 3.0};
/* Later than stamped poses may be, before they count as wrong [s], and how many delays are tried up to there. */
#define LATEST 0.3
#define DELAYS 6
/* A sensor that is silent for longer is no witness meanwhile [s]. */
#define SILENCE 0.1
/* A contradiction has to last, and to be seen this often [s, -]. */
#define LASTING 0.1
#define OFTEN 3
/* Poses that scatter by more than this, in variance over the one stated, count for less, but not for nothing. */
#define NOISY R(6.25)
#define NOISIEST R(400.0)
/* Noise of a pose within which a difference means nothing, in standard deviations of the difference of two. */
#define NOISE R(3.0)
/* Share of a turn, and of a distance, by which a floor's slip may change it within a window. */
#define SLIPPING R(0.3)
/* The same while poses are held against dead reckoning, whose slip is estimated. */
#define CREEPING R(0.02)
/* Gains of turning are known from so much turning [rad^2], and count so much at most. */
#define FIRST_TURN R(0.2)
#define MOST_TURN R(4.0)
#define MUCH_TURN R(1.5)
/* Share of a newly seen scatter of poses in its mean, and its largest part. */
#define NOVELTY R(0.04)
#define OUTLIER R(9.0)
/* By so much poses must fit better at another delay before it is taken for theirs, in squared deviations. */
#define LATE R(16.0)
/* Sums are counted from nought again beyond this, so that single precision stays sharp. */
#define FAR R(64.0)

static real square(real x) { return x * x; }

static int differ(real a, real b, real most) { return ddmpc_fabs(a - b) > most; }

void ddmpc_monitor_clear(ddmpc_controller *c)
{
    memset(&c->monitor, 0, sizeof c->monitor);
    c->monitor.wheels.heard = c->monitor.gyro.heard = -HUGE_VAL;
    c->monitor.body_by_wheels[1] = c->monitor.body_by_model[1] = FIRST_TURN;
    c->monitor.body_by_wheels[0] = FIRST_TURN / c->constants->wheel_yaw_ratio;
    c->monitor.body_by_model[0] = FIRST_TURN;
}

static ddmpc_motion *past(ddmpc_monitor *m, int ago) { return &m->path[(m->newest + MONITORED - ago) % MONITORED]; }

/* One sample on by the commands sent: what an undisturbed robot would do. */
void ddmpc_monitor_predict(ddmpc_controller *c, const real *newest)
{
    ddmpc_monitor *m = &c->monitor;
    const real half = R(0.5) * (real)c->constants->sample_time;
    real state[DDMPC_MOST_STATES], before[2], after[2];
    ddmpc_velocity_output(c, m->state, before, 0);
    ddmpc_velocity_step(c, m->state, newest, state, 0, c->problem.step_jacobian);
    memcpy(m->state, state, (size_t)STATES(c) * sizeof(real));
    ddmpc_velocity_output(c, state, after, 0);
    m->now.sum[MODEL_DISTANCE] += half * (before[0] + after[0]);
    m->now.sum[MODEL_TURN] += half * (before[1] + after[1]);
}

static void hear(ddmpc_hearing *heard, ddmpc_time t, const real *value, int count)
{
    int same = 1;
    for (int i = 0; i < count; i++)
        same = same && value[i] == heard->value[i];
    if (t - heard->heard > SILENCE)
        heard->since = t;
    if (!same || t - heard->heard > SILENCE)
        heard->changed = t;
    heard->heard = t;
    memcpy(heard->value, value, (size_t)count * sizeof(real));
}

void ddmpc_monitor_move(ddmpc_controller *c, ddmpc_time t, const ddmpc_checked_twist *twist, int wheels, int twists)
{
    ddmpc_monitor *m = &c->monitor;
    const real before[3] = {m->wheels.value[0], m->wheels.value[1], m->gyro.value[0]};
    if (wheels) {
        const real values[2] = {twist[0].value, twist[1].value};
        hear(&m->wheels, t, values, 2);
    }
    if (twists > wheels)
        hear(&m->gyro, t, &twist[wheels].value, 1);
    if (m->moves == 0)
        m->now.time = t;
    const real dt = (real)(t - m->now.time);
    if (m->moves > 0 && !(dt > R(0.0)))
        return;
    /* The gyro turns it, or where there is none the wheels. */
    const int by_wheels = t - m->gyro.heard > SILENCE || (m->accused & 1 << DDMPC_OF_YAW_RATE);
    real *sum = m->now.sum;
    const real gain = m->body_by_wheels[0] / m->body_by_wheels[1];
    const real wheel_turn = R(0.5) * dt * (before[1] + m->wheels.value[1]);
    const real gyro_turn = R(0.5) * dt * (before[2] + m->gyro.value[0]);
    const real *slip = ddmpc_estimator_slip(c);
    const real speed = R(0.5) * (before[0] + m->wheels.value[0]), distance = speed * dt;
    const real turn = by_wheels ? gain * wheel_turn : gyro_turn;
    const real heading = sum[HEADING] + R(0.5) * turn;
    const real forward = slip[LONGITUDINAL_GAIN] * distance + slip[TURN_LEFT] * turn;
    const real left = -(slip[TURN_AHEAD] + slip[SIDE_SLIP] * speed) * turn;
    sum[FORWARD] += forward * ddmpc_cos(heading) - left * ddmpc_sin(heading);
    sum[LEFT] += forward * ddmpc_sin(heading) + left * ddmpc_cos(heading);
    sum[HEADING] += turn;
    sum[WHEEL_DISTANCE] += distance;
    sum[WHEEL_TURN] += wheel_turn;
    sum[GYRO_TURN] += gyro_turn;
    m->now.time = t;
    const ddmpc_time spacing = (WINDOW_LENGTH[LONG] + LATEST + c->constants->stamp_history) / (MONITORED - 4);
    if (m->moves == 0 || t - past(m, 0)->time >= spacing) {
        m->newest = (m->newest + 1) % MONITORED;
        m->moves += m->moves < MONITORED;
        *past(m, 0) = m->now;
    }
    for (int i = 0; i < MOTIONS; i++)
        if (ddmpc_fabs(sum[i]) > FAR) {
            const real off = sum[i];
            sum[i] = R(0.0);
            for (int k = 0; k < MONITORED; k++)
                m->path[k].sum[i] -= off;
            for (int k = 0; k < MONITORED_POSES; k++)
                m->pose[k].then.sum[i] -= off;
            m->frozen.sum[i] -= off;
        }
}

/* The motion up to `time`, between the instants that are kept; 0 if they do not reach back so far. */
static int motion_at(ddmpc_monitor *m, ddmpc_time time, ddmpc_motion *found)
{
    const ddmpc_motion *after = &m->now;
    for (int ago = 0; ago < m->moves; ago++) {
        const ddmpc_motion *before = past(m, ago);
        if (before->time <= time) {
            const ddmpc_time length = after->time - before->time;
            const real share = length > 0.0 ? ddmpc_min((real)((time - before->time) / length), R(1.0)) : R(0.0);
            found->time = time;
            for (int i = 0; i < MOTIONS; i++)
                found->sum[i] = before->sum[i] + share * (after->sum[i] - before->sum[i]);
            return 1;
        }
        after = before;
    }
    return 0;
}

/* What the sensors say of the motion between two instants, along the way and in heading. */
typedef struct {
    real pose, wheels, model;            /* forward [m] */
    real pose_turn, wheel_turn, gyro_turn, model_turn; /* of the body, slip as it has been so far included [rad] */
    real wheel_excess;                   /* turn by wheels beyond that by the commands [rad] */
    real mid;                            /* heading of the pose in between [rad] */
    real left;                           /* of the pose beside dead reckoning [m] */
} compared;

static void compare(const ddmpc_controller *c, const ddmpc_motion *from, const ddmpc_motion *to, const real before[3],
                    const real after[3], compared *by)
{
    const ddmpc_monitor *m = &c->monitor;
    real sum[MOTIONS];
    for (int i = 0; i < MOTIONS; i++)
        sum[i] = to->sum[i] - from->sum[i];
    /* In two seconds a robot may turn round: by whole turns the gyro is right. */
    by->pose_turn = sum[HEADING] + ddmpc_wrap(after[2] - before[2] - sum[HEADING]);
    by->gyro_turn = sum[GYRO_TURN];
    by->wheel_turn = m->body_by_wheels[0] / m->body_by_wheels[1] * sum[WHEEL_TURN];
    by->wheel_excess = sum[WHEEL_TURN] - m->wheels_by_model[0] / m->wheels_by_model[1] * sum[MODEL_TURN];
    by->model_turn = m->body_by_model[0] / m->body_by_model[1] * sum[MODEL_TURN];
    const real dx = after[0] - before[0], dy = after[1] - before[1];
    const real mid = before[2] + R(0.5) * by->pose_turn;
    const real reckoned = from->sum[HEADING] + R(0.5) * sum[HEADING];
    const real forward = ddmpc_cos(mid) * dx + ddmpc_sin(mid) * dy;
    const real left = ddmpc_cos(mid) * dy - ddmpc_sin(mid) * dx;
    by->pose = forward;
    by->wheels = ddmpc_cos(reckoned) * sum[FORWARD] + ddmpc_sin(reckoned) * sum[LEFT];
    by->model = sum[MODEL_DISTANCE];
    if (ddmpc_fabs(by->wheels) < ddmpc_fabs(sum[WHEEL_DISTANCE]))
        by->model *= ddmpc_fabs(by->wheels / sum[WHEEL_DISTANCE]);
    by->mid = mid;
    by->left = left - (ddmpc_cos(reckoned) * sum[LEFT] - ddmpc_sin(reckoned) * sum[FORWARD]);
}

/* Whom a comparison speaks against, as bits by subject; `agrees`: who is confirmed in motion. */
static int suspects(const ddmpc_controller *c, const compared *by, int wheels, int gyro, const real noise[2],
                    int *agrees)
{
    const ddmpc_constants *k = c->constants;
    const real far = k->monitor_position + NOISE * noise[0], turned = k->monitor_heading + NOISE * noise[1];
    const real slip = turned + SLIPPING * ddmpc_fabs(by->wheel_turn);
    const real promise = turned + SLIPPING * ddmpc_fabs(by->model_turn);
    const real p = by->pose_turn, w = by->wheel_turn, g = by->gyro_turn, m = by->model_turn;
    /* Who contradicts whom: p pose, g gyro, w wheels, m model. */
    const int pg = gyro && differ(p, g, turned), pw = wheels && differ(p, w, slip), gw = wheels && differ(g, w, slip);
    const int pm = differ(p, m, promise), wm = wheels && ddmpc_fabs(by->wheel_excess) > promise;
    /* Between poses and gyro the wheels decide, or else the commands. */
    const real third = wheels ? w : m;
    int found = 0;
    *agrees = 0;
    if (pg && R(2.0) * ddmpc_fabs(p - third) < ddmpc_fabs(g - third))
        found |= 1 << DDMPC_OF_YAW_RATE;
    if (pg && R(2.0) * ddmpc_fabs(g - third) < ddmpc_fabs(p - third))
        found |= 1 << DDMPC_OF_POSE;
    if (pw && wm && !pg && (!gyro || gw) && !pm)
        found |= 1 << DDMPC_OF_WHEELS;
    const int astray = differ(by->pose, by->wheels, far);
    if (wheels && astray && differ(by->model, by->wheels, far) &&
        R(2.0) * ddmpc_fabs(by->pose - by->model) < ddmpc_fabs(by->pose - by->wheels))
        found |= 1 << DDMPC_OF_WHEELS;
    if (wheels && astray && by->pose * by->wheels < R(0.0) && ddmpc_fabs(by->pose) > far &&
        !differ(by->model, by->wheels, far))
        found |= 1 << DDMPC_OF_POSE;
    const int moves = ddmpc_fabs(by->pose) > far || ddmpc_fabs(by->pose_turn) > turned;
    if (gyro && !pg && moves)
        *agrees |= 1 << DDMPC_OF_YAW_RATE;
    if (wheels && !pw && !astray && moves)
        *agrees |= 1 << DDMPC_OF_WHEELS;
    if ((!gyro || !pg) && (!wheels || !astray) && (gyro || wheels))
        *agrees |= 1 << DDMPC_OF_POSE;
    return found;
}

/* Whether poses drift steadily away from dead reckoning while nothing else slips. */
static int drifts(const ddmpc_controller *c, const compared *half, const compared *whole, real noise)
{
    const ddmpc_constants *k = c->constants;
    const real most = k->monitor_position + NOISE * noise + CREEPING * ddmpc_fabs(whole->wheels);
    const real turned = k->monitor_heading + CREEPING * ddmpc_fabs(whole->gyro_turn);
    if (differ(whole->gyro_turn, whole->wheel_turn, turned) || ddmpc_fabs(whole->wheel_excess) > R(2.0) * turned)
        return 0;
    const real ahead[2] = {half->pose - half->wheels, whole->pose - whole->wheels};
    const real turn = whole->mid - half->mid, size = square(ahead[1]) + square(whole->left);
    const real along = ahead[0] * (ahead[1] * ddmpc_cos(turn) - whole->left * ddmpc_sin(turn)) +
                       half->left * (ahead[1] * ddmpc_sin(turn) + whole->left * ddmpc_cos(turn));
    return size > square(most) && along > R(0.25) * size && along < R(0.8) * size;
}

/* How much poses scatter beyond what they state, from second differences, in which slip has no part. */
static void scatter(ddmpc_controller *c, const ddmpc_checked_pose *pose, const compared *by)
{
    ddmpc_monitor *m = &c->monitor;
    const real stated[2] = {R(0.5) * (pose->covariance[0][0] + pose->covariance[1][1]), pose->covariance[2][2]};
    const real off[3] = {by->pose - by->wheels, by->left, by->pose_turn - by->gyro_turn};
    real seen[2] = {R(0.0), R(0.0)};
    for (int i = 0; i < 3; i++) {
        seen[i / 2] += square(off[i] - m->residual[i]) / (i < 2 ? R(12.0) : R(6.0));
        m->residual[i] = off[i];
    }
    if (m->residuals < 2) {
        m->residuals++;
        return;
    }
    for (int i = 0; i < 2; i++) {
        const real most = OUTLIER * ddmpc_max(m->scatter[i], R(1.0)), ratio = seen[i] / stated[i];
        m->scatter[i] += NOVELTY * ((ratio < most ? ratio : most) - m->scatter[i]);
    }
}

static int lasts(const ddmpc_hearing *heard, ddmpc_time since, ddmpc_time until)
{
    return heard->since <= since && until - heard->heard <= SILENCE;
}

/* Whether a pose that repeats itself does so while others say that the robot moves. */
static int frozen(ddmpc_controller *c, const ddmpc_checked_pose *pose, const ddmpc_motion *now, int honest)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_monitor *m = &c->monitor;
    if (memcmp(m->last.value, pose->value, sizeof pose->value) != 0) {
        m->same = 0;
        m->frozen = *now;
        return 0;
    }
    if (++m->same < OFTEN - 1)
        return 0;
    compared by;
    compare(c, &m->frozen, now, pose->value, pose->value, &by);
    const real far = k->monitor_position, turned = k->monitor_heading;
    const ddmpc_time now_time = m->now.time;
    const int wheels = (honest & 1 << DDMPC_OF_WHEELS) && lasts(&m->wheels, m->frozen.time, now_time) &&
                       (differ(now->sum[WHEEL_DISTANCE], m->frozen.sum[WHEEL_DISTANCE], far) ||
                        ddmpc_fabs(by.wheel_turn) > turned);
    const int gyro = (honest & 1 << DDMPC_OF_YAW_RATE) && lasts(&m->gyro, m->frozen.time, now_time) &&
                     ddmpc_fabs(by.gyro_turn) > turned;
    const int model = differ(now->sum[MODEL_DISTANCE], m->frozen.sum[MODEL_DISTANCE], far) ||
                      ddmpc_fabs(by.model_turn) > turned;
    return wheels + gyro + model >= 2;
}

static void count(ddmpc_controller *c, int found, int agrees, ddmpc_time stamp, ddmpc_time passed)
{
    ddmpc_monitor *m = &c->monitor;
    const ddmpc_time now = m->now.time;
    const int repeats[3] = {now - m->wheels.changed > SILENCE, now - m->gyro.changed > SILENCE, m->same > 0};
    for (int i = 0; i < 3; i++) {
        const int bit = 1 << i;
        if (!(found & bit))
            m->contradictions[i] = 0;
        else if (m->contradictions[i]++ == 0)
            m->since[i] = stamp;
        const ddmpc_time lasting = stamp - m->since[i];
        if ((found & bit) && ((m->contradictions[i] >= OFTEN && lasting >= LASTING) || lasting >= WINDOW_LENGTH[SHORT])) {
            m->agreed[i] = 0.0;
            if (!(m->accused & bit)) {
                m->accused |= bit;
                m->newly |= bit;
                m->repeats = repeats[i] ? m->repeats | bit : m->repeats & ~bit;
            }
        }
        if (!(m->accused & bit))
            continue;
        if (found & bit)
            m->agreed[i] = 0.0;
        else if ((agrees & bit) && !repeats[i])
            m->agreed[i] += passed;
        if (m->agreed[i] >= (ddmpc_time)c->constants->monitor_trust)
            m->accused &= ~bit;
    }
}

/* The newest pose kept that is older by `length` [s] than `stamp`; 0 if there is none. */
static const ddmpc_seen_pose *seen_before(const ddmpc_monitor *m, ddmpc_time stamp, ddmpc_time length)
{
    for (int ago = 0; ago < m->poses; ago++) {
        const ddmpc_seen_pose *seen = &m->pose[(m->newest_pose + MONITORED_POSES - ago) % MONITORED_POSES];
        if (stamp - seen->then.time >= length - 1e-9)
            return stamp - seen->then.time < 2.0 * length ? seen : 0;
    }
    return 0;
}

/* Motion at two instants, both earlier by a delay. */
static int both(ddmpc_monitor *m, const ddmpc_motion *from, const ddmpc_motion *to, ddmpc_time delay, ddmpc_motion *f,
                ddmpc_motion *t)
{
    return motion_at(m, from->time - delay, f) && motion_at(m, to->time - delay, t);
}

/* How well poses fit motion that is earlier by each delay. */
static void weigh_delays(ddmpc_controller *c, const ddmpc_seen_pose *from, const ddmpc_motion *to,
                         const ddmpc_checked_pose *pose, const real noise[2])
{
    ddmpc_monitor *m = &c->monitor;
    for (int i = 0; i <= DELAYS; i++) {
        ddmpc_motion f, t;
        compared by;
        if (!both(m, &from->then, to, LATEST * i / DELAYS, &f, &t))
            return;
        compare(c, &f, &t, from->value, pose->value, &by);
        const real forward = (by.pose - by.wheels) / (R(0.02) + noise[0] + R(0.05) * ddmpc_fabs(by.wheels));
        const real turn = (by.pose_turn - by.gyro_turn) / (R(0.01) + noise[1] + R(0.02) * ddmpc_fabs(by.gyro_turn));
        m->misfit[i] = R(0.99) * m->misfit[i] + ddmpc_min(square(forward), OUTLIER) + ddmpc_min(square(turn), OUTLIER);
    }
}

static void learn(real sums[2], real by, real turn)
{
    sums[0] += by * turn;
    sums[1] += by * by;
    if (sums[1] > MOST_TURN) {
        sums[0] *= MOST_TURN / sums[1];
        sums[1] = MOST_TURN;
    }
}

int ddmpc_monitor_judge(ddmpc_controller *c, const ddmpc_checked_pose *pose)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_monitor *m = &c->monitor;
    ddmpc_motion now;
    m->newly = 0;
    if (!k->monitor || !motion_at(m, pose->stamp, &now))
        return 0;
    const int honest = ~m->accused;
    const ddmpc_time passed = m->poses > 0 || m->residuals > 0 ? pose->stamp - m->last.stamp : 0.0;
    const int is_frozen = m->seen && frozen(c, pose, &now, honest);
    int found = 0, agrees = 0, drift = 0;
    if (!m->seen)
        m->frozen = now;
    const real noise[2] = {
        ddmpc_sqrt((pose->covariance[0][0] + pose->covariance[1][1]) * ddmpc_max(m->scatter[0], R(1.0))),
        ddmpc_sqrt(R(2.0) * pose->covariance[2][2] * ddmpc_max(m->scatter[1], R(1.0)))};
    if (m->seen) {
        /* A pose that moves faster than the robot can has leapt: that is another question. */
        compared by;
        compare(c, &m->last_motion, &now, m->last.value, pose->value, &by);
        const real most = k->monitor_position + NOISE * noise[0] + R(2.0) * k->largest_command[0] * (real)passed;
        const real widest = k->monitor_heading + NOISE * noise[1] + R(2.0) * k->largest_command[1] * (real)passed;
        if (!(ddmpc_hypot(pose->value[0] - m->last.value[0], pose->value[1] - m->last.value[1]) <= most &&
              ddmpc_fabs(by.pose_turn) <= widest)) {
            m->poses = m->residuals = 0;
        } else if (passed <= 0.25 && !is_frozen) {
            scatter(c, pose, &by);
        }
    }
    /* Stamps are believed until motion says otherwise. */
    m->delay = 0;
    for (int i = 1; i <= DELAYS; i++)
        if (m->misfit[i] + LATE < m->misfit[0] && m->misfit[i] < m->misfit[m->delay])
            m->delay = i;
    compared seen[WINDOWS];
    for (int window = SHORT; window < WINDOWS; window++) {
        const ddmpc_seen_pose *from = seen_before(m, pose->stamp, WINDOW_LENGTH[window]);
        if (!from)
            break;
        int here = 0, agreed = 0;
        /* Delays that what was seen so far does not exclude, the likeliest first. */
        for (int i = -1; i <= DELAYS; i++) {
            const int delay = i < 0 ? m->delay : i;
            ddmpc_motion f, t;
            compared by;
            if (i >= 0 && (!here || m->misfit[i] > m->misfit[m->delay] + OUTLIER))
                continue;
            if (!both(m, &from->then, &now, LATEST * delay / DELAYS, &f, &t)) {
                here = agreed = 0;
                break;
            }
            compare(c, &f, &t, from->value, pose->value, &by);
            if (i < 0) { real *d = c->result.debug + (window == LONG ? 10 : window == MIDDLE ? 37 : 0); if (window == MIDDLE) {d[0]=by.pose-by.wheels; d[1]=by.left;} else { d[0]=by.pose; d[1]=by.wheels; d[2]=by.model; d[3]=by.pose_turn; d[4]=by.wheel_turn; d[5]=by.gyro_turn; d[6]=by.model_turn; d[7]=by.left; d[8]=noise[0]; d[9]=noise[1]; } }
            const int wheels = lasts(&m->wheels, f.time, m->now.time), gyro = lasts(&m->gyro, f.time, m->now.time);
            const int w = wheels && (honest & 1 << DDMPC_OF_WHEELS), g = gyro && (honest & 1 << DDMPC_OF_YAW_RATE);
            int ignored;
            if (i < 0)
                seen[window] = by;
            if (window == LONG && i < 0 && w && g && drifts(c, &seen[MIDDLE], &by, noise[0]))
                drift = 1;
            here = honest & 1 << DDMPC_OF_POSE || w || g ? suspects(c, &by, w, g, noise, &agreed) : 0;
            if (m->accused)
                /* Whether one that is accused agrees again. */
                suspects(c, &by, wheels && (honest & 1 << DDMPC_OF_POSE || w), gyro && (honest & 1 << DDMPC_OF_POSE || g),
                         noise, &ignored), agreed |= ignored & m->accused;
            if (!here && window == SHORT && !m->accused && gyro && wheels && pose->stamp >= m->next_pose) {
                learn(m->body_by_wheels, t.sum[WHEEL_TURN] - f.sum[WHEEL_TURN], by.gyro_turn);
                learn(m->body_by_model, t.sum[MODEL_TURN] - f.sum[MODEL_TURN], by.gyro_turn);
                learn(m->wheels_by_model, t.sum[MODEL_TURN] - f.sum[MODEL_TURN], t.sum[WHEEL_TURN] - f.sum[WHEEL_TURN]);
                weigh_delays(c, from, &now, pose, noise);
            }
        }
        if (m->accused & 1 << DDMPC_OF_POSE)
            here &= 1 << DDMPC_OF_POSE;
        found |= here;
        if (window == SHORT)
            agrees = agreed;
    }
    { real *d = c->result.debug + 20; d[0]=found; d[1]=agrees; d[2]=m->scatter[0]; d[3]=m->scatter[1]; d[4]=m->body_by_wheels[0]/m->body_by_wheels[1]*k->wheel_yaw_ratio; d[5]=m->body_by_wheels[1]; d[6]=m->wheels_by_model[0]/m->wheels_by_model[1]/k->wheel_yaw_ratio; d[17]=drift; d[7]=m->delay; d[16]=m->accused; for(int i=0;i<7;i++) d[8+i]=m->misfit[i]; d[15]=pose->stamp;}
    if (drift)
        found |= 1 << DDMPC_OF_POSE;
    count(c, found, agrees, pose->stamp, ddmpc_min(passed, 0.25));
    if (is_frozen) {
        m->newly |= ~m->accused & 1 << DDMPC_OF_POSE;
        m->accused |= 1 << DDMPC_OF_POSE;
        m->repeats |= 1 << DDMPC_OF_POSE;
        m->agreed[DDMPC_OF_POSE] = 0.0;
    }
    if (m->poses == 0 || pose->stamp >= m->next_pose) {
        m->newest_pose = (m->newest_pose + 1) % MONITORED_POSES;
        m->poses += m->poses < MONITORED_POSES;
        ddmpc_seen_pose *seen = &m->pose[m->newest_pose];
        memcpy(seen->value, pose->value, sizeof seen->value);
        seen->then = now;
        m->next_pose = pose->stamp + 0.1 - 1e-9;
    }
    m->last = *pose;
    m->last_motion = now;
    m->seen = 1;
    return m->newly;
}

static real widening(real scatter) { return scatter > NOISY ? ddmpc_min(scatter, NOISIEST) : R(1.0); }

void ddmpc_monitor_widen(const ddmpc_controller *c, ddmpc_checked_pose *pose)
{
    const real *scatter = c->monitor.scatter;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            pose->covariance[i][j] *= ddmpc_sqrt(widening(scatter[i / 2]) * widening(scatter[j / 2]));
}

void ddmpc_monitor_report(ddmpc_controller *c)
{
    const ddmpc_constants *k = c->constants;
    const ddmpc_monitor *m = &c->monitor;
    ddmpc_result *result = &c->result;
    const real body = m->body_by_wheels[0] / m->body_by_wheels[1] * k->wheel_yaw_ratio;
    const real wheels = m->wheels_by_model[0] / m->wheels_by_model[1] / k->wheel_yaw_ratio, most = k->monitor_turn_ratio;
    result->reasons |= (unsigned int)m->accused * DDMPC_WHEELS_ACCUSED;
    result->repeating = m->repeats & m->accused;
    result->pose_scatter = ddmpc_max(m->scatter[0], m->scatter[1]);
    result->pose_delay = (real)(LATEST * m->delay / DELAYS);
    result->turn_ratio[0] = wheels;
    result->turn_ratio[1] = body;
    if (result->pose_scatter > NOISY)
        result->reasons |= DDMPC_POSES_SCATTER;
    if (m->delay > 0)
        result->reasons |= DDMPC_POSES_LATE;
    if (m->body_by_wheels[1] > MUCH_TURN && m->wheels_by_model[1] > MUCH_TURN &&
        !(wheels < most && wheels * most > R(1.0) && body < most && body * most > R(1.0)))
        result->reasons |= DDMPC_TURNS_OTHERWISE;
}
