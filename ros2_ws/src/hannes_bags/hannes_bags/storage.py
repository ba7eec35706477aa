"""What lies on disk: the files of a bag, its metadata.yaml, and its raw messages, read within bounds.

rosbag2 bags are a folder with metadata.yaml and storage files (MCAP or SQLite), or a single storage file.
Nothing here decodes a message. Every failure is a HannesError that says which file, what is wrong and what to
do. The files are read here rather than by rosbags because rosbags allocates by the lengths that it finds,
executes code that it makes from the definitions in the bag, and loads YAML with a parser that overflows the
stack on deep nesting.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import re
import sqlite3
import stat
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import yaml
import zstandard
from hannes_description.errors import HannesError

from .mcap_file import Limits, McapDamage, McapScan

METADATA_FILE = "metadata.yaml"
MCAP_METADATA = "hannes"
"""Name of the MCAP metadata record that holds the recording's own metadata."""
_METADATA_BYTES = 256 * 1024
_STORAGE = {".mcap": "mcap", ".db3": "sqlite3"}
_RECOVER = "Run `hannes recover {} NEW_FOLDER` to save what is in it."
_NAME = re.compile(r"[A-Za-z0-9_/]{1,255}")
_SQLITE_STEPS_PER_BYTE = 50
_SQLITE_STEPS_LEAST = 20_000_000


@dataclass(frozen=True)
class TopicEntry:
    """A topic of a bag: type, number of messages, type hash and the publishers' QoS (both empty if not
    known)."""

    name: str
    type: str
    count: int
    type_hash: str = ""
    offered_qos: str = ""


@dataclass(frozen=True)
class BagFiles:
    """Where a bag's bytes are.

    path      what was asked for
    files     storage files in the order of recording
    storage   "mcap" or "sqlite3"
    yaml      content of rosbag2_bagfile_information; {} for a single file
    """

    path: Path
    files: tuple[Path, ...]
    storage: str
    yaml: Mapping[str, Any] = field(default_factory=dict)

    @property
    def compression(self) -> str:
        """rosbag2's compression mode: "", "file" or "message"."""
        mode = str(self.yaml.get("compression_mode") or "").lower()
        return "" if mode == "none" else mode

    def packed(self, file: Path) -> bool:
        """Whether that file is packed as a whole; one that was unpacked beside it is not."""
        return self.compression == "file" and file.suffix not in _STORAGE

    def sha256(self) -> str:
        """SHA-256 over the bytes of the storage files, in order."""
        digest = hashlib.sha256()
        for path in self.files:
            with _reading(path), path.open("rb") as stream:
                while block := stream.read(1 << 20):
                    digest.update(block)
        return digest.hexdigest()


def recover_hint(path: Path) -> str:
    """What to do about a bag that is not whole."""
    return _RECOVER.format(path)


def one_line(text: object) -> str:
    """Words that may hold a bag's bytes, fit for a message: printable, on one line, not long."""
    return "".join(c if c.isprintable() else "?" for c in str(text))[:200]


def is_name(text: str) -> bool:
    """Whether a text may be the name of a topic or of a message type in ROS 2."""
    return _NAME.fullmatch(text) is not None


def existing(given: str | Path, what: str = "bag") -> Path:
    """The path, if there is something at it."""
    path = Path(given)
    if not path.exists():
        raise HannesError(f"No {what} '{given}': the path does not exist.")
    return path


def find_bags(paths: Sequence[str | Path]) -> list[Path]:
    """Bags below the given paths: a bag (folder with metadata.yaml, .mcap, .db3) or a folder of bags."""
    out: list[Path] = []
    for given in paths:
        path = existing(given)
        if path.is_dir() and not (path / METADATA_FILE).exists() and not _stored(path):
            below = sorted(
                p for p in path.iterdir() if p.is_dir() and ((p / METADATA_FILE).exists() or _stored(p))
            )
            if not below:
                raise HannesError(
                    f"'{given}' holds no bag: a bag is a folder with metadata.yaml and .mcap or .db3 files."
                )
            out += below
        else:
            out.append(path)
    return out


def _stored(path: Path) -> list[Path]:
    return [p for p in path.iterdir() if p.suffix in _STORAGE]


def locate(path: str | Path) -> BagFiles:
    """Find a bag's files; `path` is a bag folder or a single .mcap or .db3 file.

    Nothing outside the bag's folder is opened: an absolute path, "..", or a link that leads out is refused.
    """
    path = Path(path)
    with _reading(path):
        if not path.exists():
            raise HannesError(f"There is no bag at {path}.")
        if path.is_dir():
            return _locate_folder(path)
        if not stat.S_ISREG(path.stat().st_mode):
            raise HannesError(f"{path} is neither a folder nor a file.")
    storage = _STORAGE.get(path.suffix)
    if path.name == METADATA_FILE:
        return locate(path.parent)
    if storage is None:
        raise HannesError(f"{path} is not a bag: expected a bag folder, a .mcap file or a .db3 file.")
    _refuse_wal(path)
    return BagFiles(path, (path,), storage)


def _locate_folder(path: Path) -> BagFiles:
    metadata_path = path / METADATA_FILE
    if not metadata_path.exists():
        stored = sorted(child.name for child in path.iterdir() if child.suffix in _STORAGE)
        if stored:
            raise HannesError(
                f"The bag {path} has no {METADATA_FILE}: its recorder is still running or was killed "
                f"(it holds {', '.join(stored[:3])}). {recover_hint(path)}"
            )
        raise HannesError(f"{path} is not a bag: it has neither {METADATA_FILE} nor a .mcap or .db3 file.")
    _inside(path, METADATA_FILE, metadata_path)
    information = load_metadata(metadata_path)
    storage = information.get("storage_identifier")
    if not isinstance(storage, str) or storage not in _STORAGE.values():
        raise HannesError(
            f"{metadata_path}: storage_identifier is {storage!r}; readable storages: {', '.join(_STORAGE.values())}."
        )
    names = information.get("relative_file_paths")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise HannesError(
            f"{metadata_path}: relative_file_paths must list the bag's files, but is {names!r}."
        )
    version = information.get("version")
    files: list[Path] = []
    for name in names:
        pure = PurePosixPath(name)
        if pure.is_absolute() or ".." in pure.parts or "\0" in name:
            raise HannesError(
                f"{metadata_path}: the file {name!r} lies outside the bag's folder; it is not read."
            )
        # Before version 4 the paths were relative to the folder that holds the bag's folder.
        relative = pure.name if isinstance(version, int) and version < 4 else name
        file = path / relative
        plain = file.with_suffix("") if file.suffix == ".zstd" else file
        if plain.suffix == ".db3" or not file.exists():  # a packed SQLite file cannot be read in place
            file = plain if plain.exists() else file
        _inside(path, name, file)
        if file in files:
            raise HannesError(f"{metadata_path}: relative_file_paths names {name!r} twice.")
        _refuse_wal(file)
        files.append(file)
    bag = BagFiles(path, tuple(files), storage, information)
    if bag.compression not in ("", "file", "message"):
        raise HannesError(
            f"{metadata_path}: compression_mode is {bag.compression!r}; readable: none, file, message."
        )
    if bag.compression and information.get("compression_format") != "zstd":
        raise HannesError(
            f"{metadata_path}: compression_format is {information.get('compression_format')!r}; readable: zstd."
        )
    return bag


def _inside(folder: Path, name: str, file: Path) -> None:
    if not file.exists():
        raise HannesError(f"The bag {folder} lacks its file {name!r}, which its {METADATA_FILE} names.")
    if not file.resolve().is_relative_to(folder.resolve()):
        raise HannesError(
            f"The bag {folder}: {name!r} is a link that leads out of the bag's folder; it is not read."
        )
    if not stat.S_ISREG(file.stat().st_mode):
        raise HannesError(f"The bag {folder}: {name!r} is not a file.")


def _refuse_wal(file: Path) -> None:
    wal = file.with_name(file.name + "-wal")
    if file.suffix == ".db3" and wal.exists() and wal.stat().st_size > 0:
        raise HannesError(
            f"{file} was not closed (its log {wal.name} is still there). {recover_hint(file.parent)}"
        )


class _Texts(yaml.SafeLoader):
    """Texts as they stand, whatever they look like."""


_Texts.yaml_implicit_resolvers = {}


def load_metadata(path: Path) -> dict[str, Any]:
    """The content of a metadata.yaml below rosbag2_bagfile_information."""
    size = path.stat().st_size
    if size > _METADATA_BYTES:
        raise HannesError(f"{path} has {size} bytes; more than {_METADATA_BYTES} are not read.")
    try:
        # The C loader of libyaml overflows the stack on deep nesting; this one raises RecursionError.
        text = path.read_text(encoding="utf-8")
        content = yaml.safe_load(text)
    except (
        yaml.YAMLError,
        ValueError,
        RecursionError,
        OverflowError,
        TypeError,
        AttributeError,
        LookupError,
    ) as error:
        reason = (
            "it is nested too deeply" if isinstance(error, RecursionError) else " ".join(str(error).split())
        )
        raise HannesError(f"{path} is not readable YAML: {reason}. {recover_hint(path.parent)}") from None
    information = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    if not isinstance(information, dict):
        raise HannesError(f"{path} lacks rosbag2_bagfile_information. {recover_hint(path.parent)}")
    version = information.get("version")
    if isinstance(version, bool) or not isinstance(version, int) or not 1 <= version <= 9:
        raise HannesError(f"{path}: version is {version!r}; readable versions: 1 to 9.")
    if isinstance(said := information.get("custom_data"), dict):
        # A recorder writes its texts as they are: 007, yes and 12:30:00 are no numbers and no truth.
        plain = _Texts(text).get_single_data()["rosbag2_bagfile_information"]["custom_data"]
        information["custom_data"] = {
            key: word if isinstance(word, str) else said.get(key, word) for key, word in plain.items()
        }
    return information


def decode_entries(entries: object) -> dict[str, Any]:
    """custom_data or an MCAP metadata record as values: JSON where it is JSON, text otherwise.

    None, as JSON's null, stands for what is not said any more, though another place of the bag still says it.
    """
    if not isinstance(entries, Mapping):
        return {}
    values: dict[str, Any] = {}
    for key, text in entries.items():
        values[str(key)] = text
        if isinstance(text, str):
            try:
                values[str(key)] = json.loads(text)
            except (ValueError, RecursionError):
                continue
    return values


def encode_entries(metadata: Mapping[str, Any], reserved: Collection[str] = ()) -> dict[str, str]:
    """Metadata as texts of JSON, sorted by key; raises HannesError for a value that JSON does not know."""
    entries: dict[str, str] = {}
    for key in sorted(metadata):
        if key in reserved:
            continue
        try:
            entries[str(key)] = json.dumps(metadata[key], sort_keys=True, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise HannesError(f"The metadata entry {key!r} cannot be stored in a bag: {error}.") from None
    return entries


@dataclass
class BagMessages:
    """One pass over the raw messages of a bag, file by file; what it tells of the bag is complete after the
    pass.

    topics     by name, filled as they are met
    metadata   the recording's own metadata
    """

    bag: BagFiles
    limits: Limits = field(default_factory=Limits)
    types: dict[str, str] = field(default_factory=dict)
    hashes: dict[str, str] = field(default_factory=dict)
    qos: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    metadata: dict[str, Any] = field(default_factory=dict)

    def __iter__(self) -> Iterator[tuple[str, int, bytes | memoryview]]:
        """Yield (topic, log time ns, CDR bytes) in the order of the files. Raises HannesError."""
        unpack = self._unpacker() if self.bag.compression == "message" else None
        for path in self.bag.files:
            messages = self._mcap(path) if self.bag.storage == "mcap" else self._sqlite(path)
            for topic, log_ns, data in messages:
                if not 0 <= log_ns < 2**63:
                    raise HannesError(f"{path}: a message on {topic} has the impossible time {log_ns} ns.")
                self.counts[topic] = self.counts.get(topic, 0) + 1
                yield topic, log_ns, data if unpack is None else unpack(path, data)
        self.metadata.update(decode_entries(self.bag.yaml.get("custom_data")))
        for key in [key for key, value in self.metadata.items() if value is None]:
            del self.metadata[key]

    def entries(self) -> tuple[TopicEntry, ...]:
        """The topics met so far, by name."""
        return tuple(
            TopicEntry(
                name,
                self.types[name],
                self.counts.get(name, 0),
                self.hashes.get(name, ""),
                self.qos.get(name, ""),
            )
            for name in sorted(self.types)
        )

    def _meet(self, path: Path, topic: str, msgtype: str, encoding: str, type_hash: str, qos: str) -> None:
        if not (is_name(topic) and is_name(msgtype)):
            raise HannesError(
                f"{path} is damaged: it has a topic called {one_line(topic)!r} of type {one_line(msgtype)!r}. "
                + recover_hint(self.bag.path)
            )
        known = self.types.setdefault(topic, msgtype)
        if known != msgtype:
            raise HannesError(f"{path}: topic {topic} has messages of two types, {known} and {msgtype}.")
        if encoding != "cdr":
            raise HannesError(f"{path}: topic {topic} is encoded as {encoding!r}; readable: 'cdr' (ROS 2).")
        if type_hash:
            self.hashes[topic] = type_hash
        if qos:
            self.qos[topic] = qos

    def _mcap(self, path: Path) -> Iterator[tuple[str, int, bytes | memoryview]]:
        with _mapped(path, self.bag.packed(path), self.limits) as buffer:
            scan = McapScan(buffer, self.limits)
            topics: dict[int, str] = {}
            try:
                for channel_id, log_ns, _, data in scan.messages():
                    topic = topics.get(channel_id)
                    if topic is None:
                        topics[channel_id] = topic = scan.channels[channel_id].topic
                        self._meet_channel(path, scan, channel_id)
                    yield topic, log_ns, data
            except McapDamage as damage:
                raise HannesError(f"{path} is damaged: {damage}. {recover_hint(self.bag.path)}") from None
            for channel_id in scan.channels:
                self._meet_channel(path, scan, channel_id)
            self.metadata.update(decode_entries(scan.metadata.get(MCAP_METADATA)))

    def _meet_channel(self, path: Path, scan: McapScan, channel_id: int) -> None:
        channel = scan.channels[channel_id]
        self._meet(
            path,
            channel.topic,
            channel.type,
            channel.encoding,
            channel.metadata.get("topic_type_hash", ""),
            channel.metadata.get("offered_qos_profiles", ""),
        )

    def _sqlite(self, path: Path) -> Iterator[tuple[str, int, bytes | memoryview]]:
        if self.bag.packed(path):
            raise HannesError(
                f"{path}: decompress it first (`zstd -d`): a packed SQLite file cannot be read in place."
            )
        try:
            with open_sqlite(path, f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1") as connection:
                topics: dict[int, str] = {}
                for identity, name, msgtype, encoding, qos, type_hash in sqlite_topics(connection):
                    self._meet(path, name, msgtype, encoding, type_hash, qos)
                    topics[identity] = name
                total = 0
                for count, (identity, log_ns, data) in enumerate(
                    connection.execute("SELECT topic_id, timestamp, data FROM messages"), start=1
                ):
                    if identity not in topics or not isinstance(log_ns, int) or not isinstance(data, bytes):
                        raise HannesError(
                            f"{path} is damaged: row {count} of its messages is not a message. {recover_hint(path)}"
                        )
                    total += len(data)
                    if count > self.limits.messages or total > self.limits.total_bytes:
                        raise HannesError(f"{path} holds more than can be read at once: {_say(self.limits)}.")
                    yield topics[identity], log_ns, data
        except (sqlite3.Error, sqlite3.Warning, OverflowError, UnicodeDecodeError) as error:
            raise HannesError(f"{path} is damaged: {one_line(error)}. {recover_hint(path)}") from None

    def _unpacker(self) -> Any:
        budget = self.limits.total_bytes

        def unpack(path: Path, data: bytes | memoryview) -> bytes:
            nonlocal budget
            try:
                with zstandard.ZstdDecompressor().stream_reader(bytes(data)) as reader:
                    plain: bytes = reader.read(self.limits.chunk_bytes)
            except zstandard.ZstdError as error:
                raise HannesError(f"{path} is damaged: a message cannot be unpacked ({error}).") from None
            budget -= len(plain)
            if budget < 0:
                raise HannesError(f"{path} holds more than can be read at once: {_say(self.limits)}.")
            return plain

        return unpack


def _say(limits: Limits) -> str:
    return f"at most {limits.messages} messages and {limits.total_bytes} bytes (see limits=)"


@contextmanager
def open_sqlite(path: Path, uri: str) -> Iterator[sqlite3.Connection]:
    """A read-only connection that gives up after a number of steps in proportion to the file's size."""
    steps = max(_SQLITE_STEPS_LEAST, _SQLITE_STEPS_PER_BYTE * path.stat().st_size)
    connection = sqlite3.connect(uri, uri=True)
    try:
        used = 0

        def count() -> int:
            nonlocal used
            used += 10_000
            return int(used > steps)

        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 64 * 1024 * 1024)
        connection.set_progress_handler(count, 10_000)
        connection.execute("PRAGMA trusted_schema = OFF")
        _refuse_views(connection)
        yield connection
    finally:
        connection.close()


def _refuse_views(connection: sqlite3.Connection) -> None:
    """A view in place of a table could compute for ever or make rows from nothing."""
    kinds = dict(
        connection.execute("SELECT name, type FROM sqlite_master WHERE name IN ('messages', 'topics')")
    )
    for name in ("messages", "topics"):
        if kinds.get(name) != "table":
            raise sqlite3.DatabaseError(f"it has no table {name!r}, so it is not a rosbag2 file")


def sqlite_topics(connection: sqlite3.Connection) -> list[tuple[int, str, str, str, str, str]]:
    """Rows (id, name, type, serialization format, QoS, type hash) of the topics table; any schema version."""
    columns = {row[1] for row in connection.execute("PRAGMA table_info(topics)")}
    qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
    type_hash = "type_description_hash" if "type_description_hash" in columns else "''"
    rows = connection.execute(
        f"SELECT id, name, type, serialization_format, {qos}, {type_hash} FROM topics"
    ).fetchall()
    for row in rows:
        if not isinstance(row[0], int) or not all(isinstance(text, str) for text in row[1:]):
            raise sqlite3.DatabaseError("a row of its topics is not a topic")
    return rows


@contextmanager
def _mapped(path: Path, packed: bool, limits: Limits) -> Iterator[memoryview]:
    """The bytes of a file, mapped into memory; unpacked first if the file is packed as a whole."""
    with _reading(path), path.open("rb") as stream:
        if packed:
            try:
                with zstandard.ZstdDecompressor().stream_reader(stream) as reader:
                    plain = reader.read(limits.chunk_bytes + 1)
            except zstandard.ZstdError as error:
                raise HannesError(f"{path} is damaged: it cannot be unpacked ({error}).") from None
            if len(plain) > limits.chunk_bytes:
                raise HannesError(
                    f"{path} unpacks to more than {limits.chunk_bytes} bytes: unpack it first (`zstd -d`)."
                )
            yield memoryview(plain)
            return
        if path.stat().st_size == 0:
            yield memoryview(b"")
            return
        mapping = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        yield memoryview(mapping)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise HannesError(f"Cannot read {path}: {error.strerror or error}.") from None
