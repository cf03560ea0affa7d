"""Identification of a network on past commands from records."""

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
from diffdrive_mpc_extras.networks.network import Architecture, Network, split_windows, windows_of
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
    """Trained network, as `identification.fit.predictor.Predictor`, with a description of its training."""

    network: Network
    method: str
    structure: str = "lstm"
    title: str = "a network"
    states: int = 2
    estimate: None = None
    doubts: tuple[Doubt, ...] = ()

    @property
    def offset(self) -> FloatArray:
        """(2,) output at rest: sensor bias of v [m/s] and omega [rad/s] according to the model."""
        return self.network.rest_output

    def simulate(self, records: Sequence[Record], yaw: YawSource) -> list[FloatArray]:
        """Simulate the readings of v [m/s] and omega [rad/s] (K, 2) of each record from its commands."""
        return simulate_records(self.network, records, yaw)

    def refitted(self, records: Sequence[Record], yaw: YawSource) -> None:
        """Return None: the held-out part is too short for training."""

    def content(self, fields: Mapping[str, Any]) -> NetworkFile:
        """Build the content of the parameter file."""
        return network_content(self.network, **fields)

    def model(self, content: NetworkFile) -> NetworkModel:
        """Build the model from the content of a parameter file."""
        return network_model(content.name, self.network, content.sample_time, content.provenance.model_dump())

    def write(self, path: Path, content: NetworkFile) -> None:
        """Write the parameter file and the weights."""
        write_network(path, self.network, content)


def find_network(
    data: LogData,
    fitted: Fitted,
    settings: TrainingSettings | None = None,
    on_validation: Callable[[int], None] | None = None,
) -> TrainedNetwork:
    """Train a network on the training records; their last part serves as validation part.

    Parameters
    ----------
    data
        Records of the log.
    fitted
        Linear model and data of the same records.
    settings
        Settings of the training, by default the shipped settings.
    on_validation
        Callback with the number of steps at each validation.

    Raises
    ------
    models.errors.MissingPackageError
        If JAX or Optax are not installed.
    ValueError
        If the records are too short.
    """
    settings, architecture, yaw = settings or training_settings(), Architecture(), fitted.identified.yaw
    first, second, _ = settings.shares
    shares = (first / (first + second), second / (first + second))
    settings = settings.model_copy(update={"shares": shares})
    windows = windows_of(join_experiments(twist_experiments(data.train, yaw)), architecture.window)
    training, validation = split_windows(windows, shares)
    on_step = (lambda steps, _: on_validation(steps)) if on_validation else None
    training_result = train(architecture, training, validation, settings, on_step)
    return TrainedNetwork(training_result.network, method(architecture, settings, training_result))


def simulate_records(network: Network, records: Sequence[Record], yaw: YawSource) -> list[FloatArray]:
    """Simulate v [m/s] and omega [rad/s] (K, 2) of each record, with the first command repeated before the record."""
    experiments, window = twist_experiments(records, yaw), network.architecture.window
    runs = join_experiments(experiments)
    rows = [network.simulate(run.inputs, np.tile(run.inputs[0], (window, 1))) for run in runs]
    return split_rows(rows, experiments)
