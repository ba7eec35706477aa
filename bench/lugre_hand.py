"""A second simulator of such a hand, with nothing of this project in it, for `bench/foreign.py --lugre`.

Another physics than `other_hand.py`: friction of motor and load as bristles that bend (LuGre: Canudas de Wit, Olsson,
Astrom, Lischinsky 1995), backlash before the encoder, hysteresis of the load side after Bouc and Wen, a mount that
shakes.  The controller at 500 Hz with other gains, smooth moves with a hold.  Semi-implicit Euler, 20 us.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from hand_parts import command, held, played
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

TICK, STEPS = 2e-3, 100
"""s between commands, and plant steps in between."""

COUNT = 3.643e-4
"""rad of the pulley per count of the encoder."""


class Hand(NamedTuple):
    """SI units at the motor pulley; the second block is what may be hidden, switched off."""

    resistance: float = 1.58
    inductance: float = 1.5e-4
    kt: float = 0.01693
    rotor: float = 1.155e-6
    ratio: float = 19.0
    efficiency: float = 0.72
    friction: float = 0.0275
    stiction: float = 0.0283
    stiction_speed: float = 0.4
    bristle: float = 8.0
    bristle_damping: float = 4e-3
    viscous: float = 3e-4
    wire: float = 0.81
    wire_damping: float = 8e-4
    load: float = 3e-6
    preload: float = 0.01145
    spring: float = 0.00138
    load_friction: float = 0.0088
    travel: float = 15.6
    stop: float = 1.3
    object_stiffness: float = 0.0
    object_at: float = 99.0
    object_damping: float = 0.0
    zero: float = 0.0
    kp: float = 0.33
    kd: float = 0.017
    velocity_filter: float = 0.004
    current_kp: float = 0.08
    current_ki: float = 700.0
    current_max: float = 4.2
    voltage_max: float = 12.0
    # what may be hidden
    slack: float = 0.0
    capstan: float = 0.0
    glove: float = 0.0
    glove_power: float = 2.0
    backlash: float = 0.0
    hysteresis: float = 0.0
    hysteresis_width: float = 2.5
    drag: float = 0.0
    shaking: float = 0.0
    shaking_hz: float = 0.83


def reference(period: float) -> Array:
    """Target angle (ticks,) rad of one closure: minimum-jerk moves of a quarter of the period, a hold, and a rest."""
    t = np.arange(round(period / TICK)) * TICK / period
    there, back = (np.clip((t - begin) / 0.25, 0.0, 1.0) for begin in (0.05, 0.45))
    return 13.0 * sum(
        sign * x**3 * (10.0 - 15.0 * x + 6.0 * x**2) for sign, x in ((1.0, there), (-1.0, back))
    )


@njit(cache=False)
def simulate(reference: Any, h: Any, s: Any, c: Any, out: Any) -> None:
    """One reference (n,) at 500 Hz from the state s (9,) and the controller's memory c (5,), both kept for the next.

    s     motor angle and speed, load angle and speed, current, bristles of motor and load, hysteresis, encoder shaft
    c     integral, last position, filtered speed, whether there was a tick, time
    out   (n, 3): encoder angle, current, voltage
    """
    dt = TICK / STEPS
    inertia = h.rotor * h.ratio * h.ratio
    for k in range(reference.size):
        position = math.floor((s[8] + h.zero) / COUNT) * COUNT
        u = command(reference[k], position, s[4], h, TICK, c)
        out[k, 0], out[k, 1], out[k, 2] = position, s[4], u
        outside = h.shaking * math.sin(2.0 * math.pi * h.shaking_hz * c[4])
        c[4] += TICK
        for _ in range(STEPS):
            q, v, ql, vl, i = s[0], s[1], s[2], s[3], s[4]
            stretch = q - ql - h.slack
            tension = max(0.0, h.wire * stretch + h.wire_damping * (v - vl)) if stretch > 0.0 else 0.0
            level = h.friction + (h.stiction - h.friction) * math.exp(-((v / h.stiction_speed) ** 2))
            bend = v - h.bristle * abs(v) / (level + h.capstan * tension) * s[5]
            bend_load = vl - h.bristle * abs(vl) / h.load_friction * s[6]
            s[5] += dt * bend
            s[6] += dt * bend_load
            s[7] += dt * (vl - abs(vl) * s[7] / h.hysteresis_width)
            motor = h.efficiency * h.kt * h.ratio * i - h.bristle * s[5] - h.bristle_damping * bend
            motor += -h.viscous * v - h.drag * v * abs(v) - tension
            pull = (
                tension - h.preload - h.spring * ql - h.bristle * s[6] - 0.5 * h.bristle_damping * bend_load
            )
            pull -= (
                h.hysteresis * s[7] / h.hysteresis_width + h.glove * max(ql, 0.0) ** h.glove_power + outside
            )
            pull = held(pull, ql, vl, h)
            s[1] += dt * motor / inertia
            s[3] += dt * pull / h.load
            s[0] += dt * s[1]
            s[2] += dt * s[3]
            s[4] += dt * (u - h.resistance * i - h.kt * h.ratio * v) / h.inductance
            half = 0.5 * h.backlash
            s[8] = min(max(s[8], s[0] - half), s[0] + half)


def closures(hands: list[Hand], reference: Array) -> Array:
    """Angle, current, voltage (n, 3) of one closure after another, each by its hand, after 0.7 s of rest."""
    return played(simulate, 9, 5, TICK, hands, reference)
