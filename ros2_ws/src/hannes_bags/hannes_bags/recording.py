"""A recording: named, timed, checked signals, independent of where they came from.

`Recording` is what every tool of the lab works on, whether it was read from a bag (`reading.read_bag`) or
made from a rollout. Times are in s since the recording's start, values in the SI unit of
`hannes_description.signals.SIGNALS`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from hannes_description.errors import HannesError
from hannes_description.joints import JOINT_NAMES
from hannes_description.signals import SIGNALS

FloatArray = npt.NDArray[np.float64]
Method = Literal["linear", "previous", "nearest"]

_TEXT_SIGNALS = frozenset(name for name, signal in SIGNALS.items() if signal.type == "std_msgs/msg/String")
HOW_TO_NAME = "--topic SIGNAL=TOPIC (topics={signal: topic} in Python)"
"""How the topic of a signal is said, on the command line and in Python."""

LOOKS_LIKE = "which looks like"
"""In the warning of a reader that guesses at another unit; what converts units leaves such warnings out."""

_COLUMNS = {"joint_positions": len(JOINT_NAMES), "joint_velocities": len(JOINT_NAMES)}
_VECTOR_SIGNALS = frozenset(_COLUMNS) | {
    name for name, signal in SIGNALS.items() if signal.type == "std_msgs/msg/Float64MultiArray"
}


@dataclass(frozen=True, eq=False)
class Channel:
    """One signal over time; the arrays are read-only copies.

    time    (n,) float64, s since the recording's start, finite, never decreasing; n >= 1
    values  (n,) float64, or (n, 13) for joint_positions and joint_velocities (ordered by JOINT_NAMES), (n, k)
            for stiffness_probability, (n,) text for stiffness_label; finite, in `unit`
    unit    the unit of SIGNALS[name]
    name    canonical signal name

    Raises HannesError that names the channel and the index of the first bad sample.
    """

    time: FloatArray
    values: npt.NDArray[Any]
    unit: str
    name: str

    def __post_init__(self) -> None:
        if self.name not in SIGNALS:
            raise HannesError(f"Unknown signal {self.name!r}. Known signals: {', '.join(SIGNALS)}.")
        expected_unit = SIGNALS[self.name].unit
        if self.unit != expected_unit:
            raise HannesError(
                f"Channel {self.name!r} is given in {self.unit!r}, but its unit is {expected_unit!r}: convert it first."
            )
        time = _array(self.name, "time", self.time)
        if time.ndim != 1 or time.size == 0:
            raise HannesError(
                f"Channel {self.name!r}: time must have shape (n,) with n >= 1, but has shape {time.shape}."
            )
        values = self._checked_values(time.size)
        bad = np.flatnonzero(~np.isfinite(time))
        if bad.size:
            raise HannesError(
                f"Channel {self.name!r}: time is {time[bad[0]]} at index {bad[0]}; it must be finite."
            )
        back = np.flatnonzero(np.diff(time) < 0.0)
        if back.size:
            k = int(back[0]) + 1
            raise HannesError(
                f"Channel {self.name!r}: time goes back at index {k} (from {time[k - 1]:.6f} s to {time[k]:.6f} s); "
                "it must never decrease."
            )
        time.setflags(write=False)
        values.setflags(write=False)
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "values", values)

    def _checked_values(self, n: int) -> npt.NDArray[Any]:
        if self.name in _TEXT_SIGNALS:
            values: npt.NDArray[Any] = np.array(self.values, dtype=str)
        else:
            values = _array(self.name, "values", self.values)
        dimensions = 2 if self.name in _VECTOR_SIGNALS else 1
        if values.ndim != dimensions or values.shape[0] != n:
            shape = "(n,)" if dimensions == 1 else "(n, k)"
            raise HannesError(
                f"Channel {self.name!r}: values must have shape {shape} with n = {n} as time has, "
                f"but have shape {values.shape}."
            )
        columns = _COLUMNS.get(self.name)
        if columns is not None and values.shape[1] != columns:
            raise HannesError(
                f"Channel {self.name!r}: values must have {columns} columns ({', '.join(JOINT_NAMES)}), "
                f"but have {values.shape[1]}."
            )
        if self.name not in _TEXT_SIGNALS:
            bad = np.argwhere(~np.isfinite(values))
            if bad.size:
                index = ", ".join(str(int(i)) for i in bad[0])
                raise HannesError(
                    f"Channel {self.name!r} is {values[tuple(bad[0])]} at index {index} "
                    f"(t = {self.time[int(bad[0][0])]} s); values must be finite."
                )
        return values

    @property
    def period(self) -> float:
        """Median time between samples, s; 0.0 if there is only one sample."""
        return float(np.median(np.diff(self.time))) if self.time.size > 1 else 0.0


def _array(name: str, what: str, values: object) -> FloatArray:
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise HannesError(f"Channel {name!r}: {what} cannot be read as numbers: {error}.") from None


@dataclass(frozen=True, eq=False)
class Recording:
    """A set of channels on one clock, with what is known of them.

    channels  by canonical signal name
    metadata  JSON-like; what the bag says of itself (condition, object, closures, seed ...) and, from
              `read_bag`, "warnings" (list of sentences), "bag" (storage, topics) and "clock" (how the times
              were aligned)
    source    path that it was read from, or what made it
    sha256    of the bag's storage files (equals `sha256sum` for a bag of one file); of the content if not
              from a bag
    start_ns  time 0 of the channels on the recording's own clock, ns
    """

    channels: Mapping[str, Channel]
    metadata: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""
    sha256: str = ""
    start_ns: int = 0

    def __post_init__(self) -> None:
        if not self.channels:
            raise HannesError(f"The recording {self.source or '(in memory)'} has no channels.")
        for name, channel in self.channels.items():
            if name != channel.name:
                raise HannesError(f"Recording: the channel stored as {name!r} calls itself {channel.name!r}.")
        object.__setattr__(self, "channels", MappingProxyType(dict(self.channels)))
        object.__setattr__(self, "metadata", MappingProxyType(dict(self.metadata)))
        object.__setattr__(self, "start_ns", int(self.start_ns))
        if not self.sha256:
            object.__setattr__(self, "sha256", self.content_sha256())

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def __getitem__(self, name: str) -> Channel:
        self.require((name,))
        return self.channels[name]

    def __reduce__(self) -> tuple[Any, ...]:
        """Pass between worker processes: a MappingProxyType cannot be copied as it is."""
        return Recording, (dict(self.channels), dict(self.metadata), self.source, self.sha256, self.start_ns)

    @property
    def begin(self) -> float:
        """Time of the first sample of any channel, s."""
        return min(float(channel.time[0]) for channel in self.channels.values())

    @property
    def end(self) -> float:
        """Time of the last sample of any channel, s."""
        return max(float(channel.time[-1]) for channel in self.channels.values())

    @property
    def duration(self) -> float:
        """From the first to the last sample of any channel, s."""
        return self.end - self.begin

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was noticed on reading, as sentences."""
        return tuple(self.metadata.get("warnings", ()))

    def require(self, names: Iterable[str]) -> None:
        """Raise one HannesError that lists every missing signal of `names` and the signals that are
        present."""
        wanted = list(names)
        unknown = [name for name in wanted if name not in SIGNALS]
        if unknown:
            raise HannesError(
                f"Unknown signal{'s' * (len(unknown) > 1)} {', '.join(map(repr, unknown))}. "
                f"Known signals: {', '.join(SIGNALS)}."
            )
        missing = [name for name in wanted if name not in self.channels]
        if missing:
            topics = ", ".join(f"{name} (topic {SIGNALS[name].topic})" for name in missing)
            raise HannesError(
                f"The recording {self.source or '(in memory)'} lacks {topics}. It has: {', '.join(self.channels)}. "
                + self.elsewhere()
            )

    def elsewhere(self) -> str:
        """How to say that a signal was recorded under another topic, and which topics of the bag were not read."""
        bag = self.metadata.get("bag", {})
        unread = ", ".join(f"{n} ({t})" for n, t in bag.get("unread", {}).items())
        read = ", ".join(f"{topic} as {name}" for name, topic in bag.get("topics", {}).items())
        if unread:
            others = f"not read were {unread}"
        elif read:
            others = f"the bag has no topics but those that were read: {read}"
        else:
            others = "the bag has no other topic"
        return f"If it was recorded under another topic, name that with {HOW_TO_NAME}; {others}."

    def slice(self, t0: float, t1: float) -> Recording:
        """The samples with t0 <= time < t1, with t0 as the new time 0; channels without a sample there are
        left out.

        Raises HannesError if t0 >= t1 or if nothing lies between.
        """
        if not t0 < t1:
            raise HannesError(
                f"Cannot cut the recording {self.source} from {t0} s to {t1} s: the start must be earlier."
            )
        channels: dict[str, Channel] = {}
        for name, channel in self.channels.items():
            i, j = np.searchsorted(channel.time, [t0, t1], side="left")
            if i < j:
                channels[name] = replace(channel, time=channel.time[i:j] - t0, values=channel.values[i:j])
        if not channels:
            raise HannesError(
                f"The recording {self.source} has no sample from {t0} s to {t1} s; "
                f"it runs from {self.begin:.6f} s to {self.end:.6f} s."
            )
        return Recording(channels, self.metadata, self.source, "", self.start_ns + round(t0 * 1e9))

    def resample(self, name: str, times: npt.ArrayLike, method: Method = "linear") -> npt.NDArray[Any]:
        """Values of a channel at `times` (m,), shape (m,) or (m, k).

        method  "linear" between samples; "previous" holds the last sample (commands, classes); "nearest"
        At most one sample period before the first or after the last sample the edge value is held; beyond
        that the channel says nothing and a HannesError is raised. Text channels take "previous" or "nearest".
        """
        channel = self[name]
        at = np.asarray(times, dtype=np.float64)
        margin = max(channel.period, 1e-9) * 1.5
        if at.size and (at.min() < channel.time[0] - margin or at.max() > channel.time[-1] + margin):
            raise HannesError(
                f"Channel {name!r} of {self.source or 'the recording'} runs from {channel.time[0]:.6f} s to "
                f"{channel.time[-1]:.6f} s; values from {at.min():.6f} s to {at.max():.6f} s were asked for."
            )
        if method == "linear":
            if name in _TEXT_SIGNALS:
                raise HannesError(
                    f"Channel {name!r} is text: resample it with method 'previous' or 'nearest'."
                )
            if channel.values.ndim == 1:
                return np.interp(at, channel.time, channel.values)
            columns = [np.interp(at, channel.time, column) for column in channel.values.T]
            return np.stack(columns, axis=1)
        if method not in ("previous", "nearest"):
            raise HannesError(f"Unknown resampling method {method!r}; valid: linear, previous, nearest.")
        right = np.searchsorted(channel.time, at, side="right")
        before = np.clip(right - 1, 0, channel.time.size - 1)
        if method == "previous":
            return channel.values[before]
        after = np.clip(right, 0, channel.time.size - 1)
        closer = np.abs(channel.time[after] - at) < np.abs(at - channel.time[before])
        return channel.values[np.where(closer, after, before)]

    def with_metadata(self, **entries: Any) -> Recording:
        """The same recording with these metadata entries set."""
        return replace(self, metadata={**self.metadata, **entries})

    def content_sha256(self) -> str:
        """SHA-256 over names, units, times, values, start and metadata, in a fixed order."""
        digest = hashlib.sha256()
        for name in sorted(self.channels):
            channel = self.channels[name]
            digest.update(f"{name} {channel.unit} {channel.values.shape}\n".encode())
            digest.update(np.ascontiguousarray(channel.time, dtype="<f8").tobytes())
            if name in _TEXT_SIGNALS:
                digest.update("\0".join(channel.values.tolist()).encode())
            else:
                digest.update(np.ascontiguousarray(channel.values, dtype="<f8").tobytes())
        digest.update(str(self.start_ns).encode())
        digest.update(json.dumps(dict(self.metadata), sort_keys=True, default=str).encode())
        return digest.hexdigest()

    def differences(self, other: Recording) -> list[str]:
        """How the channels of `other` differ from these, as sentences; empty if times and values are equal
        exactly."""
        found = [
            f"{name} is only in one of the two." for name in sorted(set(self.channels) ^ set(other.channels))
        ]
        if self.start_ns != other.start_ns:
            found.append(f"start_ns is {self.start_ns} and {other.start_ns}.")
        for name in self.channels:
            if name not in other.channels:
                continue
            mine, theirs = self.channels[name], other.channels[name]
            if mine.values.shape != theirs.values.shape:
                found.append(f"{name} has shape {mine.values.shape} and {theirs.values.shape}.")
                continue
            if not np.array_equal(mine.time, theirs.time):
                k = int(np.flatnonzero(mine.time != theirs.time)[0])
                found.append(
                    f"{name}: time differs first at index {k}: {mine.time[k]!r} and {theirs.time[k]!r}."
                )
            if not np.array_equal(mine.values, theirs.values):
                k = int(np.argwhere(mine.values != theirs.values)[0][0])
                found.append(
                    f"{name}: values differ first at index {k}: {mine.values[k]!r} and {theirs.values[k]!r}."
                )
        return found
