"""Solve each tick with OSQP and compare with the controller's own solver.

`quadratic_program` returns the problem of the last tick: minimise x'Px/2 + q'x subject to l <= Ax <= u. The variables
are the commands of the horizon, then the slacks of soft limits. Replace OSQP by a solver of your own.
"""

import numpy as np
import osqp

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant

# A low limit on the change of omega is active at the corners of the square.
config = load_config("ssm", {"horizon": 15, "limits.omega_slew": 1.0})
controller, robot, path = Controller(config), make_plant("model:ssm", seed=1), load_trajectory("square")
robot.reset(path.sample([0.0]).pose[0])
controller.start(path, robot.time)


def solve(program):
    """Return the commands (horizon, 2) [m/s, rad/s] and the number of active limits."""
    solver = osqp.OSQP()
    accuracy = {"eps_abs": 1e-10, "eps_rel": 1e-10, "max_iter": 1_000_000, "polishing": True}
    solver.setup(program.P, program.q, program.A, program.l, program.u, verbose=False, **accuracy)
    result = solver.solve(raise_error=True)
    values = program.A @ result.x
    active = np.minimum(values - program.l, program.u - values) < 1e-7
    # Slacks are zero where no soft limit is exceeded; count limits of the commands only.
    limits = [name for name, is_active in zip(program.rows, active, strict=True) if is_active and "increment" in name]
    return result.x[: 2 * config.horizon].reshape(-1, 2), len(limits)


worst, most = 0.0, 0
for tick in range(400):
    step = controller.step(robot.time, robot.measure())
    if tick % 10 == 0:
        plan, active = solve(controller.quadratic_program())
        worst, most = max(worst, np.abs(plan - step.planned_commands).max()), max(most, active)
    robot.advance(step.command)
print(f"40 ticks, up to {most} active slew limits; largest difference of a command {worst:.0e}")
