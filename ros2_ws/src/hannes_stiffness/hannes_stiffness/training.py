"""From a data set to a trained file, and from recordings to what they were closed on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from hannes_bags.recording import Recording
from hannes_description.errors import HannesError
from hannes_description.signals import STIFFNESS_CLASSES
from hannes_sim.objects import OBJECTS, GraspObject
from numpy.typing import NDArray

from .classifier import StiffnessClassifier, new_file, save
from .dataset import Closure, Dataset, Scene, closure_of, closures_of, kind_of
from .evaluation import answer, kind_name, scores_of, split_grasps
from .features import SINGLE_SAMPLE, FeatureSpec
from .models import (
    METHODS,
    THESIS_METHOD,
    Calibration,
    TrainingData,
    TreeSettings,
    apply_rules,
    cross_validate,
    fit,
    fit_estimator,
    log_loss,
    method_of,
)
from .scoring import HOPS, score_closures

SURE = 0.7
"""Least probability of a sure answer; as they are calibrated, so often are the least sure answers right."""
COMPARED = ("objects", "hands")
"""Groupings of the cross-validation that methods are compared by."""
BEST = "best"


def check(method: str, path: str | Path) -> None:
    """HannesError where a training of this method into this file could not end well, before anything is simulated."""
    if method not in (BEST, *METHODS):
        raise HannesError(f"Method {method!r} is unknown; valid are {', '.join((BEST, *METHODS))}.")
    new_file(path)


def train(
    dataset: Dataset,
    path: str | Path,
    *,
    seed: int,
    method: str = THESIS_METHOD,
    current: str = "rectified",
    void_current: float = 0.3,
    settings: TreeSettings | None = None,
    held_out: Mapping[str, Dataset] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Path:
    """Train on the data set, score by cross-validation and write `path` (.onnx) with its manifest.

    seed      of the models and of the folds
    method    a name of METHODS, or "best": all are compared, and of those on windows the one with the best
              window F1 is taken
    current   "rectified" or "signed"
    void_current  a sample below it is void by rule, A (P19); 0: contact alone decides
    held_out  further data sets by name, none of whose closures was trained on; their scores go into the manifest
    say       told what is going on, one sentence at a time

    The thesis' method is trained as the thesis did: labels by the void current alone (P19), no calibration, no
    estimate. Returns the path of the ONNX file.
    """
    check(method, path)
    settings = settings or TreeSettings()
    names = tuple(METHODS) if method == BEST else (method,)
    specs = {
        name: FeatureSpec(current=current, void_current=void_current, version=method_of(name).features)
        for name in names
    }
    data = {
        (spec.version, contact): dataset.training_data(spec, contact=contact)
        for spec in specs.values()
        for contact in ([False] if method == THESIS_METHOD else [True])
    }
    scores: dict[str, Any] = {}
    out_of_fold: dict[str, NDArray[np.float64]] = {}
    groupings: tuple[str, ...] = ("closures",) if method == THESIS_METHOD else COMPARED
    if all(c.scene.hand == dataset.closures[0].scene.hand for c in dataset.closures):
        # One hand cannot be held out.
        groupings = tuple(g for g in groupings if g != "hands")
    for name in names:
        used = data[specs[name].version, method != THESIS_METHOD]
        scores[name] = {"title": METHODS[name].title, "samples": len(used.labels)}
        for grouping in groupings:
            say(f"{METHODS[name].title}: {settings.folds} folds, no {grouping} in two of them.")
            held = cross_validate(used, seed=seed, settings=settings, method=name, grouping=grouping)
            if grouping == groupings[0]:
                out_of_fold[name] = held
            scores[name][grouping] = _validation(dataset, used, specs[name], held)
    chosen = names[0]
    if method == BEST:
        windows = [n for n in names if METHODS[n].features != SINGLE_SAMPLE]
        # Not the log loss: the probabilities are calibrated afterwards.
        chosen = max(windows, key=lambda n: sum(scores[n][g]["overlap_50ms"]["f1"] for g in groupings))
    spec = specs[chosen]
    used = data[spec.version, method != THESIS_METHOD]
    say(f"Training {METHODS[chosen].title} on all of them.")
    model = fit(used, seed=seed, settings=settings, method=chosen)
    calibration = estimator = None
    if method != THESIS_METHOD:
        open_ = ~used.void
        calibration = Calibration.fit(out_of_fold[chosen][open_], used.labels[open_])
        say("Training the regression of the stiffness.")
        estimator = fit_estimator(used, seed=seed, folds=settings.folds)
    counts = {name: int(np.count_nonzero(used.labels == k)) for k, name in enumerate(STIFFNESS_CLASSES)}
    training = {
        **{k: v for k, v in dataset.manifest.items() if k != "parts"},
        "samples": counts,
        "void_by_rule": int(np.count_nonzero(used.void)),
    }
    content: dict[str, Any] = {
        "method": METHODS[chosen].title,
        "spec": spec,
        "seed": seed,
        "settings": asdict(settings),
        "training": training,
        "calibration": calibration,
        "sure": 0.0 if method == THESIS_METHOD else SURE,
        "estimator": estimator,
    }
    result: dict[str, Any] = {"cross_validation": scores}
    path = save(model, path, scores=result, **content)
    if held_out:
        classifier = StiffnessClassifier.load(path)
        for name, other in held_out.items():
            say(f"Scoring {len(other.closures)} closures that were not trained on ({name}).")
            result[name] = {
                **summary(scores_of(answer(classifier, other.closures), kind_name)),
                "hands": other.manifest.get("hands"),
                "seed": other.manifest.get("seed"),
            }
        save(model, path, scores=result, **content)
    return path


def _validation(
    dataset: Dataset, data: TrainingData, spec: FeatureSpec, held: NDArray[np.float64]
) -> dict[str, Any]:
    """Scores of held-out probabilities: the loss where no rule decides, and the windows."""
    open_ = ~data.void
    truth, said = data.labels, np.argmax(apply_rules(held, data.void), axis=1)
    count = np.bincount(data.closures, minlength=len(dataset.closures))
    cut = np.cumsum(count)[:-1]
    times = [f.time for f in dataset.features(spec)]
    rows = [
        (c.scene.kind, t, a, b)
        for c, t, a, b in zip(dataset.closures, times, np.split(truth, cut), np.split(said, cut), strict=True)
    ]
    return {
        "log_loss": round(log_loss(held[open_], truth[open_]), 5),
        "right": round(float(np.mean(said[open_] == truth[open_])), 5),
        **{name: score_closures(rows, hop).pooled.to_dict() for name, hop in HOPS.items()},
    }


def summary(scores: Mapping[str, Any]) -> dict[str, Any]:
    """Pooled scores only: the file ships, and the per-object ones can be made again."""
    pooled = {name: scores[name]["pooled"] for name in (*HOPS, "grasps", "latency")}
    return {
        "closures": scores["closures"],
        "samples": scores["samples"],
        **pooled,
        **{name: scores[name] for name in ("not_sure", "stiffness")},
    }


def scene_of(recording: Recording, kind: str | None = None) -> Scene:
    """What a recording says it was closed on (metadata `object`, a name or an object's data), or the given kind."""
    said = recording.metadata.get("object")
    name = Path(recording.source).name or "recording"
    known = None
    if isinstance(said, Mapping):
        known = GraspObject.from_dict(said)
    elif said in OBJECTS:
        known = OBJECTS[str(said)]
    if kind is None:
        if isinstance(said, Mapping) or said in OBJECTS:
            kind = kind_of(known)
        elif said in STIFFNESS_CLASSES:
            kind = str(said)
        else:
            raise HannesError(
                f"The recording '{recording.source}' does not say what was grasped (metadata object is {said!r}; "
                f"known are {', '.join(dict.fromkeys((*OBJECTS, *STIFFNESS_CLASSES)))}, or an object's "
                "data); say it with --kind."
            )
    if kind not in STIFFNESS_CLASSES:
        raise HannesError(f"Kind {kind!r} is unknown; valid are {', '.join(STIFFNESS_CLASSES)}.")
    label_ = said if isinstance(said, str) else name
    # Where the object itself is not known, its kind counts alone.
    same = known is not None and kind_of(known) == kind
    grasp = None if kind == STIFFNESS_CLASSES[0] else known if same else GraspObject()
    return Scene(object=label_, kind=kind, grasp=grasp, known=same or grasp is None)


def measured_closures(recording: Recording, kind: str | None = None) -> list[Closure]:
    """The closures of a recording, one a grasp; a bag of a data set says itself what each is on."""
    if kind is None and "scenes" in recording.metadata:
        return closures_of(recording)
    names = ("motor_current", "reference_position", "encoder_position", "grip_force")
    channels = {n: (recording[n].time, recording[n].values) for n in names if n in recording}
    return split_grasps(closure_of(channels, scene_of(recording, kind)))


def evaluate(
    classifier: StiffnessClassifier, recordings: Iterable[tuple[Recording, str | None]]
) -> dict[str, Any]:
    """Scores of the classifier on recordings, each with its kind where it does not say it."""
    closures = [c for recording, kind in recordings for c in measured_closures(recording, kind)]
    return scores_of(answer(classifier, closures))
