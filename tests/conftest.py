"""What all tests share: a ROS 2 of one's own for each test, and where the outside data are."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from hannes_bringup.environment import apply_ros_environment

# As the hannes command does, and before numpy is imported: sums in one order, the same numbers in every process.
for _library in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_library, "1")

# A script that runs the tests in its background makes all below it deaf to Ctrl-C, of which some tests are.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
# and `nohup` to a terminal that is closed
if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

REPOSITORY = Path(__file__).resolve().parent.parent

# Read by ROS 2 when the first node of the process starts, so set before any test
apply_ros_environment()
os.environ.setdefault("RCUTILS_COLORIZED_OUTPUT", "0")

FIRST_DOMAIN, LAST_DOMAIN = 1, 101
# A process that uses domain d holds this TCP port plus d, below the ports that the kernel hands out
DOMAIN_LOCK_PORT = 24300


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The slow tests, and with them their modules, first: at the end no process waits for another one's."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the repository."""
    return REPOSITORY


@pytest.fixture(scope="session")
def hannes_data() -> Path:
    """The folder of outside data (EMG recordings, the EMPS bench): HANNES_DATA, else ../shared/data."""
    folder = Path(os.environ.get("HANNES_DATA") or REPOSITORY.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no outside data in {folder}; set HANNES_DATA to the folder that holds emg/ and emps/")
    return folder


@pytest.fixture
def ros_domain_id() -> Iterator[int]:
    """A ROS domain id that no other test on this machine uses, held while the test runs."""
    # start at a place of one's own, so that processes seldom try the same
    span = LAST_DOMAIN - FIRST_DOMAIN + 1
    for step in range(span):
        domain = FIRST_DOMAIN + (os.getpid() * 7 + step) % span
        lock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            lock.bind(("127.0.0.1", DOMAIN_LOCK_PORT + domain))
        except OSError:
            lock.close()
            continue
        try:
            yield domain
        finally:
            lock.close()
        return
    pytest.fail(f"all ROS domain ids from {FIRST_DOMAIN} to {LAST_DOMAIN} are in use by other tests")


@pytest.fixture
def ros_environment(ros_domain_id: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """The environment of the test's nodes, set in this process too: a domain id and log folder of its own."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain_id))
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "ros_log"))
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")
    return dict(os.environ)


@pytest.fixture
def ros_context(ros_environment: dict[str, str], ros_domain_id: int) -> Iterator[object]:
    """An rclpy Context on the test's domain id, shut down afterwards."""
    import rclpy
    from rclpy.context import Context

    context = Context()
    rclpy.init(args=[], context=context, domain_id=ros_domain_id)
    yield context
    rclpy.try_shutdown(context=context)
