"""Messages -> bag: a writer that a kill cannot rob of more than its last chunk, and Recording -> bag.

A bag is a folder `NAME/` with `NAME_0.mcap` and, once it is closed, `metadata.yaml` (rosbag2 version 9), as
`ros2 bag` makes and reads it: definitions embedded, RIHS01 type hashes, QoS, the recording's metadata as
custom_data and as an MCAP metadata record at the file's beginning (so that it survives a kill).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import yaml
from hannes_description.errors import HannesError
from hannes_description.files import write_whole
from hannes_description.joints import ENCODER_JOINT, JOINT_NAMES
from hannes_description.signals import NAMESPACE, SIGNALS

from . import cdr
from .mcap_file import Compression, McapWriter
from .reading import RESERVED
from .recording import Channel, Recording
from .storage import MCAP_METADATA, METADATA_FILE, encode_entries

FORMAT = "hannes_bags 1"
_QOS_NAMES = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
}
"""Names by number, as versions up to 8 store them (rmw's enumerations)."""
_FOREVER = {"sec": 9223372036, "nsec": 854775807}


@dataclass(frozen=True)
class Qos:
    """Offered QoS of a topic's publisher, as rosbag2 stores it; names as in rosbag2's metadata version 9."""

    reliability: str = "reliable"
    durability: str = "volatile"
    history: str = "keep_last"
    depth: int = 10

    @staticmethod
    def from_text(text: str) -> Qos:
        """The first profile of a stored offered_qos_profiles; the default where it cannot be understood."""
        try:
            profiles = yaml.safe_load(text[:20_000])
        except (
            yaml.YAMLError,
            ValueError,
            RecursionError,
            OverflowError,
            TypeError,
            AttributeError,
            LookupError,
        ):
            return Qos()
        if not isinstance(profiles, list) or not profiles or not isinstance(profiles[0], dict):
            return Qos()
        values: dict[str, Any] = {}
        for key, names in _QOS_NAMES.items():
            value = profiles[0].get(key)
            if isinstance(value, int) and not isinstance(value, bool):
                value = names[value] if 0 <= value < len(names) else None
            if value in names:
                values[key] = value
        depth = profiles[0].get("depth")
        if isinstance(depth, int) and not isinstance(depth, bool) and 0 <= depth < 2**31:
            values["depth"] = depth
        return Qos(**values)

    def as_dict(self) -> dict[str, Any]:
        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": dict(_FOREVER),
            "lifespan": dict(_FOREVER),
            "liveliness": "automatic",
            "liveliness_lease_duration": dict(_FOREVER),
            "avoid_ros_namespace_conventions": False,
        }


@dataclass
class _Topic:
    name: str
    type: str
    type_hash: str
    qos: Qos
    channel_id: int
    definition: tuple[str, bytes] = field(default=("", b""))


class BagWriter:
    """Writes serialised messages into a new bag; use as a context manager or call `close`.

    path         the bag's folder, which must not exist yet
    metadata     JSON-like; kept in the bag
    chunk_bytes  a chunk is handed over when it is this long, or at `flush`; what `flush` has handed over
                 survives a kill
    compression  "none" (default; the bytes do not depend on a compressor's version) or "zstd" (about a third)

    The same calls make the same bytes. Raises HannesError if the folder exists or cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        metadata: Mapping[str, Any] | None = None,
        *,
        chunk_bytes: int = 32 * 1024,
        compression: Compression = "none",
    ) -> None:
        self.path = Path(path)
        if compression not in ("none", "zstd"):
            raise HannesError(f"Unknown compression {compression!r} of a bag; valid: none, zstd.")
        self._custom = {"format": f'"{FORMAT}"', **encode_entries(metadata or {}, RESERVED[:-1])}
        if self.path.exists() or self.path.is_symlink():
            raise HannesError(f"{self.path} exists already; a bag is never overwritten. Choose another name.")
        try:
            self.path.mkdir(parents=True)
            self._file = self.path / f"{self.path.name}_0.mcap"
            self._stream = self._file.open("xb", buffering=1 << 20)
        except OSError as error:
            raise HannesError(f"Cannot write the bag {self.path}: {error.strerror or error}.") from None
        self._topics: dict[str, _Topic] = {}
        self._schemas: dict[str, int] = {}
        self._closed = False
        self._mcap = McapWriter(self._stream, chunk_bytes=chunk_bytes, compression=compression)
        self._mcap.add_metadata(MCAP_METADATA, self._custom)
        self.flush()

    @property
    def message_count(self) -> int:
        return self._mcap.message_count

    def counts(self) -> dict[str, int]:
        """Messages written by topic."""
        counts = self._mcap.counts()
        return {topic.name: counts[topic.channel_id] for topic in self._topics.values()}

    def add_topic(
        self,
        name: str,
        msgtype: str,
        *,
        qos: Qos | None = None,
        definition: tuple[str, bytes] | None = None,
        type_hash: str | None = None,
    ) -> None:
        """Announce a topic before its first message.

        definition  (encoding, text) for a type that ROS 2 Jazzy's common interfaces do not have, with its
                    type_hash
        """
        if name in self._topics:
            raise HannesError(f"Topic {name} was added to the bag {self.path} already.")
        if definition is None:
            try:
                text, known_hash = cdr.definition(msgtype)
            except KeyError:
                raise HannesError(
                    f"The definition of the message type {msgtype!r} of {name} is not known."
                ) from None
            definition, type_hash = ("ros2msg", text.encode()), known_hash if type_hash is None else type_hash
        offered = qos or Qos()
        if msgtype not in self._schemas:
            self._schemas[msgtype] = self._mcap.add_schema(msgtype, *definition)
        metadata = {
            "offered_qos_profiles": yaml.safe_dump([offered.as_dict()], sort_keys=False).strip(),
            "topic_type_hash": type_hash or "",
        }
        channel_id = self._mcap.add_channel(name, self._schemas[msgtype], metadata)
        self._topics[name] = _Topic(name, msgtype, type_hash or "", offered, channel_id, definition)

    def write(self, topic: str, data: bytes | memoryview, log_ns: int, publish_ns: int | None = None) -> None:
        """Append one serialised (CDR) message at its log time, ns."""
        if not 0 <= log_ns < 2**63:
            raise HannesError(f"A message on {topic} cannot have the time {log_ns} ns.")
        self._mcap.add_message(
            self._topics[topic].channel_id, log_ns, log_ns if publish_ns is None else publish_ns, data
        )

    def flush(self) -> None:
        """Hand all messages so far to the operating system, so that a kill cannot take them."""
        try:
            self._mcap.end_chunk()
            self._stream.flush()
        except OSError as error:
            raise self._cannot_write(error) from None

    def _cannot_write(self, error: OSError) -> HannesError:
        return HannesError(f"Cannot write the bag {self.path}: {error.strerror or error}.")

    def sync(self) -> None:
        """Wait until the disk has what was handed over; may be called from another thread than the others."""
        try:
            if not self._stream.closed:
                os.fdatasync(self._stream.fileno())
        except OSError as error:
            raise self._cannot_write(error) from None

    def close(self, more_metadata: Mapping[str, Any] | None = None) -> None:
        """Write the index and metadata.yaml; harmless if called again.

        more_metadata  what is known only now, such as what was lost
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._mcap.end_chunk()
            if more_metadata:
                self._custom |= encode_entries(more_metadata)
                self._mcap.add_metadata(MCAP_METADATA, self._custom)
            information = self._information()
            text = yaml.safe_dump(
                {"rosbag2_bagfile_information": information}, sort_keys=False, allow_unicode=True
            )
            # Without the file's own name, so that a bag has the same bytes under any name.
            nameless = {**information, "relative_file_paths": [], "files": []}
            serialised = yaml.safe_dump(nameless, sort_keys=False, allow_unicode=True)
            self._mcap.add_metadata("rosbag2", {"serialized_metadata": serialised})
            self._mcap.finish()
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._stream.close()
            write_whole(self.path / METADATA_FILE, text)
        except OSError as error:
            raise self._cannot_write(error) from None

    def _information(self) -> dict[str, Any]:
        counts = self.counts()
        first, last = self._mcap.first_ns or 0, self._mcap.last_ns or 0
        span = {
            "duration": {"nanoseconds": last - first},
            "starting_time": {"nanoseconds_since_epoch": first},
            "message_count": self.message_count,
        }
        return {
            "version": 9,
            "storage_identifier": "mcap",
            **span,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": [topic.qos.as_dict()],
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": counts[topic.name],
                }
                for topic in self._topics.values()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._file.name],
            "files": [
                {
                    "path": self._file.name,
                    **{key: dict(v) if isinstance(v, dict) else v for key, v in span.items()},
                }
            ],
            "custom_data": self._custom,
            "ros_distro": "jazzy",
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close()


def write_recording(
    recording: Recording,
    path: str | Path,
    *,
    namespace: str = NAMESPACE,
    compression: Compression = "none",
) -> Path:
    """Write a Recording as a bag with the topics of the node graph; gives back the bag's folder.

    Stamps and log times are start_ns + time, rounded to ns; numbers are exact. `read_bag` gives the same
    channels, metadata and start_ns. The same recording makes the same bytes. Signals of one JointState topic
    (encoder_position, encoder_velocity, motor_effort; joint_positions, joint_velocities) must share their
    times, and the position must be there. Raises HannesError otherwise, or if `path` exists.
    """
    prefix = "/" + namespace.strip("/") if namespace.strip("/") else ""
    if recording.start_ns < 0:
        raise HannesError(
            f"The recording {recording.source} starts at {recording.start_ns} ns; a bag's times are >= 0."
        )
    streams = list(_streams(recording))
    with BagWriter(
        path, {**recording.metadata, "start_ns": recording.start_ns}, compression=compression
    ) as writer:
        for canonical, msgtype, _, _ in streams:
            writer.add_topic(f"{prefix}/{canonical}", msgtype)
        times = np.concatenate([stamps for _, _, stamps, _ in streams])
        owners = np.concatenate([np.full(len(stamps), k) for k, (_, _, stamps, _) in enumerate(streams)])
        names = [f"{prefix}/{canonical}" for canonical, _, _, _ in streams]
        iterators = [iter(messages) for _, _, _, messages in streams]
        for k in np.argsort(times, kind="stable"):
            owner = owners[k]
            writer.write(names[owner], next(iterators[owner]), int(times[k]))
    return Path(path)


def _streams(recording: Recording) -> Iterator[tuple[str, str, npt.NDArray[np.int64], Sequence[bytes]]]:
    """(canonical topic, type, stamps ns, messages) for each topic, in the order of SIGNALS."""
    done: set[str] = set()
    for signal in SIGNALS.values():
        present = [
            s.name for s in SIGNALS.values() if s.topic == signal.topic and s.name in recording.channels
        ]
        if signal.topic in done or not present:
            continue
        done.add(signal.topic)
        channels = [recording.channels[name] for name in present]
        stamps = np.rint(channels[0].time * 1e9).astype(np.int64) + recording.start_ns
        if stamps[0] < 0:
            raise HannesError(
                f"{present[0]} of {recording.source} begins before time 0; a bag's times are >= 0."
            )
        if signal.type == cdr.JOINT_STATE:
            yield signal.topic, signal.type, stamps, _joint_states(signal.topic, channels, stamps)
        elif signal.type == cdr.STRING:
            yield signal.topic, signal.type, stamps, cdr.encode_strings(channels[0].values.tolist())
        elif signal.type == cdr.FLOAT64_MULTI_ARRAY:
            yield signal.topic, signal.type, stamps, cdr.encode_multi_arrays(channels[0].values)
        else:
            yield signal.topic, signal.type, stamps, cdr.encode_float64(channels[0].values)


def _joint_states(topic: str, channels: list[Channel], stamps: npt.NDArray[np.int64]) -> list[bytes]:
    fields: dict[str, npt.NDArray[np.float64]] = {}
    for channel in channels:
        if not np.array_equal(channel.time, channels[0].time):
            raise HannesError(
                f"{channel.name} and {channels[0].name} share the messages of {topic}, so they must share their times: "
                "resample one of them."
            )
        fields[SIGNALS[channel.name].field] = channel.values.reshape(len(stamps), -1)
    if "position" not in fields:
        raise HannesError(
            f"{channels[0].name} cannot be written without the position that shares its topic {topic}."
        )
    names = [ENCODER_JOINT] if fields["position"].shape[1] == 1 else list(JOINT_NAMES)
    return cdr.encode_joint_states(
        stamps, names, fields["position"], fields.get("velocity"), fields.get("effort")
    )
