"""Bags of single closures that repeat one condition are one condition, however the machine began them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hannes_bags.recording import Recording
from hannes_bags.writing import write_recording
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.errors import repeatability
from hannes_lab.features import build_features, compact_end
from hannes_lab.hand import HandRig
from hannes_lab.hide import make_set
from hannes_lab.join import ENOUGH, Loaded, join_repeats
from hannes_lab.prepare import load_trials, prepare, without_named
from hannes_lab.recorded import make_trial
from hannes_lab.trials import SAME
from hannes_sim.effect import strength_of
from lab.foreign_bags import hannes

QUICK = ("fast", "grasp_fast")
CLOSURES = 6
FEW = ["glove_stiffness", "wire_slack", "gravity", "winding_heating"]


@pytest.fixture(scope="module")
def whole() -> list[Recording]:
    """A glove, recorded as usual: all closures of a condition in one bag."""
    glove = strength_of("glove_stiffness", 1.0)
    return make_set(Model.load(), [glove], seed=11, closures=CLOSURES, conditions=QUICK)[0]


def cut(recording: Recording) -> list[Recording]:
    """One recording for each closure."""
    origin = float(recording["reference_position"].time[0])
    return [
        recording.slice(origin + c.start - 0.15, origin + c.stop - 0.1)
        for c in make_trial(recording).closures
    ]


def anew(model: Model, number: int, effects: Sequence[str] = ("glove_stiffness",)) -> list[Recording]:
    """One closure of each condition by a simulator that was started for it; the nominal hand, with scatter."""
    hidden = [strength_of(e, 1.0) for e in effects]
    return make_set(model, hidden, seed=number, closures=1, conditions=QUICK, spread=0.0)[0]


def loaded(recordings: Sequence[Recording]) -> list[Loaded]:
    return [
        Loaded(make_trial(r), str(r.metadata["condition"]), r["reference_position"].period)
        for r in recordings
    ]


def without_condition(recording: Recording, name: str) -> Loaded:
    """As from a bag that says nothing of its condition and is called so."""
    trial = make_trial(recording, name=name)
    return Loaded(trial, None, recording["reference_position"].period)


@pytest.mark.slow
def test_cut_up_recordings_give_the_answer_of_the_whole_ones(whole: list[Recording], tmp_path: Path) -> None:
    for recording in whole:
        for number, part in enumerate(cut(recording)):
            write_recording(part, tmp_path / f"{recording.metadata['condition']}_{number}")
    joined = load_trials([tmp_path])
    assert [(t.name, t.conditions, len(t.closures)) for t in joined] == [
        (name, (name,), CLOSURES) for name in QUICK
    ]
    assert not any(t.fresh for t in joined)
    assert all("6 recordings repeat one condition" in t.notes[-1] for t in joined)
    model = Model.load()
    answers = [
        diagnose(prepare(trials, model), effect_sources(only=FEW), max_effects=1)
        for trials in ([make_trial(r) for r in whole], joined)
    ]
    stiffness = [a.effects[0].parameters["stiffness"] for a in answers]
    assert [[e.name for e in a.effects] for a in answers] == [["glove_stiffness"], ["glove_stiffness"]]
    assert stiffness[1].value == pytest.approx(
        stiffness[0].value, abs=0.5 * (stiffness[0].high - stiffness[0].low)
    )
    row = answers[1].data[0]
    assert row["closures"] == CLOSURES and len(row["sha256"].split(", ")) == CLOSURES


def test_recordings_of_a_simulator_that_is_started_anew_repeat_its_first_closure() -> None:
    model = Model.load()
    joined = join_repeats(loaded([r for k in range(CLOSURES) for r in anew(model, 21 + k)]))
    assert [t.name for t in joined] == list(QUICK) and all(t.fresh for t in joined)
    assert all(t.repeats == (0,) * CLOSURES for t in joined)
    first = joined[0].closures[0]
    end = compact_end(joined[0])
    assert end is not None and abs(end * joined[0].period - first.stop) < 0.1
    found = diagnose(prepare(joined, model), effect_sources(only=FEW))
    assert [e.name for e in found.effects] == ["glove_stiffness"]
    stiffness = found.effects[0].parameters["stiffness"]
    assert stiffness.low <= 0.002 <= stiffness.high or stiffness.value == pytest.approx(0.002, rel=0.1)


def test_recordings_that_begin_anew_and_repeat_nearly_are_simulated_one_by_one_once() -> None:
    """An operator's references: the first stands for all, but for what they differ by, which is taken once."""
    model, rng = Model.load(), np.random.default_rng(4)
    alone = []
    for k in range(CLOSURES):
        trial = make_trial(anew(model, 21 + k)[0])
        by_hand = trial.reference * (1.0 + 0.004 * rng.standard_normal())
        alone.append(replace(trial, name=f"fast_{k}", reference=by_hand, source="", fresh=True))
    (joined,) = join_repeats([Loaded(trial, "fast") for trial in alone])
    assert joined.anew and SAME < joined.apart < 0.02
    assert len(without_named([joined], {"fast": (CLOSURES,)})[0].closures) == CLOSURES - 1
    with pytest.raises(HannesError, match="leave that recording out instead"):
        without_named([joined], {"fast": (1,)})
    features, rig = build_features([joined], ["motor_current"]), HandRig([joined])
    found = features.closures(rig, model, {})[0]
    names = [part.name for part in joined.parts]
    for trial in alone:
        own = build_features([trial], ["motor_current"])
        np.testing.assert_allclose(own.blocks[0].phase, features.blocks[0].phase)
        (curve,) = own.closures(HandRig([trial]), model, {})[0]
        np.testing.assert_allclose(found[names.index(trial.name)], curve, atol=1e-6)
    assert float(np.abs(found - found[0]).max()) > 3e-3 * float(np.ptp(found)), "their references differ"
    quick = features.compacted(rig, model, {})
    np.testing.assert_allclose(quick.closures(rig, model, {})[0], found, atol=1e-9)


def test_several_closures_begun_anew_repeat_those_of_the_longest_recording() -> None:
    parts = [make_set(Model.load(), [], seed=s, closures=n, conditions=["slow"], spread=0.0)[0][0]
             for s, n in ((1, 1), (2, 3), (3, 2))]  # fmt: skip
    (joined,) = join_repeats(loaded(parts))
    assert joined.fresh and len(joined.closures) == 6
    assert joined.repeats == (0, 1, 2, 0, 0, 1)


def test_closures_that_are_the_same_bit_for_bit_are_known_to_a_part_of_their_span() -> None:
    (once,) = make_set(Model.load(), [], seed=1, closures=1, conditions=["grasp_fast"], spread=0.0)[0]
    features = build_features(join_repeats(loaded([once, once])), ["encoder_position"])
    block = features.blocks[0]
    assert block.n == 2 and repeatability(block) == pytest.approx(1e-5 * np.ptp(block.measured))
    moved = replace(block, measured=block.measured + np.array([[0.0], [1e-6]]))
    assert repeatability(moved) == pytest.approx(1e-6 / np.sqrt(2.0))


def test_what_differs_stays_apart(whole: list[Recording]) -> None:
    parts = [cut(r)[:3] for r in whole]
    fast = parts[0]

    def names(*given: Loaded) -> list[str]:
        return [t.name for t in join_repeats(given)]

    numbered = [without_condition(r, f"run_{k}") for k, r in enumerate(fast)]
    assert names(*numbered) == ["run_0"], "a number or a date at the end does not tell conditions apart"
    assert names(without_condition(fast[0], "a"), without_condition(fast[1], "b")) == ["a", "b"]
    described = replace(numbered[1].trial, options={**numbered[1].trial.options, "object": "soft"})
    assert names(numbered[0], replace(numbered[1], trial=described)) == ["run_0", "run_1"]
    rng = np.random.default_rng(1)
    noisy = [replace(n.trial, signals={**n.trial.signals, "grip_force": (t := n.trial.signals["encoder_position"][0],
             0.1 * rng.standard_normal(t.size))}) for n in numbered]  # fmt: skip
    assert names(*(replace(n, trial=t) for n, t in zip(numbered, noisy, strict=True))) == ["run_0"]
    alone = make_set(Model.load(), [], seed=3, closures=ENOUGH, conditions=["fast"])[0][0]
    assert len(join_repeats(loaded([alone, alone]))) == 2, "each tells its own scatter"


def test_another_object_of_which_nobody_said_anything_stays_apart() -> None:
    """The same reference on nothing and on the dynamometer; and a signal just within and beyond what may differ."""
    slow, grasp = make_set(Model.load(), [], seed=3, closures=1, conditions=["slow", "grasp"])[0]
    bare = [without_condition(replace(r, metadata={}), f"run_{k}") for k, r in enumerate((slow, slow, grasp))]

    def stretched(one: Loaded, factor: float) -> Loaded:
        time, position = one.trial.signals["encoder_position"]
        signals = {**one.trial.signals, "encoder_position": (time, position * factor)}
        return replace(one, trial=replace(one.trial, signals=signals, name="run_3"))

    assert len(join_repeats(bare[:2])) == 1 and len(join_repeats([bare[0], bare[2]])) == 2
    assert len(join_repeats([bare[0], stretched(bare[0], 1.1)])) == 1
    assert len(join_repeats([bare[0], stretched(bare[0], 1.5)])) == 2


def test_without_an_encoder_nobody_can_tell_how_recordings_began() -> None:
    parts = [r for k in range(3) for r in anew(Model.load(), 41 + k)[:1]]
    blind = [replace(one, trial=replace(one.trial, signals={"motor_current": one.trial.signals["motor_current"]}))
             for one in loaded(parts)]  # fmt: skip
    assert len(join_repeats(blind)) == 3


def test_recordings_that_begin_with_the_move_are_taken(whole: list[Recording]) -> None:
    """A closure begins 30 ms before the reference moves, which here is before the recording."""
    begun = []
    for part in cut(whole[0]):
        reference = part["reference_position"]
        moved = np.flatnonzero(np.abs(np.asarray(reference.values)) > 0.0)
        begun.append(part.slice(float(reference.time[moved[0]]) - 0.002, part.end))
    joined = join_repeats(loaded(begun))
    assert min(c.start for t in joined for c in t.closures) < 0.0
    assert np.isfinite(prepare(joined, Model.load()).problem.residual(Model.load(), {})).all()


def test_a_recording_that_ends_soon_after_the_move_shortens_the_closures_and_is_not_lost(
    whole: list[Recording],
) -> None:
    parts = cut(whole[0])[:4]
    reference = parts[1]["reference_position"]
    moved = np.flatnonzero(np.abs(np.asarray(reference.values)) > 0.02)
    until = float(reference.time[moved[-1]]) + 0.1
    (joined,) = join_repeats(loaded([parts[0], parts[1].slice(float(reference.time[0]), until), *parts[2:]]))
    lengths = np.array([c.stop - c.start for c in joined.closures])
    assert lengths.size == 4 and np.ptp(lengths) < 1e-9
    usual = loaded(parts[:1])[0].trial.closures[0]
    assert lengths[0] < 0.8 * (usual.stop - usual.start)
    assert f"the first {lengths[0]:.2f} s" in joined.notes[-1] and "ends early" in joined.notes[-1]


def test_a_note_about_some_of_the_joined_recordings_says_which(whole: list[Recording]) -> None:
    parts = [
        replace(one, trial=replace(one.trial, source=f"run_{k}", notes=notes))
        for k, (one, notes) in enumerate(
            zip(loaded(cut(whole[0])[:3]), [("all", "some"), ("all",), ("all", "some")], strict=True)
        )
    ]
    (joined,) = join_repeats(parts)
    assert joined.notes[:2] == ("all", "run_0, run_2: some") and len(joined.notes) == 3


def test_a_bag_without_a_whole_closure_or_given_twice_is_left_out_with_a_note(
    whole: list[Recording], tmp_path: Path
) -> None:
    one, two = cut(whole[0])[:2]
    begin = float(two["reference_position"].time[0])
    write_recording(one, tmp_path / "bags" / "a_1")
    write_recording(two.slice(begin, begin + 0.6), tmp_path / "bags" / "a_2")
    (trial,) = load_trials([tmp_path / "bags"])
    assert "left out" in trial.notes[-1] and "no closure was found" in trial.notes[-1]
    (trial,) = load_trials([tmp_path / "bags" / "a_1", tmp_path / "bags" / "a_1"])
    assert "is the same recording as" in trial.notes[-1] and len(trial.closures) == 1
    with pytest.raises(HannesError, match="no closure was found"):
        load_trials([tmp_path / "bags" / "a_2"])


def test_objects_are_said_by_the_names_of_the_bags_too(
    whole: list[Recording],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for number, part in enumerate(cut(whole[0])[:3]):
        write_recording(replace(part, metadata={}), tmp_path / f"run_{number}")
    words = ["compare", str(tmp_path), "--object", "run_1=none"]
    code, out, _ = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and "3 recordings repeat one condition" in " ".join(out.split())
    code, out, _ = hannes(*words, "--object", "run_2=soft", capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and "2 recordings repeat one condition" in " ".join(out.split())
    code, _, said = hannes(*words, "--object", "other=soft", capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and "unknown conditions other" in said


def test_a_named_object_is_taken_as_named_where_that_is_nearer_than_what_is_seen() -> None:
    """A recording of this simulator that does not say so: the model that made it is right as it is."""
    (recording,) = make_set(
        Model.load(), [], seed=1, closures=2, conditions=["grasp"], scatter=0.0, spread=0.0
    )[0]
    said = {k: v for k, v in recording.metadata.items() if k not in ("sensors", "plant")}
    options = {}
    for name in ("soft", "rigid"):
        trial = make_trial(replace(recording, metadata={**said, "object": name}))
        options[name] = prepare([trial], Model.load()).features.trials[0].options["object"]
    assert options["rigid"] == "rigid"
    assert options["soft"]["stiffness"] > 2000.0, "it was the dynamometer, far stiffer than a ball of 400 N/m"
