"""An adapter of a machine that turns on and on: its loop is told a speed, and its angle is wrapped by a turn."""

import itertools
import math
from pathlib import Path

import numpy as np
from hannes_description.control_ports import C_PERIOD, C_REFERENCE, C_VELOCITY
from hannes_lab.rig import PlantRig
from hannes_lab.trials import Closure, Trial
from hannes_sim.native import CONTROL_SIGNATURE
from numba import cfunc

TURN = 2.0 * math.pi
PARAMETERS = """
supply: {voltage: {value: 50.0, unit: V, lower: 1.0, upper: 100.0, status: assumed, source: test, fixed: true}}
motor:
  kt: {value: 1.0, unit: N.m/V, lower: 0.5, upper: 2.0, status: assumed, source: test, fixed: true}
  emf_compensated: {value: 1.0, unit: "1", lower: 0.0, upper: 1.0, status: assumed, source: test, fixed: true}
  armature: {value: 0.02, unit: kg.m2, lower: 0.005, upper: 0.1, status: assumed, source: test}
friction: {viscous: {value: 0.05, unit: N.m.s/rad, lower: 0.0, upper: 0.5, status: assumed, source: test}}
"""
MODEL = "schema: hannes/model/1\nname: wheel\nplant: reduced\ncontroller: '{here}:Law'\nparameters: parameters.yaml\n"
TOLERANCES = """
motor.armature: {sd: 0.2, closure_sd: 0.0, unit: "1", source: test}
friction.viscous: {sd: 0.5, closure_sd: 0.0, unit: "1", source: test}
"""


def control(x, p, s):
    """PI on the speed; its reference is the change of the angle's, by the shortest way."""
    change = x[C_REFERENCE] - s[1] if s[2] > 0.0 else 0.0
    s[1], s[2] = x[C_REFERENCE], 1.0
    change -= p[2] * math.floor(change / p[2] + 0.5)
    error = change / x[C_PERIOD] - x[C_VELOCITY]
    s[0] += p[1] * error * x[C_PERIOD]
    return p[0] * error + s[0]


COMPILED = cfunc(CONTROL_SIGNATURE)(control)


class Law:
    def __init__(self, parameters, period):
        self.address, self.period = COMPILED.address, period
        self.parameters, self.states = np.array([0.3, 3.0, TURN]), np.zeros(3)

    def reset(self):
        self.states[:] = 0.0


class Wheel(PlantRig):
    sizes = {"N.m": 0.5, "rad": TURN}
    drive_signals = ("drive_torque",)

    def logged(self, run, trial):
        angle = run.encoder_position - TURN * trial.options["turns"][: run.time.size]
        return {"encoder_position": angle, "drive_torque": run.motor_voltage}


def angle_of(speeds: tuple[float, ...], turns: int) -> np.ndarray:
    """Reference (n,) in rad, not wrapped: so many turns at each speed (rad/s), one after the other."""
    speed = [np.full(round(turns * TURN / v / 1e-3), v) for v in speeds]
    return np.concatenate([[0.0], np.cumsum(np.concatenate(speed)) * 1e-3])


def trial_of(run, speeds: tuple[float, ...], turns: int, rng: np.random.Generator) -> Trial:
    """What a log of a run shows: each whole turn but the first of a speed is a repeat."""
    reference = angle_of(speeds, turns)
    wrapped = np.floor(reference / TURN + 1e-9)
    time = 1e-3 * np.arange(reference.size)
    begins = np.interp(TURN * np.arange(turns * len(speeds)), reference, time)
    closures = tuple(
        Closure(float(a), float(b) - 2e-3, f"{speeds[k // turns]:g} rad/s")
        for k, (a, b) in enumerate(itertools.pairwise(begins))
        if k % turns
    )
    signals = {
        "encoder_position": (
            time,
            run.encoder_position - TURN * wrapped + 1e-4 * rng.standard_normal(time.size),
        ),
        "drive_torque": (time, run.motor_voltage + 2e-3 * rng.standard_normal(time.size)),
    }
    return Trial(
        "wheel",
        1e-3,
        reference - TURN * wrapped,
        signals,
        closures,
        {"turns": wrapped},
        units={"drive_torque": "N.m"},
    )


def write_files(folder: Path) -> None:
    """The model, its parameters and tolerances."""
    (folder / "parameters.yaml").write_text(PARAMETERS)
    (folder / "wheel.yaml").write_text(MODEL.format(here=Path(__file__)))
    (folder / "tolerances.yaml").write_text(TOLERANCES)
