"""Writing a file whole or not at all."""

from pathlib import Path

import pytest
from hannes_description.files import write_whole


def test_a_file_is_whole_or_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "new" / "page.html"
    write_whole(path, "first")
    write_whole(path, b"second")
    assert path.read_text() == "second"
    link = tmp_path / "link"
    link.symlink_to(path)
    write_whole(link, "by its link")
    assert path.read_text() == "by its link" and link.is_symlink()
    write_whole(Path("/dev/null"), "gone")

    def full(self: Path, content: bytes) -> int:
        self.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        write_whole(path, "third")
    assert path.read_text() == "by its link" and list(path.parent.iterdir()) == [path]
