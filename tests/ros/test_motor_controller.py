"""motor_controller alone, driven over topics, and what happens to the motor when it dies or pauses."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from collections.abc import Mapping
from time import monotonic
from typing import Any

import numpy as np
import pytest
from graph import NodeProcess, Peer, kept_waiting, processes
from hannes_bringup import motor_switch
from hannes_bringup.motor_switch import Lifecycle
from hannes_control.double_pid import DoublePID
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
    with processes(NodeProcess(NAME, clock="realtime", pause_limit_ms=10000, state_timeout_ms=3000)):
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
        before = int(status["rejected_states"])
        peer.say("encoder_position", state_bytes(1_000_000_000, 1.0))  # a stamp of long ago
        peer.until_status(NAME, lambda s: int(s["rejected_states"]) == before + 1, "the old stamp counted")
        assert voltages(peer)[-1] == 0.0


def test_real_time_warns_of_a_reference_that_has_stopped(peer):
    peer.hear_diagnostics()
    with processes(NodeProcess(NAME, clock="realtime", pause_limit_ms=10000, state_timeout_ms=10000)):
        announce(peer)
        peer.say("reference_position", convert.float64_bytes(5.0))

        def says(start: str, reference: bool = False) -> bool:
            peer.say("encoder_position", state_bytes(peer.node.get_clock().now().nanoseconds, 1.0))
            peer.say("motor_current", convert.float64_bytes(0.1))
            if reference:
                peer.say("reference_position", convert.float64_bytes(5.0))
            peer.spin(0.02)
            return bool(status := peer.status(NAME)) and status["message"].startswith(start)

        peer.until(lambda: says("no reference_position for "), what="the warning")
        assert " s: the last one is held" in peer.status(NAME)["message"]
        assert (
            peer.status(NAME)["level"] != "0"
        )  # an error where a busy machine kept the loop from running, too
        peer.until(lambda: says("running", reference=True), what="the reference again")


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
