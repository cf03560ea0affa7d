"""Detection of two living publishers on one topic, on drawn streams of messages."""

from typing import NamedTuple

import numpy as np
import pytest

from diffdrive_mpc.mpc.ros.message_series import MessageSeries

RESERVED = 7_000_000
"""Start of the seeds that no threshold was chosen on."""
BOUND = 0.3
"""Time in which a second publisher is detected, unless its third message comes later [s]."""


class Message(NamedTuple):
    arrival: float
    number: int | None
    sent: int


class Driver:
    """A publisher of 10 to 200 Hz with its own clock, latency, losses and reordering."""

    def __init__(self, draw, *, clock_offset=0.0):
        self.draw, self.offset = draw, clock_offset
        self.period = 1.0 / draw.choice([10.0, 20.0, 50.0, 100.0, 200.0, draw.uniform(10.0, 200.0)])
        self.burst = int(draw.choice([1, 1, 1, 2, 5])) if self.period < 0.04 else 1
        self.jitter = self.period * draw.choice([0.0, 0.05, 0.3])
        self.loss = draw.choice([0.0, 0.0, 0.01, 0.1])
        self.network, self.overtaken = draw.choice([1e-4, 1e-4, 2e-3, 0.01]), draw.choice([0.0, 0.0, 0.01, 0.05])

    def messages(self, start, end, first=1):
        """Return the messages between two times [s], numbered from `first`, in the order of arrival."""
        draw, count = self.draw, int((end - start) / self.period)
        sent = start + self.period * np.arange(0, count, self.burst)
        sent = np.repeat(sent + draw.uniform(0.0, self.jitter, len(sent)), self.burst)[:count]
        sent += 2e-4 * (np.arange(count) % self.burst)
        arrivals = np.maximum.accumulate(sent + 1e-4 + draw.exponential(self.network, count)) + 1e-6 * np.arange(count)
        order = np.argsort(np.arange(count) + 2.1 * (draw.random(count) < self.overtaken))
        return [
            Message(float(arrival), first + int(k), int(1e9 * (1e5 + sent[k] + self.offset)))
            for arrival, k in zip(arrivals, order, strict=True)
            if draw.random() >= self.loss
        ]


def without_numbers(messages, kind):
    """Return the messages as a middleware without numbers delivers them."""
    return [message._replace(number={"none": None, "zero": 0, "constant": 9}[kind]) for message in messages]


def detected(messages, series=None):
    """Return the time at which a second publisher is detected [s]; None if none is."""
    series = series or MessageSeries()
    for arrival, number, sent in sorted(messages, key=lambda message: message.arrival):
        series.take(number, sent, arrival)
        if series.is_shared:
            return arrival
    return None


def twins(seed):
    """Return the messages of a driver and those of the second, which begins 2 to 4 s later."""
    draw = np.random.default_rng(seed)
    offset = 0.0 if draw.random() < 0.5 else draw.choice([-1.0, 1.0]) * 10.0 ** draw.uniform(-3.0, 3.0)
    ours, theirs = Driver(draw), Driver(draw, clock_offset=offset)
    start = 2.0 + draw.uniform(0.0, 2.0)
    # Its numbers are the first ones, nearly those of the first driver, or any.
    number = int(draw.choice([1, start / ours.period + draw.integers(-5, 6), draw.integers(1, 100_000)]))
    return ours.messages(0.0, 8.0), theirs.messages(start, 8.0, max(1, number))


def restarts(seed, count=50):
    """Return the messages of a driver that is killed and started again `count` times; its stamps go on."""
    draw = np.random.default_rng(seed)
    messages, start = [], 0.0
    driver = Driver(draw)
    life = 10.0 ** draw.uniform(-0.5, 0.7)
    for _ in range(count + 1):
        end = start + life * draw.uniform(0.5, 1.5)
        driver.loss = draw.choice([0.0, 0.01, 0.1])
        # The reader misses what is sent before it is discovered.
        messages += driver.messages(start, end, first=1 + int(draw.choice([0, 0, 5, 40])))
        start = end + draw.uniform(0.1, 2.0)
    return messages


def delay(seed):
    """Return the time from the bound to the detection [s], negative within the bound; infinite without detection."""
    ours, theirs = twins(seed)
    theirs.sort()
    time = detected(ours + theirs)
    return np.inf if time is None else time - max(theirs[0].arrival + BOUND, theirs[2].arrival)


def false_alarm(seed):
    """Return True if 50 restarts are taken for two publishers."""
    return detected(restarts(seed)) is not None


LONG = pytest.param(1000, marks=pytest.mark.long)


@pytest.mark.parametrize("count", [60, LONG])
def test_second_publisher_is_detected_within_the_bound(count):
    delays = np.array([delay(seed) for seed in range(RESERVED, RESERVED + count)])
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
