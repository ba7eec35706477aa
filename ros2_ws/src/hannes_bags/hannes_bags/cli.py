"""`hannes info`: what a bag holds. Reads it whole, so it also tells whether it is intact."""

from __future__ import annotations

import json as json_module
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from hannes_description.errors import HannesError

from .reading import BagInfo, bag_info
from .storage import find_bags


def info(
    bag: Annotated[
        Path, typer.Argument(help="The bag: a rosbag2 folder, an .mcap or a .db3 file; or a folder of bags.")
    ],
    json: Annotated[
        bool, typer.Option("--json", help="Print JSON instead of text; a list for a folder of bags.")
    ] = False,
) -> None:
    """Tell what a bag holds (topics, types, counts, times, metadata) and that it is intact."""
    bags = find_bags([bag])
    single = bags == [bag]
    found, broken = [], []
    for one in bags:
        try:
            found.append(bag_info(one))
        except HannesError as error:
            if single:
                raise
            broken.append(str(error))
    if json:
        answers = [info_dict(one) for one in found]
        content = answers[0] if single else answers
        typer.echo(json_module.dumps(content, indent=2, sort_keys=True, allow_nan=False))
    else:
        typer.echo("\n\n".join(map(_words, found)))
    if broken:
        raise HannesError(f"{len(broken)} of {len(bags)} bags in {bag} cannot be read: {' '.join(broken)}")


def _words(found: BagInfo) -> str:
    lines = [f"{found.path}: {found.storage}, {found.message_count} messages, {found.duration:.3f} s"]
    lines.append(f"  files     {', '.join(found.files)}")
    lines.append(f"  sha256    {found.sha256}")
    lines.append(
        f"  from      {found.start_ns * 1e-9:.6f} s to {found.end_ns * 1e-9:.6f} s on the recorder's clock"
    )
    width = max((len(topic.name) for topic in found.topics), default=0)
    for topic in found.topics:
        rate = topic.count / found.duration if found.duration > 0.0 else 0.0
        lines.append(f"  {topic.name:<{width}}  {topic.count:>8}  {rate:8.1f} Hz  {topic.type}")
    for key, value in sorted(found.metadata.items()):
        lines.append(f"  {key}: {json_module.dumps(value, sort_keys=True)}")
    return "\n".join(lines)


def info_dict(found: BagInfo) -> dict[str, Any]:
    """What `info --json` prints."""
    content = {**asdict(found), "duration": found.duration}
    for topic in content["topics"]:
        del topic["offered_qos"]
    return content
