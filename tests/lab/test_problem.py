"""The noise of a data set, where its signals and recordings hold different numbers of closures."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.chance import Chance, chance, noise_draws
from hannes_lab.errors import split_closures
from hannes_lab.features import Block, Features
from hannes_lab.fit import fit
from hannes_lab.hide import make_set
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.problem import Problem, build_problem, nuisance_coordinate
from hannes_lab.recorded import make_trial
from hannes_lab.rig import Nuisance

NOISE = 0.03
"""Of a signal's span, by closure: well above what the rig takes for the least."""


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    model = Model.load()
    recordings, _ = make_set(model, [], seed=11, closures=13, conditions=("fast", "grasp_fast"))
    return prepare([make_trial(r) for r in recordings], model)


def cut(block: Block, closures: int) -> Block:
    """The same signal, recorded of the first closures only."""
    full, compact = (
        None if index is None else tuple(a[:closures] for a in index) for index in (block.full, block.compact)
    )
    return replace(block, measured=block.measured[:closures], full=full, compact=compact, beside=None)


def as_measured(prepared: Prepared, features: Features, seed: int = 0) -> Problem:
    """The problem in which the closures are those of the model and independent noise."""
    rng = np.random.default_rng(seed)
    closures = features.closures(prepared.rig, prepared.model, {})
    blocks = tuple(
        replace(block, measured=closure + NOISE * np.ptp(closure) * rng.standard_normal(block.measured.shape))
        for block, closure in zip(features.blocks, closures, strict=True)
    )
    return build_problem(prepared.rig, replace(features, blocks=blocks, slices=()), prepared.model, (), {})


def mean_square(prepared: Prepared, features: Features, block: int) -> float:
    """Of the whitened residual of a perfect model in the features of one block, over a few draws of the noise."""
    return float(
        np.mean(
            [
                (as_measured(prepared, features, seed).residual(prepared.model, {})[features.slices[block]])
                ** 2
                for seed in range(6)
            ]
        )
    )


@pytest.mark.parametrize("closures", [5, 3])
def test_a_signal_of_fewer_closures_is_as_uncertain_as_those_make_it(
    prepared: Prepared, closures: int
) -> None:
    features = prepared.features
    short = next(k for k, b in enumerate(features.blocks) if b.signal == "motor_current")
    blocks = tuple(cut(b, closures) if k == short else b for k, b in enumerate(features.blocks))
    fewer = replace(features, blocks=blocks, slices=())
    problem = as_measured(prepared, fewer)
    first, second = (problem.residual(prepared.model, {}) for _ in range(2))
    assert np.isfinite(first).all() and np.array_equal(first, second)
    assert mean_square(prepared, fewer, short) == pytest.approx(1.0, rel=0.35)
    assert mean_square(prepared, fewer, (short + 1) % len(blocks)) == pytest.approx(1.0, rel=0.35)
    halves = split_closures(fewer)
    assert all(np.isfinite(as_measured(prepared, h).residual(prepared.model, {})).all() for h in halves)


def test_two_recordings_of_one_condition_have_closures_of_their_own(prepared: Prepared) -> None:
    """One of 13 and one of 5 closures: each scatters on its own, and chance draws them apart."""
    one = prepared.features
    first = [b for b in one.blocks if b.trial == 0]
    again = [replace(cut(b, 5), trial=len(one.trials)) for b in first]
    both = replace(
        one,
        trials=(*one.trials, one.trials[0]),
        blocks=(*one.blocks, *again),
        ends=(*one.ends, one.ends[0]),
        slices=(),
    )
    rig = copy(prepared.rig)
    rig.trials = both.trials
    prepared = replace(prepared, rig=rig)
    problem = as_measured(prepared, both)
    assert np.array_equal(problem.residual(prepared.model, {}), problem.residual(prepared.model, {}))
    for block in (0, len(one.blocks)):
        assert mean_square(prepared, both, block) == pytest.approx(1.0, rel=0.35)
    draws, resampled = noise_draws(problem, 200, np.random.default_rng(0))
    assert resampled
    mean = [
        draws[both.slices[k].start : both.slices[k].start + first[0].phase.size] for k in (0, len(one.blocks))
    ]
    assert abs(np.corrcoef(mean[0].ravel(), mean[1].ravel())[0, 1]) < 0.05


def reached(prepared: Prepared, order: np.ndarray, size: float = 3.0) -> Chance:
    """What chance reaches of an effect that makes the current of one condition rise ever more slowly from closure to
    closure, where the closures rise so, taken in an order."""
    blocks = list(as_measured(prepared, prepared.features).features.blocks)
    k = next(k for k, b in enumerate(blocks) if b.signal == "motor_current")
    block, slices = blocks[k], prepared.features.slices
    rise = np.outer(1.0 - np.exp(-np.arange(block.n) / 5.0), np.ones(block.phase.size))
    rise *= size * NOISE * np.ptp(block.measured)
    blocks[k] = replace(block, measured=block.measured + (rise - rise.mean(axis=0))[order])
    features = replace(prepared.features, blocks=tuple(blocks), slices=())
    problem = build_problem(prepared.rig, features, prepared.model, (), {})
    found = fit(problem, prepared.model, [nuisance_coordinate(prepared.nuisances[0])], {}, evaluations=1)
    signature = np.zeros((features.size, 1))
    signature[slices[k], 0] = block.combine(rise)
    return chance(problem, found, {"warming up": [problem.whiten(signature)]})


def test_a_drift_is_no_chance_of_an_effect(prepared: Prepared) -> None:
    n = prepared.features.blocks[0].n
    still = reached(prepared, np.arange(n), 1e-9)
    drifting = reached(prepared, np.arange(n))
    mixed = reached(prepared, np.random.default_rng(1).permutation(n))
    assert mixed.gain > 2.0 * still.gain, "the same in any order is scatter, and an effect may gain by it"
    assert drifting.gain < 1.5 * still.gain
    assert drifting.misfit > 1.1 * still.misfit, (
        "what is left of a drift for which there is no effect is scatter"
    )


def test_a_tolerance_may_be_wider_downwards() -> None:
    c = nuisance_coordinate(Nuisance("friction", 2.0, 0.2, False, unit="N.m", lower=0.02, below=0.6))
    assert [c.value(z) for z in (-2.0, -1.0, 0.0, 1.0)] == pytest.approx([0.8, 1.4, 2.0, 2.2])
    assert all(c.z(c.value(z)) == pytest.approx(z) for z in (-3.0, -0.1, 0.0, 0.1, 3.0))
    assert c.bounds == (pytest.approx(-3.3), np.inf)


def test_a_wide_tolerance_takes_a_friction_to_nought_but_not_below() -> None:
    """sd 0.5: nothing at all is two tolerances off, four times as much 2.8."""
    c = nuisance_coordinate(Nuisance("friction", 2.0, 0.5, True, unit="N.m", lower=0.02, below=0.5))
    assert c.value(-1.0) == pytest.approx(1.0) and c.value(-5.0) == 0.02
    assert c.value(np.log(4.0) / 0.5) == pytest.approx(8.0)
    assert c.bounds[0] == pytest.approx(-1.98) and c.bounds[1] == np.inf
    for z in (-1.5, -1e-9, 0.0, 1e-9, 2.0):
        assert c.z(c.value(z)) == pytest.approx(z, abs=1e-12)
    slopes = [(c.value(h) - c.value(0.0)) / h for h in (-1e-6, 1e-6)]
    assert slopes == pytest.approx([1.0, 1.0], rel=1e-5), "no kink at the nominal value"
