/* Free space of the robot: convex pieces of obstacles, half-spaces between pieces and plan, and the stopping path.
 *
 * The code is compiled together with the core into a separate library, see pieces.py. cffi parses this file like core.h,
 * so Python needs no second declaration of names and shapes. */
#ifndef DDMPC_FREE_SPACE_H
#define DDMPC_FREE_SPACE_H

#include "core.h"

enum { DDMPC_MAX_CORNERS = 32, DDMPC_HALF_SPACE = 5 };

/* Convex pieces. A piece is the hull of its corners (counter-clockwise), inflated by a radius, at constant velocity. */
typedef struct {
    int pieces;
    const int *first;     /* [pieces+1] index of the first corner of each piece */
    const real *corner;   /* [first[pieces]][2] at time 0 [m] */
    const real *widening; /* [pieces] radius of inflation [m] */
    const real *velocity; /* [pieces][2] [m/s] */
    const real *circle;   /* [pieces][3] centre and radius of the bounding circle at time 0 [m] */
} ddmpc_surroundings;

/* The robot: the hull of its corners (counter-clockwise, in the frame of the robot), inflated by a radius. */
typedef struct {
    int corners;
    const real *corner; /* [corners][2] [m] */
    real widening;      /* radius of inflation [m] */
    real reach;         /* distance of the farthest point from the origin [m] */
} ddmpc_footprint;

/* Signed distance [m] from the footprint at `pose` (3) to one piece at `time` [s]: the gap, or the negative penetration
   depth. `normal` (2) is the direction of the gap from the footprint. */
real ddmpc_gap(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, int piece, const real *pose,
               real time, real *normal);
/* Minimum gap at each of `count` poses (3), clipped to `max_gap` [m], and its piece, -1 if no piece is closer. */
void ddmpc_clearances(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, int count, const real *poses,
                      const real *times, real max_gap, real *gaps, int *pieces);

/* Required distance from pieces. */
typedef struct {
    real margin; /* minimum distance [m] */
    real factor; /* number of standard deviations of a corner's position that are added to the margin [-] */
    real moving; /* additional distance from moving pieces [m] */
    real doubt;  /* uncertainty of the speed of moving pieces [m/s] */
    real reach;  /* pieces further away than this get no half-space [m] */
    real scale;  /* factor on each row [1/m] */
} ddmpc_keeping;
/* Compute the rows of half-spaces at each of `count` stages: scale a (2), corner d (2), scale b of
   a . (position + R(heading) d) <= b, with a unit vector a towards a piece. A plane separates the footprint at `guess`
   (count, 3) from the nearest piece that no earlier plane has cut off. If that footprint penetrates the piece, the normal
   is taken at `guide` (count, 3), and if that penetrates it as well, at `pose` (3). `spread` (count, 9) is the covariance
   of the poses. `table` has `stride` values per stage. `owner` (count, rows) receives the piece of each row, or -1. */
void ddmpc_half_spaces(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, const ddmpc_keeping *keeping,
                       int count, const real *guess, const real *guide, const real *pose, const real *times,
                       const real *spread, int rows, int stride, real *table, int *owner);

/* First sample of a path that is too close to a piece. */
typedef struct {
    int sample, piece; /* -1: none */
    real gap;          /* gap at this sample [m] */
    real min_gap;      /* minimum gap along the path, or `reach` of ddmpc_keeping [m] */
} ddmpc_contact;
/* Check `poses` (count, 3) at `times` whose speed (count) exceeds `slow` [m/s]. A standing piece that is already nearer
   than the margin may come nearer by `play` [m], but not nearer than `min_gap` [m]; moving away from it is always
   allowed. The allowance does not apply to moving pieces. */
ddmpc_contact ddmpc_sweep(const ddmpc_footprint *footprint, const ddmpc_surroundings *around,
                          const ddmpc_keeping *keeping, int count, const real *poses, const real *times,
                          const real *speeds, const real *spread, real slow, real play, real min_gap);

/* Settings of the search for a path around obstacles, as an offset to the left of the reference at each station. */
typedef struct {
    int stations, cells;   /* number of stations, and of offsets on each side */
    real step, spacing;    /* distance between offsets and between stations [m] */
    real min_gap, comfort; /* minimum gap, and gap above which a path has no extra cost [m] */
    int cell, slope;       /* cell at the start, and its change from the previous station */
} ddmpc_round;
/* Find the cheapest path by dynamic programming over offsets and slopes. `path` (stations, 3) are the poses of the
   reference, `travel` (stations) is 1 or -1, `max_offset` (stations) is in m, and `previous` (stations) is the previous
   path; a deviation from it has a cost. `cost`, `cached` and `from` are scratch memory of stations * (2 cells + 1) * 9
   elements. Returns the number of reached stations and their `offsets`. */
int ddmpc_find_path(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, const ddmpc_round *round,
                    const real *path, const real *travel, const real *max_offset, const real *previous, real *cost,
                    real *cached, int *from, real *offsets);

/* Predict the path under `commands` (count, 2) from the current estimate; the first command replaces the last sent
   command. Computes poses (count + 1, 3) and twists (count + 1, 2) of the body. Returns 0 if there is no estimate. */
int ddmpc_roll(const ddmpc_controller *controller, const real *commands, int count, real *poses, real *twists);
/* Predict the covariances (count + 1, 9) of the poses under `commands` (count, 2). Returns 0 if there is no estimate. */
int ddmpc_spread(const ddmpc_controller *controller, const real *commands, int count, real *covariance);

/* Generated function of a half-space term: see pieces.py. */
int ddmpc_f_half_space(const real **arg, real **res, long long *iw, real *w, int mem);

#endif
