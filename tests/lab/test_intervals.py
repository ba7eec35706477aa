"""Intervals of machines of others, and effects that do the same as a parameter which is far off."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.chance import Chance
from hannes_lab.diagnose import effect_sources
from hannes_lab.fit import Fit
from hannes_lab.hide import make_set
from hannes_lab.intervals import intervals_of, strain
from hannes_lab.prepare import prepare
from hannes_lab.problem import Coordinate
from hannes_lab.search import FAR, Search
from hannes_lab.trials import make_trial
from hannes_lab.twins import imitation, twins
from hannes_lab.wording import far_off
from hannes_sim.effect import EffectParameter, load_effect

SIZE, CONDITIONS = 60, ("slow", "fast", "grasp")
SLOPE = Coordinate("slope", 0.0, 1.0, False, -np.inf, np.inf, False, 0.1)


class Thirds:
    """Features of three conditions, each a third of the rows."""

    def rows(self, condition: str) -> Any:
        out = np.zeros(SIZE, dtype=bool)
        out[CONDITIONS.index(condition) :: 3] = True
        return out


def line_fit(shift: dict[str, float], seed: int) -> tuple[Fit, dict[str, dict[str, float]], Chance]:
    """A slope of 1 by least squares under noise of 1, other by `shift` in a condition; and without each condition."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=SIZE)
    features = Thirds()
    y = x + rng.normal(size=SIZE)
    for condition, more in shift.items():
        y += np.where(features.rows(condition), more * x, 0.0)

    def slope(rows: Any) -> float:
        return float(x[rows] @ y[rows] / (x[rows] @ x[rows]))

    every = np.ones(SIZE, dtype=bool)
    z = np.array([slope(every)])
    residual = y - z[0] * x
    found = Fit(Model.load(), (SLOPE,), z, float(residual @ residual), residual, -x[:, None])
    left_out = {c: {"slope": slope(~features.rows(c))} for c in CONDITIONS}
    return found, left_out, limits()


def limits() -> Chance:
    found: Any = SimpleNamespace(median=float(SIZE), misfit=float(SIZE), gain=0.0)
    return found


def test_where_noise_is_what_it_is_taken_for_intervals_stay() -> None:
    """Of many fits the mean square of the moves is what the curvature says."""
    features: Any = Thirds()
    squares = []
    for seed in range(300):
        found, left_out, chance = line_fit({}, seed)
        squares.append(strain(features, found, chance, left_out)["slope"])
    assert np.median(squares) < 1.25 and min(squares) == 1.0


def test_a_condition_that_pulls_elsewhere_widens_the_interval() -> None:
    features: Any = Thirds()
    found, left_out, chance = line_fit({"grasp": 3.0}, 1)
    wider = strain(features, found, chance, left_out)
    assert wider["slope"] > 2.0
    plain, wide = intervals_of(found, chance)["slope"], intervals_of(found, chance, wider)["slope"]
    assert wide[1] - wide[0] == pytest.approx(wider["slope"] * (plain[1] - plain[0]))
    assert strain(features, found, chance, {}) == {}, "nothing could be left out"


def test_a_strength_that_only_adds_imitates_in_one_direction() -> None:
    parameter = EffectParameter("level", "N.m", lower=0.0, upper=1.0, typical=0.1, vanishing=0.0)
    either = EffectParameter("sine", "N.m", lower=-1.0, upper=1.0, typical=0.1, vanishing=0.0)

    def search(*parameters: EffectParameter) -> Any:
        return SimpleNamespace(effect=lambda name: SimpleNamespace(parameters=parameters))

    along = np.arange(1.0, 6.0)
    assert imitation(search(parameter), "one", along, along[:, None]) == pytest.approx(1.0)
    assert imitation(search(parameter), "one", -along, along[:, None]) == pytest.approx(0.0, abs=1e-6)
    assert imitation(search(either), "one", -along, along[:, None]) == pytest.approx(1.0)
    assert imitation(search(parameter), "one", np.zeros(5), along[:, None]) == 0.0


def test_the_effect_that_is_the_same_thing_as_what_is_far_off_is_told() -> None:
    """Three quarters more dry friction: seven tolerances, which Coulomb friction would be too."""
    hidden = effect_sources(only=["coulomb_friction"])
    entry = load_effect(hidden["coulomb_friction"]).entry({"level": 0.02})
    made, _ = make_set(Model.load(), [entry], seed=33, closures=5, conditions=("fast", "slow"))
    prepared = prepare([make_trial(one) for one in made], Model.load())
    only = ["coulomb_friction", "glove_stiffness"]
    search = Search(
        prepared.problem, prepared.model, prepared.nuisances, effect_sources(only=only, model=prepared.model)
    )
    best = search.null()
    z = best.fit.z_of("friction.coulomb")
    assert z is not None and z > FAR
    same = twins(search, best, far_off(best))
    assert same["friction.coulomb"] == ("coulomb_friction",)
    assert twins(search, best, []) == {}
