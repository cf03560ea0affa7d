"""All features: a new one is its folder and a line here."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import NamedTuple

from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.features.feature import Feature
from diffdrive_mpc.mpc.problem.terms import Term


class RegisteredFeature(NamedTuple):
    """A feature.

    Attributes
    ----------
    name
        Its folder in `mpc`; the class is `FEATURE` of the module `feature` there.
    enabled
        Whether a configuration asks for it.
    """

    name: str
    enabled: Callable[[ControllerConfig], bool]


FEATURES = (
    RegisteredFeature("energy", lambda config: bool(config.energy.weight) or config.energy.use_min_radius),
    RegisteredFeature("free_space", lambda config: config.free_space.enabled),
    RegisteredFeature("online_dead_time", lambda config: config.online_dead_time.enabled),
    RegisteredFeature("rehearsal", lambda config: config.rehearsal.enabled),
)
"""In the order in which they are asked."""


def features_of(config: ControllerConfig) -> dict[str, type[Feature]]:
    """The features that a configuration asks for, by name; what it does not ask for is not imported."""
    return {
        name: import_module(f"diffdrive_mpc.mpc.{name}.feature").FEATURE
        for name, enabled in FEATURES
        if enabled(config)
    }


def prepared(config: ControllerConfig) -> ControllerConfig:
    """The configuration with what follows from its features; raises ConfigError where one cannot be used."""
    for feature in features_of(config).values():
        config = feature.prepare(config)
    return config


def feature_terms(config: ControllerConfig) -> tuple[Term, ...]:
    """Terms that the features of a configuration add to the cost."""
    return tuple(term for feature in features_of(config).values() for term in feature.terms(config))
