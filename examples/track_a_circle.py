"""Track a circle with the simulated robot and print the results.

In model predictive control (MPC), the controller predicts the motion over a short horizon with a model of the robot. At
every tick it computes the commands that minimise the error from the reference, and sends the first of them.
"""

from collections import Counter

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant, simulate

# The reference states the pose at each time. Other names are "square", "s" and "cane"; a path loads your own file.
circle = load_trajectory("circle")

# "ssm" is a shipped configuration; a path loads your own YAML file. Any value can be replaced, here the horizon (25
# steps of 20 ms) and the weight of the error across the path; the weight of the error along the path is 350.
config = load_config("ssm", {"horizon": 25, "weights.across": 500.0})
controller = Controller(config)

# Simulated robot with noise and delay in its sensors, which are the only input of the controller. The wheels of the
# plant "mujoco" also slip.
robot = make_plant("model:ssm", sensors="default", seed=1)

run = simulate(controller, robot, circle)
print(run)

# The time series of the run are read-only arrays with one row per tick.
error = run.true_pose[-1] - run.reference_pose[-1]
print(f"at the end {100 * error[0]:.1f} cm along x and {100 * error[1]:.1f} cm along y from the reference")

# Most ticks need no iterations: if no limit is active, the optimum is the solution of linear equations ("unlimited").
print("solver methods:", dict(Counter(run.solver_methods)))

# With pandas, run.to_dataframe() returns the time series as a table, with names such as true_x_m and v_ref_m_s.
