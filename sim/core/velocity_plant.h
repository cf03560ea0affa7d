/* Velocity model as plant for one control sample: effects of the base, dynamics, slip of the body, unexplained motion,
 * and the pose. Units are SI units. sim/plants/model_plant.py and its classes document the parameters. As in twin.h,
 * each operation is rounded in source order. */
#ifndef VELOCITY_PLANT_H
#define VELOCITY_PLANT_H

typedef struct {
    /* Dynamics with `steps` per sample. If `order` is 0, `next` contains the outputs at the end of the sample. */
    int steps, order, memory;
    double step_time;
    const double *A, *B0, *B1, *C; /* [order][order], [order][2], [order][2], [2][order] */
    int delay[2];
    double *state, *commands; /* [2][order], of which the second row is scratch; [memory + 1][2], oldest first */
    double next[2];
    /* Effects of the base; absent effects have infinite limits and zeros. */
    double upper[2], lower[2], grows[2], falls[2]; /* limits, and maximum changes per step */
    double track, resolution, coasting, top_speed, angle, yaw_per_metre;
    /* Slip of the body. */
    double longitudinal_gain, yaw_gain, side_slip, polynomial[9];
    double track_at_rest, track_growth; /* the track does not grow if track_at_rest is 0 */
    int has_polynomial;
    /* Unexplained motion: `rows` [count][3] repeat; there is no such motion if count is 0. */
    const double *rows;
    int count;
    double variance[18], largest[6];  /* [3][6] */
    double limits[2], wheel_yaw_gain; /* maximum absolute commands; ratio of true yaw rate to that of the encoders */
    /* State and results. */
    long long tick;
    double sent[2]; /* last command */
    int has_sent;
    double reached[2], strain, rate[2];
    double wheels[2], body[2], pose[3], twist[3]; /* v, omega at the end of the sample; true pose and twist */
    double yaw_rate;                              /* at the end of the sample, including unexplained motion */
    double *arcs;                                 /* [steps][6] pose and constant twist of each step */
} velocity_plant;

/* Reset to rest at the field `pose`. */
void velocity_plant_reset(velocity_plant *p);
/* Advance by one sample under a command [2]. */
void velocity_plant_advance(velocity_plant *p, const double *command);
/* Compute the pose [3] at `time` in the last sample, which started at `start`. */
void velocity_plant_look(const velocity_plant *p, double start, double time, double *pose);

#endif
