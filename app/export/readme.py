"""The README of an exported folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from diffdrive_mpc.bench.table import Table

_TEXT = """\
# Trajectory-tracking controller in C99

Written by `diffdrive-mpc export`: model {model} ({states} states), {horizon} steps of {sample_time_s} s ahead,
{precision} precision, trajectory `{trajectory}` in closed form. `export.json` holds the whole configuration.

    ddmpc/     the controller, from the sources that Python compiles for itself; ddmpc.[ch] is what an application
               calls, ddmpc_sizes.h, constants.c and trajectory.[ch] were generated for this controller
    examples/  main.c drives a simulated robot along the trajectory
    stm32f4/   startup, linker script and a main for processor in the loop over a serial line

## Build

    cmake -S . -B build && cmake --build build && build/ddmpc_example
    cmake -S . -B build-stm32f4 -DCMAKE_TOOLCHAIN_FILE=stm32f4/toolchain.cmake && cmake --build build-stm32f4

Without CMake: compile `ddmpc/*.c` as C99 with `ddmpc` as include folder, and never with `-ffast-math`: numbers that
are none must be seen. Nothing is allocated, nothing is printed, no system call is made.

## Use

```c
#include "ddmpc.h"
#include "trajectory.h"

ddmpc_reference reference = ddmpc_reference_of(&DDMPC_TRAJECTORY); /* or a function of your own */
ddmpc_controller *controller = ddmpc_open();
if (!ddmpc_follow(controller, &reference, now))
    refuse();               /* faster than the limits */

/* every {sample_time_s} s */
ddmpc_input input = {{0}};    /* what is new since the last tick; stamps on the clock of `now` */
input.pose.present = 1;     /* stamp, value[0..2] = x, y, theta; covariance if known */
const ddmpc_result *result = ddmpc_tick(controller, now, &input);
drive(result->command[0], result->command[1]);
```

`result->mode` and `result->reasons` say what it does and why, `result->note` which measurements were rejected,
`result->solver` how the solve went. There is one controller to a program.

## Differences to the Python controller

It is the Python controller with `reentry.enabled: false`: further than `failure.max_position_error` from where the
reference is it brakes, nearer it chases the reference, which does not wait.

- There is no backend: what the active set does not prove within {iteration_limit} systems is a failed solve, and the
  failure ladder acts. Where no limit is active the plan is exact, with 0 iterations.
- Weights and limits are constants; there is no `update`. Parameters of functions of yours are variables.
- `result->reasons` and `result->note` are numbers where the Python controller has sentences.

"""


def readme(facts: Mapping[str, object], tables: Sequence[Table]) -> str:
    """Text for an export described by `facts`, with what was measured of it."""
    return _TEXT.format(**facts) + "\n".join(table.markdown() for table in tables)
