"""What `reproduce` runs, read from `study.yaml` or, for a quick one, from `quick.yaml`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive

PARTS = ("mbm_sm", "ssm", "lstm", "cost", "virtual_track")
"""Names of the parts, in the order of the report."""

Count = Annotated[int, Field(ge=1)]


class MbmSmStudy(StrictModel):
    """MBM and SM from steps, held against each other on trajectories."""

    trajectories: Annotated[tuple[str, ...], Field(min_length=1)]
    free_drives: Count
    free_duration: Positive = Field(description="[s]")


class PaperRange(StrictModel):
    """How fast the set-points of the paper's free drives went."""

    v: Positive = Field(description="[m/s]")
    omega: Positive = Field(description="[rad/s]")


class SsmStudy(StrictModel):
    """SSM of several orders from one free drive."""

    train_duration: Positive = Field(description="[s]")
    largest_order: int = Field(ge=2, le=5)
    test_drives: Count
    free_drives: Count
    free_duration: Positive = Field(description="[s]")
    paper_range: PaperRange


class LongerTraining(StrictModel):
    """Where a training differs from the paper's."""

    dropout: float = Field(ge=0, lt=1)
    decay: float = Field(ge=0)
    patience: Count
    most_epochs: Count


class NetworkStudy(StrictModel):
    """LSTM beside SSM from one free drive, and networks of Table 2."""

    train_duration: Positive = Field(description="[s]")
    free_drives: Count
    free_duration: Positive = Field(description="[s]")
    paper_range: PaperRange
    rows: tuple[tuple[int, ...], ...] = Field(description="of Table 2, in groups that are trained one after the other")
    longer: LongerTraining


class CostStudy(StrictModel):
    """Simulations that are timed."""

    runs: int = Field(ge=2, description="a spread takes two")
    steps: Count
    simulation_steps: dict[str, Count] = Field(description="of the whole simulations, by model")


class ReproduceSettings(StrictModel):
    """All parts; a repetition has drives and noise of its own."""

    repetitions: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]
    mbm_sm: MbmSmStudy
    ssm: SsmStudy
    lstm: NetworkStudy
    cost: CostStudy


def load_study(*, quick: bool = False) -> ReproduceSettings:
    """Read the study; raises ConfigError when its file has a mistake."""
    return load_checked(ReproduceSettings, Path(__file__).parent / ("quick.yaml" if quick else "study.yaml"))
