"""Where numba keeps compiled code: one folder per state of the sources.

numba's own cache looks at the time stamp of the file of a function, not at the files it calls, so an edit of one
file would leave stale code in others; and an installed package may be read-only.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

import numba


def use_source_keyed_cache() -> Path | None:
    """Point numba at a cache folder named by the hash of this package's sources; NUMBA_CACHE_DIR wins if set."""
    if os.environ.get("NUMBA_CACHE_DIR"):
        return None
    package = Path(__file__).parent
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = base / "hannes" / f"numba-{digest.hexdigest()[:16]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        folder = Path(tempfile.gettempdir()) / f"hannes-numba-{os.getuid()}-{digest.hexdigest()[:16]}"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    numba.config.CACHE_DIR = str(folder)
    return folder
