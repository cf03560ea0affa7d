"""Lookup of the features of a configuration by entry points."""

from __future__ import annotations

from diffdrive_mpc.models.plug_ins import plug_in
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.features.feature import Feature
from diffdrive_mpc.mpc.problem.terms import Term


def enabled_features(config: ControllerConfig) -> dict[str, type[Feature]]:
    """Import the enabled features of a configuration and return their classes by name.

    The features are sorted by name; the controller calls them in this order. Raises ImportError if an import fails, see
    `plug_in`.
    """
    features = {name: plug_in("features", name) for name, group in config.features.items() if group.is_enabled}
    return dict(sorted(features.items()))


def prepare_config(config: ControllerConfig) -> ControllerConfig:
    """Apply the changes of all features to a configuration; raise ConfigError if a feature cannot be used."""
    for feature in enabled_features(config).values():
        config = feature.prepare(config)
    return config


def feature_terms(config: ControllerConfig) -> tuple[Term, ...]:
    """Return the terms that the features of a configuration add to the problem."""
    return tuple(term for feature in enabled_features(config).values() for term in feature.terms(config))
