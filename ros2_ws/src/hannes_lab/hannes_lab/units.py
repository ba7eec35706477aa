"""Signals in another unit than SI, or with the other sign: found by their size, converted, and said.

Encoder and reference go over at most a few turns of the pulley (a full closure is 14.57 rad), the motor takes amperes
and volts.  A factor that the user gives (`--scale SIGNAL=FACTOR`) is taken instead of a guess.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.joints import RAD_PER_COUNT
from hannes_description.signals import SIGNALS
from numpy.typing import NDArray

Array = NDArray[np.float64]
Samples = Mapping[str, tuple[Array, Array]]

_ANGLES = ("reference_position", "encoder_position")
_GUESSES: Mapping[str, tuple[tuple[float, str, float], ...]] = {
    **dict.fromkeys(_ANGLES, ((1000.0, "encoder counts", RAD_PER_COUNT), (60.0, "degrees", math.pi / 180.0))),
    "motor_current": ((50.0, "mA", 1e-3),),
    "motor_voltage": ((100.0, "mV", 1e-3),),
    "motor_effort": ((100.0, "N.mm", 1e-3),),
    "grip_force": ((2000.0, "mN", 1e-3),),
}
"""Range (angles) or magnitude above which a signal cannot be in its unit, what it then looks like, and its factor."""

FOLLOWS = (0.2, 1.5)
"""Range of the encoder over that of the reference that it follows, at least and at most."""


def in_si(
    samples: Samples, scale: Mapping[str, float], where: str
) -> tuple[dict[str, tuple[Array, Array]], list[str]]:
    """The signals in SI, and what was done, as sentences.

    scale   factors by signal name that the user gives
    Raises HannesError for an encoder that does not follow the reference: another unit, shaft or sign.
    """
    out: dict[str, tuple[Array, Array]] = {}
    notes: list[str] = []
    for name, (time, values) in samples.items():
        factor, what = scale.get(name, 1.0), "as --scale says"
        if name not in scale:
            size = float(np.ptp(values)) if name in _ANGLES else float(np.abs(values).max())
            for limit, unit, guess in _GUESSES.get(name, ()):
                if size > limit:
                    factor, what = (
                        guess,
                        f"it reaches {size:.4g} and looks like {unit}, not {SIGNALS[name].unit}",
                    )
                    what += f"; say --scale {name}=1 if it is not, or give another factor"
                    break
        if factor != 1.0:
            notes.append(f"{name} was multiplied by {factor:.6g}: {what}")
        out[name] = (time, values * factor)
    _check_follows(out, where)
    _turn_current(out, scale, notes)
    return out, notes


def _check_follows(samples: Samples, where: str) -> None:
    if not set(_ANGLES) <= set(samples):
        return
    (rt, reference), (et, encoder) = (samples[name] for name in _ANGLES)
    asked, done = float(np.ptp(reference)), float(np.ptp(encoder))
    if asked == 0.0 or et.size < 3:
        return
    r = np.interp(et, rt, reference)
    both = float(np.std(r) * np.std(encoder))
    if (
        done > 0.05 * asked
        and both > 0.0
        and float(np.mean((r - r.mean()) * (encoder - encoder.mean()))) < -0.5 * both
    ):
        raise HannesError(
            f"{where}: encoder_position moves against reference_position: one of them has the other sign. Say "
            "--scale encoder_position=-1 (or --scale reference_position=-1)."
        )
    if not FOLLOWS[0] <= done / asked <= FOLLOWS[1]:
        raise HannesError(
            f"{where}: encoder_position goes over {done:.4g} rad, reference_position over {asked:.4g} rad; an encoder "
            "that follows its reference goes over about as much. Is one of them in another unit (rad, degrees, counts) "
            "or at another shaft (motor, pulley)? Give its factor to rad at the pulley: --scale SIGNAL=FACTOR."
        )


def _turn_current(
    samples: dict[str, tuple[Array, Array]], scale: Mapping[str, float], notes: list[str]
) -> None:
    """A current that is negative while the hand closes gets the other sign."""
    if not {"encoder_position", "motor_current"} <= set(samples) or "motor_current" in scale:
        return
    time, current = samples["motor_current"]
    et, encoder = samples["encoder_position"]
    if time.size < 8 or et.size < 8:
        return
    velocity = np.interp(
        time, et, np.gradient(encoder, np.maximum.accumulate(et + 1e-9 * np.arange(et.size)))
    )
    closing = velocity > 0.2 * float(velocity.max())
    if closing.any() and float(np.median(current[closing])) < -0.2 * float(
        np.quantile(np.abs(current), 0.95)
    ):
        samples["motor_current"] = (time, -current)
        notes.append(
            "motor_current is negative while the hand closes: its sign was turned; say --scale motor_current=1 if that "
            "is wrong"
        )
