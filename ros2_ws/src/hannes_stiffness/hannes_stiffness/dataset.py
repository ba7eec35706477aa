"""Training sets by simulation: closures on nothing, on soft and on rigid objects, seen through the hand's sensors.

A `Scene` says what is closed on, how and by which hand; `draw_scenes` draws scenes from a seed; `simulate` rolls the
closed loop out over one of them and measures it with the thesis' sensors (30 Hz, rectified current, encoder counts);
`make_dataset` does both for many. The same seed gives the same data, whatever the number of processes.

Labels (thesis P18, P19): a sample of a closure on a rigid object is rigid, on a soft one soft, unless the rules of
`features` call it void; a closure on nothing is void throughout.
"""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hannes_control.double_pid import DoublePID
from hannes_control.reference import FULL_CLOSURE, half_sine
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.parameters import data_path, read_yaml
from hannes_description.signals import STIFFNESS_CLASSES
from hannes_sim.factory import make_plant
from hannes_sim.measurement import THESIS, Sensors
from hannes_sim.objects import SHAPES, SOFT_BALL, GraspObject
from hannes_sim.rollout import rollout
from numpy.typing import NDArray

from .classifier import TrainingData
from .features import Features, FeatureSpec, extract, hold

SCHEMA = "hannes/stiffness-dataset/1"
SIGNALS = ("motor_current", "reference_position", "encoder_position")
Array = NDArray[np.float64]
_ARRAYS = ("time", "current", "reference", "encoder", "force")
VOID, RIGID, SOFT = STIFFNESS_CLASSES

RIGID_FROM = 18_400.0
"""N/m of the whole grasp from which an object is rigid: 92 N of total finger force (R13) press it by the 5 mm
of P18."""
STIFFNESS: Mapping[str, tuple[float, float]] = {SOFT: (200.0, 1500.0), RIGID: (20e3, 100e3)}
"""Range of the drawn stiffness, N/m: around the thesis' two, soft about 0.4 kN/m and rigid at least 40 kN/m."""
SIZES = (0.050, 0.085)
"""Range of the drawn object sizes, m: what a closure of the bench test touches before its end."""
PLACES = {SOFT_BALL.shape: SOFT_BALL.place}
"""Place of the drawn objects by shape, m: where the fingers reach a sphere; the middle of the grasp otherwise."""
AMPLITUDES = (0.85, 1.0)
"""Range of the drawn reference amplitudes, parts of the full closure (P17)."""
PERIODS = (3.5, 4.5)
"""Range of the drawn reference periods, s, around the 4 s of the bench test (X01)."""
DAMPING_TIME = 0.002
"""Damping over stiffness of the drawn objects, s."""


@dataclass(frozen=True)
class Scene:
    """One closure to simulate.

    object     name of the object, for grouping and scores
    kind       void, rigid or soft
    grasp      the object, or None for a closure on nothing
    amplitude  rad at the pulley; period s of the half-sine reference (X01)
    hand       number of the hand of the population; 0 is the model as it is
    model      name of the model; empty for the only one
    """

    object: str
    kind: str
    grasp: GraspObject | None
    amplitude: float = FULL_CLOSURE
    period: float = 4.0
    hand: int = 0
    model: str = ""

    def __post_init__(self) -> None:
        if self.kind not in STIFFNESS_CLASSES:
            raise HannesError(f"Kind {self.kind!r} is unknown; valid are {', '.join(STIFFNESS_CLASSES)}.")
        if (self.kind == VOID) != (self.grasp is None):
            raise HannesError(f"Scene '{self.object}': a closure is void if and only if there is no object.")

    def to_dict(self) -> dict[str, Any]:
        """Plain types, for the manifest."""
        return {
            "object": self.object,
            "kind": self.kind,
            "grasp": self.grasp.to_dict() if self.grasp else None,
            "amplitude": self.amplitude,
            "period": self.period,
            "hand": self.hand,
            "model": self.model,
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Scene:
        """The inverse of `to_dict`."""
        grasp = content.get("grasp")
        return cls(**{**content, "grasp": None if grasp is None else GraspObject.from_dict(grasp)})


@dataclass(frozen=True)
class Closure:
    """One measured closure: time s, current A, reference rad, encoder rad and grip force N, all (n,), and its scene."""

    scene: Scene
    time: NDArray[np.float64]
    current: NDArray[np.float64]
    reference: NDArray[np.float64]
    encoder: NDArray[np.float64]
    force: NDArray[np.float64]


def kind_of(grasp: GraspObject | None) -> str:
    """void, rigid or soft by the object's stiffness (`RIGID_FROM`)."""
    if grasp is None:
        return VOID
    return RIGID if grasp.stiffness >= RIGID_FROM else SOFT


def draw_scenes(
    closures: int, seed: int, *, hands: int = 1, models: Sequence[str] = ("",)
) -> tuple[Scene, ...]:
    """`closures` scenes, kinds, models and hands in turn; every one has an object and a reference of its own."""
    if closures < 1 or hands < 1 or not models:
        raise HannesError(
            f"A data set needs at least one closure, hand and model, not {closures}, {hands} and {len(models)}."
        )
    scenes = []
    for k in range(closures):
        # Of each scene's own generator, so that more closures do not change the first ones.
        rng = np.random.default_rng([seed, 0, k])
        kind = STIFFNESS_CLASSES[k % len(STIFFNESS_CLASSES)]
        grasp = None
        if kind != VOID:
            low, high = STIFFNESS[kind]
            stiffness = float(np.exp(rng.uniform(math.log(low), math.log(high))))
            shape = SHAPES[int(rng.integers(len(SHAPES)))]
            grasp = GraspObject(
                shape=shape,
                place=PLACES.get(shape, (0.0, 0.0, 0.0)),
                size=float(rng.uniform(*SIZES)),
                stiffness=stiffness,
                damping=DAMPING_TIME * stiffness,
            )
        scenes.append(
            Scene(
                object=f"{kind}_{k:04d}",
                kind=kind,
                grasp=grasp,
                amplitude=FULL_CLOSURE * float(rng.uniform(*AMPLITUDES)),
                period=float(rng.uniform(*PERIODS)),
                hand=k // len(STIFFNESS_CLASSES) // len(models) % hands,
                model=models[k // len(STIFFNESS_CLASSES) % len(models)],
            )
        )
    return tuple(scenes)


def hand_of(model: Model, hand: int, seed: int) -> Model:
    """The model with the parameters of hand number `hand` of the population; hand 0 is the model itself.

    The spreads are those of the shipped parameter file `population.yaml` (`hand_sd`), normally distributed and
    cut at the parameters' bounds.
    """
    if hand == 0:
        return model
    rng = np.random.default_rng([seed, 1, hand])
    values = {}
    for name, spread in sorted(read_yaml(data_path("parameters", "population.yaml"), "population").items()):
        draw = float(rng.standard_normal()) * float(spread["hand_sd"])
        if name in model.parameters:
            parameter = model.parameters[name]
            value = parameter.value * (1.0 + draw) if spread["unit"] == "1" else parameter.value + draw
            values[name] = min(max(value, parameter.lower), parameter.upper)
    return model.with_values(values)


def simulate(scene: Scene, model: Model, sensors: Sensors, seed: int, index: int) -> Closure:
    """Roll one scene out and measure it; `seed` and `index` fix the sensors' noise."""
    plant = make_plant(model, scene.grasp)
    controller = DoublePID.of_model(model.parameters)
    run = rollout(plant, controller, half_sine(1, scene.amplitude, scene.period, controller.period))
    samples = sensors.sample(run, np.random.default_rng([seed, 2, index]))
    return closure_of({**samples, "grip_force": (run.time, run.grip_force)}, scene)


def closure_of(samples: Mapping[str, tuple[Array, Array]], scene: Scene) -> Closure:
    """The closure in measured signals, given as name -> (time (n,) s, values (n,)).

    All signals are taken at the instants of the current: the last value of each, never a later one; NaN where
    there is none.
    """
    missing = [name for name in SIGNALS if name not in samples]
    if missing:
        raise HannesError(
            f"The closure on '{scene.object}' lacks {', '.join(missing)}; it has {', '.join(samples)}."
        )
    time, current = (np.asarray(a, dtype=float) for a in samples["motor_current"])
    held = {
        name: hold(*samples[name], time) if name in samples else np.full(len(time), np.nan)
        for name in (*SIGNALS[1:], "grip_force")
    }
    return Closure(
        scene, time, current, held["reference_position"], held["encoder_position"], held["grip_force"]
    )


def label(features: Features, kind: str) -> NDArray[np.int64]:
    """True class (n,) of the feature samples of a closure of that kind."""
    return np.where(features.void, 0, STIFFNESS_CLASSES.index(kind)).astype(np.int64)


@dataclass(frozen=True)
class Dataset:
    """Measured closures and how they were made.

    closures  in the order of their scenes
    manifest  model (name, hash), seed, sensors, counts, versions
    """

    closures: tuple[Closure, ...]
    manifest: Mapping[str, Any]

    def features(self, spec: FeatureSpec) -> list[Features]:
        """Feature samples of every closure."""
        return [extract(c.time, c.current, c.reference, c.encoder, spec) for c in self.closures]

    def training_data(self, spec: FeatureSpec) -> TrainingData:
        """All feature samples with their labels, grouped by closure."""
        parts = self.features(spec)
        labels = [label(f, c.scene.kind) for f, c in zip(parts, self.closures, strict=True)]
        return TrainingData(
            np.concatenate([f.values for f in parts]),
            np.concatenate(labels),
            np.concatenate([f.void for f in parts]),
            np.repeat(np.arange(len(parts)), [len(f.time) for f in parts]),
        )

    def save(self, path: str | Path) -> Path:
        """Write as .npz: plain arrays and the manifest as JSON text, nothing that could run."""
        path = _npz_path(path)
        manifest = {**self.manifest, "scenes": [c.scene.to_dict() for c in self.closures]}
        arrays = {name: np.concatenate([getattr(c, name) for c in self.closures]) for name in _ARRAYS}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("wb") as file:
                np.savez_compressed(
                    file,
                    allow_pickle=False,
                    manifest=np.array(json.dumps(manifest)),
                    lengths=np.array([len(c.time) for c in self.closures]),
                    **arrays,
                )
        except OSError as error:
            raise HannesError(f"Cannot write the data set '{path}': {error}.") from error
        return path

    @classmethod
    def load(cls, path: str | Path) -> Dataset:
        """Read what `save` wrote; HannesError says what is wrong with a file that is not such."""
        path = _npz_path(path)
        try:
            with np.load(path, allow_pickle=False) as file:
                content = {name: file[name] for name in ("manifest", "lengths", *_ARRAYS)}
            manifest = json.loads(str(content["manifest"]))
            scenes = [Scene.from_dict(s) for s in manifest.pop("scenes")]
            ends = np.cumsum(content["lengths"])
            if manifest.get("schema") != SCHEMA or len(ends) != len(scenes):
                raise HannesError(
                    f"its schema is {manifest.get('schema')!r}, and it has {len(ends)} closures of "
                    f"{len(scenes)} scenes"
                )
            cut = {name: np.split(content[name].astype(float), ends[:-1]) for name in _ARRAYS}
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            EOFError,
            zipfile.BadZipFile,
            zlib.error,
            RecursionError,
        ) as error:
            raise HannesError(
                f"'{path}' is not a stiffness data set of this version ({SCHEMA}): {error}. Make one with "
                "`hannes stiffness dataset`."
            ) from error
        closures = tuple(
            Closure(scene, *(cut[name][k] for name in _ARRAYS)) for k, scene in enumerate(scenes)
        )
        return cls(closures, manifest)


def _npz_path(path: str | Path) -> Path:
    path = Path(path)
    if path.suffix != ".npz":
        raise HannesError(f"The data set '{path}' must end in .npz.")
    return path


def make_dataset(
    scenes: Sequence[Scene],
    *models: Model,
    seed: int,
    sensors: Sensors = THESIS,
    jobs: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Dataset:
    """Simulate the scenes, each with its model and its hand of the population.

    models    the models that the scenes name; a scene without a name takes the first
    seed      fixes the hands and the noise (the scenes are given)
    jobs      processes; the result does not depend on it
    progress  told how many closures of how many are done
    """
    named = {model.name: model for model in models}
    if not models or len(named) < len(models):
        raise HannesError(f"The models {[model.name for model in models]} need a name of their own each.")
    unknown = sorted({scene.model for scene in scenes} - {*named, ""})
    if unknown:
        raise HannesError(f"Scenes name the model '{unknown[0]}'; there is {', '.join(named)}.")
    named[""] = models[0]
    hands = {(s.model, s.hand): hand_of(named[s.model], s.hand, seed) for s in scenes}
    work = [(s, hands[s.model, s.hand], sensors, seed, index) for index, s in enumerate(scenes)]
    done: list[Closure] = []
    for closure in _run(work, jobs):
        done.append(closure)
        if progress is not None:
            progress(len(done), len(work))
    manifest = {
        "schema": SCHEMA,
        "seed": seed,
        "models": {
            m.name: {"sha256": m.sha256, "plant": m.plant, "effects": [e.name for e in m.effects]}
            for m in models
        },
        "hands": len({scene.hand for scene in scenes}),
        "closures": len(done),
        "kinds": {kind: sum(s.kind == kind for s in scenes) for kind in STIFFNESS_CLASSES},
        "sensors": sensors.to_dict(),
    }
    return Dataset(tuple(done), manifest)


def _run(work: Sequence[tuple[Scene, Model, Sensors, int, int]], jobs: int) -> Iterable[Closure]:
    if jobs < 1:
        raise HannesError(f"The number of processes is {jobs}; it must be at least 1.")
    if jobs == 1:
        return (simulate(*item) for item in work)
    from joblib import Parallel, delayed

    results: Iterable[Closure] = Parallel(n_jobs=jobs, return_as="generator")(
        delayed(simulate)(*item) for item in work
    )
    return results
