"""Results that are kept on disk under the hash of all that they depend on, so that stopped work goes on.

One result is one .npz file of plain numbers: a JSON text and the arrays that it refers to.  Nothing in it can run, and
its checksums show a file that was cut off or altered, which then counts as missing.  A file appears under its name only
when it is whole, so any number of processes may read and write the same folder.  The oldest results make way when the
folder is full, but for those of a present run.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import logging
import os
import platform
import re
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cache as cache_once
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from hannes_description.model import Model

from .fit import Fit

LIMIT = 2**30
"""Bytes that the folder may take, but for what was used in the last RUN seconds."""

RUN = 3600.0
"""A run that keeps more than the limit would lose its begin before its end, and repeated lose each result just before
that is wanted: it would find nothing."""

STALE = 3600.0
"""Seconds after which an unfinished file belongs to a process that is gone."""

NO_RESULT = ("cli", "report", "pictures", "effects_page", "page", "compare", "hide", "calibrate")
"""Beginnings of the names of the lab's files on which no result of a search depends."""

NOT_CONTENT: Mapping[str, frozenset[str]] = {
    "Trial": frozenset({"source", "notes"}),
    "Problem": frozenset({"counts"}),
}
"""Fields of these classes that change no result."""

_FILE = re.compile(r"(?P<file>.+\.py):\w+")
_log = logging.getLogger(__name__)


class NotPlain(Exception):
    """Something that has no content hash, or cannot be written as plain numbers: it is not kept."""


# -- what a result depends on ---------------------------------------------------------------------------------------
def content_hash(*things: Any) -> str:
    """SHA-256 of the content of nested plain types, arrays, dataclasses, models, classes and rigs.

    `path.py:Class` counts with the content of its file, a class with that of its source file; objects of other classes
    need a method `identity()`.  Raises NotPlain.
    """
    digest = hashlib.sha256()
    for part in _parts(things):
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


def _parts(thing: Any) -> Iterator[bytes]:
    if isinstance(thing, np.generic):
        thing = thing.item()
    if isinstance(thing, str):
        yield b"s" + thing.encode()
        match = _FILE.fullmatch(thing)
        if match:
            yield _file_hash(Path(match["file"]).expanduser())
    elif thing is None or isinstance(thing, (bool, int, float)):
        yield repr(thing).encode()
    elif isinstance(thing, np.ndarray):
        if thing.dtype.hasobject:
            raise NotPlain("an array of objects")
        yield f"{thing.dtype.str}{thing.shape}".encode()
        yield np.ascontiguousarray(thing).tobytes()
    elif isinstance(thing, Mapping):
        yield b"{"
        for key, value in thing.items():
            yield from _parts(key)
            yield from _parts(value)
        yield b"}"
    elif isinstance(thing, slice):
        yield repr(thing).encode()
    elif isinstance(thing, (tuple, list)):
        yield b"("
        for one in thing:
            yield from _parts(one)
        yield b")"
    elif isinstance(thing, Model):
        yield from _parts((thing.sha256, thing.plant, thing.controller, [e.source for e in thing.effects]))
    elif isinstance(thing, Path):
        yield b"p" + _file_hash(thing)
    elif isinstance(thing, type):
        yield f"{thing.__module__}.{thing.__qualname__}".encode()
        file = inspect.getsourcefile(thing)
        yield _file_hash(Path(file)) if file else b""
    elif is_dataclass(thing):
        yield type(thing).__qualname__.encode()
        without = NOT_CONTENT.get(type(thing).__name__, frozenset())
        for f in fields(thing):
            if not f.name.startswith("_") and f.name not in without:
                yield f.name.encode()
                yield from _parts(getattr(thing, f.name))
    elif hasattr(thing, "identity"):
        yield from _parts(thing.identity())
    else:
        raise NotPlain(f"a {type(thing).__name__}")


def _file_hash(file: Path) -> bytes:
    return hashlib.sha256(file.read_bytes()).digest() if file.is_file() else b"no file"


@cache_once
def code_hash(also: tuple[str, ...] = ()) -> str:
    """Hash of the sources and of the versions of the libraries that a result depends on.

    also  names of further files of the lab that count
    """
    found = hashlib.sha256(f"{platform.machine()} {platform.python_version()}".encode())
    for library in ("numpy", "scipy", "numba", "mujoco"):
        found.update(f"{library} {version(library)}".encode())
    for package in ("hannes_description", "hannes_control", "hannes_sim", "hannes_lab"):
        spec = find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
            for path in sorted(Path(folder).rglob("*")):
                idle = (
                    package == "hannes_lab"
                    and path.name not in also
                    and (path.parent.name == "validation" or path.name.startswith(NO_RESULT))
                )
                if path.suffix in (".py", ".yaml") and not idle:
                    found.update(path.name.encode() + b"\0" + path.read_bytes())
    return found.hexdigest()


# -- the folder -----------------------------------------------------------------------------------------------------
def default_folder(name: str = "lab") -> Path:
    """A folder of the user's cache (XDG)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hannes" / name


class Store:
    """Results by key in a folder.

    limit   bytes that the folder may take; the results that were not used for the longest time go first, those of the
            last RUN seconds never
    hits    results that were found
    """

    def __init__(self, folder: Path | None = None, limit: int = LIMIT) -> None:
        self.folder = folder or default_folder()
        self.limit = limit
        self.hits = 0
        self._written = 0
        self._works = True
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            self._give_up(error)
        else:
            self.prune()

    def read(self, key: str) -> Any | None:
        """Content of a result; None if it is not there or its file is broken, which is then removed."""
        path = self._path(key)
        try:
            with np.load(path, allow_pickle=False) as file:
                text = file["json"].tobytes().decode()
                arrays = {name: file[name] for name in file.files if name != "json"}
            content = json.loads(text)
            if content["key"] != key:
                raise ValueError(f"it holds another result, {content['key']}")
            result = _filled(content["result"], arrays)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            _log.info("%s is broken and made again: %s", path, error)
            with suppress(OSError):
                path.unlink(missing_ok=True)
            return None
        self.hits += 1
        with suppress(OSError):
            os.utime(path)
        return result

    def write(self, key: str, result: Any) -> None:
        """Keep a result: nested lists and dicts of numbers, strings and arrays.  A full disk is no error."""
        if not self._works:
            return
        arrays: list[np.ndarray[Any, Any]] = []
        text = json.dumps({"key": key, "result": _emptied(result, arrays)})
        members = {"json": np.frombuffer(text.encode(), dtype=np.uint8)}
        members |= {f"a{k}": array for k, array in enumerate(arrays)}
        part: Path | None = None
        try:
            handle, name = tempfile.mkstemp(suffix=".part", dir=self.folder)
            part = Path(name)
            with os.fdopen(handle, "wb") as file:
                np.savez(file, **members)  # type: ignore[arg-type]  # its stubs take names for options
            part.replace(self._path(key))
        except OSError as error:
            self._give_up(error)
        finally:
            if part is not None:
                with suppress(OSError):
                    part.unlink(missing_ok=True)  # what was not finished
        self._written += 1
        if self._written % 64 == 0:
            self.prune()

    def prune(self) -> None:
        """Remove what processes left unfinished, and the oldest results above the limit, but none of a present run."""
        found, now = [], time.time()
        with suppress(OSError):
            for path in self.folder.iterdir():
                with suppress(OSError):
                    state = path.stat()
                    if path.suffix == ".part" and now - state.st_mtime > STALE:
                        path.unlink(missing_ok=True)
                    elif path.suffix == ".npz":
                        found.append((state.st_mtime, state.st_size, path))
        total = sum(size for _, size, _ in found)
        for used, size, path in sorted(found):
            if total <= self.limit or now - used < RUN:
                break
            with suppress(OSError):
                path.unlink(missing_ok=True)
                total -= size

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.npz"

    def _give_up(self, error: OSError) -> None:
        if self._works:
            _log.warning("hannes: results are not kept, the folder %s cannot be used: %s", self.folder, error)
        self._works = False


def _emptied(content: Any, arrays: list[np.ndarray[Any, Any]]) -> Any:
    """The content with its arrays moved to a list."""
    if isinstance(content, np.ndarray):
        arrays.append(content)
        return {"array": len(arrays) - 1}
    if isinstance(content, dict):
        return {"dict": [[key, _emptied(value, arrays)] for key, value in content.items()]}
    if isinstance(content, list):
        return [_emptied(one, arrays) for one in content]
    return content


def _filled(content: Any, arrays: Mapping[str, np.ndarray[Any, Any]]) -> Any:
    if isinstance(content, dict):
        if "array" in content:
            return arrays[f"a{content['array']}"]
        return {key: _filled(value, arrays) for key, value in content["dict"]}
    if isinstance(content, list):
        return [_filled(one, arrays) for one in content]
    return content


# -- results of a search as plain content ---------------------------------------------------------------------------
class Codec:
    """Results to plain content and back.

    rebuild   model and coordinates of a set of effects: the same for every fit of that set, so they are not kept
    kinds     dataclasses that may occur
    """

    def __init__(
        self, rebuild: Callable[[tuple[str, ...]], tuple[Model, Sequence[Any]]], kinds: Sequence[type]
    ) -> None:
        self._rebuild = rebuild
        self._kinds = {kind.__name__: kind for kind in kinds}

    def pack(self, result: Any) -> Any:
        """Plain content of a result; raises NotPlain."""
        if isinstance(result, np.generic):
            return result.item()
        if result is None or isinstance(result, (bool, int, float, str, np.ndarray)):
            return result
        if isinstance(result, list):
            return [self.pack(one) for one in result]
        if isinstance(result, tuple):
            return {"kind": "tuple", "items": [self.pack(one) for one in result]}
        if isinstance(result, dict):
            if not all(isinstance(key, str) for key in result):
                raise NotPlain("a mapping with keys that are no text")
            return {"kind": "dict", "items": {key: self.pack(value) for key, value in result.items()}}
        if isinstance(result, Fit):
            names = tuple(dict.fromkeys(c.name.partition(".")[0] for c in result.coordinates if not c.prior))
            model, coordinates = self._rebuild(names)
            if model.sha256 != result.model.sha256 or tuple(coordinates) != tuple(result.coordinates):
                raise NotPlain("a fit of another model")
            own = {"z": result.z, "cost": float(result.cost)}
            own |= {"residual": result.residual, "jacobian": result.jacobian, "complete": result.complete}
            own["grain"] = float(result.grain)
            return {"kind": "Fit", "names": list(names), **own}
        if type(result).__name__ in self._kinds:
            own = {f.name: self.pack(getattr(result, f.name)) for f in fields(result)}
            return {"kind": type(result).__name__, "items": own}
        raise NotPlain(f"a {type(result).__name__}")

    def unpack(self, content: Any) -> Any:
        """The result; raises ValueError, KeyError or TypeError where the content is none."""
        if isinstance(content, list):
            return [self.unpack(one) for one in content]
        if not isinstance(content, dict):
            return content
        kind = content["kind"]
        if kind == "Fit":
            model, coordinates = self._rebuild(tuple(content["names"]))
            numbers = (content[name] for name in ("z", "cost", "residual", "jacobian", "complete", "grain"))
            return Fit(model, tuple(coordinates), *numbers)
        if kind == "tuple":
            return tuple(self.unpack(one) for one in content["items"])
        own = {key: self.unpack(value) for key, value in content["items"].items()}
        return own if kind == "dict" else self._kinds[kind](**own)
