/* The exported controller behind a pipe, for tests: frames in, answers out.
 *
 * Before each frame comes one more number: from this time on [s, of the reference] the reference's poses are NaN. The
 * reference always starts at 0.
 */
#include <stdio.h>

#include "frames.h"
#include "trajectory.h"

static double spoiled_from;
static ddmpc_reference table;

static void sample(const void *context, ddmpc_time time, real pose[3], real twist[2], real *arc_length)
{
    table.sample(context, time, pose, twist, arc_length);
    if (time >= spoiled_from)
        pose[0] = pose[1] = pose[2] = (real)NAN;
}

int main(void)
{
    double in[1 + FRAME_IN], out[FRAME_OUT];
    ddmpc_controller *controller = ddmpc_open();
    /* Memory was counted for the desktop, which works on wider lanes. */
    if (ddmpc_reals(&ddmpc_this_sizes) > DDMPC_REALS || ddmpc_ints(&ddmpc_this_sizes) > DDMPC_INTS)
        return 3;
    table = ddmpc_reference_of(&DDMPC_TRAJECTORY);
    const ddmpc_reference reference = {sample, table.context, table.duration};
    while (fread(in, sizeof in, 1, stdin) == 1) {
        ddmpc_input input = {0};
        spoiled_from = in[0];
        if (frame_read(in + 1, &input)) {
            ddmpc_open();
            if (!ddmpc_follow(controller, &reference, 0.0))
                return 2;
        }
        frame_write(ddmpc_tick(controller, in[1], &input), out);
        fwrite(out, sizeof out, 1, stdout);
        fflush(stdout);
    }
    return 0;
}
