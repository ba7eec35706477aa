"""`hannes record --profile`: the whole profile is in the bag, or it is said why not."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from graph import NodeProcess, Peer, processes
from hannes_bags.reading import read_bag
from hannes_bringup import graph_watch
from hannes_bringup.graph_watch import find_free_hand, follow_profile, is_recorded
from hannes_control.reference import make_profile
from hannes_description.errors import HannesError
from hannes_ros import convert
from patience import PATIENCE

pytestmark = [
    pytest.mark.ros,
    pytest.mark.filterwarnings("ignore::hannes_bags.reading.RecordingWarning"),
]


@contextmanager
def hand(peer: Peer, seconds: float) -> Iterator[None]:
    """The peer as a hand that rests, for so many seconds."""
    over = threading.Event()

    def live() -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end and not over.is_set():
            peer.say("encoder_position", convert.MOTOR_STATE.encode(time.time_ns(), (0.0,), (0.0,), (0.0,)))
            peer.say("motor_current", convert.float64_bytes(0.0))
            time.sleep(5e-3)

    other = threading.Thread(target=live)
    other.start()
    try:
        yield
    finally:
        over.set()
        other.join()


def record(
    bag: Path, environment: dict[str, str], *, closures: int, period: float
) -> subprocess.CompletedProcess[str]:
    """`hannes record` with a half sine, to its end."""
    words = (
        "record",
        str(bag),
        "--profile",
        "half_sine",
        "--closures",
        str(closures),
        "--period",
        str(period),
    )
    return subprocess.run(
        [sys.executable, "-m", "hannes_bringup.cli", *words],
        env=environment, capture_output=True, text=True, timeout=PATIENCE,
    )  # fmt: skip


def test_a_profile_is_recorded_to_its_end(
    tmp_path: Path, peer: Peer, ros_environment: dict[str, str]
) -> None:
    """Again where a busy machine lets the controller pause, which switches the motor off."""
    with hand(peer, PATIENCE):
        for attempt in range(4):
            bag = tmp_path / f"bag{attempt}"
            told = record(bag, ros_environment, closures=1, period=2.0)
            if told.returncode == 0:
                break
            assert 'the controller says "' in told.stderr
    assert told.returncode == 0, told.stderr
    read = read_bag(bag)
    assert not {"plant", "sensors"} & set(read.metadata)  # the peer is no hand_sim
    reference = read["reference_position"]
    played = make_profile("half_sine", closures=1, period=2.0)
    assert reference.values[0] < 0.5 and reference.values.max() > 14.0 and reference.values[-1] == 0.0
    assert np.isin(reference.values, played).all() and reference.time[-1] - reference.time[0] > 2.0


def test_profiles_of_a_hand_in_lockstep_are_recorded_whole_one_after_the_other(
    tmp_path: Path, ros_environment: dict[str, str]
) -> None:
    """Its time goes as fast as it is answered, and stands between two recordings: each begins with its profile."""
    played = make_profile("half_sine", closures=2, period=1.5)
    curves = []
    with processes(NodeProcess("hand_sim", clock="lockstep", object="soft", command_timeout_ms=1000.0)):
        for name in ("first", "second"):
            told = record(tmp_path / name, ros_environment, closures=2, period=1.5)
            assert told.returncode == 0, told.stderr
            read = read_bag(tmp_path / name)
            assert read.metadata["plant"] == "reduced" and read.metadata["object"] == "soft"
            reference = read["reference_position"]
            # Who is matched first may miss a message of the rest before.
            begin = int(np.flatnonzero(reference.values)[0]) - 1
            end = begin + played.size
            np.testing.assert_array_equal(reference.values[begin:end], played)
            assert 450 <= begin <= 500 and not reference.values[end:].any()
            assert reference.values.size > end + 1000
            encoder = read["encoder_position"]
            assert np.ptp(np.diff(np.unique(encoder.time))) < 1e-6, "a tick is missing"
            curves.append(np.interp(reference.time[0] + 1e-3 * np.arange(3000), encoder.time, encoder.values))
    # The first one began where nothing was wound up.
    np.testing.assert_allclose(curves[1], curves[0], atol=0.06)
    assert curves[0].max() > 5.0


def test_a_clock_that_goes_back_during_a_profile_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    came = [[33.0, 33.25], [], [34.0], [0.25]]
    messages = [[(convert.clock_bytes(round(t * 1e9)), {}) for t in look] for look in came]
    monkeypatch.setattr(graph_watch, "taken", lambda _: messages.pop(0))
    node: Any = SimpleNamespace(create_subscription=lambda *_, **__: None)
    clock = graph_watch._SimulatedTime(node)
    assert [clock.elapsed() for _ in range(3)] == pytest.approx([0.25, 0.0, 0.75])
    with pytest.raises(HannesError, match="the hand began again during the profile"):
        clock.elapsed()


def test_what_the_controller_reported_of_a_run_is_told_where_it_was_no_good() -> None:
    assert graph_watch._told_of_a_run(["ok: running", "warn: running; missed 12 of 1000 cycles"]) == ""
    told = graph_watch._told_of_a_run(
        ["ok: running", "error: running; missed 556 of 1006 cycles", "ok: running"]
    )
    assert told.startswith("in 1 of its 3 reports ") and "missed 556 of 1006 cycles" in told


def test_who_hears_the_reference_of_a_profile() -> None:
    assert is_recorded(graph_watch.REFERENCE, None)
    assert is_recorded(graph_watch.REFERENCE, ["motor/state", "reference_position"])
    assert is_recorded(graph_watch.REFERENCE, [graph_watch.REFERENCE])
    assert not is_recorded(graph_watch.REFERENCE, ["motor/state"])


def test_a_profile_is_refused_where_it_would_mix_with_another_reference(peer: Peer) -> None:
    peer.publisher("encoder_position")
    find_free_hand(PATIENCE)
    peer.publisher("reference_position")
    with pytest.raises(HannesError, match="reference_position is published already, by peer"):
        find_free_hand(PATIENCE)


def controller_runs(peer: Peer) -> None:
    """Wait until the controller tells of itself, which a busy machine may start late."""
    peer.hear_diagnostics()
    peer.until(lambda: bool(peer.status("motor_controller")), what="its diagnostics")


def test_what_a_profile_waits_for_is_said(peer: Peer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graph_watch, "BEGINS", 4.0)
    words = {"reference": "half_sine", "reference_closures": 1}
    told = r"did not begin within 4 s.*waiting for motor/state"
    with processes(NodeProcess("motor_controller", **words)):
        controller_runs(peer)
        with pytest.raises(HannesError, match=told):
            follow_profile(2.0, lambda: True)


def test_a_hand_that_dies_during_a_profile_is_said(peer: Peer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graph_watch, "STANDS", 1.5)
    words = {"reference": "half_sine", "reference_closures": 4, "pause_limit_ms": 10_000.0}
    with processes(NodeProcess("motor_controller", **words)):
        for name in ("encoder_position", "motor_current"):
            peer.matched(name)
        told = r"stands after \d\.\d of 20\.0 s.*motor/state or motor/current is too old"
        with hand(peer, 4.0), pytest.raises(HannesError, match=told):
            follow_profile(20.0, lambda: True)
