"""The lab on another machine: an adapter outside the packages, a mass in the loop of its own controller."""

import itertools
import json
import pickle
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hannes_bringup.cli import main
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.units import linear_unit
from hannes_lab import trials
from hannes_lab.chance import chance
from hannes_lab.closures import find_moves
from hannes_lab.compare import Comparison, compare
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.diagnosis import Fall
from hannes_lab.executor import Executor
from hannes_lab.falls import error_falls
from hannes_lab.features import compact_end
from hannes_lab.fit import Fit, finite_differences, fit, prior_weights
from hannes_lab.forces import Forces, scaling
from hannes_lab.greedy import _judge, _left_open, _polish_in_worker, as_good, to_judge
from hannes_lab.intervals import intervals_of
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.problem import effect_coordinates
from hannes_lab.rig import Nuisance, load_rig, scaled_effect, unit_factor
from hannes_lab.screen import usable_effects
from hannes_lab.search import Candidate, Search
from hannes_lab.spectrum import position_periods
from hannes_lab.trials import SAME, Closure, Trial
from hannes_sim.effect import EffectParameter, catalogue, load_effect
from hannes_sim.factory import make_plant
from hannes_sim.rollout import rollout
from lab.single_mass_rig import reference, write_files

ADAPTER = f"{Path(__file__).parent / 'single_mass_rig.py'}:SingleMass"
CONSIDERED = [
    "coulomb_friction",
    "stribeck_friction",
    "cogging",
    "direction_dependent_friction",
    "command_delay",
]
PERIOD = 2.5e-3  # m, of the hidden ripple


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mass of 2.1 kg with dry friction and a ripple of 2.5 mm, recorded with noise."""
    folder = tmp_path_factory.mktemp("mass")
    write_files(folder)
    rig = load_rig(ADAPTER)
    model = Model.load(folder / "mass.yaml").with_values({"motor.armature": 2.1, "friction.viscous": 5.0})
    sizes = tuple(sorted(rig.sizes.items()))
    model = model.with_effect(
        scaled_effect(load_effect("coulomb_friction"), sizes, True).entry({"level": 1.2})
    )
    ripple = {"sine": 0.3, "cosine": 0.2, "period": PERIOD}
    model = model.with_effect(scaled_effect(load_effect("cogging"), sizes, True).entry(ripple))
    machine = rig([])
    run = rollout(make_plant(model), machine.controller(model, 1e-3), reference())
    rng = np.random.default_rng(3)
    path = folder / "mass.npz"
    position = run.encoder_position + 2e-7 * rng.standard_normal(run.time.size)
    force = run.motor_voltage + 0.02 * rng.standard_normal(run.time.size)
    np.savez(path, reference=run.reference_position, position=position, force=force)
    return path


@pytest.fixture(scope="module")
def prepared(recording: Path) -> Prepared:
    rig = load_rig(ADAPTER)
    return prepare(rig.read([recording]), Model.load(recording.parent / "mass.yaml"), rig=rig)


def test_moves_are_the_stretches_between_standstills() -> None:
    spans = find_moves(reference(2), 1e-3)
    assert len(spans) == 10
    assert [round(b - a, 1) for a, b in spans[:4]] == [0.4, 0.5, 0.6, 0.4]


def test_adapters_that_were_written_for_the_first_pages_are_imported() -> None:
    assert trials.find_moves is find_moves
    with pytest.raises(ImportError, match="find_no_moves"):
        exec("from hannes_lab.trials import find_no_moves")


def test_moves_after_stands_of_other_lengths_begin_alike() -> None:
    u = np.linspace(0.0, 1.0, 1000)
    up = 0.6 * (u - np.sin(2 * np.pi * u) / (2 * np.pi))
    stands = [np.full(n, 0.6 * (k % 2)) for k, n in enumerate((300, 1200, 1000, 1500, 4000))]
    ways = [up, up[::-1], up, up[::-1], np.zeros(0)]
    path = np.concatenate([part for pair in zip(stands, ways, strict=True) for part in pair])
    spans = find_moves(path, 1e-3)
    assert len(spans) == 4
    leaves = np.cumsum([0.3, 2.2, 2.0, 2.5])
    assert [a for a, _ in spans] == pytest.approx(list(leaves - 0.3), abs=0.005)
    assert [b - a for a, b in spans] == pytest.approx([2.2, 2.0, 2.5, 2.2], abs=0.005)


def test_a_stand_with_rounding_errors_is_one_stand() -> None:
    path = np.concatenate([np.full(500, 0.0), reference(2), np.full(500, 0.0)])
    noisy = path + 1e-14 * np.random.default_rng(0).standard_normal(path.size)
    assert np.array(find_moves(noisy, 1e-3)) == pytest.approx(np.array(find_moves(path, 1e-3)), abs=1e-9)


@pytest.mark.parametrize("lap", [2.0, 2.00037, 2.0005])
def test_laps_of_no_whole_number_of_periods_begin_at_the_same_moment(lap: float) -> None:
    """Half a period is 50 um at this speed; what repeats to the bit must not scatter by it."""
    time = np.arange(round(8 * lap * 1e3)) * 1e-3
    path = 0.05 * (1.0 - np.cos(2.0 * np.pi * time / lap))
    moves = [
        Closure(a, b, "up" if k % 2 else "down") for k, (a, b) in enumerate(find_moves(path, 1e-3), start=1)
    ]
    trial = Trial("laps", 1e-3, path, {"encoder_position": (time, path)}, tuple(moves))

    def scatter(one: Trial) -> float:
        shortest = min(c.stop - c.start for c in one.closures)
        phase = np.arange(0.01, shortest - 0.01, 1e-3)
        curves = [[np.interp(c.start + phase, time, path) for c in one.of(name)] for name in one.conditions]
        return max(float(np.std(own, axis=0).max()) for own in curves)

    assert scatter(trial.aligned()) < 1e-7
    if lap == 2.0:
        assert trial.aligned() is trial
    else:
        assert scatter(trial) > 2e-5, "these laps show nothing"


def test_laps_that_begin_a_part_of_a_period_later_are_no_copies_of_one_another(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half a period is 80 um in the middle of these moves, of which the machine itself repeats to 2."""
    lap, noise = 2.00037, 2e-6
    time = np.arange(round(8 * lap * 1e3)) * 1e-3
    turn = np.mod(time, lap) / lap

    def way(u: np.ndarray) -> np.ndarray:
        u = np.clip(u, 0.0, 1.0)
        return u - np.sin(2.0 * np.pi * u) / (2.0 * np.pi)

    path = 0.1 * (way((turn - 0.1) / 0.3) - way((turn - 0.6) / 0.3))
    model, rig = Model.load(recording.parent / "mass.yaml"), load_rig(ADAPTER)
    monkeypatch.setattr(rig, "population", recording.parent / "tolerances.yaml")
    run = rollout(make_plant(model), rig([]).controller(model, 1e-3), path)
    position = run.encoder_position + noise * np.random.default_rng(0).standard_normal(time.size)
    moves = [
        Closure(a, b, "up" if path[round(b / 1e-3)] > 0.05 else "down") for a, b in find_moves(path, 1e-3)
    ]
    trial = Trial(
        "laps",
        1e-3,
        path,
        {"encoder_position": (time, position)},
        tuple(moves),
        units={"encoder_position": "m"},
    )

    def error() -> float:
        return compare(prepare([trial], model, rig=rig)).overall

    assert error() < 1.2
    monkeypatch.setattr(rig, "same", SAME)
    assert error() > 3.0, "these laps show nothing"


def test_a_factor_on_all_forces_is_told_by_the_tolerances_alone(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A force constant beside mass and friction: what drives them is known in the constant's units only."""
    (tmp_path / "tolerances.yaml").write_text(
        "motor.kt: {sd: 0.02, closure_sd: 0.0, unit: '1', source: test}\n"
        "motor.armature: {sd: 0.1, closure_sd: 0.0, unit: '1', source: test}\n"
        "friction.viscous: {sd: 0.4, closure_sd: 0.0, unit: '1', source: test}\n"
    )
    rig, model = load_rig(ADAPTER), Model.load(recording.parent / "mass.yaml")
    trials = rig.read([recording])
    monkeypatch.setattr(rig, "population", tmp_path / "tolerances.yaml")
    prepared = prepare(trials, model, rig=rig)
    sources = effect_sources(only=["coulomb_friction", "cogging"], model=model)
    search = Search(prepared.problem, prepared.model, prepared.nuisances, sources)
    found = search.polish(search.fitted(["coulomb_friction"]))
    priors = prior_weights(found.fit.coordinates)
    forces = Forces(found.fit.coordinates, found.fit.z, scaling(search.problem, found.fit.model))
    names = [c.name for c in found.fit.coordinates]
    assert {names[j] for j in forces.powers} == {
        *("motor.kt", "motor.armature", "friction.viscous", "coulomb_friction.level")
    }
    best = forces.scaled(forces.likeliest(priors))
    assert (
        float((priors * found.fit.z) @ (priors * found.fit.z))
        <= float((priors * best) @ (priors * best)) + 0.2
    ), "the priors would like another factor better"
    wide = search.with_spread(found).fit
    # Mass, friction and constant have 10, 40 and 2 %: together they know the factor to 1.96 %.
    half = 1.96 * wide.sd()[names.index("motor.kt")]
    assert half == pytest.approx(1.96, rel=0.05)
    blurred = replace(
        wide,
        jacobian=finite_differences(
            search.problem, wide.model, wide.coordinates, wide.z, wide.residual, range(len(names)), {}
        ),
    )
    told, said = (float(np.linalg.norm(f.jacobian @ forces.direction())) for f in (wide, blurred))
    by_tolerances = float(np.linalg.norm(priors * forces.direction()))
    assert told < 0.3 * by_tolerances < said


def in_volts(
    folder: Path, monkeypatch: pytest.MonkeyPatch, sds: dict[str, float], truth: dict[str, float]
) -> tuple[Prepared, Model]:
    """The mass on a motor that voltage drives, without a current: tolerances by name, and what made the data."""
    write_files(folder)
    tolerance = "{}: {{sd: {}, closure_sd: 0.0, unit: '1', source: test}}\n"
    (folder / "tolerances.yaml").write_text("".join(tolerance.format(n, sd) for n, sd in sds.items()))
    parameter = "{{value: {}, unit: {}, lower: {}, upper: {}, status: assumed, source: test}}"
    (folder / "parameters.yaml").write_text(
        f"supply: {{voltage: {parameter.format(50.0, 'V', 1.0, 100.0)}}}\n"
        f"motor:\n  resistance: {parameter.format(4.0, 'ohm', 0.5, 40.0)}\n"
        f"  kt: {parameter.format(5.0, 'N/A', 1.0, 20.0)}\n  armature: {parameter.format(2.0, 'kg', 0.2, 20.0)}\n"
        f"friction:\n  viscous: {parameter.format(4.0, 'N.s/m', 0.0, 50.0)}\n"
        f"  coulomb: {parameter.format(3.0, 'N', 0.0, 30.0)}\n"
    )
    rig, model = load_rig(ADAPTER), Model.load(folder / "mass.yaml")
    path = reference(3)
    run = rollout(make_plant(model.with_values(truth)), rig([]).controller(model, 1e-3), path)
    moves = [
        Closure(a, b, f"{path[round(a / 1e-3)]:.2f} to {path[round(b / 1e-3)]:.2f}")
        for a, b in find_moves(path, 1e-3)
    ]
    noise = 2e-6 * np.random.default_rng(2).standard_normal((2, path.size))
    signals = {
        "encoder_position": (run.time, run.encoder_position + noise[0]),
        "drive_force": (run.time, run.motor_voltage + noise[1]),
    }
    units = {"encoder_position": "m", "drive_force": "V"}
    monkeypatch.setattr(rig, "population", folder / "tolerances.yaml")
    return prepare([Trial("mass", 1e-3, path, signals, tuple(moves), units=units)], model, rig=rig), model


def test_without_a_current_a_resistance_is_known_as_well_as_all_forces_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a drive in volts: half the resistance moves twice the mass against twice the friction just so."""
    sds = {"motor.resistance": 0.2, "motor.armature": 0.2, "friction.viscous": 0.5, "friction.coulomb": 0.3}
    truth = {"motor.resistance": 4.6}
    prepared, model = in_volts(tmp_path, monkeypatch, {"motor.kt": 0.05, **sds}, truth)
    (trial,) = prepared.features.trials
    problem = prepared.problem
    assert scaling(problem, model)["ohm"] == -1.0
    in_amperes = replace(trial, units={**trial.units, "drive_force": "A"})
    told = replace(
        prepared.features,
        trials=(in_amperes,),
        blocks=tuple(
            replace(b, unit="A") if b.signal == "drive_force" else b for b in prepared.features.blocks
        ),
    )
    assert scaling(replace(problem, features=told), model) == {}

    search = Search(problem, model, prepared.nuisances, effect_sources(only=["cogging"], model=model))
    found = search.null()
    wide = search.with_spread(found).fit
    names = [c.name for c in wide.coordinates]
    together = sum(sd**-2 for sd in sds.values()) ** -0.5
    at = names.index("motor.resistance")
    value = wide.values["motor.resistance"]
    sd = wide.sd()[at] * abs(wide.coordinates[at].value(wide.z[at] + 1.0) - value) / value
    assert 0.6 * together < sd < 1.3 * together
    blurred = replace(
        wide,
        jacobian=finite_differences(
            problem, wide.model, wide.coordinates, wide.z, wide.residual, range(len(names)), {}
        ),
    )
    assert blurred.sd()[at] < 0.5 * wide.sd()[at]


def test_without_a_current_a_torque_constant_is_known_with_all_forces_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Resistance known, no current: half the constant, mass and friction, with what viscous friction the back-EMF then
    leaves, move just so.  An interval that is the data's alone would be a hundredth as wide."""
    sds = {"motor.kt": 0.4, "motor.armature": 0.8, "friction.viscous": 1.0, "friction.coulomb": 1.0}
    kt, resistance, part = 5.0, 4.0, 0.7
    truth = {
        "motor.kt": part * kt,
        "motor.armature": part * 2.0,
        "friction.coulomb": part * 3.0,
        "friction.viscous": part * (4.0 + kt**2 / resistance) - (part * kt) ** 2 / resistance,
    }
    prepared, model = in_volts(tmp_path, monkeypatch, sds, truth)
    search = Search(
        prepared.problem, model, prepared.nuisances, effect_sources(only=["cogging"], model=model)
    )
    found = search.with_spread(search.null())
    limits = chance(search.problem, found.fit, search.signatures(found))
    assert found.fit.cost < limits.misfit
    wide = intervals_of(found.fit, limits)
    for name in ("motor.kt", "motor.armature", "friction.coulomb"):
        low, high = wide[name]
        assert low < truth[name] < high and high > 1.5 * low, name
    forces = {n: found.fit.values[n] / truth[n] for n in ("motor.kt", "motor.armature", "friction.coulomb")}
    assert max(forces.values()) < 1.05 * min(forces.values()), "they are known up to a factor"


def test_what_is_no_shift_in_time_is_left_where_it_is() -> None:
    time = np.arange(8000) * 1e-3
    ever_more = 1.0 + 0.01 * np.floor(time / 2.0)
    path = 0.05 * ever_more * (1.0 - np.cos(np.pi * time))
    laps = tuple(Closure(2.0 * k, 2.0 * k + 2.0, "lap") for k in range(4))
    trial = Trial("laps", 1e-3, path, {"encoder_position": (time, path)}, laps)
    assert trial.aligned() is trial


@pytest.mark.parametrize("digits", [5, 4, 3])
def test_moves_of_a_reference_of_few_digits(digits: int) -> None:
    exact = find_moves(reference(2), 1e-3)
    path = reference(2)
    rounded = find_moves(np.round(path / np.ptp(path), digits), 1e-3)
    assert len(rounded) == len(exact)
    assert np.array(rounded) == pytest.approx(np.array(exact), abs=0.03)


def test_effects_without_a_meaning_are_not_offered(prepared: Prepared) -> None:
    usable = usable_effects(prepared, effect_sources(model=prepared.model))
    assert {"coulomb_friction", "cogging", "presliding_friction"} <= set(usable.sources)
    assert not {"wire_slack", "wire_elasticity", "object_damping", "current_sensor", "gravity"} & set(
        usable.sources
    )
    assert any("gravity" in note and "horizontal" in note for note in usable.notes)
    assert any("wire_slack" in note and "move none" in note for note in usable.notes)


def test_what_compares_the_directions_is_not_offered_to_a_machine_that_goes_one_way(
    prepared: Prepared, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = effect_sources(only=["direction_dependent_friction", "coulomb_friction"])
    assert set(usable_effects(prepared, sources).sources) == set(sources)
    monkeypatch.setattr("hannes_lab.screen.never_turns", lambda trials: True)
    usable = usable_effects(prepared, sources)
    assert set(usable.sources) == {"coulomb_friction"}
    assert "direction_dependent_friction is not considered: every condition goes the same way" in usable.notes


def test_of_a_ripple_that_the_model_has_no_second_one_is_looked_for_and_that_is_said(
    prepared: Prepared,
) -> None:
    model = prepared.model.with_effect(load_effect("cogging").entry())
    usable = usable_effects(
        replace(prepared, model=model), effect_sources(only=["coulomb_friction"], model=model)
    )
    assert usable.notes[0].startswith("cogging is in the model already: a second one")


def test_an_effect_that_acts_on_another_is_offered(prepared: Prepared) -> None:
    """The model has no dry friction of which there could be less at rest, but it may get some."""
    sources = effect_sources(only=["velocity_strengthening", "coulomb_friction"])
    assert set(usable_effects(prepared, sources).sources) == set(sources)
    alone = usable_effects(prepared, effect_sources(only=["velocity_strengthening"]))
    assert not alone.sources and "velocity_strengthening would move none" in alone.notes[0]
    assert alone.notes[0].endswith("on this machine and is not considered")


def test_a_ripple_is_seen_in_the_spectrum_over_the_position(prepared: Prepared) -> None:
    from hannes_lab.search import Search

    search = Search(
        prepared.problem, prepared.model, prepared.nuisances, {"coulomb_friction": "coulomb_friction"}
    )
    best = search.add(search.null(), "coulomb_friction")
    periods = position_periods(prepared.problem, best.fit, 1e-3, 0.1)
    assert periods and periods[0] == pytest.approx(PERIOD, rel=0.02)


def test_what_only_scales_with_all_else_is_led_back_to_its_tolerance(prepared: Prepared) -> None:
    """The command does not tell the force constant from mass and friction: only its tolerance does."""
    kt = Nuisance("motor.kt", 1.0, 0.03, False, unit="N/V", lower=0.01)
    names = ("coulomb_friction", "cogging")
    search = Search(prepared.problem, prepared.model, (*prepared.nuisances, kt), {n: n for n in names})
    problem = search.problem
    near = search.fitted(names).fit
    factor = {c.name: 1.0 if c.name.endswith("period") else 1.4 for c in near.coordinates}
    z = np.array([c.z(factor[c.name] * near.values[c.name]) for c in near.coordinates])
    priors = prior_weights(near.coordinates)
    values = {c.name: c.value(float(v)) for c, v in zip(near.coordinates, z, strict=True)}
    residual = problem.residual(near.model, values)
    cost = float(residual @ residual + (priors * z) @ (priors * z))
    away = replace(near, z=z, residual=residual, cost=cost)
    at_once = fit(problem, near.model, near.coordinates, z, evaluations=1)
    assert abs(at_once.z_of("motor.kt") or 0.0) < 2.0 and at_once.cost < cost - 100.0
    assert away.z_of("motor.kt") > 10.0 and away.misfit == pytest.approx(near.misfit, rel=0.01)
    back = search.polish(Candidate(names, away, away.cost)).fit
    assert abs(back.z_of("motor.kt")) < 1.0 and back.cost < away.cost - 100.0
    for name in ("motor.armature", "coulomb_friction.level"):
        part = back.values[name] / away.values[name]
        assert part == pytest.approx(back.values["motor.kt"] / away.values["motor.kt"], rel=0.02)


@pytest.mark.slow
def test_greedy_search_finds_friction_and_ripple_and_stops(prepared: Prepared, executor: Executor) -> None:
    found = diagnose(prepared, effect_sources(only=CONSIDERED), greedy=True, max_effects=6, executor=executor)
    assert found.verdict == "effects"
    assert [e.name for e in found.effects] == ["coulomb_friction", "cogging"]
    friction, ripple = (e.parameters for e in found.effects)
    assert friction["level"].value == pytest.approx(1.2, rel=0.02) and friction["level"].unit == "N"
    assert ripple["period"].value == pytest.approx(PERIOD, rel=2e-3) and ripple["period"].unit == "m"
    assert found.model.parameters.value("motor.armature") == pytest.approx(2.1, rel=0.005)
    falls = [f.held_out_signals["drive_force"] for f in found.falls[1:]]
    assert falls == sorted(falls, reverse=True) and falls[-1] < 0.03
    assert any("stops here" in note for note in found.notes)


@pytest.mark.slow
def test_greedy_search_is_the_same_in_two_processes(prepared: Prepared) -> None:
    """A rig from a user's file travels to the workers."""
    only = ["coulomb_friction", "viscous_friction", "command_delay"]
    one, two = (
        diagnose(prepared, effect_sources(only=only), greedy=True, max_effects=1, jobs=jobs)
        for jobs in (1, 2)
    )
    assert one.values == two.values
    again = pickle.loads(pickle.dumps(prepared.rig))
    assert type(again).__name__ == "SingleMass" and again.trials[0].name == "mass"


def test_commands_take_the_adapter(
    recording: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = str(recording.parent / "mass.yaml")
    words = ["compare", str(recording), "--rig", ADAPTER, "--model", model, "--fitted", "--json"]
    monkeypatch.setattr("sys.argv", ["hannes", *words])
    try:
        assert not main()
    except SystemExit as end:
        assert not end.code
    content = json.loads(capsys.readouterr().out)
    assert {e["unit"] for e in content["errors"]} == {"m", "N"}
    assert content["metrics"] == []
    monkeypatch.setattr("sys.argv", ["hannes", *words, "--topic", "motor_current=/rig/iq"])
    assert main() == 2
    assert "--topic is for bags" in " ".join(capsys.readouterr().err.split())


def test_laps_that_repeat_each_other_are_simulated_for_two(prepared: Prepared) -> None:
    """Moves from place to place, each a condition: the second lap stands for the others, if nothing is out of turn."""
    (trial,) = prepared.rig.trials
    assert trial.in_turn and trial.repeats[:3] == (0, 1, 2) and set(trial.repeats[5:]) == set(range(5, 10))
    (end,) = prepared.features.ends
    assert end is not None and end < 0.45 * trial.reference.size
    values = {"motor.armature": 2.2}
    short = prepared.features.closures(prepared.rig, prepared.model, values)
    whole = replace(prepared.features, ends=(None,), slices=()).closures(prepared.rig, prepared.model, values)
    for block, a, b in zip(prepared.features.blocks, short, whole, strict=True):
        scatter = float((block.measured - block.measured.mean(axis=0)).std())
        assert np.abs(a - b).max() < 1e-3 * scatter, block.condition
    one_missing = trial.only([c for k, c in enumerate(trial.closures) if k != 11])
    assert not one_missing.in_turn and compact_end(one_missing) is None


def test_broken_adapters_are_clear_errors(tmp_path: Path) -> None:
    with pytest.raises(HannesError, match=r"path\.py:Class"):
        load_rig("single_mass")
    file = tmp_path / "mine.py"
    file.write_text("class Mine:\n    pass\n")
    with pytest.raises(HannesError, match="not a subclass"):
        load_rig(f"{file}:Mine")
    with pytest.raises(HannesError, match="No file"):
        load_rig(ADAPTER).read([tmp_path / "none.npz"])


def test_units_scale_by_dimension() -> None:
    sizes = {"N.m": 0.5, "rad": 1.457}  # ten times the torque over a tenth of the travel
    assert unit_factor("N.m", sizes) == pytest.approx(10.0)
    assert unit_factor("N.m.s/rad", sizes) == pytest.approx(100.0)
    assert unit_factor("rad/(N.m)", sizes) == pytest.approx(0.01)
    assert unit_factor("N.m/rad3", sizes) == pytest.approx(1e4)
    assert unit_factor("kg.m2", sizes) == pytest.approx(100.0)
    assert unit_factor("s", sizes) == unit_factor("1", sizes) == 1.0
    assert (
        linear_unit("N.m.s/rad") == "N.s/m"
        and linear_unit("rad/(N.m)") == "m/N"
        and linear_unit("kg.m2") == "kg"
    )
    drawn = type(
        "Drawn", (catalogue()["cogging"],), {"parameters": (EffectParameter("at", "rad", 0, 9, 2, sd=0.5),)}
    )
    (at,) = scaled_effect(drawn, tuple(sorted(sizes.items())), False).parameters
    assert (at.typical, at.sd) == (pytest.approx(0.2), pytest.approx(0.05))
    for effect in catalogue().values():
        for p in scaled_effect(effect, tuple(sorted(sizes.items())), False).parameters:
            assert p.lower <= p.typical <= p.upper, f"{effect.name}.{p.name}"


def test_what_the_table_shows_decides_whether_an_effect_joins(prepared: Prepared, executor: Executor) -> None:
    """The rule of --greedy, on the printed numbers: each effect takes 15 % of the mean square."""
    found = diagnose(
        prepared, effect_sources(only=["coulomb_friction", "cogging"]), greedy=True, executor=executor
    )
    errors = [fall.held_out_conditions for fall in found.falls[1:]]
    assert len(errors) == 3
    assert all(b**2 <= 0.85 * a**2 for a, b in itertools.pairwise(errors))


def test_one_mass_has_no_part_of_a_friction_beyond_a_wire(recording: Path) -> None:
    """There both parts act on the same mass: half of the coefficient, or half of it beyond a wire, are one thing."""
    rig, model = load_rig(ADAPTER), Model.load(recording.parent / "mass.yaml")
    made = prepare(rig.read([recording]), model, rig=rig).rig
    capstan = load_effect("load_dependent_friction")
    for one in (made, pickle.loads(pickle.dumps(made))):
        kind = one.effect(capstan)
        assert [p.name for p in kind.parameters] == ["coefficient"]
        assert [p.name for p in kind.figures()] == ["coefficient", "share"]
        assert kind.entry({"coefficient": 0.2}).values == {"coefficient": 0.2, "share": 0.0}
    made.one_mass = False
    assert [p.name for p in made.effect(capstan).parameters] == ["coefficient", "share"]


def test_little_explained_is_unknown(prepared: Prepared, executor: Executor) -> None:
    """A ripple beside dry friction of five times its size: alone it is no answer, though the error falls."""
    found = diagnose(
        prepared, effect_sources(only=["cogging", "command_delay"]), greedy=True, executor=executor
    )
    assert found.verdict == "unknown"
    assert "not one of those that were looked for (cogging, command_delay)" in found.summary
    assert "more than half is left" in found.summary


def test_unknown_without_greedy_says_what_else_can_be_done(prepared: Prepared, executor: Executor) -> None:
    sources = effect_sources(only=["command_delay"])
    found = diagnose(prepared, sources, greedy=False, executor=executor)
    assert found.verdict == "unknown" and any("--greedy adds effects" in note for note in found.notes)
    assert not any("--greedy adds" in note for note in diagnose(prepared, sources, executor=executor).notes)


def test_the_model_file_says_what_is_printed(prepared: Prepared, tmp_path: Path, executor: Executor) -> None:
    """Also where nothing was added: the file then holds the parameters with which the error was found."""
    found = diagnose(prepared, effect_sources(only=["coulomb_friction"]), greedy=True, executor=executor)
    (effect,) = found.effects
    (entry,) = Model.load(found.model.save(tmp_path / "mass.yaml")).effects
    level, written = effect.parameters["level"], entry.parameters["level"]
    assert written.value == level.value and written.upper > 2.0 * level.high, "its range stays what it was"
    spans = Model.load(tmp_path / "mass.yaml").provenance["intervals_95"]
    assert spans["coulomb_friction.level"] == pytest.approx((level.low, level.high), rel=1e-4)
    alone = diagnose(prepared, effect_sources(only=["gear_backlash"]), greedy=True, executor=executor)
    assert not alone.effects
    assert alone.model.parameters.value("motor.armature") == alone.values["motor.armature"] != 2.0


def test_bounds_of_a_users_own_effect_are_in_the_machines_units(prepared: Prepared) -> None:
    file = Path(__file__).parent / "outside_effect.py"
    own = load_effect(f"{file}:Worn")
    assert prepared.rig.effect(own) is own
    assert prepared.rig.effect(load_effect("coulomb_friction")).parameters[0].unit == "N"


def test_what_moves_nothing_is_not_known(prepared: Prepared) -> None:
    fit = Search(prepared.problem, prepared.model, prepared.nuisances, {}).null().fit
    free = replace(fit.coordinates[0], prior=False)
    column = np.zeros((fit.residual.size, 1))
    blind = replace(
        fit,
        coordinates=(*fit.coordinates, free),
        z=np.append(fit.z, 0.0),
        jacobian=np.hstack([fit.jacobian, column]),
    )
    twin = replace(blind, jacobian=np.hstack([fit.jacobian, fit.jacobian[:, :1]]))
    assert blind.sd()[:-1] == pytest.approx(fit.sd())
    assert blind.sd()[-1] > 100.0
    assert twin.sd()[0] > 0.5 * twin.sd()[-1] > 0.3, "only their sum is known, and the prior of one"


def test_signals_by_another_clock_than_the_reference_are_noticed_and_can_be_fitted(tmp_path: Path) -> None:
    rng, early = np.random.default_rng(5), 3
    write_files(tmp_path)
    model = Model.load(tmp_path / "mass.yaml")
    rig = load_rig(ADAPTER)
    run = rollout(make_plant(model), rig([]).controller(model, 1e-3), reference())
    noise = rng.standard_normal((2, run.time.size))
    position = (run.encoder_position + 2e-7 * noise[0])[early:]
    force = (run.motor_voltage + 0.02 * noise[1])[early:]
    path = tmp_path / "early.npz"
    np.savez(path, reference=run.reference_position[:-early], position=position, force=force)

    def found() -> Comparison:
        return compare(prepare(rig.read([path]), model, rig=rig), fitted=True)

    before = found()
    (note,) = (n for n in before.notes if "clock" in n)
    assert "signals were earlier than the reference's clock says, by 3 ms" in note
    alone = diagnose(prepare(rig.read([path]), model, rig=rig), effect_sources(only=["coulomb_friction"]))
    assert alone.verdict == "unknown"
    assert "First look at the clock: what is left looks as if the signals were earlier" in alone.summary
    tolerances = tmp_path / "tolerances.yaml"
    known = tolerances.read_text()
    tolerances.write_text(
        known + "log.reference_delay: {sd: 0.005, closure_sd: 0.0, unit: s, source: test}\n"
    )
    after = found()
    assert after.overall < 1.5 < 10.0 < before.overall and not [n for n in after.notes if "clock" in n]
    tolerances.write_text(
        known + 'log.reference_delay: {sd: 0.005, closure_sd: 0.0, unit: "1", source: test}\n'
    )
    with pytest.raises(HannesError, match="is a time in s"):
        found()


def test_an_error_as_small_as_the_machine_repeats_leaves_nothing_to_look_for(
    prepared: Prepared, monkeypatch: pytest.MonkeyPatch, executor: Executor
) -> None:
    """Of a real machine chance never explains the rest; on --greedy the error on other conditions decides."""
    sources = effect_sources(only=["coulomb_friction"])
    for module in ("choose", "greedy"):
        monkeypatch.setattr(f"hannes_lab.{module}.AS_IT_REPEATS", 1e6)
    found = diagnose(prepared, sources, executor=executor)
    assert found.verdict == "nothing" and not found.effects, "though the effect would lower it"
    assert "as close to the recordings as they repeat" in found.summary and "chance" not in found.summary
    assert any("leaves nothing to look for" in note for note in found.notes)


def test_an_effect_that_the_data_leave_open_must_take_half_of_the_error(
    prepared: Prepared, monkeypatch: pytest.MonkeyPatch, executor: Executor
) -> None:
    only = effect_sources(only=["coulomb_friction", "cogging"])
    both = diagnose(prepared, only, executor=executor)
    assert [effect.name for effect in both.effects] == ["coulomb_friction", "cogging"]
    before, after = (fall.held_out_conditions for fall in both.falls[-2:])
    monkeypatch.setattr(
        "hannes_lab.greedy._left_open",
        lambda search, c, base: "cogging.period" if c.names[-1] == "cogging" else "",
    )
    monkeypatch.setattr("hannes_lab.greedy.LEFT_OPEN", 0.9 * (after / before) ** 2)
    cut = diagnose(prepared, only, executor=executor)
    assert [effect.name for effect in cut.effects] == ["coulomb_friction"]
    assert any("for the data leave cogging.period open" in note for note in cut.notes)


def test_what_fits_as_well_as_one_that_is_judged_is_judged_too() -> None:
    costs = [100.0, 110.0, 120.0, 120.1, 120.4, 130.0]
    candidates: Any = [SimpleNamespace(penalised=cost) for cost in costs]
    none = [False] * 6
    assert [c.penalised for c in to_judge(candidates, none)] == [100.0, 110.0, 120.0, 120.1]
    same: Any = [SimpleNamespace(penalised=100.0) for _ in range(9)]
    assert len(to_judge(same, [False] * 9)) == 6
    assert to_judge(candidates[:2], none[:2]) == candidates[:2]


def test_effects_of_ones_own_are_judged_beside_the_best_of_the_catalogue() -> None:
    """Two of them that fit best, and foretold nothing, had taken the place of the one that would have joined."""
    costs = [100.0, 110.0, 120.0, 130.0, 140.0, 150.0]
    candidates: Any = [SimpleNamespace(penalised=cost) for cost in costs]
    own = [True, True, False, False, False, False]
    assert [c.penalised for c in to_judge(candidates, own)] == costs[:5]
    assert [c.penalised for c in to_judge(candidates, [False, False, False, False, True, True])] == costs[:3]
    assert to_judge(candidates, [True, True, True, True, False, False]) == candidates


def test_a_further_parameter_must_be_worth_it() -> None:
    """Presliding friction of no length to speak of is Coulomb friction; it foretold 2 % better, and came first."""
    near = 1.02
    assert as_good([1.0, 1.03], [6, 5], near) == [0, 1]
    assert as_good([1.0, 1.06], [6, 5], near) == [0]
    assert as_good([1.0, 1.03, 1.01], [6, 6, 6], near) == [0, 2]
    assert as_good([1.03, 1.0, 1.02], [5, 6, 5], near) == [1, 2], "one that is as simple is there already"
    assert as_good([float("nan"), float("nan")], [5, 6], near) == []


@pytest.mark.parametrize(("simpler", "winner"), [(9.4, 0), (9.15, 1), (9.6, 0)])
def test_a_simpler_effect_that_does_not_join_ends_no_search(
    simpler: float, winner: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An effect must lower the error of 10 to 9.22; the one with a parameter more lowers it to 9."""
    held = [9.0, simpler]
    candidates: Any = [
        SimpleNamespace(names=(f"effect {k}",), penalised=0.0, fit=SimpleNamespace(coordinates=range(6 - k)))
        for k in range(2)
    ]

    def each(function: Any, items: Any, text: str) -> list[Any]:
        polish = function is _polish_in_worker
        return [item[0] if polish else held[candidates.index(item[0])] for item in items]

    search: Any = SimpleNamespace(
        each=each,
        keep=lambda candidate: candidate,
        own=lambda name: False,
        once=lambda function, *item, text: each(function, [item], text)[0],
        effect=lambda name: SimpleNamespace(parameters=range(2 - int(name[-1]))),
    )
    monkeypatch.setattr("hannes_lab.greedy.distorted", lambda *args: False)
    monkeypatch.setattr("hannes_lab.greedy._left_open", lambda *args: "")
    found = _judge(search, candidates, "", candidates[0], 0.15, 10.0, (("position", 1.0),))
    assert found.best is candidates[winner] and found.falls(10.0)
    assert found.rivals == ((candidates[0],) if winner else ())

    held[:] = 9.0, 9.1
    for candidate in candidates:
        candidate.fit.coordinates = range(5)
    found = _judge(search, candidates, "", candidates[0], 0.15, 10.0, (("position", 1.0),))
    assert found.best is candidates[1], "of twins the one that has no parameter which is idle here"
    assert found.rivals == (candidates[0],)


@pytest.fixture
def cogging_may_be_nought(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of data that leave its strength open."""
    monkeypatch.setattr(
        "hannes_lab.diagnose._may_be_nought", lambda search, found, *_: found.names[-1] == "cogging"
    )
    monkeypatch.setattr("hannes_lab.diagnose._is_needed", lambda falls: False)


@pytest.mark.usefixtures("cogging_may_be_nought")
def test_an_effect_that_may_be_nought_at_the_end_is_left_out(prepared: Prepared, executor: Executor) -> None:
    found = diagnose(prepared, effect_sources(only=["coulomb_friction", "cogging"]), executor=executor)
    assert [effect.name for effect in found.effects] == ["coulomb_friction"] and found.verdict == "effects"
    assert found.tied == (("coulomb_friction",),) and found.falls[-1].added == "coulomb_friction"
    assert any("cogging joined too" in note for note in found.notes)
    assert [effect.name for effect in found.model.effects] == ["coulomb_friction"]


@pytest.mark.usefixtures("cogging_may_be_nought")
def test_what_is_left_of_a_pair_is_judged_by_itself(
    prepared: Prepared, monkeypatch: pytest.MonkeyPatch, executor: Executor
) -> None:
    """Of a pair one may be nought at its end: then the other one must have lowered the error without it."""
    monkeypatch.setattr("hannes_lab.diagnose.EACH_TAKES", 0.9999)
    found = diagnose(prepared, effect_sources(only=["coulomb_friction", "cogging"]), executor=executor)
    assert found.verdict == "unknown" and not found.effects and not found.tied
    assert any("coulomb_friction joined too" in n and "must fall by 100 %" in n for n in found.notes)
    assert len(found.falls) == 2 and not found.model.effects


def test_what_is_foretold_far_worse_without_an_effect_names_it_though_its_intervals_hold_nought(
    prepared: Prepared, monkeypatch: pytest.MonkeyPatch, executor: Executor
) -> None:
    """Of two or three conditions one that is left out opens every interval."""
    monkeypatch.setattr("hannes_lab.diagnose._may_be_nought", lambda *_: True)
    found = diagnose(prepared, effect_sources(only=["coulomb_friction"]), executor=executor)
    assert found.verdict == "effects" and [e.name for e in found.effects] == ["coulomb_friction"]
    assert any(note.startswith("coulomb_friction: its 95 % intervals hold nought") for note in found.notes)


def test_where_all_that_joined_may_be_nought_nothing_is_named(
    prepared: Prepared, monkeypatch: pytest.MonkeyPatch, executor: Executor
) -> None:
    monkeypatch.setattr("hannes_lab.diagnose._may_be_nought", lambda *_: True)
    monkeypatch.setattr("hannes_lab.diagnose._is_needed", lambda falls: False)
    for module in ("diagnose", "choose"):  # as of data that the model alone explains
        monkeypatch.setattr(f"hannes_lab.{module}.is_adequate", lambda *args, **how: True)
    found = diagnose(prepared, effect_sources(only=["coulomb_friction"]), executor=executor)
    assert found.verdict == "nothing" and not found.effects and not found.model.effects
    assert any("coulomb_friction joined too, but" in note for note in found.notes)


def test_a_fit_stays_inside_the_bounds_of_the_parameters_file(tmp_path: Path) -> None:
    """A mass that was weighed is no lighter, whatever that would explain, and it is said."""
    rng = np.random.default_rng(6)
    write_files(tmp_path)
    rig, model = load_rig(ADAPTER), Model.load(tmp_path / "mass.yaml")
    light = model.with_values({"motor.armature": 1.7})
    run = rollout(make_plant(light), rig([]).controller(light, 1e-3), reference())
    noise = rng.standard_normal((2, run.time.size))
    path = tmp_path / "light.npz"
    position, force = run.encoder_position + 2e-7 * noise[0], run.motor_voltage + 0.02 * noise[1]
    np.savez(path, reference=run.reference_position, position=position, force=force)
    free = diagnose(prepare(rig.read([path]), model, rig=rig), effect_sources(only=["wire_slack"]))
    assert free.verdict == "nothing" and free.values["motor.armature"] == pytest.approx(1.7, rel=1e-3)
    parameters = tmp_path / "parameters.yaml"
    parameters.write_text(
        parameters.read_text().replace("lower: 0.5, upper: 10.0", "lower: 1.9, upper: 10.0")
    )
    weighed = Model.load(tmp_path / "mass.yaml")
    told = compare(prepare(rig.read([path]), weighed, rig=rig), fitted=True).notes
    assert any("the fit holds motor.armature at 1.9 kg" in note for note in told)
    held = diagnose(prepare(rig.read([path]), weighed, rig=rig), effect_sources(only=["coulomb_friction"]))
    assert held.values["motor.armature"] >= 1.9 and held.verdict != "nothing"
    assert held.model.parameters["motor.armature"].lower == 1.9
    assert any("the fit holds motor.armature at 1.9 kg, the end of its range" in note for note in held.notes)
    parameters.write_text(parameters.read_text().replace("lower: 1.9, upper: 10.0", "lower: 2.0, upper: 2.0"))
    with pytest.raises(
        HannesError, match=r"'motor.armature' has a tolerance, but its bounds hold it at 2 kg"
    ):
        prepare(rig.read([path]), Model.load(tmp_path / "mass.yaml"), rig=rig)


def test_an_effect_with_which_left_out_closures_are_foretold_worse_is_left_out(
    prepared: Prepared, monkeypatch: pytest.MonkeyPatch, executor: Executor
) -> None:
    def risen(*given: Any, **how: Any) -> tuple[Fall, ...]:
        falls = error_falls(*given, **how)
        return (*falls[:-1], replace(falls[-1], held_out=1.1 * falls[-2].held_out))

    monkeypatch.setattr("hannes_lab.diagnose.error_falls", risen)
    found = diagnose(prepared, effect_sources(only=["coulomb_friction", "cogging"]), executor=executor)
    assert [effect.name for effect in found.effects] == ["coulomb_friction"]
    assert any("cogging joined too, but the error on held-out closures rises" in note for note in found.notes)


def test_what_the_data_leave_open() -> None:
    """A shape to the end of its range, or all strengths to nought; not what the data hold, or was there before."""
    coordinates = tuple(effect_coordinates(load_effect("presliding_friction")))
    level, length = (c.name for c in coordinates)
    assert (level, length) == ("presliding_friction.level", "presliding_friction.length")
    least = coordinates[1].bounds[0]

    class Given:
        effect = staticmethod(load_effect)

    def named(strength: float, off: float, precision: float, base: tuple[str, ...] = ()) -> str:
        z = np.array([strength, least + off])
        found = Fit(Model.load(), coordinates, z, 1.0, np.ones(2), precision * np.eye(2))
        both = Candidate((*base, "presliding_friction"), found, 1.0)
        return _left_open(Given(), both, Candidate(base, found, 1.0))  # type: ignore[arg-type]

    assert named(0.5, 0.5, 10.0) == ""
    assert named(1.0, 0.5, 3.0) == length and named(0.5, 0.0, 100.0) == length
    assert named(0.5, 2.5, 3.0) == level and named(0.5, 0.5, 3.0) == f"{length}, {level}"
    assert named(0.5, 0.0, 100.0, ("presliding_friction",)) == "", "it was there before"


@pytest.mark.parametrize("kept", ["one condition", "of this simulator"])
def test_where_nothing_can_be_held_out_the_smallest_set_that_explains_all_is_looked_for(
    recording: Path, kept: str
) -> None:
    """And of recordings of the simulator's own form; effects one after another are the rule for all others."""
    rig = load_rig(ADAPTER)
    (trial,) = rig.read([recording])
    first = trial.conditions[0]
    closures = {
        "one condition": [c for c in trial.closures if c.condition == first],
        "of this simulator": trial.closures,
    }
    made = rig if kept != "of this simulator" else type("Own", (rig,), {"foreign": False})
    prepared = prepare([trial.only(closures[kept])], Model.load(recording.parent / "mass.yaml"), rig=made)
    texts = set[str]()
    sources = effect_sources(only=["coulomb_friction"])
    found = diagnose(prepared, sources, progress=lambda done, total, text: texts.add(text))
    assert [effect.name for effect in found.effects] == ["coulomb_friction"]
    assert any(text.startswith("one effect") for text in texts)
    assert not any("held-out conditions" in text for text in texts)
    if kept != "of this simulator":
        with pytest.raises(HannesError, match="--no-greedy"):
            diagnose(prepared, sources, greedy=True)


@pytest.mark.parametrize("floor", [2e-4, 0.05])
def test_without_repeats_what_was_left_out_decides_whatever_is_taken_for_scatter(
    recording: Path, floor: float
) -> None:
    rig = type("Rough", (load_rig(ADAPTER),), {"floor": floor})
    (trial,) = rig.read([recording])
    trial = trial.only([trial.of(condition)[0] for condition in trial.conditions])
    prepared = prepare([trial], Model.load(recording.parent / "mass.yaml"), rig=rig)
    texts = set[str]()
    sources = effect_sources(only=["coulomb_friction", "glove_stiffness"])
    found = diagnose(prepared, sources, progress=lambda done, total, text: texts.add(text))
    assert any("held-out conditions" in text for text in texts)
    assert found.verdict == "effects" and [effect.name for effect in found.effects] == ["coulomb_friction"]
    assert "No condition was repeated" in found.summary
    (note,) = (note for note in found.notes if "one closure of" in note)
    assert f"`floor` ({floor:g} of each signal's span)" in note
