/* The sensor test distinguishes a faulty sensor from an unusual motion without a fault. At each pose, it compares the
 * motions by poses, wheels, gyro and commands over several windows with hypotheses. Hypotheses without a fault: all sensors
 * agree within the effects of slip, slopes and loads; the wheels slip; the robot is blocked. Hypotheses with a fault of one
 * sensor: all other sensors agree. A sensor is excluded if its fault is more likely than all hypotheses without a fault; the
 * required odds follow from the permitted rate of false alarms. */
#include <string.h>

#include "internal.h"

enum { SHORT, MIDDLE, LONG, WINDOWS };
enum { BY_WHEELS = 1 << DDMPC_OF_WHEELS, BY_GYRO = 1 << DDMPC_OF_YAW_RATE, BY_POSE = 1 << DDMPC_OF_POSE, SENSES = 3 };
enum { ABSOLUTE, SHARE };

static real square(real x) { return x * x; }

/* Compute a gain from two sums, with a minimum below the gain of any robot. */
static real quotient(const real sums[2]) { return ddmpc_max(sums[0] / sums[1], R(0.1)); }

/* Compute the variance of a difference with an absolute part and a part proportional to `size`. */
static real variance(const real deviation[2], real size)
{
    return square(deviation[ABSOLUTE]) + square(deviation[SHARE] * size);
}

void ddmpc_monitor_clear(ddmpc_controller *c)
{
    ddmpc_monitor *m = &c->monitor;
    memset(m, 0, sizeof *m);
    m->wheels.arrival = m->gyro.arrival = m->slipped_at = m->blocked_at = -HUGE_VAL;
    m->body_by_wheels[1] = m->body_by_model[1] = m->wheels_by_model[1] = c->constants->gains[0];
    m->body_by_wheels[0] = c->constants->gains[0] / c->constants->wheel_yaw_ratio;
    m->body_by_model[0] = c->constants->gains[0];
    m->wheels_by_model[0] = c->constants->gains[0] * c->constants->wheel_yaw_ratio;
    m->max_scatter[0] = m->max_scatter[1] = R(1.0);
}

/* Return the stored motion that is `age` entries older than the newest. */
static ddmpc_motion *stored_motion(ddmpc_monitor *m, int age)
{
    return &m->path[(m->newest + MONITORED - age) % MONITORED];
}

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
    m->current.sum[MODEL_DISTANCE] += half * (before[0] + after[0]);
    m->current.sum[MODEL_TURN] += half * (before[1] + after[1]);
}

/* Store a new reading of `count` values; a pause longer than `silence` [s] restarts the uninterrupted arrival. */
static void store_reading(ddmpc_last_reading *reading, ddmpc_time silence, ddmpc_time t, const real *value, int count)
{
    const int has_pause = t - reading->arrival > silence;
    int is_equal = 1;
    for (int i = 0; i < count; i++)
        is_equal = is_equal && value[i] == reading->value[i];
    if (has_pause)
        reading->first_arrival = t;
    if (!is_equal || has_pause)
        reading->last_change = t;
    reading->arrival = t;
    memcpy(reading->value, value, (size_t)count * sizeof(real));
}

/* Return 1 if a reading contradicts the commands for all plausible gains. */
static int is_doubtful(const ddmpc_constants *k, real reading, real model)
{
    return ddmpc_fabs(reading - model) > k->doubtful[ABSOLUTE] + k->doubtful[SHARE] * ddmpc_fabs(model);
}

void ddmpc_monitor_count(ddmpc_controller *c, int subject, int impossible)
{
    real *count = &c->monitor.impossible[subject];
    *count = c->constants->impossible[1] * *count + (real)impossible;
}

/* Return 1 if a sensor has recently had so many physically impossible readings that its other readings are unreliable. */
static int is_impossible(const ddmpc_controller *c, int subject)
{
    return c->monitor.impossible[subject] > c->constants->impossible[0];
}

int ddmpc_monitor_doubtful_sensors(const ddmpc_controller *c, ddmpc_time t)
{
    const ddmpc_constants *k = c->constants;
    const ddmpc_monitor *m = &c->monitor;
    const ddmpc_time silence = (ddmpc_time)k->silence;
    real model[2];
    if (!k->monitor || t - m->blocked_at <= R(2.0) * (ddmpc_time)k->windows[SHORT])
        return 0;
    ddmpc_velocity_output(c, m->state, model, 0);
    const real wheel_turn = quotient(m->wheels_by_model) * model[1], body_turn = quotient(m->body_by_model) * model[1];
    const int wheels = is_doubtful(k, m->wheels.value[0], model[0]) || is_doubtful(k, m->wheels.value[1], wheel_turn);
    const int gyro = is_doubtful(k, m->gyro.value[0], body_turn);
    const int wheels_repeat = t - m->wheels.arrival <= silence && t - m->wheels.last_change > silence;
    const int gyro_repeats = t - m->gyro.arrival <= silence && t - m->gyro.last_change > silence;
    /* The wheels turn as commanded, but the gyro has consistently had the opposite sign. */
    const int gyro_opposes = m->turning[1] > k->gyro[ABSOLUTE] && m->turning[0] < R(-0.5) * m->turning[1];
    return ((wheels && wheels_repeat) || is_impossible(c, DDMPC_OF_WHEELS) ? BY_WHEELS : 0) |
           ((gyro && gyro_repeats) || gyro_opposes || is_impossible(c, DDMPC_OF_YAW_RATE) ? BY_GYRO : 0);
}

/* Subtract the current value of a sum from all its copies, to maintain accuracy in single precision. */
static void rebase(ddmpc_monitor *m, int i)
{
    if (!isfinite(m->current.sum[i])) {
        /* The sums are invalid, as are all quantities that were learned from them. */
        m->current.sum[i] = R(0.0);
        m->moves = m->poses = m->residuals = m->has_last = m->has_anchor = 0;
        m->turn_difference = m->course_evidence = m->anchor_evidence = m->fits = m->turning[0] = m->turning[1] = R(0.0);
        memset(m->slip, 0, sizeof m->slip);
        memset(m->gyro_sums, 0, sizeof m->gyro_sums);
        memset(m->wheel_sums, 0, sizeof m->wheel_sums);
        return;
    }
    /* Subtract only whole turns from the heading, because positions were integrated along it. */
    const real turn = R(2.0) * DDMPC_PI,
               offset = i == HEADING ? turn * ddmpc_rint(m->current.sum[i] / turn) : m->current.sum[i];
    m->current.sum[i] -= offset;
    m->frozen.sum[i] -= offset;
    m->last_motion.sum[i] -= offset;
    for (int k = 0; k < MONITORED; k++)
        m->path[k].sum[i] -= offset;
    for (int k = 0; k < MONITORED_POSES; k++)
        m->pose[k].motion.sum[i] -= offset;
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
        store_reading(&m->wheels, silence, t, values, 2);
    }
    if (twists > wheels)
        store_reading(&m->gyro, silence, t, &twist[wheels].value, 1);
    if (m->moves == 0)
        m->current.time = t;
    const real dt = (real)(t - m->current.time);
    if (m->moves > 0 && !(dt > R(0.0)))
        return;
    const real *newest = ddmpc_estimator_slip(c);
    const real share = m->moves > 0 ? ddmpc_min(dt / k->memory, R(1.0)) : R(1.0);
    for (int i = 0; i < SLIPS(c); i++)
        m->slip[i] += share * (newest[i] - m->slip[i]);
    const real *slip = m->slip, speed = R(0.5) * (before[0] + m->wheels.value[0]);
    const real wheel_turn = R(0.5) * dt * (before[1] + m->wheels.value[1]);
    const real gyro_turn = R(0.5) * dt * (before[2] + m->gyro.value[0]);
    /* The heading is integrated from the gyro or, without a gyro, from the wheels. */
    const int no_gyro = t - m->gyro.arrival > silence || (m->excluded & BY_GYRO);
    const real turn = no_gyro ? quotient(m->body_by_wheels) * wheel_turn : gyro_turn;
    real *sum = m->current.sum;
    if (dt > R(0.0)) {
        /* The slide is estimated in the frame of the poses, so the motion is computed in this frame, and then rotated into the
         * frame of the sums. */
        const real theta = newest[POSE(c) + 2], zero = R(0.0), rotation = sum[HEADING] - theta;
        const real model[2] = {speed - slip[V_OFFSET], turn / (dt * slip[OMEGA_GAIN] * slip[YAW_GAIN])};
        const real cosine = ddmpc_cos(rotation), sine = ddmpc_sin(rotation),
                   *arguments[5] = {model, slip, &theta, &zero, &dt};
        real step[3], *results[2] = {step, 0};
        WITH_SLIP(c, move)(arguments, results, 0, 0, 0);
        sum[FORWARD] += cosine * step[0] - sine * step[1];
        sum[LEFT] += sine * step[0] + cosine * step[1];
    }
    real model_now[2];
    ddmpc_velocity_output(c, m->state, model_now, 0);
    if (m->wheels.value[1] * model_now[1] > R(0.0)) {
        const real decay = ddmpc_max(R(1.0) - dt / k->memory, R(0.0)), product = m->gyro.value[0] * m->wheels.value[1];
        m->turning[0] = decay * m->turning[0] + dt * product;
        m->turning[1] = decay * m->turning[1] + dt * ddmpc_fabs(product);
    }
    sum[HEADING] += turn;
    sum[WHEEL_DISTANCE] += speed * dt;
    sum[WHEEL_TURN] += wheel_turn;
    sum[GYRO_TURN] += gyro_turn;
    sum[TURNED] += ddmpc_fabs(turn);
    m->current.time = t;
    const ddmpc_time span = (ddmpc_time)(k->windows[LONG] + k->pose_spacing + k->latest + k->stamp_history);
    if (m->moves == 0 || t - stored_motion(m, 0)->time >= span / (MONITORED - 2)) {
        m->newest = (m->newest + 1) % MONITORED;
        m->moves += m->moves < MONITORED;
        *stored_motion(m, 0) = m->current;
    }
    for (int i = 0; i < MOTIONS; i++)
        /* The comparison is negated so that `rebase` also removes NaN. */
        if (!(ddmpc_fabs(sum[i]) <= k->far))
            rebase(m, i);
}

/* Interpolate the motion up to `time` between the stored times; return 0 if `time` is before them. */
static int motion_at(ddmpc_monitor *m, ddmpc_time time, ddmpc_motion *move)
{
    /* The newest entry that is not later than `time` is between `low` and `high`. */
    int low = 0, high = m->moves - 1;
    if (high < 0)
        return 0;
    if (stored_motion(m, high)->time > time) {
        /* The robot was at rest before the first entry. */
        *move = *stored_motion(m, high);
        move->time = time;
        return m->moves < MONITORED;
    }
    /* Bisection: seven iterations for MONITORED entries. */
    while (low < high) {
        const int middle = (low + high) / 2;
        if (stored_motion(m, middle)->time <= time)
            high = middle;
        else
            low = middle + 1;
    }
    const ddmpc_motion *before = stored_motion(m, low), *after = low > 0 ? stored_motion(m, low - 1) : &m->current;
    const ddmpc_time length = after->time - before->time;
    const real share = length > 0.0 ? ddmpc_min((real)((time - before->time) / length), R(1.0)) : R(0.0);
    move->time = time;
    for (int i = 0; i < MOTIONS; i++)
        move->sum[i] = before->sum[i] + share * (after->sum[i] - before->sum[i]);
    return 1;
}

/* Motion between two times according to each sensor, in the frame of the mean heading. */
typedef struct {
    real pose, wheels, model; /* forward motion [m]; for wheels and commands with the estimated slip */
    real left;                /* lateral motion of the pose minus that of dead reckoning [m] */
    real pose_turn, wheel_turn, gyro_turn, model_turn; /* turns of the body with the learned gains [rad] */
    real total_turn;                                   /* sum of absolute turns [rad] */
    real chord, path; /* chord over distance travelled [-]; distance travelled by the wheels [m] */
    real heading;     /* mean heading of the pose [rad] */
    real late[2];     /* change of the commanded motion if the wheels respond later [m, rad] */
} motions;

static motions compare_motions(const ddmpc_monitor *m, const ddmpc_motion *from, const ddmpc_motion *to,
                               const real before[3], const real after[3])
{
    motions move;
    real sum[MOTIONS];
    move.late[0] = move.late[1] = R(0.0);
    for (int i = 0; i < MOTIONS; i++)
        sum[i] = to->sum[i] - from->sum[i];
    /* A robot may make full turns within a window; dead reckoning determines their number. */
    move.pose_turn = sum[HEADING] + ddmpc_wrap(after[2] - before[2] - sum[HEADING]);
    move.gyro_turn = sum[GYRO_TURN];
    move.wheel_turn = quotient(m->body_by_wheels) * sum[WHEEL_TURN];
    move.model_turn = quotient(m->body_by_model) * sum[MODEL_TURN];
    move.total_turn = ddmpc_max(sum[TURNED], ddmpc_max(ddmpc_fabs(move.gyro_turn), ddmpc_fabs(move.model_turn)));
    move.heading = before[2] + R(0.5) * move.pose_turn;
    const real wheel_heading = from->sum[HEADING] + R(0.5) * sum[HEADING];
    const real cosine[2] = {ddmpc_cos(move.heading), ddmpc_cos(wheel_heading)};
    const real sine[2] = {ddmpc_sin(move.heading), ddmpc_sin(wheel_heading)};
    const real dx = after[0] - before[0], dy = after[1] - before[1];
    move.pose = cosine[0] * dx + sine[0] * dy;
    move.wheels = cosine[1] * sum[FORWARD] + sine[1] * sum[LEFT];
    move.left = cosine[0] * dy - sine[0] * dx - (cosine[1] * sum[LEFT] - sine[1] * sum[FORWARD]);
    move.chord = ddmpc_fabs(move.wheels) < ddmpc_fabs(sum[WHEEL_DISTANCE])
                     ? ddmpc_fabs(move.wheels / sum[WHEEL_DISTANCE])
                     : R(1.0);
    move.path = sum[WHEEL_DISTANCE];
    move.model = move.wheels + move.chord * (sum[MODEL_DISTANCE] - sum[WHEEL_DISTANCE]);
    return move;
}

/* Squared residuals of one window. */
typedef struct {
    real fault[SENSES]; /* with a fault of each sensor */
    int slips;          /* 1 if the best hypothesis without a fault is slip or a blocked robot */
    real no_fault;      /* with the best hypothesis without a fault */
} evaluation;

/* Squared residuals of each hypothesis for one kind of motion, turning or driving. */
typedef struct {
    real normal, slip, held, fault[SENSES];
} residuals;

/* Evaluate the hypotheses for one kind of motion: body by pose `P` and gyro `G`, wheels by encoders `W` and commands `M`. A
   negative variance marks a sensor without readings. `body_variance` is the variance between body and wheels,
   `wheel_variance` the variance between wheels and commands. */
static residuals evaluate_hypotheses(const real value[4], const real noise[4], real body_variance, real wheel_variance)
{
    enum { P, G, W, M };
    const int pose = noise[P] >= R(0.0), gyro = noise[G] >= R(0.0), wheels = noise[W] >= R(0.0);
    residuals result;
    memset(&result, 0, sizeof result);
    const real body_noise = pose && gyro ? noise[P] * noise[G] / (noise[P] + noise[G]) : pose ? noise[P] : noise[G];
    const real body =
        pose && gyro ? (value[P] * noise[G] + value[G] * noise[P]) / (noise[P] + noise[G]) : value[pose ? P : G];
    const real wheel = wheels ? value[W] : value[M], wheel_noise = wheels ? noise[W] : wheel_variance;
    const real body_error = pose && gyro ? square(value[P] - value[G]) / (noise[P] + noise[G]) : R(0.0);
    const real wheel_error = wheels ? square(value[W] - value[M]) / (noise[W] + wheel_variance) : R(0.0);
    const real slip_error = square(body - wheel) / (body_variance + body_noise + wheel_noise);
    result.normal = body_error + wheel_error + slip_error;
    result.slip = body_error + wheel_error;
    result.held = body_error + (wheels ? slip_error : R(0.0));
    result.fault[DDMPC_OF_WHEELS] =
        body_error + square(body - value[M]) / (body_variance + body_noise + wheel_variance);
    result.fault[DDMPC_OF_YAW_RATE] =
        wheel_error + (pose ? square(value[P] - wheel) / (body_variance + noise[P] + wheel_noise) : R(0.0));
    result.fault[DDMPC_OF_POSE] =
        wheel_error + (gyro ? square(value[G] - wheel) / (body_variance + noise[G] + wheel_noise) : R(0.0));
    return result;
}

/* Evaluate the hypotheses in a window of `duration` [s] with the pose and the sensors in `available`. */
static evaluation evaluate(const ddmpc_constants *k, const ddmpc_monitor *m, const motions *move, int available,
                           const real noise[2], real duration)
{
    const int wheels = available & BY_WHEELS, gyro = available & BY_GYRO;
    const real net_turn = ddmpc_max(ddmpc_fabs(move->gyro_turn), ddmpc_fabs(move->model_turn));
    const real distance = ddmpc_max(ddmpc_fabs(move->pose), ddmpc_fabs(move->model));
    const real gyro_noise = square(k->gyro[ABSOLUTE] * duration) + square(k->gyro[SHARE] * move->gyro_turn);
    const real turn[4] = {move->pose_turn, move->gyro_turn, move->wheel_turn, move->model_turn};
    const real turn_noise[4] = {square(noise[1]), gyro ? gyro_noise : R(-1.0), wheels ? R(0.0) : R(-1.0), R(0.0)};
    const real forward[4] = {move->pose, R(0.0), move->wheels, move->model};
    const real forward_noise[4] = {square(noise[0]), R(-1.0), wheels ? R(0.0) : R(-1.0), R(0.0)};
    /* The uncertainty of the gains decreases with the turns of the robot so far. */
    const real gain_variance = square(k->gains[3] * net_turn) * k->gains[0];
    /* The errors of opposite turns do not cancel if one side slips more than the other. */
    const real uneven_variance = square(k->uneven * (move->total_turn - net_turn));
    const real body_turn = variance(k->slip_turning, net_turn) + gain_variance / m->body_by_wheels[1] + uneven_variance;
    const real wheel_turn = variance(k->following, net_turn) + gain_variance / m->wheels_by_model[1] +
                            square(move->late[1]) + uneven_variance;
    const real body_forward = variance(k->slip_driving, distance);
    const real wheel_forward = variance(k->following, distance) + square(move->late[0]);
    const residuals turning = evaluate_hypotheses(turn, turn_noise, body_turn, wheel_turn);
    const residuals driving = evaluate_hypotheses(forward, forward_noise, body_forward, wheel_forward);
    /* Without the gyro, the turn may have occurred before, during or after the drive. */
    const real chord = move->path * ddmpc_cos(R(0.5) * move->pose_turn);
    const real fitted = ddmpc_max(ddmpc_min(move->pose, ddmpc_max(chord, move->path)), ddmpc_min(chord, move->path));
    const real free_forward[4] = {move->pose, R(0.0), fitted, move->model + fitted - move->wheels};
    const residuals free_driving = evaluate_hypotheses(free_forward, forward_noise, body_forward, wheel_forward);
    evaluation result;
    result.no_fault = ddmpc_min(turning.normal + driving.normal, ddmpc_min(turning.slip + driving.slip + k->odds[0],
                                                                           turning.held + driving.held + k->odds[1]));
    for (int i = 0; i < SENSES; i++)
        /* The gyro does not measure driving. */
        result.fault[i] =
            turning.fault[i] + (i == DDMPC_OF_YAW_RATE ? ddmpc_min(free_driving.normal, free_driving.slip + k->odds[0])
                                                       : driving.fault[i]);
    result.slips = result.no_fault < turning.normal + driving.normal;
    return result;
}

/* Compute the squared deviation of poses with a steady drift from dead reckoning that slopes and slip do not explain. */
static real drift_evidence(const ddmpc_constants *k, const motions *half, const motions *whole, real noise)
{
    const real spread = R(0.5) * square(noise) + square(R(0.5) * k->sliding[0] * whole->wheels) +
                        square(R(0.5) * k->sliding[1] * whole->total_turn) + square(k->slip_driving[ABSOLUTE]);
    /* A push or a correction of the localisation is sudden, so use the half of the window with the smaller drift. */
    const real half_error = half->pose - half->wheels, error = whole->pose - whole->wheels;
    const real cosine = ddmpc_cos(whole->heading - half->heading), sine = ddmpc_sin(whole->heading - half->heading);
    const real size = ddmpc_hypot(error, whole->left);
    const real along =
        half_error * (cosine * error - sine * whole->left) + half->left * (sine * error + cosine * whole->left);
    const real second = size > R(0.0) ? along / size : R(0.0), smaller = ddmpc_min(second, size - second);
    return smaller > R(0.0) ? R(2.0) * square(smaller) / spread : R(0.0);
}

/* Learn the variance of poses relative to their stated covariance from second differences, which exclude steady slip. */
static void learn_scatter(const ddmpc_constants *k, ddmpc_monitor *m, const ddmpc_checked_pose *pose,
                          const motions *move)
{
    const real stated[2] = {R(0.5) * (pose->covariance[0][0] + pose->covariance[1][1]), pose->covariance[2][2]};
    const real error[3] = {move->pose - move->wheels, move->left, move->pose_turn - move->gyro_turn};
    real observed[2] = {R(0.0), R(0.0)};
    for (int i = 0; i < 3; i++) {
        /* Each second difference contains 1 + 4 + 1 variances; the first two are averaged as the position. */
        observed[i / 2] += square(error[i] - m->residual[i]) / (i < 2 ? R(12.0) : R(6.0));
        m->residual[i] = error[i];
    }
    if (m->residuals < (int)k->scatter[1])
        m->residuals++;
    if (m->residuals <= 2)
        return;
    const real share = ddmpc_max(k->scatter[0], R(1.0) / (real)m->residuals);
    for (int i = 0; i < 2; i++) {
        const real limit = k->scatter[2] * ddmpc_max(m->scatter[i], R(1.0)), ratio = observed[i] / stated[i];
        /* In contrast to ddmpc_min, this comparison removes NaN. */
        m->scatter[i] += share * ((ratio < limit ? ratio : limit) - m->scatter[i]);
    }
}

/* Add a window to the sums of the gain from `input` to `turn`, whose weight is at most `max_weight`. */
static void learn_gain(real sums[2], real max_weight, real input, real turn)
{
    sums[0] += input * turn;
    sums[1] += input * input;
    if (sums[1] > max_weight) {
        sums[0] *= max_weight / sums[1];
        sums[1] = max_weight;
    }
}

static ddmpc_time delay_of(const ddmpc_constants *k, int index)
{
    return (ddmpc_time)k->latest * index / (MONITORED_DELAYS - 1);
}

/* Compare the motions between two times shifted back by a delay; return 0 if these times are no longer stored. */
static int compare_delayed(const ddmpc_constants *k, ddmpc_monitor *m, const ddmpc_stored_pose *from,
                           const ddmpc_motion *to, ddmpc_time delay, const real pose[3], motions *move)
{
    ddmpc_motion first, last;
    if (!motion_at(m, from->motion.time - delay, &first) || !motion_at(m, to->time - delay, &last))
        return 0;
    *move = compare_motions(m, &first, &last, from->value, pose);
    const ddmpc_time response = (ddmpc_time)k->response_time;
    ddmpc_motion before, after;
    if (motion_at(m, first.time - response, &before) && motion_at(m, last.time - response, &after)) {
        move->late[0] = move->chord * (last.sum[MODEL_DISTANCE] - first.sum[MODEL_DISTANCE] -
                                       after.sum[MODEL_DISTANCE] + before.sum[MODEL_DISTANCE]);
        move->late[1] =
            move->model_turn - quotient(m->body_by_model) * (after.sum[MODEL_TURN] - before.sum[MODEL_TURN]);
    }
    return 1;
}

/* Learn the ratios between the turns of wheels, body and commands. */
static void learn_gains(const ddmpc_constants *k, ddmpc_monitor *m, const motions *move)
{
    const real turn = R(0.5) * (move->pose_turn + move->gyro_turn);
    const real wheels = move->wheel_turn / quotient(m->body_by_wheels);
    const real model = move->model_turn / quotient(m->body_by_model);
    /* A blocked robot provides no information about the turn of its body. */
    if (ddmpc_fabs(turn) >= k->held * ddmpc_fabs(wheels)) {
        learn_gain(m->body_by_wheels, k->gains[2], wheels, turn);
        learn_gain(m->body_by_model, k->gains[2], model, turn);
    }
    learn_gain(m->wheels_by_model, k->gains[2], model, wheels);
}

/* Learn the scale of the gyro from windows that are consistent with a single scale. */
static void learn_gyro_scale(const ddmpc_constants *k, ddmpc_monitor *m, const motions *move, real noise)
{
    const real turn_noise = k->gyro[ABSOLUTE] + noise, weight = R(1.0) / square(turn_noise);
    const real pose = move->pose_turn, gyro = move->gyro_turn,
               scale = m->gyro_sums[4] > R(0.0) ? m->gyro_sums[5] / m->gyro_sums[4] : R(1.0);
    if (m->gyro_sums[3] > k->late[2] &&
        ddmpc_fabs(pose - scale * gyro) > R(1.5) * turn_noise + k->uneven * ddmpc_fabs(pose))
        return;
    const real terms[6] = {R(1.0), pose, gyro, square(pose), square(gyro), pose * gyro};
    for (int i = 0; i < 6; i++)
        m->gyro_sums[i] = k->late[1] * m->gyro_sums[i] + weight * terms[i];
}

/* Return 1 if turns come from the wheels because no gyro is available. */
static int turns_by_wheels(const ddmpc_constants *k, const ddmpc_monitor *m)
{
    const ddmpc_time silence = (ddmpc_time)k->silence;
    return (m->current.time - m->gyro.arrival > silence || m->implausible & BY_GYRO) &&
           m->current.time - m->wheels.arrival <= silence && !(m->excluded & BY_WHEELS);
}

/* Compute the turn between two times by the gyro or, without a gyro, by the wheels. */
static real turn_between(const ddmpc_constants *k, const ddmpc_monitor *m, const ddmpc_motion *from,
                         const ddmpc_motion *to)
{
    return turns_by_wheels(k, m) ? quotient(m->body_by_wheels) * (to->sum[WHEEL_TURN] - from->sum[WHEEL_TURN])
                                 : to->sum[GYRO_TURN] - from->sum[GYRO_TURN];
}

/* Learn the delay of poses. For each candidate delay, a Kalman filter fits the heading of the poses minus that of the gyro by
 * an offset, a drifting bias and a share of the turn, so that neither bias nor scale appears as a delay; all candidates share
 * one covariance. Forward motion does not determine the delay, because the elasticity of the tyres delays the body relative to
 * the wheels. For the same reason, the wheels can replace the gyro only for long delays. */
static void learn_delay(const ddmpc_constants *k, ddmpc_monitor *m, const ddmpc_motion *to, const real pose[3],
                        real noise)
{
    const real dt = (real)(to->time - m->last_motion.time), turn = ddmpc_wrap(pose[2] - m->last.value[2]);
    const real decay = ddmpc_max(R(1.0) - dt / k->delay_fit[5], R(0.0)),
               reading = R(0.5) * square(noise) + square(k->delay_fit[3]);
    real error[MONITORED_DELAYS], low = HUGE_VAL, high = -HUGE_VAL, (*P)[3] = m->fit_covariance;
    ddmpc_motion earlier;
    const int wheels = turns_by_wheels(k, m);
    const int no_turns =
        !wheels && (m->current.time - m->gyro.last_change > (ddmpc_time)k->silence || m->implausible & BY_GYRO);
    if (no_turns || (m->excluded & BY_POSE) || !motion_at(m, to->time - (ddmpc_time)k->latest, &earlier))
        return;
    /* P = F P F', as the offset grows by the bias and by a share of the turn. */
    for (int j = 0; j < 3; j++)
        P[0][j] += dt * P[1][j] + turn * P[2][j];
    for (int j = 0; j < 3; j++)
        P[j][0] += dt * P[j][1] + turn * P[j][2];
    P[0][0] += dt * square(k->delay_fit[0]) + (wheels ? square(k->by_wheels[0]) * ddmpc_fabs(turn) : R(0.0));
    P[1][1] += dt * square(k->delay_fit[1]);
    const real total = P[0][0] + reading, gain[3] = {P[0][0] / total, P[1][0] / total, P[2][0] / total};
    for (int i = 0; i < MONITORED_DELAYS; i++) {
        motion_at(m, to->time - delay_of(k, i), &earlier);
        m->fit[i][0] += dt * m->fit[i][1] + turn * m->fit[i][2];
        error[i] = turn_between(k, m, &earlier, to) - m->turn_difference - m->fit[i][0];
        low = ddmpc_min(low, error[i]);
        high = ddmpc_max(high, error[i]);
    }
    /* Restart after a jump, which no delay explains. An excluded gyro may have any scale. */
    const real initial[3] = {reading, square(k->delay_fit[2]),
                             square(wheels                  ? k->by_wheels[1]
                                    : m->excluded & BY_GYRO ? k->delay_fit[7]
                                                            : k->gyro[SHARE])};
    const int restart = !(m->fits > R(0.0)) || ddmpc_max(low, -high) > k->delay_fit[6] * ddmpc_sqrt(total);
    m->fits = restart ? R(1.0) : decay * m->fits + R(1.0);
    /* The first and last delay are not candidates, since the parabola below needs both neighbours. */
    int best = 1;
    for (int i = 0; i < MONITORED_DELAYS; i++) {
        m->misfit[i] = restart ? R(0.0) : decay * m->misfit[i] + square(error[i]) / total;
        for (int j = 0; j < 3; j++)
            m->fit[i][j] = !restart ? m->fit[i][j] + gain[j] * error[i] : j == 0 ? m->fit[i][0] + error[i] : R(0.0);
        best = i > 1 && i < MONITORED_DELAYS - 1 && m->misfit[i] < m->misfit[best] ? i : best;
    }
    for (int i = 0; i < 9; i++)
        P[i / 3][i % 3] = !restart     ? P[i / 3][i % 3] - gain[i / 3] * gain[i % 3] * total
                          : i % 4 == 0 ? initial[i / 4]
                                       : R(0.0);
    /* A parabola through the best candidate and its neighbours gives the delay and, by its curvature, the standard deviation,
     * which is large in steady motion. */
    const real *misfit = &m->misfit[best], slope = misfit[-1] - misfit[1], step = (real)delay_of(k, 1);
    const real curvature = ddmpc_max(misfit[-1] - R(2.0) * misfit[0] + misfit[1], R(1e-6));
    const real delay = ddmpc_max(step * ((real)best + R(0.5) * slope / curvature), R(0.0));
    const real scatter = ddmpc_max(misfit[0] / m->fits, R(1.0)),
               deviation = step * ddmpc_sqrt(R(2.0) * scatter / curvature);
    const int is_certain = best < MONITORED_DELAYS - 2 && scatter < k->late[4] &&
                           deviation < ddmpc_max(k->delay_fit[4], m->excluded & BY_GYRO ? R(0.0) : k->late[3] * delay);
    /* The delay must be certain for some time: the turns of a failing sensor may briefly appear delayed, and a new delay changes
     * the whole estimate. */
    if (!is_certain || restart || (wheels && delay < k->by_wheels[2]))
        m->uncertain_at = to->time;
    const int is_different = ddmpc_fabs(delay - (real)m->delay) > k->late[0] * deviation;
    const int is_more_precise = m->delay > 0.0 && deviation < m->delay_deviation;
    if (to->time - m->uncertain_at >= (ddmpc_time)k->lasting && (is_different || is_more_precise)) {
        /* The scale of the gyro was learned from windows at the previous delay. */
        if (is_different)
            memset(m->gyro_sums, 0, sizeof m->gyro_sums);
        m->delay = (ddmpc_time)delay;
        m->delay_deviation = deviation;
    }
}

/* Return the sensors, as bits, with uninterrupted readings since `time`. */
static int available_since(const ddmpc_constants *k, const ddmpc_monitor *m, ddmpc_time time)
{
    const ddmpc_time silence = (ddmpc_time)k->silence;
    const int wheels = m->wheels.first_arrival <= time && m->current.time - m->wheels.arrival <= silence;
    const int gyro = m->gyro.first_arrival <= time && m->current.time - m->gyro.arrival <= silence;
    return (wheels ? BY_WHEELS : 0) | (gyro ? BY_GYRO : 0);
}

/* Return 1 if poses repeat while two other sources report motion. */
static int is_frozen(ddmpc_controller *c, const real pose[3], const ddmpc_motion *to, const real noise[2])
{
    const ddmpc_constants *k = c->constants;
    ddmpc_monitor *m = &c->monitor;
    m->same++;
    for (int i = 0; i < 3; i++)
        if (pose[i] != m->last.value[i])
            m->same = 0;
    if (m->same == 0)
        m->frozen = *to;
    if (m->same < (int)k->often - 1)
        return 0;
    const motions move = compare_motions(m, &m->frozen, to, pose, pose);
    const int available = available_since(k, m, m->frozen.time) & ~m->excluded;
    const real min_distance = k->frozen[0] + R(3.0) * noise[0], min_turn = k->frozen[1] + R(3.0) * noise[1];
    const int model = ddmpc_fabs(to->sum[MODEL_DISTANCE] - m->frozen.sum[MODEL_DISTANCE]) > min_distance ||
                      ddmpc_fabs(move.model_turn) > min_turn;
    const int wheels = ddmpc_fabs(to->sum[WHEEL_DISTANCE] - m->frozen.sum[WHEEL_DISTANCE]) > min_distance ||
                       ddmpc_fabs(move.wheel_turn) > min_turn;
    const int gyro = ddmpc_fabs(move.gyro_turn) > min_turn;
    return model + (wheels && (available & BY_WHEELS)) + (gyro && (available & BY_GYRO)) >= 2;
}

/* Return the newest stored pose that is at least `length` [s] older than `stamp`; 0 if it is older than twice `length`. */
static const ddmpc_stored_pose *pose_before(const ddmpc_monitor *m, ddmpc_time stamp, ddmpc_time length)
{
    for (int age = 0; age < m->poses; age++) {
        const ddmpc_stored_pose *stored = &m->pose[(m->newest_pose + MONITORED_POSES - age) % MONITORED_POSES];
        if (stamp - stored->motion.time >= length - 1e-9)
            return stamp - stored->motion.time < 2.0 * length ? stored : 0;
    }
    return 0;
}

/* Evaluate each hypothesis at its best delay of poses, because late poses are not a fault. For a faulty pose the delay has no
 * meaning, so the other sensors must agree at all delays. */
static evaluation evaluate_delays(const ddmpc_constants *k, ddmpc_monitor *m, const ddmpc_stored_pose *from,
                                  const ddmpc_motion *to, const real *pose, int available, const real noise[2],
                                  int window)
{
    evaluation minimum;
    int first = 1;
    real best = m->misfit[0];
    memset(&minimum, 0, sizeof minimum);
    for (int i = 1; i < MONITORED_DELAYS; i++)
        best = ddmpc_min(best, m->misfit[i]);
    for (int i = 0; i < MONITORED_DELAYS; i++) {
        motions move;
        /* Skip delays that are already excluded. */
        if (m->misfit[i] > best + k->late[5] || !compare_delayed(k, m, from, to, delay_of(k, i), pose, &move))
            continue;
        const evaluation result = evaluate(k, m, &move, available, noise, k->windows[window]);
        if (first)
            minimum = result;
        for (int j = 0; j < SENSES; j++)
            minimum.fault[j] = j == DDMPC_OF_POSE ? ddmpc_max(minimum.fault[j], result.fault[j])
                                                  : ddmpc_min(minimum.fault[j], result.fault[j]);
        minimum.slips = result.no_fault < minimum.no_fault ? result.slips : minimum.slips;
        minimum.no_fault = ddmpc_min(minimum.no_fault, result.no_fault);
        first = 0;
    }
    return minimum;
}

/* Compute the course between two poses relative to their mean heading, and its variance; return 0 if they are too close. */
static int compute_course(const ddmpc_constants *k, const ddmpc_stored_pose *from, const ddmpc_motion *to,
                          const real pose[3], real noise, real *direction, real *spread)
{
    const real dx = pose[0] - from->value[0], dy = pose[1] - from->value[1], length = ddmpc_hypot(dx, dy);
    const real distance = to->sum[WHEEL_DISTANCE] - from->motion.sum[WHEEL_DISTANCE];
    if (!(length > R(4.0) * noise) || !(length > k->frozen[0]))
        return 0;
    const real turn = ddmpc_wrap(pose[2] - from->value[2]), heading = from->value[2] + R(0.5) * turn;
    *direction = ddmpc_wrap(ddmpc_atan2(dy, dx) - heading - (distance < R(0.0) ? DDMPC_PI : R(0.0)));
    /* If the path is not an arc, its chord may have any direction between both headings. */
    *spread = square(k->course[0]) + square(noise / length) + square(k->course[3] * turn) + square(R(0.5) * *direction);
    return ddmpc_fabs(turn) < k->course[4];
}

/* If gyro and poses have diverged, the course of the poses shows which heading is correct, since it turns with the robot. */
static void follow_course(const ddmpc_constants *k, ddmpc_monitor *m, const ddmpc_motion *to, const real pose[3],
                          real noise)
{
    const ddmpc_stored_pose *from = pose_before(m, to->time, (ddmpc_time)k->windows[SHORT]);
    real direction, spread;
    if (!from || !compute_course(k, from, to, pose, noise, &direction, &spread))
        return;
    m->direction_weight = k->late[1] * m->direction_weight + R(1.0) / spread;
    m->direction = ddmpc_wrap(m->direction + ddmpc_wrap(direction - m->direction) / (spread * m->direction_weight));
    if (to->time >= m->next_pose) {
        m->course_evidence *= k->late[1];
        m->anchor_evidence *= k->late[1];
    }
    const real difference = m->turn_difference - m->anchor[2], change = ddmpc_wrap(direction - m->anchor[0]),
               total = spread + m->anchor[1];
    if (m->has_anchor && ddmpc_fabs(difference) > k->course[1]) {
        const real evidence = (square(ddmpc_wrap(change - difference)) - square(change)) / total, limit = k->course[2];
        m->course_evidence = ddmpc_max(ddmpc_min(m->anchor_evidence + evidence, limit), -limit);
    }
    if (!m->has_anchor || ddmpc_fabs(difference) > R(3.0) * k->course[1]) {
        m->anchor_evidence = R(0.5) * m->course_evidence;
        m->has_anchor = 1;
        m->anchor[0] = direction;
        m->anchor[1] = spread;
        m->anchor[2] = m->turn_difference;
    }
}

/* Compute the squared deviation of poses that move sideways in two consecutive windows; a push affects only one of them. */
static real sideways_evidence(const ddmpc_constants *k, ddmpc_monitor *m, const ddmpc_stored_pose *from,
                              const ddmpc_motion *to, const real pose[3], real noise)
{
    const ddmpc_stored_pose *middle = pose_before(m, to->time, (ddmpc_time)k->windows[SHORT]);
    motions move[2];
    if (!middle || middle == from || !compare_delayed(k, m, from, &middle->motion, m->delay, middle->value, &move[0]) ||
        !compare_delayed(k, m, middle, to, m->delay, pose, &move[1]) ||
        !(move[0].left * move[1].left + move[0].pose * move[1].pose > R(0.0)))
        return R(0.0);
    real minimum = HUGE_VAL;
    for (int i = 0; i < 2; i++) {
        /* No surface moves a robot in the opposite direction of its wheels and its commands. */
        const real reverse = move[i].pose * move[i].wheels < R(0.0) && move[i].model * move[i].wheels > R(0.0)
                                 ? square(move[i].pose)
                                 : R(0.0);
        const real length = ddmpc_hypot(move[i].pose, move[i].left), distance = ddmpc_fabs(move[i].wheels);
        /* On a sliding surface the distances of poses and wheels differ. */
        if (!(ddmpc_fabs(length - distance) < R(2.0) * (noise + k->slip_driving[SHARE] * distance)))
            return R(0.0);
        minimum = ddmpc_min(minimum,
                            (square(move[i].left) + reverse) / (square(noise) + variance(k->sideways, move[i].wheels) +
                                                                square(k->sliding[1] * move[i].total_turn)));
    }
    return R(2.0) * minimum;
}

/* Return 1 if the gyro differs from poses by a constant scale, which neither a bias nor a faulty pose causes. */
static int gyro_has_scale(const ddmpc_constants *k, const ddmpc_monitor *m)
{
    const real *sum = m->gyro_sums, weights = ddmpc_max(sum[0], R(1e-9));
    const real pose = sum[3] - square(sum[1]) / weights, gyro = sum[4] - square(sum[2]) / weights;
    const real product = sum[5] - sum[1] * sum[2] / weights;
    return pose > k->late[2] && product > k->scaled[0] * gyro && ddmpc_fabs(product - gyro) > k->scaled[1] * gyro &&
           pose * gyro - square(product) < k->scaled[2] * pose * gyro;
}

/* Compute the evidence that the distance of the wheels differs from that of poses and commands over recent motion. */
static real wheel_scale_evidence(const ddmpc_constants *k, const ddmpc_monitor *m)
{
    if (!(m->wheel_sums[3] > k->scales[0]))
        return R(0.0);
    const real wheels = m->wheel_sums[1] / m->wheel_sums[0], body = m->wheel_sums[2] / m->wheel_sums[0];
    const real wheel_error = square((wheels - R(1.0)) / k->scales[2]),
               body_error = square((body - R(1.0)) / k->scales[3]);
    return ddmpc_min(wheel_error, square((wheels - body) / k->scales[1]) + body_error) - body_error;
}

/* Compute the evidence against each sensor from the motion up to this pose; set `agreeing` to the sensors, as bits, that
 * agree with the others during motion. */
static void collect_evidence(ddmpc_controller *c, const ddmpc_checked_pose *pose, const ddmpc_motion *to,
                             const real noise[2], real evidence[SENSES], int *agreeing)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_monitor *m = &c->monitor;
    const int excluded = m->excluded, both = BY_WHEELS | BY_GYRO;
    motions half, whole;
    if (available_since(k, m, to->time) & BY_GYRO)
        follow_course(k, m, to, pose->value, noise[0]);
    learn_delay(k, m, to, pose->value, noise[1]);
    for (int window = SHORT; window < WINDOWS; window++) {
        const ddmpc_stored_pose *from = pose_before(m, pose->stamp, (ddmpc_time)k->windows[window]);
        motions *move = window == LONG ? &whole : &half;
        if (!from || !compare_delayed(k, m, from, to, m->delay, pose->value, move))
            break;
        const int available = available_since(k, m, from->motion.time - m->delay), used = available & ~excluded;
        if (window == MIDDLE) {
            const ddmpc_stored_pose *oldest = pose_before(m, pose->stamp, (ddmpc_time)(R(2.0) * k->windows[SHORT]));
            if (oldest && used & BY_WHEELS)
                evidence[DDMPC_OF_POSE] =
                    ddmpc_max(evidence[DDMPC_OF_POSE], sideways_evidence(k, m, oldest, to, pose->value, noise[0]));
            continue;
        }
        evaluation result = evaluate_delays(k, m, from, to, pose->value, used, noise, window);
        result.fault[DDMPC_OF_POSE] += ddmpc_max(m->course_evidence, R(0.0));
        result.fault[DDMPC_OF_YAW_RATE] += ddmpc_max(-m->course_evidence, R(0.0));
        result.fault[DDMPC_OF_POSE] += gyro_has_scale(k, m) ? k->scaled[3] : R(0.0);
        for (int i = 0; i < SENSES; i++)
            if ((used | BY_POSE) & 1 << i)
                evidence[i] = ddmpc_max(evidence[i], result.no_fault - result.fault[i]);
        if (window == SHORT && pose->stamp >= m->next_pose) {
            const real model = move->model, decay = R(1.0) - k->pose_spacing / k->memory;
            const real terms[6] = {
                model * model,           model * move->wheels,
                model * move->pose,      k->pose_spacing / k->windows[SHORT] * ddmpc_fabs(model),
                square(move->pose_turn), move->pose_turn * move->wheel_turn / quotient(m->body_by_wheels)};
            for (int i = 0; i < 6; i++)
                m->wheel_sums[i] = decay * m->wheel_sums[i] + terms[i];
        }
        if (window == SHORT && used & BY_WHEELS)
            evidence[DDMPC_OF_WHEELS] = ddmpc_max(evidence[DDMPC_OF_WHEELS], wheel_scale_evidence(k, m));
        if (window == LONG) {
            m->is_diverging = square(move->pose_turn - move->gyro_turn) >
                              square(noise[1]) + square(k->gyro[ABSOLUTE] * k->windows[LONG]);
            /* Dead reckoning uses wheels and gyro, so it shows a drift of the poses only if both agree with all other data. */
            if (used == both && result.no_fault < k->plausible && pose->stamp - m->slipped_at > (ddmpc_time)k->memory)
                evidence[DDMPC_OF_POSE] =
                    ddmpc_max(evidence[DDMPC_OF_POSE], drift_evidence(k, &half, &whole, noise[0]));
            continue;
        }
        const evaluation with_excluded = excluded ? evaluate(k, m, move, available, noise, k->windows[window]) : result;
        const int moves = ddmpc_fabs(move->pose) > k->frozen[0] || ddmpc_fabs(move->pose_turn) > k->frozen[1];
        const int wheels_agree =
            square(move->wheels - move->pose) < square(noise[0]) + variance(k->slip_driving, move->pose);
        const int turns = ddmpc_max(ddmpc_fabs(move->pose_turn), ddmpc_fabs(move->gyro_turn)) > k->frozen[1];
        const real min_distance = k->frozen[0] + R(2.0) * noise[0], min_turn = k->frozen[1] + R(2.0) * noise[1];
        const real distance = ddmpc_fabs(move->pose), turn = ddmpc_fabs(move->pose_turn);
        const int has_command = ddmpc_fabs(move->model) - distance > k->frozen[0] ||
                                ddmpc_fabs(move->model_turn) - turn > R(2.0) * k->frozen[1];
        if (has_command && !(distance > min_distance || turn > min_turn))
            m->blocked_at = pose->stamp;
        if (with_excluded.no_fault < k->plausible)
            *agreeing = (moves ? available & ~(turns ? 0 : BY_GYRO) & ~(wheels_agree ? 0 : BY_WHEELS) : 0) | BY_POSE;
        if (result.slips)
            m->slipped_at = pose->stamp;
        const ddmpc_time changed =
            m->wheels.last_change < m->gyro.last_change ? m->wheels.last_change : m->gyro.last_change;
        const int both_change = m->current.time - changed <= (ddmpc_time)k->silence;
        if (pose->stamp < m->next_pose)
            continue;
        const int turns_agree =
            square(move->pose_turn - move->gyro_turn) < R(4.0) * (square(noise[1]) + square(k->gyro[ABSOLUTE]));
        if (!excluded && both_change && available == both && turns_agree && result.no_fault < k->plausible &&
            !m->is_diverging)
            learn_gains(k, m, move);
        if (!((excluded & BY_POSE) | (m->implausible & BY_GYRO)) && available & BY_GYRO &&
            m->current.time - m->gyro.last_change <= (ddmpc_time)k->silence &&
            ddmpc_min(result.no_fault, result.fault[DDMPC_OF_YAW_RATE]) < k->plausible)
            learn_gyro_scale(k, m, move, noise[1]);
    }
    /* Readings that repeat despite the commands, or at the end of their range, are not evidence against poses. */
    const int gyro_repeats = m->current.time - m->gyro.last_change > (ddmpc_time)k->silence &&
                             ddmpc_fabs(m->gyro.value[0]) > k->doubtful[ABSOLUTE];
    if ((ddmpc_monitor_doubtful_sensors(c, m->current.time) | (gyro_repeats ? BY_GYRO : 0)) & ~excluded)
        evidence[DDMPC_OF_POSE] = R(0.0);
    /* Poses that are not used are not evidence against other sensors. */
    if (excluded & BY_POSE)
        evidence[DDMPC_OF_WHEELS] = evidence[DDMPC_OF_YAW_RATE] = R(0.0);
}

/* Exclude sensors after a sufficient time of contradiction, and use them again after a sufficient time of agreement. */
static void update_exclusions(ddmpc_controller *c, const real evidence[SENSES], int agreeing, ddmpc_time stamp,
                              ddmpc_time elapsed)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_monitor *m = &c->monitor;
    const ddmpc_time time = m->current.time, silence = (ddmpc_time)k->silence;
    const int repeats[SENSES] = {time - m->wheels.last_change > silence, time - m->gyro.last_change > silence,
                                 m->same > 0};
    for (int i = 0; i < SENSES; i++) {
        const int bit = 1 << i;
        real second = R(0.0);
        for (int j = 0; j < SENSES; j++)
            second = j == i ? second : ddmpc_max(second, evidence[j]);
        /* The required margin increases with the contradiction, since the gains of the third sensor were learned from one of
         * the two contradictory sensors. */
        if (evidence[i] > k->enough &&
            evidence[i] > second + k->margin + ddmpc_min(k->share[0] * second, k->share[1])) {
            if (m->contradictions[i]++ == 0)
                m->contradiction_start[i] = stamp;
            const ddmpc_time duration = stamp - m->contradiction_start[i];
            m->agreement_time[i] = 0.0;
            if ((m->contradictions[i] < (int)k->often || duration < (ddmpc_time)k->lasting) &&
                duration < (ddmpc_time)k->windows[SHORT])
                continue;
            if (!(m->excluded & bit))
                m->repeating = repeats[i] ? m->repeating | bit : m->repeating & ~bit;
            m->excluded |= bit;
        } else {
            m->contradictions[i] = 0;
            if ((m->excluded & agreeing & bit) && !repeats[i] && !is_impossible(c, i))
                m->agreement_time[i] += elapsed;
            if (m->agreement_time[i] >= (ddmpc_time)k->monitor_trust) {
                m->excluded &= ~bit;
                m->implausible &= ~bit;
                m->agreement_time[i] = 0.0;
            }
        }
    }
}

int ddmpc_monitor_check_pose(ddmpc_controller *c, const ddmpc_checked_pose *pose)
{
    const ddmpc_constants *k = c->constants;
    ddmpc_monitor *m = &c->monitor;
    ddmpc_motion to;
    if (!k->monitor || !motion_at(m, pose->stamp, &to))
        return 0;
    const int before = m->excluded;
    const real noise[2] = {
        ddmpc_sqrt((pose->covariance[0][0] + pose->covariance[1][1]) * ddmpc_max(m->scatter[0], R(1.0))),
        ddmpc_sqrt(R(2.0) * pose->covariance[2][2] * ddmpc_max(m->scatter[1], R(1.0)))};
    int frozen = 0, agreeing = 0;
    real evidence[SENSES] = {R(0.0), R(0.0), R(0.0)};
    if (m->has_last) {
        const ddmpc_time elapsed = pose->stamp - m->last.stamp;
        const motions move = compare_motions(m, &m->last_motion, &to, m->last.value, pose->value);
        frozen = is_frozen(c, pose->value, &to, noise);
        /* A pose that moves further than a faulty sensor can explain is a jump, which the estimator handles. */
        const real max_distance = R(0.5) * k->frozen[0] + R(3.0) * noise[0] + ddmpc_fastest(k, 0) * (real)elapsed;
        const real max_turn = R(0.5) * k->frozen[1] + R(3.0) * noise[1] + ddmpc_fastest(k, 1) * (real)elapsed;
        if (!(ddmpc_hypot(move.pose - move.wheels, move.left) <= max_distance &&
              ddmpc_fabs(move.pose_turn - move.gyro_turn) <= max_turn))
            m->poses = m->residuals = m->has_anchor = 0;
        else if (elapsed <= R(0.25) && m->same == 0)
            learn_scatter(k, m, pose, &move);
        m->turn_difference += turn_between(k, m, &m->last_motion, &to) - ddmpc_wrap(pose->value[2] - m->last.value[2]);
        collect_evidence(c, pose, &to, noise, evidence, &agreeing);
        update_exclusions(c, evidence, agreeing, pose->stamp, elapsed < 0.25 ? elapsed : 0.25);
    } else {
        m->frozen = to;
    }
    for (int i = 0; i < DDMPC_OF_POSE; i++)
        if (is_impossible(c, i))
            m->implausible |= 1 << i;
    m->excluded |= m->implausible;
    if (frozen) {
        m->excluded |= BY_POSE;
        m->repeating |= BY_POSE;
        m->agreement_time[DDMPC_OF_POSE] = 0.0;
    }
    if (m->excluded & ~before) {
        /* Discard the delay, since it was learned from a faulty sensor. */
        memset(m->misfit, 0, sizeof m->misfit);
        memset(m->gyro_sums, 0, sizeof m->gyro_sums);
        m->fits = R(0.0);
        m->delay = 0.0;
    }
    if (m->poses == 0 || pose->stamp >= m->next_pose) {
        m->newest_pose = (m->newest_pose + 1) % MONITORED_POSES;
        m->poses += m->poses < MONITORED_POSES;
        memcpy(m->pose[m->newest_pose].value, pose->value, sizeof pose->value);
        m->pose[m->newest_pose].motion = to;
        m->next_pose = pose->stamp + (ddmpc_time)k->pose_spacing - 1e-6;
    }
    m->last = *pose;
    m->last_motion = to;
    m->has_last = 1;
    return m->excluded & ~before;
}

/* Return the factor by which the variance of poses is multiplied, from their observed scatter. */
static real variance_factor(const ddmpc_constants *k, real scatter)
{
    return scatter > k->scatter[3] ? ddmpc_min(scatter, k->scatter[4]) : R(1.0);
}

void ddmpc_monitor_enlarge_covariance(ddmpc_controller *c, ddmpc_checked_pose *pose)
{
    ddmpc_monitor *m = &c->monitor;
    real scale[2];
    for (int i = 0; i < 2; i++) {
        const real factor = variance_factor(c->constants, m->scatter[i]);
        /* The current estimate is overconfident, since the variance of earlier poses was too small. */
        pose->doubt[i] = factor > m->max_scatter[i] ? ddmpc_sqrt(factor / m->max_scatter[i]) : R(1.0);
        m->max_scatter[i] = ddmpc_max(factor, m->max_scatter[i]);
        scale[i] = ddmpc_sqrt(factor);
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            pose->covariance[i][j] *= scale[i / 2] * scale[j / 2];
}

ddmpc_time ddmpc_monitor_delay(const ddmpc_controller *c) { return c->monitor.delay; }

void ddmpc_monitor_report(ddmpc_controller *c)
{
    const ddmpc_monitor *m = &c->monitor;
    ddmpc_result *result = &c->result;
    const real ratio = c->constants->wheel_yaw_ratio, limit = c->constants->monitor_turn_ratio;
    const real wheels = quotient(m->wheels_by_model) / ratio, body = quotient(m->body_by_wheels) * ratio;
    result->reasons |= (unsigned int)m->excluded * DDMPC_WHEELS_EXCLUDED;
    result->repeating = m->repeating & m->excluded;
    result->implausible = m->implausible;
    result->pose_scatter = ddmpc_sqrt(ddmpc_max(m->scatter[0], m->scatter[1]));
    result->pose_delay = (real)m->delay;
    result->reads[0] = m->gyro_sums[3] > R(0.0) ? m->gyro_sums[5] / m->gyro_sums[3] : R(0.0);
    result->reads[1] = ddmpc_fabs(m->wheel_sums[2]) > R(0.0) ? m->wheel_sums[1] / m->wheel_sums[2] : R(0.0);
    result->reads[2] = m->wheel_sums[4] > R(0.0) ? m->wheel_sums[5] / m->wheel_sums[4] : R(0.0);
    result->direction = m->direction;
    result->turn_ratio[0] = wheels;
    result->turn_ratio[1] = body;
    if (square(result->pose_scatter) > c->constants->scatter[3])
        result->reasons |= DDMPC_POSES_SCATTER;
    if (m->delay > 0.015)
        result->reasons |= DDMPC_POSES_LATE;
    if (m->body_by_wheels[1] > c->constants->gains[1] && m->wheels_by_model[1] > c->constants->gains[1] &&
        !(wheels < limit && wheels * limit > R(1.0) && body < limit && body * limit > R(1.0)))
        result->reasons |= DDMPC_TURNS_OTHERWISE;
}
