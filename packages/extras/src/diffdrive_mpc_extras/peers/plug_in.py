"""Peers with a tracking law."""

from pathlib import Path

from diffdrive_mpc.bench.peers import TrackingLaw
from diffdrive_mpc_extras.peers.mppi import MppiLaw

MPPI = TrackingLaw(MppiLaw, Path(__file__).with_name("gains.yaml"))
