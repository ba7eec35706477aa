"""Serialised messages and numbers, both ways, held against rclpy's own serialisation."""

import math
import struct

import pytest
from hannes_description.errors import HannesError
from hannes_description.joints import JOINT_NAMES
from hannes_ros import convert
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

STAMP = 12_000_345_678


@pytest.mark.parametrize("value", [0.0, -1.5, 1e300, math.inf])
def test_float64_both_ways(value):
    assert deserialize_message(convert.float64_bytes(value), Float64).data == value
    assert convert.float64_value(serialize_message(Float64(data=value))) == value


def test_float64_of_a_big_endian_peer():
    assert convert.float64_value(b"\x00\x00\x00\x00" + struct.pack(">d", 2.5)) == 2.5


def test_clock_and_time():
    assert convert.to_ns(deserialize_message(convert.clock_bytes(STAMP), Clock).clock) == STAMP
    assert convert.to_ns(convert.to_time(STAMP)) == STAMP


@pytest.mark.parametrize("names", [("motor_pulley",), JOINT_NAMES, ("a", "bc", "def", "ghij")])
@pytest.mark.parametrize("effort", [True, False])
def test_joint_state_is_what_rclpy_reads_and_writes(names, effort):
    codec = convert.JointCodec(names, effort=effort)
    count = len(names)
    position, velocity = (tuple(base + k for k in range(count)) for base in (0.25, 100.5))
    torque = tuple(-0.125 - k for k in range(count)) if effort else ()
    message = deserialize_message(codec.encode(STAMP, position, velocity, torque), JointState)
    assert tuple(message.name) == names
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 345_678)
    assert message.header.frame_id == ""
    sample = convert.JointSample(STAMP, position, velocity, torque)
    assert convert.joint_sample(names, message) == sample
    assert codec.decode(codec.encode(STAMP, position, velocity, torque)) == sample
    assert codec.decode(serialize_message(convert.joint_message(names, sample))) == sample


def test_a_peer_with_a_frame_or_without_velocity_is_understood():
    message = JointState(name=["motor_pulley"], position=[1.0])
    message.header.frame_id = "base_link"
    sample = convert.MOTOR_STATE.decode(serialize_message(message))
    assert sample == convert.JointSample(0, (1.0,), (), ())


@pytest.mark.parametrize(
    ("names", "position"),
    [(["elbow"], [1.0]), (["motor_pulleX"], [1.0]), ([], []), (["motor_pulley", "motor_pulley"], [1.0, 2.0])],
)
def test_other_joints_are_refused(names, position):
    with pytest.raises(HannesError, match="expected \\['motor_pulley'\\]"):
        convert.MOTOR_STATE.decode(
            serialize_message(JointState(name=names, position=position, velocity=position, effort=position))
        )


def test_other_lengths_are_refused():
    with pytest.raises(HannesError, match="have 2, 0 and 0 entries, expected 1 each"):
        convert.MOTOR_STATE.decode(serialize_message(JointState(name=["motor_pulley"], position=[1.0, 2.0])))


def test_a_damaged_message_is_no_number_and_no_joint():
    assert math.isnan(convert.float64_value(convert.float64_bytes(1.0)[:9]))
    whole = convert.MOTOR_STATE.encode(1, (1.0,), (2.0,), (3.0,))
    with pytest.raises(HannesError, match="a message of 20 bytes is no JointState"):
        convert.MOTOR_STATE.decode(whole[:20])
