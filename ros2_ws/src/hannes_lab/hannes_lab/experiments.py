"""Which experiment tells tied models apart: candidate conditions ranked by what the models predict for them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from hannes_control.reference import make_profile
from numpy.typing import NDArray

from .prepare import Prepared
from .search import Candidate, Search
from .surrogate import FAST_PLANT, SLOW_PLANTS
from .trials import Trial

Array = NDArray[np.float64]


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
    prepared: Prepared, search: Search, tied: Sequence[Candidate], keep: int = 3
) -> tuple[Experiment, ...]:
    """The candidate conditions that separate the tied models best.

    Each model predicts one closure with its fitted parameters; differences count in units of the sensors' noise and
    scatter as they were seen in these data, after the nuisance parameters have compensated what they can.
    """
    if not prepared.rig.experiments:
        return ()
    tied = tied[:4]
    noise = _noise(prepared)
    out = []
    for name, profile, options, grasp in CANDIDATES:
        trial = _trial(prepared.features.trials[0], name, profile, options, grasp)
        predictions = [_predict(prepared, c, trial, noise) for c in tied]
        sensitivity = _sensitivity(prepared, tied[0], trial, noise, predictions[0])
        distances = []
        for a, b in itertools.combinations(range(len(tied)), 2):
            d = predictions[a] - predictions[b]
            reduced = d - sensitivity @ np.linalg.solve(
                sensitivity.T @ sensitivity + np.eye(sensitivity.shape[1]), sensitivity.T @ d
            )
            distances.append(float(np.sqrt(max(float(d @ reduced), 0.0))))
        out.append(
            Experiment(name, profile, dict(options), grasp, min(distances), tuple(c.names for c in tied))
        )
    return tuple(sorted(out, key=lambda e: -e.distance)[:keep])


def _noise(prepared: Prepared) -> dict[str, float]:
    """Typical standard deviation of one sample of each signal."""
    values: dict[str, list[float]] = {}
    for block in prepared.features.blocks:
        e = block.measured - block.measured.mean(axis=0)
        sd = float(np.sqrt((e**2).sum() / max(1, e.size - e.shape[1])))
        values.setdefault(block.signal, []).append(max(sd, 1e-4 * float(np.ptp(block.measured))))
    return {signal: float(np.median(v)) for signal, v in values.items()}


def _trial(like: Trial, name: str, profile: str, options: dict[str, float], grasp: str) -> Trial:
    reference = make_profile(profile, closures=2, dt=like.period, **options)
    meta = {**like.options, "object": grasp}
    return Trial(name, like.period, reference, like.signals, like.closures, meta)


def _predict(
    prepared: Prepared,
    candidate: Candidate,
    trial: Trial,
    noise: dict[str, float],
    values: dict[str, float] | None = None,
) -> Array:
    rig = type(prepared.rig)([trial])  # type: ignore[call-arg]
    run = rig.simulate(
        candidate.fit.model.with_plant(FAST_PLANT)
        if candidate.fit.model.plant in SLOW_PLANTS
        else candidate.fit.model,
        {n: v for n, v in (values or candidate.fit.values).items() if "@" not in n},
        trial,
        trial.reference,
    )
    every = max(1, round(1.0 / 30.0 / trial.period))
    second = (
        trial.reference.size // 2
    )  # the first closure starts from rest at encoder zero and tells of that alone
    return np.concatenate([run[signal][second::every] / sd for signal, sd in noise.items()])


def _sensitivity(
    prepared: Prepared, candidate: Candidate, trial: Trial, noise: dict[str, float], base: Array
) -> Array:
    columns = []
    for c in candidate.fit.coordinates:
        if c.prior and "@" not in c.name:
            z = candidate.fit.z_of(c.name) or 0.0
            moved = {**candidate.fit.values, c.name: c.value(z + c.step)}
            columns.append((_predict(prepared, candidate, trial, noise, moved) - base) / c.step)
    return np.column_stack(columns) if columns else np.zeros((base.size, 0))
