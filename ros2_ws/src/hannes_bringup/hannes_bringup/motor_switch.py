"""Asks a lifecycle node for its state and for transitions."""

from __future__ import annotations

import time
from typing import Any

from hannes_description.errors import HannesError
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.client import Client
from rclpy.exceptions import InvalidServiceNameException
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node

from .visitor import visit

UP = {"unconfigured": Transition.TRANSITION_CONFIGURE, "inactive": Transition.TRANSITION_ACTIVATE}
DOWN = {"active": Transition.TRANSITION_DEACTIVATE}
_GOALS = {
    Transition.TRANSITION_CONFIGURE: "inactive",
    Transition.TRANSITION_ACTIVATE: "active",
    Transition.TRANSITION_DEACTIVATE: "inactive",
}
_PATIENCE_S = 1.0
"""How long an answer may take before the request counts as lost.

Fast DDS drops the answer to a client of which the server knows the writer but, 100 ms later, not yet the reader
(ros2/rmw_fastrtps, pull request 390).
"""


def switch(name: str, on: bool | None, timeout: float) -> str:
    """State of the node (active: the motor is on) after it was switched on or off; None only asks.

    A transition that somebody else made in the meantime counts as made.
    Raises HannesError where no such node answers within `timeout` seconds.
    """
    with visit("motor", SingleThreadedExecutor) as (node, executor):
        asked = Lifecycle(node, executor, name, time.monotonic() + timeout)
        state = asked.state()
        steps = {} if on is None else UP if on else DOWN
        while state in steps:
            done, before = asked.change(steps[state]), state
            state = asked.state()
            if not done and state == before:
                break
        return state


class Lifecycle:
    """The lifecycle services of the node `name`, asked by `node`, which `executor` spins.

    `until` is a time of the monotonic clock (s); each call raises HannesError if no answer came by then,
    and so does the construction where the name is none.
    """

    def __init__(self, node: Node, executor: Executor, name: str, until: float) -> None:
        self._node, self._executor, self._name, self._until = node, executor, name, until
        try:
            self._states = node.create_client(GetState, f"{name}/get_state")
            self._changes = node.create_client(ChangeState, f"{name}/change_state")
        except InvalidServiceNameException as error:
            raise HannesError(f"'{name}' is no name of a node: {str(error).splitlines()[0]}") from error

    def state(self) -> str:
        """Label of the node's state; asked again until it answers."""
        while (answer := self._call(self._states, GetState.Request())) is None:
            pass
        return str(answer.current_state.label)

    def change(self, transition: int) -> bool:
        """Whether the node made the transition; a lost answer is made up for by its state."""
        request = ChangeState.Request(transition=Transition(id=transition))
        while (answer := self._call(self._changes, request)) is None:
            if self.state() == _GOALS.get(transition):
                return True
        return bool(answer.success)

    def _call(self, client: Client, request: Any) -> Any:
        """The answer; None if none came in time."""
        while not client.service_is_ready():
            self._wait()
        answer, patience = client.call_async(request), time.monotonic() + _PATIENCE_S
        while not answer.done():
            if time.monotonic() > patience:
                client.remove_pending_request(answer)
                return None
            self._wait()
        return answer.result()

    def _wait(self) -> None:
        self._executor.spin_once(timeout_sec=0.05)
        if time.monotonic() > self._until:
            raise HannesError(
                f"No lifecycle node '{self._name}' answers in ROS domain {self._node.context.get_domain_id()}: start "
                "it with `hannes run graph`, or give its name with --node (`hannes nodes` lists what runs)."
            )
