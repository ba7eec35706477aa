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
from hannes_sim.plant import DEFAULT_DT
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


def closure_cost(plant: MujocoPlant, controller: DoublePID, reference: np.ndarray) -> tuple[float, float]:
    """s of one core's time and of wall time of one closure, each the best of REPEATS.

    On an idle machine they are the same; what else runs on it lengthens the second.
    """
    core = wall = np.inf
    for _ in range(REPEATS):
        start, begin = time.thread_time(), time.perf_counter()
        rollout(plant, controller, reference)
        core, wall = min(core, time.thread_time() - start), min(wall, time.perf_counter() - begin)
    return float(core), float(wall)


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
        start = time.thread_time()
        mujoco.mj_step(plant.model, plant.data, steps)
        best = min(best, time.thread_time() - start)
    return float(1e6 * best / steps)


def solver_work(model: Model, grasp: GraspObject | None) -> tuple[float, float]:
    """Mean number of constraint rows, and of Newton iterations, of one step of the closing hand."""
    plant = MujocoPlant(model, grasp)
    plant.data.qfrc_applied[plant.model.joint("motor").dofadr[0]] = 9.0
    rows, iterations, samples = 0.0, 0.0, 400
    for _ in range(samples):
        mujoco.mj_step(plant.model, plant.data, 10)
        rows += float(plant.data.nefc) / samples
        iterations += float(plant.data.solver_niter[0]) / samples
    return rows, iterations


def run(model: Model) -> Section:
    """R16."""
    controller = DoublePID.of_model(model.parameters)
    reference = half_sine()
    duration = reference.size * controller.period
    out: list[Figure] = []
    full = np.inf
    in_loop = 0.0
    for mechanism in RETURN_MECHANISMS:
        for transmission in TRANSMISSIONS:
            chosen = replace(
                model, variant={**model.variant, "return_mechanism": mechanism, "transmission": transmission}
            )
            for name in ("void", "rigid"):
                plant = MujocoPlant(chosen, object_for(model, name))
                seconds, wall = closure_cost(plant, controller, reference)
                limit = THESIS.get((mechanism, transmission), float("nan"))
                out.append(
                    Figure(
                        "R16",
                        f"{mechanism}, {transmission}, {name}: time of one closure on one core",
                        "s",
                        limit if np.isfinite(limit) else 60.0,
                        limit,
                        seconds,
                        kind="at_most",
                        note=f"{duration / seconds:.1f} x real time; {wall:.2f} s of wall time",
                    )
                )
                if (mechanism, transmission) == ("return_wire", "wires"):
                    full = min(full, duration / seconds)
                    in_loop = in_loop or 1e6 * seconds / (duration / DEFAULT_DT)
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
    rows, iterations = solver_work(model, None)
    held_rows, held_iterations = solver_work(model, object_for(model, "rigid"))
    notes = (
        f"Of {base:.1f} us a step (void, nv {size['nv']}, {size['nbody']} bodies, dt {1e3 * size['dt']:g} ms), "
        f"{base - bare:.1f} us are the constraints (dry friction of every joint, stops, wires: {rows:.0f} rows, "
        f"{iterations:.1f} Newton iterations a step on the mean; with the rigid object {held_rows:.0f} and "
        f"{held_iterations:.1f}), {bare:.1f} us kinematics, inertia and integration. In the loop a void step takes "
        f"{in_loop:.1f} us: what it takes more is the motor, the effects and the control law, and other phases of the "
        "closure.",
        "What MuJoCo offers, us a step: "
        + ", ".join(f"{k} {v:.1f}" for k, v in tries.items())
        + f"; chosen: no islands, dense Jacobian, Newton, implicitfast, {base:.1f}. Control law, motor and effects "
        "run as machine code beside mj_step.",
        "Best of a few runs, time of one core; wall time is longer where something else runs on the machine.",
    )
    return Section(("R16",), "run time", tuple(out), notes)
