"""Prediction of the tracking error of a reference before it is driven."""

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use

if TYPE_CHECKING:
    from diffdrive_mpc_extras.predicted_error.predicted_error import PredictedError as PredictedError
    from diffdrive_mpc_extras.predicted_error.predicted_error import predict_error as predict_error

_HOMES = {"PredictedError": "predicted_error", "predict_error": "predicted_error"}

if not TYPE_CHECKING:  # a type checker takes the imports above for the public names
    __all__ = list(_HOMES)
# Lazy: `diffdrive-mpc --help` imports this package for the help of its command.
__getattr__ = on_first_use(__name__, _HOMES)
