"""The hand as a rig: plants and controller of a model file, sensors and objects of a trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from hannes_control.double_pid import DoublePID
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.parameters import data_path, read_yaml
from hannes_sim.effect import load_class
from hannes_sim.factory import make_plant
from hannes_sim.measurement import Sensors, folded_mean, logger, sample_noise
from hannes_sim.objects import GraspObject, named_object
from hannes_sim.plant import Plant
from hannes_sim.rollout import Controller, Rollout, rollout
from numpy.typing import NDArray

from .rig import Nuisance
from .trials import Trial

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


class HandRig:
    """Simulates trials of the hand, on whichever plant the model names.

    Plants are built once per (model structure, trial) and then only re-parametrised.
    """

    def __init__(self, trials: Sequence[Trial]) -> None:
        self.trials = tuple(trials)
        self._plants: dict[tuple[str, ...], tuple[Plant, Controller, dict[str, float]]] = {}
        self._sensors = {trial.name: sensors_of(trial) for trial in self.trials}

    def __reduce__(self) -> tuple[Any, ...]:
        return HandRig, (self.trials,)

    def nuisances(self, model: Model) -> list[Nuisance]:
        """Priors from population.yaml; object parameters per trial with an object, the encoder's zero per trial."""
        table = read_yaml(data_path("parameters", "population.yaml"), "population file")
        out = []
        for name, entry in table.items():
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
            else:
                mean = model.parameters.value(name)
                if mean > 0.0:
                    out.append(Nuisance(name, mean, sd, relative, scatter, model.parameters[name].unit))
        return out

    def _plant(self, model: Model, trial: Trial) -> tuple[Plant, Controller, dict[str, float]]:
        structure = tuple(effect.source or effect.name for effect in model.effects)
        key = (
            model.plant,
            model.controller,
            model.parameters.sha256,
            repr(sorted(model.variant.items())),
            trial.name,
            *structure,
        )
        if key not in self._plants:
            plant = make_plant(model, object_of(trial))
            plant.set("encoder.resolution", 0.0)
            self._plants[key] = (plant, make_controller(model, trial.period), {})
        return self._plants[key]

    def simulate(
        self, model: Model, values: Mapping[str, float], trial: Trial, reference: Array
    ) -> dict[str, Array]:
        """See Rig; the encoder's quantiser is off, so that the signals are smooth in the parameters."""
        run = self.run(model, values, trial, reference)
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

    def run(self, model: Model, values: Mapping[str, float], trial: Trial, reference: Array) -> Rollout:
        """The rollout itself, with all that the plant can show."""
        plant, controller, base = self._plant(model, trial)
        wanted = {f"{e.name}.{n}": p.value for e in model.effects for n, p in e.parameters.items()}
        for name, value in values.items():
            parameter, _, where = name.partition("@")
            if not where or where == trial.name:
                wanted[parameter] = value
        for name in set(base) - set(wanted):
            plant.set(name, base[name])
        for name, value in wanted.items():
            if name not in base:
                base[name] = plant.get(name)
            plant.set(name, value)
        return rollout(plant, controller, reference, joints=False)


def make_controller(model: Model, period: float) -> Controller:
    """The control law that a model file names."""
    if model.controller == "double_pid":
        return DoublePID.of_model(model.parameters, period)
    if ":" in model.controller:
        file, _, name = model.controller.rpartition(":")
        law: Controller = load_class(file, name, "controller")(model.parameters, period)
        return law
    raise HannesError(
        f"Model '{model.name}': unknown controller '{model.controller}'; valid are double_pid, or "
        "path.py:Class for your own."
    )
