"""From torques against radius back to a terrain: Ordonez et al., 2017 (P4), equation 24."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.terrain.terrain_file import Shear, Terrain
from diffdrive_mpc_extras.terrain.turning import side_torques
from diffdrive_mpc_extras.turn_costs.vehicle import Vehicle

# From, to and first guess of mu and of K [m]: ice to rubber on stone, stiff to soft tyres.
_FRICTION, _MODULUS = (0.02, 3.0, 0.6), (1e-6, 0.05, 1e-3)
_LEAST_ROWS = 3
# A value within a hundredth of an end of its range is at that end.
_NEAR = 0.01
# A value whose deviation is more than this share of it is not told.
_TOLD = 0.2
# Pull towards where the search begins, over the greatest torque: it decides only what torques do not.
_PULL = 2e-3


class FittedShear(NamedTuple):
    """What was found."""

    shear: Shear
    drag_torque: float
    """[N m] of a side; that of the vehicle where it was not asked for"""
    rms: float
    """What remains, over both sides [N m]"""
    deviation: dict[str, float]
    """Standard deviation of each value over itself, by its name; large where the torques hardly tell it"""
    at_bound: tuple[str, ...]
    """Names of values that ended at an end of where they were looked for: the torques do not tell them"""

    @property
    def untold(self) -> tuple[str, ...]:
        """Names of values that the torques do not tell, alone: where nothing slides, friction over modulus is all."""
        return tuple(name for name, one in self.deviation.items() if one > _TOLD or name in self.at_bound)

    def on(self, terrain: Terrain) -> Terrain:
        """`terrain` with this shear law."""
        return terrain.model_copy(update={"shear": self.shear})


def fit_shear(
    vehicle: Vehicle,
    terrain: Terrain,
    radius: ArrayLike,
    speed: ArrayLike,
    outer: ArrayLike,
    inner: ArrayLike,
    *,
    with_drag: bool = False,
    one_friction: bool = False,
) -> FittedShear:
    """Friction and shear modulus, and the drag on request, that give the torques (n,) best in the least-squares sense.

    Parameters
    ----------
    vehicle, terrain
        Under what the torques were measured or learned; of the terrain only the slip law is used.
    radius, speed
        (n,) commanded [m, counter-clockwise positive], [m/s].
    outer, inner
        (n,) torques of the sides [N m].
    with_drag
        Whether the vehicle's drag torque is found, too.
    one_friction
        Whether both sides have one coefficient. In a steady turn the tractions of the sides are nearly equal and
        opposite, so two coefficients are told apart by the moment's yaw rate alone: with a measured slip law, not
        without.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there are less than three radii, or something is not finite.
    """
    from scipy.optimize import least_squares  # noqa: PLC0415 - loads slowly

    columns = np.broadcast_arrays(*(np.asarray(one, dtype=float) for one in (radius, speed, outer, inner)))
    radii, speeds, outside, inside = (np.atleast_1d(column) for column in columns)
    if len(radii) < _LEAST_ROWS:
        raise ConfigError(f"{len(radii)} radii: three values are to be found, so give {_LEAST_ROWS} or more")
    if not all(np.isfinite(one).all() for one in (speeds, outside, inside)):
        raise ConfigError("speeds and torques: all have to be finite numbers")
    names = [
        *(["mu"] if one_friction else ["mu_outer", "mu_inner"]),
        "modulus",
        *(["drag_torque"] if with_drag else []),
    ]
    most_drag = max(1e-6, float(np.abs([outside, inside]).max()))
    ranges = {"modulus": _MODULUS, "drag_torque": (1e-6 * most_drag, most_drag, 0.1 * most_drag)}
    low, high, start = np.log([ranges.get(name, _FRICTION) for name in names]).T

    def built(logs: FloatArray) -> tuple[Vehicle, Terrain]:
        values = dict(zip(names, np.exp(logs).tolist(), strict=True))
        drag, both = values.pop("drag_torque", vehicle.drag_torque), values.pop("mu", None)
        shear = Shear(**({} if both is None else {"mu_outer": both, "mu_inner": both}), **values)
        return vehicle.model_copy(update={"drag_torque": drag}), terrain.model_copy(update={"shear": shear})

    def missing(logs: FloatArray) -> FloatArray:
        torques = side_torques(*built(logs), radii, speeds)
        return np.concatenate([torques.outer - outside, torques.inner - inside, pull * (logs - start)])

    pull = _PULL * most_drag
    # A difference of a thousandth is far above what the balance leaves.
    best = least_squares(missing, start, bounds=(low, high), diff_step=1e-3, x_scale=1.0)
    on, ground = built(best.x)
    ends = (best.x - low < _NEAR) | (high - best.x < _NEAR)
    at_bound = tuple(name for name, end in zip(names, ends.tolist(), strict=True) if end)
    count = 2 * len(radii)
    rms, slope = float(np.sqrt(np.mean(best.fun[:count] ** 2))), best.jac[:count]
    # The pull is left out of what the torques tell; a value that they do not touch has no finite deviation.
    inverse_normal = np.linalg.pinv(slope.T @ slope + 1e-12 * np.trace(slope.T @ slope) * np.eye(len(names)))
    spread = rms * np.sqrt(np.diag(inverse_normal))
    deviation = dict(zip(names, spread.tolist(), strict=True))
    return FittedShear(ground.known_shear(), on.drag_torque, rms, deviation, at_bound)
