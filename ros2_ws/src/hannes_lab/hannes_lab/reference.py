"""The reference of a recording on the control grid, and where it rests."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .described import STRANGE_HOLD_RATE, ZERO_ORDER_HOLD_RATE

Array = NDArray[np.float64]

RESTS = 0.02
HELD = 0.05
"""A reference rests within this part of its span from its rest value, which it has for so large a part of the time."""


def reference_on_grid(
    time: Array, values: Array, period: float, duration: float, hold_rate: float = ZERO_ORDER_HOLD_RATE
) -> tuple[Array, str | None]:
    """The reference [n] on the control grid, and a note where it had to be guessed between samples.

    Fast logs are held from message to message, as the controller does.  Slow logs are interpolated by a monotone cubic;
    where the reference leaves or reaches its rest value between two samples, the moving part is extrapolated to it.
    Of messages that came at one instant the last one holds.
    """
    later = np.append(np.diff(time) > 0.0, True)
    time, values = time[later], values[later]
    grid = np.arange(max(2, math.floor(duration / period + 1e-6) + 1)) * period
    steps = np.diff(time) if time.size > 1 else np.array([period])
    step = float(np.median(steps))
    # Stamps in whole milliseconds: at 60 Hz the median step is 17 ms.
    rate = 1.0 / float(steps[steps < 1.5 * step].mean())
    said = f"the reference is logged at {rate:.0f} Hz; "
    if time.size < 4 or 1.0 / step >= hold_rate:
        index = np.clip(np.searchsorted(time, grid + 1e-7, side="right") - 1, 0, time.size - 1)
        slow = time.size >= 4 and 1.0 / step < STRANGE_HOLD_RATE
        return values[index], said + "each message is held until the next" if slow else None
    from scipy.interpolate import PchipInterpolator

    out = np.interp(grid, time, values)
    rest = rest_value(values)
    span = float(np.ptp(values)) or 1.0
    moving = np.abs(values - rest) > 1e-9 * span
    for first, last in true_runs(moving):
        t, v = time[first : last + 1], values[first : last + 1]
        if t.size < 4:
            continue
        curve = PchipInterpolator(t, v, extrapolate=True)
        left, right = t[0], t[-1]
        if first > 0:
            slope = (v[1] - v[0]) / (t[1] - t[0])
            left = (
                max(time[first - 1], t[0] - (v[0] - rest) / slope)
                if slope * (v[0] - rest) > 0
                else time[first - 1]
            )
        if last < time.size - 1:
            slope = (v[-1] - v[-2]) / (t[-1] - t[-2])
            right = (
                min(time[last + 1], t[-1] + (v[-1] - rest) / -slope)
                if slope * (v[-1] - rest) < 0
                else time[last + 1]
            )
        inside = (grid >= t[0]) & (grid <= t[-1])
        out[inside] = curve(grid[inside])
        if first > 0:
            edge = (grid > time[first - 1]) & (grid < t[0])
            out[edge] = np.interp(grid[edge], [left, t[0]], [rest, v[0]])
        if last < time.size - 1:
            edge = (grid > t[-1]) & (grid < time[last + 1])
            out[edge] = np.interp(grid[edge], [t[-1], right], [v[-1], rest])
    return out, said + "between samples it is interpolated"


def true_runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def rest_value(values: Array) -> float:
    """The value at which the reference rests: the one at which it begins and ends, else the most frequent one.

    A grip may be held for longer than the hand rests.  The minimum of a reference that never rests.
    """
    rounded, counts = np.unique(np.round(values, 6), return_counts=True)
    near = RESTS * float(np.ptp(values))
    at_ends = np.abs(rounded - values[0]) <= near
    if abs(values[-1] - values[0]) <= near and counts[at_ends].max() >= HELD * values.size:
        return float(rounded[at_ends][np.argmax(counts[at_ends])])
    return float(rounded[np.argmax(counts)]) if counts.max() >= HELD * values.size else float(values.min())
