"""What the network of a hybrid says, and how much of it counts, for any library: CasADi or JAX.

`m` is the library, of which tanh, fmin and fmax are used; matrices are its own.
"""

from __future__ import annotations

from typing import Any


def network(m: Any, z: Any, inward: Any, outward: Any) -> Any:  # noqa: ANN401 - arrays and symbols of any library
    """(n,) one layer of tanh without offsets: it is odd, so it rests, and answers backwards as forwards.

    z (f,) features, inward (f, units), outward (units, n).
    """
    return outward.T @ m.tanh(inward.T @ z)


def gate(m: Any, z: Any, shape: Any, full: float, least: float) -> Any:  # noqa: ANN401
    """Between 0 and 1: 1 where the squared distance z' shape z is at most `full`, exactly 0 from `least` on.

    `shape` (f, f) is the inverse covariance of the features of the data, so that this is Mahalanobis' distance from
    rest. Its slope is continuous.
    """
    past = (z.T @ shape @ z - full) / (least - full)
    share = m.fmin(m.fmax(past, 0.0), 1.0)
    return 1.0 - share**2 * (3.0 - 2.0 * share)
