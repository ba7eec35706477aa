"""Named parameters of a model identified from published figures."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_sim.plant import PlantDiverged
from numpy.typing import NDArray

from ..cache import code_hash
from ..identify import (
    Calibration,
    agreeing,
    calibrated_model,
    held_coordinates,
    identify,
    search,
    sensitivities,
    warnings_of,
)
from ..problem import FAILED, Coordinate
from ..remembered import Remembered
from ..search import Progress

Array = NDArray[np.float64]

FIGURE_SOURCES = ("currents.py", "least_force.py", "fitting.py")
"""Files of the lab that stand between a simulation and its residual."""


@dataclass(frozen=True)
class Target:
    """A published figure to be reached: value and standard deviation in its unit, and the row it stands in."""

    name: str
    row: str
    value: float
    sd: float
    unit: str = ""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.value) and math.isfinite(self.sd) and self.sd > 0.0):
            raise HannesError(
                f"Target '{self.name}': value {self.value} and sd {self.sd} must be finite, sd positive."
            )


@dataclass(frozen=True)
class _Figures:
    size: int
    units: frozenset[str]


@dataclass
class TargetProblem:
    """Published figures as a least-squares problem: residual = (target - predicted) / sd.

    predict  (model, values) -> figures by target name
    digest   what else determines the prediction (the object, the step), for the cache's key
    """

    targets: tuple[Target, ...]
    predict: Callable[[Model, Mapping[str, float]], Mapping[str, float]]
    digest: str = ""
    simulations: int = 0
    failures: int = 0
    failed: float = FAILED

    @property
    def features(self) -> _Figures:
        return _Figures(len(self.targets), frozenset(target.unit for target in self.targets))

    @property
    def key(self) -> str:
        return json.dumps([[t.name, t.value, t.sd] for t in self.targets]) + self.digest

    def residual(self, model: Model, values: Mapping[str, float]) -> Array:
        """Residual (n,) in standard deviations; `failed` where the simulation diverges, 30 where one is missing."""
        self.simulations += 1
        try:
            found = self.predict(model, values)
        except PlantDiverged:
            self.failures += 1
            return np.full(len(self.targets), self.failed)
        out = np.array([(t.value - found.get(t.name, math.nan)) / t.sd for t in self.targets])
        return np.where(np.isfinite(out), out, 30.0)


def calibrate_targets(
    problem: TargetProblem,
    model: Model,
    coordinates: Sequence[Coordinate],
    *,
    starts: int = 3,
    seed: int = 0,
    evaluations: int = 15,
    cache: Path | None = None,
    first: Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate on published figures."""
    remembered = Remembered(problem, code_hash(FIGURE_SOURCES) + problem.key, cache, progress)
    remembered.total = starts * evaluations * (len(coordinates) + 1)

    def announce(k: int, n: int) -> None:
        remembered.text = f"start {k + 1} of {n}"

    found = search(
        remembered,
        model,
        coordinates,
        starts=starts,
        seed=seed,
        evaluations=evaluations,
        first=first,
        announce=announce,
    )
    free = [c.name for c in coordinates]
    remembered.text = "tolerances of what is held"
    held = held_coordinates(model, free)
    parameters = identify(found[0], free, held, sensitivities(remembered, found[0], held))
    notes = warnings_of(parameters, len(free), len(problem.targets))
    rows = ", ".join(dict.fromkeys(t.row for t in problem.targets))
    costs = tuple(f.cost for f in found)
    return Calibration(
        calibrated_model(model, parameters, f"fitted to {rows}"),
        parameters,
        costs,
        agreeing(costs),
        {},
        tuple(notes),
        remembered.done - remembered.hits,
        remembered.hits,
        found[0],
    )
