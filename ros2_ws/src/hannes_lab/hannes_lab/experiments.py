"""Which experiment tells tied models apart: candidate conditions ranked by what the models predict for them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from hannes_control.reference import make_profile
from hannes_sim.plant import PlantDiverged
from numpy.typing import NDArray

from .prepare import Prepared
from .problem import Coordinate, nuisance_coordinate, sample_variance
from .rig import Rig
from .search import Candidate
from .surrogate import FAST_PLANT, SLOW_PLANTS
from .trials import Closure, Trial

Array = NDArray[np.float64]
Loose = tuple[Coordinate, float, float]
"""A parameter that stays open: coordinate, z and standard deviation of z."""


VISIBLE = 5.0
"""Whitened distance d from which an experiment tells two models apart: where one of them is right, their costs differ
by d^2 with a standard deviation of 2 d, which at 5 is more than a tie allows (6) in 97 %."""


@dataclass(frozen=True)
class Experiment:
    """A condition to record next.

    profile, options  of hannes_control.reference.make_profile
    grasp             named object
    distance          least whitened distance between any two tied models, nuisance parameters compensated
    """

    name: str
    profile: str
    options: dict[str, float]
    grasp: str
    distance: float
    separates: tuple[tuple[str, ...], ...]

    def to_dict(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "profile": self.profile,
            "options": dict(self.options),
            "object": self.grasp,
            "distance": self.distance,
            "separates": [list(n) for n in self.separates],
            "command": f"hannes record bags/{self.name} --condition {self.name} --object {self.grasp} "
            f"--profile {self.profile} --closures 13"
            + "".join(f" --{k} {v:g}" for k, v in self.options.items()),
        }


CANDIDATES: tuple[tuple[str, str, dict[str, float], str], ...] = (
    ("slow_void", "half_sine", {"period": 8.0}, "none"),
    ("fast_void", "half_sine", {"period": 1.5}, "none"),
    ("small_void", "half_sine", {"period": 3.0, "amplitude": 5.0}, "none"),
    ("reversals_void", "reversals", {"period": 8.0}, "none"),
    ("hold_rigid", "ramp_hold", {"period": 6.0}, "rigid"),
    ("hold_soft", "ramp_hold", {"period": 6.0}, "soft"),
    ("fast_soft", "half_sine", {"period": 1.8}, "soft"),
    ("reversals_rigid", "reversals", {"period": 8.0}, "rigid"),
)
"""Candidate conditions: name, profile, options, object."""


def separating_experiments(
    prepared: Prepared, tied: Sequence[Candidate], keep: int = 3
) -> tuple[Experiment, ...]:
    """The candidate conditions that separate the tied models best.

    Each model predicts one closure with its fitted parameters; differences count in units of the sensors' noise and
    scatter as they were seen in these data, after the nuisance parameters have compensated what they can within their
    tolerances, and the effects' own parameters within what these data leave open.  A condition in which one of the
    models diverges is left out.
    """
    if not prepared.rig.experiments:
        return ()
    tied = tied[:4]
    noise = _noise(prepared)
    out = []
    if not noise:
        return ()
    for name, profile, options, grasp in CANDIDATES:
        trial = _trial(prepared.features.trials[0], name, profile, options, grasp)
        rig = type(prepared.rig)([trial])  # type: ignore[call-arg]  # the protocol has no constructor
        try:
            distance = _least_distance(rig, tied, trial, noise)
        except PlantDiverged:
            continue
        out.append(Experiment(name, profile, dict(options), grasp, distance, tuple(c.names for c in tied)))
    return tuple(sorted(out, key=lambda e: -e.distance)[:keep])


def _least_distance(rig: Rig, tied: Sequence[Candidate], trial: Trial, noise: dict[str, float]) -> float:
    """Least whitened distance between any two tied models; PlantDiverged where one of them diverges."""
    open_ = [_open(rig, c) for c in tied]
    predictions = [_predict(rig, c, trial, noise, o) for c, o in zip(tied, open_, strict=True)]
    of_all = _sensitivity(rig, tied[0], trial, noise, open_[0], predictions[0])
    of_effects = [
        _sensitivity(rig, c, trial, noise, o, p, _found(c))
        for c, o, p in zip(tied, open_, predictions, strict=True)
    ]
    distances = []
    for a, b in itertools.combinations(range(len(tied)), 2):
        d = predictions[a] - predictions[b]
        sensitivity = np.column_stack([of_all, of_effects[a], of_effects[b]])
        reduced = d - sensitivity @ np.linalg.solve(
            sensitivity.T @ sensitivity + np.eye(sensitivity.shape[1]), sensitivity.T @ d
        )
        distances.append(float(np.sqrt(max(float(d @ reduced), 0.0))))
    return min(distances)


def _noise(prepared: Prepared) -> dict[str, float]:
    """Typical standard deviation of one sample of each signal that changes; of single closures, of their roughness."""
    values: dict[str, list[float]] = {}
    for block in prepared.features.blocks:
        span = float(np.ptp(block.measured))
        if span > 0.0:
            e = block.measured - block.measured.mean(axis=0)
            sd = float(np.sqrt(sample_variance(block.measured, e).mean()))
            values.setdefault(block.signal, []).append(max(sd, 1e-4 * span))
    return {signal: float(np.median(v)) for signal, v in values.items()}


def _trial(like: Trial, name: str, profile: str, options: dict[str, float], grasp: str) -> Trial:
    reference = make_profile(profile, closures=2, dt=like.period, **options)
    meta = {**like.options, "object": grasp}
    ends = [k * options["period"] for k in range(3)]
    closures = tuple(Closure(a, b, name) for a, b in itertools.pairwise(ends))
    return Trial(name, like.period, reference, like.signals, closures, meta)


def _open(rig: Rig, candidate: Candidate) -> list[Loose]:
    """What stays open in a new recording within the tolerances: the hand's fitted parameters, and its own.

    Those of the recording (the encoder's zero, clocks) begin at the mean of what was fitted to the others; those of
    its object are of that object.
    """
    fit = candidate.fit
    out = [
        (c, float(z), 1.0)
        for c, z in zip(fit.coordinates, fit.z, strict=True)
        if c.nuisance and "@" not in c.name
    ]
    for nuisance in rig.nuisances(fit.model):
        family, its_own, _ = nuisance.name.partition("@")
        if its_own:
            fitted = [v for name, v in fit.values.items() if name.startswith(f"{family}@")]
            if fitted and not family.startswith("object."):
                nuisance = replace(nuisance, mean=float(np.mean(fitted)))
            out.append((nuisance_coordinate(nuisance), 0.0, 1.0))
    return out


def _found(candidate: Candidate) -> list[Loose]:
    """The effects' parameters as they were found, with the standard deviations that the data leave them."""
    fit = candidate.fit
    return [
        (c, float(z), float(sd))
        for c, z, sd in zip(fit.coordinates, fit.z, fit.sd(), strict=True)
        if not c.nuisance
    ]


def _predict(
    rig: Rig,
    candidate: Candidate,
    trial: Trial,
    noise: dict[str, float],
    open_: Sequence[Loose],
) -> Array:
    model = candidate.fit.model
    values = {n: v for n, v in candidate.fit.values.items() if "@" not in n}
    run = rig.simulate(
        model.with_plant(FAST_PLANT) if model.plant in SLOW_PLANTS else model,
        values | {c.name: c.value(z) for c, z, _ in open_},
        trial,
        trial.reference,
    )
    every = max(1, round(1.0 / 30.0 / trial.period))
    # the first closure starts from rest at encoder zero and tells of that alone
    second = trial.reference.size // 2
    return np.concatenate([run[signal][second::every] / sd for signal, sd in noise.items()])


def _sensitivity(
    rig: Rig,
    candidate: Candidate,
    trial: Trial,
    noise: dict[str, float],
    open_: Sequence[Loose],
    base: Array,
    of: Sequence[Loose] | None = None,
) -> Array:
    """Change of the prediction (size, k) by a standard deviation of each of these, or of all that stays open."""
    columns = []
    for c, z, sd in open_ if of is None else of:
        step = c.inside_step(z)
        moved = [*open_, (c, z + step, sd)]
        columns.append((_predict(rig, candidate, trial, noise, moved) - base) * (sd / step))
    return np.column_stack(columns) if columns else np.zeros((base.size, 0))
