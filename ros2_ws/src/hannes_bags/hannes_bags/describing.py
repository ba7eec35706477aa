"""What a bag says of itself, written afterwards into its metadata.yaml; its messages stay as they are."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from hannes_description.errors import HannesError
from hannes_description.files import write_all

from .storage import METADATA_FILE, decode_entries, encode_entries, locate


def described(path: str | Path) -> dict[str, Any]:
    """What the metadata.yaml of a bag says in its custom_data; raises HannesError where it has none."""
    return decode_entries(_information(Path(path)).get("custom_data"))


def describe(paths: Sequence[str | Path], entries: Mapping[str, Any]) -> list[Path]:
    """Put entries into the custom_data of bags, over what is there; gives back the files that were written.

    entries  JSON-like; None says nothing of that key any more
    All files are written or none.  Raises HannesError for what is no bag folder, or cannot be written.
    """
    written: dict[Path, str] = {}
    for given in paths:
        information = _information(Path(given))
        there = information.get("custom_data")
        custom = {**(there if isinstance(there, Mapping) else {}), **encode_entries(entries)}
        file = _file(Path(given))
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
        content["rosbag2_bagfile_information"] = {**information, "custom_data": custom}
        written[file] = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    for file in written:
        if not os.access(file.parent, os.W_OK):
            raise HannesError(f"Cannot write {file}: nothing can be written into its folder.")
    try:
        write_all(dict(written))
    except OSError as error:
        raise HannesError(
            f"Cannot write {error.filename or METADATA_FILE}: {error.strerror or error}."
        ) from None
    return list(written)


def _file(path: Path) -> Path:
    return path if path.name == METADATA_FILE else path / METADATA_FILE


def _information(path: Path) -> Mapping[str, Any]:
    bag = locate(path)
    if not bag.yaml:
        raise HannesError(
            f"{path} is a single file, and what a bag says of itself stands in the {METADATA_FILE} of its folder: name "
            f"that folder, or make one with `hannes recover {path} NEW_FOLDER`."
        )
    return bag.yaml
