"""Closures in which a sensor froze, and recordings without noise that began elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hannes_lab.frozen import without_frozen
from hannes_lab.prepare import without_outliers
from hannes_lab.trials import Closure, Trial

PERIOD = 1e-3
EACH = 4.0


def closures(count: int = 6, noise: float = 0.0) -> Trial:
    """Half sines of which the position follows, and the voltage stands at its limit for a third of the way."""
    one = np.concatenate([13.0 * np.sin(np.pi * np.arange(0.0, 2.0, PERIOD) / 2.0), np.zeros(2000)])
    reference = np.tile(one, count)
    time = np.arange(reference.size)[::10] * PERIOD
    rng = np.random.default_rng(5)
    position = 0.98 * reference[::10] + noise * rng.standard_normal(time.size)
    voltage = np.minimum(reference[::10], 8.0)
    starts = EACH * np.arange(count)
    return Trial(
        "air",
        PERIOD,
        reference,
        {"encoder_position": (time, position), "motor_voltage": (time, voltage)},
        tuple(Closure(start, start + EACH - PERIOD, "air") for start in starts),
    )


def changed(trial: Trial, signal: str, change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Trial:
    """The trial with another signal: change(time, values) -> values."""
    time, values = trial.signals[signal]
    return replace(trial, signals={**trial.signals, signal: (time, change(time, values.copy()))})


@pytest.mark.parametrize("signal", ["encoder_position", "motor_voltage"])
@pytest.mark.parametrize(("since", "left"), [(12.1, 3), (13.0, 3), (21.0, 5)])
def test_closures_in_which_a_sensor_froze_are_left_out_and_said(signal: str, since: float, left: int) -> None:
    """From one of six closures on, or from its midst."""
    trial = changed(
        closures(noise=1e-3), signal, lambda t, v: np.where(t < since, v, v[np.searchsorted(t, since)])
    )
    looked_at = without_frozen(trial)
    assert [c.start for c in looked_at.closures] == [c.start for c in trial.closures[:left]]
    (note,) = looked_at.notes
    assert note.startswith(f"{signal} stands still, at ") and f"{6 - left} closure" in note


def test_a_coarse_current_at_one_speed_is_not_frozen() -> None:
    """One code for 80 % of the way in one closure, and two by turns in the others."""

    def coarse(time: np.ndarray, values: np.ndarray) -> np.ndarray:
        steady = (values > 1.3) & (values < 11.7)
        return np.where(steady, 0.3 + 0.026 * ((time > EACH) & (np.arange(time.size) % 4 < 2)), values)

    trial = changed(
        closures(),
        "motor_voltage",
        lambda t, v: coarse(t, np.interp(t, *closures().signals["encoder_position"])),
    )
    assert without_frozen(trial) is trial


def test_a_signal_at_its_limit_or_that_never_moves_is_not_frozen() -> None:
    """The latter is left out as a signal, or refused, by who looks at whole recordings."""
    trial = closures()
    assert without_frozen(trial) is trial
    dead = changed(trial, "motor_voltage", lambda t, v: 0.0 * v)
    assert without_frozen(dead) is dead


@pytest.mark.parametrize("count", [5, 6])
def test_the_first_of_closures_without_noise_is_left_out_where_the_hand_was_elsewhere(count: int) -> None:
    """A fit of what is left of the others, rounding errors, took it for a slack."""

    def elsewhere(time: np.ndarray, values: np.ndarray) -> np.ndarray:
        return values - np.where(time < 1.0, 0.1, 0.0)

    looked_at = without_outliers(changed(closures(count), "encoder_position", elsewhere))
    assert len(looked_at.closures) == count - 1 and looked_at.closures[0].start == EACH
    assert looked_at.notes[0].startswith("the first closure is left out: the others repeat to 0.01 %")
    assert (
        len(without_outliers(changed(closures(count, noise=0.05), "encoder_position", elsewhere)).closures)
        == count
    )
    fresh = changed(closures(count), "encoder_position", lambda t, v: v + np.where(t < 4.0, 0.0, 0.05))
    assert without_outliers(fresh).closures == fresh.closures, (
        "it begins at rest at nought, as the model does"
    )
