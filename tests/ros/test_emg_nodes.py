"""emg_source and emg_reference alone, driven over topics."""

from __future__ import annotations

import math
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
from graph import NodeProcess, processes
from hannes_control.emg import EmgIntegrator, EmgParameters, SyntheticEmg, emg_reference, synthesise
from hannes_ros import convert

EMG = ("emg_flexor", "emg_extensor")


def state(tick: int) -> bytes:
    return convert.MOTOR_STATE.encode(tick * 1_000_000, (0.0,), (0.0,), (0.0,))


def values(peer, name: str) -> list[float]:
    return [convert.float64_value(data) for data in peer.heard[name]]


def test_source_follows_the_stamps_in_lockstep(peer):
    peer.hear(*EMG)
    emg = synthesise(SyntheticEmg(close=0.2, hold=0.1, open=0.2, rest=0.2), seed=7)
    with processes(
        NodeProcess(
            "emg_source",
            clock="lockstep",
            seed=7,
            close_time=0.2,
            hold_time=0.1,
            open_time=0.2,
            rest_time=0.2,
        )
    ):
        peer.matched("encoder_position")
        for tick, count in ((0, 1), (3, 1), (4, 2), (500, 151), (1200, 361)):
            peer.say("encoder_position", state(tick))
            peer.until(
                lambda count=count: all(len(peer.heard[name]) >= count for name in EMG),
                what=f"{count} samples",
            )
            peer.spin(0.05)
            assert [len(peer.heard[name]) for name in EMG] == [count, count]
    n = emg.flexor.size
    assert values(peer, "emg_flexor") == [*emg.flexor, *[0.0] * (361 - n)]
    assert values(peer, "emg_extensor") == [*emg.extensor, *[0.0] * (361 - n)]


def test_source_plays_a_file_in_real_time(peer, tmp_path: Path):
    path = tmp_path / "emg.csv"
    # At 100 Hz the queues hold 3 s: nothing is lost to a peer that this machine keeps waiting.
    path.write_text("t_s,close,open\n" + "".join(f"{k / 100:.4f},{k},{-k}\n" for k in range(60)))
    peer.hear(*EMG)
    with processes(NodeProcess("emg_source", file=path, rate=100)):
        peer.until(lambda: all(len(peer.heard[name]) > 100 for name in EMG), what="samples")
    flexor = values(peer, "emg_flexor")
    played = flexor[: flexor.index(0.0, 1)] if flexor[0] != 0.0 else flexor
    assert all(b - a == 1.0 for a, b in pairwise(played) if b != 0.0)
    assert flexor[-1] == 0.0


def test_source_refuses_a_bad_file(peer, tmp_path: Path):
    path = tmp_path / "emg.csv"
    path.write_text("t_s,close\n0,1\n")
    node = NodeProcess("emg_source", file=path)
    assert node.wait() == 2
    assert "there is no column 'open'" in node.output
    assert "Traceback" not in node.output


def test_reference_answers_each_tick_with_the_samples_until_then(peer):
    peer.hear("reference_position")
    emg = synthesise(SyntheticEmg(), seed=2)
    expected = emg_reference(emg.flexor, emg.extensor).reference
    ticks = 1200
    with processes(NodeProcess("emg_reference", clock="lockstep")):
        for name in (*EMG, "encoder_position"):
            peer.matched(name)
        sent = 0
        for tick in range(0, ticks, 4):
            peer.say("encoder_position", state(tick))
            while sent < tick * 300 // 1000 + 1:
                peer.say("emg_extensor", convert.float64_bytes(emg.extensor[sent]))
                peer.say("emg_flexor", convert.float64_bytes(emg.flexor[sent]))
                sent += 1
            peer.until(
                lambda n=tick // 4 + 1: len(peer.heard["reference_position"]) >= n, what=f"tick {tick}"
            )
        # a repeated reading gets the same answer again
        peer.say("encoder_position", state(tick))
        peer.until(
            lambda: len(peer.heard["reference_position"]) == ticks // 4 + 1, what="the repeated answer"
        )
    answers = values(peer, "reference_position")
    np.testing.assert_allclose(
        answers[:-1], [expected[t * 300 // 1000] for t in range(0, ticks, 4)], atol=1e-12
    )
    assert answers[-1] == answers[-2] > 0.0


def test_reference_in_real_time_replaces_what_is_not_finite(peer):
    peer.hear("reference_position")
    peer.hear_diagnostics()
    integrator = EmgIntegrator()
    samples = [1.0] * 150
    with processes(NodeProcess("emg_reference")):
        for name in EMG:
            peer.matched(name)
        # It answers whether or not it has found who listens: its report shows that it has.
        peer.until(lambda: bool(peer.status("emg_reference")), what="a report")
        for k, sample in enumerate(samples):
            peer.say("emg_extensor", convert.float64_bytes(0.0))
            peer.say("emg_flexor", convert.float64_bytes(math.nan if k == 100 else sample))
        expected = [integrator.update(sample, 0.0) for sample in samples]
        peer.until(lambda: len(peer.heard["reference_position"]) == 150, what="references")
        status = peer.until_status("emg_reference", lambda s: s["samples"] == "150")
        both = re.compile(r"no emg/flexor for \S+ s, no emg/extensor for \S+ s: the reference stands")
        silent = peer.until_status(
            "emg_reference", lambda s: bool(both.fullmatch(s["message"])), "the silence"
        )
        assert silent["level"] == "1"

        def flexor_alone_is_missed() -> bool:
            peer.say("emg_extensor", convert.float64_bytes(0.0))
            peer.spin(0.05)
            message = peer.status("emg_reference")["message"]
            return message.startswith("no emg/flexor for ") and "emg/extensor" not in message

        peer.until(flexor_alone_is_missed, what="the silence of one channel")
    assert values(peer, "reference_position") == expected
    assert status["rejected_samples"] == "1"
    assert expected[-1] > 0.5


def test_reference_in_real_time_catches_up_with_a_channel_that_came_late(peer):
    """Samples of the other one that came before it would delay the hand for ever."""
    peer.hear("reference_position")
    peer.hear_diagnostics()
    integrator = EmgIntegrator(EmgParameters(rate=100))
    alone, paired, later = [1.0] * 80, [0.5] * 100, [0.8] * 30
    with processes(NodeProcess("emg_reference", rate=100)):
        for name in EMG:
            peer.matched(name)
        peer.until(lambda: bool(peer.status("emg_reference")), what="a report")
        for sample in alone:
            peer.say("emg_flexor", convert.float64_bytes(sample))
        peer.spin(0.5)
        for count, pairs in ((100, paired), (130, later)):
            for sample in pairs:
                peer.say("emg_flexor", convert.float64_bytes(sample))
                peer.say("emg_extensor", convert.float64_bytes(0.0))
            peer.until(lambda n=count: len(peer.heard["reference_position"]) == n, what="references")
        status = peer.until_status("emg_reference", lambda s: s["samples"] == "130")
    used = [*alone, *paired[:20], *later]
    assert values(peer, "reference_position") == [integrator.update(sample, 0.0) for sample in used]
    assert status["dropped_samples"] == "80"


def test_an_emg_of_another_rate_is_told(peer):
    """Its samples are counted, each for 1 / rate: the hand would move too slowly, and nobody would know."""
    peer.hear_diagnostics()

    def message_after_a_sample(words: str) -> bool:
        for name in EMG:
            peer.say(name, convert.float64_bytes(0.5))
        peer.spin(0.02)
        return words in peer.status("emg_reference").get("message", "")

    with processes(NodeProcess("emg_reference", rate=2000)):
        for name in EMG:
            peer.matched(name)
        words = "counts for 1/2000 s: the reference moves at 0."
        peer.until(lambda: message_after_a_sample(words), what=words)
        status = peer.status("emg_reference")
    assert status["level"] == "1" and status["message"].startswith("EMG comes at ")
    assert all(0.0 < float(rate) < 100.0 for rate in status["emg_rates_hz"].split(", "))


def test_source_rests_until_the_motor_is_driven(peer):
    """On a machine that still compiles the hand, the only closure would be over before there is one."""
    peer.hear(*EMG)
    peer.hear_diagnostics()
    with processes(NodeProcess("emg_source", begin="driven", rate=100)):
        peer.matched("motor_voltage")
        peer.until_status("emg_source", lambda s: "waiting for motor/voltage" in s["message"])
        peer.until(lambda: len(peer.heard["emg_flexor"]) > 20, what="rest")
        assert set(values(peer, "emg_flexor")) == {0.0}
        peer.say("motor_voltage", convert.float64_bytes(0.0))
        peer.until(lambda: any(values(peer, "emg_flexor")), what="a contraction")
        peer.until_status("emg_source", lambda s: s["message"] == "running")
