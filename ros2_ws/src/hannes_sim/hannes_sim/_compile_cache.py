"""Where numba keeps compiled code: one folder per state of the sources.

numba's own cache looks at the time stamp of the file of a function, not at the files it calls, so an edit of one
file would leave stale code in others; and an installed package may be read-only.
"""

from __future__ import annotations

import hashlib
import logging
import os
import stat
import sys
import tempfile
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_OURS = "HANNES_NUMBA_CACHE_DIR"
"""Environment variable that tells a child process that NUMBA_CACHE_DIR is ours, not the user's."""

_OWN = "hannes-numba-own-"
"""Name of a folder of this process and its children alone, where another's stands in the way."""

_log = logging.getLogger(__name__)


def use_source_keyed_cache() -> Path | None:
    """Point numba at a cache folder named by the hash of this package's sources; NUMBA_CACHE_DIR wins if a user set it.

    numba itself is not imported here: a node must be able to handle signals before that second of work.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given and given != os.environ.get(_OURS):
        return None
    if given and Path(given).name.startswith(_OWN) and _safe(Path(given)):
        return Path(given)  # made by the parent where there was no other place
    package = Path(__file__).parent
    # Compiled loops hold constants of MuJoCo and of the description package.
    digest = hashlib.sha256(f"{version('numba')} {version('mujoco')}".encode())
    described = find_spec("hannes_description")
    folders = [package, *map(Path, (described and described.submodule_search_locations) or ())]
    for source in sorted(file for folder in folders for file in folder.rglob("*.py")):
        digest.update(source.read_bytes())
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = base / "hannes" / f"numba-{digest.hexdigest()[:16]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        folder = Path(tempfile.gettempdir()) / f"hannes-numba-{os.getuid()}-{digest.hexdigest()[:16]}"
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700, parents=True)
        if not _safe(folder):
            folder = Path(tempfile.mkdtemp(prefix=_OWN))
    os.environ["NUMBA_CACHE_DIR"] = os.environ[_OURS] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    return folder


def _safe(folder: Path) -> bool:
    """Whether nobody else can have put anything there: numba runs what it reads in its cache."""
    try:
        seen = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(seen.st_mode) and seen.st_uid == os.getuid() and not seen.st_mode & 0o022


@cache
def forgive_damage() -> None:
    """Let numba compile anew what a damaged file of its cache holds, and go on where the cache cannot be written.

    A power cut leaves files that are empty or junk; numba's own reading of them ends in an exception.
    """
    from numba.core.caching import Cache

    load, save = Cache.load_overload, Cache.save_overload

    def load_overload(self: Any, *what: Any) -> Any:
        try:
            return load(self, *what)
        except Exception as error:  # whatever unpickling junk raises
            _log.debug("compiled anew: %s of %s", error, self.cache_path)
            with suppress(OSError):
                self.flush()  # an index that is junk would stop the saving too
            return None

    def save_overload(self: Any, *what: Any) -> None:
        try:
            save(self, *what)
        except OSError as error:
            _say_once(Path(self.cache_path).parent, error.strerror or type(error).__name__)

    Cache.load_overload, Cache.save_overload = load_overload, save_overload


@cache
def _say_once(folder: Path, why: str) -> None:
    _log.warning("hannes: compiled code is not kept, the folder %s cannot be used: %s", folder, why)
