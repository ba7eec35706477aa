"""Files that a command writes when its work is done: whether they can be written is known before it begins."""

from __future__ import annotations

from pathlib import Path

from hannes_description.errors import HannesError


def check_writable(path: Path, what: str) -> None:
    """Raise one HannesError if a file cannot be written there; what is there already stays as it is.

    Folders that are missing may be made when the file is written: here they are made and removed again.
    what   begins the sentence: "The report"
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        return  # a pipe or a device: to open it may change it
    new = not path.exists()
    missing = [folder for folder in (path.parent, *path.parent.parents) if not folder.exists()]
    made: list[Path] = []
    try:
        for folder in reversed(missing):
            folder.mkdir()
            made.append(folder)
        path.open("ab").close()
        if new:
            path.unlink()
    except OSError as error:
        reason = "it is a folder; name a file" if path.is_dir() else (error.strerror or str(error))
        raise HannesError(f"{what} cannot be written to '{path}': {reason}.") from error
    finally:
        for folder in reversed(made):
            folder.rmdir()


def check_model_file(path: Path) -> None:
    """Raise HannesError if no model file that can be loaded again can be written there."""
    if path.suffix not in (".yaml", ".yml"):
        raise HannesError(f"--out {path}: a model file ends in .yaml.")
    check_writable(path, "The model file")
