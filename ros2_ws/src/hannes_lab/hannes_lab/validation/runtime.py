"""R16: run time of one simulated closure for all four variants, and where the time of a step goes."""

from __future__ import annotations

import time
from dataclasses import replace

import mujoco
import numpy as np
from hannes_control.double_pid import DoublePID
from hannes_control.reference import half_sine
from hannes_description.mjcf import RETURN_MECHANISMS, TRANSMISSIONS
from hannes_description.model import Model
from hannes_sim.mujoco_plant import MujocoPlant, describe
from hannes_sim.objects import GraspObject
from hannes_sim.rollout import rollout

from .currents import object_for
from .table import Figure, Section

THESIS = {
    ("return_wire", "wires"): 12 * 3600.0,
    ("torsion_spring", "wires"): 28 * 60.0,
    ("torsion_spring", "forces"): 60.0,
}
"""s of one simulation in the thesis."""

REPEATS = 3
FACTOR = 10.0


def wall_time(plant: MujocoPlant, controller: DoublePID, reference: np.ndarray) -> float:
    """s of wall time of one closure, best of REPEATS."""
    best = np.inf
    for _ in range(REPEATS):
        start = time.perf_counter()
        rollout(plant, controller, reference)
        best = min(best, time.perf_counter() - start)
    return float(best)


def profile(model: Model, grasp: GraspObject | None, **options: int | float) -> float:
    """Microseconds of one mj_step on the closing hand, with options or disable flags of MuJoCo changed."""
    plant = MujocoPlant(model, grasp)
    for name, value in options.items():
        if name == "disable":
            plant.model.opt.disableflags |= int(value)
        elif name == "enable":
            plant.model.opt.disableflags &= ~int(value)
        else:
            setattr(plant.model.opt, name, value)
    motor = plant.model.joint("motor").dofadr[0]
    best, steps = np.inf, 4000
    for _ in range(REPEATS):
        mujoco.mj_resetData(plant.model, plant.data)
        plant.data.qfrc_applied[motor] = 9.0
        start = time.perf_counter()
        mujoco.mj_step(plant.model, plant.data, steps)
        best = min(best, time.perf_counter() - start)
    return float(1e6 * best / steps)


def run(model: Model) -> Section:
    """R16."""
    controller = DoublePID.of_model(model.parameters)
    reference = half_sine()
    duration = reference.size * controller.period
    out: list[Figure] = []
    full = np.inf
    for mechanism in RETURN_MECHANISMS:
        for transmission in TRANSMISSIONS:
            chosen = replace(
                model, variant={**model.variant, "return_mechanism": mechanism, "transmission": transmission}
            )
            for name in ("void", "rigid"):
                seconds = wall_time(MujocoPlant(chosen, object_for(model, name)), controller, reference)
                limit = THESIS.get((mechanism, transmission), float("nan"))
                out.append(
                    Figure(
                        "R16",
                        f"{mechanism}, {transmission}, {name}: wall time of one closure",
                        "s",
                        limit if np.isfinite(limit) else 60.0,
                        limit,
                        seconds,
                        kind="at_most",
                        note=f"{duration / seconds:.1f} x real time",
                    )
                )
                if (mechanism, transmission) == ("return_wire", "wires"):
                    full = min(full, duration / seconds)
    out.append(
        Figure(
            "R16",
            "return_wire and wires, slower object: real-time factor on one core",
            "1",
            FACTOR,
            duration / THESIS["return_wire", "wires"],
            full,
            kind="at_least",
        )
    )
    bit = mujoco.mjtDisableBit
    base = profile(model, None)
    bare = profile(model, None, disable=int(bit.mjDSBL_CONSTRAINT))
    tries = {
        "islands on": profile(model, None, enable=int(bit.mjDSBL_ISLAND)),
        "sparse Jacobian": profile(model, None, jacobian=int(mujoco.mjtJacobian.mjJAC_SPARSE)),
        "conjugate gradient solver": profile(model, None, solver=int(mujoco.mjtSolver.mjSOL_CG)),
        "full implicit integrator": profile(model, None, integrator=int(mujoco.mjtIntegrator.mjINT_IMPLICIT)),
    }
    size = describe(MujocoPlant(model))
    notes = (
        f"Of {base:.1f} us a step (void, nv {size['nv']}, {size['nbody']} bodies, dt {1e3 * size['dt']:g} ms), "
        f"{base - bare:.1f} us are the constraints (dry friction of every joint, stops, wires: Newton's method), "
        f"{bare:.1f} us kinematics, inertia and integration.",
        "What MuJoCo offers, us a step: "
        + ", ".join(f"{k} {v:.1f}" for k, v in tries.items())
        + f"; chosen: no islands, dense Jacobian, Newton, implicitfast, {base:.1f}. Control law, motor and effects "
        "run as machine code beside mj_step.",
        "Best of a few runs on one core; the figures depend on the machine and on what else runs on it.",
    )
    return Section(("R16",), "run time", tuple(out), notes)
