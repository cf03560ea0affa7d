"""Prediction of the tracking error of a reference before the drive."""

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use

if TYPE_CHECKING:
    from diffdrive_mpc_extras.predicted_error.predicted_error import PredictedError as PredictedError
    from diffdrive_mpc_extras.predicted_error.predicted_error import predict_error as predict_error

_MODULES = {"PredictedError": "predicted_error", "predict_error": "predicted_error"}

if not TYPE_CHECKING:  # type checkers use the imports above
    __all__ = list(_MODULES)
# Import lazily: `diffdrive-mpc --help` imports this package.
__getattr__, __dir__ = on_first_use(__name__, _MODULES)
