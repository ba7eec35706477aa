"""What the simulated hands of `bench/foreign.py` share: the cascaded controller, stops and object, one closure after
another.  Nothing of this project is in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

REST = 0.7
"""s before the first closure."""


@njit(cache=False)
def command(target: float, position: float, current: float, h: Any, tick: float, c: Any) -> float:
    """Voltage for a target angle, from the measured angle and current.

    c   memory: integral, last position, filtered speed, whether there was a tick
    """
    a = math.exp(-tick / h.velocity_filter)
    if c[3] == 0.0:
        c[1], c[3] = position, 1.0
    c[2] = a * c[2] + (1.0 - a) * (position - c[1]) / tick
    c[1] = position
    wanted = h.kp * (target - position) - h.kd * c[2]
    error = min(max(wanted, -h.current_max), h.current_max) - current
    c[0] = min(max(c[0] + h.current_ki * tick * error, -h.voltage_max), h.voltage_max)
    return min(max(h.current_kp * error + c[0], -h.voltage_max), h.voltage_max)


@njit(cache=False)
def held(pull: float, angle: float, speed: float, h: Any) -> float:
    """The pull at the load, less what the object and the soft stops hold against it."""
    depth = angle - h.object_at
    if depth > 0.0:
        pull -= max(0.0, h.object_stiffness * depth * (1.0 + h.object_damping * speed))
    if angle < 0.0:
        pull -= h.stop * angle + 0.002 * speed
    if angle > h.travel:
        pull -= h.stop * (angle - h.travel) + 0.002 * speed
    return pull


def played(
    simulate: Callable[..., None], states: int, memory: int, tick: float, hands: list[Any], reference: Array
) -> Array:
    """Angle, current, voltage (n, 3) of one closure after another, each by its hand, after a rest."""
    s, c, parts = np.zeros(states), np.zeros(memory), []
    for one, hand in ((np.zeros(round(REST / tick)), hands[0]), *((reference, hand) for hand in hands)):
        out = np.zeros((one.size, 3))
        simulate(one, hand, s, c, out)
        parts.append(out)
    return np.concatenate(parts)
