"""What a verdict says in words, where that rests on numbers that are easily made."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from hannes_lab.conclusion import missed_most
from hannes_lab.errors import SignalError


def largest(*ratios: float, own_error: bool, adequate: bool = True) -> str:
    """The sentence on the largest of these errors."""
    signals = [
        SignalError("air_slow", name, "V", 0.01 * ratio, 0.01, ratio)
        for name, ratio in zip(("encoder_position", "motor_current", "motor_voltage"), ratios, strict=False)
    ]
    problem: Any = SimpleNamespace(discrepancy=(1,) if own_error else ())
    return missed_most(problem, signals, adequate)


def test_nothing_says_where_another_machine_is_missed_most() -> None:
    """A detent that moves the voltage alone was "nothing", and 4.6 times the repeatability was in a table only."""
    said = largest(0.9, float("nan"), 4.62, own_error=True)
    assert said.startswith(
        " It is largest in motor voltage of 'air_slow', 4.6 times the repeatability: of another "
    )


@pytest.mark.parametrize(
    ("ratios", "own_error"),
    (((0.9, 1.3, 1.9), True), ((0.9, 1.3, 4.6), False), ((float("nan"),), True), ((), True)),
    ids=("little", "the model is of this machine", "no repeats", "no signal"),
)
def test_nothing_says_no_more_than_that_elsewhere(ratios: tuple[float, ...], own_error: bool) -> None:
    assert largest(*ratios, own_error=own_error) == ""


def test_nothing_that_chance_does_not_bear_out_says_where_it_is_missed_most() -> None:
    """A wheel's speed was missed by 3 times the repeatability in one of eight conditions, and "nothing" by the mean."""
    said = largest(0.9, 3.2, own_error=False, adequate=False)
    assert said.startswith(" It is largest in motor current of 'air_slow', 3.2 times the repeatability: some")
