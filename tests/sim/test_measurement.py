"""What a log of the current says of its logger."""

from __future__ import annotations

import numpy as np
import pytest
from hannes_sim.measurement import goes_below_nought

TIME = np.arange(0.0, 45.0, 1 / 30)
CLOSURES = 0.33 * np.clip(np.sin(2.0 * np.pi * TIME / 5.6), 0.0, None) ** 0.3


@pytest.mark.parametrize("seed", range(20))
def test_noise_after_a_current_was_rectified_gives_it_no_sign(seed: int) -> None:
    noise = np.random.default_rng(seed).normal(0.0, 0.005, TIME.size)
    assert not goes_below_nought(CLOSURES + noise)
    opening = np.where(np.sin(2.0 * np.pi * TIME / 5.6) < 0.0, -0.02, 0.0)
    assert goes_below_nought(CLOSURES + opening + noise), "little, but for seconds"


def test_one_sample_far_below_nought_is_a_sign() -> None:
    noise = np.random.default_rng(0).normal(0.0, 0.005, TIME.size)
    braked = CLOSURES.copy()
    braked[100] = -0.2
    assert goes_below_nought(braked + noise)
    assert not goes_below_nought(np.zeros(0)) and not goes_below_nought(np.zeros(3))
