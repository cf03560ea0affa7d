"""Identification of SM, one transfer function for v and one for omega, from records."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import YawSource, twist_experiments
from diffdrive_mpc.models.output_error.input_limits import effects_of
from diffdrive_mpc.models.output_error.parameters import join_estimates
from diffdrive_mpc.models.structures.channel import ChannelForm, IdentifiedChannel, identify_channel
from diffdrive_mpc.models.structures.identified import IdentifiedModel, round_values
from diffdrive_mpc.models.structures.model_file import ModelFile, SmFile
from diffdrive_mpc.models.structures.structure import IdentificationConditions, StructureFit
from diffdrive_mpc.models.structures.two_poles import TWO_POLES
from diffdrive_mpc.models.velocity_model import CHANNELS

METHOD = (
    "output error (simulation from commands alone), {} and a dead time for each channel, all records at once, free "
    "initial states, outliers held back, several starts"
)
"""Description of the method; `{}` is replaced by the form of the channels."""


def identify_sm(
    records: Sequence[Record],
    *,
    yaw: YawSource = "gyro",
    limits: bool | FloatArray = True,
    robust: bool = True,
    form: ChannelForm = TWO_POLES,
    schema: type[ModelFile] = SmFile,
) -> IdentifiedModel:
    """Identify SM (Guffanti et al., Sensors 2025, 25(11), 3553) by output error.

    Parameters
    ----------
    records
        Records with encoders and, if `yaw` is "gyro", a gyro, whose bias is also identified.
    yaw
        Sensor whose omega the model predicts.
    limits
        As for `identify_channels`.
    robust
        True to reduce the weight of single outliers.
    form, schema
        Form of the transfer functions, and schema of a file with this form in `channels`.

    Raises
    ------
    ValueError
        If a record lacks a signal, or the readings or commands never change.
    """
    channels = identify_channels(records, yaw=yaw, limits=limits, robust=robust, form=form)
    fits = dict(zip(CHANNELS, channels, strict=True))
    return IdentifiedModel(
        schema=schema,
        content={
            "dead_time": round_values({name: fit.parameters.value("dead_time") for name, fit in fits.items()}),
            "channels": round_values({name: fit.content for name, fit in fits.items()}),
            "base_effects": round_values(effects_of(np.concatenate([fit.fit.system.limit for fit in channels]))),
        },
        parameters=join_estimates([fit.parameters.renamed(name) for name, fit in fits.items()]),
        offset=np.concatenate([fit.fit.system.offset for fit in channels]),
        yaw=yaw,
        method=METHOD.format(form.description),
        fits=tuple(fit.fit for fit in channels),
        warnings=tuple(warning for fit in channels for warning in fit.warnings),
    )


def identify_channels(
    records: Sequence[Record],
    *,
    yaw: YawSource = "gyro",
    limits: bool | FloatArray = True,
    robust: bool = True,
    form: ChannelForm = TWO_POLES,
) -> tuple[IdentifiedChannel, IdentifiedChannel]:
    """Identify the channels v and omega of SM; other parameters and errors as for `identify_sm`.

    `limits` is True to search for limits of the base, or contains approximate limits (2, 4), as from
    `input_limits.limits_in`, to estimate only those that are finite.
    """
    experiments = twist_experiments(records, yaw)
    v, omega = (
        identify_channel(
            [experiment.channel(row, row) for experiment in experiments],
            channel,
            form=form,
            offset=channel == "omega" and yaw == "gyro",
            limit=limits if isinstance(limits, bool) else limits[row],
            robust=robust,
        )
        for row, channel in enumerate(CHANNELS)
    )
    return v, omega


def identify(records: Sequence[Record], conditions: IdentificationConditions) -> StructureFit:
    """Identify SM; implements `Structure.identify`."""
    return StructureFit(identify_sm(records, yaw=conditions.yaw, limits=conditions.limits))
