"""The first drive of an identified configuration on the robot: a slow circle, and a recipe in the report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from diffdrive_mpc.app.identification.trial_drives import TrialDrive, trial_doubts
from diffdrive_mpc.models.identification.node_parameters import node_arguments
from diffdrive_mpc.models.logs.record import Topics
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import ControllerConfig

FIRST_CIRCLE = "first_circle.yaml"
_SHARE = 0.3
"""Of the speeds that the robot reaches [-]: slow enough to walk beside, fast enough to leave its dead band."""
_FASTEST = 0.5
"""A walk [m/s], whatever the robot could do."""
_ROOM = 2.0
"""Free space over the size of the circle [-]."""


@dataclass(frozen=True)
class FirstCircle:
    """One turn to the left, slowly.

    Attributes
    ----------
    radius
        That of the shipped circle, times the robot's track over that of the papers' robot [m].
    v, omega
        Speeds [m/s], [rad/s].
    """

    radius: float
    v: float
    omega: float

    @property
    def duration(self) -> float:
        """Of one turn [s]."""
        return 2.0 * math.pi / self.omega

    def text(self) -> str:
        """The trajectory file."""
        return (
            f"# One turn to the left, {self.radius:.3g} m in radius, at {_SHARE:g} of what the robot can, or a walk.\n"
            "name: first circle\n"
            "segments:   # v [m/s], omega [rad/s], duration [s]\n"
            f"  - {{v: {self.v:.6g}, omega: {self.omega:.6g}, duration: {self.duration:.6g}}}\n"
        )


def first_circle(config: ControllerConfig, model: VelocityModel | NonlinearModel) -> FirstCircle:
    """The circle for a robot with these limits and gains."""
    radius = config.wheels.encoder_track / load_robot().track
    v_gain, omega_gain = abs(model.dc_gain[0, 0]), abs(model.dc_gain[1, 1])
    reached = min(
        v_gain * config.limits.v / radius, omega_gain * config.limits.omega, config.limits.wheel_speed / radius
    )
    omega = float(min(_SHARE * reached, _FASTEST / radius))
    return FirstCircle(radius, radius * omega, omega)


def recipe(circle: FirstCircle, config: ControllerConfig, drives: Sequence[TrialDrive], topics: Topics) -> str:
    """How to drive the robot for the first time, as the end of the report; `topics` are those of a bag."""
    room = _ROOM * 2.0 * circle.radius
    arguments = f" {node_arguments(topics)}" if topics else ""
    steps = [
        "Read the warnings that matter for driving, and mend what can be mended.",
        "Drive it here first, in the folder of this report: `diffdrive-mpc simulate --config config.yaml "
        f"--plant model:model.yaml --surface surface.yaml --trajectory {FIRST_CIRCLE}`. It is a circle of "
        f"{circle.radius:.2g} m in radius at {circle.v:.2g} m/s, one turn in {circle.duration:.0f} s.",
        "Wheels off the ground: start the node, look that no topic is refused, call start. Both sides must turn as "
        "told, and the base must stop by itself when the node is killed (docs/robot.md, step 4).",
        f"On the floor, {room:.2g} m free all round, a hand on the emergency stop: `diffdrive-mpc node --config "
        f"config.yaml --trajectory {FIRST_CIRCLE}{arguments}` with the topics of the robot (docs/robot.md, step 5).",
        "Look at the mode, which stays TRACKING, at the lateral error, a few centimetres and not growing, and at "
        "the message, which is empty or says what is wrong (docs/failure.md).",
        f"Stop it if it weaves more and more, turns the wrong way, or is further than {config.reentry.band:.2g} m "
        "beside the circle for longer than a second.",
        "Then faster, a little at a time; then paths with corners. New floor or load: a new log.",
    ]
    if trial_doubts(drives):
        steps.insert(0, "Not yet: it does not drive all paths above. Mend that first.")
    return "## The first drive on the robot\n\n" + "".join(f"{i}. {step}\n" for i, step in enumerate(steps, 1))
