"""Identify a robot from logs of its drives, and drive it with the identified model.

The simulated robot has an additional delay of 0.3 s, like that of a slow radio link, so no shipped model fits. For your
own robot, use CSV files or ROS 2 bags with commands, wheel speeds, gyro and poses; `mapping="mine.yaml"` assigns the
columns.
"""

from pathlib import Path

from diffdrive_mpc import Controller, identify, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.sim.log_csv import write_log

ROBOT = "model:sm+0.3"
OUT = Path("identified")

# 1. Drive with a shipped configuration. The tracking need not be accurate; the robot must accelerate, brake and turn.
for seed, trajectory in enumerate(("s", "square", "cane")):
    run = simulate(Controller(load_config("ssm")), make_plant(ROBOT, seed=seed), load_trajectory(trajectory))
    write_log(run, f"{trajectory}.csv")

# 2. Identify a model from two logs: "sm" has a transfer function with dead time for v, and one for omega. The report
#    contains the quality of the prediction of the third log, and parameters that the logs do not determine.
identified = identify(["s.csv", "square.csv"], structure="sm", validate=["cane.csv"])
print(identified)
identified.write(OUT)

# 3. Drive with the identified model along a path that is not in the logs. The written configuration contains the model
#    and limits that are within the range of the logs.
for name in ("ssm", OUT / "config.yaml"):
    run = simulate(Controller(load_config(name)), make_plant(ROBOT, seed=7), load_trajectory("circle"))
    print(f"{name}: position RMSE {1000 * run.metrics.position_rmse_m:.1f} mm")
