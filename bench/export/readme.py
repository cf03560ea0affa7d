"""The README of an exported folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from diffdrive_mpc.bench.table import Table

_TEXT = """\
# Trajectory-tracking controller in C99

Written by `diffdrive-mpc export`: model {model} ({states} states), {horizon} steps of {sample_time_s} s ahead,
{precision} precision, trajectory `{trajectory}` as a table. `export.json` holds the whole configuration.

    ddmpc/     the controller; ddmpc_sizes.h, constants.c and trajectory.[ch] were generated for it
    osqp/      OSQP {osqp}, embedded code and two workspaces, as OSQP generates them (licence beside them)
    examples/  main.c drives a simulated robot along the trajectory
    stm32f4/   startup, linker script and a main for processor in the loop over a serial line

## Build

    cmake -S . -B build && cmake --build build && build/ddmpc_example
    cmake -S . -B build-stm32f4 -DCMAKE_TOOLCHAIN_FILE=stm32f4/toolchain.cmake && cmake --build build-stm32f4

Without CMake: compile `ddmpc/*.c`, `osqp/src/*.c` and `osqp/*_workspace.c` as C99 with `ddmpc`, `osqp`,
`osqp/inc/public` and `osqp/inc/private` as include folders. Nothing is allocated, nothing is printed, no system call
is made.

## Use

```c
#include "ddmpc.h"
#include "trajectory.h"

static ddmpc_controller controller;
static ddmpc_result result;

ddmpc_reference reference = ddmpc_table_reference(&DDMPC_TRAJECTORY); /* or a function of your own */
ddmpc_init(&controller);
if (!ddmpc_start(&controller, &reference, now))
    refuse();                       /* faster than the limits */

/* every {sample_time_s} s */
ddmpc_input input = {{0}};            /* what is new since the last tick; stamps on the clock of `now` */
input.measurement.pose.present = 1; /* stamp, value[0..2] = x, y, theta; covariance if known */
ddmpc_step(&controller, now, &input, &result);
drive(result.command[0], result.command[1]);
```

`result.mode` and `result.reasons` say what it does and why, `result.notes` which measurements were rejected,
`result.solver` how the solve went. One controller to a program: OSQP's workspace is global.

## Differences to the Python controller

It is the Python controller with `reentry.enabled: false`: further than `failure.max_position_error` from where the
reference is it brakes, nearer it chases the reference, which does not wait.

- Weights and limits are constants; there is no `update`.
- At most {soft_slots} soft limits (one limit, one step, one side) take part in one tick's program;
  `result.solver.left_out` counts exceeded ones beyond that.
- One step makes at most {iteration_limit} iterations of OSQP, over all solves of the tick, and has no time limit.
- OSQP's residuals come to a tolerance of {tolerance:g} in rows of unit length, see docs/export.md of the project. Where
  no constraint is active the plan is exact, with 0 iterations.
- `result.reasons` and `result.notes` are numbers where the Python controller has sentences.
- A reference comes with a function or a table: cubic in the pose, linear in the twist between rows.

"""


def readme(facts: Mapping[str, object], tables: Sequence[Table]) -> str:
    """Text for an export described by `facts`, with what was measured of it."""
    return _TEXT.format(**facts) + "\n".join(table.markdown() for table in tables)
