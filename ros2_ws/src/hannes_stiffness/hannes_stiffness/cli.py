"""`hannes stiffness`: data sets, training and evaluation of the stiffness classifier."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.signals import STIFFNESS_CLASSES

if TYPE_CHECKING:
    from .dataset import Dataset

app = typer.Typer(
    help="Void, rigid or soft: data sets, training and scores of the stiffness classifier.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

SeedOption = Annotated[int, typer.Option(help="Seed; the same seed gives the same result.", min=0)]
ClosuresOption = Annotated[
    int, typer.Option(help="Closures to simulate, a third of each kind.", min=15, max=1_000_000)
]
HandsOption = Annotated[
    int, typer.Option(help="Hands of the population; 1 is the model as it is.", min=1, max=100_000)
]
ModelOption = Annotated[
    list[str],
    typer.Option(help="Model by name or path of a model file; give several to draw from each in turn."),
]
JobsOption = Annotated[int, typer.Option(help="Processes; the result does not depend on it.", min=1, max=256)]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
ClassifierOption = Annotated[str, typer.Option(help="Trained classifier (.onnx); empty: the one installed.")]

# Data sets that are scored but not trained on have seeds of their own, so that no closure occurs twice.
_HELD_OUT_SEED = 1_000_003


@app.command()
def dataset(
    out: Annotated[Path, typer.Option(help="File to write (.npz).")],
    seed: SeedOption = 1,
    closures: ClosuresOption = 1200,
    hands: HandsOption = 1,
    model: ModelOption = ["nominal"],  # noqa: B006 (typer copies it)
    jobs: JobsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Simulate closures on nothing, on soft and on rigid objects, measured as the thesis measures."""
    made = _simulate("closures", closures, seed, hands, model, jobs)
    path = made.save(out)
    result = {"file": str(path), "bytes": path.stat().st_size, **made.manifest}
    _show(
        result,
        as_json,
        lambda: print(
            f"{closures} closures ({_listed(made.manifest['kinds'])}) of {hands} hand(s), "
            f"model {', '.join(made.manifest['models'])}: {path} ({path.stat().st_size / 1e6:.1f} MB)"
        ),
    )


@app.command()
def train(
    out: Annotated[
        Path, typer.Option(help="Trained file to write (.onnx; its manifest stands beside it as .json).")
    ],
    seed: SeedOption = 1,
    data: Annotated[
        Path | None, typer.Option(help="Data set (.npz); without it, closures are simulated.")
    ] = None,
    closures: ClosuresOption = 1200,
    hands: HandsOption = 1,
    model: ModelOption = ["nominal"],  # noqa: B006 (typer copies it)
    jobs: JobsOption = 1,
    current: Annotated[str, typer.Option(help="Current as the feature: rectified or signed.")] = "rectified",
    trees: Annotated[int, typer.Option(help="Trees in the bag.", min=1, max=1000)] = 30,
    leaves: Annotated[int, typer.Option(help="Most leaves of a tree.", min=2, max=100_000)] = 256,
    as_json: JsonOption = False,
) -> None:
    """Train the thesis' bagged trees on single samples, score them on unseen closures, and store them."""
    from .classifier import StiffnessClassifier, TreeSettings
    from .dataset import Dataset
    from .features import FeatureSpec
    from .training import train as train_trees

    spec, settings = FeatureSpec(current=current), TreeSettings(trees=trees, leaves=leaves)
    training = Dataset.load(data) if data else _simulate("training", closures, seed, hands, model, jobs)
    count = max(60, len(training.closures) // (4 * len(model)))
    held_out = {}
    for name in model:
        for what, step, count_of_hands in (("objects", 1, 1), ("hands", 2, count)):
            title = f"held_out_{what}, {Model.load(name).name}"
            held_out[title] = _simulate(
                title, count, seed + step * _HELD_OUT_SEED, count_of_hands, [name], jobs
            )
    path = train_trees(training, out, seed=seed, spec=spec, settings=settings, held_out=held_out, say=_say)
    manifest = dict(StiffnessClassifier.load(path).manifest)
    _show({"file": str(path), **manifest}, as_json, lambda: _print_training(path, manifest))


@app.command()
def evaluate(
    bags: Annotated[list[Path], typer.Argument(help="Bags of closures.")],
    classifier: ClassifierOption = "",
    kind: Annotated[
        str | None,
        typer.Option(help=f"What was grasped ({', '.join(STIFFNESS_CLASSES)}), where a bag does not say it."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Score the classifier on bags as the thesis does: mode over 200 ms windows, precision, recall and F1."""
    from hannes_bags.reading import read_bag

    from .classifier import StiffnessClassifier
    from .training import evaluate as evaluate_recordings
    from .training import scene_of

    loaded = StiffnessClassifier.load(classifier)
    recordings = []
    for bag in bags:
        _say(f"Reading {bag}.")
        recording = read_bag(bag)
        recordings.append((recording, scene_of(recording, kind)))
    result = evaluate_recordings(loaded, recordings)
    _show(
        {"classifier": loaded.manifest["onnx"]["sha256"], "bags": [str(b) for b in bags], **result},
        as_json,
        lambda: _print_scores(result),
    )


def _simulate(what: str, closures: int, seed: int, hands: int, names: Sequence[str], jobs: int) -> Dataset:
    from .dataset import draw_scenes, make_dataset

    models = [Model.load(name) for name in names]
    scenes = draw_scenes(closures, seed, hands=hands, models=[model.name for model in models])
    with _progress(what) as progress:
        return make_dataset(scenes, *models, seed=seed, jobs=jobs, progress=progress)


@contextmanager
def _progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar on stderr, so that stdout stays the result."""
    if not sys.stderr.isatty():
        _say(f"Simulating {what}.")
        yield lambda done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(f"Simulating {what}", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _show(result: dict[str, Any], as_json: bool, table: Callable[[], None]) -> None:
    if as_json:
        print(json.dumps(result, indent=2, allow_nan=False))
    else:
        table()


def _listed(counts: dict[str, Any]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.2f} %"


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for k, column in enumerate(columns):
        table.add_column(column, justify="left" if k == 0 else "right")
    for row in rows:
        table.add_row(*row)
    Console(width=None if sys.stdout.isatty() else 160).print(table)


def _row(name: str, score: dict[str, Any]) -> list[str]:
    return [
        name,
        str(score["count"]),
        _percent(score["f1"]),
        *(_percent(score["classes"][c]["f1"]) for c in STIFFNESS_CLASSES),
    ]


_COLUMNS = ("", "windows", "F1", *(f"F1 {name}" for name in STIFFNESS_CLASSES))


def _print_training(path: Path, manifest: dict[str, Any]) -> None:
    rows = [
        _row(f"{name}, {part}", score[part])
        for name, score in manifest["scores"].items()
        for part in ("overlap_50ms", "hop_50ms")
    ]
    _table(_COLUMNS, rows)
    print(
        f"F1 is the mean over the classes. Trained on {_listed(manifest['training']['kinds'])} closures, seed "
        f"{manifest['seed']}: {path} ({manifest['onnx']['bytes'] / 1e3:.0f} kB), manifest {path.with_suffix('.json')}"
    )


def _print_scores(result: dict[str, Any]) -> None:
    for part in ("overlap_50ms", "hop_50ms"):
        print(f"Windows of {result[part]['window_s'] * 1e3:.0f} ms, hop {result[part]['hop_s'] * 1e3:.0f} ms")
        _table(
            _COLUMNS,
            [
                *(_row(name, s) for name, s in result[part]["objects"].items()),
                _row("pooled", result[part]["pooled"]),
            ],
        )
    print(
        "Confusion of the last (rows true, columns answered): "
        + "; ".join(
            f"{name} {counts}"
            for name, counts in zip(STIFFNESS_CLASSES, result["hop_50ms"]["pooled"]["confusion"], strict=True)
        )
    )


def main() -> int:
    """The command line of this package alone."""
    try:
        app()
    except HannesError as error:
        print(f"hannes stiffness: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
