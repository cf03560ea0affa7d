"""Drives one controller of `CASES` through failures in a process of its own; prints as JSON what its steps imported.

    python steps_without_imports.py NAME

The robot begins beside the path, is held, and loses its pose for a while: the way back, the failure ladder and what the
configuration enables all run.
"""

import json
import os
import subprocess
import sys

CASES = {
    "shipped": {},
    "osqp": {"solver.method": "osqp"},
    "daqp": {"solver.method": "daqp"},
}
HELD, LOST, TICKS = range(60, 90), range(120, 160), 200


class Watch:
    """A finder that finds nothing and notes what is looked for: modules that are loaded already never come here."""

    def __init__(self):
        self.wanted = []

    def find_spec(self, name, path=None, target=None):
        self.wanted.append(name)


def drive(settings, started=lambda controller: None):
    """Return the names of the modules that the steps imported, and every message; `started` gets the controller."""
    from diffdrive_mpc.mpc import Controller, Hold, Measurement, load_config, load_trajectory
    from diffdrive_mpc.sim import make_plant

    controller, reference = Controller(load_config("ssm", settings)), load_trajectory("circle")
    robot, dt = make_plant("model:ssm+0.08"), controller.config.sample_time
    start = reference.sample([0.0]).pose[0] + [-0.1, 0.15, 0.0]
    robot.reset(start)
    controller.start(reference, 0.0)
    started(controller)
    watch, messages = Watch(), []
    for tick in range(TICKS):
        measurement = Measurement() if tick in LOST else robot.measure()
        hold = Hold("a test") if tick in HELD else None
        sys.meta_path.insert(0, watch)
        result = controller.step(tick * dt, measurement, hold)
        sys.meta_path.remove(watch)
        messages.append(result.message)
        robot.advance(result.command)
    return {"imported": watch.wanted, "messages": messages}


def check_steps(program, name):
    """Run a program that prints what `drive` returns; check that its steps ran all branches and imported nothing."""
    path = os.pathsep.join(filter(None, sys.path))
    words, environment = [sys.executable, str(program), name], os.environ | {"PYTHONPATH": path}
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=environment)
    steps = json.loads(done.stdout)
    assert steps["imported"] == []
    for part in ("rejoining", "no pose was accepted", "a test"):
        assert any(part in message for message in steps["messages"])


if __name__ == "__main__":
    sys.stdout.write(json.dumps(drive(CASES[sys.argv[1]])))
