"""Recordings of a simulator without noise, as of `hand_sim` in lock-step: what rounding makes is no missing effect."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hannes_bags.recording import Recording
from hannes_description.model import Model
from hannes_lab.compare import compare
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.features import NOISELESS
from hannes_lab.hide import make_set
from hannes_lab.prepare import prepare
from hannes_lab.recorded import make_trial
from hannes_lab.trials import Trial
from hannes_sim.effect import strength_of
from hannes_sim.measurement import Sensors

EXACT = Sensors(
    motor_rate=500.0,
    current_rectified=False,
    current_window=0.0,
    current_noise=0.0,
    voltage_rate=500.0,
    reference_rate=1000.0,
)
SOME = ["gear_backlash", "viscous_friction", "glove_stiffness"]


@cache
def recorded(*effects: str, scatter: float = 0.0, spread: float = 1.0) -> list[Recording]:
    """Five closures of two conditions."""
    hidden = [strength_of(name, 1.0) for name in effects]
    conditions = ("fast", "grasp_fast")
    return make_set(
        Model.load(),
        hidden,
        seed=23,
        closures=5,
        conditions=conditions,
        sensors=EXACT,
        scatter=scatter,
        spread=spread,
    )[0]


def trials(*effects: str, scatter: float = 0.0) -> list[Trial]:
    return [make_trial(r) for r in recorded(*effects, scatter=scatter)]


def test_closures_without_noise_count_as_known_to_a_part_of_their_span() -> None:
    prepared = prepare([make_trial(r) for r in recorded(spread=0.0)], Model.load())
    (said,) = [note for note in prepared.notes if "simulator without noise" in note]
    assert said.startswith("encoder_position, motor_current and motor_voltage repeat as ") and "0.1 %" in said
    for block in prepared.features.blocks:
        span = float(np.ptp(block.measured))
        scatter = float(np.sqrt(block.alike.var(axis=0, ddof=1).mean()))
        assert scatter < NOISELESS * prepared.rig.coarse * span
        assert block.floor == block.known_to == pytest.approx(prepared.rig.coarse * span)
    assert all(e.ratio < 0.2 for e in compare(prepared).errors), "the true hand: rounding is all that is left"


def test_a_hand_whose_closures_scatter_is_taken_as_it_repeats() -> None:
    blocks = prepare(trials(scatter=0.2), Model.load()).features.blocks
    assert not any(block.known_to for block in blocks)


@pytest.mark.parametrize("hidden", ((), ("gear_backlash",)), ids=("nothing", "backlash"))
def test_what_is_hidden_is_found_in_recordings_without_noise(hidden: tuple[str, ...]) -> None:
    found = diagnose(prepare(trials(*hidden), Model.load()), effect_sources(only=SOME))
    assert found.verdict == ("effects" if hidden else "nothing"), found.summary
    assert tuple(e.name for e in found.effects) == hidden
    if hidden:
        width = found.effects[0].parameters["width"]
        assert width.value == pytest.approx(
            strength_of("gear_backlash", 1.0).parameters["width"].value, rel=0.02
        )
