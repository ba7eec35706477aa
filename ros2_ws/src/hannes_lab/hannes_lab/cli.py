"""The lab's commands: compare, diagnose, add, hide, report."""

from __future__ import annotations

import math
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.output import (
    TEXT_WIDTH,
    estimate,
    finite,
    number,
    print_json,
    show_table,
    text_console,
    with_unit,
)
from hannes_description.signals import SIGNALS
from hannes_sim.effect import effect_source, load_effect, strength_of
from joblib import cpu_count
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from .add import Addition, add_effects, with_provenance
from .cache import Store
from .choose import MAX_EFFECTS, MAX_GREEDY
from .cli_files import check_model_file, check_writable
from .compare import Comparison, MetricRow
from .compare import compare as compare_model
from .diagnose import diagnose as diagnose_model
from .diagnose import effect_sources
from .diagnosis import Diagnosis, has_excess
from .executor import Executor, interruptible
from .experiments import VISIBLE, Experiment
from .falls import NO_REPEATS, errors_in_units, step_name
from .hand import HandRig
from .own_effect import along_reference, check_own_effects, first_closure
from .own_law import check_own_code
from .prepare import Prepared, load_trials, prepare, read_trials
from .report_text import NO_FINDING
from .rig import load_rig
from .trials import SIGNALS as COMPARED
from .trials import UNITS, stem_of

Bags = Annotated[list[Path], typer.Argument(help="Bags, or folders of bags; one bag may hold many closures.")]
ModelFile = Annotated[str, typer.Option("--model", help="Model file, or the name of a shipped model.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Effects = Annotated[
    list[str] | None, typer.Option("--effect", help="Effect by name, or your own as path.py:Class.")
]
Objects = Annotated[
    list[str] | None,
    typer.Option(
        "--object", help="What a condition holds, as CONDITION=none|soft|rigid; overrides the bag's metadata."
    ),
]
Scale = Annotated[
    list[str] | None,
    typer.Option(
        "--scale",
        help="Factor of a signal to SI (rad at the pulley, A, V, N), as SIGNAL=FACTOR; 1 where the guess is wrong.",
    ),
]
Topics = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        help="Topic that carries a signal, as SIGNAL=TOPIC, where the name does not say it; SIGNAL= leaves it out. "
        f"Signals: {', '.join(('reference_position', *COMPARED))}.",
    ),
]
RigFile = Annotated[
    str | None,
    typer.Option(
        "--rig", help="Another machine's adapter, as path.py:Class; BAGS are then the files that it reads."
    ),
]
MaxEffects = Annotated[
    int | None,
    typer.Option(
        "--max-effects",
        min=1,
        help=f"Most effects that a diagnosis may name (default: {MAX_EFFECTS}; with --greedy {MAX_GREEDY}).",
    ),
]
Greedy = Annotated[
    bool | None,
    typer.Option(
        "--greedy/--no-greedy",
        help="Add effects one after another while the error on held-out conditions falls by 8 %, many small effects "
        "of a real machine, or look for the smallest set that explains all. Default: --greedy for recordings of a "
        "machine that no model has the form of (a --rig) in two conditions or more.",
    ),
]
Signals = Annotated[list[str] | None, typer.Option("--signal", help="Compare only these signals.")]
Jobs = Annotated[int, typer.Option("--jobs", min=1, help="Worker processes.")]
Dask = Annotated[
    str | None,
    typer.Option(
        "--dask", help="Work on the Dask cluster whose scheduler is at this address (tcp://HOST:8786)."
    ),
]
NoCache = Annotated[
    bool,
    typer.Option("--no-cache", help="Neither go on from the results that an earlier run kept, nor keep any."),
]
REPORT = "a self-contained HTML report, or one picture where the name ends in .png, .svg or .pdf"
ReportFile = Annotated[Path | None, typer.Option("--report", help=f"Write {REPORT}.")]

_JOBS = max(1, cpu_count())
"""Cores that this process may use: fewer than the machine has in a container or a batch job."""


class _Progress:
    """Progress on stderr: a bar on a terminal, a line every few seconds elsewhere."""

    def __init__(self, quiet: bool) -> None:
        self._quiet = quiet
        self._bar: Progress | None = None
        self._task: Any = None
        self._last = 0.0
        if not quiet and sys.stderr.isatty():
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.completed}/{task.total}"),
                TimeElapsedColumn(),
                console=Console(stderr=True),
                transient=True,
            )
            self._task = self._bar.add_task("", total=1)

    def __enter__(self) -> _Progress:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.stop()

    def __call__(self, done: int, total: int, text: str) -> None:
        if self._quiet:
            return
        if self._bar:
            self._bar.update(self._task, description=text, completed=done, total=max(total, 1))
        elif time.monotonic() - self._last > 3.0:
            self._last = time.monotonic()
            print(f"  {text} ({done}/{total})", file=sys.stderr, flush=True)


def _prepared(
    bags: Sequence[Path],
    model: str,
    objects: Sequence[str] | None,
    signals: Sequence[str] | None,
    rig: str | None = None,
    scale: Sequence[str] | None = None,
    threads: int = 1,
    topics: Sequence[str] | None = None,
) -> Prepared:
    machine = load_rig(rig) if rig else None
    if machine is not None and model == "nominal":
        model = str(machine.model)
    given = {}
    for text in objects or ():
        name, _, what = text.partition("=")
        if not what:
            raise HannesError(f"--object {text}: give CONDITION=none|soft|rigid.")
        given[name] = what
    factors = _factors(scale)
    if machine and factors:
        raise HannesError("--scale is for bags; with --rig the adapter's reader says what the units are.")
    if machine and topics:
        raise HannesError("--topic is for bags; with --rig the adapter's reader says where the signals are.")
    trials = (
        read_trials(machine, bags)
        if machine
        else load_trials(bags, scale=factors, objects=given, topics=_topics(topics))
    )
    known = ({t.name, stem_of(t.source), *(part.name for part in t.parts)} for t in trials)
    unknown = sorted(set(given).difference(*known))
    if unknown:
        raise HannesError(
            f"--object names unknown conditions {', '.join(unknown)}; these bags have "
            f"{', '.join(t.name for t in trials)}."
        )
    trials = [
        replace(t, options={**t.options, "object": given[t.name]}) if t.name in given else t for t in trials
    ]
    return prepare(trials, Model.load(model), rig=machine, signals=signals, surrogate=True, threads=threads)


def _factors(scale: Sequence[str] | None) -> dict[str, float]:
    """Factors to SI by signal name."""
    out = {}
    for text in scale or ():
        name, _, factor = text.partition("=")
        try:
            out[name] = float(factor)
        except ValueError:
            out[name] = math.nan
        if not (math.isfinite(out[name]) and out[name] != 0.0):
            raise HannesError(f"--scale {text}: give SIGNAL=FACTOR with a number that is not 0.")
        if name not in ("reference_position", *UNITS):
            raise HannesError(
                f"--scale {text}: unknown signal; valid are {', '.join(('reference_position', *UNITS))}."
            )
    return out


def _topics(given: Sequence[str] | None) -> dict[str, str | None]:
    """Topics by signal name; None leaves the signal out."""
    out: dict[str, str | None] = {}
    for text in given or ():
        name, equals, topic = text.partition("=")
        if not equals or name not in SIGNALS:
            raise HannesError(
                f"--topic {text}: give SIGNAL=TOPIC, or SIGNAL= to leave it out; signals are {', '.join(SIGNALS)}."
            )
        if name in out:
            raise HannesError(f"--topic {text}: another topic is named for {name} already.")
        out[name] = topic or None
    return out


def _executor(jobs: int, dask: str | None, no_cache: bool) -> Executor:
    return Executor(jobs, dask, None if no_cache else Store())


def _check_effects(prepared: Prepared, sources: Sequence[str]) -> None:
    """Try the user's own effects on the shortest closure before working with them."""
    trial, reference = first_closure(prepared.features.trials)

    def simulate(source: str) -> None:
        kind = prepared.rig.effect(load_effect(source))
        entry = kind.entry({p.name: p.typical for p in kind.parameters}, source=effect_source(kind, source))
        prepared.rig.simulate(prepared.model.with_effect(entry), {}, trial, reference)

    check_own_effects(sources, simulate, along_reference(trial, reference))


def _command() -> str:
    return "hannes " + " ".join(shlex.quote(a) for a in sys.argv[1:])


def compare(
    bags: Bags,
    model: ModelFile = "nominal",
    fitted: Annotated[
        bool,
        typer.Option(
            "--fitted",
            help="Fit the uncertain nominal parameters first, each within its tolerance, to what repeats best: that "
            "may raise the error of a signal or phase that scatters more.",
        ),
    ] = False,
    objects: Objects = None,
    scale: Scale = None,
    topics: Topics = None,
    signals: Signals = None,
    rig: RigFile = None,
    report: ReportFile = None,
    json: Json = False,
) -> None:
    """Compare the model with recorded closures: where does it fail, and by how much?"""
    _check_files(report)
    prepared = _prepared(bags, model, objects, signals, rig, scale, _JOBS, topics)
    with _Progress(quiet=json or not fitted) as progress, _executor(_JOBS, None, not fitted) as executor:
        result = compare_model(prepared, fitted=fitted, executor=executor, progress=progress)
    try:
        if json:
            print_json(result.to_dict())
        else:
            _show_comparison(result)
    finally:  # whoever reads the answer may be gone
        if report:
            _write_report(report, comparison=result, after=None, diagnosis=None)
    _say_files(json, report)


def _show_comparison(result: Comparison) -> None:
    console = text_console()
    table = Table(title=f"Error of model '{result.model.name}'" + (" (fitted)" if result.fitted else ""))
    for name in ("condition", "signal", "phase", "RMSE", "bias", "repeatability", "ratio", ""):
        table.add_column(name, justify="left" if name in ("condition", "signal", "phase", "") else "right")
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
        table.add_column(name, justify="left" if name in ("condition", "figure") else "right")
    for m in result.metrics:
        table.add_row(
            m.condition,
            m.name,
            with_unit(m.measured, m.unit),
            number(m.sd, 2),
            number(m.model),
            _relative_error(m),
        )
    show_table(table, TEXT_WIDTH)
    if result.metrics:
        console.print("Relative error: (measured - model) / measured.", style="dim")
    console.print("The residual depends on: " + ", ".join(d.said for d in result.depends_on))
    if math.isfinite(result.overall):
        console.print(f"Overall error: {number(result.overall)} times the repeatability between closures.")
    else:
        units = {e.signal: e.unit for e in result.errors}
        each = ", ".join(f"{with_unit(v, units[s], 3)} ({s})" for s, v in result.by_signal.items())
        console.print(f"Overall error: {each}. {NO_REPEATS}")
    for note in result.notes:
        console.print(f"note: {note}", style="dim")


def _relative_error(row: MetricRow) -> str:
    """In percent, in words where the model is many times as large; unknown where the measured value may be zero."""
    if not row.nonzero:
        return "-"
    return row.many_times or f"{number(row.relative_error_percent, 3)} %"


@interruptible
def diagnose(
    bags: Bags,
    model: ModelFile = "nominal",
    effects: Effects = None,
    only: Annotated[list[str] | None, typer.Option("--only", help="Consider only these effects.")] = None,
    add: Annotated[bool, typer.Option("--add", help="Write the model with what was found to --out.")] = False,
    model_file: Annotated[
        Path | None, typer.Option("--out", help="Model file that --add writes; without it my_hand.yaml.")
    ] = None,
    objects: Objects = None,
    scale: Scale = None,
    topics: Topics = None,
    signals: Signals = None,
    rig: RigFile = None,
    max_effects: MaxEffects = None,
    greedy: Greedy = None,
    jobs: Jobs = _JOBS,
    dask: Dask = None,
    no_cache: NoCache = False,
    report: ReportFile = None,
    json: Json = False,
) -> None:
    """Which physical effect does the model lack: nothing, effects of the catalogue, or something unknown?"""
    if model_file is not None and not add:
        raise HannesError(f"--out {model_file}: only --add writes a model file; say --add too.")
    out = model_file or Path("my_hand.yaml")
    _check_files(report, out if add else None)
    prepared = _prepared(bags, model, objects, signals, rig, scale, jobs, topics)
    _check_effects(prepared, [*(only or ()), *(effects or ())])
    with _Progress(quiet=json) as progress, _executor(jobs, dask, no_cache) as executor:
        found = diagnose_model(
            prepared,
            effect_sources(effects or (), only=only, model=prepared.model),
            executor=executor,
            progress=progress,
            max_effects=max_effects,
            greedy=greedy,
        )
    try:
        if json:
            print_json(found.to_dict() | {"model_file": str(out) if add else None})
        else:
            _show_diagnosis(found, prepared.rig.machine)
    finally:
        if add:
            named = replace(found.model, name=out.stem)
            with_provenance(named, prepared, found.falls, _command()).save(out)
        if report:
            _report_of(report, prepared, found)
    if add and found.verdict == "unknown" and found.effects and not json:
        typer.echo("The model file holds the nearest effects, which are no finding.")
    _say_files(json, report, out if add else None)


def _before(prepared: Prepared, found: Diagnosis | Addition) -> Comparison:
    """The given model beside the recordings: fitted, where something was added to it, so that this is all they differ
    in."""
    return compare_model(
        found.moved or prepared, values=found.nominal if found.effects else None, fitted=bool(found.effects)
    )


def _after(prepared: Prepared, found: Diagnosis | Addition) -> Comparison:
    return compare_model(replace(found.moved or prepared, model=found.model), values=found.values)


def _report_of(path: Path, prepared: Prepared, found: Diagnosis | Addition) -> None:
    """The report of a model before and after what was found."""
    _write_report(path, comparison=_before(prepared, found), after=_after(prepared, found), diagnosis=found)


def _show_diagnosis(found: Diagnosis, machine: str) -> None:
    console = text_console()
    console.print(f"[bold]{found.verdict.upper()}[/bold]  {found.summary}")
    if found.verdict == "unknown" and found.effects:
        console.print(f"\n{NO_FINDING}")
    for effect in found.effects:
        console.print(f"\n[bold]{effect.title}[/bold] ({effect.name})")
        for name, p in effect.parameters.items():
            note = "" if p.identified else "   not identified by these data"
            value, span = estimate(p.value, p.low, p.high, p.unit)
            console.print(f"  {name} = {value}   95 %: {span}{note}")
        console.print(f"  {effect.why}")
    _show_falls(console, found, machine)
    if found.ranking and not has_excess(found.costs, bool(found.effects)):
        console.print("\nThere is no excess misfit that effects could explain: chance explains all of it.")
    elif found.ranking:
        console.print(
            "\nRanking (part of the excess misfit that each effect explains alone, at least: only the best are fitted "
            "to the end; each parameter costs):"
        )
        for rank in found.ranking[:8]:
            console.print(f"  {100 * rank.explained:5.1f} %  {' + '.join(rank.names)}")
    _show_experiments(console, found.experiments)
    if found.verdict == "unknown":
        console.print("\nThe rest depends on: " + ", ".join(d.said for d in found.depends_on))
    for note in found.notes:
        console.print(f"note: {note}", style="dim")


def _show_experiments(console: Console, experiments: Sequence[Experiment]) -> None:
    for experiment in (e for e in experiments if e.distance >= VISIBLE):
        tied = ", ".join(" + ".join(names) for names in experiment.separates)
        console.print(
            f"\nTo tell apart {tied}: {experiment.name} (they differ by {number(experiment.distance, 3)} standard "
            f"deviations of the noise there)\n  {experiment.to_dict()['command']}"
        )


_LISTED = 3
"""Conditions that a line of the table names each; of more, the worst alone (all are in --json and the report)."""


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
    for name in ("training\nclosures", "held-out\nclosures"):
        table.add_column(name, justify="right")
    table.add_column("held-out\nconditions", overflow="fold")
    for signal in signals:
        table.add_column(_heading(signal, units[signal]), justify="right")
    for k, fall in enumerate(found.falls):
        if len(fall.by_condition) > _LISTED:
            worst = max(fall.by_condition, key=fall.by_condition.__getitem__)
            conditions = f"at most {number(fall.by_condition[worst], 3)}, {worst}"
        else:
            conditions = ", ".join(f"{c} {number(v, 3)}" for c, v in fall.by_condition.items())
        if len(fall.by_condition) > 1:
            conditions = f"{number(fall.held_out_conditions, 3)} ({conditions})"
        table.add_row(
            step_name(k, fall.added),
            number(fall.train, 3),
            number(fall.held_out, 3),
            conditions,
            *(number(fall.held_out_signals.get(s, math.nan), 3) for s in signals),
        )
    show_table(table, TEXT_WIDTH)
    if signals:
        console.print("The last columns: error of each signal on held-out conditions.", style="dim")


def _heading(signal: str, unit: str) -> str:
    """A signal as the heading of a column, with its unit."""
    return signal.replace("_", "\n", 1) + ("" if unit == "1" else f", {unit}")


def _show_falls_in_units(found: Diagnosis | Addition, units: dict[str, str]) -> None:
    """The table where nothing was repeated: there is no repeatability to give the errors in."""
    held, steps = errors_in_units([fall.to_dict() for fall in found.falls])
    table = Table(title="Error on conditions that were left out of the fit" if held else "Error of the fit")
    table.add_column("model", no_wrap=True)
    for signal in steps[-1]:
        table.add_column(_heading(signal, units[signal]), justify="right")
    for k, (fall, errors) in enumerate(zip(found.falls, steps, strict=True)):
        table.add_row(step_name(k, fall.added), *(number(errors.get(s, math.nan), 3) for s in steps[-1]))
    show_table(table, TEXT_WIDTH)


@interruptible
def add(
    bags: Bags,
    effects: Annotated[list[str], typer.Option("--effect", help="Effect by name, or path.py:Class.")],
    model: ModelFile = "nominal",
    out: Annotated[Path, typer.Option("--out", help="Model file to write.")] = Path("my_hand.yaml"),
    objects: Objects = None,
    scale: Scale = None,
    topics: Topics = None,
    signals: Signals = None,
    rig: RigFile = None,
    jobs: Jobs = _JOBS,
    dask: Dask = None,
    no_cache: NoCache = False,
    report: ReportFile = None,
    json: Json = False,
) -> None:
    """Add effects to the model, fit them, and show the error fall on held-out data."""
    _check_files(report, out)
    prepared = _prepared(bags, model, objects, signals, rig, scale, jobs, topics)
    _check_effects(prepared, effects or ())
    with _Progress(quiet=json) as progress, _executor(jobs, dask, no_cache) as executor:
        found = add_effects(
            prepared,
            effect_sources(only=effects, model=prepared.model),
            executor=executor,
            progress=progress,
        )
    try:
        if json:
            print_json(found.to_dict() | {"model_file": str(out)})
        else:
            _show_addition(found, prepared.rig.machine)
    finally:
        replace(
            found.model, name=out.stem, provenance={**found.model.provenance, "command": _command()}
        ).save(out)
        if report:
            _report_of(report, prepared, found)
    _say_files(json, report, out)


def _show_addition(found: Addition, machine: str) -> None:
    console = text_console()
    for effect in found.effects:
        known = {n: estimate(p.value, p.low, p.high, p.unit) for n, p in effect.parameters.items()}
        values = ", ".join(f"{n} = {value} ({span})" for n, (value, span) in known.items())
        console.print(f"[bold]{effect.title}[/bold]: {values}")
    _show_falls(console, found, machine)
    for note in found.notes:
        console.print(f"note: {note}", style="dim")


def hide(
    out: Annotated[Path, typer.Argument(help="Folder for the bags, one per condition.")],
    truth: Annotated[
        Path, typer.Option("--truth", help="New file for the truth; keep it away from the bags.")
    ],
    effects: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            help="NAME or path.py:Class, of typical strength, or with =FACTOR of so many times that; leave it "
            "out to hide nothing.",
        ),
    ] = None,
    model: ModelFile = "nominal",
    seed: Annotated[int, typer.Option(min=0, help="Seed of hand, scatter and noise.")] = 0,
    closures: Annotated[int, typer.Option(min=1, help="Closures per condition.")] = 13,
    conditions: Annotated[
        list[str] | None,
        typer.Option(
            "--condition",
            help="Condition, once for each: slow, fast, creep (on nothing), grasp (rigid), grasp_soft, grasp_fast "
            "(soft); default slow fast grasp.",
        ),
    ] = None,
    sensors: Annotated[
        str, typer.Option(help="thesis (30 Hz rectified current) or bench (100 Hz, signed).")
    ] = "thesis",
    json: Json = False,
) -> None:
    """Make a measurement set with a hidden effect, to test the lab or to learn what an effect looks like."""
    from .hide import DEFAULT_CONDITIONS, empty_trial, make_set, write_set

    check_writable(truth, "The truth")
    wanted: dict[str, float] = {}
    for text in effects or ():
        name, _, factor = text.partition("=")
        if name in wanted:
            raise HannesError(f"--effect {name} is given more than once; give one factor.")
        try:
            wanted[name] = float(factor) if factor else 1.0
        except ValueError as error:
            raise HannesError(
                f"--effect {text}: give NAME or NAME=FACTOR with a number as the factor."
            ) from error

    for given in wanted.items():
        _check_factor(*given)
    hand, trial = Model.load(model), empty_trial("fast")
    check_own_code(HandRig([trial]), hand)

    def simulate(source: str) -> None:
        entry = strength_of(source, wanted[source])
        make_set(hand, [entry], seed=seed, closures=1, conditions=["fast"], scatter=0.0)

    check_own_effects(wanted, simulate, along_reference(trial, trial.reference))
    entries = [strength_of(name, factor) for name, factor in wanted.items()]
    recordings, hidden = make_set(
        hand,
        entries,
        seed=seed,
        closures=closures,
        sensors=sensors,
        conditions=conditions or DEFAULT_CONDITIONS,
    )
    bags = write_set(recordings, hidden, out, truth)
    if json:
        print_json({"bags": [str(b) for b in bags], "truth": str(truth)})
        return
    typer.echo(f"{len(bags)} bags in {out}, the truth in {truth}")


def _check_factor(source: str, factor: float) -> None:
    """Refuse a strength that hides nothing, or another one than was asked for."""
    main = load_effect(source).strength()
    value = factor * main.typical
    if not math.isfinite(factor) or factor == 0.0 or not main.lower <= value <= main.upper:
        low, high = sorted((main.lower / main.typical, main.upper / main.typical))
        raise HannesError(
            f"--effect {source}={factor:g}: {main.name} would be {value:g} {main.unit}; its range is {main.lower:g} .. "
            f"{main.upper:g}, factors {low:.3g} .. {high:.3g} but not 0."
        )


@interruptible
def report(
    bags: Bags,
    out: Annotated[Path, typer.Option("--out", help=f"File to write: {REPORT}.")] = Path("report.html"),
    model: ModelFile = "nominal",
    effects: Effects = None,
    objects: Objects = None,
    scale: Scale = None,
    topics: Topics = None,
    signals: Signals = None,
    rig: RigFile = None,
    max_effects: MaxEffects = None,
    greedy: Greedy = None,
    jobs: Jobs = _JOBS,
    dask: Dask = None,
    no_cache: NoCache = False,
    json: Json = False,
) -> None:
    """Compare, diagnose and add, all on one self-contained HTML page."""
    _check_files(out)
    prepared = _prepared(bags, model, objects, signals, rig, scale, jobs, topics)
    _check_effects(prepared, effects or ())
    with _Progress(quiet=json) as progress, _executor(jobs, dask, no_cache) as executor:
        found = diagnose_model(
            prepared,
            effect_sources(effects or (), model=prepared.model),
            executor=executor,
            progress=progress,
            max_effects=max_effects,
            greedy=greedy,
        )
    try:
        if json:
            print_json({"report": str(out), "verdict": found.verdict})
        else:
            typer.echo(found.summary)
    finally:
        _report_of(out, prepared, found)
    _say_files(json, out)


def _write_report(
    path: Path, *, comparison: Comparison, after: Comparison | None, diagnosis: Diagnosis | Addition | None
) -> None:
    from .pictures import ENDINGS, write_picture
    from .report import write_report

    parts = {
        "comparison": finite(comparison.to_dict()),
        "after": finite(after.to_dict()) if after else None,
        "diagnosis": finite(diagnosis.to_dict()) if diagnosis else None,
        "title": "Hannes: model against measurement",
    }
    if path.suffix.lower() in ENDINGS:
        write_picture(path, **parts)
    else:
        write_report(path, **parts, command=_command())


def _check_files(report: Path | None, model_file: Path | None = None) -> None:
    """Refuse files that cannot be written, before the work begins."""
    if report is not None:
        from .pictures import ENDINGS

        if report.suffix.lower() not in ("", ".html", ".htm", *ENDINGS):
            raise HannesError(
                f"The report {report} must end in .html, or for a picture in {', '.join(ENDINGS)}."
            )
        check_writable(report, "The report")
    if model_file is not None:
        check_model_file(model_file)


def _say_files(json: bool, report: Path | None, model_file: Path | None = None) -> None:
    """Where the files are that were written; with --json the output is the answer alone."""
    if model_file and not json:
        typer.echo(f"Model file: {model_file}")
    if report and not json:
        typer.echo(f"Report: {report.resolve()}")
