"""Each topic has one source: who tells of a second one, whose messages mix with those of the first, and of one whom
nobody hears, since its messages are of another type or may get lost."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy

from .topics import CLOCK_TOPIC, CLOCK_TYPE, signal

_LOG_S = 30.0


class Sources:
    """Counts the publishers of the inputs of a node.

    names  signals that the node hears, or CLOCK_TOPIC
    rule   what holds for them, the end of the report
    A node that was killed counts until the middleware forgets it, some 20 s later.
    """

    def __init__(self, node: Node, *names: str, rule: str = "end all but one") -> None:
        self._node, self._names, self._rule = node, names, rule

    def count(self, name: str) -> int:
        """How many publishers the topic of that signal has."""
        return self._node.count_publishers(self._node.resolve_topic_name(_topic(name)))

    def mixed(self) -> bool:
        """Whether an input has more than one publisher."""
        return any(self.count(name) > 1 for name in self._names)

    def several(self) -> str | None:
        """What to report of inputs with several publishers, or one who is not heard; None if all is well."""
        counts = {name: self.count(name) for name in self._names}
        mixed = [f"{n} publishers of {_topic(name)}" for name, n in counts.items() if n > 1]
        wrong = [text for name, n in counts.items() if n for text in self._unheard(name)]
        if not (mixed or wrong):
            return None
        text = "; ".join([*wrong, *([f"{', '.join(mixed)}; {self._rule}"] if mixed else [])])
        self._node.get_logger().error(text, throttle_duration_sec=_LOG_S)
        return text

    def _unheard(self, name: str) -> list[str]:
        """Why a publisher is not heard: the type of its messages, or a best-effort one where every message counts."""
        topic, wanted = _topic(name), CLOCK_TYPE if name == CLOCK_TOPIC else signal(name).type
        out = []
        for info in self._node.get_publishers_info_by_topic(self._node.resolve_topic_name(topic)):
            said = f"{topic} is published by {info.node_name}"
            if info.topic_type != wanted:
                out.append(f"{said} as {info.topic_type}, which is not heard: it must be {wanted}")
            elif info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT and name != CLOCK_TOPIC:
                out.append(
                    f"{said} as best effort (SensorDataQoS), which is not heard: publish it reliable (depth 10)"
                )
        return out

    def surplus(self, name: str) -> str:
        """The error of a lock-step whose messages no longer belong together, because of that signal's topic."""
        count = self.count(name)
        return (
            f"{signal(name).topic} has more messages than the ticks need, and {count} "
            f"publisher{'' if count == 1 else 's'}. In lock-step it has one, which answers each tick once: end the "
            "others (a bag that is played, ros2 topic pub, a second graph; a node that was killed counts for 20 s), "
            "give every node clock:=lockstep and the same rate and period, and start the graph again."
        )


def _topic(name: str) -> str:
    return name if name == CLOCK_TOPIC else signal(name).topic
