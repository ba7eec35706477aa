"""player: plays a bag onto its topics, with /clock."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from time import monotonic

from hannes_description.errors import HannesError
from hannes_ros import topics
from hannes_ros.convert import clock_bytes
from hannes_ros.diagnostics import SAY_AGAIN_S
from hannes_ros.node import DEFAULT_NAMESPACE, HannesNode
from hannes_ros.node_parameters import declare, parameter
from hannes_ros.run import run_node
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from .player import Playlist, Schedule, load_playlist
from .recorder_node import message_class
from .storage import TopicEntry
from .writing import Qos

_STEP_S = 0.001
_CLOCK_S = 0.01
_FAST_TICKS = 5
"""Distinct times a step in fast mode, so 5000 a second. DDS has no back pressure on readers that keep the last n, and
acknowledgements come with heartbeats, every 3 s: what bounds the speed is what a Python subscriber can take."""
_TICKS_AT_ONCE = 1000
_LEAD = 200
"""Commands by which the player may be ahead of a hand in lock-step, which answers each once: it keeps a thousand."""
_STOOD_S = 1.0
"""A hand that has stood for so long has answered what it got, though not all of its /clock was heard."""
_LEAST_PATIENCE_S = 5.0
_ARRIVAL_S = 3.5
_LOOK_S = 0.1
_QUIET_S, _LONGEST_S = 0.5, 3.0
"""Others are known when the graph has not changed for the first time, or after the second at the latest."""
_DEPTH = 2000
_OF_EVERY_NODE = ("/rosout", "/parameter_events")
"""What each ROS node publishes."""


@dataclass(frozen=True)
class PlayerParameters:
    """ROS parameters of player."""

    bag: str = parameter("", "the bag to play: a folder, a .mcap or a .db3 file")
    rate: float = parameter(1.0, "played seconds in a second", lower=1e-3, upper=1e3)
    fast: bool = parameter(
        False, "5000 ticks a second, or as fast as a hand in lock-step answers, instead of at `rate`"
    )
    topics: tuple[str, ...] = parameter((), "topics to play; empty for all but /diagnostics")
    beside: bool = parameter(False, "play topics too that another node publishes")
    start: float = parameter(0.0, "time to skip at the beginning", lower=0.0, upper=1e6, unit="s")
    loop: bool = parameter(False, "begin again at the end; simulated time goes on")
    clock: bool = parameter(True, "publish /clock with the bag's times")
    subscribers: int = parameter(
        0, "subscribers that each played topic must have before the first message", lower=0, upper=100
    )
    wait: float = parameter(10.0, "how long to wait for them", lower=0.0, upper=1e4, unit="s")

    def __post_init__(self) -> None:
        if not self.bag:
            raise HannesError("Parameter 'bag' is empty; give the bag to play: -p bag:=FOLDER.")


class PlayerNode(HannesNode, Node):
    """Publishes a bag's messages as they lie in it, serialised.

    A topic has one source: where another node publishes a topic of the bag too, it refuses to begin.
    """

    node_name = "player"
    parameters = PlayerParameters

    def __init__(self, cli_args: list[str] | None = None) -> None:
        super().__init__(self.node_name, namespace=DEFAULT_NAMESPACE, cli_args=cli_args)
        self._p = p = declare(self, PlayerParameters)
        playlist = self._playable(load_playlist(p.bag, topics=p.topics, start=p.start, clock=not p.clock))
        self._schedule = Schedule(playlist, 0.0 if p.fast else p.rate, loop=p.loop)
        self._topics = playlist.topics
        # A hand in lock-step takes one command for each tick, and tells the time.
        self._voltage = self.resolve_topic_name(topics.signal("motor_voltage").topic)
        played = {entry.name for entry in playlist.topics}
        if p.loop and topics.CLOCK_TOPIC in played:
            raise HannesError(
                f"A bag's own {topics.CLOCK_TOPIC} cannot be played in a loop: time would go back at each round. Leave "
                "it out, and let the player tell the time (clock:=true)."
            )
        self._follows = not p.clock and self._voltage in played and topics.CLOCK_TOPIC not in played
        self._in_step = False
        self._sent = self._answered = 0
        self._rebased_at = -1
        self._answered_at = 0.0
        self._sim_clock: Publisher | None = None
        self._outputs: dict[str, Publisher] = {}
        self._began: float | None = None
        self._opened: float | None = None
        self._looked = self._changed = monotonic()
        self._seen: object = None
        self._clocked = 0.0
        self._count = 0
        self._last_ns = -1
        self._what = (
            f"{len(playlist.entries)} messages on {len(self._topics)} topics, {playlist.duration:.3f} s"
        )
        self.wall_timer(_STEP_S, self._step)
        self.wall_timer(_LOOK_S, self._look)

    def _playable(self, playlist: Playlist) -> Playlist:
        """Without the topics whose type is not installed here, unless they were named."""
        missing = {}
        for entry in playlist.topics:
            try:
                message_class(entry.type)
            except HannesError as error:
                missing[entry.name] = str(error)
        if not missing:
            return playlist
        said = "; ".join(f"{topic}: {why}" for topic, why in missing.items())
        left = playlist.without(missing)
        if self._p.topics or not left.entries:
            raise HannesError(
                f"{said} Install the package of the type, or name other topics (--topic of hannes play)."
            )
        self.get_logger().warning(f"left out: {said}")
        return left

    def _open(self) -> None:
        """Announce what is to be played."""
        # First: who finds another topic, and looks for simulated time, finds this too.
        if self._p.clock:
            self._sim_clock = topics.clock_publisher(self)
        if self._follows:
            topics.clock_subscription(self, self._on_clock)
        self._outputs = {entry.name: self._publisher(entry) for entry in self._topics}
        self._opened = self._changed = monotonic()

    def _publisher(self, entry: TopicEntry) -> Publisher:
        offered = Qos.from_text(entry.offered_qos)
        reliable = offered.reliability != "best_effort"
        latched = offered.durability == "transient_local"
        profile = QoSProfile(
            depth=_DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        return self.create_publisher(message_class(entry.type), entry.name, profile)

    def _step(self) -> None:
        """What is due now."""
        if self.done or not self._ready():
            return
        now = monotonic()
        elapsed = now - (self._began or now)
        at_most = _FAST_TICKS if self._p.fast else _TICKS_AT_ONCE
        if self._in_step:
            at_most = min(at_most, self._room())
            if not at_most and self._schedule.is_due(elapsed):
                self._stands(now)
        ticks = self._schedule.due(elapsed, at_most)
        for stamp_ns, messages in ticks:
            self._tell_time(stamp_ns, now)
            for topic, data in messages:
                self._outputs[topic].publish(data)
                self._sent += topic == self._voltage
            self._count += len(messages)
        if not self._p.fast and now - self._clocked > _CLOCK_S and not self._schedule.done:
            self._tell_time(self._schedule.time_at(elapsed), now)
        if self._schedule.done:
            self.done = True

    def _on_clock(self, data: bytes) -> None:
        """A tick of the hand in lock-step: one command is answered."""
        if self._began is not None:
            self._answered += 1
            self._answered_at = monotonic()

    def _room(self) -> int:
        """How many commands may be sent: more than the hand keeps would be lost without a word."""
        return max(0, self._answered + _LEAD - self._sent)

    def _stands(self, now: float) -> None:
        """The hand stands though it was sent enough: go on once, as some of its /clock may be unheard, then end."""
        since = now - max(self._answered_at, self._began or 0.0)
        if since > _STOOD_S and self._answered > self._rebased_at:
            self._answered = self._rebased_at = self._sent
        elif since > max(self._p.wait, _LEAST_PATIENCE_S):
            self.fail(
                f"The hand that takes {topics.signal('motor_voltage').topic} in lock-step has stood for {since:.0f} s, "
                f"after {self._sent} commands: see `hannes nodes` for what it waits for."
            )

    def _one_in_step(self) -> bool:
        """Whether the node that tells the time is the hand: then it answers commands tick by tick."""
        state = self.resolve_topic_name(topics.signal("encoder_position").topic)
        of_clock, of_state = (
            {(i.node_namespace, i.node_name) for i in self.get_publishers_info_by_topic(name)}
            for name in (topics.CLOCK_TOPIC, state)
        )
        return bool(of_clock & of_state)

    def _ready(self) -> bool:
        """Whether nobody else publishes the topics and each has its subscribers; the time of playing begins then."""
        if self._began is not None:
            return True
        if self._opened is None:
            # Looked for before anything is announced: others would report a second source that never sends.
            if not (self._p.beside or self._settled(self._looked)) or self._refused():
                return False
            self._open()
        assert self._opened is not None
        missing = [
            topic
            for topic, output in self._outputs.items()
            if output.get_subscription_count() < self._p.subscribers
        ]
        if missing:
            if monotonic() - self._opened > self._p.wait:
                self.fail(
                    f"After {self._p.wait:g} s there are not {self._p.subscribers} subscribers of "
                    f"{', '.join(missing)}."
                )
            return False
        if not self._settled(self._opened) or self._refused():
            return False
        self._began = monotonic()
        self.get_logger().info(f"playing {self._what}")
        return True

    def _settled(self, since: float) -> bool:
        """Whether all that is there has been found, since a time of the monotonic clock."""
        now = monotonic()
        return now - max(since, self._changed) >= _QUIET_S or now - since >= _LONGEST_S

    def _look(self) -> None:
        """Whether the graph still changes; while it plays, whether somebody else began to."""
        self._in_step = self._follows and self._one_in_step()
        if self._began is None:
            listeners = [output.get_subscription_count() for output in self._outputs.values()]
            seen = len(self.get_node_names()), listeners, self._others()
            if seen != self._seen:
                self._seen, self._changed = seen, monotonic()
        elif not self._p.beside and (others := self._others()):
            self.get_logger().error(
                f"Another node publishes what is being played: {_listed(others)}; end one of the two.",
                throttle_duration_sec=SAY_AGAIN_S,
            )

    def _refused(self) -> bool:
        """Whether somebody else publishes what is to be played; the node ends then."""
        others = {} if self._p.beside else self._others()
        if others:
            own_time = self._p.clock and topics.CLOCK_TOPIC in others
            clock = " (clock:=false leaves /clock out)" if own_time else ""
            self.fail(
                f"Another node publishes what is to be played: {_listed(others)}. Stop it, name the topics to play "
                f"(--topic of hannes play){clock}, or give --beside (beside:=true) to play all the same."
            )
        return bool(others)

    def _others(self) -> dict[str, list[str]]:
        """By topic that is played: the other nodes that publish it."""
        names = [entry.name for entry in self._topics if entry.name not in _OF_EVERY_NODE]
        others = {}
        for topic in (*names, *([topics.CLOCK_TOPIC] if self._p.clock else [])):
            found = [
                f"{info.node_namespace.rstrip('/')}/{info.node_name}"
                for info in self.get_publishers_info_by_topic(self.resolve_topic_name(topic))
            ]
            if self._opened is not None and (own := self.get_fully_qualified_name()) in found:
                found.remove(own)  # once: another player may have the same name
            if found:
                others[topic] = sorted(found)
        return others

    def _tell_time(self, stamp_ns: int, now: float) -> None:
        if self._sim_clock is not None and stamp_ns > self._last_ns:
            self._sim_clock.publish(clock_bytes(stamp_ns))
            self._last_ns, self._clocked = stamp_ns, now

    def stop(self) -> None:
        """Let the last messages arrive: a lost one is sent again at the next heartbeat, within 3 s."""
        until = monotonic() + _ARRIVAL_S
        for output in self._outputs.values():
            if self._began is not None:
                output.wait_for_all_acked(Duration(seconds=max(0.0, until - monotonic())))
        if self._began is not None:
            self.get_logger().info(f"played {self._count} messages")


def _listed(others: dict[str, list[str]]) -> str:
    """The topics of each node, as text."""
    by_nodes: dict[str, list[str]] = {}
    for topic, nodes in others.items():
        by_nodes.setdefault(", ".join(nodes), []).append(topic)
    return "; ".join(f"{', '.join(names)} by {nodes}" for nodes, names in by_nodes.items())


def main() -> None:
    """Run the node."""
    sys.exit(run_node("hannes_bags.player_node:PlayerNode"))


if __name__ == "__main__":
    main()
