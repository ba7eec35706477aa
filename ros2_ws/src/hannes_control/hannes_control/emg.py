"""Two-channel surface EMG to a position reference, and EMG to try it with.

The way of a published Hannes controller (thesis P13: two sites, 300 Hz): each channel is rectified and low-pass
filtered to an envelope; the hand closes while the flexor's envelope exceeds a threshold and opens while the extensor's
does and exceeds the flexor's; a speed proportional to the envelope is integrated into a position reference limited to
the hand's travel. Both channels high at once (co-contraction) is not a movement but a switch event.

Signals that are envelopes already (electrodes that rectify and smooth) may be given as they are: rectifying a positive
signal changes nothing and the low-pass only adds its delay. `full_scale` is the envelope of a full contraction; all
thresholds are fractions of it, so a recording in 0..1 needs full_scale 1 and an electrode of 0..5 V needs 5.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, fields
from math import gcd
from pathlib import Path

import numpy as np
from hannes_description.errors import HannesError
from numpy.typing import NDArray
from scipy import signal

from .reference import FULL_CLOSURE, MOST

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EmgParameters:
    """How EMG becomes a reference.

    rate                     Hz, of both channels
    full_scale               V, envelope of a full contraction; everything below is relative to it
    envelope_cutoff          Hz, second-order Butterworth low-pass of the rectified signal
    dead_band                1, envelope that counts as zero speed
    close_threshold          1, flexor envelope above which the hand closes (published: 2.0 of 5)
    open_threshold           1, extensor envelope above which the hand opens (published: 2.0 of 5)
    speed                    rad/s at the pulley for a full contraction
    max_speed                rad/s, limit
    max_position             rad, the reference stays in [0, max_position]
    cocontraction_threshold  1, both envelopes above it is a co-contraction (published: 2.5 of 5)
    cocontraction_time       s, how long both must stay above it to be a switch event
    """

    rate: float = 300.0
    full_scale: float = 1.0
    envelope_cutoff: float = 3.0
    dead_band: float = 0.1
    close_threshold: float = 0.4
    open_threshold: float = 0.4
    speed: float = 15.0
    max_speed: float = 20.0
    max_position: float = FULL_CLOSURE
    cocontraction_threshold: float = 0.5
    cocontraction_time: float = 0.05

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not (math.isfinite(value) and value >= 0.0):
                raise HannesError(
                    f"EMG parameter '{item.name}' is {value}; it must be a finite number of at least 0."
                )
        for name in ("rate", "full_scale", "envelope_cutoff", "speed", "max_speed", "max_position"):
            if getattr(self, name) == 0.0:
                raise HannesError(f"EMG parameter '{name}' is 0; it must be positive.")
        if self.envelope_cutoff >= self.rate / 2.0:
            raise HannesError(
                f"EMG parameter 'envelope_cutoff' is {self.envelope_cutoff} Hz; it must be below half "
                f"the rate, {self.rate / 2.0} Hz."
            )
        for name in ("close_threshold", "open_threshold"):
            if getattr(self, name) < self.dead_band:
                raise HannesError(
                    f"EMG parameter '{name}' is {getattr(self, name)}; it must be at least the dead "
                    f"band, {self.dead_band}."
                )

    def filter(self) -> Array:
        """Second-order section (6,) of the envelope's low-pass: b0 b1 b2 1 a1 a2."""
        section: Array = signal.butter(2, self.envelope_cutoff, fs=self.rate, output="sos")[0]
        return section


# -- vectorised ------------------------------------------------------------------------------------------------------
def envelope(emg: Array, parameters: EmgParameters) -> Array:
    """Envelope of a channel (n,), V in, fraction of full scale out: rectified and low-pass filtered, causal."""
    rectified = np.abs(np.asarray(emg, dtype=np.float64))
    filtered: Array = signal.sosfilt(parameters.filter()[np.newaxis], rectified)
    return filtered / parameters.full_scale


@dataclass(frozen=True)
class EmgReference:
    """What a whole recording commands: reference (n,) rad at the pulley, envelopes (n,), sample numbers of switches."""

    reference: Array
    flexor_envelope: Array
    extensor_envelope: Array
    switches: tuple[int, ...]


def emg_reference(flexor: Array, extensor: Array, parameters: EmgParameters | None = None) -> EmgReference:
    """Reference of a whole recording, from two channels (n,) in V; what EmgIntegrator gives sample by sample."""
    parameters = parameters or EmgParameters()
    flexor, extensor = np.asarray(flexor, dtype=np.float64), np.asarray(extensor, dtype=np.float64)
    if flexor.ndim != 1 or flexor.shape != extensor.shape:
        raise HannesError(
            f"The EMG channels have the shapes {flexor.shape} and {extensor.shape}; they must be 1-D and "
            "of the same length."
        )
    for name, channel in (("flexor", flexor), ("extensor", extensor)):
        bad = np.flatnonzero(~np.isfinite(channel))
        if bad.size:
            raise HannesError(f"The {name} EMG is not finite at sample {bad[0]} ({bad.size} samples in all).")
    flexor_envelope, extensor_envelope = envelope(flexor, parameters), envelope(extensor, parameters)
    logic = _Logic(parameters)
    reference, switches = np.empty(flexor.size), []
    for k, (close, opening) in enumerate(
        zip(flexor_envelope.tolist(), extensor_envelope.tolist(), strict=True)
    ):
        reference[k] = logic.step(close, opening)
        if logic.switched:
            switches.append(k)
    return EmgReference(reference, flexor_envelope, extensor_envelope, tuple(switches))


# -- sample by sample ------------------------------------------------------------------------------------------------
class _Logic:
    """Thresholds, proportional speed, integration and co-contraction, on envelopes (fractions of full scale)."""

    def __init__(self, parameters: EmgParameters) -> None:
        self._p = parameters
        self._dt = 1.0 / parameters.rate
        self.position = 0.0
        self.switched = False
        self._both = 0.0
        self._armed = True

    def step(self, close: float, opening: float) -> float:
        """Reference (rad) after one sample."""
        p, self.switched = self._p, False
        if close > p.cocontraction_threshold and opening > p.cocontraction_threshold:
            self._both += self._dt
            if self._armed and self._both >= p.cocontraction_time:
                self._armed, self.switched = False, True
            return self.position
        if close < p.cocontraction_threshold and opening < p.cocontraction_threshold:
            self._armed = True  # one event for one contraction: both must have fallen again
        self._both = 0.0
        if opening > p.open_threshold and opening > close:
            speed = -min(p.speed * (opening - p.dead_band), p.max_speed)
        elif close > p.close_threshold:
            speed = min(p.speed * (close - p.dead_band), p.max_speed)
        else:
            return self.position
        self.position = min(max(self.position + speed * self._dt, 0.0), p.max_position)
        return self.position


class _Envelope:
    """The low-pass of one channel, one sample at a time (direct form II transposed, as scipy's sosfilt)."""

    def __init__(self, parameters: EmgParameters) -> None:
        self._b0, self._b1, self._b2, _, self._a1, self._a2 = (float(c) for c in parameters.filter())
        self._full_scale = parameters.full_scale
        self._z0 = self._z1 = 0.0

    def step(self, emg: float) -> float:
        x = abs(emg)
        y = self._b0 * x + self._z0
        self._z0 = self._b1 * x - self._a1 * y + self._z1
        self._z1 = self._b2 * x - self._a2 * y
        return y / self._full_scale


class EmgIntegrator:
    """EMG to reference, one sample of both channels at a time.

    reference  rad at the pulley, after the last sample
    switches   number of co-contractions so far
    """

    def __init__(self, parameters: EmgParameters | None = None) -> None:
        self.parameters = parameters or EmgParameters()
        self.reset()

    def reset(self) -> None:
        """Open hand, no signal."""
        self._flexor, self._extensor = _Envelope(self.parameters), _Envelope(self.parameters)
        self._logic = _Logic(self.parameters)
        self.switches = 0

    @property
    def reference(self) -> float:
        return self._logic.position

    def update(self, flexor: float, extensor: float) -> float:
        """The reference (rad) after one more sample of both channels (V); HannesError if a sample is not finite."""
        if not (math.isfinite(flexor) and math.isfinite(extensor)):
            raise HannesError(f"The EMG sample is not finite: flexor {flexor}, extensor {extensor}.")
        reference = self._logic.step(self._flexor.step(flexor), self._extensor.step(extensor))
        self.switches += self._logic.switched
        return reference


# -- EMG to try it with ----------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class EmgRecording:
    """Two channels (n,) in V, sampled together at `rate` Hz from time 0."""

    rate: float
    flexor: Array
    extensor: Array

    @property
    def duration(self) -> float:
        """s"""
        return self.flexor.size / self.rate

    def resampled(self, rate: int) -> EmgRecording:
        """At another integer rate, by a polyphase filter; the recording itself if it has that rate."""
        if self.rate == rate:
            return self
        old = round(self.rate)
        if abs(old - self.rate) > 1e-3 * self.rate:
            raise HannesError(
                f"The EMG has {self.rate:.3f} Hz, which is no integer; resample it to {rate} Hz first."
            )
        common = gcd(old, rate)
        flexor, extensor = (
            signal.resample_poly(channel, rate // common, old // common)
            for channel in (self.flexor, self.extensor)
        )
        return EmgRecording(float(rate), flexor, extensor)


@dataclass(frozen=True)
class SyntheticEmg:
    """A protocol of contractions, `closures` times: flexor (closing), hold, extensor (opening), rest.

    close hold open rest  s, durations
    amplitude             V, mean rectified value of a full contraction
    effort                1, contraction level while closing and opening
    noise                 V, mean rectified value at rest
    cocontraction         s, both muscles at once after each rest; 0 for none
    """

    closures: int = 1
    close: float = 1.6
    hold: float = 1.0
    open: float = 1.6
    rest: float = 0.8
    amplitude: float = 1.0
    effort: float = 0.9
    noise: float = 0.02
    cocontraction: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            low = 1 if item.name == "closures" else 0.0
            if not (math.isfinite(value) and value >= low):
                raise HannesError(
                    f"Synthetic EMG: '{item.name}' is {value}; it must be a finite number of at least {low}."
                )


def synthesise(protocol: SyntheticEmg, seed: int, rate: int = 300) -> EmgRecording:
    """Surface EMG of a protocol: Gaussian noise of 20 Hz to 0.45 rate, its amplitude modulated by the contraction.

    Amplitude-modulated band-limited noise is the usual model of the interference pattern (Hogan & Mann 1980). Onset and
    release take 0.1 s. The same seed gives the same samples.
    """
    if rate < 100:
        raise HannesError(f"The EMG rate is {rate} Hz; synthetic EMG needs at least 100 Hz.")
    level = protocol.effort
    steps = [(protocol.rest / 2.0, 0.0, 0.0)]
    for _ in range(protocol.closures):
        steps += [
            (protocol.close, level, 0.0),
            (protocol.hold, 0.0, 0.0),
            (protocol.open, 0.0, level),
            (protocol.rest, 0.0, 0.0),
        ]
        if protocol.cocontraction > 0.0:
            steps += [(protocol.cocontraction, 1.0, 1.0), (protocol.rest, 0.0, 0.0)]
    counts = [round(duration * rate) for duration, _, _ in steps]
    if sum(counts) > MOST:
        raise HannesError(
            f"Synthetic EMG of {protocol.closures} closures takes {sum(counts):.3g} samples at {rate} Hz; at most "
            f"{MOST} are made: ask for fewer or shorter ones."
        )
    rng = np.random.default_rng(seed)
    band = signal.butter(4, (20.0, 0.45 * rate), btype="bandpass", fs=rate, output="sos")
    ramp = np.hanning(max(3, round(0.1 * rate)) + 2)[1:-1]
    lead = rate  # the filter's transient is cut off
    channels = []
    for which in (1, 2):
        activation = np.concatenate(
            [np.full(count, step[which]) for count, step in zip(counts, steps, strict=True)]
        )
        smooth = np.convolve(activation, ramp / ramp.sum(), mode="same")
        carrier = signal.sosfilt(band, rng.standard_normal(smooth.size + lead))[lead:]
        carrier /= np.mean(np.abs(carrier))
        channels.append((protocol.noise + protocol.amplitude * smooth) * carrier)
    return EmgRecording(float(rate), channels[0], channels[1])


def read_emg_csv(
    path: str | Path, close: str = "close", opening: str = "open", time: str = "t_s"
) -> EmgRecording:
    """EMG from a CSV file with a header: a time column in s and one column in V (or fraction) for each channel.

    Other columns are ignored. Raises HannesError that names the file, the column and the line of what is wrong.
    """
    path = Path(path)
    columns: tuple[list[float], list[float], list[float]] = ([], [], [])
    names = (time, close, opening)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # as spreadsheets write it
            reader = csv.DictReader(file)
            missing = [name for name in names if name not in (reader.fieldnames or ())]
            if missing:
                raise HannesError(
                    f"{path}: there is no column '{missing[0]}'; the header is "
                    f"{', '.join(reader.fieldnames or ()) or 'empty'}, needed are {', '.join(names)}."
                )
            for row in reader:
                for name, column in zip(names, columns, strict=True):
                    column.append(_number(row[name], path, reader.line_num, name))
                if len(columns[0]) > 1 and columns[0][-1] <= columns[0][-2]:
                    raise HannesError(
                        f"{path}, line {reader.line_num}: the time {columns[0][-1]} s is not after the "
                        f"one before, {columns[0][-2]} s."
                    )
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise HannesError(f"Cannot read the EMG file '{path}': {error}.") from error
    count = len(columns[0])
    if count < 10:
        raise HannesError(f"{path}: there are {count} samples; at least 10 are needed.")
    t = np.array(columns[0])
    rate = (count - 1) / (t[-1] - t[0])
    gap = int(np.argmax(np.diff(t)))
    if np.diff(t)[gap] > 1.5 / rate:
        raise HannesError(
            f"{path}: samples are missing after t = {t[gap]} s (a gap of {np.diff(t)[gap]:.4f} s at "
            f"{rate:.1f} Hz); the EMG must be sampled evenly."
        )
    # Times printed with few digits give 300.0016 Hz for 300 Hz.
    rate = float(round(rate)) if abs(rate - round(rate)) < 1e-3 * rate else float(rate)
    return EmgRecording(rate, np.array(columns[1]), np.array(columns[2]))


def _number(text: str | None, path: Path, line: int, name: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        raise HannesError(f"{path}, line {line}: {name} is {text!r}, not a number.") from None
    if not math.isfinite(value):
        raise HannesError(f"{path}, line {line}: {name} is {value}; it must be finite.")
    return value
