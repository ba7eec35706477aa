"""The trained classifier on disk and in use: one ONNX file with its manifest.

On disk there are two files, `NAME.onnx` (the classifier, and the regression of the stiffness where there is one) and
`NAME.json` (the manifest: method, features and their version, class names, calibration, training data, seed, scores,
versions, and the hash of the ONNX file). Both are data: nothing in them runs. The rules of `features` stand before the
model: a sample that they call void is void with probability 1. scikit-learn and skl2onnx are needed to train,
onnxruntime to answer; each is imported at its first use.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.files import write_all
from hannes_description.signals import STIFFNESS_CLASSES
from numpy.typing import ArrayLike, NDArray

from .features import FEATURES, FeatureSpec
from .models import LEAST_SPREAD, Calibration, Estimator, apply_rules

SCHEMA = "hannes/stiffness/2"
BASELINE = "baseline"
"""The thesis' method."""
DEFAULT = "window"
SHIPPED = (DEFAULT, BASELINE)
"""Classifiers that come with the package, by name."""
NOT_SURE = -1
"""Class number of an answer that is not sure."""
NOT_SURE_LABEL = "not sure"
_INPUT = "features"
_PROBABILITIES, _VALUE, _SPREAD = "probabilities", "log10_stiffness", "log10_spread"
_LARGEST_ONNX, _LARGEST_MANIFEST = 100 << 20, 4 << 20
"""Sizes, bytes, above which a file cannot be one of ours."""
STIFFNESS_RANGE = (100.0, 100e3)
"""N/m; range of the training, beyond which no estimate goes."""


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
    model: Any,
    path: str | Path,
    *,
    method: str,
    spec: FeatureSpec,
    seed: int,
    settings: Mapping[str, object],
    training: Mapping[str, object],
    scores: Mapping[str, object],
    calibration: Calibration | None = None,
    sure: float = 0.0,
    estimator: Estimator | None = None,
) -> Path:
    """Write `path` (.onnx) and its manifest (.json beside it); answer the path of the ONNX file.

    method     what the model is called
    sure       least probability of a sure answer
    estimator  the regression of the stiffness
    """
    path = _onnx_path(path)
    parts = {_PROBABILITIES: model}
    if estimator is not None:
        parts |= {_VALUE: estimator.value, _SPREAD: estimator.spread}
    content = _to_onnx(parts, len(spec.names)).SerializeToString()
    manifest = {
        "schema": SCHEMA,
        "method": method,
        "features": spec.to_dict(),
        "feature_names": list(spec.names),
        "classes": list(STIFFNESS_CLASSES),
        "calibration": None if calibration is None else calibration.to_dict(),
        "sure": sure,
        "interval_factor": None if estimator is None else round(estimator.factor, 6),
        "seed": seed,
        "settings": dict(settings),
        "training": dict(training),
        "scores": dict(scores),
        "versions": _versions(),
        "onnx": {"file": path.name, "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()},
    }
    try:
        write_all({path: content, path.with_suffix(".json"): json.dumps(manifest, indent=1) + "\n"})
    except OSError as error:
        raise _not_written(path, error) from error
    return path


def _to_onnx(parts: Mapping[str, Any], width: int) -> Any:
    """One ONNX model of several scikit-learn models on the same input, an output each."""
    import onnx
    from onnx.compose import add_prefix
    from skl2onnx import convert_sklearn
    from skl2onnx.common.data_types import FloatTensorType

    nodes, initializers, outputs = [], [], []
    merged = None
    for name, model in parts.items():
        options = {id(model): {"zipmap": False}} if name == _PROBABILITIES else None
        merged = convert_sklearn(
            model,
            name="hannes_stiffness",
            options=options,
            initial_types=[(_INPUT, FloatTensorType([None, width]))],
            target_opset={"": 17, "ai.onnx.ml": 3},
        )
        add_prefix(merged, f"{name}/", rename_inputs=False, inplace=True)
        # A classifier gives labels and probabilities, a regression its value alone: the last one counts.
        last = merged.graph.output[-1]
        nodes += [*merged.graph.node, onnx.helper.make_node("Identity", [last.name], [name])]
        initializers += list(merged.graph.initializer)
        columns = len(STIFFNESS_CLASSES) if name == _PROBABILITIES else 1
        outputs.append(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [None, columns]))
    if merged is None:
        raise HannesError("There is no model to write.")
    graph = onnx.helper.make_graph(
        nodes, "hannes_stiffness", [merged.graph.input[0]], outputs, initializer=initializers
    )
    return onnx.helper.make_model(
        graph, opset_imports=list(merged.opset_import), ir_version=merged.ir_version, producer_name="hannes"
    )


def new_file(path: str | Path) -> Path:
    """Where a classifier may be written: HannesError where the name or the folder is none for it."""
    path = _onnx_path(path)
    if path.is_dir():
        raise _not_written(path, "it is a folder")
    trial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        trial.touch()
        trial.unlink()
    except OSError as error:
        raise _not_written(path, error.strerror or error) from error
    return path


def _not_written(path: Path, why: object) -> HannesError:
    return HannesError(f"Cannot write the classifier '{path}': {why}.")


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
class Answers:
    """What a classifier says to feature samples.

    probabilities  (n, 3) of void, rigid, soft
    stiffness      (n, 3) N/m: estimate, lower and upper end of its interval; NaN where there is none
    """

    probabilities: NDArray[np.float64]
    stiffness: NDArray[np.float64]

    @property
    def classes(self) -> NDArray[np.int64]:
        """Most probable class (n,)."""
        return np.argmax(self.probabilities, axis=1).astype(np.int64)

    def sure(self, least: float) -> NDArray[np.int64]:
        """Class (n,), NOT_SURE where its probability is below `least`."""
        return np.where(self.probabilities.max(axis=1) < least, NOT_SURE, self.classes)


def class_label(number: int) -> str:
    """Name of an answered class; "not sure" for NOT_SURE."""
    return NOT_SURE_LABEL if number == NOT_SURE else STIFFNESS_CLASSES[number]


@dataclass(frozen=True)
class StiffnessClassifier:
    """A loaded classifier. `load` reads it; `answer` answers.

    spec         what its features are
    manifest     all that the manifest says
    session      the onnxruntime session
    calibration  of its probabilities
    least        least probability of a sure answer
    factor       half the interval of the stiffness over its spread; NaN where it does not estimate
    """

    spec: FeatureSpec
    manifest: Mapping[str, Any]
    session: Any
    calibration: Calibration | None = None
    least: float = 0.0
    factor: float = math.nan
    _outputs: Sequence[str] = field(default=(_PROBABILITIES,), repr=False)

    @classmethod
    def load(cls, path: str | Path | None = None) -> StiffnessClassifier:
        """Load `path` (.onnx, with its .json beside it), or a shipped one by name (empty: the default).

        Raises HannesError where a file is missing or broken, where the ONNX file is not the one that the
        manifest describes (sha256), or where the features are of another version.
        """
        if path is None or str(path) == "":
            path = DEFAULT
        if str(path) in SHIPPED:
            path = Path(str(files("hannes_stiffness") / "data" / f"{path}.onnx"))
        path = _onnx_path(path)
        manifest_path = path.with_suffix(".json")
        manifest = _read_manifest(manifest_path)
        where = f"The manifest '{manifest_path}'"
        spec = FeatureSpec.from_dict(manifest.get("features"), where)
        if manifest.get("feature_names") != list(spec.names):
            raise HannesError(
                f"{where} names the features {manifest.get('feature_names')!r}; this version computes "
                f"{list(FEATURES[spec.version])}."
            )
        calibration, least, factor = _numbers(manifest, where)
        content = _read(path, _LARGEST_ONNX, "classifier file")
        found, stated = hashlib.sha256(content).hexdigest(), manifest["onnx"]["sha256"]
        if found != stated:
            raise HannesError(
                f"The classifier file '{path}' is not the one its manifest describes (sha256 {found[:12]}, "
                f"not {stated[:12]}): one of the two is broken or was changed. Train it again with "
                "`hannes stiffness train`."
            )
        outputs = (_PROBABILITIES,) if math.isnan(factor) else (_PROBABILITIES, _VALUE, _SPREAD)
        session = _session(content, path, len(spec.names), outputs)
        return cls(spec, manifest, session, calibration, least, factor, outputs)

    @property
    def estimates(self) -> bool:
        """Whether it estimates the stiffness."""
        return not math.isnan(self.factor)

    def answer(self, values: ArrayLike, void: ArrayLike) -> Answers:
        """Answers to feature samples: values (n, k) in the order of the spec's names; void (n,) bool, void by rule.

        The interval holds the truth in nine of ten samples like those of the training; an estimate belongs to a
        sample that is not void.
        """
        x = np.ascontiguousarray(values, dtype=np.float32)
        rule = np.asarray(void, dtype=bool)
        width = len(self.spec.names)
        if x.ndim != 2 or x.shape[1] != width or rule.shape != (len(x),):
            raise HannesError(
                f"The classifier needs samples of shape (n, {width}) and a rule (n,); it got {x.shape} and "
                f"{rule.shape}."
            )
        stiffness = np.full((len(x), 3), np.nan)
        if not len(x):
            return Answers(np.empty((0, len(STIFFNESS_CLASSES))), stiffness)
        out = self.session.run(list(self._outputs), {_INPUT: x})
        probabilities = out[0].astype(float)
        if self.calibration is not None:
            probabilities = self.calibration.apply(probabilities)
        if self.estimates:
            value, half = out[1][:, 0].astype(float), out[2][:, 0].astype(float)
            half = self.factor * np.maximum(half, LEAST_SPREAD)
            stiffness = np.clip(10.0 ** (value[:, None] + half[:, None] * (0.0, -1.0, 1.0)), *STIFFNESS_RANGE)
            stiffness[rule] = np.nan
        return Answers(apply_rules(probabilities, rule), stiffness)

    def probabilities(self, values: ArrayLike, void: ArrayLike) -> NDArray[np.float64]:
        """Probabilities (n, 3), order void, rigid, soft, of feature samples as in `answer`."""
        return self.answer(values, void).probabilities

    def classify(self, values: ArrayLike, void: ArrayLike) -> NDArray[np.int64]:
        """Class numbers (n,) of feature samples (0 void, 1 rigid, 2 soft), sure or not."""
        return self.answer(values, void).classes


def _numbers(manifest: Mapping[str, Any], where: str) -> tuple[Calibration | None, float, float]:
    """Calibration, least probability of a sure answer, and factor of the interval."""
    given = manifest.get("calibration")
    try:
        calibration = (
            None
            if given is None
            else Calibration(np.array(given["weights"], dtype=float), np.array(given["bias"], dtype=float))
        )
        least = float(manifest["sure"])
        factor = manifest["interval_factor"]
        factor = math.nan if factor is None else float(factor)
    except (KeyError, TypeError, ValueError) as error:
        raise HannesError(f"{where}: calibration, sure or interval_factor is wrong: {error}.") from error
    if not 0.0 <= least <= 1.0 or factor < 0.0 or math.isinf(factor):
        raise HannesError(f"{where}: sure must be from 0 to 1 and interval_factor not negative.")
    return calibration, least, factor


def _session(content: bytes, path: Path, width: int, wanted: Sequence[str]) -> Any:
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
        or inputs[0].shape[-1] != width
        or not set(wanted) <= set(outputs)
    ):
        raise HannesError(
            f"The classifier file '{path}' takes {[i.name for i in inputs]} and gives {outputs}; a Hannes "
            f"classifier takes '{_INPUT}' (n, {width}) and gives {', '.join(wanted)}."
        )
    return session
