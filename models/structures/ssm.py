"""Identification of SSM from records: one state-space model with a dead time for each input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error import doubts
from diffdrive_mpc.models.output_error.experiment import (
    SampledExperiment,
    YawSource,
    join_experiments,
    twist_experiments,
)
from diffdrive_mpc.models.output_error.input_limits import effects_of, limit_names
from diffdrive_mpc.models.output_error.parameters import Layout
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import OutputErrorFit, fit_output_error
from diffdrive_mpc.models.output_error.state_space import (
    LinearSystem,
    LocalStateSpace,
    Realisation,
    balance,
    distinct_poles,
    from_impulse_response,
    impulse_response,
    parallel,
    pole_names,
    pole_numbers,
    real_pole_names,
    spare_state,
)
from diffdrive_mpc.models.output_error.validation import validate
from diffdrive_mpc.models.structures.channel import IdentifiedChannel
from diffdrive_mpc.models.structures.identified import IdentifiedModel, round_values
from diffdrive_mpc.models.structures.model_file import SsmFile
from diffdrive_mpc.models.structures.orders import OrderChoice, block_fit, compare_orders, is_behind
from diffdrive_mpc.models.structures.registry import MAX_ORDER
from diffdrive_mpc.models.structures.sm import identify_channels
from diffdrive_mpc.models.structures.structure import IdentificationConditions, StructureFit
from diffdrive_mpc.models.velocity_model import CHANNELS

METHOD = (
    "output error (simulation from commands alone), state space with a dead time for each input, data driven local "
    "coordinates, all records at once, free initial states, outliers held back; starts from an impulse response "
    "(eigensystem realization), from SM and from the order below"
)
_Channels = tuple[IdentifiedChannel, IdentifiedChannel]
_SM_ORDER = 4
"""Order of SM as a state-space model."""
_MAX_EVALUATIONS = 8
"""Maximum number of evaluations in a round of the search; candidates start near a minimum."""


def identify_ssm(records: Sequence[Record], order: int = 2, *, limits: bool = True) -> IdentifiedModel:
    """Identify SSM of one order by output error.

    Parameters
    ----------
    records
        Records with encoders and a gyro, whose bias is also identified.
    order
        Order, 1 to 5.
    limits
        True to search for limits of the base.

    Raises
    ------
    ValueError
        If the order is out of range, a record lacks a signal, or the readings or commands never change.
    """
    if not 1 <= order <= MAX_ORDER:
        raise ValueError(f"order {order}: give 1 to {MAX_ORDER}")
    return _identify_orders(records, identify_channels(records, limits=limits), order, "gyro")[-1]


def choose_order(
    train: Sequence[Record],
    validation: Sequence[Record] = (),
    *,
    max_order: int = MAX_ORDER,
    yaw: YawSource = "gyro",
    limits: bool | FloatArray = True,
    requested: int | None = None,
) -> OrderChoice:
    """Identify every order up to `max_order` and select one by `compare_orders`.

    SM as a state-space model replaces order 4 and is selected if its delays are well determined and it predicts
    held-out blocks or training records (see `is_behind`) better than the selected order.

    Parameters
    ----------
    train
        Training records.
    validation
        Validation records, which are not used for the selection.
    max_order
        Maximum order, 2 to 5.
    yaw, limits
        As for `identify_channels`.
    requested
        Order to use; None to select it.

    Raises
    ------
    ValueError
        As for `identify_ssm`, or if no order gives a usable model.
    """
    channels = identify_channels(train, yaw=yaw, limits=limits)
    models = _identify_orders(train, channels, max_order, yaw)
    floor = validate(_sm_as_state_space(channels), train, yaw).fit_percent
    choice = compare_orders(models, train, validation, yaw, requested=requested, floor=floor)
    selected = choice.rows[choice.order - 1]
    blocks = selected.block_fit_percent
    if blocks is None or max_order < _SM_ORDER:
        return choice
    experiments = twist_experiments(train, yaw)
    parts = [[part.channel(row, row) for part in join_experiments(experiments)] for row in range(len(channels))]
    simpler = [block_fit(channel.fit, part) for channel, part in zip(channels, parts, strict=True)]
    score = np.concatenate([fit for fit in simpler if fit is not None]).mean()
    if score <= blocks.mean() and not is_behind(selected.train_fit_percent, floor):
        return choice
    fit = _fit(experiments, channels, _SM_ORDER, None, yaw == "gyro", evaluations=1)
    if doubts.uncertain_delays(doubts.response_delays(fit, CHANNELS, [0, 1])):
        return choice
    models[_SM_ORDER - 1] = _build_model(fit, yaw)
    reason = (
        f"SM as a state space, mean FIT {score:.2f} % on held-out blocks; order {choice.order} {blocks.mean():.2f} %"
    )
    return replace(compare_orders(models, train, validation, yaw, requested=_SM_ORDER), reason=reason)


def _identify_orders(
    records: Sequence[Record], channels: _Channels, max_order: int, yaw: YawSource
) -> list[IdentifiedModel]:
    """Identify SSM of every order from 1 to `max_order`; the next lower order provides an initial guess.

    SM also provides an initial guess for order 4. SM is the result if the search ends with a lower FIT (see
    `is_behind`).
    """
    experiments = twist_experiments(records, yaw)
    fits: list[OutputErrorFit] = []
    for order in range(1, max_order + 1):
        fits.append(_fit(experiments, channels, order, fits[-1] if fits else None, yaw == "gyro"))
    models = [_build_model(fit, yaw) for fit in fits]
    # Order 4 contains SM, so its FIT must not be lower than that of SM.
    if max_order >= _SM_ORDER:
        floor, row = validate(_sm_as_state_space(channels), records, yaw).fit_percent, _SM_ORDER - 1
        if is_behind(validate(models[row].system, records, yaw).fit_percent, floor):
            fit = _fit(experiments, channels, _SM_ORDER, None, yaw == "gyro", evaluations=1)
            models[row] = _build_model(fit, yaw)
    return models


def _fit(
    experiments: list[SampledExperiment],
    channels: _Channels,
    order: int,
    below: OutputErrorFit | None,
    offset: bool,
    evaluations: int | None = None,
) -> OutputErrorFit:
    limited = tuple(row for channel in channels for row in channel.fit.layout.limited)
    dead_time = np.array([channel.parameters.value("dead_time") for channel in channels])
    shared = [channels[1].parameters.value("offset")] if offset else []
    shared += [level for channel in channels for level in channel.fit.layout.split(channel.fit.parameters)[-1]]

    def candidate(start: Realisation, dead_time: FloatArray) -> tuple[Layout, FloatArray]:
        space = LocalStateSpace(*start)
        layout = Layout(space, 2, 2, offset=(False, offset), limited=limited)
        return layout, np.concatenate([np.zeros(len(space.names)), dead_time, shared])

    dt = experiments[0].dt
    length = round(estimator_settings().impulse_response / dt)
    candidates = []
    # An even order has one or two poles for each channel, as SM.
    if order % 2 == 0:
        candidates.append(candidate(_side_by_side(channels, order // 2), dead_time))
    scale = np.concatenate([channel.fit.scale for channel in channels])
    trust = [np.concatenate(rows, axis=1) for rows in zip(*(channel.fit.trust for channel in channels), strict=True)]
    if evaluations == 1:
        return fit_output_error(candidates, experiments, scale=scale, trust=trust, evaluations=1)
    direct = from_impulse_response(impulse_response(experiments, dead_time, length), order, dt)
    if direct:
        candidates.append(candidate(direct, dead_time))
    # The next lower order, and one additional state for its residuals, are a further initial guess.
    if below:
        system = below.system
        unexplained = [
            replace(experiment, outputs=residuals, counts=np.isfinite(residuals))
            for experiment, residuals in zip(experiments, below.residuals, strict=True)
        ]
        added = from_impulse_response(impulse_response(unexplained, system.dead_time, length), 1, dt)
        lower = (system.A, system.B, system.C)
        candidates.append(candidate(parallel(lower, added or spare_state(*lower)), system.dead_time))
    if not candidates:
        # One common pole of both channels, for impulse responses that cannot be realised.
        A, B, C = _side_by_side(channels, 1)
        candidates.append(candidate((A[:1, :1], B[:1], C[:, :1]), dead_time))
    return fit_output_error(candidates, experiments, scale=scale, trust=trust, evaluations=_MAX_EVALUATIONS)


def _sm_as_state_space(channels: _Channels) -> LinearSystem:
    """Return SM as one linear system with sensor offsets and limits."""
    parts = [channel.fit.system for channel in channels]
    dead_time, offset, limit = (np.concatenate(rows) for rows in zip(*(part[3:] for part in parts), strict=True))
    return LinearSystem(*_side_by_side(channels, 2), dead_time, offset, limit)


def _side_by_side(channels: _Channels, poles: int) -> Realisation:
    """Combine the transfer functions of both channels, with two poles each, or with one pole of equal lag and gain."""
    parts = []
    for row, channel in enumerate(channels):
        system = channel.fit.system
        A, B, C = system.A, system.B, system.C
        if poles == 1:
            gain, w, damping = (channel.parameters.value(name) for name in ("gain", "natural_frequency", "damping"))
            A, B, C = np.array([[-w / (2 * damping)]]), np.array([[gain * w / (2 * damping)]]), np.eye(1)
        B_part, C_part = np.zeros((len(A), 2)), np.zeros((2, len(A)))
        B_part[:, row], C_part[row] = B[:, 0], C[0]
        parts.append((A, B_part, C_part))
    return balance(*parallel(*parts))


def _build_model(fit: OutputErrorFit, yaw: YawSource) -> IdentifiedModel:
    system = fit.system
    A, B, C = balance(system.A, system.B, system.C)
    order = len(A)
    label = f"SSM order {order}"
    gain_count, _, offsets, _ = fit.layout.counts
    poles = distinct_poles(A)
    gains = [f"gain.{source}_ref_to_{target}" for target in CHANNELS for source in CHANNELS]
    named_poles = pole_names(poles)
    rest = [f"dead_time.{name}" for name in CHANNELS] + ["omega.offset"] * offsets
    rest += limit_names(fit.layout.limited)

    def physical(parameters: FloatArray) -> FloatArray:
        system = fit.layout.system(parameters)
        gain = -system.C @ np.linalg.solve(system.A, system.B)
        return np.concatenate([gain.ravel(), pole_numbers(system.A, poles), parameters[gain_count:]])

    parameters = fit.derived((*gains, *named_poles, *rest), physical)
    main = parameters.part([gains[0], gains[3], *(name for name in named_poles if not name.endswith("imag"))])
    delays = doubts.response_delays(fit, CHANNELS, [0, 1])
    return IdentifiedModel(
        schema=SsmFile,
        content={
            "dead_time": round_values(dict(zip(CHANNELS, system.dead_time, strict=True))),
            "A": round_values(A),
            "B": round_values(B),
            "C": round_values(C),
            "base_effects": round_values(effects_of(system.limit)),
        },
        parameters=parameters,
        offset=np.asarray(system.offset),
        yaw=yaw,
        method=f"{METHOD}; order {order}",
        fits=(fit,),
        warnings=(
            *doubts.parameters_at_bounds(fit, label),
            *(
                doubt.about(label)
                for doubt in (*doubts.uncertain_parameters(main, delays=delays), *doubts.uncertain_delays(delays))
            ),
            *doubts.merged_poles(parameters.part(real_pole_names(named_poles)), label),
        ),
    )


def identify(records: Sequence[Record], conditions: IdentificationConditions) -> StructureFit:
    """Identify SSM; implements `Structure.identify`."""
    order = conditions.order
    # Order 1 is only a baseline, so the maximum is at least order 2.
    maximum = max(order or MAX_ORDER, 2)
    choice = choose_order(
        records, conditions.validation, max_order=maximum, yaw=conditions.yaw, limits=conditions.limits, requested=order
    )
    return StructureFit(choice.identified, choice)
