/* Projection of points onto a polyline, as documented in sim/metrics/path_projection.py. Units are SI units. */
#ifndef POLYLINE_H
#define POLYLINE_H

typedef struct {
    int segments;
    const double *start, *direction, *length; /* [segments][2], [segments][2], [segments] */
    const double *arc_start, *arc_end;        /* [segments] arc lengths at both ends of each segment */
} polyline;

/* Compute the signed distances [count] of `points` [count][2]. The search range of each point is the union of the
 * segments `first` [count] to `last` [count], excluding `last`, around its expected position, and of the segments
 * within the arc length `margin` [count] of the nearest segment of the previous point. */
void polyline_lateral(const polyline *line, int count, const double *points, const long long *first,
                      const long long *last, const double *margin, double *lateral);

#endif
