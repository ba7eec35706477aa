"""Damaged and odd recordings, as a user meets them: worked through and said, or one clear error."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hannes_description.joints import RAD_PER_COUNT
from hannes_description.model import Model
from hannes_lab.compare import compare
from hannes_lab.prepare import load_trials, prepare
from lab.foreign_bags import Damage, Signals, hannes_in_one_line, scaled, signals_of_set, write_bag, write_set
from rosbags.rosbag2 import StoragePlugin, Writer


@pytest.fixture(scope="module")
def good() -> dict[str, Signals]:
    return signals_of_set()


@pytest.fixture(scope="module")
def slow(good: dict[str, Signals]) -> dict[str, Signals]:
    return {"slow": good["slow"]}


@pytest.fixture(scope="module")
def whole_error(slow: dict[str, Signals], tmp_path_factory: pytest.TempPathFactory) -> float:
    """What the nominal model leaves of these recordings where nothing is damaged."""
    bags = write_set(tmp_path_factory.mktemp("whole") / "bags", slow)
    return compare(prepare(load_trials([bags]), Model.load())).overall


def cut(begin: float, end: float, *only: str) -> Damage:
    """Keep what lies more than `begin` s after the start and `end` s before the end."""

    def damage(signals: Signals) -> Signals:
        out = {}
        for n, (t, v) in signals.items():
            keep = (t >= begin) & (t <= t[-1] - end) if not only or n in only else np.ones(t.size, dtype=bool)
            out[n] = (t[keep], v[keep])
        return out

    return damage


def without(name: str) -> Damage:
    return lambda signals: {n: pair for n, pair in signals.items() if n != name}


def hole(signals: Signals) -> Signals:
    t, v = signals["encoder_position"]
    keep = (t < 6.0) | (t > 7.0)
    return {**signals, "encoder_position": (t[keep], v[keep])}


def silence(signals: Signals) -> Signals:
    return {n: (t[(t < 6.0) | (t > 7.0)], v[(t < 6.0) | (t > 7.0)]) for n, (t, v) in signals.items()}


def holes_of_nan(signals: Signals) -> Signals:
    signals["motor_current"][1][40:42] = np.nan
    signals["encoder_position"][1][10] = np.inf
    return signals


def all_nan(signals: Signals) -> Signals:
    signals["motor_current"][1][:] = np.nan
    return signals


def dead(signals: Signals) -> Signals:
    signals["motor_current"][1][:] = 0.0
    return signals


def doubled(signals: Signals) -> Signals:
    t, v = signals["motor_current"]
    again = np.sort(np.concatenate([np.arange(t.size), np.arange(100, 107)]))
    return {**signals, "motor_current": (t[again], v[again])}


def lossy(signals: Signals) -> Signals:
    t, v = signals["motor_current"]
    heard = np.random.default_rng(3).random(t.size) > 0.3
    return {**signals, "motor_current": (t[heard], v[heard])}


def pushed(signals: Signals) -> Signals:
    t, v = signals["encoder_position"]
    v[(t > 8.8) & (t < 10.0)] += 3.0
    return signals


def spiked(**values: float) -> Damage:
    """A few samples of another size."""

    def damage(signals: Signals) -> Signals:
        for name, value in values.items():
            signals[name][1][[100, 101, 400]] = value
        return signals

    return damage


def shifted(signals: Signals) -> Signals:
    t, v = signals["encoder_position"]
    return {**signals, "encoder_position": (t, v + 100.0)}


def an_hour_later(signals: Signals) -> Signals:
    t, v = signals["motor_current"]
    return {**signals, "motor_current": (t + 3600.0, v)}


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (cut(1.7, 2.2), "2 of 5 closures are cut off"),
        (cut(0.0, 10.0, "motor_current"), "closures are cut off"),
        (hole, "1 closure in which samples are missing is left out"),
        (silence, "nothing was recorded from 6.00 to 7.00 s: what was there is not known"),
        (
            doubled,
            "Messages that repeat the one before, its stamp too, were left out: 7 on /hannes/motor/current",
        ),
        (lossy, "messages seem to be lost: 30 % of motor_current"),
        (pushed, "1 closure(s) far from the others are left out"),
        (without("motor_current"), "no current is recorded"),
        (without("encoder_position"), "no encoder position is recorded"),
        (holes_of_nan, "2 of 615 samples of motor_current are not finite"),
        (all_nan, "no current is recorded"),
        (
            dead,
            "motor_current is 0 A throughout, though the reference moves: it was not measured and is left out",
        ),
        (scaled(encoder_position=180.0 / math.pi), "looks like degrees"),
        (
            scaled(encoder_position=1.0 / RAD_PER_COUNT, reference_position=1.0 / RAD_PER_COUNT),
            "encoder counts",
        ),
        (scaled(motor_current=1000.0), "motor_current was multiplied by 0.001"),
        (spiked(motor_current=80.0), "3 of 615 samples of motor_current are far outside everything else"),
        (
            spiked(encoder_position=-3e3),
            "3 of 615 samples of encoder_position are far outside everything else",
        ),
        (shifted, "encoder_position rests 100 rad from reference_position and was shifted by that"),
    ],
)
def test_it_works_through_and_says_so(
    damage: Damage,
    said: str,
    slow: dict[str, Signals],
    whole_error: float,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bags = write_set(tmp_path / "bags", slow, damage)
    code, out, err = hannes_in_one_line("compare", str(bags), capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0, err
    assert said in out
    assert float(out.split("Overall error: ")[1].split()[0]) < 1.5 * whole_error


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (
            without("reference_position"),
            "has no reference_position: it is needed, for the model replays it. If it was recorded under another "
            "topic, name that with --topic SIGNAL=TOPIC (topics={signal: topic} in Python); the bag has no topics but "
            "those that were read: /hannes/motor/state as encoder_position, ",
        ),
        (scaled(encoder_position=3.8), "at another shaft"),
        (scaled(encoder_position=19.0), "at another shaft"),
        (scaled(encoder_position=-1.0), "--scale encoder_position=-1"),
        (cut(1.7, 17.0), "no closure was found"),
        (an_hour_later, "s: they do not overlap in time. Record them together"),
    ],
)
def test_what_cannot_be_used_is_one_clear_error(
    damage: Damage,
    said: str,
    slow: dict[str, Signals],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bags = write_set(tmp_path / "bags", slow, damage)
    for command in (("compare",), ("diagnose",), ("add", "--effect", "wire_slack"), ("report",)):
        code, _, err = hannes_in_one_line(
            command[0], str(bags), *command[1:], capsys=capsys, monkeypatch=monkeypatch
        )
        assert code == 2 and said in err and len(err.strip().splitlines()) == 1


def test_a_factor_of_ones_own(
    slow: dict[str, Signals],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bags = write_set(tmp_path / "bags", slow, scaled(encoder_position=-3.8))
    words = ("compare", str(bags), "--scale", f"encoder_position={-1 / 3.8}")
    code, out, _ = hannes_in_one_line(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and "as --scale says" in out
    for wrong, said in (("encoder_position=x", "a number"), ("encoder=2", "unknown signal")):
        code, _, err = hannes_in_one_line(
            "compare", str(bags), "--scale", wrong, capsys=capsys, monkeypatch=monkeypatch
        )
        assert code == 2 and said in err


RIG = {"reference_position": "/rig/target", "encoder_position": "/rig/encoder", "motor_current": "/rig/iq"}
NAMED = [word for name, topic in RIG.items() for word in ("--topic", f"{name}={topic}")]


@pytest.mark.parametrize(
    ("number", "stamped"), [("std_msgs/msg/Float32", True), ("std_msgs/msg/Float64", False)]
)
def test_topics_of_other_names_and_types_are_named(
    number: str,
    stamped: bool,
    slow: dict[str, Signals],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bags = write_set(tmp_path / "bags", slow, topics=RIG, number=number, stamped=stamped)
    code, _, err = hannes_in_one_line("compare", str(bags), capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and "--topic SIGNAL=TOPIC" in err and "/rig/encoder" in err and "motor_current" in err
    words = ("compare", str(bags), *NAMED)
    code, out, err = hannes_in_one_line(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0, err
    assert float(out.split("Overall error: ")[1].split()[0]) < 5.0
    words = ("compare", str(bags), *NAMED[:-1], "motor_current=", "--json")
    code, out, err = hannes_in_one_line(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and '"no current is recorded' in out and '"signals": [ "encoder_position" ]' in out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("reference=/rig/target",), "signals are emg_flexor, emg_extensor, reference_position"),
        (("motor_current",), "give SIGNAL=TOPIC"),
        (("motor_current=/a", "motor_current=/b"), "another topic is named for motor_current already"),
        (("motor_current=/rig/amps",), "fast has no message on /rig/amps, which is named for motor_current"),
        (("reference_position=",), "has no reference_position: it is needed"),
        (
            ("encoder_position=", "motor_current="),
            "name that with --topic SIGNAL=TOPIC (topics={signal: topic} in Python); not read were "
            "/hannes/motor/state (sensor_msgs/msg/JointState)",
        ),
    ],
)
def test_a_topic_that_cannot_be_used_is_one_clear_error(
    words: tuple[str, ...],
    said: str,
    good: dict[str, Signals],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = {n: "/hannes/motor/state" if n == "encoder_position" else f"/hannes/{n}" for n in RIG}
    for condition, current in (("slow", "/rig/amps"), ("fast", "/rig/iq")):
        write_bag(tmp_path / condition, good[condition], topics={**names, "motor_current": current})
    given = [word for text in words for word in ("--topic", text)]
    code, _, err = hannes_in_one_line(
        "compare", str(tmp_path), *given, capsys=capsys, monkeypatch=monkeypatch
    )
    assert code == 2 and said in err and len(err.strip().splitlines()) == 1


@pytest.mark.parametrize("clock", [1234.5, -0.06, 0.06])
def test_stamps_of_another_clock(
    clock: float,
    slow: dict[str, Signals],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bags = write_set(tmp_path / "bags", slow, clock=clock)
    code, out, _ = hannes_in_one_line("compare", str(bags), capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and "different clocks" in out
    assert float(out.split("Overall error: ")[1].split()[0]) < 5.0


@pytest.mark.slow
def test_different_rates_and_storages_in_one_set(
    good: dict[str, Signals],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fast = signals_of_set(sensors="bench", conditions=("fast",))["fast"]
    write_bag(tmp_path / "slow", good["slow"])
    write_bag(tmp_path / "fast", fast, sqlite=True)
    code, out, _ = hannes_in_one_line(
        "compare", str(tmp_path), "--fitted", capsys=capsys, monkeypatch=monkeypatch
    )
    assert code == 0 and float(out.split("Overall error: ")[1].split()[0]) < 6.0
    assert "motor_voltage is recorded only in fast" in out


def test_empty_bags(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, plugin in (("mcap", StoragePlugin.MCAP), ("sqlite", StoragePlugin.SQLITE3)):
        with Writer(tmp_path / name, version=9, storage_plugin=plugin):
            pass
        code, _, err = hannes_in_one_line(
            "compare", str(tmp_path / name), capsys=capsys, monkeypatch=monkeypatch
        )
        assert code == 2 and "holds no message" in err
    (tmp_path / "zero").mkdir()
    (tmp_path / "zero" / "zero.mcap").write_bytes(b"")
    for path in ("zero", "zero/zero.mcap"):
        code, _, err = hannes_in_one_line(
            "compare", str(tmp_path / path), capsys=capsys, monkeypatch=monkeypatch
        )
        assert code == 2 and "hannes recover" in err


def test_hide_lists_its_conditions(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from hannes_lab.hide import CONDITIONS

    _, out, _ = hannes_in_one_line("hide", "--help", capsys=capsys, monkeypatch=monkeypatch)
    assert all(name in out for name in CONDITIONS)
