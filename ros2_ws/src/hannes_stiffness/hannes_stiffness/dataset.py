"""Training and test sets by simulation: closures on nothing and on objects, seen through the hand's sensors.

A `Scene` says what is closed on, how and by which hand; `draw_scenes` draws scenes from a seed; `simulate` rolls the
closed loop out over one of them and measures it with the thesis' sensors (30 Hz, rectified current, encoder counts);
`make_dataset` does both for many, in memory or as a bag set: a folder of bags with a manifest, made part by part,
gone on with after an interruption. The same seed gives the same data, whatever the number of processes.

Labels (thesis P18, P19): a sample of a closure on a rigid object is rigid, on a soft one soft, unless the rules of
`features` call it void; a closure on nothing is void throughout. Where the force on the object is known, a sample
without contact is void too (X18): a hand with friction that nobody knows of needs more than 0.3 A to close on nothing.
"""

from __future__ import annotations

import json
import math
import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from hannes_bags.reading import read_bag
from hannes_bags.recording import Channel, Recording
from hannes_bags.writing import write_recording
from hannes_control.double_pid import DoublePID
from hannes_control.reference import FULL_CLOSURE, PROFILES, make_profile
from hannes_description.errors import HannesError
from hannes_description.files import write_whole
from hannes_description.model import EffectEntry, Model
from hannes_description.parameters import data_path, read_yaml
from hannes_description.signals import SIGNALS, STIFFNESS_CLASSES
from hannes_description.stopping import end_after_feeders
from hannes_sim.effect import catalogue, effect_of, strength_of
from hannes_sim.factory import make_plant
from hannes_sim.measurement import THESIS, Sensors
from hannes_sim.objects import SOFT_BALL, GraspObject
from hannes_sim.plant import PlantDiverged
from hannes_sim.rollout import rollout
from numpy.typing import NDArray

from .features import Features, FeatureSpec, extract, hold
from .models import TrainingData

SCHEMA = "hannes/stiffness-dataset/2"
MANIFEST = "manifest.json"
INPUTS = ("motor_current", "reference_position", "encoder_position")
"""The signals that the classifier sees."""
Array = NDArray[np.float64]
_ARRAYS = {"current": "motor_current", "reference": "reference_position", "encoder": "encoder_position",
           "force": "grip_force"}  # fmt: skip
VOID, RIGID, SOFT = STIFFNESS_CLASSES

RIGID_FROM = 18_400.0
"""N/m of the whole grasp from which an object is rigid: 92 N of total finger force (R13) press it by the 5 mm
of P18."""
CONTACT_FORCE = 0.5
"""Grip force, N, from which there is a contact."""
PLACES = MappingProxyType({SOFT_BALL.shape: SOFT_BALL.place})
"""Place of the drawn objects by shape, m: where the fingers reach a sphere; the middle of the grasp otherwise."""
PART = 24
"""Closures in one bag of a set."""
_PAUSE = 1.0
"""Rest between two closures of a bag, s: longer than a gap that still is one stream."""


@dataclass(frozen=True)
class Variety:
    """What scenes are drawn from; every range is (low, high), both ends included.

    stiffness     ranges of the whole grasp's stiffness, N/m, log-uniform; each is as probable as the others
    void          part of the closures that are on nothing
    shapes        of the objects, equally probable
    sizes         m; jitter m, half the range of the place along each axis
    damping_time  damping over stiffness, s, log-uniform, but at most `damping` N.s/m
    profiles      reference profiles, equally probable
    amplitudes    parts of the full closure (P17); periods s (X01: 4 s)
    varied        the hands have hidden effects and scatter from closure to closure
    """

    stiffness: tuple[tuple[float, float], ...]
    void: float = 1 / 3
    shapes: tuple[str, ...] = ("capsule", "sphere", "box")
    sizes: tuple[float, float] = (0.050, 0.085)
    jitter: float = 0.0
    damping_time: tuple[float, float] = (0.002, 0.002)
    damping: float = math.inf
    profiles: tuple[str, ...] = ("half_sine",)
    amplitudes: tuple[float, float] = (0.85, 1.0)
    periods: tuple[float, float] = (3.5, 4.5)
    varied: bool = False


VARIETIES: Mapping[str, Variety] = MappingProxyType(
    {
        # The thesis trained on two stiffnesses.
        "two": Variety(((400.0, 400.0), (40e3, 40e3))),
        # Around the thesis' two: soft about 0.4 kN/m and rigid at least 40 kN/m.
        "narrow": Variety(((200.0, 1500.0), (20e3, 100e3))),
        # Half sines thrice: they are what a bench test uses.
        "wide": Variety(
            ((100.0, 100e3),),
            void=0.15,
            shapes=("capsule", "sphere", "box", "prism"),
            sizes=(0.030, 0.090),
            jitter=0.006,
            damping_time=(3e-4, 0.03),
            damping=100.0,
            profiles=("half_sine", "half_sine", "half_sine", "ramp_hold", "reversals"),
            amplitudes=(0.65, 1.0),
            periods=(3.0, 6.0),
            varied=True,
        ),
    }
)
"""What scenes are drawn from, by name."""

_P = SOFT_BALL.place
THESIS_OBJECTS: Mapping[str, GraspObject] = MappingProxyType(
    {
        "dynamometer": GraspObject("capsule", 0.065, 40e3, 20.0),
        "metal block": GraspObject("box", 0.050, 80e3, 40.0),
        "black support": GraspObject("prism", 0.060, 50e3, 25.0),
        "crutch": GraspObject("capsule", 0.036, 60e3, 30.0),
        "blue ball": GraspObject("sphere", 0.080, 400.0, 2.0, place=_P),
        "green ball": GraspObject("sphere", 0.070, 800.0, 3.0, place=_P),
        "banana plush": GraspObject("capsule", 0.045, 500.0, 10.0),
        "sponge": GraspObject("box", 0.060, 400.0, 2.0),
        "orange plush": GraspObject("sphere", 0.075, 600.0, 15.0, place=_P),
        "grape plush": GraspObject("sphere", 0.055, 500.0, 10.0, place=_P),
    }
)
"""Ten objects like the thesis' (P18): its names; shapes, sizes and stiffnesses are assumed, none was measured. The
plushes are damped; crutch, banana and grape are small."""


@dataclass(frozen=True)
class Scene:
    """One closure to simulate.

    object     name of the object, for grouping and scores
    kind       void, rigid or soft
    grasp      the object, or None for a closure on nothing
    amplitude  rad at the pulley; period s of the reference (X01); profile its name
    hand       number of the hand of the population; 0 is the model as it is
    model      name of the model; empty for the only one
    varied     the hand has hidden effects, and its parameters scatter from closure to closure
    known      the object is `grasp` itself; False: only its kind is known (a recording that does not say more)
    """

    object: str
    kind: str
    grasp: GraspObject | None
    amplitude: float = FULL_CLOSURE
    period: float = 4.0
    hand: int = 0
    model: str = ""
    profile: str = "half_sine"
    varied: bool = False
    known: bool = True

    def __post_init__(self) -> None:
        if self.kind not in STIFFNESS_CLASSES:
            raise HannesError(f"Kind {self.kind!r} is unknown; valid are {', '.join(STIFFNESS_CLASSES)}.")
        if (self.kind == VOID) != (self.grasp is None):
            raise HannesError(f"Scene '{self.object}': a closure is void if and only if there is no object.")
        if self.profile not in PROFILES:
            raise HannesError(
                f"Scene '{self.object}': unknown profile '{self.profile}'; valid are {', '.join(PROFILES)}."
            )

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
            "profile": self.profile,
            "varied": self.varied,
            "known": self.known,
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Scene:
        """The inverse of `to_dict`."""
        grasp = content.get("grasp")
        return cls(**{**content, "grasp": None if grasp is None else GraspObject.from_dict(grasp)})


@dataclass(frozen=True)
class Closure:
    """One measured closure: time s, current A, reference rad, encoder rad and grip force N, all (n,), and its scene.

    force    NaN where it is not known
    touched  time of the first contact, s; NaN where there is none or where it is not known
    """

    scene: Scene
    time: NDArray[np.float64]
    current: NDArray[np.float64]
    reference: NDArray[np.float64]
    encoder: NDArray[np.float64]
    force: NDArray[np.float64]
    touched: float = math.nan


def kind_of(grasp: GraspObject | None) -> str:
    """void, rigid or soft by the object's stiffness (`RIGID_FROM`)."""
    if grasp is None:
        return VOID
    return RIGID if grasp.stiffness >= RIGID_FROM else SOFT


def draw_scenes(
    closures: int,
    seed: int,
    *,
    hands: int = 1,
    models: Sequence[str] = ("",),
    variety: str = "narrow",
    objects: int | None = None,
) -> tuple[Scene, ...]:
    """`closures` scenes; models in turn, hands, objects and references drawn.

    hands    hands of the population; with 1 it is the model as it is
    variety  what is drawn from, by name
    objects  different objects (and, drawn apart, void closures); None: every closure has an object of its own
    """
    if closures < 1 or hands < 1 or not models or (objects is not None and objects < 1):
        raise HannesError(
            f"A data set needs at least one closure, hand, model and object, not {closures}, {hands}, {len(models)} "
            f"and {objects}."
        )
    if variety not in VARIETIES:
        raise HannesError(f"Variety {variety!r} is unknown; valid are {', '.join(VARIETIES)}.")
    chosen = VARIETIES[variety]
    scenes = []
    for k in range(closures):
        # Of each scene's own generator, so that more closures do not change the first ones.
        rng = np.random.default_rng([seed, 0, k])
        number = k if objects is None else int(rng.integers(objects))
        grasp = draw_object(chosen, seed, number) if rng.uniform() >= chosen.void else None
        kind = kind_of(grasp)
        scenes.append(
            Scene(
                object=VOID if grasp is None else f"{kind}_{number:04d}",
                kind=kind,
                grasp=grasp,
                amplitude=FULL_CLOSURE * float(rng.uniform(*chosen.amplitudes)),
                period=float(rng.uniform(*chosen.periods)),
                # Hand 0 is the nominal one; a varied set has none of it.
                hand=int(rng.integers(hands)) + (1 if chosen.varied else 0),
                model=models[k % len(models)],
                profile=chosen.profiles[int(rng.integers(len(chosen.profiles)))],
                varied=chosen.varied,
            )
        )
    return tuple(scenes)


def draw_object(variety: Variety, seed: int, number: int) -> GraspObject:
    """Object number `number` of the variety."""
    rng = np.random.default_rng([seed, 5, number])

    def log_uniform(span: tuple[float, float]) -> float:
        return float(np.exp(rng.uniform(math.log(span[0]), math.log(span[1]))))

    stiffness = log_uniform(variety.stiffness[number % len(variety.stiffness)])
    shape = variety.shapes[int(rng.integers(len(variety.shapes)))]
    place = np.add(PLACES.get(shape, (0.0, 0.0, 0.0)), rng.uniform(-variety.jitter, variety.jitter, 3))
    return GraspObject(
        shape=shape,
        size=float(rng.uniform(*variety.sizes)),
        stiffness=stiffness,
        damping=min(variety.damping, stiffness * log_uniform(variety.damping_time)),
        place=(float(place[0]), float(place[1]), float(place[2])),
    )


def bench_scenes(
    hands: int,
    closures: int,
    *,
    model: str,
    varied: bool = True,
    objects: Mapping[str, GraspObject] | None = None,
) -> tuple[Scene, ...]:
    """The thesis' test (P17, P18): each object closed on `closures` times, by `hands` hands of the population in turn.

    varied False takes the nominal hand.
    """
    given = THESIS_OBJECTS if objects is None else objects
    return tuple(
        Scene(name, kind_of(grasp), grasp, hand=1 + k % hands if varied else 0, model=model, varied=varied)
        for name, grasp in given.items()
        for k in range(closures)
    )


def hand_of(model: Model, hand: int, seed: int, *, varied: bool = False) -> Model:
    """The model with the parameters of hand number `hand` of the population; hand 0 is the model itself.

    The spreads are those of the shipped parameter file `population.yaml` (`hand_sd`), normally distributed and
    cut at the parameters' bounds. A varied hand has up to three effects of the catalogue at 0.3 to 2 times their
    typical strength, of either sign where the effect has one; one that the model itself has adds to it.
    """
    if hand == 0:
        return model
    rng = np.random.default_rng([seed, 1, hand])
    model = _scattered(model, "hand_sd", rng)
    if not varied:
        return model
    rng = np.random.default_rng([seed, 4, hand])
    names = sorted(catalogue())
    for name in rng.choice(names, size=int(rng.choice(4, p=(0.2, 0.3, 0.3, 0.2))), replace=False):
        sign = float(rng.choice((-1.0, 1.0))) if catalogue()[name].strength().lower < 0.0 else 1.0
        factor = float(np.exp(rng.uniform(math.log(0.3), math.log(2.0))))
        model = _with_hidden(model, strength_of(str(name), sign * factor))
    return model


def _with_hidden(model: Model, hidden: EffectEntry) -> Model:
    """The model with a further effect. What the model has of it already stays below: to replace a calibrated strength
    by a draw around the typical one could take away more than it hides."""
    own = next((e for e in model.effects if e.name == hidden.name), None)
    if own is not None:
        kind = effect_of(own)
        values = dict(own.values)
        for p in kind.parameters:
            if p.vanishing is not None:
                values[p.name] = min(
                    max(values[p.name] + hidden.values[p.name] - p.vanishing, p.lower), p.upper
                )
        hidden = kind.entry(values, source=own.source)
    return model.with_effect(hidden)


def _scattered(model: Model, spread: str, rng: np.random.Generator) -> Model:
    """The model with parameters drawn from the tolerances `spread` of the population file."""
    values = {}
    for name, entry in sorted(read_yaml(data_path("parameters", "population.yaml"), "population").items()):
        draw = float(rng.standard_normal()) * float(entry[spread])
        if name in model.parameters and draw != 0.0:
            parameter = model.parameters[name]
            value = parameter.value * (1.0 + draw) if entry["unit"] == "1" else parameter.value + draw
            values[name] = min(max(value, parameter.lower), parameter.upper)
    return model.with_values(values)


def simulate(scene: Scene, model: Model, sensors: Sensors, seed: int, index: int) -> Closure:
    """Roll one scene out by its hand and measure it; `seed` and `index` fix what scatters and the sensors' noise."""
    hand = _scattered(model, "closure_sd", np.random.default_rng([seed, 3, index])) if scene.varied else model
    plant = make_plant(hand, scene.grasp)
    controller = DoublePID.of_model(model.parameters)
    reference = make_profile(
        scene.profile, amplitude=scene.amplitude, period=scene.period, dt=controller.period
    )
    run = rollout(plant, controller, reference, joints=False)
    samples = sensors.sample(run, np.random.default_rng([seed, 2, index]))
    return closure_of({**samples, "grip_force": (run.time, run.grip_force)}, scene)


def closure_of(samples: Mapping[str, tuple[Array, Array]], scene: Scene) -> Closure:
    """The closure in measured signals, given as name -> (time (n,) s, values (n,)).

    All signals are taken at the instants of the current: the last value of each, never a later one; NaN where
    there is none.
    """
    missing = [name for name in INPUTS if name not in samples]
    if missing:
        raise HannesError(
            f"The closure on '{scene.object}' lacks {', '.join(missing)}; it has {', '.join(samples)}."
        )
    time, current = (np.asarray(a, dtype=float) for a in samples["motor_current"])
    held = {
        name: hold(*samples[name], time) if name in samples else np.full(len(time), np.nan)
        for name in (*INPUTS[1:], "grip_force")
    }
    touched = math.nan
    if "grip_force" in samples:
        at, force = samples["grip_force"]
        above = np.flatnonzero(np.asarray(force) > CONTACT_FORCE)
        touched = float(at[above[0]]) if len(above) else math.nan
    # Whole nanoseconds, as a bag keeps them.
    time = np.rint(time * 1e9) / 1e9
    return Closure(
        scene,
        time,
        current,
        held["reference_position"],
        held["encoder_position"],
        held["grip_force"],
        touched,
    )


def label(features: Features, closure: Closure, *, contact: bool = True) -> NDArray[np.int64]:
    """True class (n,) of the feature samples of a closure.

    contact  a sample without contact is void (X18); False: only the rules and the kind of the object count (P19)
    """
    kind = STIFFNESS_CLASSES.index(closure.scene.kind)
    truth = np.where(features.void, 0, kind).astype(np.int64)
    if contact and kind and len(truth):
        force = closure.force[np.searchsorted(closure.time, features.time - 1e-9)]
        truth[force <= CONTACT_FORCE] = (
            0  # NaN compares false: where the force is not known, P19 stands alone
        )
    return truth


@dataclass(frozen=True)
class Dataset:
    """Measured closures and how they were made.

    closures  in the order of their scenes
    manifest  models (name, hash), seed, sensors, counts
    """

    closures: tuple[Closure, ...]
    manifest: Mapping[str, Any]

    def features(self, spec: FeatureSpec) -> list[Features]:
        """Feature samples of every closure."""
        return [extract(c.time, c.current, c.reference, c.encoder, spec) for c in self.closures]

    def training_data(self, spec: FeatureSpec, *, contact: bool = True) -> TrainingData:
        """All feature samples with their labels, grouped by closure, object and hand; `contact` as in `label`."""
        parts = self.features(spec)
        labels = [label(f, c, contact=contact) for f, c in zip(parts, self.closures, strict=True)]
        count = [len(f.time) for f in parts]
        scenes = [c.scene for c in self.closures]
        objects = {name: k for k, name in enumerate(dict.fromkeys(s.object for s in scenes))}
        # A void closure has no object to be known again by.
        own = [len(objects) + k if s.grasp is None else objects[s.object] for k, s in enumerate(scenes)]
        stiffness = [s.grasp.stiffness if s.grasp is not None and s.known else math.nan for s in scenes]
        return TrainingData(
            np.concatenate([f.values for f in parts]),
            np.concatenate(labels),
            np.concatenate([f.void for f in parts]),
            np.repeat(np.arange(len(parts)), count),
            np.repeat(own, count),
            np.repeat([s.hand for s in scenes], count),
            np.repeat(stiffness, count),
        )

    @classmethod
    def load(cls, folder: str | Path) -> Dataset:
        """Read a bag set; HannesError says what is wrong with a folder that is not a whole one."""
        folder = Path(folder)
        manifest = _read_manifest(folder)
        parts = manifest.get("parts")
        if not isinstance(parts, list):
            raise HannesError(
                f"The data set '{folder}' is not finished; give the same `hannes stiffness dataset` again to go on."
            )
        closures = [closure for name in parts for closure in closures_of(read_bag(folder / str(name)))]
        return cls(tuple(closures), manifest)


def merge(sets: Sequence[Dataset]) -> Dataset:
    """Several sets as one to train on; objects and hands of different sets stay different."""
    if not sets:
        raise HannesError("There is no data set to train on.")
    if len(sets) == 1:
        return sets[0]
    whose = [json.dumps(one.manifest, sort_keys=True) for one in sets]
    if len(set(whose)) < len(whose):
        raise HannesError(
            "A data set is given more than once: its closures would be on both sides of every split."
        )
    most = 1 + max(c.scene.hand for one in sets for c in one.closures)
    closures = tuple(
        replace(
            c,
            scene=replace(
                c.scene,
                object=c.scene.object if c.scene.grasp is None else f"{number}/{c.scene.object}",
                hand=number * most + c.scene.hand,
            ),
        )
        for number, one in enumerate(sets)
        for c in one.closures
    )
    kinds = {kind: sum(c.scene.kind == kind for c in closures) for kind in STIFFNESS_CLASSES}
    manifests = [{k: v for k, v in one.manifest.items() if k != "parts"} for one in sets]
    return Dataset(closures, {"closures": len(closures), "kinds": kinds, "sets": manifests})


def _read_manifest(folder: Path) -> dict[str, Any]:
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise HannesError(
            f"'{folder}' is not a stiffness data set ({error}); give the folder of one, or a new one to make it in."
        ) from error
    if not isinstance(manifest, dict) or manifest.get("schema") != SCHEMA:
        raise HannesError(f"'{folder}' is not a stiffness data set of this version ({SCHEMA}).")
    return manifest


def recording_of(closures: Sequence[Closure], source: str) -> Recording:
    """Closures one after the other as a recording; its metadata say what each was on and when it starts."""
    channels: dict[str, list[Array]] = {name: [] for name in _ARRAYS}
    times, starts, start = [], [], 0.0
    for closure in closures:
        starts.append(start)
        times.append(start + closure.time)
        for name in _ARRAYS:
            channels[name].append(getattr(closure, name))
        start = math.ceil(times[-1][-1] + _PAUSE)
    time = np.concatenate(times)
    metadata = {
        "closures": len(closures),
        "scenes": [c.scene.to_dict() for c in closures],
        "starts": starts,
        "touched": [None if math.isnan(c.touched) else c.touched for c in closures],
    }
    return Recording(
        {
            signal: Channel(time, np.concatenate(channels[name]), SIGNALS[signal].unit, signal)
            for name, signal in _ARRAYS.items()
        },
        metadata,
        source,
    )


def closures_of(recording: Recording) -> list[Closure]:
    """The closures of a bag of a set: the inverse of `recording_of`."""
    meta = recording.metadata
    try:
        scenes = [Scene.from_dict(scene) for scene in meta["scenes"]]
        starts = [float(start) for start in meta["starts"]]
        touched = [math.nan if at is None else float(at) for at in meta["touched"]]
        recording.require([*_ARRAYS.values()])
        time = recording["motor_current"].time + recording_offset(recording)
        cut = np.searchsorted(time, np.array(starts[1:]) - 1e-6)
        pieces = {name: np.split(recording[signal].values, cut) for name, signal in _ARRAYS.items()}
        times = np.split(time, cut)
        if not len(scenes) == len(starts) == len(touched) == len(times):
            raise HannesError("its numbers of scenes, starts and closures differ")
        return [
            Closure(
                scene,
                np.rint((t - start) * 1e9) / 1e9,
                np.array(pieces["current"][k]),
                np.array(pieces["reference"][k]),
                np.array(pieces["encoder"][k]),
                np.array(pieces["force"][k]),
                at,
            )
            for k, (scene, start, at, t) in enumerate(zip(scenes, starts, touched, times, strict=True))
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise HannesError(f"'{recording.source}' is not a bag of a stiffness data set: {error}.") from error


def recording_offset(recording: Recording) -> float:
    """Time 0 of the channels on the clock of the set, s."""
    return recording.start_ns * 1e-9


def make_dataset(
    scenes: Sequence[Scene],
    *models: Model,
    seed: int,
    sensors: Sensors = THESIS,
    jobs: int = 1,
    folder: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Dataset:
    """Simulate the scenes, each with its model and its hand of the population.

    models    the models that the scenes name; a scene without a name takes the first
    seed      fixes the hands, the scatter and the noise (the scenes are given)
    jobs      processes; the result does not depend on it
    folder    where to write the bag set; parts that are there already (of the same request) are kept
    progress  told how many closures of how many are done
    """
    named = {model.name: model for model in models}
    if not models or len(named) < len(models):
        raise HannesError(f"The models {[model.name for model in models]} need a name of their own each.")
    unknown = sorted({scene.model for scene in scenes} - {*named, ""})
    if unknown:
        raise HannesError(f"Scenes name the model '{unknown[0]}'; there is {', '.join(named)}.")
    if jobs < 1:
        raise HannesError(f"The number of processes is {jobs}; it must be at least 1.")
    named[""] = models[0]
    request = {
        "schema": SCHEMA,
        "seed": seed,
        "models": {
            m.name: {"sha256": m.sha256, "plant": m.plant, "effects": [e.name for e in m.effects]}
            for m in models
        },
        "hands": len({scene.hand for scene in scenes}),
        "objects": len({scene.object for scene in scenes if scene.grasp is not None}),
        "varied": any(scene.varied for scene in scenes),
        "closures": len(scenes),
        "kinds": {kind: sum(s.kind == kind for s in scenes) for kind in STIFFNESS_CLASSES},
        "sensors": sensors.to_dict(),
    }
    parts = [(k, list(enumerate(scenes))[k * PART : (k + 1) * PART]) for k in range(-(-len(scenes) // PART))]
    path = None if folder is None else Path(folder)
    if path is not None:
        _open_set(path, request)
    closures: list[Closure] = []
    diverged: list[int] = []
    work = [(part, named, sensors, seed, path and path / f"part_{k:05d}") for k, part in parts]
    for made, failed in _run(work, jobs):
        closures += made
        diverged += failed
        if progress is not None:
            progress(len(closures) + len(diverged), len(scenes))
    manifest = {**request, "diverged": diverged}
    if path is not None:
        manifest["parts"] = [f"part_{k:05d}" for k, _ in parts if (path / f"part_{k:05d}").is_dir()]
        _write_manifest(path, manifest)
    return Dataset(tuple(closures), manifest)


def _open_set(path: Path, request: Mapping[str, Any]) -> None:
    """Begin a bag set, or find the one that this request began."""
    if path.exists() and any(path.iterdir()) if path.is_dir() else path.exists():
        there = _read_manifest(path)
        other = [key for key, value in json.loads(json.dumps(request)).items() if there.get(key) != value]
        if other:
            raise HannesError(
                f"The folder '{path}' holds another data set (its {', '.join(other)} differ); give another folder."
            )
        return
    _write_manifest(path, request)


def _write_manifest(path: Path, manifest: Mapping[str, Any]) -> None:
    try:
        write_whole(path / MANIFEST, json.dumps(manifest, indent=1) + "\n")
    except OSError as error:
        raise HannesError(f"Cannot write the data set '{path}': {error}.") from error


_Work = tuple[list[tuple[int, Scene]], Mapping[str, Model], Sensors, int, "Path | None"]
_Made = tuple[list[Closure], list[int]]


def _make_part(
    part: list[tuple[int, Scene]], models: Mapping[str, Model], sensors: Sensors, seed: int, bag: Path | None
) -> _Made:
    """The closures of a part, and the numbers of the scenes whose simulation diverged."""
    if bag is not None and bag.is_dir():
        recording = read_bag(bag)
        return closures_of(recording), list(recording.metadata.get("diverged", []))
    made, diverged = [], []
    for index, scene in part:
        hand = hand_of(models[scene.model], scene.hand, seed, varied=scene.varied)
        try:
            made.append(simulate(scene, hand, sensors, seed, index))
        except PlantDiverged:
            diverged.append(index)
    if bag is not None and made:
        # Under another name until it is whole, so that an interruption leaves no half part.
        temporary = bag.with_name(bag.name + ".part")
        shutil.rmtree(temporary, ignore_errors=True)
        recording = recording_of(made, str(bag))
        write_recording(
            Recording(recording.channels, {**recording.metadata, "diverged": diverged}, str(bag)),
            temporary,
            compression="zstd",
        )
        temporary.replace(bag)
    return made, diverged


def _run(work: Sequence[_Work], jobs: int) -> Iterable[_Made]:
    if jobs == 1:
        return (_make_part(*item) for item in work)
    return _in_workers(work, jobs)


def _in_workers(work: Sequence[_Work], jobs: int) -> Iterator[_Made]:
    """What worker processes make; where this is left early (Ctrl-C, SIGTERM), they are ended at once."""
    from joblib import Parallel, delayed
    from joblib.externals.loky import get_reusable_executor

    whole = False
    end_after_feeders()
    warnings.filterwarnings(
        "ignore", message=".*tasks which were still being processed", category=UserWarning
    )
    try:
        yield from Parallel(n_jobs=jobs, return_as="generator")(delayed(_make_part)(*item) for item in work)
        whole = True
    finally:
        if not whole:
            # a result that came while they were ended may have started others
            get_reusable_executor(reuse=True).shutdown(wait=True, kill_workers=True)
