"""From a data set to a trained file, and from recordings to scores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hannes_bags.recording import Recording
from hannes_description.errors import HannesError
from hannes_description.signals import STIFFNESS_CLASSES
from hannes_sim.objects import OBJECTS, GraspObject
from numpy.typing import NDArray

from .classifier import StiffnessClassifier, TreeSettings, cross_validate, fit, save
from .dataset import Closure, Dataset, Scene, closure_of, kind_of, label
from .features import Features, FeatureSpec, extract
from .scoring import HOPS, score, score_closures


@dataclass(frozen=True)
class Answered:
    """The answers to one closure or recording: object name, sample times (n,) s, true and answered class (n,)."""

    object: str
    time: NDArray[np.float64]
    truth: NDArray[np.int64]
    answer: NDArray[np.int64]


def scores_of(answered: Sequence[Answered]) -> dict[str, Any]:
    """Scores as plain types: of single samples, and of the thesis' windows in both readings (per object and pooled)."""
    if not answered:
        raise HannesError("There is no closure to score.")
    out: dict[str, Any] = {
        "samples": score(
            np.concatenate([a.truth for a in answered]), np.concatenate([a.answer for a in answered])
        ).to_dict()
    }
    rows = [(a.object, a.time, a.truth, a.answer) for a in answered]
    return out | {name: score_closures(rows, hop).to_dict() for name, hop in HOPS.items()}


def answer(
    classifier: StiffnessClassifier, closures: Iterable[Closure], *, by_kind: bool = False
) -> list[Answered]:
    """What the classifier says to measured closures; `by_kind` pools the objects of a kind."""
    out = []
    for closure in closures:
        f = extract(closure.time, closure.current, closure.reference, closure.encoder, classifier.spec)
        name = closure.scene.kind if by_kind else closure.scene.object
        out.append(
            Answered(name, f.time, label(f, closure.scene.kind), classifier.classify(f.values, f.void))
        )
    return out


def train(
    dataset: Dataset,
    path: str | Path,
    *,
    seed: int,
    spec: FeatureSpec | None = None,
    settings: TreeSettings | None = None,
    held_out: Mapping[str, Dataset] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Path:
    """Train the bagged trees on the data set, score them and write `path` (.onnx) with its manifest.

    seed      of the trees and of the folds
    held_out  further data sets by name, none of whose closures was trained on; their scores go into the manifest
    say       told what is going on, one sentence at a time
    Returns the path of the ONNX file.
    """
    spec, settings = spec or FeatureSpec(), settings or TreeSettings()
    data = dataset.training_data(spec)
    say(
        f"{settings.folds}-fold cross-validation over {len(dataset.closures)} closures, {len(data.labels)} samples."
    )
    folds = cross_validate(data, seed=seed, settings=settings)
    scores: dict[str, Any] = {
        "cross_validation": _summary(scores_of(_split(dataset, dataset.features(spec), folds)))
    }
    say("Training on all of them.")
    trees = fit(data, seed=seed, settings=settings)
    counts = {name: int(np.count_nonzero(data.labels == k)) for k, name in enumerate(STIFFNESS_CLASSES)}
    training = {**dataset.manifest, "samples": counts, "void_by_rule": int(np.count_nonzero(data.void))}
    path = save(trees, path, spec=spec, seed=seed, settings=settings, training=training, scores=scores)
    if held_out:
        classifier = StiffnessClassifier.load(path)
        for name, other in held_out.items():
            say(f"Scoring {len(other.closures)} closures that were not trained on ({name}).")
            scores[name] = {
                **_summary(scores_of(answer(classifier, other.closures, by_kind=True))),
                "closures": len(other.closures),
                "hands": other.manifest.get("hands"),
                "seed": other.manifest.get("seed"),
            }
        save(trees, path, spec=spec, seed=seed, settings=settings, training=training, scores=scores)
    return path


def _split(dataset: Dataset, features: Sequence[Features], answers: NDArray[np.int64]) -> list[Answered]:
    parts = np.split(answers, np.cumsum([len(f.time) for f in features])[:-1])
    return [
        Answered(c.scene.kind, f.time, label(f, c.scene.kind), a)
        for c, f, a in zip(dataset.closures, features, parts, strict=True)
    ]


def _summary(scores: Mapping[str, Any]) -> dict[str, Any]:
    """Pooled scores only: the file ships, and the per-object ones can be made again."""
    return {"samples": scores["samples"], **{name: scores[name]["pooled"] for name in HOPS}}


def scene_of(recording: Recording, kind: str | None = None) -> Scene:
    """What a recording says it was closed on (metadata `object`, a name or an object's data), or the given kind."""
    said = recording.metadata.get("object")
    name = Path(recording.source).name or "recording"
    if kind is None:
        if isinstance(said, Mapping):
            kind = kind_of(GraspObject.from_dict(said))
        elif said in OBJECTS:
            kind = kind_of(OBJECTS[str(said)])
        elif said in STIFFNESS_CLASSES:
            kind = str(said)
        else:
            raise HannesError(
                f"The recording '{recording.source}' does not say what was grasped (metadata object is {said!r}; "
                f"known are {', '.join((*OBJECTS, *STIFFNESS_CLASSES))}, or an object's data); say it with "
                "--kind."
            )
    if kind not in STIFFNESS_CLASSES:
        raise HannesError(f"Kind {kind!r} is unknown; valid are {', '.join(STIFFNESS_CLASSES)}.")
    label_ = said if isinstance(said, str) else name
    # The true object is not known to the classifier's scene; only its kind counts for the scores.
    return Scene(object=label_, kind=kind, grasp=None if kind == STIFFNESS_CLASSES[0] else GraspObject())


def evaluate(
    classifier: StiffnessClassifier, recordings: Iterable[tuple[Recording, Scene]]
) -> dict[str, Any]:
    """Scores of the classifier on recordings, each with its truth."""
    closures = []
    for recording, scene in recordings:
        channels = {
            name: (recording[name].time, recording[name].values)
            for name in ("motor_current", "reference_position", "encoder_position")
            if name in recording
        }
        closures.append(closure_of(channels, scene))
    return scores_of(answer(classifier, closures))
