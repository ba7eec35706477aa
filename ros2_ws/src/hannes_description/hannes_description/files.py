"""Files that are there whole, or as they were before."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file (text as UTF-8), its folder too; whatever stops it, a full disk or Ctrl-C, leaves no half of it.

    A file that is there keeps its mode. Raises OSError.
    """
    write_all({path: content})


def write_all(contents: Mapping[Path, str | bytes]) -> None:
    """Write files that belong together: none of them before all are on the disk. Raises OSError."""
    parts: dict[Path, Path] = {}
    try:
        for given, content in contents.items():
            data = content.encode("utf-8") if isinstance(content, str) else content
            path = given.resolve() if given.is_symlink() else given
            path.parent.mkdir(parents=True, exist_ok=True)
            if (path.exists() and not path.is_file()) or not os.access(path.parent, os.W_OK):
                path.write_bytes(data)  # a pipe, /dev/stdout; a file in a folder that takes no other
                continue
            handle, name = tempfile.mkstemp(dir=path.parent, prefix=".part-")
            parts[path] = Path(name)
            with os.fdopen(handle, "wb") as stream:
                stream.write(data)
            if path.exists():
                shutil.copymode(path, name)
            else:
                os.chmod(name, 0o666 & ~_umask())
        for path, part in parts.items():
            part.replace(path)
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)


def _umask() -> int:
    """The process' file mode mask, which can only be read by setting it."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
