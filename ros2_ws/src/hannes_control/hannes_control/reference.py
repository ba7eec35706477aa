"""Reference profiles of the encoder position: what the hand is asked to do, in rad at the motor pulley."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.joints import RAD_PER_COUNT
from hannes_description.parameters import ParameterSet
from numpy.typing import NDArray

FULL_CLOSURE = 40000 * RAD_PER_COUNT
"""rad; amplitude of the thesis' bench test (P17: 40000 counts)."""

Profile = NDArray[np.float64]


MOST = 100_000_000
"""Samples of a profile or of synthetic EMG: a day at 1 kHz, 800 MB, and a few times that while they are made."""


def _check(*, closures: float, period: float, dt: float, **more: float) -> None:
    for name, value in {"closures": closures, "period": period, "dt": dt, **more}.items():
        if not math.isfinite(value) or value <= 0.0:
            raise HannesError(f"Reference profile: {name} is {value}; it must be a positive number.")
    if closures * period / dt > MOST:
        raise HannesError(
            f"Reference profile: {closures:g} closures of {period:g} s take {closures * period / dt:.3g} samples of "
            f"{dt:g} s; at most {MOST} are made. Ask for fewer, or give the reference by its topic."
        )


def half_sine(
    closures: int = 1, amplitude: float = FULL_CLOSURE, period: float = 4.0, dt: float = 1e-3
) -> Profile:
    """max(0, amplitude sin(2 pi t / period)), `closures` periods sampled at dt: thesis P17 as read in X01."""
    _check(closures=closures, amplitude=amplitude, period=period, dt=dt)
    t = np.arange(round(closures * period / dt)) * dt
    return np.maximum(0.0, amplitude * np.sin(2.0 * math.pi * t / period))


def ramp_hold(
    closures: int = 1,
    amplitude: float = FULL_CLOSURE,
    period: float = 3.0,
    hold: float = 0.2,
    rest: float = 0.2,
    dt: float = 1e-3,
) -> Profile:
    """Rise, hold, fall and rest, `closures` times; rise and fall are raised cosines (continuous velocity).

    hold and rest are shares of the period; rise and fall take half of what is left each.
    """
    _check(closures=closures, amplitude=amplitude, period=period, hold=hold, rest=rest, dt=dt)
    if hold + rest >= 1.0:
        raise HannesError(
            f"Reference profile: hold {hold} and rest {rest} leave nothing of the period to move in."
        )
    n = [round(share * period / dt) for share in ((1.0 - hold - rest) / 2.0, hold, rest)]
    up = 0.5 - 0.5 * np.cos(math.pi * np.arange(n[0]) / n[0])
    one = np.concatenate([up, np.ones(n[1]), 1.0 - up, np.zeros(n[2])])
    return amplitude * np.tile(one, closures)


def reversals(
    closures: int = 1,
    amplitude: float = FULL_CLOSURE,
    period: float = 6.0,
    ripple: float = 0.15,
    ripple_period: float = 0.6,
    dt: float = 1e-3,
) -> Profile:
    """A half sine with small reversals on top, in each closure alike: shows slack, backlash, presliding and inertia."""
    _check(
        closures=closures,
        amplitude=amplitude,
        period=period,
        ripple=ripple,
        ripple_period=ripple_period,
        dt=dt,
    )
    slow = half_sine(closures, 1.0, period, dt)
    t = np.arange(slow.size) * dt % period
    wave = ripple * np.sin(2.0 * math.pi * t / ripple_period) * np.minimum(1.0, 4.0 * slow) * (slow > 0.0)
    return amplitude * np.clip(slow * (1.0 - ripple) + wave, 0.0, 1.0)


PROFILES: Mapping[str, Callable[..., Profile]] = {
    "half_sine": half_sine,
    "ramp_hold": ramp_hold,
    "reversals": reversals,
}
"""Profiles by name, for nodes and the command line."""


def travel_of(parameters: ParameterSet) -> float:
    """Encoder position (rad) of the closed hand, infinite where the parameters do not say it; the open hand is at 0."""
    return parameters.value("hand.travel") if "hand.travel" in parameters else math.inf


def check_travel(amplitude: float, parameters: ParameterSet) -> None:
    """Refuse an amplitude (rad) beyond the hand's travel, where the parameters say it: the motor would stall there."""
    travel = travel_of(parameters)
    if amplitude > travel:
        raise HannesError(
            f"Reference profile: amplitude is {amplitude:g} rad, but the hand is fully closed at {travel:g} rad "
            "(hand.travel of the model), where the motor would stall: give less."
        )


def make_profile(name: str, **options: float) -> Profile:
    """A profile by name; unknown names and options are refused with the valid ones."""
    if name not in PROFILES:
        raise HannesError(f"Unknown reference profile '{name}'; valid are {', '.join(PROFILES)}.")
    try:
        return PROFILES[name](**options)
    except TypeError as error:
        raise HannesError(f"Reference profile '{name}': {error}.") from error
