"""The lab's commands: compare, diagnose, add, hide, report."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.output import between, finite, print_json

from .cli_files import Output, check_files, check_writable, deliver
from .cli_options import (
    JOBS,
    REPORT,
    Bags,
    Dask,
    Effects,
    Greedy,
    Jobs,
    Json,
    LeaveOut,
    MaxEffects,
    ModelFile,
    NoCache,
    Objects,
    ReportFile,
    RigFile,
    Scale,
    Signals,
    Topics,
)
from .cli_progress import ConsoleProgress
from .interruptible import interruptible

if TYPE_CHECKING:
    from .add import Addition
    from .compare import Comparison
    from .diagnosis import Diagnosis
    from .prepare import Prepared


def compare(
    bags: Bags,
    model: ModelFile = None,
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
    leave_out: LeaveOut = None,
    signals: Signals = None,
    rig: RigFile = None,
    report: ReportFile = None,
    json: Json = False,
) -> None:
    """Compare the model with recorded closures: where does it fail, and by how much?"""
    from .cli_show import show_comparison
    from .compare import compare as compare_model
    from .session import executor_of, prepared_from

    check_files(report)
    prepared = prepared_from(bags, model, objects, signals, rig, scale, JOBS, topics, leave_out)
    with (
        ConsoleProgress(quiet=json or not fitted) as progress,
        executor_of(JOBS, None, not fitted) as executor,
    ):
        result = compare_model(prepared, fitted=fitted, executor=executor, progress=progress)
    files = [_report(report, lambda: (result, None), None)] if report else []
    deliver(json, result.to_dict(), lambda: show_comparison(result), files)


@interruptible
def diagnose(
    bags: Bags,
    model: ModelFile = None,
    effects: Effects = None,
    only: Annotated[list[str] | None, typer.Option("--only", help="Consider only these effects.")] = None,
    add: Annotated[bool, typer.Option("--add", help="Write the model with what was found to --out.")] = False,
    model_file: Annotated[
        Path | None, typer.Option("--out", help="Model file that --add writes; without it my_hand.yaml.")
    ] = None,
    objects: Objects = None,
    scale: Scale = None,
    topics: Topics = None,
    leave_out: LeaveOut = None,
    signals: Signals = None,
    rig: RigFile = None,
    max_effects: MaxEffects = None,
    greedy: Greedy = None,
    jobs: Jobs = JOBS,
    dask: Dask = None,
    no_cache: NoCache = False,
    report: ReportFile = None,
    json: Json = False,
) -> None:
    """Which physical effect does the model lack: nothing, effects of the catalogue, or something unknown?"""
    from .cli_show import show_diagnosis
    from .diagnose import diagnose as diagnose_model
    from .diagnose import effect_sources
    from .session import executor_of, prepared_from, try_effects

    if model_file is not None and not add:
        raise HannesError(f"--out {model_file}: only --add writes a model file; say --add too.")
    out = model_file or Path("my_hand.yaml")
    check_files(report, out if add else None)
    prepared = prepared_from(bags, model, objects, signals, rig, scale, jobs, topics, leave_out)
    try_effects(prepared, [*(only or ()), *(effects or ())])
    with ConsoleProgress(quiet=json) as progress, executor_of(jobs, dask, no_cache) as executor:
        found = diagnose_model(
            prepared,
            effect_sources(effects or (), only=only, model=prepared.model),
            executor=executor,
            progress=progress,
            max_effects=max_effects,
            greedy=greedy,
        )
    files = [_model_file(found, out)] if add else []
    files += [_report_of(report, prepared, found)] if report else []
    answer = found.to_dict() | {"model_file": str(out) if add else None}
    deliver(json, answer, lambda: show_diagnosis(found, prepared.rig.machine), files)


@interruptible
def add(
    bags: Bags,
    effects: Annotated[list[str], typer.Option("--effect", help="Effect by name, or path.py:Class.")],
    model: ModelFile = None,
    out: Annotated[Path, typer.Option("--out", help="Model file to write.")] = Path("my_hand.yaml"),
    objects: Objects = None,
    scale: Scale = None,
    topics: Topics = None,
    leave_out: LeaveOut = None,
    signals: Signals = None,
    rig: RigFile = None,
    jobs: Jobs = JOBS,
    dask: Dask = None,
    no_cache: NoCache = False,
    report: ReportFile = None,
    json: Json = False,
) -> None:
    """Add effects to the model, fit them, and show the error fall on held-out data."""
    from .add import add_effects
    from .cli_show import show_addition
    from .diagnose import effect_sources
    from .session import executor_of, prepared_from, try_effects

    check_files(report, out)
    prepared = prepared_from(bags, model, objects, signals, rig, scale, jobs, topics, leave_out)
    try_effects(prepared, effects or ())
    with ConsoleProgress(quiet=json) as progress, executor_of(jobs, dask, no_cache) as executor:
        found = add_effects(
            prepared,
            effect_sources(only=effects, model=prepared.model),
            executor=executor,
            progress=progress,
        )
    files = [_model_file(found, out), *([_report_of(report, prepared, found)] if report else [])]
    answer = found.to_dict() | {"model_file": str(out)}
    deliver(json, answer, lambda: show_addition(found, prepared.rig.machine), files)


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
    values: Annotated[
        list[str] | None,
        typer.Option(
            "--value",
            help="EFFECT.PARAMETER=NUMBER in SI, once for each: a strength or a shape of a hidden effect, such as "
            "cogging.period=2.9.",
        ),
    ] = None,
    model: Annotated[
        str, typer.Option("--model", help="Model file, or the name of a shipped model.")
    ] = "nominal",
    seed: Annotated[int, typer.Option(min=0, help="Seed of hand, scatter and noise.")] = 0,
    closures: Annotated[
        int, typer.Option(min=1, help="Closures per condition; of each recording the first may be left out.")
    ] = 13,
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
    from .hand import HandRig
    from .hide import DEFAULT_CONDITIONS, empty_trial, entries_of, make_set, visibility, write_set
    from .own_effect import along_reference, check_own_effects
    from .own_law import check_own_code

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
    entries = entries_of(wanted, values or ())
    hand, trial = Model.load(model), empty_trial("fast")
    check_own_code(HandRig([trial]), hand)

    def simulate(source: str) -> None:
        make_set(hand, [entries[source]], seed=seed, closures=1, conditions=["fast"], scatter=0.0)

    check_own_effects(wanted, simulate, along_reference(trial, trial.reference))
    asked = partial(
        make_set,
        hand,
        seed=seed,
        closures=closures,
        sensors=sensors,
        conditions=conditions or DEFAULT_CONDITIONS,
    )
    recordings, hidden = asked(list(entries.values()))
    if entries:
        hidden = replace(hidden, visible=visibility(recordings, asked([])[0]))
    bags = write_set(recordings, hidden, out, truth)
    if json:
        print_json({"bags": [str(b) for b in bags], "truth": str(truth)})
        return
    typer.echo(f"{len(bags)} bags in {out}, the truth in {truth}")
    if hidden.visible:
        signals = dict.fromkeys(name for own in hidden.visible.values() for name in own)
        seen = {name: [own[name] for own in hidden.visible.values() if name in own] for name in signals}
        told = ", ".join(f"{name} {between(min(own), max(own), 2)}" for name, own in seen.items())
        typer.echo(
            f"What is hidden moves the mean closure by {told} times the closures' scatter (over the conditions), "
            "before the hand's own parameters take over what they can."
        )


def _check_factor(source: str, factor: float) -> None:
    """Refuse a strength that hides nothing, or another one than was asked for."""
    from hannes_sim.effect import load_effect

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
    model: ModelFile = None,
    effects: Effects = None,
    objects: Objects = None,
    scale: Scale = None,
    topics: Topics = None,
    leave_out: LeaveOut = None,
    signals: Signals = None,
    rig: RigFile = None,
    max_effects: MaxEffects = None,
    greedy: Greedy = None,
    jobs: Jobs = JOBS,
    dask: Dask = None,
    no_cache: NoCache = False,
    json: Json = False,
) -> None:
    """Compare, diagnose and add, all on one self-contained HTML page."""
    from .diagnose import diagnose as diagnose_model
    from .diagnose import effect_sources
    from .session import executor_of, prepared_from, try_effects

    check_files(out)
    prepared = prepared_from(bags, model, objects, signals, rig, scale, jobs, topics, leave_out)
    try_effects(prepared, effects or ())
    with ConsoleProgress(quiet=json) as progress, executor_of(jobs, dask, no_cache) as executor:
        found = diagnose_model(
            prepared,
            effect_sources(effects or (), model=prepared.model),
            executor=executor,
            progress=progress,
            max_effects=max_effects,
            greedy=greedy,
        )
    answer = {"report": str(out), "verdict": found.verdict}
    deliver(json, answer, lambda: typer.echo(found.summary), [_report_of(out, prepared, found)])


def _model_file(found: Diagnosis | Addition, path: Path) -> Output:
    from .diagnosis import Diagnosis
    from .provenance import own_command, save_model

    remarks = []
    if isinstance(found, Diagnosis) and found.verdict == "unknown":
        nearest = "of the nearest effects, which are no finding"
        remarks = [
            nearest if found.effects else "the fitted nominal model, which does not explain the recordings"
        ]
    left_out = sorted({name.partition("@")[0] for name in found.model.provenance["recordings"]})
    if left_out:
        remarks.append(f"without what is of the recordings: {', '.join(left_out)}")
    return Output(
        "Model file", path, lambda to: save_model(found.model, to, own_command()), "; ".join(remarks)
    )


def _report_of(path: Path, prepared: Prepared, found: Diagnosis | Addition) -> Output:
    """The report of a model before and after what was found."""
    from .session import after, before

    return _report(path, lambda: (before(prepared, found), after(prepared, found)), found)


def _report(
    path: Path,
    compared: Callable[[], tuple[Comparison, Comparison | None]],
    found: Diagnosis | Addition | None,
) -> Output:
    """A report, or a picture by the ending of its name, of a comparison, and of another after what was found."""
    from .pictures import ENDINGS, write_picture
    from .provenance import own_command
    from .report import write_report

    def write(to: Path) -> None:
        first, then = compared()
        parts = {
            "comparison": finite(first.to_dict()),
            "after": finite(then.to_dict()) if then else None,
            "diagnosis": finite(found.to_dict()) if found else None,
            "title": "Hannes: model against measurement",
        }
        if to.suffix.lower() in ENDINGS:
            write_picture(to, **parts)
        else:
            write_report(to, **parts, command=own_command())

    return Output("Report", path.resolve(), write)
