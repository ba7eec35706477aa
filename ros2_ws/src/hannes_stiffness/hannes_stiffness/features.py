"""Features, once per stream and once for whole arrays, bit for bit the same: of single samples and of windows.

A single sample is (motor current A, reference rad, encoder rad) at one instant (thesis P20); what a window adds
(slopes, ranges, what the grasp has shown since its beginning) is in `window_features`. Three rules belong to both:

- The current is the mean over the trailing 1/rate s, because the trained sensor averages too: a 1 kHz
  stream is brought down to the trained 30 Hz, a 30 Hz stream passes unchanged.
- A sample below 0.3 A is void (P19).
- A closure starts with a current peak that no object causes (X18): for `mask` s after the reference starts
  to rise, samples are void as well.

Whether the current is rectified (what the thesis' hand logs, X17) or signed is part of the `FeatureSpec`,
and so is the version: a trained file names its spec, and a file of another spec is refused.

Only samples that move forward in time count. A sample at or before its predecessor is dropped; one that
jumps back by more than `GAP` s is a restart (a bag played again); a hole longer than `GAP` s starts afresh
after it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields

import numpy as np
from hannes_description.errors import HannesError
from numpy.typing import ArrayLike, NDArray

from .window import WINDOW_NAMES, new_window_state, window_features, window_series

SINGLE_SAMPLE = "single-sample/1"
WINDOW = "window/2"
FEATURES: Mapping[str, tuple[str, ...]] = {
    SINGLE_SAMPLE: ("motor_current", "reference_position", "encoder_position"),
    WINDOW: WINDOW_NAMES,
}
"""Names of the features by the version of their meaning; a version that changes its meaning changes its name."""
CURRENTS = ("rectified", "signed")

GAP = 0.25
"""Longest hole in a stream that is still one stream, s."""
_AVERAGED = 0.885
"""Part of the sampling period that is averaged: below 1, so that jitter does not put two slow samples into
one mean, and no multiple of a millisecond at 30 Hz, so that rounding of the stamps decides nothing."""
_EARLY = 0.245
"""Part of the sampling period by which a sample may come early and still be taken (jitter of a stream at
its own rate); no multiple of a millisecond either."""
_RISES, _RESTS = 0.5, 0.05
"""Rates of the reference, rad/s, above which a closure starts and below which the next one may start
(hysteresis)."""
_PLAUSIBLE = (100.0, 1e4, 1e4)
"""Largest believable magnitudes of current (A), reference and encoder (rad): 20 times the current limit,
700 closures."""


@dataclass(frozen=True)
class FeatureSpec:
    """What a trained classifier must know about its input.

    current       "rectified" (absolute value, as the thesis' hand logs it) or "signed"
    rate          samples a second
    void_current  a sample below it is void, A (magnitude)
    mask          time after the start of a closure in which samples are void, s
    version       version of this code's meaning
    """

    current: str = "rectified"
    rate: float = 30.0
    void_current: float = 0.3
    mask: float = 0.2
    version: str = SINGLE_SAMPLE

    def __post_init__(self) -> None:
        if self.version not in FEATURES:
            raise HannesError(
                f"Feature version {self.version!r} is none of this code's, {', '.join(FEATURES)}; train the "
                "classifier again with `hannes stiffness train`."
            )
        if self.current not in CURRENTS:
            raise HannesError(
                f"Feature setting current={self.current!r} is unknown; valid are {', '.join(CURRENTS)}."
            )
        for name, low, high in (("rate", 1.0, 10_000.0), ("void_current", 0.0, 10.0), ("mask", 0.0, 5.0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
                raise HannesError(
                    f"Feature setting {name}={value!r} must be a number from {low:g} to {high:g}."
                )

    @property
    def period(self) -> float:
        """Time between samples, s."""
        return 1.0 / self.rate

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the features, in their order."""
        return FEATURES[self.version]

    def to_dict(self) -> dict[str, object]:
        """Plain types, for the manifest."""
        return asdict(self)

    @classmethod
    def from_dict(cls, content: object, where: str) -> FeatureSpec:
        """From a manifest; `where` begins the message of the HannesError that names what is wrong."""
        known = [f.name for f in fields(cls)]
        if not isinstance(content, Mapping) or set(content) != set(known):
            raise HannesError(
                f"{where}: the features must be a mapping with exactly the keys {', '.join(known)}."
            )
        return cls(**dict(content))


@dataclass(frozen=True)
class Sample:
    """One feature sample: time s, values in the order of the spec's names, and whether the rules make it void."""

    time: float
    values: tuple[float, ...]
    void: bool


@dataclass(frozen=True)
class Features:
    """Feature samples of a whole stream.

    time      (m,) s
    values    (m, k) in the order of the spec's names, float32 (the precision of the trained file)
    void      (m,) bool: below the void current, or in the start-up of a closure
    rejected  input samples dropped: not finite, not believable, or not later than the one before
    restarts  times the stream started afresh after a hole or a jump back
    """

    time: NDArray[np.float64]
    values: NDArray[np.float32]
    void: NDArray[np.bool_]
    rejected: int = 0
    restarts: int = 0


def believable(current: ArrayLike, reference: ArrayLike, encoder: ArrayLike) -> NDArray[np.bool_]:
    """True where all three are finite and of a believable magnitude; NaN compares false."""
    result: NDArray[np.bool_] = np.ones((), dtype=bool)
    for value, limit in zip((current, reference, encoder), _PLAUSIBLE, strict=True):
        result = result & (np.abs(np.asarray(value, dtype=float)) <= limit)
    return result


@dataclass
class FeatureStream:
    """Feature samples from a stream, one input sample at a time.

    `push` answers a `Sample` when one is due (about `rate` a second, by default `spec.rate`, and never more
    often than the input), else None. `rejected` and `restarts` count as in `Features`.
    """

    spec: FeatureSpec = field(default_factory=FeatureSpec)
    rate: float | None = None
    rejected: int = 0
    restarts: int = 0

    def __post_init__(self) -> None:
        self._period = 1.0 / _checked_rate(self.spec, self.rate)
        self._last: float | None = None
        self._begin(0.0)

    def _begin(self, time: float) -> None:
        self._anchor = time
        self._tick = self._due = -1
        self._window: deque[tuple[float, float]] = deque()
        self._before: tuple[float, float] | None = None
        self._rising = False
        self._onset = -np.inf
        self._grasp = new_window_state()
        self._values = np.empty(len(WINDOW_NAMES))

    def reset(self) -> None:
        """Forget the stream; the counts stay."""
        self._last = None

    def push(self, time: float, current: float, reference: float, encoder: float) -> Sample | None:
        """Take the values at `time` (s, A, rad, rad)."""
        spec = self.spec
        if not (
            math.isfinite(time)
            and abs(current) <= _PLAUSIBLE[0]
            and abs(reference) <= _PLAUSIBLE[1]
            and abs(encoder) <= _PLAUSIBLE[2]
        ):
            self.rejected += 1
            return None
        if self._last is None:
            self._begin(time)
        elif time - self._last > GAP or time - self._last < -GAP:
            self.restarts += 1
            self._begin(time)
        elif time <= self._last:
            self.rejected += 1
            return None
        self._last = time

        self._window.append((time, abs(current) if spec.current == "rectified" else current))
        oldest = time - _AVERAGED * spec.period
        while self._window[0][0] <= oldest:
            self._window.popleft()
        tick = math.floor((time - self._anchor) / spec.period + _EARLY)
        due = math.floor((time - self._anchor) / self._period + _EARLY)
        ticked, answers = tick > self._tick, due > self._due
        self._tick, self._due = max(tick, self._tick), max(due, self._due)
        if spec.version == WINDOW:
            if not ticked and not answers:
                return None
            mean = float(np.mean(np.array([c for _, c in self._window])))
            # An answer between two ticks leaves no trace, so that the features mean the same at any rate of answers.
            state = self._grasp if ticked else self._grasp.copy()
            blind = window_features(state, time, mean, reference, encoder, spec.mask, self._values)
            if not answers:
                return None
            return Sample(time, tuple(self._values.tolist()), blind or abs(mean) < spec.void_current)
        if ticked:
            self._watch(time, reference)
        if not answers:
            return None
        mean = float(np.mean(np.array([c for _, c in self._window])))
        void = abs(mean) < spec.void_current or time - self._onset < spec.mask
        return Sample(time, (mean, reference, encoder), void)

    def _watch(self, time: float, reference: float) -> None:
        """Notice the start of a closure."""
        if self._before is not None:
            rate = (reference - self._before[1]) / (time - self._before[0])
            if rate > _RISES and not self._rising:
                self._rising, self._onset = True, time
            elif rate <= _RESTS:
                self._rising = False
        self._before = (time, reference)


def _checked_rate(spec: FeatureSpec, rate: float | None) -> float:
    rate = spec.rate if rate is None else rate
    if not 0.1 <= rate <= 10_000.0:
        raise HannesError(f"The rate of answers is {rate!r}; it must be from 0.1 to 10000 a second.")
    return rate


def extract(
    time: ArrayLike,
    current: ArrayLike,
    reference: ArrayLike,
    encoder: ArrayLike,
    spec: FeatureSpec | None = None,
    rate: float | None = None,
) -> Features:
    """Feature samples of whole arrays, equal to pushing them one by one through `FeatureStream`.

    time (n,) s; current (n,) A; reference, encoder (n,) rad. Raises HannesError where the lengths differ.
    """
    spec = spec or FeatureSpec()
    period = 1.0 / _checked_rate(spec, rate)
    t, i, r, q = (np.asarray(a, dtype=float) for a in (time, current, reference, encoder))
    if t.ndim != 1 or not t.shape == i.shape == r.shape == q.shape:
        raise HannesError(
            f"Features need four arrays of one length; time has shape {t.shape}, current {i.shape}, "
            f"reference {r.shape}, encoder {q.shape}."
        )
    keep = np.isfinite(t) & believable(i, r, q)
    rejected = int(np.count_nonzero(~keep))
    t, i, r, q = t[keep], i[keep], r[keep], q[keep]
    if spec.current == "rectified":
        i = np.abs(i)

    pieces: list[Features] = []
    start = 0
    while start < len(t):
        latest = np.maximum.accumulate(t[start:])
        step = t[start + 1 :] - latest[:-1]
        breaks = np.flatnonzero((step > GAP) | (step < -GAP))
        stop = start + 1 + int(breaks[0]) if len(breaks) else len(t)
        forward = np.r_[True, step[: stop - start - 1] > 0.0]
        rejected += int(np.count_nonzero(~forward))
        t_, i_, r_, q_ = (x[start:stop][forward] for x in (t, i, r, q))
        pieces.append(_extract_stretch(t_, i_, r_, q_, spec, period))
        start = stop
    if not pieces:
        return Features(
            np.empty(0), np.empty((0, len(spec.names)), np.float32), np.empty(0, bool), rejected, 0
        )
    return Features(
        np.concatenate([p.time for p in pieces]),
        np.concatenate([p.values for p in pieces]),
        np.concatenate([p.void for p in pieces]),
        rejected,
        len(pieces) - 1,
    )


def _extract_stretch(
    t: NDArray[np.float64],
    i: NDArray[np.float64],
    r: NDArray[np.float64],
    q: NDArray[np.float64],
    spec: FeatureSpec,
    period: float,
) -> Features:
    """One stretch without holes, strictly forward in time."""
    watched, due = _ticks(t, spec.period), _ticks(t, period)
    if spec.version == WINDOW:
        use = np.union1d(watched, due)
        first = np.searchsorted(t, t[use] - _AVERAGED * spec.period, side="right")
        mean = np.array([np.mean(i[a : b + 1]) for a, b in zip(first, use, strict=True)])
        values, blind = window_series(
            t[use], mean, r[use], q[use], np.isin(use, watched), spec.mask, len(WINDOW_NAMES)
        )
        answers = np.isin(use, due)
        void = blind | (np.abs(mean) < spec.void_current)
        return Features(t[due], values[answers].astype(np.float32), void[answers])
    first = np.searchsorted(t, t[due] - _AVERAGED * spec.period, side="right")
    mean = np.array([np.mean(i[a : b + 1]) for a, b in zip(first, due, strict=True)])

    rate = np.diff(r[watched]) / np.diff(t[watched])
    # 1 where the reference rises, -1 where it rests, 0 where the state before holds; it starts at rest.
    switch = np.r_[-1, np.where(rate > _RISES, 1, np.where(rate <= _RESTS, -1, 0))]
    held = switch[np.maximum.accumulate(np.where(switch != 0, np.arange(len(switch)), 0))]
    starts = np.r_[False, (held[1:] == 1) & (held[:-1] == -1)]
    onset = np.maximum.accumulate(np.where(starts, t[watched], -np.inf))
    latest = onset[np.searchsorted(watched, due, side="right") - 1]
    void = (np.abs(mean) < spec.void_current) | (t[due] - latest < spec.mask)
    return Features(t[due], np.column_stack([mean, r[due], q[due]]).astype(np.float32), void)


def _ticks(t: NDArray[np.float64], period: float) -> NDArray[np.intp]:
    """Indices of the samples that are the first of their tick."""
    tick = np.floor((t - t[0]) / period + _EARLY)
    return np.flatnonzero(np.r_[True, np.diff(tick) > 0])


def hold(time: ArrayLike, values: ArrayLike, at: ArrayLike) -> NDArray[np.float64]:
    """The last value at or before each instant of `at`; NaN before the first one and where it is older than
    `GAP` s.

    time (n,) ascending s, values (n,), at (m,) s. Aligns channels of different rates without looking ahead,
    as the node does online.
    """
    t, v, a = (np.asarray(x, dtype=float) for x in (time, values, at))
    if len(t) == 0:
        return np.full(len(a), np.nan)
    index = np.searchsorted(t, a + 1e-9, side="right") - 1
    out = v[np.clip(index, 0, None)].copy()
    out[(index < 0) | (a - t[np.clip(index, 0, None)] > GAP)] = np.nan
    return out
