"""A slow plant seen through a fast one, so that a search of thousands of simulations needs only a few slow ones.

    signal(values) = fast(values) + slow(anchor) - fast(anchor)

At the anchor this is the slow plant exactly; away from it only the fast plant's sensitivities count.  A fit moves the
anchor to where it ends and goes on until it stays there (manifold mapping: Echeverria, Hemker 2005), so that what is
reported at the end was simulated on the slow plant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from hannes_description.model import Model
from hannes_sim.effect import EffectType
from numpy.typing import NDArray

from .rig import Nuisance, PlantRig, Rig
from .trials import Trial

Array = NDArray[np.float64]

FAST_PLANT = "reduced"
SLOW_PLANTS = ("mujoco",)
"""Plants of which a whole diagnosis would take longer than a coffee."""


class AnchoredRig:
    """A rig whose slow plant is replaced by the fast one and a correction taken at an anchor.

    exact   the rig itself
    """

    def __init__(self, exact: PlantRig, model: Model, values: Mapping[str, float]) -> None:
        self.exact = exact
        self.trials = exact.trials
        self.floor, self.points, self.pooled = exact.floor, exact.points, exact.pooled
        self.drive_signals, self.without = exact.drive_signals, exact.without
        self.phases, self.figures, self.experiments = exact.phases, exact.figures, exact.experiments
        self._model, self._values = model, dict(values)
        self._corrections: dict[tuple[str, int], dict[str, Array]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (self.exact, self._model, self._values, self._corrections)

    def anchored(self, model: Model, values: Mapping[str, float]) -> AnchoredRig:
        """The same with another anchor."""
        return AnchoredRig(self.exact, model, values)

    def nuisances(self, model: Model) -> Sequence[Nuisance]:
        """See Rig."""
        return self.exact.nuisances(model)

    def effect(self, kind: EffectType) -> EffectType:
        """See Rig."""
        return self.exact.effect(kind)

    def simulate(
        self, model: Model, values: Mapping[str, float], trial: Trial, reference: Array
    ) -> dict[str, Array]:
        """See Rig."""
        fast = self.exact.simulate(model.with_plant(FAST_PLANT), values, trial, reference)
        correction = self._correction(trial, reference)
        return {name: signal + correction[name] for name, signal in fast.items()}

    def _correction(self, trial: Trial, reference: Array) -> dict[str, Array]:
        key = (trial.name, reference.size)
        if key not in self._corrections:
            slow = self.exact.simulate(self._model, self._values, trial, reference)
            fast = self.exact.simulate(self._model.with_plant(FAST_PLANT), self._values, trial, reference)
            self._corrections[key] = {name: slow[name] - fast[name] for name in fast}
        return self._corrections[key]


def _rebuild(
    exact: PlantRig,
    model: Model,
    values: dict[str, float],
    corrections: dict[tuple[str, int], dict[str, Array]],
) -> AnchoredRig:
    rig = AnchoredRig(exact, model, values)
    rig._corrections.update(corrections)
    return rig


def rig_for(rig: Rig, model: Model) -> Rig:
    """The rig to search with: anchored where the model's plant is slow, else the rig itself."""
    if model.plant in SLOW_PLANTS and isinstance(rig, PlantRig):
        return AnchoredRig(rig, model, {})
    return rig


def exact_rig(rig: Rig) -> Rig:
    """The rig that simulates the model's own plant."""
    return rig.exact if isinstance(rig, AnchoredRig) else rig


def anchored_at(rig: Rig, model: Model, values: Mapping[str, float]) -> Rig:
    """The rig with its anchor moved, where it has one."""
    return rig.anchored(model, values) if isinstance(rig, AnchoredRig) else rig
