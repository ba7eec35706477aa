"""`hannes nodes`: what is running."""

from __future__ import annotations

from typing import Annotated

import typer
from hannes_description.output import number, print_json, print_table

from .options import JsonOption


def nodes(
    window: Annotated[float, typer.Option(min=0.2, max=60.0, help="How long to look, in seconds.")] = 2.0,
    json: JsonOption = False,
) -> None:
    """Show the running nodes and topics: message rates and ages, measured over a short window."""
    from hannes_bringup.environment import apply_ros_environment, require_ros

    require_ros()
    apply_ros_environment()
    from hannes_bringup.graph_watch import watch

    seen = watch(window)
    if json:
        print_json(seen.to_dict())
        return
    if not seen.nodes:
        typer.echo(
            f"No node is running in ROS domain {seen.domain_id} (looked for {window:g} s). "
            "Start the hand with `hannes run graph`."
        )
        return
    print_table(
        f"Nodes in ROS domain {seen.domain_id}",
        ("node", "health", "publishes", "subscribes"),
        [(n.name, n.health or "-", " ".join(n.publishes), " ".join(n.subscribes)) for n in seen.nodes],
    )
    typer.echo("")
    print_table(
        f"Topics, over {window:g} s",
        ("topic", "type", "publishers", "subscribers", "messages", "rate Hz", "age s"),
        [
            (t.name, t.type, t.publishers, t.subscribers, t.messages, number(t.rate), number(t.age, 3))
            for t in seen.topics
        ],
        right=(2, 3, 4, 5, 6),
    )
