"""Sections of ROS parameter files that were meant for a node and are not read by it, which ROS says nothing of."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml


def files_given(arguments: Sequence[str]) -> list[str]:
    """The parameter files of a command line."""
    return [file for flag, file in pairwise(arguments) if flag == "--params-file"]


def unread_sections(file: str | Path, node: str) -> list[str]:
    """Names of sections as they stand in the file whose last word is that of the node, but which are not for it.

    node  fully qualified, such as /hannes/hand_sim
    Empty where another section of that word is for the node (a file for several hands), and for what is no YAML.
    """
    try:
        content = yaml.safe_load(Path(file).read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError, RecursionError):
        return []  # rcl has refused it, or will
    word = node.rpartition("/")[2]
    named = [name for name in _sections(content, "") if name.rpartition("/")[2] == word]
    return [] if any(_is_for(name, node) for name in named) else named


def _sections(content: Any, above: str) -> Iterator[str]:
    """Names of what has ros__parameters; a section may stand in that of its namespace."""
    if not isinstance(content, Mapping):
        return
    for key, inner in content.items():
        if isinstance(inner, Mapping):
            name = f"{above}/{key}" if above else str(key)
            if "ros__parameters" in inner:
                yield name
            yield from _sections({k: v for k, v in inner.items() if k != "ros__parameters"}, name)


def _is_for(section: str, node: str) -> bool:
    """As rcl compares: * is one word of a name, ** any number of them, and a name without / begins at the root."""
    pattern = re.escape("/" + section.lstrip("/")).replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"/\w+")
    return re.fullmatch(pattern, node) is not None
