"""`hannes calibrate`: named parameters of a hand from its recorded closures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from hannes_description.errors import HannesError
from hannes_description.output import estimate, number, text_console

from .cli_files import Output, check_model_file, deliver
from .cli_options import LeaveOut, Scale, Topics
from .cli_progress import ConsoleProgress
from .interruptible import interruptible

if TYPE_CHECKING:
    from .calibrate import Calibration


@interruptible
def calibrate(
    bags: Annotated[list[Path], typer.Argument(help="Bags, or folders of bags, of your hand.")],
    free: Annotated[str, typer.Option("--free", help="Names of the free parameters, with commas between.")],
    out: Annotated[Path, typer.Option("--out", help="Model file to write.")] = Path("my_hand.yaml"),
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            help="Model file, or the name of a shipped model; default: nominal (nominal_mujoco of recordings of the "
            "full hand in the simulator).",
        ),
    ] = None,
    prior: Annotated[
        list[str] | None,
        typer.Option(
            "--prior", help="NAME=SD: prior standard deviation, of the logarithm for positive parameters."
        ),
    ] = None,
    scale: Scale = None,
    topics: Topics = None,
    leave_out: LeaveOut = None,
    starts: Annotated[int, typer.Option(min=1, help="Searches from different points.")] = 3,
    seed: Annotated[int, typer.Option(help="Seed of the starts.")] = 0,
    cache: Annotated[
        Path | None,
        typer.Option("--cache", help="Folder of finished simulations; a stopped run goes on from it."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """Identify named parameters of your hand from recorded closures, with intervals and warnings."""
    from .cache import default_folder
    from .calibrate import calibrate as calibrate_model
    from .provenance import own_command, save_model
    from .session import prepared_from

    names = [n.strip() for n in free.split(",") if n.strip()]
    check_model_file(out)
    sds = {}
    for text in prior or ():
        name, _, value = text.partition("=")
        try:
            sds[name] = float(value)
        except ValueError:
            raise HannesError(f"--prior {text}: give NAME=SD with a number.") from None
        if name not in names:
            raise HannesError(f"--prior {text}: '{name}' is not among --free.")
    with ConsoleProgress(quiet=json) as progress:
        progress(0, 1, "reading the bags")
        prepared = prepared_from(bags, model, None, None, scale=scale, topics=topics, leave_out=leave_out)
        found = calibrate_model(
            prepared,
            names,
            sds=sds,
            starts=starts,
            seed=seed,
            cache=cache or default_folder("calibrate"),
            progress=progress,
        )
    model_file = Output("Model file", out, lambda to: save_model(found.model, to, own_command()))
    deliver(json, found.to_dict() | {"model_file": str(out)}, lambda: _show(found), [model_file])


def _show(found: Calibration) -> None:
    console = text_console()
    for p in found.parameters:
        note = "" if p.identified else "   not identified"
        value, span = estimate(p.value, p.low, p.high, p.unit)
        console.print(f"{p.name} = {value}   95 %: {span}{note}")
    console.print(
        f"{found.agree} of {len(found.costs)} starts agree; {found.simulations} simulations, "
        f"{found.from_cache} from the cache."
    )
    if any(map(math.isfinite, found.errors.values())):
        console.print(
            "Error in multiples of the repeatability: "
            + ", ".join(f"{k.replace('_', ' ')} {number(v, 3)}" for k, v in found.errors.items())
        )
    for text in found.warnings:
        console.print(f"warning: {text}", style="dim")
