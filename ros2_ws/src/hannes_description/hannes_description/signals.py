"""The signals of the node graph: canonical name, topic, ROS type and unit, each defined once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

NAMESPACE = "/hannes"
"""Namespace that the launch files and the nodes put their relative topics into."""


@dataclass(frozen=True)
class Signal:
    """One measured or commanded quantity.

    name         canonical name, the key of a Recording's channels
    topic        topic relative to NAMESPACE
    type         ROS message type
    unit         SI unit (angles in rad at the motor pulley unless said otherwise)
    field        the message field that carries the quantity
    description  what it is
    """

    name: str
    topic: str
    type: str
    unit: str
    field: str
    description: str


_ALL = (
    Signal("emg_flexor", "emg/flexor", "std_msgs/msg/Float64", "V", "data", "surface EMG of the flexor site"),
    Signal(
        "emg_extensor",
        "emg/extensor",
        "std_msgs/msg/Float64",
        "V",
        "data",
        "surface EMG of the extensor site",
    ),
    Signal(
        "reference_position",
        "reference_position",
        "std_msgs/msg/Float64",
        "rad",
        "data",
        "reference of the encoder position, at the motor pulley",
    ),
    Signal(
        "encoder_position",
        "motor/state",
        "sensor_msgs/msg/JointState",
        "rad",
        "position",
        "encoder position, at the motor pulley",
    ),
    Signal(
        "encoder_velocity",
        "motor/state",
        "sensor_msgs/msg/JointState",
        "rad/s",
        "velocity",
        "encoder velocity, at the motor pulley",
    ),
    Signal(
        "motor_effort",
        "motor/state",
        "sensor_msgs/msg/JointState",
        "N.m",
        "effort",
        "nominal Kt x gear ratio x measured current",
    ),
    Signal("motor_current", "motor/current", "std_msgs/msg/Float64", "A", "data", "measured motor current"),
    Signal(
        "motor_voltage", "motor/voltage", "std_msgs/msg/Float64", "V", "data", "command: PWM duty x supply"
    ),
    Signal(
        "joint_positions",
        "joint_states",
        "sensor_msgs/msg/JointState",
        "rad",
        "position",
        "finger joint positions",
    ),
    Signal(
        "joint_velocities",
        "joint_states",
        "sensor_msgs/msg/JointState",
        "rad/s",
        "velocity",
        "finger joint velocities",
    ),
    Signal(
        "grip_force",
        "grip_force",
        "std_msgs/msg/Float64",
        "N",
        "data",
        "total fingertip force on the object (the dynamometer)",
    ),
    Signal(
        "stiffness_label",
        "stiffness/label",
        "std_msgs/msg/String",
        "",
        "data",
        "void, rigid, soft or not sure",
    ),
    Signal(
        "stiffness_class",
        "stiffness/class",
        "std_msgs/msg/Float64",
        "",
        "data",
        "0 void, 1 rigid, 2 soft, -1 not sure",
    ),
    Signal(
        "stiffness_probability",
        "stiffness/probability",
        "std_msgs/msg/Float64MultiArray",
        "",
        "data",
        "probabilities of void, rigid, soft",
    ),
    Signal(
        "stiffness_estimate",
        "stiffness/estimate",
        "std_msgs/msg/Float64MultiArray",
        "N/m",
        "data",
        "stiffness of the grasp, lower and upper end of its 90 % interval; only while something is grasped",
    ),
)

SIGNALS: Mapping[str, Signal] = MappingProxyType({signal.name: signal for signal in _ALL})
"""Every signal by its canonical name."""

STIFFNESS_CLASSES = ("void", "rigid", "soft")
"""Class names in the order of their numbers (thesis P19)."""
