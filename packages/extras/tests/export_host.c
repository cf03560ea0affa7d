/* Test program: exported controller that reads requests from stdin and writes replies to stdout.
 *
 * A request starts with one additional number: the time of the reference [s] from which its poses are NaN. The reference
 * always starts at 0.
 */
#include <stdio.h>

#include "frames.h"
#include "trajectory.h"

static double invalid_from;
static ddmpc_reference exported;

static void sample(const void *context, ddmpc_time time, real pose[3], real twist[2], real *arc_length)
{
    exported.sample(context, time, pose, twist, arc_length);
    if (time >= invalid_from)
        pose[0] = pose[1] = pose[2] = (real)NAN;
}

int main(void)
{
    double in[1 + FRAME_IN], out[FRAME_OUT];
    ddmpc_controller *controller = ddmpc_open();
    /* The memory was computed on the desktop, which uses wider SIMD lanes. */
    if (ddmpc_reals(&ddmpc_this_sizes) > DDMPC_REALS || ddmpc_ints(&ddmpc_this_sizes) > DDMPC_INTS)
        return 3;
    exported = ddmpc_reference_of(&DDMPC_TRAJECTORY);
    const ddmpc_reference reference = {sample, exported.context, exported.duration};
    while (fread(in, sizeof in, 1, stdin) == 1) {
        ddmpc_input input = {0};
        invalid_from = in[0];
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
