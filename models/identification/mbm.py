"""MBM from records: a transfer function for each motor, and the two tracks around them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.identification import doubts
from diffdrive_mpc.models.identification.channel import ChannelEstimate, identify_channel
from diffdrive_mpc.models.identification.estimate import Estimate, joined
from diffdrive_mpc.models.identification.identified import IdentifiedModel, rounded
from diffdrive_mpc.models.identification.output_error.layout import Layout
from diffdrive_mpc.models.identification.output_error.motors import MotorsStructure
from diffdrive_mpc.models.identification.output_error.solve import OutputErrorFit, estimate
from diffdrive_mpc.models.identification.output_error.stretch import Stretch
from diffdrive_mpc.models.identification.output_error.structures import two_poles, two_poles_parameters
from diffdrive_mpc.models.identification.signals import twist_stretches, wheel_stretches
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.structures import Motors, TwoPoles
from diffdrive_mpc.models.velocity_model import CHANNELS

METHOD = (
    "output error (simulation from commands alone), two poles and no zeros for each motor, one dead time, firmware "
    "track with them; effective track from the steady yaw gain of the gyro; all records at once, free initial states, "
    "outliers held back"
)
_MOTORS = tuple(Motors.model_fields)
_SIDES = (-1, 1, -1, 1)


def identify_mbm(records: Sequence[Record], wheel_radius: float, *, robust: bool = True) -> IdentifiedModel:
    """Identify MBM (Guffanti et al., Sensors 2025, 25(11), 3553) by output error.

    The effective track is the one for which the motors' steady turning rate becomes that of the gyro, whatever the two
    sensors' delays are.

    Parameters
    ----------
    records
        Records with wheel speeds and a gyro. Where only two sides were logged, front and rear motor of
        a side are equal.
    wheel_radius
        [m], as the robot's firmware has it.
    robust
        Whether single outliers are held back.

    Raises
    ------
    ValueError
        If a record lacks a signal, or the robot or its commands never move.
    """
    stretches = wheel_stretches(records)
    yaw = identify_channel(
        [stretch.channel(1, 1) for stretch in twist_stretches(records)],
        "omega",
        offset=True,
        limit=False,
        robust=robust,
    )
    sides = _SIDES[: stretches[0].outputs.shape[1]]
    layout = Layout(MotorsStructure(sides, wheel_radius), 2, len(sides), shared_dead_time=True)
    fit = estimate([(layout, _start(stretches, sides, wheel_radius, robust))], stretches, robust)
    parameters = _with_effective_track(joined([_physical(fit, len(sides)), _yaw_gain(yaw)]), len(sides))
    motors = {
        name: {key: parameters.value(f"{_MOTORS[i % len(sides)]}.{key}") for key in TwoPoles.model_fields}
        for i, name in enumerate(_MOTORS)
    }
    dead_time = parameters.value("dead_time")
    return IdentifiedModel(
        structure="mbm",
        content={
            "dead_time": rounded(dict.fromkeys(CHANNELS, dead_time)),
            "motors": rounded(motors),
            "wheel_radius": wheel_radius,
            "firmware_track": rounded(parameters.value("firmware_track")),
            "effective_track": rounded(parameters.value("effective_track")),
        },
        parameters=parameters,
        offset=np.array([0.0, yaw.parameters.value("offset")]),
        limits={},
        yaw="gyro",
        method=METHOD,
        fits=(fit, yaw.fit),
        warnings=(
            *doubts.at_bounds(fit, "motors"),
            *(f"motors: {sentence}" for sentence in doubts.badly_known(parameters.part(_doubtful(parameters)))),
            *doubts.hardly_identifiable(fit, "motors"),
        ),
    )


def _start(stretches: Sequence[Stretch], sides: tuple[int, ...], radius: float, robust: bool) -> FloatArray:
    """Forward motion gives a motor for all, turning the track."""
    forward = [_combined(stretch, np.full(len(sides), radius / len(sides)), 0) for stretch in stretches]
    turning = [_combined(stretch, np.array(sides) * 2 * radius / len(sides), 1) for stretch in stretches]
    v = identify_channel(forward, "wheels", limit=False, robust=robust).parameters
    omega = identify_channel(turning, "wheels' difference", limit=False, robust=robust).parameters
    motor = two_poles_parameters(*(v.value(key) for key in TwoPoles.model_fields))
    track = np.log(omega.value("gain") / v.value("gain"))
    return np.concatenate([np.tile(motor, len(sides)), [track, v.value("dead_time")]])


def _combined(stretch: Stretch, weights: FloatArray, column: int) -> Stretch:
    """One command against a weighted sum of the wheels."""
    return Stretch(
        stretch.name,
        stretch.dt,
        stretch.inputs[:, column : column + 1],
        (stretch.outputs @ weights)[:, None],
        np.asarray(stretch.counts.all(axis=1, keepdims=True)),
    )


def _physical(fit: OutputErrorFit, motors: int) -> Estimate:
    names = [f"{motor}.{key}" for motor in _MOTORS[:motors] for key in TwoPoles.model_fields]

    def physical(row: FloatArray) -> FloatArray:
        each = [two_poles(row[3 * i : 3 * i + 3]) for i in range(motors)]
        return np.concatenate([*each, np.exp(row[3 * motors : 3 * motors + 1]), row[3 * motors + 1 :]])

    return Estimate(fit.layout.names, fit.parameters, fit.covariance).derived(
        (*names, "firmware_track", "dead_time"), physical
    )


def _yaw_gain(yaw: ChannelEstimate) -> Estimate:
    return yaw.parameters.part(["gain", "offset"]).renamed("omega")


def _with_effective_track(found: Estimate, motors: int) -> Estimate:
    """The yaw gain of the gyro turned into a track: firmware track times the motors' mean gain over the yaw gain."""
    gains = [found.names.index(f"{motor}.gain") for motor in _MOTORS[:motors]]
    track, yaw = found.names.index("firmware_track"), found.names.index("omega.gain")

    def exchanged(row: FloatArray) -> FloatArray:
        changed = row.copy()
        changed[yaw] = row[track] * row[gains].mean() / row[yaw]
        return changed

    names = tuple("effective_track" if name == "omega.gain" else name for name in found.names)
    return found.derived(names, exchanged)


def _doubtful(parameters: Estimate) -> list[str]:
    """An offset or a dead time near zero is no doubt about the model."""
    return [name for name in parameters.names if name not in ("omega.offset", "dead_time")]
