"""Intervals of machines of others, and effects that do the same as a parameter which is far off."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.chance import Chance
from hannes_lab.diagnose import effect_sources
from hannes_lab.fit import Fit
from hannes_lab.hide import make_set
from hannes_lab.intervals import NORMAL, intervals_of, may_vanish, strain, sway, wider
from hannes_lab.prepare import prepare
from hannes_lab.problem import Coordinate
from hannes_lab.recorded import make_trial
from hannes_lab.search import FAR, Search
from hannes_lab.secants import grain_of
from hannes_lab.twins import imitation, twins
from hannes_lab.wording import far_off, jumps
from hannes_sim.effect import EffectParameter, load_effect

SIZE, CONDITIONS = 60, ("slow", "fast", "grasp")
SLOPE = Coordinate("slope", 0.0, 1.0, False, -np.inf, np.inf, False, 0.1)


@cache
def nominal() -> Model:
    return Model.load()


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
    found = Fit(nominal(), (SLOPE,), z, float(residual @ residual), residual, -x[:, None])
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


LAPS = 6


def lap_fit(scatter: float, seed: int) -> tuple[Any, Fit]:
    """A slope of 1 in laps of two conditions under noise of 1 a sample; in each lap it is another by `scatter`."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(2, SIZE))
    laps = 1.0 + scatter * rng.normal(size=LAPS)
    closures = laps[:, None, None] * x + rng.normal(size=(LAPS, 2, SIZE))
    block = SimpleNamespace(n=LAPS, trial=0, combine=lambda c: c.mean(axis=0))
    one = np.sqrt(1.0 / LAPS)
    problem: Any = SimpleNamespace(
        features=SimpleNamespace(
            size=2 * SIZE,
            blocks=(block, block),
            slices=(slice(0, SIZE), slice(SIZE, 2 * SIZE)),
            rows_of=lambda trial: np.ones(2 * SIZE, dtype=bool),
        ),
        deviations=tuple(closures[:, k] - closures[:, k].mean(axis=0) for k in range(2)),
        discrepancy=(),
        whiten=lambda difference: difference / one,
    )
    along, measured = x.ravel() / one, closures.mean(axis=0).ravel() / one
    z = np.array([along @ measured / (along @ along)])
    residual = measured - z[0] * along
    return problem, Fit(nominal(), (SLOPE,), z, float(residual @ residual), residual, -along[:, None])


def test_scatter_that_moves_whole_laps_widens_the_interval_until_it_holds_the_truth() -> None:
    """Of a friction, say, that is another in each lap and of which no tolerance speaks."""
    held = {False: 0, True: 0}
    for seed in range(200):
        problem, found = lap_fit(0.3, seed)
        limits_of: Any = SimpleNamespace(median=max(found.cost, 1.0))
        for widened in held:
            low, high = intervals_of(found, limits_of, sway(problem, found) if widened else {})["slope"]
            held[widened] += low <= 1.0 <= high
    assert held[False] < 100, "these laps show nothing"
    assert 180 <= held[True] <= 198


def test_noise_from_sample_to_sample_leaves_intervals_nearly_as_they_are() -> None:
    ratios = [sway(*lap_fit(0.0, seed))["slope"] for seed in range(200)]
    # Six laps know a variance badly: Student's t alone is 1.3 times as wide.
    assert min(ratios) == 1.0 and 1.0 < np.median(ratios) < 1.5
    problem, found = lap_fit(0.0, 1)
    problem.deviations = tuple(d[:1] for d in problem.deviations)
    assert sway(problem, found) == {}, "nothing was repeated"
    assert wider({"a": 2.0, "b": 1.0}, {"b": 3.0, "c": 1.5}) == {"a": 2.0, "b": 3.0, "c": 1.5}


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


def test_strengths_that_act_alike_may_each_be_nought_and_not_both() -> None:
    """A friction of one direction as a level and as a slope, where speeds hardly differ."""
    rng = np.random.default_rng(3)
    speed = 1.0 + 0.05 * rng.normal(size=SIZE)
    acts = np.column_stack([np.ones(SIZE), speed])
    coordinates = tuple(
        Coordinate(name, 0.0, 1.0, False, -np.inf, np.inf, False, 0.1) for name in ("level", "slope")
    )
    for size, vanishes in ((2.0, False), (0.1, True)):
        y = acts @ np.array([0.5 * size, 0.5 * size]) + rng.normal(size=SIZE)
        z = np.linalg.lstsq(acts, y, rcond=None)[0]
        left = y - acts @ z
        found = Fit(nominal(), coordinates, z, float(left @ left), left, -acts)
        assert all(low < 0.0 < high for low, high in intervals_of(found, limits()).values())
        assert may_vanish(found, limits(), {}, ("level", "slope")) == vanishes
        assert may_vanish(found, limits(), {"level": 50.0, "slope": 50.0}, ("level", "slope"))


def test_two_repeats_of_several_conditions_know_their_scatter_together() -> None:
    """One pair knows a variance by one degree of freedom (a factor of 12.7); five pairs of like scatter by more."""
    wide, alone = [], []
    for seed in range(40):
        problem, found = paired_fit(5, 0.3, seed)
        wide.append(sway(problem, found)["slope"])
        problem, found = paired_fit(1, 0.3, seed)
        alone.append(sway(problem, found)["slope"])
    assert np.quantile(alone, 0.9) > 2.0 * np.quantile(wide, 0.9)
    # By the curvature the standard deviation is that of noise alone; the scatter's is 0.3 sqrt(60) as large.
    expected = np.sqrt(1.0 + 0.3**2 * SIZE)
    assert expected < np.median(wide) < 2.0 * expected


def paired_fit(trials: int, scatter: float, seed: int) -> tuple[Any, Fit]:
    """A slope of 1 in recordings of two closures under noise of 1 a sample; in each closure it is another."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(trials, SIZE))
    laps = 1.0 + scatter * rng.normal(size=(trials, 2))
    closures = laps[..., None] * x[:, None] + rng.normal(size=(trials, 2, SIZE))
    blocks = [SimpleNamespace(n=2, trial=k, combine=lambda c: c.mean(axis=0)) for k in range(trials)]
    one = np.sqrt(0.5)

    def rows_of(trial: int) -> Any:
        return np.arange(trials * SIZE) // SIZE == trial

    problem: Any = SimpleNamespace(
        features=SimpleNamespace(
            size=trials * SIZE,
            blocks=blocks,
            slices=[slice(k * SIZE, (k + 1) * SIZE) for k in range(trials)],
            rows_of=rows_of,
        ),
        deviations=[c - c.mean(axis=0) for c in closures],
        discrepancy=(),
        whiten=lambda difference: difference / one,
    )
    along, measured = x.ravel() / one, closures.mean(axis=1).ravel() / one
    z = np.array([along @ measured / (along @ along)])
    residual = measured - z[0] * along
    return problem, Fit(nominal(), (SLOPE,), z, float(residual @ residual), residual, -along[:, None])


def jumpy(by: float, bend: float = 0.0) -> tuple[Any, Fit]:
    """A misfit of 100 + z^2 (and a bend) for a slope, and jumps of a standard deviation `by` from place to place."""

    def residual(model: Model, values: Any) -> Any:
        z = values["slope"]
        place = np.random.default_rng(round(abs(z) * 1e6) + (z < 0.0))
        return np.array([np.sqrt(100.0 + by * place.standard_normal() + bend * z**3), z])

    problem: Any = SimpleNamespace(residual=residual, failures=0)
    return problem, Fit(
        nominal(), (SLOPE,), np.zeros(1), 100.0, np.array([10.0, 0.0]), np.array([[0.0], [1.0]])
    )


def test_a_misfit_that_jumps_is_told_from_one_that_bends() -> None:
    assert grain_of(*jumpy(0.0)) < 1e-9 and grain_of(*jumpy(0.0, bend=0.5)) < 1e-9
    found = grain_of(*jumpy(3.0))
    assert 0.5 < found < 9.0 and grain_of(*jumpy(30.0)) == pytest.approx(10.0 * found, rel=0.02)
    nowhere = Fit(nominal(), (), np.zeros(0), 0.0, np.zeros(1), np.zeros((1, 0)))
    assert grain_of(jumpy(3.0)[0], nowhere) == 0.0


def test_where_the_misfit_jumps_intervals_are_wider_and_it_is_said() -> None:
    _, found = jumpy(0.0)
    chance: Any = SimpleNamespace(median=100.0, misfit=130.0, gain=0.0)
    low, high = intervals_of(found, chance)["slope"]
    rough = replace(found, grain=1.5 * NORMAL**2)
    assert intervals_of(rough, chance)["slope"] == pytest.approx((2.0 * low, 2.0 * high))
    assert intervals_of(rough, chance, {"slope": 3.0})["slope"] == pytest.approx((3.0 * low, 3.0 * high))
    assert not jumps(found, chance)
    (said,) = jumps(rough, chance)
    assert said.startswith("the misfit jumps by some 5.8 ") and "are 2.0 times as wide" in said
    noisy: Any = SimpleNamespace(median=1.0, misfit=1.3, gain=0.0)
    assert not jumps(rough, noisy), "against what else is left it is little"
