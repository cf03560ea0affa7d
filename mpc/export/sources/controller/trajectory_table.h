/* What is tracked: a timed trajectory, as a table or as a function of the application. */
#ifndef DDMPC_TRAJECTORY_TABLE_H
#define DDMPC_TRAJECTORY_TABLE_H

#include "real.h"

/* A trajectory: before 0 it rests at its start, after `duration` at its end with zero twist. */
typedef struct ddmpc_reference {
    /* Pose (x, y [m], theta [rad], unwrapped) and twist (v [m/s], omega [rad/s]) at `time` [s] since its start. */
    void (*sample)(const void *context, ddmpc_time time, real pose[3], real twist[2]);
    const void *context;
    ddmpc_time duration; /* [s] */
} ddmpc_reference;

/* One row of a table: x, y [m], theta [rad, unwrapped], v [m/s], omega [rad/s]. */
typedef real ddmpc_point[5];

/* Rows every `spacing` [s] from 0 on, the last one at `duration` [s]. */
typedef struct {
    const ddmpc_point *point;
    int points; /* at least 2 */
    ddmpc_time spacing, duration;
} ddmpc_table;

/* The trajectory of a table; between rows cubic in the pose, linear in the twist. */
ddmpc_reference ddmpc_table_reference(const ddmpc_table *table);

#endif
