/* The condensed problem without its limits: a factor of H, the minimiser, and which limits that breaks. Where it breaks
 * none it solves the whole problem. */
#ifndef DDMPC_RELAX_H
#define DDMPC_RELAX_H

#include "condense.h"

/* Bits of the kinds of limit that a plan breaks: v_ref, omega_ref, their increments, and the kinds of soft limit. */
enum { DDMPC_BROKEN_COMMAND = 1, DDMPC_BROKEN_INCREMENT = 4, DDMPC_BROKEN_SOFT = 16 };

typedef struct {
    real plan[DDMPC_INPUTS];
    real residual; /* largest |H plan + g| */
    /* U of H = U'U, upper triangular, row by row; the rest of the memory is for whole lanes */
    real factor[DDMPC_INPUTS * DDMPC_INPUTS + DDMPC_LANES];
} ddmpc_relaxed;

typedef enum { DDMPC_RELAXED, DDMPC_NOT_FINITE, DDMPC_NOT_CONVEX } ddmpc_relax_status;

/* Factorise and minimise. */
ddmpc_relax_status ddmpc_relax(const ddmpc_tick *tick, const ddmpc_qp *qp, ddmpc_relaxed *relaxed);
/* What `plan` breaks by more than `slack`, as bits. After ddmpc_condense. */
int ddmpc_broken(const ddmpc_tracking *constants, const ddmpc_tick *tick, const ddmpc_workspace *work,
                 const ddmpc_qp *qp, const real plan[DDMPC_INPUTS], real slack);

/* Linearise along `plan`, condense, factorise and minimise; `broken` gets what the minimiser breaks at all, as bits. */
ddmpc_relax_status ddmpc_condense_and_relax(const ddmpc_tracking *constants, const ddmpc_tick *tick,
                                            const real plan[DDMPC_INPUTS], ddmpc_workspace *work, ddmpc_qp *qp,
                                            ddmpc_relaxed *relaxed, int *broken);

unsigned long ddmpc_relaxed_size(void);

#endif
