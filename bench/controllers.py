"""Build controllers by name: the predictive one and its peers."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

from diffdrive_mpc.bench.peers.kanayama import KanayamaController
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import TrackingController
from diffdrive_mpc.models.load import MODEL_NAMES, load_model
from diffdrive_mpc.mpc import Controller, ControllerConfig, load_config

PEERS: dict[str, Callable[[], TrackingController]] = {"kanayama": KanayamaController}
"""Controllers without a velocity model, by name."""

CONTROLLERS = ("mpc", *PEERS)
DEFAULT_MODEL = "ssm"
NO_MODEL = "none"


def make_controller(
    controller: str, model: str, config: str | None = None, overrides: tuple[tuple[str, object], ...] = ()
) -> TrackingController:
    """A fresh controller; the arguments are those of `bench.case.Case`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the controller is unknown, or its model or configuration cannot be used.
    """
    if controller in PEERS:
        return PEERS[controller]()
    if controller != "mpc":
        raise ConfigError(f"unknown controller '{controller}'; known: {', '.join(CONTROLLERS)}")
    return Controller(controller_config(model, config, overrides))


@lru_cache(maxsize=256)
def controller_config(
    model: str, config: str | None = None, overrides: tuple[tuple[str, object], ...] = ()
) -> ControllerConfig:
    """The configuration of the predictive controller.

    Without a file it is the shipped one of `model`. A model file of the user's own has none: it takes that of the
    SSM, without the extra dead time, which belongs to the model it was found with.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the model is unknown or the configuration has a mistake.
    """
    if config is not None:
        return load_config(config, {"model": _model_reference(model), **dict(overrides)})
    if model in MODEL_NAMES:
        return load_config(model, dict(overrides))
    load_model(model)
    return load_config("ssm", {"model": _model_reference(model), "extra_dead_time": {}, **dict(overrides)})


def default_model(config: Path | None) -> str:
    """The model that a configuration file names, or the default one without a file; raises ConfigError."""
    return load_config(config).model if config is not None else DEFAULT_MODEL


def _model_reference(model: str) -> str:
    return model if model in MODEL_NAMES else str(Path(model).resolve())
