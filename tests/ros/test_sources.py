"""A second source of an input: an error in the health of the node; in lock-step the end of the node that it shifts."""

from __future__ import annotations

import pytest
from graph import PATIENT, NodeProcess, Peer, processes
from hannes_control.double_pid import DoublePID
from hannes_description.model import Model
from hannes_ros import convert, topics
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32

ERROR = "2"


def number(value: float) -> bytes:
    return convert.float64_bytes(value)


def state(tick: int, position: float = 0.0) -> bytes:
    return convert.MOTOR_STATE.encode(tick * 1_000_000, (position,), (0.0,), (0.0,))


def second_source(peer: Peer, node: str, name: str):
    """Another publisher of that signal, once the node tells of it."""
    publisher = topics.publisher(peer.node, name)
    told = f"2 publishers of {topics.signal(name).topic}; "
    peer.until_status(node, lambda s: told in s["message"] and s["level"] == ERROR, told)
    return publisher


def ends_with_one_error(peer: Peer, node: NodeProcess, name: str) -> None:
    """The node ends by itself, and its last line says which topic has how many publishers and what to do."""
    peer.until(lambda: node.process.poll() is not None, what="the end of the node")
    assert node.wait() == 2, node.output
    last = node.lines[-1]
    assert f"{topics.signal(name).topic} has more messages than the ticks need, and 2 publishers" in last
    assert "end the others" in last
    assert "Traceback" not in node.output


class Loop:
    """The peer as hand_sim and emg_reference: says tick after tick, each when the one before was answered."""

    def __init__(self, peer: Peer) -> None:
        self._peer, self.tick, self.reference = peer, 0, 5.0
        peer.hear("motor_voltage", callback=self._next)

    def say(self) -> None:
        self._peer.say("reference_position", number(self.reference))
        self._peer.say("motor_current", number(0.0))
        self._peer.say("encoder_position", state(self.tick))

    def _next(self, data: bytes) -> None:
        self.tick += 1
        self.say()


INPUTS = ("encoder_position", "motor_current", "reference_position")


@pytest.mark.parametrize("name", INPUTS)
def test_in_lockstep_one_message_of_another_source_ends_the_controller(peer, name):
    peer.hear_diagnostics()
    with processes(NodeProcess("motor_controller", clock="lockstep")) as (node,):
        for each in INPUTS:
            peer.matched(each)
        loop = Loop(peer)
        loop.say()
        peer.until(lambda: loop.tick > 20, what="the loop running")
        other = second_source(peer, "motor_controller", name)
        ticks = loop.tick
        peer.until(lambda: loop.tick > ticks, what="the loop, which a silent source does not disturb")
        # A state as of the first tick: it would pass for a simulator that began again.
        other.publish(state(0) if name == "encoder_position" else number(3.0))
        ends_with_one_error(peer, node, name)


def test_in_lockstep_a_reference_that_waits_for_no_tick_ends_the_controller(peer):
    """As emg_reference does in real time: its queue does not grow, and it does not keep the rest waiting for ever."""
    with processes(NodeProcess("motor_controller", clock="lockstep")) as (node,):
        for each in INPUTS:
            peer.matched(each)

        def ended() -> bool:
            for _ in range(10):
                peer.say("reference_position", number(1.0))
            return node.process.poll() is not None

        peer.until(ended, what="the end of the node")
        assert node.wait() == 2, node.output
    assert "reference_position has more messages than the ticks need, and 1 publisher." in node.lines[-1]
    assert "give every node clock:=lockstep" in node.lines[-1]


def test_in_lockstep_a_late_repetition_of_the_only_source_is_made_up_for(peer):
    """One that comes when the order counts again: it is noticed, and each tick meets its own reference."""
    peer.hear("motor_voltage")
    peer.hear_diagnostics()
    heard = peer.heard["motor_voltage"]
    law = DoublePID.of_model(Model.load("nominal").parameters)
    references = [5.0 + 0.1 * tick for tick in range(6)]
    with processes(NodeProcess("motor_controller", clock="lockstep")):
        for each in INPUTS:
            peer.matched(each)
        for tick, reference in enumerate(references):
            if tick == 1:
                peer.say("reference_position", number(references[0]))
                peer.spin(0.2)
            peer.say("reference_position", number(reference))
            peer.say("motor_current", number(0.0))
            peer.say("encoder_position", state(tick))
            peer.until(lambda n=tick + 1: len(heard) == n, what=f"voltage {tick}")
        peer.until_status("motor_controller", lambda s: s["rejoins"] == "1", "the count")
    assert [convert.float64_value(data) for data in heard] == [law.update(r, 0.0, 0.0) for r in references]


def test_in_lockstep_one_sample_of_another_source_ends_the_reference(peer):
    peer.hear("reference_position")
    peer.hear_diagnostics()
    heard = peer.heard["reference_position"]
    with processes(NodeProcess("emg_reference", clock="lockstep")) as (node,):
        for each in ("emg_flexor", "emg_extensor", "encoder_position"):
            peer.matched(each)
        other = second_source(peer, "emg_reference", "emg_extensor")
        other.publish(number(1.0))
        for tick in range(0, 40, 10):
            peer.say("encoder_position", state(tick))
            for _ in range(3 if tick else 1):
                peer.say("emg_flexor", number(1.0))
                peer.say("emg_extensor", number(0.0))
            peer.until(
                lambda n=tick // 10 + 1: len(heard) >= n or node.process.poll() is not None,
                what=f"the reference of tick {tick}",
            )
        ends_with_one_error(peer, node, "emg_extensor")


def test_in_lockstep_one_command_of_another_source_ends_the_simulator(peer):
    peer.hear_diagnostics()
    peer.hear("motor_current")
    peer.hear("encoder_position", callback=lambda data: peer.say("motor_voltage", number(1.0)))
    with processes(NodeProcess("hand_sim", clock="lockstep", **PATIENT)) as (node,):
        peer.matched("motor_voltage")
        other = second_source(peer, "hand_sim", "motor_voltage")
        ticks = len(peer.heard["motor_current"])
        peer.until(
            lambda: len(peer.heard["motor_current"]) > ticks + 100,
            what="the loop, which a silent source does not disturb",
        )
        other.publish(number(3.0))
        ends_with_one_error(peer, node, "motor_voltage")


@pytest.mark.parametrize(
    ("node", "names"),
    [("motor_controller", INPUTS), ("emg_reference", ("emg_flexor", "emg_extensor"))],
)
def test_in_real_time_each_input_with_two_sources_is_reported_and_logged(peer, node, names):
    peer.hear_diagnostics()
    with processes(NodeProcess(node)) as (process,):
        for name in names:
            peer.publisher(name)
            second_source(peer, node, name)
        every = ", ".join(f"2 publishers of {topics.signal(name).topic}" for name in names)
        peer.until_status(node, lambda s: s["message"].startswith(f"{every}; end all but one"))
        peer.until(lambda: "; end all but one" in process.output, what="the same in the log")


def test_a_source_of_another_type_is_told(peer):
    """Nothing of it is heard, and neither side would say why."""
    peer.hear_diagnostics()
    peer.node.create_publisher(Float32, "emg/flexor", 10)
    with processes(NodeProcess("emg_reference")):
        told = "emg/flexor is published by peer as std_msgs/msg/Float32, which is not heard: it must be std_msgs/"
        peer.until_status("emg_reference", lambda s: told in s["message"] and s["level"] == ERROR, told)


def test_a_best_effort_source_is_told(peer):
    """As drivers of sensors publish: nothing of it is heard either."""
    peer.hear_diagnostics()
    quality = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    peer.node.create_publisher(JointState, "motor/state", quality)
    with processes(NodeProcess("motor_controller")):
        told = "motor/state is published by peer as best effort (SensorDataQoS), which is not heard: publish it rel"
        peer.until_status("motor_controller", lambda s: told in s["message"] and s["level"] == ERROR, told)
