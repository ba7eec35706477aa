"""The lab blind: the tests hold the truth, the lab gets recordings only."""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_lab.add import add_effects
from hannes_lab.chance import chance
from hannes_lab.choose import Choice, pruned, tie_width
from hannes_lab.compare import compare
from hannes_lab.diagnose import diagnose, effect_sources, found_effects, without_idle, without_law
from hannes_lab.diagnosis import Diagnosis, Fall, FoundEffect
from hannes_lab.errors import SignalError
from hannes_lab.executor import Executor
from hannes_lab.falls import fall_sentence, relative_errors, worth_showing
from hannes_lab.fit import Fit, fit
from hannes_lab.hide import DEFAULT_CONDITIONS, Truth, make_set
from hannes_lab.intervals import intervals_of
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.recorded import make_trial
from hannes_lab.search import Candidate, Search
from hannes_lab.wording import bent_sentence, law_sentence, notes, worse_fitted
from hannes_sim.effect import load_effect, strength_of

CLOSURES = 8

OUTSIDE = '''
import math
from hannes_sim.effect import Effect, EffectParameter
from hannes_sim.ports import LOAD_TORQUE, QL, VL


class Flap(Effect):
    """A latch that holds the fingers in the middle of their travel and lets go."""

    name = "latch"
    parameters = (EffectParameter("torque", "N.m", 0.0, 1.0, 0.05, 0.0, "peak torque"),)

    @staticmethod
    def contribute(x, p, s, y):
        u = (x[QL] - 6.0) / 0.5
        y[LOAD_TORQUE] -= p[0] * u * math.exp(-u * u)
'''


QUICK = ("fast", "grasp_fast")
"""Conditions that last a third of the usual ones, and so does each simulation."""


def data(
    effects: list[str], seed: int, factor: float = 1.0, conditions: Sequence[str] = DEFAULT_CONDITIONS
) -> tuple[Prepared, Truth]:
    model = Model.load()
    recordings, truth = make_set(
        model, [strength_of(e, factor) for e in effects], seed=seed, closures=CLOSURES, conditions=conditions
    )
    return prepare([make_trial(r) for r in recordings], model), truth


def run(prepared: Prepared, only: Sequence[str] | None = None, executor: Executor | None = None) -> Diagnosis:
    return diagnose(prepared, effect_sources(only=only, model=prepared.model), executor=executor)


SPRINGS = (
    *("glove_stiffness", "glove_hysteresis", "return_preload", "wire_elasticity", "wire_slack", "gravity"),
    *("encoder_offset", "encoder_eccentricity"),
)
FRICTIONS = (
    *("coulomb_friction", "load_dependent_friction", "joint_friction", "velocity_strengthening"),
    *("stribeck_friction", "presliding_friction", "current_sensor", "winding_heating"),
)
INERTIAS = (
    *("gearbox_inertia", "command_delay", "current_sensor", "gear_backlash", "wire_elasticity", "supply_sag"),
    *("viscous_friction", "object_damping"),
)
"""What looks alike; in the whole catalogue the README's effect is sought, and nothing in clean data."""


@pytest.fixture(scope="module")
def latched(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    """A hand with an effect outside the catalogue."""
    file = tmp_path_factory.mktemp("latch") / "latch.py"
    file.write_text(OUTSIDE)
    return data([f"{file}:Flap"], seed=105, conditions=QUICK[1:])[0]


@pytest.fixture(scope="module")
def gloved(executor: Executor) -> Search:
    """A search for a glove that is hidden, with the fits of no effect, of the glove, and of gravity and the glove."""
    prepared, _ = data(["glove_stiffness"], seed=102, conditions=QUICK)
    names = ["glove_stiffness", "gravity", "wire_slack"]
    search = Search(
        prepared.problem, prepared.model, prepared.nuisances, effect_sources(only=names), executor
    )
    search.fitted(("glove_stiffness",))
    search.fitted(("gravity", "glove_stiffness"))
    return search


def copy_of(search: Search, **changes: Any) -> Search:
    """The same search, with what it found, to be changed by a test."""
    return replace(search, found=dict(search.found), **changes)


def test_two_effects_of_one_name_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(OUTSIDE.replace('"latch"', '"stribeck_friction"'))
    with pytest.raises(
        HannesError, match=r"Two effects are named 'stribeck_friction': the catalogue's .* and .*Flap"
    ):
        effect_sources([f"{file}:Flap"])
    assert effect_sources([f"{file}:Flap"], only=["gravity"]) == {
        "gravity": "gravity",
        "stribeck_friction": f"{file}:Flap",
    }
    assert "gravity" in effect_sources(["gravity"])
    spelt = f"{tmp_path}/../{tmp_path.name}/mine.py:Flap"
    assert effect_sources([f"{file}:Flap", spelt], only=[]) == {"stribeck_friction": f"{file}:Flap"}


def test_nothing_is_missing_in_clean_data() -> None:
    found = run(data([], seed=101)[0])
    assert found.verdict == "nothing" and not found.effects
    assert found.falls[-1].held_out < 1.3
    assert "Nothing is missing" in found.summary


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seed", "only"),
    [
        ("glove_stiffness", 102, SPRINGS),
        ("gearbox_inertia", 103, INERTIAS),
        ("load_dependent_friction", 104, FRICTIONS),
    ],
)
def test_a_hidden_effect_is_named_its_parameter_recovered_and_the_error_falls(
    name: str, seed: int, only: Sequence[str], executor: Executor
) -> None:
    prepared, truth = data([name], seed, conditions=QUICK)
    found = run(prepared, only, executor)
    assert found.verdict == "effects"
    assert [e.name for e in found.effects] == [name]
    assert len(found.tied) <= 2
    p = load_effect(name).strength().name
    estimate = found.effects[0].parameters[p]
    true = truth.effects[0].values[p]
    assert estimate.low <= true <= estimate.high or estimate.value == pytest.approx(true, rel=0.1)
    held_out = [fall.held_out for fall in found.falls]
    assert held_out[-1] <= 1.3 < held_out[0]
    assert held_out[-1] < held_out[1], "more than the nuisance parameters must be gained"
    content = found.to_dict()
    assert set(content) >= {"verdict", "effects", "tied", "experiments", "error", "falls", "depends_on"}
    assert set(content["error"]) >= {"nominal", "final", "repeatability", "held_out"}
    assert set(content["effects"][0]["parameters"][p]) >= {"value", "low", "high", "unit"}
    assert set(content["falls"][0]) >= {"added", "train", "held_out"}


@pytest.mark.slow
def test_friction_within_reach_of_the_tolerance_is_no_effect_but_is_pointed_at() -> None:
    """0.0125 N.m more is little over three standard deviations of the hand's own friction: a reader must see it."""
    prepared, _ = data(["coulomb_friction"], seed=3004, factor=1.25)
    found = diagnose(prepared, effect_sources(model=prepared.model), max_effects=1)
    assert found.verdict == "nothing"
    assert found.nuisances["friction.coulomb"]["prior_sds"] > 3.0
    assert "But it takes friction.coulomb" in found.summary
    assert (
        f"comes nearest is {found.ranking[0].names[0]}" in found.summary and "are asked for" in found.summary
    )


def test_the_zero_that_recordings_of_a_hand_share_counts_once() -> None:
    """The hand of this seed reads 0.030 rad where it is open, three tolerances, in all three recordings."""
    model = Model.load()
    slack = load_effect("wire_slack").entry({"slack": 0.0213})
    trials = [make_trial(r) for r in make_set(model, [slack], seed=50_120)[0]]
    prepared = prepare(trials, model)
    where = trials[0]
    none, shared, own = (
        prepared.rig.simulate(model, values, where, where.reference)["encoder_position"]
        for values in ({}, {"encoder.hand_zero": 0.03}, {f"encoder.zero@{where.name}": 0.03})
    )
    assert np.array_equal(shared, own) and np.ptp(shared - none) > 1e-3

    found = diagnose(prepared, {n: n for n in ("wire_slack", "encoder_offset")}, max_effects=2)
    assert [e.name for e in found.effects] == ["wire_slack"] and found.verdict == "effects"
    zeros = {n: v["value"] for n, v in found.nuisances.items() if n.startswith("encoder.")}
    of_all = zeros.pop("encoder.hand_zero")
    assert of_all + sum(zeros.values()) / 3 == pytest.approx(0.030, abs=0.006) and of_all > 0.015

    alone = prepare(trials[:1], model)
    assert "encoder.hand_zero" not in {n.name for n in alone.nuisances}


def test_an_effect_that_a_later_one_made_superfluous_is_dropped(gloved: Search) -> None:
    search = copy_of(gloved)
    null = search.null()
    limits = chance(search.problem, null.fit, search.signatures(null))
    both = search.fitted(("gravity", "glove_stiffness"))
    kept = pruned(Choice(search, both, limits, True, ()))
    assert kept.best.names == ("glove_stiffness",)
    assert kept.best.penalised < both.penalised + limits.gain


OWN_ERROR = (np.zeros(0, dtype=np.int64), np.zeros((0, 0)))


def test_where_the_model_has_an_error_of_its_own_an_effect_must_lower_the_error(gloved: Search) -> None:
    def fall(added: str, held_out: float, conditions: float | None = None) -> Fall:
        return Fall(added, held_out, held_out, {}, (), {}, held_out if conditions is None else conditions)

    search = gloved
    null = search.null()
    limits = chance(search.problem, null.fit, search.signatures(null))
    one, both = search.fitted(("glove_stiffness",)), search.fitted(("gravity", "glove_stiffness"))
    about = copy_of(search, problem=replace(search.problem, discrepancy=(OWN_ERROR,)))
    begin = (fall("nominal, as given", 9.0), fall("nominal, fitted", 4.0), fall("glove_stiffness", 2.0))
    rises, drops = ((*begin, fall("gravity", error)) for error in (2.1, 1.7))

    own_error = Choice(about, both, limits, True, ())
    kept, falls = without_idle(own_error, rises)
    assert kept.best is one and falls == begin
    assert any("gravity would fit better" in note and "2.10 instead of 2.00" in note for note in kept.notes)
    assert without_idle(own_error, drops) == (own_error, drops)
    little = (*begin, fall("gravity", 1.8, 1.9))
    assert without_idle(own_error, little)[0].best is one, "it must foretell clearly better"
    elsewhere = (*begin, fall("gravity", 1.7, 2.3))
    assert without_idle(own_error, elsewhere) == (own_error, elsewhere), "either will do"
    alone = (*begin[:2], fall("glove_stiffness", 3.9, 4.1))
    about.found[()] = Candidate((), replace(null.fit, z=np.zeros(null.fit.z.size), cost=limits.misfit), 0.0)
    single = Choice(about, one, limits, True, ())
    nothing, falls = without_idle(single, alone)
    assert (
        nothing.best.names == () and falls == begin[:2] and "3.90 instead of 4.00 on closures" in nothing.idle
    )
    z = np.zeros(null.fit.z.size)
    z[[c.name for c in null.fit.coordinates].index("hand.coulomb")] = 7.0
    about.found[()] = Candidate((), replace(null.fit, z=z, cost=limits.misfit), 0.0)
    back, falls = without_idle(single, alone)
    assert back.best is one and falls == alone, "what leads a parameter back stays"
    assert "glove_stiffness the model foretells as well, but only with hand.coulomb 0.0136" in back.notes[-1]
    worse = (fall("nominal, as given", 2.1), begin[1], fall("glove_stiffness", 2.0))
    about.found[()] = Candidate((), replace(null.fit, z=np.zeros(null.fit.z.size), cost=limits.misfit), 0.0)
    assert without_idle(single, worse)[0].best.names == (), "as it was given the model foretells as well"
    unrepeated = (*begin[:2], fall("glove_stiffness", math.nan))
    assert without_idle(single, unrepeated) == (single, unrepeated), "nothing was left out"
    known = Choice(search, both, limits, True, ())
    assert without_idle(known, rises) == (known, rises), "there the likelihood decides"
    strict = replace(own_error, limits=replace(limits, misfit=0.9 * one.fit.cost))
    assert without_idle(strict, rises)[0].best is both, "the rest would not explain all"


def test_effects_that_bend_the_model_and_leave_most_of_the_error_are_no_answer(gloved: Search) -> None:
    """What a set explains with a machine far outside its tolerances must be foretold too."""

    def fall(held_out: float, conditions: float | None = None) -> Fall:
        return Fall("", held_out, held_out, {}, (), {}, held_out if conditions is None else conditions)

    search = gloved
    one = search.fitted(("glove_stiffness",))
    limits = chance(search.problem, one.fit, search.signatures(one))
    about = copy_of(search, problem=replace(search.problem, discrepancy=(OWN_ERROR,)))
    off = next(k for k, c in enumerate(one.fit.coordinates) if c.name == "friction.viscous")
    z = one.fit.z.copy()
    z[off] = -4.0
    bent = Candidate(one.names, replace(one.fit, z=z), one.penalised)
    begin = (fall(9.0), fall(4.5))
    little, enough = (*begin, fall(3.5)), (*begin, fall(2.7))
    said = bent_sentence(Choice(about, bent, limits, True, ()), little)
    assert (
        "glove_stiffness would bring the misfit within chance only with friction.viscous" in said
        and "more than half" in said
    )
    for choice, falls in (
        (Choice(about, bent, limits, True, ()), enough),
        (Choice(about, bent, limits, True, ()), (*begin, fall(3.5, 2.0))),
        (Choice(about, one, limits, True, ()), little),
        (Choice(search, bent, limits, True, ()), little),
        (Choice(about, replace(bent, names=()), limits, True, ()), begin),
        (Choice(about, bent, limits, True, ()), (fall(9.0), fall(math.nan), fall(math.nan))),
    ):
        assert bent_sentence(choice, falls) == ""

    def worse(search: Search, closures: float, conditions: float) -> str:
        """Of effects with which what was left out has another error than without."""
        return bent_sentence(
            Choice(search, one, limits, True, ()), (*begin[:1], fall(2.0, 1.0), fall(closures, conditions))
        )

    assert "glove_stiffness would bring the misfit within chance, but foretells" in worse(search, 2.5, 1.3)
    assert "rises from 2 and 1 to 2.5 and 1.3 times the repeatability" in worse(about, 2.5, 1.3)
    assert "rises from 1 to 1.3 times" in worse(search, math.nan, 1.3)
    for closures, conditions in ((2.5, 1.0), (1.5, 1.3), (2.2, 1.1), (math.nan, math.nan)):
        assert not worse(search, closures, conditions), "not clearly, or not all"

    def alone(of: Search, sds: float, error: float) -> str:
        """Of the model without effects, with a viscous friction so many tolerances off."""
        z = one.fit.z.copy()
        z[off] = sds
        choice = Choice(of, Candidate((), replace(one.fit, z=z), one.penalised), limits, True, ())
        return bent_sentence(choice, (*begin, fall(error)))

    assert "only with friction.viscous" in alone(about, 4.0, 2.0)
    assert not (alone(about, -4.0, 2.0) or alone(about, 4.0, 1.3) or alone(about, 2.0, 2.0)), (
        "no effect takes friction away"
    )
    assert not alone(search, 4.0, 2.0), "the model has no error of its own there"


def test_an_effect_that_is_the_same_as_a_parameter_far_off_is_named_beside_another() -> None:
    """Beside a breakaway friction the dry friction was nine tolerances off, which was "unknown"."""
    hidden = [strength_of("coulomb_friction", 2.0), strength_of("stribeck_friction", 1.0)]
    recordings, _ = make_set(Model.load(), hidden, seed=6124, closures=4, conditions=QUICK, sensors="bench")
    prepared = prepare([make_trial(r) for r in recordings], Model.load())
    found = run(prepared, only=["coulomb_friction", "stribeck_friction"])
    assert found.verdict == "effects"
    assert {effect.name for effect in found.effects} == {"coulomb_friction", "stribeck_friction"}


def test_where_the_model_has_an_error_of_its_own_more_ties(gloved: Search) -> None:
    search = gloved
    about = copy_of(search, problem=replace(search.problem, discrepancy=(OWN_ERROR,)))
    null = search.null()
    for cost, width in ((100.0, 12.0), (500.0, 30.0)):
        best = Candidate((), replace(null.fit, cost=cost), cost)
        assert tie_width(about, best) == pytest.approx(width)
        assert tie_width(search, best) == pytest.approx(6.0)


def test_a_fit_from_which_nothing_of_worth_is_in_reach_ends_early_and_is_not_kept(gloved: Search) -> None:
    problem, model = gloved.problem, gloved.model
    search = replace(gloved, sources={}, found={})
    start = {c.name: 1.0 for c in search.coordinates}

    def tried(worth: float) -> tuple[Fit, int]:
        before = problem.simulations
        found = fit(problem, model, search.coordinates, start, worth=worth)
        return found, problem.simulations - before

    whole, simulations = tried(np.inf)
    same, as_many = tried(1.1 * whole.cost)
    assert whole.complete and same.complete and (same.cost, as_many) == (whole.cost, simulations)
    ended, fewer = tried(0.5 * whole.cost)
    assert not ended.complete and fewer < simulations and ended.cost >= whole.cost
    assert search.keep(Candidate((), ended, ended.cost)).fit is ended
    assert () not in search.found, "a fit that ended early must not stand for the set"


def test_of_many_extensions_the_best_after_a_few_steps_are_fitted_to_the_end(monkeypatch) -> None:
    monkeypatch.setattr("hannes_lab.search.REFIT", 1)
    monkeypatch.setattr("hannes_lab.search.POLISH", 1)
    prepared, _ = data(["glove_stiffness"], seed=102)
    names = ["gravity", "glove_stiffness", "viscous_friction"]
    search = Search(prepared.problem, prepared.model, prepared.nuisances, effect_sources(only=names))
    null = search.null()
    assert null.pulled
    ranked = search.extend([null], names, "one effect")
    assert [c.fit.complete for c in ranked] == [True, False, False]
    assert ranked[0].names == ("glove_stiffness",) and set(search.found) == {(), ("glove_stiffness",)}
    alone = search.polish(search.add(null, "glove_stiffness"))
    assert ranked[0].fit.cost == pytest.approx(alone.fit.cost, rel=0.01)


def test_a_friction_that_makes_the_hand_stick_is_fitted() -> None:
    """The misfit has a narrow pit at the true level: a coarse scan, or its linear moves, end beside it."""
    prepared, truth = data(["joint_friction"], seed=50067, factor=1.94)
    search = Search(
        prepared.problem, prepared.model, prepared.nuisances, effect_sources(only=["joint_friction"])
    )
    null = search.null()
    assert null.fit.z_of("hand.coulomb") > 8.0, "which has the same form, far beyond its tolerance"
    found = search.polish(search.add(null, "joint_friction"))
    level = truth.effects[0].values["level"]
    model, coordinates = search.with_effects(("joint_friction",))
    scale = next(c.scale for c in coordinates if c.name == "joint_friction.level")
    from_truth = fit(
        search.problem, model, coordinates, {"joint_friction.level": level / scale}, evaluations=25
    )
    assert found.fit.cost < 1.05 * from_truth.cost and found.fit.cost < 1.5 * search.problem.features.size
    assert abs(found.fit.z_of("hand.coulomb")) < 4.0
    assert found.fit.values["joint_friction.level"] == pytest.approx(level, rel=0.1)


@pytest.mark.parametrize(("period", "phase"), [(0.6, 0.0), (4.2, 0.0), (1.1, -1.5)])
def test_a_ripple_of_any_period_and_phase_is_fitted(period: float, phase: float) -> None:
    """A current that is logged at 30 Hz and rectified shows no line; periods between the usual ones count too."""
    model = Model.load()
    amplitudes = {"sine": 0.01 * math.cos(phase), "cosine": 0.01 * math.sin(phase)}
    ripple = load_effect("cogging").entry({**amplitudes, "period": period})
    recordings, _ = make_set(model, [ripple], seed=100, closures=5, conditions=("slow",))
    prepared = prepare([make_trial(r) for r in recordings], model)
    search = Search(prepared.problem, model, prepared.nuisances, effect_sources(only=["cogging"]))
    found = search.polish(search.add(search.null(), "cogging"))
    assert found.fit.values["cogging.period"] == pytest.approx(period, rel=0.005)
    assert found.fit.cost < 1.5 * prepared.problem.features.size
    for name, amplitude in amplitudes.items():
        assert found.fit.values[f"cogging.{name}"] == pytest.approx(amplitude, abs=0.0005)


def test_what_the_model_gets_wrong_of_the_first_closure_is_no_scatter() -> None:
    """A slack shows in how the first closure differs; counted as scatter, chance seemed to gain 150 with a slack."""
    model = Model.load()
    recordings, _ = make_set(model, [strength_of("wire_slack", 2.0)], seed=5, closures=8)
    prepared = prepare([make_trial(r) for r in recordings], model)
    search = Search(prepared.problem, model, prepared.nuisances, effect_sources(only=["wire_slack"]))
    null = search.null()
    assert chance(search.problem, null.fit, search.signatures(null)).gain < 60.0


def test_one_closure_is_said_to_hold_nothing_out() -> None:
    model = Model.load()
    recordings, _ = make_set(model, [], seed=104, closures=1, conditions=("fast",))
    found = diagnose(prepare([make_trial(r) for r in recordings], model), effect_sources(only=["gravity"]))
    assert not re.search(r"\bnan\b", found.summary)
    assert "No condition was repeated: there is no repeatability to hold the error against." in found.summary
    assert re.search(r"encoder_position [\d.e-]+ rad, motor_current [\d.e-]+ A", found.summary)


@pytest.mark.slow
def test_an_effect_outside_the_catalogue_is_called_unknown(latched: Prepared, executor: Executor) -> None:
    sources = effect_sources(model=latched.model)
    found = diagnose(latched, sources, max_effects=1, executor=executor)
    assert found.verdict == "unknown"
    assert "not in the catalogue" in found.summary
    variables = {"position", "velocity", "direction", "load", "time"}
    variables |= {"friction_by_position", "inertia_by_position"}
    assert {d.variable for d in found.depends_on} == variables


def test_triples_are_not_tried_where_the_pairs_lead_nowhere(latched: Prepared) -> None:
    only = ["gravity", "glove_stiffness", "encoder_offset", "return_preload"]
    texts = set[str]()
    found = diagnose(
        latched,
        effect_sources(only=only),
        progress=lambda done, total, text: texts.add(text),
    )
    assert found.verdict == "unknown"
    assert any("sets of more effects were not tried" in note for note in found.notes)
    assert any("two effects" in text for text in texts) and not any("three" in text for text in texts)
    assert not any("--greedy" in note for note in found.notes), "which needs a second condition"


def test_a_parameter_at_the_end_of_its_range_is_pointed_out(
    latched: Prepared, executor: Executor, tmp_path: Path
) -> None:
    narrow = tmp_path / "narrow.py"
    narrow.write_text(OUTSIDE.replace('"N.m", 0.0, 1.0, 0.05', '"N.m", 0.0, 0.025, 0.01'))
    sources = effect_sources([f"{narrow}:Flap"], only=[])
    found = diagnose(latched, sources, max_effects=1, executor=executor)
    assert found.effects[0].parameters["torque"].value == pytest.approx(0.025, rel=1e-3)
    assert not found.effects[0].parameters["torque"].identified
    assert any("latch.torque lies at the end of its range (0 to 0.025 N.m)" in note for note in found.notes)


@pytest.mark.slow
def test_the_users_own_effect_is_a_full_citizen(tmp_path: Path) -> None:
    """With its file given, the effect outside the catalogue is found and added, and the model file loads again."""
    file = tmp_path / "latch.py"
    file.write_text(OUTSIDE)
    source = f"{file}:Flap"
    prepared, truth = data([source], seed=105, conditions=QUICK)
    nearest = ["cogging", "gravity", "wire_slack"]
    found = diagnose(prepared, effect_sources([source], only=nearest, model=prepared.model))
    assert [e.name for e in found.effects] == ["latch"]
    assert found.effects[0].parameters["torque"].value == pytest.approx(
        truth.effects[0].values["torque"], rel=0.1
    )
    addition = add_effects(prepared, effect_sources(only=[source], model=prepared.model))
    path = addition.model.save(tmp_path / "my_hand.yaml")
    loaded = Model.load(path)
    assert loaded.effects[0].source == f"{file.resolve()}:Flap"
    assert addition.falls[-1].held_out <= 1.3


def test_add_writes_a_model_whose_error_is_low_as_given(tmp_path: Path, executor: Executor) -> None:
    prepared, _ = data(["glove_stiffness"], 102, conditions=QUICK)
    sources = effect_sources(only=["glove_stiffness"], model=prepared.model)
    addition = add_effects(prepared, sources, executor=executor)
    model = Model.load(addition.model.save(tmp_path / "hand.yaml"))
    before = compare(prepared)
    after = compare(prepare(prepared.features.trials, model))
    # as given: where the object lay and the encoder's zero of these recordings are not part of a model of the hand
    assert after.overall < 0.2 * before.overall
    assert model.provenance["bags"] and model.provenance["falls"][-1]["added"] == "glove_stiffness"
    assert sum(c.fails for c in before.cells) > sum(c.fails for c in after.cells)


@pytest.mark.slow
def test_position_alone_works_and_says_what_is_lost() -> None:
    prepared, _ = data(["glove_stiffness"], 108, conditions=QUICK)
    alone = prepare(prepared.features.trials, prepared.model, signals=["encoder_position"])
    assert any("no current" in note for note in alone.notes)
    found = diagnose(
        alone, effect_sources(only=["glove_stiffness", "gravity", "load_dependent_friction", "wire_slack"])
    )
    assert found.verdict in ("effects", "unknown")
    assert np.isfinite(found.falls[-1].held_out)


def test_a_glove_is_told_from_the_hands_own_spring_as_far_as_the_tolerance_of_that_says():
    """Both act on the same coordinate: only the prior of the spring parts them, and the interval must say so."""
    weak = strength_of("glove_stiffness", 0.15)
    recordings, truth = make_set(Model.load(), [weak], seed=812)
    prepared = prepare([make_trial(r) for r in recordings], Model.load())
    found = diagnose(prepared, effect_sources(only=["glove_stiffness"]), max_effects=1)
    stiffness = found.effects[0].parameters["stiffness"]
    sd = next(n.sd for n in prepared.nuisances if n.name == "hand.stiffness")
    width = (stiffness.high - stiffness.low) / (2 * 1.96)
    assert stiffness.low > 0.0 and 0.7 * sd < width < 1.3 * sd
    assert abs(stiffness.value - weak.values["stiffness"]) < 3.0 * sd
    spring = float(truth.parameters["hand.stiffness"].removeprefix("x "))
    total = spring * prepared.model.parameters.value("hand.stiffness") + weak.values["stiffness"]
    here = found.values["hand.stiffness"] + found.values["glove_stiffness.stiffness"]
    assert here == pytest.approx(total, rel=0.02)


def test_how_another_machines_law_sets_in_is_not_named_where_the_rest_explains_all(
    gloved: Search, monkeypatch: pytest.MonkeyPatch
) -> None:
    null = gloved.null()
    limits = chance(gloved.problem, null.fit, gloved.signatures(null))
    about = copy_of(gloved, problem=replace(gloved.problem, discrepancy=(OWN_ERROR,)))
    choice = Choice(about, gloved.fitted(("gravity", "glove_stiffness")), limits, True, ())
    assert without_law(choice) is choice
    monkeypatch.setattr("hannes_lab.diagnose.in_the_law", lambda search, best: ("gravity", "little"))
    assert without_law(choice).best.names == ("glove_stiffness",)
    monkeypatch.setattr("hannes_lab.diagnose.in_the_law", lambda search, best: ("glove_stiffness", "little"))
    assert without_law(choice) is choice, "gravity alone does not explain it"
    said = law_sentence("presliding_friction", "length 0.009 rad, 0.06 % of the travel", 1.6, 2.6)
    assert "1.60 instead of 2.60" in said and "hannes add --effect presliding_friction" in said


def test_without_repeats_what_only_fits_better_is_not_shown() -> None:
    """There is no repeatability: the error on held-out conditions, in the signals' units, decides."""

    def fall(added: str, position: float, current: float) -> Fall:
        nan, signals = float("nan"), {"encoder_position": position, "motor_current": current}
        return Fall(added, nan, nan, {}, (), signals)

    given, fitted = fall("nominal, as given", 0.02, 0.5), fall("nominal, fitted", 0.04, 0.5)
    worse, better = fall("supply_sag", 0.06, 0.4), fall("supply_sag", 0.03, 0.5)
    assert relative_errors((given, fitted, worse))[1:] == pytest.approx([1.0, np.sqrt((1.5**2 + 0.8**2) / 2)])
    found = {(): "null", ("supply_sag",): "sag"}
    search: Any = SimpleNamespace(fit_of=lambda names: found[tuple(names)])
    best: Any = SimpleNamespace(names=("supply_sag",))
    assert worth_showing(search, best, (given, fitted, worse)) == ("null", (given, fitted))
    assert worth_showing(search, best, (given, fitted, better)) == (best, (given, fitted, better))
    (note,) = worse_fitted((given, fitted))
    assert "as fitted (on conditions that were left out) than as given (0.79 of the error)" in note
    unknown = replace(given, held_out_signals={}), replace(fitted, held_out_signals={})
    assert not worse_fitted(unknown)


def test_an_interval_that_the_end_of_the_range_cuts_is_said(gloved: Search) -> None:
    best = gloved.fitted(("glove_stiffness",))
    limits = chance(gloved.problem, best.fit, gloved.signatures(best))
    missed = SignalError("slow", "motor_current", "A", 0.1, 0.05, 2.0)
    (effect,) = found_effects(
        gloved, best, intervals_of(best.fit, limits), (Fall("", 1.0, 1.0, {}, (missed,)),) * 2
    )
    main = next(iter(effect.parameters))
    whole = next(c for c in best.fit.coordinates if c.name == f"glove_stiffness.{main}")
    p = replace(effect.parameters[main], high=whole.upper, identified=True)
    cut = replace(effect, parameters={**effect.parameters, main: p})

    def said(one: FoundEffect) -> list[str]:
        told = notes(gloved, best, "effects", [one], (), False, None)
        return [note for note in told if f"interval of glove_stiffness.{main}" in note]

    assert not said(effect)
    (note,) = said(cut)
    assert f"cut at the end of its range ({whole.lower:g} to {whole.upper:g})" in note


def test_an_error_that_rises_is_said_to_rise() -> None:
    """A fit weighs what is known of the model's own error; its error may be larger than before."""

    def fall(added: str, held_out: float, of: dict[str, float]) -> Fall:
        return Fall(added, held_out, held_out, of, (), {}, held_out)

    steps = [fall("nominal, as given", 9.0, {}), fall("nominal, fitted", 4.0, {"slow": 3.0, "fast": 5.0})]
    better, worse = (
        fall("gravity", 2.0, {"slow": 1.0, "fast": 3.0}),
        fall("gravity", 4.5, {"slow": 1.0, "fast": 6.0}),
    )
    assert "falls from 4.00 (nominal, fitted) to 2.00 times" in fall_sentence([*steps, better])
    given = fall("nominal, as given", 3.0, {"slow": 2.0, "fast": 4.0})
    assert "falls from 3.00 (nominal, as given) to 2.00" in fall_sentence([given, steps[1], better])
    assert fall_sentence(steps) == "The error on held-out closures is 4.00 times the repeatability."
    said = fall_sentence([*steps, better], by_conditions=True)
    assert said.startswith(
        "The error on conditions that were left out of the fit falls from 4.00 (nominal, fitted) to"
    )
    assert said.endswith("(on held-out closures from 4.00 to 2.00).")
    between = fall("gravity", 3.5, {"slow": 1.0, "fast": 6.0})
    for by_conditions in (False, True):
        said = fall_sentence([given, steps[1], between], by_conditions=by_conditions)
        assert "rises from 3.00 (nominal, as given; 4.00 as fitted) to 3.50 times" in said
    said = fall_sentence([*steps, worse])
    assert "rises from 4.00 (nominal, fitted) to 4.50 times" in said
    assert "'slow' from 3.00 to 1.00, 'fast' from 5.00 to 6.00" in said
