"""The thesis' classifier as the baseline: bagged trees on single samples, stored as ONNX with a manifest.

Bagging: every tree sees a bootstrap sample of the data and all three features; the probabilities of the
trees' leaves are averaged (Breiman, Bagging predictors, Machine Learning 24, 1996). The rules of `features`
stand before the trees: a sample that they call void is void with probability 1.

On disk there are two files, `NAME.onnx` (the trees) and `NAME.json` (the manifest: features and their
version, class names, training data, seed, scores, versions, and the hash of the ONNX file). Both are data:
nothing in them runs. scikit-learn and skl2onnx are needed to train, onnxruntime to answer; each is imported
at its first use.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.signals import STIFFNESS_CLASSES
from numpy.typing import ArrayLike, NDArray

from .features import FEATURE_NAMES, FeatureSpec

SCHEMA = "hannes/stiffness/1"
BASELINE = "baseline"
_INPUT = "features"
_LARGEST_ONNX, _LARGEST_MANIFEST = 100 << 20, 4 << 20
"""Sizes, bytes, above which a file cannot be one of ours."""


@dataclass(frozen=True)
class TreeSettings:
    """Settings of the bagged trees.

    trees     how many (30, the usual size of such a bag)
    leaves    most leaves of one tree; bounds the size of the file
    leaf      least samples in a leaf
    folds     folds of the cross-validation (5, P20), grouped by closure
    """

    trees: int = 30
    leaves: int = 256
    leaf: int = 5
    folds: int = 5

    def __post_init__(self) -> None:
        for name, low, high in (
            ("trees", 1, 1000),
            ("leaves", 2, 100_000),
            ("leaf", 1, 10_000),
            ("folds", 2, 100),
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise HannesError(
                    f"Tree setting {name}={value!r} must be a whole number from {low} to {high}."
                )


@dataclass(frozen=True)
class TrainingData:
    """Samples to learn from.

    values  (n, 3) float32 current A, reference rad, encoder rad
    labels  (n,) class numbers
    void    (n,) bool: void by rule, whatever the trees say
    groups  (n,) number of the closure; a closure is never split between training and validation
    """

    values: NDArray[np.float32]
    labels: NDArray[np.int64]
    void: NDArray[np.bool_]
    groups: NDArray[np.int64]

    def __post_init__(self) -> None:
        n = len(self.values)
        if (
            self.values.shape != (n, len(FEATURE_NAMES))
            or not len(self.labels) == len(self.void) == len(self.groups) == n
        ):
            raise HannesError(
                f"Training data do not fit together: values {self.values.shape}, labels {self.labels.shape}, "
                f"void {self.void.shape}, groups {self.groups.shape}."
            )
        if not np.isfinite(self.values).all():
            raise HannesError("Training data hold values that are not finite.")


def make_trees(seed: int, settings: TreeSettings) -> Any:
    """The untrained bag of trees (scikit-learn).

    A random forest that looks at all features at every split is a bag of trees, and converts to one ONNX
    operator.
    """
    from sklearn.ensemble import RandomForestClassifier

    return RandomForestClassifier(
        n_estimators=settings.trees,
        max_features=None,
        bootstrap=True,
        random_state=seed,
        max_leaf_nodes=settings.leaves,
        min_samples_leaf=settings.leaf,
    )


def fit(data: TrainingData, *, seed: int, settings: TreeSettings | None = None) -> Any:
    """Trees trained on the data. Raises HannesError where a class is missing."""
    settings = settings or TreeSettings()
    missing = [n for k, n in enumerate(STIFFNESS_CLASSES) if not np.any(data.labels == k)]
    if missing:
        raise HannesError(
            f"The training data hold no sample of {' and '.join(missing)}; the classifier needs all of "
            f"{', '.join(STIFFNESS_CLASSES)}."
        )
    return make_trees(seed, settings).fit(data.values, data.labels)


def apply_rules(probabilities: NDArray[np.float64], void: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Probabilities (n, 3) with the samples that are void by rule set to (1, 0, 0)."""
    return np.where(void[:, None], np.array([1.0, 0.0, 0.0]), probabilities)


def cross_validate(
    data: TrainingData, *, seed: int, settings: TreeSettings | None = None
) -> NDArray[np.int64]:
    """Class (n,) of every sample, answered by trees that saw no sample of its closure."""
    from sklearn.model_selection import StratifiedGroupKFold

    settings = settings or TreeSettings()
    if len(np.unique(data.groups)) < settings.folds:
        raise HannesError(f"{len(np.unique(data.groups))} closures are too few for {settings.folds} folds.")
    answer = np.zeros(len(data.labels), dtype=np.int64)
    folds = StratifiedGroupKFold(n_splits=settings.folds, shuffle=True, random_state=seed)
    for training, held_out in folds.split(data.values, data.labels, data.groups):
        part = TrainingData(
            data.values[training], data.labels[training], data.void[training], data.groups[training]
        )
        trees = fit(part, seed=seed, settings=settings)
        answer[held_out] = np.argmax(
            apply_rules(trees.predict_proba(data.values[held_out]), data.void[held_out]), axis=1
        )
    return answer


def _versions() -> dict[str, str]:
    out = {"python": platform.python_version()}
    for name in (
        "hannes_stiffness",
        "hannes_sim",
        "numpy",
        "scikit-learn",
        "skl2onnx",
        "onnx",
        "onnxruntime",
    ):
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            out[name] = "from source"
    return out


def save(
    trees: Any,
    path: str | Path,
    *,
    spec: FeatureSpec,
    seed: int,
    settings: TreeSettings,
    training: Mapping[str, object],
    scores: Mapping[str, object],
) -> Path:
    """Write `path` (.onnx) and its manifest (.json beside it); answer the path of the ONNX file."""
    from skl2onnx import convert_sklearn
    from skl2onnx.common.data_types import FloatTensorType

    path = _onnx_path(path)
    model = convert_sklearn(
        trees,
        name="hannes_stiffness",
        options={id(trees): {"zipmap": False}},
        initial_types=[(_INPUT, FloatTensorType([None, len(FEATURE_NAMES)]))],
        target_opset={"": 17, "ai.onnx.ml": 3},
    )
    content = model.SerializeToString()
    manifest = {
        "schema": SCHEMA,
        "method": "bagged trees on single samples",
        "features": spec.to_dict(),
        "feature_names": list(FEATURE_NAMES),
        "classes": list(STIFFNESS_CLASSES),
        "seed": seed,
        "settings": {
            "trees": settings.trees,
            "leaves": settings.leaves,
            "leaf": settings.leaf,
            "folds": settings.folds,
        },
        "training": dict(training),
        "scores": dict(scores),
        "versions": _versions(),
        "onnx": {"file": path.name, "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()},
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        path.with_suffix(".json").write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise HannesError(f"Cannot write the classifier '{path}': {error}.") from error
    return path


def _onnx_path(path: str | Path) -> Path:
    path = Path(path)
    if path.suffix != ".onnx":
        raise HannesError(
            f"The classifier file '{path}' must end in .onnx; its manifest stands beside it as .json."
        )
    return path


def _read(path: Path, largest: int, what: str) -> bytes:
    try:
        size = path.stat().st_size
        if size > largest:
            raise HannesError(
                f"The {what} '{path}' has {size} bytes, more than the {largest} that one can have."
            )
        return path.read_bytes()
    except OSError as error:
        raise HannesError(
            f"Cannot read the {what} '{path}': {error.strerror}. Train one with `hannes stiffness train`, or "
            f"leave the path empty for the one that is installed."
        ) from error


def _read_manifest(path: Path) -> dict[str, Any]:
    where = f"The manifest '{path}'"
    try:
        manifest = json.loads(_read(path, _LARGEST_MANIFEST, "classifier's manifest").decode("utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise HannesError(
            f"{where} is not JSON: {error}. Train the classifier again with `hannes stiffness train`."
        ) from error
    if not isinstance(manifest, dict) or manifest.get("schema") != SCHEMA:
        found = manifest.get("schema") if isinstance(manifest, dict) else type(manifest).__name__
        raise HannesError(f"{where} has the schema {found!r}; this version reads {SCHEMA!r}.")
    if manifest.get("classes") != list(STIFFNESS_CLASSES):
        raise HannesError(
            f"{where} names the classes {manifest.get('classes')!r}; valid are {list(STIFFNESS_CLASSES)}."
        )
    onnx = manifest.get("onnx")
    if not isinstance(onnx, dict) or not isinstance(onnx.get("sha256"), str):
        raise HannesError(f"{where} does not give the hash of its ONNX file (onnx.sha256).")
    return manifest


@dataclass(frozen=True)
class StiffnessClassifier:
    """A loaded classifier. `load` reads it; `probabilities` answers.

    spec      what its features are
    manifest  all that the manifest says
    session   the onnxruntime session
    """

    spec: FeatureSpec
    manifest: Mapping[str, Any]
    session: Any

    @classmethod
    def load(cls, path: str | Path | None = None) -> StiffnessClassifier:
        """Load `path` (.onnx, with its .json beside it), or the shipped baseline.

        Raises HannesError where a file is missing or broken, where the ONNX file is not the one that the
        manifest describes (sha256), or where the features are of another version.
        """
        if path is None or str(path) == "":
            path = Path(str(files("hannes_stiffness") / "data" / f"{BASELINE}.onnx"))
        path = _onnx_path(path)
        manifest_path = path.with_suffix(".json")
        manifest = _read_manifest(manifest_path)
        spec = FeatureSpec.from_dict(manifest.get("features"), f"The manifest '{manifest_path}'")
        if manifest.get("feature_names") != list(FEATURE_NAMES):
            raise HannesError(
                f"The manifest '{manifest_path}' names the features {manifest.get('feature_names')!r}; this "
                f"version computes {list(FEATURE_NAMES)}."
            )
        content = _read(path, _LARGEST_ONNX, "classifier file")
        found, stated = hashlib.sha256(content).hexdigest(), manifest["onnx"]["sha256"]
        if found != stated:
            raise HannesError(
                f"The classifier file '{path}' is not the one its manifest describes (sha256 {found[:12]}, "
                f"not {stated[:12]}): one of the two is broken or was changed. Train it again with "
                "`hannes stiffness train`."
            )
        return cls(spec, manifest, _session(content, path))

    def probabilities(self, values: ArrayLike, void: ArrayLike) -> NDArray[np.float64]:
        """Probabilities (n, 3), order void, rigid, soft, of feature samples.

        values (n, 3) current A, reference rad, encoder rad; void (n,) bool, void by rule.
        """
        x = np.ascontiguousarray(values, dtype=np.float32)
        rule = np.asarray(void, dtype=bool)
        if x.ndim != 2 or x.shape[1] != len(FEATURE_NAMES) or rule.shape != (len(x),):
            raise HannesError(
                f"The classifier needs samples of shape (n, {len(FEATURE_NAMES)}) and a rule (n,); it got "
                f"{x.shape} and {rule.shape}."
            )
        if not len(x):
            return np.empty((0, len(STIFFNESS_CLASSES)))
        return apply_rules(self.session.run(["probabilities"], {_INPUT: x})[0].astype(float), rule)

    def classify(self, values: ArrayLike, void: ArrayLike) -> NDArray[np.int64]:
        """Class numbers (n,) of feature samples (0 void, 1 rigid, 2 soft)."""
        return np.argmax(self.probabilities(values, void), axis=1).astype(np.int64)


def _session(content: bytes, path: Path) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    # One sample at a time: more threads only add their hand-over.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # onnxruntime's errors have no common base class below Exception.
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        inputs, outputs = session.get_inputs(), [o.name for o in session.get_outputs()]
    except Exception as error:
        raise HannesError(
            f"The classifier file '{path}' is not usable ONNX: {str(error)[:200]}. Train it again with "
            "`hannes stiffness train`."
        ) from error
    if (
        [i.name for i in inputs] != [_INPUT]
        or inputs[0].shape[-1] != len(FEATURE_NAMES)
        or "probabilities" not in outputs
    ):
        raise HannesError(
            f"The classifier file '{path}' takes {[i.name for i in inputs]} and gives {outputs}; a Hannes "
            f"classifier takes '{_INPUT}' (n, {len(FEATURE_NAMES)}) and gives 'probabilities'."
        )
    return session
