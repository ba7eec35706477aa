"""Compiled code on disk: what a power cut or a full disk left there is compiled anew, and stops no command."""

from __future__ import annotations

import errno
import tempfile
from ctypes import byref, c_double
from pathlib import Path

import numba
import pytest
from hannes_sim._compile_cache import use_source_keyed_cache
from hannes_sim.native import CONTROL_SIGNATURE
from numba.core.caching import IndexDataCacheFile


def law(x, p, s):
    return 2.0 * x[0]


def compiled() -> tuple[float, int]:
    """A result of the law as a new process compiles it, and how often the cache gave it."""
    function = numba.cfunc(CONTROL_SIGNATURE, cache=True)(law)
    three = c_double(3.0)
    return function.ctypes(*[byref(three)] * 3), function.cache_hits


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(
        numba.config, "CACHE_DIR", str(tmp_path)
    )  # read again only where the environment changed
    return tmp_path


@pytest.mark.parametrize("damage", [b"", b"junk", bytes(500), b"\x80\x05."])
@pytest.mark.parametrize("files", ["*.nbi", "*.nbc"])
def test_damaged_files_count_as_missing(folder: Path, files: str, damage: bytes) -> None:
    assert compiled() == (6.0, 0) and compiled() == (6.0, 1)
    (file,) = folder.rglob(files)
    file.write_bytes(damage)
    assert compiled() == (6.0, 0) and compiled() == (6.0, 1)


def test_a_full_disk_is_said_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(IndexDataCacheFile, "_save_data", full)
    assert compiled() == compiled() == (6.0, 0)
    (said,) = caplog.messages
    assert str(folder) in said and "No space left on device" in said


@pytest.mark.parametrize("mode", [0o777, 0o700])
def test_only_a_folder_of_ones_own_serves_where_there_is_no_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: int
) -> None:
    """numba runs what it reads in its cache: one that others may write is not used."""
    (tmp_path / "no_folder").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "no_folder"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    first = use_source_keyed_cache()
    assert first is not None and first.parent == tmp_path and first.stat().st_mode & 0o077 == 0
    first.chmod(mode)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    assert (use_source_keyed_cache() == first) == (mode == 0o700)
