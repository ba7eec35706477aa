"""Asks a lifecycle node for its state and for transitions."""

from __future__ import annotations

import time
from typing import Any

from hannes_description.errors import HannesError
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.exceptions import InvalidServiceNameException
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node

from .visitor import visit

UP = {"unconfigured": Transition.TRANSITION_CONFIGURE, "inactive": Transition.TRANSITION_ACTIVATE}
DOWN = {"active": Transition.TRANSITION_DEACTIVATE}


def switch(name: str, on: bool | None, timeout: float) -> str:
    """State of the node (active: the motor is on) after it was switched on or off; None only asks.

    Raises HannesError where no such node answers within `timeout` seconds.
    """
    with visit("motor", SingleThreadedExecutor) as (node, executor):
        asked = _Asked(node, executor, name, time.monotonic() + timeout)
        try:
            state = asked.state()
            steps = {} if on is None else UP if on else DOWN
            while state in steps:
                done = asked.change(steps[state])
                state = asked.state()
                if not done:
                    break
            return state
        except InvalidServiceNameException as error:
            raise HannesError(f"'{name}' is no name of a node: {str(error).splitlines()[0]}") from error


class _Asked:
    """The lifecycle services of one node."""

    def __init__(self, node: Node, executor: Executor, name: str, until: float) -> None:
        self._node, self._executor, self._name, self._until = node, executor, name, until

    def state(self) -> str:
        return str(self._call(GetState, "get_state", GetState.Request()).current_state.label)

    def change(self, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self._call(ChangeState, "change_state", request).success)

    def _call(self, kind: Any, service: str, request: Any) -> Any:
        client = self._node.create_client(kind, f"{self._name}/{service}")
        while not client.service_is_ready():
            self._wait()
        answer = client.call_async(request)
        while not answer.done():
            self._wait()
        return answer.result()

    def _wait(self) -> None:
        self._executor.spin_once(timeout_sec=0.05)
        if time.monotonic() > self._until:
            raise HannesError(
                f"No lifecycle node '{self._name}' answers in ROS domain {self._node.context.get_domain_id()}: start "
                "it with `hannes run graph`, or give its name with --node (`hannes nodes` lists what runs)."
            )
