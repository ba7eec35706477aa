"""Convergence and the laws that the plant must keep: half the step, energy, cart balance, tension = moment / arm."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from hannes_description.joints import DIGITS, FINGERS, JOINT_LIMITS
from hannes_description.mjcf import (
    CARTS,
    MASTER,
    PAIRS,
    SLAVES,
    build_spec,
    joints_of,
    return_moments,
    wire_arms,
)
from hannes_description.model import Model

from . import double_pendulum, least_force
from .currents import closure_time, figures, object_for, simulate
from .table import Figure, Progress, Section, silent

STEPS = (0.25e-3, 0.125e-3)
"""s; the step in use and its half."""

LIMIT = 0.01


def energy_drift(model: Model, dt: float = 0.25e-3) -> float:
    """Change of the fingers' energy over the kinetic energy gained, falling freely for 0.1 s (R02's model)."""
    _, angles = double_pendulum.simulated_drop_times(model, dt)
    worst = 0.0
    for finger in FINGERS:
        p = double_pendulum.Pendulum.of(model.parameters, finger)
        # MuJoCo's semi-implicit step puts the velocity half a step from the positions: central differences are exact
        q = np.column_stack([angles[finger][:, 0], angles[finger].sum(axis=1)])
        w = np.gradient(q, dt, axis=0)
        energy = [p.energy(np.concatenate([a, b])) for a, b in zip(q, w, strict=True)]
        k = round(0.1 / dt)
        # at rest in the second sample, to the order of the step
        gained = abs(energy[k] - p.energy(np.concatenate([q[k], [0.0, 0.0]])))
        worst = max(worst, abs(energy[k] - p.energy(np.concatenate([q[0], [0.0, 0.0]]))) / gained)
    return worst


def statics(model: Model, force: float = 10.0) -> dict[str, float]:
    """Largest relative errors at rest under a constant wire force, without friction and weight.

    `tension`: the master wire carries the motor's force; `carts`: a slave wire has twice that less the cart's spring;
    `moments`: tension x arm is the return spring's moment at every joint between its stops (P14).
    """
    off = {
        "friction.coulomb": 0.0,
        "joints.friction_tension": 0.0,
        "carts.friction": 0.0,
        "friction.viscous": 0.002,
        "gravity.palmar": 0.0,
        "gravity.radial": 0.0,
        "gravity.distal": 0.0,
    }
    stiff = {f"springs.{digit}_rate": 3000.0 for digit in DIGITS}
    values = model.parameters.with_values(off | stiff)
    m = build_spec(
        values, {**model.variant, "return_mechanism": "torsion_spring", "transmission": "wires"}
    ).compile()
    d = mujoco.MjData(m)
    motor = m.joint("motor").dofadr[0]
    steps = round(6.0 / m.opt.timestep)
    ramp = steps // 10
    for k in range(0, ramp, 10):
        d.qfrc_applied[motor] = force * k / ramp
        mujoco.mj_step(m, d, 10)
    d.qfrc_applied[motor] = force
    mujoco.mj_step(m, d, steps - ramp)
    master = float(d.sensor(f"tension_{MASTER}").data[0])
    out = {"tension": abs(master / force - 1.0), "carts": 0.0, "moments": 0.0}
    arms, moments = wire_arms(values), return_moments(values)
    for wire, cart, pair in zip(SLAVES, CARTS, PAIRS, strict=True):
        slave = float(d.sensor(f"tension_{wire}").data[0])
        spring = values.value("carts.preload") + values.value("carts.stiffness") * float(
            d.joint(cart).qpos[0]
        )
        out["carts"] = max(out["carts"], abs(slave / (2.0 * master - spring) - 1.0))
        levers = [values.value(f"pulleys.{digit}_lever") for digit in pair]
        for digit, other in zip(pair, levers[::-1], strict=True):
            out["moments"] = max(
                out["moments"], _moment_error(d, digit, slave * other / sum(levers), arms, moments)
            )
    out["moments"] = max(out["moments"], _moment_error(d, "thumb", master, arms, moments))
    return out


def _moment_error(
    d: mujoco.MjData,
    digit: str,
    tension: float,
    arms: dict[str, float],
    moments: dict[str, tuple[float, float]],
) -> float:
    worst = 0.0
    for joint in joints_of(digit):
        q = float(d.joint(joint).qpos[0])
        if JOINT_LIMITS[joint].lower + 0.01 < q < JOINT_LIMITS[joint].upper - 0.01:
            m0, k = moments[joint]
            worst = max(worst, abs((m0 + k * q) / (arms[joint] * tension) - 1.0))
    return worst


def all_figures(model: Model, dt: float) -> dict[str, float]:
    """Every row's figure that the integration step can change."""
    out = {
        f"R02-03 {finger} {link}": time
        for finger, times in double_pendulum.simulated_drop_times(model, dt)[0].items()
        for link, time in zip(double_pendulum.LINKS, times, strict=True)
    }
    for digit in DIGITS:
        out[f"R04 {digit}"] = least_force.onset(model, digit, lever=least_force.lever_of(model), dt=dt)
    out["R05 closure time"] = closure_time(model, dt=dt)
    names = {
        "plateau": "R07",
        "average_closing": "R08",
        "slope_closing": "R09",
        "maximum": "R10",
        "average_opening": "R11",
        "slope_opening": "R12",
        "force": "R13",
    }
    for kind in ("void", "rigid", "soft"):
        found = figures(simulate(model, object_for(model, kind), dt=dt))
        for name, row in names.items():
            wanted = name == "plateau" if kind == "void" else name != "plateau"
            if wanted and not (kind == "soft" and name == "force"):
                out[f"{row} {kind}"] = found.get(name, math.nan)
    return out


def run(model: Model, progress: Progress = silent) -> Section:
    """Change of every row when the step is halved, and the laws."""
    coarse, fine = (all_figures(model, dt) for dt in STEPS)
    out = [
        Figure(
            "convergence",
            f"{name}: change when dt is halved",
            "1",
            LIMIT,
            math.nan,
            abs(coarse[name] / fine[name] - 1.0),
            kind="at_most",
            note="",
        )
        for name in coarse
    ]
    out.append(
        Figure(
            "convergence",
            "energy of the falling fingers, drift over kinetic energy",
            "1",
            LIMIT,
            math.nan,
            energy_drift(model),
            kind="at_most",
        )
    )
    held = statics(model)
    out.append(
        Figure(
            "convergence",
            "master wire's tension against the motor's force",
            "1",
            0.001,
            math.nan,
            held["tension"],
            kind="at_most",
        )
    )
    out.append(
        Figure(
            "convergence",
            "cart balance: slave wire against 2 F less the cart's spring",
            "1",
            0.001,
            math.nan,
            held["carts"],
            kind="at_most",
        )
    )
    out.append(
        Figure(
            "convergence",
            "tension x arm against the return moment",
            "1",
            0.002,
            math.nan,
            held["moments"],
            kind="at_most",
        )
    )
    notes = (f"Steps {1e3 * STEPS[0]:g} and {1e3 * STEPS[1]:g} ms.",)
    return Section(("convergence",), "half the step, energy, balance", tuple(out), notes)
