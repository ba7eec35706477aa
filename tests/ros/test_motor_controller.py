"""motor_controller alone, driven over topics, and what happens to the motor when it dies or pauses."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from time import monotonic, sleep
from typing import Any

import numpy as np
import pytest
from graph import NodeProcess, Peer, kept_waiting, processes
from hannes_bringup import motor_switch
from hannes_bringup.motor_switch import Lifecycle
from hannes_control.double_pid import DoublePID
from hannes_control.reference import half_sine
from hannes_description.model import Model
from hannes_ros import convert
from lifecycle_msgs.msg import Transition
from patience import PATIENCE
from rclpy.serialization import serialize_message
from rclpy.task import Future

NAME = "motor_controller"


def state_bytes(stamp_ns: int, position: float, names: tuple[str, ...] = ("motor_pulley",)) -> bytes:
    sample = convert.JointSample(stamp_ns, (position,), (0.0,), (0.0,))
    return serialize_message(convert.joint_message(names, sample))


def say_tick(peer: Peer, tick: int, position: float, current: float, reference: float) -> None:
    peer.say("reference_position", convert.float64_bytes(reference))
    peer.say("motor_current", convert.float64_bytes(current))
    peer.say("encoder_position", state_bytes(tick * 1_000_000, position))


def announce(peer: Peer) -> None:
    """Publishers of all that the controller hears, matched."""
    for name in ("encoder_position", "motor_current", "reference_position"):
        peer.matched(name)


def voltages(peer: Peer) -> list[float]:
    return [convert.float64_value(data) for data in peer.heard["motor_voltage"]]


def next_report(peer: Peer) -> Mapping[str, str]:
    """The next diagnostics, with the controller as the only node."""
    before = len(peer.diagnostics)
    peer.until(lambda: len(peer.diagnostics) > before, what="the next report")
    return peer.status(NAME)


def lifecycle(peer: Peer) -> Lifecycle:
    return Lifecycle(peer.node, peer.executor, NAME, monotonic() + PATIENCE)


def transition(peer: Peer, number: int) -> bool:
    return lifecycle(peer).change(number)


def test_lockstep_answers_each_state_with_the_law(peer):
    peer.hear("motor_voltage")
    law = DoublePID.of_model(Model.load("nominal").parameters)
    rng = np.random.default_rng(0)
    inputs = rng.uniform((0, 0, -1), (14, 14, 1), size=(30, 3)).tolist()
    with processes(NodeProcess(NAME, clock="lockstep")):
        announce(peer)
        for tick, (reference, position, current) in enumerate(inputs):
            say_tick(peer, tick, position, current, reference)
            peer.until(lambda tick=tick: len(voltages(peer)) == tick + 1, what=f"voltage {tick}")
        expected = [law.update(*values) for values in inputs]
        assert voltages(peer) == expected
        # a repeated reading is not answered again; a simulator that begins again finds a cleared controller
        say_tick(peer, 29, *inputs[29][1:], inputs[29][0])
        peer.spin(0.2)
        assert len(voltages(peer)) == 30
        for tick in range(2):
            reference, position, current = inputs[tick]
            peer.say("encoder_position", state_bytes(tick * 1_000_000, position))
            peer.spin(0.05)
            peer.say("motor_current", convert.float64_bytes(current))
            peer.say("reference_position", convert.float64_bytes(reference))
            peer.until(lambda tick=tick: len(voltages(peer)) == 31 + tick, what=f"voltage {tick} again")
        assert voltages(peer)[30:] == expected[:2]


def test_another_period_than_the_simulator_s_is_one_clear_error(peer):
    peer.hear("motor_voltage")
    with processes(NodeProcess(NAME, clock="lockstep", period=0.002)) as (node,):
        announce(peer)
        say_tick(peer, 0, 0.0, 0.0, 5.0)
        peer.until(lambda: len(voltages(peer)) == 1)
        say_tick(peer, 1, 0.0, 0.0, 5.0)
        peer.until(lambda: node.process.poll() is not None, what="the end of the node")
        assert node.wait() == 2
        assert "motor/state comes every 0.001 s, but the control period is 0.002 s" in node.output
    assert len(voltages(peer)) == 1


def test_a_profile_beyond_the_travel_of_the_hand_is_refused(ros_environment):
    with processes(NodeProcess(NAME, reference="ramp_hold", reference_amplitude=20.0)) as (node,):
        assert node.wait() == 2
        assert "amplitude is 20 rad, but the hand is fully closed at 15.6 rad" in node.output


def drives(status: Mapping[str, str]) -> bool:
    """All is well, but for the rate at which a busy machine lets the test send."""
    return status["message"].startswith(("running", "motor/state comes at"))


def test_wrong_joint_and_not_finite_inputs_are_rejected_and_counted(peer):
    peer.hear("motor_voltage")
    peer.hear_diagnostics()
    with processes(NodeProcess(NAME, clock="lockstep")) as (node,):
        announce(peer)
        peer.say("encoder_position", state_bytes(0, 1.0, names=("elbow",)))
        for tick, current in enumerate((math.nan, math.inf, 0.5)):
            say_tick(peer, tick, 1.0, current, 5.0)
            peer.until(lambda tick=tick: len(voltages(peer)) == tick + 1, what=f"voltage {tick}")
        status = peer.until_status(NAME, lambda s: s["cycles"] == "3", "the counts")
        assert (status["rejected_states"], status["rejected_inputs"]) == ("1", "2")
        assert voltages(peer)[:2] == [0.0, 0.0]
        assert voltages(peer)[2] > 0.0
        rejected = "motor/state is rejected: the joints are ['elbow'], expected ['motor_pulley']"
        peer.until(lambda: rejected in node.output, what="the reason in the log")


def test_a_reference_that_is_not_finite_leaves_the_last_good_one(peer):
    peer.hear("motor_voltage")
    peer.hear_diagnostics()
    law = DoublePID.of_model(Model.load("nominal").parameters)
    with processes(NodeProcess(NAME, clock="lockstep")) as (node,):
        announce(peer)
        for tick, reference in enumerate((math.nan, 5.0, math.nan, math.inf)):
            say_tick(peer, tick, 1.0, 0.5, reference)
            peer.until(lambda tick=tick: len(voltages(peer)) == tick + 1, what=f"voltage {tick}")
        assert voltages(peer) == [0.0, *(law.update(5.0, 1.0, 0.5) for _ in range(3))]
        said = "reference_position is not finite (inf): the last good one holds"
        bad = peer.until_status(NAME, lambda s: s["message"] == said, "the rejected reference")
        assert (bad["level"], bad["rejected_inputs"]) == ("1", "3")
        peer.until(lambda: "reference_position is not finite (" in node.output, what="the reason in the log")
        say_tick(peer, 4, 1.0, 0.5, 6.0)
        peer.until(lambda: len(voltages(peer)) == 5)
        assert voltages(peer)[4] == law.update(6.0, 1.0, 0.5)
        peer.until_status(NAME, lambda s: "not finite" not in s["message"] and s["level"] == "0", "all well")


def test_a_reference_beyond_the_travel_of_the_hand_is_limited(peer):
    peer.hear("motor_voltage")
    peer.hear_diagnostics()
    law = DoublePID.of_model(Model.load("nominal").parameters)
    close_to = 15.6 + 1e-6  # rounding is no reason to say a word
    with processes(NodeProcess(NAME, clock="lockstep")) as (node,):
        announce(peer)
        for tick, reference in enumerate((close_to, -60.0, 400.0)):
            say_tick(peer, tick, 14.0, 0.5, reference)
            peer.until(lambda tick=tick: len(voltages(peer)) == tick + 1, what=f"voltage {tick}")
        assert voltages(peer) == [law.update(reference, 14.0, 0.5) for reference in (close_to, 0.0, 15.6)]
        said = "reference_position of 400 rad is limited to 0 .. 15.6 rad, the travel of the hand"
        status = peer.until_status(NAME, lambda s: s["message"] == said, "the limited reference")
        assert (status["level"], status["limited_references"]) == ("1", "2")
        peer.until(lambda: "is limited to 0 .. 15.6 rad" in node.output, what="the reason in the log")
        say_tick(peer, 3, 14.0, 0.5, 14.0)
        peer.until_status(NAME, lambda s: "limited to" not in s["message"] and s["level"] == "0", "all well")


@dataclass
class Sensors:
    """State, current and reference in real time, as a board would send them; long limits, for a busy machine."""

    peer: Peer
    position: float = 1.0
    current: float = 0.1
    reference: float | None = 5.0
    stamped_ahead: float = 0.0
    patient = {"clock": "realtime", "pause_limit_ms": 10000, "state_timeout_ms": 3000}

    def say(self) -> None:
        now = self.peer.node.get_clock().now().nanoseconds + round(self.stamped_ahead * 1e9)
        self.peer.say("encoder_position", state_bytes(now, self.position))
        self.peer.say("motor_current", convert.float64_bytes(self.current))
        if self.reference is not None:
            self.peer.say("reference_position", convert.float64_bytes(self.reference))
        self.peer.executor.spin_once(timeout_sec=0.001)

    def until(self, condition: Callable[[Mapping[str, str]], bool], what: str) -> Mapping[str, str]:
        """Send, without a pause, until the controller's status is that."""
        end = monotonic() + PATIENCE
        while not (status := self.peer.status(NAME)) or not condition(status):
            assert monotonic() < end, f"not within {PATIENCE} s: {what}"
            self.say()
        return status


@contextmanager
def driven_then(peer: Peer, bad: Mapping[str, float]) -> Iterator[tuple[Sensors, NodeProcess]]:
    """A controller that has driven the motor, from where on its sensors, by name, are bad."""
    peer.hear("motor_voltage")
    peer.hear_diagnostics()
    sensors = Sensors(peer)
    with processes(NodeProcess(NAME, **Sensors.patient)) as (node,):
        announce(peer)
        sensors.until(drives, "a driven motor")
        for name, value in bad.items():
            setattr(sensors, name, value)
        yield sensors, node


@pytest.mark.parametrize(
    ("bad", "said", "level"),
    (
        ({"current": math.nan}, "motor/current is not finite (nan): 0 V", "2"),
        ({"position": math.nan}, "position of motor/state is not finite (nan): 0 V", "2"),
        ({"reference": math.nan}, "reference_position is not finite (nan): the last good one holds", "1"),
        ({"reference": 400.0}, "reference_position of 400 rad is limited to 0 .. 15.6 rad", "1"),
    ),
)
def test_bad_inputs_are_said_until_good_ones_come(peer, bad, said, level):
    with driven_then(peer, bad) as (sensors, node):
        status = sensors.until(lambda s: said in s["message"], "the rejected input")
        assert status["level"] >= level
        # the voltages and the status are two topics: what was sent before the status may still be on its way
        status = sensors.until(lambda s: (voltages(peer)[-1] == 0.0) is (level == "2"), "the voltage with it")
        assert status["state_timeouts"] == "0"
        peer.until(lambda: said in node.output, what="the reason in the log")
        sensors.position, sensors.current, sensors.reference = 1.0, 0.1, 5.0
        sensors.until(drives, "all well again")
        sensors.until(lambda s: voltages(peer)[-1] > 0.0, "a voltage that moves")


@pytest.mark.parametrize(
    ("bad", "said"),
    (
        ({"current": 200.0}, "motor/current of 200 A is beyond what this hand has, 24.2 A: in A? 0 V"),
        (
            {"position": 57.3},
            "position of motor/state of 57.3 rad is beyond what this hand has, -15.6 .. 31.2 rad",
        ),
    ),
)
def test_readings_that_no_hand_gives_switch_the_motor_off(peer, bad, said):
    """In mA or degrees: at 0 V the hand soon draws little enough to be believed, and would be driven again."""
    with driven_then(peer, bad) as (sensors, node):
        sensors.until(lambda s: "not active: motor off; activate again" in s["message"], "the motor off")
        peer.until(
            lambda: said in node.output and "readings that no hand gives" in node.output, what="the log"
        )
        # what was driven before may still be on its way: after the first 0 V nothing else comes
        sensors.until(lambda s: voltages(peer)[-1] == 0.0, "0 V")
        before = len(voltages(peer))
        sensors.position, sensors.current = 1.0, 0.1
        status = sensors.until(lambda s: "beyond what" not in s["message"], "good readings")
        assert status["active"] == "False" and status["trips"] == "1"
        assert not any(voltages(peer)[before:])


@pytest.mark.parametrize(("ahead", "said"), ((-60.0, " s before "), (60.0, " s after ")))
def test_states_of_another_clock_are_rejected_and_said(peer, ahead, said):
    peer.hear("motor_voltage")
    peer.hear_diagnostics()
    sensors = Sensors(peer, stamped_ahead=ahead)
    with processes(NodeProcess(NAME, **Sensors.patient)) as (node,):
        announce(peer)
        status = sensors.until(lambda s: "motor/state is rejected" in s["message"], "the reason")
        assert said + "the clock of this machine (for a played bag set use_sim_time)" in status["message"]
        assert "waiting for motor/state" not in status["message"]
        assert status["level"] == "2"
        assert voltages(peer) == []
        peer.until(
            lambda: "motor/state is rejected: it is stamped" in node.output, what="the reason in the log"
        )
        sensors.stamped_ahead = 0.0
        before = int(sensors.until(drives, "a motor")["rejected_states"])
        # a single one costs no other: those that follow it are not older than it
        sensors.stamped_ahead = ahead
        sensors.say()
        sensors.stamped_ahead = 0.0
        status = sensors.until(lambda s: int(s["rejected_states"]) > before, "one more rejected")
        assert (int(status["rejected_states"]), status["state_timeouts"]) == (before + 1, "0")


def test_states_without_a_stamp_are_rejected_and_said(peer):
    peer.hear_diagnostics()
    with processes(NodeProcess(NAME, **Sensors.patient)):
        announce(peer)
        peer.say("encoder_position", state_bytes(0, 1.0))
        said = "motor/state is rejected: its header has no stamp; set it by the clock of this machine"
        peer.until_status(NAME, lambda s: said in s["message"], "the reason")


def test_a_state_that_comes_late_among_others_is_counted_only(peer):
    """A busy machine makes it late; its clock is the same."""
    peer.hear_diagnostics()
    sensors = Sensors(peer)
    limits = {**Sensors.patient, "state_timeout_ms": 200}
    with processes(NodeProcess(NAME, **limits)) as (node,):
        announce(peer)
        sensors.until(lambda s: int(s["resets"]) > 0, "a controller that hears")

        def late() -> bool:
            sensors.say()
            sensors.stamped_ahead = -0.3
            sensors.say()
            sensors.stamped_ahead = 0.0
            return int(peer.status(NAME).get("rejected_states", 0)) > 3

        peer.until(late, what="late states")
        assert "it is stamped" not in node.output and "it is stamped" not in peer.status(NAME)["message"]


def test_states_that_come_too_slowly_are_said(peer):
    peer.hear_diagnostics()
    sensors = Sensors(peer)
    with processes(NodeProcess(NAME, **Sensors.patient)) as (node,):
        announce(peer)

        def slow() -> bool:
            sensors.say()
            sleep(0.05)
            status = peer.status(NAME)
            told = status.get("message", "").startswith("motor/state comes at ")
            # a busy machine makes the loop miss cycles, which is an error of its own for a while
            return told and status["level"] == "1"

        peer.until(slow, what="a warning")
        assert float(peer.status(NAME)["state_rate_hz"]) < 80.0
        peer.until(
            lambda: "Hz: the loop needs 100 Hz, or it oscillates" in node.output, what="the reason in the log"
        )
        status = sensors.until(lambda s: s["message"].startswith("running"), "faster states")
        assert float(status["state_rate_hz"]) >= 80.0


def test_a_waiting_controller_is_a_warning_however_late_its_loop(peer):
    peer.hear_diagnostics()

    with processes(NodeProcess(NAME, **Sensors.patient)) as (node,):
        next_report(peer)
        node.send(signal.SIGSTOP)
        peer.spin(0.3)  # some hundred periods
        node.send(signal.SIGCONT)
        next_report(peer)
        next_report(peer)
        waiting = "waiting for motor/state, motor/current, reference_position"
        assert {(s.level[0], s.message) for s in peer.diagnostics} == {(1, waiting)}


@pytest.mark.slow
def test_a_profile_of_its_own_waits_for_the_hand(peer):
    peer.hear("motor_voltage", "reference_position")
    peer.hear_diagnostics()
    sensors = Sensors(peer, reference=None)
    profile = half_sine(period=400.0)  # 100 s of closing: it tells which period a reference is of

    def references() -> list[float]:
        return [convert.float64_value(data) for data in peer.heard["reference_position"]]

    with processes(NodeProcess(NAME, reference="half_sine", reference_period=400.0, **Sensors.patient)):
        for name in ("encoder_position", "motor_current"):
            peer.matched(name)
        next_report(peer)
        next_report(peer)  # a second of waiting
        assert references() == []
        sensors.until(drives, "a driven motor")
        assert references()[0] == profile[0]
        peer.until_status(NAME, lambda s: int(s["state_timeouts"]) > 0, "the timeout")
        stands = len(references())
        next_report(peer)
        next_report(peer)  # a second without sensors
        sensors.until(drives, "a driven motor again")
        given = references()
        assert len(given) > stands
        # one period for each reference, besides those that a busy machine made the loop miss
        missed = int(next_report(peer)["missed_cycles"])
        assert np.searchsorted(profile[:100_000], given[-1]) < len(given) + missed


def test_a_profile_of_its_own_waits_for_those_who_shall_hear_all_of_it(peer):
    peer.hear("motor_voltage")
    peer.hear_diagnostics()
    sensors = Sensors(peer, reference=None)
    own = {"reference": "half_sine", "reference_period": 400.0, "reference_subscribers": 1}
    with processes(NodeProcess(NAME, **own, **Sensors.patient)):
        sensors.until(
            lambda s: s["message"] == "waiting for 1 subscriber(s) of reference_position", "what it waits for"
        )
        peer.hear("reference_position")
        sensors.until(drives, "a driven motor")
        first = convert.float64_value(peer.heard["reference_position"][0])
    assert first == half_sine(period=400.0)[0]


def test_the_motor_is_driven_only_while_active_and_activation_clears_the_integrator(peer):
    peer.hear("motor_voltage")
    with processes(NodeProcess(NAME, clock="lockstep", autostart=False)):
        announce(peer)
        say_tick(peer, 0, 0.0, 0.0, 5.0)
        peer.spin(0.3)
        assert voltages(peer) == []
        assert lifecycle(peer).state() == "unconfigured"
        assert transition(peer, Transition.TRANSITION_CONFIGURE)
        assert transition(peer, Transition.TRANSITION_ACTIVATE)
        peer.until(lambda: len(voltages(peer)) == 1, what="the answer to the waiting tick")
        for tick in range(1, 5):
            say_tick(peer, tick, 0.0, 0.0, 5.0)
            peer.until(lambda tick=tick: len(voltages(peer)) == tick + 1)
        assert voltages(peer)[4] > voltages(peer)[0]  # the integrator has grown
        assert transition(peer, Transition.TRANSITION_DEACTIVATE)
        say_tick(peer, 5, 0.0, 0.0, 5.0)
        peer.spin(0.3)
        assert len(voltages(peer)) == 5
        assert transition(peer, Transition.TRANSITION_ACTIVATE)
        peer.until(lambda: len(voltages(peer)) == 6)
        assert voltages(peer)[5] == voltages(peer)[0]


def test_real_time_goes_to_zero_volt_when_the_state_stops(peer):
    peer.hear("motor_voltage")
    peer.hear_diagnostics()
    # Long limits: this test is about a state that stops for good, on a machine that may keep each process waiting.
    node = NodeProcess(NAME, clock="realtime", pause_limit_ms=10000, state_timeout_ms=3000)
    with processes(node):
        announce(peer)
        peer.say("reference_position", convert.float64_bytes(5.0))

        def driven() -> bool:
            now = peer.node.get_clock().now().nanoseconds
            peer.say("encoder_position", state_bytes(now, 1.0))
            peer.say("motor_current", convert.float64_bytes(0.1))
            peer.spin(0.01)
            return max(voltages(peer), default=0.0) > 1.0

        peer.until(driven, what="a voltage")
        status = peer.until_status(NAME, lambda s: int(s["state_timeouts"]) >= 1, "the timeout")
        peer.until(lambda: voltages(peer)[-1] == 0.0, what="0 V")
        peer.until(lambda: "motor/state or motor/current is too old: 0 V" in node.output, what="the log")
        before = int(status["rejected_states"])
        peer.say("encoder_position", state_bytes(1_000_000_000, 1.0))  # a stamp of long ago
        peer.until_status(NAME, lambda s: int(s["rejected_states"]) == before + 1, "the old stamp counted")
        assert voltages(peer)[-1] == 0.0


def test_real_time_warns_of_a_reference_that_has_stopped(peer):
    peer.hear_diagnostics()
    with processes(NodeProcess(NAME, clock="realtime", pause_limit_ms=10000, state_timeout_ms=10000)):
        announce(peer)
        peer.say("reference_position", convert.float64_bytes(5.0))

        def silent(reference: bool = False) -> bool | None:
            peer.say("encoder_position", state_bytes(peer.node.get_clock().now().nanoseconds, 1.0))
            peer.say("motor_current", convert.float64_bytes(0.1))
            if reference:
                peer.say("reference_position", convert.float64_bytes(5.0))
            peer.spin(0.02)
            status = peer.status(NAME)
            return "no reference_position for " in status["message"] if status else None

        peer.until(lambda: silent() is True, what="the warning")
        assert " s: the last one is held" in peer.status(NAME)["message"]
        assert (
            peer.status(NAME)["level"] != "0"
        )  # an error where a busy machine kept the loop from running, too
        peer.until(lambda: silent(reference=True) is False, what="the reference again")


def test_lockstep_warns_of_a_tick_that_misses_its_reference(peer):
    peer.hear("motor_voltage")
    peer.hear_diagnostics()
    with processes(NodeProcess(NAME, clock="lockstep")):
        announce(peer)
        peer.say("motor_current", convert.float64_bytes(0.0))
        peer.say("encoder_position", state_bytes(0, 0.0))
        peer.until_status(
            NAME, lambda s: (s["message"], s["level"]) == ("waiting for reference_position", "1")
        )


def test_hannes_motor_switches_a_running_controller(peer):
    def motor(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "hannes_bringup.cli", "motor", "--json", "--timeout", "60", *words]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    with processes(NodeProcess(NAME, clock="lockstep", autostart=False)):
        announce(peer)
        name = ("--node", f"{peer.node.get_namespace().rstrip('/')}/{NAME}")
        for wanted, state in (
            ((), "unconfigured"),
            (("on",), "active"),
            (("off",), "inactive"),
            (("on",), "active"),
        ):
            asked = motor(*wanted, *name)
            assert asked.returncode == 0, asked.stderr
            assert json.loads(asked.stdout)["state"] == state
    nobody = motor("on", "--node", "/nobody/there", "--timeout", "0.5")
    assert nobody.returncode == 2
    assert nobody.stderr.count("\n") == 1 and "No lifecycle node '/nobody/there'" in nobody.stderr
    wrong = motor("on", "--node", "/no name!")
    assert wrong.returncode == 2
    assert wrong.stderr.count("\n") == 1 and "'/no name!' is no name of a node" in wrong.stderr


def test_a_transition_that_the_state_does_not_allow_is_refused_and_the_node_lives(peer):
    with processes(NodeProcess(NAME, clock="realtime", autostart=False)) as (node,):
        for possible, number, state in (
            (False, Transition.TRANSITION_ACTIVATE, "unconfigured"),
            (False, 77, "unconfigured"),
            (True, Transition.TRANSITION_CONFIGURE, "inactive"),
            (False, Transition.TRANSITION_CONFIGURE, "inactive"),
            (False, Transition.TRANSITION_DEACTIVATE, "inactive"),
            (True, Transition.TRANSITION_ACTIVATE, "active"),
            (False, Transition.TRANSITION_ACTIVATE, "active"),
            (True, Transition.TRANSITION_ACTIVE_SHUTDOWN, "finalized"),
            (False, Transition.TRANSITION_ACTIVATE, "finalized"),
        ):
            assert transition(peer, number) is possible
            assert lifecycle(peer).state() == state
        assert node.process.poll() is None
        assert "Traceback" not in node.output


class Hurried(Lifecycle):
    """Somebody else makes each transition a moment before."""

    def change(self, transition: int) -> bool:
        assert super().change(transition)
        return super().change(transition)


def test_the_motor_is_switched_by_two_at_once(peer, monkeypatch):
    monkeypatch.setattr(motor_switch, "Lifecycle", Hurried)
    monkeypatch.setattr(motor_switch, "_PATIENCE_S", PATIENCE)
    with processes(NodeProcess(NAME, clock="lockstep", autostart=False)):
        name = f"{peer.node.get_namespace().rstrip('/')}/{NAME}"
        assert motor_switch.switch(name, True, PATIENCE) == "active"
        assert motor_switch.switch(name, False, PATIENCE) == "inactive"


class Deaf:
    """A client whose first requests get no answer, as when Fast DDS drops one, and which counts them.

    Only those count as lost: for the answers that do come there is time, on a busy machine too.
    """

    def __init__(self, client: Any, lost: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self._client, self._lost, self.requests = client, lost, 0
        self._monkeypatch = monkeypatch

    def call_async(self, request: object) -> Any:
        self.requests += 1
        answered = self.requests > self._lost
        self._monkeypatch.setattr(motor_switch, "_PATIENCE_S", PATIENCE if answered else 1.0)
        return self._client.call_async(request) if answered else Future()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._client, name)


def test_lost_answers_of_a_lifecycle_node_are_made_up_for(peer, monkeypatch):
    with processes(NodeProcess(NAME, clock="lockstep", autostart=False)):
        announce(peer)
        asked = lifecycle(peer)
        asked._states = Deaf(asked._states, 1, monkeypatch)
        assert asked.state() == "unconfigured"
        assert asked._states.requests == 2
        asked._changes = Deaf(asked._changes, 1, monkeypatch)
        assert asked.change(Transition.TRANSITION_CONFIGURE)  # the request was lost: asked again
        assert asked._changes.requests == 2
        assert asked.change(Transition.TRANSITION_ACTIVATE)
        asked._changes = Deaf(asked._changes, 1, monkeypatch)
        assert asked.change(Transition.TRANSITION_ACTIVATE)  # the answer was lost: it is active
        assert asked._changes.requests == 1


def without_command(status: Mapping[str, str]) -> bool:
    return status["message"].startswith("command timed out: 0 V")


def test_killed_or_stopped_controller_leaves_zero_volt(peer):
    peer.hear_diagnostics()
    sim = NodeProcess("hand_sim", clock="realtime", command_timeout_ms=60)
    # Period and limit are long because two real-time loops and the test share this machine with others: the pause that
    # switches the motor off must be the one made here.
    first = NodeProcess(
        NAME,
        clock="realtime",
        reference="half_sine",
        period=0.005,
        pause_limit_ms=2000,
        state_timeout_ms=1000,
    )
    with processes(sim, first):
        running = peer.until_status(
            "hand_sim", lambda s: s["message"].startswith("running"), "a driven motor"
        )
        before = int(running["command_timeouts"])
        first.send(signal.SIGSTOP)
        stopped = peer.until_status("hand_sim", without_command, "the timeout")
        assert stopped["applied_voltage"] == "0"
        assert int(stopped["command_timeouts"]) > before
        assert float(stopped["command_age_at_zero_s"]) <= 0.1 + kept_waiting(running, stopped)
        peer.spin(2.3)
        first.send(signal.SIGCONT)
        peer.until_status(NAME, lambda s: s["trips"] == "1", "the pause noticed")
        paused = peer.status(NAME)
        assert paused["active"] == "False"
        assert "activate again" in paused["message"]
        peer.spin(0.3)
        peer.until_status("hand_sim", without_command, "0 V as before")
        assert transition(peer, Transition.TRANSITION_ACTIVATE)
        running = peer.until_status("hand_sim", lambda s: s["message"].startswith("running"), "driven again")
        first.send(signal.SIGKILL)
        killed = peer.until_status("hand_sim", without_command, "the timeout")
        assert killed["applied_voltage"] == "0"
        assert float(killed["command_age_at_zero_s"]) <= 0.1 + kept_waiting(running, killed)
