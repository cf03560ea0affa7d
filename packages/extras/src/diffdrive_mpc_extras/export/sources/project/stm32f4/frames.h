/* A tick of the controller as numbers over a line: little-endian doubles in and out. */
#ifndef FRAMES_H
#define FRAMES_H

#include "ddmpc.h"

enum {
    /* t; start anew; request; sent: present, v, omega; then pose, wheels and gyro, each of k = 3, 2, 1 values: present,
       stamp, values, covariance present, covariance (k x k) */
    FRAME_IN = 35,
    /* v_ref, omega_ref, mode, reasons, status, iterations, soft limits, operations, cycles of the step */
    FRAME_OUT = 9
};

/* Put what came in where ddmpc_step looks for it; whether to start anew. */
int frame_read(const double in[FRAME_IN], ddmpc_input *input);

/* Output without the cycles. */
void frame_write(const ddmpc_result *result, double out[FRAME_OUT]);

#endif
