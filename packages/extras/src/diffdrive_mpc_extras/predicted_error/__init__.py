"""The tracking error of a reference before it is driven: tubes in which a stated share of drives stays."""

from diffdrive_mpc_extras.predicted_error.predicted_error import predict_error as predict_error
