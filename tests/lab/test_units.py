"""Unit, sign, shift and absurd samples of recorded signals, over all recordings of one command."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from hannes_bags.recording import Channel, Recording
from hannes_control.reference import half_sine
from hannes_description.errors import HannesError
from hannes_lab.prepare import load_trials
from hannes_lab.recorded import make_trial
from hannes_lab.trials import Trial
from hannes_lab.units import in_si
from lab.foreign_bags import Signals, hannes_in_one_line, scaled, signals_of_set, write_set

FREE, BLOCKED = 13.0, 4.0


def closing(
    name: str = "free", *, reach: float = FREE, peak: float = 0.0, period: float = 4.0, **factors: float
) -> Recording:
    """Four closures of 13 rad in which the hand goes as far as `reach`, then presses; each begins with `peak` A."""
    reference = np.concatenate([np.zeros(500), half_sine(4, period=period, amplitude=13.0)])
    time = np.arange(reference.size) * 1e-3
    log = np.arange(0.0, time[-1], 0.01)
    asked = np.interp(log - 0.05, time, reference)
    position = np.minimum(asked, reach)
    speed = np.gradient(position, log)
    current = 0.25 * np.tanh(speed) + 0.005 * position + 0.4 * (asked - position)
    current += 0.003 * np.random.default_rng(0).standard_normal(log.size)
    starts = np.flatnonzero((asked[1:] > 0.0) & (asked[:-1] <= 0.0))
    current[starts] += peak
    channels = {
        "reference_position": Channel(time, reference, "rad", "reference_position"),
        "encoder_position": Channel(log, position, "rad", "encoder_position"),
        "motor_current": Channel(log, current, "A", "motor_current"),
    }
    return changed(Recording(channels, {}, name), **factors)


def changed(recording: Recording, **factors: float) -> Recording:
    return Recording(
        {
            n: Channel(c.time, c.values * factors.get(n, 1.0), c.unit, n)
            for n, c in recording.channels.items()
        },
        {},
        recording.source,
    )


def with_values(recording: Recording, name: str, samples: Mapping[int, float]) -> Recording:
    """With some samples of one signal replaced."""
    channel = recording[name]
    values = channel.values.copy()
    for at, value in samples.items():
        values[at] = value
    return Recording(
        {**recording.channels, name: Channel(channel.time, values, channel.unit, name)}, {}, recording.source
    )


def shifted(recording: Recording, by: float) -> Recording:
    values = recording["encoder_position"].values + by
    return with_values(recording, "encoder_position", dict(enumerate(values)))


def values(recording: Recording | Trial, name: str) -> np.ndarray:
    if isinstance(recording, Trial):
        return recording.signals[name][1]
    return np.asarray(recording[name].values)


def test_a_sign_is_found_where_the_grip_takes_most_of_the_current() -> None:
    grasp = closing("grasp", reach=BLOCKED)
    trial = make_trial(changed(grasp, motor_current=-1.0))
    assert values(trial, "motor_current") == pytest.approx(values(grasp, "motor_current"))
    assert any("its sign was turned" in note for note in trial.notes)
    right = make_trial(grasp)
    assert not right.notes and values(right, "motor_current").max() > 2.0


@pytest.mark.parametrize(
    ("factor", "said"), [(-1.0, "its sign was turned"), (1000.0, "looks like mA"), (-1000.0, "looks like mA")]
)
def test_what_some_recordings_cannot_tell_the_others_do(factor: float, said: str) -> None:
    """A current of which only noise was recorded tells neither its sign nor its unit."""
    noise = 0.003 * np.random.default_rng(2).standard_normal(closing()["motor_current"].time.size)
    blind = with_values(closing("blind"), "motor_current", dict(enumerate(noise)))
    right = [closing(), closing("grasp", reach=BLOCKED), blind]
    spoilt = [changed(r, motor_current=factor) for r in right]
    for one, plain in zip(in_si(spoilt, {}), right, strict=True):
        assert values(one, "motor_current") == pytest.approx(values(plain, "motor_current"))
        assert any(said in note for note in one.warnings)


def test_recordings_that_contradict_each_other_are_named() -> None:
    plus, minus = closing("plus"), closing("minus", motor_current=-1.0)
    with pytest.raises(HannesError, match=r"closes in plus, but negative in minus.*--scale motor_current=1"):
        in_si([plus, minus], {})
    assert values(in_si([plus, minus], {"motor_current": 1.0})[1], "motor_current").min() < -0.2
    with pytest.raises(HannesError, match="must be in one unit"):
        in_si([plus, closing("milli", motor_current=1000.0)], {})
    degrees = {"encoder_position": 180.0 / math.pi, "reference_position": 180.0 / math.pi}
    with pytest.raises(HannesError, match=r"looks like degrees, but over 13 in free.*in one unit"):
        in_si([closing("d", **degrees), closing("free")], {})


@pytest.mark.parametrize(("factor", "said"), [(100.0, "unknown unit"), (0.01, "less than friction")])
def test_a_current_in_neither_A_nor_mA_is_said(factor: float, said: str) -> None:
    recording = closing(motor_current=factor)
    if factor > 1.0:
        with pytest.raises(HannesError, match=said):
            make_trial(recording)
    else:
        assert any(said in note for note in make_trial(recording).notes)
    taken = make_trial(recording, scale={"motor_current": 1.0 / factor})
    assert values(taken, "motor_current") == pytest.approx(values(closing(), "motor_current"))


def test_a_hand_that_closes_to_negative_angles_is_refused_with_the_scale_to_say() -> None:
    down = changed(closing(), reference_position=-1.0, encoder_position=-1.0)
    with pytest.raises(
        HannesError, match=r"goes from -?0 to -13 rad, but closing is positive: say --scale ref"
    ):
        make_trial(down)
    turned = make_trial(down, scale={"reference_position": -1.0, "encoder_position": -1.0})
    assert values(turned, "motor_current") == pytest.approx(values(closing(), "motor_current"))
    assert values(turned, "encoder_position").max() > 10.0


def test_a_force_that_never_changes_in_any_recording_is_left_out() -> None:
    def pressed(force: np.ndarray) -> Recording:
        free = closing()
        channel = Channel(free["motor_current"].time, force, "N", "grip_force")
        return Recording({**free.channels, "grip_force": channel}, {}, "pressed")

    none = np.zeros(closing()["motor_current"].time.size)
    dead = make_trial(pressed(none))
    assert "grip_force" not in dead.signals and "grip_force is 0 N throughout" in dead.notes[-1]
    some = np.linspace(0.0, 1.0, none.size)
    first, second = in_si([pressed(none), pressed(some)], {})
    assert "grip_force" in first and "grip_force" in second, "on nothing nothing presses"


def test_a_current_that_goes_below_nought_is_not_rectified_whatever_the_recording_says() -> None:
    said = {"current_rectified": True, "current_window": 0.01, "current_noise": 0.003}
    signed = closing().with_metadata(sensors=said)
    trial = make_trial(signed)
    assert trial.options["sensors"] == {**said, "current_rectified": False}
    assert any("taken as signed" in note for note in trial.notes)
    channel = signed["motor_current"]
    folded = Channel(channel.time, np.abs(channel.values) - 0.004, "A", "motor_current")
    kept = make_trial(Recording({**signed.channels, "motor_current": folded}, {"sensors": said}, "folded"))
    assert kept.options["sensors"] == said


def test_a_current_that_never_changes_was_not_measured() -> None:
    dead = changed(closing(), motor_current=0.0)
    trial = make_trial(dead)
    assert "motor_current" not in trial.signals and "it was not measured and is left out" in trial.notes[-1]
    taken = make_trial(dead, scale={"motor_current": 1.0})
    assert not values(taken, "motor_current").any()
    there, gone = in_si([closing(), dead], {})
    assert "motor_current" in there and not there.warnings and "motor_current" not in gone
    alone = Recording({n: c for n, c in dead.channels.items() if n != "encoder_position"}, {}, "alone")
    with pytest.raises(
        HannesError, match=r"alone: motor_current is 0 A throughout.*nothing else can be compared"
    ):
        make_trial(alone)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("motor_current", 80.0),
        ("encoder_position", 120.0),
        ("encoder_position", -3e3),
        ("reference_position", 500.0),
    ],
)
@pytest.mark.parametrize("scale", [{}, {"encoder_position": 1.0, "motor_current": 1.0}])
def test_a_few_absurd_samples_are_left_out(name: str, value: float, scale: dict[str, float]) -> None:
    plain = make_trial(closing())
    spoilt = make_trial(
        with_values(closing(), name, dict.fromkeys((700, 701, 702, 1100), value)), scale=scale
    )
    assert [n for n in spoilt.notes if n not in plain.notes] == [
        f"4 of {closing()[name].time.size} samples of {name} are far outside everything else that it does "
        f"(one is {value:.4g}); they were left out"
    ]
    assert np.abs(values(spoilt, "motor_current")).max() < 1.0
    assert np.ptp(values(spoilt, "encoder_position")) < 14.0
    assert np.ptp(spoilt.reference) < 14.0 and len(spoilt.closures) == 4


@pytest.mark.parametrize("peak", [2.0, 8.0])
def test_the_inrush_of_a_motor_is_no_absurd_sample(peak: float) -> None:
    trial = make_trial(closing(peak=peak))
    assert not trial.notes
    assert np.sum(values(trial, "motor_current") > 0.9 * peak) == 4


def test_a_long_step_is_no_absurd_sample() -> None:
    """A hand that rests for ten minutes and closes once."""
    still = closing()
    rest = 600.0
    long = {}
    for n, c in still.channels.items():
        keep = c.time < 4.4
        time = np.concatenate([np.arange(0.0, rest, 0.01), rest + c.time[keep]])
        noise = 1e-3 * np.random.default_rng(1).standard_normal(time.size - keep.sum())
        at_rest = np.zeros(noise.size) if n == "reference_position" else noise
        long[n] = Channel(time, np.concatenate([at_rest, c.values[keep]]), c.unit, n)
    found = in_si([Recording(long, {}, "long")], {"motor_current": 1.0})[0]
    assert not found.warnings
    assert all(np.array_equal(found[n].values, long[n].values) for n in long)


def test_an_encoder_that_rests_far_from_its_reference_is_shifted() -> None:
    both = [shifted(closing("free"), 100.0), shifted(closing("grasp", reach=BLOCKED), 100.0)]
    for one, plain in zip(in_si(both, {}), (closing(), closing(reach=BLOCKED)), strict=True):
        assert values(one, "encoder_position") == pytest.approx(values(plain, "encoder_position"))
        assert "shifted by that; say --scale encoder_position=1" in one.warnings[-1]
    (taken,) = in_si(both[:1], {"encoder_position": 1.0})
    assert values(taken, "encoder_position").min() == pytest.approx(100.0) and not taken.warnings
    with pytest.raises(HannesError, match="by another amount in each recording"):
        in_si([both[0], shifted(closing("other"), 200.0)], {})


@pytest.mark.parametrize(("by", "span"), [(0.05, 13.0), (-1.0, 13.0), (1.3, 13.0), (0.9, 0.6)])
def test_a_small_offset_of_the_encoder_is_left_to_the_fit(by: float, span: float) -> None:
    part = span / 13.0
    (one,) = in_si([shifted(closing(encoder_position=part, reference_position=part), by)], {})
    assert not one.warnings
    assert values(one, "encoder_position").min() == pytest.approx(by, abs=1e-9)


@pytest.mark.parametrize("sort", [(FREE, BLOCKED), (BLOCKED,)])
def test_an_encoder_on_the_motor_shaft_is_not_taken_for_degrees(sort: tuple[float, ...]) -> None:
    with pytest.raises(HannesError, match=r"times as much.*another shaft") as error:
        in_si([closing(f"r{reach}", reach=reach, encoder_position=19.0) for reach in sort], {})
    assert f"{19.0 * sort[0] / 13.0:.3g} times" in str(error.value)


def test_a_unit_of_the_encoder_is_guessed_from_the_recording_that_follows_best() -> None:
    degrees = 180.0 / math.pi
    free = closing("free", encoder_position=degrees)
    grasp = closing("grasp", reach=BLOCKED, encoder_position=degrees)
    for one, reach in zip(in_si([free, grasp], {}), (FREE, BLOCKED), strict=True):
        assert np.ptp(values(one, "encoder_position")) == pytest.approx(reach, rel=1e-3)
        assert any("looks like degrees" in note for note in one.warnings)
    with pytest.raises(HannesError, match="another unit"):
        in_si([grasp], {})
    assert not in_si([closing(reach=BLOCKED)], {})[0].warnings
    counted = closing(reach=BLOCKED, encoder_position=3000.0, reference_position=3000.0)
    assert any("encoder counts" in note for note in in_si([counted], {})[0].warnings)


def test_a_message_about_ranges_says_what_the_program_did() -> None:
    recording = closing("r", reach=1.0, encoder_position=1.0, reference_position=180.0 / math.pi)
    with pytest.raises(HannesError, match=r"13 rad \(after this program multiplied it by 0.01745\)"):
        in_si([recording], {})


@pytest.fixture(scope="module")
def bench() -> dict[str, Signals]:
    """Signed current; two free closures and a stiff grasp."""
    return signals_of_set(sensors="bench", conditions=("slow", "fast", "grasp"), closures=3)


def test_bags_of_one_command_get_one_sign(bench: dict[str, Signals], tmp_path: Path) -> None:
    plain = load_trials([write_set(tmp_path / "plain", bench)])
    turned = load_trials([write_set(tmp_path / "turned", bench, scaled(motor_current=-1.0))])
    for one, other in zip(plain, turned, strict=True):
        assert values(one, "motor_current") == pytest.approx(values(other, "motor_current"))
        assert any("its sign was turned" in note for note in other.notes)


def test_the_command_refuses_hundredths_of_an_ampere_in_one_line(
    bench: dict[str, Signals],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bags = str(write_set(tmp_path / "bags", bench, scaled(motor_current=100.0)))
    code, _, err = hannes_in_one_line("compare", bags, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and "too much for A" in err and len(err.strip().splitlines()) == 1
    words = ("compare", bags, "--scale", "motor_current=0.01")
    code, out, _ = hannes_in_one_line(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and out.count("motor_current was multiplied by 0.01: as --scale says") == 1
