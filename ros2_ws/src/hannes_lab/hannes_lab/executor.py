"""Where the items of a search are worked on: in this process, in worker processes, or on a Dask cluster.

Every item is a pure function of a search and its arguments, so the results are the same wherever it runs.
"""

from __future__ import annotations

import copy
import functools
import os
import re
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from hannes_description.errors import HannesError
from hannes_description.stopping import end_after_feeders
from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky.process_executor import TerminatedWorkerError

from .cache import Store, code_hash

# joblib replaces a worker whose memory has grown; its items are done by the next one.
warnings.filterwarnings("ignore", message="A worker stopped while some jobs were given", category=UserWarning)
# Ctrl-C is one line; that work under way was lost goes without saying.
warnings.filterwarnings("ignore", message=".*tasks which were still being processed", category=UserWarning)

Work = Callable[..., Any]
"""(shared, key of shared, function, item) -> (result, simulations, failures)"""

ADDRESS = re.compile(r"((tcp|tls|wss?|ucxx?)://)?[^/\s]+:\d+|inproc://\S+")
"""What a Dask client takes as an address; with others it prints a traceback of its own."""

PARENT_S = 1.0
"""How often a worker looks whether the process that started it is still there, in seconds."""

CONNECT_S = 10
"""Seconds in which a Dask scheduler must answer, and have a worker."""


@dataclass
class Executor:
    """Where work is done.

    jobs   processes on this machine
    dask   address of a Dask scheduler, whose workers are used instead
    store  where results are kept; None keeps nothing
    """

    jobs: int = 1
    dask: str | None = None
    store: Store | None = None
    _client: Any = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise HannesError(f"{self.jobs} jobs: at least one process is needed.")
        if self.dask is not None and not ADDRESS.fullmatch(self.dask):
            raise HannesError(f"'{self.dask}' is no address of a Dask scheduler; give it as tcp://HOST:8786.")

    @property
    def serial(self) -> bool:
        """True if the work is done in this process."""
        return self.jobs == 1 and self.dask is None

    def run(self, work: Work, shared: Any, key: str, items: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        """(k, work(shared, key, *items[k])) for every item, as they are done."""
        code = code_hash() if self.dask else None
        parent = None if self.dask else os.getpid()
        end_after_feeders()
        tasks = [delayed(_numbered)(k, code, parent, work, shared, key, item) for k, item in enumerate(items)]
        options = {"backend": "dask", "client": self.client()} if self.dask else {"backend": "loky"}
        with parallel_config(**options):
            parallel = Parallel(
                n_jobs=-1 if self.dask else self.jobs,
                return_as="generator_unordered",
                batch_size=1,  # type: ignore[arg-type]  # its stubs know "auto" only
            )
            try:
                with _deaf_workers():
                    results = parallel(tasks)
                yield from results
            except TerminatedWorkerError as error:
                raise HannesError(
                    "A worker process was killed, most likely for want of memory; try fewer --jobs. What was found is "
                    "kept: the same command goes on from there."
                ) from error

    def client(self) -> Any:
        """The connection to the scheduler; raises HannesError where there is none."""
        if self._client is None:
            try:
                from distributed import Client
            except ImportError as error:
                raise HannesError(
                    "--dask needs the libraries of the extra 'cluster': pip install 'hannes_lab[cluster]'."
                ) from error
            try:
                self._client = Client(self.dask, timeout=CONNECT_S, set_as_default=False)
                self._client.wait_for_workers(1, timeout=CONNECT_S)
            except (OSError, ValueError) as error:
                raise HannesError(
                    f"No Dask scheduler with a worker answers at '{self.dask}' ({error}); give its address as "
                    "tcp://HOST:8786."
                ) from error
        return self._client

    def __enter__(self) -> Executor:
        return self

    def __exit__(self, *_: object) -> None:
        """End the connection to the scheduler."""
        if self._client is not None:
            self._client.close()
            self._client = None


@contextmanager
def _deaf_workers() -> Iterator[None]:
    """Processes that start in this block ignore Ctrl-C and SIGTERM: they end with this process, and say nothing.

    For those milliseconds this process ignores Ctrl-C too, and SIGTERM waits: what is ignored or held back is what its
    children inherit.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _numbered(
    number: int,
    code: str | None,
    parent: int | None,
    work: Work,
    shared: Any,
    key: str,
    item: tuple[Any, ...],
) -> Any:
    if parent is not None:
        _end_with(parent)
    if code is not None and code != code_hash():
        raise HannesError(
            "A worker has other sources of hannes or other versions of its libraries than this process: install the "
            "same on all machines."
        )
    return number, work(shared, key, *item)


@functools.cache
def _end_with(parent: int) -> None:
    """Let a worker process end soon after the process that started it, were that killed.

    Else it would go on to wait for work, with its memory and with the output that it inherited held open.
    """
    if os.getpid() == parent:
        return  # joblib works where it is called if it may start no process

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="parent").start()


class Held(threading.local):
    """What a worker built last, one for each of its threads: a plant must not be stepped by two of them."""

    key = ""
    thing: Any = None

    def get(self, key: str, build: Callable[[], Any]) -> Any:
        if self.key != key:
            self.thing = build()
            self.key = key
        return self.thing


def own(rig: Any) -> Any:
    """A rig of one's own: workers that are threads of one process are handed the same object."""
    return copy.deepcopy(rig)
