"""What compiled code raises.

A C function made by numba cannot pass an exception on: it hands it to `sys.unraisablehook`, which prints it, returns 0
and is called again at the next step.  So whoever calls one watches: the hook then keeps the first exception of the
calling thread and says so in a flag, which a compiled loop can read.
"""

from __future__ import annotations

import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .effect import NEEDS_PYTHON, reason

_HERE = Path(__file__).parent


class Raised:
    """What was raised while it was watched for.

    flag   int64 (1,): 0, and 1 from the first exception on
    said   one line about that exception
    """

    def __init__(self) -> None:
        self.flag: NDArray[np.int64] = np.zeros(1, dtype=np.int64)
        self.said = ""

    def keep(self, error: BaseException | None) -> None:
        """Note an exception; the first one stays."""
        if self.flag[0] == 0 and error is not None:
            self.flag[0] = 1
            self.said = _line(error)


class _Watching(threading.local):
    raised: Raised | None = None


_watching = _Watching()
_before: Callable[[Any], Any] = sys.__unraisablehook__
_setting = threading.Lock()


def _hook(unraisable: Any) -> None:
    raised = _watching.raised
    if raised is None or "numba" not in str(unraisable.object):
        _before(unraisable)
    else:
        raised.keep(unraisable.exc_value)


@contextmanager
def watched() -> Iterator[Raised]:
    """Keep what compiled code raises in this thread meanwhile."""
    global _before
    if sys.unraisablehook is not _hook:
        with _setting:
            # of two threads that come here one sets it, or the hook before it would be the hook itself
            if sys.unraisablehook is not _hook:
                _before, sys.unraisablehook = sys.unraisablehook, _hook
    outer, raised = _watching.raised, Raised()
    _watching.raised = raised
    try:
        yield raised
    finally:
        _watching.raised = outer


def _line(error: BaseException) -> str:
    if str(error).startswith("missing Environment"):
        return f"it {NEEDS_PYTHON}"
    # numba gives the line of a `raise`, and of other exceptions that of the caller at most.
    frames = [f for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).parent != _HERE]
    where = f" ({frames[0].filename}, line {frames[0].lineno})" if frames else ""
    return f"{reason(error)}{where}"
