"""Detection of a second publisher on an input of the monitor, with the message streams of the root package's tests."""

import numpy as np
import pytest
from message_streams import RESERVED, delay_of, restarts

from diffdrive_mpc_monitor.senders import Senders

LONG = pytest.param(1000, marks=pytest.mark.long)


def detection_time(messages):
    """Return the time [s] at which two publishers are detected; None if they are not."""
    senders = Senders()
    for arrival, number, _ in sorted(messages, key=lambda message: message.arrival):
        if senders.take(number, arrival):
            return arrival
    return None


@pytest.mark.parametrize("count", [60, LONG])
def test_two_publishers_are_detected_within_the_bound(count):
    delays = np.array([delay_of(detection_time, seed) for seed in range(RESERVED, RESERVED + count)])
    assert np.mean(delays > 0.0) <= 0.01, delays[delays > 0.0]


@pytest.mark.parametrize("count", [15, LONG])
def test_restarts_count_as_one_publisher(count):
    """Best-effort subscriptions drop reordered messages; the publisher runs for a second or more."""
    streams = (restarts(seed, is_ordered=True, min_life=1.0) for seed in range(RESERVED, RESERVED + count))
    assert not [stream[0] for stream in streams if detection_time(stream) is not None]


def test_messages_without_numbers_are_ignored():
    senders = Senders()
    assert not any(senders.take(None, 0.01 * k) for k in range(100))
