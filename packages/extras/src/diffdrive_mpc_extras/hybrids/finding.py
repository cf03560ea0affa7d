"""A linear model with a network for its residuals, from records."""

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
    hybrid_of,
    write_hybrid,
)
from diffdrive_mpc_extras.hybrids.training import TrainingRun, hybrid_settings, runs_of, silent, trained

_NAME = "hybrid"


@dataclass(frozen=True)
class FoundHybrid:
    """A hybrid as `identification.fit.predictor.Predictor`.

    Attributes
    ----------
    identified
        The identified linear model.
    correction
        The network.
    dt
        Sample time [s].
    decay
        The penalty that predicted held-out blocks best; None where no network did better than the linear model.
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
        """See `Predictor`."""
        s = hybrid_settings()
        choice = "no network did better" if self.decay is None else f"L2 {self.decay:g} chosen on held-out blocks"
        return (
            f"{self.identified.method}; on its states a network of {s.units} x tanh, least squares on free runs "
            f"(L-BFGS), {choice}; in full at {s.full:.0%} of the rows and silent at {s.reach:g} times their distance; "
            f"seed {s.seed}"
        )

    @property
    def offset(self) -> FloatArray:
        """See `Predictor`."""
        return self.identified.offset

    @property
    def states(self) -> int:
        """See `Predictor`."""
        return self.identified.model.order

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """See `Predictor`."""
        if self.decay is not None:
            return ()
        words = "no network predicts held-out blocks better than the linear model: it is silent"
        return (Doubt("network left out", words),)

    def simulate(self, records: Sequence[Record], yaw: YawSource) -> list[FloatArray]:
        """Simulate as `Predictor` describes."""
        model = hybrid_model(_NAME, self.identified.model.discretise(self.dt), self.correction)
        experiments = twist_experiments(records, yaw)
        runs = runs_of(model.linear, self.identified.system, join_experiments(experiments))
        return split_rows([run.simulate(model) + self.offset for run in runs], experiments)

    def refitted(self, records: Sequence[Record], yaw: YawSource) -> HybridModel | None:
        """Refit as `Predictor` describes: another network on the same linear model; None without a network."""
        if self.decay is None:
            return None
        linear = self.identified.model.discretise(self.dt)
        runs = runs_of(linear, self.identified.system, join_experiments(twist_experiments(_part(records), yaw)))
        (network,) = trained(linear, runs, (self.decay,), hybrid_settings())
        return hybrid_model(f"{self.structure} of the data held out", linear, network)

    def content(self, fields: Mapping[str, Any]) -> HybridFile:
        """Build the content as `Predictor` describes."""
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
        """Build the model as `Predictor` describes."""
        return hybrid_of(content)

    def write(self, path: Path, content: HybridFile) -> None:
        """Write the files as `Predictor` describes."""
        write_hybrid(path, content)


def find_hybrid(data: LogData, fitted: Fitted) -> FoundHybrid:
    """Train a network on the residuals of the linear model on the training records: of long ones a part, as effects.

    The penalty of its weights is chosen on blocks of these records, each predicted by a network trained without it; the
    linear model is that of all of them.

    Raises
    ------
    models.errors.MissingPackageError
        If JAX is not installed.
    ValueError
        If the records are too short to hold blocks out.
    """
    identified, dt, settings = fitted.identified, data.train[0].dt, hybrid_settings()
    linear, system = identified.model.discretise(dt), identified.system
    experiments = join_experiments(twist_experiments(_part(data.train), identified.yaw))
    gains = []
    for rest, block in blocks(experiments):
        held_out = runs_of(linear, system, extract(experiments, block))
        networks = trained(linear, runs_of(linear, system, extract(experiments, rest)), settings.decays, settings)
        gains.append([_log_power(linear, network, held_out) for network in networks])
    scores = np.mean(gains, axis=0)
    runs, best = runs_of(linear, system, experiments), int(np.argmin(scores))
    if scores[best] > np.log1p(-settings.min_gain):
        return FoundHybrid(identified, silent(runs, settings), dt, None)
    networks = trained(linear, runs, settings.decays[: best + 1], settings)
    return FoundHybrid(identified, networks[-1], dt, settings.decays[best])


def _part(records: Sequence[Record]) -> list[Record]:
    return most_informative(records, identification_settings().max_rows["effects"])


def _log_power(linear: DiscreteModel, correction: Correction, runs: Sequence[TrainingRun]) -> float:
    """Compute the logarithm of the squared errors over those of the linear model, mean over v and omega."""
    try:
        model = hybrid_model(_NAME, linear, correction)
    except ModelError:  # a model that cannot be a robot is not chosen
        return float("inf")
    errors, alone = (
        np.concatenate([(predicted - run.outputs) * run.counts for run, predicted in zip(runs, rows, strict=True)])
        for rows in ([run.simulate(model) for run in runs], [run.states @ linear.C.T for run in runs])
    )
    return float(np.mean(np.log((errors**2).sum(axis=0) / (alone**2).sum(axis=0))))
