"""`hannes model`: what a model file says, and one with other values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from hannes_description.errors import HannesError
from hannes_description.output import number, print_json, print_table

from .options import JsonOption

if TYPE_CHECKING:
    from hannes_description.parameters import Parameter

app = typer.Typer(
    help="Models: nominal parameters plus effects.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.callback()
def _models() -> None:
    pass


@app.command()
def show(
    model: Annotated[
        str, typer.Argument(help="Name of a shipped model, or path of a model file.")
    ] = "nominal",
    changed: Annotated[
        bool, typer.Option("--changed", help="Only what differs from the nominal parameters.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Show a model: every parameter with unit, bounds, status and source, and the effects that were added."""
    from hannes_description.model import Model
    from hannes_description.parameters import load_parameters
    from hannes_sim.factory import check_effects

    loaded = Model.load(model)
    check_effects(loaded)
    base = load_parameters(loaded.base)
    parameters = {
        name: parameter
        for name, parameter in loaded.parameters.items()
        if not changed or name not in base or base[name] != parameter
    }
    if json:
        print_json(
            {
                "name": loaded.name,
                "plant": loaded.plant,
                "controller": loaded.controller,
                "variant": dict(loaded.variant),
                "sha256": loaded.sha256,
                "parameters": {name: parameter.to_dict() for name, parameter in parameters.items()},
                "effects": [effect.to_dict() for effect in loaded.effects],
                "provenance": dict(loaded.provenance),
            }
        )
        return
    variant = ", ".join(f"{key} {value}" for key, value in loaded.variant.items()) or "none"
    typer.echo(f"{loaded.name}: plant {loaded.plant}, controller {loaded.controller}, variant {variant}")
    typer.echo(f"sha256 {loaded.sha256}\n")
    columns = ("parameter", "value", "unit", "lower", "upper", "known to", "status", "source")
    groups = [("Parameters", parameters)]
    groups += [(f"Effect {effect.name}", dict(effect.parameters)) for effect in loaded.effects]
    for title, entries in groups:
        rows = [
            (
                name,
                number(p.value),
                p.unit,
                number(p.lower),
                number(p.upper),
                _known_to(p),
                p.status,
                p.source,
            )
            for name, p in entries.items()
        ]
        print_table(title, columns, rows, right=(1, 3, 4))
    if not loaded.effects:
        typer.echo("\nNo effects beyond the nominal model.")


def _known_to(p: Parameter) -> str:
    """How well a parameter is known, where its entry says so."""
    if p.tolerance is None:
        return ""
    return f"{100 * p.tolerance:.3g} %" if p.tolerance else "exactly"


@app.command()
def change(
    model: Annotated[str, typer.Argument(help="Name of a shipped model, or path of a model file.")],
    out: Annotated[Path, typer.Option("--out", help="Model file to write.")],
    effects: Annotated[
        list[str] | None,
        typer.Option(
            "--effect", help="Effect to add, by name or your own as path.py:Class, at its typical values."
        ),
    ] = None,
    values: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="NAME=NUMBER in the parameter's unit, as motor.kt=0.0172 or, of an effect, cogging.sine=0.01.",
        ),
    ] = None,
) -> None:
    """Write a model file with effects or values of your choice, to see what the hand would do: nothing is fitted."""
    from hannes_description.model import Model
    from hannes_lab.cli_files import check_model_file
    from hannes_lab.provenance import own_command, save_model
    from hannes_sim.effect import catalogue, effect_source, load_effect
    from hannes_sim.factory import make_plant

    check_model_file(out)
    changed, where = Model.load(model), "hannes model change"
    given = _numbers(values or ())
    for source in effects or ():
        kind = load_effect(source)
        if any(entry.name == kind.name for entry in changed.effects):
            raise HannesError(f"--effect {source}: the model has '{kind.name}' already; --set changes it.")
        own = {n.removeprefix(f"{kind.name}."): v for n, v in given.items() if n.startswith(f"{kind.name}.")}
        changed = changed.with_effect(kind.entry(own, source=effect_source(source), where=where))
        given = {n: v for n, v in given.items() if not n.startswith(f"{kind.name}.")}
    for name, value in given.items():
        if name not in changed.names and (group := name.partition(".")[0]) in catalogue():
            raise HannesError(f"--set {name}: the model has no effect '{group}'; add it by --effect {group}.")
        p = changed.named(name)
        if not p.lower <= value <= p.upper:
            raise HannesError(
                f"--set {name}={value:g}: outside its bounds, {p.lower:g} .. {p.upper:g} {p.unit}; a model file that "
                "gives bounds of its own takes it."
            )
    changed = changed.with_values(given, status="assumed", source=where)
    make_plant(changed)
    save_model(changed, out, own_command())
    typer.echo(f"Model file: {out}")


def _numbers(texts: Sequence[str]) -> dict[str, float]:
    """Values by name."""
    out: dict[str, float] = {}
    for text in texts:
        name, _, figure = text.rpartition("=")
        try:
            value = float(figure)
        except ValueError:
            value = math.nan
        if not (name and math.isfinite(value)):
            raise HannesError(f"--set {text}: give NAME=NUMBER, such as motor.kt=0.0172.")
        if name in out:
            raise HannesError(f"--set {name} is given more than once; give one number.")
        out[name] = value
    return out


@app.command()
def effects(
    names: Annotated[
        list[str] | None,
        typer.Argument(help="Effects by name, or your own as path.py:Class; none: the catalogue."),
    ] = None,
    page: Annotated[
        Path | None, typer.Option(help="Write a page (.md) with a picture of each effect's signature.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """List the effects that a model can be given: parameters, bounds, what each looks like in the data."""
    from hannes_lab.effects_page import describe, write_page
    from hannes_sim.effect import catalogue, load_effect

    wanted = names or list(catalogue())
    found = [describe(load_effect(name)) for name in wanted]
    if page:
        typer.echo(f"{write_page(page, wanted)}: {len(wanted)} effects")
    elif json:
        print_json({"effects": found})
    else:
        rows = [
            (
                effect["name"] if k == 0 else "",
                p["name"],
                p["unit"],
                number(p["lower"]),
                number(p["upper"]),
                number(p["typical"]),
                number(p["vanishing"]),
                p["description"],
            )
            for effect in found
            for k, p in enumerate(effect["parameters"])
        ]
        columns = ("effect", "parameter", "unit", "lower", "upper", "typical", "off at", "what it is")
        print_table("Effects", columns, rows, right=(3, 4, 5, 6))
        typer.echo(
            "\nWith pictures: docs/effects.md, written by `hannes model effects --page docs/effects.md`."
        )
