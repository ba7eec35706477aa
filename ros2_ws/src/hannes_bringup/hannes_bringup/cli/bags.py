"""`hannes record` and `hannes play`: the recorder and the player of hannes_bags, with options instead of parameters."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated

import typer


def record(
    output: Annotated[Path, typer.Argument(help="Folder of the new bag; it must not exist.")],
    arguments: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME:=VALUE]...", help="More parameters of the recorder node."),
    ] = None,
) -> None:
    """Record the topics of the hand into a bag (MCAP, safe against a crash); Ctrl-C ends it."""
    _run("recorder", {"output": str(output.absolute())}, arguments or [])


def play(
    bag: Annotated[Path, typer.Argument(help="The bag: a rosbag2 folder or an .mcap file.")],
    rate: Annotated[float, typer.Option(min=0.01, max=100.0, help="Speed relative to the recording.")] = 1.0,
    arguments: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME:=VALUE]...", help="More parameters of the player node."),
    ] = None,
) -> None:
    """Play a bag back onto its topics, with /clock."""
    _run("player", {"bag": str(bag.absolute()), "rate": rate}, arguments or [])


def _run(executable: str, parameters: dict[str, object], more: list[str]) -> None:
    """Become the node, in the namespace of the hand."""
    from hannes_bringup.environment import require_ros, ros_environment
    from hannes_bringup.ros2_standin import find_command, parse_launch_arguments

    require_ros()
    environment = ros_environment()
    words = ["--ros-args", "-r", "__ns:=/hannes"]
    for name, value in parameters.items():
        words += ["-p", f"{name}:={json.dumps(value)}"]
    for name, text in parse_launch_arguments(more).items():
        words += ["-p", f"{name}:={text}"]
    command = find_command("hannes_bags", executable, environment)
    os.execve(command[0], [*command, *words], environment)
