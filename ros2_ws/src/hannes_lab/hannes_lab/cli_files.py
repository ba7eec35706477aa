"""Files that a command writes when its work is done: whether they can be written is known before it begins."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import typer
from hannes_description.errors import HannesError
from hannes_description.output import print_json


class Output(NamedTuple):
    """A file that a command writes: what it is (\"Report\"), where, what writes it there, and what to know of it."""

    what: str
    path: Path
    write: Callable[[Path], None]
    remark: str = ""


def deliver(
    json: bool, content: Mapping[str, Any], show: Callable[[], None], files: Sequence[Output] = ()
) -> None:
    """Print an answer as JSON, or show it and say where its files are.

    Each file is written whatever happens before: whoever reads the answer may be gone, or another file's disk full.
    """
    with ExitStack() as last:
        for file in reversed(files):
            last.callback(file.write, file.path)
        if json:
            print_json(content)
        else:
            show()
    for file in () if json else files:
        typer.echo(f"{file.what}: {file.path}" + (f" ({file.remark})" if file.remark else ""))


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


def check_files(report: Path | None, model_file: Path | None = None) -> None:
    """Refuse files that cannot be written, before the work begins."""
    if report is not None:
        from .pictures import ENDINGS

        if report.suffix.lower() not in ("", ".html", ".htm", *ENDINGS):
            raise HannesError(
                f"The report {report} must end in .html, or for a picture in {', '.join(ENDINGS)}."
            )
        check_writable(report, "The report")
    if model_file is not None:
        check_model_file(model_file)
