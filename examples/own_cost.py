"""Add a cost term, with which the robot keeps a distance from a person who crosses its path.

Run this example with: python own_cost.py
"""

import casadi as ca
import numpy as np

from diffdrive_mpc import Controller, Term, load_config, load_trajectory, make_plant

NEAR = 0.4  # m, desired distance from the person
WEIGHT = 6000.0  # cost per squared metre of missing distance, like weights.across for the path

# The term is a CasADi function of the plan at one sample. The names select its inputs: here the pose (x, y, theta) and
# stage parameters, the position of the person. Half of its square is added to the cost at each sample.
pose, person = ca.SX.sym("pose", 3), ca.SX.sym("parameters", 2)
too_close = ca.fmax(0, NEAR - ca.norm_2(pose[:2] - person))
keep_away = ca.Function("keep_away", [pose, person], [np.sqrt(WEIGHT) * too_close], ["pose", "parameters"], ["cost"])
FAR_AWAY = (100.0, 100.0)

config = load_config("ssm")
reference = load_trajectory("circle")
START, WALK = np.array([1.35, 1.0]), np.array([-0.12, 0.0])  # m, m/s: across the circle from outside


def min_distance(controller: Controller, *, has_term: bool) -> float:
    """Drive once and return the minimum distance between robot and person [m]."""
    robot = make_plant("model:ssm", seed=0)
    robot.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, robot.time)
    result = np.inf
    while robot.time < 8.0:
        if has_term:
            # Predicted positions of the person at the samples of the plan, one row per sample.
            ahead = robot.time + config.sample_time * np.arange(config.horizon + 1)
            controller.set_parameters(keep_away=START + ahead[:, None] * WALK)
        step = controller.step(robot.time, robot.measure())
        robot.advance(step.command)
        result = min(result, np.hypot(*(robot.true_pose[:2] - START - robot.time * WALK)))
    return float(result)


without = min_distance(Controller(config), has_term=False)
controller = Controller(config, terms=[Term("keep_away", keep_away, defaults=FAR_AWAY)])
print(
    f"minimum distance without the term {without:.2f} m, with the term {min_distance(controller, has_term=True):.2f} m"
)
