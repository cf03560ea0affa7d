"""Hybrids with random weights, for tests."""

import numpy as np

from diffdrive_mpc.models import load_model
from diffdrive_mpc_extras.hybrids.hybrid_model import Correction, hybrid_model

DT = 0.0202


def random_correction(seed=0, size=0.02, units=5):
    """For the four states of an SM; what it adds in a sample is some hundredths of their usual size."""
    random = np.random.default_rng(seed)
    root = np.eye(6) + 0.2 * random.normal(size=(6, 6))
    scale = np.array([0.5, 0.05, 0.8, 0.02, 0.5, 0.8])
    inward, outward = random.normal(size=(6, units)), size * random.normal(size=(units, 4))
    return Correction(scale, inward, outward, root.T @ root, 9.0, 36.0)


def random_hybrid(seed=0, **kind):
    return hybrid_model("hybrid", load_model("sm").discretise(DT), random_correction(seed, **kind))
