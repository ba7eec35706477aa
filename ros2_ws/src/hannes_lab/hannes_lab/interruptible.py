"""Commands that may be stopped."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import ParamSpec

import typer
from hannes_description.stopping import Terminated, terminable

P = ParamSpec("P")


def interruptible(command: Callable[P, None]) -> Callable[P, None]:
    """A command that Ctrl-C ends with one line and exit code 130, and SIGTERM with one line and exit code 143."""

    @functools.wraps(command)
    def run(*words: P.args, **options: P.kwargs) -> None:
        try:
            with terminable():
                command(*words, **options)
        except KeyboardInterrupt as why:
            kept = not options.get("no_cache")
            rest = (
                "what was found is kept: the same command goes on from there" if kept else "nothing is kept"
            )
            what, code = ("terminated", 143) if isinstance(why, Terminated) else ("interrupted", 130)
            print(f"\nhannes: {what}; {rest}", file=sys.stderr)
            raise typer.Exit(code) from None

    return run
