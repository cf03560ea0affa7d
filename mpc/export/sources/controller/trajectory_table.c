#include "trajectory_table.h"

/* Cubic with values `from`, `to` and slopes times width `out`, `in` at the ends, at share `s` of the way. */
static real cubic(real from, real to, real out, real in, real s)
{
    real change = to - from, rest = R(1.0) - s;
    return from + s * change + s * rest * (rest * (out - change) - s * (in - change));
}

static void sample_table(const void *context, ddmpc_time time, real pose[3], real twist[2])
{
    const ddmpc_table *table = (const ddmpc_table *)context;
    int last = table->points - 1, outside = time < 0.0 || time > table->duration;
    if (!(time > 0.0))
        time = 0.0;
    if (time > table->duration)
        time = table->duration;
    int row = (int)(time / table->spacing);
    if (row > last - 1)
        row = last - 1;
    /* The last rows may lie closer together. */
    ddmpc_time begin = row * table->spacing, end = row + 1 == last ? table->duration : begin + table->spacing;
    real width = (real)(end - begin), s = (real)((time - begin) / (end - begin));
    const real *a = table->point[row], *b = table->point[row + 1];
    pose[0] = cubic(a[0], b[0], width * a[3] * ddmpc_cos(a[2]), width * b[3] * ddmpc_cos(b[2]), s);
    pose[1] = cubic(a[1], b[1], width * a[3] * ddmpc_sin(a[2]), width * b[3] * ddmpc_sin(b[2]), s);
    pose[2] = cubic(a[2], b[2], width * a[4], width * b[4], s);
    for (int channel = 0; channel < 2; channel++)
        twist[channel] = outside ? R(0.0) : a[3 + channel] + s * (b[3 + channel] - a[3 + channel]);
}

ddmpc_reference ddmpc_table_reference(const ddmpc_table *table)
{
    ddmpc_reference reference = {sample_table, table, table->duration};
    return reference;
}
