"""recorder: puts the topics of the hand into a bag that a kill cannot rob of more than 0.2 s."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from hannes_description.errors import HannesError
from hannes_description.signals import SIGNALS
from hannes_ros.node import DEFAULT_NAMESPACE, HannesNode
from hannes_ros.node_parameters import declare, parameter
from hannes_ros.run import run_node
from hannes_ros.sources import Sources
from hannes_ros.taking import taken
from hannes_ros.telling import LOOP, Told
from hannes_ros.topics import CLOCK_TOPIC, CLOCK_TYPE, DIAGNOSTICS_TOPIC, signal
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from .cdr import stamp_at
from .recorder import Recorder, SimulatedTimes
from .writing import BagWriter, Qos

_POLL_S = 0.004
_LOOK_S = 0.05
_ASK_S = 0.2
_SYNC_S = 1.0
_STOP_S = 0.5
_LATE_S = 2.0
_ELSEWHERE_S = 10.0
_OWN_CLOCK_NS = 1_000_000_000
_HELD_MS = 170.0
"""From when a message is taken until it is handed over at the latest: less than the 0.2 s that a kill may take."""
_DEPTH = 10_000
_MOST_AT_ONCE = 5000
_LEADING = SIGNALS["encoder_position"].topic
_DRIVING = SIGNALS["motor_voltage"].topic
_COARSE = 2
"""Messages of motor/state for each of /clock from which that is too slow to tell the times of others."""
_TYPES = {
    **{signal.topic: signal.type for signal in SIGNALS.values()},
    CLOCK_TOPIC: CLOCK_TYPE,
    DIAGNOSTICS_TOPIC: "diagnostic_msgs/msg/DiagnosticArray",
}


@dataclass(frozen=True)
class RecorderParameters:
    """ROS parameters of recorder."""

    output: str = parameter("", "folder of the new bag; it must not exist")
    topics: tuple[str, ...] = parameter(
        (), "topics to record; empty for those of the hand, /clock and /diagnostics"
    )
    condition: str = parameter("", "what was done, for instance slow, fast or grasp; kept in the bag")
    object: str = parameter("", "what the hand closed on: none, soft or rigid; kept in the bag")
    metadata: str = parameter(
        "", "what else the bag shall say of itself, as a JSON object (condition, object, seed ...)"
    )
    clock: str = parameter(
        "auto",
        "what the log times count: simulated is /clock as it stood when a message was sent, computer is when it was "
        "received; auto is simulated if somebody publishes /clock or use_sim_time is set",
        choices=("auto", "computer", "simulated"),
    )
    compression: str = parameter("none", "packing of the bag's chunks", choices=("none", "zstd"))
    flush_ms: float = parameter(
        50.0, "how often messages are handed to the operating system", lower=1.0, upper=100.0, unit="ms"
    )

    def __post_init__(self) -> None:
        if not self.output:
            raise HannesError(
                "Parameter 'output' is empty; give the folder of the new bag: -p output:=FOLDER."
            )
        if Path(self.output).exists():
            raise HannesError(
                f"{self.output} exists already; a bag is never overwritten. Choose another name."
            )
        self.entries()

    def entries(self) -> dict[str, Any]:
        """The metadata as an object."""
        try:
            value = json.loads(self.metadata or "{}")
        except (ValueError, RecursionError) as error:
            raise HannesError(f"Parameter 'metadata' is not JSON: {error}.") from None
        if not isinstance(value, dict):
            raise HannesError('Parameter \'metadata\' must be a JSON object, such as {"condition": "slow"}.')
        said = {"condition": self.condition, "object": self.object}
        return {name: text for name, text in said.items() if text} | value


def message_class(msgtype: str) -> type:
    """The Python class of a type such as std_msgs/msg/Float64; HannesError if its package is not
    installed."""
    package, middle, name = ([*msgtype.split("/"), "", ""])[:3]
    try:
        if middle != "msg":
            raise ImportError(msgtype)
        kind: type = getattr(import_module(f"{package}.msg"), name)
        return kind
    except (ImportError, AttributeError):
        raise HannesError(f"The message type {msgtype!r} is not installed here.") from None


class RecorderNode(HannesNode, Node):
    """Records topics into a bag that a kill cannot rob of more than 0.2 s.

    It takes serialised messages itself, because no executor tells when they were sent.
    """

    node_name = "recorder"
    parameters = RecorderParameters

    def __init__(self, cli_args: list[str] | None = None) -> None:
        super().__init__(self.node_name, namespace=DEFAULT_NAMESPACE, cli_args=cli_args)
        self._p = p = declare(self, RecorderParameters)
        names = p.topics or tuple(dict.fromkeys((*_TYPES,)))
        known = {self.resolve_topic_name(name): msgtype for name, msgtype in _TYPES.items()}
        self._leading = self.resolve_topic_name(_LEADING)
        self._wanted: dict[str, str | None] = {
            topic: known.get(topic) for topic in (self.resolve_topic_name(name) for name in names)
        }
        # A node of its own that no executor serves: executors take messages without their times.
        self._ears = Node(
            f"_{self.get_name()}_input",
            namespace=self.get_namespace(),
            context=self.context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._subscriptions_by_topic: dict[str, Subscription] = {}
        self._clock = self.resolve_topic_name(CLOCK_TOPIC)
        self._health = self.resolve_topic_name(DIAGNOSTICS_TOPIC)
        self._times = SimulatedTimes(self._clock, hold_ns=round((_HELD_MS - p.flush_ms) * 1e6))
        self._only_heard = self._clock not in self._wanted and p.clock != "computer"
        if self._only_heard:
            self._wanted[self._clock] = _TYPES[CLOCK_TOPIC]
        self._decided = p.clock != "auto"
        self._simulated = p.clock != "computer"
        self._clocks = Sources(self, CLOCK_TOPIC, rule="time is told by one hand in lock-step, or one player")
        if p.clock == "auto" and self.get_parameter("use_sim_time").value:
            self._decided = True
        self._may_be_others = not self._decided  # nobody said whose /clock it is
        self._seen_at: float | None = None
        self._settled_at: float | None = None
        self._leading_at = 0.0
        self._matched = 0
        self._late_at = 0.0
        self._elsewhere_at = time.monotonic() + _LATE_S
        self._recorder: Recorder | None = None
        self._begun: set[str] = set()
        self._states = 0
        self._said_back = 0
        self._unwritten: HannesError | None = None
        self._stop_sync = threading.Event()
        self._sync = threading.Thread(target=self._keep_on_disk, name="sync", daemon=True)
        self._driving = self.resolve_topic_name(_DRIVING)
        self._told = Told(self, self._leading, self._driving)
        self._look()
        self.wall_timer(_LOOK_S, self._look)
        self.wall_timer(_ASK_S, self._told.look)
        self.wall_timer(_POLL_S, self._listen)
        self.wall_timer(p.flush_ms / 1e3, self._flush)
        self.get_logger().info(f"recording {len(names)} topics into {p.output}")

    # -- subscriptions ---------------------------------------------------------------------------------------------
    def _look(self) -> None:
        """Subscribe to what there is; the leading topic last, since in lock-step it starts the run."""
        if not self._decided:
            self._decide()
        self._look_for_the_hand()
        if self._simulated and self._times.went_back > self._said_back:
            self._said_back = self._times.went_back
            self.get_logger().error(
                f"{self._clock} went back: another run has begun, a player loops, or two nodes tell the time. This bag "
                "cannot be read as one; record each run into a bag of its own",
                throttle_duration_sec=_ELSEWHERE_S,
            )
        if self._simulated and self._decided:
            self._clocks.several()
            if self._recorder is not None and self._times.latest is None and time.monotonic() > self._late_at:
                self.get_logger().warning(
                    f"waiting for {self._clock}: until it comes, nothing is written (clock:=computer does without)",
                    throttle_duration_sec=10.0,
                )
        try:
            self._listen_to_all()
        except HannesError as error:
            self.fail(f"{error} Install its package, or leave the topic out.")

    def _listen_to_all(self) -> None:
        for topic, msgtype in self._wanted.items():
            if topic == self._leading and not self._may_lead():
                continue
            if topic not in self._subscriptions_by_topic:
                self._subscribe(topic, msgtype)
            elif self._unheard(topic):
                self._ears.destroy_subscription(self._subscriptions_by_topic.pop(topic))
                self._subscribe(topic, msgtype)

    def _look_for_the_hand(self) -> None:
        """Say where a hand is whose topics are elsewhere than those that are recorded, while nothing of it comes."""
        if self._leading not in self._wanted or self._begun - {self._clock, self._health}:
            return
        if time.monotonic() < self._elsewhere_at:
            return
        self._elsewhere_at = time.monotonic() + _ELSEWHERE_S
        seen = [
            name
            for name, _ in self.get_topic_names_and_types()
            if name.endswith(f"/{_LEADING}") and name not in self._wanted and self.count_publishers(name)
        ]
        if seen:
            space = seen[0].removesuffix(f"/{_LEADING}") or "/"
            self.get_logger().warning(
                f"nothing of the hand comes under {self.get_namespace()}, but {' and '.join(seen)} is published: "
                f"record with --namespace {space} (of the node: -r __ns:={space})"
            )

    def _decide(self) -> None:
        """Whether there is simulated time: a publisher of /clock says yes, signals for 0.1 s without one say no."""
        if self.count_publishers(self._clock):
            self._decided = True
            return
        if self._seen_at is None and (self._begun - {self._health} or self.count_publishers(self._leading)):
            self._seen_at = time.monotonic()
        if self._seen_at is not None and time.monotonic() - self._seen_at > 0.1:
            self._decided, self._simulated = True, False
            if self._recorder is not None:
                self._recorder.use_receive_times(time.time_ns())

    def _may_lead(self) -> bool:
        """With simulated time: 0.4 s after the last match with another publisher, at most 3 s after its own."""
        if self._leading in self._subscriptions_by_topic or (self._decided and not self._simulated):
            return True
        if not self.count_publishers(self._leading):
            self._settled_at = None
            return False
        others = [topic for topic in self._wanted if topic not in (self._leading, self._health)]
        matched = sum(
            1
            for topic in others
            if topic in self._subscriptions_by_topic
            and self._subscriptions_by_topic[topic].get_publisher_count()
        )
        now = time.monotonic()
        if self._settled_at is None:
            self._settled_at, self._matched, self._leading_at = now, matched, now
        if matched != self._matched:
            self._settled_at, self._matched = now, matched
        if not self._decided:
            return False
        return now - self._settled_at > 0.4 or now - self._leading_at > 3.0

    def _subscribe(self, topic: str, msgtype: str | None) -> None:
        if msgtype is None:
            types = dict(self.get_topic_names_and_types()).get(topic)
            if not types:
                return
            msgtype = self._wanted[topic] = types[0]
        offered = self.get_publishers_info_by_topic(topic)
        best_effort = any(info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for info in offered)
        reliability = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
        self._subscriptions_by_topic[topic] = self._ears.create_subscription(
            message_class(msgtype),
            topic,
            _never_called,
            QoSProfile(depth=_DEPTH, reliability=reliability),
            raw=True,
        )

    def _unheard(self, topic: str) -> bool:
        """Whether there are only publishers that a reliable subscription cannot hear."""
        subscription = self._subscriptions_by_topic[topic]
        if subscription.get_publisher_count() or not self.count_publishers(topic):
            return False
        offered = self.get_publishers_info_by_topic(topic)
        reliable = subscription.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        return reliable and all(i.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for i in offered)

    # -- messages --------------------------------------------------------------------------------------------------
    def _listen(self) -> None:
        self._poll()

    def _poll(self) -> int:
        """Take what has come in; how many messages."""
        taken = 0
        try:
            for topic, subscription in self._subscriptions_by_topic.items():
                taken += self._take(topic, subscription)
        except HannesError as error:
            self.fail(error)
        return taken

    def _take(self, topic: str, subscription: Subscription) -> int:
        count = 0
        for data, info in taken(subscription, _MOST_AT_ONCE):
            count += 1
            now_ns = time.time_ns()
            sent_ns = info.get("source_timestamp") or now_ns
            if topic == self._clock and self._only_heard:
                self._times.heard(data, sent_ns)
                continue
            if topic not in self._begun:
                self._begin(topic)
                if topic == self._leading:
                    self._check_stamp(data, sent_ns)
            self._states += topic == self._leading
            assert self._recorder is not None
            self._recorder.take(topic, data, info, now_ns)
        return count

    def _begin(self, topic: str) -> None:
        """The first message of a topic; of the first topic, the bag."""
        msgtype = self._wanted[topic]
        assert msgtype is not None
        if self._recorder is None:
            writer = BagWriter(self._p.output, self._p.entries(), compression=self._p.compression)  # type: ignore[arg-type]
            self._recorder = Recorder(writer, self._times if self._simulated else None)
            self._sync.start()
            self._late_at = time.monotonic() + _LATE_S
        self._recorder.writer.add_topic(topic, msgtype, qos=self._offered(topic))
        self._begun.add(topic)

    def _check_stamp(self, data: bytes, sent_ns: int) -> None:
        """Who stamps by the computer's clock does not live by the /clock that another hand publishes."""
        stamp = stamp_at(data)
        if (
            not (self._may_be_others and self._simulated)
            or stamp is None
            or abs(sent_ns - stamp) > _OWN_CLOCK_NS
        ):
            return
        if (told := self._times.latest) is not None and abs(told - stamp) <= _OWN_CLOCK_NS:
            return
        assert self._recorder is not None
        self._simulated = False
        self._recorder.use_receive_times(time.time_ns())
        self.get_logger().warning(
            f"{self._clock} is not the time of {self._leading}, which is stamped by the computer's clock: "
            "log times are those of reception"
        )

    def _unchecked(self) -> bool:
        """Whether motor/state, which tells whose time /clock is, has not come yet though somebody publishes it."""
        return (
            self._simulated
            and self._may_be_others
            and self._leading in self._wanted
            and self._leading not in self._begun
            and self.count_publishers(self._leading) > 0
            and time.monotonic() < self._late_at + _LATE_S
        )

    def _offered(self, topic: str) -> Qos:
        for info in self.get_publishers_info_by_topic(topic):
            profile = info.qos_profile
            return Qos(profile.reliability.name.lower(), profile.durability.name.lower())
        return Qos()

    def _flush(self) -> None:
        if self._recorder is None:
            return
        now_ns = time.time_ns()
        self._poll()  # where this process was held up, /clock waits behind the messages of its time
        if self._unchecked():
            return
        try:
            if self._unwritten is not None:
                raise self._unwritten
            self._recorder.hand_over(now_ns)
        except HannesError as error:
            self.fail(error)

    def _keep_on_disk(self) -> None:
        """A power failure takes at most a second; in a thread, since a disk may be slow."""
        while self._unwritten is None and not self._stop_sync.wait(_SYNC_S):
            try:
                if self._recorder is not None:
                    self._recorder.writer.sync()
            except HannesError as error:
                self._unwritten = error  # the thread of the messages ends the node

    def stop(self) -> None:
        """Take what is still on its way, close the bag, tell what is in it.

        Nodes that go on publishing do not hold the end up: one poll takes all that had come in before it.
        """
        until = time.monotonic() + _STOP_S
        while self.failure is None and self._poll() and time.monotonic() < until:
            time.sleep(0.02)
        if self.failure is None and self._clock in self._subscriptions_by_topic:
            self._take(self._clock, self._subscriptions_by_topic[self._clock])  # of what was taken last
        self._stop_sync.set()
        if self._sync.is_alive():
            self._sync.join(timeout=5.0)
        if self._recorder is None:
            if self.failure is None:
                self.get_logger().warning("no message came: there is no bag")
        else:
            self._close(self._recorder)
        self._ears.destroy_node()

    def _description(self) -> dict[str, Any]:
        """What the simulated hand and its controller tell of themselves and the user did not say."""
        return description(self._told.of(self._leading), self._told.of(self._driving), self._p.entries())

    def _close(self, recorder: Recorder) -> None:
        try:
            recorder.close(time.time_ns(), self._description())
        except HannesError as error:
            self.fail(error)
            return
        lost: Mapping[str, int] = recorder.losses.lost
        if lost:
            self.get_logger().warning(f"messages that never arrived: {dict(lost)}")
        if recorder.misplaced:
            self.get_logger().warning(
                f"{recorder.misplaced} messages have too early a log time: {self._clock} came more than "
                f"{self._times.hold_ns * 1e-6:.0f} ms after them. Do not use the log times of what has no header."
            )
        if self._simulated and self._states > _COARSE * self._times.ticks > 0:
            self.get_logger().warning(
                f"{self._clock} came {self._times.ticks} times for {self._states} messages of {self._leading}: times "
                "of what has no header are known to one of its steps only. Let it come as often as the fastest topic"
            )
        if self._simulated and self._times.went_back:
            self.get_logger().error(
                f"{self._clock} went back: the bag holds more than one run, or two clocks, and is none to compare"
            )
        self.get_logger().info(f"{recorder.writer.message_count} messages in {self._p.output}")
        named = self._p.topics or (signal("reference_position").topic,)
        if silent := [name for name in named if self.resolve_topic_name(name) not in self._begun]:
            needed = "" if self._p.topics else ", without which a recording cannot be compared with a model"
            self.get_logger().warning(f"no message came on {' and '.join(silent)}{needed}")


def description(
    hand: Mapping[str, Any], controller: Mapping[str, Any], said: Mapping[str, Any]
) -> dict[str, Any]:
    """Metadata of a recording by what the two nodes of its loop tell of themselves; empty for another hand.

    said  the user's own entries, which stand; but an object's name does not where the hand tells its measures
    A plant is named only where it ran in lock-step in the loop of its own model.
    """
    told = {name: hand[name] for name in ("object", "sensors") if name in hand}
    if LOOP in hand and controller.get(LOOP) == hand[LOOP]:
        of_loop = (("plant", hand), ("control_period", controller))
        told |= {name: source[name] for name, source in of_loop if name in source}
    measured = isinstance(told.get("object"), Mapping) and isinstance(said.get("object"), str)
    return {
        name: entry for name, entry in told.items() if name not in said or (measured and name == "object")
    }


def _never_called(data: bytes) -> None:
    raise AssertionError("the input node is in no executor")


def main() -> None:
    """Run the node."""
    sys.exit(run_node("hannes_bags.recorder_node:RecorderNode"))


if __name__ == "__main__":
    main()
