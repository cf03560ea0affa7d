"""Simulated drives with the identified configuration, on its model and on a model of the validation data."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from diffdrive_mpc.bench.drive import sensor_readings
from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.checked_yaml import StrictModel, check, load_checked
from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.identification import Identification
from diffdrive_mpc.models.identification.deliver.configuration import node_arguments
from diffdrive_mpc.models.identification.fit.fitting import Fitted
from diffdrive_mpc.models.identification.log_data import LogData, most_informative
from diffdrive_mpc.models.logs.record import Topics
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.output_error.input_limits import limits_in
from diffdrive_mpc.models.robot import Positive, TwistBounds, load_robot
from diffdrive_mpc.models.slip_laws import POLYNOMIAL
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.structures.structure import IdentificationConditions
from diffdrive_mpc.models.table import TextTable, number
from diffdrive_mpc.models.velocity_model import ModelError, VelocityModel
from diffdrive_mpc.mpc import Controller, ControllerConfig
from diffdrive_mpc.mpc.trajectories.moved import scaled_to_robot
from diffdrive_mpc.sim import Metrics, Run, simulate
from diffdrive_mpc.sim.plants.identified_robot import UnexplainedMotion
from diffdrive_mpc.sim.plants.make import model_robot
from diffdrive_mpc.sim.plants.model_plant import ModelPlant
from diffdrive_mpc.sim.plants.surface import BodySlip, Polynomial, Surface
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet, load_sensor_set

PATHS = ("circle", "square", "s", "cane")
ITSELF, HELD_OUT = "model itself", "held-out model"
UNEXPLAINED = "the model with its unexplained motion"
Share = Annotated[float, Field(gt=0, le=1)]
_NOTE = (
    "Paths are scaled to size and limits of the robot; lateral errors are relative to the radius of the scaled circle: "
    "below {:g} % is good. Drives on the model itself test whether configuration and model are consistent. The "
    "held-out model has another structure and is fitted to the held-out data; drives on it test whether the result "
    "depends on the part of the log or on the structure. Neither includes the surface: start slowly, with free space."
)


class TrialSettings(StrictModel):
    """Requirements of the trial drives, and reductions of the limits after a failure."""

    lateral_share: Positive = Field(description="maximum ratio of lateral error to radius of the scaled circle [-]")
    shares: tuple[tuple[Share, Share], ...] = Field(
        description="shares of limits.v and limits.omega after a failure, in descending order [-]"
    )
    curved: tuple[str, ...] = Field(description="paths without corners, on which the expected performance is based")
    window: Positive = Field(description="averaging window of the unexplained motion [s]")
    noise_speed: Positive = Field(description="maximum apparent speed due to noise of the poses [m/s]")
    unexplained: int = Field(ge=1, description="number of drives with unexplained motion on these paths")
    lost_share: Share = Field(description="maximum share of these drives that do not arrive [-]")
    mean_share: Share = Field(description="maximum geometric mean of their ratios of lateral error to radius [-]")
    promise_factor: Positive = Field(
        description="ratio of expected maximum error to geometric mean of these drives [-]"
    )
    stand_in_order: int = Field(ge=1, description="order of the SSM that replaces an SM or MBM in the held-out model")
    stand_in_rows: int = Field(ge=1, description="maximum number of validation rows for the fit of the held-out model")


@cache
def trial_settings() -> TrialSettings:
    """Load `trial_drives.yaml`; raise ConfigError if the file is invalid."""
    return load_checked(TrialSettings, Path(__file__).with_name("trial_drives.yaml"))


@dataclass(frozen=True)
class TrialDrive:
    """Simulated drive of a stand-in for the robot along a path.

    Attributes
    ----------
    plant
        `ITSELF`, `HELD_OUT` or `UNEXPLAINED`.
    path
        Name of the driven path.
    run
        Simulated run.
    radius
        Radius of the circle path, scaled to the robot [m].
    """

    plant: str
    path: str
    run: Run
    radius: float

    @property
    def metrics(self) -> Metrics:
        """Statistics of the run."""
        return self.run.metrics

    @property
    def lateral_share(self) -> float:
        """Ratio of maximum lateral error to radius of the scaled circle [-]."""
        return self.metrics.lateral_max_m / self.radius

    @property
    def passed(self) -> bool:
        """True if the robot arrived and its lateral error stayed within the limit."""
        return self.metrics.completed and self.lateral_share <= trial_settings().lateral_share


@dataclass(frozen=True)
class StandIn:
    """Stand-in for the robot in a trial drive.

    Attributes
    ----------
    name
        `ITSELF`, `HELD_OUT` or `UNEXPLAINED`.
    model
        Velocity model of the robot.
    base
        Identified effects of the base in addition to the model.
    disturbance
        Unexplained motion for `ModelPlant`.
    slip, sensors
        Slip and sensors; None for the slip of the log and the default sensor set.
    """

    name: str
    model: VelocityModel | NonlinearModel
    base: BaseEffects
    disturbance: UnexplainedMotion | None = None
    slip: BodySlip | None = None
    sensors: SensorSet | None = None


def model_itself(identification: Identification) -> StandIn:
    """Return the identified model with its base effects as a stand-in."""
    return StandIn(ITSELF, identification.model, identification.report.fitted.identified.base_effects)


def stand_ins(identification: Identification) -> list[StandIn]:
    """Return the model itself and, if the fit succeeds, a model of another structure fitted to the validation data."""
    itself, held_out = model_itself(identification), _held_out_stand_in(identification)
    return [itself] if held_out is None else [itself, held_out]


def trial_drives(
    identification: Identification,
    config: ControllerConfig,
    plants: Sequence[StandIn],
    on_run: Callable[[], None] = lambda: None,
    *,
    paths: Sequence[str] | None = None,
    seed: int = 0,
) -> Iterator[TrialDrive]:
    """Simulate drives of the stand-ins `plants` along `paths` with the configuration, and yield each drive.

    The default paths are `PATHS`. `on_run` is called after each drive; `seed` is the seed of the sensor noise.
    """
    radius = circle_radius(config)
    limits = TwistBounds(v=max(config.limits.v.sides), omega=max(config.limits.omega.sides))
    robot = model_robot(config.sample_time, limits)
    for stand_in in plants:
        slip = stand_in.slip or log_slip(identification)
        sensors = stand_in.sensors or load_sensor_set("default", sensor_readings(config))
        for path in PATHS if paths is None else paths:
            effects, motion = stand_in.base, stand_in.disturbance
            plant = ModelPlant(stand_in.model, slip, sensors, seed, effects=effects, robot=robot, disturbance=motion)
            reference = scaled_to_robot(path, config, identification.model)
            # For drives with a disturbance only metrics are used, so their signals need not be stored.
            run = simulate(Controller(config, identification.model), plant, reference, lean=motion is not None)
            on_run()
            yield TrialDrive(stand_in.name, path, run, radius)


def log_slip(identification: Identification, *, pose_point: bool = False) -> BodySlip:
    """Return the slip on the surface of the log, for the rotation centre or for the pose point."""
    slip = check(Surface, identification.surface, "surface").slip
    ahead, left = identification.report.poses.place if pose_point else (0.0, 0.0)
    if not (ahead or left):
        return slip
    point = dict.fromkeys(POLYNOMIAL, 0.0) | {"a12": -left, "a22": ahead}
    return slip.model_copy(update={"polynomial": Polynomial(**point)})


def log_sensors(identification: Identification, config: ControllerConfig) -> SensorSet:
    """Return the sensors of the configuration with the rate and noise of the poses in the log."""
    sensors, data = load_sensor_set("default", sensor_readings(config)), identification.report.data
    fresh = [r.fresh_pose for r in (*data.train, *data.validation) if r.fresh_pose is not None]
    count = sum(map(np.sum, fresh))
    if not count:
        return sensors
    noise, period = config.estimator, data.train[0].dt * sum(map(len, fresh)) / count
    pose = {"position_sd": noise.position_noise, "heading_sd": noise.heading_noise, "period": period}
    return sensors.model_copy(update={"pose": sensors.pose.model_copy(update=pose)})


def circle_radius(config: ControllerConfig) -> float:
    """Compute the radius [m] of the shipped circle (1 m) after scaling to the robot's track."""
    return config.wheels.encoder_track / load_robot().track


def _held_out_stand_in(identification: Identification) -> StandIn | None:
    """Fit the predictor, the selected effects or another structure to the validation data; return None on failure.

    The fit includes selected effects, because a slew limit of the base otherwise appears as a lag.
    """
    data, fitted = identification.report.data, identification.report.fitted
    try:
        refitted = fitted.predictor.refitted(data.validation, data.yaw) if fitted.predictor else None
        if refitted is not None:
            return StandIn(HELD_OUT, refitted, BaseEffects())
        alternative = fitted.base.refitted(data.validation) if fitted.base else _fit_other_structure(data, fitted)
        return StandIn(HELD_OUT, alternative.model, alternative.base_effects)
    except ValueError:
        return None


def _fit_other_structure(data: LogData, fitted: Fitted) -> IdentifiedModel:
    """Fit an SSM instead of a structure with decoupled channels, or an SM instead of an SSM.

    The limits of `fitted` are estimated again, without a search for other limits. If the result cannot describe a
    robot, fit gains with dead times.
    """
    settings = trial_settings()
    rows = tuple(most_informative(data.validation, settings.stand_in_rows))
    limits = limits_in(fitted.identified.base_effects)
    conditions = IdentificationConditions(yaw=data.yaw, order=settings.stand_in_order, limits=limits)
    identified = STRUCTURES["sm" if fitted.structure == "ssm" else "ssm"].identify(rows, conditions).identified
    try:
        _ = identified.model
    except ModelError:
        # Short data may not determine the lag; a pole may then be faster than the poles of a robot.
        identified = STRUCTURES["two_delays"].identify(rows, conditions).identified
    return identified


def trial_table(drives: Sequence[TrialDrive]) -> TextTable:
    """Tabulate the errors by stand-in and path."""
    columns = ("stand-in", "path", "position RMSE [m]", "max lateral [m]", "of radius [%]")
    return TextTable(
        "Trial drives",
        (*columns, "fall-backs", "completed"),
        tuple(
            (
                drive.plant,
                drive.path,
                number(drive.metrics.position_rmse_m, 4),
                number(drive.metrics.lateral_max_m, 4),
                number(100 * drive.lateral_share, 1),
                str(drive.metrics.fallbacks),
                "yes" if drive.metrics.completed else "no",
            )
            for drive in drives
        ),
        text_columns=2,
        note=_NOTE.format(100 * trial_settings().lateral_share),
    )


def trial_doubts(drives: Sequence[TrialDrive]) -> list[Doubt]:
    """Return a doubt for each drive that failed."""
    doubts = [
        f"the configuration fails on '{drive.path}' with {drive.plant}: "
        + (
            f"a lateral error of {drive.metrics.lateral_max_m:.2g} m"
            if drive.metrics.completed
            else "; ".join(filter(None, ["the robot does not arrive", *drive.run.messages[-1:]]))
        )
        for drive in drives
        if not drive.passed
    ]
    return [Doubt("failed drive", message) for message in doubts]


# First drive of the robot with an identified configuration: a slow circle, and instructions in the report.


FIRST_CIRCLE = "first_circle.yaml"
_SHARE = 0.3
"""Share of the attainable speeds [-], slow enough to walk next to the robot and fast enough to exceed the dead band."""
_WALKING_SPEED = 0.5
"""Walking speed [m/s], the maximum speed of the circle for faster robots."""
_FREE_SPACE = 2.0
"""Free space relative to the diameter of the circle [-]."""


@dataclass(frozen=True)
class FirstCircle:
    """Slow circle to the left.

    Attributes
    ----------
    radius
        Radius of the shipped circle, scaled to the robot's track [m].
    v, omega
        Forward speed [m/s] and yaw rate [rad/s].
    """

    radius: float
    v: float
    omega: float

    @property
    def duration(self) -> float:
        """Duration of one turn [s]."""
        return 2.0 * math.pi / self.omega

    def text(self) -> str:
        """Format the trajectory file."""
        return (
            f"# One turn to the left with a radius of {self.radius:.3g} m, at {_SHARE:g} of the maximum speed or at "
            "walking speed.\n"
            "name: first circle\n"
            "segments:   # v [m/s], omega [rad/s], duration [s]\n"
            f"  - {{v: {self.v:.6g}, omega: {self.omega:.6g}, duration: {self.duration:.6g}}}\n"
        )


def first_circle(config: ControllerConfig, model: VelocityModel | NonlinearModel) -> FirstCircle:
    """Compute the circle from the limits of `config` and the gains of `model`."""
    radius = circle_radius(config)
    v_gain, omega_gain = abs(model.dc_gain[0, 0]), abs(model.dc_gain[1, 1])
    max_omega = min(
        v_gain * config.limits.v / radius, omega_gain * config.limits.omega, config.limits.wheel_speed / radius
    )
    omega = float(min(_SHARE * max_omega, _WALKING_SPEED / radius))
    return FirstCircle(radius, radius * omega, omega)


def recipe(circle: FirstCircle, config: ControllerConfig, drives: Sequence[TrialDrive], topics: Topics) -> str:
    """Format the instructions for the first drive at the end of the report; `topics` are the topics of a bag."""
    free_space = _FREE_SPACE * 2.0 * circle.radius
    arguments = f" {node_arguments(topics)}" if topics else ""
    steps = [
        "Read the warnings that matter for driving, and correct their causes if possible.",
        "Simulate the drive first, in the folder of this report: `diffdrive-mpc simulate --config config.yaml "
        f"--plant model:model.yaml --surface surface.yaml --trajectory {FIRST_CIRCLE}`. It is a circle with "
        f"a radius of {circle.radius:.2g} m at {circle.v:.2g} m/s, one turn in {circle.duration:.0f} s.",
        "Lift the wheels, start the node, check that no topic is rejected, and call start. Both sides must turn as "
        "commanded, and the base must stop when the node is killed (docs/robot.md, step 4).",
        f"On the ground, with {free_space:.2g} m of free space on all sides and a hand on the emergency stop: "
        "`diffdrive-mpc node --config "
        f"config.yaml --trajectory {FIRST_CIRCLE} --autostart{arguments}` with the topics of the robot; "
        "call start (docs/robot.md, step 5).",
        "Check that the mode stays TRACKING, that the lateral error is a few centimetres and does not grow, and that "
        "the message is empty or names a fault (docs/safety.md).",
        f"Stop the robot if it oscillates increasingly, turns in the wrong direction, or is more than "
        f"{config.reentry.band:.2g} m away from the circle for longer than a second.",
        "Increase the speed in small steps, then drive paths with corners. For another surface or load, record a new "
        "log.",
    ]
    if trial_doubts(drives):
        steps.insert(0, "Do not drive yet: some paths above failed. Correct the cause first.")
    return "## The first drive on the robot\n\n" + "".join(f"{i}. {step}\n" for i, step in enumerate(steps, 1))
