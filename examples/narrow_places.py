"""Drive between posts and through a doorway, wait for a person who crosses the path, and draw the drive.

Polygons and discs represent the obstacles; on a robot, use a costmap. The doorway is 0.10 m wider than the robot.
packages/extras/docs/worlds.md describes clearances and messages.
"""

from pathlib import Path

import matplotlib as mpl
import numpy as np

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant
from diffdrive_mpc_extras.free_space import MovingDisc, Surroundings

mpl.use("Agg")
import matplotlib.pyplot as plt

OUTLINE = np.array([[0.25, 0.2], [-0.25, 0.2], [-0.25, -0.2], [0.25, -0.2]])
BOXES = [(1.4, -0.05, 0.12, 0.12), (2.7, -0.1, 0.12, 0.12), (4.5, 0.25, 0.15, 1.2), (4.5, -1.45, 0.15, 1.2)]
OBSTACLES = [np.array([[x, y], [x + a, y], [x + a, y + b], [x, y + b]]) for x, y, a, b in BOXES]


def person(t):
    return MovingDisc(6.2, -4.0 + 0.25 * t, 0.25, 0.0, 0.25)


Path("straight.yaml").write_text("segments: [{v: 0.4, omega: 0.0, duration: 20.0}]\n")
reference = load_trajectory("straight.yaml")
settings = {"free_space.enabled": True, "free_space.footprint": str(OUTLINE.tolist()), "free_space.margin": 0.015}
controller, robot = Controller(load_config("ssm", settings)), make_plant("model:ssm", seed=1)
robot.reset(reference.sample([0.0]).pose[0])
controller.start(reference, robot.time)

poses, last_message = [], ""
while robot.time < 60.0:
    controller.feature("free_space").set_obstacles(Surroundings(OBSTACLES, [person(robot.time)], time=robot.time))
    step = controller.step(robot.time, robot.measure())
    if step.mode == "STOPPED" and step.message != last_message:
        print(f"{robot.time:5.1f} s: {step.message}")
        last_message = step.message
    robot.advance(step.command)
    poses.append(robot.true_pose)
    if step.mode == "FINISHED":
        break
print(f"at x = {poses[-1][0]:.2f} m after {robot.time:.1f} s")

figure, axes = plt.subplots(figsize=(10, 3.6))
for obstacle in OBSTACLES:
    axes.fill(*obstacle.T, color="0.4")
for pose in poses[::45]:
    turn = np.array([[np.cos(pose[2]), np.sin(pose[2])], [-np.sin(pose[2]), np.cos(pose[2])]])
    axes.fill(*(OUTLINE @ turn + pose[:2]).T, facecolor="none", edgecolor="tab:blue", linewidth=0.7)
axes.plot(*np.array(poses)[:, :2].T, color="tab:blue")
for t in range(12, 20):
    axes.add_patch(plt.Circle((6.2, person(t).y), 0.25, color="tab:orange", alpha=0.25))
axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", xlim=(-0.5, 8.6), ylim=(-1.5, 1.5))
figure.savefig("narrow-places.png", dpi=110, bbox_inches="tight")
