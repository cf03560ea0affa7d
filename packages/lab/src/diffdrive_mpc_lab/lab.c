/* Functions called by the page: set numbers by kind, run ticks, and read a report and the plan. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "ddmpc_formulas.h"
#include "lab.h"

#define CALLED(name) __attribute__((export_name(#name))) name

enum { DRAWN_PIECES = 2048, ARC_ROWS = 10 };

/* The page's clock [s]. */
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
static lab_controller ours;
static lab_drawing drawing;
static ddmpc_trajectory trajectory;
static ddmpc_reference reference;
static lab_report report;
static double push_twist[2];
static int push_ticks, start_refused;

/* Memory for so many numbers; the page gives it back when nothing points to them any more. */
double *CALLED(lab_room)(int count) { return malloc((size_t)count * sizeof(double)); }
void CALLED(lab_free)(double *numbers) { free(numbers); }

lab_report *CALLED(lab_report_of)(void) { return &report; }
const double *CALLED(lab_plan)(void) { return ddmpc_result_of(ours.controller)->planned_poses; }

void CALLED(lab_set_robot)(const double *numbers) { memcpy(&world.robot, numbers, sizeof world.robot); }
void CALLED(lab_set_floor)(const double *numbers) { memcpy(&world.floor, numbers, sizeof world.floor); }
void CALLED(lab_set_ice)(const double *numbers) { memcpy(&world.ice, numbers, sizeof world.ice); }
void CALLED(lab_set_sensors)(const double *numbers) { memcpy(&world.sensors, numbers, sizeof world.sensors); }
void CALLED(lab_set_peer)(const double *numbers) { memcpy(&peer_parameters, numbers, sizeof peer_parameters); }
void CALLED(lab_set_drawing)(const double *numbers) { memcpy(&drawing, numbers, sizeof drawing); }
void CALLED(lab_set_cover)(int covered) { world.covered = covered; }

/* Number of states, delays, then A, B0, B1 and C row by row. The robots drive on with the states that they have. */
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

/* Rows, then the draws of poses, gyro, encoders and losses. */
void CALLED(lab_set_noise)(const double *numbers)
{
    const int count = (int)numbers[0];
    const double *pose = numbers + 1, *gyro = pose + 3 * count, *encoders = gyro + count;
    const lab_noise noise = {count, pose, gyro, encoders, encoders + 4 * count};
    world.noise = noise;
}

/* Set the number of patches of ice, and x, y and radius of each. */
void CALLED(lab_set_patches)(const double *numbers)
{
    world.patch_count = (int)fmin(numbers[0], LAB_PATCHES);
    memcpy(world.patch, numbers + 1, (size_t)world.patch_count * sizeof *world.patch);
}

/* Sizes and constants as generated; what they point to lies among the numbers. Returns 0 if the core has no room. */
int CALLED(lab_set_controller)(const double *numbers)
{
    for (int i = 0; i < 4; i++)
        free(ours.memory[i]);
    memset(&ours, 0, sizeof ours);
    lab_read_controller(numbers, &ours.sizes, &ours.constants);
    const size_t bytes[4] = {
        ddmpc_controller_bytes(),
        (size_t)ddmpc_reals(&ours.sizes) * sizeof(real),
        (size_t)ddmpc_ints(&ours.sizes) * sizeof(int),
        (size_t)ours.sizes.history * ddmpc_node_bytes(),
    };
    for (int i = 0; i < 4; i++)
        if (!(ours.memory[i] = calloc(bytes[i] + 1, 1)))
            return 0;
    ours.controller = ours.memory[0];
    ours.ready = ddmpc_init(ours.controller, &ours.sizes, &ours.constants, &ours.functions, ours.memory[1],
                            ours.memory[2], ours.memory[3]);
    return ours.ready;
}

static void take_reference(const ddmpc_trajectory *taken)
{
    const ddmpc_reference sampled = {ddmpc_sample_one, &trajectory, taken->duration};
    trajectory = *taken;
    reference = sampled;
    report.duration = trajectory.duration;
}

/* Numbers: 1 for cubics, pieces, breaks, duration, then the breaks and the table. */
void CALLED(lab_set_reference)(const double *numbers)
{
    const int breaks = (int)numbers[2];
    const ddmpc_trajectory taken = {numbers + 4,    numbers + 4 + breaks, (int)numbers[1],
                                    (int)numbers[0], numbers[3],           {0.0, 0.0, 0.0}};
    take_reference(&taken);
}

/* Pose and twist of the reference at `time`, into 5 numbers. */
void CALLED(lab_sample)(double time, double *numbers)
{
    double arc_length;
    ddmpc_sample_one(&trajectory, time, numbers, numbers + 3, &arc_length);
}

/* A drawn line in equal steps, smoothed: (count, 2) points in place. Returns how many there are now. */
static int evened(const double *points, int count, double even[DRAWN_PIECES][2])
{
    int laid = 1;
    double rest = drawing.spacing;
    memcpy(even[0], points, sizeof even[0]);
    for (int i = 1; i < count && laid < DRAWN_PIECES; i++) {
        const double *from = points + 2 * (i - 1), dx = points[2 * i] - from[0], dy = points[2 * i + 1] - from[1];
        const double length = hypot(dx, dy);
        for (; length > 0.0 && rest <= length && laid < DRAWN_PIECES; rest += drawing.spacing, laid++) {
            even[laid][0] = from[0] + dx * rest / length;
            even[laid][1] = from[1] + dy * rest / length;
        }
        rest -= length;
    }
    for (int round = 0; round < (int)drawing.rounds; round++)
        for (int axis = 0; axis < 2; axis++) {
            double before = even[0][axis];
            for (int i = 1; i + 1 < laid; i++) {
                const double value = even[i][axis];
                even[i][axis] = 0.25 * before + 0.5 * value + 0.25 * even[i + 1][axis];
                before = value;
            }
        }
    return laid;
}

/* Speeds at the ends of pieces: as fast as `most`, curvature and acceleration allow, from rest to rest. */
static void timed(int pieces, const double *curvature, double most, double *speed)
{
    const double gained = 2.0 * drawing.acceleration * drawing.spacing;
    for (int i = 0; i <= pieces; i++) {
        const double bend = fmax(fabs(curvature[i < pieces ? i : pieces - 1]), fabs(curvature[i ? i - 1 : 0]));
        speed[i] = fmin(most, fmin(drawing.yaw_rate / fmax(bend, 1e-9), sqrt(drawing.lateral / fmax(bend, 1e-9))));
    }
    speed[0] = speed[pieces] = 0.0;
    for (int i = 1; i <= pieces; i++)
        speed[i] = fmin(speed[i], sqrt(speed[i - 1] * speed[i - 1] + gained));
    for (int i = pieces - 1; i >= 0; i--)
        speed[i] = fmin(speed[i], sqrt(speed[i + 1] * speed[i + 1] + gained));
}

/* Take a drawn line, (count, 2) points, as reference: arcs from step to step. Returns 0 where it is too short. */
int CALLED(lab_draw)(const double *points, int count, double most)
{
    static double even[DRAWN_PIECES][2], heading[DRAWN_PIECES], curvature[DRAWN_PIECES], speed[DRAWN_PIECES + 1];
    static double breaks[DRAWN_PIECES], table[ARC_ROWS * DRAWN_PIECES];
    const int pieces = evened(points, count, even) - 2, columns = pieces + 1;
    if (pieces < 4)
        return 0;
    for (int i = 0; i <= pieces; i++) {
        heading[i] = atan2(even[i + 1][1] - even[i][1], even[i + 1][0] - even[i][0]);
        if (i)
            heading[i] = heading[i - 1] + ddmpc_wrap(heading[i] - heading[i - 1]);
    }
    for (int i = 0; i < pieces; i++)
        curvature[i] = (heading[i + 1] - heading[i]) / drawing.spacing;
    timed(pieces, curvature, most, speed);
    double pose[3] = {even[0][0], even[0][1], heading[0]}, time = 0.0, travelled = 0.0;
    for (int i = 0; i <= pieces; i++) {
        const int last = i == pieces;
        const double duration = last ? 0.0 : 2.0 * drawing.spacing / (speed[i] + speed[i + 1]);
        const double gained = last ? 0.0 : 0.5 * (speed[i + 1] - speed[i]) / duration;
        const double column[ARC_ROWS] = {time, pose[0], pose[1], pose[2], travelled, last ? 0.0 : 1.0,
                                         last ? 0.0 : curvature[i], 0.0, last ? 0.0 : speed[i], gained};
        const double *arguments[2] = {&duration, column};
        double twist[2], *results[3] = {pose, twist, &travelled};
        for (int row = 0; row < ARC_ROWS; row++)
            table[row * columns + i] = column[row];
        breaks[i] = time;
        if (!last)
            ddmpc_f_arc_piece(arguments, results, 0, 0, 0);
        time += duration;
    }
    const ddmpc_trajectory taken = {breaks, table, columns, 0, time, {0.0, 0.0, 0.0}};
    take_reference(&taken);
    return 1;
}

/* Both robots at rest where the reference begins, and everything as new. Returns 0 if the controller refuses it. */
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
    ddmpc_reset(ours.controller);
    start_refused = !(ours.ready && ddmpc_start(ours.controller, &reference, 0.0));
    memcpy(report.pose, pose, sizeof pose);
    memcpy(report.peer, pose, sizeof pose);
    memcpy(report.reference, pose, sizeof pose);
    return !start_refused;
}

/* Somebody carries the robot: it stands elsewhere from now on. */
void CALLED(lab_place)(double x, double y, double heading)
{
    robot.pose[0] = x;
    robot.pose[1] = y;
    robot.pose[2] = heading;
}

/* Somebody pushes it: for so many ticks it slides to its left and turns, beside what its wheels do. */
void CALLED(lab_push)(double left, double turn, int ticks)
{
    push_twist[0] = left;
    push_twist[1] = turn;
    push_ticks = ticks;
}

static void slide(void)
{
    const double dt = world.robot.sample_time;
    if (push_ticks <= 0)
        return;
    push_ticks--;
    robot.pose[0] -= dt * push_twist[0] * sin(robot.pose[2]);
    robot.pose[1] += dt * push_twist[0] * cos(robot.pose[2]);
    robot.pose[2] += dt * push_twist[1];
}

static void decide(double time, ddmpc_input *input)
{
    const double began = lab_now();
    input->reference_time = time;
    input->on_time = 1;
    ddmpc_step(ours.controller, time, input);
    ddmpc_give_up(ours.controller);
    report.controller_seconds += lab_now() - began;
    report.ticks += 1.0;
}

static void judge(double time)
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

static void tell(const ddmpc_result *result)
{
    const int pose = ours.sizes.states + ours.sizes.slips + 3;
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

/* One tick of both robots: measure, decide, report what was decided where, and advance. */
void CALLED(lab_tick)(void)
{
    ddmpc_input input;
    const double time = (double)robot.tick * world.robot.sample_time;
    if (start_refused)
        return;
    robot_measure(&robot, &world, &input);
    decide(time, &input);
    const ddmpc_result *result = ddmpc_result_of(ours.controller);
    robot_measure(&ghost, &world, &input);
    rpp_step(&peer, time, world.robot.sample_time, &input);
    report.time = time;
    judge(time);
    tell(result);
    robot_advance(&robot, &world, result->command);
    robot_advance(&ghost, &world, peer.last);
    slide();
}
