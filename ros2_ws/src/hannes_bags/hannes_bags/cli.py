"""`hannes info`: what a bag holds. Reads it whole, so it also tells whether it is intact."""

from __future__ import annotations

import json as json_module
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from .reading import BagInfo, bag_info


def info(
    bag: Annotated[Path, typer.Argument(help="The bag: a rosbag2 folder, an .mcap or a .db3 file.")],
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """Tell what a bag holds (topics, types, counts, times, metadata) and that it is intact."""
    found = bag_info(bag)
    if json:
        typer.echo(json_module.dumps(info_dict(found), indent=2, sort_keys=True, allow_nan=False))
        return
    typer.echo(f"{found.path}: {found.storage}, {found.message_count} messages, {found.duration:.3f} s")
    typer.echo(f"  files     {', '.join(found.files)}")
    typer.echo(f"  sha256    {found.sha256}")
    typer.echo(
        f"  from      {found.start_ns * 1e-9:.6f} s to {found.end_ns * 1e-9:.6f} s on the recorder's clock"
    )
    width = max((len(topic.name) for topic in found.topics), default=0)
    for topic in found.topics:
        rate = topic.count / found.duration if found.duration > 0.0 else 0.0
        typer.echo(f"  {topic.name:<{width}}  {topic.count:>8}  {rate:8.1f} Hz  {topic.type}")
    for key, value in sorted(found.metadata.items()):
        typer.echo(f"  {key}: {json_module.dumps(value, sort_keys=True)}")


def info_dict(found: BagInfo) -> dict[str, Any]:
    """What `info --json` prints."""
    content = {**asdict(found), "duration": found.duration}
    for topic in content["topics"]:
        del topic["offered_qos"]
    return content
