"""Second publisher on an input of the monitor, on the streams of messages of the root package's tests."""

import numpy as np
import pytest
from message_streams import RESERVED, delay_of, restarts

from diffdrive_mpc_monitor.senders import Senders

LONG = pytest.param(1000, marks=pytest.mark.long)


def detected(messages):
    """Return the time at which two publishers are detected [s]; None if they are not."""
    senders = Senders()
    for arrival, number, _ in sorted(messages, key=lambda message: message.arrival):
        if senders.take(number, arrival):
            return arrival
    return None


@pytest.mark.parametrize("count", [60, LONG])
def test_two_publishers_are_detected_within_the_bound(count):
    delays = np.array([delay_of(detected, seed) for seed in range(RESERVED, RESERVED + count)])
    assert np.mean(delays > 0.0) <= 0.01, delays[delays > 0.0]


@pytest.mark.parametrize("count", [15, LONG])
def test_restarts_are_one_publisher(count):
    """Readers of sensors, of best effort, drop messages that were overtaken; the driver lives for a second or more."""
    streams = (restarts(seed, is_ordered=True, min_life=1.0) for seed in range(RESERVED, RESERVED + count))
    assert not [stream[0] for stream in streams if detected(stream) is not None]


def test_messages_without_numbers_are_not_judged():
    senders = Senders()
    assert not any(senders.take(None, 0.01 * k) for k in range(100))
