/* Request and reply of one tick over a serial line, as little-endian doubles. */
#ifndef FRAMES_H
#define FRAMES_H

#include "ddmpc.h"

enum {
    /* t; restart; request; sent command: present, v, omega; then pose, wheels and gyro with k = 3, 2, 1 values, each:
       present, stamp, values, covariance present, covariance (k x k) */
    FRAME_IN = 35,
    /* v_ref, omega_ref, mode, reasons, status, iterations, soft limits, operations, cycles of the step */
    FRAME_OUT = 9
};

/* Decode a request into `input`; return nonzero if the controller is to restart. */
int frame_read(const double in[FRAME_IN], ddmpc_input *input);

/* Encode a reply; the cycles are set to 0. */
void frame_write(const ddmpc_result *result, double out[FRAME_OUT]);

#endif
