"""`hannes describe`: write into bags what they may say of themselves."""

from __future__ import annotations

import json as json_module
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer
from hannes_bags.describing import describe as write_entries
from hannes_bags.describing import described
from hannes_bags.storage import find_bags
from hannes_description.errors import HannesError
from hannes_description.output import print_json

from .cli_options import Bags, Json
from .described import ENTRIES, NAMES, check_entries


def describe(
    bags: Bags,
    say: Annotated[
        list[str],
        typer.Option(
            "--say",
            help=f"KEY=VALUE, or KEY= to say nothing of it any more. Keys: {', '.join(ENTRIES)}. Values as in JSON; a "
            "name needs no quotes.",
        ),
    ],
    json: Json = False,
) -> None:
    """Write into the metadata of bags what they may say of themselves: what was grasped, how it was logged.

    The messages stay as they are. docs/your-own-hand.md says what each entry means, and what happens without it.
    """
    entries = _entries(say)
    check_entries(entries, "--say")
    found = find_bags(bags)
    write_entries(found, entries)
    said = {str(bag): _known(described(bag)) for bag in found}
    if json:
        print_json(said)
        return
    for bag, content in said.items():
        words = ", ".join(f"{key} {_text(value)}" for key, value in sorted(content.items()))
        typer.echo(f"{bag}: {words or 'nothing is said'}")


def _known(entries: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in entries.items() if key in ENTRIES and value is not None}


def _entries(say: Sequence[str]) -> dict[str, Any]:
    """Values by key; None where nothing is said any more."""
    out: dict[str, Any] = {}
    for text in say:
        key, equals, value = text.partition("=")
        if not (key and equals):
            raise HannesError(f"--say {text}: give KEY=VALUE, or KEY= to say nothing of it any more.")
        if key in out:
            raise HannesError(f"--say {text}: something else is said of '{key}' already.")
        out[key] = _value(key, value) if value else None
    return out


def _value(key: str, text: str) -> Any:
    if key in NAMES:
        return text.strip()
    try:
        return json_module.loads(text)
    except (ValueError, RecursionError):
        return text


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json_module.dumps(value, sort_keys=True)
