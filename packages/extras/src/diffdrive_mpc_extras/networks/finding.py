"""A network on past commands from records."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.identification.fit.fitting import Fitted
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.output_error.experiment import YawSource, join_experiments, split_rows, twist_experiments
from diffdrive_mpc_extras.networks.network import Architecture, Network, divided, windows_of
from diffdrive_mpc_extras.networks.network_model import (
    NetworkFile,
    NetworkModel,
    network_content,
    network_model,
    write_network,
)
from diffdrive_mpc_extras.networks.training import TrainingSettings, method, train, training_settings


@dataclass(frozen=True)
class TrainedNetwork:
    """A network as `identification.fit.predictor.Predictor`, and how it was trained in words."""

    network: Network
    method: str
    structure: str = "lstm"
    title: str = "a network"
    states: int = 2
    estimate: None = None
    doubts: tuple[Doubt, ...] = ()

    @property
    def offset(self) -> FloatArray:
        """See `Predictor`."""
        return self.network.at_rest

    def simulate(self, records: Sequence[Record], yaw: YawSource) -> list[FloatArray]:
        """Simulate as `Predictor` describes."""
        return simulate_records(self.network, records, yaw)

    def refitted(self, records: Sequence[Record], yaw: YawSource) -> None:
        """Return None as `Predictor` describes: the held-out part is too short for training."""

    def content(self, fields: Mapping[str, Any]) -> NetworkFile:
        """Build the content as `Predictor` describes."""
        return network_content(self.network, **fields)

    def model(self, content: NetworkFile) -> NetworkModel:
        """Build the model as `Predictor` describes."""
        return network_model(content.name, self.network, content.sample_time, content.provenance.model_dump())

    def write(self, path: Path, content: NetworkFile) -> None:
        """Write the files as `Predictor` describes, with the weights next to them."""
        write_network(path, self.network, content)


def find_network(
    data: LogData,
    fitted: Fitted,
    settings: TrainingSettings | None = None,
    on_look: Callable[[int], None] | None = None,
) -> TrainedNetwork:
    """Train a network on the training records, whose last part in time tells when to stop.

    Parameters
    ----------
    data
        The records.
    fitted
        Linear model and data of the same records.
    settings
        By default the shipped ones.
    on_look
        Called with the steps done, now and then.

    Raises
    ------
    models.errors.MissingPackageError
        If the package for training is not installed.
    ValueError
        If the records are too few.
    """
    chosen, kind, yaw = settings or training_settings(), Architecture(), fitted.identified.yaw
    first, second, _ = chosen.shares
    shares = (first / (first + second), second / (first + second))
    chosen = chosen.model_copy(update={"shares": shares})
    windows = windows_of(join_experiments(twist_experiments(data.train, yaw)), kind.window)
    training, validation = divided(windows, shares)
    on_step = (lambda steps, _: on_look(steps)) if on_look else None
    training_result = train(kind, training, validation, chosen, on_step)
    return TrainedNetwork(training_result.network, method(kind, chosen, training_result))


def simulate_records(network: Network, records: Sequence[Record], yaw: YawSource) -> list[FloatArray]:
    """Simulate v [m/s] and omega [rad/s] (K, 2) of each record from its commands; the first one is held before them."""
    experiments, window = twist_experiments(records, yaw), network.architecture.window
    runs = join_experiments(experiments)
    rows = [network.simulate(run.inputs, np.tile(run.inputs[0], (window, 1))) for run in runs]
    return split_rows(rows, experiments)
