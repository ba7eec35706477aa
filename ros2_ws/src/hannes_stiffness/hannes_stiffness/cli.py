"""`hannes stiffness`: data sets, training and evaluation of the stiffness classifier."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.output import print_json, print_table
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
ClosuresOption = Annotated[int, typer.Option(help="Closures to simulate.", min=15, max=1_000_000)]
HandsOption = Annotated[
    int, typer.Option(help="Hands of the population; 1 is the model as it is.", min=1, max=100_000)
]
ModelOption = Annotated[
    list[str],
    typer.Option(help="Model by name or path of a model file; give several to draw from each in turn."),
]
JobsOption = Annotated[int, typer.Option(help="Processes; the result does not depend on it.", min=1, max=256)]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
VarietyOption = Annotated[
    str,
    typer.Option(
        help="What is drawn: wide (100 N/m to 100 kN/m, all shapes, hidden effects), narrow or two (stiffnesses)."
    ),
]
ObjectsOption = Annotated[
    int | None, typer.Option(help="Different objects; without it every closure has its own.", min=1)
]
ClassifierOption = Annotated[
    str,
    typer.Option(help="Trained classifier (.onnx), or baseline (the thesis' method); empty: the default."),
]

# Data sets that are scored but not trained on have seeds of their own, so that no closure occurs twice.
_HELD_OUT_SEED = 1_000_003
# Shapes exist in the multi-body plant only, which most closures are therefore of; the hand that was calibrated to the
# thesis' figures is the nearest to a real one.
_MODELS = ["thesis_hand", "nominal_mujoco", "thesis_hand", "nominal"]


@app.command()
def dataset(
    out: Annotated[
        Path, typer.Option(help="Folder of the bag set; given again, it goes on where it stopped.")
    ],
    seed: SeedOption = 1,
    closures: ClosuresOption = 4800,
    hands: HandsOption = 2400,
    objects: ObjectsOption = 2400,
    variety: VarietyOption = "wide",
    model: ModelOption = _MODELS,
    jobs: JobsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Simulate closures on nothing and on objects, measured as the thesis measures; write a bag set with a manifest."""
    made = _simulate("closures", closures, seed, hands, model, jobs, variety, objects, out)
    size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
    result = {"folder": str(out), "bytes": size, **made.manifest}
    _show(
        result,
        as_json,
        lambda: print(
            f"{closures} closures ({_listed(made.manifest['kinds'])}) on {made.manifest['objects']} objects by "
            f"{made.manifest['hands']} hand(s), model {', '.join(made.manifest['models'])}, "
            f"{len(made.manifest['diverged'])} diverged: {out} ({size / 1e6:.1f} MB)"
        ),
    )


@app.command()
def train(
    out: Annotated[
        Path, typer.Option(help="Trained file to write (.onnx; its manifest stands beside it as .json).")
    ],
    seed: SeedOption = 1,
    data: Annotated[
        list[Path] | None,
        typer.Option(help="Bag set of `dataset`, or several; without it, closures are simulated."),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            help="best (compares all, takes the best one on windows), thesis (bagged trees on single samples), "
            "forest, boosting, network or logistic."
        ),
    ] = "best",
    closures: ClosuresOption = 1200,
    hands: HandsOption = 300,
    objects: ObjectsOption = 600,
    variety: VarietyOption = "wide",
    model: ModelOption = _MODELS,
    jobs: JobsOption = 1,
    current: Annotated[str, typer.Option(help="Current as the feature: rectified or signed.")] = "rectified",
    void_current: Annotated[
        float,
        typer.Option(
            help="A below which a sample is void by rule; 0: contact alone decides.", min=0.0, max=10.0
        ),
    ] = 0.3,
    trees: Annotated[int, typer.Option(help="Trees in the bag.", min=1, max=1000)] = 30,
    leaves: Annotated[int, typer.Option(help="Most leaves of a tree.", min=2, max=100_000)] = 256,
    folds: Annotated[int, typer.Option(help="Folds of the cross-validation.", min=2, max=100)] = 5,
    held_out: Annotated[
        int | None, typer.Option(help="Closures that are scored only; without it a quarter as many.", min=0)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Train a classifier with calibrated probabilities and an estimate of the stiffness, and store it."""
    from .classifier import StiffnessClassifier
    from .dataset import Dataset, merge
    from .models import TreeSettings
    from .training import check
    from .training import train as train_classifier

    check(method, out)
    settings = TreeSettings(trees=trees, leaves=leaves, folds=folds)
    if data:
        training = merge([Dataset.load(folder) for folder in data])
    else:
        training = _simulate("training", closures, seed, hands, model, jobs, variety, objects)
    count = max(60, len(training.closures) // 4) if held_out is None else held_out
    others = {}
    for name in dict.fromkeys(model) if count else ():
        title = f"held_out, {Model.load(name).name}"
        others[title] = _simulate(title, count, seed + _HELD_OUT_SEED, hands, [name], jobs, variety)
    path = train_classifier(
        training, out, seed=seed, method=method, current=current, void_current=void_current, settings=settings,
        held_out=others, say=_say,
    )  # fmt: skip
    manifest = dict(StiffnessClassifier.load(path).manifest)
    _show({"file": str(path), **manifest}, as_json, lambda: _print_training(path, manifest))


@app.command()
def evaluate(
    bags: Annotated[list[Path], typer.Argument(help="Bags of closures, or folders of bags.")],
    classifier: ClassifierOption = "",
    kind: Annotated[
        str | None,
        typer.Option(
            help=f"What was grasped ({', '.join(STIFFNESS_CLASSES)}), instead of what the bags say."
        ),
    ] = None,
    pictures: Annotated[Path | None, typer.Option(help="Folder for pictures of closures and scores.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Score the classifier on bags: windows as the thesis does, grasps, latency, reliability, stiffness."""
    from hannes_bags.reading import read_and_say

    from .classifier import StiffnessClassifier
    from .evaluation import answer, scores_of
    from .training import measured_closures

    loaded = StiffnessClassifier.load(classifier)
    closures = []
    for bag in _bags(bags):
        _say(f"Reading {bag}.")
        closures += measured_closures(read_and_say(bag, _say), kind)
    answered = answer(loaded, closures)
    result = scores_of(answered)
    if pictures is not None:
        from .pictures import draw

        for path in draw(answered, result, pictures):
            _say(f"Picture: {path}")
    _show(
        {
            "classifier": loaded.manifest["onnx"]["sha256"],
            "method": loaded.manifest["method"],
            "bags": [str(b) for b in bags],
            **result,
        },
        as_json,
        lambda: _print_scores(result),
    )


def _bags(given: Sequence[Path]) -> list[Path]:
    """The bags; a bag set stands for all of its parts, a folder of bags for the bags in it."""
    from hannes_bags.storage import find_bags

    from .dataset import MANIFEST

    out: list[Path] = []
    for path in given:
        out += sorted(path.glob("part_*[0-9]")) if (path / MANIFEST).is_file() else find_bags([path])
    return out


def _simulate(
    what: str,
    closures: int,
    seed: int,
    hands: int,
    names: Sequence[str],
    jobs: int,
    variety: str,
    objects: int | None = None,
    folder: Path | None = None,
) -> Dataset:
    from .dataset import draw_scenes, make_dataset

    models = {name: Model.load(name) for name in names}
    scenes = draw_scenes(
        closures,
        seed,
        hands=hands,
        models=[models[name].name for name in names],
        variety=variety,
        objects=objects,
    )
    with _progress(what) as progress:
        return make_dataset(scenes, *models.values(), seed=seed, jobs=jobs, folder=folder, progress=progress)


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
        print_json(result)
    else:
        table()


def _listed(counts: dict[str, Any]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.2f}\u00a0%"  # no line ends before the sign


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    print_table("", columns, rows, right=range(1, len(columns)))


def _row(name: str, score: dict[str, Any]) -> list[str]:
    return [
        name,
        str(score["count"]),
        _percent(score["f1"]),
        *(_percent(score["classes"][c]["f1"]) for c in STIFFNESS_CLASSES),
    ]


_COLUMNS = ("", "windows", "F1", *(f"F1 {name}" for name in STIFFNESS_CLASSES))


def _print_training(path: Path, manifest: dict[str, Any]) -> None:
    scores = manifest["scores"]
    rows = [
        [
            score["title"],
            grouping,
            f"{score[grouping]['log_loss']:.4f}",
            _percent(score[grouping]["right"]),
            _percent(score[grouping]["overlap_50ms"]["f1"]),
            _percent(score[grouping]["hop_50ms"]["f1"]),
        ]
        for score in scores["cross_validation"].values()
        for grouping in score
        if isinstance(score[grouping], dict)
    ]
    print("Cross-validation; no group is split. Right and log loss: samples on which no rule decides.")
    _table(("method", "groups", "log loss", "right", "window F1, hop 150 ms", "hop 50 ms"), rows)
    rows = [
        [
            name,
            str(s["closures"]),
            *(_percent(s[part]["f1"]) for part in ("overlap_50ms", "hop_50ms", "grasps")),
        ]
        for name, s in scores.items()
        if name != "cross_validation"
    ]
    if rows:
        _table(("not trained on", "closures", "window F1, hop 150 ms", "hop 50 ms", "grasp F1"), rows)
    print(
        f"F1 is the mean over the classes. Method: {manifest['method']}; trained on "
        f"{_listed(manifest['training']['kinds'])} closures, seed {manifest['seed']}: {path} "
        f"({manifest['onnx']['bytes'] / 1e3:.0f} kB), manifest {path.with_suffix('.json')}"
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
    print("Grasps")
    late = result["latency"]["objects"]
    _table(
        (*_COLUMNS[:1], "grasps", *_COLUMNS[2:], "median latency, ms"),
        [
            [*_row(name, s), _milliseconds(late.get(name, {}).get("from_contact_median_s"))]
            for name, s in result["grasps"]["objects"].items()
        ]
        + [
            [
                *_row("pooled", result["grasps"]["pooled"]),
                _milliseconds(result["latency"]["pooled"]["from_contact_median_s"]),
            ]
        ],
    )
    print(
        "Confusion of windows, hop 50 ms (rows true, columns answered): "
        + "; ".join(
            f"{name} {counts}"
            for name, counts in zip(STIFFNESS_CLASSES, result["hop_50ms"]["pooled"]["confusion"], strict=True)
        )
    )
    refused, error = result["not_sure"], result["reliability"]["expected_calibration_error"]
    print(
        f"Where no rule decides: {_percent(refused['part'])} not sure, {_percent(refused['right_when_sure'])} of the "
        f"others right ({_percent(refused['right_if_forced'])} if forced); calibration error {error}."
    )
    stiff = result["stiffness"]["grasps"]
    if stiff["count"]:
        print(
            f"Stiffness of {stiff['count']} grasps: {_percent(stiff['within_factor'])} within a factor "
            f"{result['stiffness']['factor']}, interval (a factor {stiff['interval_factor']:.2f} either way) holds "
            f"{_percent(stiff['covered'])}."
        )


def _milliseconds(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.0f}"


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
