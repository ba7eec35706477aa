"""An adapter of another machine, as a user would write it: a mass of 2 kg on a linear motor."""

from pathlib import Path

import numpy as np
from hannes_description.control_ports import C_POSITION, C_REFERENCE, C_VELOCITY
from hannes_description.errors import HannesError
from hannes_lab.closures import find_moves
from hannes_lab.rig import PlantRig
from hannes_lab.trials import Closure, Trial
from hannes_sim.native import CONTROL_SIGNATURE
from numba import cfunc

PARAMETERS = """
supply: {voltage: {value: 50.0, unit: V, lower: 1.0, upper: 100.0, status: assumed, source: test, fixed: true}}
motor:
  kt: {value: 1.0, unit: N/V, lower: 0.5, upper: 2.0, status: assumed, source: test, fixed: true}
  emf_compensated: {value: 1.0, unit: "1", lower: 0.0, upper: 1.0, status: assumed, source: test, fixed: true}
  armature: {value: 2.0, unit: kg, lower: 0.5, upper: 10.0, status: assumed, source: test}
friction: {viscous: {value: 4.0, unit: N.s/m, lower: 0.0, upper: 50.0, status: assumed, source: test}}
"""
MODEL = "schema: hannes/model/1\nname: mass\nplant: reduced\ncontroller: '{here}:Law'\nparameters: parameters.yaml\n"
TOLERANCES = """
motor.armature: {sd: 0.2, closure_sd: 0.0, unit: "1", source: test}
friction.viscous: {sd: 0.5, closure_sd: 0.0, unit: "1", source: test}
"""


def control(x, p, s):
    return p[0] * (x[C_REFERENCE] - x[C_POSITION]) - p[1] * x[C_VELOCITY]


COMPILED = cfunc(CONTROL_SIGNATURE)(control)


class Law:
    def __init__(self, parameters, period):
        self.address, self.period = COMPILED.address, period
        self.parameters, self.states = np.array([800.0, 60.0]), np.zeros(1)

    def reset(self):
        self.states[:] = 0.0


def write_files(folder: Path) -> None:
    """The model, its parameters and tolerances, beside the data (a real adapter has them beside itself)."""
    (folder / "parameters.yaml").write_text(PARAMETERS)
    (folder / "mass.yaml").write_text(MODEL.format(here=Path(__file__)))
    (folder / "tolerances.yaml").write_text(TOLERANCES)


class SingleMass(PlantRig):
    linear = True
    sizes = {"N.m": 3.0, "rad": 0.1}
    floor, points, pooled = 1e-5, 200, True
    drive_signals = ("drive_force",)
    without = {"gravity": "the axis is horizontal"}

    def logged(self, run, trial):
        return {"encoder_position": run.encoder_position, "drive_force": run.motor_voltage}

    @classmethod
    def read(cls, paths):
        trials = []
        for path in paths:
            if not Path(path).is_file():
                raise HannesError(f"No file '{path}' for the single mass.")
            cls.population = Path(path).parent / "tolerances.yaml"
            with np.load(path) as data:
                reference, position, force = data["reference"], data["position"], data["force"]
            time = np.arange(reference.size) * 1e-3
            at = np.round(1e3 * reference).astype(int)
            moves = [
                Closure(a, b, f"{at[round(a / 1e-3)]} to {at[round(b / 1e-3)]} mm")
                for a, b in find_moves(reference, 1e-3)
            ]
            signals = {"drive_force": (time, force), "encoder_position": (time, position)}
            units = {"drive_force": "N", "encoder_position": "m"}
            trials.append(
                Trial("mass", 1e-3, reference, signals, tuple(moves), source=str(path), units=units)
            )
        return trials


def reference(laps: int = 5) -> np.ndarray:
    """Moves of 20, 50 and 30 mm there and back at three speeds, with soft starts."""

    def move(a: float, b: float, seconds: float) -> np.ndarray:
        u = np.arange(round(seconds * 1e3)) / (seconds * 1e3)
        return a + (b - a) * (u - np.sin(2 * np.pi * u) / (2 * np.pi))

    stops = [(0.0, 0.02, 0.4), (0.02, 0.07, 0.5), (0.07, 0.1, 0.6), (0.1, 0.05, 0.4), (0.05, 0.0, 0.7)]
    return np.concatenate([move(*stop) for _ in range(laps) for stop in stops])
