/* Closed loop of a velocity plant, its sensors and a controller, for ticks that need no Python. sim/compiled_loop.py
 * fills the structure. */
#ifndef CLOSED_LOOP_H
#define CLOSED_LOOP_H

#include "sensors.h"
#include "velocity_plant.h"

/* Memory that is copied to row k of a table at tick k; the rows are `stride` bytes apart. */
typedef struct {
    const void *from;
    char *to;
    int bytes, stride;
} loop_column;

typedef struct {
    /* Step of the controller, which returns 0 after a complete tick, and addresses of the fields of its input. */
    int (*step)(void *controller, double time, const void *input);
    void *controller;
    const void *input;
    sensor_reading *pose, *wheels, *yaw_rate;
    double start, *reference_time, *sent;
    int *has_sent;
    /* Result of the step. A tick is ordinary if mode, reasons, notes and status are 0. */
    const double *command;
    const int *mode, *reasons, *notes, *status;
    int pending; /* return value of the last step */
    const loop_column *columns;
    int column_count;
} closed_loop;

/* Advance plant and sensors by one sample under a command [2], which is clipped to the limits. */
void plant_sample(velocity_plant *p, sensor_unit *s, const double *command);
/* Run up to `ticks` ticks, and record them from row `row` on. Return the number of completed ticks. A number below
 * `ticks` means that the next tick is not ordinary: the controller has made its step, and the caller must complete the
 * tick. */
int closed_loop_run(closed_loop *loop, velocity_plant *p, sensor_unit *s, int row, int ticks);

#endif
