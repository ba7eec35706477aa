"""Child processes that start together and stop together: SIGINT, then SIGTERM, then SIGKILL."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import FrameType, TracebackType

from hannes_description.errors import HannesError
from hannes_ros.early import ending_signals

GRACE_SIGINT = 5.0
"""s that a process has after SIGINT before it gets SIGTERM (upstream launch: 5 s)."""
GRACE_SIGTERM = 5.0
"""s after SIGTERM before SIGKILL (upstream launch: 5 s)."""
POLL = 0.05
"""s between two looks at the processes."""

QUIET_FROM_THE_START = (
    "import os, signal, sys\n"
    "for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):\n"
    "    if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:\n"
    "        signal.signal(number, lambda *_: os._exit(0))\n"
    "signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])\n"
)
"""What the code of `python -c` begins with so that a signal during its imports ends it as quietly as a later one.

A `ProcessGroup` holds SIGINT back from such a program until then: of its start Python itself prints a traceback."""


@dataclass
class ProcessGroup:
    """Processes by name, each in a process group of its own so that Ctrl-C reaches them only through `stop`.

    Use as a context manager: whatever happens inside, no process is left behind; where this process is killed, the
    kernel sends them SIGINT.
    """

    say: Callable[[str], None]
    environment: Mapping[str, str] | None = None
    _children: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def __enter__(self) -> ProcessGroup:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def start(self, name: str, command: Sequence[str]) -> None:
        """Start one process; HannesError if its program cannot be run."""
        if name in self._children:
            raise HannesError(f"Two processes are called '{name}'; give each node its own name.")
        waits = list(command[1:2]) == ["-c"] and command[2].startswith(QUIET_FROM_THE_START)
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, [])
        try:
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT] if waits else [])
            self._children[name] = subprocess.Popen(
                command,
                env=None if self.environment is None else dict(self.environment),
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                preexec_fn=partial(_end_with, os.getpid()),
            )
        except OSError as error:
            raise HannesError(f"Cannot start '{name}' ({command[0]}): {error.strerror}.") from error
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        self.say(f"[{name}] started, pid {self._children[name].pid}")

    @property
    def running(self) -> list[str]:
        return [name for name, child in self._children.items() if child.poll() is None]

    @property
    def exit_codes(self) -> dict[str, int]:
        """Of those that have ended; a negative number is the signal that ended it."""
        return {name: child.returncode for name, child in self._children.items() if child.poll() is not None}

    def wait(self, until: Callable[[dict[str, int]], bool], timeout: float | None = None) -> bool:
        """Wait until `until(exit_codes)` is true or nothing runs any more; False if `timeout` (s) passed first."""
        end = None if timeout is None else time.monotonic() + timeout
        while self.running and not until(self.exit_codes):
            if end is not None and time.monotonic() >= end:
                return False
            time.sleep(POLL)
        return True

    def stop(self) -> dict[str, int]:
        """End what still runs, politely first; the exit codes of all."""
        for number, grace in (
            (signal.SIGINT, GRACE_SIGINT),
            (signal.SIGTERM, GRACE_SIGTERM),
            (signal.SIGKILL, 5.0),
        ):
            waiting = self.running
            if not waiting:
                break
            for name in waiting:
                if number != signal.SIGINT:
                    self.say(f"[{name}] still runs; {number.name}")
                self._signal(name, number)
            self.wait(lambda codes: False, timeout=grace)
        for name, code in self.exit_codes.items():
            if code not in (0, -signal.SIGINT):
                self.say(f"[{name}] ended with exit code {code}")
        return self.exit_codes

    def _signal(self, name: str, number: int) -> None:
        try:
            os.killpg(self._children[name].pid, number)
        except ProcessLookupError:
            return  # it has just ended by itself


_PR_SET_PDEATHSIG = 1
# looked up here: between fork and exec nothing may be
_prctl = getattr(ctypes.CDLL(None), "prctl", None)
_SIGINT = int(signal.SIGINT)


def _end_with(parent: int) -> None:
    """In a child, before its program begins: SIGINT when the parent dies (Linux; elsewhere nothing happens)."""
    if _prctl is not None:
        _prctl(_PR_SET_PDEATHSIG, _SIGINT, 0, 0, 0)
        if os.getppid() != parent:
            os._exit(0)  # it died before


class Interrupted(Exception):
    """SIGINT or SIGTERM came, or the terminal was closed."""


def raise_on_signals() -> None:
    """Let SIGINT, SIGTERM and SIGHUP raise Interrupted in the main thread, once; others are ignored while stopping.

    A SIGHUP that is ignored (`nohup`) stays so.
    """
    numbers = ending_signals()

    def handler(number: int, frame: FrameType | None) -> None:
        for each in numbers:
            signal.signal(each, signal.SIG_IGN)
        if number == signal.SIGHUP:
            # Nobody reads any more, and a write to a closed terminal is an error in the midst of stopping.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            for stream in (1, 2):
                if os.isatty(stream):
                    os.dup2(nowhere, stream)
        raise Interrupted(signal.Signals(number).name)

    for number in numbers:
        signal.signal(number, handler)
