"""Thresholds of re-entry that no robot has to change, where both Python and the core need them.

Those of the sensor test stand in `sensor_test.yaml`, those of single measurements in `core_thresholds.yaml`.
"""

STANDING = 0.02
"""The reference stands where it is slower than this [m/s]: it is then taken to head where it will go next."""
TURNING = 0.05
"""... and turns on the spot where it is then faster than this [rad/s]."""
BEHIND = 3.0
"""In units of `reentry.wait`: waiting leaves a robot behind by twice that at most; further back it was moved [-]."""
AHEAD = 1.5
"""The same for a robot that is ahead of its reference, which it never is by much unless it was moved [-]."""
