"""`make_env`: path tracking on the simulated robot with the Gymnasium API."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from diffdrive_mpc.models.errors import MissingPackageError, checked_call
from diffdrive_mpc.mpc import ControllerConfig, Trajectory, load_config

if TYPE_CHECKING:
    from diffdrive_mpc_extras.research.tracking_env import TrackingEnv


@checked_call()
def make_env(
    trajectory: str | Path | Trajectory = "circle",
    config: str | Path | ControllerConfig = "ssm",
    *,
    plant: str = "mujoco",
    surface: str | Path = "default",
    sensors: str | Path = "default",
    scenario: str | Path = "none",
    preview: int = 10,
    max_error: float = 1.0,
) -> TrackingEnv:
    """Make an environment in which an agent tracks a trajectory.

    An action is a command (2,): v [m/s], omega [rad/s]. An observation has 7 + 5 `preview` values from the sensors and
    the reference, see `TrackingEnv`. The reward of a tick is the negative distance of the true position from the
    reference [m]. `reset(seed=...)` repeats an episode bit for bit; without a seed, the noise of each episode differs.

    An episode is truncated at the end of the reference. It terminates if the robot is lost or further from the
    reference than `max_error`. `info` has `time` [s] and `position_error` [m]; at the end it also has `metrics`, the
    statistics of `bench` by name.

    Parameters
    ----------
    trajectory
        Trajectory, or name or path as for `load_trajectory`.
    config
        Configuration with sample time and command limits, or its name or path.
    plant, surface, sensors, scenario
        Arguments of `make_plant`.
    preview
        Number of future ticks of the reference in an observation.
    max_error
        Position error that ends an episode [m].

    Raises
    ------
    MissingPackageError
        If gymnasium is not installed.
    ConfigError, ValueError
        If a name is unknown, a file is invalid, or `preview` or `max_error` is out of range.
    """
    try:
        from diffdrive_mpc_extras.research.tracking_env import TrackingEnv  # noqa: PLC0415 - needs gymnasium
    except ImportError as error:
        if (error.name or "").partition(".")[0] != "gymnasium":
            raise
        raise MissingPackageError("make_env needs gymnasium: pip install 'diffdrive-mpc-extras[gym]'") from error
    plant_options = {"name": plant, "surface": surface, "sensors": sensors, "scenario": scenario}
    return TrackingEnv(trajectory, load_config(config), plant_options, preview=preview, max_error=max_error)
