"""One signal by another clock: moved back, said, and the rest fitted; what a hand lacks moves none."""

import re
from collections.abc import Mapping
from dataclasses import replace

import pytest
from hannes_description.model import Model
from hannes_lab.compare import compare
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.hand import outer_loop
from hannes_lab.hide import make_set
from hannes_lab.lags import lags, lags_to_voltage, with_one_clock
from hannes_lab.prepare import prepare
from hannes_lab.recorded import make_trial
from hannes_lab.trials import Trial
from hannes_sim.effect import catalogue, strength_of

QUICK = ("fast", "grasp_fast")


def late(trials: list[Trial], by: Mapping[str, float]) -> list[Trial]:
    return [
        replace(t, signals={n: (time + by.get(n, 0.0), values) for n, (time, values) in t.signals.items()})
        for t in trials
    ]


@pytest.fixture(scope="module")
def trials() -> list[Trial]:
    recordings, _ = make_set(
        Model.load(), [strength_of("glove_stiffness", 1.0)], seed=102, closures=4, conditions=QUICK
    )
    return [make_trial(r) for r in recordings]


@pytest.mark.parametrize(("signal", "seconds"), [("motor_current", 0.2), ("encoder_position", -0.15)])
def test_a_signal_by_another_clock_is_moved_back_and_the_answer_stays(
    trials: list[Trial], signal: str, seconds: float
) -> None:
    prepared = prepare(late(trials, {signal: seconds}), Model.load())
    (note,) = (n for n in prepared.notes if "another clock" in n)
    assert note.startswith(f"fast, grasp_fast: {signal} is 0.") and "moved back" in note
    assert ("later" in note) == (seconds > 0.0)
    found = diagnose(prepared, effect_sources(only=["glove_stiffness", "gravity", "command_delay"]))
    assert [e.name for e in found.effects] == ["glove_stiffness"]
    fitted = found.nuisances[f"log.delay_of_{signal}"]["value"]
    left = prepared.features.trials[0].signals[signal][0][0] - trials[0].signals[signal][0][0]
    assert fitted == pytest.approx(float(left), abs=0.005)


def test_all_signals_of_recordings_that_describe_nothing_leave_it_to_the_clock_that_is_fitted(
    trials: list[Trial],
) -> None:
    both = {"encoder_position": 0.2, "motor_current": 0.2}
    plain = [replace(t, options={"object": t.options["object"]}) for t in late(trials, both)]
    assert with_one_clock(plain, Model.load()) == plain
    assert all("moved" in t.options for t in with_one_clock(late(trials, both), Model.load()))


@pytest.mark.slow
def test_a_signal_that_is_a_little_late_in_recordings_that_describe_nothing_is_fitted(
    trials: list[Trial],
) -> None:
    plain = [
        replace(t, options={"object": t.options["object"]}) for t in late(trials, {"encoder_position": 0.03})
    ]
    found = diagnose(prepare(plain, Model.load()), effect_sources(only=["glove_stiffness", "gear_backlash"]))
    assert found.verdict == "effects" and [e.name for e in found.effects] == ["glove_stiffness"]
    (moved,) = re.findall(r"motor_current is ([\d.]+) s earlier than the encoder", "\n".join(found.notes))
    rest = found.nuisances["log.delay_of_motor_current"]["value"]
    assert rest - float(moved) == pytest.approx(-0.03, abs=0.005)
    assert found.moved is not None
    after = compare(replace(found.moved, model=found.model), values=found.values)
    assert after.overall < 1.5, "a report compares with what was moved"


@pytest.mark.parametrize("effect", sorted(catalogue()))
def test_no_effect_looks_like_another_clock(effect: str) -> None:
    model = Model.load()
    recordings, _ = make_set(model, [strength_of(effect, 2.0)], seed=7, closures=2, conditions=QUICK)
    found = lags([make_trial(r) for r in recordings], model)
    assert set(found) == {"encoder_position", "motor_current"}
    assert not any(lag.clear for lag in found.values()), found


@pytest.mark.parametrize("effect", sorted(catalogue()))
def test_no_effect_looks_like_another_clock_than_the_voltage(effect: str) -> None:
    recordings, _ = make_set(
        Model.load(), [strength_of(effect, 2.0)], seed=7, closures=2, conditions=QUICK, sensors="bench"
    )
    assert lags_to_voltage([make_trial(r) for r in recordings]) == {}


@pytest.mark.parametrize(
    ("by", "found"),
    [
        ({"motor_current": 0.025}, {"motor_current": 0.025}),
        ({"encoder_position": -0.03}, {"encoder_position": -0.03}),
        ({"encoder_position": 0.03, "motor_current": 0.03}, {}),
        ({"motor_current": 0.008}, {}),
    ],
    ids=["current", "encoder", "both: the command is", "as little as a model may be off"],
)
def test_a_voltage_tells_the_time_of_current_and_encoder(
    by: Mapping[str, float], found: Mapping[str, float]
) -> None:
    recordings, _ = make_set(
        Model.load(),
        [strength_of("glove_stiffness", 1.0)],
        seed=102,
        closures=3,
        conditions=QUICK,
        sensors="bench",
    )
    trials = late([make_trial(r) for r in recordings], by)
    assert lags_to_voltage(trials) == pytest.approx(found, abs=0.0051)
    notes = [
        note
        for trial in with_one_clock(trials, Model.load())
        for note in trial.notes
        if "another clock" in note
    ]
    assert len(notes) == len(QUICK) * len(found)


def test_an_outer_loop_is_read_off_the_recordings_only_where_they_show_it(trials: list[Trial]) -> None:
    """Fast closures with a rectified current at 30 Hz gave fourteen times the gain."""
    assert outer_loop(trials) is None
    recordings, _ = make_set(Model.load(), [], seed=102, closures=3, conditions=("slow",), sensors="bench")
    loop = outer_loop([make_trial(r) for r in recordings])
    assert loop is not None and loop.kp == pytest.approx(Model.load().parameters.value("control.kp"), rel=0.3)
