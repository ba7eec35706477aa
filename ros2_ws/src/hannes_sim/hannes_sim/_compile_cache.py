"""Where numba keeps compiled code: one folder per state of the sources.

numba's own cache looks at the time stamp of the file of a function, not at the files it calls, so an edit of one
file would leave stale code in others; and an installed package may be read-only.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

_OURS = "HANNES_NUMBA_CACHE_DIR"
"""Environment variable that tells a child process that NUMBA_CACHE_DIR is ours, not the user's."""


def use_source_keyed_cache() -> Path | None:
    """Point numba at a cache folder named by the hash of this package's sources; NUMBA_CACHE_DIR wins if a user set it.

    numba itself is not imported here: a node must be able to handle signals before that second of work.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given and given != os.environ.get(_OURS):
        return None
    package = Path(__file__).parent
    digest = hashlib.sha256(version("numba").encode())
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = base / "hannes" / f"numba-{digest.hexdigest()[:16]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        folder = Path(tempfile.gettempdir()) / f"hannes-numba-{os.getuid()}-{digest.hexdigest()[:16]}"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    os.environ["NUMBA_CACHE_DIR"] = os.environ[_OURS] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    return folder
