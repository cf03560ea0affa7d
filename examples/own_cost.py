"""A cost of your own: the robot keeps its distance from a person who walks across its path.

Run it with: python own_cost.py
"""

import casadi as ca
import numpy as np

from diffdrive_mpc import Controller, Term, load_config, load_trajectory, make_plant

NEAR = 0.4  # m, the robot should stay this far away from the person
WEIGHT = 6000.0  # what a metre too close costs; a metre off the path costs weights.across

# One CasADi function of what the plan does at a sample. Its inputs go by name: here the pose (x, y, theta), and stage
# parameters of our own, the person's position. Half the square of its value is added to the cost at each sample.
pose, person = ca.SX.sym("pose", 3), ca.SX.sym("parameters", 2)
too_close = ca.fmax(0, NEAR - ca.norm_2(pose[:2] - person))
keep_away = ca.Function("keep_away", [pose, person], [np.sqrt(WEIGHT) * too_close], ["pose", "parameters"], ["cost"])
FAR_AWAY = (100.0, 100.0)

config = load_config("ssm")
reference = load_trajectory("circle")
START, WALK = np.array([1.35, 1.0]), np.array([-0.12, 0.0])  # m, m/s: across the circle from outside


def least_distance(controller: Controller, *, knows: bool) -> float:
    """Drive once; returns how close the robot came to the person [m]."""
    robot = make_plant("model:ssm", seed=0)
    robot.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, robot.time)
    least = np.inf
    while robot.time < 8.0:
        if knows:
            # Where the person will be at each of the samples that the plan looks at: one row a sample.
            ahead = robot.time + config.sample_time * np.arange(config.horizon + 1)
            controller.set_parameters(keep_away=START + ahead[:, None] * WALK)
        step = controller.step(robot.time, robot.measure())
        robot.advance(step.command)
        least = min(least, np.hypot(*(robot.true_pose[:2] - START - robot.time * WALK)))
    return float(least)


without = least_distance(Controller(config), knows=False)
aware = Controller(config, terms=[Term("keep_away", keep_away, defaults=FAR_AWAY)])
print(f"least distance without the term {without:.2f} m, with it {least_distance(aware, knows=True):.2f} m")
