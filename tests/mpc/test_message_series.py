"""Detection of two living publishers on one topic, on drawn streams of messages."""

import numpy as np
import pytest
from message_streams import RESERVED, delay_of, restarts, twins, without_numbers

from diffdrive_mpc.mpc.ros.message_series import MessageSeries


def detected(messages, series=None):
    """Return the time at which a second publisher is detected [s]; None if none is."""
    series = series or MessageSeries()
    for arrival, number, sent in sorted(messages, key=lambda message: message.arrival):
        series.take(number, sent, arrival)
        if series.is_shared:
            return arrival
    return None


def false_alarm(seed):
    """Return True if 50 restarts are taken for two publishers."""
    return detected(restarts(seed)) is not None


LONG = pytest.param(1000, marks=pytest.mark.long)


@pytest.mark.parametrize("count", [60, LONG])
def test_second_publisher_is_detected_within_the_bound(count):
    delays = np.array([delay_of(detected, seed) for seed in range(RESERVED, RESERVED + count)])
    assert np.isfinite(delays).all()
    assert np.mean(delays > 0.0) <= 0.01, delays[delays > 0.0]


@pytest.mark.parametrize("count", [15, LONG])
def test_restarts_are_one_publisher(count):
    """At most one alarm in 10,000 restarts, in which up to a twentieth of the messages is overtaken."""
    alarms = [seed for seed in range(RESERVED, RESERVED + count) if false_alarm(seed)]
    assert len(alarms) <= count * 50 // 10_000, alarms


@pytest.mark.parametrize("kind", ["none", "zero", "constant"])
def test_messages_without_numbers_are_reported_as_such(kind):
    series = MessageSeries()
    messages = [message for messages in twins(RESERVED) for message in messages]
    assert detected(without_numbers(messages, kind), series) is None
    assert not series.is_numbered
    assert detected(messages, MessageSeries()) is not None
