"""The hand as a rig: plants and controller of a model file, sensors and objects of a trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.parameters import data_path, read_yaml
from hannes_sim.factory import make_plant
from hannes_sim.measurement import Sensors, folded_mean, logger, sample_noise
from hannes_sim.objects import GraspObject, named_object
from hannes_sim.plant import Plant
from hannes_sim.rollout import Rollout
from numpy.typing import NDArray

from .rig import Nuisance, PlantRig, make_controller
from .trials import Trial

__all__ = ["HandRig", "make_controller", "object_of", "sensors_of"]

Array = NDArray[np.float64]

_PER_OBJECT = ("object.stiffness", "object.position")
_UNKNOWN_OBJECT_SD = {"object.stiffness": 2.0, "object.position": 2.0}
"""Width of the priors where the recording does not say what was grasped."""


def object_of(trial: Trial) -> GraspObject | None:
    """What a trial's metadata says was grasped: a name, a mapping, or nothing."""
    given = trial.options.get("object")
    if given is None or given == "none":
        return None
    if isinstance(given, str):
        return named_object(given)
    if isinstance(given, Mapping):
        return GraspObject.from_dict(given)
    raise HannesError(
        f"Trial '{trial.name}': 'object' must be a name or a mapping, not {type(given).__name__}."
    )


def sensors_of(trial: Trial) -> dict[str, Any]:
    """How the current was logged: from the metadata, else guessed from the data (never negative = rectified)."""
    given = trial.options.get("sensors")
    if isinstance(given, Mapping):
        sensors = Sensors.from_dict(given)
        return {
            "rectified": sensors.current_rectified,
            "window": sensors.current_window,
            "noise": sensors.current_noise,
        }
    if "motor_current" not in trial.signals:
        return {"rectified": False, "window": 0.0, "noise": 0.0}
    values = trial.signals["motor_current"][1]
    return {
        "rectified": bool(values.min() >= -0.01 * max(values.max(), 1e-9)),
        "window": 0.0,
        "noise": sample_noise(values),
    }


class HandRig(PlantRig):
    """Simulates trials of the hand, on whichever plant the model names: objects, sensors and encoder zero per trial."""

    population = data_path("parameters", "population.yaml")
    figures = True
    experiments = True

    def __init__(self, trials: Sequence[Trial]) -> None:
        super().__init__(trials)
        self._sensors = {trial.name: sensors_of(trial) for trial in self.trials}

    @classmethod
    def read(cls, paths: Sequence[Path]) -> list[Trial]:
        """Trials of all bags below the paths."""
        from .prepare import load_trials

        return load_trials(paths)

    def nuisances(self, model: Model) -> list[Nuisance]:
        """Priors from population.yaml; object parameters per trial with an object, the encoder's zero per trial."""
        out = []
        for name, entry in read_yaml(Path(self.population), "population file").items():
            sd, scatter, relative = float(entry["hand_sd"]), float(entry["closure_sd"]), entry["unit"] == "1"
            if name in _PER_OBJECT:
                for trial in self.trials:
                    if object_of(trial) is None:
                        continue
                    plant, _, _ = self._plant(model.without_effects(), trial)
                    out.append(Nuisance(f"{name}@{trial.name}", plant.get(name), sd, relative, scatter))
            elif name == "encoder.zero":
                out += [
                    Nuisance(f"{name}@{trial.name}", 0.0, sd, False, scatter, "rad") for trial in self.trials
                ]
            elif model.parameters.value(name) > 0.0:
                out.append(self._nuisance(name, entry, model))
        return out

    def plant(self, model: Model, trial: Trial) -> Plant:
        """The plant with the trial's object, encoder quantiser off."""
        plant = make_plant(model, object_of(trial))
        plant.set("encoder.resolution", 0.0)
        return plant

    def logged(self, run: Rollout, trial: Trial) -> dict[str, Array]:
        """Signals as the hand's loggers show them: the current filtered, and rectified where it was."""
        logged = self._sensors[trial.name]
        current = logger(
            run.motor_current, trial.period, rectified=logged["rectified"], window=logged["window"]
        )
        if logged["rectified"]:
            current = folded_mean(current, logged["noise"])
        return {
            "encoder_position": run.encoder_position,
            "motor_current": current,
            "motor_voltage": run.motor_voltage,
            "grip_force": run.grip_force,
            "motor_effort": run.motor_effort,
        }
