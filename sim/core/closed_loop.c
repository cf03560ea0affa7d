#include "closed_loop.h"

#include <math.h>
#include <string.h>

void plant_sample(velocity_plant *p, sensor_unit *s, const double *command)
{
    const double start = p->tick * s->sample_time;
    double now, twist[2], speeds[4];
    int i;
    for (i = 0; i < 2; i++)
        p->sent[i] = fmin(fmax(command[i], -p->limits[i]), p->limits[i]);
    p->has_sent = 1;
    velocity_plant_advance(p, p->sent);
    now = p->tick * s->sample_time;
    while (sensors_pose_due(s, now)) {
        double pose[3];
        if (s->due_time != now)
            velocity_plant_past_pose(p, start, s->due_time, pose);
        sensors_add_pose(s, s->due_time, s->due_time != now ? pose : p->pose);
    }
    /* BodySlip.turned */
    twist[0] = p->wheels[0] + p->wheel_motion[0];
    twist[1] = (p->yaw_gain * p->wheels[1] + p->wheel_motion[1]) / p->wheel_yaw_gain;
    for (i = 0; i < 4; i++) /* rounded like a matrix product */
        speeds[i] = fma(twist[0], s->to_wheels[2 * i], twist[1] * s->to_wheels[2 * i + 1]);
    sensors_add_motion(s, now, speeds, p->yaw_rate);
}

int closed_loop_run(closed_loop *loop, velocity_plant *p, sensor_unit *s, int row, int ticks)
{
    int tick, i;
    for (tick = 0; tick < ticks; tick++, row++) {
        const double time = p->tick * s->sample_time;
        sensors_collect(s, time);
        *loop->pose = s->pose;
        *loop->wheels = s->twist;
        *loop->yaw_rate = s->yaw_rate;
        sensors_clear(s);
        *loop->has_sent = p->has_sent;
        memcpy(loop->sent, p->sent, sizeof p->sent);
        *loop->reference_time = time - loop->start;
        loop->pending = loop->step(loop->controller, time, loop->input);
        if (loop->pending || *loop->mode || *loop->reasons || *loop->notes || *loop->status)
            break;
        for (i = 0; i < loop->column_count; i++) {
            const loop_column *column = loop->columns + i;
            memcpy(column->to + row * column->stride, column->from, (size_t)column->bytes);
        }
        plant_sample(p, s, loop->command);
    }
    return tick;
}
