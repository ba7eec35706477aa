"""The main of every node: start, spin, end quietly on SIGINT and SIGTERM, one line for a mistake in the input.

Only the standard library is imported at the top, so that signals are handled before the slow imports begin.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from hannes_description.errors import HannesError

if TYPE_CHECKING:
    from rclpy.context import Context
    from rclpy.executors import Executor
    from rclpy.node import Node

USAGE_ERROR = 2
_SPIN_S = 0.5


def run_node(*names: str, executor: str = "events", argv: Sequence[str] | None = None) -> int:
    """Run nodes in this process until they are done or a signal ends them; the exit code.

    names     "package.module:Class" of each node; imported here, after signals are safe
    executor  "events" (fast) or "single" (the ordinary single-threaded one)
    A node may have `parameters` (a dataclass class, for --help), `done` (true ends the process) and `stop()`
    (called before it is destroyed). 0 after SIGINT, SIGTERM or the end of the work, 2 after a HannesError.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave_at_once)
    arguments = list(sys.argv if argv is None else argv)
    try:
        return _run(names, executor, arguments)
    except HannesError as error:
        print(f"{os.path.basename(arguments[0])}: {error}", file=sys.stderr, flush=True)
        return USAGE_ERROR


def _leave_at_once(number: int, frame: object) -> None:
    """Before the nodes spin, nothing has been driven or written: there is nothing to put away."""
    os._exit(0)


def _load(name: str) -> Any:
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _run(names: Sequence[str], executor: str, arguments: list[str]) -> int:
    classes = [_load(name) for name in names]
    if {"-h", "--help"} & set(arguments[1:]):
        _help(os.path.basename(arguments[0]), classes)
        return 0
    import rclpy
    from rclpy.executors import ExternalShutdownException

    context, nodes = _init(arguments), []
    try:
        spinner = _executor(executor, context)
        for cls in classes:
            nodes.append(_create(cls))
            spinner.add_node(nodes[-1])
        for number in (signal.SIGINT, signal.SIGTERM):
            # From here on rclpy's own handler shuts the context down, and the loop below sees it.
            signal.signal(number, signal.SIG_IGN)
        rclpy.signals.uninstall_signal_handlers()
        rclpy.signals.install_signal_handlers(rclpy.signals.SignalHandlerOptions.ALL)
        while context.ok() and not any(getattr(node, "done", False) for node in nodes):
            spinner.spin_once(_SPIN_S)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        for node in nodes:
            if hasattr(node, "stop"):
                node.stop()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    failed = [node.failure for node in nodes if getattr(node, "failure", None)]
    if failed:
        raise HannesError(str(failed[0]))
    return 0
