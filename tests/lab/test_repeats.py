"""Of closures that repeat each other only as many are simulated as do not yet end as the one before."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.clock import REFERENCE_DELAY
from hannes_lab.features import build_features, compact_end
from hannes_lab.hand import HandRig
from hannes_lab.hide import make_set
from hannes_lab.recorded import make_trial
from hannes_lab.repeats import FEW, end_of, few
from hannes_lab.trials import Trial
from hannes_sim.effect import load_effect
from hannes_sim.rollout import rollout


@pytest.fixture(scope="module")
def trial() -> Trial:
    recordings, _ = make_set(Model.load(), [], seed=41, closures=10, conditions=("fast",))
    return make_trial(recordings[0])


def simulated(trial: Trial, **hysteresis: float) -> tuple[list[int], float, float]:
    """Ticks of each rollout, and how far closures are from those of the whole trial: as predicted, and if the second
    one stood for all that follow."""
    model = Model.load().with_effect(load_effect("glove_hysteresis").entry(hysteresis))
    ticks: list[int] = []

    class Counted(HandRig):
        def run(self, model, values, trial, reference):
            ticks.append(reference.size)
            return super().run(model, values, trial, reference)

    rig, features = Counted([trial]), build_features([trial], ("motor_current",))
    (block,) = features.blocks
    whole = rig.simulate(model, {}, trial, trial.reference)["motor_current"]
    ticks.clear()
    exact, (found,) = block.predicted(whole, False), features.closures(rig, model, {})
    span = float(np.ptp(exact))
    copied = block.predicted(whole[: compact_end(trial)], True)
    return ticks, float(np.abs(found - exact).max()) / span, float(np.abs(copied - exact).max()) / span


def test_closures_of_one_condition_are_counted(trial: Trial) -> None:
    assert few(trial) == FEW and few(trial.only(trial.closures[:3])) == 3


def test_conditions_one_after_the_other_are_simulated_whole(trial: Trial) -> None:
    """All closures of the first are simulated anyway: none of them is taken for another."""
    (*others, last) = trial.closures
    block = replace(trial, closures=(*others, replace(last, condition="other")))
    assert block.repeats == (0, *[1] * (len(others) - 1), len(others)) and block.in_turn
    assert compact_end(block) is None and compact_end(trial) is not None
    in_turn = tuple(replace(c, condition=f"{k % 2}") for k, c in enumerate(trial.closures))
    laps = replace(trial, closures=in_turn)
    assert laps.repeats == (0, 1, *[2, 3] * 4) and compact_end(laps) == end_of(trial, 4)
    assert few(laps) == 2 * FEW


def test_a_glove_that_creeps_back_within_a_few_closures(trial: Trial) -> None:
    ticks, worst, of_two = simulated(trial, stiffness=0.004, relaxation=0.3)
    assert ticks == [compact_end(trial), end_of(trial, FEW)]
    assert ticks[1] < 0.6 * trial.reference.size
    assert worst < 0.05 * of_two and of_two > 1e-3


def test_a_glove_that_creeps_for_longer_than_that(trial: Trial) -> None:
    ticks, worst, _ = simulated(trial, stiffness=0.004, relaxation=2.0)
    assert ticks == [compact_end(trial), end_of(trial, FEW), trial.reference.size]
    assert worst == 0.0


def test_a_longer_simulation_goes_on_from_the_shorter_one(
    trial: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the last bit as one from the beginning; and that is made where anything is another."""
    short, model = trial.reference[: compact_end(trial)], Model.load()
    made: list[tuple[int, int]] = []

    def counted(plant: Any, law: Any, reference: np.ndarray, *, begin: int = 0, **others: Any) -> Any:
        made.append((begin, reference.size))
        return rollout(plant, law, reference, begin=begin, **others)

    monkeypatch.setattr("hannes_lab.rig.rollout", counted)
    n, size = short.size, trial.reference.size
    values = {"control.kp": 2.5, "friction.coulomb": 0.01, f"{REFERENCE_DELAY}@{trial.name}": 0.013}
    whole = HandRig([trial]).run(model, values, trial, trial.reference)
    rig = HandRig([trial])
    rig.run(model, values, trial, short)
    on = rig.run(model, values, trial, trial.reference)
    assert made == [(0, size), (0, n), (n, size - n)]
    assert np.array_equal(on.raw, whole.raw) and np.array_equal(on.motor_voltage, whole.motor_voltage)

    for name in values:
        other = HandRig([trial])
        other.run(model, {**values, name: 0.9 * values[name]}, trial, short)
        assert np.array_equal(other.run(model, values, trial, trial.reference).raw, whole.raw), name
    rig = HandRig([trial])
    rig.run(model, values, trial, short)
    assert rig.law_used is not None
    rig.law_used.reset()  # as who tries the law does
    assert np.array_equal(rig.run(model, values, trial, trial.reference).raw, whole.raw)
    assert {begin for begin, _ in made[3:]} == {0}


def test_an_adapter_may_work_in_the_arrays_of_a_simulation(trial: Trial) -> None:
    """What it changes there is not changed once more where a longer one goes on."""

    class InPlace(HandRig):
        def run(self, model, values, trial, reference):
            done = super().run(model, values, trial, reference)
            done.encoder_position[:] -= 0.01
            done.reference_position[:] += 0.5
            return done

        def logged(self, run, trial, window=None):
            out = super().logged(run, trial, window)
            out["encoder_position"] += 0.02
            return out

    model, references = Model.load(), [trial.reference[:n].copy() for n in (5000, 9000, trial.reference.size)]
    whole = InPlace([trial]).observed(model, {}, trial, trial.reference.copy())
    rig = InPlace([trial])
    for reference in references:
        signals = rig.observed(model, {}, trial, reference)
        n = signals["encoder_position"].size
        assert np.array_equal(signals["encoder_position"], whole["encoder_position"][:n])
