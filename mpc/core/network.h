/* A network on past commands as velocity model: its functions, and the layout of its parameters.
 *
 * One layer of long short-term memory with H units, a dense layer of D units with tanh, and two outputs. P, Q and Z are
 * H, D and H + 2 (the units and the two commands) padded to whole blocks. The parameters lie one after the other:
 *
 *     3            samples of the window, H, D
 *     [H+2][4][P]  weights of the gates enter, keep, candidate and leave, for previous outputs and the command
 *     [4][P]       their offsets
 *     [4][P][Z]    the same weights once more, transposed
 *     [H][Q]       dense layer
 *     [Q]          its offsets
 *     [D][P]       its weights transposed
 *     [2][Q]       outputs
 *     2            their offsets
 *
 * Padding is zero. mpc/core/network.py writes this layout. */
#ifndef DDMPC_NETWORK_H
#define DDMPC_NETWORK_H

#include "real.h"

/* Number of columns processed at once; rows are padded to a multiple of it. */
enum { DDMPC_BLOCK = 32 };
/* Numbers stored per unit and sample for the gradient. */
enum { DDMPC_STORED = 6 };

#endif
