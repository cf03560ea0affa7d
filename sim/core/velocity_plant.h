/* A velocity model as plant, for one control sample: effects of the base around its dynamics, slip of the body, motion
 * beyond the model, and the pose. SI units. sim/plants/model_plant.py and the classes that it names explain the numbers.
 * As in twin.h, sums and products are rounded one by one. */
#ifndef VELOCITY_PLANT_H
#define VELOCITY_PLANT_H

typedef struct {
  /* Dynamics in `steps` of a sample. Without states `next` holds the outputs at the end of the sample. */
  int steps, order, memory;
  double step_time;
  const double *A, *B0, *B1, *C; /* [order][order], [order][2], [order][2], [2][order] */
  int delay[2];
  double *state, *commands; /* [2][order], the second one is scratch; [memory + 1][2], the newest last */
  double next[2];
  /* Effects of the base; infinite limits and zeros for none. */
  double upper[2], lower[2], grows[2], falls[2]; /* rates are those of a step */
  double track, resolution, coasting, top_speed, angle, yaw_per_metre;
  /* Slip of the body. */
  double longitudinal_gain, yaw_gain, side_slip, polynomial[9];
  double track_at_rest, track_growth; /* a track at rest of zero: no growing track */
  int has_polynomial;
  /* Motion beyond the model: `rows` [count][3] repeat; count 0: none. */
  const double *rows;
  int count;
  double variance[18], largest[6]; /* [3][6] */
  /* State and results. */
  long long tick;
  double reached[2], strain, rate[2];
  double wheels[2], body[2], pose[3], twist[3]; /* v, omega at the end of the sample; true pose and twist */
  double yaw_rate;                              /* at the end of the sample, with its motion beyond the model */
  double *arcs;                                 /* [steps][6] pose and constant twist of each step */
} velocity_plant;

/* Reset to rest at `pose`, which the struct holds. */
void velocity_plant_reset(velocity_plant *p);
/* Advance by one sample under a command [2]. */
void velocity_plant_advance(velocity_plant *p, const double *command);
/* Pose [3] at `time` in the last sample, which began at `start`. */
void velocity_plant_look(const velocity_plant *p, double start, double time, double *pose);

#endif
