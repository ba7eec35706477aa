"""What every Hannes node has besides rclpy's: an end, a reason for it, and timers of wall time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Protocol

from hannes_description.signals import NAMESPACE
from rclpy.clock import Clock, ClockType
from rclpy.timer import Timer

DEFAULT_NAMESPACE: Final = NAMESPACE.strip("/")
CLOCKS: Final = ("realtime", "lockstep")
CLOCK_HELP: Final = "realtime runs by the clock of the machine, lockstep waits for every message of a tick"


class Host(Protocol):
    """What a part of a node needs of it: its clock, its log, and its end."""

    def get_clock(self) -> Any: ...
    def get_logger(self) -> Any: ...
    def fail(self, error: object) -> None:
        """End the process with this error."""


class HannesNode:
    """Mixin of Node or LifecycleNode; the class is called with the arguments for this node alone (`run.run_node`).

    node_name   the node's name unless it is remapped
    parameters  dataclass of its parameters
    done     the work is finished: the process ends with exit code 0
    failure  why it cannot go on: printed in one line, exit code 2
    """

    node_name: str
    parameters: type
    create_timer: Any
    done = False
    failure: str | None = None

    def fail(self, error: object) -> None:
        """End the process with this error."""
        self.failure, self.done = str(error), True

    def stop(self) -> None:
        """Put away what runs besides the executor; called once, before the node is destroyed."""

    def wall_timer(self, period: float, callback: Callable[[], None]) -> Timer:
        """A timer of `period` s of wall time, even while simulated time stands still."""
        return self.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))
