"""Feature of a controller that keeps clear of corridors and obstacles."""

from __future__ import annotations

import math

from diffdrive_mpc import Term
from diffdrive_mpc.core_sources import parameter_places
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.features.feature import Feature, Host
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.step_result import StepResult
from diffdrive_mpc_extras.free_space.config import FreeSpace, free_space_of
from diffdrive_mpc_extras.free_space.keeper import FreeSpaceKeeper
from diffdrive_mpc_extras.free_space.pieces import half_space_function, load_free_space
from diffdrive_mpc_extras.free_space.surroundings import Surroundings

_NO_LIMIT = (0.0, 0.0, 0.0, 0.0, 1.0)
"""Parameters of a half-space that contains every point."""


def half_space_terms(config: FreeSpace) -> tuple[Term, ...]:
    """Return the half-space terms of a configuration; empty if free space is not enabled."""
    if not config.enabled:
        return ()
    function, (ffi, lib) = half_space_function(), load_free_space()
    compiled = ffi.addressof(lib, "ddmpc_f_half_space")
    return tuple(
        Term(f"free_space_{row}", function, "soft", 0.0, None, _NO_LIMIT, compiled) for row in range(config.rows)
    )


class KeepClear(Feature):
    """Feature that keeps clear of the surroundings; methods as in `Feature`."""

    schema = FreeSpace

    def __init__(self, config: ControllerConfig, model: VelocityModel | NonlinearModel) -> None:
        super().__init__(config, model)
        self._sent: FloatArray | None = None

    @classmethod
    def terms(cls, config: ControllerConfig) -> tuple[Term, ...]:
        """Build the terms as `Feature` describes."""
        return half_space_terms(free_space_of(config))

    def attach(self, host: Host) -> None:
        """Attach as `Feature` describes."""
        super().attach(host)
        self._keeper = FreeSpaceKeeper(host.config, host.tick, parameter_places(host.terms)["free_space_0"].start)

    def configure(self) -> None:
        """Configure as `Feature` describes."""
        self._keeper.configure(self.host.config)

    def set_obstacles(self, surroundings: Surroundings | None) -> None:
        """Replace the surroundings from the next step on; raises SurroundingsError if they are invalid."""
        self._keeper.set_obstacles(surroundings)

    def modify_reference(self, reference: Reference) -> Reference:
        """Return the reference with the offsets that lead around obstacles."""
        return self._keeper.start(reference)

    def reset(self) -> None:
        """Reset as `Feature` describes."""
        self._keeper.forget()

    def before_step(self, t: float) -> Hold | None:
        """Plan the reference around obstacles, slow it down, or return a reason to stop."""
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
        """Check the stopping path of a new tick; repeat the checked result for a repeated call."""
        del measurement
        if self._sent is None:
            return result
        if not self.host.is_new_tick():
            return self._keeper.again(result)
        checked = self._keeper.after(t, result, self._sent)
        if checked.mode is not result.mode:
            self.host.pursuit.stand()
        return checked
