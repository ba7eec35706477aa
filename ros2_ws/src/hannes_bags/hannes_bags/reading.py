"""Bag -> Recording.

Topics are recognised by their canonical name under any namespace, joints by their name; a number may be of any
plain type.  JointState messages count at their header stamp, header-less ones at their log time; `clocks` says what
happens if those are two clocks. What is wrong with the file or the data is one HannesError; what is merely
suspicious is a sentence in `metadata["warnings"]`.
"""

from __future__ import annotations

import warnings as python_warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from hannes_description.errors import HannesError
from hannes_description.joints import ENCODER_JOINT, JOINT_NAMES
from hannes_description.signals import SIGNALS, Signal

from . import cdr
from .clocks import SAME_NS, ClockRelation, relate, spread
from .mcap_file import Limits
from .recording import HOW_TO_NAME, LOOKS_LIKE, Channel, Recording
from .storage import BagMessages, TopicEntry, locate

IntArray = npt.NDArray[np.int64]

MISPLACED = "misplaced_messages"
RESERVED = ("warnings", "bag", "clock", MISPLACED, "start_ns")
"""Metadata entries that reading sets; they are not written back."""

_JOINT_SIGNALS = ("joint_positions", "joint_velocities")
_ENCODER_TOPIC = SIGNALS["encoder_position"].topic

_PLAUSIBLE: Mapping[str, tuple[float, str]] = {
    "encoder_position": (1000.0, "encoder counts (40000 counts are 14.57 rad)"),
    "reference_position": (1000.0, "encoder counts (40000 counts are 14.57 rad)"),
    "encoder_velocity": (10_000.0, "counts/s"),
    "joint_positions": (4.0, "degrees"),
    "motor_current": (100.0, "mA"),
    "motor_voltage": (100.0, "mV or a duty in per mille"),
    "emg_flexor": (5.0, "mV, uV or ADC counts"),
    "emg_extensor": (5.0, "mV, uV or ADC counts"),
    "grip_force": (1000.0, "mN or g"),
}
"""Greatest range (for positions) or magnitude that SI units let expect, and what a greater one may be."""
_DEGREES = 60.0
_THIS_CENTURY_NS = 946_684_800 * 10**9
"""Stamps (ns since 1970) from here on are of a clock that is set; on it nothing happens at zero."""


@dataclass(frozen=True)
class BagInfo:
    """What a bag holds, without decoding its messages: times in ns on the recorder's clock."""

    path: str
    storage: str
    files: tuple[str, ...]
    sha256: str
    message_count: int
    start_ns: int
    end_ns: int
    topics: tuple[TopicEntry, ...]
    metadata: Mapping[str, Any]

    @property
    def duration(self) -> float:
        """s"""
        return (self.end_ns - self.start_ns) * 1e-9


def read_and_say(path: str | Path, say: Callable[[str], None]) -> Recording:
    """The bag; what was noticed in it is said in plain sentences, not as Python's warnings."""
    with python_warnings.catch_warnings():
        python_warnings.simplefilter("ignore", RecordingWarning)
        recording = read_bag(path)
    for sentence in recording.warnings:
        say(sentence)
    return recording


def bag_info(path: str | Path, *, limits: Limits | None = None) -> BagInfo:
    """Read a bag once and tell what it holds; raises HannesError if it is not intact."""
    bag = locate(path)
    messages = BagMessages(bag, limits or Limits())
    first, last = 2**63, 0
    for _, log_ns, _ in messages:
        first, last = min(first, log_ns), max(last, log_ns)
    count = sum(messages.counts.values())
    return BagInfo(
        path=str(path),
        storage=bag.storage,
        files=tuple(file.name for file in bag.files),
        sha256=bag.sha256(),
        message_count=count,
        start_ns=first if count else 0,
        end_ns=last if count else 0,
        topics=messages.entries(),
        metadata=dict(messages.metadata),
    )


def read_bag(
    path: str | Path, *, topics: Mapping[str, str | None] | None = None, limits: Limits | None = None
) -> Recording:
    """Read a rosbag2 bag (folder, .mcap or .db3 file) into a Recording.

    topics  by signal name (or canonical topic), the topic that carries it where the name says it differently,
            or where two topics might be meant; None leaves the signal out; what is said of encoder_position or
            joint_positions holds for what else is on their topic
    limits  how much is read at most; by default 5 million messages and 1 GiB

    Raises HannesError: unreadable or damaged bag, ambiguous or missing topic, wrong type, undecodable
    message, stamps that go back. Samples that are not finite are left out, with a warning.
    """
    bag = locate(path)
    messages = BagMessages(bag, limits or Limits())
    raw: dict[str, cdr.RawTopic] = {}
    wanted: dict[str, bool] = {}
    overrides = _overrides(topics or {})
    named = set(filter(None, overrides.values()))
    for topic, log_ns, data in messages:
        if topic not in wanted:
            wanted[topic] = topic in named or _canonical_of(topic) is not None
        if wanted[topic]:
            raw.setdefault(topic, cdr.RawTopic()).append(log_ns, data)
    if not messages.counts:
        raise HannesError(f"The bag {path} holds no message.")
    return _Reader(str(path), messages, raw, overrides).recording(bag.sha256())


def _overrides(topics: Mapping[str, str | None]) -> dict[str, str | None]:
    """By signal name, the bag's topic that stands for it."""
    first = {signal.topic: signal.name for signal in reversed(tuple(SIGNALS.values()))}
    resolved: dict[str, str | None] = {}
    for key, topic in topics.items():
        signal = first.get(key, key)
        if signal not in SIGNALS:
            raise HannesError(
                f"--topic (topics= in Python): unknown signal {key!r}. Known signals: {', '.join(SIGNALS)}."
            )
        name = None if topic is None else "/" + topic.strip("/")
        if resolved.get(signal, name) != name:
            raise HannesError(
                f"--topic (topics= in Python): two topics are named for {signal}: {resolved[signal]} and {name}."
            )
        for other, taken in resolved.items():
            if name is not None and taken == name and SIGNALS[other].topic != SIGNALS[signal].topic:
                raise HannesError(
                    f"--topic (topics= in Python): {name} is named for two signals, {other} and {signal}."
                )
        resolved[signal] = name
    return resolved


def _canonical_of(topic: str) -> str | None:
    name = "/" + topic.strip("/")
    found = [signal.topic for signal in SIGNALS.values() if name.endswith("/" + signal.topic)]
    return max(found, key=len) if found else None


def _naming(signal: str, topic: str | None) -> str:
    """How this topic is said for a signal, on the command line and in Python."""
    return f"--topic {signal}={topic or ''} (topics={{{signal!r}: {topic!r}}} in Python)"


def _instead(signal: Signal) -> str:
    """What to do about a topic that cannot be the signal; without the reference nothing is compared."""
    or_not = (
        "" if signal.name == "reference_position" else f", or leave it out with {_naming(signal.name, None)}"
    )
    return f"Name another topic with {HOW_TO_NAME}{or_not}."


def _is_empty(block: cdr.JointStates) -> bool:
    return not block.names and not block.position.shape[1]


def _unstamped(stamps: IntArray) -> int:
    """Number of zero stamps (n,) that are no times: simulated time may begin with some, but never comes back."""
    zero = stamps == 0
    if int(stamps.max()) < _THIS_CENTURY_NS:
        zero = zero & np.maximum.accumulate(~zero)
    return int(zero.sum()) if not zero.all() else 0


class _Reader:
    """Makes the channels of one bag; holds what the steps share."""

    def __init__(
        self,
        path: str,
        messages: BagMessages,
        raw: Mapping[str, cdr.RawTopic],
        overrides: Mapping[str, str | None],
    ) -> None:
        self.path = path
        self.messages = messages
        self.raw = raw
        self.overrides = overrides
        self.warnings: list[str] = []
        self.repeats: dict[str, int] = {}
        self.log_ns: dict[str, IntArray] = {
            topic: np.frombuffer(messages.log_ns, dtype=np.int64) for topic, messages in raw.items()
        }
        self.coarse: dict[str, int] = {}

    def recording(self, sha256: str) -> Recording:
        chosen = self._choose()
        if not chosen:
            present = ", ".join(f"{entry.name} ({entry.type})" for entry in self.messages.entries())
            wanted = ", ".join(dict.fromkeys(signal.topic for signal in SIGNALS.values()))
            raise HannesError(
                f"The bag {self.path} has none of the topics {wanted}, under any namespace. It has: {present}. "
                f"Name the topics with {HOW_TO_NAME}; the signals are {', '.join(SIGNALS)}."
            )
        carried: dict[str, list[Signal]] = {}
        for name, topic in chosen.items():
            carried.setdefault(topic, []).append(SIGNALS[name])
        encoder_first = sorted(carried, key=lambda topic: carried[topic][0].topic != _ENCODER_TOPIC)
        states = {
            topic: self._decode(topic, cdr.decode_joint_states) for topic in encoder_first if self._is(topic)
        }
        self._spread_log_times(carried, states)
        relation = self._relation(states)
        samples: dict[str, tuple[IntArray, npt.NDArray[Any]]] = {}
        for topic, signals in carried.items():
            if topic in states:
                self._joint_channels(topic, signals, states[topic], relation, samples)
            else:
                times, values = self._plain(topic)
                samples[signals[0].name] = (relation.apply(times), values)
                self._drop_repeats(topic, [signals[0].name], samples)
        if unsure := [topic for topic in self.coarse if topic not in self.stamps]:
            self.warnings.append(
                f"The recorder's times come in steps of {max(self.coarse.values()) * 1e-6:.3g} ms (it followed a slow "
                f"/clock): the messages of a step were spread over it, on {', '.join(unsure)}, and each is right to a "
                "part of a step. Record beside a /clock that is as fast as motor/state."
            )
        if self.repeats:
            told = ", ".join(f"{count} on {topic}" for topic, count in self.repeats.items())
            self.warnings.append(
                f"Messages that repeat the one before, its stamp too, were left out: {told}."
            )
        ordered = {
            name: self._in_order(name, *finite)
            for name in SIGNALS
            if name in samples and (finite := self._finite(name, *samples[name])) is not None
        }
        if not ordered:
            raise HannesError(f"The bag {self.path} has no usable signal. " + " ".join(self.warnings))
        return self._assemble(ordered, chosen, relation, sha256)

    def _choose(self) -> dict[str, str]:
        """By signal, the bag's topic that carries it."""
        chosen: dict[str, str] = {}
        for canonical in dict.fromkeys(signal.topic for signal in SIGNALS.values()):
            first, *others = [signal for signal in SIGNALS.values() if signal.topic == canonical]
            leading = self._named(first.name) if first.name in self.overrides else self._found(first)
            for signal in (first, *others):
                topic = self._named(signal.name) if signal.name in self.overrides else leading
                if topic is None or (topic == leading and signal is not first and not self._is(topic)):
                    continue
                self._check_type(signal, topic)
                chosen[signal.name] = topic
        return chosen

    def _named(self, signal: str) -> str | None:
        """The topic that the user names for a signal."""
        named = self.overrides[signal]
        if named is not None and named not in self.raw:
            present = ", ".join(self.messages.types)
            raise HannesError(
                f"The bag {self.path} has no message on {named}, which is named for {signal}. Its topics: {present}."
            )
        return named

    def _found(self, signal: Signal) -> str | None:
        """The topic that is called as the signal's."""
        candidates = sorted(
            topic
            for topic in self.raw
            if _canonical_of(topic) == signal.topic and topic not in self.overrides.values()
        )
        if len(candidates) > 1:
            raise HannesError(
                f"The bag {self.path} has several topics that may be {signal.topic}: {', '.join(candidates)}. "
                f"Say which one with {_naming(signal.name, candidates[0])}."
            )
        return candidates[0] if candidates else None

    def _check_type(self, signal: Signal, topic: str) -> None:
        """Refuse a type that cannot be the signal; a number may be of any plain type, or the only joint's position."""
        found = self.messages.types[topic]
        usable = {signal.type}
        if signal.type == cdr.FLOAT64 or signal.topic == _ENCODER_TOPIC:
            usable |= set(cdr.NUMBERS)
        if signal.name == "reference_position":
            usable.add(cdr.JOINT_STATE)
        if found not in usable:
            raise HannesError(
                f"The bag {self.path}: topic {topic} is a {found}, but {signal.name} is a {signal.type}. "
                f"{_instead(signal)}"
            )

    def _is(self, topic: str) -> bool:
        return self.messages.types[topic] == cdr.JOINT_STATE

    def _decode(self, topic: str, decode: Any) -> Any:
        try:
            return decode(self.raw[topic])
        except cdr.CdrError as error:
            raise HannesError(
                f"The bag {self.path}: message {error.index} on {topic} cannot be read as "
                f"{self.messages.types[topic]}: {error.what}."
            ) from None

    def _plain(self, topic: str) -> tuple[IntArray, npt.NDArray[Any]]:
        msgtype = self.messages.types[topic]
        decoders = {
            cdr.STRING: lambda raw: np.array(cdr.decode_strings(raw)),
            cdr.FLOAT64_MULTI_ARRAY: cdr.decode_multi_arrays,
        }
        decode = decoders.get(msgtype, lambda raw: cdr.decode_numbers(raw, msgtype))
        return self.log_ns[topic], self._decode(topic, decode)

    def _spread_log_times(self, topics: Iterable[str], states: Mapping[str, list[cdr.JointStates]]) -> None:
        """Of a slow /clock: where what is stamped was logged in steps that its stamps do not have; without stamps,
        where anything was."""
        found = {topic: spread(self.log_ns[topic]) for topic in topics}
        for topic, blocks in states.items():
            stamps = np.sort(np.concatenate([block.stamp_ns for block in blocks]))
            if stamps.any():
                doubled = stamps.size > 1 and np.median(np.diff(stamps)) == 0
                if doubled or not found[topic][1]:
                    return
                break
        self.log_ns |= {topic: times for topic, (times, _) in found.items()}
        self.coarse = {topic: step for topic, (_, step) in found.items() if step}

    def _stamped(self, topic: str, blocks: list[cdr.JointStates]) -> tuple[IntArray, IntArray] | None:
        """(stamps, log times) in the order of the topic; None if its publisher does not stamp."""
        indices = np.concatenate([block.indices for block in blocks])
        stamps = np.concatenate([block.stamp_ns for block in blocks])[np.argsort(indices, kind="stable")]
        if not stamps.any() and len(stamps) > 1:
            self.warnings.append(f"The messages on {topic} carry no stamp: the recorder's times were used.")
            return None
        if unstamped := _unstamped(stamps):
            self.warnings.append(
                f"{unstamped} of {len(stamps)} messages on {topic} carry no stamp (it is zero): the recorder's times "
                "were used for all of them."
            )
            return None
        return stamps, self.log_ns[topic]

    def _relation(self, states: dict[str, list[cdr.JointStates]]) -> ClockRelation:
        """The encoder's stamps lead; other stamped topics are checked against them."""
        self.stamps: dict[str, IntArray] = {}
        leading: ClockRelation | None = None
        for topic, blocks in states.items():
            pair = self._stamped(topic, blocks)
            if pair is None:
                continue
            stamps, log_ns = pair
            if leading is None:
                leading = relate(topic, stamps, log_ns)
                if sentence := leading.sentence():
                    self.warnings.append(sentence)
            elif abs(int(np.median(leading.apply(log_ns) - stamps))) >= SAME_NS:
                self.warnings.append(
                    f"The stamps of {topic} are on another clock than those of {leading.topic}: the recorder's times "
                    "were used for it."
                )
                continue
            self.stamps[topic] = stamps
        return leading or ClockRelation("log")

    def _joint_channels(
        self,
        topic: str,
        signals: list[Signal],
        blocks: list[cdr.JointStates],
        relation: ClockRelation,
        samples: dict[str, tuple[IntArray, npt.NDArray[Any]]],
    ) -> None:
        times = self.stamps.get(topic)
        if times is None:
            times = relation.apply(self.log_ns[topic])
        scalar = signals[0].name not in _JOINT_SIGNALS
        columns = [self._columns(topic, block, scalar) for block in blocks]
        usable = [
            (block, column) for block, column in zip(blocks, columns, strict=True) if column is not None
        ]
        if not usable:
            self._no_joints(topic, blocks, scalar)
            return
        skipped = [block for block, column in zip(blocks, columns, strict=True) if column is None]
        for empty, what in ((True, "have no joint at all"), (False, "are of other joints")):
            count = sum(len(block.indices) for block in skipped if _is_empty(block) == empty)
            if count:
                self.warnings.append(f"{count} messages on {topic} {what}; they were left out.")
        for signal in signals:
            part = "position" if signal.field == "data" else signal.field
            fields = [(block, column, getattr(block, part)) for block, column in usable]
            self._check_numbers(topic, signal, part, fields)
            missing = [
                field.shape[1] == 0 or bool(np.isnan(field[:, column]).all()) for _, column, field in fields
            ]
            if all(missing):
                # velocity and effort are optional in a JointState: to leave them out is no fault
                if any(field.shape[1] for _, _, field in fields):
                    self.warnings.append(
                        f"The messages on {topic} have NaN for every {part}: there is no {signal.name}."
                    )
                elif part == "position":
                    self.warnings.append(
                        f"The messages on {topic} have no {part}: there is no {signal.name}."
                    )
                continue
            present = [entry for entry in fields if entry[2].shape[1]]
            indices = np.concatenate([block.indices for block, _, _ in present])
            values = np.concatenate([field[:, column] for _, column, field in present])
            order = np.argsort(indices, kind="stable")
            samples[signal.name] = (times[indices[order]], values[order])
        self._drop_repeats(topic, [signal.name for signal in signals if signal.name in samples], samples)
        if scalar:
            for signal in signals:
                if signal.name in samples:
                    stamps, values = samples[signal.name]
                    samples[signal.name] = (stamps, values[:, 0])

    def _check_numbers(
        self,
        topic: str,
        signal: Signal,
        part: str,
        fields: list[tuple[cdr.JointStates, list[int], npt.NDArray[np.float64]]],
    ) -> None:
        """Refuse a field with more or fewer numbers than there are joints: which is whose cannot be told."""
        for block, _, values in fields:
            if values.shape[1] not in (0, len(block.names) or 1):
                raise HannesError(
                    f"The bag {self.path}: {topic} has another number of {part}s than of names (message "
                    f"{int(block.indices[0])}: {values.shape[1]} for {', '.join(block.names) or 'no name'}). "
                    f"{_instead(signal)}"
                )

    def _drop_repeats(
        self, topic: str, names: list[str], samples: dict[str, tuple[IntArray, npt.NDArray[Any]]]
    ) -> None:
        """Leave out messages that repeat the one before, stamp and all (lock-step repeats for newcomers)."""
        if not names or len({len(samples[name][0]) for name in names}) != 1:
            return
        times = samples[names[0]][0]
        if len(times) < 2:
            return
        repeated = np.concatenate([[False], np.diff(times) == 0])
        for name in names:
            values = samples[name][1]
            unequal = (values[1:] != values[:-1]).reshape(len(values) - 1, -1).any(axis=1)
            repeated[1:] &= ~unequal
        if repeated.any():
            self.repeats[topic] = int(repeated.sum())
            for name in names:
                samples[name] = (samples[name][0][~repeated], samples[name][1][~repeated])

    def _columns(self, topic: str, block: cdr.JointStates, scalar: bool) -> list[int] | None:
        """Columns of the joints that this topic is about; None if the block is of other joints."""
        if not scalar:
            return (
                [block.names.index(n) for n in JOINT_NAMES] if set(JOINT_NAMES) <= set(block.names) else None
            )
        if ENCODER_JOINT in block.names:
            return [block.names.index(ENCODER_JOINT)]
        if len(block.names) <= 1 and block.position.shape[1] == 1:
            name = block.names[0] if block.names else "(no name)"
            note = f"The only joint on {topic} is called {name!r}; it was taken as {ENCODER_JOINT!r}."
            if note not in self.warnings:
                self.warnings.append(note)
            return [0]
        return None

    def _no_joints(self, topic: str, blocks: list[cdr.JointStates], scalar: bool) -> None:
        names = next((block.names for block in blocks if not _is_empty(block)), ())
        if scalar:
            raise HannesError(
                f"The bag {self.path}: {topic} has the joints {', '.join(names) or '(none)'}, but not "
                f"{ENCODER_JOINT!r}; which one is the encoder cannot be told."
            )
        missing = [name for name in JOINT_NAMES if name not in names]
        self.warnings.append(
            f"The messages on {topic} lack the joints {', '.join(missing)}: there are no joint_positions."
        )

    def _finite(
        self, name: str, times: IntArray, values: npt.NDArray[Any]
    ) -> tuple[IntArray, npt.NDArray[Any]] | None:
        """The samples without NaN and infinity; None if none is left."""
        if values.dtype.kind != "f":
            return times, values
        good = np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        if good.all():
            return times, values
        first = int(np.argmin(good))
        self.warnings.append(
            f"{int((~good).sum())} of {len(good)} samples of {name} are not finite numbers (the first is message "
            f"{first}); they were left out."
        )
        return (times[good], values[good]) if good.any() else None

    def _in_order(
        self, name: str, times: IntArray, values: npt.NDArray[Any]
    ) -> tuple[IntArray, npt.NDArray[Any]]:
        """Samples by time; a few swapped neighbours are sorted, a clock that starts again is an error."""
        back = np.diff(times)
        if (back >= 0).all():
            return times, values
        worst = int(np.argmin(back))
        typical = float(np.median(np.abs(back)))
        if -back[worst] > max(20.0 * typical, 50e6):
            raise HannesError(
                f"The bag {self.path}: the times of {name} go back at message {worst + 1}, from "
                f"{times[worst] * 1e-9:.6f} s to {times[worst + 1] * 1e-9:.6f} s: more than one run is in the bag, or "
                "the clock was set. Record each run into a bag of its own."
            )
        order = np.argsort(times, kind="stable")
        count = int((back < 0).sum())
        self.warnings.append(
            f"{count} sample{'s' * (count > 1)} of {name} came out of order; all were sorted by time."
        )
        return times[order], values[order]

    def _assemble(
        self,
        samples: dict[str, tuple[IntArray, npt.NDArray[Any]]],
        chosen: dict[str, str],
        relation: ClockRelation,
        sha256: str,
    ) -> Recording:
        start = min(int(times[0]) for times, _ in samples.values())
        misplaced = self.messages.metadata.get(MISPLACED)
        if isinstance(misplaced, int) and misplaced:
            self.warnings.append(
                f"{misplaced} messages have too early a log time: /clock came too late; signals without "
                "a header (those of Float64 topics) may be shifted."
            )
        stored = self.messages.metadata.get("start_ns")
        if isinstance(stored, int) and not isinstance(stored, bool) and 0 <= start - stored < 10**15:
            start = stored
        channels = {
            name: self._channel(name, (times - start) / 1e9, values)
            for name, (times, values) in samples.items()
        }
        for channel in channels.values():
            self._look_at_units(channel)
        metadata = {key: value for key, value in self.messages.metadata.items() if key not in RESERVED}
        metadata["warnings"] = list(self.warnings)
        read = {name: chosen[name] for name in channels}
        metadata["bag"] = {
            "storage": self.messages.bag.storage,
            "files": [file.name for file in self.messages.bag.files],
            "messages": sum(self.messages.counts.values()),
            "topics": read,
            "unread": {n: t for n, t in self.messages.types.items() if n not in read.values()},
        }
        metadata["clock"] = {
            "kind": relation.kind,
            "offset": relation.offset_ns * 1e-9,
            "topic": relation.topic,
        }
        for sentence in self.warnings:
            python_warnings.warn(f"{self.path}: {sentence}", RecordingWarning, stacklevel=4)
        return Recording(channels, metadata, self.path, sha256, start)

    def _channel(self, name: str, time: npt.NDArray[np.float64], values: npt.NDArray[Any]) -> Channel:
        try:
            return Channel(time, values, SIGNALS[name].unit, name)
        except HannesError as error:
            raise HannesError(f"The bag {self.path}: {error}") from None

    def _look_at_units(self, channel: Channel) -> None:
        if channel.name not in _PLAUSIBLE:
            return
        limit, guess = _PLAUSIBLE[channel.name]
        if channel.name.endswith("_position"):
            extent, what = float(np.ptp(channel.values)), "ranges over"
        else:
            extent, what = float(np.abs(channel.values).max()), "reaches"
        if extent > limit:
            self.warnings.append(
                f"{channel.name} {what} {extent:.4g} {channel.unit}, {LOOKS_LIKE} {guess} "
                f"rather than {channel.unit}."
            )
        elif channel.name.endswith("_position") and extent > _DEGREES:
            self.warnings.append(
                f"{channel.name} {what} {extent:.4g} {channel.unit}, {LOOKS_LIKE} degrees rather than "
                f"{channel.unit} (a full closure is 14.57 rad)."
            )


class RecordingWarning(UserWarning):
    """Something in a bag is suspicious; the same sentence is in the Recording's metadata."""
