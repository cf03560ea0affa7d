"""The bond with a lifecycle manager: its protocol on a simulated clock, and over DDS with a bondcpp-like sister."""

import time
import uuid

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lifecycle_msgs.msg import Transition
from ros_parts import stack

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


class Manager:
    """Manager's side of a bond, as in bondcpp: it publishes periodically and evaluates received heartbeats."""

    def __init__(self, s, name="diffdrive_mpc"):
        from bond.msg import Status

        self.s, self.type, self.name, self.instance = s, Status, name, str(uuid.uuid4())
        self.publisher = s.base.node.create_publisher(Status, "bond", 5)
        s.base.node.create_subscription(Status, "bond", self.take, 100)
        self.heard, self.sister, self.active = [], "", True

    def take(self, message):
        if message.id != self.name or message.instance_id == self.instance:
            return
        self.sister = self.sister or message.instance_id
        self.heard.append(message)

    def say(self, *, active):
        message = self.type(id=self.name, instance_id=self.instance, active=active)
        message.heartbeat_period, message.heartbeat_timeout = 0.1, 4.0
        self.publisher.publish(message)

    def live(self, seconds):
        """Send heartbeats for a while, and run the ticks of the robot."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.say(active=True)
            beat = time.monotonic() + 0.1
            while time.monotonic() < beat:
                self.s.base.step()


@pytest.fixture
def managed(ros_types):
    with stack(trajectory="circle") as s:
        manager = Manager(s)
        s.base.until(lambda: s.base.silent(1) is not None and manager.heard, "a heartbeat")
        yield s, manager


def test_over_dds_a_manager_is_bound_and_told_at_once_of_deactivation(managed):
    s, manager = managed
    assert s.trigger("start").success
    manager.live(1.5)
    assert s.node.parts["bond"].bond.text == "bound"
    first = manager.heard[-1]
    assert (first.active, first.id, first.instance_id) == (True, "diffdrive_mpc", manager.sister)
    assert first.heartbeat_period == pytest.approx(0.1)
    assert first.heartbeat_timeout == pytest.approx(4.0)
    assert len(manager.heard) >= 5
    assert s.change(Transition.TRANSITION_DEACTIVATE)
    s.base.until(lambda: not manager.heard[-1].active, "the end of the bond")
    # It goes on saying so until the manager has said it, too.
    count = len(manager.heard)
    s.base.until(lambda: len(manager.heard) > count + 2, "more of it")
    manager.say(active=False)
    s.base.until(lambda: s.node.parts["bond"].bond.protocol.state is BondState.DEAD, "the end")
    # Activated again it is another side of the same bond.
    manager.heard.clear()
    assert s.change(Transition.TRANSITION_ACTIVATE)
    s.base.until(lambda: any(each.active for each in manager.heard), "a new heartbeat")
    assert manager.heard[-1].instance_id != manager.sister
