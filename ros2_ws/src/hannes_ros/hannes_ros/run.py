"""The main of every node: start, spin, end quietly on SIGINT, SIGTERM and SIGHUP, one line for a mistake in the input.

Only the standard library is imported at the top, so that signals are handled before the slow imports begin.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
from collections.abc import Sequence
from time import monotonic
from typing import TYPE_CHECKING, Any

from hannes_description.errors import HannesError

from .early import ending_signals, leave_at_once
from .leave import leave_within

if TYPE_CHECKING:
    from rclpy.context import Context
    from rclpy.executors import Executor
    from rclpy.node import Node

USAGE_ERROR = 2
# A signal is noticed when spin_once returns.
_SPIN_S = 0.1
# A message that was dropped on the way is sent again after a heartbeat: 0.02 s later with the project's profile of Fast
# DDS, 3 s with its own.
_DELIVER_S = 4.0
# Destroying a node takes milliseconds, but Fast DDS 2.14 may wait in it for ever for a thread of its own that has just
# heard of another node (DomainParticipant::set_listener; once in 450 nodes, five of which started and ended at a time).
_LEAVE_S = 4.0


def run_node(*names: str, executor: str = "events", argv: Sequence[str] | None = None) -> int:
    """Run nodes in this process until they are done or a signal ends them; the exit code.

    names     "package.module:Class" of each node; imported here, after signals are safe
    executor  "events" (fast) or "single" (the ordinary single-threaded one)
    Each class is called with `cli_args` and has `node_name` and `parameters` (a dataclass, for --help); its nodes have
    `done` (true ends the process), `failure` (why) and `stop()` (called before it is destroyed).
    0 after SIGINT, SIGTERM, SIGHUP or the end of the work, 2 after a HannesError or a failure.
    """
    for number in ending_signals():
        signal.signal(number, leave_at_once)
    arguments = list(sys.argv if argv is None else argv)
    try:
        return _run(names, executor, arguments)
    except HannesError as error:
        return _refused(arguments, error)


def _refused(arguments: Sequence[str], error: object) -> int:
    print(f"{os.path.basename(arguments[0])}: {error}", file=sys.stderr, flush=True)
    return USAGE_ERROR


def _load(name: str) -> Any:
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _run(names: Sequence[str], executor: str, arguments: list[str]) -> int:
    classes = [_load(name) for name in names]
    if {"-h", "--help"} & set(arguments[1:]):
        _help(os.path.basename(arguments[0]), classes)
        return 0
    import rclpy

    _refuse_bare_parameters(arguments)
    arguments, local = _node_rules(arguments, [cls.node_name for cls in classes])
    context = _init(arguments)
    nodes: list[Any] = []
    error: HannesError | None = None
    code = 1  # of what is no HannesError
    try:
        spinner = _executor(executor, context)
        for cls in classes:
            nodes.append(_create(cls, local[cls.node_name]))
            spinner.add_node(nodes[-1])
            _tell_unread_sections(arguments, nodes[-1])
        stop = _StopOnSignal()
        while context.ok() and not stop.asked and not any(node.done for node in nodes):
            spinner.spin_once(_SPIN_S)
        code = 0
    except HannesError as raised:
        error = (
            raised  # kept: with it goes a node that was made in part, which may take for ever (see _LEAVE_S)
        )
    finally:
        for node in reversed(nodes):
            node.stop()
        _deliver(nodes)
        failure = error or next((node.failure for node in nodes if node.failure), None)
        if failure:
            code = _refused(arguments, failure)
        leave_within(_LEAVE_S, code)
        for node in reversed(nodes):
            node.destroy_node()
        rclpy.try_shutdown(context=context)
    return code


def _deliver(nodes: Sequence[Any]) -> None:
    """Let the last messages reach those who are there, a recorder for one; a dead one holds this up for a while."""
    from rclpy.duration import Duration

    end = monotonic() + _DELIVER_S
    for node in nodes:
        for publisher in node.publishers:
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, end - monotonic())))


class _StopOnSignal:
    """Turns what ends a node into a flag, so that no callback is interrupted halfway."""

    def __init__(self) -> None:
        self.asked = False
        for number in ending_signals():
            signal.signal(number, self._ask)

    def _ask(self, number: int, frame: object) -> None:
        self.asked = True


def _init(arguments: list[str]) -> Context:
    import rclpy
    from rclpy.signals import SignalHandlerOptions
    from rclpy.utilities import get_default_context, remove_ros_args

    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        others = remove_ros_args(arguments)[1:]
    except RuntimeError as error:  # all that rclpy raises for a command line or a parameter file
        raise HannesError(f"ROS arguments are not valid: {_first_line(error)}") from None
    if others:
        raise HannesError(
            f"Unknown argument '{others[0]}'; give parameters as '--ros-args -p name:=value' "
            "(--help lists them)."
        )
    return get_default_context()


def _refuse_bare_parameters(arguments: list[str]) -> None:
    """Refuse `name:=value` outside --ros-args, but for a topic or a node's name.

    rcl takes any for an old way to rename, and a parameter that was meant would be ignored.
    """
    from hannes_description.signals import SIGNALS

    topics = {signal.topic for signal in SIGNALS.values()}
    ours = True
    for word in arguments[1:]:
        ours = word == "--" if word in ("--", "--ros-args") else ours
        name, renames, _ = word.partition(":=")
        name = name.rpartition(":")[2]
        if ours and renames and not (name.startswith("__") or "/" in name or name in topics):
            raise HannesError(
                f"'{word}' is no parameter outside --ros-args; give it as '--ros-args -p {word}' (--help lists the "
                "parameters)."
            )


def _node_rules(arguments: list[str], names: Sequence[str]) -> tuple[list[str], dict[str, list[str]]]:
    """Take `-p node:name:=value` out of the arguments, as arguments of that node alone.

    rcl compares `node` with the fully qualified name, which its command line cannot express for a node in a
    namespace, and ignores the rule without a word when it does not fit.
    """
    rest: list[str] = []
    local: dict[str, list[str]] = {name: [] for name in names}
    position = 0
    while position < len(arguments):
        argument = arguments[position]
        rule = (
            arguments[position + 1] if argument in ("-p", "--param") and position + 1 < len(arguments) else ""
        )
        node, colon, parameter = rule.partition(":=")[0].partition(":")
        if colon and "/" not in node:
            if node not in local:
                raise HannesError(
                    f"There is no node '{node}' in this process ('{argument} {rule}'); there "
                    f"is {', '.join(names)}."
                )
            local[node] += ["--ros-args", "-p", parameter + rule[rule.index(":=") :], "--"]
            position += 2
        else:
            rest.append(argument)
            position += 1
    return rest, local


def _create(cls: Any, cli_args: list[str]) -> Node:
    from rclpy.exceptions import NameValidationException
    from rclpy.impl.implementation_singleton import rclpy_implementation

    try:
        node: Node = cls(cli_args)
        return node
    except (rclpy_implementation.RCLError, NameValidationException) as error:
        raise HannesError(f"The node cannot start: {_first_line(error)}") from None


def _tell_unread_sections(arguments: Sequence[str], node: Node) -> None:
    from .parameter_files import files_given, unread_sections

    own = node.get_fully_qualified_name()
    for file in files_given(arguments):
        for section in unread_sections(file, own):
            node.get_logger().warning(
                f"{file}: the section '{section}:' is not read, for this node is {own}: name it '{own}:', or "
                f"'/**/{node.get_name()}:' for any namespace"
            )


def _executor(name: str, context: Context) -> Executor:
    if name == "events":
        from rclpy.experimental import EventsExecutor

        return EventsExecutor(context=context)
    if name == "single":
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor(context=context)
    raise HannesError(f"Executor '{name}' does not exist; valid are events, single.")


def _first_line(error: BaseException) -> str:
    return str(error).strip().split("\n")[0].split(", at ")[0]


def _help(program: str, classes: Sequence[Any]) -> None:
    from .node import DEFAULT_NAMESPACE
    from .node_parameters import help_text

    node = classes[0].node_name
    print(f"usage: {program} [--ros-args -p name:=value -r old:=new --params-file FILE.yaml ...]")
    print(
        f"FILE.yaml has a section '/{DEFAULT_NAMESPACE}/{node}:' (or '/**/{node}:' in any namespace, '/**:' for all "
        f"nodes)\nwith 'ros__parameters:' in it; a section of another name, such as '{node}:', is not read."
    )
    if len(classes) > 1:
        print(f"-p {node}:NAME:=VALUE gives a parameter to one of the nodes alone.")
    for cls in classes:
        title = (cls.__doc__ or "").strip().split("\n")[0]
        print(f"\n{cls.node_name}: {title}\n{help_text(cls.parameters)}")
