"""Another simulator of such a hand, with nothing of this project in it, for `bench/foreign.py`.

A motor with inductance, a gear, a wire as a spring with damping, one load with a return spring, soft stops, friction as
tanh(v / blur), an object as a spring, and a cascaded controller of 1 kHz.  Midpoint rule, 10 us.  What it can
hide is written otherwise than in the catalogue; `spot` and `drag` have no counterpart there.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from hand_parts import command, held, played
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

TICK, STEPS = 1e-3, 100
"""s between commands, and plant steps in between."""

COUNT = 2.0 * math.pi * 3.8 / 65536
"""rad of the pulley per count of the encoder."""


class Hand(NamedTuple):
    """SI units at the motor pulley; the second block is what may be hidden, switched off."""

    resistance: float = 1.49
    inductance: float = 1.37e-4
    kt: float = 0.01745
    rotor: float = 1.1e-6
    ratio: float = 19.0
    efficiency: float = 0.70
    friction: float = 0.0255
    viscous: float = 3.2e-4
    blur: float = 0.03
    wire: float = 0.74
    wire_damping: float = 6e-4
    load: float = 2e-6
    preload: float = 0.0107
    spring: float = 0.0015
    load_friction: float = 0.008
    travel: float = 15.6
    stop: float = 1.5
    object_stiffness: float = 0.0
    object_at: float = 99.0
    object_damping: float = 0.0
    zero: float = 0.0
    kp: float = 0.4
    kd: float = 0.0214
    velocity_filter: float = 0.005
    current_kp: float = 0.137
    current_ki: float = 1490.0
    current_max: float = 4.6
    voltage_max: float = 12.0
    # what may be hidden
    slack: float = 0.0
    capstan: float = 0.0
    glove: float = 0.0
    glove_power: float = 3.0
    stiction: float = 0.0
    stiction_speed: float = 0.5
    asymmetry: float = 0.0
    ripple: float = 0.0
    waves: float = 1.0
    current_gain: float = 1.0
    spot: float = 0.0
    spot_at: float = 7.0
    drag: float = 0.0
    brush: float = 0.0
    source: float = 0.0
    saturation: float = 0.0


def reference(period: float) -> Array:
    """Target angle (ticks,) rad of one closure: the upper half of a sine, and a rest."""
    t = np.arange(round(period / TICK)) * TICK
    return np.maximum(0.0, 13.0 * np.sin(2.0 * np.pi * t / period))


@njit(cache=False)
def _rates(s: Any, u: float, h: Any) -> Any:
    """Of motor angle, speed, load angle, speed, current."""
    q, v, ql, vl, i = s
    direction = math.tanh(v / h.blur)
    stretch = q - ql - h.slack
    tension = max(0.0, h.wire * stretch + h.wire_damping * (v - vl)) if stretch > 0.0 else 0.0
    friction = h.friction + h.capstan * tension
    friction += h.stiction * math.exp(-((v / h.stiction_speed) ** 2))
    friction += h.asymmetry * max(direction, 0.0)
    friction += h.spot * math.exp(-(((q - h.spot_at) / 0.8) ** 2))
    kt = h.kt / (1.0 + h.saturation * i * i)
    drive = h.efficiency * kt * h.ratio * i - friction * direction - h.viscous * v
    drive += -h.drag * v * abs(v) - h.ripple * math.sin(h.waves * q) - tension
    pull = tension - h.preload - h.spring * ql - h.load_friction * math.tanh(vl / (2.0 * h.blur))
    pull -= h.glove * max(ql, 0.0) ** h.glove_power
    pull = held(pull, ql, vl, h)
    back = kt * h.ratio * v
    motor = drive / (h.rotor * h.ratio * h.ratio)
    u -= h.source * i * (u / h.voltage_max) ** 2 + h.brush * math.tanh(i / 0.01)
    return np.array([v, motor, vl, pull / h.load, (u - h.resistance * i - back) / h.inductance])


@njit(cache=False)
def simulate(reference: Any, h: Any, s: Any, c: Any, out: Any) -> None:
    """One reference (n,) at 1 kHz from the state s (5,) and the controller's memory c (4,), both kept for the next.

    out   (n, 3): encoder angle, measured current, voltage
    """
    dt = TICK / STEPS
    for k in range(reference.size):
        position = math.floor((s[0] + h.zero) / COUNT) * COUNT
        current = s[4] * h.current_gain
        u = command(reference[k], position, current, h, TICK, c)
        out[k, 0], out[k, 1], out[k, 2] = position, current, u
        for _ in range(STEPS):
            middle = s + 0.5 * dt * _rates(s, u, h)
            s += dt * _rates(middle, u, h)


def closures(hands: list[Hand], reference: Array) -> Array:
    """Angle, current, voltage (n, 3) of one closure after another, each by its hand, after 0.7 s of rest."""
    return played(simulate, 5, 4, TICK, hands, reference)
