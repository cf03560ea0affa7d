"""Drive models with dead time and slope limits, as velocity models of the controller and of plants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Protocol

import casadi as ca
import numpy as np
from pydantic import Field
from scipy.linalg import expm

from diffdrive_mpc.models.checked_yaml import StrictModel, check
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.robot import NotNegative, Positive
from diffdrive_mpc.models.structures.model_file import FunctionFile, write_parameters

_CORNER = 4
"""Even power of the rounded limit: at the corner it gives 2^(-1/4) = 84 % of the limit."""


class DriveFunctions(Protocol):
    """Functions in the equations of a drive, exact or smooth."""

    def limited(self, x: ca.SX) -> ca.SX:
        """Clip x to -1 to 1."""
        ...

    def size(self, x: ca.SX, width: float) -> ca.SX:
        """Compute |x|, rounded over `width`."""
        ...

    def sign(self, x: ca.SX, width: float) -> ca.SX:
        """Compute the sign of x."""
        ...

    def positive(self, x: ca.SX) -> ca.SX:
        """Return the positive part of x, which is between -1 and 1."""
        ...

    def exceeds(self, x: ca.SX, width: float) -> ca.SX:
        """Return 1 for positive x, and 0 otherwise."""
        ...


class Sharp:
    """Exact functions, for plants."""

    def limited(self, x: ca.SX) -> ca.SX:
        """Clip as in `DriveFunctions`."""
        return ca.fmin(1, ca.fmax(-1, x))

    def size(self, x: ca.SX, width: float) -> ca.SX:  # noqa: ARG002 - exact
        """Compute the size as in `DriveFunctions`."""
        return ca.fabs(x)

    def sign(self, x: ca.SX, width: float) -> ca.SX:  # noqa: ARG002
        """Compute the sign as in `DriveFunctions`."""
        return ca.sign(x)

    def positive(self, x: ca.SX) -> ca.SX:
        """Return the positive part as in `DriveFunctions`."""
        return ca.fmax(x, 0)

    def exceeds(self, x: ca.SX, width: float) -> ca.SX:  # noqa: ARG002
        """Compare as in `DriveFunctions`."""
        return ca.if_else(x > 0, 1, 0)


class Smooth:
    """Smooth functions, for the controller: algebraic limit, |x| as a root, signs and thresholds as tanh.

    For a robot at rest the limit has slope 1, and size and sign are 0.
    """

    def limited(self, x: ca.SX) -> ca.SX:
        """Clip as in `DriveFunctions`."""
        return x * (1 + x**_CORNER) ** (-1 / _CORNER)

    def size(self, x: ca.SX, width: float) -> ca.SX:
        """Compute the size as in `DriveFunctions`."""
        return ca.sqrt(x**2 + width**2) - width

    def sign(self, x: ca.SX, width: float) -> ca.SX:
        """Compute the sign as in `DriveFunctions`."""
        return ca.tanh(x / width)

    def positive(self, x: ca.SX) -> ca.SX:
        """Return the positive part as in `DriveFunctions`."""
        small = 0.05
        return (ca.sqrt(x**2 + small**2) + x - small) / 2

    def exceeds(self, x: ca.SX, width: float) -> ca.SX:
        """Compare as in `DriveFunctions`."""
        return (1 + ca.tanh(x / width)) / 2


# Step of one channel of a drive, v or omega: the slope-limited reference, and the response of the robot.


STATES = 4
"""Number of states of a channel; the first two are the slope-limited reference and the speed."""
SLOPE_LAG = 0.1
"""Time constant of the estimated slope of the reference [s]; equal to the sample time of the paper."""
FORGETTING = 10.0
"""Time constant with which the last direction of travel decays at rest [s], so that the state is not kept forever."""


class Channel(NamedTuple):
    """Constants of a channel in addition to the coefficients of its model."""

    dt: float
    """Sample time [s]."""
    still: float
    """Speed below which the robot is at rest [m/s or rad/s]; also the width over which kinks are smoothed."""


def experimental_step(channel: Channel, *, sharp: bool) -> ca.Function:
    """Build the step x, u, c -> x one sample later of the experimental model (section 2.2, Figure 8).

    x: slope-limited reference, speed, slope of the reference, last direction of travel (-1 to 1). u: command after the
    dead time. c: gain [-], maximum slope when accelerating and when decelerating, lag [s], threshold at slope zero and
    its growth with the slope [s]. After a change of direction the robot stands still while the reference rises and is
    below the threshold.
    """
    shapes: DriveFunctions = Sharp() if sharp else Smooth()
    x, u, c = ca.SX.sym("x", STATES), ca.SX.sym("u"), ca.SX.sym("c", 6)
    reference, speed, slope, direction = ca.vertsplit(x)
    gain, quicker, slower, lag, threshold, threshold_by_slope = ca.vertsplit(c)
    dt, still = channel
    ramped = _limit_slope(shapes, channel, reference, u, quicker, slower)
    slope = slope + (1 - np.exp(-dt / SLOPE_LAG)) * (shapes.size((ramped - reference) / dt, still / SLOPE_LAG) - slope)
    # The threshold acts only against the last direction, while the reference rises and is below the threshold.
    against = shapes.positive(-direction * shapes.sign(ramped, still))
    steady = still / SLOPE_LAG
    rising = shapes.exceeds(slope - steady, steady)
    below = shapes.exceeds(threshold + threshold_by_slope * slope - shapes.size(ramped, still), still)
    speed = speed + (1 - ca.exp(-dt / lag)) * (gain * ramped * (1 - against * rising * below) - speed)
    # The high power keeps small speeds below the threshold from counting as travel.
    pace = speed / (2 * still)
    moving = shapes.exceeds(shapes.size(speed, still) - still, still) if sharp else pace**4 / (pace**4 + 1)
    direction = direction * np.exp(-dt / FORGETTING)
    direction = direction + moving * (shapes.sign(speed, still) - direction)
    after = ca.vertcat(ramped, speed, slope, direction)
    return ca.Function("step", [x, u, c], [after], ["x", "u", "c"], ["after"])


def physical_step(channel: Channel, *, sharp: bool) -> ca.Function:
    """Build the step x, u, c -> x one sample later of the physical model (equations 14 to 17, PI control, lag).

    x: slope-limited reference, speed, torque and integral of the error of `wheel_response`. u: command after the dead
    time. c: gain [-], maximum slope when accelerating and when decelerating, then the response by columns (3, 4).
    """
    shapes: DriveFunctions = Sharp() if sharp else Smooth()
    x, u, c = ca.SX.sym("x", STATES), ca.SX.sym("u"), ca.SX.sym("c", 15)
    gain, quicker, slower = ca.vertsplit(c[:3])
    ramped = _limit_slope(shapes, channel, x[0], u, quicker, slower)
    after = ca.vertcat(ramped, ca.reshape(c[3:], 3, 4) @ ca.vertcat(x[1:], gain * ramped))
    return ca.Function("step", [x, u, c], [after], ["x", "u", "c"], ["after"])


def wheel_response(
    stiffness: float, friction: float, integral_time: float, actuator_lag: float, dt: float
) -> FloatArray:
    """Compute the discrete response (3, 4) of both wheels in common or differential mode: state (3), held reference.

    The sum and the difference of equations 14 and 15 decouple the wheels, with the inertias (A + B) and (A - B).
    Divided by the inertia: speed' = torque - friction speed; integral' = error;
    torque' = (stiffness (error + integral / integral_time) - torque) / actuator_lag.

    Parameters
    ----------
    stiffness
        Controller gain divided by inertia [1/s].
    friction
        Viscous friction divided by inertia [1/s].
    integral_time, actuator_lag, dt
        Integral time of the controller, lag of the actuator, and sample time [s].
    """
    continuous = np.array(
        [
            [-friction, 1.0, 0.0, 0.0],
            [
                -stiffness / actuator_lag,
                -1 / actuator_lag,
                stiffness / integral_time / actuator_lag,
                stiffness / actuator_lag,
            ],
            [-1.0, 0.0, 0.0, 1.0],
            [0.0, 0.0, 0.0, 0.0],
        ]
    )
    return np.asarray(expm(dt * continuous)[:3])


def _limit_slope(
    shapes: DriveFunctions, channel: Channel, reference: ca.SX, u: ca.SX, quicker: ca.SX, slower: ca.SX
) -> ca.SX:
    """Advance the reference towards `u` by one sample, with slopes up to `quicker` and, towards zero, `slower`."""
    dt, still = channel
    towards_zero = (1 - shapes.sign(reference, still) * shapes.sign(u - reference, still)) / 2
    max_change = dt * (quicker + (slower - quicker) * towards_zero)
    return reference + max_change * shapes.limited((u - reference) / max_change)


Kind = Literal["drive_experimental", "drive_physical"]
STEPS = {"drive_experimental": experimental_step, "drive_physical": physical_step}
"""Step function of one channel, by kind of model."""


@dataclass(frozen=True, eq=False, repr=False)
class DriveModel(NonlinearModel):
    """`NonlinearModel` with an additional exact step for plants; built by `drive_model`.

    Attributes
    ----------
    kind
        Kind of the model.
    sharp
        Exact step without smoothing.
    """

    kind: Kind = field(kw_only=True)
    sharp: ca.Function = field(kw_only=True)

    @property
    def structure(self) -> str:
        """Name of the kind for tables and files."""
        return self.kind

    @property
    def plant_step(self) -> ca.Function:
        """Exact step; a simulated robot needs no derivatives."""
        return self.sharp


def drive_model(
    name: str,
    kind: Kind,
    dt: float,
    dead_samples: Sequence[int],
    still: Sequence[float],
    coefficients: Sequence[FloatArray],
    provenance: Mapping[str, object] | None = None,
) -> DriveModel:
    """Build the velocity model of two channels.

    Parameters
    ----------
    dt
        Sample time [s].
    dead_samples, still, coefficients
        Values for v and omega: dead time in samples, `still` of `Channel`, and the coefficients c of the step.

    Raises
    ------
    ModelError
        Under the conditions of `NonlinearModel`.
    """
    memory = max(1, *dead_samples)
    x, window = ca.SX.sym("x", 2 * STATES), ca.SX.sym("window", 2 * (memory + 1))
    steps = []
    for sharp in (False, True):
        after = [
            STEPS[kind](Channel(dt, still[row]), sharp=sharp)(
                x[STATES * row : STATES * (row + 1)], window[2 * (memory - dead_samples[row]) + row], coefficients[row]
            )
            for row in (0, 1)
        ]
        steps.append(ca.Function("step", [x, window], [ca.vertcat(*after)], ["x", "window"], ["after"]))
    output = ca.Function("output", [x], [x[[1, STATES + 1]]], ["x"], ["y"])
    return DriveModel(name, steps[0], output, dt, memory, kind=kind, sharp=steps[1], provenance=dict(provenance or {}))


def settled_state(kind: Kind, speed: float, coefficients: FloatArray) -> FloatArray:
    """Compute the steady state (4,) of a channel at a constant `speed` [m/s or rad/s]."""
    reference = speed / coefficients[0]
    if kind == "drive_experimental":
        return np.array([reference, speed, 0.0, np.sign(speed)])
    response = coefficients[3:].reshape(4, 3).T
    rest = np.linalg.lstsq(
        (np.eye(3) - response[:, :3])[:, 1:], (response[:, 3] - np.eye(3)[:, 0] + response[:, 0]) * speed, rcond=None
    )[0]
    return np.array([reference, speed, *rest])


# Parameter files of drive models.


_HEAD = "A drive model: dead time in samples, slopes [m/s^2, rad/s^2], times [s], SI units elsewhere."
Samples = Annotated[int, Field(ge=0, le=100)]


class DriveChannel(StrictModel):
    """Parameters of a channel in both models; lengths in m for v, angles in rad for omega."""

    gain: Positive = Field(description="ratio of speed to reference; not in the paper [-]")
    dead_samples: Samples = Field(description="dead time in samples [-]")
    quicker: Positive = Field(description="maximum slope when accelerating [m/s^2 or rad/s^2]")
    slower: Positive = Field(description="maximum slope when decelerating [m/s^2 or rad/s^2]")
    still: Positive = Field(
        description="speed below which the robot is at rest; also the width over which kinks are smoothed"
    )


class ExperimentalChannel(DriveChannel):
    """Parameters of a channel of the experimental model."""

    lag: Positive = Field(description="first-order lag [s]")
    threshold: NotNegative = Field(description="threshold of the reference after a change of direction, at slope zero")
    threshold_by_slope: NotNegative = Field(description="growth of the threshold with the slope of the reference [s]")


class DriveChassis(StrictModel):
    """Parameters of the chassis, and the inertias of equations 16 and 17."""

    mass: Positive = Field(description="mass m [kg]")
    wheel_radius: Positive = Field(description="wheel radius r [m]")
    track: Positive = Field(description="track b [m]")
    centre_ahead: float = Field(ge=-100, le=100, description="distance d of the centre of mass ahead of the axle [m]")
    yaw_inertia: Positive = Field(description="yaw inertia I_A [kg m^2]")
    wheel_inertia: NotNegative = Field(description="inertia I_0 of a wheel with its rotor [kg m^2]")

    @property
    def direct(self) -> float:
        """Inertia A of equation 16 [kg m^2]."""
        return self._forward + self._turning + self.wheel_inertia

    @property
    def cross(self) -> float:
        """Inertia B of equation 17 [kg m^2]."""
        return self._forward - self._turning

    @property
    def _forward(self) -> float:
        return self.mass * self.wheel_radius**2 / 4

    @property
    def _turning(self) -> float:
        return (self.yaw_inertia + self.mass * self.centre_ahead**2) * self.wheel_radius**2 / self.track**2


class WheelDrive(StrictModel):
    """Parameters of the PI speed control of a wheel and of its actuator."""

    proportional_gain: Positive = Field(description="torque per speed error, K_R with motor and gear [N m s/rad]")
    integral_time: Positive = Field(description="integral time T_I [s]")
    actuator_lag: Positive = Field(description="actuator lag T_A [s]")
    friction: NotNegative = Field(description="viscous friction K [N m s/rad]")


class ExperimentalFile(FunctionFile):
    """Parameter file of an experimental drive model."""

    structure: Literal["drive_experimental"]
    v: ExperimentalChannel
    omega: ExperimentalChannel

    def coefficients(self) -> list[FloatArray]:
        """Return the coefficients of the steps of both channels."""
        return [
            np.array(
                [
                    channel.gain,
                    channel.quicker,
                    channel.slower,
                    channel.lag,
                    channel.threshold,
                    channel.threshold_by_slope,
                ]
            )
            for channel in (self.v, self.omega)
        ]


class PhysicalFile(FunctionFile):
    """Parameter file of a physical drive model."""

    structure: Literal["drive_physical"]
    chassis: DriveChassis
    wheel_drive: WheelDrive
    v: DriveChannel
    omega: DriveChannel

    def coefficients(self) -> list[FloatArray]:
        """Return the coefficients of the steps of both channels."""
        drive, direct, cross = self.wheel_drive, self.chassis.direct, self.chassis.cross
        return [
            np.concatenate(
                [
                    [channel.gain, channel.quicker, channel.slower],
                    wheel_response(
                        drive.proportional_gain / inertia,
                        drive.friction / inertia,
                        drive.integral_time,
                        drive.actuator_lag,
                        self.sample_time,
                    ).T.ravel(),
                ]
            )
            for channel, inertia in ((self.v, direct + cross), (self.omega, direct - cross))
        ]


DRIVE_FILES: dict[str, type[ExperimentalFile] | type[PhysicalFile]] = {
    "drive_experimental": ExperimentalFile,
    "drive_physical": PhysicalFile,
}
"""Schema of the parameter file, by its key `structure`."""


def load_drive(path: Path, data: Any) -> DriveModel:  # noqa: ANN401 - YAML data
    """Load the model of the parameter file at `path` with the content `data`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file is invalid.
    models.velocity_model.ModelError
        If the parameters are not physically possible.
    """
    return drive_of(check(DRIVE_FILES[data["structure"]], data, str(path)))


def drive_of(content: ExperimentalFile | PhysicalFile) -> DriveModel:
    """Build the model of a parameter file; raises ModelError if the parameters are not physically possible."""
    channels: tuple[DriveChannel, DriveChannel] = (content.v, content.omega)
    return drive_model(
        content.name,
        content.structure,
        content.sample_time,
        [channel.dead_samples for channel in channels],
        [channel.still for channel in channels],
        content.coefficients(),
        content.origins,
    )


def write_drive(path: Path, content: ExperimentalFile | PhysicalFile) -> None:
    """Write a parameter file; raises OSError if the file cannot be written."""
    write_parameters(path, _HEAD, content)
