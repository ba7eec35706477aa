"""What took no part in a fit must not be known to it."""

from dataclasses import replace

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.errors import SignalError, held_out_condition_errors, held_out_conditions, overall
from hannes_lab.hide import make_set
from hannes_lab.prepare import prepare
from hannes_lab.search import Candidate, Search
from hannes_lab.trials import make_trial
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
