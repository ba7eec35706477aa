"""Imported first by the node modules: a signal during the slow imports ends the node's process quietly.

The imports of rclpy, numba and scipy take about a second, in which Ctrl-C would print a traceback from somewhere inside
them. Only where the running program is a node: importing a node module into another program changes nothing there.
"""

from __future__ import annotations

import os
import signal
import sys

_PROGRAMS = frozenset(
    {
        "hand_sim",
        "motor_controller",
        "emg_reference",
        "emg_source",
        "stiffness_classifier",
        "recorder",
        "player",
        "hannes_composed",
    }
)


def ending_signals() -> tuple[signal.Signals, ...]:
    """What ends a node: Ctrl-C, SIGTERM and a terminal that is closed, which `nohup` lets a node outlive."""
    outlives = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    return (signal.SIGINT, signal.SIGTERM) if outlives else (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def leave_at_once(number: int, frame: object) -> None:
    """Signal handler while nothing has been driven or written yet: there is nothing to put away."""
    os._exit(0)


def _is_node(program: str) -> bool:
    name = os.path.basename(program)
    return name in _PROGRAMS or name.endswith("_node.py")


if sys.argv and _is_node(sys.argv[0]):
    for _number in ending_signals():
        signal.signal(_number, leave_at_once)
