"""Controllers with features keep the promises of docs/safety.md in random lives."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

import pytest
from fuzz.surroundings import draw_surroundings, make_surroundings

from diffdrive_mpc import Controller
from fuzz.case import draw, saved_findings
from fuzz.configs import Overrides
from fuzz.controller import EXTRAS, ControllerFuzzer, Life, one_line
from fuzz.runner import judged

FEATURES: tuple[Overrides, ...] = (
    {"energy.weight": 0.01, "energy.turn_costs": "fsu_bot-default"},
    {"energy.weight": 1.0, "energy.turn_costs": "fsu_bot-slippery", "energy.use_min_radius": True},
    {"rehearsal.enabled": True, "rehearsal.by": "laps"},
    {"rehearsal.enabled": True, "rehearsal.by": "floor"},
    {"free_space.enabled": True},
    {"free_space.enabled": True, "free_space.margin": 0.3},
)


class FeatureFuzzer(ControllerFuzzer):
    """Fuzzer of controllers whose configuration enables features."""

    name = "features"
    extras: Sequence[Overrides] = (*EXTRAS, *FEATURES)

    def draw_feature_events(self, random: Random, overrides: Overrides) -> list[list[Any]]:
        """Draw surroundings for a controller that keeps clear of them."""
        if "free_space.enabled" not in overrides or random.random() < 0.5:
            return []
        return [["see", draw_surroundings(random)]]

    def make_life(self, controller: Controller, references: list[Any]) -> Life:
        """Return a life in which surroundings are set."""
        return FeatureLife(controller, references)


class FeatureLife(Life):
    """Life of a controller with surroundings."""

    def see(self, stated: Any) -> None:
        """Set surroundings near the present pose, or remove them."""
        try:
            surroundings = make_surroundings(stated, self.pose, self.t)
            self.controller.feature("free_space").set_obstacles(surroundings)
        except ValueError as error:
            one_line(error)


FINDINGS = saved_findings(Path(__file__).with_name("fuzz_findings"))


def test_drawn_cases_keep_what_is_promised():
    fuzzer = FeatureFuzzer()
    cases = [draw(fuzzer, 30, index) for index in range(60)]
    assert [judged(fuzzer, case) for case in cases] == [None] * len(cases)
    assert all(any(extra.items() <= case["overrides"].items() for case in cases) for extra in FEATURES)
    assert "see" in {event[0] for case in cases for event in case["events"]}
    assert fuzzer.steps > 2000


@pytest.mark.parametrize("key", FINDINGS)
def test_earlier_finding_is_mended(key):
    assert judged(FeatureFuzzer(), FINDINGS[key]) is None


def test_there_are_findings_to_replay():
    assert len(FINDINGS) > 5
