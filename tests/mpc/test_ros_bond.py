"""Bond with a lifecycle manager: protocol on a simulated clock, and over DDS with a peer that behaves like bondcpp."""

import time
import uuid

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lifecycle_msgs.msg import Transition
from ros_parts import stack

from diffdrive_mpc.mpc.ros.bond import CONNECT_TIMEOUT, DISCONNECT_TIMEOUT, HEARTBEAT_TIMEOUT, BondProtocol, BondState

PERIOD = 0.1


class BondSide:
    """One side of a bond, with the heartbeats that it has published."""

    def __init__(self):
        self.time, self.heartbeats = 0.0, []
        self.protocol = BondProtocol(self.heartbeats.append, lambda: self.time)

    def advance(self, seconds, *, peer_is_alive=None):
        """Advance the clock; the peer sends heartbeats with this state, or none if None."""
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
    ("bound", "timeout", "lost"), [(False, CONNECT_TIMEOUT, ""), (True, HEARTBEAT_TIMEOUT, "no heartbeat for 4 s")]
)
def test_bond_without_a_peer_stops_sending_after_the_timeout(bound, timeout, lost):
    side = BondSide()
    if bound:
        side.advance(1.0, peer_is_alive=True)
    assert side.advance(timeout - 0.3) is not BondState.DEAD
    assert side.advance(0.6) is BondState.DEAD
    assert side.protocol.end_reason == lost
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
    leaving = BondSide()
    leaving.advance(1.0, peer_is_alive=True)
    leaving.protocol.leave()
    assert leaving.advance(DISCONNECT_TIMEOUT + 0.5) is BondState.DEAD


@given(st.lists(st.sampled_from(["beat", "alive", "dead", "leave", "late"]), max_size=40))
def test_dead_bond_stays_dead_and_sends_nothing(events):
    side, dead = BondSide(), False
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


class Manager:
    """Manager's side of a bond, as in bondcpp: it publishes periodically and evaluates received heartbeats."""

    def __init__(self, s, name="diffdrive_mpc"):
        from bond.msg import Status

        self.s, self.type, self.name, self.instance = s, Status, name, str(uuid.uuid4())
        self.publisher = s.base.node.create_publisher(Status, "bond", 5)
        s.base.node.create_subscription(Status, "bond", self.take, 100)
        self.received, self.peer_instance, self.active = [], "", True

    def take(self, message):
        if message.id != self.name or message.instance_id == self.instance:
            return
        self.peer_instance = self.peer_instance or message.instance_id
        self.received.append(message)

    def send(self, *, active):
        message = self.type(id=self.name, instance_id=self.instance, active=active)
        message.heartbeat_period, message.heartbeat_timeout = 0.1, 4.0
        self.publisher.publish(message)

    def send_heartbeats(self, seconds):
        """Send heartbeats for a while, and run the ticks of the robot."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.send(active=True)
            beat = time.monotonic() + 0.1
            while time.monotonic() < beat:
                self.s.base.step()


@pytest.fixture
def managed(ros_types):
    with stack(trajectory="circle") as s:
        manager = Manager(s)
        s.base.until(lambda: s.base.silent(1) is not None and manager.received, "a heartbeat")
        yield s, manager


def test_deactivation_ends_the_bond_with_a_manager_over_dds(managed):
    s, manager = managed
    assert s.trigger("start").success
    manager.send_heartbeats(1.5)
    assert s.node.parts["bond"].bond.text == "bound"
    first = manager.received[-1]
    assert (first.active, first.id, first.instance_id) == (True, "diffdrive_mpc", manager.peer_instance)
    assert first.heartbeat_period == pytest.approx(0.1)
    assert first.heartbeat_timeout == pytest.approx(4.0)
    assert len(manager.received) >= 5
    assert s.change(Transition.TRANSITION_DEACTIVATE)
    s.base.until(lambda: not manager.received[-1].active, "the end of the bond")
    # The node repeats the end until the manager confirms it.
    count = len(manager.received)
    s.base.until(lambda: len(manager.received) > count + 2, "repetitions")
    manager.send(active=False)
    s.base.until(lambda: s.node.parts["bond"].bond.protocol.state is BondState.DEAD, "the dead bond")
    # After activation, the bond has a new instance.
    manager.received.clear()
    assert s.change(Transition.TRANSITION_ACTIVATE)
    s.base.until(lambda: any(message.active for message in manager.received), "a new heartbeat")
    assert manager.received[-1].instance_id != manager.peer_instance
