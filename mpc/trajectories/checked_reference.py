"""References of the user: what they sample is looked at before anything, C among it, reads it by count."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Reference, ReferenceSample


class CheckedReference:
    """A reference whose samples have the shapes that `Reference` promises, as floating-point numbers.

    Parameters
    ----------
    reference
        Any object that samples poses, twists and arc lengths.
    """

    def __init__(self, reference: Reference) -> None:
        self._reference = reference

    @property
    def name(self) -> str:
        """Name for tables and figures."""
        return self._reference.name

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self._reference.duration

    def sample(self, times: ArrayLike) -> ReferenceSample:
        """Evaluate at `times` (n,) [s]; raises ValueError where the reference gives other shapes."""
        sample, count = self._reference.sample(times), np.size(times)
        return ReferenceSample(
            self._checked("pose", sample.pose, (count, 3)),
            self._checked("twist", sample.twist, (count, 2)),
            self._checked("arc_length", sample.arc_length, (count,)),
        )

    def _checked(self, what: str, values: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
        array = np.asarray(values, dtype=float)
        if array.shape != shape:
            raise ValueError(
                f"reference '{self.name}': {what} of sample(times) has shape {array.shape} for {shape[0]} times; "
                f"expected {shape}"
            )
        return array


def checked_reference(reference: Reference) -> Reference:
    """`reference` with checked samples; itself where the compiled core samples it."""
    return reference if getattr(reference, "native", None) is not None else CheckedReference(reference)
