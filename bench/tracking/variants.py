"""The variants of the ablation by the configuration values that make them."""

from __future__ import annotations

from diffdrive_mpc.bench.case import Overrides
from diffdrive_mpc.bench.tracking.plan import overrides_of
from diffdrive_mpc.bench.tracking.study import Study

BOUND_NAME = "clairvoyant bound"
"""What tables and figures call the bound."""


def variants(study: Study) -> dict[Overrides, str]:
    """Name of each variant by its overrides."""
    return {overrides_of(values): name for name, values in study.ablation.variants.items()}


def variant_names(study: Study) -> tuple[str, ...]:
    """Names of the variants, in their order."""
    return tuple(study.ablation.variants)
