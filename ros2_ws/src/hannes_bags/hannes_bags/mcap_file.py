"""MCAP files: a writer whose chunk boundaries are the caller's, and a reader that never trusts a length.

Format: https://mcap.dev/spec. The records that are rare (header, schemas, chunks, indexes, footer) are
written by the official `mcap` package; messages are packed here because they are the hot path and because the
official writer offers no way to end a chunk by time, which is what bounds the loss when the process is
killed. The reader walks the file record by record and checks each length against what is there before
touching it, so that memory and time are bounded by the size of the file and by `Limits`, whatever the bytes
say.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO, Literal

import lz4.frame
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
Compression = Literal["none", "zstd"]

_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_BODY = struct.Struct("<HIQQ")
_CHUNK_BODY = struct.Struct("<QQQI")
_ZSTD_LEVEL = 3


class McapWriter:
    """Writes an MCAP file of profile ros2 into a binary stream.

    A chunk ends when it holds `chunk_bytes`, or when `end_chunk` is called; what was written before a chunk's
    end is complete on its own, so a file cut anywhere keeps all earlier chunks. The same calls give the same
    bytes.
    """

    def __init__(
        self, stream: BinaryIO, *, chunk_bytes: int = 32 * 1024, compression: Compression = "none"
    ) -> None:
        self._stream = stream
        self._chunk_bytes = chunk_bytes
        self._compression = compression
        self._compress = (
            zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress if compression == "zstd" else bytes
        )
        self._offset = 0
        self._data_crc = 0
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._counts: dict[int, int] = {}
        self._chunk_indexes: list[records.ChunkIndex] = []
        self._metadata_indexes: list[records.MetadataIndex] = []
        self._chunk: list[bytes] = []
        self._chunk_size = 0
        self._index: dict[int, list[tuple[int, int]]] = {}
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self._emit(MAGIC)
        self._emit_record(records.Header(profile="ros2", library="hannes_bags"))

    @property
    def message_count(self) -> int:
        return sum(self._counts.values())

    @property
    def pending(self) -> bool:
        """Whether messages wait in a chunk that has not ended."""
        return bool(self._index)

    def counts(self) -> dict[int, int]:
        """Messages written so far by channel id."""
        return dict(self._counts)

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        schema = records.Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=data)
        self._schemas.append(schema)
        self._append(_bytes_of(schema))
        return schema.id

    def add_channel(self, topic: str, schema_id: int, metadata: dict[str, str]) -> int:
        channel = records.Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding="cdr",
            metadata=metadata,
            schema_id=schema_id,
        )
        self._channels.append(channel)
        self._counts[channel.id] = 0
        self._append(_bytes_of(channel))
        return channel.id

    def add_message(self, channel_id: int, log_ns: int, publish_ns: int, data: bytes | memoryview) -> None:
        """Append one message; 0 <= times < 2^63, ns."""
        sequence = self._counts[channel_id] + 1
        self._counts[channel_id] = sequence
        self._index.setdefault(channel_id, []).append((log_ns, self._chunk_size))
        head = _MESSAGE_HEAD.pack(
            Opcode.MESSAGE,
            _MESSAGE_BODY.size + len(data),
            channel_id,
            sequence & 0xFFFFFFFF,
            log_ns,
            publish_ns,
        )
        self._append(head)
        self._append(bytes(data))
        if self._chunk_size >= self._chunk_bytes:
            self.end_chunk()

    def add_metadata(self, name: str, entries: dict[str, str]) -> None:
        self.end_chunk()
        record = records.Metadata(name=name, metadata=entries)
        offset = self._offset
        self._emit_record(record)
        self._metadata_indexes.append(
            records.MetadataIndex(offset=offset, length=self._offset - offset, name=name)
        )

    def end_chunk(self) -> None:
        """End the chunk at hand, if it holds messages, and give it to the stream (flushing is the
        caller's)."""
        if not self._index:
            return
        raw = b"".join(self._chunk)
        times = [log_ns for entries in self._index.values() for log_ns, _ in entries]
        first, last = min(times), max(times)
        self.first_ns = first if self.first_ns is None else min(self.first_ns, first)
        self.last_ns = last if self.last_ns is None else max(self.last_ns, last)
        name = "" if self._compression == "none" else self._compression
        data = self._compress(raw)
        start = self._offset
        self._emit_record(
            records.Chunk(
                compression=name,
                data=data,
                message_end_time=last,
                message_start_time=first,
                uncompressed_crc=zlib.crc32(raw),
                uncompressed_size=len(raw),
            )
        )
        length = self._offset - start
        offsets: dict[int, int] = {}
        for channel_id, entries in self._index.items():
            offsets[channel_id] = self._offset
            self._emit_record(records.MessageIndex(channel_id=channel_id, records=entries))
        self._chunk_indexes.append(
            records.ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression=name,
                compressed_size=len(data),
                message_end_time=last,
                message_index_length=self._offset - start - length,
                message_index_offsets=offsets,
                message_start_time=first,
                uncompressed_size=len(raw),
            )
        )
        self._chunk, self._chunk_size, self._index = [], 0, {}

    def finish(self) -> None:
        """End the chunk, write summary and footer. The stream stays open."""
        self.end_chunk()
        self._emit_record(records.DataEnd(self._data_crc))
        summary_start = self._offset
        groups: list[tuple[Opcode, list[records.McapRecord]]] = [
            (Opcode.SCHEMA, list(self._schemas)),
            (Opcode.CHANNEL, list(self._channels)),
            (
                Opcode.STATISTICS,
                [
                    records.Statistics(
                        attachment_count=0,
                        channel_count=len(self._channels),
                        channel_message_counts=dict(self._counts),
                        chunk_count=len(self._chunk_indexes),
                        message_count=self.message_count,
                        message_end_time=self.last_ns or 0,
                        message_start_time=self.first_ns or 0,
                        metadata_count=len(self._metadata_indexes),
                        schema_count=len(self._schemas),
                    )
                ],
            ),
            (Opcode.CHUNK_INDEX, list(self._chunk_indexes)),
            (Opcode.METADATA_INDEX, list(self._metadata_indexes)),
        ]
        summary = bytearray()
        offsets: list[records.SummaryOffset] = []
        for opcode, group in groups:
            if not group:
                continue
            begin = len(summary)
            for record in group:
                summary += _bytes_of(record)
            offsets.append(
                records.SummaryOffset(
                    group_opcode=opcode, group_start=summary_start + begin, group_length=len(summary) - begin
                )
            )
        offset_start = summary_start + len(summary)
        for offset in offsets:
            summary += _bytes_of(offset)
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, offset_start)
        self._emit(bytes(summary))
        self._emit_record(
            records.Footer(
                summary_start=summary_start,
                summary_offset_start=offset_start,
                summary_crc=zlib.crc32(head, zlib.crc32(summary)),
            )
        )
        self._emit(MAGIC)

    def _append(self, data: bytes) -> None:
        self._chunk.append(data)
        self._chunk_size += len(data)

    def _emit(self, data: bytes) -> None:
        self._stream.write(data)
        self._offset += len(data)
        self._data_crc = zlib.crc32(data, self._data_crc)

    def _emit_record(self, record: records.McapRecord) -> None:
        self._emit(_bytes_of(record))


def _bytes_of(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


class McapDamage(Exception):
    """The bytes are not a complete, intact MCAP file; carries what and where for the caller's message."""

    def __init__(self, what: str, offset: int) -> None:
        super().__init__(f"{what} (at byte {offset})")
        self.what = what
        self.offset = offset


@dataclass(frozen=True)
class Limits:
    """What a reader may use before it gives up.

    chunk_bytes  the largest chunk that is unpacked
    total_bytes  unpacked bytes in all
    messages     records in all, which are nearly all messages
    """

    chunk_bytes: int = 256 * 1024 * 1024
    total_bytes: int = 1024 * 1024 * 1024
    messages: int = 5_000_000


@dataclass(frozen=True)
class McapChannel:
    """A channel of an MCAP file together with its schema."""

    topic: str
    type: str
    encoding: str
    schema_encoding: str
    schema_data: bytes
    metadata: dict[str, str]


@dataclass
class McapScan:
    """One pass over an MCAP file; iterate `messages()`, then look at what was met.

    buffer    the whole file (an mmap will do)
    tolerant  False: any damage raises McapDamage. True: damage is noted in `damage`, whole chunks after it
              are still found, and only messages whose chunk passes its checksum are given.
    """

    buffer: memoryview
    limits: Limits = field(default_factory=Limits)
    tolerant: bool = False
    channels: dict[int, McapChannel] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    damage: list[McapDamage] = field(default_factory=list)
    profile: str = ""
    message_count: int = 0
    declared_count: int | None = None
    complete: bool = False
    salvaged_bytes: int = 0
    _schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    _unpacked: int = 0
    _records: int = 0

    def messages(self) -> Iterator[tuple[int, int, int, memoryview]]:
        """Yield (channel id, log time ns, publish time ns, CDR bytes) in the order of the file."""
        try:
            yield from self._walk()
        except McapDamage as damage:
            if not self.tolerant:
                raise
            self.damage.append(damage)

    def _walk(self) -> Iterator[tuple[int, int, int, memoryview]]:
        buffer = self.buffer
        size = len(buffer)
        if size == 0:
            raise McapDamage("the file is empty", 0)
        if bytes(buffer[:8]) != MAGIC:
            raise McapDamage("the file does not begin as an MCAP file", 0)
        position = 8
        summary = False
        while True:
            try:
                if position == size:
                    raise McapDamage("the file ends without a footer", position)
                opcode, begin, end = _record(buffer, position, size)
                if opcode == Opcode.FOOTER:
                    self._finish(begin, end)
                    return
                if opcode == Opcode.DATA_END:
                    self._check_data_crc(begin, end, position)
                    summary = True
                elif opcode == Opcode.CHUNK:
                    yield from self._unpack_chunk(begin, end)
                elif opcode == Opcode.MESSAGE and not summary:
                    yield self._message(begin, end)
                else:
                    self._note(opcode, begin, end)
                self.salvaged_bytes = end
                position = end
            except McapDamage as damage:
                if not self.tolerant:
                    raise
                self.damage.append(damage)
                following = _next_chunk(buffer, position + 1)
                if following is None:
                    yield from self._cut_chunk(position, size)
                    return
                position = following

    def _unpack_chunk(self, begin: int, end: int) -> Iterator[tuple[int, int, int, memoryview]]:
        buffer = self.buffer
        if end - begin < _CHUNK_BODY.size + 4:
            raise McapDamage("a chunk is too short", begin)
        _, _, unpacked, crc = _CHUNK_BODY.unpack_from(buffer, begin)
        name, position = _string(buffer, begin + _CHUNK_BODY.size, end)
        if position + 8 > end:
            raise McapDamage("a chunk is too short", begin)
        (packed,) = struct.unpack_from("<Q", buffer, position)
        position += 8
        if packed != end - position:
            raise McapDamage("the length of a chunk's data is not the length of the chunk", begin)
        if unpacked > self.limits.chunk_bytes:
            raise McapDamage(f"a chunk says that it unpacks to {unpacked} bytes", begin)
        self._unpacked += unpacked
        if self._unpacked > self.limits.total_bytes:
            raise McapDamage(f"the messages unpack to more than {self.limits.total_bytes} bytes", begin)
        data = _decompress(buffer[position:end], name, unpacked, begin)
        if len(data) != unpacked:
            raise McapDamage(
                f"a chunk unpacks to {len(data)} bytes, not to the {unpacked} that it says", begin
            )
        if crc and zlib.crc32(data) != crc:
            raise McapDamage("a chunk fails its checksum", begin)
        yield from self._chunk_messages(data, begin)

    def _cut_chunk(self, position: int, size: int) -> Iterator[tuple[int, int, int, memoryview]]:
        """The whole messages in front of the cut, if the record at `position` is a chunk without its end."""
        buffer = self.buffer
        if position + 61 > size or buffer[position] != Opcode.CHUNK:
            return
        _, length = _RECORD_HEAD.unpack_from(buffer, position)
        begin = position + 9
        if begin + length <= size:
            return
        try:
            _, _, unpacked, _ = _CHUNK_BODY.unpack_from(buffer, begin)
            name, at = _string(buffer, begin + _CHUNK_BODY.size, size)
            data = _decompress(buffer[at + 8 :], name, min(unpacked, self.limits.chunk_bytes), begin)
            for message in self._chunk_messages(data, begin):
                self.salvaged_bytes = size
                yield message
        except McapDamage:
            return

    def _chunk_messages(self, data: memoryview, origin: int) -> Iterator[tuple[int, int, int, memoryview]]:
        position, size = 0, len(data)
        channels = self.channels
        while position < size:
            if position + 9 > size:
                raise McapDamage("a record in a chunk is cut", origin)
            opcode, length = _RECORD_HEAD.unpack_from(data, position)
            begin = position + 9
            end = begin + length
            if end > size:
                raise McapDamage("a record in a chunk is longer than the chunk", origin)
            if opcode == Opcode.MESSAGE:
                if length < _MESSAGE_BODY.size:
                    raise McapDamage("a message is too short", origin)
                channel_id, _, log_ns, publish_ns = _MESSAGE_BODY.unpack_from(data, begin)
                if channel_id not in channels:
                    raise McapDamage(f"a message names the unknown channel {channel_id}", origin)
                self._count(origin)
                yield channel_id, log_ns, publish_ns, data[begin + _MESSAGE_BODY.size : end]
            else:
                self._count_record(origin)
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._define(opcode, data, begin, end)
                elif opcode == 0:
                    raise McapDamage("a record in a chunk has no kind", origin)
            position = end

    def _message(self, begin: int, end: int) -> tuple[int, int, int, memoryview]:
        if end - begin < _MESSAGE_BODY.size:
            raise McapDamage("a message is too short", begin)
        channel_id, _, log_ns, publish_ns = _MESSAGE_BODY.unpack_from(self.buffer, begin)
        if channel_id not in self.channels:
            raise McapDamage(f"a message names the unknown channel {channel_id}", begin)
        self._count(begin)
        return channel_id, log_ns, publish_ns, self.buffer[begin + _MESSAGE_BODY.size : end]

    def _count(self, origin: int) -> None:
        self.message_count += 1
        self._count_record(origin)

    def _count_record(self, origin: int) -> None:
        self._records += 1
        if self._records > self.limits.messages:
            raise McapDamage(f"there are more than {self.limits.messages} messages", origin)

    def _note(self, opcode: int, begin: int, end: int) -> None:
        buffer = self.buffer
        self._count_record(begin)
        if opcode == Opcode.HEADER:
            self.profile, _ = _string(buffer, begin, end)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(opcode, buffer, begin, end)
        elif opcode == Opcode.METADATA:
            name, position = _string(buffer, begin, end)
            self.metadata[name] = _string_map(buffer, position, end)
        elif opcode == Opcode.STATISTICS and end - begin >= 8:
            (self.declared_count,) = struct.unpack_from("<Q", buffer, begin)

    def _define(self, opcode: int, data: memoryview, begin: int, end: int) -> None:
        if end - begin < 4:
            raise McapDamage("a schema or channel is too short", begin)
        if opcode == Opcode.SCHEMA:
            (identity,) = struct.unpack_from("<H", data, begin)
            name, position = _string(data, begin + 2, end)
            encoding, position = _string(data, position, end)
            text, _ = _bytes(data, position, end)
            self._schemas[identity] = (name, encoding, text)
        else:
            identity, schema_id = struct.unpack_from("<HH", data, begin)
            topic, position = _string(data, begin + 4, end)
            encoding, position = _string(data, position, end)
            name, schema_encoding, text = self._schemas.get(schema_id, ("", "", b""))
            channel = McapChannel(
                topic, name, encoding, schema_encoding, text, _string_map(data, position, end)
            )
            known = self.channels.setdefault(identity, channel)
            if known != channel:
                raise McapDamage(
                    f"channel {identity} is defined twice, as {known.topic!r} and as {topic!r}", begin
                )

    def _check_data_crc(self, begin: int, end: int, position: int) -> None:
        if end - begin < 4:
            raise McapDamage("the end of the data section is cut", begin)
        (crc,) = struct.unpack_from("<I", self.buffer, begin)
        if crc and zlib.crc32(self.buffer[:position]) != crc:
            raise McapDamage("the data section fails its checksum", begin)

    def _finish(self, begin: int, end: int) -> None:
        if end - begin != 20 or bytes(self.buffer[end:]) != MAGIC:
            raise McapDamage("the file does not end as an MCAP file", begin)
        summary_start, _, crc = struct.unpack_from("<QQI", self.buffer, begin)
        if crc:
            if not 8 <= summary_start <= begin:
                raise McapDamage("the footer points outside the file", begin)
            if zlib.crc32(self.buffer[summary_start : end - 4]) != crc:
                raise McapDamage("the summary fails its checksum", begin)
        if self.declared_count is not None and self.declared_count != self.message_count:
            raise McapDamage(
                f"the summary tells of {self.declared_count} messages, but {self.message_count} are there",
                begin,
            )
        self.complete = True
        self.salvaged_bytes = end + 8


def _record(buffer: memoryview, position: int, size: int) -> tuple[int, int, int]:
    """Opcode, begin and end of the record at `position`; McapDamage if it does not fit into the file."""
    if position + 9 > size:
        raise McapDamage("the file is cut within a record", position)
    opcode, length = _RECORD_HEAD.unpack_from(buffer, position)
    end = position + 9 + length
    if end > size:
        raise McapDamage(f"the file is cut: a record of {length} bytes does not fit", position)
    if opcode == 0:
        raise McapDamage("a record has no kind", position)
    return opcode, position + 9, end


def _next_chunk(buffer: memoryview, position: int) -> int | None:
    """Where the next plausible chunk begins: its kind, a length that fits, ordered times."""
    size = len(buffer)
    step = 1 << 20
    while position < size:
        window = bytes(buffer[position : position + step + 64])
        at = window.find(Opcode.CHUNK)
        while 0 <= at < step:
            place = position + at
            if place + 61 <= size:
                _, length = _RECORD_HEAD.unpack_from(buffer, place)
                first, last, _, _ = _CHUNK_BODY.unpack_from(buffer, place + 9)
                (name_length,) = struct.unpack_from("<I", buffer, place + 37)
                if place + 9 + length <= size and first <= last and name_length in (0, 3, 4):
                    (packed,) = struct.unpack_from("<Q", buffer, place + 41 + name_length)
                    if packed == length - 40 - name_length:
                        return place
            at = window.find(Opcode.CHUNK, at + 1)
        position += step
    return None


def _bytes(data: memoryview, position: int, end: int) -> tuple[bytes, int]:
    if position + 4 > end:
        raise McapDamage("a text is cut", position)
    (length,) = struct.unpack_from("<I", data, position)
    position += 4
    if position + length > end:
        raise McapDamage("a text is longer than its record", position)
    return bytes(data[position : position + length]), position + length


def _string(data: memoryview, position: int, end: int) -> tuple[str, int]:
    raw, following = _bytes(data, position, end)
    try:
        return raw.decode(), following
    except UnicodeDecodeError:
        raise McapDamage("a text is not UTF-8", position) from None


def _string_map(data: memoryview, position: int, end: int) -> dict[str, str]:
    if position + 4 > end:
        raise McapDamage("a table is cut", position)
    (length,) = struct.unpack_from("<I", data, position)
    position += 4
    stop = position + length
    if stop > end:
        raise McapDamage("a table is longer than its record", position)
    table: dict[str, str] = {}
    while position < stop:
        key, position = _string(data, position, stop)
        table[key], position = _string(data, position, stop)
    return table


def _decompress(data: memoryview, name: str, size: int, origin: int) -> memoryview:
    """Unpack at most `size` + 1 bytes: a bomb shows as a wrong length instead of filling the memory."""
    if name == "":
        return data
    try:
        if name == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(bytes(data)) as reader:
                return memoryview(reader.read(size + 1))
        if name == "lz4":
            return memoryview(lz4.frame.LZ4FrameDecompressor().decompress(bytes(data), max_length=size + 1))
    except (zstandard.ZstdError, RuntimeError, MemoryError, EOFError, ValueError) as error:
        raise McapDamage(f"a chunk cannot be unpacked ({error})", origin) from None
    raise McapDamage(f"a chunk is packed with the unknown {name!r}", origin)
