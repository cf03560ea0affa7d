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

    An action is a command (2,): v [m/s], omega [rad/s]. An observation has 7 + 5 `preview` numbers of the sensors and
    the reference, see `TrackingEnv`. The reward of a tick is minus the distance of the true position from the reference
    [m]. `reset(seed=...)` repeats an episode bit for bit; without a seed each episode has other noise.

    An episode is truncated at the end of the reference. It terminates if the robot is lost or further from the
    reference than `max_error`. `info` has `time` [s] and `position_error` [m], and at the end `metrics`: the statistics
    of `bench` by name.

    Parameters
    ----------
    trajectory
        Name or path as `load_trajectory` takes it, or a trajectory.
    config
        Configuration, or its name or path: sample time and limits of the commands.
    plant, surface, sensors, scenario
        As `make_plant` takes them.
    preview
        Number of future ticks whose references are observed.
    max_error
        Position error that ends an episode [m].

    Raises
    ------
    MissingPackageError
        If gymnasium is not installed.
    ConfigError, ValueError
        If a name is unknown, a file has a mistake, or `preview` or `max_error` is out of range.
    """
    try:
        from diffdrive_mpc_extras.research.tracking_env import TrackingEnv  # noqa: PLC0415 - needs gymnasium
    except ImportError as error:
        if (error.name or "").partition(".")[0] != "gymnasium":
            raise
        raise MissingPackageError("make_env needs gymnasium: pip install 'diffdrive-mpc-extras[gym]'") from error
    place = {"name": plant, "surface": surface, "sensors": sensors, "scenario": scenario}
    return TrackingEnv(trajectory, load_config(config), place, preview=preview, max_error=max_error)
