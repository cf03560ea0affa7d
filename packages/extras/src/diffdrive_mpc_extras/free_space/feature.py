"""Corridors and obstacles, attached to a controller."""

from __future__ import annotations

import math
from dataclasses import dataclass

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.features.feature import Feature, Host
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.problem.terms import Term, half_space_function, parameter_places
from diffdrive_mpc.mpc.step_result import StepResult
from diffdrive_mpc_extras.free_space.config import FreeSpace
from diffdrive_mpc_extras.free_space.keeper import FreeSpaceKeeper
from diffdrive_mpc_extras.free_space.surroundings import Surroundings

# The rows of free space among the soft limits: one shipped term for each, whose C comes with the core.


_ANYWHERE = (0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class ShippedTerm(Term):
    """A term whose function is in the compiled library.

    Attributes
    ----------
    symbol
        Its name there.
    """

    symbol: str = ""


def half_space_terms(config: FreeSpace) -> tuple[ShippedTerm, ...]:
    """The rows of a configuration; none unless it is enabled."""
    if not config.enabled:
        return ()
    function = half_space_function()
    return tuple(
        ShippedTerm(f"free_space_{row}", function, "soft", 0.0, None, _ANYWHERE, symbol="ddmpc_f_half_space")
        for row in range(config.rows)
    )


class KeepClear(Feature):
    """See `Feature`."""

    def __init__(self, config: ControllerConfig, model: VelocityModel | NonlinearModel) -> None:
        super().__init__(config, model)
        self._sent: FloatArray | None = None

    @classmethod
    def terms(cls, config: ControllerConfig) -> tuple[Term, ...]:
        """See `Feature`."""
        return half_space_terms(config.free_space)

    def attach(self, host: Host) -> None:
        """See `Feature`."""
        super().attach(host)
        self._keeper = FreeSpaceKeeper(host.config, host.tick, parameter_places(host.terms)["free_space_0"].start)

    def configure(self) -> None:
        """See `Feature`."""
        self._keeper.configure(self.host.config)

    def set_obstacles(self, surroundings: Surroundings | None) -> None:
        """Keep clear of them from the next step on; raises SurroundingsError where they cannot be used."""
        self._keeper.set_obstacles(surroundings)

    def lay(self, reference: Reference) -> Reference:
        """See `Feature`: moved aside where something is in its way."""
        return self._keeper.start(reference)

    def forget(self) -> None:
        """See `Feature`."""
        self._keeper.forget()

    def before_step(self, t: float) -> Hold | None:
        """Let the reference go round things, wait for them, or stop."""
        keeper, pursuit = self._keeper, self.host.pursuit
        self._sent = self.host.tick.last_command
        reference, since_start, time = pursuit.reference, t - self.host.t0, pursuit.time
        if reference is None or not math.isfinite(since_start):
            return None
        now = since_start if not math.isfinite(time) else min(since_start, time + self.host.config.sample_time)
        hold = keeper.before(t, now, reference)
        pursuit.pace, pursuit.room = keeper.pace, keeper.room
        return hold

    def after_step(self, t: float, measurement: Measurement, result: StepResult) -> StepResult:
        """Check the way to rest, where the tick is a new one."""
        del measurement
        if self._sent is None:
            return result
        if not self.host.is_new_tick():
            return self._keeper.again(result)
        kept = self._keeper.after(t, result, self._sent)
        if kept.mode is not result.mode:
            self.host.pursuit.stand()
        return kept


FEATURE = KeepClear
