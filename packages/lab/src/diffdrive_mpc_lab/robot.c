/* Simulated robot by a velocity model with slip and sensors, equal to sim/plants/model_plant.py and
 * sim/sensing/sensors.py. numbers.py generates the formulas of slip and motion. */
#include <math.h>
#include <string.h>

#include "lab.h"
#include "lab_plant.h"

static const double TIME_TOLERANCE = 1e-9;

static void model_output(const lab_robot_state *robot, const lab_model *model, double output[2])
{
    for (int channel = 0; channel < 2; channel++) {
        output[channel] = 0.0;
        for (int i = 0; i < model->states; i++)
            output[channel] += model->C[channel * model->states + i] * robot->state[i];
    }
}

static const lab_floor *floor_at(const lab_world *world, const double pose[3])
{
    for (int i = 0; i < world->patch_count; i++) {
        const lab_patch *patch = &world->patch[i];
        if (hypot(pose[0] - patch->x, pose[1] - patch->y) <= patch->radius)
            return &world->ice;
    }
    return &world->floor;
}

static void apply_slip(const lab_floor *floor, const double output[2], double body[3], double wheels[2])
{
    const double *arguments[2] = {output, (const double *)floor};
    double *results[2] = {body, wheels};
    lab_f_floor(arguments, results, 0, 0, 0);
}

static void integrate_pose(const double pose[3], const double body[3], double duration, double after[3])
{
    const double *arguments[3] = {pose, body, &duration};
    double *results[1] = {after};
    lab_f_move(arguments, results, 0, 0, 0);
}

static void model_advance(lab_robot_state *robot, const lab_model *model, const double command[2])
{
    const int n = model->states;
    double before[LAB_STATES];
    memmove(robot->past[1], robot->past[0], sizeof robot->past - sizeof robot->past[0]);
    memcpy(robot->past[0], command, sizeof robot->past[0]);
    memcpy(before, robot->state, sizeof before);
    for (int i = 0; i < n; i++) {
        double sum = 0.0;
        for (int j = 0; j < n; j++)
            sum += model->A[i * n + j] * before[j];
        for (int channel = 0; channel < 2; channel++) {
            const int delay = model->delay[channel];
            sum += model->B0[2 * i + channel] * robot->past[delay][channel];
            sum += model->B1[2 * i + channel] * robot->past[delay + 1][channel];
        }
        robot->state[i] = sum;
    }
}

/* Measure the pose at `time`. */
static void measure_pose(lab_robot_state *robot, const lab_world *world, double time, const double pose[3])
{
    const lab_sensors *sensors = &world->sensors;
    const double *normal = world->noise.pose + 3 * (robot->pose_draws++ % world->noise.count);
    lab_late_pose late = {time + sensors->latency, time, {0.0, 0.0, 0.0}};
    if (sensors->stamped_on_arrival != 0.0)
        late.stamp = late.arrival;
    for (int i = 0; i < 3; i++)
        late.value[i] = pose[i] + sensors->pose_sd[i] * normal[i];
    late.value[2] = -ddmpc_wrap(-late.value[2]);
    if (sensors->loss > 0.0 && world->noise.losses[robot->loss_draws++ % world->noise.count] < sensors->loss)
        return;
    if (robot->in_flight < LAB_FLIGHT && !world->covered)
        robot->flight[robot->in_flight++] = late;
}

static void measure_motion(lab_robot_state *robot, const lab_world *world, const double wheels[2], double yaw_rate)
{
    const lab_sensors *sensors = &world->sensors;
    const double *normal = world->noise.encoders + 4 * (robot->encoder_draws++ % world->noise.count);
    double speeds[4];
    for (int wheel = 0; wheel < 4; wheel++) {
        const double *row = sensors->body_to_wheels + 2 * wheel;
        speeds[wheel] = row[0] * wheels[0] + row[1] * wheels[1] + sensors->encoder_sd * normal[wheel];
    }
    for (int channel = 0; channel < 2; channel++) {
        robot->twist[channel] = 0.0;
        for (int wheel = 0; wheel < 4; wheel++)
            robot->twist[channel] += sensors->wheels_to_body[4 * channel + wheel] * speeds[wheel];
    }
    const double noise = sensors->gyro_sd * world->noise.gyro[robot->gyro_draws++ % world->noise.count];
    robot->yaw_rate = yaw_rate + (robot->gyro_bias + noise);
}

/* Return 1 if a pose measurement is due up to `until`, and set its `time`. */
static int pose_is_due(lab_robot_state *robot, const lab_world *world, double until, double *time)
{
    *time = (double)robot->next_pose * world->sensors.period;
    if (*time > until + TIME_TOLERANCE)
        return 0;
    robot->next_pose++;
    return 1;
}

void robot_reset(lab_robot_state *robot, const lab_world *world, const double pose[3])
{
    const double at_rest[2] = {0.0, 0.0};
    double time;
    memset(robot, 0, sizeof *robot);
    memcpy(robot->pose, pose, sizeof robot->pose);
    robot->gyro_bias = world->sensors.gyro_bias_sd * world->noise.gyro[robot->gyro_draws++ % world->noise.count];
    robot->next_pose = -(long)ceil((world->sensors.latency - TIME_TOLERANCE) / world->sensors.period);
    while (pose_is_due(robot, world, 0.0, &time))
        measure_pose(robot, world, time, pose);
    measure_motion(robot, world, at_rest, 0.0);
}

static void state_covariance(ddmpc_stamped *stamped, const double *covariance, int size)
{
    stamped->has_covariance = covariance[0] > 0.0;
    memcpy(stamped->covariance, covariance, (size_t)(size * size) * sizeof *covariance);
}

void robot_measure(lab_robot_state *robot, const lab_world *world, ddmpc_input *input)
{
    const lab_sensors *sensors = &world->sensors;
    const double time = (double)robot->tick * world->robot.sample_time;
    int arrived = 0;
    memset(input, 0, sizeof *input);
    while (arrived < robot->in_flight && robot->flight[arrived].arrival <= time + TIME_TOLERANCE)
        arrived++;
    if (arrived) {
        const lab_late_pose *newest = &robot->flight[arrived - 1];
        input->pose.present = 1;
        input->pose.stamp = newest->stamp;
        memcpy(input->pose.value, newest->value, sizeof newest->value);
        state_covariance(&input->pose, sensors->pose_covariance, 3);
        robot->in_flight -= arrived;
        memmove(robot->flight, robot->flight + arrived, (size_t)robot->in_flight * sizeof *robot->flight);
    }
    input->wheels.present = input->yaw_rate.present = 1;
    input->wheels.stamp = input->yaw_rate.stamp = time;
    memcpy(input->wheels.value, robot->twist, sizeof robot->twist);
    state_covariance(&input->wheels, sensors->twist_covariance, 2);
    input->yaw_rate.value[0] = robot->yaw_rate;
    state_covariance(&input->yaw_rate, &sensors->gyro_covariance, 1);
    input->has_sent = robot->has_sent;
    memcpy(input->sent, robot->sent, sizeof robot->sent);
}

static double clipped(double value, double limit) { return fmin(fmax(value, -limit), limit); }

void robot_advance(lab_robot_state *robot, const lab_world *world, const double command[2])
{
    const double sample_time = world->robot.sample_time, start_time = (double)robot->tick * sample_time;
    const lab_floor *floor = floor_at(world, robot->pose);
    double before[2], after[2], mean[2], twist[3], wheels[2], start[3], end, time;
    robot->has_sent = 1;
    for (int channel = 0; channel < 2; channel++)
        robot->sent[channel] = clipped(command[channel], world->robot.limits[channel]);
    model_output(robot, &world->model, before);
    model_advance(robot, &world->model, robot->sent);
    model_output(robot, &world->model, after);
    for (int channel = 0; channel < 2; channel++)
        mean[channel] = 0.5 * (before[channel] + after[channel]);
    apply_slip(floor, mean, twist, wheels);
    memcpy(start, robot->pose, sizeof start);
    integrate_pose(start, twist, sample_time, robot->pose);
    robot->tick++;
    end = (double)robot->tick * sample_time;
    while (pose_is_due(robot, world, end, &time)) {
        double measured[3];
        integrate_pose(start, twist, time - start_time, measured);
        measure_pose(robot, world, time, time == end ? robot->pose : measured);
    }
    apply_slip(floor, after, robot->body, wheels);
    measure_motion(robot, world, wheels, robot->body[2]);
}
