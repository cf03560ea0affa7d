/* Distances between convex pieces, separating planes, path search, and prediction of the stopping path. */
#include <string.h>

#include "free_space.h"
#include "internal.h"

#define FAR R(1e9)
/* A plane cuts off a piece that extends at most this far to the near side [m]. */
#define CUT_OFF R(1e-6)

typedef struct {
    int corners;
    real corner[DDMPC_MAX_CORNERS][2];
    real widening;
} placed_shape;

static void place(const ddmpc_footprint *footprint, const real *pose, placed_shape *shape)
{
    const real cosine = ddmpc_cos(pose[2]), sine = ddmpc_sin(pose[2]);
    shape->corners = footprint->corners;
    shape->widening = footprint->widening;
    for (int i = 0; i < footprint->corners; i++) {
        const real *d = footprint->corner + 2 * i;
        shape->corner[i][0] = pose[0] + cosine * d[0] - sine * d[1];
        shape->corner[i][1] = pose[1] + sine * d[0] + cosine * d[1];
    }
}

static void fetch(const ddmpc_surroundings *around, int piece, real time, placed_shape *shape)
{
    const int first = around->first[piece];
    const real *v = around->velocity + 2 * piece;
    shape->corners = around->first[piece + 1] - first;
    shape->widening = around->widening[piece];
    for (int i = 0; i < shape->corners; i++)
        for (int k = 0; k < 2; k++)
            shape->corner[i][k] = around->corner[2 * (first + i) + k] + v[k] * time;
}

static real dot2(const real *a, const real *b) { return a[0] * b[0] + a[1] * b[1]; }

/* Minimum of a . corner over the corners of `shape`. */
static real min_projection(const placed_shape *shape, const real *a)
{
    real minimum = dot2(a, shape->corner[0]);
    for (int i = 1; i < shape->corners; i++)
        minimum = ddmpc_min(minimum, dot2(a, shape->corner[i]));
    return minimum;
}

/* Maximise the gap to `opposite` along the outward edge normals of `shape`; `sign` orients the resulting normal. */
static void try_edges(const placed_shape *shape, const placed_shape *opposite, real sign, real *best, real *normal)
{
    if (shape->corners < 2)
        return;
    for (int i = 0; i < shape->corners; i++) {
        const real *from = shape->corner[i], *to = shape->corner[i + 1 < shape->corners ? i + 1 : 0];
        real a[2] = {to[1] - from[1], from[0] - to[0]};
        const real length = ddmpc_hypot(a[0], a[1]);
        if (!(length > R(0.0)))
            continue;
        a[0] /= length;
        a[1] /= length;
        const real gap = min_projection(opposite, a) - dot2(a, from);
        if (gap > *best) {
            *best = gap;
            normal[0] = sign * a[0];
            normal[1] = sign * a[1];
        }
    }
}

/* Signed distance as the maximum gap over all directions. For separate shapes, the direction joins the nearest points:
   two corners, or a corner and an edge. For overlapping shapes it is an edge normal. */
static real gap_between(const placed_shape *robot, const placed_shape *piece, real *normal)
{
    real best = -FAR, nearest = FAR * FAR, toward[2] = {R(1.0), R(0.0)};
    normal[0] = R(1.0);
    normal[1] = R(0.0);
    try_edges(robot, piece, R(1.0), &best, normal);
    try_edges(piece, robot, R(-1.0), &best, normal);
    for (int i = 0; i < robot->corners; i++)
        for (int j = 0; j < piece->corners; j++) {
            const real dx = piece->corner[j][0] - robot->corner[i][0], dy = piece->corner[j][1] - robot->corner[i][1];
            if (dx * dx + dy * dy < nearest) {
                nearest = dx * dx + dy * dy;
                toward[0] = dx;
                toward[1] = dy;
            }
        }
    const real length = ddmpc_hypot(toward[0], toward[1]);
    if (length > R(0.0)) {
        toward[0] /= length;
        toward[1] /= length;
    } else {
        toward[0] = R(1.0);
        toward[1] = R(0.0);
    }
    const real back[2] = {-toward[0], -toward[1]};
    const real gap = min_projection(piece, toward) + min_projection(robot, back);
    if (gap > best) {
        best = gap;
        memcpy(normal, toward, sizeof toward);
    }
    return best - robot->widening - piece->widening;
}

/* Lower bound of the gap to a piece, from its bounding circle. */
static real gap_bound(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, int piece, const real *pose,
                      real time)
{
    const real *circle = around->circle + 3 * piece, *v = around->velocity + 2 * piece;
    return ddmpc_hypot(circle[0] + v[0] * time - pose[0], circle[1] + v[1] * time - pose[1]) - circle[2] -
           footprint->reach;
}

real ddmpc_gap(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, int piece, const real *pose,
               real time, real *normal)
{
    placed_shape robot, obstacle;
    place(footprint, pose, &robot);
    fetch(around, piece, time, &obstacle);
    return gap_between(&robot, &obstacle, normal);
}

void ddmpc_clearances(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, int count, const real *poses,
                      const real *times, real max_gap, real *gaps, int *pieces)
{
    for (int k = 0; k < count; k++) {
        placed_shape robot, obstacle;
        real normal[2];
        place(footprint, poses + 3 * k, &robot);
        gaps[k] = max_gap;
        pieces[k] = -1;
        for (int i = 0; i < around->pieces; i++) {
            if (gap_bound(footprint, around, i, poses + 3 * k, times[k]) >= gaps[k])
                continue;
            fetch(around, i, times[k], &obstacle);
            const real gap = gap_between(&robot, &obstacle, normal);
            if (gap < gaps[k]) {
                gaps[k] = gap;
                pieces[k] = i;
            }
        }
    }
}

/* Standard deviation [m] along `a` of the footprint's point `d`, from the covariance (9) of the pose. */
static real deviation(const real *a, const real *d, const real *pose, const real *covariance)
{
    const real cosine = ddmpc_cos(pose[2]), sine = ddmpc_sin(pose[2]);
    const real lever = a[0] * (-sine * d[0] - cosine * d[1]) + a[1] * (cosine * d[0] - sine * d[1]);
    const real g[3] = {a[0], a[1], lever};
    real variance = R(0.0);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            variance += g[i] * covariance[3 * i + j] * g[j];
    return ddmpc_sqrt(ddmpc_max(variance, R(0.0)));
}

static real speed_of(const ddmpc_surroundings *around, int piece)
{
    return ddmpc_hypot(around->velocity[2 * piece], around->velocity[2 * piece + 1]);
}

/* Maximum of a . (R d) over the footprint's corners except `excluded`; `corner` receives the index of the maximum. */
static real farthest(const ddmpc_footprint *footprint, const real *a, real heading, int excluded, int *corner)
{
    const real cosine = ddmpc_cos(heading), sine = ddmpc_sin(heading);
    const real direction[2] = {cosine * a[0] + sine * a[1], cosine * a[1] - sine * a[0]};
    real maximum = -FAR;
    *corner = -1;
    for (int i = 0; i < footprint->corners; i++) {
        const real along = dot2(direction, footprint->corner + 2 * i);
        if (i != excluded && along > maximum) {
            maximum = along;
            *corner = i;
        }
    }
    return maximum;
}

enum { MAX_NEAR = 64 };

typedef struct {
    real gap, normal[2];
    int piece;
} near_piece;

/* Find the pieces within `reach`, sorted by distance; at most MAX_NEAR. Returns their number. */
static int find_near(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, real reach, const real *pose,
                     real time, near_piece *nearest)
{
    placed_shape robot, obstacle;
    int count = 0;
    place(footprint, pose, &robot);
    for (int i = 0; i < around->pieces; i++) {
        near_piece candidate;
        const real limit = count < MAX_NEAR ? reach : nearest[MAX_NEAR - 1].gap;
        if (gap_bound(footprint, around, i, pose, time) >= limit)
            continue;
        fetch(around, i, time, &obstacle);
        candidate.gap = gap_between(&robot, &obstacle, candidate.normal);
        candidate.piece = i;
        if (!(candidate.gap < limit))
            continue;
        int position = count < MAX_NEAR ? count++ : MAX_NEAR - 1;
        for (; position > 0 && nearest[position - 1].gap > candidate.gap; position--)
            nearest[position] = nearest[position - 1];
        nearest[position] = candidate;
    }
    return count;
}

/* Uncertainty of the position of a piece at `time` [m]; 0 for a standing piece. */
static real position_doubt(const ddmpc_surroundings *around, int piece, const ddmpc_keeping *keeping, real time)
{
    return speed_of(around, piece) > R(0.0) ? keeping->moving + keeping->doubt * time : R(0.0);
}

void ddmpc_half_spaces(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, const ddmpc_keeping *keeping,
                       int count, const real *guess, const real *guide, const real *pose_now, const real *times,
                       const real *spread, int rows, int stride, real *table, int *owner)
{
    near_piece near[MAX_NEAR];
    const int corners_per_piece = footprint->corners > 1 ? 2 : 1;
    for (int k = 0; k < count; k++) {
        const real *pose = guess + 3 * k;
        real *row = table + k * stride;
        int used = 0, near_count = find_near(footprint, around, keeping->reach, pose, times[k], near);
        for (int i = 0; i < rows * DDMPC_HALF_SPACE; i++)
            row[i] = i % DDMPC_HALF_SPACE == DDMPC_HALF_SPACE - 1 ? R(1.0) : R(0.0);
        for (int i = 0; i < rows; i++)
            owner[k * rows + i] = -1;
        for (int i = 0; i < near_count && used + corners_per_piece <= rows; i++) {
            placed_shape obstacle;
            real *a = near[i].normal;
            int first, second, piece = near[i].piece;
            if (piece < 0)
                continue;
            if (near[i].gap <= R(0.0) && ddmpc_gap(footprint, around, piece, guide + 3 * k, times[k], a) <= R(0.0))
                ddmpc_gap(footprint, around, piece, pose_now, times[k], a);
            fetch(around, piece, times[k], &obstacle);
            const real plane = min_projection(&obstacle, a) - obstacle.widening;
            farthest(footprint, a, pose[2], -1, &first);
            farthest(footprint, a, pose[2], first, &second);
            for (int j = 0; j < corners_per_piece; j++) {
                const real *d = footprint->corner + 2 * (j ? second : first);
                const real distance = keeping->margin + footprint->widening +
                                      keeping->factor * deviation(a, d, pose, spread + 9 * k) +
                                      position_doubt(around, piece, keeping, times[k]);
                row[0] = keeping->scale * a[0];
                row[1] = keeping->scale * a[1];
                row[2] = d[0];
                row[3] = d[1];
                row[4] = keeping->scale * (plane - distance);
                owner[k * rows + used++] = piece;
                row += DDMPC_HALF_SPACE;
            }
            /* Skip the pieces behind this plane. */
            for (int j = i + 1; j < near_count; j++) {
                if (near[j].piece < 0)
                    continue;
                fetch(around, near[j].piece, times[k], &obstacle);
                if (min_projection(&obstacle, a) - obstacle.widening >= plane - CUT_OFF)
                    near[j].piece = -1;
            }
        }
    }
}

ddmpc_contact ddmpc_sweep(const ddmpc_footprint *footprint, const ddmpc_surroundings *around,
                          const ddmpc_keeping *keeping, int count, const real *poses, const real *times,
                          const real *speeds, const real *spread, real slow, real play, real min_gap)
{
    ddmpc_contact contact = {-1, -1, keeping->reach, keeping->reach};
    placed_shape robot, obstacle;
    real normal[2];
    for (int i = 0; i < around->pieces && count > 0; i++) {
        const int moves = speed_of(around, i) > R(0.0);
        real gap_now = FAR;
        for (int k = 0; k < count; k++) {
            const real *pose = poses + 3 * k;
            int corner;
            if (k > 0 && gap_bound(footprint, around, i, pose, times[k]) >= keeping->reach)
                continue;
            place(footprint, pose, &robot);
            fetch(around, i, times[k], &obstacle);
            const real gap = gap_between(&robot, &obstacle, normal);
            if (k == 0)
                gap_now = gap;
            contact.min_gap = ddmpc_min(contact.min_gap, gap);
            if (k == 0 || !(ddmpc_fabs(speeds[k]) > slow))
                continue;
            farthest(footprint, normal, pose[2], -1, &corner);
            const real required =
                keeping->margin +
                keeping->factor * deviation(normal, footprint->corner + 2 * corner, pose, spread + 9 * k) +
                position_doubt(around, i, keeping, times[k]);
            if (gap >= required)
                continue;
            /* Motion along or away from a standing piece is allowed; a moving piece has priority. */
            if (!moves && ((gap >= min_gap && gap >= gap_now - play) || gap >= gap_now - CUT_OFF))
                continue;
            if (contact.sample < 0 || k < contact.sample) {
                contact.sample = k;
                contact.piece = i;
                contact.gap = gap;
            }
            break;
        }
    }
    return contact;
}

enum { SLOPES = 9, STRAIGHT = 4 };
/* Cost weights at a station: squared offset, squared deviation from the previous path [1/m^2]; squared slope and squared
   change of slope [1/cell^2]; squared shortfall of the gap, relative to the range between min_gap and comfort. */
#define OFFSET_WEIGHT R(1.0)
#define DEVIATION_WEIGHT R(2.0)
#define SLOPE_WEIGHT R(0.005)
#define BEND_WEIGHT R(0.0075)
#define NARROW_WEIGHT R(1.0)

/* Minimum gap at an offset from the path and with a slope, clipped to `max_gap`. */
static real gap_at_offset(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, const real *path,
                          real travel, real offset, real slope, real max_gap)
{
    const real pose[3] = {path[0] - ddmpc_sin(path[2]) * offset, path[1] + ddmpc_cos(path[2]) * offset,
                          path[2] + travel * atan2(slope, R(1.0))};
    const real now = R(0.0);
    real gap;
    int piece;
    ddmpc_clearances(footprint, around, 1, pose, &now, max_gap, &gap, &piece);
    return gap;
}

/* Data of one search; `cached` (stations, cells, slopes) holds computed gaps, and values below -FAR for all others. */
typedef struct {
    const ddmpc_footprint *footprint;
    const ddmpc_surroundings *around;
    const ddmpc_round *round;
    const real *path, *travel;
    real *cached;
} path_search;

static real gap_at(const path_search *s, int station, int cell, int slope)
{
    const int wide = 2 * s->round->cells + 1;
    real *cached = s->cached + (station * wide + cell) * SLOPES;
    const real offset = s->round->step * (real)(cell - s->round->cells);
    const real bend = (real)(slope - STRAIGHT) * s->round->step / s->round->spacing, comfort = s->round->comfort;
    if (cached[slope] >= -FAR)
        return cached[slope];
    /* A rotation moves each corner by at most reach * angle, so a wide gap needs no computation with the slope. */
    if (cached[STRAIGHT] < -FAR)
        cached[STRAIGHT] = gap_at_offset(s->footprint, s->around, s->path + 3 * station, s->travel[station], offset,
                                         R(0.0), comfort + s->footprint->reach);
    if (slope != STRAIGHT)
        cached[slope] = cached[STRAIGHT] - s->footprint->reach * ddmpc_fabs(atan2(bend, R(1.0))) >= comfort
                            ? comfort
                            : gap_at_offset(s->footprint, s->around, s->path + 3 * station, s->travel[station], offset,
                                            bend, comfort);
    return cached[slope];
}

int ddmpc_find_path(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, const ddmpc_round *round,
                    const real *path, const real *travel, const real *max_offset, const real *previous, real *cost,
                    real *cached, int *from, real *offsets)
{
    const path_search search = {footprint, around, round, path, travel, cached};
    const int wide = 2 * round->cells + 1, layer = wide * SLOPES, middle = round->cells;
    int reached = 1, best;
    for (int i = 0; i < round->stations * layer; i++) {
        cost[i] = FAR;
        cached[i] = R(-2.0) * FAR;
    }
    cost[(round->cell + middle) * SLOPES + round->slope + STRAIGHT] = R(0.0);
    for (int i = 1; i < round->stations; i++) {
        const real *last = cost + (i - 1) * layer;
        int any = 0;
        for (int j = 0; j < wide; j++) {
            const real offset = round->step * (real)(j - middle);
            if (ddmpc_fabs(offset) > max_offset[i] + R(1e-9))
                continue;
            for (int k = 0; k < SLOPES; k++) {
                const int change = k - STRAIGHT, last_cell = j - change;
                real min_cost = FAR, gap;
                int predecessor = -1;
                for (int b = k - 1; b <= k + 1; b++) {
                    if (last_cell < 0 || last_cell >= wide || b < 0 || b >= SLOPES)
                        continue;
                    const real candidate = last[last_cell * SLOPES + b] + BEND_WEIGHT * (real)((k - b) * (k - b));
                    if (candidate < min_cost) {
                        min_cost = candidate;
                        predecessor = last_cell * SLOPES + b;
                    }
                }
                if (!(min_cost < FAR))
                    continue;
                /* The slope applies at both ends of the segment, so the robot does not rotate inside a doorway. */
                gap = gap_at(&search, i, j, k);
                if (i > 1 || change != 0)
                    gap = ddmpc_min(gap, gap_at(&search, i - 1, last_cell, k));
                if (gap < round->min_gap)
                    continue;
                const real shortfall =
                    gap < round->comfort ? (round->comfort - gap) / (round->comfort - round->min_gap) : R(0.0);
                const real shift = offset - previous[i];
                cost[i * layer + j * SLOPES + k] =
                    min_cost + OFFSET_WEIGHT * offset * offset + DEVIATION_WEIGHT * shift * shift +
                    SLOPE_WEIGHT * (real)(change * change) + NARROW_WEIGHT * shortfall * shortfall;
                from[i * layer + j * SLOPES + k] = predecessor;
                any = 1;
            }
        }
        if (!any)
            break;
        reached = i + 1;
    }
    best = 0;
    for (int s = 1; s < layer; s++)
        if (cost[(reached - 1) * layer + s] < cost[(reached - 1) * layer + best])
            best = s;
    for (int i = reached - 1; i >= 0; i--) {
        offsets[i] = round->step * (real)(best / SLOPES - middle);
        if (i > 0)
            best = from[i * layer + best];
    }
    return reached;
}

/* Copy the window of commands that act on the current sample, with the newest command replaced. */
static void window_of(const ddmpc_controller *c, const real *newest, real *commands)
{
    const int window = WINDOW(c) + 1;
    memcpy(commands, c->estimator.commands + 2 * (COMMANDS(c) - window), sizeof(real) * (size_t)(2 * window));
    memcpy(commands + 2 * (window - 1), newest, sizeof(real) * 2);
}

static void append_command(const ddmpc_controller *c, const real *newest, real *commands)
{
    memmove(commands, commands + 2, sizeof(real) * (size_t)(2 * WINDOW(c)));
    memcpy(commands + 2 * WINDOW(c), newest, sizeof(real) * 2);
}

int ddmpc_roll(const ddmpc_controller *c, const real *planned, int count, real *poses, real *twists)
{
    real commands[2 * (DDMPC_MAX_WINDOW + 1)], means[2][MAX_BELIEF];
    real *now = means[0], *next = means[1];
    if (!c->result.has_estimate || count < 1)
        return 0;
    memcpy(now, c->result.estimate.mean, sizeof(real) * (size_t)BELIEF(c));
    window_of(c, planned, commands);
    for (int i = 0; i <= count; i++) {
        memcpy(poses + 3 * i, now + STATES(c) + POSE(c), sizeof(real) * 3);
        ddmpc_filter_twist(c, now, twists + 2 * i);
        if (i == count)
            break;
        if (i > 0)
            append_command(c, planned + 2 * i, commands);
        ddmpc_filter_carry(c, now, commands + 2 * WINDOW(c), next);
        real *former = now;
        now = next;
        next = former;
    }
    return 1;
}

int ddmpc_spread(const ddmpc_controller *c, const real *planned, int count, real *covariance)
{
    static const int max_size = MAX_BELIEF;
    real commands[2 * (DDMPC_MAX_WINDOW + 1)], means[2][MAX_BELIEF], covariances[2][MAX_BELIEF * MAX_BELIEF];
    real pending[2 * DDMPC_MAX_WINDOW];
    ddmpc_belief beliefs[2] = {{means[0], covariances[0], {0}}, {means[1], covariances[1], {0}}};
    const int Z = BELIEF(c), first = STATES(c) + POSE(c);
    if (Z > max_size || count < 1 || !ddmpc_newest_belief(c, means[0], covariances[0], pending))
        return 0;
    window_of(c, planned, commands);
    for (int i = 0; i <= count; i++) {
        const ddmpc_belief *now = beliefs + i % 2;
        for (int j = 0; j < 3; j++)
            for (int k = 0; k < 3; k++)
                covariance[9 * i + 3 * j + k] = now->covariance[(first + j) * Z + first + k];
        if (i == count)
            break;
        if (i > 0)
            append_command(c, planned + 2 * i, commands);
        ddmpc_filter_predict(c, now, commands + 2 * WINDOW(c), beliefs + (i + 1) % 2);
    }
    return 1;
}
