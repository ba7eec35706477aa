"""Two simulated closures stand for all of them only where the machine comes back to where it was."""

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.features import build_features, compact_end
from hannes_lab.hand import HandRig
from hannes_lab.hide import make_set
from hannes_lab.trials import Trial, make_trial
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
