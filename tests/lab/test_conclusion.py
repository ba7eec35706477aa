"""What a verdict says in words, where that rests on numbers that are easily made."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from hannes_lab.conclusion import Conclusion
from hannes_lab.errors import SignalError


def concluded(*ratios: float, own_error: bool) -> Any:
    """As much of a conclusion as its sentence on the largest error needs."""
    signals = [
        SignalError("air_slow", name, "V", 0.01 * ratio, 0.01, ratio)
        for name, ratio in zip(("encoder_position", "motor_current", "motor_voltage"), ratios, strict=False)
    ]
    problem = SimpleNamespace(discrepancy=(1,) if own_error else ())
    return SimpleNamespace(falls=[SimpleNamespace(signals=signals)], search=SimpleNamespace(problem=problem))


def largest(found: Any) -> str:
    text: str = Conclusion._largest.fget(found)  # type: ignore[attr-defined]
    return text


def test_nothing_says_where_another_machine_is_missed_most() -> None:
    """A detent that moves the voltage alone was "nothing", and 4.6 times the repeatability was in a table only."""
    said = largest(concluded(0.9, float("nan"), 4.62, own_error=True))
    assert said.startswith(
        " It is largest in motor voltage of 'air_slow', 4.6 times the repeatability: of another "
    )


@pytest.mark.parametrize(
    "found",
    (
        concluded(0.9, 1.3, 1.9, own_error=True),
        concluded(0.9, 1.3, 4.6, own_error=False),
        concluded(float("nan"), own_error=True),
        concluded(own_error=True),
    ),
    ids=("little", "the model is of this machine", "no repeats", "no signal"),
)
def test_nothing_says_no_more_than_that_elsewhere(found: Any) -> None:
    assert largest(found) == ""
