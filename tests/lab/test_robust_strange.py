"""Recordings that say nothing of themselves, of a hand with another controller and clock than the nominal's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hannes_bags.reading import read_bag
from hannes_description.model import EffectEntry, Model
from hannes_lab.adequacy import is_adequate, shortfall
from hannes_lab.calibrate import calibrate
from hannes_lab.chance import chance
from hannes_lab.compare import compare
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.diagnosis import Diagnosis
from hannes_lab.errors import overall, signal_errors
from hannes_lab.executor import Executor
from hannes_lab.features import compact_end
from hannes_lab.fit import Fit, fit
from hannes_lab.grasp import Curve, _seen, with_seen_objects
from hannes_lab.hand import HandRig, outer_loop
from hannes_lab.hide import make_set
from hannes_lab.prepare import load_trials, prepare
from hannes_lab.problem import nuisance_coordinate
from hannes_lab.recorded import make_trial
from hannes_lab.rig import COMES_BACK, Nuisance
from hannes_lab.search import Candidate, Search, wide_starts
from hannes_lab.trials import SAME, Closure, Trial
from hannes_lab.wording import _taken_for_its_own
from hannes_sim.effect import load_effect, strength_of
from hannes_sim.ports import R_QL
from lab.foreign_bags import Signals, one_after_the_other, signals_of_set, write_bag, write_set

STRANGE = {
    "control.kp": 0.5,
    "control.damping": 0.03,
    "control.current_kp": 0.1,
    "control.current_ki": 1200.0,
}
FEW = ("viscous_friction", "glove_stiffness", "wire_slack")


def late(signals: Signals) -> Signals:
    """The reference was logged 8 ms before the controller took it, at 100 Hz."""
    t, v = signals["reference_position"]
    at = np.arange(t[0], t[-1], 0.01)
    return {**signals, "reference_position": (at - 0.008 + 0.01, np.interp(at, t, v))}


def strange_set(folder: Path, *effects: str, names: Sequence[str] = ("fast", "grasp_fast")) -> list[Trial]:
    conditions = signals_of_set(
        model=Model.load().with_values(STRANGE),
        effects=[strength_of(name, 1.0) for name in effects],
        conditions=names,
        closures=4,
        seed=11,
    )
    return load_trials([write_set(folder / "bags", conditions, late)])


def offset_of(angle: float) -> EffectEntry:
    kind = load_effect("encoder_offset")
    return kind.entry({"offset": angle})


def diagnosed(trials: list[Trial]) -> Diagnosis:
    prepared = prepare(trials, Model.load())
    return diagnose(prepared, effect_sources(only=FEW), max_effects=1)


def test_what_was_grasped_and_how_it_was_controlled_is_read_from_the_closures(tmp_path: Path) -> None:
    trials = strange_set(tmp_path, names=("slow", "fast", "grasp"))
    seen = {t.name: t.options.get("object") for t in with_seen_objects(trials, Model.load())}
    assert seen["slow"] is None and seen["fast"] is None and seen["grasp"]["stiffness"] > 5e3
    loop = outer_loop(trials)
    assert loop is not None and loop.kp == pytest.approx(0.5, rel=0.25) and loop.ki == 0.0
    assert "sensors" not in read_bag(tmp_path / "bags" / "slow").metadata


def test_closures_on_nothing_and_on_an_object_in_one_bag_are_two_recordings(tmp_path: Path) -> None:
    """Though the reference is the same: only in one of them something is grasped."""
    own = signals_of_set(conditions=("slow", "grasp"), closures=4, seed=9)
    write_bag(tmp_path / "session", one_after_the_other(own["slow"], own["grasp"]))
    trials = load_trials([tmp_path])
    assert [(t.name, len(t.closures)) for t in trials] == [("session.1", 4), ("session.2", 4)]
    seen = {t.name: t.options.get("object") for t in with_seen_objects(trials, Model.load())}
    assert seen["session.1"] is None and seen["session.2"]["stiffness"] > 5e3
    said = load_trials([tmp_path], objects={"session.2": "rigid"})
    assert [t.options.get("object") for t in said] == [None, "rigid"]


@pytest.mark.slow
def test_a_strange_hand_lacks_nothing(tmp_path: Path) -> None:
    found = diagnosed(strange_set(tmp_path))
    assert found.verdict == "nothing"
    assert any("something was grasped" in note for note in found.notes)
    assert any(note.startswith("grasp_fast: fitted too") and "N.m/rad" in note for note in found.notes)


@pytest.mark.slow
def test_a_strange_hand_may_rest_off_its_open_stop(tmp_path: Path) -> None:
    """The controller sees the encoder only: where that reads too little, the wire is wound up by as much."""
    two = ("fast", "grasp_fast")
    wound = signals_of_set(effects=[offset_of(-1.6)], conditions=two, closures=4, seed=11)
    prepared = prepare(load_trials([write_set(tmp_path / "bags", wound)]), Model.load())

    def null(without: str = "") -> Fit:
        nuisances = [n for n in prepared.nuisances if n.name != without]
        return Search(prepared.problem, prepared.model, nuisances, {}).null().fit

    def friction_off(found: Fit) -> float:
        return max(abs(found.point["friction.coulomb"]), abs(found.point["hand.coulomb"]))

    fitted = null()
    # One tolerance of the spring's preload pulls as 0.36 rad of travel do.
    assert fitted.values["encoder.homing"] == pytest.approx(1.6, abs=0.36)
    assert friction_off(fitted) < 2.5 < 4.0 < friction_off(null(without="encoder.homing"))
    held = [
        w for w in calibrate(prepared, ["friction.coulomb"], starts=1).warnings if "hold the tolerances" in w
    ]
    assert held and "homing" not in held[0], (
        "what the recordings do not tell is fitted beside what is calibrated"
    )
    (said,) = (
        note for note in diagnose(prepared, effect_sources(only=["gravity"])).notes if "do not tell" in note
    )
    assert "encoder.homing" in said and "control.kp" in said


def test_where_an_object_is_does_not_depend_on_the_homing(tmp_path: Path) -> None:
    """Its place is what the encoder shows there: else a fit that moves the homing loses the object."""
    prepared = prepare(strange_set(tmp_path, names=("fast", "grasp")), Model.load())
    trial = next(t for t in prepared.rig.trials if t.name == "grasp")
    rig, values = prepared.rig, {n.name: n.mean for n in prepared.nuisances}

    def touched(homing: float) -> float:
        run = rig.run(prepared.model, {**values, "encoder.homing": homing}, trial, trial.reference)
        return float(run.encoder_position[np.argmax(run.grip_force > 0.0)])

    places = [touched(homing) for homing in (0.0, 1.0, 2.0)]
    assert np.ptp(places) < 0.05 and places[0] == pytest.approx(values["object.position@grasp"], abs=0.1)


def test_a_fit_of_a_hand_off_its_stop_is_led_back_to_one_on_it(tmp_path: Path) -> None:
    prepared = prepare(strange_set(tmp_path), Model.load())
    search = Search(prepared.problem, prepared.model, prepared.nuisances, {})
    begin = {"encoder.homing": 3.0, "hand.preload": -6.0}
    off = fit(search.problem, search.model, search.coordinates, begin)
    back = search._led_back(off)
    assert off.values["encoder.homing"] > 1.5, "the fit comes back by itself, and shows nothing"
    assert back.values["encoder.homing"] < 0.5 and back.cost < 0.9 * off.cost


@pytest.mark.slow
def test_an_effect_is_found_on_a_strange_hand(tmp_path: Path) -> None:
    found = diagnosed(strange_set(tmp_path, "viscous_friction"))
    assert found.verdict == "effects" and [e.name for e in found.effects] == ["viscous_friction"]
    p = found.effects[0].parameters["coefficient"]
    assert p.value == pytest.approx(0.001, rel=0.25)
    assert found.ranking[0].names == ("viscous_friction",) and found.ranking[0].explained > 0.9


def test_compare_fits_a_strange_hand_as_a_diagnosis_does(tmp_path: Path) -> None:
    """From the nominal values alone a fit may end in a minimum of its own, worse than the model as it is."""
    conditions = signals_of_set(
        model=Model.load().with_values(STRANGE), conditions=("fast",), closures=4, seed=11
    )
    prepared = prepare(load_trials([write_set(tmp_path / "bags", conditions, late)]), Model.load())
    starts = wide_starts([nuisance_coordinate(n) for n in prepared.nuisances])
    assert len(starts) > 1, "little is known of it"
    texts = set[str]()
    fitted = compare(prepared, fitted=True, progress=lambda done, total, text: texts.add(f"{text} {total}"))
    assert f"nominal: fit {len(starts)}" in texts
    null = Search(prepared.problem, prepared.model, prepared.nuisances, {}).null().fit
    expected = prepared.features.closures(prepared.rig, prepared.model, null.values)
    assert fitted.overall == overall(signal_errors(prepared.features, expected))
    plain = compare(prepared)
    assert fitted.overall < plain.overall
    said = "the recordings do not tell control.kp, control.damping"
    assert any(note.startswith(said) and "--fitted" in note for note in plain.notes)
    assert not any(note.startswith(said) for note in fitted.notes)


@pytest.mark.slow
def test_the_damping_of_an_object_that_nobody_described_is_an_effect_where_it_is_large(
    tmp_path: Path,
    executor: Executor,
) -> None:
    """As a parameter of the recording it charges less than an effect must gain."""
    damping = load_effect("object_damping").entry({"coefficient": 0.02})
    two = ("fast", "grasp_soft")
    conditions = signals_of_set(effects=[damping], conditions=two, closures=4, seed=11)
    prepared = prepare(load_trials([write_set(tmp_path / "bags", conditions)]), Model.load())
    own = [n for n in prepared.nuisances if n.effect]
    assert [n.name for n in own] == ["object.damping@grasp_soft"]

    found = diagnose(
        prepared,
        effect_sources(only=["object_damping", "viscous_friction"]),
        max_effects=1,
        executor=executor,
    )
    assert found.verdict == "effects" and [e.name for e in found.effects] == ["object_damping"]
    assert found.effects[0].parameters["coefficient"].value == pytest.approx(0.02, rel=0.25)
    assert own[0].name not in found.nuisances
    assert any(f"{own[0].name} would do the same" in note for note in found.notes)
    other = diagnose(prepared, effect_sources(only=["viscous_friction"]), max_effects=1, executor=executor)
    assert other.verdict == "nothing", "no effect of that name is considered"
    assert other.nuisances[own[0].name]["value"] == pytest.approx(0.02, rel=0.5), "taken over"


def test_a_damping_that_may_be_the_objects_own_is_pointed_at() -> None:
    """From far off on it is named; below, the recordings cannot tell, but who knows the object can."""
    own = Nuisance("object.damping@ball", 7e-5, 1.5, True, 0.0, "N.m.s/rad", effect="object_damping")
    coordinate = nuisance_coordinate(own)

    def said(
        z: float, names: tuple[str, ...] = (), sources: Sequence[str] = ("object_damping",)
    ) -> list[str]:
        found = Fit(Model.load(), (coordinate,), np.array([z]), 0.0, np.zeros(1), np.zeros((1, 1)))
        search: Any = SimpleNamespace(nuisances=[own], sources=dict.fromkeys(sources, ""))
        return _taken_for_its_own(search, Candidate(names, found, 0.0))

    (note,) = said(2.5)
    assert (
        note.startswith("ball: object.damping is fitted at 43 times the nominal")
        and "object_damping is missing" in note
    )
    assert not (said(1.0) or said(3.5) or said(2.5, names=("object_damping",)) or said(2.5, sources=()))


@pytest.mark.slow
def test_a_slack_is_found_on_a_hand_of_half_the_friction(tmp_path: Path) -> None:
    """The fit without it goes far off: six tolerances in the spring's preload."""
    light = {"friction.coulomb": 0.012, "hand.coulomb": 0.005, "wire.stiffness": 5.0}
    light |= {"control.kp": 0.36, "control.damping": 0.02}
    slack = load_effect("wire_slack").entry({"slack": 1.0})
    conditions = signals_of_set(
        model=Model.load().with_values(light),
        effects=[slack],
        conditions=("fast", "grasp"),
        closures=4,
        seed=11,
        sensors="bench",
    )
    found = diagnosed(load_trials([write_set(tmp_path / "bags", conditions)]))
    assert found.verdict == "effects" and [e.name for e in found.effects] == ["wire_slack"]
    assert found.effects[0].parameters["slack"].value == pytest.approx(1.0, abs=0.3)


def signed(q: np.ndarray, current: np.ndarray) -> Curve:
    """The curve of a logger that keeps the current's sign."""
    return Curve(q, current, current)


def test_a_slow_closure_on_nothing_is_no_grasp_where_the_fast_one_brakes() -> None:
    """The fast hand's current falls before it arrives; the slow one's does not rise."""
    q = np.linspace(2.5, 12.5, 200)
    slow, braking = np.full(q.size, 0.26), np.interp(q, [9.5, 11.0], [0.30, -0.05])
    gripping = np.interp(q, [9.5, 11.0], [0.26, 0.80])
    nominal = (0.044, 0.0015, 0.21)
    assert _seen(signed(q, slow), [signed(q, braking)], nominal) is None
    assert _seen(signed(q, gripping), [signed(q, braking)], nominal) is not None
    assert _seen(signed(q, gripping), [signed(q, slow)], nominal) is not None


def test_a_quick_start_is_no_part_of_the_grasp() -> None:
    """A fast closure takes more current from the start on; where the object is begins later."""
    q = np.linspace(2.5, 12.5, 200)
    free = np.full(q.size, 0.15)
    pressing = np.interp(q, [2.5, 5.0, 7.5, 12.0], [0.45, 0.20, 0.18, 0.50])
    seen = _seen(signed(q, pressing), [signed(q, free)], (0.044, 0.0015, 0.21))
    assert seen is not None
    stiffness, place = seen
    assert place == pytest.approx(7.2, abs=0.5) and stiffness == pytest.approx(0.21 * 0.32 / 4.5, rel=0.1)


def test_the_crest_of_a_ripple_is_no_object() -> None:
    """Beside a closure that brakes and so needs little, a ripple of the drive stands out at the end of the way."""
    q = np.linspace(2.5, 12.5, 200)
    slow = 0.22 + 0.003 * q + 0.05 * np.sin(19.0 * q)
    braking = np.interp(q, [2.5, 4.0, 12.5], [0.38, 0.16, 0.12])
    nominal = (0.02, 0.001, 0.21)
    assert _seen(signed(q, slow), [signed(q, braking)], nominal) is None
    seen = _seen(
        signed(q, slow + 0.08 * np.maximum(q - 8.0, 0.0)), [signed(q, braking), signed(q, slow)], nominal
    )
    assert seen is not None and seen[0] == pytest.approx(0.21 * 0.08, rel=0.5) and 7.0 < seen[1] < 9.5


def test_what_the_hand_goes_on_through_is_no_object() -> None:
    """A spike of the current, of a loop that a busy machine disturbed, rises as a rigid object does."""
    q = np.linspace(2.8, 14.0, 400)
    spike = np.interp(q, [7.8, 8.0, 8.2], [0.0, 1.5, 0.0])
    nominal = (0.035, 0.0015, 0.21)
    assert _seen(signed(q, 0.25 + spike), [], nominal) is None
    gripped = q < 8.0
    seen = _seen(signed(q[gripped], (0.25 + spike)[gripped]), [], nominal)
    assert seen is not None and seen[1] == pytest.approx(7.8, abs=0.1)


def test_a_free_hand_takes_about_what_the_nominal_one_does() -> None:
    """A quick closure that brakes for most of its way says little of what moves a slow one."""
    q = np.linspace(2.5, 12.5, 200)
    slow = 0.17 + 0.03 * np.maximum(q - 8.0, 0.0)
    braking = np.interp(q, [2.5, 5.0, 12.5], [0.57, 0.12, 0.10])
    assert _seen(signed(q, slow), [signed(q, braking)], (0.035, 0.0015, 0.21)) is None


def test_what_brakes_a_hand_is_no_object_where_the_current_has_no_sign() -> None:
    """At the end of a quick way, beyond where others come, an object or the motor may brake it."""
    q = np.linspace(2.5, 13.4, 200)
    free, braked = np.full(q.size, 0.25), np.interp(q, [10.5, 13.4], [0.25, 0.9])
    shorter = Curve(q[:170], free[:170], free[:170])
    nominal = (0.044, 0.0015, 0.21)
    assert _seen(Curve(q, free, braked), [shorter], nominal) is None
    assert _seen(signed(q, braked), [shorter], nominal) is not None
    assert _seen(Curve(q, free, braked), [signed(q, free)], nominal) is not None, (
        "another came as far without"
    )


def closing(name: str, position: list[tuple[float, float]], current: list[tuple[float, float]]) -> Trial:
    """A recording of one closure: position by time, rounded over 0.2 s; current by time, without what inertia takes."""
    value = Model.load().parameters.value
    time = np.arange(0.0, 4.0, 0.005)
    moved, still = (np.interp(time, *np.transpose(points)) for points in (position, current))
    window = np.hanning(41)
    moved = np.convolve(np.pad(moved, 20, mode="edge"), window / window.sum(), "valid")
    velocity = np.gradient(moved, time)
    inertia = value("motor.armature") * value("gear.ratio") ** 2 + value("hand.inertia")
    torque = inertia * np.gradient(velocity, time) + value("friction.viscous") * velocity
    per_ampere = value("motor.kt") * value("gear.ratio") * value("gear.efficiency")
    signals = {"encoder_position": (time, moved), "motor_current": (time, still + torque / per_ampere)}
    reference = np.interp(np.arange(0.0, 4.0, 0.001), time, moved)
    return Trial(name, 0.001, reference, signals, (Closure(0.0, 4.0, name),))


def seen_in(trial: Trial, free: Trial) -> tuple[float, float]:
    """Place (rad) and stiffness (N/m) of the object that is seen in the first recording; there is none in the other."""
    seen, nothing = with_seen_objects([trial, free], Model.load())
    assert "object" not in nothing.options
    assert any("--object CONDITION=soft" in note for note in nothing.notes)
    assert any(f"--object {trial.name}=none" in note for note in seen.notes)
    value = Model.load().parameters.value
    grasp = seen.options["object"]
    return (value("hand.opening") - grasp["size"]) / value("hand.fingertip_travel"), grasp["stiffness"]


def test_a_user_who_relaxes_and_pulls_again_grasps_at_one_place() -> None:
    """While friction holds the hand, its current says nothing of the object."""
    way = [(0.0, 0.0), (1.2, 11.0), (2.0, 11.0), (2.2, 11.2), (2.6, 11.2), (3.6, 0.0)]
    pull = [
        (0.0, 0.2),
        (0.65, 0.2),
        (1.2, 0.55),
        (1.6, 0.3),
        (2.0, 0.55),
        (2.2, 0.6),
        (2.6, 0.3),
        (3.0, -0.1),
    ]
    none = [(0.0, 0.2), (1.2, 0.2), (1.6, 0.05), (2.0, 0.2), (2.2, 0.25), (2.6, 0.1), (3.0, -0.1)]
    place, stiffness = seen_in(closing("ball", way, pull), closing("free", way, none))
    assert place == pytest.approx(6.0, abs=0.5)
    value = Model.load().parameters.value
    ampere_per_rad = 0.35 / (11.0 * (1.2 - 0.65) / 1.2)
    per_ampere = value("motor.kt") * value("gear.ratio") * value("gear.efficiency")
    assert stiffness * value("hand.fingertip_travel") ** 2 == pytest.approx(
        ampere_per_rad * per_ampere, rel=0.15
    )


def test_a_grasp_that_is_denied_but_seen_is_said() -> None:
    way, pull = [(0.0, 0.0), (1.2, 11.0), (2.6, 11.0), (3.6, 0.0)], [(0.0, 0.2), (2.6, 0.2), (3.0, -0.1)]
    plain, free = (closing(name, way, pull) for name in ("ball", "free"))
    time, position = plain.signals["encoder_position"]
    pressed = {**plain.signals, "grip_force": (time, 15.0 * np.maximum(position - 8.0, 0.0))}
    denied = [replace(t, options={"object": "none"}) for t in (replace(plain, signals=pressed), free)]
    seen, nothing = with_seen_objects(denied, Model.load())
    assert seen.options["object"] == "none" and nothing == denied[1]
    (note,) = seen.notes
    assert "as was said" in note and "from 8." in note and "--object ball=none" in note


def test_an_encoder_that_is_logged_too_slowly_shows_no_grasp() -> None:
    way, pull = [(0.0, 0.0), (1.2, 11.0), (2.6, 11.0), (3.6, 0.0)], [(0.0, 0.2), (2.6, 0.2), (3.0, -0.1)]
    trial = closing("ball", way, pull)
    coarse = {name: (time[::100], values[::100]) for name, (time, values) in trial.signals.items()}
    (seen,) = with_seen_objects([replace(trial, signals=coarse)], Model.load())
    assert "object" not in seen.options and any("no grasp is seen" in note for note in seen.notes)


@pytest.mark.parametrize("pressed", ["object", "noise", "crosstalk"])
def test_a_dynamometer_shows_what_the_current_does_not(pressed: str) -> None:
    """15 N/rad from 8 rad on: so soft that the current of a quick closure does not stand out.

    Noise is no grip, nor is what rises with the position from its beginning on.
    """
    way, pull = [(0.0, 0.0), (1.2, 11.0), (2.6, 11.0), (3.6, 0.0)], [(0.0, 0.2), (2.6, 0.2), (3.0, -0.1)]
    plain, free = (closing(name, way, pull) for name in ("ball", "free"))
    time, position = plain.signals["encoder_position"]
    force = {"object": 15.0 * np.maximum(position - 8.0, 0.0), "crosstalk": 0.2 * position}.get(pressed, 0.0)
    force = force + 0.1 * np.random.default_rng(7).standard_normal(time.size)
    trial = replace(plain, signals={**plain.signals, "grip_force": (time, force)})
    if pressed != "object":
        assert all("object" not in t.options for t in with_seen_objects([trial, free], Model.load()))
        return
    place, stiffness = seen_in(trial, free)
    assert place == pytest.approx(8.0, abs=0.3)
    # F = k travel q at the fingertip
    value = Model.load().parameters.value
    assert stiffness * value("hand.fingertip_travel") == pytest.approx(15.0, rel=0.1)


def test_a_hand_that_hits_and_stands_has_grasped_something_hard() -> None:
    """It springs back, and the current rises while the place stays the same."""
    way = [(0.0, 0.0), (0.8, 8.8), (0.9, 8.4), (1.4, 8.79), (2.2, 8.8), (2.6, 8.81), (3.6, 0.0)]
    pull = [(0.0, 0.3), (0.75, 0.1), (1.4, 1.2), (2.6, 1.4), (3.0, -0.1)]
    free = [(0.0, 0.3), (0.75, 0.2), (2.6, 0.25), (3.0, -0.1)]
    place, stiffness = seen_in(
        closing("bar", way, pull), closing("free", [(0.0, 0.0), (1.2, 12.0), (3.6, 0.0)], free)
    )
    assert place == pytest.approx(8.8, abs=0.3)
    assert stiffness > 5e3


def test_a_hand_that_stops_a_little_elsewhere_each_time_is_simulated_once(tmp_path: Path) -> None:
    """Off its stop a hand sticks where the recorded reference, never the same twice, leaves it."""
    known = Model.load()
    rng = np.random.default_rng(5)

    def never_the_same(signals: Signals) -> Signals:
        t, v = signals["reference_position"]
        return {**signals, "reference_position": (t, v + 1.5 + 0.005 * rng.standard_normal(v.size))}

    conditions = signals_of_set(model=known, effects=[], conditions=("fast",), closures=4, seed=5)
    (trial,) = load_trials([write_set(tmp_path / "bags", conditions, never_the_same)])
    rig = HandRig([trial])
    whole = rig.run(known, {}, trial, trial.reference)
    ends = [whole.raw[round(c.stop / trial.period), R_QL] for c in trial.closures]
    moved = abs(ends[1] - ends[0]) / trial.span
    assert trial.apart < SAME and COMES_BACK < moved < rig.comes_back(known, trial)
    cut = trial.reference[: compact_end(trial)]
    assert cut.size < trial.reference.size
    assert rig.simulate(known, {}, trial, cut)["encoder_position"].size == cut.size


def test_another_hands_rotor_is_fitted_and_is_no_torque_constant(tmp_path: Path) -> None:
    """Held at the data sheet's inertia, a weaker motor would make up for a heavier rotor."""
    model = Model.load().with_values({**STRANGE, "motor.armature": 1.25e-6})
    conditions = signals_of_set(model=model, conditions=("slow", "fast"), closures=4, seed=12)
    prepared = prepare(load_trials([write_set(tmp_path / "bags", conditions, late)]), Model.load())
    fit = Search(prepared.problem, prepared.model, prepared.nuisances, {}).null().fit
    assert fit.values["motor.armature"] == pytest.approx(1.25e-6, rel=0.06)
    described, _ = make_set(Model.load(), [], seed=12, closures=2, conditions=("slow",))
    known = prepare([make_trial(one) for one in described], Model.load())
    assert "motor.armature" not in {n.name for n in known.nuisances}


def test_the_model_as_it_is_is_fitted_from_several_starts_where_little_is_known(tmp_path: Path) -> None:
    """The misfit of a closed loop of unknown gains has several minima; the fit must not end in a high one."""
    prepared = prepare(strange_set(tmp_path, "gear_backlash"), Model.load())
    search = Search(prepared.problem, prepared.model, prepared.nuisances, {})
    starts = wide_starts(search.coordinates)
    wide = set(starts[2])
    assert starts[:2] == [{}, {"encoder.homing": 1.0}]
    assert len(starts) > 4 and all(set(one) == wide for one in starts[2:])
    assert {"control.kp", "wire.stiffness"} <= wide and not wide & {"motor.kt", "friction.coulomb"}
    costs = [search.begun_at(start).cost for start in starts]
    assert max(costs) > 1.03 * min(costs), "these data have one minimum, and show nothing"
    assert search.null().fit.cost <= min(costs)


def test_where_all_is_described_the_fit_has_one_start() -> None:
    made, _ = make_set(Model.load(), [], seed=11, closures=2, conditions=("slow",))
    prepared = prepare([make_trial(one) for one in made], Model.load())
    assert wide_starts([nuisance_coordinate(n) for n in prepared.nuisances]) == [{}]


def test_one_hand_whose_zero_is_elsewhere_in_each_recording_explains_nothing(tmp_path: Path) -> None:
    prepared = prepare(strange_set(tmp_path, names=("slow", "fast", "grasp")), Model.load())
    sources = effect_sources(only=FEW, model=prepared.model)
    search = Search(prepared.problem, prepared.model, prepared.nuisances, sources, executor=Executor(1))
    null = search.null()
    limits = chance(search.problem, null.fit, search.signatures(null))
    zeros = [k for k, c in enumerate(null.fit.coordinates) if c.name.startswith("encoder.zero@")]

    def moved(by: list[float]) -> Candidate:
        z = null.fit.z.copy()
        z[zeros] += by
        return replace(null, fit=replace(null.fit, z=z))

    assert len(zeros) == 3 and is_adequate(search, null, limits)
    assert is_adequate(search, moved([15.0, 15.0, 15.0]), limits)
    assert not is_adequate(search, moved([0.0, 0.0, 15.0]), limits)
    assert not is_adequate(search, moved([0.0, 0.0, 7.5]), limits), "five from their mean"
    said = shortfall(search, moved([0.0, 0.0, 15.0]), limits)
    assert said == "encoder.zero differs between recordings of one machine by 10 times its tolerance"


def test_a_set_that_needs_a_hand_far_outside_the_tolerances_explains_nothing(tmp_path: Path) -> None:
    """The misfit of a thousand samples hides what the prior says of one parameter."""
    prepared = prepare(strange_set(tmp_path), Model.load())
    search = Search(prepared.problem, prepared.model, prepared.nuisances, {})
    null = search.null()
    limits = chance(search.problem, null.fit, {})

    def at(name: str, off: float) -> Candidate:
        names = [c.name for c in null.fit.coordinates]
        z = null.fit.z.copy()
        z[names.index(name)] = off
        return replace(null, fit=replace(null.fit, z=z))

    assert is_adequate(search, at("friction.coulomb", -7.5), limits)
    assert not is_adequate(search, at("friction.coulomb", -9.0), limits)
    said = shortfall(search, at("friction.coulomb", -9.0), limits)
    assert said.startswith("friction.coulomb would be ") and "9 times its tolerance off" in said, said
    assert "calibrate" in said
    assert is_adequate(search, at("control.current_kp", 9.0), limits), "of this nothing is known beforehand"


@pytest.mark.slow
def test_an_outer_loop_that_integrates_is_seen_and_is_no_effect(tmp_path: Path) -> None:
    conditions = signals_of_set(
        model=Model.load().with_values({**STRANGE, "control.ki": 0.4}),
        conditions=("slow", "grasp_fast"),
        closures=4,
        seed=11,
    )
    trials = load_trials([write_set(tmp_path / "bags", conditions, late)])
    loop = outer_loop(trials)
    assert loop is not None and loop.ki == pytest.approx(0.4, rel=0.3)
    found = diagnose(prepare(trials, Model.load()), effect_sources(only=["viscous_friction"]), max_effects=1)
    assert found.values["control.ki"] == pytest.approx(0.4, rel=0.1)
    assert found.verdict == "nothing"
