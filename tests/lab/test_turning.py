"""A machine that turns on and on, whose angle is recorded wrapped by a turn."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.rig import load_rig, scaled_effect
from hannes_lab.search import Search
from hannes_lab.spectrum import turn, whole_periods
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


def test_the_turn_is_seen_in_the_jumps(prepared: Prepared) -> None:
    null = Search(prepared.problem, prepared.model, prepared.nuisances, {}).null().fit
    seen = turn(prepared.problem, null)
    assert seen == pytest.approx(TURN, rel=1e-3)
    periods = whole_periods(prepared.features, 0.1, 10.0, seen)
    assert min(abs(p / PERIOD - 1.0) for p in periods) < 1e-3
    (trial,) = prepared.features.trials
    time, angle = trial.signals["encoder_position"]
    straight = replace(trial, signals={**trial.signals, "encoder_position": (time, np.unwrap(angle))})
    features = replace(prepared.features, trials=(straight,))
    assert turn(replace(prepared.problem, features=features), null) == 0.0, "nothing was wrapped"


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
    """A motor with one wave in its whole way may have any curve over the position."""
    sources = effect_sources(only=["cogging"])
    search = Search(prepared.problem, prepared.model, prepared.nuisances, sources)
    best = search.from_point(("cogging",), {"cogging.sine": 1.0})

    def said(period: float) -> list[str]:
        fit = best.fit
        z = fit.z.copy()
        (k,) = (k for k, c in enumerate(fit.coordinates) if c.name == "cogging.period")
        z[k] = fit.coordinates[k].z(period)
        found = notes(search, replace(best, fit=replace(fit, z=z)), "effects", (), (), False, None)
        return [note for note in found if "of its waves" in note]

    assert not said(PERIOD)
    (note,) = said(TURN / 1.5)
    assert note.startswith("cogging: the whole way is 1.") and "a longer way tells" in note
