"""Track a circle with the simulated robot, and look at what happened.

Model-predictive control (MPC): at every tick the controller predicts, with a model of how the robot answers commands,
where the next second would lead, chooses the commands that come closest to the reference, and sends the first.
"""

from collections import Counter

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant, simulate

# The reference is timed: where the robot shall be, at every instant. Also "square", "s", "cane", or a file of yours.
circle = load_trajectory("circle")

# "ssm" is a configuration that ships; a YAML file of yours is read by its path. Any value can be replaced:
# 25 steps of 20 ms ahead; how much 1 m of error across the path weighs against one along it (150).
config = load_config("ssm", {"horizon": 25, "weights.across": 500.0})
controller = Controller(config)

# The robot's stand-in, with noisy and late sensors: the controller sees these only. "mujoco" has wheels that skid.
robot = make_plant("model:ssm", sensors="default", seed=1)

run = simulate(controller, robot, circle)
print(run)

# Everything is there over time, as read-only arrays: rows are ticks.
last = run.true_pose[-1] - run.reference_pose[-1]
print(f"at the end {100 * last[0]:.1f} cm along x and {100 * last[1]:.1f} cm along y from where it should be")

# Most ticks need no iterations: where no limit is near, the optimum is the solution of linear equations ("unlimited").
print("ways the solver took:", dict(Counter(run.solver_methods)))

# With pandas: run.to_dataframe() has the same as a table, with names like true_x_m or v_ref_m_s.
