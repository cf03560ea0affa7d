"""What the saving study does: `study.yaml` says what each value is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field, model_validator
from scipy.stats import qmc

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import NotNegative, Positive, Share
from diffdrive_mpc_extras.planner import PlanSettings, load_plan_settings

FOLDER = Path(__file__).parent

Place = tuple[float, float, float]
"""x, y [m] and heading [degrees]."""
Post = tuple[float, float, Positive]
"""x, y and radius [m]."""


class DrawnTasks(StrictModel):
    """Pairs of start and goal."""

    count: int = Field(ge=1)
    seed: int = Field(ge=0)
    tuning_seed: int = Field(ge=0)
    distance: tuple[Positive, Positive]

    @model_validator(mode="after")
    def _apart(self) -> DrawnTasks:
        if self.seed == self.tuning_seed:
            raise ValueError("seed and tuning_seed are the same: what is reported must not have been tuned on")
        if not self.distance[0] < self.distance[1]:
            raise ValueError("distance: give the least and then the largest")
        return self


class Planning(StrictModel):
    """In place of the planner's own settings."""

    radius_margin: Share
    longest_detour: Positive

    @property
    def settings(self) -> PlanSettings:
        """The planner's settings with these."""
        own = load_plan_settings()
        polish = own.polish.model_copy(update={"radius_margin": self.radius_margin})
        motion = own.motion.model_copy(update={"longest_detour": self.longest_detour})
        return own.model_copy(update={"polish": polish, "motion": motion})


class Standstill(StrictModel):
    """When the robot stands."""

    speed: Positive
    yaw_rate: Positive
    wait: Positive


class PaperScenario(StrictModel):
    """One of P4's, section 4.3."""

    kind: Literal["nominal", "foreign", "loaded"]
    surface: str
    start: Place
    goal: Place
    posts: tuple[Post, ...]
    law: str = ""
    payload: NotNegative = 0.0


class SavingStudySettings(StrictModel):
    """All of it."""

    robot: str
    controller: Path
    surfaces: Annotated[tuple[str, ...], Field(min_length=1)]
    speed: Positive
    planning: Planning
    pairs: DrawnTasks
    standing: Standstill
    scenarios: tuple[PaperScenario, ...]
    seed: int = Field(ge=0)
    asked: NotNegative
    computer: NotNegative

    @property
    def configuration(self) -> Path:
        """Of the controller; a relative path that is not found from here is taken from the folder of this study."""
        return self.controller if self.controller.is_file() else FOLDER / self.controller

    def costs_of(self, surface: str) -> str:
        """Name of the shipped turn costs of the robot on a surface."""
        return f"{self.robot}-{surface}"


def load_study(path: Path | None = None) -> SavingStudySettings:
    """Read what to do; raises ConfigError on a mistake in the file."""
    return load_checked(SavingStudySettings, path or FOLDER / "study.yaml")


def small(study: SavingStudySettings) -> SavingStudySettings:
    """Two pairs near each other on one floor and the first scenario, to see that it works."""
    return study.model_copy(
        update={
            "surfaces": ("default",),
            "pairs": study.pairs.model_copy(update={"count": 2, "distance": (2.0, 4.0)}),
            "scenarios": study.scenarios[:1],
        }
    )


# Starts and goals, drawn.


Pose = tuple[float, float, float]
"""x, y [m], theta [rad]."""


class Pair(NamedTuple):
    """Where the robot rests at first and in the end."""

    start: Pose
    goal: Pose

    @property
    def distance(self) -> float:
        """Straight from one to the other [m]."""
        return float(np.hypot(self.goal[0] - self.start[0], self.goal[1] - self.start[1]))


def draw_pairs(settings: DrawnTasks, count: int, seed: int) -> list[Pair]:
    """So many pairs from a seed: distance, where the goal lies, and where the robot is to look there.

    A Latin hypercube: each of the three is spread evenly over its range, one pair to each of `count` slices, so that
    neither near goals nor goals straight ahead can be in the majority. A floor is the same everywhere: all start at
    the origin and look along x.
    """
    unit = qmc.LatinHypercube(d=3, seed=np.random.default_rng(seed)).random(count)
    low, high = np.array([[settings.distance[0], -np.pi, -np.pi], [settings.distance[1], np.pi, np.pi]])
    rows = low + unit * (high - low)
    return [
        Pair((0.0, 0.0, 0.0), (float(far * np.cos(bearing)), float(far * np.sin(bearing)), float(heading)))
        for far, bearing, heading in rows
    ]
