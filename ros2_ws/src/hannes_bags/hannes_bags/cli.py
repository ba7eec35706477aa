"""Command-line functions for bags: `info`, `recover`, `record`, `play`, with typer's annotations, each with
`--json`.

They print what they have to say and raise HannesError for a mistake in the input; who registers them prints
that and exits with 2. `app` holds all four.
"""

from __future__ import annotations

import json as json_module
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from hannes_description.errors import HannesError

from .reading import BagInfo, bag_info
from .recover import recover as recover_bag

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]

app = typer.Typer(
    help="Recorded bags: look into them, save what is left of broken ones, record and play.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.command()
def info(
    bag: Annotated[Path, typer.Argument(help="The bag: a rosbag2 folder, a .mcap or a .db3 file.")],
    json: JsonOption = False,
) -> None:
    """Tell what a bag holds: topics, types, counts, times, metadata. Reads it whole, so it also tells if it
    is intact."""
    found = bag_info(bag)
    if json:
        _print_json(info_dict(found))
        return
    typer.echo(f"{found.path}: {found.storage}, {found.message_count} messages, {found.duration:.3f} s")
    typer.echo(f"files     {', '.join(found.files)}")
    typer.echo(f"sha256    {found.sha256}")
    typer.echo(
        f"from      {found.start_ns * 1e-9:.6f} s to {found.end_ns * 1e-9:.6f} s on the recorder's clock"
    )
    width = max((len(topic.name) for topic in found.topics), default=0)
    for topic in found.topics:
        rate = topic.count / found.duration if found.duration > 0.0 else 0.0
        typer.echo(f"  {topic.name:<{width}}  {topic.count:>8}  {rate:8.1f} Hz  {topic.type}")
    for key, value in sorted(found.metadata.items()):
        typer.echo(f"  {key}: {json_module.dumps(value, sort_keys=True)}")


@app.command()
def recover(
    bag: Annotated[
        Path, typer.Argument(help="The broken bag: its folder, or a .mcap or .db3 file. It is only read.")
    ],
    output: Annotated[Path, typer.Argument(help="Folder of the new bag; it must not exist.")],
    json: JsonOption = False,
) -> None:
    """Save what can be read of a cut or damaged bag into a new one, and verify that."""
    saved = recover_bag(bag, output)
    if json:
        _print_json(saved.as_dict())
        return
    typer.echo(
        f"{saved.messages} messages of {saved.duration:.3f} s saved into {saved.output}, read again and whole"
    )
    for topic, count in sorted(saved.topics.items()):
        typer.echo(f"  {topic}  {count}")
    if saved.unread_bytes:
        typer.echo(
            f"{saved.unread_bytes} of {saved.input_bytes} bytes could not be read: about {saved.lost_s:.3f} s"
        )
    for sentence in saved.damage:
        typer.echo(f"  {sentence}")


@app.command()
def record(
    output: Annotated[Path, typer.Argument(help="Folder of the new bag; it must not exist.")],
    topic: Annotated[
        list[str] | None,
        typer.Option("--topic", help="Topic to record (again for more); the hand's if none is given."),
    ] = None,
    metadata: Annotated[str, typer.Option(help="What the bag shall say of itself, as a JSON object.")] = "",
    compression: Annotated[str, typer.Option(help="none or zstd.")] = "none",
    json: JsonOption = False,
) -> None:
    """Record the topics of the hand into a bag that a kill cannot rob of more than 0.2 s; Ctrl-C ends it."""
    parameters: dict[str, Any] = {
        "output": str(output.absolute()),
        "metadata": metadata,
        "compression": compression,
    }
    if topic:
        parameters["topics"] = topic
    _run_node("recorder", "hannes_bags.recorder_node:RecorderNode", parameters)
    if json:
        _print_json(
            info_dict(bag_info(output)) if output.exists() else {"path": str(output), "message_count": 0}
        )


@app.command()
def play(
    bag: Annotated[Path, typer.Argument(help="The bag: a rosbag2 folder, a .mcap or a .db3 file.")],
    rate: Annotated[float, typer.Option(min=1e-3, max=1e3, help="Played seconds in a second.")] = 1.0,
    fast: Annotated[bool, typer.Option("--fast", help="As fast as subscribers can follow.")] = False,
    topic: Annotated[
        list[str] | None,
        typer.Option("--topic", help="Topic to play (again for more); all if none is given."),
    ] = None,
    start: Annotated[float, typer.Option(min=0.0, help="Seconds to skip at the beginning.")] = 0.0,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end.")] = False,
    subscribers: Annotated[int, typer.Option(min=0, help="Subscribers that each topic must have first.")] = 0,
    json: JsonOption = False,
) -> None:
    """Play a bag back onto its topics, with /clock."""
    found = bag_info(bag)
    parameters: dict[str, Any] = {
        "bag": str(bag.absolute()),
        "rate": float(rate),
        "fast": fast,
        "start": float(start),
        "loop": loop,
        "subscribers": subscribers,
    }
    if topic:
        parameters["topics"] = topic
    _run_node("player", "hannes_bags.player_node:PlayerNode", parameters)
    if json:
        _print_json(info_dict(found))


def info_dict(found: BagInfo) -> dict[str, Any]:
    """What `info --json` prints."""
    content = {**asdict(found), "duration": found.duration}
    for topic in content["topics"]:
        del topic["offered_qos"]
    return content


def _run_node(name: str, target: str, parameters: dict[str, Any]) -> None:
    """Run a node in this process; its own exit code if that is not 0."""
    try:
        from hannes_ros.run import run_node
    except ImportError:
        raise HannesError(
            f"`{name}` needs ROS 2 (rclpy), which is not installed here: run `make setup` or source ROS 2 Jazzy."
        ) from None
    words = [w for key, value in parameters.items() for w in ("-p", f"{key}:={json_module.dumps(value)}")]
    code = run_node(target, argv=[name, "--ros-args", *words])
    if code:
        raise typer.Exit(code)


def _print_json(content: dict[str, Any]) -> None:
    typer.echo(json_module.dumps(content, indent=2, sort_keys=True, allow_nan=False))
