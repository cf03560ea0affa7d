#include "polyline.h"

#include <math.h>

/* Difference of distances up to which two segments count as equally near, and rounding error of distances [m]. */
static const double TIE = 1e-12, ROUNDING = 1e-9;

/* Compute the signed distance of a point from the segments `start` to `end`, excluding `end`; return the first of the
 * nearest segments. */
static int project(const polyline *line, const double *point, int start, int end, double *lateral)
{
    double closest = INFINITY, minimum = INFINITY, side = 0.0;
    int nearest = start, pass, i;
    for (i = start; i < end; i++) {
        const double x = point[0] - line->start[2 * i], y = point[1] - line->start[2 * i + 1];
        closest = fmin(closest, x * x + y * y);
    }
    closest = sqrt(closest);
    /* The first pass finds the distance. At a vertex two segments are equally near, and the point may be collinear with
     * one of them, so the sum of both determines the sign in the second pass. */
    for (pass = 0; pass < 2; pass++)
        for (i = start; i < end; i++) {
            const double *u = line->direction + 2 * i;
            const double x = point[0] - line->start[2 * i], y = point[1] - line->start[2 * i + 1];
            /* No segment is nearer than its start by more than its length, which excludes most of them. */
            const double reach = closest + line->length[i] + ROUNDING;
            double along, gap;
            if (x * x + y * y > reach * reach)
                continue;
            along = fmin(fmax(x * u[0] + y * u[1], 0.0), line->length[i]);
            gap = hypot(x - along * u[0], y - along * u[1]);
            if (pass && gap <= minimum + TIE)
                side += u[0] * y - u[1] * x;
            if (!pass && gap < minimum) {
                minimum = gap;
                nearest = i;
            }
        }
    *lateral = copysign(minimum, side);
    return nearest;
}

void polyline_lateral(const polyline *line, int count, const double *points, const long long *first,
                      const long long *last, const double *margin, double *lateral)
{
    int nearest = 0, row;
    for (row = 0; row < count; row++) {
        int start = (int)first[row], end = (int)last[row];
        if (row) {
            const double from = line->arc_start[nearest] - margin[row], to = line->arc_end[nearest] + margin[row];
            int low = nearest, high = nearest + 1;
            while (low > 0 && line->arc_end[low - 1] >= from)
                low--;
            while (high < line->segments && line->arc_start[high] <= to)
                high++;
            start = low < start ? low : start;
            end = high > end ? high : end;
        }
        nearest = project(line, points + 2 * row, start, end, lateral + row);
    }
}
