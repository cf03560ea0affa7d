#include "frames.h"

/* Read a measurement with `values` components from the frame; return the position after it. */
static const double *read_stamped(ddmpc_stamped *stamped, const double *position, int values)
{
    stamped->present = *position++ != 0.0;
    stamped->stamp = *position++;
    for (int i = 0; i < values; i++)
        stamped->value[i] = (real)*position++;
    stamped->has_covariance = *position++ != 0.0;
    for (int i = 0; i < values * values; i++)
        stamped->covariance[i] = (real)*position++;
    return position;
}

int frame_read(const double in[FRAME_IN], ddmpc_input *input)
{
    const double *next = in + 6;
    input->request = (int)in[2];
    input->has_sent = in[3] != 0.0;
    input->sent[0] = (real)in[4];
    input->sent[1] = (real)in[5];
    next = read_stamped(&input->pose, next, 3);
    next = read_stamped(&input->wheels, next, 2);
    read_stamped(&input->yaw_rate, next, 1);
    return in[1] != 0.0;
}

void frame_write(const ddmpc_result *result, double out[FRAME_OUT])
{
    out[0] = (double)result->command[0];
    out[1] = (double)result->command[1];
    out[2] = (double)result->mode;
    out[3] = (double)result->reasons;
    out[4] = (double)result->solver.status;
    out[5] = (double)result->solver.iterations;
    out[6] = (double)result->solver.soft_limits;
    out[7] = (double)result->solver.operations;
    out[8] = 0.0;
}
