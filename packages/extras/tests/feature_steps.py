"""Drive a controller with a feature of `CASES` like `steps_without_imports.py`: python feature_steps.py NAME."""

import json
import sys

from steps_without_imports import drive

CASES = {
    "rehearsal": {"rehearsal.enabled": True},
    "floor": {"rehearsal.enabled": True, "rehearsal.by": "floor"},
    "free space": {"free_space.enabled": True},
    "energy": {"energy.turn_costs": "fsu_bot-default", "energy.weight": 0.01},
}


def set_obstacles(controller):
    """Set a box, if the controller has free space."""
    from diffdrive_mpc_extras.free_space import Surroundings

    if "free_space" in controller.features:
        box = [[1.2, -0.1], [1.3, -0.1], [1.3, 0.1], [1.2, 0.1]]
        controller.feature("free_space").set_obstacles(Surroundings([box]))


if __name__ == "__main__":
    sys.stdout.write(json.dumps(drive(CASES[sys.argv[1]], set_obstacles)))
