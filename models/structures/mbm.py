"""Identification of MBM from records: four motors between inverse and forward wheel kinematics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.interface import AnyArray, FloatArray
from diffdrive_mpc.models.logs.geometry import WheelGeometry, firmware_track, wheel_geometry
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error import doubts
from diffdrive_mpc.models.output_error.experiment import wheel_experiments
from diffdrive_mpc.models.output_error.input_limits import effects_of, limit_names
from diffdrive_mpc.models.output_error.parameters import Layout, ParameterEstimate, join_estimates
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import OutputErrorFit, fit_output_error
from diffdrive_mpc.models.structures.channel import IdentifiedChannel
from diffdrive_mpc.models.structures.identified import IdentifiedModel, round_values
from diffdrive_mpc.models.structures.model_file import MbmFile, Motors, TwoPoles
from diffdrive_mpc.models.structures.sm import identify_channels
from diffdrive_mpc.models.structures.structure import IdentificationConditions, StructureFit
from diffdrive_mpc.models.structures.two_poles import TWO_POLES
from diffdrive_mpc.models.velocity_model import CHANNELS

METHOD = (
    "output error (simulation from commands alone), two poles and no zeros for each motor, a dead time for each "
    "command, firmware track with them; effective track from the steady yaw gain of the gyro; all records at once, "
    "free initial states, outliers held back"
)
SIDES = (-1, 1, -1, 1)
"""-1 (left) or 1 (right) for each motor."""
MOTORS = tuple(Motors.model_fields)


@dataclass(frozen=True)
class MotorsParametrisation:
    """Transfer function with two poles for each motor, and firmware track, with inputs v_ref and omega_ref.

    Attributes
    ----------
    sides
        -1 (left) or 1 (right) for each motor.
    radius
        Wheel radius with which the firmware converts rim speeds to wheel rates [m].
    """

    sides: tuple[int, ...]
    radius: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of three parameters for each motor, and of the firmware track."""
        return (*(f"{name}_{i}" for i in range(len(self.sides)) for name in TWO_POLES.names), "log_track")

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds (3 motors + 1,) from the settings."""
        low, high = TWO_POLES.bounds
        track = np.log(estimator_settings().track)
        count = len(self.sides)
        return np.append(np.tile(low, count), track[0]), np.append(np.tile(high, count), track[1])

    def matrices(self, parameters: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Compute A (2 motors, 2 motors), B (2 motors, 2), C (motors, 2 motors)."""
        count = len(self.sides)
        A = np.zeros((2 * count, 2 * count), dtype=parameters.dtype)
        B, C = np.zeros((2 * count, 2), dtype=parameters.dtype), np.zeros((count, 2 * count), dtype=parameters.dtype)
        track = np.exp(parameters[-1])
        for i, (side, motor) in enumerate(zip(self.sides, parameters[:-1].reshape(count, -1), strict=True)):
            rows = slice(2 * i, 2 * i + 2)
            A[rows, rows], b, C[i : i + 1, rows] = TWO_POLES.matrices(motor)
            # The set-point of the wheel is its rim speed, v + side track omega / 2, divided by the radius.
            B[rows] = b * np.array([1.0, 0.5 * side * track]) / self.radius
        return A, B, C

    def recentred(self, parameters: FloatArray) -> tuple[MotorsParametrisation, FloatArray]:
        """Return the parametrisation unchanged, because logarithms are well scaled for all values."""
        return self, parameters


def identify_mbm(records: Sequence[Record], wheel_radius: float, *, limits: bool = True) -> IdentifiedModel:
    """Identify MBM (Guffanti et al., Sensors 2025, 25(11), 3553) by output error.

    The effective track is the ratio of the motors' steady speed difference to the yaw rate of the gyro, which does not
    depend on the delays of the two sensors.

    Parameters
    ----------
    records
        Records with wheel speeds and a gyro. If the log has only one speed per side, front and rear motor of a side are
        assumed to be equal.
    wheel_radius
        Wheel radius in the robot's firmware [m].
    limits
        True to search for limits of the base.

    Raises
    ------
    ValueError
        If a record lacks a signal, or the readings or commands never change.
    """
    experiments = wheel_experiments(records)
    v, yaw = identify_channels(records, limits=limits)
    sides = SIDES[: experiments[0].outputs.shape[1]]
    geometry = wheel_geometry(records) or WheelGeometry(wheel_radius, 1.0)
    track = firmware_track(records, geometry, np.diag([channel.content["gain"] for channel in (v, yaw)]))
    fit = fit_output_error([_start(sides, wheel_radius, track or geometry.track, v, yaw)], experiments)
    turning = yaw.parameters.part(["gain", "offset"]).renamed("omega")
    parameters = _with_effective_track(join_estimates([_physical_parameters(fit, len(sides)), turning]), len(sides))
    motors = {
        name: {key: parameters.value(f"{MOTORS[i % len(sides)]}.{key}") for key in TwoPoles.model_fields}
        for i, name in enumerate(MOTORS)
    }
    return IdentifiedModel(
        schema=MbmFile,
        content={
            "dead_time": round_values({name: parameters.value(f"{name}.dead_time") for name in CHANNELS}),
            "motors": round_values(motors),
            "wheel_radius": wheel_radius,
            "firmware_track": round_values(parameters.value("firmware_track")),
            "effective_track": round_values(parameters.value("effective_track")),
            "base_effects": round_values(effects_of(fit.system.limit)),
        },
        parameters=parameters,
        offset=np.array([0.0, yaw.parameters.value("offset")]),
        yaw="gyro",
        method=METHOD,
        fits=(fit, yaw.fit),
        warnings=_warnings(fit, parameters, len(sides)),
    )


def _warnings(fit: OutputErrorFit, parameters: ParameterEstimate, motors: int) -> tuple[Doubt, ...]:
    delays = doubts.response_delays(fit, MOTORS[:motors], [0] * motors)
    # Offset and dead time may be near zero, where a large relative deviation does not indicate a poor model.
    nonzero = [name for name in parameters.names if not name.endswith(("offset", "dead_time"))]
    unclear = [*doubts.uncertain_parameters(parameters.part(nonzero), delays=delays), *doubts.uncertain_delays(delays)]
    return (
        *doubts.parameters_at_bounds(fit, "motors"),
        *(doubt.about("motors") for doubt in unclear),
        *doubts.poorly_determined(fit, "motors"),
    )


def _start(
    sides: tuple[int, ...], radius: float, track: float, v: IdentifiedChannel, yaw: IdentifiedChannel
) -> tuple[Layout, FloatArray]:
    """Return the layout and initial parameters, from the channels of SM and the track of the firmware [m]."""
    motor = TWO_POLES.parameters(np.array(list(v.content.values())))
    limited = (*v.fit.layout.limited, *yaw.fit.layout.limited)
    levels = [level for channel in (v, yaw) for level in channel.fit.layout.split(channel.fit.parameters)[-1]]
    dead_time = [channel.parameters.value("dead_time") for channel in (v, yaw)]
    layout = Layout(MotorsParametrisation(sides, radius), 2, len(sides), limited=limited)
    return layout, np.concatenate([np.tile(motor, len(sides)), [np.log(track)], dead_time, levels])


def _physical_parameters(fit: OutputErrorFit, motors: int) -> ParameterEstimate:
    names = [f"{motor}.{key}" for motor in MOTORS[:motors] for key in TwoPoles.model_fields]
    names += ["firmware_track", *(f"{channel}.dead_time" for channel in CHANNELS), *limit_names(fit.layout.limited)]

    def physical(row: FloatArray) -> FloatArray:
        motor_parameters, dead_time, _, levels = fit.layout.split(row)
        each = [TWO_POLES.values(motor) for motor in motor_parameters[:-1].reshape(motors, -1)]
        return np.concatenate([*each, np.exp(motor_parameters[-1:]), dead_time, levels])

    return fit.estimate.derived(names, physical)


def _with_effective_track(estimate: ParameterEstimate, motors: int) -> ParameterEstimate:
    """Replace the yaw gain by the effective track: firmware track times mean gain of the motors over yaw gain."""
    gains = [estimate.names.index(f"{motor}.gain") for motor in MOTORS[:motors]]
    track, yaw = estimate.names.index("firmware_track"), estimate.names.index("omega.gain")

    def replace_gain(row: FloatArray) -> FloatArray:
        replaced = row.copy()
        replaced[yaw] = row[track] * row[gains].mean() / row[yaw]
        return replaced

    names = tuple("effective_track" if name == "omega.gain" else name for name in estimate.names)
    return estimate.derived(names, replace_gain)


def identify(records: Sequence[Record], conditions: IdentificationConditions) -> StructureFit:
    """Identify MBM; implements `Structure.identify`."""
    return StructureFit(identify_mbm(records, required_radius(conditions)))


def required_radius(conditions: IdentificationConditions) -> float:
    """Return the wheel radius [m]; raise ConfigError if the log lacks wheel speeds or a gyro."""
    if conditions.wheel_radius is None or conditions.yaw != "gyro":
        raise ConfigError("mbm: the log needs wheel speeds and a gyro; map them, or identify sm or ssm")
    return conditions.wheel_radius
