"""Looks at a running ROS 2 graph: which nodes and topics there are, and how often messages come."""

from __future__ import annotations

import contextlib
import importlib
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from hannes_description.errors import HannesError
from hannes_description.signals import SIGNALS
from hannes_ros.node import DEFAULT_NAMESPACE
from hannes_ros.reach import not_beyond
from hannes_ros.taking import taken
from hannes_ros.topics import CLOCK_TOPIC, DIAGNOSTICS_TOPIC
from rclpy.context import Context
from rclpy.executors import Executor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

from .visitor import visit

QUIET, LONGEST = 0.5, 3.0
"""s: discovery is over when no topic or node was added for QUIET, or after LONGEST."""
HAND = f"/{DEFAULT_NAMESPACE}/{SIGNALS['encoder_position'].topic}"
REFERENCE = f"/{DEFAULT_NAMESPACE}/{SIGNALS['reference_position'].topic}"
VOLTAGE = f"/{DEFAULT_NAMESPACE}/{SIGNALS['motor_voltage'].topic}"
BEGINS, STANDS, REST = 30.0, 5.0, 1.5
"""s: a profile begins within BEGINS, stands for no longer than STANDS, and is followed for REST more."""
HIDDEN = ("/parameter_events", "/rosout")
LEVELS = {b"\x00": "ok", b"\x01": "warn", b"\x02": "error", b"\x03": "stale"}


@dataclass(frozen=True)
class NodeSeen:
    """A running node, the topics that it publishes and subscribes to, and what it says of its health."""

    name: str
    publishes: tuple[str, ...]
    subscribes: tuple[str, ...]
    health: str | None


@dataclass(frozen=True)
class TopicSeen:
    """A topic: its messages in the window, rate (Hz) and age (s) of the last one; None where too few came."""

    name: str
    type: str
    publishers: int
    subscribers: int
    messages: int
    rate: float | None
    age: float | None


@dataclass(frozen=True)
class GraphSeen:
    """A look at the graph that took `window` seconds."""

    domain_id: int
    window: float
    nodes: tuple[NodeSeen, ...]
    topics: tuple[TopicSeen, ...]

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


class _Arrivals:
    """Counts the messages of one topic by their arrival."""

    def __init__(self, keep_last: bool) -> None:
        self.count = 0
        self.first = self.last = 0.0
        self.kept: list[bytes] | None = [] if keep_last else None

    def __call__(self, message: bytes) -> None:
        self.last = time.monotonic()
        if self.count == 0:
            self.first = self.last
        self.count += 1
        if self.kept is not None:
            self.kept.append(message)


def watch(window: float, context: Context | None = None) -> GraphSeen:
    """Watch the graph for `window` seconds (plus discovery), without disturbing it: best-effort, raw subscriptions."""
    with visit("nodes", EventsExecutor, context) as (node, executor):
        return _watch(node, executor, window)


def find_free_hand(timeout: float) -> bool:
    """Whether the hand that runs is in lock-step: it takes voltages, and tells the time.

    Raises a HannesError where no hand is found within `timeout` seconds (nobody who publishes motor/state), or where
    somebody moves it already.
    """
    with visit("peers", EventsExecutor) as (node, executor):
        end = time.monotonic() + timeout
        while not node.count_publishers(HAND):
            if time.monotonic() > end:
                raise HannesError(
                    f"No motor/state is seen in ROS domain {node.context.get_domain_id()}: is hand_sim, or the motor "
                    f"board, running? (`hannes run hand_sim` starts one.){not_beyond()}"
                )
            _spin(executor, 0.05)
        _spin(executor, QUIET)
        if others := [i.node_name for i in node.get_publishers_info_by_topic(REFERENCE)]:
            raise HannesError(
                f"{REFERENCE} is published already, by {', '.join(others)}: a profile would mix with it. End that node."
            )
        told, taken_in = node.get_publishers_info_by_topic, node.get_subscriptions_info_by_topic
        ends = (told(HAND), told(CLOCK_TOPIC), taken_in(VOLTAGE))
        return bool(set.intersection(*({(i.node_namespace, i.node_name) for i in end} for end in ends)))


def wait_for_recorder(running: Callable[[], bool]) -> None:
    """Return when the recorder hears the graph, after BEGINS, or when `running` is no longer true."""
    with visit("recorder", EventsExecutor) as (node, executor):
        end = time.monotonic() + BEGINS
        while running() and time.monotonic() < end:
            if any(name.startswith("_recorder") for name in node.get_node_names()):
                _spin(executor, 0.2)  # from its start to its last subscription
                return
            _spin(executor, 0.05)


def is_recorded(topic: str, recorded: list[str] | None) -> bool:
    """Whether a topic of the hand is among those that a recorder records; None: all of the hand's."""
    return recorded is None or any(
        name in (topic, topic.removeprefix(f"/{DEFAULT_NAMESPACE}/")) for name in recorded
    )


def follow_profile(seconds: float, running: Callable[[], bool], *, lockstep: bool = False) -> str:
    """Return when the controller has played its profile of so many seconds and the hand has come to rest, or when
    `running` is no longer true: a sentence on what it reported of itself meanwhile, empty where all was well.

    Looks ten times a second whether references have come, instead of at each message: the control loop beside it needs
    the machine. So the time that was played is an estimate, which REST covers; in lock-step it is the hand's (/clock).
    Raises HannesError where the profile does not begin, or stands: with what the controller says of itself.
    """
    with visit("profile", EventsExecutor) as (node, _):
        reference = node.create_subscription(Float64, REFERENCE, _never_called, _listener_qos(1), raw=True)
        clock = _SimulatedTime(node) if lockstep else None
        said = node.create_subscription(
            DiagnosticArray, DIAGNOSTICS_TOPIC, _never_called, _listener_qos(), raw=True
        )
        played, health = 0.0, "nothing"
        reports = list[str]()
        before = last = time.monotonic()
        while running():
            time.sleep(0.1)
            now = time.monotonic()
            went_on = clock.elapsed() if clock else now - before
            if list(taken(reference)):
                played, last = played + went_on, now
            before = now
            told = _health([message for message, _ in taken(said)]).items()
            new = [what for who, what in told if who.endswith("motor_controller")]
            health = next(iter(new), health)
            reports += new if played else []
            if played >= seconds + REST:
                return _told_of_a_run(reports)
            if now - last > (STANDS if played else BEGINS):
                what = (
                    f"stands after {played:.1f} of {seconds:.1f} s, and has not gone on for {STANDS:.0f} s"
                    if played
                    else f"did not begin within {BEGINS:.0f} s"
                )
                raise HannesError(
                    f'The profile {what}; the controller says "{health}". What came is in the bag; record again.'
                )
    return ""


class _SimulatedTime:
    """How much later it is by /clock at each look."""

    def __init__(self, node: Node) -> None:
        self._clock = node.create_subscription(Clock, CLOCK_TOPIC, _never_called, _listener_qos(), raw=True)
        self._last: float | None = None

    def elapsed(self) -> float:
        """s since the look before, or at the first look since the first time that came."""
        said = [message for message, _ in taken(self._clock)]
        if not said:
            return 0.0
        first, last = (_seconds(said[k]) for k in (0, -1))
        elapsed = last - (first if self._last is None else self._last)
        if elapsed < 0.0:
            raise HannesError(
                "/clock went back: the hand began again during the profile. What came is in the bag; record again."
            )
        self._last = last
        return elapsed


def _seconds(message: bytes) -> float:
    """The time of a /clock, s."""
    stamp = deserialize_message(message, Clock).clock
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def _told_of_a_run(reports: Sequence[str]) -> str:
    """A sentence on a controller's reports of a run, of which errors say that the loop was not the model's."""
    bad = [said for said in reports if said.startswith("error: ")]
    if not bad:
        return ""
    return (
        f"in {len(bad)} of its {len(reports)} reports the controller told of an error (the last of them: "
        f'"{bad[-1]}"): a model knows of none, and what is recorded may differ from it for that'
    )


def _never_called(data: bytes) -> None:
    raise AssertionError("the node is in no executor that spins")


def _watch(node: Node, executor: Executor, window: float) -> GraphSeen:
    subscribed: dict[str, _Arrivals] = {}
    _discover(node, executor, subscribed)
    for heard in subscribed.values():
        heard.count = 0
    started = now = time.monotonic()
    while now - started < window:
        _subscribe(node, subscribed)  # what is discovered late is listened to from then on
        _spin(executor, min(0.2, window - (now - started)))
        now = time.monotonic()
    types = _topics(node)
    topics = []
    for name, kind in sorted(types.items()):
        arrivals = subscribed.get(name)
        count = arrivals.count if arrivals else 0
        spread = arrivals.last - arrivals.first if arrivals else 0.0
        topics.append(
            TopicSeen(
                name=name,
                type=kind,
                publishers=node.count_publishers(name),
                subscribers=node.count_subscribers(name) - (1 if arrivals else 0),
                messages=count,
                rate=(count - 1) / spread if count > 1 and spread > 0.0 else None,
                age=now - arrivals.last if arrivals and count else None,
            )
        )
    diagnostics = subscribed.get("/diagnostics")
    health = _health(diagnostics.kept if diagnostics and diagnostics.kept else [])
    return GraphSeen(
        domain_id=node.context.get_domain_id(),
        window=now - started,
        nodes=tuple(_nodes(node, health)),
        topics=tuple(topics),
    )


def _discover(node: Node, executor: Executor, subscribed: dict[str, _Arrivals]) -> None:
    """Subscribe to every topic with a publisher, until no more of them appear; as long as it takes if none does."""
    started = changed = time.monotonic()
    known: tuple[set[str], int] = (set(), 0)
    while (now := time.monotonic()) - changed < QUIET and now - started < LONGEST:
        _subscribe(node, subscribed)
        seen = (set(subscribed), len(node.get_node_names()))
        if seen != known or not subscribed:
            known, changed = seen, now
        _spin(executor, 0.05)


def _subscribe(node: Node, subscribed: dict[str, _Arrivals]) -> None:
    """Listen to the topics with a publisher that are not listened to yet."""
    for name, kind in _topics(node).items():
        message = message_class(kind)
        if name not in subscribed and message is not None and node.count_publishers(name):
            subscribed[name] = _Arrivals(keep_last=name == "/diagnostics")
            node.create_subscription(message, name, subscribed[name], _listener_qos(), raw=True)


def _topics(node: Node) -> dict[str, str]:
    return {name: kinds[0] for name, kinds in node.get_topic_names_and_types() if name not in HIDDEN}


def _nodes(node: Node, health: dict[str, str]) -> list[NodeSeen]:
    seen = []
    for name, namespace in sorted(set(node.get_node_names_and_namespaces())):
        if name == node.get_name():
            continue
        full = f"{namespace.rstrip('/')}/{name}"
        publishes: list[str] = []
        subscribes: list[str] = []
        # the node may end while it is looked at
        with contextlib.suppress(RuntimeError):
            publishes = [
                t for t, _ in node.get_publisher_names_and_types_by_node(name, namespace) if t not in HIDDEN
            ]
            subscribes = [
                t for t, _ in node.get_subscriber_names_and_types_by_node(name, namespace) if t not in HIDDEN
            ]
        said = next((level for who, level in health.items() if who in (full, full.lstrip("/"), name)), None)
        seen.append(NodeSeen(full, tuple(sorted(publishes)), tuple(sorted(subscribes)), said))
    return seen


def _health(messages: list[bytes]) -> dict[str, str]:
    """Name -> "level: message" of the latest diagnostics; names are cut at ':' as in "node: what"."""
    health: dict[str, str] = {}
    for message in messages:
        for status in deserialize_message(message, DiagnosticArray).status:
            health[status.name.partition(":")[0].strip()] = (
                f"{LEVELS.get(status.level, '?')}: {status.message}"
            )
    return health


def message_class(kind: str) -> Any | None:
    """ "std_msgs/msg/Float64" -> the class; None if its package is not installed."""
    package, _, name = kind.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        return None


def _listener_qos(depth: int = 1000) -> QoSProfile:
    # matches every publisher: best effort and volatile are the least that can be asked for
    return QoSProfile(
        depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE
    )


def _spin(executor: Executor, duration: float) -> None:
    end = time.monotonic() + duration
    while (left := end - time.monotonic()) > 0.0:
        executor.spin_once(min(left, 0.05))
