"""Writing a file whole or not at all."""

import os
from pathlib import Path

import pytest
from hannes_description.files import write_all, write_whole


def test_a_file_is_whole_or_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "new" / "page.html"
    write_whole(path, "first")
    usual = tmp_path / "usual"
    usual.touch()
    assert path.stat().st_mode == usual.stat().st_mode
    path.chmod(0o600)
    write_whole(path, b"second")
    assert path.read_text() == "second" and path.stat().st_mode & 0o777 == 0o600
    link = tmp_path / "link"
    link.symlink_to(path)
    write_whole(link, "by its link")
    assert path.read_text() == "by its link" and link.is_symlink()
    write_whole(Path("/dev/null"), "gone")

    other, opened, left = path.with_name("other.html"), os.fdopen, [1]

    def full(handle: int, mode: str) -> object:
        if not left:
            os.close(handle)
            raise OSError(28, "No space left on device")
        left.pop()
        return opened(handle, mode)

    monkeypatch.setattr(os, "fdopen", full)
    with pytest.raises(OSError, match="No space left"):
        write_all({path: "third", other: "too"})
    assert path.read_text() == "by its link" and list(path.parent.iterdir()) == [path]
