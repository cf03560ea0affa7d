"""Identification of a hybrid from records: train a network for the residuals of the linear model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.identification.fit.fitting import Fitted
from diffdrive_mpc.models.identification.log_data import LogData, most_informative
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.output_error.experiment import YawSource, join_experiments, split_rows, twist_experiments
from diffdrive_mpc.models.output_error.held_out import blocks, extract
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.velocity_model import ModelError
from diffdrive_mpc_extras.hybrids.hybrid_model import (
    Correction,
    HybridFile,
    HybridModel,
    correction_content,
    hybrid_model,
    model_from_file,
    write_hybrid,
)
from diffdrive_mpc_extras.hybrids.training import (
    TrainingRun,
    hybrid_settings,
    train_corrections,
    training_runs,
    zero_correction,
)

_NAME = "hybrid"


@dataclass(frozen=True)
class HybridPredictor:
    """Identified hybrid, as `identification.fit.predictor.Predictor`.

    Attributes
    ----------
    identified
        Identified linear model.
    correction
        Network and gate.
    dt
        Sample time [s].
    decay
        Penalty with the smallest error on held-out blocks; None if no network is better than the linear model.
    """

    identified: IdentifiedModel
    correction: Correction
    dt: float
    decay: float | None
    structure: str = "hybrid"
    title: str = "a linear model with a network"
    estimate: None = None

    @property
    def method(self) -> str:
        """Description of the identification."""
        s = hybrid_settings()
        choice = "no network was better" if self.decay is None else f"L2 {self.decay:g} chosen on held-out blocks"
        return (
            f"{self.identified.method}; network of {s.units} x tanh on its states, least squares on free runs (L-BFGS),"
            f" {choice}; gate 1 for {s.full:.0%} of the rows and 0 from {s.reach:g} times their distance; seed {s.seed}"
        )

    @property
    def offset(self) -> FloatArray:
        """(2,) offsets of the readings of v [m/s] and omega [rad/s]."""
        return self.identified.offset

    @property
    def states(self) -> int:
        """Order of the model."""
        return self.identified.model.order

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """Doubts about the model; not empty if no network improves the prediction."""
        if self.decay is not None:
            return ()
        reason = "no network predicts held-out blocks better than the linear model: its output is zero"
        return (Doubt("network left out", reason),)

    def simulate(self, records: Sequence[Record], yaw: YawSource) -> list[FloatArray]:
        """Simulate the readings of v [m/s] and omega [rad/s] (K, 2) of each record from its commands."""
        model = hybrid_model(_NAME, self.identified.model.discretise(self.dt), self.correction)
        experiments = twist_experiments(records, yaw)
        runs = training_runs(model.linear, self.identified.system, join_experiments(experiments))
        return split_rows([run.simulate(model) + self.offset for run in runs], experiments)

    def refitted(self, records: Sequence[Record], yaw: YawSource) -> HybridModel | None:
        """Train a network on other records with the same linear model; return None if this hybrid has no network."""
        if self.decay is None:
            return None
        linear = self.identified.model.discretise(self.dt)
        runs = training_runs(linear, self.identified.system, join_experiments(twist_experiments(_part(records), yaw)))
        (network,) = train_corrections(linear, runs, (self.decay,), hybrid_settings())
        return hybrid_model(f"{self.structure} of the held-out data", linear, network)

    def content(self, fields: Mapping[str, Any]) -> HybridFile:
        """Build the content of the parameter file."""
        provenance = {
            "origin": "identified",
            "source": fields["provenance"]["source"],
            "method": self.identified.method,
        }
        return HybridFile.model_validate(
            {
                **fields,
                "structure": "hybrid",
                "linear": self.identified.file(f"linear model of {fields['name']}", provenance),
                "correction": correction_content(self.correction),
            }
        )

    def model(self, content: HybridFile) -> HybridModel:
        """Build the model from the content of a parameter file."""
        return model_from_file(content)

    def write(self, path: Path, content: HybridFile) -> None:
        """Write the parameter file."""
        write_hybrid(path, content)


def find_hybrid(data: LogData, fitted: Fitted) -> HybridPredictor:
    """Train a network on the residuals of the linear model in the training records.

    Long records are shortened to their most informative rows, as for effects. The penalty of the weights is chosen by
    cross-validation on blocks of these records; the linear model is fitted to all blocks.

    Raises
    ------
    models.errors.MissingPackageError
        If JAX is not installed.
    ValueError
        If the records are too short for held-out blocks.
    """
    identified, dt, settings = fitted.identified, data.train[0].dt, hybrid_settings()
    linear, system = identified.model.discretise(dt), identified.system
    experiments = join_experiments(twist_experiments(_part(data.train), identified.yaw))
    gains = []
    for rest, block in blocks(experiments):
        held_out, training = (training_runs(linear, system, extract(experiments, part)) for part in (block, rest))
        networks = train_corrections(linear, training, settings.decays, settings)
        gains.append([_log_error_ratio(linear, network, held_out) for network in networks])
    scores = np.mean(gains, axis=0)
    runs, best = training_runs(linear, system, experiments), int(np.argmin(scores))
    if scores[best] > np.log1p(-settings.min_gain):
        return HybridPredictor(identified, zero_correction(runs, settings), dt, None)
    networks = train_corrections(linear, runs, settings.decays[: best + 1], settings)
    return HybridPredictor(identified, networks[-1], dt, settings.decays[best])


def _part(records: Sequence[Record]) -> list[Record]:
    return most_informative(records, identification_settings().max_rows["effects"])


def _log_error_ratio(linear: DiscreteModel, correction: Correction, runs: Sequence[TrainingRun]) -> float:
    """Compute the logarithm of the squared error relative to the linear model's, averaged over v and omega."""
    try:
        model = hybrid_model(_NAME, linear, correction)
    except ModelError:  # never select a model that is not plausible for a robot
        return float("inf")
    errors, linear_errors = (
        np.concatenate([(predicted - run.outputs) * run.counts for run, predicted in zip(runs, rows, strict=True)])
        for rows in ([run.simulate(model) for run in runs], [run.states @ linear.C.T for run in runs])
    )
    return float(np.mean(np.log((errors**2).sum(axis=0) / (linear_errors**2).sum(axis=0))))
