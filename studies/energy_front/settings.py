"""What the study of the front does: `study.yaml` says what each value is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import NotNegative, Positive

HERE = Path(__file__).parent


class Floor(StrictModel):
    """A floor, what turns cost on it, and the paths that are driven there."""

    surface: str
    turn_costs: str
    trajectories: Annotated[tuple[str, ...], Field(min_length=1)]


class FrontSettings(StrictModel):
    """All of it."""

    plant: str
    config: str
    top_speed: Positive
    weights: Annotated[tuple[NotNegative, ...], Field(min_length=2)]
    seeds: Annotated[tuple[int, ...], Field(min_length=1)]
    floors: Annotated[tuple[Floor, ...], Field(min_length=1)]

    def cases(self, folder: Path) -> list[Case]:
        """Every run; files are named as seen from `folder`."""
        return [
            self._case(floor, name, weight, seed, folder)
            for floor in self.floors
            for name in floor.trajectories
            for weight in self.weights
            for seed in self.seeds
        ]

    def _case(self, floor: Floor, name: str, weight: float, seed: int, folder: Path) -> Case:
        own = folder / name
        drawn = own.is_file()
        overrides = (("energy.turn_costs", floor.turn_costs), ("energy.weight", weight))
        return Case(
            model=str(folder / self.config).replace("config.yaml", "model.yaml"),
            trajectory=str(own) if drawn else name,
            plant=self.plant,
            surface=floor.surface,
            seed=seed,
            config=str(folder / self.config),
            overrides=overrides,
            top_speed=None if drawn else self.top_speed,
        )


def load_study(path: Path | None = None) -> FrontSettings:
    """Read what to do; raises ConfigError on a mistake in the file."""
    return load_checked(FrontSettings, path or HERE / "study.yaml")


def quick(study: FrontSettings) -> FrontSettings:
    """One path, three weights and two seeds, to see that it works."""
    floor = study.floors[0].model_copy(update={"trajectories": study.floors[0].trajectories[:1]})
    return study.model_copy(update={"floors": (floor,), "weights": (0.0, 0.005, 0.05), "seeds": (0, 1)})
