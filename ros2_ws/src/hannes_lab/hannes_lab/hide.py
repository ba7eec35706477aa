"""Measurement sets with a hidden effect: to test the lab, and to learn what an effect looks like.

A set is one bag per condition.  The hand is drawn from the population, its parameters scatter from closure to closure,
the sensors are real (30 Hz rectified current, encoder counts, noise).  The truth goes into a file of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from hannes_bags.recording import Channel, Recording
from hannes_bags.writing import write_recording
from hannes_control.reference import half_sine
from hannes_description.errors import HannesError
from hannes_description.model import EffectEntry, Model
from hannes_description.parameters import data_path, read_yaml
from hannes_description.signals import SIGNALS
from hannes_sim.effect import load_effect, strength_of
from hannes_sim.factory import make_plant
from hannes_sim.measurement import SENSORS, Sensors
from hannes_sim.objects import named_object
from hannes_sim.rollout import Rollout, rollout
from numpy.typing import NDArray

from .described import CONTROL_PERIOD
from .hand import make_controller
from .recorded import make_trial
from .trials import Closure, Trial, curves_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ConditionSpec:
    """One condition of a set: period of the half sine [s], amplitude [rad], and what is grasped (a named object)."""

    name: str
    period: float
    amplitude: float
    grasp: str

    def reference(self, dt: float, rate: float) -> Array:
        """One closure on the control grid, held between the messages of the reference topic (rate, Hz)."""
        profile = half_sine(1, self.amplitude, self.period, dt)
        hold = max(1, round(1.0 / rate / dt))
        return profile[np.arange(profile.size) // hold * hold]


CONDITIONS: Mapping[str, ConditionSpec] = {
    c.name: c
    for c in (
        ConditionSpec("slow", 4.0, 13.0, "none"),
        ConditionSpec("fast", 1.8, 13.0, "none"),
        ConditionSpec("grasp", 4.0, 13.0, "rigid"),
        ConditionSpec("grasp_soft", 4.0, 13.0, "soft"),
        ConditionSpec("grasp_fast", 2.0, 13.0, "soft"),
        ConditionSpec("creep", 12.0, 13.0, "none"),
    )
}
"""Conditions by name; the default set is slow, fast, grasp."""

DEFAULT_CONDITIONS = ("slow", "fast", "grasp")

REST = 0.5
"""s of rest before the first closure."""


def empty_trial(condition: str) -> Trial:
    """A closure of which nothing was recorded: what a model's own code is tried on."""
    spec, period = CONDITIONS[condition], CONTROL_PERIOD
    reference = spec.reference(period, 1.0 / period)
    closure = Closure(0.0, spec.period, condition)
    return Trial(condition, period, reference, {}, (closure,), {"object": spec.grasp})


@dataclass(frozen=True)
class Truth:
    """What was hidden: the effects, the hand's own parameters, and the seed."""

    effects: tuple[EffectEntry, ...]
    parameters: Mapping[str, str]
    """the hand's own beside the nominal: 'x 1.0421' or '+ 0.0031 rad'"""
    seed: int
    plant: str
    visible: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """condition -> signal -> what the effects change, in multiples of the closures' scatter; see `visibility`"""

    def to_dict(self) -> dict[str, Any]:
        seen = {name: {s: float(f"{v:.3g}") for s, v in own.items()} for name, own in self.visible.items()}
        return {
            "seed": self.seed,
            "plant": self.plant,
            "effects": [e.to_dict() for e in self.effects],
            "parameters": dict(self.parameters),
            **({"visible": seen} if seen else {}),
        }


def make_set(
    model: Model,
    effects: Sequence[EffectEntry],
    *,
    seed: int,
    closures: int = 13,
    conditions: Sequence[str] = DEFAULT_CONDITIONS,
    sensors: Sensors | str = "thesis",
    scatter: float = 1.0,
    spread: float = 1.0,
) -> tuple[list[Recording], Truth]:
    """Recordings of one hand of the population with hidden effects, and the truth.

    scatter, spread  factors on the tolerances of population.yaml from closure to closure, from hand to hand
    """
    if closures < 1:
        raise HannesError(f"A set needs at least one closure per condition, not {closures}.")
    unknown = [name for name in conditions if name not in CONDITIONS]
    if unknown:
        raise HannesError(f"Unknown condition {', '.join(unknown)}; valid are {', '.join(CONDITIONS)}.")
    if isinstance(sensors, str):
        if sensors not in SENSORS:
            raise HannesError(f"Unknown sensor set '{sensors}'; valid are {', '.join(SENSORS)}.")
        sensors = SENSORS[sensors]
    for effect in effects:
        model = model.with_effect(effect)
    table = read_yaml(data_path("parameters", "population.yaml"), "population file")
    rng = np.random.default_rng(seed)
    hand = {name: spread * float(entry["hand_sd"]) * rng.standard_normal() for name, entry in table.items()}
    recordings = [
        _record(
            model,
            CONDITIONS[name],
            closures,
            sensors,
            hand,
            table,
            scatter,
            np.random.default_rng([seed, number + 1]),
        )
        for number, name in enumerate(conditions)
    ]
    truth = {
        name: (f"x {math.exp(z):.4f}" if table[name]["unit"] == "1" else f"+ {z:.4f} {table[name]['unit']}")
        for name, z in hand.items()
    }
    return recordings, Truth(tuple(effects), truth, seed, model.plant)


def _record(
    model: Model,
    spec: ConditionSpec,
    closures: int,
    sensors: Sensors,
    hand: Mapping[str, float],
    table: Mapping[str, Mapping[str, Any]],
    scatter: float,
    rng: np.random.Generator,
) -> Recording:
    plant = make_plant(model, named_object(spec.grasp))
    controller = make_controller(model, 1e-3)
    base = {name: plant.get(name) for name in table if not name.startswith("object.") or spec.grasp != "none"}
    zero = hand.get("encoder.zero", 0.0)
    reference = spec.reference(controller.period, sensors.reference_rate)
    parts: list[Rollout] = []
    for _ in range(closures):
        for name, value in base.items():
            entry = table[name]
            shift = hand[name] + scatter * float(entry["closure_sd"]) * rng.standard_normal()
            if name == "encoder.zero":
                plant.set(name, zero + scatter * float(entry["closure_sd"]) * rng.standard_normal())
            else:
                plant.set(name, value * math.exp(shift) if entry["unit"] == "1" else value + shift)
        if not parts:
            rest = np.zeros(round(REST / controller.period))
            parts.append(rollout(plant, controller, rest, joints=False))
        parts.append(rollout(plant, controller, reference, reset=False, joints=False))
    run = Rollout(
        np.concatenate([p.time for p in parts]),
        np.concatenate([p.reference_position for p in parts]),
        np.concatenate([p.motor_voltage for p in parts]),
        np.concatenate([p.raw for p in parts]),
    )
    samples = sensors.sample(run, rng)
    channels = {}
    for name, (time, values) in samples.items():
        channels[name] = Channel(time, values, SIGNALS[name].unit, name)
    metadata = {
        "condition": spec.name,
        "closures": closures,
        "object": spec.grasp,
        "sensors": sensors.to_dict(),
        "plant": model.plant,
    }
    return Recording(channels, metadata, spec.name)


def visibility(recordings: Sequence[Recording], without: Sequence[Recording]) -> dict[str, dict[str, float]]:
    """How much recordings differ from those of the same hand, scatter and noise without the effects.

    Condition -> signal -> root mean square of the difference of the mean closures over that of the closures' own
    scatter: what a fit of the hand's own parameters leaves of it is less, and of an effect that is much like one of
    them next to nothing.  Signals that repeat exactly are left out, and all where a condition has one closure.
    """
    out = {}
    for recording, bare in zip(recordings, without, strict=True):
        trial, plain = make_trial(recording), make_trial(bare)
        own = {}
        for name, (time, values) in plain.signals.items():
            closures = curves_of(plain.closures, time, values)
            apart = curves_of(plain.closures, *trial.signals[name]).mean(axis=0) - closures.mean(axis=0)
            scatter = np.std(closures, axis=0, ddof=1) if len(closures) > 1 else np.zeros(1)
            if scatter.any():
                own[name] = float(np.sqrt(np.mean(apart**2) / np.mean(scatter**2)))
        out[str(recording.metadata["condition"])] = own
    return {name: own for name, own in out.items() if own}


def write_set(
    recordings: Sequence[Recording], truth: Truth, folder: str | Path, truth_file: str | Path
) -> list[Path]:
    """One bag per condition below `folder`; the truth in a file outside the bags."""
    folder, truth_file = Path(folder), Path(truth_file)
    if truth_file.exists():
        raise HannesError(f"The truth file '{truth_file}' exists already; give another name.")
    names = [str(r.metadata["condition"]) for r in recordings]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise HannesError(f"Condition {', '.join(twice)} is asked for more than once; name each once.")
    try:
        truth_file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HannesError(
            f"No folder '{truth_file.parent}' for the truth: {error.strerror or error}."
        ) from error
    bags = [write_recording(r, folder / str(r.metadata["condition"]), compression="zstd") for r in recordings]
    try:
        truth_file.write_text(yaml.safe_dump(truth.to_dict(), sort_keys=False), encoding="utf-8")
    except OSError as error:
        raise HannesError(
            f"The truth cannot be written to '{truth_file}': {error.strerror or error}."
        ) from error
    return bags


def entries_of(wanted: Mapping[str, float], texts: Sequence[str]) -> dict[str, EffectEntry]:
    """Entries of effects (name or path.py:Class -> factor of the typical strength) by these words.

    texts   "EFFECT.PARAMETER=NUMBER": values of their own, in SI; the others stay as the factor makes them
    Raises HannesError for a text that is not of that form, an effect that is not hidden, a parameter that it has not, a
    value out of its range, and where nothing would be hidden.
    """
    kinds = {source: load_effect(source) for source in wanted}
    own: dict[str, dict[str, float]] = {kind.name: {} for kind in kinds.values()}
    for text in texts:
        place, _, number = text.rpartition("=")
        name, _, parameter = place.partition(".")
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not (name and parameter and math.isfinite(value)):
            raise HannesError(f"--value {text}: give EFFECT.PARAMETER=NUMBER, such as cogging.period=2.9.")
        if name not in own:
            hidden = ", ".join(own) or "none"
            raise HannesError(
                f"--value {text}: the effect '{name}' is not hidden (--effect); hidden are: {hidden}."
            )
        if parameter in own[name]:
            raise HannesError(f"--value {name}.{parameter} is given more than once; give one number.")
        own[name][parameter] = value
    out = {}
    for source, factor in wanted.items():
        kind, entry = kinds[source], strength_of(source, factor)
        if given := own[kind.name]:
            values = {**entry.values, **given}
            entry = kind.entry(values, source=entry.source, where="given to hannes hide")
            strengths = [p for p in kind.parameters if p.vanishing is not None]
            if all(entry.values[p.name] == p.vanishing for p in strengths):
                raise HannesError(f"--value: with {', '.join(given)} as given, '{kind.name}' hides nothing.")
        out[source] = entry
    return out
