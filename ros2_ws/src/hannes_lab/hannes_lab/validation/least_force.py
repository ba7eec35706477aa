"""R04: the least force on the distal phalanx that moves it, by moment balance and in the simulation.

At the onset the stop carries nothing:   F lever + gravity moment = preload x arm   (dry friction adds to the right).
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
from hannes_description.errors import HannesError
from hannes_description.joints import DIGITS, JOINT_NAMES
from hannes_description.kinematics import forward_kinematics, links
from hannes_description.mjcf import Variant, build_spec
from hannes_description.model import Model

from .table import Figure, Section

LEVER = 0.24
"""Where the force acts, as a share of the distance from the joint to the tip pad, in a model that does not say; see
`run`."""

SIMULATED = {"thumb": 3.51, "index": 1.65, "middle": 2.46, "ring": 1.83, "little": 0.99}
ANALYTIC = {"thumb": 3.66, "index": 1.66, "middle": 2.42, "ring": 1.83, "little": 0.99}
"""N; the thesis' values."""


def lever_of(model: Model) -> float:
    """The lever that a calibrated model was solved for, from its provenance."""
    return float(model.provenance.get("lever", LEVER))


def distal(digit: str) -> tuple[str, str, str]:
    """Joint, link and length parameter of a digit's distal phalanx."""
    if digit == "thumb":
        return "thumb_abd", "thumb", "geometry.thumb_length"
    return f"{digit}_pip", f"{digit}_middle", f"geometry.{digit}_distal"


def gravity_moment(model: Model, digit: str) -> float:
    """N.m with which gravity flexes the distal joint of the open hand."""
    _, name, _ = distal(digit)
    tree = links(model.parameters, Variant.of(model.variant).thumb_stop_deg)
    link = next(k for k in tree if k.name == name)
    if link.joint is None:
        raise HannesError(f"Link '{name}' has no joint.")
    _, frame = forward_kinematics(tree, np.zeros(len(JOINT_NAMES)))[name]
    g = np.array([model.parameters.value(f"gravity.{axis}") for axis in ("palmar", "radial", "distal")])
    arm = frame @ np.array([0.0, 0.0, link.com])
    return float(np.cross(arm, link.mass * g) @ (frame @ np.array(link.joint.axis)))


def balance(model: Model, lever: float = LEVER, friction: bool = False) -> dict[str, float]:
    """Least force [N] of every digit from the moment balance."""
    v = model.parameters.value
    out = {}
    for digit in DIGITS:
        joint, _, length = distal(digit)
        moment = v(f"springs.{digit}_preload") * v(f"springs.{joint}_arm") - gravity_moment(model, digit)
        if friction:
            moment += v("joints.friction_tension") * v(f"pulleys.{joint}")
        out[digit] = moment / (lever * v(length))
    return out


def preloads_for(model: Model, forces: Mapping[str, float], lever: float = LEVER) -> dict[str, float]:
    """Preloads [N] of the return wires with which the balance gives these forces: `balance` solved for them."""
    v = model.parameters.value
    out = {}
    for digit in DIGITS:
        joint, _, length = distal(digit)
        moment = forces[digit] * lever * v(length) + gravity_moment(model, digit)
        out[f"springs.{digit}_preload"] = moment / v(f"springs.{joint}_arm")
    return out


def onset(
    model: Model,
    digit: str,
    lever: float = LEVER,
    *,
    friction: bool = False,
    rate: float = 0.3,
    dt: float = 0.25e-3,
) -> float:
    """Force [N] at which the simulated phalanx leaves its stop, on a ramp of `rate` N/s.

    The return wire acts, the flexor wires are slack, the joint before the distal one is held.  Without friction the
    joint leaves when its angle passes 0; with friction it must also turn at 5e-3 rad/s, far above the solver's creep.
    """
    spec = build_spec(model.parameters, {**model.variant, "return_mechanism": "return_wire"})
    spec.option.timestep = dt
    m = spec.compile()
    d = mujoco.MjData(m)
    joint, body, length = distal(digit)
    dof, at = int(m.joint(joint).dofadr[0]), int(m.joint(joint).qposadr[0])
    for name in JOINT_NAMES:
        if name != joint:
            m.dof_frictionloss[m.joint(name).dofadr[0]] = 1.0  # held
    if not friction:
        m.dof_frictionloss[dof] = 0.0
    m.dof_damping[dof] = 5e-3  # quasi-static: without it the joint trembles on its stop and leaves early
    d.joint("motor").qpos[0] = -0.1
    number = m.body(body).id
    arm = lever * model.parameters.value(length)
    # Start a little below the expected onset, at rest on the stop.
    start = max(0.0, balance(model, lever, friction)[digit] - 0.15)
    slowest = 5e-3 if friction else -np.inf
    point, pull, generalised = np.zeros(3), np.zeros(3), np.zeros(m.nv)
    before = 0.0
    d.qpos[at] = -0.15 * arm / model.parameters.value("joints.stop_stiffness")
    for k in range(round((0.2 + 0.6 / rate) / dt)):
        force = start + max(0.0, k * dt - 0.2) * rate
        frame = d.xmat[number].reshape(3, 3)
        point[:] = d.xpos[number] + frame @ np.array([0.0, 0.0, arm])
        pull[:] = frame @ np.array([force, 0.0, 0.0])
        generalised[:] = 0.0
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        mujoco.mj_applyFT(m, d, pull, np.zeros(3), point, number, generalised)
        d.qfrc_applied[:] = generalised
        mujoco.mj_step(m, d)
        if k * dt > 0.2 and d.qpos[at] > 0.0 and d.qvel[dof] > slowest:
            return before
        before = force
    raise HannesError(
        f"The {digit}'s distal phalanx did not move at {force:.2f} N; check springs.{digit}_preload."
    )


def run(model: Model, dt: float = 0.25e-3) -> Section:
    """R04: thesis' analytic value, our balance, our simulation, with the return wire."""
    figures = []
    lever = lever_of(model)
    own, rubbing = balance(model, lever), balance(model, lever, friction=True)
    simulated, stuck = {}, {}
    for digit in ("thumb", "index", "middle", "ring", "little"):
        simulated[digit] = onset(model, digit, lever, dt=dt)
        stuck[digit] = onset(model, digit, lever, friction=True, dt=dt)
        thesis = own[digit] * SIMULATED[digit] / ANALYTIC[digit]
        figures.append(
            Figure(
                "R04",
                f"{digit}, least force, simulated onset against balance",
                "N",
                own[digit],
                thesis,
                simulated[digit],
                limit=0.005,
            )
        )
    for digit in simulated:
        figures.append(
            Figure(
                "R04",
                f"{digit}, least force with dry friction",
                "N",
                rubbing[digit],
                float("nan"),
                stuck[digit],
                limit=0.005,
            )
        )
    for digit in simulated:
        figures.append(
            Figure(
                "R04",
                f"{digit}, balance against the thesis' analytic value",
                "N",
                ANALYTIC[digit],
                float("nan"),
                own[digit],
                limit=0.005,
                role="fitted",
            )
        )
    notes = (
        f"The thesis gives forces, not where they act. With the force at the tip the preloads would ask more current "
        f"to close than R07 gives. Here it acts at {lever:.3g} of the distance from joint to tip pad on every digit; "
        "five preloads are then solved from the five analytic forces, so that the last five lines are met by "
        "construction. Lever and preload are told apart by the void current alone.",
        "The thesis' forces are rounded to 0.01 N, up to 0.5 % of them: where its error is printed "
        "as 0, being closer is "
        "not defined.",
        "Joint before the distal one held, flexor wires slack, palm down; the thesis' column is its "
        "simulation's error "
        "on the same balance.",
    )
    return Section(("R04",), "least force that moves the distal phalanx", tuple(figures), notes)
