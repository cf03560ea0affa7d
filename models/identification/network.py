"""A network on past commands from records, beside the linear model that limits, tracks and poses come from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from diffdrive_mpc.models.identification.fitting import Fitted, scored
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.networks.network import Architecture, Network
from diffdrive_mpc.models.networks.training import method, train
from diffdrive_mpc.models.networks.training_settings import TrainingSettings, training_settings
from diffdrive_mpc.models.networks.windows import divided, windows_of
from diffdrive_mpc.models.output_error.experiment import YawSource, joined, parted, twist_experiments


@dataclass(frozen=True)
class TrainedNetwork:
    """A network, and how it was trained in words."""

    network: Network
    method: str


def with_network(
    data: LogData,
    fitted: Fitted,
    settings: TrainingSettings | None = None,
    on_look: Callable[[int], None] | None = None,
) -> Fitted:
    """`fitted` with a network trained on the same records, and its scores and outputs in place of the linear model's.

    The last part of the records in time tells when to stop; the records held out are not looked at.

    Parameters
    ----------
    data
        The records.
    fitted
        What was made of them without a network.
    settings
        By default the shipped ones.
    on_look
        Called with the steps done, now and then.

    Raises
    ------
    models.errors.MissingPackageError
        If what trains is not installed.
    ValueError
        If the records are too few.
    """
    chosen, kind, yaw = settings or training_settings(), Architecture(), fitted.identified.yaw
    first, second, _ = chosen.shares
    shares = (first / (first + second), second / (first + second))
    chosen = chosen.model_copy(update={"shares": shares})
    started = perf_counter()
    windows = windows_of(joined(twist_experiments(data.train, yaw)), kind.window)
    training, validation = divided(windows, shares)
    told = (lambda steps, _: on_look(steps)) if on_look else None
    found = train(kind, training, validation, chosen, told)
    seconds = perf_counter() - started
    simulated = [simulate_records(found.network, records, yaw) for records in (data.train, data.validation)]
    both = ((data.train, "training"), (data.validation, "validation"))
    scores = [scored(outputs, records, yaw, name) for outputs, (records, name) in zip(simulated, both, strict=True)]
    return replace(
        fitted,
        network=TrainedNetwork(found.network, method(kind, chosen, found)),
        train=scores[0],
        validation=scores[1],
        simulated=tuple(simulated[1]),
        seconds=fitted.seconds + seconds,
    )


def simulate_records(network: Network, records: Sequence[Record], yaw: YawSource) -> list[FloatArray]:
    """For each record v [m/s] and omega [rad/s] (K, 2) from its commands alone; before them, the first one held."""
    experiments, window = twist_experiments(records, yaw), network.architecture.window
    runs = joined(experiments)
    rows = [network.simulate(run.inputs, np.tile(run.inputs[0], (window, 1))) for run in runs]
    return parted(rows, experiments)
