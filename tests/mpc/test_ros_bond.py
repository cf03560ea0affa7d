"""The bond with a lifecycle manager: its protocol on a simulated clock, and over DDS with a bondcpp-like sister."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.mpc.ros.bond import CONNECT_TIMEOUT, DISCONNECT_TIMEOUT, HEARTBEAT_TIMEOUT, BondProtocol, BondState

PERIOD = 0.1


class Side:
    """One side of a bond, with the heartbeats that it has published."""

    def __init__(self):
        self.time, self.heartbeats = 0.0, []
        self.protocol = BondProtocol(self.heartbeats.append, lambda: self.time)

    def pass_by(self, seconds, *, hears=None):
        for _ in range(round(seconds / PERIOD)):
            self.time += PERIOD
            if hears is not None:
                self.protocol.receive(is_alive=hears)
            self.protocol.beat()
        return self.protocol.state


def test_it_waits_is_bound_and_leaves_when_the_sister_has_heard():
    side = Side()
    assert side.pass_by(5.0) is BondState.WAITING
    assert all(side.heartbeats)
    assert side.pass_by(60.0, hears=True) is BondState.ALIVE
    assert all(side.heartbeats)
    side.protocol.leave()
    assert side.heartbeats[-1] is False
    assert side.pass_by(1.0, hears=True) is BondState.LEAVING
    assert not any(side.heartbeats[-10:])
    side.protocol.receive(is_alive=False)
    count = len(side.heartbeats)
    assert side.pass_by(10.0, hears=True) is BondState.DEAD
    assert len(side.heartbeats) == count
    assert not side.protocol.end_reason


@pytest.mark.parametrize(
    ("bound", "timeout", "lost"), [(False, CONNECT_TIMEOUT, ""), (True, HEARTBEAT_TIMEOUT, "no heartbeat for 4 s")]
)
def test_without_a_sister_it_falls_silent_after_a_while(bound, timeout, lost):
    side = Side()
    if bound:
        side.pass_by(1.0, hears=True)
    assert side.pass_by(timeout - 0.3) is not BondState.DEAD
    assert side.pass_by(0.6) is BondState.DEAD
    assert side.protocol.end_reason == lost
    count = len(side.heartbeats)
    side.pass_by(20.0, hears=True)
    assert len(side.heartbeats) == count


def test_a_sister_that_dies_is_answered_once_and_one_that_never_answers_is_left():
    side = Side()
    side.pass_by(1.0, hears=True)
    side.protocol.receive(is_alive=False)
    assert side.heartbeats[-1] is False
    assert side.protocol.end_reason == "it ended the bond"
    count = len(side.heartbeats)
    assert side.pass_by(5.0, hears=False) is BondState.DEAD
    assert len(side.heartbeats) == count
    leaving = Side()
    leaving.pass_by(1.0, hears=True)
    leaving.protocol.leave()
    assert leaving.pass_by(DISCONNECT_TIMEOUT + 0.5) is BondState.DEAD


@given(st.lists(st.sampled_from(["beat", "alive", "dead", "leave", "late"]), max_size=40))
def test_whatever_happens_the_dead_stay_dead_and_say_nothing(events):
    side, dead = Side(), False
    for event in events:
        count = len(side.heartbeats)
        if event == "late":
            side.time += 30.0
        elif event == "beat":
            side.time += PERIOD
            side.protocol.beat()
        elif event == "leave":
            side.protocol.leave()
        else:
            side.protocol.receive(is_alive=event == "alive")
        if dead:
            assert side.protocol.state is BondState.DEAD
            assert len(side.heartbeats) == count
        dead = side.protocol.state is BondState.DEAD
