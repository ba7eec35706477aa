"""The measurement chain: what the sensors and the logger make of a rollout.

The chain is part of the model: the same averaging, rectification and sampling go over simulated and measured signals
before they are compared.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from hannes_description.errors import HannesError
from numba import njit
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .rollout import Rollout

Array = NDArray[np.float64]
Samples = Mapping[str, tuple[Array, Array]]
"""Signal name -> (time (n,) s, values (n,))."""


@dataclass(frozen=True)
class Sensors:
    """How a hand is logged; a rate of 0 means that the signal is not logged.

    motor_rate         Hz, encoder position and motor current (thesis P17: 30 Hz)
    current_rectified  the log has |current| (thesis X17)
    current_window     s, the logger averages the current over this trailing window; 0 = instantaneous
    current_noise      A, standard deviation of one sample
    voltage_rate       Hz, the commanded voltage
    force_rate         Hz, grip force (thesis P17: 100 Hz, dynamometer only)
    force_noise        N, standard deviation of one sample
    reference_rate     Hz, the reference as the controller receives it
    """

    motor_rate: float = 30.0
    current_rectified: bool = True
    current_window: float = 1.0 / 30.0
    current_noise: float = 0.005
    voltage_rate: float = 0.0
    force_rate: float = 0.0
    force_noise: float = 0.5
    reference_rate: float = 250.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name == "current_rectified":
                if not isinstance(value, bool):
                    raise HannesError(f"Sensors: {item.name} is {value!r}; it must be true or false.")
            elif isinstance(value, bool) or not isinstance(value, int | float):
                raise HannesError(f"Sensors: {item.name} is {value!r}; it must be a number.")
            elif not (math.isfinite(value) and value >= 0.0):
                raise HannesError(f"Sensors: {item.name} is {value}; it must be finite and at least 0.")
        if self.motor_rate == 0.0 or self.reference_rate == 0.0:
            raise HannesError("Sensors: motor_rate and reference_rate must be positive.")

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Sensors:
        unknown = sorted(set(content) - {item.name for item in fields(cls)})
        if unknown:
            raise HannesError(
                f"Sensors: unknown keys {unknown}; valid are {', '.join(item.name for item in fields(cls))}."
            )
        return cls(**content)

    def sample(self, run: Rollout, rng: np.random.Generator | None = None) -> dict[str, tuple[Array, Array]]:
        """Signals of a rollout as the log would hold them; with rng, noise is added."""
        time = run.time
        out: dict[str, tuple[Array, Array]] = {}
        at = sample_times(time[0], time[-1], self.reference_rate)
        out["reference_position"] = (at, take(time, run.reference_position, at))
        at = sample_times(time[0], time[-1], self.motor_rate)
        out["encoder_position"] = (at, take(time, run.encoder_position, at))
        current = logged_current(
            time, run.motor_current, at, rectified=self.current_rectified, window=self.current_window
        )
        if rng is not None:
            current = current + self.current_noise * rng.standard_normal(at.size)
            if self.current_rectified:
                current = np.abs(current)
        out["motor_current"] = (at, current)
        if self.voltage_rate > 0.0:
            at = sample_times(time[0], time[-1], self.voltage_rate)
            out["motor_voltage"] = (at, take(time, run.motor_voltage, at))
        if self.force_rate > 0.0:
            at = sample_times(time[0], time[-1], self.force_rate)
            force = take(time, run.grip_force, at)
            out["grip_force"] = (
                at,
                force if rng is None else force + self.force_noise * rng.standard_normal(at.size),
            )
        return out


def sample_times(start: float, stop: float, rate: float) -> Array:
    """start + k / rate up to stop, s."""
    return start + np.arange(math.floor((stop - start) * rate + 1e-9) + 1) / rate


def take(time: Array, values: Array, at: Array) -> Array:
    """The value at or before each instant (zero-order hold); instants before the first take the first."""
    index = np.searchsorted(time, at + 1e-9, side="right") - 1
    return values[np.clip(index, 0, values.shape[0] - 1)]


def logged_current(time: Array, current: Array, at: Array, *, rectified: bool, window: float) -> Array:
    """The current [A] as a logger gives it at the instants `at`: rectified, averaged over the trailing window [s]."""
    period = float(time[1] - time[0]) if time.size > 1 else 1.0
    return take(time, logger(current, period, rectified=rectified, window=window), at)


def logger(current: Array, period: float, *, rectified: bool, window: float) -> Array:
    """What a logger would show at every tick: the current (n,) rectified and averaged over the trailing window [s]."""
    values = np.abs(current) if rectified else current
    width = max(1, round(window / period))
    if width == 1:
        return values
    total = np.cumsum(values)
    sums = total.copy()
    sums[width:] -= total[:-width]
    return np.asarray(sums / np.minimum(np.arange(1, values.size + 1), width))


FOLDED = 9.0
"""From so many standard deviations on, folding changes a mean by less than a part in 1e16."""


def folded_mean(current: Array, noise: float) -> Array:
    """Mean of |current + n| for normal noise n of standard deviation `noise`: what a rectified log shows on average.

    The folded normal distribution (Leone, Nelson, Nottingham 1961); near zero current a rectified log never averages to
    zero.
    """
    if noise <= 0.0:
        return np.abs(current)
    folded: Array = _folded(np.ascontiguousarray(current), float(noise))
    return folded


@njit(cache=True, nogil=True)
def _folded(current, noise):  # type: ignore[no-untyped-def]
    out = np.empty(current.size)
    for k in range(current.size):
        value = abs(current[k])
        if value < FOLDED * noise:
            u = value / noise
            value = noise * (
                math.sqrt(2.0 / math.pi) * math.exp(-0.5 * u * u) + u * math.erf(u / math.sqrt(2.0))
            )
        out[k] = value
    return out


def sample_noise(values: Array) -> float:
    """Standard deviation of the noise of one sample of a log, from its second differences (robust; smooth signals)."""
    if values.size < 8:
        return 0.0
    return float(np.median(np.abs(np.diff(values, 2))) / 0.6745 / math.sqrt(6.0))


BELOW = 0.01
"""Part of the largest value by which a log must go below nought to count as signed, beyond its noise."""

AVERAGED = 5
BEYOND = (6.0, 2.0)
"""Standard deviations of the noise beyond which a sample, and a mean of so many, is no noise."""


def goes_below_nought(values: Array) -> bool:
    """Whether a logged current has a sign: one sample far below nought, or some together.

    Noise that is added after a current was rectified takes samples below nought too.
    """
    if values.size == 0:
        return False
    noise, least = sample_noise(values), BELOW * max(float(values.max()), 1e-9)
    one, some = (-max(least, times * noise) for times in BEYOND)
    means = np.convolve(values, np.ones(AVERAGED) / AVERAGED, "valid") if values.size > AVERAGED else values
    return bool(values.min() < one or means.min() < some)


THESIS = Sensors()
"""The thesis' log (P17): encoder and rectified current at 30 Hz."""

BENCH = Sensors(
    motor_rate=100.0,
    current_rectified=False,
    current_window=0.01,
    current_noise=0.005,
    voltage_rate=100.0,
    force_rate=100.0,
)
"""A better log: signed current, voltage and force at 100 Hz."""

SENSORS: Mapping[str, Sensors] = {"thesis": THESIS, "bench": BENCH}
"""Sensor sets by name."""
