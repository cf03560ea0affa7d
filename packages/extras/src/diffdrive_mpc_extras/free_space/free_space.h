/* Free space of the robot: convex pieces around it, half-spaces between them and its plan, and its stopping path.
 *
 * The code is compiled together with the core into a separate library, see half_space.py. Python parses this file like
 * core.h, so names and shapes need no second declaration there. */
#ifndef DDMPC_FREE_SPACE_H
#define DDMPC_FREE_SPACE_H

#include "core.h"

enum { DDMPC_MOST_CORNERS = 32, DDMPC_HALF_SPACE = 5 };

/* Convex pieces, each the hull of its corners (counter-clockwise) widened all round, moving straight on. */
typedef struct {
    int pieces;
    const int *first;     /* [pieces+1] index of the first corner of each */
    const real *corner;   /* [first[pieces]][2] at time 0 [m] */
    const real *widening; /* [pieces] [m] */
    const real *velocity; /* [pieces][2] [m/s] */
    const real *circle;   /* [pieces][3] middle and radius of a circle around it, at time 0 [m] */
} ddmpc_surroundings;

/* The robot: the hull of its corners (counter-clockwise, in its own frame) widened all round. */
typedef struct {
    int corners;
    const real *corner; /* [corners][2] [m] */
    real widening;      /* [m] */
    real reach;         /* distance of the farthest point from the origin [m] */
} ddmpc_footprint;

/* Signed distance [m] from the footprint at `pose` (3) to one piece at `time` [s]: the gap, or less than zero by how far one
   of them has to move to part them. `normal` (2) is the direction in which the gap lies, from the footprint. */
real ddmpc_gap(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, int piece, const real *pose, real time,
               real *normal);
/* The least gap at each of `count` poses (3) and its piece, -1 where all are further than `enough` [m], which it is then. */
void ddmpc_clearances(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, int count, const real *poses,
                      const real *times, real enough, real *gaps, int *pieces);

/* Distance that the plan keeps from pieces. */
typedef struct {
    real margin;  /* [m] */
    real factor;  /* additional standard deviations of a corner's position [-] */
    real moving;  /* additional distance from moving pieces [m] */
    real doubt;   /* uncertainty of the speed of moving pieces [m/s] */
    real reach;   /* pieces further away than this get no half-space [m] */
    real scale;   /* unit of a row by metres [1/m] */
} ddmpc_keeping;
/* Rows of half-spaces, for each of `count` stages: scale a (2), corner d (2), scale b of a . (position + R(heading) d) <= b,
   where a is a unit vector towards a piece. Planes part the footprint at `guess` (count, 3), where it is inside a piece at
   `guide` (count, 3), or at `pose` (3) if that is inside, too, from the nearest piece that no plane before has cut off.
   `spread` (count, 9) is the covariance of the poses; `table` has `stride` numbers a stage; `owner` (count, rows) becomes the
   piece of each row, or -1. */
void ddmpc_half_spaces(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, const ddmpc_keeping *keeping,
                       int count, const real *guess, const real *guide, const real *pose, const real *times,
                       const real *spread, int rows, int stride, real *table, int *owner);

/* First contact along a path that is too close to a piece. */
typedef struct {
    int sample, piece; /* -1: none */
    real gap;          /* gap at this sample [m] */
    real least;        /* least gap along it, or `reach` of keeping [m] */
} ddmpc_contact;
/* Follow `poses` (count, 3) at `times` while the speed (count) there is more than `slow` [m/s]. What stands nearer than
   the margin already may be passed by `play` [m] nearer, but not below `least_gap` [m]: from there on it may be left. What
   moves is waited for. */
ddmpc_contact ddmpc_sweep(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, const ddmpc_keeping *keeping,
                          int count, const real *poses, const real *times, const real *speeds, const real *spread,
                          real slow, real play, real least_gap);

/* Path around obstacles: its offset to the left of the reference path at each station. */
typedef struct {
    int stations, cells; /* offsets are `cells` to either side, `step` [m] apart */
    real step, spacing;  /* and stations `spacing` [m] */
    real least, comfort; /* minimum gap, and comfortable gap [m] */
    int cell, slope;     /* cell at the start, and the change of cells to there */
} ddmpc_round;
/* The cheapest way from the first station on, by dynamic programming over offsets and their slopes: `path` (stations, 3) poses
   and `travel` (stations) 1 or -1, `most` (stations) the largest offset [m], `before` (stations) the way of before, which it
   keeps to. `cost`, `known` and `from` have stations * (2 cells + 1) * 9 numbers of memory. Returns how many stations are reached, and
   their `offsets`. */
int ddmpc_way_round(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, const ddmpc_round *round,
                    const real *path, const real *travel, const real *most, const real *before, real *cost,
                    real *known, int *from, real *offsets);

/* Predict the path under `commands` (count, 2) from the estimate on, the first replacing the last one sent: poses
   (count + 1, 3) and twists (count + 1, 2) of the body. Returns 0 without an estimate. */
int ddmpc_roll(const ddmpc_controller *controller, const real *commands, int count, real *poses, real *twists);
/* Predict the covariance (count + 1, 9) of these poses. */
int ddmpc_spread(const ddmpc_controller *controller, const real *commands, int count, real *covariance);

/* Half-space as a term: see half_space.py. */
int ddmpc_f_half_space(const real **arg, real **res, long long *iw, real *w, int mem);

#endif
