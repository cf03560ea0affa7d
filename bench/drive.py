"""`diffdrive_mpc.simulate`: closed loop that also accepts names and files instead of objects."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diffdrive_mpc.models.errors import ArgumentError, checked_call, wrong_type
from diffdrive_mpc.models.interface import Reference, TrackingController
from diffdrive_mpc.models.robot import TwistBounds, load_robot
from diffdrive_mpc.models.table import escape
from diffdrive_mpc.models.two_sided import sides_of
from diffdrive_mpc.mpc import Controller, ControllerConfig, load_trajectory
from diffdrive_mpc.mpc.trajectories.load import BUILT_IN
from diffdrive_mpc.sim import loop
from diffdrive_mpc.sim.plants.make import make_plant
from diffdrive_mpc.sim.plants.names import PHYSICS

if TYPE_CHECKING:
    from diffdrive_mpc.models.nonlinear_model import NonlinearModel
    from diffdrive_mpc.models.velocity_model import VelocityModel
    from diffdrive_mpc.sim.plants.plant import Plant
    from diffdrive_mpc.sim.run import Run

_PLANT_SCALE = 0.05
"""Maximum difference of the encoder scale of a simulated robot from one [-]."""
_ORDER = "the order is simulate(controller, plant, reference)"


@checked_call(
    seed="a plant takes it: make_plant('mujoco', seed=1)", model="a controller takes it: Controller('ssm', model=model)"
)
def simulate(
    controller: TrackingController | ControllerConfig | str | Path | Mapping[str, object],
    plant: Plant | VelocityModel | NonlinearModel | str | Path,
    reference: Reference | str | Path,
    *,
    extra_time: float = 0.0,
    keep_plans: bool = False,
    lean: bool = False,
    on_tick: Callable[[int, int], None] | None = None,
) -> Run:
    """Drive `plant` along `reference` from rest, for example `simulate("ssm", "mujoco", "circle")`.

    Parameters
    ----------
    controller
        Object with the methods `start` and `step`, a configuration, or an argument of `load_config`, such as "ssm". A
        controller of an earlier drive keeps only what its features learned, which `controller.reset()` clears.
    plant
        Simulated robot, which is reset first, or an argument of `make_plant`, such as "mujoco" or a velocity model. A
        plant created from such an argument has the sample time, limits and sensors of the controller's configuration.
        To set its seed or sensors, pass `make_plant(name, seed=..., sensors=...)`.
    reference
        Timed trajectory, or an argument of `load_trajectory`, such as "circle", which is loaded with the limits of
        the controller's configuration.
    extra_time, keep_plans, lean, on_tick
        Arguments of `sim.loop.simulate`: duration of the run after the end of the trajectory [s], whether the run
        stores the plans, whether it omits measurements and computation times and runs in C if possible, and a function
        that is called after each tick with the number of completed ticks and the total number.

    Returns
    -------
    Run
        See `sim.loop.simulate`. A warning states where the reference exceeds the limits of the robot.

    Raises
    ------
    ArgumentError
        If an argument has the wrong type, or the arguments are in the wrong order.
    ConfigError, ModelError, ValueError
        If a name is unknown, a file is invalid, or the arguments do not match each other.
    """
    _check_names({"controller": controller, "plant": plant, "trajectory": reference})
    if isinstance(controller, (ControllerConfig, str, Path, Mapping)):
        controller = Controller(controller)
    _check(controller, ("start", "step"), "controller", "a Controller", "Controller('ssm', model=model) takes a model")
    config = getattr(controller, "config", None)
    config = config if isinstance(config, ControllerConfig) else None
    if not loop.has_members(plant, _PLANT):
        if not isinstance(plant, (str, Path)) and not hasattr(plant, "with_extra_dead_time"):
            _check(plant, _PLANT + loop.PLANT_STATE, "plant", "a plant or its name")
        plant = make_plant(plant, **(plant_settings(config) if config else {}))  # type: ignore[arg-type]
    if isinstance(reference, (str, Path)):
        reference = load_trajectory(reference, config)
    remedy = "create one with Trajectory.from_arrays(t, x, y)"
    _check(reference, ("sample", "duration"), "reference", "a trajectory or its name", remedy)
    if isinstance(controller, Controller) and (shortfall := controller.find_shortfall(reference)):
        warnings.warn(escape(str(shortfall)), stacklevel=3)
    # The arguments are checked above.
    return loop.simulate(
        controller,
        plant,  # type: ignore[arg-type]
        reference,
        extra_time=extra_time,
        keep_plans=keep_plans,
        lean=lean,
        on_tick=on_tick,
    )


def plant_settings(config: ControllerConfig) -> dict[str, Any]:
    """Return sample time, limits and sensor readings of a controller's plant as arguments of `make_plant`."""
    standard = load_robot().limits
    # A robot with higher limits than the papers' robot must not be limited to the range of the latter's serial link.
    bounds = {name: max(*sides_of(getattr(config.limits, name)), getattr(standard, name)) for name in ("v", "omega")}
    readings = sensor_readings(config)
    return {"sample_time": config.sample_time, "limits": TwistBounds(**bounds), "readings": readings}


def sensor_readings(config: ControllerConfig) -> dict[str, dict[str, Any]]:
    """Return values of the default sensor set with which the sensors have the errors that `sensors` corrects.

    Late poses are stamped on arrival. Late speeds are not simulated, nor small encoder scales, which plants have.
    """
    wheels, gyro, pose = config.sensors.wheels, config.sensors.yaw_rate, config.sensors.pose
    side = wheels.sign * (wheels.scale if abs(wheels.scale - 1.0) > _PLANT_SCALE else 1.0)
    late = {"latency": pose.delay, "stamped_on_arrival": True} if pose.delay else {}
    return {
        "pose": {"turned": pose.heading, **late},
        "gyro": {"scale": gyro.sign * gyro.scale},
        "encoders": {"left": side, "right": side, "swapped": wheels.sign != wheels.turn_sign},
    }


def odometry_correction(readings: Mapping[str, Mapping[str, Any]]) -> tuple[float, float]:
    """Return the ratios of the readings of wheels and gyro to the motion, from the values of `sensor_readings`."""
    return readings["encoders"]["left"], readings["gyro"]["scale"]


_PLANT = ("sample_time", "reset", "measure", "advance")
"""Members of a plant before its first reset, see `sim.plants.plant.Plant`."""


def _check_names(arguments: Mapping[str, object]) -> None:
    """Raise ArgumentError if an argument is a built-in name of another kind; `arguments` are the arguments by kind."""
    for kind, names in {"plant": (PHYSICS,), "trajectory": BUILT_IN}.items():
        for argument, value in arguments.items():
            if isinstance(value, str) and value in names and argument != kind:
                raise ArgumentError(f"simulate: '{value}' is the name of a {kind}, given as the {argument}; {_ORDER}")


def _check(value: object, names: tuple[str, ...], argument: str, expected: str, remedy: str = "") -> None:
    """Raise ArgumentError with the `remedy` if `value` lacks an attribute in `names`."""
    if not loop.has_members(value, names):
        missing = ", ".join(name for name in names if not hasattr(value, name))
        remedies = (missing and f"it lacks {missing}", remedy, _ORDER)
        raise wrong_type(argument, expected, value, "; ".join(filter(None, remedies)))
