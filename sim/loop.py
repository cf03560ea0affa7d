"""Closed-loop simulation of a controller that drives a plant along a reference."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from diffdrive_mpc.models.errors import checked_number, wrong_type
from diffdrive_mpc.models.interface import CompiledController, FloatArray, Measurement, Reference, TrackingController
from diffdrive_mpc.sim.metrics.metrics import TIME_TOLERANCE
from diffdrive_mpc.sim.plants.plant import Plant, RobotLostError
from diffdrive_mpc.sim.plants.plug_ins import Surrounded
from diffdrive_mpc.sim.recorder import Recorder
from diffdrive_mpc.sim.run import Run

if TYPE_CHECKING:
    from diffdrive_mpc.sim.compiled_loop import CompiledLoop

PLANT_STATE = ("time", "true_pose", "true_twist")
"""Members of a plant from its first reset on, see `sim.plants.plant.Plant`."""
_TRUTH = {
    "true_pose": "x [m], y [m], theta [rad]",
    "true_twist": "forward speed [m/s], sideways speed [m/s], yaw rate [rad/s]",
}
"""Contents of the arrays (3,) of a plant."""
_STEP = ("command", "mode", "message", "solver", "solve_time", "step_time")
"""Members of the result of a step that each run reads, see `models.interface.ControlStep`."""
_SAME_PERIOD = 1e-3
"""Relative difference below which two sample times count as equal [-]."""
_MAX_EXTRA_TIME = 86400.0
"""Maximum additional time [s], a day, as for a trajectory."""
_ZERO_COMMANDS = np.zeros((1000, 2))
"""Commands before a drive, for more samples than any dead time."""


_RESERVED: set[int] = set()
_RESERVING = threading.Lock()


def simulate(
    controller: TrackingController,
    plant: Plant,
    reference: Reference,
    *,
    extra_time: float = 0.0,
    keep_plans: bool = False,
    lean: bool = False,
    on_tick: Callable[[int, int], None] | None = None,
) -> Run:
    """Drive `plant` along `reference`, from rest at the start pose of the reference.

    The scenario of the plant may add a start offset.

    Parameters
    ----------
    controller
        Controller; it receives only measurements, not the true state. Before the start its last commands become zero,
        because the robot is at rest. Features keep what they learned in earlier drives; `controller.reset()` clears it.
    plant
        Simulated robot; it is reset at the start.
    reference
        Timed trajectory, whose time 0 is the plant's time 0.
    extra_time
        Additional time after the end of the reference [s].
    keep_plans
        True to store the plan of the controller at each tick.
    lean
        True to store neither measurements nor computation times. If the plant is a velocity model, ticks then run in C,
        unless a feature, `keep_plans` or `on_tick` requires Python. Other results are bitwise equal.
    on_tick
        Function that is called after each tick with the number of finished ticks and the total number.

    Returns
    -------
    Run
        Run from time 0 to the first tick at or after the end, or until the robot is lost; `ended` then contains the
        reason. The run of a plant with surroundings continues until the time limit of the plant, or until the plant
        ends the run.

    Raises
    ------
    ValueError
        If `extra_time` is negative or more than a day, the sample times of controller and plant differ, or a command
        does not consist of two finite numbers.
    RuntimeError
        If another drive, for instance in another thread, uses the controller or the plant.
    """
    _check_arguments(controller, plant, extra_time)
    with _reserved(controller, "controller"), _reserved(plant, "plant"):
        return _drive(controller, plant, reference, extra_time, on_tick, keep_plans=keep_plans, lean=lean)


@contextmanager
def _reserved(part: object, name: str) -> Iterator[None]:
    """Reserve a controller or a plant, which has the state of one drive, for this thread."""
    with _RESERVING:
        if id(part) in _RESERVED:
            raise RuntimeError(f"another drive uses this {name}: make a {name} for each thread")
        _RESERVED.add(id(part))
    try:
        yield
    finally:
        _RESERVED.remove(id(part))


def _drive(
    controller: TrackingController,
    plant: Plant,
    reference: Reference,
    extra_time: float,
    on_tick: Callable[[int, int], None] | None,
    *,
    keep_plans: bool,
    lean: bool,
) -> Run:
    """Drive as `simulate` describes, with checked arguments."""
    plant.reset(reference.sample([0.0]).pose[0])
    if not has_members(plant, PLANT_STATE):
        raise wrong_type("plant", "a plant", plant, f"it needs {', '.join(PLANT_STATE)} after reset")
    for name, values in _TRUTH.items():
        if np.shape(value := getattr(plant, name)) != (3,):
            raise wrong_type(f"plant.{name}", "three numbers", value, f"give {values}")
    if hasattr(controller, "set_applied_commands"):
        controller.set_applied_commands(_ZERO_COMMANDS)
    controller.start(reference, plant.time)
    surrounded = plant if isinstance(plant, Surrounded) else None
    end, goal = reference.duration + TIME_TOLERANCE, reference.sample([reference.duration]).pose[0]
    end_time = max(reference.duration + extra_time, surrounded.time_limit if surrounded else 0.0)
    ticks = int(np.ceil((end_time - TIME_TOLERANCE) / plant.sample_time)) + 1
    record = Recorder(ticks, keep_plans=keep_plans, lean=lean)
    is_compilable = lean and not keep_plans and on_tick is None
    loop = _compiled_loop(controller, plant, record, ticks) if is_compilable else None
    k, ended = 0, ""
    while k < ticks:
        k, step = (k, None) if loop is None else loop.run(k)
        if k == ticks:
            break
        measurement = plant.measure() if step is None else None
        if step is None and not isinstance(measurement, Measurement):
            raise wrong_type("plant.measure()", "a Measurement", measurement, "return Measurement() if it has no data")
        record.record_state(plant, measurement)
        is_over = False
        if surrounded is not None:
            surrounded.show(controller)
            is_over = plant.time > end and surrounded.is_over(goal)
        step = controller.step(plant.time, measurement) if measurement is not None else step
        if step is None or not has_members(step, _STEP):
            raise wrong_type("controller.step()", "a result like StepResult", step, f"return {', '.join(_STEP)}")
        command = _check_command(step.command, plant.time)
        record.record_step(step, command)
        try:
            plant.advance(command)
        except RobotLostError as error:
            ended = str(error)
        record.record_work(plant, lost=bool(ended))
        if on_tick is not None:
            on_tick(k + 1, ticks)
        k += 1
        if ended or is_over:
            break
    return record.run(plant, reference, ended=ended)


def _compiled_loop(controller: TrackingController, plant: Plant, record: Recorder, ticks: int) -> CompiledLoop | None:
    """Return the loop in C; None if controller or plant have no tick in C."""
    from diffdrive_mpc.sim.compiled_loop import CompiledLoop  # noqa: PLC0415 - only lean runs need it
    from diffdrive_mpc.sim.plants.model_plant import ModelPlant  # noqa: PLC0415

    if isinstance(controller, CompiledController) and isinstance(plant, ModelPlant) and plant.c.order:
        return CompiledLoop(controller, plant, record, ticks)
    return None


def has_members(value: object, names: tuple[str, ...]) -> bool:
    """Return True if `value` has all attributes in `names`, and is not a class."""
    return not isinstance(value, type) and all(hasattr(value, name) for name in names)


def _check_arguments(controller: TrackingController, plant: Plant, extra_time: float) -> None:
    """Raise ValueError for an invalid `extra_time` or different sample times of controller and plant."""
    if not 0 <= checked_number("extra_time", extra_time, "give a time in seconds") <= _MAX_EXTRA_TIME:
        raise ValueError(f"extra_time = {extra_time}: give a time in seconds, 0 to {_MAX_EXTRA_TIME:g}")
    period = getattr(controller, "sample_time", None)
    if period is not None and not math.isclose(period, plant.sample_time, rel_tol=_SAME_PERIOD):
        raise ValueError(
            f"the controller's sample_time is {period:g} s, the plant's is {plant.sample_time:g} s: make the plant "
            f"with make_plant(..., sample_time={period:g}), or set sample_time in the configuration"
        )


def _check_command(command: FloatArray, t: float) -> FloatArray:
    """Return the command as an array; raise ValueError if it does not consist of two finite numbers."""
    command = np.asarray(command, dtype=float)
    if command.shape != (2,) or not all(map(math.isfinite, command.tolist())):
        raise ValueError(f"t = {t:.3f} s: the controller's command must be two finite numbers, not {command.tolist()}")
    return command
