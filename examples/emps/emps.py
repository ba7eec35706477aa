"""EMPS, a real positioning axis (motor, ball screw, carriage), for the lab: reader, control law, tolerances.

Data: DATA_EMPS.mat of Janot, Gautier, Brunot, "EMPS", Nonlinear System Identification Benchmarks 2019; not part of the
project.  t [s], reference qg and position qm [m], drive vir [V], gtau [N/V] (motor.kt too); a closure is a move.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from hannes_description.control_ports import C_PERIOD, C_POSITION, C_REFERENCE
from hannes_description.errors import HannesError
from hannes_lab.closures import find_moves
from hannes_lab.rig import PlantRig
from hannes_lab.trials import Closure, Trial
from hannes_sim.native import CONTROL_SIGNATURE
from hannes_sim.rollout import Rollout
from numba import cfunc
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

HERE = Path(__file__).parent
FIELDS = ("t", "qg", "qm", "vir", "gtau")


def control(x, p, s):
    """V: proportional position loop around a velocity loop; the velocity is the change of the mean of two samples."""
    mean = 0.5 * (x[C_POSITION] + s[0])
    velocity = (mean - s[1]) / x[C_PERIOD]
    s[0], s[1] = x[C_POSITION], mean
    return p[1] * (p[0] * (x[C_REFERENCE] - x[C_POSITION]) - velocity)


COMPILED = cfunc(CONTROL_SIGNATURE)(control)


class Ppd:
    """The bench's controller."""

    def __init__(self, parameters, period):
        self.address, self.period = COMPILED.address, period
        self.parameters = np.array([parameters.value("control.kp"), parameters.value("control.kv")])
        self.states = np.zeros(2)

    def reset(self) -> None:
        """At rest at zero, where the recording starts."""
        self.states[:] = 0.0


class Emps(PlantRig):
    """The bench: position [m] and drive force [N] = gtau x command."""

    model, population = HERE / "emps.yaml", HERE / "tolerances.yaml"
    linear = True
    sizes = {"N.m": 40.0, "rad": 0.246, "V": 10.0, "A": 10.0}  # N, m, V; the command counts as the current
    floor = 1e-5  # the reference is known exactly
    points = 320
    pooled = True
    drive_signals = ("drive_force",)
    phases = {"void": "forward", "opening": "back"}
    without = {
        "brush_drop": "the amplifier controls the current",
        "supply_sag": "the amplifier controls the current",
        "winding_heating": "the amplifier controls the current",
        "gravity": "the axis is horizontal",
        "return_preload": "the axis has no return spring",
        "glove_stiffness": "the axis has no glove",
        "glove_hysteresis": "the axis has no glove",
        "encoder_eccentricity": "the encoder sits on the screw; its period is not that of the hand's",
    }

    def logged(self, run: Rollout, trial: Trial) -> dict[str, np.ndarray]:
        force = trial.options["gtau"] * run.motor_voltage
        return {"encoder_position": run.encoder_position, "drive_force": force}

    @classmethod
    def read(cls, paths: Sequence[Path]) -> list[Trial]:
        return [cls._read(path) for path in paths]

    @staticmethod
    def _read(path: Path) -> Trial:
        if not path.is_file():
            raise HannesError(f"{'A folder:' if path.is_dir() else 'No file'} '{path}'; give DATA_EMPS.mat.")
        try:
            data = loadmat(path)
            t, reference, position, voltage, gtau = (np.asarray(data[n], float).ravel() for n in FIELDS)
        except (KeyError, IndexError, ValueError, OSError, MatReadError) as error:
            message = f"'{path}' is no recording of EMPS with {', '.join(FIELDS)}: {error}."
            raise HannesError(message) from error
        period = round(float(np.median(np.diff(t))), 6)
        grid = np.arange(t.size) * period
        at = [round(1e3 * float(r)) for r in reference]
        moves = find_moves(reference, period)
        closures = [Closure(a, b, f"{at[round(a / period)]} to {at[round(b / period)]} mm") for a, b in moves]
        signals = {"drive_force": (grid, float(gtau[0]) * voltage), "encoder_position": (grid, position)}
        return Trial("emps", period, reference, signals, tuple(closures), {"gtau": float(gtau[0])}, str(path),
                     hashlib.sha256(path.read_bytes()).hexdigest(),
                     units={"drive_force": "N", "encoder_position": "m", "reference": "m"})  # fmt: skip
