/* Regulated pure pursuit with the parameters of bench/peers/rpp.yaml, ported from bench/peers/rpp.py for the comparison
 * in the page. A test compares both implementations. */
#include <math.h>
#include <string.h>

#include "lab.h"

static const double SAMPLE_INTERVAL = 0.005; /* interval at which the reference is sampled for its path [s] */
static const double MIN_SQUARE_DISTANCE =
    0.001; /* squared distance of the carrot below which the curvature is 0 [m^2] */

static void append(rpp_peer *peer, const double before[3], const double after[3], double fraction)
{
    if (peer->count == RPP_POSES)
        return;
    for (int i = 0; i < 3; i++)
        peer->path[peer->count][i] = before[i] + fraction * (after[i] - before[i]);
    peer->count++;
}

/* Compute the poses of the path at distances of `path_spacing` along the reference; the last pose is its end. */
static void build_path(rpp_peer *peer, const ddmpc_reference *reference)
{
    const double spacing = peer->parameters->path_spacing;
    double before[3], after[3], twist[2], arc_length, travelled = 0.0;
    long steps = (long)ceil(reference->duration / SAMPLE_INTERVAL);
    peer->count = 0;
    reference->sample(reference->context, 0.0, before, twist, &arc_length);
    append(peer, before, before, 0.0);
    for (long k = 1; k <= steps; k++) {
        const double time = k == steps ? reference->duration : SAMPLE_INTERVAL * (double)k;
        reference->sample(reference->context, time, after, twist, &arc_length);
        const double step = hypot(after[0] - before[0], after[1] - before[1]);
        while (step > 0.0 && peer->count * spacing <= travelled + step)
            append(peer, before, after, (peer->count * spacing - travelled) / step);
        travelled += step;
        memcpy(before, after, sizeof before);
    }
    append(peer, before, before, 0.0);
    peer->along[0] = 0.0;
    for (int i = 1; i < peer->count; i++) {
        const double *last = peer->path[i - 1], *next = peer->path[i];
        peer->along[i] = peer->along[i - 1] + hypot(next[0] - last[0], next[1] - last[1]);
    }
}

void rpp_start(rpp_peer *peer, const lab_rpp *parameters, const ddmpc_reference *reference)
{
    memset(peer, 0, sizeof *peer);
    peer->parameters = parameters;
    peer->next = -INFINITY;
    build_path(peer, reference);
}

/* Return the end of the part of the path that is searched from the pose `nearest` on. */
static int search_end(const rpp_peer *peer)
{
    int end = peer->nearest;
    while (end < peer->count && peer->along[end] - peer->along[peer->nearest] <= peer->parameters->search_dist)
        end++;
    return end;
}

/* Advance `nearest` to the pose of the path that is nearest to the robot. */
static void prune(rpp_peer *peer)
{
    const int end = search_end(peer);
    double nearest = INFINITY;
    for (int i = peer->nearest; i < end; i++) {
        const double distance = hypot(peer->path[i][0] - peer->pose[0], peer->path[i][1] - peer->pose[1]);
        if (distance < nearest) {
            nearest = distance;
            peer->nearest = i;
        }
    }
}

static void to_robot_frame(const double pose[3], const double point[3], double relative[2])
{
    const double dx = point[0] - pose[0], dy = point[1] - pose[1], c = cos(pose[2]), s = sin(pose[2]);
    relative[0] = c * dx + s * dy;
    relative[1] = -s * dx + c * dy;
}

/* Find the first exit of the path, in the robot's frame, from the circle of radius `distance`, or its end. */
static void find_carrot(const rpp_peer *peer, double distance, double carrot[2])
{
    const int end = search_end(peer);
    double last[2] = {0.0, 0.0}, point[2] = {0.0, 0.0};
    for (int i = peer->nearest; i < end; i++) {
        memcpy(last, point, sizeof last);
        to_robot_frame(peer->pose, peer->path[i], point);
        if (hypot(point[0], point[1]) < distance)
            continue;
        if (i > peer->nearest) {
            const double dx = point[0] - last[0], dy = point[1] - last[1];
            const double a = dx * dx + dy * dy, b = last[0] * dx + last[1] * dy;
            const double c = last[0] * last[0] + last[1] * last[1] - distance * distance;
            const double fraction = a > 0.0 ? (-b + sqrt(fmax(0.0, b * b - a * c))) / a : 1.0;
            point[0] = last[0] + fraction * dx;
            point[1] = last[1] + fraction * dy;
        }
        break;
    }
    memcpy(carrot, point, sizeof point);
}

static double regulated_speed(const rpp_peer *peer, double curvature, double to_goal)
{
    const lab_rpp *p = peer->parameters;
    const double tight = fabs(curvature) * p->regulated_linear_scaling_min_radius;
    double v = p->desired_linear_vel;
    if (p->use_regulated_linear_velocity_scaling != 0.0 && tight > 1.0)
        v *= 1.0 / tight;
    v = fmax(v, p->regulated_linear_scaling_min_speed);
    if (peer->along[peer->count - 1] - peer->along[peer->nearest] < p->approach_velocity_scaling_dist) {
        const double approach = v * to_goal / p->approach_velocity_scaling_dist;
        v = fmin(v, fmax(approach, p->min_approach_linear_velocity));
    }
    return fmin(v, p->desired_linear_vel);
}

/* Turn on the spot at the maximum rate from which the robot can stop at `angle`. */
static void turn(rpp_peer *peer, double angle)
{
    const lab_rpp *p = peer->parameters;
    const double change = p->max_angular_accel / p->control_frequency;
    const double max_rate = sqrt(2.0 * p->max_angular_accel * fabs(angle));
    double rate = copysign(p->rotate_to_heading_angular_vel, angle);
    rate = fmin(fmax(rate, peer->twist[1] - change), peer->twist[1] + change);
    peer->wish[0] = 0.0;
    peer->wish[1] = fabs(rate) > max_rate ? copysign(max_rate, angle) : rate;
}

static void compute_command(rpp_peer *peer)
{
    const lab_rpp *p = peer->parameters;
    const double *goal = peer->path[peer->count - 1];
    double carrot[2], distance = p->lookahead_dist;
    prune(peer);
    const double heading = ddmpc_wrap(goal[2] - peer->pose[2]);
    const double to_goal = hypot(goal[0] - peer->pose[0], goal[1] - peer->pose[1]);
    const int half = peer->along[peer->nearest] >= 0.5 * peer->along[peer->count - 1];
    peer->near_goal = peer->near_goal || (half && to_goal <= p->xy_goal_tolerance);
    if (peer->near_goal && fabs(heading) <= p->yaw_goal_tolerance) {
        peer->finished = 1;
        peer->wish[0] = peer->wish[1] = 0.0;
        return;
    }
    if (p->use_velocity_scaled_lookahead_dist != 0.0)
        distance = fmin(fmax(p->lookahead_time * fabs(peer->twist[0]), p->min_lookahead_dist), p->max_lookahead_dist);
    find_carrot(peer, distance, carrot);
    if (p->use_rotate_to_heading != 0.0) {
        const double bearing = atan2(carrot[1], carrot[0]);
        if (peer->near_goal || fabs(bearing) > p->rotate_to_heading_min_angle) {
            turn(peer, peer->near_goal ? heading : bearing);
            return;
        }
    }
    const double square = carrot[0] * carrot[0] + carrot[1] * carrot[1];
    const double curvature = square > MIN_SQUARE_DISTANCE ? 2.0 * carrot[1] / square : 0.0;
    peer->wish[0] = regulated_speed(peer, curvature, to_goal);
    peer->wish[1] = peer->wish[0] * curvature;
}

void rpp_step(rpp_peer *peer, double t, double sample_time, const ddmpc_input *input)
{
    const lab_rpp *p = peer->parameters;
    const double limit[2] = {p->max_v, p->max_omega}, step[2] = {p->step_v, p->step_omega};
    if (input->pose.present) {
        memcpy(peer->pose, input->pose.value, sizeof peer->pose);
        peer->has_pose = 1;
    }
    if (input->wheels.present)
        memcpy(peer->twist, input->wheels.value, sizeof peer->twist);
    if (peer->has_pose && !peer->finished && t >= peer->next) {
        peer->next = t + 1.0 / p->control_frequency - 0.5 * sample_time;
        compute_command(peer);
    }
    for (int channel = 0; channel < 2; channel++) {
        const double clipped = fmin(fmax(peer->wish[channel], -limit[channel]), limit[channel]);
        const double low = peer->last[channel] - step[channel], high = peer->last[channel] + step[channel];
        peer->last[channel] = fmin(fmax(clipped, low), high);
    }
}

double rpp_distance(const rpp_peer *peer, const double pose[3])
{
    double nearest = INFINITY;
    for (int i = 1; i < peer->count; i++) {
        const double *from = peer->path[i - 1], *to = peer->path[i];
        const double dx = to[0] - from[0], dy = to[1] - from[1], square = dx * dx + dy * dy;
        const double along = (pose[0] - from[0]) * dx + (pose[1] - from[1]) * dy;
        const double fraction = square > 0.0 ? fmin(fmax(along / square, 0.0), 1.0) : 0.0;
        nearest = fmin(nearest, hypot(pose[0] - from[0] - fraction * dx, pose[1] - from[1] - fraction * dy));
    }
    return nearest;
}
