"""Build the controller, the plant and the reference of a case."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.bench.case import AS_FILED, NO_MODEL, Case, Overrides, describe_setting, label
from diffdrive_mpc.bench.drive import plant_settings
from diffdrive_mpc.bench.peers import PEERS, accepts_settings, make_peer
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference, TrackingController
from diffdrive_mpc.models.load import is_shipped, load_model, model_path
from diffdrive_mpc.models.plug_ins import known_packages, missing_part
from diffdrive_mpc.models.suggestions import format_unknown_name
from diffdrive_mpc.mpc import Controller, ControllerConfig, Trajectory, load_config, load_trajectory
from diffdrive_mpc.mpc.config.config_file import model_of
from diffdrive_mpc.mpc.features.registry import prepare_config
from diffdrive_mpc.mpc.trajectories.limits import BeyondLimitError, TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.load import load_segments
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_segments
from diffdrive_mpc.sim import Plant, Run, make_plant, simulate
from diffdrive_mpc.sim.plants.make import drawn_robot, physics_robot
from diffdrive_mpc.sim.plants.names import split_plant
from diffdrive_mpc.sim.plants.plant import PlantAround

# Plant with an additional dead time, which the controllers do not know.


class LatePlant(PlantAround):
    """Plant behind a delay line that delays every command by `ticks` samples; see `sim.plants.plant.Plant`."""

    def __init__(self, plant: Plant, ticks: int) -> None:
        super().__init__(plant)
        self._ticks = ticks
        self._delay_line: deque[FloatArray] = deque()

    def reset(self, pose: ArrayLike) -> None:
        """Reset the plant and fill the delay line with zero commands."""
        self._plant.reset(pose)
        self._delay_line = deque(np.zeros(2) for _ in range(self._ticks))

    def measure(self) -> Measurement:
        """Collect the plant's sensor data; `sent` is the last command that entered the delay line."""
        measurement = self._plant.measure()
        if measurement.sent is None or not self._delay_line:
            return measurement
        v, omega = self._delay_line[-1].tolist()
        return replace(measurement, sent=(v, omega))

    def advance(self, command: ArrayLike) -> None:
        """Append `command` (2,) to the delay line and advance the plant with the output of the line."""
        self._delay_line.append(np.array(command, dtype=float))
        self._plant.advance(self._delay_line.popleft())


CONTROLLERS = ("mpc", *PEERS)
_TRACK_TOLERANCE = 0.05
"""Relative difference in track above which plant and configuration count as different robots [-]."""


def build(case: Case) -> tuple[TrackingController, Plant, Reference]:
    """Create the controller, the plant and the reference of a case.

    The plant accepts commands at the sample time of the configuration. Raise ConfigError or ValueError if a name is
    unknown or a file is invalid.
    """
    return make_controller(case), build_plant(case), load_reference(case)


def build_plant(case: Case) -> Plant:
    """Create the plant of a case; raises as `build` does."""
    options: dict[str, Any] = {}
    if case.controller not in PEERS:
        options = plant_settings(controller_config(case.model, case.config, settings_of(case)))
    plant = make_plant(case.plant, case.surface, case.sensors, case.seed, scenario=case.scenario, **options)
    return LatePlant(plant, case.late) if case.late > 0 else plant


def run_case(case: Case) -> Run:
    """Run one closed loop; raises as `build` does."""
    return simulate(*build(case))


def check_cases(cases: Iterable[Case], *, has_references: bool = False) -> None:
    """Build each distinct configuration once and load every trajectory; raise as `build` does.

    If `has_references` is True, the trajectories are objects, and those that the cases name are not loaded.
    """
    case_list = list(cases)
    for case in {(case.trajectory, case.timing, case.scaled): case for case in case_list}.values():
        if not has_references:
            load_reference(case)
    for case in {replace(case, trajectory="", timing="", seed=0): case for case in case_list}.values():
        make_controller(case)
        build_plant(case)
        if not has_references:
            load_reference(case)


def load_reference(case: Case) -> Trajectory:
    """Return the timed trajectory of a case; raise ConfigError if its trajectory or its timing cannot be used.

    A trajectory with a maximum speed or scaled to the robot stops at jumps of curvature. A plant may define its own
    reference.
    """
    plant_path = _reference_of_plant(case)
    if plant_path is not None:
        return plant_path
    config = _config_of_robot(case)
    if case.scaled:
        from diffdrive_mpc.mpc.trajectories.moved import scaled_to_robot  # noqa: PLC0415 - as above

        return scaled_to_robot(case.trajectory, config, load_model(config.model))
    if case.top_speed is not None:
        segments = load_segments(case.trajectory)
        ratio = case.top_speed / max(abs(segment.v) for segment in segments)
        scaled = [
            Segment(v=segment.v * ratio, omega=segment.omega * ratio, duration=segment.duration / ratio)
            for segment in segments
        ]
        name = f"{case.trajectory} at {case.top_speed:g} m/s"
        return time_segments(scaled, TrajectoryLimits.of_controller(config.limits), name=name)
    try:
        return load_trajectory(case.trajectory, config, timing=None if case.timing == AS_FILED else case.timing)
    except BeyondLimitError as error:
        if case.config is not None:
            raise
        raise BeyondLimitError(f"{error}, or state the configuration of the robot (--config)") from error


_NO_LIMIT = 1e3
"""Speed [m/s] and yaw rate [rad/s] above those of every path, for a path that is not driven."""


def start_pose(case: Case) -> FloatArray:
    """Return the pose (3,) at the start of the trajectory of a case [m, m, rad]; its speeds are not checked.

    Raise ConfigError if the trajectory cannot be loaded.
    """
    limits = replace(TrajectoryLimits.of_robot(), v=_NO_LIMIT, omega=_NO_LIMIT)
    reference = _reference_of_plant(case) or load_trajectory(case.trajectory, limits)
    return np.asarray(reference.sample([0.0]).pose[0])


def _reference_of_plant(case: Case) -> Trajectory | None:
    """Return the reference that the plant of a case defines; None if it does not define a reference.

    Raise ConfigError if the case names another trajectory, or if neither the case nor the plant has a trajectory.
    """
    wrapper = split_plant(case.plant)
    if wrapper is None:
        return None
    kind, name, _ = wrapper
    limits = TrajectoryLimits.of_controller(_config_of_robot(case).limits)
    reference: Trajectory | None = kind.reference(name, case.seed, limits)
    is_named = case.trajectory != case.plant
    if reference is not None and is_named:
        raise ConfigError(
            f"--trajectory {case.trajectory}: the plant '{label(case.plant)}' has its own path; omit the option, "
            "or remove the path from a copy of the plant's file"
        )
    if reference is None and not is_named:
        raise ConfigError(f"--plant {case.plant}: the plant has no path; give a --trajectory")
    return reference


def other_robots(cases: Iterable[Case]) -> list[str]:
    """Return a warning for each physics plant that differs from the robot in the configuration of its case."""
    predictive = (case for case in cases if case.controller == "mpc" and case.model != NO_MODEL)
    distinct = {(case.model, case.config, settings_of(case), case.plant): case for case in predictive}
    sentences = (_other_robot(case) for case in distinct.values())
    return list(dict.fromkeys(filter(None, sentences)))


def reference_remarks(cases: Iterable[Case]) -> list[str]:
    """Return a remark on each reference that differs from its file."""
    distinct: dict[tuple[object, ...], Case] = {}
    for case in cases:
        distinct[case.trajectory, case.timing, case.scaled, case.top_speed, case.config, settings_of(case)] = case
    remarks: dict[str, Case] = {}
    for case in distinct.values():
        remarks.setdefault(load_reference(case).remark, case)
    counts = Counter(case.trajectory for case in remarks.values())
    return [
        ", with ".join((remark, *(map(describe_setting, case.overrides) if counts[case.trajectory] > 1 else ())))
        for remark, case in remarks.items()
        if remark
    ]


def _other_robot(case: Case) -> str:
    robot = physics_robot(case.plant)
    if robot is None:
        return ""
    beside = Path(case.model).with_name("config.yaml")  # `identify` writes it beside the model
    is_identified = case.config is None and not is_shipped(case.model) and beside.is_file()
    config = load_config(beside) if is_identified else _config_of_robot(case)
    track, differences = config.wheels.encoder_track, []
    if abs(track / robot.track - 1.0) > _TRACK_TOLERANCE:
        differences.append(f"its track is {robot.track:.3g} m, the configuration's {track:.3g} m")
    for name, unit in (("v", "m/s"), ("omega", "rad/s")):
        robot_limit, limit = getattr(robot.limits, name), getattr(config.limits, name)
        if limit > robot_limit:
            differences.append(f"it clips {name} at {robot_limit:.3g} {unit}, limits.{name} is {limit:.3g} {unit}")
    if not differences:
        return ""
    return (
        f"the plant '{label(case.plant)}' does not match the robot of the configuration: {'; '.join(differences)}. For "
        "your robot, give --plant model:FILE with its model, or mujoco:FILE with its twin (diffdrive-mpc twin)"
    )


def _config_of_robot(case: Case) -> ControllerConfig:
    """Return the configuration of the robot of a case; for a peer, the configuration of the default model."""
    model = Case().model if case.controller in PEERS or case.model == NO_MODEL else case.model
    return controller_config(model, case.config, settings_of(case))


def make_controller(case: Case) -> TrackingController:
    """Create a controller for a case.

    Raise ConfigError if the controller is unknown, or its model or configuration cannot be used.
    """
    if case.controller in PEERS:
        return make_peer(case.controller, dict(settings_of(case)), dict(case.gains))
    if case.controller != "mpc":
        if case.controller in known_packages().get("peers", {}):
            raise MissingPackageError(missing_part("peers", case.controller))
        raise ConfigError(f"unknown controller {format_unknown_name(case.controller, CONTROLLERS)}")
    return Controller(case_config(case))


def settings_of(case: Case) -> Overrides:
    """Return configuration values by dotted key: `case.overrides` and the values that a random robot's user states.

    A peer that does not use this project's estimator receives `case.overrides` only.
    """
    robot = None if case.controller in PEERS and not accepts_settings(case.controller) else drawn_robot(case.plant)
    return case.overrides if robot is None else tuple((dict(robot.stated) | dict(case.overrides)).items())


def case_config(case: Case) -> ControllerConfig:
    """Return the configuration of the predictive controller of a case, with the settings that the plant requires.

    Raise ConfigError as `controller_config`.
    """
    wrapper = split_plant(case.plant)
    required = {} if wrapper is None else dict(wrapper[0].settings(wrapper[1], wrapper[2]))
    return controller_config(case.model, case.config, tuple((required | dict(settings_of(case))).items()))


@lru_cache(maxsize=256)
def controller_config(model: str, config: str | None = None, overrides: Overrides = ()) -> ControllerConfig:
    """Return the configuration of the predictive controller.

    Without `config`, return the built-in configuration of `model`. For a user's model file, return the built-in
    configuration of the SSM without its extra dead time, which was identified together with the SSM.

    Raise ConfigError if the model is unknown or the configuration is invalid.
    """
    if config is not None:
        loaded = load_config(config, {"model": _model_reference(model), **dict(overrides)})
    elif is_shipped(model):
        loaded = load_config(model, dict(overrides))
    else:
        load_model(model)
        loaded = load_config("ssm", {"model": _model_reference(model), "extra_dead_time": {}, **dict(overrides)})
    return prepare_config(loaded)


def select_model(model: str | None, config: Path | None) -> str:
    """Return `model`; if it is None, the model of the configuration file, or without a file the default model.

    Raise ConfigError if the name is empty or the file cannot be used.
    """
    if model is None:
        return Case().model if config is None else model_of(load_config(config))
    if not model.strip():
        raise ConfigError("--model: empty name; give mbm, sm, ssm, two_delays, kinematic or the path of a model file")
    return model


def _model_reference(model: str) -> str:
    return model if is_shipped(model) else str(model_path(model).resolve())
