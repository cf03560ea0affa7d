/* The exported controller behind a pipe, for tests: frames in, answers out.
 *
 * Before each frame comes one more number: from this time on [s, of the reference] the reference's poses are NaN. The
 * reference always starts at 0.
 */
#include <stdio.h>

#include "frames.h"
#include "trajectory.h"

static ddmpc_controller controller;
static ddmpc_result result;
static double spoiled_from;
static ddmpc_reference table;

static void sample(const void *context, ddmpc_time time, real pose[3], real twist[2])
{
    table.sample(context, time, pose, twist);
    if (time >= spoiled_from)
        pose[0] = pose[1] = pose[2] = (real)NAN;
}

int main(void)
{
    double in[1 + FRAME_IN], out[FRAME_OUT];
    table = ddmpc_table_reference(&DDMPC_TRAJECTORY);
    ddmpc_reference reference = {sample, table.context, table.duration};
    ddmpc_init(&controller);
    while (fread(in, sizeof in, 1, stdin) == 1) {
        ddmpc_input input = {0};
        spoiled_from = in[0];
        if (frame_read(in + 1, &input)) {
            ddmpc_init(&controller);
            if (!ddmpc_start(&controller, &reference, 0.0))
                return 2;
        }
        ddmpc_step(&controller, in[1], &input, &result);
        frame_write(&result, out);
        fwrite(out, sizeof out, 1, stdout);
        fflush(stdout);
    }
    return 0;
}
