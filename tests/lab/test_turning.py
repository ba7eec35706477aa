"""A machine that turns on and on, whose angle is recorded wrapped by a turn."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.adequacy import distorted, waves_of
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.problem import Problem
from hannes_lab.rig import load_rig, scaled_effect
from hannes_lab.search import Candidate, Search
from hannes_lab.spectrum import _jumps, periods_of_a_turn, turn
from hannes_lab.wording import notes
from hannes_sim.effect import load_effect
from hannes_sim.factory import make_plant
from hannes_sim.rollout import rollout
from lab.turning_rig import TURN, angle_of, trial_of, write_files

ADAPTER = f"{Path(__file__).parent / 'turning_rig.py'}:Wheel"
SPEEDS, TURNS, PERIOD = (9.0, 14.0), 7, TURN / 11.0


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    """A ripple of eleven waves a turn, of a wheel that is a tenth heavier and rubs a third more than was thought."""
    folder = tmp_path_factory.mktemp("wheel")
    write_files(folder)
    rig, model = load_rig(ADAPTER), Model.load(folder / "wheel.yaml")
    rig.population = folder / "tolerances.yaml"
    true = model.with_values({"motor.armature": 0.022, "friction.viscous": 0.066})
    ripple = scaled_effect(load_effect("cogging"), tuple(sorted(rig.sizes.items())), False)
    true = true.with_effect(ripple.entry({"sine": 0.06, "cosine": -0.04, "period": PERIOD}))
    angle = angle_of(SPEEDS, TURNS)
    reference = angle - TURN * np.floor(angle / TURN + 1e-9)
    run = rollout(make_plant(true), rig([]).controller(true, 1e-3), reference)
    return prepare([trial_of(run, SPEEDS, TURNS, np.random.default_rng(4))], model, rig=rig)


def with_reference(prepared: Prepared, reference: np.ndarray) -> Problem:
    """The problem of the same trial with another reference."""
    (trial,) = prepared.features.trials
    features = replace(prepared.features, trials=(replace(trial, reference=reference),))
    return replace(prepared.problem, features=features)


def test_the_turn_is_seen_in_the_jumps_of_the_reference(prepared: Prepared) -> None:
    null = Search(prepared.problem, prepared.model, prepared.nuisances, {}).null().fit
    assert turn(prepared.problem, null) == pytest.approx(TURN, rel=1e-6)
    periods = periods_of_a_turn(prepared.problem, null, 0.1, 10.0)
    assert min(abs(p / PERIOD - 1.0) for p in periods) < 1e-6
    reference = prepared.features.trials[0].reference
    straight = with_reference(prepared, np.unwrap(reference, period=TURN))
    assert turn(straight, null) == 0.0, "nothing was wrapped"
    assert turn(with_reference(prepared, np.zeros(reference.size)), null) == 0.0, "nothing moves"


def test_steps_of_a_reference_are_no_turns(prepared: Prepared) -> None:
    """The machine follows them; what jumps by sizes of all kinds is no turn either."""
    null = Search(prepared.problem, prepared.model, prepared.nuisances, {}).null().fit
    tick = np.arange(prepared.features.trials[0].reference.size)
    there_and_back = np.where(tick // 400 % 2 == 0, 0.0, 1.0)
    assert _jumps(there_and_back) == 1.0 and turn(with_reference(prepared, there_and_back), null) == 0.0
    assert _jumps(np.array([0.0, 0.5, 1.37])[tick // 400 % 3]) == 0.0


def test_what_goes_once_a_turn_repeats_with_every_turn(prepared: Prepared) -> None:
    """An imbalance: one wave in the recorded angle, fourteen along the way."""
    sources = effect_sources(only=["cogging"])
    search = Search(prepared.problem, prepared.model, prepared.nuisances, sources)
    found = search.from_point(("cogging",), {"cogging.sine": 1.0})
    imbalance = with_period(found, TURN)
    assert waves_of(search, imbalance, "cogging") == pytest.approx(TURNS * len(SPEEDS), rel=0.01)
    assert not distorted(search, imbalance)


def with_period(found: Candidate, period: float) -> Candidate:
    """A fitted ripple of another period."""
    z = found.fit.z.copy()
    (k,) = (k for k, c in enumerate(found.fit.coordinates) if c.name == "cogging.period")
    z[k] = found.fit.coordinates[k].z(period)
    return replace(found, fit=replace(found.fit, z=z))


def test_a_ripple_of_whole_waves_in_a_turn_is_found(prepared: Prepared) -> None:
    """The way is fourteen times as long as the angle that is recorded: a period a percent off is out of step."""
    sources = effect_sources(only=["cogging", "coulomb_friction", "direction_dependent_friction"])
    found = diagnose(prepared, sources)
    assert [effect.name for effect in found.effects] == ["cogging"] and found.verdict == "effects"
    ripple = found.effects[0].parameters
    assert ripple["period"].value == pytest.approx(PERIOD, rel=5e-4)
    amplitude = math.hypot(ripple["sine"].value, ripple["cosine"].value)
    assert amplitude == pytest.approx(math.hypot(0.06, 0.04), rel=0.05)
    assert found.values["motor.armature"] == pytest.approx(0.022, rel=0.03)


def test_a_ripple_that_the_way_shows_once_is_said_to_be_that(prepared: Prepared) -> None:
    """With one wave in its whole way it may be any curve over the position."""
    sources = effect_sources(only=["cogging"])
    search = Search(prepared.problem, prepared.model, prepared.nuisances, sources)
    best = search.from_point(("cogging",), {"cogging.sine": 1.0})

    def said(of: Search, period: float) -> list[str]:
        found = notes(of, with_period(best, period), "effects", (), (), False, None)
        return [note for note in found if "of its waves" in note]

    assert not said(search, PERIOD) and not said(search, TURN)
    straight = np.unwrap(prepared.features.trials[0].reference, period=TURN)
    within_a_turn = replace(search, problem=with_reference(prepared, straight))
    (note,) = said(within_a_turn, TURN / 1.5)
    assert note.startswith("cogging: the whole way is 1.5") and "a longer way tells" in note
