/* Functions called by the page: set parameters, run ticks, and read the report and the plan. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "ddmpc_formulas.h"
#include "lab.h"

#define CALLED(name) __attribute__((export_name(#name))) name

enum { DRAWN_PIECES = 2048, ARC_ROWS = 10 };

/* Clock of the page [s]. */
__attribute__((import_module("page"), import_name("now"))) double page_now(void);
double lab_now(void) { return page_now(); }

typedef struct {
    ddmpc_sizes sizes;
    ddmpc_constants constants;
    ddmpc_functions functions;
    ddmpc_controller *controller;
    void *memory[4];
    int ready;
} lab_controller;

static lab_world world;
static lab_robot_state robot, ghost;
static lab_rpp peer_parameters;
static rpp_peer peer;
static lab_controller mpc;
static lab_drawing drawing;
static ddmpc_trajectory trajectory;
static ddmpc_reference reference;
static lab_report report;
static double push_twist[2];
static int push_ticks, start_refused;

/* Allocate memory for `count` numbers; the page frees it with lab_free when no structure points to it any more. */
double *CALLED(lab_allocate)(int count) { return malloc((size_t)count * sizeof(double)); }
void CALLED(lab_free)(double *numbers) { free(numbers); }

lab_report *CALLED(lab_get_report)(void) { return &report; }
const double *CALLED(lab_plan)(void) { return ddmpc_result_of(mpc.controller)->planned_poses; }

void CALLED(lab_set_robot)(const double *numbers) { memcpy(&world.robot, numbers, sizeof world.robot); }
void CALLED(lab_set_floor)(const double *numbers) { memcpy(&world.floor, numbers, sizeof world.floor); }
void CALLED(lab_set_ice)(const double *numbers) { memcpy(&world.ice, numbers, sizeof world.ice); }
void CALLED(lab_set_sensors)(const double *numbers) { memcpy(&world.sensors, numbers, sizeof world.sensors); }
void CALLED(lab_set_peer)(const double *numbers) { memcpy(&peer_parameters, numbers, sizeof peer_parameters); }
void CALLED(lab_set_drawing)(const double *numbers) { memcpy(&drawing, numbers, sizeof drawing); }
void CALLED(lab_set_cover)(int covered) { world.covered = covered; }

/* Set the velocity model from the number of states, both delays, and A, B0, B1 and C row by row. The robots keep their
 * states. Returns 0 if the model is too large. */
int CALLED(lab_set_model)(const double *numbers)
{
    const int n = (int)numbers[0], delay[2] = {(int)numbers[1], (int)numbers[2]};
    if (n > LAB_STATES || delay[0] > LAB_PAST - 2 || delay[1] > LAB_PAST - 2)
        return 0;
    const double *A = numbers + 3, *B0 = A + n * n, *B1 = B0 + 2 * n;
    const lab_model model = {n, {delay[0], delay[1]}, A, B0, B1, B1 + 2 * n};
    world.model = model;
    return 1;
}

/* Set the noise from the number of rows, and the samples of poses, gyro, encoders and losses. */
void CALLED(lab_set_noise)(const double *numbers)
{
    const int count = (int)numbers[0];
    const double *pose = numbers + 1, *gyro = pose + 3 * count, *encoders = gyro + count;
    const lab_noise noise = {count, pose, gyro, encoders, encoders + 4 * count};
    world.noise = noise;
}

/* Set the patches of ice from their number, and x, y and radius of each. */
void CALLED(lab_set_patches)(const double *numbers)
{
    world.patch_count = (int)fmin(numbers[0], LAB_PATCHES);
    memcpy(world.patch, numbers + 1, (size_t)world.patch_count * sizeof *world.patch);
}

/* Create the controller from sizes and constants; the constants point into `numbers`. Returns 0 if this fails. */
int CALLED(lab_set_controller)(const double *numbers)
{
    for (int i = 0; i < 4; i++)
        free(mpc.memory[i]);
    memset(&mpc, 0, sizeof mpc);
    lab_read_controller(numbers, &mpc.sizes, &mpc.constants);
    const size_t bytes[4] = {
        ddmpc_controller_bytes(),
        (size_t)ddmpc_reals(&mpc.sizes) * sizeof(real),
        (size_t)ddmpc_ints(&mpc.sizes) * sizeof(int),
        (size_t)mpc.sizes.history * ddmpc_node_bytes(),
    };
    for (int i = 0; i < 4; i++)
        if (!(mpc.memory[i] = calloc(bytes[i] + 1, 1)))
            return 0;
    mpc.controller = mpc.memory[0];
    mpc.ready = ddmpc_init(mpc.controller, &mpc.sizes, &mpc.constants, &mpc.functions, mpc.memory[1], mpc.memory[2],
                           mpc.memory[3]);
    return mpc.ready;
}

static void use_trajectory(const ddmpc_trajectory *new_trajectory)
{
    const ddmpc_reference sampled = {ddmpc_sample_one, &trajectory, new_trajectory->duration};
    trajectory = *new_trajectory;
    reference = sampled;
    report.duration = trajectory.duration;
}

/* Set the reference from: 1 for cubics, number of pieces, number of breaks, duration, breaks, table. */
void CALLED(lab_set_reference)(const double *numbers)
{
    const int breaks = (int)numbers[2];
    const ddmpc_trajectory new_trajectory = {numbers + 4,     numbers + 4 + breaks, (int)numbers[1],
                                             (int)numbers[0], numbers[3],           {0.0, 0.0, 0.0}};
    use_trajectory(&new_trajectory);
}

/* Write pose and twist of the reference at `time` into 5 numbers. */
void CALLED(lab_sample)(double time, double *numbers)
{
    double arc_length;
    ddmpc_sample_one(&trajectory, time, numbers, numbers + 3, &arc_length);
}

/* Resample a drawn line of (count, 2) points at equal distances and smooth it. Returns the number of new points. */
static int resample(const double *points, int count, double even[DRAWN_PIECES][2])
{
    int used = 1;
    double remaining = drawing.spacing;
    memcpy(even[0], points, sizeof even[0]);
    for (int i = 1; i < count && used < DRAWN_PIECES; i++) {
        const double *from = points + 2 * (i - 1), dx = points[2 * i] - from[0], dy = points[2 * i + 1] - from[1];
        const double length = hypot(dx, dy);
        for (; length > 0.0 && remaining <= length && used < DRAWN_PIECES; remaining += drawing.spacing, used++) {
            even[used][0] = from[0] + dx * remaining / length;
            even[used][1] = from[1] + dy * remaining / length;
        }
        remaining -= length;
    }
    for (int round = 0; round < (int)drawing.rounds; round++)
        for (int axis = 0; axis < 2; axis++) {
            double before = even[0][axis];
            for (int i = 1; i + 1 < used; i++) {
                const double value = even[i][axis];
                even[i][axis] = 0.25 * before + 0.5 * value + 0.25 * even[i + 1][axis];
                before = value;
            }
        }
    return used;
}

/* Compute the maximum speeds at the ends of pieces for `max_speed`, curvature and acceleration, from rest to rest. */
static void compute_speeds(int pieces, const double *curvature, double max_speed, double *speed)
{
    const double square_change = 2.0 * drawing.acceleration * drawing.spacing;
    for (int i = 0; i <= pieces; i++) {
        const double bend = fmax(fabs(curvature[i < pieces ? i : pieces - 1]), fabs(curvature[i ? i - 1 : 0]));
        speed[i] = fmin(max_speed, fmin(drawing.yaw_rate / fmax(bend, 1e-9), sqrt(drawing.lateral / fmax(bend, 1e-9))));
    }
    speed[0] = speed[pieces] = 0.0;
    for (int i = 1; i <= pieces; i++)
        speed[i] = fmin(speed[i], sqrt(speed[i - 1] * speed[i - 1] + square_change));
    for (int i = pieces - 1; i >= 0; i--)
        speed[i] = fmin(speed[i], sqrt(speed[i + 1] * speed[i + 1] + square_change));
}

/* Set the reference to a drawn line of (count, 2) points, converted to arcs. Returns 0 if the line is too short. */
int CALLED(lab_draw)(const double *points, int count, double max_speed)
{
    static double even[DRAWN_PIECES][2], heading[DRAWN_PIECES], curvature[DRAWN_PIECES], speed[DRAWN_PIECES + 1];
    static double breaks[DRAWN_PIECES], table[ARC_ROWS * DRAWN_PIECES];
    const int pieces = resample(points, count, even) - 2, columns = pieces + 1;
    if (pieces < 4)
        return 0;
    for (int i = 0; i <= pieces; i++) {
        heading[i] = atan2(even[i + 1][1] - even[i][1], even[i + 1][0] - even[i][0]);
        if (i)
            heading[i] = heading[i - 1] + ddmpc_wrap(heading[i] - heading[i - 1]);
    }
    for (int i = 0; i < pieces; i++)
        curvature[i] = (heading[i + 1] - heading[i]) / drawing.spacing;
    compute_speeds(pieces, curvature, max_speed, speed);
    double pose[3] = {even[0][0], even[0][1], heading[0]}, time = 0.0, travelled = 0.0;
    for (int i = 0; i <= pieces; i++) {
        const int last = i == pieces;
        const double duration = last ? 0.0 : 2.0 * drawing.spacing / (speed[i] + speed[i + 1]);
        const double acceleration = last ? 0.0 : 0.5 * (speed[i + 1] - speed[i]) / duration;
        const double column[ARC_ROWS] = {time,
                                         pose[0],
                                         pose[1],
                                         pose[2],
                                         travelled,
                                         last ? 0.0 : 1.0,
                                         last ? 0.0 : curvature[i],
                                         0.0,
                                         last ? 0.0 : speed[i],
                                         acceleration};
        const double *arguments[2] = {&duration, column};
        double twist[2], *results[3] = {pose, twist, &travelled};
        for (int row = 0; row < ARC_ROWS; row++)
            table[row * columns + i] = column[row];
        breaks[i] = time;
        if (!last)
            ddmpc_f_arc_piece(arguments, results, 0, 0, 0);
        time += duration;
    }
    const ddmpc_trajectory new_trajectory = {breaks, table, columns, 0, time, {0.0, 0.0, 0.0}};
    use_trajectory(&new_trajectory);
    return 1;
}

/* Both robots at remaining where the reference begins, and everything as new. Returns 0 if the controller refuses it. */
int CALLED(lab_start)(void)
{
    double pose[3], twist[2], arc_length;
    const double duration = reference.duration;
    reference.sample(reference.context, 0.0, pose, twist, &arc_length);
    memset(&report, 0, sizeof report);
    report.duration = duration;
    push_ticks = 0;
    robot_reset(&robot, &world, pose);
    robot_reset(&ghost, &world, pose);
    rpp_start(&peer, &peer_parameters, &reference);
    ddmpc_reset(mpc.controller);
    start_refused = !(mpc.ready && ddmpc_start(mpc.controller, &reference, 0.0));
    memcpy(report.pose, pose, sizeof pose);
    memcpy(report.peer, pose, sizeof pose);
    memcpy(report.reference, pose, sizeof pose);
    return !start_refused;
}

/* Move the robot to another pose. */
void CALLED(lab_place)(double x, double y, double heading)
{
    robot.pose[0] = x;
    robot.pose[1] = y;
    robot.pose[2] = heading;
}

/* Push the robot: for `ticks` ticks it slides to the left [m/s] and turns [rad/s] in addition to its wheel motion. */
void CALLED(lab_push)(double left, double turn, int ticks)
{
    push_twist[0] = left;
    push_twist[1] = turn;
    push_ticks = ticks;
}

static void apply_push(void)
{
    const double dt = world.robot.sample_time;
    if (push_ticks <= 0)
        return;
    push_ticks--;
    robot.pose[0] -= dt * push_twist[0] * sin(robot.pose[2]);
    robot.pose[1] += dt * push_twist[0] * cos(robot.pose[2]);
    robot.pose[2] += dt * push_twist[1];
}

static void run_controller(double time, ddmpc_input *input)
{
    const double start = lab_now();
    input->reference_time = time;
    input->on_time = 1;
    ddmpc_step(mpc.controller, time, input);
    ddmpc_give_up(mpc.controller);
    report.controller_seconds += lab_now() - start;
    report.ticks += 1.0;
}

static void update_errors(double time)
{
    double twist[2], arc_length;
    reference.sample(reference.context, time, report.reference, twist, &arc_length);
    report.error = hypot(robot.pose[0] - report.reference[0], robot.pose[1] - report.reference[1]);
    report.peer_error = rpp_distance(&peer, ghost.pose);
    if (time <= reference.duration + 1e-9) {
        report.counted += 1.0;
        report.square_sum += report.error * report.error;
        report.largest = fmax(report.largest, report.error);
    }
}

static void fill_report(const ddmpc_result *result)
{
    const int pose = mpc.sizes.states + mpc.sizes.slips + 3;
    memcpy(report.pose, robot.pose, sizeof report.pose);
    memcpy(report.peer, ghost.pose, sizeof report.peer);
    memcpy(report.estimate, result->estimate.mean + pose, sizeof report.estimate);
    memcpy(report.twist, robot.body, sizeof report.twist);
    memcpy(report.peer_twist, ghost.body, sizeof report.peer_twist);
    memcpy(report.command, result->command, sizeof report.command);
    memcpy(report.peer_command, peer.last, sizeof report.peer_command);
    report.mode = result->mode;
    report.reasons = result->reasons;
    report.has_estimate = result->has_estimate;
    report.has_plan = result->has_plan;
    report.iterations = result->solver.iterations;
    report.peer_finished = peer.finished;
}

/* Run one tick of both robots: measure, control, report, and advance. */
void CALLED(lab_tick)(void)
{
    ddmpc_input input;
    const double time = (double)robot.tick * world.robot.sample_time;
    if (start_refused)
        return;
    robot_measure(&robot, &world, &input);
    run_controller(time, &input);
    const ddmpc_result *result = ddmpc_result_of(mpc.controller);
    robot_measure(&ghost, &world, &input);
    rpp_step(&peer, time, world.robot.sample_time, &input);
    report.time = time;
    update_errors(time);
    fill_report(result);
    robot_advance(&robot, &world, result->command);
    robot_advance(&ghost, &world, peer.last);
    apply_push();
}
