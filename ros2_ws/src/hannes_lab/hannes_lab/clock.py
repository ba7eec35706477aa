"""When the reference of a recording was logged, by the clock of its signals."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .trials import Trial

Array = NDArray[np.float64]

REFERENCE_DELAY = "log.reference_delay"
REFERENCE_DELAY_SD = 0.02
"""s; by how much the machine's reference is later than that of the log, by the clock of the signals, and how far that
may be off where nobody says: latencies, a reference that was logged after or before it was filtered, signals that are
stamped when they were read."""

RATE_OVER = 0.01
"""s; one that comes by messages has a rate only over one of them or several."""


def moved(reference: Array, delay: float, lead: float, trial: Trial) -> Array:
    """The reference later by `delay` [s] and with `lead` [s] times its rate; a cut one goes on as the trial's."""
    if delay == 0.0 and lead == 0.0:
        return reference
    n = reference.size
    whole = trial.reference if np.array_equal(trial.reference[:n], reference) else reference
    if lead != 0.0:
        whole = whole + lead * np.gradient(moving_mean(whole, RATE_OVER / trial.period), trial.period)
    return later(whole, delay / trial.period, n)


def later(values: Array, ticks: float, count: int | None = None) -> Array:
    """The first `count` values (all if None), later by so many ticks; before the first and after the last, those."""
    out: Array = _later(np.ascontiguousarray(values), ticks, values.size if count is None else count)
    return out


@njit(cache=True, nogil=True)
def _at_tick(values, at):  # type: ignore[no-untyped-def]
    """Linear interpolation of values (n,) at a place in ticks; beyond the ends, the end."""
    if at <= 0.0:
        return values[0]
    if at >= values.size - 1:
        return values[-1]
    k = int(at)
    return values[k] + (at - k) * (values[k + 1] - values[k])


@njit(cache=True, nogil=True)
def _later(values, ticks, n):  # type: ignore[no-untyped-def]
    """The first n values, later by `ticks`."""
    out = np.empty(n)
    for k in range(n):
        out[k] = _at_tick(values, k - ticks)
    return out


def moving_mean(values: Array, width: float) -> Array:
    """Mean over the trailing `width` ticks; unlike `logger`, continuous in the width."""
    mean: Array = _trailing_mean(np.ascontiguousarray(values), max(width, 1.0))
    return mean


@njit(cache=True, nogil=True)
def _trailing_mean(values, width):  # type: ignore[no-untyped-def]
    total = np.zeros(values.size + 1)
    for k in range(values.size):
        total[k + 1] = total[k] + values[k]
    out = np.empty(values.size)
    for k in range(values.size):
        begin = max(k + 1 - width, 0.0)
        out[k] = (total[k + 1] - _at_tick(total, begin)) / (k + 1 - begin)
    return out
