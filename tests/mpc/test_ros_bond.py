"""Bond with a lifecycle manager: the protocol on a simulated clock."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.mpc.ros.bond import CONNECT_TIMEOUT, DISCONNECT_TIMEOUT, HEARTBEAT_TIMEOUT, BondProtocol, BondState

PERIOD = 0.1


class BondSide:
    """One side of a bond, with the heartbeats that it has published."""

    def __init__(self):
        self.time, self.heartbeats = 0.0, []
        self.protocol = BondProtocol(self.heartbeats.append, lambda: self.time)

    def advance(self, seconds, *, peer_is_alive=None):
        """Advance the clock; the peer sends heartbeats with the state `peer_is_alive`, or none for None."""
        for _ in range(round(seconds / PERIOD)):
            self.time += PERIOD
            if peer_is_alive is not None:
                self.protocol.receive(is_alive=peer_is_alive)
            self.protocol.beat()
        return self.protocol.state


def test_bond_waits_forms_and_ends_after_the_peer_confirms():
    side = BondSide()
    assert side.advance(5.0) is BondState.WAITING
    assert all(side.heartbeats)
    assert side.advance(60.0, peer_is_alive=True) is BondState.ALIVE
    assert all(side.heartbeats)
    side.protocol.leave()
    assert side.heartbeats[-1] is False
    assert side.advance(1.0, peer_is_alive=True) is BondState.LEAVING
    assert not any(side.heartbeats[-10:])
    side.protocol.receive(is_alive=False)
    count = len(side.heartbeats)
    assert side.advance(10.0, peer_is_alive=True) is BondState.DEAD
    assert len(side.heartbeats) == count
    assert not side.protocol.end_reason


@pytest.mark.parametrize(
    ("formed", "timeout", "reason"), [(False, CONNECT_TIMEOUT, ""), (True, HEARTBEAT_TIMEOUT, "no heartbeat for 4 s")]
)
def test_bond_without_a_peer_stops_sending_after_the_timeout(formed, timeout, reason):
    side = BondSide()
    if formed:
        side.advance(1.0, peer_is_alive=True)
    assert side.advance(timeout - 0.3) is not BondState.DEAD
    assert side.advance(0.6) is BondState.DEAD
    assert side.protocol.end_reason == reason
    count = len(side.heartbeats)
    side.advance(20.0, peer_is_alive=True)
    assert len(side.heartbeats) == count


def test_end_by_the_peer_is_confirmed_once_and_a_missing_confirmation_times_out():
    side = BondSide()
    side.advance(1.0, peer_is_alive=True)
    side.protocol.receive(is_alive=False)
    assert side.heartbeats[-1] is False
    assert side.protocol.end_reason == "it ended the bond"
    count = len(side.heartbeats)
    assert side.advance(5.0, peer_is_alive=False) is BondState.DEAD
    assert len(side.heartbeats) == count
    second = BondSide()
    second.advance(1.0, peer_is_alive=True)
    second.protocol.leave()
    assert second.advance(DISCONNECT_TIMEOUT + 0.5) is BondState.DEAD


@given(st.lists(st.sampled_from(["beat", "alive", "dead", "leave", "late"]), max_size=40))
def test_dead_bond_stays_dead_and_sends_no_heartbeats(events):
    side, was_dead = BondSide(), False
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
        if was_dead:
            assert side.protocol.state is BondState.DEAD
            assert len(side.heartbeats) == count
        was_dead = side.protocol.state is BondState.DEAD
