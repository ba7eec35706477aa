"""Answers of the lab as text: tables, and sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from hannes_description.output import TEXT_WIDTH, estimate, number, show_table, text_console, with_unit
from rich.console import Console, JustifyMethod
from rich.table import Table
from rich.text import Text

from .add import Addition
from .compare import Comparison, MetricRow
from .diagnosis import Diagnosis, Fall, has_excess
from .experiments import VISIBLE, Experiment
from .falls import NO_REPEATS, errors_in_units, fit_in_units, step_name
from .report_text import NO_FINDING, unsure

UNFITTED = "Nothing is fitted: what parameters are off in any machine leaves such a residual too; --fitted fits them."


def show_comparison(result: Comparison) -> None:
    """Where a model fails, the figures of the thesis, and what the residual depends on."""
    console = text_console()
    table = Table(title=f"Error of model '{result.model.name}'" + (" (fitted)" if result.fitted else ""))
    for name in ("condition", "signal", "phase", "RMSE", "bias", "repeatability", "ratio", ""):
        side: JustifyMethod = "left" if name in ("condition", "signal", "phase", "") else "right"
        # conditions fold where it is narrow; a signal that is cut cannot be searched for
        table.add_column(name, justify=side, overflow="fold", no_wrap=name != "condition")
    for c in result.cells:
        table.add_row(
            c.condition,
            c.signal,
            c.phase,
            with_unit(c.rmse, c.unit, 3),
            number(c.bias, 3),
            number(c.repeatability, 3),
            number(c.ratio, 3),
            "fails" if c.fails else "",
        )
    if any(c.fails for c in result.cells):
        table.caption = "fails: the mean over the closures is further off than their scatter makes it"
    show_table(table, TEXT_WIDTH)
    table = (
        Table(title="Figures of the thesis") if result.metrics else Table(show_header=False, show_edge=False)
    )
    for name in (
        ("condition", "figure", "measured", "sd", "model", "relative error") if result.metrics else ()
    ):
        side = "left" if name in ("condition", "figure") else "right"
        table.add_column(name, justify=side, overflow="fold", no_wrap=name not in ("condition", "figure"))
    for m in result.metrics:
        table.add_row(
            m.condition,
            m.name,
            with_unit(m.measured, m.unit),
            number(m.sd, 2),
            number(m.model),
            relative_error(m),
        )
    show_table(table, TEXT_WIDTH)
    if result.metrics:
        console.print("Relative error: (measured - model) / measured.", style="dim")
    _show_nuisances(result.nuisances)
    console.print("The residual depends on: " + ", ".join(d.said for d in result.depends_on))
    if result.depends_on and not result.fitted:
        console.print(UNFITTED, style="dim")
    if math.isfinite(result.overall):
        console.print(f"Overall error: {number(result.overall)} times the repeatability between closures.")
    else:
        units = {e.signal: e.unit for e in result.errors}
        each = ", ".join(f"{with_unit(v, units[s], 3)} ({s})" for s, v in result.by_signal.items())
        console.print(f"Overall error: {each}. {NO_REPEATS}")
    for note in result.notes:
        console.print(f"note: {note}", style="dim")


def relative_error(row: MetricRow) -> str:
    """In percent, in words where the model is many times as large; unknown where the measured value may be zero."""
    if not row.nonzero:
        return "-"
    return row.many_times or f"{number(row.relative_error_percent, 3)} %"


def show_diagnosis(found: Diagnosis, machine: str) -> None:
    """What is missing from the model of a machine, and how the error falls."""
    console = text_console()
    console.print(Text.assemble((found.verdict.upper(), "bold"), f"  {found.summary}"))
    if found.verdict == "unknown" and found.effects:
        console.print(f"\n{NO_FINDING}")
    for effect in found.effects:
        console.print(Text.assemble("\n", (effect.title, "bold"), f" ({effect.name})"))
        for name, p in effect.parameters.items():
            doubt = unsure(p.identified, p.at_end)
            value, span = estimate(p.value, p.low, p.high, p.unit)
            console.print(f"  {name} = {value}   95 %: {span}{f'   {doubt}' if doubt else ''}")
        console.print(f"  {effect.why}")
    _show_falls(console, found, machine)
    _show_nuisances(found.nuisances)
    if found.ranking and not has_excess(found.costs, bool(found.effects)):
        console.print("\nThere is no excess misfit that effects could explain: chance explains all of it.")
    elif found.ranking:
        console.print(
            "\nRanking (part of the excess misfit that each effect explains alone, at least: only the best are fitted "
            "to the end; each parameter costs):"
        )
        for rank in sorted(found.ranking, key=lambda rank: -rank.explained)[:8]:
            console.print(f"  {100 * rank.explained:5.1f} %  {' + '.join(rank.names)}")
    _show_experiments(console, found.experiments)
    if found.verdict == "unknown":
        console.print("\nThe rest depends on: " + ", ".join(d.said for d in found.depends_on))
    for note in found.notes:
        console.print(f"note: {note}", style="dim")


_FARTHEST = 10
"""Parameters of the model that are shown: those that a fit moved farthest."""


def _show_nuisances(nuisances: Mapping[str, Mapping[str, Any]]) -> None:
    """The model's own parameters as fitted, farthest from their nominal values first."""
    rows = sorted(nuisances.items(), key=lambda row: -abs(row[1]["prior_sds"]))
    if not rows:
        return
    table = Table(title="The model's own parameters, as fitted")
    spans = any(math.isfinite(row["low"]) for _, row in rows)
    for name in ("parameter", "fitted", *(["95 %"] if spans else []), "nominal", "tolerances"):
        table.add_column(name, justify="left" if name == "parameter" else "right")
    for name, row in rows[:_FARTHEST]:
        fitted, span = estimate(row["value"], row["low"], row["high"], row["unit"])
        cells = [fitted, *([span] if spans else []), number(row["nominal"]), f"{row['prior_sds']:+.1f}"]
        table.add_row(name, *cells)
    if len(rows) > _FARTHEST:
        table.caption = f"the {len(rows) - _FARTHEST} others moved less; all are in --json and the report"
    show_table(table, TEXT_WIDTH)


def _show_experiments(console: Console, experiments: Sequence[Experiment]) -> None:
    for experiment in (e for e in experiments if e.distance >= VISIBLE):
        tied = ", ".join(" + ".join(names) for names in experiment.separates)
        console.print(
            f"\nTo tell apart {tied}: {experiment.name} (they differ by {number(experiment.distance, 3)} standard "
            f"deviations of the noise there)\n  {experiment.to_dict()['command']}"
        )


_LISTED = 6
"""Conditions that the table has a column for each; of more, the worst alone (all are in --json and the report)."""


def _show_falls(console: Console, found: Diagnosis | Addition, machine: str) -> None:
    units = {s.signal: s.unit for fall in found.falls for s in fall.signals}
    if not math.isfinite(found.falls[-1].held_out):
        _show_falls_in_units(found, units)
        return
    table = Table(
        title=f"Error, in multiples of the repeatability between closures (1 = as good as the {machine} repeats)"
    )
    signals = list(found.falls[-1].held_out_signals)
    table.add_column("model", no_wrap=True)
    for name in ("training\nclosures", "held-out\nclosures", "held-out\nconditions"):
        table.add_column(name, justify="right")
    for signal in signals:
        table.add_column(_heading(signal, units[signal]), justify="right")
    for k, fall in enumerate(found.falls):
        table.add_row(
            step_name(k, fall.added),
            number(fall.train, 3),
            number(fall.held_out, 3),
            number(fall.held_out_conditions, 3),
            *(number(fall.held_out_signals.get(s, math.nan), 3) for s in signals),
        )
    show_table(table, TEXT_WIDTH)
    if signals:
        console.print(
            "The last columns: error of each signal on held-out conditions. Closures: root mean square of all ratios; "
            "conditions: of each signal the error over all against the repeatability over all.",
            style="dim",
        )
    _show_conditions(found.falls)


def _show_conditions(falls: Sequence[Fall]) -> None:
    """The error on each condition while it took no part in the fit; of many the largest."""
    conditions = list(falls[-1].by_condition)
    if len(conditions) < 2:
        return
    table = Table(title="Of each condition, left out of the fit")
    table.add_column("model", no_wrap=True)
    listed = len(conditions) <= _LISTED
    for name in conditions if listed else ("largest", "on condition"):
        table.add_column(name, justify="left" if name == "on condition" else "right", overflow="fold")
    for k, fall in enumerate(falls):
        known = {c: v for c, v in fall.by_condition.items() if math.isfinite(v)}
        worst = max(known, key=known.__getitem__, default="")
        cells = (
            [number(fall.by_condition.get(c, math.nan), 3) for c in conditions]
            if listed
            else [number(known.get(worst, math.nan), 3), worst]
        )
        table.add_row(step_name(k, fall.added), *cells)
    show_table(table, TEXT_WIDTH)


def _heading(signal: str, unit: str) -> str:
    """A signal as the heading of a column, with its unit."""
    return signal.replace("_", "\n", 1) + ("" if unit == "1" else f", {unit}")


def _show_falls_in_units(found: Diagnosis | Addition, units: dict[str, str]) -> None:
    """The table where nothing was repeated: there is no repeatability to give the errors in."""
    falls = [fall.to_dict() for fall in found.falls]
    held, left_out = errors_in_units(falls)
    tables = {"Error on conditions that were left out of the fit": left_out} if held else {}
    for title, steps in (tables | {"Error of the fit": fit_in_units(falls)}).items():
        table = Table(title=title)
        table.add_column("model", no_wrap=True)
        for signal in steps[-1]:
            table.add_column(_heading(signal, units[signal]), justify="right")
        for k, (fall, errors) in enumerate(zip(found.falls, steps, strict=True)):
            table.add_row(step_name(k, fall.added), *(number(errors.get(s, math.nan), 3) for s in steps[-1]))
        show_table(table, TEXT_WIDTH)


def show_addition(found: Addition, machine: str) -> None:
    """The effects that were added, and how the error falls."""
    console = text_console()
    for effect in found.effects:
        known = {n: estimate(p.value, p.low, p.high, p.unit) for n, p in effect.parameters.items()}
        values = ", ".join(f"{n} = {value} ({span})" for n, (value, span) in known.items())
        console.print(Text.assemble((effect.title, "bold"), f": {values}"))
    _show_falls(console, found, machine)
    for note in found.notes:
        console.print(f"note: {note}", style="dim")
