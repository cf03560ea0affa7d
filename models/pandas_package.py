"""pandas, loaded where rows become a table and nowhere else."""

from __future__ import annotations

from typing import Any

from diffdrive_mpc.models.errors import MissingPackageError


def load_pandas(wanted_by: str) -> Any:  # noqa: ANN401 - a module
    """Import pandas for `wanted_by`; raises MissingPackageError where it is not installed."""
    try:
        import pandas as pd  # noqa: PLC0415 - loads slowly
    except ImportError as error:
        raise MissingPackageError(f"{wanted_by} needs pandas: pip install pandas") from error
    return pd
