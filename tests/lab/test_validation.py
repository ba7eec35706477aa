"""The rows of the validation: the laws behind them, and what the table says of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hannes_description.errors import HannesError
from hannes_description.joints import DIGITS, FINGERS
from hannes_description.model import Model
from hannes_description.parameters import read_yaml
from hannes_lab.validation import (
    convergence,
    currents,
    double_pendulum,
    fitting,
    hypotheses,
    least_force,
    runtime,
)
from hannes_lab.validation.cli import run as run_rows
from hannes_lab.validation.double_pendulum import Pendulum
from hannes_lab.validation.table import Figure, Section, markdown
from hannes_sim.mujoco_plant import MujocoPlant
from scipy.signal import medfilt

HAND = Model.load("thesis_hand")


def test_lagranges_equations_keep_the_energy() -> None:
    """An independent check of the equations: along a trajectory the energy stands still."""
    p = Pendulum.of(HAND.parameters, "middle")
    s, dt = np.array([0.3, 0.7, 0.0, 0.0]), 1e-5
    start = p.energy(s)

    def rate(x: np.ndarray) -> np.ndarray:
        return np.array([x[2], x[3], *p.acceleration(*x)])

    for _ in range(8000):
        s = s + dt * rate(s + 0.5 * dt * rate(s))  # midpoint rule
    gained = abs(s[2]) + abs(s[3])
    assert gained > 1.0
    assert p.energy(s) == pytest.approx(start, abs=1e-7 * abs(start) + 1e-9)


def test_drop_times_agree_with_the_independent_integration() -> None:
    section = double_pendulum.run(HAND)
    assert len(section.figures) == 16
    assert all(f.met for f in section.figures)


@pytest.mark.parametrize("digit", DIGITS)
def test_the_onset_is_where_the_balance_says(digit: str) -> None:
    lever = least_force.lever_of(HAND)
    expected = least_force.balance(HAND, lever)[digit]
    assert expected == pytest.approx(least_force.ANALYTIC[digit], rel=1e-3)
    assert least_force.onset(HAND, digit, lever) == pytest.approx(expected, rel=5e-3)


def test_a_model_with_another_preload_moves_at_another_force() -> None:
    hand = HAND.with_values({"springs.index_preload": 1.3 * HAND.parameters.value("springs.index_preload")})
    lever = least_force.lever_of(hand)
    assert least_force.onset(hand, "index", lever) == pytest.approx(
        least_force.balance(hand, lever)["index"], rel=5e-3
    )
    assert least_force.balance(hand, lever)["index"] > 1.2 * least_force.balance(HAND, lever)["index"]


def test_slopes_of_a_line_and_of_a_kink() -> None:
    t = np.arange(0.0, 1.0, 0.01)
    assert currents.slopes(t, 3.0 * t - 1.0) == pytest.approx(3.0)
    kink = np.maximum(0.0, t - 0.5) * 4.0
    assert currents.slopes(t, kink).max() == pytest.approx(4.0)
    assert currents.slopes(t, kink).min() == pytest.approx(0.0, abs=1e-12)


def test_figures_of_a_made_closure() -> None:
    """A trapezoid: 0.2 A void, a rise of 5 A/s to 2 A, a fall of 8 A/s to nothing, 0.15 A opening."""
    t = np.arange(0.0, 2.3, 1e-3)
    i = np.interp(t, [0.0, 0.5, 0.86, 1.05, 1.3, 1.35, 2.3], [0.2, 0.2, 2.0, 2.0, 0.0, 0.15, 0.15])
    found = currents.figures(currents.Closure(t, i, t, t, 0.0 * t, i))
    assert found["maximum"] == pytest.approx(2.0)
    assert found["slope_closing"] == pytest.approx(5.0, rel=1e-3)
    assert found["slope_opening"] == pytest.approx(-8.0, rel=1e-3)
    assert found["average_opening"] == pytest.approx(0.15, rel=1e-3)
    assert 0.2 <= found["average_closing"] < 0.21


def test_the_shipped_hand_reaches_what_it_was_fitted_to() -> None:
    found = fitting.predict(HAND, {fitting.LEVER: least_force.lever_of(HAND)})
    for target in fitting.TARGETS:
        tolerance = 0.1 if target.name == "plateau" else 0.03
        assert found[target.name] == pytest.approx(target.value, rel=tolerance), target.row
    free = currents.closure_time(currents.frictionless(HAND))
    assert free < 1.0
    assert free < 0.6 * found["closure_time"]


def test_the_shipped_hand_says_what_was_fitted_to_what() -> None:
    assert HAND.provenance["targets"] == len(fitting.TARGETS)
    assert HAND.provenance["free_parameters"] == len(fitting.coordinates(fitting.base_model()))
    for name in HAND.provenance["intervals_95"]:
        if name in HAND.parameters:
            entry = HAND.parameters[name]
            assert entry.status == "identified" and "R12" in entry.source


def test_a_finger_at_its_stop_does_not_strike_the_object() -> None:
    """A contact's virtual mass times the jerk of a finger that strikes its own stop would spike the grip force."""
    force = currents.simulate(HAND, currents.object_for(HAND, "soft")).force
    assert force.max() > 5.0
    assert np.abs(force - medfilt(force, 21)).max() < 0.3


def test_wires_carts_and_energy_hold() -> None:
    held = convergence.statics(HAND)
    assert held["tension"] < 1e-3 and held["carts"] < 1e-3 and held["moments"] < 2e-3
    assert convergence.energy_drift(HAND) < 0.01


def test_rows_that_fall_short_say_so() -> None:
    near = Figure("R08", "a", "A", 0.25, 0.26, 0.251)
    far = Figure("R09", "b", "A/s", 7.0, 6.5, 9.0)
    limit = Figure("R05", "c", "s", 1.189, 1.18, 1.21, limit=0.005)
    ceiling = Figure("R15", "d", "rad", 0.01, 0.02, 0.012, kind="at_most")
    assert near.met and near.closer
    assert not far.met and far.closer is False
    assert not limit.met and not ceiling.met
    page = markdown([Section(("R08",), "x", (near, far, limit, ceiling))])
    assert page.count("**no**") == 3 and "not closer" in page
    assert math.isnan(Figure("R06", "e", "s", 1.0, math.nan, 0.6).thesis_error)


def test_a_row_by_itself_and_an_unknown_one() -> None:
    (section,) = run_rows(HAND, ["R02"])
    assert {f.name.split()[0] for f in section.figures} >= set(FINGERS)
    with pytest.raises(HannesError, match="R99"):
        run_rows(HAND, ["R99"])


def test_every_law_that_r12_is_tried_with_can_be_fitted_and_applied() -> None:
    for name, law in fitting.LAWS.items():
        base = fitting.base_model(law=name)
        free = fitting.coordinates(base, name)
        own = [c.name for c in free if law.free is not None and c.name == law.free[0]]
        assert len(own) == (law.free is not None)
        assert len(free) <= len(fitting.targets_of(name))
        hand = fitting.applied(base, dict.fromkeys(own, 2.0 * law.free[1]) if law.free else {}, name)
        assert (hand.sha256 != base.sha256) and len(hand.effects) == (law.effect is not None)
    with pytest.raises(HannesError, match="glue"):
        fitting.base_model(law="glue")


def test_the_kept_laws_are_those_of_the_fit() -> None:
    kept = read_yaml(hypotheses.FILE, "laws of R12")
    assert set(kept) == set(hypotheses.OTHERS)
    for name, entry in kept.items():
        names = {c.name for c in fitting.coordinates(fitting.base_model(law=name), name)}
        assert set(entry["values"]) == names
        assert entry["free"] == len(names) and entry["soft_stiffness"] > 0.0


def test_dry_friction_of_a_joint_has_a_door() -> None:
    plant = MujocoPlant(HAND)
    plant.set_dry_friction({"index_mcp": 0.5})
    plant.advance(0.0, 1)
    assert plant.model.dof_frictionloss[plant.model.joint("index_mcp").dofadr[0]] == 0.5
    for wrong in ({"index_toe": 0.1}, {"index_mcp": -0.1}, {"index_mcp": math.nan}):
        with pytest.raises(HannesError, match="index"):
            plant.set_dry_friction(wrong)


def test_the_work_of_the_solver_is_counted() -> None:
    rows, iterations = runtime.solver_work(HAND, None)
    assert 13.0 < rows < 60.0 and 0.5 < iterations < 10.0
