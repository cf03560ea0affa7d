"""Identify a robot from logs of its drives, and drive it with the model that was found.

The robot here is a simulated one that no shipped model fits: as over a slow radio link it answers 0.3 s later. Of your
own robot take logs with commands, wheel speeds, gyro and poses, as CSV or ROS 2 bag; `mapping="mine.yaml"` says which
column is what.
"""

from pathlib import Path

from diffdrive_mpc import Controller, identify, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.sim.log_csv import write_log

ROBOT = "model:sm+0.3"
OUT = Path("identified")

# 1. Drive with a controller that ships. It need not track well: it has to speed up, brake and turn.
for seed, trajectory in enumerate(("s", "square", "cane")):
    run = simulate(Controller(load_config("ssm")), make_plant(ROBOT, seed=seed), load_trajectory(trajectory))
    write_log(run, f"{trajectory}.csv")

# 2. From two logs to a model: "sm" has a transfer function with dead time for v, and one for omega. The third log is
#    not fitted to: the report says how well the model predicts it, and what the logs do not tell.
identified = identify(["s.csv", "square.csv"], structure="sm", validate=["cane.csv"])
print(identified)
identified.write(OUT)

# 3. Drive with it, along a path that it has not seen. The configuration that was written names the model, and has
#    limits that the logs cover.
for name in ("ssm", OUT / "config.yaml"):
    run = simulate(Controller(load_config(name)), make_plant(ROBOT, seed=7), load_trajectory("circle"))
    print(f"{name}: position RMSE {1000 * run.metrics.position_rmse_m:.1f} mm")
