/* Plant with a velocity model: base effects, dynamics, slip of the body, unexplained motion, and integration of the
 * pose. Units are SI units. sim/plants/model_plant.py and the classes that it uses document the parameters. As in
 * twin.h, each operation is rounded in source order. */
#ifndef VELOCITY_PLANT_H
#define VELOCITY_PLANT_H

typedef struct {
    /* Dynamics with `steps` per sample. If `order` is 0, `next` contains the outputs at the end of the sample. */
    int steps, order, memory;
    double step_time;
    const double *A, *B0, *B1, *C; /* [order][order], [order][2], [order][2], [2][order] */
    int delay[2];
    double *state, *commands; /* [2][order], with a scratch second row; [memory + 1][2], oldest first */
    double next[2];
    /* Base effects; parameters of absent effects are zero, and their limits are so large that they are never active. */
    double upper[2], lower[2], max_rise[2], max_fall[2]; /* limits, and maximum changes per step */
    double track, resolution, coasting, max_wheel_speed, relaxation_angle, yaw_per_metre;
    /* Slip of the body. */
    double longitudinal_gain, yaw_gain, side_slip, polynomial[9];
    double track_at_rest, track_growth; /* the track does not grow if track_at_rest is 0 */
    int has_polynomial;
    /* Unexplained motion: the `rows` [count][3] are repeated periodically; it is absent if count is 0. */
    const double *rows;
    int count;
    double variance[18], max_squares[6]; /* [3][6] factors of the squared features, and upper bounds of the squares */
    /* Ratio of forward slip speed and |omega| dv/dt; ratio of additional yaw rate and omega, and its growth per v^2. */
    double traction_slip, yaw_slip[2];
    int on_wheels[2]; /* 1 if the encoders measure the unexplained forward speed, and the unexplained yaw rate */
    double limits[2], wheel_yaw_gain; /* maximum absolute commands; ratio of true yaw rate to that of the encoders */
    /* State and results. */
    long long tick;
    double sent[2]; /* last command */
    int has_sent;
    double limited_command[2], strain, rate[2];
    double wheels[2], body[2]; /* v, omega of encoders and body at the end of the sample */
    double pose[3], twist[3];  /* true pose and twist */
    double yaw_rate;           /* at the end of the sample, including unexplained motion */
    double wheel_motion[2];    /* unexplained v, omega of the encoders at the end of the sample */
    double *arcs;              /* [steps][6] pose and constant twist of each step */
} velocity_plant;

/* Reset to rest at the field `pose`. */
void velocity_plant_reset(velocity_plant *p);
/* Advance by one sample under a command [2]. */
void velocity_plant_advance(velocity_plant *p, const double *command);
/* Compute the pose [3] at a `time` in the last sample; `start` is the start time of the sample. */
void velocity_plant_past_pose(const velocity_plant *p, double start, double time, double *pose);

#endif
