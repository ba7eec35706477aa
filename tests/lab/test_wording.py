"""Notes that an answer carries beside its summary."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.diagnosis import Fall
from hannes_lab.directions import never_turns
from hannes_lab.fit import Fit, nuisance_table
from hannes_lab.problem import nuisance_coordinate
from hannes_lab.rig import Nuisance
from hannes_lab.search import Candidate
from hannes_lab.trials import Closure, Trial
from hannes_lab.wording import _identifiability, _one_way, notes, phase_moves, unmoved, worse_fitted


def test_a_condition_that_is_alone_in_its_direction_is_told() -> None:
    """What differs between directions is not foretold from the other one; square waves step at a closure's start."""
    ticks = np.arange(4000) * 1e-3
    reference = np.where((ticks % 2.0) < 1.0, 1.0, 0.0)
    place = np.where((ticks % 2.0) < 1.0, 1.0 - np.exp(-(ticks % 1.0) / 0.1), np.exp(-(ticks % 1.0) / 0.1))
    noise = 1e-3 * np.random.default_rng(0).standard_normal(ticks.size)
    names = ("up", "down", "up", "down")
    closures = tuple(Closure(k + 0.005, k + 0.995, name) for k, name in enumerate(names))
    trial = Trial("t", 1e-3, reference, {"encoder_position": (ticks, place + noise)}, closures)
    (said,) = _one_way([trial])
    assert said.startswith("'up' is the only condition that goes its way")
    second = replace(
        trial, name="u", closures=(Closure(2.005, 2.995, "up 2"), Closure(3.005, 3.995, "down 2"))
    )
    assert not _one_way([trial, second]), "each direction has another"
    both = replace(trial, closures=(Closure(0.005, 1.995, "lap"), Closure(2.005, 2.995, "up")))
    assert not _one_way([both]), "a lap goes both ways"
    up = replace(trial, closures=tuple(closure for closure in closures if closure.condition == "up"))
    (said,) = _one_way([up])
    assert said.startswith("every condition goes the same way")
    assert never_turns([up]) and not never_turns([trial])
    assert not never_turns([both]), "a lap goes back"
    swings = replace(up, signals={"encoder_position": (ticks, place + 0.1 * np.sin(20.0 * ticks))})
    assert not never_turns([swings]), "it comes back on its way"


def test_a_wave_of_another_phase_in_each_condition_is_told() -> None:
    """A real motor's ripple of the right amplitude was dropped for a phase that the log's angles did not hold."""

    def said(name: str, *there: tuple[float, float]) -> str:
        z = {f"{name}.sine": 3.0, f"{name}.cosine": 0.0}
        parameters = [
            SimpleNamespace(name=own, vanishing=None if own == "period" else 0.0, period=own == "period")
            for own in ("sine", "cosine", "period")
        ]
        kind = SimpleNamespace(parameters=parameters if name == "cogging" else parameters[:2])
        search: Any = SimpleNamespace(effect=lambda _: kind, strengths=lambda _: list(z))
        found: Any = SimpleNamespace(names=(name,), fit=SimpleNamespace(z_of=z.get))
        left_out = {str(k): dict(zip(z, one, strict=True)) for k, one in enumerate(there)}
        return phase_moves(search, found, cast(Any, SimpleNamespace(left_out=left_out)))

    assert "its phase moves by up to 1.6 rad" in said("cogging", (3.0, 0.1), (0.0, 3.0))
    assert not said("cogging", (3.0, 0.1), (3.0, -0.3)), "it stays"
    assert not said("cogging", (3.0, 0.1), (0.0, 0.5)), "another strength is none"
    assert not said("gravity", (3.0, 0.1), (0.0, 3.0)), "no wave"


def test_a_tolerance_of_what_moves_nothing_is_no_result() -> None:
    model = Model.load()
    nuisances = [
        Nuisance("friction.coulomb", 0.02, 0.1, True, 0.0, "N.m"),
        Nuisance("log.reference_delay", 0.0, 0.01, False, 0.0, "s"),
    ]
    coordinates = tuple(nuisance_coordinate(n) for n in nuisances)
    jacobian = np.array([[1.0, 0.0], [2.0, 1e-9]])
    found = Fit(model, coordinates, np.array([0.5, 1e-12]), 1.0, np.zeros(2), jacobian)
    assert list(nuisance_table(found)) == ["friction.coulomb"]
    (said,) = unmoved(found)
    assert said.startswith("log.reference_delay: has a tolerance, but moves none of the compared signals")
    five = [replace(coordinates[1], name=f"{name}@a") for name in "vwxyz"]
    more = replace(found, coordinates=tuple(five), z=np.zeros(5), jacobian=np.zeros((2, 5)))
    assert unmoved(more)[0].startswith("v, w, x, y and 1 more: have tolerances, but move none")


@pytest.mark.parametrize(
    ("closures", "conditions", "said"),
    [
        ((8.0, 8.5), (16.6, 52.1), ["further off as fitted (8.50)", "3.1 times worse"]),
        ((8.0, 7.9), (2.0, 40.0), ["20.0 times worse"]),
        ((8.0, 8.5), (16.6, 20.0), ["further off as fitted (8.50)"]),
        ((8.0, 7.9), (16.6, math.inf), []),
        ((8.0, 7.9), (math.nan, math.nan), []),
    ],
)
def test_a_fit_that_foretells_far_worse_than_the_model_as_given_is_told(
    closures: tuple[float, float], conditions: tuple[float, float], said: list[str]
) -> None:
    falls = [
        Fall("", own, own, {}, (), {}, left_out) for own, left_out in zip(closures, conditions, strict=True)
    ]
    found = worse_fitted(falls)
    assert len(found) == len(said) and all(words in note for words, note in zip(said, found, strict=True))
    assert not said or "20.0" not in said[-1] or "the gains, the supply or the load" in found[-1]


def test_the_same_where_nothing_was_repeated() -> None:
    """There errors count in what the fitted nominal model leaves."""
    nan = math.nan
    falls = [Fall("", nan, nan, {}, (), {"position": error}) for error in (0.1, 1.0)]
    assert "10.0 times worse" in worse_fitted(falls)[-1]


def test_an_answer_has_these_notes() -> None:
    """On a machine where conditions that are left out decide."""
    ticks = np.arange(2000) * 1e-3
    place = np.where(ticks < 1.0, ticks, 2.0 - ticks)
    closures = (Closure(0.005, 0.995, "up"), Closure(1.005, 1.995, "down"))
    trial = Trial("t", 1e-3, place, {"encoder_position": (ticks, place)}, closures)
    model, idle = (
        Model.load(),
        nuisance_coordinate(Nuisance("log.reference_delay", 0.0, 0.01, False, 0.0, "s")),
    )
    best = Candidate((), Fit(model, (idle,), np.zeros(1), 0.0, np.zeros(2), np.zeros((2, 1))), 0.0)
    problem = SimpleNamespace(
        features=SimpleNamespace(trials=(trial,), blocks=(), conditions=("up", "down"), repeated=False),
        rig=SimpleNamespace(foreign=True),
        failures=0,
        simulations=1,
        discrepancy=(),
    )
    search: Any = SimpleNamespace(problem=problem, model=model, nuisances=(), sources={})

    def told(verdict: str, greedy: bool) -> list[bool]:
        said = notes(search, best, verdict, (), (), greedy, None)
        return [
            any(words in note for note in said) for words in ("goes its way", "moves none of the compared")
        ]

    assert told("unknown", True) == [True, True]
    assert told("unknown", False) == told("nothing", True) == [False, True]


def test_what_moves_the_data_alike_is_told_once() -> None:
    """A factor that all forces share is one sentence, not one for each pair; of tolerances alone nothing is said."""
    rng = np.random.default_rng(4)
    force, other, third = rng.standard_normal((3, 200))

    def told(columns: dict[str, np.ndarray], *known: str) -> list[str]:
        coordinates = tuple(
            replace(nuisance_coordinate(Nuisance(n, 1.0, 0.1, True, 0.0)), prior=n in known) for n in columns
        )
        jacobian = 1e3 * np.column_stack([c + 1e-3 * rng.standard_normal(200) for c in columns.values()])
        z = np.zeros(len(columns))
        return _identifiability(
            Candidate((), Fit(Model.load(), coordinates, z, 0.0, np.zeros(200), jacobian), 0.0)
        )

    # The four together move nothing: one factor on all of them is told by what is known of two.
    alike = {"motor.kt": force, "friction": other, "cogging.sine": third}
    alike["cogging.cosine"] = -force - other - third
    (said,) = told({**alike, "slack": rng.standard_normal(200)}, "motor.kt", "friction")
    assert said.startswith("cogging.sine, cogging.cosine, motor.kt and friction cannot be told apart well")
    assert "correlations up to 0.99" in said or "correlations up to 1.000" in said
    (said,) = told({"hand.stiffness": force, "glove": force, "slack": other}, "hand.stiffness")
    assert said.startswith("glove and hand.stiffness cannot be told apart") and "(correlation -1.000)" in said
    assert not told({"motor.kt": force, "friction": force, "slack": other}, "motor.kt", "friction")
