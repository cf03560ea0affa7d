"""Simulated drives with the identified configuration, on its model and on a model of the held-out part."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.checked_yaml import StrictModel, check, load_checked
from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.identification import Identification
from diffdrive_mpc.models.identification.deliver.configuration import node_arguments
from diffdrive_mpc.models.identification.fit.fitting import fit
from diffdrive_mpc.models.identification.log_data import LogData, most_informative
from diffdrive_mpc.models.logs.record import Topics
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.robot import Positive, load_robot
from diffdrive_mpc.models.slip_laws import POLYNOMIAL
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.table import TextTable, number
from diffdrive_mpc.models.velocity_model import CHANNELS, ModelError, VelocityModel
from diffdrive_mpc.mpc import Controller, ControllerConfig
from diffdrive_mpc.mpc.trajectories.moved import scaled_to_robot
from diffdrive_mpc.sim import Metrics, Run, simulate
from diffdrive_mpc.sim.plants.identified_robot import UnexplainedMotion
from diffdrive_mpc.sim.plants.model_plant import ModelPlant
from diffdrive_mpc.sim.plants.surface import BodySlip, Polynomial, Surface
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet, load_sensor_set

PATHS = ("circle", "square", "s", "cane")
ITSELF, HELD_OUT = "model itself", "model of held-out data"
UNEXPLAINED = "the model with the motion that it left unexplained"
_TITLE = "Driving with it"
Share = Annotated[float, Field(gt=0, le=1)]
_NOTE = (
    "Paths scaled to size and limits of the robot; lateral errors beside the radius of the scaled circle: below {:g} % "
    "is good. On the model itself this shows that configuration and model agree; on one of the data held out, of "
    "another structure, that it depends neither on the part of the log nor on the structure. Neither shows the floor: "
    "begin slowly, with room."
)


class TrialSettings(StrictModel):
    """Requirements of the trial drives, and reactions to a failure."""

    lateral_share: Positive = Field(description="largest lateral error over the radius of the scaled circle [-]")
    shares: tuple[tuple[Share, Share], ...] = Field(
        description="of limits.v and limits.omega to go down to, the fastest first [-]"
    )
    curved: tuple[str, ...] = Field(description="paths without corners, of which the promise is")
    window: Positive = Field(description="over which motion that the model leaves unexplained is averaged [s]")
    noise_speed: Positive = Field(description="speed that noise of the poses may pass for [m/s]")
    unexplained: int = Field(ge=1, description="number of curved drives with such motion")
    lost_share: Share = Field(description="maximum share of these drives that do not arrive [-]")
    promise_factor: Positive = Field(description="promised error over the geometric mean of these drives [-]")
    stand_in_order: int = Field(ge=1, description="of the SSM that stands in for a robot whose model is an SM or MBM")
    stand_in_rows: int = Field(ge=1, description="of the data held out that it is fitted to")


@cache
def trial_settings() -> TrialSettings:
    """Read `trial_drives.yaml`; raises ConfigError on a mistake in it."""
    return load_checked(TrialSettings, Path(__file__).with_name("trial_drives.yaml"))


@dataclass(frozen=True)
class TrialDrive:
    """Drive of one path on one stand-in of the robot.

    Attributes
    ----------
    plant
        `ITSELF`, `HELD_OUT` or `UNEXPLAINED`.
    path
        Name of the driven path.
    run
        The simulated drive.
    radius
        Radius of the circle among the paths, scaled to the robot [m].
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
        """Largest lateral error over the radius of the scaled circle [-]."""
        return self.metrics.lateral_max_m / self.radius

    @property
    def passed(self) -> bool:
        """True if the robot arrived and stayed near enough to its path."""
        return self.metrics.completed and self.lateral_share <= trial_settings().lateral_share


@dataclass(frozen=True)
class StandIn:
    """Stand-in for the robot in a trial drive.

    Attributes
    ----------
    name
        `ITSELF`, `HELD_OUT` or `UNEXPLAINED`.
    model
        Model of the robot's velocities.
    base
        Identified effects of the base around the model.
    disturbance
        Motion beyond the model, as `ModelPlant` takes it.
    slip, sensors
        Slip and sensors of the drive; by default the slip of the log and the default sensor set.
    """

    name: str
    model: VelocityModel | NonlinearModel
    base: BaseEffects
    disturbance: UnexplainedMotion | None = None
    slip: BodySlip | None = None
    sensors: SensorSet | None = None


def model_itself(identification: Identification) -> StandIn:
    """Return the model that was identified, with the effects of its base."""
    return StandIn(ITSELF, identification.model, identification.report.fitted.identified.base_effects)


def stand_ins(identification: Identification) -> list[StandIn]:
    """Return the model itself, and one of another structure fitted to held-out data, if there is enough."""
    itself, held_out = model_itself(identification), _of_held_out(identification)
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
    """Drive paths, by default `PATHS`, with the configuration on stand-ins of the robot.

    `on_run` is called after each drive; `seed` is that of the sensors' noise.
    """
    radius = circle_radius(config)
    usual = load_robot()
    for stand_in in plants:
        slip, sensors = stand_in.slip or log_slip(identification), stand_in.sensors or load_sensor_set("default")
        reached = {name: max(getattr(config.limits, name).sides) for name in CHANNELS}
        limits = usual.limits.model_copy(update=reached)
        robot = usual.model_copy(update={"sample_time": config.sample_time, "limits": limits})
        for path in PATHS if paths is None else paths:
            plant = ModelPlant(
                stand_in.model,
                slip,
                sensors,
                seed,
                effects=stand_in.base,
                robot=robot,
                disturbance=stand_in.disturbance,
            )
            reference = scaled_to_robot(path, config, identification.model)
            run = simulate(Controller(config, identification.model), plant, reference)
            on_run()
            yield TrialDrive(stand_in.name, path, run, radius)


def log_slip(identification: Identification, *, pose_point: bool = False) -> BodySlip:
    """Return the slip of the surface of the log, of the rotation centre or of the point that the poses are of."""
    slip = check(Surface, identification.surface, "surface").slip
    ahead, left = identification.report.poses.place if pose_point else (0.0, 0.0)
    if not (ahead or left):
        return slip
    point = dict.fromkeys(POLYNOMIAL, 0.0) | {"a12": -left, "a22": ahead}
    return slip.model_copy(update={"polynomial": Polynomial(**point)})


def log_sensors(identification: Identification, config: ControllerConfig) -> SensorSet:
    """Return the default sensors, with rate and noise of the poses of the log."""
    sensors, data = load_sensor_set("default"), identification.report.data
    fresh = [r.fresh_pose for r in (*data.train, *data.validation) if r.fresh_pose is not None]
    count = sum(map(np.sum, fresh))
    if not count:
        return sensors
    noise, period = config.estimator, data.train[0].dt * sum(map(len, fresh)) / count
    pose = {"position_sd": noise.position_noise, "heading_sd": noise.heading_noise, "period": period}
    return sensors.model_copy(update={"pose": sensors.pose.model_copy(update=pose)})


def circle_radius(config: ControllerConfig) -> float:
    """Compute the radius of the shipped circle, a metre, scaled to the robot's track [m]."""
    return config.wheels.encoder_track / load_robot().track


def _of_held_out(identification: Identification) -> StandIn | None:
    """Fit another structure, the selected effects, or the function, to the data held out; None if that fails.

    A model without the effects would mistake a slew limit of the base for a lag.
    """
    data, fitted = identification.report.data, identification.report.fitted
    try:
        refitted = fitted.predictor.refitted(data.validation, data.yaw) if fitted.predictor else None
        if refitted is not None:
            return StandIn(HELD_OUT, refitted, BaseEffects())
        if fitted.base is not None:
            alternative = fitted.base.refitted(data.validation)
        else:
            alternative = _of_other_structure(data, fitted.structure)
        return StandIn(HELD_OUT, alternative.model, alternative.base_effects)
    except ValueError:
        return None


def _of_other_structure(data: LogData, structure: str) -> IdentifiedModel:
    """Fit an SSM to a robot of decoupled channels, an SM to any other, or dead times if neither is a robot's."""
    settings = trial_settings()
    rows = tuple(most_informative(data.validation, settings.stand_in_rows))
    structure_name, order = ("ssm", settings.stand_in_order) if structure != "ssm" else ("sm", None)
    held_out = replace(data, train=rows, validation=rows)
    try:
        return fit(held_out, STRUCTURES[structure_name], order).identified
    except ModelError:
        # Short data may show no lag at all, as a pole that is faster than a robot's.
        return fit(held_out, STRUCTURES["two_delays"], None).identified


def trial_table(drives: Sequence[TrialDrive]) -> TextTable:
    """Tabulate errors, a row for each stand-in and path."""
    columns = ("stand-in", "path", "position RMSE [m]", "largest lateral [m]", "of the circle's radius [%]")
    return TextTable(
        _TITLE,
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
        f"the configuration does not drive '{drive.path}' on {drive.plant}: "
        + (f"{drive.metrics.lateral_max_m:.2g} m beside the path" if drive.metrics.completed else "it did not arrive")
        for drive in drives
        if not drive.passed
    ]
    return [Doubt("failed drive", words) for words in doubts]


# The first drive of an identified configuration on the robot: a slow circle, and a recipe in the report.


FIRST_CIRCLE = "first_circle.yaml"
_SHARE = 0.3
"""Share of the attainable speeds [-]: slow enough to walk along, fast enough to leave the dead band."""
_FASTEST = 0.5
"""Walking speed [m/s], which limits faster robots."""
_ROOM = 2.0
"""Free space over the size of the circle [-]."""


@dataclass(frozen=True)
class FirstCircle:
    """One turn to the left, slowly.

    Attributes
    ----------
    radius
        Radius of the shipped circle, times the robot's track over that of the papers' robot [m].
    v, omega
        Speeds [m/s], [rad/s].
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
            f"# One turn to the left, {self.radius:.3g} m in radius, at {_SHARE:g} of what the robot can, or a walk.\n"
            "name: first circle\n"
            "segments:   # v [m/s], omega [rad/s], duration [s]\n"
            f"  - {{v: {self.v:.6g}, omega: {self.omega:.6g}, duration: {self.duration:.6g}}}\n"
        )


def first_circle(config: ControllerConfig, model: VelocityModel | NonlinearModel) -> FirstCircle:
    """Design the circle for a robot with these limits and gains."""
    radius = circle_radius(config)
    v_gain, omega_gain = abs(model.dc_gain[0, 0]), abs(model.dc_gain[1, 1])
    reached = min(
        v_gain * config.limits.v / radius, omega_gain * config.limits.omega, config.limits.wheel_speed / radius
    )
    omega = float(min(_SHARE * reached, _FASTEST / radius))
    return FirstCircle(radius, radius * omega, omega)


def recipe(circle: FirstCircle, config: ControllerConfig, drives: Sequence[TrialDrive], topics: Topics) -> str:
    """Describe the first drive of the robot, as the end of the report; `topics` are those of a bag."""
    room = _ROOM * 2.0 * circle.radius
    arguments = f" {node_arguments(topics)}" if topics else ""
    steps = [
        "Read the warnings that matter for driving, and fix what you can.",
        "Drive it here first, in the folder of this report: `diffdrive-mpc simulate --config config.yaml "
        f"--plant model:model.yaml --surface surface.yaml --trajectory {FIRST_CIRCLE}`. It is a circle of "
        f"{circle.radius:.2g} m in radius at {circle.v:.2g} m/s, one turn in {circle.duration:.0f} s.",
        "Lift the wheels: start the node, check that no topic is refused, call start. Both sides must turn as "
        "told, and the base must stop by itself when the node is killed (docs/robot.md, step 4).",
        f"On the floor, {room:.2g} m free all round, a hand on the emergency stop: `diffdrive-mpc node --config "
        f"config.yaml --trajectory {FIRST_CIRCLE}{arguments}` with the topics of the robot (docs/robot.md, step 5).",
        "Look at the mode, which stays TRACKING, at the lateral error, a few centimetres and not growing, and at "
        "the message, which is empty or says what is wrong (docs/safety.md).",
        f"Stop it if it weaves more and more, turns the wrong way, or is further than {config.reentry.band:.2g} m "
        "beside the circle for longer than a second.",
        "Then faster, a little at a time; then paths with corners. New floor or load: a new log.",
    ]
    if trial_doubts(drives):
        steps.insert(0, "Not yet: some paths above failed. Fix that first.")
    return "## The first drive on the robot\n\n" + "".join(f"{i}. {step}\n" for i, step in enumerate(steps, 1))
