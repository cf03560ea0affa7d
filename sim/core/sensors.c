#include "sensors.h"

#include <math.h>
#include <string.h>

static const double PI = 3.141592653589793;
static const double TIME_TOLERANCE = 1e-9; /* sim/sensing/sensors.py, TIME_TOLERANCE */

static const double *next_row(sensor_noise *noise, int columns) { return noise->rows + columns * noise->next++; }

/* -wrap_angle(-angle) of models/pose.py: into (-pi, pi]. */
static double wrap(double angle)
{
    double rest = fmod(-angle + PI, 2.0 * PI);
    if (rest < 0.0)
        rest += 2.0 * PI;
    return -(rest - PI);
}

int sensors_pose_due(sensor_unit *s, double until)
{
    s->due_time = s->next_pose * s->period;
    if (!(s->due_time <= until + TIME_TOLERANCE))
        return 0;
    s->next_pose++;
    return 1;
}

void sensors_add_pose(sensor_unit *s, double time, const double *pose)
{
    const double *noise = next_row(&s->pose_noise, 3), arrival = time + s->latency;
    double *pending;
    int i;
    if (s->loss > 0.0 && *next_row(&s->loss_noise, 1) < s->loss)
        return;
    if (s->pending_count == s->capacity) {
        s->first_pending = (s->first_pending + 1) % s->capacity;
        s->pending_count--;
    }
    pending = s->pending + 5 * ((s->first_pending + s->pending_count++) % s->capacity);
    pending[0] = arrival;
    pending[1] = s->stamped_on_arrival ? arrival : time;
    for (i = 0; i < 3; i++)
        pending[2 + i] = (pose[i] + noise[i]) * s->pose_signs[i];
    pending[4] = wrap(pending[4] + s->heading_offset);
}

void sensors_add_motion(sensor_unit *s, double time, const double *wheel_speeds, double yaw_rate)
{
    const double *noise = next_row(&s->wheel_noise, 4), *w = s->wheel_speeds;
    const double rate = s->gyro_scale * yaw_rate + (s->gyro_bias + s->gyro_noise * *next_row(&s->yaw_rate_noise, 1));
    int i;
    for (i = 0; i < 4; i++)
        s->wheel_speeds[i] = (wheel_speeds[s->wheels[i]] + noise[s->wheels[i]]) * s->wheel_signs[i];
    for (i = 0; i < 2; i++) {
        const double *row = s->to_body + 4 * i;
        s->twist.value[i] = (w[0] * row[0] + w[2] * row[2]) + (w[1] * row[1] + w[3] * row[3]);
    }
    s->yaw_rate.value[0] = fmin(fmax(rate, -s->max_gyro_reading), s->max_gyro_reading);
    s->twist.stamp = s->yaw_rate.stamp = time;
    s->twist.present = s->yaw_rate.present = 1;
}

void sensors_collect(sensor_unit *s, double time)
{
    s->pose.present = 0;
    while (s->pending_count && s->pending[5 * s->first_pending] <= time + TIME_TOLERANCE) {
        const double *pending = s->pending + 5 * s->first_pending;
        s->pose.stamp = pending[1];
        memcpy(s->pose.value, pending + 2, sizeof s->pose.value);
        s->pose.present = 1;
        s->first_pending = (s->first_pending + 1) % s->capacity;
        s->pending_count--;
    }
}

void sensors_clear(sensor_unit *s) { s->twist.present = s->yaw_rate.present = 0; }
