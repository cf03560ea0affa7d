/* Sensors of all plants: noise, bias, loss and latency between the true motion and the controller.
 * sim/sensing/sensors.py documents the parameters and draws the noise. Units are SI units. As in twin.h, each operation
 * is rounded in source order. */
#ifndef SENSORS_H
#define SENSORS_H

/* Random numbers drawn in advance: `count` rows of 3 (pose), 4 (wheels) or 1 (gyro, losses) columns. */
typedef struct {
    const double *rows;
    int next, count;
} sensor_noise;

/* One reading, with the fields of ddmpc_stamped in mpc/core/core.h. */
typedef struct {
    double stamp;
    double value[3];
    double covariance[9];
    int present, has_covariance;
} sensor_reading;

typedef struct {
    double sample_time;
    double period, latency, loss, heading_offset, pose_signs[3];
    int stamped_on_arrival;
    double gyro_scale, gyro_noise, gyro_bias, max_gyro_reading;
    double to_wheels[8], to_body[8], wheel_signs[4]; /* [4][2], [2][4] */
    int wheels[4];                                   /* index of the wheel that each encoder measures */
    sensor_noise pose_noise, wheel_noise, yaw_rate_noise, loss_noise;
    long long next_pose;
    double due_time; /* time of the last pose found by sensors_pose_due */
    double *pending; /* [capacity][5] arrival, stamp and value of poses that are not delivered yet */
    int first_pending, pending_count;
    int capacity;           /* a full buffer drops its oldest pose; newer poses replace that pose at delivery anyway */
    double wheel_speeds[4]; /* newest reading */
    sensor_reading pose, twist, yaw_rate;
} sensor_unit;

/* Return 1 if a further pose is measured up to time `until`, and store its time as `due_time`. */
int sensors_pose_due(sensor_unit *s, double until);
/* Measure the true pose [3] at `time`, unless the reading is lost. */
void sensors_add_pose(sensor_unit *s, double time, const double *pose);
/* Measure wheel speeds [4] and yaw rate at `time`. */
void sensors_add_motion(sensor_unit *s, double time, const double *wheel_speeds, double yaw_rate);
/* Deliver the newest pose that has arrived by `time`. */
void sensors_collect(sensor_unit *s, double time);
/* Clear the readings of wheels and gyro, since each reading is delivered only once. */
void sensors_clear(sensor_unit *s);

#endif
