"""Plant whose motion is the closed-form solution of a velocity model."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.base_effects import PARTS, BaseEffects, TwistRange, TwistSlew
from diffdrive_mpc.models.errors import checked_methods
from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.robot import Robot, load_robot
from diffdrive_mpc.models.two_sided import sides_of
from diffdrive_mpc.models.velocity_model import ModelError, VelocityModel
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.core.library import address, load_twin, view
from diffdrive_mpc.sim.plants.drivetrain import checked_pose, clip_command
from diffdrive_mpc.sim.plants.identified_robot import UnexplainedMotion
from diffdrive_mpc.sim.plants.plant import NativePlant
from diffdrive_mpc.sim.plants.surface import BodySlip
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet
from diffdrive_mpc.sim.sensing.sensors import Sensors

_NO_LIMIT = 1e6
"""Limit above all commands; it is finite, so that ratios of limits are finite."""


@checked_methods
class ModelPlant(NativePlant):
    """Plant with velocity model, extra dead time, slip, and simulated sensors; see `sim.plants.plant.Plant`.

    The model predicts v of the encoders and omega of the gyro on the surface of the identification. The twist of a
    sample is the mean of the outputs at both ends, and the pose moves along the exact arc of this mean. With base
    effects, a sample is divided into several such steps. Poses are those of the centre of rotation.

    Parameters
    ----------
    model
        Velocity model.
    slip
        Slip from the model's twist to the true twist.
    sensors
        Sensor parameters.
    seed
        Non-negative seed of the noise.
    extra_dead_time
        Dead time in addition to that of the model, for both channels [s].
    effects
        Base effects; None for a base without effects.
    robot
        Geometry, sample time and limits; by default the robot of the papers.
    disturbance
        Motion of the body that the model does not explain; None if it is absent.
    """

    def __init__(
        self,
        model: VelocityModel | NonlinearModel,
        slip: BodySlip,
        sensors: SensorSet,
        seed: int = 0,
        *,
        extra_dead_time: float = 0.0,
        effects: BaseEffects | None = None,
        robot: Robot | None = None,
        disturbance: UnexplainedMotion | None = None,
    ) -> None:
        self._robot, self._name = robot or load_robot(), model.name
        delayed_model = model.with_extra_dead_time([extra_dead_time, extra_dead_time])
        self._nonlinear = _NonlinearState(delayed_model) if isinstance(delayed_model, NonlinearModel) else None
        kinematics = WheelKinematics(self._robot.wheel_radius, self._robot.track)
        self.sensors = Sensors(sensors, kinematics, self._robot.sample_time, seed=seed, noisy_encoders=True)
        self.c, self._memory = _plant_in_c(delayed_model, effects or BaseEffects(), slip, disturbance, self.sample_time)
        self.c.limits, self.c.wheel_yaw_gain = [self._robot.limits.v, self._robot.limits.omega], slip.wheel_yaw_gain
        self._sample = load_twin()[1].plant_sample
        self._pose, self._twist = view(self.c.pose), view(self.c.twist)
        self.reset(np.zeros(3))

    def __repr__(self) -> str:
        """Describe the plant in one line."""
        return f"ModelPlant of {self._name!r}, samples of {self.sample_time:g} s"

    @property
    def sample_time(self) -> float:
        """Time between two control ticks [s]."""
        return self._robot.sample_time

    @property
    def time(self) -> float:
        """Time since the last reset [s]."""
        return float(self.c.tick * self._robot.sample_time)

    @property
    def true_pose(self) -> FloatArray:
        """(3,) x [m], y [m], theta [rad, unwrapped] of the point midway between the wheels."""
        return self._pose.copy()

    @property
    def true_twist(self) -> FloatArray:
        """(3,) forward and lateral speed [m/s] and yaw rate [rad/s] in the body frame."""
        return self._twist.copy()

    def reset(self, pose: ArrayLike) -> None:
        """Reset the robot to rest at `pose` (3,) at time 0 and restart the noise."""
        self._pose[:] = checked_pose(pose)
        if self._nonlinear is not None:
            self.c.next = self._nonlinear.rest()
        load_twin()[1].velocity_plant_reset(self.c)
        self.sensors.reset(self._pose, np.zeros(4))

    def measure(self) -> Measurement:
        """Collect the sensor data since the last call."""
        return self.sensors.collect(self.time, tuple(self.c.sent) if self.c.has_sent else None)

    def advance(self, command: ArrayLike) -> None:
        """Send `command` (2,) and advance by one sample; raise ValueError for an invalid command."""
        sent = clip_command(command, self._robot.limits).tolist()
        if self._nonlinear is not None:
            self.c.next = self._nonlinear.advance(sent)
        self.sensors.draw_noise(1)
        self._sample(self.c, self.sensors.c, sent)


class _NonlinearState:
    """Simulation state of a nonlinear model."""

    def __init__(self, model: NonlinearModel) -> None:
        self._model = model

    def rest(self) -> list[float]:
        """Reset to rest without pending commands; return the output (2,)."""
        self._state, self._past = np.zeros(self._model.order), np.zeros((self._model.memory, 2))
        return self._output()

    def advance(self, command: list[float]) -> list[float]:
        """Advance by one sample under `command` (2,); return the output (2,)."""
        window = np.vstack([self._past, command])
        self._state = np.asarray(self._model.plant_step(self._state, window.ravel())).ravel()
        self._past = window[1:]
        return self._output()

    def _output(self) -> list[float]:
        return list(map(float, np.asarray(self._model.output(self._state)).ravel()))


def _plant_in_c(
    model: VelocityModel | NonlinearModel,
    effects: BaseEffects,
    slip: BodySlip,
    disturbance: UnexplainedMotion | None,
    sample_time: float,
) -> tuple[Any, list[Any]]:
    """Return the C structure of the plant, see `sim/core/velocity_plant.h`, and the memory that it uses.

    Raises ModelError if a nonlinear model has another sample time or is combined with base effects.
    """
    has_no_effects = effects.model_copy(update={"pose_mount": None}) == BaseEffects()
    c = load_twin()[0].new("velocity_plant *")
    # The mean twist of a step is computed from both ends, so a step is at most the sample time of the papers' robot.
    c.steps = max(1 if has_no_effects else PARTS, math.ceil(sample_time / load_robot().sample_time - 1e-9))
    matrices: dict[str, FloatArray] = {}
    if isinstance(model, NonlinearModel):
        if not (has_no_effects and math.isclose(sample_time, model.dt, rel_tol=1e-9)):
            raise ModelError(
                f"model '{model.name}' requires samples of {model.dt} s and a base without effects; for samples of "
                f"{sample_time} s use another model, or set sample_time to {model.dt} s"
            )
        c.steps = 1
    else:
        sampled = model.discretise(sample_time / c.steps)
        c.order, c.memory, c.delay = sampled.order, sampled.memory, sampled.delay.tolist()
        matrices = {name: getattr(sampled, name) for name in ("A", "B0", "B1", "C")}
    c.step_time = sample_time / c.steps
    state = {"state": np.zeros((2, c.order)), "commands": np.zeros((c.memory + 1, 2)), "arcs": np.zeros((c.steps, 6))}
    arrays = matrices | state | ({} if disturbance is None else {"rows": disturbance.rows})
    arrays = {name: np.ascontiguousarray(array, dtype=float) for name, array in arrays.items()}
    for name, array in arrays.items():
        setattr(c, name, address(array))
    if disturbance is not None:
        c.count, c.traction_slip, c.yaw_slip = len(disturbance.rows), disturbance.traction_slip, disturbance.yaw_slip
        c.variance, c.max_squares = disturbance.variance.ravel().tolist(), disturbance.largest.tolist()
        c.on_wheels = disturbance.on_wheels
    c.upper, c.lower = _both_sides(effects.twist_range).tolist()
    c.max_rise, c.max_fall = (_both_sides(effects.twist_slew) * c.step_time).tolist()
    if effects.wheel_command is not None:
        wheel_command = effects.wheel_command
        c.track, c.resolution, c.coasting = wheel_command.track, wheel_command.resolution, wheel_command.coasting_speed
        c.max_wheel_speed = wheel_command.top_speed or _NO_LIMIT
    c.relaxation_angle = effects.yaw_relaxation.angle if effects.yaw_relaxation else 0.0
    c.yaw_per_metre = effects.veer.yaw_per_metre if effects.veer else 0.0
    for name in ("longitudinal_gain", "yaw_gain", "side_slip"):
        setattr(c, name, getattr(slip, name))
    if slip.virtual_track is not None:
        c.track_at_rest, c.track_growth = slip.virtual_track.p0, slip.virtual_track.p1
    if slip.polynomial is not None:
        c.polynomial, c.has_polynomial = slip.polynomial.coefficients, 1
    # The structure contains only addresses, so the caller must keep the arrays.
    return c, [*arrays.values()]


def _both_sides(limits: TwistRange | TwistSlew | None) -> FloatArray:
    """Return the limits (2, 2) of v and omega; the rows are the first and second side, see `models.two_sided`."""
    channels: tuple[float | None, float | None] = (None, None) if limits is None else (limits.v, limits.omega)
    sides = [sides_of(math.inf if limit is None else limit) for limit in channels]
    return np.asarray(np.minimum(sides, _NO_LIMIT).T)
