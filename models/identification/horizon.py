"""How often the controller of an identified robot is asked, and how far it looks ahead."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.velocity_model import VelocityModel

_INSTANTS = 2000
_SAME_PERIOD = 1e-4
"""Two periods that differ by less are the same [-]."""


@dataclass(frozen=True)
class Pace:
    """How often the controller is asked, and how far it looks.

    Attributes
    ----------
    sample_time
        Between two commands [s].
    every
        That in samples of the log.
    horizon
        Steps that the controller looks ahead.
    settling
        Time after which the slower channel has answered a step of its command, dead time included [s].
    """

    sample_time: float
    every: int
    horizon: int
    settling: float


def settling_time(model: VelocityModel) -> float:
    """Time after which both channels stay within a share of the end of their answers to a step [s], dead time included.

    The share stands in `settings.yaml`. A model without lag answers at once.
    """
    share = identification_settings().settled
    # Long enough for the slowest pole to leave a thousandth.
    slowest = max((-1.0 / pole.real for pole in model.poles), default=0.0)
    longest = float(np.max(model.dead_time)) + 7.0 * slowest
    if not longest > 0.0:
        return 0.0
    dt = longest / _INSTANTS
    late = 0.0
    for row, step in enumerate(np.eye(2)):
        answer = model.discretise(dt).simulate(np.tile(step, (_INSTANTS, 1)))[:, row]
        (unsettled,) = np.nonzero(np.abs(answer - model.dc_gain[row, row]) > share * abs(model.dc_gain[row, row]))
        late = max(late, dt * (unsettled[-1] + 1) if unsettled.size else 0.0)
    return late


def round_period(dt: float) -> float:
    """Sample time of a controller for samples `dt` [s] apart: the shortest number within 0.01 % of it [s].

    Times of a log jitter: their median step is 0.0500001 s where 0.05 s was meant.
    """
    rounded = (float(f"{dt:.{digits}g}") for digits in range(1, 17))
    return next((period for period in rounded if abs(period - dt) <= _SAME_PERIOD * dt), dt)


def choose_pace(model: VelocityModel, dt: float) -> Pace:
    """A horizon that sees a robot's answer to its end, from a log with samples of `dt` [s].

    A robot that is slow beside its log is asked every few samples, so that the steps stay few.
    """
    settings, settling = identification_settings(), settling_time(model)
    ahead = settings.look_ahead * settling
    every = max(1, math.ceil(ahead / (settings.most_steps * dt) - 1e-9))
    horizon = max(settings.least_steps, math.ceil(ahead / (every * dt) - 1e-9))
    return Pace(every * dt, every, horizon, settling)
