"""`hannes validate`: every row of the thesis against the calibrated hand."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.output import print_json, print_table, text_console
from hannes_description.parameters import data_path

from ..cache import default_folder
from ..cli_files import check_model_file
from ..cli_progress import ConsoleProgress
from ..interruptible import interruptible
from . import (
    columns,
    convergence,
    double_pendulum,
    fitting,
    hypotheses,
    least_force,
    pictures,
    runtime,
    variants,
)
from .table import HEADINGS, Progress, Section, cells, markdown

ROWS = tuple(f"R{k:02d}" for k in range(1, 17))

_GROUPS: tuple[tuple[tuple[str, ...], str, Callable[[Model, Progress], Section]], ...] = (
    (("R01", "R02", "R03"), "drop times", lambda model, _: double_pendulum.run(model)),
    (("R04",), "least force", lambda model, _: least_force.run(model)),
    (ROWS[4:13], "currents", lambda model, progress: columns.run(model, progress=progress)),
    (("R14",), "torsion springs", lambda model, progress: variants.run(model, "springs", progress)),
    (("R15",), "forces", lambda model, progress: variants.run(model, "forces", progress)),
    (("R16",), "run time", lambda model, _: runtime.run(model)),
    (("convergence",), "convergence", lambda model, progress: convergence.run(model, progress)),
)
"""What is run for which rows, in the order of the page."""


def run(model: Model, rows: list[str] | None = None, progress: Progress = lambda *_: None) -> list[Section]:
    """The sections of the given rows, all if None."""
    valid = {row for group, _, _ in _GROUPS for row in group}
    unknown = [row for row in rows or () if row not in valid]
    if unknown:
        raise HannesError(f"Unknown row {', '.join(unknown)}; valid are {', '.join(sorted(valid))}.")
    chosen = [g for g in _GROUPS if rows is None or set(g[0]) & set(rows)]
    out = []
    for k, (_, name, make) in enumerate(chosen):

        def inner(done: int, total: int, text: str, k: int = k) -> None:
            progress(round(100 * (k + done / max(total, 1))), 100 * len(chosen), text)

        progress(100 * k, 100 * len(chosen), name)
        out.append(make(model, inner))
    return out


def document(model: Model, sections: list[Section], files: list[Path], command: str, seconds: float) -> str:
    """docs/validation.md."""
    figures = [f for s in sections for f in s.figures]
    rows = sum(f.met for f in figures)
    closer = [f.closer for f in figures if f.closer is not None]
    missed = [f"{f.row} {f.name}" for f in figures if not f.met]
    behind = [
        f"{f.row} {f.name}" + (" (the thesis' error is 0 as printed)" if abs(f.thesis_error) < 1e-6 else "")
        for f in figures
        if f.closer is False
    ]
    free, targets = model.provenance.get("free_parameters"), model.provenance.get("targets")
    intervals = model.provenance.get("intervals_95", {})
    lines = [
        "# The model against the thesis, row by row",
        "",
        f"Made by `{command}`; model `{model.name}`, sha256 `{model.sha256}`; {seconds:.0f} s of wall "
        "time. Do not edit.",
        "",
        'The rows are those of the thesis "Analysis and Optimization of Hannes prosthetic hand: a '
        'Multi-Body approach": '
        "the real hand or the analytic value, the thesis' own model with its error, this model with "
        "its error. Relative "
        "errors are (desired - model) / desired.",
        "",
        f"**{rows} of {len(figures)} figures reach their target; {sum(closer)} of {len(closer)} that can be "
        "compared are closer than the thesis' model.** "
        + (f"Not reached: {'; '.join(missed)}. " if missed else "")
        + (f"Not closer: {'; '.join(behind)}." if behind else ""),
        "",
    ]
    if free:
        lines += [
            f"The calibration has {free} free parameters against {targets} targets "
            f"({', '.join(model.provenance.get('fitted_to', []))}), made by "
            f"`{model.provenance.get('command')}`:",
            "",
            "| parameter | value | 95 % interval |",
            "|---|---|---|",
        ]
        for name, (low, high) in intervals.items():
            value = _value(model, name)
            lines.append(f"| {name} | {value:.4g} | {low:.4g} to {high:.4g} |")
        lines.append("")
        lines += [f"- {text}" for text in model.provenance.get("warnings", [])]
        lines.append("")
    lines.append(markdown(sections))
    if files:
        lines += ["## Pictures", ""]
        lines += [f"![{f.stem.replace('_', ' ')}](figures/{f.name})" for f in files]
        lines.append("")
    return "\n".join(lines)


def _value(model: Model, name: str) -> float:
    if name == fitting.LEVER:
        return least_force.lever_of(model)
    if name in model.parameters:
        return model.parameters.value(name)
    effect, _, parameter = name.partition(".")
    return next(e.values[parameter] for e in model.effects if e.name == effect)


@interruptible
def validate(
    rows: Annotated[
        list[str] | None, typer.Option("--row", help="Only these rows (R01 .. R16, convergence).")
    ] = None,
    model: Annotated[
        str, typer.Option("--model", help="Model file, or the name of a shipped model.")
    ] = "thesis_hand",
    out: Annotated[Path, typer.Option("--out", help="Page to write when all rows are run.")] = Path(
        "docs/validation.md"
    ),
    calibrate: Annotated[
        bool,
        typer.Option(
            "--calibrate", help="Calibrate the model on the void phases and the rigid column first."
        ),
    ] = False,
    motor: Annotated[
        str, typer.Option(help="Motor of --calibrate: " + ", ".join(fitting.MOTORS) + ".")
    ] = "2642W012CR",
    laws: Annotated[
        bool,
        typer.Option(
            "--laws",
            help="Calibrate the other laws that R12 is tried with first; the page shows what they predict.",
        ),
    ] = False,
    starts: Annotated[int, typer.Option(min=1, help="Starts of --calibrate and --laws.")] = 3,
    model_out: Annotated[
        Path | None, typer.Option("--model-out", help="Where --calibrate writes the model file.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """Hold the plant against the thesis, row by row; writes docs/validation.md and its pictures."""
    if model_out is not None:
        if not calibrate:
            raise HannesError(
                f"--model-out {model_out}: only --calibrate writes a model file; say --calibrate too."
            )
        check_model_file(model_out)
    if calibrate and motor not in fitting.MOTORS:
        raise HannesError(f"--motor {motor}: valid are {', '.join(fitting.MOTORS)}.")
    begin = time.monotonic()
    with ConsoleProgress(quiet=json) as progress:
        if laws:
            written = hypotheses.write(starts=starts, cache=default_folder("calibrate"), progress=progress)
            if not json:
                typer.echo(f"Laws of R12: {written}")
        if calibrate:
            found = fitting.calibrate_thesis(
                motor=motor, starts=starts, cache=default_folder("calibrate"), progress=progress
            )
            chosen = found.model
            target = model_out or data_path("models", f"{chosen.name}.yaml")
            chosen.save(target)
            model = chosen.name if model_out is None else str(model_out)
            if not json:
                ends = ", ".join(f"{cost:.1f}" for cost in found.costs)
                typer.echo(f"{found.agree} of {len(found.costs)} starts agree (costs {ends}).")
                typer.echo(f"Model file: {target}")
        else:
            chosen = Model.load(model)
        if chosen.plant != "mujoco":
            raise HannesError(
                f"Model '{chosen.name}' is of the plant '{chosen.plant}'; the rows need the multi-body one "
                "(mujoco)."
            )
        sections = run(chosen, rows, progress)
    seconds = time.monotonic() - begin
    command = "hannes validate" + (f" --model {shlex.quote(model)}" if model != "thesis_hand" else "")
    files: list[Path] = []
    if rows is None:
        files = pictures.write(sections, out.parent / "figures")
        try:
            out.write_text(document(chosen, sections, files, command, seconds), encoding="utf-8")
        except OSError as error:
            raise HannesError(f"Cannot write '{out}': {error}.") from error
    if json:
        content: dict[str, Any] = {
            "model": {"name": chosen.name, "sha256": chosen.sha256},
            "seconds": seconds,
            "sections": [s.to_dict() for s in sections],
        }
        print_json(content)
        return
    _show(sections, rows)
    if rows is None:
        typer.echo(f"Page: {out} with {len(files)} pictures; {seconds:.0f} s")


def _show(sections: list[Section], rows: list[str] | None) -> None:
    console = text_console()
    for section in sections:
        shown = [
            [text.replace("**", "") for text in cells(figure)]
            for figure in section.figures
            if rows is None or any(figure.row == r or r in _expand(figure.row) for r in rows)
        ]
        print_table(section.title, HEADINGS, shown, right=range(3, 8))
        for note in section.notes:
            console.print(f"note: {note}", style="dim")


def _expand(row: str) -> tuple[str, ...]:
    """`R02-03` stands for both."""
    first, _, last = row.partition("-")
    return (first, f"R{last}") if last else (row,)
