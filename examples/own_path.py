"""Drive along your own path, from timed positions or from waypoints.

A trajectory states where the robot should be at each instant. `from_arrays` takes timed poses; `from_waypoints` takes
points without times, rounds the corners and chooses the speed.
"""

import numpy as np

from diffdrive_mpc import Trajectory, simulate

# 1. A Lissajous curve as timed positions. Heading and twist follow from the positions. The time is warped so that the
#    robot starts and ends at rest.
duration = 30.0  # s
t = np.linspace(0.0, duration, 601)
phase = 2 * np.pi * (t / duration - np.sin(2 * np.pi * t / duration) / (2 * np.pi))
curve = Trajectory.from_arrays(t, 2.0 * np.sin(phase), np.sin(2 * phase), name="lissajous")

# 2. Corners of a corridor [m], driven at 0.4 m/s at most. The path stays within 10 cm of the straight lines.
corridor = Trajectory.from_waypoints(
    [(0.0, 0.0), (3.0, 0.0), (3.0, 2.0), (5.0, 2.0)], speed=0.4, max_deviation=0.1, name="corridor"
)

for path in (curve, corridor):
    run = simulate("ssm", "model:ssm", path)
    print(f"{path}: position RMSE {1000 * run.metrics.position_rmse_m:.1f} mm, completed: {run.metrics.completed}")

# Samples for your own code: pose, twist and arc length at any time.
end = corridor.sample([corridor.duration]).pose[0]
print(f"the corridor ends at x = {end[0]:.2f} m, y = {end[1]:.2f} m")
