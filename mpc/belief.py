"""What the extended Kalman filter believes: a mean and how far it can be trusted."""

from __future__ import annotations

from typing import NamedTuple

from diffdrive_mpc.models.interface import FloatArray


class Belief(NamedTuple):
    """Mean (n + 9,) and covariance (n + 9, n + 9) of the filter's state, and which sensors contradict it.

    `surprised` counts, for each sensor, the samples since its innovations have been larger than slip explains; 0 where
    the last one was not.
    """

    mean: FloatArray
    covariance: FloatArray
    surprised: tuple[int, ...] = (0, 0, 0, 0)

    def later(self, mean: FloatArray, covariance: FloatArray) -> Belief:
        """The belief one sample later."""
        return Belief(mean, covariance, tuple(count + (count > 0) for count in self.surprised))

    def judged(self, sensor: int, surprising: bool) -> Belief:
        """The same belief after an innovation of `sensor` that is or is not surprising."""
        counts = list(self.surprised)
        counts[sensor] = max(1, counts[sensor]) if surprising else 0
        return self._replace(surprised=tuple(counts))

    def corrected(self, mean: FloatArray, P: FloatArray, gain: FloatArray, PHt: FloatArray, S: FloatArray) -> Belief:
        """The belief with `mean` after `P` was corrected with any gain, optimal or not (Joseph's form)."""
        step = gain @ PHt.T
        P = P - step - step.T + gain @ S @ gain.T
        return self._replace(mean=mean, covariance=0.5 * (P + P.T))
