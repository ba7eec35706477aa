"""A peer for the node under test, and the nodes as processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from time import monotonic, sleep
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from hannes_ros import topics
from patience import PATIENCE
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

PROGRAMS = {
    "hand_sim": "hannes_sim.sim_node",
    "motor_controller": "hannes_control.motor_controller_node",
    "emg_source": "hannes_control.emg_source_node",
    "emg_reference": "hannes_control.emg_reference_node",
    "composed": "hannes_bringup.composed_node",
}

PATIENT = {"command_timeout_ms": 10_000.0}
"""A hand_sim that repeats no reading to a peer that is no newcomer but may be slow."""


class NodeProcess:
    """One node as a process of its own, its output kept."""

    def __init__(self, name: str, *arguments: str, **parameters: object) -> None:
        rules = [item for key, value in parameters.items() for item in ("-p", f"{key}:={_text(value)}")]
        self.process = subprocess.Popen(
            [sys.executable, "-m", PROGRAMS[name], *arguments, *(["--ros-args", *rules] if rules else [])],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=dict(os.environ),
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line)

    @property
    def output(self) -> str:
        return "".join(self.lines)

    def send(self, number: int) -> None:
        self.process.send_signal(number)

    def wait(self, timeout: float = PATIENCE) -> int:
        try:
            code = self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running after {timeout} s: {self.output}") from None
        self._reader.join(timeout=PATIENCE)
        return code

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.terminate()
            try:
                self.process.wait(5.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()


def kept_waiting(before: Mapping[str, str], after: Mapping[str, str], period: float = 0.001) -> float:
    """Time (s) between two reports of a node in which a busy machine did not let its loop run."""
    return (int(after["missed_cycles"]) - int(before["missed_cycles"])) * period


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


@contextmanager
def processes(*nodes: NodeProcess) -> Iterator[tuple[NodeProcess, ...]]:
    """End the processes whatever happens; show what they printed if the test fails."""
    try:
        yield nodes
    except BaseException:
        for node in nodes:
            print(node.output)
        raise
    finally:
        for node in nodes:
            node.end()


class Peer:
    """A node in the test that publishes and hears signals; messages are kept serialised, in order."""

    def __init__(self, context: Context, namespace: str = "hannes") -> None:
        self.node = Node("peer", context=context, namespace=namespace, use_global_arguments=False)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.heard: dict[str, list[bytes]] = {}
        self.diagnostics: list[Any] = []
        self._publishers: dict[str, Any] = {}

    def hear(self, *names: str, callback: Callable[[bytes], None] | None = None) -> None:
        for name in names:
            kept = self.heard.setdefault(name, [])
            topics.subscription(self.node, name, callback or kept.append)

    def hear_diagnostics(self) -> None:
        self.node.create_subscription(
            DiagnosticArray,
            topics.DIAGNOSTICS_TOPIC,
            lambda m: self.diagnostics.extend(m.status),
            topics.DIAGNOSTICS_QOS,
        )

    def publisher(self, name: str) -> Any:
        if name not in self._publishers:
            self._publishers[name] = topics.publisher(self.node, name)
        return self._publishers[name]

    def say(self, name: str, data: bytes) -> None:
        self.publisher(name).publish(data)

    def until(self, condition: Callable[[], bool], timeout: float = PATIENCE, what: str = "") -> None:
        """Spin until the condition holds."""
        end = monotonic() + timeout
        while not condition():
            assert monotonic() < end, f"not within {timeout} s: {what or condition}"
            self.executor.spin_once(timeout_sec=0.05)

    def spin(self, seconds: float) -> None:
        end = monotonic() + seconds
        while monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)

    def matched(self, name: str, count: int = 1) -> None:
        """Wait until the signal's publisher here has that many subscribers."""
        publisher = self.publisher(name)
        self.until(
            lambda: publisher.get_subscription_count() >= count, what=f"{count} subscriber(s) of {name}"
        )
        sleep(0.05)

    def status(self, node: str) -> Mapping[str, str]:
        """Latest diagnostics of a node as a dict, with its `message`; empty before the first."""
        for status in reversed(self.diagnostics):
            if status.name.endswith(node):
                return {
                    "message": status.message,
                    "level": str(status.level[0]),
                    **{pair.key: pair.value for pair in status.values},
                }
        return {}

    def until_status(
        self, node: str, condition: Callable[[Mapping[str, str]], bool], what: str = ""
    ) -> Mapping[str, str]:
        self.until(lambda: bool(self.status(node)) and condition(self.status(node)), what=what)
        return self.status(node)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
