"""What the lab must know of a machine: its uncertain nominal parameters and how to simulate a trial."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import Model
from numpy.typing import NDArray

from .trials import Trial

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Nuisance:
    """A nominal parameter that is not known exactly; the fit may move it within its prior.

    name         parameter that the rig's `simulate` takes; `name@condition` acts on one condition's trial only
    mean         nominal value
    sd           standard deviation of the prior, in the parameter's unit, or of its logarithm if `log`
    log          positive parameter, treated on a logarithmic scale
    closure_sd   scatter from closure to closure, same scale as sd
    """

    name: str
    mean: float
    sd: float
    log: bool
    closure_sd: float = 0.0
    unit: str = ""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.sd) and self.sd > 0.0):
            raise HannesError(f"Nuisance '{self.name}': sd is {self.sd}; it must be positive.")
        if self.log and self.mean <= 0.0:
            raise HannesError(f"Nuisance '{self.name}': mean {self.mean} cannot be on a logarithmic scale.")

    def value(self, z: float) -> float:
        """The parameter's value at z standard deviations from its mean."""
        return self.mean * math.exp(self.sd * z) if self.log else self.mean + self.sd * z


class Rig(Protocol):
    """A machine: plant and controller behind one call.

    trials    what was recorded
    signals   per trial, which signals are compared
    """

    trials: tuple[Trial, ...]

    def nuisances(self, model: Model) -> Sequence[Nuisance]:
        """The uncertain nominal parameters with their priors."""

    def simulate(
        self, model: Model, values: Mapping[str, float], trial: Trial, reference: Array
    ) -> Mapping[str, Array]:
        """Logged signals on the control grid for a reference (n,): what each logger would show at tick k.

        `values` overrides parameters of the model by name (nominal ones, and effect.parameter).
        Raises PlantDiverged.
        """
