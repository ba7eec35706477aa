"""Saving what is in a bag whose recorder was killed, or whose file was cut or damaged.

MCAP: every whole chunk is kept, before and after damage, and the whole messages of a chunk that is cut at the
file's end. SQLite: a copy is opened with its write-ahead log, and the rows are read from both ends up to the
damage. The result is always a new MCAP bag with metadata.yaml, and it is read again before it is called good.
The input is only read.
"""

from __future__ import annotations

import mmap
import re
import shutil
import sqlite3
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from hannes_description.errors import HannesError

from . import cdr
from .mcap_file import Limits, McapDamage, McapScan
from .reading import bag_info
from .storage import (
    MCAP_METADATA,
    METADATA_FILE,
    decode_entries,
    is_name,
    load_metadata,
    one_line,
    open_sqlite,
    sqlite_topics,
)
from .writing import BagWriter, Qos

_HOLE_S = 0.2
"""s without a message that are worth a word where some are missing."""
_NO_LIMIT = Limits(total_bytes=1 << 50, messages=1 << 50)


@dataclass(frozen=True)
class Recovery:
    """What was saved.

    source, output   paths
    messages         number of messages kept, and `topics` the same by topic
    start_ns, end_ns first and last log time kept
    input_bytes      size of the input's storage files
    unread_bytes     bytes behind the last message that could be read
    recorded         number of messages that were there, by metadata.yaml or the files themselves; None if a cut
                     or damaged file is all that is known
    lost_s           the lost tail, s: up to the end that metadata.yaml tells of; else an estimate, unread bytes at
                     the mean rate of the rest (what the recorder had not handed over yet, at most 0.2 s, comes on
                     top, and what lay behind a cut is not known)
    gap              first and last second, from the beginning on, of the longest time without a message
    damage           what was wrong, as sentences; empty if only metadata.yaml was missing
    """

    source: str
    output: str
    messages: int
    topics: Mapping[str, int]
    start_ns: int
    end_ns: int
    input_bytes: int
    unread_bytes: int
    recorded: int | None
    lost_s: float
    gap: tuple[float, float]
    damage: tuple[str, ...]

    @property
    def duration(self) -> float:
        """Time span kept, s."""
        return (self.end_ns - self.start_ns) * 1e-9

    @property
    def losses(self) -> str:
        """What is missing, as a sentence."""
        if self.recorded is None:
            return (
                f"how much is missing is not known; of what is there, {self.unread_bytes} bytes at the end, "
                f"about {self.lost_s:.3f} s, could not be read"
            )
        if self.recorded == self.messages:
            return "no message is missing"
        missing = self.recorded - self.messages
        begin, end = self.gap
        hole = f"; none is there from {begin:.3f} to {end:.3f} s" if end - begin > _HOLE_S else ""
        return (
            f"{missing} of {self.recorded} messages are missing, about {self.lost_s:.3f} s at the end{hole}"
        )

    def as_dict(self) -> dict[str, Any]:
        """JSON-like."""
        return {**asdict(self), "topics": dict(self.topics), "duration": self.duration}


@dataclass(frozen=True)
class _Definition:
    type: str
    encoding: str = "ros2msg"
    text: bytes = b""
    type_hash: str = ""
    qos: str = ""


@dataclass
class _Salvage:
    """What is learnt of the input on the way."""

    definitions: dict[str, _Definition] = field(default_factory=dict)
    metadata: dict[str, Any] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)
    unread_bytes: int = 0
    recorded: int | None = 0

    def was_there(self, count: int | None) -> None:
        """Add a file's number of messages; None if it cannot be known."""
        self.recorded = None if count is None or self.recorded is None else self.recorded + count

    def leave_out(self, sentence: str) -> None:
        """Note once what was left out many times."""
        if sentence not in self.damage:
            self.damage.append(sentence)


def recover(path: str | Path, out: str | Path) -> Recovery:
    """Write what can be read of the bag `path` (folder, .mcap or .db3) into the new bag folder `out` and
    verify it.

    Raises HannesError if there is nothing to save, if `out` exists or lies within the input, or if the new
    bag does not hold exactly what was put into it.
    """
    path, out = Path(path), Path(out)
    files = _storage_files(path)
    if path.is_dir() and out.resolve().is_relative_to(path.resolve()):
        raise HannesError(
            f"{out} lies within the bag {path}, which must not be changed. Choose another place."
        )
    if out.exists():
        raise HannesError(f"{out} exists already; a bag is never overwritten. Choose another name.")
    salvage = _Salvage()
    _gather_metadata(files, salvage)
    information: Mapping[str, Any] = {}
    if path.is_dir() and (path / METADATA_FILE).exists():
        try:
            information = load_metadata(path / METADATA_FILE)
            salvage.metadata.update(decode_entries(information.get("custom_data")))
        except HannesError as error:
            salvage.damage.append(str(error).split(" Run `")[0])
    salvage.damage.extend(f"{name} is missing." for name in _missing(information, path))
    writer: BagWriter | None = None
    counts: dict[str, int] = {}
    first, last, gap = 2**63, -1, (0, 0)
    try:
        for topic, log_ns, data in _messages(files, salvage):
            if writer is None:
                writer = BagWriter(out, {**salvage.metadata, "recovered_from": path.name})
            if topic not in counts:
                counts[topic] = 0
                _announce(writer, topic, salvage.definitions[topic])
            writer.write(topic, data, log_ns)
            counts[topic] += 1
            if last >= 0 and log_ns - last > gap[1] - gap[0]:
                gap = (last, log_ns)
            first, last = min(first, log_ns), max(last, log_ns)
    except OSError as error:
        raise HannesError(f"Cannot recover {path}: {error.strerror or error}.") from None
    finally:
        if writer is not None:
            writer.close()
    if writer is None:
        reason = " ".join(salvage.damage) or "The file is whole but empty."
        raise HannesError(f"There is no message to save in {path}. {reason}")
    _verify(out, counts)
    size = sum(file.stat().st_size for file in files)
    messages = sum(counts.values())
    recorded, end = _told(information, messages)
    if recorded is None:
        recorded = salvage.recorded
    if end is None:
        kept = max(1, size - salvage.unread_bytes)
        end = last + round(salvage.unread_bytes / kept * (last - first))
    return Recovery(
        source=str(path),
        output=str(out),
        messages=messages,
        topics=counts,
        start_ns=first,
        end_ns=last,
        input_bytes=size,
        unread_bytes=salvage.unread_bytes,
        recorded=recorded,
        lost_s=max(0, end - last) * 1e-9,
        gap=((gap[0] - first) * 1e-9, (gap[1] - first) * 1e-9) if gap[1] else (0.0, 0.0),
        damage=tuple(salvage.damage),
    )


def _missing(information: Mapping[str, Any], folder: Path) -> list[str]:
    """Files that metadata.yaml names and that are not there."""
    names = information.get("relative_file_paths")
    told = [Path(name).name for name in names if isinstance(name, str)] if isinstance(names, list) else []
    return [n for n in told if not (folder / n).exists() and not (folder / n.removesuffix(".zstd")).exists()]


def _told(information: Mapping[str, Any], kept: int) -> tuple[int | None, int | None]:
    """Number of messages and time of the last one [ns] by metadata.yaml; None where it does not tell.

    One that tells of fewer messages than were found is older than the files.
    """
    count = _whole_number(information.get("message_count"))
    if count is None or count < kept:
        return None, None
    times = [
        _whole_number(entry.get(unit)) if isinstance(entry := information.get(key), Mapping) else None
        for key, unit in (("starting_time", "nanoseconds_since_epoch"), ("duration", "nanoseconds"))
    ]
    return count, None if None in times else sum(filter(None, times))


def _whole_number(value: object) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63 else None


def _storage_files(path: Path) -> list[Path]:
    if not path.exists():
        raise HannesError(f"There is no bag at {path}.")
    candidates = sorted(path.iterdir(), key=_natural) if path.is_dir() else [path]
    inside = path.resolve()
    files = [
        file
        for file in candidates
        if file.suffix in (".mcap", ".db3") and file.is_file() and file.resolve().is_relative_to(inside)
    ]
    if not files:
        raise HannesError(f"There is no .mcap or .db3 file to recover in {path}.")
    return files


def _natural(path: Path) -> list[tuple[int, str]]:
    """Split files are numbered NAME_0, NAME_1, ... NAME_10."""
    return [
        (int(part), "") if part.isdigit() and len(part) < 18 else (-1, part)
        for part in re.split(r"(\d+)", path.name)
    ]


def _announce(writer: BagWriter, topic: str, definition: _Definition) -> None:
    qos = Qos.from_text(definition.qos)
    try:
        writer.add_topic(topic, definition.type, qos=qos)
    except HannesError:
        writer.add_topic(
            topic,
            definition.type,
            qos=qos,
            definition=(definition.encoding, definition.text),
            type_hash=definition.type_hash,
        )


def _verify(out: Path, counts: Mapping[str, int]) -> None:
    found = {entry.name: entry.count for entry in bag_info(out, limits=_NO_LIMIT).topics}
    if found != dict(counts):
        raise HannesError(f"The recovered bag {out} holds {found}, but {dict(counts)} were written to it.")


def _gather_metadata(files: list[Path], salvage: _Salvage) -> None:
    """The recording's own metadata stands at the beginning of an MCAP file; the new bag wants it before its
    messages."""
    for file in files:
        if file.suffix != ".mcap":
            continue
        for buffer in _buffers(file):
            scan = McapScan(buffer, _NO_LIMIT, tolerant=True)
            next(iter(scan.messages()), None)
            salvage.metadata.update(decode_entries(scan.metadata.get(MCAP_METADATA)))


def _messages(files: list[Path], salvage: _Salvage) -> Iterator[tuple[str, int, bytes | memoryview]]:
    for file in files:
        read = _mcap_messages if file.suffix == ".mcap" else _sqlite_messages
        for topic, log_ns, data in read(file, salvage):
            if not (is_name(topic) and is_name(salvage.definitions[topic].type)):
                salvage.leave_out(f"{file.name}: messages on a topic without a proper name were left out.")
            elif 0 <= log_ns < 2**63:
                yield topic, log_ns, data
            else:
                salvage.leave_out(f"{file.name}: messages on {topic} with impossible times were left out.")


def _buffers(file: Path) -> Iterator[memoryview]:
    """The mapped bytes of a file; nothing for an empty file."""
    if file.stat().st_size:
        with file.open("rb") as stream:
            yield memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))


def _mcap_messages(file: Path, salvage: _Salvage) -> Iterator[tuple[str, int, bytes | memoryview]]:
    if file.stat().st_size == 0:
        salvage.damage.append(f"{file.name} is empty.")
        salvage.was_there(None)
    for buffer in _buffers(file):
        scan = McapScan(buffer, _NO_LIMIT, tolerant=True)
        topics: dict[int, str] = {}
        try:
            for channel_id, log_ns, _, data in scan.messages():
                if channel_id not in topics:
                    channel = scan.channels[channel_id]
                    definition = _Definition(
                        channel.type,
                        channel.schema_encoding,
                        channel.schema_data,
                        channel.metadata.get("topic_type_hash", ""),
                        channel.metadata.get("offered_qos_profiles", ""),
                    )
                    topics[channel_id] = _unique(channel.topic, definition, salvage)
                yield topics[channel_id], log_ns, data
        except McapDamage as damage:
            scan.damage.append(damage)
        salvage.damage.extend(f"{file.name}: {damage}." for damage in scan.damage[:20])
        salvage.was_there(scan.message_count if scan.complete and not scan.damage else None)
        if not scan.complete:
            salvage.unread_bytes += len(buffer) - scan.salvaged_bytes


def _unique(topic: str, definition: _Definition, salvage: _Salvage) -> str:
    """A topic of two types would not be readable: the second type's messages go to a name of their own."""
    name, number = topic, 2
    while name in salvage.definitions and salvage.definitions[name].type != definition.type:
        name, number = f"{topic}_{number}", number + 1
    salvage.definitions.setdefault(name, definition)
    return name


def _sqlite_messages(file: Path, salvage: _Salvage) -> Iterator[tuple[str, int, bytes]]:
    before = len(salvage.damage)
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "copy.db3"
        shutil.copyfile(file, copy)
        for ending in ("-wal", "-journal"):
            companion = file.with_name(file.name + ending)
            if companion.is_file() and not companion.is_symlink():
                shutil.copyfile(companion, copy.with_name(copy.name + ending))
        try:
            with open_sqlite(copy, f"file:{quote(str(copy))}?mode=rw") as connection:
                topics = {
                    identity: _unique(name, _Definition(msgtype, "ros2msg", b"", type_hash, qos), salvage)
                    for identity, name, msgtype, _, qos, type_hash in sqlite_topics(connection)
                }
                for name, definition in list(salvage.definitions.items()):
                    salvage.definitions[name] = _with_text(connection, definition)
                rows = _rows_around_damage(connection, file.name, salvage)
                salvage.was_there(len(rows) if len(salvage.damage) == before else None)
                for _, identity, log_ns, data in rows:
                    if identity in topics and isinstance(log_ns, int) and isinstance(data, bytes):
                        yield topics[identity], log_ns, data
        except (sqlite3.Error, sqlite3.Warning, OverflowError, UnicodeDecodeError) as error:
            salvage.damage.append(f"{file.name}: {one_line(error)}.")
            salvage.was_there(None)


def _with_text(connection: sqlite3.Connection, definition: _Definition) -> _Definition:
    try:
        cdr.definition(definition.type)
    except KeyError:
        try:
            row = connection.execute(
                "SELECT encoding, encoded_message_definition FROM message_definitions WHERE topic_type = ?",
                (definition.type,),
            ).fetchone()
        except sqlite3.Error:
            row = None
        if row and all(isinstance(text, str) for text in row):
            return _Definition(definition.type, row[0], row[1].encode(), definition.type_hash, definition.qos)
        return _Definition(definition.type, "", b"", definition.type_hash, definition.qos)
    return definition


def _rows_around_damage(
    connection: sqlite3.Connection, name: str, salvage: _Salvage
) -> list[tuple[int, Any, Any, Any]]:
    """Rows (id, topic_id, timestamp, data) from the first up to the damage, and from the last down to it."""
    query = "SELECT rowid, topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY rowid"
    rows, error = _rows_until_error(connection, query, ())
    if error is not None:
        salvage.damage.append(f"{name}: {one_line(error)}.")
        reached = rows[-1][0] if rows else -(2**63)
        behind, _ = _rows_until_error(
            connection, query.replace("ORDER", "WHERE rowid > ? ORDER") + " DESC", (reached,)
        )
        rows += reversed(behind)
    return rows


def _rows_until_error(
    connection: sqlite3.Connection, query: str, arguments: tuple[int, ...]
) -> tuple[list[tuple[int, Any, Any, Any]], sqlite3.Error | None]:
    rows: list[tuple[int, Any, Any, Any]] = []
    try:
        for row in connection.execute(query, arguments):
            rows.append(row)
    except sqlite3.Error as error:
        return rows, error
    return rows, None
