"""Two simulated closures stand for all of them only where the machine comes back to where it was."""

from dataclasses import replace

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.features import build_features, compact_end
from hannes_lab.hand import HandRig
from hannes_lab.hide import make_set
from hannes_lab.recorded import make_trial
from hannes_lab.trials import SAME, Trial
from hannes_sim.effect import load_effect

SIGNALS = ("encoder_position", "motor_current")


@pytest.fixture(scope="module")
def trial() -> Trial:
    recordings, _ = make_set(Model.load(), [], seed=41, closures=6, conditions=("fast",))
    return make_trial(recordings[0])


def ticks_and_worst(trial: Trial, level: float) -> tuple[int, float]:
    """Length of the simulation, and the largest difference of predicted closures from those of the whole one."""
    model = Model.load().with_effect(load_effect("joint_friction").entry({"level": level}))
    rig, features = HandRig([trial]), build_features([trial], SIGNALS)
    whole = rig.simulate(model, {}, trial, trial.reference)
    run = rig.simulate(model, {}, trial, trial.reference[: compact_end(trial)])
    worst = 0.0
    for block, predicted in zip(features.blocks, features.closures(rig, model, {}), strict=True):
        apart = np.abs(predicted - block.predicted(whole[block.signal], False))
        worst = max(worst, float(apart.max()) / float(np.ptp(block.measured)))
    return run["encoder_position"].size, worst


def test_a_hand_that_opens_is_simulated_for_two_closures(trial):
    ticks, worst = ticks_and_worst(trial, 0.0)
    assert ticks == compact_end(trial) < trial.reference.size
    assert worst < 1e-3


def test_a_hand_whose_joints_stick_is_simulated_whole(trial):
    """Its fingers stay further closed with every closure; two closures would be off by a hundredth and more."""
    ticks, worst = ticks_and_worst(trial, 0.03)
    assert ticks == trial.reference.size
    assert worst == 0.0


def by_hand(trial: Trial, scatter: float) -> Trial:
    """The trial with closures of which the amplitudes differ, as those of an operator do."""
    rng = np.random.default_rng(3)
    factor = np.ones(trial.reference.size)
    for closure in trial.closures:
        ticks = slice(round(closure.start / trial.period), round(closure.stop / trial.period))
        factor[ticks] = 1.0 + scatter * rng.standard_normal()
    return replace(trial, reference=trial.reference * factor)


def test_closures_that_an_operator_repeats_nearly_are_simulated_for_two(trial):
    """What they differ by is exact where it was taken, and hardly another for a model that is a tenth off."""
    trial = by_hand(trial, 0.004)
    assert SAME < trial.apart < 0.02 and compact_end(trial, SAME) is None
    model, rig = Model.load(), HandRig([trial])
    features = build_features([trial], SIGNALS)
    assert features.nearly == (0,)
    compacted = features.compacted(rig, model, {})
    off = {"motor.resistance": 1.1 * model.parameters.value("motor.resistance")}
    for values, part in (({}, 1e-9), (off, 0.1)):
        exact, quick = (f.closures(rig, model, values) for f in (features, compacted))
        bare = [replace(block, beside=np.zeros_like(block.measured)) for block in compacted.blocks]
        plain = replace(compacted, blocks=tuple(bare))
        for block, a, b, c in zip(
            features.blocks, exact, quick, plain.closures(rig, model, values), strict=True
        ):
            left, without = (float(np.sqrt(np.mean((a - other) ** 2))) for other in (b, c))
            assert without > 1e-3 * float(np.ptp(block.measured))
            assert left < part * without


def test_what_nobody_described_unwinds_no_farther_than_its_encoder_showed(trial):
    """The pulley of the model runs on along a slack wire; a recording that says what made it is simulated so.

    A bounce at the stop is not where the hand comes to rest.
    """
    model, (time, reading) = Model.load(), trial.signals["encoder_position"]
    reading = np.maximum(reading, -0.05)
    bounce = (time > time[0] + 0.4) & (time < time[0] + 0.5)
    assert bounce.any()
    shown = {"encoder_position": (time, np.where(bounce, -0.3, reading))}
    strange = replace(trial, signals={**trial.signals, **shown}, options={})
    fast = trial.reference.copy()
    for closure in trial.closures:
        opening = np.arange(fast.size) * trial.period > 0.5 * (closure.start + closure.stop)
        fast[opening & (np.arange(fast.size) * trial.period < closure.stop)] = 0.0
    lowest = {}
    for name, one in (("described", trial), ("strange", strange)):
        run = HandRig([one]).simulate(model, {"encoder.zero@fast": 0.02}, one, fast)
        lowest[name] = float(run["encoder_position"].min())
    assert lowest["described"] < -0.1
    assert lowest["strange"] == pytest.approx(-0.05, abs=1e-6)
