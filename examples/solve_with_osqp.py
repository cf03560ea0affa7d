"""Solve the quadratic program of a tick with OSQP directly, and compare with the plan of the controller."""

import numpy as np
import osqp

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant

# The robot is slow to turn, so that limits press.
controller = Controller(load_config("ssm", {"horizon": 15, "limits.omega_slew": 1.0}))
robot, square = make_plant("model:ssm", seed=1), load_trajectory("square")
robot.reset(square.sample([0.0]).pose[0])
controller.start(square, robot.time)
for _ in range(155):
    step = controller.step(robot.time, robot.measure())
    robot.advance(step.command)

# P, q, A, l, u as OSQP takes them; `variables` and `rows` name what they are.
program = controller.quadratic_program()
solver = osqp.OSQP()
solver.setup(
    program.P, program.q, program.A, program.l, program.u, eps_abs=1e-9, eps_rel=1e-9, polishing=True, verbose=False
)
result = solver.solve()
commands = result.x[: 2 * controller.config.horizon].reshape(-1, 2)
print(f"largest difference of the commands: {np.abs(commands - step.planned_commands).max():.1e}")
# Rows of slacks stand last: `over ...` and `under ...`.
limits = len(program.rows) - (len(program.variables) - commands.size)
pressing = [program.rows[row] for row in range(limits) if abs(result.y[row]) > 1e-6]
print("limits that press:", ", ".join(pressing))
