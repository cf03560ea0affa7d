"""Drive one controller of `CASES` through failures in a separate process; print the imports of its steps as JSON.

    python steps_without_imports.py NAME

The robot starts off the path, is held, and temporarily loses its pose. The return path, the failure modes and the
features of the configuration are all used.
"""

import json
import os
import subprocess
import sys

CASES = {"shipped": {}, "osqp": {"solver.method": "osqp"}, "daqp": {"solver.method": "daqp"}}
HOLD_TICKS, NO_POSE_TICKS, TICKS = range(60, 90), range(120, 160), 200


class ImportRecorder:
    """Finder that finds no module and records the requested names; loaded modules are never requested."""

    def __init__(self):
        self.requested = []

    def find_spec(self, name, path=None, target=None):
        self.requested.append(name)


def drive(settings, on_start=lambda controller: None):
    """Return the names of the modules that the steps imported, and all messages; `on_start` receives the controller."""
    from diffdrive_mpc.mpc import Controller, Hold, Measurement, load_config, load_trajectory
    from diffdrive_mpc.sim import make_plant

    controller, reference = Controller(load_config("ssm", settings)), load_trajectory("circle")
    robot, dt = make_plant("model:ssm+0.08"), controller.config.sample_time
    start = reference.sample([0.0]).pose[0] + [-0.1, 0.15, 0.0]
    robot.reset(start)
    controller.start(reference, 0.0)
    on_start(controller)
    recorder, messages = ImportRecorder(), []
    for tick in range(TICKS):
        measurement = Measurement() if tick in NO_POSE_TICKS else robot.measure()
        hold = Hold("a test") if tick in HOLD_TICKS else None
        sys.meta_path.insert(0, recorder)
        result = controller.step(tick * dt, measurement, hold)
        sys.meta_path.remove(recorder)
        messages.append(result.message)
        robot.advance(result.command)
    return {"imported": recorder.requested, "messages": messages}


def check_steps(program, name):
    """Run a program that prints the result of `drive`; check that its steps ran all branches and imported no module."""
    path = os.pathsep.join(filter(None, sys.path))
    arguments, environment = [sys.executable, str(program), name], os.environ | {"PYTHONPATH": path}
    result = subprocess.run(arguments, capture_output=True, text=True, check=True, env=environment)
    steps = json.loads(result.stdout)
    assert steps["imported"] == []
    for part in ("rejoining", "no pose was accepted", "a test"):
        assert any(part in message for message in steps["messages"])


if __name__ == "__main__":
    sys.stdout.write(json.dumps(drive(CASES[sys.argv[1]])))
