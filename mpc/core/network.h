/* Network on past commands as velocity model: layout of its parameters.
 *
 * One layer of long short-term memory with H units, a dense layer of D units with tanh, and two outputs. P, Q and Z are
 * H, D and H + 2 (the units and the two commands) padded to whole blocks. The parameters are consecutive numbers:
 *
 *     3            number of samples of the window, H, D
 *     [H+2][4][P]  weights of the gates enter, keep, candidate and leave, for previous outputs and the command
 *     [4][P]       offsets of the gates
 *     [4][P][Z]    weights of the gates, transposed
 *     [H][Q]       weights of the dense layer
 *     [Q]          offsets of the dense layer
 *     [D][P]       weights of the dense layer, transposed
 *     [2][Q]       weights of the outputs
 *     2            offsets of the outputs
 *
 * Padding is zero. mpc/core/network.py writes this layout. */
#ifndef DDMPC_NETWORK_H
#define DDMPC_NETWORK_H

#include "real.h"

/* Number of columns processed at once; rows are padded to a multiple of this number. */
enum { DDMPC_BLOCK = 32 };
/* Numbers stored per unit and sample for the gradient. */
enum { DDMPC_STORED = 6 };

#endif
