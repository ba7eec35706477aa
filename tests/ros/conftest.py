"""A peer on the test's own ROS domain."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def peer(ros_context: Any) -> Iterator[Any]:
    from graph import Peer

    peer = Peer(ros_context)
    yield peer
    peer.close()
