"""What a reproduction gave, and as plain values."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from diffdrive_mpc.bench.reproduce.experiments.cost import Cost
from diffdrive_mpc.bench.reproduce.experiments.mbm_and_sm import MbmSmResult
from diffdrive_mpc.bench.reproduce.experiments.state_space import SsmResult
from diffdrive_mpc.bench.reproduce.experiments.virtual_track import VirtualTrackResult
from diffdrive_mpc.bench.reproduce.study import Study
from diffdrive_mpc.models.checked_yaml import StrictModel

# Whole paths are for figures: they would fill the file.
_NOT_WRITTEN = "paths"


@dataclass(frozen=True)
class Reproduction:
    """Results by part; a part that was not run is empty or None.

    Attributes
    ----------
    study
        What was asked for.
    meta
        Machine, versions, definitions.
    mbm_sm, ssm
        One for each repetition.
    cost
        By name of the model.
    virtual_track
        The printed tests and their lines.
    """

    study: Study
    meta: Mapping[str, Any]
    mbm_sm: tuple[MbmSmResult, ...] = ()
    ssm: tuple[SsmResult, ...] = ()
    cost: Mapping[str, Cost] | None = None
    virtual_track: VirtualTrackResult | None = None


def plain(value: object) -> Any:  # noqa: ANN401 - whatever JSON takes
    """Dataclasses, mappings, sequences and arrays as dicts, lists and numbers; what is not finite as None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [field.name for field in dataclasses.fields(value) if field.name != _NOT_WRITTEN]
        return {name: plain(getattr(value, name)) for name in fields}
    if isinstance(value, StrictModel):
        return plain(value.model_dump(mode="json"))
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(entry) for entry in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value
