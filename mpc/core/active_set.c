#include "active_set.h"

#include <float.h>
#include <string.h>

#include "tile.h"

/* With z = R (U - U0) the cost is |z|^2 / 2, row i becomes v_i = R'^-1 a_i, and z = -sum lambda_i v_i. What follows
 * counts each row that presses towards its bound: its side is 1 at the upper bound and -1 at the lower one, its
 * pressure mu = side lambda >= 0, its room d = side (bound - a_i U0). Pressures maximise the concave dual
 *
 *     -mu'G mu / 2 - d'mu - sum over soft rows of max(mu - price, 0)^2 / (2 slope),    G_ij = side_i side_j v_i'v_j
 */
enum { LANES = DDMPC_LANES, MOST_ROUNDS = 12, PATIENCE = 3, MOST_STALLS = 20, MOST_REFINEMENTS = 3 };

#ifdef DDMPC_FLOAT
#define EPSILON FLT_EPSILON
/* A row is taken to depend on others where less than this part of its square is left. */
#define DEPENDENT R(4e-6)
#define NEGLIGIBLE R(1e-3)
#define STATIONARY R(3e-4)
#else
#define EPSILON DBL_EPSILON
#define DEPENDENT R(1e-12)
#define NEGLIGIBLE R(1e-7)
#define STATIONARY R(1e-8)
#endif
/* Numbers beyond this are no robot's. */
#define LARGEST R(1e15)
#define ROUNDING (R(16.0) * EPSILON)

/* How a row stands; the sign of its state is its side. */
enum { FREE = 0, KEPT = 1, EXCEEDED = 2 };

typedef struct {
    const ddmpc_limited_problem *problem;
    int n, m, slots, most_active;
    int taken, used;   /* slots that were ever taken; the same in whole lanes */
    int active;        /* rows that press */
    int factored;      /* of these, in their order, the first for which the factor holds */
    int iterations;
    real largest_input; /* of U0 */
    real primal;       /* largest excess of a hard row */
    real *columns;     /* (n, slots) v of the row in each slot; kept for rows that left, they often come back */
    real *gram;        /* (slots, slots) v'v */
    real *factor;      /* (slots, slots) upper triangular: of the Gram matrix of the active rows, in their order */
    real *batch;       /* (n, LANES) */
    real *inverse;     /* (n) of R's diagonal */
    real *z;           /* (n) */
    real *line;        /* (n) */
    real *gradient;    /* (n) */
    real *start;       /* (m) values at U0 */
    real *now;         /* (m) values at the plan, then by how much they exceed a limit */
    real *pivot;       /* (slots) inverses of the factor's diagonal */
    real *partial;     /* (slots) the right-hand side, half solved */
    real *wanted;      /* (slots) pressures at which the active rows are where they belong */
    real *pressure;    /* (slots) pressures that the dual method has reached */
    real *step;        /* (slots) */
    real *spread;      /* (slots) multipliers by slot */
    int *slot_of;      /* (m) slot + 1 of a row, or 0 */
    int *state;        /* (m) */
    int *row_in;       /* (slots) the row in each slot, or -1 */
    int *order;        /* (slots) slots of the active rows */
    int *entering;     /* (slots) rows that are to press */
} work;

static int set_up(work *w, const ddmpc_limited_problem *problem, const ddmpc_limited_memory *memory)
{
    const int n = problem->inputs, m = problem->rows, slots = DDMPC_LIMITED_SLOTS(memory->most_active);
    real *next = memory->reals;
    memset(w, 0, sizeof *w);
    w->problem = problem;
    w->n = n;
    w->m = m;
    w->slots = slots;
    w->most_active = memory->most_active;
    w->columns = next;
    w->gram = w->columns + n * slots;
    w->factor = w->gram + slots * slots;
    w->batch = w->factor + slots * slots;
    w->inverse = w->batch + n * LANES;
    w->z = w->inverse + n;
    w->line = w->z + n;
    w->gradient = w->line + n;
    w->pivot = w->gradient + n;
    w->partial = w->pivot + slots;
    w->wanted = w->partial + slots;
    w->pressure = w->wanted + slots;
    w->step = w->pressure + slots;
    w->spread = w->step + slots;
    w->start = w->spread + slots;
    w->now = w->start + m;
    w->slot_of = memory->ints;
    w->state = w->slot_of + m;
    w->row_in = w->state + m;
    w->order = w->row_in + slots;
    w->entering = w->order + slots;
    memset(w->slot_of, 0, (size_t)m * sizeof(int));
    memset(w->state, 0, (size_t)m * sizeof(int));
    for (int i = 0; i < n; i++) {
        const real diagonal = problem->factor[i * n + i];
        /* Not the other way round, here and below: NaN must fail. */
        if (!(diagonal > R(0.0) && diagonal < LARGEST && ddmpc_fabs(problem->minimiser[i]) < LARGEST))
            return 0;
        w->inverse[i] = R(1.0) / diagonal;
        w->largest_input = ddmpc_max(w->largest_input, ddmpc_fabs(problem->minimiser[i]));
    }
    if (m > problem->hard && !(problem->price >= R(0.0) && problem->slope > R(0.0) && problem->price < LARGEST))
        return 0;
    problem->values(problem->context, problem->minimiser, w->start);
    int sound = 1;
    for (int i = 0; i < m; i++)
        sound &= ddmpc_fabs(w->start[i]) < LARGEST;
    return sound;
}

static real sum_of_lanes(const real *sum)
{
    const real a = (sum[0] + sum[4]) + (sum[2] + sum[6]), b = (sum[1] + sum[5]) + (sum[3] + sum[7]);
    return a + b;
}

/* a'b in several sums side by side, which one order of adding would forbid. */
static real dot(const real *restrict a, const real *restrict b, int count)
{
    real sum[LANES] = {R(0.0)};
    int i = 0;
    for (; i + LANES <= count; i += LANES)
#pragma GCC unroll 8
        for (int lane = 0; lane < LANES; lane++)
            sum[lane] += a[i + lane] * b[i + lane];
    for (int lane = 0; i < count; i++, lane++)
        sum[lane] += a[i] * b[i];
    return sum_of_lanes(sum);
}

/* sum = left' right for blocks of LANES columns. */
static void cross(const real *restrict left, int left_stride, const real *restrict right, int right_stride, int rows,
                  real sum[LANES][LANES])
{
    real own[LANES][LANES];
    memset(own, 0, sizeof own);
    for (int row = 0; row < rows; row++, left += left_stride, right += right_stride)
#pragma GCC unroll 8
        for (int a = 0; a < LANES; a++)
#pragma GCC unroll 8
            for (int b = 0; b < LANES; b++)
                own[a][b] += left[a] * right[b];
    memcpy(sum, own, sizeof own);
}

/* x = R'^-1 x for one right-hand side that is zero before `first`. */
static void substitute_one(const work *w, int first, real *restrict x)
{
    const int n = w->n;
    for (int k = first; k < n; k++) {
        const real *restrict row = w->problem->factor + k * n;
        const real now = x[k] *= w->inverse[k];
        for (int i = k + 1; i < n; i++)
            x[i] -= row[i] * now;
    }
}

/* The same for LANES of them side by side, (n, LANES). */
static void substitute_batch(const work *w, int first, real *x)
{
    const int n = w->n, begin = first / LANES * LANES;
    const real *factor = w->problem->factor;
    for (int i = begin; i < n; i += LANES) {
        const int width = n - i < LANES ? n - i : LANES;
        real sum[LANES][LANES];
        /* Beyond a last block that is not whole this reads on into the next row; nobody looks at the result. */
        cross(factor + begin * n + i, n, x + begin * LANES, LANES, i - begin, sum);
        for (int a = 0; a < width; a++) {
            real *own = x + (i + a) * LANES;
            const real *row = factor + (i + a) * n + i;
            for (int b = 0; b < LANES; b++)
                own[b] = (own[b] - sum[a][b]) * w->inverse[i + a];
            for (int c = a + 1; c < width; c++)
                for (int b = 0; b < LANES; b++)
                    sum[c][b] += row[c] * own[b];
        }
    }
}

/* The plan at the pressures, and the values of all rows there. */
static void find_plan(work *w, real *plan)
{
    const int n = w->n;
    const real *factor = w->problem->factor;
    memset(w->spread, 0, (size_t)w->used * sizeof(real));
    for (int i = 0; i < w->active; i++)
        w->spread[w->order[i]] = w->state[w->row_in[w->order[i]]] > 0 ? w->pressure[i] : -w->pressure[i];
    for (int k = 0; k < n; k++)
        w->z[k] = dot(w->columns + k * w->slots, w->spread, w->used);
    /* In blocks: what depends on blocks that are known does not wait. */
    for (int end = n; end > 0; end -= LANES) {
        const int begin = end > LANES ? end - LANES : 0;
        for (int k = begin; k < end; k++)
            w->z[k] -= dot(factor + k * n + end, w->z + end, n - end);
        for (int k = end - 1; k >= begin; k--) {
            w->z[k] *= w->inverse[k];
            for (int i = begin; i < k; i++)
                w->z[i] -= factor[i * n + k] * w->z[k];
        }
    }
    for (int k = 0; k < n; k++)
        plan[k] = w->problem->minimiser[k] - w->z[k];
    w->problem->values(w->problem->context, plan, w->now);
}

/* A slot for `row`: a new one, else that of a row which does not press. */
static int take_slot(work *w, int row)
{
    int slot = w->taken;
    if (slot < w->slots) {
        w->taken++;
    } else {
        for (slot = 0; slot < w->slots - 1 && w->state[w->row_in[slot]] != FREE; slot++)
            ;
        w->slot_of[w->row_in[slot]] = 0;
    }
    if (slot == w->used) {
        for (int k = 0; k < w->n; k++)
            memset(w->columns + k * w->slots + slot, 0, LANES * sizeof(real));
        w->used += LANES;
    }
    w->row_in[slot] = row;
    w->slot_of[row] = slot + 1;
    return slot;
}

/* Columns and products of one row that has got a slot. */
static void bring_one(work *w, int slot)
{
    const int n = w->n, slots = w->slots;
    int first = 0, last = n;
    real *restrict x = w->z;
    w->problem->row(w->problem->context, w->row_in[slot], w->line, &first, &last);
    memset(x, 0, (size_t)n * sizeof(real));
    memcpy(x + first, w->line + first, (size_t)(last - first) * sizeof(real));
    substitute_one(w, first, x);
    for (int k = 0; k < n; k++)
        w->columns[k * slots + slot] = x[k];
    for (int block = 0; block < w->used; block += LANES) {
        real sum[LANES] = {R(0.0)};
        const real *restrict column = w->columns + first * slots + block;
        for (int k = first; k < n; k++, column += slots)
#pragma GCC unroll 8
            for (int lane = 0; lane < LANES; lane++)
                sum[lane] += x[k] * column[lane];
        for (int lane = 0; lane < LANES; lane++)
            w->gram[(block + lane) * slots + slot] = w->gram[slot * slots + block + lane] = sum[lane];
    }
}

/* The same for several at once. */
static void bring_batch(work *w, const int *chosen, int count)
{
    const int n = w->n, slots = w->slots;
    int earliest = n;
    memset(w->batch, 0, (size_t)(n * LANES) * sizeof(real));
    for (int lane = 0; lane < count; lane++) {
        int first = 0, last = n;
        w->problem->row(w->problem->context, w->row_in[chosen[lane]], w->line, &first, &last);
        for (int k = first; k < last; k++)
            w->batch[k * LANES + lane] = w->line[k];
        earliest = first < earliest ? first : earliest;
    }
    substitute_batch(w, earliest, w->batch);
    for (int k = 0; k < n; k++)
        for (int lane = 0; lane < count; lane++)
            w->columns[k * slots + chosen[lane]] = w->batch[k * LANES + lane];
    for (int block = 0; block < w->used; block += LANES) {
        real sum[LANES][LANES];
        cross(w->columns + earliest * slots + block, slots, w->batch + earliest * LANES, LANES, n - earliest, sum);
        for (int a = 0; a < LANES; a++)
            for (int lane = 0; lane < count; lane++) {
                const int own = chosen[lane];
                w->gram[own * slots + block + a] = w->gram[(block + a) * slots + own] = sum[a][lane];
            }
    }
}

/* Let rows press that are in `entering`: their states are set already, and there is room for them. */
static void enter(work *w, int count)
{
    int chosen[LANES], waiting = 0;
    for (int i = 0; i < count; i++) {
        const int row = w->entering[i];
        if (w->slot_of[row] == 0) {
            chosen[waiting++] = take_slot(w, row);
            if (waiting == LANES) {
                bring_batch(w, chosen, waiting);
                waiting = 0;
            }
        }
        w->pressure[w->active] = R(0.0);
        w->order[w->active++] = w->slot_of[row] - 1;
    }
    if (waiting == 1)
        bring_one(w, chosen[0]);
    else if (waiting > 1)
        bring_batch(w, chosen, waiting);
}

static int *state_at(const work *w, int position)
{
    return w->state + w->row_in[w->order[position]];
}

static int is_soft(const work *w, int position)
{
    return w->row_in[w->order[position]] >= w->problem->hard;
}

static int is_exceeded(const work *w, int position)
{
    const int state = *state_at(w, position);
    return state == EXCEEDED || state == -EXCEEDED;
}

static void touch(work *w, int position)
{
    w->factored = w->factored < position ? w->factored : position;
}

static void leave(work *w, int position)
{
    *state_at(w, position) = FREE;
    w->active--;
    memmove(w->order + position, w->order + position + 1, (size_t)(w->active - position) * sizeof(int));
    memmove(w->pressure + position, w->pressure + position + 1, (size_t)(w->active - position) * sizeof(real));
    memmove(w->wanted + position, w->wanted + position + 1, (size_t)(w->active - position) * sizeof(real));
    touch(w, position);
}

/* A soft row goes over to the other piece of its penalty. */
static void switch_piece(work *w, int position)
{
    int *state = state_at(w, position);
    const int side = *state > 0 ? 1 : -1;
    *state = side * (is_exceeded(w, position) ? KEPT : EXCEEDED);
    touch(w, position);
}

/* side (bound - a U0), less what the linear part of the penalty gives way. */
static real target(const work *w, int position)
{
    const ddmpc_limited_problem *problem = w->problem;
    const int row = w->row_in[w->order[position]];
    const real room = w->state[row] > 0 ? problem->upper[row] - w->start[row] : w->start[row] - problem->lower[row];
    return is_exceeded(w, position) ? room - problem->price / problem->slope : room;
}

/* U'U = G of the active rows, with 1 / slope on the diagonal of exceeded ones, and U'^-1 of the right-hand side; from
 * the first row on for which they do not hold. Returns the first row that depends on those before it (the factor holds
 * up to it), else how many are active; or -1 where numbers are none. */
static int factorise(work *w)
{
    const int k = w->active, from = w->factored, slots = w->slots;
    const real give = R(1.0) / w->problem->slope;
    real *restrict U = w->factor, *restrict y = w->partial;
    for (int i = 0; i < k; i++) {
        const real *row = w->gram + w->order[i] * slots;
        const int positive = *state_at(w, i) > 0;
        for (int j = i > from ? i : from; j < k; j++)
            U[i * slots + j] = positive == (*state_at(w, j) > 0) ? row[w->order[j]] : -row[w->order[j]];
        if (i >= from) {
            if (is_exceeded(w, i))
                U[i * slots + i] += give;
            /* Kept for the test of the pivot. */
            w->step[i] = U[i * slots + i];
            y[i] = -target(w, i);
            if (!(w->step[i] < LARGEST && ddmpc_fabs(y[i]) < LARGEST))
                return -1;
        }
    }
    for (int i = 0; i < k; i++) {
        real *restrict own = U + i * slots;
        int begin = from;
        if (i >= from) {
            if (!(own[i] > DEPENDENT * w->step[i])) {
                w->factored = i;
                return own[i] < LARGEST ? i : -1;
            }
            own[i] = ddmpc_sqrt(own[i]);
            w->pivot[i] = R(1.0) / own[i];
            y[i] *= w->pivot[i];
            begin = i + 1;
        }
        for (int j = begin; j < k; j++)
            own[j] *= w->pivot[i];
        for (int r = i + 1; r < k; r++) {
            real *restrict other = U + r * slots;
            const real weight = own[r];
            for (int j = r > from ? r : from; j < k; j++)
                other[j] -= weight * own[j];
        }
        for (int r = begin; r < k; r++)
            y[r] -= own[r] * y[i];
    }
    w->factored = k;
    return k;
}

/* x = U^-1 x for the first `count` rows. */
static void substitute_back(const work *w, int count, real *x)
{
    for (int i = count - 1; i >= 0; i--)
        x[i] = (x[i] - dot(w->factor + i * w->slots + i + 1, x + i + 1, count - 1 - i)) * w->pivot[i];
}

static void find_wanted(work *w)
{
    memcpy(w->wanted, w->partial, (size_t)w->active * sizeof(real));
    substitute_back(w, w->active, w->wanted);
}

/* Range of the pressure of a row on its piece. */
static real least_pressure(const work *w, int position)
{
    return is_exceeded(w, position) ? w->problem->price : R(0.0);
}

static real most_pressure(const work *w, int position)
{
    return is_soft(w, position) && !is_exceeded(w, position) ? w->problem->price : LARGEST;
}

/* How much a value may be beyond its limit. */
static real tolerance(const work *w, int row)
{
    return w->problem->slack + ROUNDING * (w->largest_input + ddmpc_fabs(w->start[row]));
}

/* By how much each row is beyond its limits and their tolerance, into `now`; returns whether all are numbers. */
static int survey(work *w)
{
    const real *restrict upper = w->problem->upper, *restrict lower = w->problem->lower, *restrict start = w->start;
    const real slack = w->problem->slack + ROUNDING * w->largest_input;
    real *restrict now = w->now;
    int sound = 1;
    w->primal = R(0.0);
    for (int i = 0; i < w->problem->hard; i++)
        w->primal = ddmpc_max(w->primal, ddmpc_max(now[i] - upper[i], lower[i] - now[i]));
    for (int i = 0; i < w->m; i++) {
        const real over = now[i] - upper[i], under = lower[i] - now[i];
        sound &= ddmpc_fabs(now[i]) < LARGEST;
        now[i] = ddmpc_max(over, under) - (slack + ROUNDING * ddmpc_fabs(start[i]));
        /* Positive at the upper bound. */
        now[i] = now[i] > R(0.0) && under > over ? -now[i] : now[i] > R(0.0) ? now[i] : R(0.0);
    }
    return sound;
}

typedef enum { SETTLED, RAN_OUT, UNBOUNDED } outcome;

/* The way to the maximum of the dual on the active rows into `step`, and how long it is: where a row depends on others,
 * along what moves no plan, without end. Returns 0 if numbers ran out. */
static int find_step(work *w, real *length, real *gain)
{
    const int k = w->active, dependent = factorise(w), slots = w->slots;
    real *step = w->step;
    if (dependent < 0)
        return 0;
    *length = R(1.0);
    *gain = R(0.0);
    if (dependent == k) {
        find_wanted(w);
        for (int i = 0; i < k; i++)
            step[i] = w->wanted[i] - w->pressure[i];
        return 1;
    }
    for (int i = 0; i < dependent; i++)
        step[i] = -w->factor[i * slots + dependent];
    substitute_back(w, dependent, step);
    step[dependent] = R(1.0);
    memset(step + dependent + 1, 0, (size_t)(k - dependent - 1) * sizeof(real));
    real largest = R(1.0), rise = R(0.0);
    for (int i = 0; i <= dependent; i++)
        largest = ddmpc_max(largest, ddmpc_fabs(step[i]));
    for (int i = 0; i <= dependent; i++) {
        real slope = target(w, i);
        if (ddmpc_fabs(step[i]) <= NEGLIGIBLE * largest) {
            step[i] = R(0.0);
            continue;
        }
        for (int j = 0; j < k; j++) {
            const real product = w->gram[w->order[i] * slots + w->order[j]];
            slope += (*state_at(w, i) > 0) == (*state_at(w, j) > 0) ? product * w->pressure[j]
                                                                    : -product * w->pressure[j];
        }
        if (is_exceeded(w, i))
            slope += w->pressure[i] / w->problem->slope;
        rise -= slope * step[i];
    }
    if (rise < R(0.0))
        for (int i = 0; i <= dependent; i++)
            step[i] = -step[i];
    *length = LARGEST;
    *gain = ddmpc_fabs(rise);
    return 1;
}

/* The first row whose pressure leaves its piece within `length` along `step`; -1 if none does. */
static int find_block(const work *w, real *length)
{
    int block = -1;
    for (int i = 0; i < w->active; i++) {
        const real step = w->step[i], bound = step < R(0.0) ? least_pressure(w, i) : most_pressure(w, i);
        if (step == R(0.0) || bound == LARGEST)
            continue;
        const real reach = ddmpc_max((bound - w->pressure[i]) / step, R(0.0));
        if (reach < *length) {
            *length = reach;
            block = i;
        }
    }
    return block;
}

/* From pressures within their pieces climb to the maximum of the dual on the active rows or a part of them. */
static outcome settle(work *w)
{
    for (;;) {
        real length, gain, total = R(0.0);
        if (++w->iterations > w->problem->most_iterations || !find_step(w, &length, &gain))
            return RAN_OUT;
        const int is_null = length > R(1.0);
        int block = find_block(w, &length);
        if (is_null && block < 0) {
            for (int i = 0; i < w->active; i++)
                total += ddmpc_fabs(w->step[i]);
            if (gain > w->problem->slack * total)
                return UNBOUNDED;
            /* As high everywhere: the other way something blocks. */
            for (int i = 0; i < w->active; i++)
                w->step[i] = -w->step[i];
            block = find_block(w, &length);
            if (block < 0)
                return RAN_OUT;
        }
        if (block < 0) {
            memcpy(w->pressure, w->wanted, (size_t)w->active * sizeof(real));
            return SETTLED;
        }
        const real bound = w->step[block] < R(0.0) ? least_pressure(w, block) : most_pressure(w, block);
        for (int i = 0; i < w->active; i++) {
            w->pressure[i] += length * w->step[i];
            w->pressure[i] = ddmpc_min(ddmpc_max(w->pressure[i], least_pressure(w, i)), most_pressure(w, i));
        }
        w->pressure[block] = bound;
        if (bound == R(0.0))
            leave(w, block);
        else
            switch_piece(w, block);
    }
}

/* Whether active rows are where their pressures say, to within their tolerance; else corrects the pressures once. */
static int is_met(work *w)
{
    int met = 1;
    for (int i = 0; i < w->active; i++) {
        const int row = w->row_in[w->order[i]];
        const real give = is_exceeded(w, i) ? (w->pressure[i] - w->problem->price) / w->problem->slope : R(0.0);
        const real miss = w->state[row] > 0 ? w->now[row] - w->problem->upper[row] : w->problem->lower[row] - w->now[row];
        w->step[i] = miss - give;
        met &= ddmpc_fabs(w->step[i]) <= tolerance(w, row);
    }
    return met;
}

static void refine(work *w)
{
    real *step = w->step;
    for (int i = 0; i < w->active; i++) {
        step[i] *= w->pivot[i];
        for (int r = i + 1; r < w->active; r++)
            step[r] -= w->factor[i * w->slots + r] * step[i];
    }
    substitute_back(w, w->active, step);
    for (int i = 0; i < w->active; i++)
        w->pressure[i] = ddmpc_min(ddmpc_max(w->pressure[i] + step[i], least_pressure(w, i)), most_pressure(w, i));
}

/* Steps of the primal-dual active set method, from the rows that are active: what pulls leaves, what is broken comes,
 * all at once. Returns whether that ended at the solution; else leaves what may begin the dual method. */
static int change_many(work *w, real *plan)
{
    int best = w->m + 1, patience = PATIENCE;
    for (int round = 0; round < MOST_ROUNDS && w->iterations < w->problem->most_iterations; round++) {
        int dependent, met, wrong = 0, entering = 0;
        w->iterations++;
        while ((dependent = factorise(w)) < w->active) {
            if (dependent < 0)
                return 0;
            leave(w, dependent);
        }
        find_wanted(w);
        memcpy(w->pressure, w->wanted, (size_t)w->active * sizeof(real));
        find_plan(w, plan);
        met = is_met(w);
        if (!survey(w))
            return 0;
        for (int i = w->active - 1; i >= 0; i--) {
            const int pulls = w->pressure[i] < R(0.0);
            if (!pulls && w->pressure[i] >= least_pressure(w, i) && w->pressure[i] <= most_pressure(w, i))
                continue;
            wrong++;
            if (pulls) {
                leave(w, i);
            } else {
                w->pressure[i] = w->problem->price;
                switch_piece(w, i);
            }
        }
        for (int row = 0; row < w->m; row++)
            if (w->now[row] != R(0.0) && w->state[row] == FREE) {
                wrong++;
                if (w->active + entering < w->most_active)
                    w->entering[entering++] = row;
            }
        if (wrong == 0)
            return met;
        if (wrong < best) {
            best = wrong;
            patience = PATIENCE;
        } else if (--patience == 0) {
            return 0;
        }
        for (int i = 0; i < entering; i++)
            w->state[w->entering[i]] = w->now[w->entering[i]] > R(0.0) ? KEPT : -KEPT;
        enter(w, entering);
    }
    return 0;
}

/* The dual objective where the pressures are those wanted. */
static real height(const work *w)
{
    real sum = R(0.0);
    for (int i = 0; i < w->active; i++) {
        sum -= w->pressure[i] * target(w, i);
        if (is_exceeded(w, i))
            sum -= w->problem->price * w->problem->price / w->problem->slope;
    }
    return R(0.5) * sum;
}

/* The dual method: settle, let the row that is broken most press, settle, ... */
static ddmpc_limited_status climb(work *w, real *plan)
{
    real highest = -LARGEST;
    for (int stalls = 0; stalls < MOST_STALLS;) {
        const outcome end = settle(w);
        int refinements = 0, worst = -1;
        if (end != SETTLED)
            return end == UNBOUNDED ? DDMPC_INFEASIBLE : DDMPC_NOT_PROVEN;
        find_plan(w, plan);
        while (!is_met(w)) {
            if (refinements++ == MOST_REFINEMENTS)
                return DDMPC_NOT_PROVEN;
            refine(w);
            find_plan(w, plan);
        }
        if (!survey(w))
            return DDMPC_NOT_PROVEN;
        for (int row = 0; row < w->m; row++)
            if (w->now[row] != R(0.0) && w->state[row] == FREE &&
                (worst < 0 || ddmpc_fabs(w->now[row]) > ddmpc_fabs(w->now[worst])))
                worst = row;
        if (worst < 0)
            return DDMPC_PROVEN;
        if (w->active == w->most_active)
            return DDMPC_NOT_PROVEN;
        const real reached = height(w);
        stalls = reached > highest ? 0 : stalls + 1;
        highest = ddmpc_max(highest, reached);
        w->state[worst] = w->now[worst] > R(0.0) ? KEPT : -KEPT;
        w->entering[0] = worst;
        enter(w, 1);
    }
    return DDMPC_NOT_PROVEN;
}

/* Fill residuals and multipliers from the plan; returns whether the cost is stationary. */
static int is_stationary(work *w, const real *plan, real *multipliers, ddmpc_limited_result *result)
{
    const ddmpc_limited_problem *problem = w->problem;
    const int n = w->n;
    real *restrict gradient = w->gradient, *restrict scale = w->batch;
    real largest = R(0.0), allowed = R(0.0);
    memset(gradient, 0, (size_t)n * sizeof(real));
    memset(scale, 0, (size_t)n * sizeof(real));
    for (int k = 0; k < n; k++)
        w->z[k] = plan[k] - problem->minimiser[k];
    for (int k = 0; k < n; k++) {
        const real *restrict row = problem->factor + k * n;
        real moved = R(0.0), size = R(0.0);
        for (int i = k; i < n; i++) {
            moved += row[i] * w->z[i];
            size += ddmpc_fabs(row[i]) * (ddmpc_fabs(plan[i]) + ddmpc_fabs(problem->minimiser[i]));
        }
        for (int i = k; i < n; i++) {
            gradient[i] += row[i] * moved;
            scale[i] += ddmpc_fabs(row[i]) * size;
        }
    }
    for (int k = 0; k < n; k++)
        allowed = ddmpc_max(allowed, ROUNDING * scale[k]);
    memset(multipliers, 0, (size_t)w->m * sizeof(real));
    for (int i = 0; i < w->active; i++) {
        const int row = w->row_in[w->order[i]], side = w->state[row] > 0 ? 1 : -1;
        const real bound = side > 0 ? problem->upper[row] : problem->lower[row];
        int first = 0, last = n;
        real multiplier = side * w->pressure[i], give = R(0.0);
        problem->row(problem->context, row, w->line, &first, &last);
        multipliers[row] = multiplier;
        if (is_exceeded(w, i)) {
            /* The price is that of the plan as it is. */
            real value = R(0.0);
            for (int k = first; k < last; k++)
                value += w->line[k] * plan[k];
            multiplier = side * problem->price + problem->slope * (value - bound);
            give = problem->slope * tolerance(w, row);
        }
        for (int k = first; k < last; k++) {
            gradient[k] += multiplier * w->line[k];
            largest = ddmpc_max(largest, ddmpc_fabs(multiplier * w->line[k]));
            allowed = ddmpc_max(allowed, give * ddmpc_fabs(w->line[k]));
        }
    }
    result->dual = R(0.0);
    int stationary = 1;
    for (int k = 0; k < n; k++) {
        stationary &= ddmpc_fabs(gradient[k]) <= allowed + STATIONARY * largest;
        result->dual = ddmpc_max(result->dual, ddmpc_fabs(gradient[k]));
    }
    return stationary;
}

/* Let the rows press whose multipliers say so. Returns whether limits are numbers in their order. */
static int start_from(work *w, const real *multipliers)
{
    const ddmpc_limited_problem *problem = w->problem;
    int entering = 0, sound = 1;
    for (int row = 0; row < w->m; row++) {
        const real size = ddmpc_fabs(multipliers[row]);
        sound &= problem->lower[row] <= problem->upper[row];
        if (size > R(0.0) && entering < w->most_active) {
            const int piece = row >= problem->hard && size > problem->price ? EXCEEDED : KEPT;
            w->state[row] = multipliers[row] > R(0.0) ? piece : -piece;
            w->entering[entering++] = row;
        }
    }
    if (sound)
        enter(w, entering);
    return sound;
}

ddmpc_limited_result ddmpc_solve_limited(const ddmpc_limited_problem *problem, const ddmpc_limited_memory *memory,
                                         real *multipliers, real *plan)
{
    work w;
    ddmpc_limited_result result = {DDMPC_NOT_PROVEN, 0, 0, R(0.0), R(0.0)};
    if (set_up(&w, problem, memory) && start_from(&w, multipliers)) {
        result.status = change_many(&w, plan) ? DDMPC_PROVEN : climb(&w, plan);
        result.active = w.active;
        result.iterations = w.iterations;
        result.primal = w.primal;
        if (result.status == DDMPC_PROVEN && !is_stationary(&w, plan, multipliers, &result))
            result.status = DDMPC_NOT_PROVEN;
    }
    if (result.status != DDMPC_PROVEN) {
        memset(multipliers, 0, (size_t)problem->rows * sizeof(real));
        memcpy(plan, problem->minimiser, (size_t)problem->inputs * sizeof(real));
    }
    return result;
}

unsigned long ddmpc_limited_reals(int inputs, int rows, int most_active)
{
    return (unsigned long)DDMPC_LIMITED_REALS(inputs, rows, most_active);
}

unsigned long ddmpc_limited_ints(int inputs, int rows, int most_active)
{
    (void)inputs;
    return (unsigned long)DDMPC_LIMITED_INTS(inputs, rows, most_active);
}
