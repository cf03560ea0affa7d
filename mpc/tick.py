"""What changes from tick to tick in the optimal control problem."""

from __future__ import annotations

from dataclasses import dataclass

from diffdrive_mpc.models.interface import FloatArray


@dataclass
class Tick:
    """The data of one optimal control problem over N steps; in C the memory of one serves all.

    Attributes
    ----------
    pose
        (3,) estimated pose now: x [m], y [m], theta [rad].
    free_twist
        (N + 1, 2) twist of the body at the samples that follows from the state, the commands already sent and the
        estimated slip, if the plan were zero [m/s, rad/s].
    gains
        (2,) twist of the body over that of the model [-].
    side_slip
        Lateral speed, outward, over v omega [s].
    reference
        (N + 1, 3) reference poses at the samples; theta unwrapped and within pi of `pose` at the first.
    heading
        (N + 1,) heading [rad] that the robot should have there: that of the reference, and a lead against side-slip.
    feed_forward
        (N, 2) commands from which deviations are penalised [m/s, rad/s].
    last_command
        (2,) the command before the plan [m/s, rad/s].
    """

    pose: FloatArray
    free_twist: FloatArray
    gains: FloatArray
    side_slip: float
    reference: FloatArray
    heading: FloatArray
    feed_forward: FloatArray
    last_command: FloatArray
