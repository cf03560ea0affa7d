/* Distances between convex pieces, the planes between them, and the robot's stopping path. */
#include <string.h>

#include "free_space.h"
#include "internal.h"

#define FAR R(1e9)
/* A piece is cut off by a plane if no more than this lies on the near side [m]. */
#define CUT_OFF R(1e-6)

typedef struct {
    int corners;
    real corner[DDMPC_MOST_CORNERS][2];
    real widening;
} placed;

static void place(const ddmpc_footprint *footprint, const real *pose, placed *shape)
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

static void fetch(const ddmpc_surroundings *around, int piece, real time, placed *shape)
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

/* Minimum of a . corner. */
static real lowest(const placed *shape, const real *a)
{
    real least = dot2(a, shape->corner[0]);
    for (int i = 1; i < shape->corners; i++)
        least = ddmpc_min(least, dot2(a, shape->corner[i]));
    return least;
}

/* Maximise the gap along the outward normals of `shape`, from which `sign` leads to `opposite`. */
static void try_edges(const placed *shape, const placed *opposite, real sign, real *best, real *normal)
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
        const real gap = lowest(opposite, a) - dot2(a, from);
        if (gap > *best) {
            *best = gap;
            normal[0] = sign * a[0];
            normal[1] = sign * a[1];
        }
    }
}

/* The greatest gap of all directions: where they are apart it lies along the nearest points, on two corners or on a corner
   and an edge; where they are not, along a normal of an edge. */
static real gap_between(const placed *robot, const placed *piece, real *normal)
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
    const real gap = lowest(piece, toward) + lowest(robot, back);
    if (gap > best) {
        best = gap;
        memcpy(normal, toward, sizeof toward);
    }
    return best - robot->widening - piece->widening;
}

/* Lower bound of the gap to a piece, by its circle. */
static real least_gap_to(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, int piece, const real *pose,
                         real time)
{
    const real *circle = around->circle + 3 * piece, *v = around->velocity + 2 * piece;
    return ddmpc_hypot(circle[0] + v[0] * time - pose[0], circle[1] + v[1] * time - pose[1]) - circle[2] -
           footprint->reach;
}

real ddmpc_gap(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, int piece, const real *pose, real time,
               real *normal)
{
    placed robot, obstacle;
    place(footprint, pose, &robot);
    fetch(around, piece, time, &obstacle);
    return gap_between(&robot, &obstacle, normal);
}

void ddmpc_clearances(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, int count, const real *poses,
                      const real *times, real enough, real *gaps, int *pieces)
{
    for (int k = 0; k < count; k++) {
        placed robot, obstacle;
        real normal[2];
        place(footprint, poses + 3 * k, &robot);
        gaps[k] = enough;
        pieces[k] = -1;
        for (int i = 0; i < around->pieces; i++) {
            if (least_gap_to(footprint, around, i, poses + 3 * k, times[k]) >= gaps[k])
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

/* Standard deviation [m] along `a` of the footprint's point `d` at a pose with this covariance (9). */
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

/* The most of a . (R d) over the footprint's corners; `which` is the corner, other than `but`. */
static real farthest(const ddmpc_footprint *footprint, const real *a, real heading, int but, int *which)
{
    const real cosine = ddmpc_cos(heading), sine = ddmpc_sin(heading);
    const real direction[2] = {cosine * a[0] + sine * a[1], cosine * a[1] - sine * a[0]};
    real most = -FAR;
    *which = -1;
    for (int i = 0; i < footprint->corners; i++) {
        const real along = dot2(direction, footprint->corner + 2 * i);
        if (i != but && along > most) {
            most = along;
            *which = i;
        }
    }
    return most;
}

enum { MOST_NEAR = 64 };

typedef struct {
    real gap, normal[2];
    int piece;
} near_piece;

/* The nearest pieces within reach, nearest first. */
static int find_near(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, real reach, const real *pose,
                     real time, near_piece *nearest)
{
    placed robot, obstacle;
    int count = 0;
    place(footprint, pose, &robot);
    for (int i = 0; i < around->pieces; i++) {
        near_piece candidate;
        const real most = count < MOST_NEAR ? reach : nearest[MOST_NEAR - 1].gap;
        if (least_gap_to(footprint, around, i, pose, time) >= most)
            continue;
        fetch(around, i, time, &obstacle);
        candidate.gap = gap_between(&robot, &obstacle, candidate.normal);
        candidate.piece = i;
        if (!(candidate.gap < most))
            continue;
        int place_in_order = count < MOST_NEAR ? count++ : MOST_NEAR - 1;
        for (; place_in_order > 0 && nearest[place_in_order - 1].gap > candidate.gap; place_in_order--)
            nearest[place_in_order] = nearest[place_in_order - 1];
        nearest[place_in_order] = candidate;
    }
    return count;
}

/* Uncertainty of the position of a piece at `time`. */
static real unknown_of(const ddmpc_surroundings *around, int piece, const ddmpc_keeping *keeping, real time)
{
    return speed_of(around, piece) > R(0.0) ? keeping->moving + keeping->doubt * time : R(0.0);
}

void ddmpc_half_spaces(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, const ddmpc_keeping *keeping,
                       int count, const real *guess, const real *guide, const real *origin, const real *times,
                       const real *spread, int rows, int stride, real *table, int *owner)
{
    near_piece near[MOST_NEAR];
    const int each = footprint->corners > 1 ? 2 : 1;
    for (int k = 0; k < count; k++) {
        const real *pose = guess + 3 * k;
        real *row = table + k * stride;
        int used = 0, near_count = find_near(footprint, around, keeping->reach, pose, times[k], near);
        for (int i = 0; i < rows * DDMPC_HALF_SPACE; i++)
            row[i] = i % DDMPC_HALF_SPACE == DDMPC_HALF_SPACE - 1 ? R(1.0) : R(0.0);
        for (int i = 0; i < rows; i++)
            owner[k * rows + i] = -1;
        for (int i = 0; i < near_count && used + each <= rows; i++) {
            placed obstacle;
            real *a = near[i].normal;
            int first, second, piece = near[i].piece;
            if (piece < 0)
                continue;
            if (near[i].gap <= R(0.0) && ddmpc_gap(footprint, around, piece, guide + 3 * k, times[k], a) <= R(0.0))
                ddmpc_gap(footprint, around, piece, origin, times[k], a);
            fetch(around, piece, times[k], &obstacle);
            const real plane = lowest(&obstacle, a) - obstacle.widening;
            farthest(footprint, a, pose[2], -1, &first);
            farthest(footprint, a, pose[2], first, &second);
            for (int j = 0; j < each; j++) {
                const real *d = footprint->corner + 2 * (j ? second : first);
                const real away = keeping->margin + footprint->widening +
                                  keeping->factor * deviation(a, d, pose, spread + 9 * k) +
                                  unknown_of(around, piece, keeping, times[k]);
                row[0] = keeping->scale * a[0];
                row[1] = keeping->scale * a[1];
                row[2] = d[0];
                row[3] = d[1];
                row[4] = keeping->scale * (plane - away);
                owner[k * rows + used++] = piece;
                row += DDMPC_HALF_SPACE;
            }
            /* Pieces beyond the plane need no plane of their own. */
            for (int j = i + 1; j < near_count; j++) {
                if (near[j].piece < 0)
                    continue;
                fetch(around, near[j].piece, times[k], &obstacle);
                if (lowest(&obstacle, a) - obstacle.widening >= plane - CUT_OFF)
                    near[j].piece = -1;
            }
        }
    }
}

ddmpc_contact ddmpc_sweep(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, const ddmpc_keeping *keeping,
                          int count, const real *poses, const real *times, const real *speeds, const real *spread,
                          real slow, real play, real least_gap)
{
    ddmpc_contact contact = {-1, -1, keeping->reach, keeping->reach};
    placed robot, obstacle;
    real normal[2];
    for (int i = 0; i < around->pieces && count > 0; i++) {
        const int moves = speed_of(around, i) > R(0.0);
        real now = FAR;
        for (int k = 0; k < count; k++) {
            const real *pose = poses + 3 * k;
            int corner;
            if (k > 0 && least_gap_to(footprint, around, i, pose, times[k]) >= keeping->reach)
                continue;
            place(footprint, pose, &robot);
            fetch(around, i, times[k], &obstacle);
            const real gap = gap_between(&robot, &obstacle, normal);
            if (k == 0)
                now = gap;
            contact.least = ddmpc_min(contact.least, gap);
            if (k == 0 || !(ddmpc_fabs(speeds[k]) > slow))
                continue;
            farthest(footprint, normal, pose[2], -1, &corner);
            const real wanted = keeping->margin +
                                keeping->factor * deviation(normal, footprint->corner + 2 * corner, pose, spread + 9 * k) +
                                unknown_of(around, i, keeping, times[k]);
            if (gap >= wanted)
                continue;
            /* Beside what stands, and out of it, it may be driven; what moves it is to let pass. */
            if (!moves && ((gap >= least_gap && gap >= now - play) || gap >= now - CUT_OFF))
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
/* Prices at a station: of an offset, and of one other than before, by square metre; of a slope and its change by square of a
   cell; of a gap no wider than needed. */
#define OFFSET R(1.0)
#define OTHER R(2.0)
#define SLOPE R(0.005)
#define BEND R(0.0075)
#define NARROW R(1.0)

/* The least gap beside the path, no more than `enough`. */
static real gap_beside(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, const real *path, real travel,
                       real offset, real slope, real enough)
{
    const real pose[3] = {path[0] - ddmpc_sin(path[2]) * offset, path[1] + ddmpc_cos(path[2]) * offset,
                          path[2] + travel * atan2(slope, R(1.0))};
    const real now = R(0.0);
    real gap;
    int piece;
    ddmpc_clearances(footprint, around, 1, pose, &now, enough, &gap, &piece);
    return gap;
}

/* Data of one search; `known` (stations, cells, slopes) caches gaps, and is less than -FAR before their computation. */
typedef struct {
    const ddmpc_footprint *footprint;
    const ddmpc_surroundings *around;
    const ddmpc_round *round;
    const real *path, *travel;
    real *known;
} searched;

static real gap_at(const searched *s, int station, int cell, int slope)
{
    const int wide = 2 * s->round->cells + 1;
    real *known = s->known + (station * wide + cell) * SLOPES;
    const real offset = s->round->step * (real)(cell - s->round->cells);
    const real bend = (real)(slope - STRAIGHT) * s->round->step / s->round->spacing, comfort = s->round->comfort;
    if (known[slope] >= -FAR)
        return known[slope];
    /* No corner moves further by a turn than this: where there is room enough the slope does not matter. */
    if (known[STRAIGHT] < -FAR)
        known[STRAIGHT] = gap_beside(s->footprint, s->around, s->path + 3 * station, s->travel[station], offset, R(0.0),
                                     comfort + s->footprint->reach);
    if (slope != STRAIGHT)
        known[slope] = known[STRAIGHT] - s->footprint->reach * ddmpc_fabs(atan2(bend, R(1.0))) >= comfort
                           ? comfort
                           : gap_beside(s->footprint, s->around, s->path + 3 * station, s->travel[station], offset, bend,
                                        comfort);
    return known[slope];
}

int ddmpc_way_round(const ddmpc_footprint *footprint, const ddmpc_surroundings *around, const ddmpc_round *round,
                    const real *path, const real *travel, const real *most, const real *before, real *cost,
                    real *known, int *from, real *offsets)
{
    const searched search = {footprint, around, round, path, travel, known};
    const int wide = 2 * round->cells + 1, layer = wide * SLOPES, middle = round->cells;
    int reached = 1, best;
    for (int i = 0; i < round->stations * layer; i++)
    {
        cost[i] = FAR;
        known[i] = R(-2.0) * FAR;
    }
    cost[(round->cell + middle) * SLOPES + round->slope + STRAIGHT] = R(0.0);
    for (int i = 1; i < round->stations; i++) {
        const real *last = cost + (i - 1) * layer;
        int any = 0;
        for (int j = 0; j < wide; j++) {
            const real offset = round->step * (real)(j - middle);
            if (ddmpc_fabs(offset) > most[i] + R(1e-9))
                continue;
            for (int k = 0; k < SLOPES; k++) {
                const int change = k - STRAIGHT, behind = j - change;
                real least = FAR, gap;
                int predecessor = -1;
                for (int b = k - 1; b <= k + 1; b++) {
                    if (behind < 0 || behind >= wide || b < 0 || b >= SLOPES)
                        continue;
                    const real way = last[behind * SLOPES + b] + BEND * (real)((k - b) * (k - b));
                    if (way < least) {
                        least = way;
                        predecessor = behind * SLOPES + b;
                    }
                }
                if (!(least < FAR))
                    continue;
                /* It lies so at both ends of the stretch: a robot does not turn into a doorway, nor out of one. */
                gap = gap_at(&search, i, j, k);
                if (i > 1 || change != 0)
                    gap = ddmpc_min(gap, gap_at(&search, i - 1, behind, k));
                if (gap < round->least)
                    continue;
                const real lacks = gap < round->comfort ? (round->comfort - gap) / (round->comfort - round->least) : R(0.0);
                const real change_of_path = offset - before[i];
                cost[i * layer + j * SLOPES + k] = least + OFFSET * offset * offset + OTHER * change_of_path * change_of_path +
                                                   SLOPE * (real)(change * change) + NARROW * lacks * lacks;
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

/* The window of commands that act on the sample that begins now, the newest replaced. */
static void window_of(const ddmpc_controller *c, const real *newest, real *commands)
{
    const int window = WINDOW(c) + 1;
    memcpy(commands, c->estimator.commands + 2 * (COMMANDS(c) - window), sizeof(real) * (size_t)(2 * window));
    memcpy(commands + 2 * (window - 1), newest, sizeof(real) * 2);
}

static void go_on(const ddmpc_controller *c, const real *newest, real *commands)
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
            go_on(c, planned + 2 * i, commands);
        ddmpc_filter_carry(c, now, commands + 2 * WINDOW(c), next);
        real *swapped = now;
        now = next;
        next = swapped;
    }
    return 1;
}

int ddmpc_spread(const ddmpc_controller *c, const real *planned, int count, real *covariance)
{
    static const int most = MAX_BELIEF;
    real commands[2 * (DDMPC_MAX_WINDOW + 1)], means[2][MAX_BELIEF], covariances[2][MAX_BELIEF * MAX_BELIEF];
    real pending[2 * DDMPC_MAX_WINDOW];
    ddmpc_belief beliefs[2] = {{means[0], covariances[0], {0}}, {means[1], covariances[1], {0}}};
    const int Z = BELIEF(c), first = STATES(c) + POSE(c);
    if (Z > most || count < 1 || !ddmpc_newest_belief(c, means[0], covariances[0], pending))
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
            go_on(c, planned + 2 * i, commands);
        ddmpc_filter_predict(c, now, commands + 2 * WINDOW(c), beliefs + (i + 1) % 2);
    }
    return 1;
}
