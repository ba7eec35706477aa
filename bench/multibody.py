"""Speed of the multi-body plant in the closed loop: real-time factor, cost beside mj_step, and what limits it.

python bench/multibody.py
"""

from __future__ import annotations

import time
from dataclasses import replace

import mujoco
import numpy as np
from hannes_control.double_pid import DoublePID
from hannes_control.reference import half_sine
from hannes_description.model import Model
from hannes_sim import mujoco_plant
from hannes_sim.mujoco_plant import MujocoPlant, describe
from hannes_sim.objects import RIGID_DYNAMOMETER, SOFT_BALL, GraspObject
from hannes_sim.rollout import rollout
from numba import cfunc, types

REPEATS = 5
TARGET_FACTOR, TARGET_OVERHEAD = 10.0, 0.05


@cfunc(types.void(types.CPointer(types.float64), types.CPointer(types.float64)))
def _no_step(model: object, data: object) -> None:
    pass


def closure_time(plant: MujocoPlant, controller: DoublePID, reference: np.ndarray) -> float:
    """Best of a few runs, s of wall time."""
    best = np.inf
    for _ in range(REPEATS):
        start = time.perf_counter()
        rollout(plant, controller, reference)
        best = min(best, time.perf_counter() - start)
    return best


def overhead(model: Model, controller: DoublePID, reference: np.ndarray) -> float:
    """Share of the closed loop that is not mj_step: the same loop with a step that does nothing, over the rest."""
    plant = MujocoPlant(model)
    whole = closure_time(plant, controller, reference)
    plant.handle[mujoco_plant._STEP] = _no_step.address
    plant.check = lambda: None  # type: ignore[method-assign]  # its time stands still, which the check would report
    own = closure_time(plant, controller, reference)
    return own / (whole - own)


def without(flag: int, steps: int = 8000) -> float:
    """Microseconds of mj_step on the closing void hand with a feature switched off."""
    plant = MujocoPlant(Model.load("nominal_mujoco"))
    plant.model.opt.disableflags |= flag
    motor = plant.model.joint("motor").dofadr[0]
    best = np.inf
    for _ in range(REPEATS):
        mujoco.mj_resetData(plant.model, plant.data)
        plant.data.qfrc_applied[motor] = 9.0
        start = time.perf_counter()
        mujoco.mj_step(plant.model, plant.data, steps)
        best = min(best, time.perf_counter() - start)
    return 1e6 * best / steps


def main() -> None:
    """Print the table."""
    model = Model.load("nominal_mujoco")
    controller = DoublePID.of_model(model.parameters)
    reference = half_sine()
    steps = reference.size * round(controller.period / MujocoPlant(model).dt)
    print(f"one closure of {reference.size * controller.period:.0f} s, {steps} steps; best of {REPEATS}")
    worst = np.inf
    for mechanism in ("return_wire", "torsion_spring"):
        for transmission in ("wires", "forces"):
            chosen = replace(model, variant={"return_mechanism": mechanism, "transmission": transmission})
            row = []
            objects: tuple[tuple[str, GraspObject | None], ...] = (
                ("void", None),
                ("soft", SOFT_BALL),
                ("rigid", RIGID_DYNAMOMETER),
            )
            for name, grasp in objects:
                plant = MujocoPlant(chosen, grasp)
                seconds = closure_time(plant, controller, reference)
                factor = reference.size * controller.period / seconds
                row.append(f"{name} {1e6 * seconds / steps:5.1f} us a step, {factor:5.1f} x real time")
                if mechanism == "return_wire" and transmission == "wires":
                    worst = min(worst, factor)
            print(f"{mechanism:14s} {transmission:6s} nv {describe(plant)['nv']}: " + "; ".join(row))
    extra = overhead(model, controller, reference)
    print(
        f"full model, slowest object: {worst:.1f} x real time (at least {TARGET_FACTOR:.0f}: "
        f"{'met' if worst >= TARGET_FACTOR else 'MISSED'})"
    )
    print(
        f"control law, motor, effects and sensors beside mj_step: {100 * extra:.1f} % (at most "
        f"{100 * TARGET_OVERHEAD:.0f} %: {'met' if extra <= TARGET_OVERHEAD else 'MISSED'})"
    )
    disable = mujoco.mjtDisableBit
    base = without(0)
    bare = without(int(disable.mjDSBL_CONSTRAINT))
    print(
        f"what limits it: of {base:.1f} us of mj_step, {base - bare:.1f} us are the constraints (dry friction, "
        f"stops, wires: the Newton solver), {bare:.1f} us kinematics, inertia and integration of "
        f"{describe(plant)['nbody']} bodies"
    )


if __name__ == "__main__":
    main()
