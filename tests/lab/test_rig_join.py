"""Recordings of a rig in several files: those that repeat one condition are taken together, as bags are."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_lab.compare import compare
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.errors import held_out_conditions
from hannes_lab.fit import fit
from hannes_lab.join import join_trials
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.problem import nuisance_coordinate
from hannes_lab.rig import Nuisance, load_rig
from hannes_lab.trials import Closure, Trial
from hannes_sim.factory import make_plant
from hannes_sim.rollout import VoltagePlayback, rollout
from lab.single_mass_rig import write_files
from lab.test_rig_checks import BASE


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> type:
    folder = tmp_path_factory.mktemp("rig")
    write_files(folder)
    found = load_rig(BASE)

    class Mass(found):
        model, population, source = folder / "mass.yaml", folder / "tolerances.yaml", ""

    return Mass


def moves(rig: type, kind: str, there: float, back: float, count: int, fresh: bool = False) -> list[Trial]:
    """Files of one move each, from rest at zero to `there` and on to `back` [m], with noise."""
    u = np.linspace(0.0, 1.0, 500)
    soft = u - np.sin(2 * np.pi * u) / (2 * np.pi)
    reference = np.concatenate(
        [np.zeros(50), there * soft, there + (back - there) * soft, np.full(400, back)]
    )
    machine = rig([])
    model = Model.load(rig.model)
    run = rollout(make_plant(model), machine.controller(model, 1e-3), reference)
    rng = np.random.default_rng(count)
    time = np.arange(reference.size) * 1e-3
    out = []
    for k in range(count):
        signals = {
            "encoder_position": (time, run.encoder_position + 2e-7 * rng.standard_normal(time.size)),
            "drive_force": (time, run.motor_voltage + 0.02 * rng.standard_normal(time.size)),
        }
        units = {"drive_force": "N", "encoder_position": "m"}
        closure = Closure(0.0, float(time[-1]), kind)
        out.append(Trial(f"{kind}{k}", 1e-3, reference, signals, (closure,), units=units, fresh=fresh))
    return out


def prepared(rig: type, *trials: Trial) -> Prepared:
    return prepare(trials, Model.load(rig.model), rig=rig)


def test_files_that_repeat_a_condition_are_taken_together(rig: type) -> None:
    found = prepared(rig, *moves(rig, "far", 0.1, 0.0, 6), *moves(rig, "near", 0.02, 0.0, 3))
    far, near = found.features.trials
    assert (len(far.closures), far.conditions) == (6, ("far",))
    assert (len(near.closures), near.conditions) == (3, ("near",))
    assert not far.anew and any("6 recordings repeat one condition" in note for note in found.notes)
    assert not any("fewer than five closures of far" in note for note in found.notes)
    assert all(b.n == (6 if b.condition == "far" else 3) for b in found.features.blocks)


def test_an_adapter_says_that_each_file_begins_as_the_first(rig: type) -> None:
    """Each ends elsewhere than it began: a simulation that goes on from there would be another one."""
    (trial,) = prepared(rig, *moves(rig, "step", 0.05, 0.04, 4, fresh=True)).features.trials
    assert trial.anew and trial.repeats == (0, 0, 0, 0)
    # It need not be said where it is seen: all end that far from where they began.
    (seen,) = prepared(rig, *moves(rig, "step", 0.05, 0.04, 4)).features.trials
    assert seen.anew and seen.repeats == trial.repeats


def test_what_cannot_be_told_stays_apart_and_is_told_apart(rig: type) -> None:
    """Without an encoder nobody sees how a recording began."""
    blind = [
        replace(t, signals={"drive_force": t.signals["drive_force"]}) for t in moves(rig, "x", 0.05, 0.0, 2)
    ]
    found = prepared(rig, *blind)
    assert len(found.features.trials) == 2
    assert any("x0, x1 are of one condition, 'x', and are not taken together" in note for note in found.notes)
    result = compare(found)
    assert {cell.condition for cell in result.cells} == {"x (x0)", "x (x1)"}
    assert [e.condition for e in result.errors] == ["x (x0)", "x (x1)"]
    assert {o.condition for o in result.overlays} == {"x (x0)", "x (x1)"}
    (said,) = prepared(rig, *(replace(t, fresh=True) for t in blind)).features.trials
    assert len(said.closures) == 2


def test_why_files_of_one_condition_are_not_taken_together_is_said(rig: type) -> None:
    one, two, three = moves(rig, "x", 0.05, 0.0, 3, fresh=True)

    def pushed(trial: Trial, part: float) -> Trial:
        time, force = trial.signals["drive_force"]
        return replace(trial, signals={**trial.signals, "drive_force": (time, force + part * np.ptp(force))})

    notes = prepared(rig, one, two, pushed(three, 0.3)).notes
    assert any(
        "drive_force differs by 30 % of its span, where repeats may by 20 %" in note and "(x0, x2)" in note
        for note in notes
    )
    assert not any("fresh=True" in note for note in notes)
    found = prepared(rig, one, pushed(two, 0.15))
    assert len(found.features.trials) == 1, "an adapter is believed, and what scatters is said"
    assert any(
        "x0: drive_force differs by 15 % of its span from recording to recording" in n for n in found.notes
    )
    assert not any("differs by" in note for note in prepared(rig, one, two, three).notes)


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"options": {"load": 2.0}}, "their options differ (load)"),
        ({"units": {"drive_force": "N", "encoder_position": "rad"}}, "the units of encoder_position differ"),
        ({"fresh": False}, "one of them begins as the first does (fresh=True), the other does not"),
        ({"reference": 1.1}, "their references differ by up to 10.0 % of their span"),
    ],
)
def test_what_differs_between_files_of_one_condition_is_named(rig: type, changed: dict, why: str) -> None:
    one, two = moves(rig, "x", 0.05, 0.0, 2, fresh=True)
    if "reference" in changed:
        changed = {"reference": changed["reference"] * two.reference}
    said = [n for n in join_trials([one, replace(two, **changed)])[0].notes if "not taken together" in n]
    assert said == [f"x0, x1 are of one condition, 'x', and are not taken together: {why} (x0, x1)"]


def test_samples_that_begin_late_are_not_mixed_with_the_end_of_the_file_before(rig: type) -> None:
    """A logger's first sample comes a moment after the begin: until then the signal stands."""
    files = [
        replace(t, signals={name: (time[4::5], values[4::5]) for name, (time, values) in t.signals.items()})
        for t in moves(rig, "step", 0.05, 0.04, 3, fresh=True)
    ]
    (position,) = (b for b in prepared(rig, *files).features.blocks if b.signal == "encoder_position")
    assert np.ptp(position.measured) > 0.04
    assert position.measured.std(axis=0).max() < 2e-6 and np.abs(position.measured[:, 0]).max() < 2e-6


def test_noise_of_the_samples_does_not_keep_files_apart(rig: type) -> None:
    rng = np.random.default_rng(4)
    noisy = []
    for trial in moves(rig, "x", 0.05, 0.0, 3):
        time, force = trial.signals["drive_force"]
        rough = force + 0.1 * np.ptp(force) * rng.standard_normal(force.size)
        noisy.append(replace(trial, signals={**trial.signals, "drive_force": (time, rough)}))
    (trial,) = prepared(rig, *noisy).features.trials
    assert len(trial.closures) == 3


def test_recordings_of_one_file_are_told_by_their_names(rig: type) -> None:
    of_one = [replace(t, source="all.csv") for t in moves(rig, "x", 0.05, 0.0, 3)]
    notes = prepared(rig, *of_one).notes
    assert any("3 recordings repeat one condition and are taken together (x0, x1, x2)" in n for n in notes)


def test_without_repeats_what_brings_left_out_conditions_no_nearer_is_no_finding(rig: type) -> None:
    far, near = moves(rig, "far", 0.1, 0.0, 1), moves(rig, "near", 0.02, 0.0, 1)
    bent = []
    for trial in far + near:
        time, position = trial.signals["encoder_position"]
        signals = {**trial.signals, "encoder_position": (time, position + 1e-4 * np.sin(40.0 * time))}
        bent.append(replace(trial, signals=signals))
    found = prepared(rig, *bent)
    sources = effect_sources(only=["coulomb_friction"])
    answer = diagnose(found, sources)
    assert answer.verdict == "unknown" and not any("--greedy" in note for note in answer.notes)
    assert answer.effects == ()
    assert answer.summary.startswith(
        "Whether something is missing cannot be told, for nothing was repeated: "
    )
    told = answer.to_dict()
    assert told["unknown_kind"] == "no_repeats" and told["error"]["held_out"] is False
    assert np.isnan([told["error"][name] for name in ("nominal", "final", "repeatability")]).all()


def test_a_travel_unlike_that_of_the_adapter_is_said(rig: type) -> None:
    class Degrees(rig):
        sizes = {"N.m": 3.0, "rad": 0.1 / 57.3}

    trials = moves(rig, "far", 0.1, 0.0, 2)

    class Rail(rig):
        """Each file is a small move, at another place of a long rail."""

        sizes = {"N.m": 3.0, "rad": 2.5}

    time, position = trials[0].signals["encoder_position"]
    there = replace(
        trials[0], name="there", signals={**trials[0].signals, "encoder_position": (time, position + 2.0)}
    )
    assert any("`sizes` say 2.5" in n for n in prepare(trials[:1], Model.load(rig.model), rig=Rail).notes)
    assert not any(
        "`sizes` say" in n for n in prepare([trials[1], there], Model.load(rig.model), rig=Rail).notes
    )
    notes = prepare(trials, Model.load(rig.model), rig=Degrees).notes
    assert any("encoder_position goes over 0.1 m, and the adapter's `sizes` say 0.0017" in n for n in notes)
    assert not any("`sizes` say" in note for note in prepared(rig, *trials).notes)


def test_trials_with_many_closures_or_conditions_stay_alone(rig: type) -> None:
    one, two = moves(rig, "a", 0.05, 0.0, 2)
    several = [
        replace(t, closures=(Closure(0.0, 0.5, "out"), Closure(0.55, 1.1, "back"))) for t in (one, two)
    ]
    assert len(prepared(rig, *several).features.trials) == 2
    other = replace(two, options={"gain": np.ones(3)})
    assert len(prepared(rig, one, other).features.trials) == 2
    same = replace(one, options={"gain": np.ones(3)})
    assert len(prepared(rig, same, other).features.trials) == 1


def test_a_name_that_two_recordings_have_is_made_their_own(rig: type) -> None:
    one, two = moves(rig, "a", 0.05, 0.0, 1) + moves(rig, "b", 0.02, 0.0, 1)
    trials = prepared(rig, replace(one, name="x"), replace(two, name="x")).features.trials
    assert [t.name for t in trials] == ["x", "x#2"]


def test_a_recording_alone_begins_but_once(rig: type) -> None:
    """`fresh` of a recording with several closures that nothing is joined to says nothing."""
    (one,) = moves(rig, "a", 0.05, 0.0, 1, fresh=True)
    two = replace(one, closures=(Closure(0.0, 1.0, "a"), Closure(1.0, 1.2, "a")))
    (trial,) = prepared(rig, two).features.trials
    assert trial.repeats == (0, 1) and not trial.anew


def test_a_recorded_command_is_replayed_without_a_controller(rig: type) -> None:
    """Open loop: the reference is the command, and the adapter's control law hands it on."""
    (one,) = moves(rig, "open", 0.05, 0.0, 1)

    class Open(rig):
        def controller(self, model, period):
            return VoltagePlayback(period)

    command = replace(one, reference=one.signals["drive_force"][1])
    model = replace(Model.load(rig.model), controller="double_pid")  # as a model file that names none
    found = prepare([command], model, rig=Open)
    result = compare(found)
    assert all(o.to_dict()["reference"] is None for o in result.overlays), "it is no position"
    errors = {e.signal: e.rmse for e in result.errors}
    assert errors["drive_force"] < 1e-9 and errors["encoder_position"] < 1e-3
    assert not any("reference, which the simulated one" in note for note in found.notes)
    factor = 1e3 * model.parameters.value("supply.voltage") / np.abs(command.reference).max()
    wrong = prepare([replace(command, reference=factor * command.reference)], model, rig=Open)
    assert any(note.startswith("the command that is played back reaches") for note in wrong.notes)
    assert not any("played back" in note for note in found.notes)


def test_a_current_that_is_played_back_is_known(rig: type) -> None:
    """Without a signal of it: it is the reference."""
    (one,) = moves(rig, "open", 0.05, 0.0, 1)
    position = {"encoder_position": one.signals["encoder_position"]}
    command = replace(one, reference=one.signals["drive_force"][1], signals=position)

    class Open(rig):
        def controller(self, model, period):
            return VoltagePlayback(period)

    def said(kind: type, compensated: float) -> bool:
        model = Model.load(rig.model).with_values({"motor.emf_compensated": compensated})
        notes = prepare([command], replace(model, controller="double_pid"), rig=kind).notes
        return any("friction, torque constant and inertia are hard to tell apart" in note for note in notes)

    assert not said(Open, 1.0)
    assert said(Open, 0.0), "a voltage tells no torque"


def test_each_recording_may_have_a_value_of_its_own(rig: type, tmp_path: Path) -> None:
    """A friction by place: each file is at another one."""
    viscous = (3.0, 4.0, 6.5)
    trials = []
    for k, value in enumerate(viscous):

        class There(rig):
            model = tmp_path / f"m{k}.yaml"

        write_files(tmp_path)
        text = (tmp_path / "parameters.yaml").read_text().replace("value: 4.0", f"value: {value}")
        (tmp_path / f"p{k}.yaml").write_text(text)
        text = (tmp_path / "mass.yaml").read_text().replace("parameters.yaml", f"p{k}.yaml")
        (tmp_path / f"m{k}.yaml").write_text(text)
        (one, *_) = moves(There, f"place{k}", 0.05 + 0.01 * k, 0.0, 1)
        trials.append(one)
    tolerances = tmp_path / "each.yaml"

    class Each(rig):
        population = tolerances

    def lines(*own: str) -> None:
        tolerances.write_text(
            "".join(f"{n}: {{sd: 0.5, closure_sd: 0.0, unit: '1', source: test}}\n" for n in own)
        )

    lines("motor.armature", "friction.viscous@each")
    found = prepare(trials, Model.load(rig.model), rig=Each)
    assert [n.name for n in found.nuisances] == [
        "motor.armature",
        *(f"friction.viscous@place{k}0" for k in range(3)),
    ]
    table = compare(found, fitted=True).nuisances
    for k, value in enumerate(viscous):
        assert table[f"friction.viscous@place{k}0"]["value"] == pytest.approx(value, rel=0.02)
    answer = diagnose(found, effect_sources(only=["coulomb_friction"]))
    assert answer.effects == () and set(answer.nuisances) == {n.name for n in found.nuisances}
    for wrong in (
        ("friction.viscous@place00",),
        ("friction.viscous@each", "friction.viscous"),
        ("control.kp@each",),
    ):
        lines(*wrong)
        with pytest.raises(HannesError, match="of which each recording has a value of its own is called"):
            prepare(trials, Model.load(rig.model), rig=Each)


def test_what_a_condition_alone_shows_is_not_known_where_it_is_left_out(rig: type) -> None:
    """A tolerance draws it to where it is expected, but weighs nothing where much else is left: the fit ends before."""

    class Place(rig):
        def run(self, model, values, trial, reference):
            wanted = dict(values)
            push = wanted.pop("place.far", 0.0)
            if trial.conditions == ("far",):
                wanted["friction.viscous"] = model.parameters.value("friction.viscous") * (1.0 + 0.1 * push)
            return super().run(model, wanted, trial, reference)

    trials = moves(rig, "far", 0.1, 0.0, 3) + moves(rig, "near", 0.02, 0.0, 3)
    for k, trial in enumerate(trials):
        time, position = trial.signals["encoder_position"]
        bent = position + 2e-3 * np.sin(40.0 * time) + 2e-7 * k
        trials[k] = replace(trial, signals={**trial.signals, "encoder_position": (time, bent)})
    found = prepare(trials, Model.load(rig.model), rig=Place)
    own = Nuisance("place.far", 0.0, 1.0, False, 0.0, "1")
    coordinates = [nuisance_coordinate(n) for n in (*found.nuisances, own)]
    start = fit(found.problem, found.model, coordinates, {}).z
    start[-1] = -2.6
    left_out = held_out_conditions(found.problem, found.model, coordinates, start)
    assert abs(left_out["far"][1]["place.far"]) < 1e-6
    assert abs(left_out["near"][1]["place.far"]) > 1e-3, "there it is seen"


def test_closures_of_a_condition_in_trials_of_several_are_said_to_be_no_repeats(rig: type) -> None:
    one, two = (
        replace(t, closures=(*t.closures, replace(t.closures[0], condition=f"only in {t.name}")))
        for t in moves(rig, "up", 0.05, 0.0, 2, fresh=True)
    )
    (note,) = (n for t in join_trials([one, two]) for n in t.notes if "not taken for repeats" in n)
    assert str(note).startswith("up: in several trials (up0, up1) of which some hold other conditions too")
    assert not any("not taken for repeats" in n for t in join_trials([one]) for n in t.notes)


def test_a_recording_that_differs_from_many_of_its_condition_is_left_out(rig: type) -> None:
    """One that was stuck, whichever of them it is; where half of them differ nobody knows which are right."""
    good = moves(rig, "push", 0.1, 0.0, 7, fresh=True)
    time, position = good[0].signals["encoder_position"]
    stuck = replace(
        good[0], name="stuck", signals={**good[0].signals, "encoder_position": (time, 0.3 * position)}
    )
    for order in ([stuck, *good[1:]], [*good[1:4], stuck, *good[4:]]):
        (joined,) = join_trials(order)
        assert len(joined.closures) == 6 and "stuck" not in {part.name for part in joined.parts}
        (note,) = (note for note in joined.notes if "left out" in note)
        assert "stuck of condition 'push', unlike its 6 other closures: encoder_position differs by" in note
    half = [replace(stuck, name=f"stuck{k}") for k in range(3)]
    apart = join_trials([*half, *good])
    assert sorted(len(trial.closures) for trial in apart) == [3, 7]
    assert any("of one condition, 'push', and are not taken together" in note for note in apart[0].notes)
    # each stuck in another place: none of them alone is many, and all together are
    several = [
        replace(
            good[0],
            name=f"stuck{k}",
            signals={**good[0].signals, "encoder_position": (time, (0.1 + 0.25 * k) * position)},
        )
        for k in range(3)
    ]
    assert sum(len(trial.closures) for trial in join_trials([*several, *good])) == 10


def test_what_holds_another_object_is_no_stray(rig: type) -> None:
    """Recordings of the same motion, of which one says that it held something else."""
    soft = [replace(one, options={"object": "soft"}) for one in moves(rig, "push", 0.1, 0.0, 6, fresh=True)]
    other = replace(soft[0], name="other", options={"object": "rigid"})
    joined = join_trials([*soft[1:], other])
    assert sorted(len(trial.closures) for trial in joined) == [1, 5]
    assert not any("left out" in note for note in joined[0].notes)
