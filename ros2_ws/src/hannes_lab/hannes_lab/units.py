"""Signals in another unit than SI, with another sign, shifted, dead or with absurd samples: noticed, mended, and said.

The recordings of one command come from one recorder: unit, sign and shift of a signal are decided once, from all of
them, and are the same in all.  Encoder and reference go over at most a few turns of the pulley (a full closure is
14.57 rad), the motor takes amperes and volts.  A factor that the user gives (`--scale SIGNAL=FACTOR`) is taken instead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from hannes_bags.recording import LOOKS_LIKE, Recording
from hannes_description.errors import HannesError
from hannes_description.joints import RAD_PER_COUNT
from hannes_description.output import with_unit
from hannes_description.signals import SIGNALS
from numpy.typing import NDArray

Array = NDArray[np.float64]
Guess = tuple[float, str, float]

REFERENCE, ENCODER, CURRENT = "reference_position", "encoder_position", "motor_current"
FORCE = "grip_force"

DRIVES = (CURRENT, "motor_voltage", "motor_effort")
"""What a motor takes: it changes where the reference moves, whatever the hand does.  A grip force need not."""

_ANGLE_UNITS: tuple[Guess, ...] = (
    (1000.0, "encoder counts", RAD_PER_COUNT),
    (60.0, "degrees", math.pi / 180.0),
)
_GUESSES: Mapping[str, tuple[Guess, ...]] = {
    REFERENCE: _ANGLE_UNITS,
    "motor_voltage": ((100.0, "mV", 1e-3),),
    "motor_effort": ((100.0, "N.mm", 1e-3),),
    "grip_force": ((2000.0, "mN", 1e-3),),
}
"""Range (reference) or magnitude above which a signal is not in its unit, what it then looks like, and its factor."""

SAME_UNIT = 20.0
"""Times by which the references of one recorder may differ in range: less than units of angle do (57, 157)."""

FOLLOWS = (0.2, 1.5)
"""Range of the encoder over that of the reference that it follows, at least and at most; little where it is blocked."""

STANDS = 0.05
"""Range of an encoder over that of its reference up to which it does not move with or against it."""

AGAINST = -0.5
"""Correlation of encoder and reference, or of a signal and its simulation, below which they go against each other."""

FREE = 0.7
"""The same in a free closure, at least: some recording must reach it before the encoder's unit is taken for another."""

SHIFT = 1.0
LEAST_SHIFT = 1.0
"""Spans of the reference, and rad: an encoder that rests farther from it than both is nowhere between open and closed,
but shifted.  Smaller offsets are what the lab fits and looks for."""

SAME_SHIFT = 0.1
"""Spans by which the shift may differ between recordings of one encoder; a rest position scatters by less."""

REST = 0.1
"""s for which the reference must stand before the first closure to tell where the encoder rests."""

CURRENTS = (0.05, 10.0)
"""A while the hand closes, at least and at most: the motor's dry friction alone takes 0.11 A; blocked, with 12 V, the
motor takes 8 A."""

WORK = 0.3
"""Work that a current must do, or take, of the most that it could while the hand closes, to have a sign; noise does
none."""

FEW = 5
RARE = 0.002
"""Absurd samples: at most this many neighbours, and at most FEW or this part of a signal."""

FAR = 30.0
FAR_ANGLE = 3.0
"""Ranges of all other samples beyond which a sample is absurd.  A motor that starts takes 8 A, in free run 0.3 A, which
is 27 times less: that must stay.  No machine goes over several times its way and back within a few samples."""

_STEP = 0.02  # s in which work is summed


@dataclass
class _One:
    """One recording on its way to SI.

    asked, done  range of reference and encoder
    guessed      factors that the user did not give
    """

    where: str
    samples: dict[str, tuple[Array, Array]]
    notes: list[str] = field(default_factory=list)
    guessed: dict[str, float] = field(default_factory=dict)

    @property
    def asked(self) -> float:
        return _range(self.samples[REFERENCE][1])

    @property
    def done(self) -> float:
        return _range(self.samples[ENCODER][1])

    def multiply(self, name: str, factor: float, why: str) -> None:
        time, values = self.samples[name]
        self.samples[name] = (time, values * factor)
        self.notes.append(f"{name} was multiplied by {factor:.6g}: {why}")


def in_si(recordings: Sequence[Recording], scale: Mapping[str, float]) -> list[Recording]:
    """The recordings of one recorder in SI, each with what was done among its warnings; without signals that are dead.

    scale   factors by signal name that the user gives
    Raises HannesError for an encoder that does not follow the reference (another unit, shaft or sign), a current that
    is in no unit, and recordings that contradict each other.
    """
    ones = [
        _One(r.source, {n: (np.asarray(c.time), np.array(c.values)) for n, c in r.channels.items()})
        for r in recordings
    ]
    for one in ones:
        _drop_absurd(one)
        _drop_dead(one, scale)
    _drop_dead_force(ones, scale)
    for name in dict.fromkeys(name for one in ones for name in one.samples):
        with_it = [one for one in ones if name in one.samples]
        if name in scale:
            for one in with_it if scale[name] != 1.0 else ():
                one.multiply(name, scale[name], "as --scale says")
        elif name in _GUESSES:
            _convert(with_it, name, *_by_size(with_it, name))
    for one in ones:
        _check_closes_upwards(one)
    with_encoder = [one for one in ones if ENCODER in one.samples]
    if ENCODER not in scale:
        _convert(with_encoder, ENCODER, *_by_reference(with_encoder))
        _shift_back(with_encoder)
    for one in with_encoder:
        _check_follows(one)
    if CURRENT not in scale:
        _convert_current([one for one in ones if CURRENT in one.samples])
    return [_recording(r, one) for r, one in zip(recordings, ones, strict=True)]


def _recording(recording: Recording, one: _One) -> Recording:
    channels = {
        name: replace(channel, time=one.samples[name][0], values=one.samples[name][1])
        for name, channel in recording.channels.items()
        if name in one.samples
    }
    # The reader's guesses at units give way to what was done.
    read = [w for w in recording.warnings if LOOKS_LIKE not in w]
    return replace(recording, channels=channels).with_metadata(warnings=[*read, *one.notes])


def _range(values: Array) -> float:
    """Range without the rare samples at both ends."""
    low, high = np.quantile(values, (RARE, 1.0 - RARE))
    return float(high - low)


def _drop_absurd(one: _One) -> None:
    for name, (time, values) in one.samples.items():
        absurd = _absurd(values, FAR_ANGLE if name in (REFERENCE, ENCODER) else FAR)
        if absurd.any():
            one.samples[name] = (time[~absurd], values[~absurd])
            farthest = values[absurd][np.argmax(np.abs(values[absurd] - np.median(values)))]
            one.notes.append(
                f"{int(absurd.sum())} of {values.size} samples of {name} are far outside everything else that it does "
                f"(one is {farthest:.4g}); they were left out"
            )


def _drop_dead(one: _One, scale: Mapping[str, float]) -> None:
    """Leave out what a motor takes where it never changes though the reference moves: nothing was measured."""
    for name in DRIVES:
        if name not in one.samples or name in scale or one.asked == 0.0:
            continue
        values = one.samples[name][1]
        if values.size < FEW or np.ptp(values) > 0.0:
            continue
        told = f"{name} is {with_unit(values[0], SIGNALS[name].unit)} throughout, though the reference moves"
        if set(one.samples) == {REFERENCE, name}:
            raise HannesError(
                f"{one.where}: {told}: it was not measured, and nothing else can be compared. Record it again, with an "
                f"encoder, or say --scale {name}=1 to take it as it is."
            )
        del one.samples[name]
        one.notes.append(
            f"{told}: it was not measured and is left out; say --scale {name}=1 to take it as it is"
        )


def _drop_dead_force(ones: Sequence[_One], scale: Mapping[str, float]) -> None:
    """Leave out a force that never changes in any of the recordings; in one of them nothing may have been pressed."""
    with_it = [one for one in ones if FORCE in one.samples and set(one.samples) != {REFERENCE, FORCE}]
    if FORCE in scale or any(np.ptp(one.samples[FORCE][1]) > 0.0 for one in with_it):
        return
    for one in with_it:
        value = float(one.samples[FORCE][1][0])
        one.notes.append(
            f"{FORCE} is {with_unit(value, SIGNALS[FORCE].unit)} throughout in all recordings: it was not measured, or "
            f"nothing was pressed, and is left out; say --scale {FORCE}=1 to take it as it is"
        )
        del one.samples[FORCE]


def _check_closes_upwards(one: _One) -> None:
    """Raise a HannesError for a reference that sets off downwards, and goes over negative angles all but alone."""
    values = one.samples[REFERENCE][1]
    low, high = float(values.min()), float(values.max())
    if values[0] > 0.5 * (low + high) and high < 0.1 * one.asked and low < -0.5 * one.asked:
        raise HannesError(
            f"{one.where}: {REFERENCE} goes from {values[0]:.4g} to {low:.4g} rad, but closing is positive: say "
            f"--scale {REFERENCE}=-1 --scale {ENCODER}=-1 (and --scale {CURRENT}=-1, --scale motor_voltage=-1 where "
            "they are negative while the hand closes)."
        )


def _absurd(values: Array, far: float) -> NDArray[np.bool_]:
    """Rare runs of few samples that leave the others' range by `far` times that range."""
    out = np.zeros(values.size, dtype=bool)
    rare = max(FEW, int(RARE * values.size))
    if values.size < 10 * FEW:
        return out
    others = values[np.argsort(np.abs(values - np.median(values)))[:-rare]]
    span = float(np.ptp(others))
    beyond = np.maximum(others.min() - values, values - others.max())
    outside = np.flatnonzero(beyond > span)
    for run in np.split(outside, np.flatnonzero(np.diff(outside) > 1) + 1):
        # A peak on top of something longer is no absurd sample: the run is what leaves the range by once the range.
        if span > 0.0 and 0 < run.size <= FEW and beyond[run].max() > far * span:
            out[run] = True
    return out


def _convert(ones: Sequence[_One], name: str, factor: float, why: str) -> None:
    for one in ones if factor != 1.0 else ():
        one.multiply(name, factor, f"{why}; say --scale {name}=1 if it is not, or give another factor")
        one.guessed[name] = factor


def _by_size(ones: Sequence[_One], name: str) -> tuple[float, str]:
    """Factor of a signal to SI, and why."""
    values = [one.samples[name][1] for one in ones]
    sizes = [_range(v) if name == REFERENCE else float(np.quantile(np.abs(v), 1.0 - RARE)) for v in values]
    size = max(sizes)
    for limit, unit, factor in _GUESSES[name]:
        if size > limit:
            other = [k for k, s in enumerate(sizes) if 0.0 < s < size / SAME_UNIT]
            if name == REFERENCE and other:
                raise HannesError(
                    f"{name} goes over {size:.4g} in {ones[int(np.argmax(sizes))].where} and looks like {unit}, but "
                    f"over {sizes[other[0]]:.4g} in {ones[other[0]].where}: recordings given together must be in one "
                    f"unit. Give them one by one, or say --scale {name}=FACTOR."
                )
            return factor, f"it reaches {size:.4g} and looks like {unit}, not {SIGNALS[name].unit}"
    return 1.0, ""


def _by_reference(ones: Sequence[_One]) -> tuple[float, str]:
    """Factor of the encoder to rad with which some recording goes over about as much as its reference, and why."""
    ratios = np.array([one.done / one.asked for one in ones if one.asked > 0.0 and one.done > 0.0])
    if not ratios.size:
        return 1.0, ""
    shared = ones[0].guessed.get(REFERENCE)
    for _, unit, factor in ((0.0, "rad", 1.0), *_ANGLE_UNITS):
        best = factor * ratios[np.argmin(np.abs(np.log(factor * ratios)))]
        if (FOLLOWS[0] if factor in (1.0, shared) else FREE) <= best <= FOLLOWS[1]:
            reaches = max(one.done for one in ones)
            return factor, f"it reaches {reaches:.4g} and looks like {unit}, not rad"
    return 1.0, ""


def _shift_back(ones: Sequence[_One]) -> None:
    """An encoder that rests farther than a span from its reference, by one constant in all recordings, is shifted."""
    rests = [(one.where, *rest) for one in ones if (rest := _rest(one)) is not None]
    span = max((one.asked for one in ones), default=0.0)
    limit = max(SHIFT * span, LEAST_SHIFT)
    if not any(abs(off) > limit and abs(at) > abs(at - off) for _, at, off in rests):
        return
    offs = [off for _, _, off in rests]
    if np.ptp(offs) > SAME_SHIFT * span:
        said = ", ".join(f"{off:.4g} rad in {where}" for where, _, off in rests)
        raise HannesError(
            f"{ENCODER} rests far from {REFERENCE}, by another amount in each recording ({said}). Give recordings of "
            f"one zero, or say --scale {ENCODER}=1 to take it as it is."
        )
    shift = float(np.median(offs))
    for one in ones:
        time, values = one.samples[ENCODER]
        one.samples[ENCODER] = (time, values - shift)
        one.notes.append(
            f"{ENCODER} rests {shift:.4g} rad from {REFERENCE} and was shifted by that; say --scale {ENCODER}=1 to "
            "take it as it is"
        )


def _rest(one: _One) -> tuple[float, float] | None:
    """Where the encoder rests before the first closure, and how far from the reference; None if it does not rest."""
    (rt, reference), (et, encoder) = one.samples[REFERENCE], one.samples[ENCODER]
    left = np.flatnonzero(np.abs(reference - reference[0]) > 0.02 * one.asked)
    before = et < rt[left[0]] if left.size else np.zeros(et.size, dtype=bool)
    if before.sum() < 3 or np.ptp(et[before]) < REST:
        return None
    at = float(np.median(encoder[before]))
    return at, at - float(reference[0])


def follows(reference: tuple[Array, Array], encoder: tuple[Array, Array]) -> tuple[float, float] | None:
    """Times the reference's range that an encoder goes over, and their correlation (0 where it hardly moves).

    None where the reference stands still.
    """
    (rt, asked), (et, done) = reference, encoder
    if et.size < 3 or _range(asked) == 0.0:
        return None
    times = _range(done) / _range(asked)
    r = np.interp(et, rt, asked)
    both = float(np.std(r) * np.std(done))
    if times <= STANDS or both == 0.0:
        return times, 0.0
    return times, float(np.mean((r - r.mean()) * (done - done.mean()))) / both


def _check_follows(one: _One) -> None:
    found = follows(one.samples[REFERENCE], one.samples[ENCODER])
    if found is None:
        return
    times, correlation = found
    asked, done = one.asked, one.done
    if correlation < AGAINST:
        raise HannesError(
            f"{one.where}: encoder_position moves against reference_position: one of them has the other sign. Say "
            "--scale encoder_position=-1 (or --scale reference_position=-1)."
        )
    if not FOLLOWS[0] <= times <= FOLLOWS[1]:
        ranges = [
            f"{name} goes over {size:.4g} rad"
            + (f" (after this program multiplied it by {f:.4g})" if (f := one.guessed.get(name)) else "")
            for name, size in ((ENCODER, done), (REFERENCE, asked))
        ]
        raise HannesError(
            f"{one.where}: {', '.join(ranges)}; that is {times:.3g} times as much, and an encoder that follows "
            "its reference goes over about as much. Is one of them in another unit (rad, degrees, counts) or at "
            "another shaft (motor, pulley)? Give its factor to rad at the pulley: --scale SIGNAL=FACTOR."
        )


def _closing(one: _One) -> tuple[float, float] | None:
    """Size of the current while the hand closes, and the work that it does of the most that it could (-1 to 1)."""
    angle = one.samples.get(ENCODER, one.samples[REFERENCE])
    time, current = one.samples[CURRENT]
    grid = np.arange(max(time[0], angle[0][0]), min(time[-1], angle[0][-1]), _STEP)
    if grid.size < 8 or one.asked == 0.0:
        return None
    steps = np.diff(np.interp(grid, *angle))
    closes = steps > 0.2 * steps.max()
    i, steps = np.interp(grid[:-1] + 0.5 * _STEP, time, current)[closes], steps[closes]
    most = float(np.abs(i) @ steps)
    return (float(np.median(np.abs(i))), float(i @ steps) / most) if most > 0.0 else None


def _convert_current(ones: Sequence[_One]) -> None:
    """Another unit than A, where the currents while closing say so together, and the sign with which it closes."""
    told = [(one, *closing) for one in ones if (closing := _closing(one)) is not None]
    if not told:
        return
    size = float(np.median([s for _, s, _ in told]))
    least, most = CURRENTS
    for one in ones if size < least else ():
        one.notes.append(
            f"{CURRENT} is about {size:.4g} A while the hand closes, less than friction alone takes: if it is in "
            f"another unit, say --scale {CURRENT}=FACTOR"
        )
    if most < size < 1e3 * least:
        where = f"{ones[0].where} and others" if len(ones) > 1 else ones[0].where
        raise HannesError(
            f"{where}: {CURRENT} is in an unknown unit: it is about {size:.4g} while the hand closes, too much for A "
            "(the motor takes 8 A at most) and too little for mA (its friction alone takes 110 mA). Give its factor "
            f"to A: --scale {CURRENT}=FACTOR."
        )
    milli = size > most
    for one, s, work in told:
        other = (least <= s <= most) if milli else (s >= 1e3 * least)
        if other and abs(work) > WORK:
            raise HannesError(
                f"{CURRENT} while the hand closes is about {s:.4g} in {one.where}, but {size:.4g} over all recordings: "
                "recordings given together must be in one unit. Give them one by one, or say "
                f"--scale {CURRENT}=FACTOR."
            )
    if milli:
        _convert(
            ones, CURRENT, 1e-3, f"it is about {size:.4g} while the hand closes and looks like mA, not A"
        )
    _turn(ones, [one.where for one, _, w in told if w > WORK], [one.where for one, _, w in told if w < -WORK])


def _turn(ones: Sequence[_One], positive: Sequence[str], negative: Sequence[str]) -> None:
    """A current that takes work from the closing hand, which needs some against friction and spring, is turned."""
    if positive and negative:
        raise HannesError(
            f"{CURRENT} is positive while the hand closes in {', '.join(positive)}, but negative in "
            f"{', '.join(negative)}: recordings given together must have one sign. Give them one by one, or say "
            f"--scale {CURRENT}=1 (or -1) to take them as they are."
        )
    for one in ones if negative else ():
        time, current = one.samples[CURRENT]
        one.samples[CURRENT] = (time, -current)
        one.notes.append(
            f"{CURRENT} is negative while the hand closes: its sign was turned; say --scale {CURRENT}=1 if that is "
            "wrong"
        )
