"""CDR (XCDR1) of the few message types that carry signals, decoded and encoded by the column.

A bag holds hundreds of thousands of equally built messages. They are decoded together: the layout of one
message (where its arrays lie) is worked out, and all messages with the same structural bytes are read with it
by numpy. Encoding mirrors it: rosbags' serialiser makes the first message, the numbers of the others are put
into copies of it. Alignment padding is neither compared nor trusted: rclpy leaves it uninitialised.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FLOAT64 = "std_msgs/msg/Float64"
JOINT_STATE = "sensor_msgs/msg/JointState"
STRING = "std_msgs/msg/String"
FLOAT64_MULTI_ARRAY = "std_msgs/msg/Float64MultiArray"
NUMBERS = {
    "std_msgs/msg/Float32": "<f4",
    FLOAT64: "<f8",
    **{f"std_msgs/msg/Int{8 * size}": f"<i{size}" for size in (1, 2, 4, 8)},
    **{f"std_msgs/msg/UInt{8 * size}": f"<u{size}" for size in (1, 2, 4, 8)},
}
"""Types of one number, with its numpy type."""

_LITTLE = b"\x00\x01"
_ENDIAN = {b"\x00\x01": "<", b"\x00\x00": ">"}
_TIME = {_LITTLE: struct.Struct("<iI"), b"\x00\x00": struct.Struct(">iI")}
_MAX_LAYOUTS = 256
_MAX_JOINTS = 4096


class CdrError(Exception):
    """A message is not what its type says; `index` is its number on the topic."""

    def __init__(self, what: str, index: int = 0) -> None:
        super().__init__(what)
        self.what = what
        self.index = index


@dataclass
class RawTopic:
    """The messages of one topic as they lie in the bag: log times (ns) and CDR bytes, one after the other."""

    log_ns: array[int] = field(default_factory=lambda: array("q"))
    lengths: array[int] = field(default_factory=lambda: array("q"))
    payload: bytearray = field(default_factory=bytearray)

    def append(self, log_ns: int, data: bytes | memoryview) -> None:
        self.log_ns.append(log_ns)
        self.lengths.append(len(data))
        self.payload += data

    def __len__(self) -> int:
        return len(self.log_ns)

    def offsets(self) -> IntArray:
        """(n,) where each message begins in the payload."""
        lengths = np.frombuffer(self.lengths, dtype=np.int64)
        return np.concatenate([[0], np.cumsum(lengths)[:-1]]) if len(lengths) else np.zeros(0, np.int64)

    def rows(self, indices: IntArray, length: int) -> npt.NDArray[np.uint8]:
        """(m, length) bytes of the messages `indices`, which all have this length."""
        whole = np.frombuffer(self.payload, dtype=np.uint8)
        if len(indices) == len(self):
            return whole.reshape(len(self), length)
        return whole[self.offsets()[indices][:, None] + np.arange(length)[None, :]]

    def message(self, index: int) -> bytes:
        start = int(self.offsets()[index])
        return bytes(self.payload[start : start + self.lengths[index]])


@cache
def typestore() -> Typestore:
    """Definitions, hashes and serialisers of the message types of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def definition(msgtype: str) -> tuple[str, str]:
    """Definition text (with all nested types) and RIHS01 hash of a type of ROS 2 Jazzy; KeyError if
    unknown."""
    store = typestore()
    if msgtype not in store.fielddefs:
        raise KeyError(msgtype)
    text, _ = store.generate_msgdef(msgtype, ros_version=2)
    return text, store.hash_rihs01(msgtype)


def decode_numbers(raw: RawTopic, msgtype: str) -> FloatArray:
    """(n,) values of messages of one of the types NUMBERS. Raises CdrError."""
    dtype = NUMBERS[msgtype]
    return _fixed(raw, dtype, np.dtype(dtype).itemsize)[:, 0].astype(np.float64)


def _fixed(raw: RawTopic, dtype: str, size: int) -> npt.NDArray[Any]:
    lengths = np.frombuffer(raw.lengths, dtype=np.int64)
    padded = -(-size // 4) * 4  # some middlewares fill up the last word
    length = 4 + (padded if len(raw) and lengths[0] == 4 + padded else size)
    wrong = np.flatnonzero(lengths != length)
    if wrong.size:
        raise CdrError(f"it has {lengths[wrong[0]]} bytes instead of {length}", int(wrong[0]))
    rows = np.frombuffer(raw.payload, dtype=np.uint8).reshape(len(raw), length)
    big = (rows[:, 0] == 0) & (rows[:, 1] == 0)
    little = (rows[:, 0] == 0) & (rows[:, 1] == 1)
    wrong = np.flatnonzero(~(big | little))
    if wrong.size:
        raise CdrError("it does not begin as CDR", int(wrong[0]))
    body = np.ascontiguousarray(rows[:, 4 : 4 + size])
    values = body.view(dtype)
    if big.any():
        values = np.where(big[:, None], body.view(dtype.replace("<", ">")), values)
    return values


def _stamp(seconds: IntArray, nanoseconds: IntArray) -> IntArray:
    """Stamp in ns; the words are uint32 as read, seconds are int32 in builtin_interfaces/Time."""
    signed = np.where(seconds >= 2**31, seconds - 2**32, seconds)
    return signed * 1_000_000_000 + nanoseconds


class _Cursor:
    """Walks the fields of one CDR message; positions count from behind the 4 bytes of encapsulation."""

    def __init__(self, data: bytes) -> None:
        endian = _ENDIAN.get(data[:2])
        if endian is None or len(data) < 4:
            raise CdrError("it does not begin as CDR")
        self.endian = endian
        self.data = data
        self.at = 4
        self.fixed: list[tuple[int, int]] = [(0, 2)]
        self._word = struct.Struct(endian + "I")

    def word(self) -> int:
        self.align(4)
        if self.at + 4 > len(self.data):
            raise CdrError("it is too short")
        (value,) = self._word.unpack_from(self.data, self.at)
        self.fixed.append((self.at, self.at + 4))
        self.at += 4
        return int(value)

    def align(self, size: int) -> None:
        self.at = 4 + (self.at - 4 + size - 1) // size * size

    def take(self, length: int) -> bytes:
        if self.at + length > len(self.data):
            raise CdrError("a field is longer than the message")
        piece = self.data[self.at : self.at + length]
        self.fixed.append((self.at, self.at + length))
        self.at += length
        return piece

    def text(self) -> str:
        raw = self.take(self.word())
        try:
            return raw.rstrip(b"\0").decode()
        except UnicodeDecodeError:
            raise CdrError("a text is not UTF-8") from None

    def numbers(self) -> tuple[int, int]:
        """Begin and count of a float64 sequence."""
        count = self.word()
        if count == 0:
            return self.at, 0
        self.align(8)
        begin = self.at
        if begin + 8 * count > len(self.data):
            raise CdrError("an array is longer than the message")
        self.at = begin + 8 * count
        return begin, count


@dataclass(frozen=True)
class _Layout:
    """Where the parts of a JointState lie: byte ranges that make the structure, begin and count of each
    array."""

    endian: str
    names: tuple[str, ...]
    structure: npt.NDArray[np.int64]
    arrays: tuple[tuple[int, int], ...]

    @staticmethod
    def of(data: bytes) -> _Layout:
        cursor = _Cursor(data)
        cursor.align(4)
        cursor.at += 8
        cursor.text()
        count = cursor.word()
        if count > _MAX_JOINTS:
            raise CdrError(f"it tells of {count} joints")
        names = tuple(cursor.text() for _ in range(count))
        arrays = tuple(cursor.numbers() for _ in range(3))
        if len(data) - cursor.at > 3:
            raise CdrError("it is longer than its fields")
        structure = np.concatenate([np.arange(begin, end) for begin, end in cursor.fixed])
        return _Layout(cursor.endian, names, structure, arrays)


@dataclass(frozen=True)
class JointStates:
    """Equally built JointState messages of a topic.

    indices    (m,) numbers of the messages on the topic
    stamp_ns   (m,) header stamps
    names      joint names
    position, velocity, effort   (m, k) with k the number of joints, or 0 if the field is empty
    """

    indices: IntArray
    stamp_ns: IntArray
    names: tuple[str, ...]
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray


def decode_joint_states(raw: RawTopic) -> list[JointStates]:
    """Blocks of equally built messages; a topic with one publisher gives one block. Raises CdrError."""
    blocks: list[JointStates] = []
    lengths = np.frombuffer(raw.lengths, dtype=np.int64)
    for length in dict.fromkeys(lengths.tolist()):
        rest = np.flatnonzero(lengths == length)
        while rest.size:
            if len(blocks) == _MAX_LAYOUTS:
                raise CdrError(f"the topic holds more than {_MAX_LAYOUTS} kinds of message", int(rest[0]))
            try:
                layout = _Layout.of(raw.message(int(rest[0])))
            except CdrError as error:
                raise CdrError(error.what, int(rest[0])) from None
            rows = raw.rows(rest, int(length))
            same = (rows[:, layout.structure] == rows[0, layout.structure]).all(axis=1)
            blocks.append(_read_block(layout, rest[same], rows[same]))
            rest = rest[~same]
    return blocks


def _read_block(layout: _Layout, indices: IntArray, rows: npt.NDArray[np.uint8]) -> JointStates:
    words = np.ascontiguousarray(rows[:, 4:12]).view(layout.endian + "u4").astype(np.int64)
    fields = [
        np.ascontiguousarray(rows[:, begin : begin + 8 * count]).view(layout.endian + "f8").astype(np.float64)
        if count
        else np.zeros((len(rows), 0))
        for begin, count in layout.arrays
    ]
    return JointStates(indices, _stamp(words[:, 0], words[:, 1]), layout.names, *fields)


def decode_strings(raw: RawTopic) -> list[str]:
    """Texts of std_msgs/String messages. Raises CdrError."""
    return [_each(raw, index, _Cursor.text) for index in range(len(raw))]


def decode_multi_arrays(raw: RawTopic) -> FloatArray:
    """(n, k) data of std_msgs/Float64MultiArray messages, all of the same length. Raises CdrError."""
    rows: list[FloatArray] = [_each(raw, index, _multi_array) for index in range(len(raw))]
    for index, row in enumerate(rows):
        if len(row) != len(rows[0]):
            raise CdrError(f"it has {len(row)} numbers, the first message {len(rows[0])}", index)
    return np.array(rows, dtype=np.float64)


def _multi_array(cursor: _Cursor) -> FloatArray:
    dimensions = cursor.word()
    if dimensions > 16:
        raise CdrError(f"it tells of {dimensions} dimensions")
    for _ in range(dimensions):
        cursor.text()
        cursor.word()
        cursor.word()
    cursor.word()
    begin, count = cursor.numbers()
    return np.frombuffer(cursor.data, dtype=cursor.endian + "f8", count=count, offset=begin).astype(
        np.float64
    )


def _each(raw: RawTopic, index: int, read: Any) -> Any:
    try:
        return read(_Cursor(raw.message(index)))
    except CdrError as error:
        raise CdrError(error.what, index) from None


def stamp_at(data: bytes) -> int | None:
    """The stamp (ns) at the beginning of a message: of a header, or of a Clock; None if it is not CDR."""
    layout = _TIME.get(bytes(data[:2]))
    if layout is None or len(data) < 12:
        return None
    seconds, nanoseconds = layout.unpack_from(data, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def shift_stamp(data: bytes, by_ns: int) -> bytes:
    """The message with the stamp at its beginning moved by so many ns."""
    layout, stamp = _TIME.get(bytes(data[:2])), stamp_at(data)
    if layout is None or stamp is None:
        return data
    seconds, nanoseconds = divmod(stamp + by_ns, 1_000_000_000)
    if not -(2**31) <= seconds < 2**31:
        return data
    return data[:4] + layout.pack(seconds, nanoseconds) + data[12:]


@cache
def stamped_types() -> frozenset[str]:
    """Message types of ROS 2 Jazzy that begin with a std_msgs/Header."""
    fields = typestore().fielddefs
    return frozenset(
        name for name, (_, members) in fields.items() if members and members[0][1][1] == "std_msgs/msg/Header"
    )


def encode_float64(values: npt.ArrayLike) -> list[bytes]:
    """CDR of one std_msgs/Float64 for each value."""
    rows = np.zeros((np.size(values), 12), dtype=np.uint8)
    rows[:, 1] = 1
    rows[:, 4:] = np.ascontiguousarray(values, dtype="<f8").reshape(-1, 1).view(np.uint8)
    return _split(rows)


def encode_clock(stamps_ns: IntArray) -> list[bytes]:
    """CDR of one rosgraph_msgs/Clock for each stamp (n,) in ns."""
    rows = np.zeros((len(stamps_ns), 12), dtype=np.uint8)
    rows[:, 1] = 1
    rows[:, 4:] = _stamp_bytes(stamps_ns)
    return _split(rows)


def encode_joint_states(
    stamps_ns: IntArray,
    names: Sequence[str],
    position: FloatArray,
    velocity: FloatArray | None = None,
    effort: FloatArray | None = None,
) -> list[bytes]:
    """CDR of one sensor_msgs/JointState for each stamp (n,) in ns; fields (n, k) or None for an empty
    field."""
    store = typestore()
    header = store.types["std_msgs/msg/Header"]
    time = store.types["builtin_interfaces/msg/Time"]
    fields = [
        np.zeros((len(stamps_ns), 0)) if values is None else values for values in (position, velocity, effort)
    ]
    first = store.types[JOINT_STATE](
        header=header(stamp=time(sec=0, nanosec=0), frame_id=""),
        name=list(names),
        position=np.zeros(fields[0].shape[1]),
        velocity=np.zeros(fields[1].shape[1]),
        effort=np.zeros(fields[2].shape[1]),
    )
    template = bytes(store.serialize_cdr(first, JOINT_STATE, little_endian=True))
    rows = np.tile(np.frombuffer(template, dtype=np.uint8), (len(stamps_ns), 1))
    rows[:, 4:12] = _stamp_bytes(stamps_ns)
    for (begin, count), values in zip(_Layout.of(template).arrays, fields, strict=True):
        if count:
            rows[:, begin : begin + 8 * count] = np.ascontiguousarray(values, dtype="<f8").view(np.uint8)
    return _split(rows)


def encode_strings(texts: Sequence[str]) -> list[bytes]:
    """CDR of one std_msgs/String for each text."""
    store = typestore()
    return [
        bytes(store.serialize_cdr(store.types[STRING](data=str(text)), STRING, little_endian=True))
        for text in texts
    ]


def encode_multi_arrays(values: FloatArray) -> list[bytes]:
    """CDR of one std_msgs/Float64MultiArray (no layout) for each row of (n, k)."""
    store = typestore()
    layout = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    kind = store.types[FLOAT64_MULTI_ARRAY]
    return [
        bytes(
            store.serialize_cdr(
                kind(layout=layout, data=np.ascontiguousarray(row, dtype=np.float64)),
                FLOAT64_MULTI_ARRAY,
                little_endian=True,
            )
        )
        for row in values
    ]


def _stamp_bytes(stamps_ns: IntArray) -> npt.NDArray[np.uint8]:
    words = np.empty((len(stamps_ns), 2), dtype="<u4")
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    words[:, 0] = (stamps // 1_000_000_000).astype(np.int32).view(np.uint32)
    words[:, 1] = stamps % 1_000_000_000
    return words.view(np.uint8)


def _split(rows: npt.NDArray[np.uint8]) -> list[bytes]:
    length = rows.shape[1]
    whole = rows.tobytes()
    return [whole[k : k + length] for k in range(0, len(whole), length)]
