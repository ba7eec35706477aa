"""Topic, message type and QoS of every signal, and the two calls that create publishers and subscriptions.

Names, types and units come from `hannes_description.signals`; only the QoS is decided here. Every topic is reliable and
volatile: in lock-step a lost message would stop the loop, and a recorder must not miss a tick. The depth of a signal
that comes at each tick covers about a second of stall of a subscriber at 1 kHz; what is sent is kept longer, for in
lock-step a second has many more ticks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticArray
from hannes_description.errors import HannesError
from hannes_description.signals import SIGNALS, Signal
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, String

CLOCK_TOPIC: Final = "/clock"
CLOCK_TYPE: Final = "rosgraph_msgs/msg/Clock"
DIAGNOSTICS_TOPIC: Final = "/diagnostics"

MESSAGE_TYPES: Final[Mapping[str, type]] = MappingProxyType(
    {
        "std_msgs/msg/Float64": Float64,
        "std_msgs/msg/Float64MultiArray": Float64MultiArray,
        "std_msgs/msg/String": String,
        "sensor_msgs/msg/JointState": JointState,
    }
)
"""Message class by ROS type name, for every type that a signal uses."""

_EACH_TICK: Final = frozenset({"reference_position", "motor/state", "motor/current", "motor/voltage"})
_TICK_DEPTH: Final = 1000
_SENT_DEPTH: Final = 5000
_SLOW_DEPTH: Final = 300


def _reliable(depth: int) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
    )


CLOCK_QOS: Final = _reliable(_TICK_DEPTH)
DIAGNOSTICS_QOS: Final = _reliable(10)


def signal(name: str) -> Signal:
    """The signal of that canonical name; HannesError lists the valid ones."""
    try:
        return SIGNALS[name]
    except KeyError:
        raise HannesError(f"Signal '{name}' does not exist; valid are {', '.join(SIGNALS)}.") from None


def message_type(name: str) -> type:
    """Message class of the topic that carries the signal."""
    return MESSAGE_TYPES[signal(name).type]


def qos(name: str, depth: int = _TICK_DEPTH) -> QoSProfile:
    """QoS of the topic that carries the signal; depth: that of a signal which comes at each tick."""
    return _reliable(depth if signal(name).topic in _EACH_TICK else _SLOW_DEPTH)


def publisher(node: Node, name: str, on_match: Callable[[Any], None] | None = None) -> Publisher:
    """Publisher of the signal's topic, relative to the node's namespace; `on_match` is told of new and
    lost subscribers."""
    events = PublisherEventCallbacks(matched=on_match) if on_match else None
    return node.create_publisher(
        message_type(name), signal(name).topic, qos(name, _SENT_DEPTH), event_callbacks=events
    )


def subscription(
    node: Node, name: str, callback: Callable[[bytes], None], on_match: Callable[[Any], None] | None = None
) -> Subscription:
    """Subscription of the signal's topic that hands over serialised messages (decode them with `convert`)."""
    events = SubscriptionEventCallbacks(matched=on_match) if on_match else None
    return node.create_subscription(
        message_type(name), signal(name).topic, callback, qos(name), event_callbacks=events, raw=True
    )


def clock_publisher(node: Node, on_match: Callable[[Any], None] | None = None) -> Publisher:
    """Publisher of simulated time; `on_match` is told of new and lost subscribers."""
    events = PublisherEventCallbacks(matched=on_match) if on_match else None
    return node.create_publisher(Clock, CLOCK_TOPIC, _reliable(_SENT_DEPTH), event_callbacks=events)


def clock_subscription(node: Node, callback: Callable[[bytes], None]) -> Subscription:
    """Subscription of simulated time that hands over serialised messages."""
    return node.create_subscription(Clock, CLOCK_TOPIC, callback, CLOCK_QOS, raw=True)


def diagnostics_publisher(node: Node) -> Publisher:
    """Publisher of the node's health."""
    return node.create_publisher(DiagnosticArray, DIAGNOSTICS_TOPIC, DIAGNOSTICS_QOS)
