"""The `hannes` command.

Each subcommand is one line of COMMANDS: its name, the function or typer.Typer that carries it out (imported only when
it is called, so that `hannes --help` is quick), and one sentence for the list. Exit codes: 0 done, 1 a node or a check
failed or the output could not be written, 2 wrong use or bad input (one line on stderr), 130 interrupted, 141 the
reader of the output has gone, 143 terminated.
"""

from __future__ import annotations

import importlib
import os
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import typer
from hannes_description.errors import HannesError
from hannes_description.stopping import terminable

from .. import __version__

# Read when numpy is imported, which the subcommands do: processes work side by side, and sums in one order give the
# same numbers in every one of them.
for _library in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_library, "1")


@dataclass(frozen=True)
class Command:
    """A subcommand: `target` is "module:attribute", a function with typer annotations or a typer.Typer."""

    name: str
    target: str
    help: str


COMMANDS: tuple[Command, ...] = (
    Command(
        "demo",
        "hannes_bringup.cli.demo:demo",
        "The whole way once: graph, bags, comparison, diagnosis, report.",
    ),
    Command("run", "hannes_bringup.cli.run:app", "Start the whole node graph, or one node."),
    Command("nodes", "hannes_bringup.cli.nodes:nodes", "Show what is running: nodes, topics, rates, ages."),
    Command("motor", "hannes_bringup.cli.motor:motor", "Switch the motor of a running hand on or off."),
    Command(
        "record", "hannes_bringup.cli.bags:record", "Record the topics of the hand into a crash-safe bag."
    ),
    Command("play", "hannes_bringup.cli.bags:play", "Play a bag back onto the topics, with /clock."),
    Command("info", "hannes_bags.cli:info", "Show what a bag holds, and that it is intact."),
    Command("recover", "hannes_bringup.cli.bags:recover", "Save what is left of a cut or damaged bag."),
    Command(
        "describe", "hannes_lab.cli_describe:describe", "Write into bags what they may say of themselves."
    ),
    Command("trials", "hannes_lab.cli_trials:trials", "Tell what the lab reads of recordings."),
    Command(
        "compare", "hannes_lab.cli:compare", "Compare the model with recorded closures: where does it fail?"
    ),
    Command("diagnose", "hannes_lab.cli:diagnose", "Which physical effect does the model lack?"),
    Command("add", "hannes_lab.cli:add", "Add effects to the model, fit them, show the error fall."),
    Command(
        "calibrate",
        "hannes_lab.cli_calibrate:calibrate",
        "Identify named parameters of your hand from its bags.",
    ),
    Command(
        "validate", "hannes_lab.validation.cli:validate", "Hold the model against the thesis, row by row."
    ),
    Command("hide", "hannes_lab.cli:hide", "Make a measurement set with a hidden effect."),
    Command("report", "hannes_lab.cli:report", "Compare, diagnose and add, on one HTML page."),
    Command("page", "hannes_lab.page:page", "Compare, diagnose and add, in a web page of this machine."),
    Command("model", "hannes_bringup.cli.model:app", "Show models: parameters with provenance, effects."),
    Command("stiffness", "hannes_stiffness.cli:app", "Train and test the classifier of the grasped object."),
)
"""Every subcommand, in the order of `hannes --help`."""

_PASS_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "allow_interspersed_args": False}


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"hannes {__version__}")
        raise typer.Exit


def build_app(commands: tuple[Command, ...] = COMMANDS) -> typer.Typer:
    """The command line of those subcommands; none of their modules is imported yet."""
    app = typer.Typer(
        name="hannes",
        help="A model of the Hannes prosthetic hand that can be held against the real one.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )

    @app.callback()
    def options(
        show_version: Annotated[
            bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
        ] = False,
    ) -> None:
        pass

    for command in commands:
        # the real command parses its own words, --help among them
        app.command(command.name, help=command.help, add_help_option=False, context_settings=_PASS_ON)(
            _caller(command)
        )
    return app


def _caller(command: Command) -> Callable[[typer.Context], None]:
    def call(context: typer.Context) -> None:
        load(command)(args=context.args, prog_name=f"hannes {command.name}")

    return call


def load(command: Command) -> Any:
    """Import the subcommand and make it a callable command line of its own."""
    module, _, attribute = command.target.partition(":")
    target = getattr(importlib.import_module(module), attribute)
    if not isinstance(target, typer.Typer):
        function = target
        target = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
        target.command(help=function.__doc__ or command.help)(function)
    return typer.main.get_command(target)


_INTERRUPTED, _TERMINATED = 130, 143
"""Exit codes after SIGINT and SIGTERM."""


def main() -> int:
    """Entry point of `hannes`."""
    code: int | str | None = 0
    _open_what_is_closed()
    try:
        with terminable() as came:
            build_app()()
    except HannesError as error:
        print(f"hannes: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return _stopped(came, said=False)
    except SystemExit as end:
        # typer and rich say this where a pipe broke; whether one did stands in the context
        if isinstance(end.__context__, BrokenPipeError):
            return _nobody_reads()
        code = end.code
        if code == _INTERRUPTED:  # typer's, whatever stopped it; a command that caught it has said so
            by_typer = isinstance(getattr(end.__context__, "__cause__", None), KeyboardInterrupt)
            return _stopped(came, said=not by_typer)
    except BrokenPipeError:
        return _nobody_reads()
    except OSError:
        reason = _failing_output("\n")  # what could not be written before is in no buffer any more
        if not reason:
            raise
        return _output_failed(reason)
    reason = _failing_output()
    if reason:
        return _output_failed(reason)
    if code is None or isinstance(code, int):
        return code or 0
    raise SystemExit(code)


def _stopped(terminated: threading.Event, *, said: bool) -> int:
    """The exit code of a command that was stopped, and its one line unless the command has said it."""
    if terminated.is_set():
        print("\nhannes: terminated", file=sys.stderr)
        return _TERMINATED
    if not said:
        print("\nhannes: interrupted", file=sys.stderr)
    return _INTERRUPTED


def _open_what_is_closed() -> None:
    """An output that was closed (`hannes ... >&-`) is none at all; one that takes nothing fails as a full disk does."""
    if sys.stdout is None:
        sys.stdout = os.fdopen(os.open(os.devnull, os.O_RDONLY), "w")
    if sys.stderr is None:
        sys.stderr = os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")


def _nobody_reads() -> int:
    """The exit code where the reader of a pipe has gone (`hannes nodes | head`), as the shell gives it for SIGPIPE."""
    sys.stdout = None  # or Python complains when it flushes at exit
    return 141


def _failing_output(text: str = "") -> str:
    """Why the standard output takes what is in its buffer and this text not; empty if it does."""
    try:
        if sys.stdout is not None:
            sys.stdout.write(text)
            sys.stdout.flush()
    except BrokenPipeError:
        return "its reader has gone"
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _output_failed(reason: str) -> int:
    sys.stdout = None
    print(f"hannes: the output cannot be written: {reason}.", file=sys.stderr)
    return 1
