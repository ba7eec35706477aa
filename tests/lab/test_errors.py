"""What took no part in a fit must not be known to it."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.errors import (
    SignalError,
    apart_alone,
    held_out_condition_errors,
    held_out_conditions,
    overall,
    signal_errors,
)
from hannes_lab.features import Block
from hannes_lab.hide import make_set
from hannes_lab.prepare import prepare
from hannes_lab.recorded import make_trial
from hannes_lab.search import Candidate, Search
from hannes_sim.effect import strength_of


def left_out(search: Search, candidate: Candidate) -> dict[str, tuple[SignalError, ...]]:
    fit = candidate.fit
    return held_out_condition_errors(search.problem, fit.model, fit.coordinates, fit.z)


def test_an_effect_that_only_the_left_out_condition_shows_does_not_foretell_it() -> None:
    """Its strength was fitted to all conditions, and none that is left says anything about it."""
    model = Model.load()
    recordings, _ = make_set(
        model,
        [strength_of("object_damping", 3.0)],
        seed=8,
        closures=8,
        conditions=("fast", "grasp_fast"),
    )
    prepared = prepare([make_trial(r) for r in recordings], model)
    search = Search(prepared.problem, model, prepared.nuisances, {"object_damping": "object_damping"})
    without = search.null()
    damped = search.add(without, "object_damping")
    assert damped.fit.cost < 0.5 * without.fit.cost, "fitted to both, it explains the grasp"
    found = [
        held_out_conditions(search.problem, c.fit.model, c.fit.coordinates, c.fit.z)["grasp_fast"]
        for c in (without, damped)
    ]
    # What is left of the grasp chatters on the undamped bar, and ends a tenth apart from start to start.
    grasp = [overall(errors) for errors, _ in found]
    assert grasp[1] > 0.5 * grasp[0] > 10.0, "left out, it cannot be foretold"
    assert abs(found[1][1]["object_damping.coefficient"]) < 1e-6


def test_what_another_condition_of_the_recording_tells_is_not_fitted_to_the_left_out_one() -> None:
    """An encoder that jumps half way: its zero is known from the first half, and wrong in the second."""
    model = Model.load()
    (recording,), _ = make_set(model, [], seed=8, closures=10, conditions=("fast",))
    trial = make_trial(recording)
    time, encoder = trial.signals["encoder_position"]
    late = trial.closures[5].start
    trial = replace(
        trial,
        signals={**trial.signals, "encoder_position": (time, encoder + np.where(time >= late, 0.2, 0.0))},
        closures=tuple(replace(c, condition="late") if c.start >= late else c for c in trial.closures),
    )
    prepared = prepare([trial], model)
    zero = f"encoder.zero@{trial.name}"
    assert zero in {n.name for n in prepared.nuisances}
    search = Search(prepared.problem, model, prepared.nuisances, {})
    position = next(e for e in left_out(search, search.null())["late"] if e.signal == "encoder_position")
    assert position.rmse == pytest.approx(0.2, rel=0.02)


def blocks_of(biases: dict[str, float], seed: int = 0) -> tuple[Any, list[np.ndarray]]:
    """Two conditions of three repeats and some of one, noise of 1 a sample, predicted as 0; means other by `biases`."""
    rng, phase = np.random.default_rng(seed), np.linspace(0.0, 1.0, 200)
    empty = np.zeros((0, 0), dtype=np.int64)

    def block(condition: str, n: int) -> Block:
        measured = rng.normal(size=(n, phase.size)) + biases.get(condition, 0.0)
        return Block(0, condition, "motor_current", phase, measured, (empty, empty, empty), None, "A")

    blocks = [block("slow", 3), block("fast", 3), *(block(name, 1) for name in ("once", "twice", "thrice"))]
    features: Any = SimpleNamespace(blocks=tuple(blocks))
    return features, [np.zeros_like(b.measured) for b in blocks]


def test_a_bias_of_what_was_recorded_once_is_no_repeatability() -> None:
    """Over all conditions its error is hardly more than the others repeat; a noise of the same size is none."""
    features, predicted = blocks_of({"once": 1.2, "twice": 0.1})
    (one,) = apart_alone(features, predicted, 1.25)
    assert one.condition == "once" and one.ratio == pytest.approx(1.6, abs=0.2)
    assert overall(signal_errors(features, predicted)) < 1.25
    for seed in range(20):
        assert apart_alone(*blocks_of({}, seed), 1.25) == ()
    assert apart_alone(*blocks_of({"once": 0.5}), 1.25) == (), "that is within what the others repeat to"
