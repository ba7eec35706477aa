"""hand_sim alone, driven over topics."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from graph import PATIENT, NodeProcess, kept_waiting, processes
from hannes_description.joints import JOINT_NAMES
from hannes_ros import convert


def say_voltage(peer, value: float) -> None:
    peer.say("motor_voltage", convert.float64_bytes(value))


def test_lockstep_advances_one_tick_for_one_voltage(peer):
    # Those that the simulator waits for come last: it has found the others by then.
    peer.hear("joint_positions", "grip_force", "encoder_position", "motor_current")
    with processes(NodeProcess("hand_sim", clock="lockstep", duration=0.05, **PATIENT)) as (sim,):
        peer.matched("motor_voltage")
        states, currents = peer.heard["encoder_position"], peer.heard["motor_current"]
        for tick in range(50):
            peer.until(lambda tick=tick: len(states) == len(currents) == tick + 1, what=f"reading {tick}")
            assert convert.MOTOR_STATE.decode(states[-1]).stamp_ns == tick * 1_000_000
            say_voltage(peer, 6.0)
        assert sim.wait() == 0
        peer.until(
            lambda: len(peer.heard["joint_positions"]) == len(peer.heard["grip_force"]) == 5,
            what="the slow signals",
        )
    last = convert.MOTOR_STATE.decode(states[-1])
    assert last.position[0] > 0.1
    assert last.velocity[0] > 0.0
    assert last.effort[0] == pytest.approx(0.01745 * 19 * convert.float64_value(currents[-1]), rel=0.02)
    fingers = [
        convert.JointCodec(JOINT_NAMES, effort=False).decode(data) for data in peer.heard["joint_positions"]
    ]
    assert [sample.stamp_ns for sample in fingers] == [k * 10_000_000 for k in range(5)]
    assert len(peer.heard["grip_force"]) == 5


def test_not_finite_commands_give_zero_volt_and_are_counted_and_large_ones_are_clamped(peer):
    peer.hear("encoder_position", "motor_current")
    peer.hear_diagnostics()
    with processes(NodeProcess("hand_sim", clock="lockstep", **PATIENT)) as (sim,):
        peer.matched("motor_voltage")
        states, currents = peer.heard["encoder_position"], peer.heard["motor_current"]
        commands = [math.nan, math.inf, -math.inf, 1e9]
        for tick, voltage in enumerate([*commands, 12.0]):
            peer.until(lambda tick=tick: len(states) == len(currents) == tick + 1, what=f"reading {tick}")
            say_voltage(peer, voltage)
        peer.until(lambda: len(states) == len(currents) == 6)
        status = peer.until_status("hand_sim", lambda s: s["tick"] == "5", "the counts")
        peer.until(
            lambda: "motor/voltage is not finite (-inf): 0 V" in sim.output, what="the reason in the log"
        )
    assert (status["rejected_commands"], status["clamped_commands"]) == ("3", "1")
    current = [convert.float64_value(data) for data in peer.heard["motor_current"]]
    assert current[1:4] == [0.0, 0.0, 0.0]
    assert 0.0 < current[4] < 12.0 / 1.0


def test_lockstep_reports_what_it_waits_for_and_ignores_commands_out_of_turn(peer):
    peer.hear_diagnostics()
    with processes(NodeProcess("hand_sim", clock="lockstep", subscribers=3)) as (sim,):
        peer.matched("motor_voltage")
        say_voltage(peer, 3.0)
        waiting = "waiting for 3 subscriber(s) of motor/state"
        # It reports at once, though it may not have found the publisher of motor/voltage yet.
        status = peer.until_status(
            "hand_sim", lambda s: s["unexpected_commands"] == "1" and waiting in s["message"]
        )
        peer.until(lambda: waiting in sim.output, what="the same in the log")
        assert status["tick"] == "0"


def test_lockstep_repeats_the_reading_to_whom_was_found_too_late_for_the_current_alone(peer):
    """A controller is found one topic after the other: here another hears motor/current before it does."""
    peer.hear("encoder_position", "motor_current")
    states = peer.heard["encoder_position"]
    late: list[bytes] = []
    with processes(NodeProcess("hand_sim", clock="lockstep")):
        peer.matched("motor_voltage")
        peer.until(lambda: len(states) >= 1, what="the first reading")
        peer.hear("motor_current", callback=late.append)
        peer.until(lambda: len(late) > 0 and len(states) > 1, what="the reading again on both topics")
        assert [convert.MOTOR_STATE.decode(data).stamp_ns for data in states[:2]] == [0, 0]
        say_voltage(peer, 1.0)
        peer.until(
            lambda: convert.MOTOR_STATE.decode(states[-1]).stamp_ns == 1_000_000, what="the loop going on"
        )


def test_real_time_gives_zero_volt_when_commands_stop(peer):
    peer.hear("encoder_position", "motor_current")
    peer.hear_diagnostics()
    with processes(NodeProcess("hand_sim", clock="realtime", command_timeout_ms=50)):
        peer.matched("motor_voltage")
        currents = peer.heard["motor_current"]

        def moved() -> bool:
            say_voltage(peer, 5.0)
            peer.spin(0.01)
            return len(currents) > 0 and convert.float64_value(currents[-1]) != 0.0

        peer.until(moved, what="a driven motor")
        driven = len(currents)
        before = peer.status("hand_sim") or {"missed_cycles": "0"}
        say_voltage(peer, 1e9)  # the last command, which the report tells from the others: it is clamped
        status = peer.until_status(
            "hand_sim",
            lambda s: s["clamped_commands"] == "1" and s["message"].startswith("command timed out: 0 V"),
            "the timeout",
        )
        assert status["applied_voltage"] == "0"
        # More than one where this machine kept a command waiting; from here on there is no more than one command.
        timeouts = int(status["command_timeouts"])
        assert timeouts >= 1
        # By the node's own clock, and less what it was kept from running: the load of the machine does not matter here.
        assert float(status["command_age_at_zero_s"]) <= 0.1 + kept_waiting(before, status)
        say_voltage(peer, 5.0)
        peer.until_status(
            "hand_sim", lambda s: s["command_timeouts"] == str(timeouts + 1), "a second timeout"
        )
        peer.until(lambda: len(currents) > driven, what="currents")
    states = [convert.MOTOR_STATE.decode(data) for data in peer.heard["encoder_position"]]
    assert all(b.stamp_ns > a.stamp_ns for a, b in pairwise(states))


def test_noise_is_seeded_and_on_current_and_effort(peer):
    peer.hear("encoder_position", "motor_current")
    states, currents = peer.heard["encoder_position"], peer.heard["motor_current"]
    noisy = {"duration": 0.02, "current_noise": 0.1, "seed": 3}
    with processes(NodeProcess("hand_sim", clock="lockstep", **noisy, **PATIENT)) as (sim,):
        peer.matched("motor_voltage")
        for tick in range(20):
            peer.until(lambda tick=tick: len(states) == len(currents) == tick + 1)
            say_voltage(peer, 0.0)
        assert sim.wait() == 0
    heard = [convert.float64_value(data) for data in currents]
    assert heard == pytest.approx(0.1 * np.random.default_rng(3).standard_normal(20))
    assert convert.MOTOR_STATE.decode(states[5]).effort[0] == pytest.approx(0.01745 * 19 * heard[5], rel=0.02)
