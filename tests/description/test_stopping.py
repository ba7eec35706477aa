"""The end of a command whose workers were stopped."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

BUSY = """
import importlib, threading, time
from joblib import Parallel, delayed
from joblib.externals.loky import get_reusable_executor
from hannes_description.stopping import end_after_feeders

queues, locks = (importlib.import_module(f"joblib.externals.loky.backend.{n}") for n in ("queues", "synchronize"))
feed, tracker = queues.Queue._feed, locks.resource_tracker


class Slow:
    register = staticmethod(tracker.register)

    @staticmethod
    def unregister(name, kind):
        if threading.current_thread().name == "QueueFeederThread":
            time.sleep(0.5)
        tracker.unregister(name, kind)


def last_to_hold(*given):
    try:
        feed(*given)
    finally:
        time.sleep(0.02)


queues.Queue._feed = staticmethod(last_to_hold)
locks.resource_tracker = Slow
if __name__ == "__main__":
    end_after_feeders()
    assert sum(Parallel(n_jobs=2)(delayed(abs)(-k) for k in range(4))) == 6
    get_reusable_executor(reuse=True).shutdown(wait=True, kill_workers=True)
    time.sleep(0.1)
"""
"""A machine so busy that the thread which feeds the workers is the last that holds their locks, and slow."""


def test_the_end_waits_for_the_thread_that_fed_the_workers(tmp_path: Path) -> None:
    script = tmp_path / "busy.py"
    script.write_text(BUSY)
    run = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60)
    assert run.returncode == 0 and not run.stderr, run.stderr
