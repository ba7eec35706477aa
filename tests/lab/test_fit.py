"""A fit in closed loop: derivatives are taken seldom, and it ends where one that takes them always would."""

from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.fit import Derivatives, Fit, finite_differences, fit, prior_weights
from hannes_lab.hide import make_set
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.problem import Coordinate, Problem, nuisance_coordinate
from hannes_lab.recorded import make_trial
from hannes_lab.secants import over_its_spread
from scipy.optimize import least_squares


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    recordings, _ = make_set(Model.load(), [], seed=43, closures=6, conditions=("fast", "grasp_fast"))
    return prepare([make_trial(r) for r in recordings], Model.load())


def test_a_fit_ends_where_fresh_derivatives_at_every_step_lead(prepared: Prepared) -> None:
    problem, model = prepared.problem, prepared.model
    coordinates = [nuisance_coordinate(n) for n in prepared.nuisances]
    prior = prior_weights(coordinates)
    low, high = np.array([c.bounds for c in coordinates]).T
    start = np.full(len(coordinates), 0.5)

    def residual(z: np.ndarray) -> np.ndarray:
        values = {c.name: c.value(float(v)) for c, v in zip(coordinates, z, strict=True)}
        return np.concatenate([problem.residual(model, values), prior * z])

    def all_afresh(z: np.ndarray) -> np.ndarray:
        at = residual(z)
        steps = [c.inside_step(float(v)) for c, v in zip(coordinates, z, strict=True)]
        moved = [residual(z + step * row) for step, row in zip(steps, np.eye(z.size), strict=True)]
        return np.column_stack([(r - at) / step for r, step in zip(moved, steps, strict=True)])

    problem.counts.simulations = 0
    wanted = least_squares(residual, start, jac=all_afresh, bounds=(low, high), ftol=1e-5, xtol=1e-5)
    of_all, problem.counts.simulations = problem.simulations, 0
    found = fit(problem, model, coordinates, start, evaluations=25)
    assert found.complete
    assert found.cost == pytest.approx(2.0 * wanted.cost, rel=0.01)
    assert problem.simulations < 0.9 * of_all


class Curved:
    """A problem of two coordinates, r = A z + 0.1 z^2, that counts its simulations."""

    failures = 0
    size = 2

    def __init__(self) -> None:
        self.simulations = 0
        self.features, self.units = self, frozenset[str]()

    def residual(self, model: object, values: dict[str, float]) -> np.ndarray:
        self.simulations += 1
        return self.at(np.array([values["a"], values["b"]]))

    @staticmethod
    def at(z: np.ndarray) -> np.ndarray:
        return np.array([[300.0, 20.0], [50.0, 400.0]]) @ z + 10.0 * z**2 + 5.0


A, B = (Coordinate(name, 0.0, 1.0, False, -10.0, 10.0, True, 1e-4) for name in "ab")
BEGIN = np.array([1.0, 1.0])


def as_problem(curved: Curved) -> Problem:
    """It has all of a problem that derivatives need."""
    return cast(Problem, curved)


def derivatives(problem: Curved, known: dict[str, np.ndarray], most: int = 10) -> Derivatives:
    def cost(r: np.ndarray, z: np.ndarray) -> float:
        return float(r @ r)

    found = Derivatives(
        as_problem(problem), Model.load(), (A, B), known, {}, cost, np.ones(2, dtype=bool), most
    )
    found.at(BEGIN, problem.at(BEGIN))
    return found


def test_a_step_teaches_the_derivatives_half_of_what_they_missed() -> None:
    problem = Curved()
    taught = derivatives(problem, {})
    before = taught.jacobian
    assert taught.fresh and problem.simulations == 2
    z = np.array([0.8, 0.85])
    after = taught.at(z, problem.at(z))
    assert problem.simulations == 2 and not taught.fresh
    made, promised = problem.at(z) - problem.at(BEGIN), before @ (z - BEGIN)
    np.testing.assert_allclose(after @ (z - BEGIN), 0.5 * (made + promised))
    assert np.abs(made - promised).min() > 0.1
    taught.forget()
    taught.at(z, problem.at(z))
    assert problem.simulations == 4 and taught.fresh


def test_what_moves_nothing_together_is_not_taught_to() -> None:
    """The zero of a hand and those of its recordings: a fit would go far along what only their priors hold."""
    alike = {"a": np.array([300.0, 50.0]), "b": np.array([-300.0, -50.0])}
    taught = derivatives(Curved(), alike)
    z = np.array([1.5, 1.4])
    after = taught.at(z, Curved.at(z))
    assert np.abs(after[:, 0] - alike["a"]).max() > 10.0
    np.testing.assert_allclose(after @ [1.0, 1.0], 0.0, atol=1e-9)


def test_derivatives_that_promised_too_much_are_taken_anew_unless_they_are_known_or_enough_were() -> None:
    worse = np.array([1.5, 1.5])
    wrong = {"a": np.array([-300.0, 0.0]), "b": np.array([0.0, -400.0])}
    for known, most, taken in (({}, 10, 4), ({}, 3, 2), (wrong, 10, 0), ({"a": wrong["a"]}, 10, 2)):
        problem = Curved()
        derivatives(problem, known, most).at(worse, problem.at(worse))
        assert problem.simulations == taken


class Cliff(Curved):
    """The same, which diverges where a is larger than an edge (or anything but what it is)."""

    failed = 1e6

    def __init__(self, edge: float, lowest: float = -np.inf) -> None:
        super().__init__()
        self.edge, self.lowest = edge, lowest

    def residual(self, model: object, values: dict[str, float]) -> np.ndarray:
        if not self.lowest <= values["a"] <= self.edge:
            self.simulations, self.failures = self.simulations + 1, self.failures + 1
            return np.full(2, self.failed)
        return super().residual(model, values)


def test_a_derivative_at_the_edge_of_what_can_be_simulated_is_taken_to_the_other_side() -> None:
    for edge, lowest in ((1.0, -np.inf), (1.0 + 5e-5, 1.0 - 5e-5)):
        problem = Cliff(edge, lowest)
        found = finite_differences(
            as_problem(problem), Model.load(), (A, B), BEGIN, problem.at(BEGIN), (0, 1)
        )
        np.testing.assert_allclose(found, [[320.0, 20.0], [50.0, 420.0]], rtol=1e-3)
        assert problem.failures > 0
    alone = Cliff(1.0, 1.0)
    found = finite_differences(as_problem(alone), Model.load(), (A, B), BEGIN, alone.at(BEGIN), (0, 1))
    np.testing.assert_array_equal(found[:, 0], 0.0)
    assert found[1, 1] == pytest.approx(420.0, rel=1e-3)


def test_an_interval_at_the_edge_is_taken_from_the_side_that_can_be_simulated() -> None:
    problem = Cliff(1.0)
    fit_ = Fit(Model.load(), (A, B), BEGIN, 0.0, problem.at(BEGIN), np.array([[320.0, 20.0], [50.0, 420.0]]))
    wider = over_its_spread(as_problem(problem), fit_)
    assert problem.failures > 0
    np.testing.assert_allclose(wider.jacobian, fit_.jacobian, rtol=0.01)


def test_a_simulation_that_diverges_costs_more_than_any_that_does_not() -> None:
    """Of a machine that repeats well an honest error is thousands of its standard deviations."""
    recordings, _ = make_set(Model.load(), [], seed=1, closures=6, conditions=["fast"], scatter=0.0)
    prepared = prepare([make_trial(r) for r in recordings], Model.load())
    fine = replace(
        prepared.problem, whitener=tuple((rows, 1e-4 * lower) for rows, lower in prepared.problem.whitener)
    )
    honest = fine.residual(prepared.model, {"motor.kt": 0.5 * prepared.model.parameters.value("motor.kt")})
    diverged = fine.residual(prepared.model, {"hand.stiffness": -1e9, "friction.coulomb": float("nan")})
    assert fine.failures == 1 and honest @ honest > honest.size * 1e6
    assert diverged @ diverged > 10.0 * (honest @ honest)
