"""Messages to numbers and back, serialised.

The nodes exchange a few small messages thousands of times a second, and rclpy's own path (message object, serialise,
deserialise) costs more than the control law. So the two hot message types, Float64 and JointState, are written and read
here as CDR bytes directly. What does not have exactly the expected layout (another frame_id, byte order or
padding) takes the ordinary path through rclpy, so any ROS 2 peer is understood.

CDR little endian (DDS-XTypes 1.3, plain CDR version 1): four bytes of header 00 01 00 00, then the fields, each aligned
to its own size counted from the end of the header; strings are a length including the final zero, the bytes, the zero.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from builtin_interfaces.msg import Time
from hannes_description.errors import HannesError
from hannes_description.joints import ENCODER_JOINT, JOINT_NAMES
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

_HEADER: Final = b"\x00\x01\x00\x00"
_FLOAT64: Final = struct.Struct("<4sd")
_CLOCK: Final = struct.Struct("<4siI")
_GIGA: Final = 1_000_000_000


@dataclass(frozen=True)
class JointSample:
    """One JointState: stamp in ns, then position (rad), velocity (rad/s), effort (N.m), one number for each joint.

    velocity and effort may be empty, as in the message.
    """

    stamp_ns: int
    position: tuple[float, ...]
    velocity: tuple[float, ...] = ()
    effort: tuple[float, ...] = ()


# -- single numbers --------------------------------------------------------------------------------------------------
def float64_bytes(value: float) -> bytes:
    """A serialised std_msgs/Float64."""
    return _FLOAT64.pack(_HEADER, value)


def float64_value(data: bytes) -> float:
    """The number in a serialised std_msgs/Float64; NaN where that is damaged, as of any other number that is none."""
    if len(data) == 12 and data[:4] == _HEADER:
        return _FLOAT64.unpack(data)[1]
    try:
        return float(deserialize_message(data, Float64).data)
    except rclpy_implementation.RMWError:
        return math.nan


def clock_bytes(stamp_ns: int) -> bytes:
    """A serialised rosgraph_msgs/Clock."""
    return _CLOCK.pack(_HEADER, *divmod(stamp_ns, _GIGA))


def to_time(stamp_ns: int) -> Time:
    """builtin_interfaces/Time of a time in ns."""
    sec, nanosec = divmod(stamp_ns, _GIGA)
    return Time(sec=sec, nanosec=nanosec)


def to_ns(stamp: Time) -> int:
    """A time in ns of a builtin_interfaces/Time."""
    return stamp.sec * _GIGA + stamp.nanosec


# -- joints ----------------------------------------------------------------------------------------------------------
def joint_message(names: Sequence[str], sample: JointSample) -> JointState:
    """The message of a sample of the named joints."""
    message = JointState(
        name=list(names),
        position=list(sample.position),
        velocity=list(sample.velocity),
        effort=list(sample.effort),
    )
    message.header.stamp = to_time(sample.stamp_ns)
    return message


def joint_sample(names: Sequence[str], message: JointState) -> JointSample:
    """The sample in a message that must hold exactly the named joints, in that order.

    Raises HannesError when a name, or the length of a field, is another one (velocity and effort may be empty).
    """
    if list(message.name) != list(names):
        raise HannesError(f"the joints are {list(message.name)}, expected {list(names)}")
    count = len(names)
    if (
        len(message.position) != count
        or len(message.velocity) not in (0, count)
        or len(message.effort) not in (0, count)
    ):
        raise HannesError(
            f"position, velocity and effort have {len(message.position)}, {len(message.velocity)} and "
            f"{len(message.effort)} entries, expected {count} each (velocity and effort may be empty)"
        )
    return JointSample(
        to_ns(message.header.stamp), tuple(message.position), tuple(message.velocity), tuple(message.effort)
    )


def _string(text: str) -> bytes:
    """CDR string that starts on a multiple of four, filled up to the next multiple of four."""
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)


class JointCodec:
    """Serialised JointState of a fixed list of joints, without building the message.

    names   joint names, in order
    effort  whether the effort field is filled
    """

    def __init__(self, names: Sequence[str], effort: bool) -> None:
        self.names = tuple(names)
        count = len(self.names)
        # All that never changes between the stamp and the first position: frame_id, names, length of position.
        between = (
            _string("")
            + struct.pack("<I", count)
            + b"".join(_string(name) for name in self.names)
            + struct.pack("<I", count)
        )
        self._between = between + bytes(-len(between) % 8)
        self._length = struct.pack("<I4x", count)
        self._tail = (self._length,) if effort else ()
        self._end = () if effort else (struct.pack("<I", 0),)
        block = f"8s{count}d"
        self._struct = struct.Struct(
            f"<4siI{len(self._between)}s{count}d{block}" + (block if effort else "4s")
        )
        # Places of the constant parts in the unpacked tuple, and of the values between them.
        self._second, self._third = 4 + count, 5 + 2 * count

    def encode(
        self,
        stamp_ns: int,
        position: Sequence[float],
        velocity: Sequence[float],
        effort: Sequence[float] = (),
    ) -> bytes:
        """A serialised JointState; each sequence has one number for each joint (no effort if the codec has none)."""
        return self._struct.pack(
            _HEADER,
            *divmod(stamp_ns, _GIGA),
            self._between,
            *position,
            self._length,
            *velocity,
            *self._tail,
            *effort,
            *self._end,
        )

    def decode(self, data: bytes) -> JointSample:
        """The sample in a serialised JointState; HannesError as `joint_sample`, and where the message is damaged."""
        if len(data) == self._struct.size:
            parts = self._struct.unpack(data)
            second, third = self._second, self._third
            if (
                parts[0] == _HEADER
                and parts[3] == self._between
                and parts[second] == self._length
                and parts[third : third + 1] == (self._tail or self._end)
            ):
                return JointSample(
                    parts[1] * _GIGA + parts[2],
                    parts[4:second],
                    parts[second + 1 : third],
                    parts[third + 1 :],
                )
        try:
            message = deserialize_message(data, JointState)
        except rclpy_implementation.RMWError as error:
            raise HannesError(f"a message of {len(data)} bytes is no JointState") from error
        return joint_sample(self.names, message)


MOTOR_STATE: Final = JointCodec((ENCODER_JOINT,), effort=True)
"""motor/state: encoder position rad, velocity rad/s, effort N.m, all at the motor pulley."""

FINGER_STATES: Final = JointCodec(JOINT_NAMES, effort=False)
"""joint_states: position rad and velocity rad/s of the 13 finger joints."""
