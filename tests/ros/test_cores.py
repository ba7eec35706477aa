"""The parts of the nodes that need no graph: command gate, lock-step joins, stall watch, real-time loop, node rules."""

from __future__ import annotations

import math
import threading
from time import sleep
from types import SimpleNamespace

import pytest
from hannes_description.errors import HannesError
from hannes_ros.command import CommandGate
from hannes_ros.diagnostics import ERROR, OK, SAY_AGAIN_S, WARN, Arrivals, Faults, Rate, missed_level
from hannes_ros.lockstep import Peers, Probe, StallWatch, TickJoin, samples_until
from hannes_ros.loop import RealtimeLoop
from hannes_ros.run import _node_rules
from patience import PATIENCE


# -- command gate ----------------------------------------------------------------------------------------------------
def test_gate_is_zero_before_the_first_command_and_from_the_timeout_on():
    gate = CommandGate(limit=12.0, timeout=0.08)
    assert gate.voltage(100.0) == 0.0
    assert gate.timeouts == 0
    gate.command(5.0, now=1.0)
    assert gate.voltage(1.0799) == 5.0
    assert gate.voltage(1.0801) == 0.0
    assert gate.voltage(9.0) == 0.0
    assert (gate.timed_out, gate.timeouts, gate.age_at_zero) == (True, 1, pytest.approx(0.0801))
    gate.command(-3.0, now=9.0)
    assert (gate.voltage(9.01), gate.timed_out) == (-3.0, False)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_gate_refuses_what_is_not_finite(bad):
    gate = CommandGate(limit=12.0, timeout=0.08)
    gate.command(5.0, now=0.0)
    assert gate.command(bad, now=0.01) == 0.0
    assert (gate.voltage(0.02), gate.rejected) == (0.0, 1)


def test_gate_clamps():
    gate = CommandGate(limit=12.0, timeout=0.08)
    assert [gate.command(v, 0.0) for v in (12.0, 12.1, -1e300)] == [12.0, 12.0, -12.0]
    assert gate.clamped == 2


# -- lock-step -------------------------------------------------------------------------------------------------------
def test_samples_until_counts_exactly():
    assert [samples_until(k * 1_000_000, 300) for k in (0, 3, 4, 6, 7, 1000)] == [1, 1, 2, 2, 3, 301]
    assert samples_until(10**15, 300) == 300_000_001  # eleven days later still exact


def test_join_pairs_the_newest_until_the_first_answer_and_by_order_afterwards():
    join = TickJoin(2)
    join.put(0, "state 7")
    join.put(0, "state 8")
    assert join.take() is None
    assert join.missing() == [1]
    join.put(1, "current 8")
    assert join.take() == ["state 8", "current 8"]
    join.synchronise()
    for k in (9, 10):
        join.put(1, f"current {k}")
    for k in (9, 10):
        join.put(0, f"state {k}")
    assert [join.take(), join.take(), join.take()] == [
        ["state 9", "current 9"],
        ["state 10", "current 10"],
        None,
    ]
    for k in (11, 11):
        join.put(1, f"current {k}")
    join.rejoin()
    assert not join.synchronised
    join.put(0, "state 11")
    assert join.take() == ["state 11", "current 11"]
    assert join.take() is None
    join.put(1, "current 12")
    join.reset()
    join.put(0, "state 0")
    assert join.take() is None


def test_join_tells_of_messages_that_no_tick_needs_and_its_queues_are_bounded():
    join = TickJoin(2, longest=3)
    for k in range(
        10
    ):  # repetitions while the tick is joined: the newest count, as long as they keep together
        join.put(0, k)
        join.put(1, k)
    assert join.surplus is None
    assert join.take() == [9, 9]
    join.synchronise()
    for k in (10, 10, 11):
        join.put(1, k)
    assert join.left_over == 1
    join.put(0, 10)
    assert join.complete
    assert join.take() == [10, 10]
    for k in (12, 13):
        join.put(1, k)
    assert join.surplus == 1
    join.rejoin()
    assert (join.surplus, join.left_over) == (None, None)
    for k in range(4):
        join.put(0, k)
    assert join.surplus == 0


def test_a_tick_is_held_when_a_second_source_came_or_one_went_and_again_while_there_are_several(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("hannes_ros.lockstep.monotonic", lambda: now[0])
    several = [False]
    probe = Probe(lambda: several[0])
    probe.on_match(SimpleNamespace(current_count=1, current_count_change=1))
    assert (probe.over(), probe.holds()) == (False, False)
    for count, change in ((2, 1), (1, -1)):
        probe.on_match(SimpleNamespace(current_count=count, current_count_change=change))
        assert (probe.holds(), probe.over(), probe.holds()) == (True, False, True)
        now[0] += 1.5 * Probe.HOLD_S
        assert (probe.over(), probe.over(), probe.holds()) == (True, False, False)
    several[0] = True
    for _ in range(3):
        now[0] += 1.5 * Probe.REPEAT_S
        assert (probe.over(), probe.holds()) == (False, True)
        now[0] += 1.5 * Probe.HOLD_S
        assert (probe.over(), probe.holds()) == (True, False)


def test_peers_once_complete_stay_complete():
    count = {"n": 0}
    peers = Peers({"a subscriber": (lambda: count["n"], 1)})
    assert peers.missing() == ["a subscriber"]
    assert not peers.complete
    count["n"] = 1
    assert peers.missing() == []
    count["n"] = 0
    assert peers.complete
    assert peers.missing() == []


def test_stall_watch_repeats_only_to_newcomers():
    watch = StallWatch(timeout=0.1, repeat=0.5)
    watch.published(0.0)
    assert not watch.check(0.05)
    assert (watch.check(5.0), watch.stalled, watch.stalls) == (False, True, 1)
    watch.newcomer()
    assert [watch.check(t) for t in (5.1, 5.2, 5.7)] == [True, False, True]
    watch.published(6.0)
    # the newcomer may still be out of step: one more tick may be repeated to it
    assert watch.check(7.0)
    assert watch.stalls == 2
    watch.published(8.0)
    watch.published(8.001)
    assert not watch.check(20.0)


# -- real time -------------------------------------------------------------------------------------------------------
def test_loop_counts_the_periods_that_it_missed():
    calls: list[int] = []
    enough = threading.Event()

    def step(now: float, elapsed: int) -> None:
        calls.append(elapsed)
        if len(calls) == 3:
            sleep(0.05)
        if len(calls) >= 10:
            enough.set()

    loop = RealtimeLoop(0.005, step)
    loop.start()
    assert enough.wait(PATIENCE)
    loop.stop()
    loop._thread.join(PATIENCE)
    assert loop.missed >= 9
    assert sum(calls) == len(calls) + loop.missed
    assert loop.error is None


def test_loop_hands_over_what_its_step_raises():
    def step(now: float, elapsed: int) -> None:
        raise RuntimeError("broken")

    loop = RealtimeLoop(0.001, step)
    loop.start()
    loop._thread.join(PATIENCE)
    assert str(loop.error) == "broken"


def test_rate_is_between_two_looks():
    rate = Rate(now=10.0)
    assert rate.update(12.0, 100) == pytest.approx(50.0)
    assert rate.update(13.0, 100) == 0.0


def test_a_fault_is_reported_once_at_least_and_logged_now_and_then():
    faults = Faults()
    assert faults.report(0.0) == []
    faults.bad("current", ERROR, "nan")
    faults.good("current")  # short, and seen all the same
    assert "current" in faults
    assert faults.report(1.0) == [(ERROR, "nan", True)]
    assert faults.report(2.0) == []
    faults.bad("current", ERROR, "inf")
    faults.bad("state", WARN, "old")
    assert faults.report(3.0) == [(ERROR, "inf", False), (WARN, "old", True)]
    assert faults.report(4.0) == [(ERROR, "inf", False), (WARN, "old", False)]  # they stand
    faults.bad("current", ERROR, "inf")
    faults.good("state")
    assert faults.report(1.0 + SAY_AGAIN_S) == [(ERROR, "inf", True)]
    faults.good("current")
    assert "current" not in faults


def test_rate_of_arrivals_counts_from_the_first_message():
    arrivals = Arrivals()
    assert arrivals.rate() is None
    for k in range(11):
        arrivals.came(0.7 + 0.01 * k)
    assert arrivals.rate() == pytest.approx(100.0)
    arrivals.came(0.82)  # a look changes nothing
    assert arrivals.rate() == pytest.approx(50.0)
    assert arrivals.rate() is None
    arrivals.came(100.0)  # after a rest it begins anew
    arrivals.came(100.1)
    assert arrivals.rate() == pytest.approx(10.0)
    for at in (100.2, 101.7, 101.8, 101.9):  # as it does after a gap: who was started again is not slow
        arrivals.came(at)
    assert arrivals.rate() == pytest.approx(10.0)


def test_missed_cycles_warn_and_then_are_an_error():
    assert [missed_level(1000 - n, n) for n in (0, 10, 11, 100, 101)] == [OK, OK, WARN, WARN, ERROR]
    assert missed_level(0, 0) == OK


# -- arguments -------------------------------------------------------------------------------------------------------
def test_rules_for_one_node_go_to_that_node():
    arguments = ["prog", "--ros-args", "-p", "a:object:=soft", "-p", "clock:=lockstep", "-p", "file:=x:y.csv"]
    rest, local = _node_rules(arguments, ["a", "b"])
    assert rest == ["prog", "--ros-args", "-p", "clock:=lockstep", "-p", "file:=x:y.csv"]
    assert local == {"a": ["--ros-args", "-p", "object:=soft", "--"], "b": []}


def test_a_rule_for_a_node_that_is_not_there_is_an_error():
    with pytest.raises(HannesError, match="no node 'c' in this process"):
        _node_rules(["prog", "--ros-args", "-p", "c:object:=soft"], ["a", "b"])
