"""From records of a robot to the numbers of a velocity model."""

from models.identification.fit import fit_percent, pooled_fit_percent
from models.identification.tracks import identify_track, side_difference
from models.identification.two_poles import Experiment, TwoPolesFit, identify_two_poles, simulate_two_poles

__all__ = [
    "Experiment",
    "TwoPolesFit",
    "fit_percent",
    "identify_track",
    "identify_two_poles",
    "pooled_fit_percent",
    "side_difference",
    "simulate_two_poles",
]
