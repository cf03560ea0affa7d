/* Finds the sensor that the others contradict: whenever a pose comes, motion by poses, wheels, gyro and the commands
 * sent is compared over windows of time, and two that agree outvote a third. The commands are no sensor: a robot may be
 * held, pushed or slip, so what they promise counts only beside what a sensor says. */
#include <string.h>

#include "internal.h"

enum { SHORT, MIDDLE, LONG, WINDOWS };
enum { BY_WHEELS = 1 << DDMPC_OF_WHEELS, BY_GYRO = 1 << DDMPC_OF_YAW_RATE, BY_POSE = 1 << DDMPC_OF_POSE, SENSES = 3 };

/* Windows over which motion is compared, the last two for what creeps [s]. */
static const ddmpc_time WINDOW_LENGTH[WINDOWS] = {0.5, 1.5, 3.0};
/* Poses later than stamped are looked for up to here [s]. */
#define LATEST 0.3
/* A sensor that is silent for longer is no witness meanwhile [s]. */
#define SILENCE 0.1
/* Time between the poses that are kept [s]. */
#define POSE_SPACING 0.1
/* A contradiction has to last [s], and to be seen so often; poses have to drift for longer [s]. */
#define LASTING 0.1
#define OFTEN 3
#define LONG_LASTING 0.3
/* Noise of a pose within which a difference means nothing, in standard deviations of the difference of two. */
#define NOISE R(3.0)
/* Poses that scatter by more than this, in variance over the one stated, count for less, but not for nothing. */
#define NOISY R(6.25)
#define NOISIEST R(400.0)
/* Shares of a turn by which slip may change within a window, and by which it is taken for slip at all. */
#define SLIPPING R(0.3)
#define SLIDING R(0.1)
/* Drift of poses beyond that of dead reckoning: over the contradiction allowed, and in addition by distance and turn. */
#define DRIFTING R(1.4)
#define CREEPING R(0.02)
/* For so long slip is remembered [s]. Dead reckoning uses that of a while ago, as the newest may have been learned from
   a sensor that is about to be found out. */
#define SLIP_MEMORY 5.0
/* In curves with more acceleration to the side than this, slip may carry a robot out of them [m/s^2]. */
#define SIDEWAYS R(0.4)
/* Gains of turning: certain as if learned from the first [rad^2], of the last at most, told from the middle one on. */
#define FIRST_TURN R(0.2)
#define MUCH_TURN R(6.0)
#define MOST_TURN R(8.0)
#define HELD R(0.2) /* turning less than this share of what its wheels do, it is held */
/* Share of a newly seen scatter in its mean, which the first ones exceed: a mean of all, the stated one among them.
   A squared deviation counts no more than OUTLIER. */
#define NOVELTY R(0.04)
#define FIRST_ONES 25
#define OUTLIER R(9.0)
/* By so much poses must fit better at another delay before it is taken for theirs, and what is left of it at the next
   pose that is kept. */
#define LATE R(16.0)
#define FADING R(0.99)
/* Sums are counted from nought again beyond this, so that single precision stays sharp. */
#define FAR R(64.0)

static real square(real x) { return x * x; }

static int differ(real a, real b, real most) { return ddmpc_fabs(a - b) > most; }

static real quotient(const real sums[2]) { return sums[0] / sums[1]; }

void ddmpc_monitor_clear(ddmpc_controller *c)
{
    ddmpc_monitor *m = &c->monitor;
    memset(m, 0, sizeof *m);
    m->wheels.heard = m->gyro.heard = m->slipped = -HUGE_VAL;
    m->body_by_wheels[1] = m->body_by_model[1] = m->wheels_by_model[1] = FIRST_TURN;
    m->body_by_wheels[0] = FIRST_TURN / c->constants->wheel_yaw_ratio;
    m->body_by_model[0] = FIRST_TURN;
    m->wheels_by_model[0] = FIRST_TURN * c->constants->wheel_yaw_ratio;
    m->widest[0] = m->widest[1] = R(1.0);
}

/* The motion up to now, `ago` of those that are kept. */
static ddmpc_motion *past(ddmpc_monitor *m, int ago) { return &m->path[(m->newest + MONITORED - ago) % MONITORED]; }

void ddmpc_monitor_predict(ddmpc_controller *c, const real *newest)
{
    ddmpc_monitor *m = &c->monitor;
    const real half = R(0.5) * (real)c->constants->sample_time;
    real state[DDMPC_MOST_STATES], before[2], after[2];
    if (!c->constants->monitor)
        return;
    ddmpc_velocity_output(c, m->state, before, 0);
    ddmpc_velocity_step(c, m->state, newest, state, 0, 0);
    memcpy(m->state, state, (size_t)STATES(c) * sizeof(real));
    ddmpc_velocity_output(c, state, after, 0);
    m->now.sum[MODEL_DISTANCE] += half * (before[0] + after[0]);
    m->now.sum[MODEL_TURN] += half * (before[1] + after[1]);
}

static void hear(ddmpc_hearing *heard, ddmpc_time t, const real *value, int count)
{
    const int paused = t - heard->heard > SILENCE;
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

/* Count a sum from nought again, wherever it is kept. */
static void rebase(ddmpc_monitor *m, int i)
{
    const real off = m->now.sum[i];
    m->now.sum[i] = R(0.0);
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
    const real before[3] = {m->wheels.value[0], m->wheels.value[1], m->gyro.value[0]};
    if (!c->constants->monitor)
        return;
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
    const real *newest = ddmpc_estimator_slip(c);
    const real share = m->moves > 0 ? ddmpc_min(dt / (real)SLIP_MEMORY, R(1.0)) : R(1.0);
    for (int i = 0; i < SLIPS(c); i++)
        m->slip[i] += share * (newest[i] - m->slip[i]);
    const real *slip = m->slip, speed = R(0.5) * (before[0] + m->wheels.value[0]);
    const real wheel_turn = R(0.5) * dt * (before[1] + m->wheels.value[1]);
    const real gyro_turn = R(0.5) * dt * (before[2] + m->gyro.value[0]);
    /* The gyro turns it, or without one the wheels. */
    const int silent = t - m->gyro.heard > SILENCE || (m->accused & BY_GYRO);
    const real turn = silent ? quotient(m->body_by_wheels) * wheel_turn : gyro_turn;
    real forward = slip[LONGITUDINAL_GAIN] * speed * dt + slip[TURN_LEFT] * turn;
    real left = -(slip[TURN_AHEAD] + slip[SIDE_SLIP] * speed) * turn;
    if (CURVED(c)) {
        forward += slip[FORWARD_COUPLING] * speed * wheel_turn;
        left += slip[CRAB] * speed * dt;
    }
    real *sum = m->now.sum;
    const real heading = sum[HEADING] + R(0.5) * turn;
    sum[FORWARD] += forward * ddmpc_cos(heading) - left * ddmpc_sin(heading);
    sum[LEFT] += forward * ddmpc_sin(heading) + left * ddmpc_cos(heading);
    sum[HEADING] += turn;
    sum[WHEEL_DISTANCE] += speed * dt;
    sum[WHEEL_TURN] += wheel_turn;
    sum[GYRO_TURN] += gyro_turn;
    m->now.time = t;
    const ddmpc_time reach = WINDOW_LENGTH[LONG] + POSE_SPACING + LATEST + (ddmpc_time)c->constants->stamp_history;
    if (m->moves == 0 || t - past(m, 0)->time >= reach / (MONITORED - 2)) {
        m->newest = (m->newest + 1) % MONITORED;
        m->moves += m->moves < MONITORED;
        *past(m, 0) = m->now;
    }
    for (int i = 0; i < MOTIONS; i++)
        /* Not the other way round: what is not finite has to go. */
        if (!(ddmpc_fabs(sum[i]) <= FAR))
            rebase(m, i);
}

/* The motion up to `time`, between the instants that are kept; 0 if they do not reach back so far. */
static int motion_at(ddmpc_monitor *m, ddmpc_time time, ddmpc_motion *found)
{
    /* The newest that is not later lies from `low` to `high`. */
    int low = 0, high = m->moves - 1;
    if (high < 0 || past(m, high)->time > time)
        return 0;
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
    found->time = time;
    for (int i = 0; i < MOTIONS; i++)
        found->sum[i] = before->sum[i] + share * (after->sum[i] - before->sum[i]);
    return 1;
}

/* What each says of the motion between two instants, seen from the heading halfway. */
typedef struct {
    real pose, wheels, model;            /* forward [m], by wheels with slip */
    real left;                           /* of the pose, beyond dead reckoning [m] */
    real pose_turn, wheel_turn, gyro_turn, model_turn; /* of the body, with the gains seen so far [rad] */
    real wheel_advance, wheel_excess;    /* of the wheels beyond what was commanded, without slip [m, rad] */
    real heading;                        /* of the pose halfway [rad] */
} motions;

static motions compare(const ddmpc_monitor *m, const ddmpc_motion *from, const ddmpc_motion *to, const real before[3],
                       const real after[3])
{
    motions by;
    real sum[MOTIONS];
    for (int i = 0; i < MOTIONS; i++)
        sum[i] = to->sum[i] - from->sum[i];
    /* A robot may turn round within a window: of whole turns the gyro knows. */
    by.pose_turn = sum[HEADING] + ddmpc_wrap(after[2] - before[2] - sum[HEADING]);
    by.gyro_turn = sum[GYRO_TURN];
    by.wheel_turn = quotient(m->body_by_wheels) * sum[WHEEL_TURN];
    by.model_turn = quotient(m->body_by_model) * sum[MODEL_TURN];
    by.wheel_advance = sum[WHEEL_DISTANCE] - sum[MODEL_DISTANCE];
    by.wheel_excess = sum[WHEEL_TURN] - quotient(m->wheels_by_model) * sum[MODEL_TURN];
    by.heading = before[2] + R(0.5) * by.pose_turn;
    const real reckoned = from->sum[HEADING] + R(0.5) * sum[HEADING];
    const real cosine[2] = {ddmpc_cos(by.heading), ddmpc_cos(reckoned)};
    const real sine[2] = {ddmpc_sin(by.heading), ddmpc_sin(reckoned)};
    const real dx = after[0] - before[0], dy = after[1] - before[1];
    by.pose = cosine[0] * dx + sine[0] * dy;
    by.wheels = cosine[1] * sum[FORWARD] + sine[1] * sum[LEFT];
    by.left = cosine[0] * dy - sine[0] * dx - (cosine[1] * sum[LEFT] - sine[1] * sum[FORWARD]);
    by.model = sum[MODEL_DISTANCE];
    /* The chord of its way, as of the wheels'. */
    if (ddmpc_fabs(by.wheels) < ddmpc_fabs(sum[WHEEL_DISTANCE]))
        by.model *= ddmpc_fabs(by.wheels / sum[WHEEL_DISTANCE]);
    return by;
}

/* Whom a comparison speaks against, of those who are `heard`; `agreeing` are confirmed by the others in motion. */
static int suspects(const ddmpc_constants *k, const motions *by, int heard, const real noise[2], int *agreeing)
{
    const real far = k->monitor_position + NOISE * noise[0], turned = k->monitor_heading + NOISE * noise[1];
    const real slip = turned + SLIPPING * ddmpc_fabs(by->wheel_turn);
    const real promise = turned + SLIPPING * ddmpc_fabs(by->model_turn);
    const real p = by->pose_turn, w = by->wheel_turn, g = by->gyro_turn, m = by->model_turn;
    const int wheels = heard & BY_WHEELS, gyro = heard & BY_GYRO;
    const int pg = gyro && differ(p, g, turned), pw = wheels && differ(p, w, slip);
    const int apart = wheels && differ(by->pose, by->wheels, far);
    const int moves = ddmpc_fabs(by->pose) > far || ddmpc_fabs(p) > turned;
    /* Between poses and gyro the wheels decide, or without them the commands. */
    const real third = wheels ? w : m;
    int found = 0;
    if (pg && R(2.0) * ddmpc_fabs(p - third) < ddmpc_fabs(g - third))
        found |= BY_GYRO;
    if (pg && R(2.0) * ddmpc_fabs(g - third) < ddmpc_fabs(p - third))
        found |= BY_POSE;
    /* Wheels that slip still turn as commanded. */
    if (pw && !pg && (!gyro || differ(g, w, slip)) && !differ(p, m, promise) && ddmpc_fabs(by->wheel_excess) > promise)
        found |= BY_WHEELS;
    if (apart && ddmpc_fabs(by->wheel_advance) > far && differ(by->model, by->wheels, far) &&
        R(2.0) * ddmpc_fabs(by->pose - by->model) < ddmpc_fabs(by->pose - by->wheels))
        found |= BY_WHEELS;
    *agreeing = (gyro && !pg && moves ? BY_GYRO : 0) | (wheels && !pw && !apart && moves ? BY_WHEELS : 0) |
                ((gyro || wheels) && !pg && !apart ? BY_POSE : 0);
    return found;
}

/* Whether poses go steadily away from dead reckoning while nothing slips. */
static int drifts(const ddmpc_constants *k, const motions *half, const motions *whole, real noise)
{
    const real most = DRIFTING * k->monitor_position + NOISE * noise + CREEPING * ddmpc_fabs(whole->wheels);
    const real turned = k->monitor_heading + CREEPING * ddmpc_fabs(whole->gyro_turn);
    const real duration = (real)WINDOW_LENGTH[LONG];
    if (ddmpc_fabs(whole->wheels * whole->gyro_turn) > SIDEWAYS * duration * duration ||
        differ(whole->gyro_turn, whole->wheel_turn, turned) || ddmpc_fabs(whole->wheel_excess) > R(2.0) * turned)
        return 0;
    /* About half of the way in the second half of the time: a push or a correction comes at once. */
    const real half_off = half->pose - half->wheels, off = whole->pose - whole->wheels;
    const real cosine = ddmpc_cos(whole->heading - half->heading), sine = ddmpc_sin(whole->heading - half->heading);
    const real size = square(off) + square(whole->left);
    const real along = half_off * (cosine * off - sine * whole->left) + half->left * (sine * off + cosine * whole->left);
    return size > square(most) && along > R(0.25) * size && along < R(0.8) * size;
}

/* Learn how poses scatter beyond what they state from second differences, in which steady slip has no part. */
static void learn_scatter(ddmpc_monitor *m, const ddmpc_checked_pose *pose, const motions *by)
{
    const real stated[2] = {R(0.5) * (pose->covariance[0][0] + pose->covariance[1][1]), pose->covariance[2][2]};
    const real off[3] = {by->pose - by->wheels, by->left, by->pose_turn - by->gyro_turn};
    real seen[2] = {R(0.0), R(0.0)};
    for (int i = 0; i < 3; i++) {
        /* 1 + 4 + 1 variances in each; the first two are along and across. */
        seen[i / 2] += square(off[i] - m->residual[i]) / (i < 2 ? R(12.0) : R(6.0));
        m->residual[i] = off[i];
    }
    if (m->residuals < FIRST_ONES)
        m->residuals++;
    if (m->residuals <= 2)
        return;
    const real share = ddmpc_max(NOVELTY, R(1.0) / (real)m->residuals);
    for (int i = 0; i < 2; i++) {
        const real most = OUTLIER * ddmpc_max(m->scatter[i], R(1.0)), ratio = seen[i] / stated[i];
        /* Not by min: NaN must go. */
        m->scatter[i] += share * ((ratio < most ? ratio : most) - m->scatter[i]);
    }
}

static void learn_gain(real sums[2], real by, real turn)
{
    sums[0] += by * turn;
    sums[1] += by * by;
    if (sums[1] > MOST_TURN) {
        sums[0] *= MOST_TURN / sums[1];
        sums[1] = MOST_TURN;
    }
}

static ddmpc_time delay_of(int index) { return LATEST * index / (MONITORED_DELAYS - 1); }

/* The motion between two instants that are earlier by a delay; 0 if it is not kept. */
static int compare_late(ddmpc_monitor *m, const ddmpc_seen_pose *from, const ddmpc_motion *to, int delay,
                        const real pose[3], motions *by)
{
    ddmpc_motion begin, end;
    if (!motion_at(m, from->then.time - delay_of(delay), &begin) || !motion_at(m, to->time - delay_of(delay), &end))
        return 0;
    *by = compare(m, &begin, &end, from->value, pose);
    return 1;
}

/* Learn how far wheels and body turn for what is commanded, and how late poses are. */
static void learn(ddmpc_monitor *m, const ddmpc_seen_pose *from, const ddmpc_motion *now, const real pose[3],
                  const real noise[2])
{
    motions by;
    if (!m->creeping && compare_late(m, from, now, m->delay, pose, &by)) {
        const real turn = R(0.5) * (by.pose_turn + by.gyro_turn);
        const real wheels = by.wheel_turn / quotient(m->body_by_wheels);
        const real model = by.model_turn / quotient(m->body_by_model);
        /* Of a robot that is held nothing is learned. */
        if (ddmpc_fabs(turn) >= HELD * ddmpc_fabs(wheels)) {
            learn_gain(m->body_by_wheels, wheels, turn);
            learn_gain(m->body_by_model, model, turn);
        }
        learn_gain(m->wheels_by_model, model, wheels);
    }
    for (int i = 0; i < MONITORED_DELAYS && compare_late(m, from, now, i, pose, &by); i++) {
        const real forward = (by.pose - by.wheels) / (R(0.02) + noise[0] + R(0.15) * ddmpc_fabs(by.wheels));
        const real turn = (by.pose_turn - by.gyro_turn) / (R(0.01) + noise[1] + R(0.02) * ddmpc_fabs(by.gyro_turn));
        m->misfit[i] = FADING * m->misfit[i] + ddmpc_min(square(forward), OUTLIER) + ddmpc_min(square(turn), OUTLIER);
    }
    /* Stamps are believed until motion says otherwise. */
    m->delay = 0;
    for (int i = 1; i < MONITORED_DELAYS; i++)
        if (m->misfit[i] + LATE < m->misfit[0] && m->misfit[i] < m->misfit[m->delay])
            m->delay = i;
}

/* Which sensors have come without a pause since `time`. */
static int heard_since(const ddmpc_monitor *m, ddmpc_time time)
{
    const int wheels = m->wheels.since <= time && m->now.time - m->wheels.heard <= SILENCE;
    const int gyro = m->gyro.since <= time && m->now.time - m->gyro.heard <= SILENCE;
    return (wheels ? BY_WHEELS : 0) | (gyro ? BY_GYRO : 0);
}

/* Whether a pose that repeats itself does so while two others say that the robot moves. */
static int is_frozen(ddmpc_controller *c, const real pose[3], const ddmpc_motion *now)
{
    const real far = c->constants->monitor_position, turned = c->constants->monitor_heading;
    ddmpc_monitor *m = &c->monitor;
    m->same++;
    for (int i = 0; i < 3; i++)
        if (pose[i] != m->last.value[i])
            m->same = 0;
    if (m->same == 0)
        m->frozen = *now;
    if (m->same < OFTEN - 1)
        return 0;
    const motions by = compare(m, &m->frozen, now, pose, pose);
    const int heard = heard_since(m, m->frozen.time) & ~m->accused;
    const int model = differ(now->sum[MODEL_DISTANCE], m->frozen.sum[MODEL_DISTANCE], far) ||
                      ddmpc_fabs(by.model_turn) > turned;
    const int wheels = differ(now->sum[WHEEL_DISTANCE], m->frozen.sum[WHEEL_DISTANCE], far) ||
                       ddmpc_fabs(by.wheel_turn) > turned;
    const int gyro = ddmpc_fabs(by.gyro_turn) > turned;
    return model + (wheels && (heard & BY_WHEELS)) + (gyro && (heard & BY_GYRO)) >= 2;
}

/* The newest pose kept that is older by `length` [s] than `stamp`; 0 if there is none, or only one far older. */
static const ddmpc_seen_pose *seen_before(const ddmpc_monitor *m, ddmpc_time stamp, ddmpc_time length)
{
    for (int ago = 0; ago < m->poses; ago++) {
        const ddmpc_seen_pose *seen = &m->pose[(m->newest_pose + MONITORED_POSES - ago) % MONITORED_POSES];
        if (stamp - seen->then.time >= length - 1e-9)
            return stamp - seen->then.time < 2.0 * length ? seen : 0;
    }
    return 0;
}

/* Whom the motion up to this pose speaks against. */
static int judge(ddmpc_controller *c, const ddmpc_checked_pose *pose, const ddmpc_motion *now, const real noise[2],
                 int *agreeing)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_monitor *m = &c->monitor;
    const int accused = m->accused, told = accused & BY_POSE ? ~accused : BY_WHEELS | BY_GYRO;
    int found = 0, drifting = 0;
    motions likeliest[WINDOWS];
    for (int window = SHORT; window < WINDOWS; window++) {
        const ddmpc_seen_pose *from = seen_before(m, pose->stamp, WINDOW_LENGTH[window]);
        if (!from || !compare_late(m, from, now, m->delay, pose->value, &likeliest[window]))
            break;
        motions *by = &likeliest[window];
        const int there = heard_since(m, from->then.time - delay_of(m->delay)), heard = there & ~accused;
        const int all = heard == (BY_WHEELS | BY_GYRO);
        if (window == MIDDLE)
            continue;
        int ignored, here = suspects(k, by, heard, noise, window == SHORT && !accused ? agreeing : &ignored);
        if (window == SHORT && accused) {
            /* Those whom the poses, or who the poses are to be compared with. */
            suspects(k, by, there & told, noise, agreeing);
        }
        /* Delays that have not been excluded so far explain it as well. */
        for (int i = 0; here && i < MONITORED_DELAYS; i++) {
            motions late;
            if (i == m->delay || m->misfit[i] > m->misfit[m->delay] + OUTLIER)
                continue;
            here = compare_late(m, from, now, i, pose->value, &late) ? suspects(k, &late, heard, noise, &ignored) : 0;
        }
        found |= here;
        if (window == SHORT) {
            const real turned = k->monitor_heading + noise[1] + SLIDING * ddmpc_fabs(by->wheel_turn);
            const int spinning = R(2.0) * ddmpc_fabs(by->pose) < ddmpc_fabs(by->wheels) &&
                                 differ(by->pose, by->wheels, k->monitor_position + NOISE * noise[0]);
            if (all && (spinning || differ(by->gyro_turn, by->wheel_turn, turned)))
                m->slipped = pose->stamp;
            const int alive = m->now.time - (m->wheels.changed < m->gyro.changed ? m->wheels.changed : m->gyro.changed) <= SILENCE;
            if (!here && !accused && alive && there == (BY_WHEELS | BY_GYRO) && pose->stamp >= m->next_pose)
                learn(m, from, now, pose->value, noise);
        } else {
            m->creeping = differ(by->pose_turn, by->gyro_turn, R(0.5) * k->monitor_heading + noise[1]);
            drifting = all && pose->stamp - m->slipped > SLIP_MEMORY && drifts(k, &likeliest[MIDDLE], by, noise[0]);
        }
    }
    if (!drifting)
        m->steady = pose->stamp;
    if (pose->stamp - m->steady > LONG_LASTING)
        found |= BY_POSE;
    /* By poses that are not believed nobody else is accused. */
    return accused & BY_POSE ? found & BY_POSE : found;
}

/* Accuse who has been contradicted for long enough, and believe who has agreed for long enough. */
static void decide(ddmpc_controller *c, int found, int agreeing, ddmpc_time stamp, ddmpc_time passed)
{
    ddmpc_monitor *m = &c->monitor;
    const ddmpc_time now = m->now.time;
    const int repeats[SENSES] = {now - m->wheels.changed > SILENCE, now - m->gyro.changed > SILENCE, m->same > 0};
    for (int i = 0; i < SENSES; i++) {
        const int bit = 1 << i;
        if (found & bit) {
            if (m->contradictions[i]++ == 0)
                m->since[i] = stamp;
            const ddmpc_time lasting = stamp - m->since[i];
            m->agreed[i] = 0.0;
            if ((m->contradictions[i] < OFTEN || lasting < LASTING) && lasting < WINDOW_LENGTH[SHORT])
                continue;
            if (!(m->accused & bit))
                m->repeating = repeats[i] ? m->repeating | bit : m->repeating & ~bit;
            m->accused |= bit;
        } else {
            m->contradictions[i] = 0;
            if ((m->accused & agreeing & bit) && !repeats[i])
                m->agreed[i] += passed;
            if (m->agreed[i] >= (ddmpc_time)c->constants->monitor_trust) {
                m->accused &= ~bit;
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
    if (m->seen) {
        const ddmpc_time passed = pose->stamp - m->last.stamp;
        const motions by = compare(m, &m->last_motion, &now, m->last.value, pose->value);
        frozen = is_frozen(c, pose->value, &now);
        /* One that goes further at once than a wrong sensor could make it has leapt, which is another question. */
        const real far = R(0.5) * k->monitor_position + NOISE * noise[0] + k->largest_command[0] * (real)passed;
        const real turned = R(0.5) * k->monitor_heading + NOISE * noise[1] + k->largest_command[1] * (real)passed;
        if (!(ddmpc_hypot(by.pose - by.wheels, by.left) <= far && !differ(by.pose_turn, by.gyro_turn, turned)))
            m->poses = m->residuals = 0;
        else if (passed <= R(0.25) && m->same == 0)
            learn_scatter(m, pose, &by);
        const int found = judge(c, pose, &now, noise, &agreeing);
        decide(c, found, agreeing, pose->stamp, passed < 0.25 ? passed : 0.25);
    } else {
        m->frozen = now;
    }
    if (frozen) {
        m->accused |= BY_POSE;
        m->repeating |= BY_POSE;
        m->agreed[DDMPC_OF_POSE] = 0.0;
    }
    if (m->accused & ~before) {
        /* What was made of the delay by a wrong sensor. */
        memset(m->misfit, 0, sizeof m->misfit);
        m->delay = 0;
    }
    if (m->poses == 0 || pose->stamp >= m->next_pose) {
        m->newest_pose = (m->newest_pose + 1) % MONITORED_POSES;
        m->poses += m->poses < MONITORED_POSES;
        memcpy(m->pose[m->newest_pose].value, pose->value, sizeof pose->value);
        m->pose[m->newest_pose].then = now;
        m->next_pose = pose->stamp + POSE_SPACING - 1e-9;
    }
    m->last = *pose;
    m->last_motion = now;
    m->seen = 1;
    return m->accused & ~before;
}

static real widening(real scatter) { return scatter > NOISY ? ddmpc_min(scatter, NOISIEST) : R(1.0); }

void ddmpc_monitor_widen(ddmpc_controller *c, ddmpc_checked_pose *pose)
{
    ddmpc_monitor *m = &c->monitor;
    real by[2];
    for (int i = 0; i < 2; i++) {
        const real wide = widening(m->scatter[i]);
        /* What was believed came from poses that were trusted too much. */
        pose->doubt[i] = wide > m->widest[i] ? ddmpc_sqrt(wide / m->widest[i]) : R(1.0);
        m->widest[i] = ddmpc_max(wide, m->widest[i]);
        by[i] = ddmpc_sqrt(wide);
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            pose->covariance[i][j] *= by[i / 2] * by[j / 2];
}

void ddmpc_monitor_report(ddmpc_controller *c)
{
    const ddmpc_monitor *m = &c->monitor;
    ddmpc_result *result = &c->result;
    const real ratio = c->constants->wheel_yaw_ratio, most = c->constants->monitor_turn_ratio;
    const real wheels = quotient(m->wheels_by_model) / ratio, body = quotient(m->body_by_wheels) * ratio;
    result->reasons |= (unsigned int)m->accused * DDMPC_WHEELS_ACCUSED;
    result->repeating = m->repeating & m->accused;
    result->pose_scatter = ddmpc_sqrt(ddmpc_max(m->scatter[0], m->scatter[1]));
    result->pose_delay = (real)delay_of(m->delay);
    result->turn_ratio[0] = wheels;
    result->turn_ratio[1] = body;
    if (square(result->pose_scatter) > NOISY)
        result->reasons |= DDMPC_POSES_SCATTER;
    if (m->delay > 0)
        result->reasons |= DDMPC_POSES_LATE;
    if (m->body_by_wheels[1] > MUCH_TURN && m->wheels_by_model[1] > MUCH_TURN &&
        !(wheels < most && wheels * most > R(1.0) && body < most && body * most > R(1.0)))
        result->reasons |= DDMPC_TURNS_OTHERWISE;
}
