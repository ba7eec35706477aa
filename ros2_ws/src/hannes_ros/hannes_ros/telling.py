"""What a node of a simulated loop tells of itself, for the metadata of a recording: a read-only parameter.

A driver of a real hand has no such parameter, whatever its name, and of it nothing is said.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

from hannes_description.model import Model
from rcl_interfaces.msg import ParameterDescriptor, ParameterType
from rcl_interfaces.srv import GetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future

PARAMETER: Final = "recording_metadata"
LOOP: Final = "loop"
"""Entry of both nodes of a loop: what is the same in both where the one's model is the other's."""
_LIMITS: Final = ("motor.current_limit", "supply.voltage")


def tell(node: Node, entries: Mapping[str, Any]) -> None:
    """Declare what this node says of itself, JSON-like; after `declare`, which refuses it from users."""
    told = ParameterDescriptor(description="what a recorder writes of this node, as JSON", read_only=True)
    node.declare_parameter(PARAMETER, json.dumps(entries), told, ignore_override=True)


def loop_of(model: Model) -> dict[str, Any]:
    """Control law, gains and limits of a model."""
    gains = [name for name in model.parameters if name.startswith("control.") or name in _LIMITS]
    return {"law": model.controller, **{name: model.parameters.value(name) for name in sorted(gains)}}


class Told:
    """Asks who publishes some topics what they tell of themselves; for the thread of the node's executor."""

    def __init__(self, node: Node, *topics: str) -> None:
        self._node, self._topics = node, topics
        self._asked: dict[str, dict[bytes, Future | None]] = {topic: {} for topic in topics}
        self._clients: dict[str, Client] = {}

    def look(self) -> None:
        """Ask whoever is new."""
        for topic in self._topics:
            asked = self._asked[topic]
            for info in self._node.get_publishers_info_by_topic(topic):
                who = bytes(info.endpoint_gid)
                if asked.get(who) is None:
                    asked[who] = self._ask(f"{info.node_namespace.rstrip('/')}/{info.node_name}")

    def _ask(self, name: str) -> Future | None:
        """The answer to come; None where nobody of that name can be asked yet."""
        if not name.startswith("/"):  # the middleware does not know it yet
            return None
        if name not in self._clients:
            self._clients[name] = self._node.create_client(GetParameters, f"{name}/get_parameters")
        client = self._clients[name]
        return (
            client.call_async(GetParameters.Request(names=[PARAMETER])) if client.service_is_ready() else None
        )

    def of(self, topic: str) -> dict[str, Any]:
        """What the one who published the topic since the first look told; empty for several, and who tells nothing."""
        futures = list(self._asked[topic].values())
        if len(futures) != 1 or futures[0] is None or not futures[0].done() or futures[0].exception():
            return {}
        values = futures[0].result().values
        if not values or values[0].type != ParameterType.PARAMETER_STRING:
            return {}
        try:
            told = json.loads(values[0].string_value)
        except ValueError:
            return {}  # a parameter of that name that is not this one
        return told if isinstance(told, dict) else {}
