"""What the tests of the lab share."""

import pytest
from hannes_lab.cache import Store
from hannes_lab.executor import Executor


@pytest.fixture(scope="module")
def executor(tmp_path_factory: pytest.TempPathFactory) -> Executor:
    """Works in this process and keeps what it finds, as the commands do: tests of the same recordings find it again.

    Not for a test that changes how fits are made, or that looks at their progress.
    """
    return Executor(store=Store(tmp_path_factory.mktemp("found")))
