"""R14 and R15: a simpler mechanism identified from the full one by least squares, as the thesis does.

R14  torsion springs M = M0 + k q in every joint instead of the return wires (moment preload + rate x travel of the
     wire, shared by both joints of a digit)
R15  forces on the joints instead of pulleys and wires: the `forces` transmission

Both are fitted to the joint angles of the full hand (void closure, same controller and reference) by Gauss-Newton; the
RMSE is over closing and opening.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from hannes_control.double_pid import DoublePID
from hannes_control.reference import half_sine
from hannes_description.joints import DIGITS, FINGERS, JOINT_NAMES
from hannes_description.mjcf import joints_of, return_moments
from hannes_description.model import Model
from hannes_sim.mujoco_plant import MujocoPlant
from hannes_sim.plant import PlantDiverged
from hannes_sim.rollout import rollout
from numpy.typing import NDArray

from .table import Figure, Progress, Section, silent

Array = NDArray[np.float64]

FLEXED = tuple(joint for digit in DIGITS for joint in joints_of(digit))
"""The nine joints that wires flex."""

SPRINGS: Mapping[str, float] = {
    "thumb_abd": 0.0493,
    "index_mcp": 0.0112,
    "index_pip": 0.0399,
    "middle_mcp": 0.0107,
    "middle_pip": 0.0399,
    "ring_mcp": 0.0099,
    "ring_pip": 0.0964,
    "little_mcp": 0.0242,
    "little_pip": 0.0615,
}
FORCES: Mapping[str, float] = {
    "index_mcp": 0.0256,
    "index_pip": 0.0108,
    "middle_mcp": 0.0625,
    "middle_pip": 0.0478,
    "ring_mcp": 0.0751,
    "ring_pip": 0.0683,
    "little_mcp": 0.0595,
    "little_pip": 0.0556,
}
"""rad; the thesis' RMSE."""

FLOOR = 0.01
"""rad; half the thesis' RMSE or this, whichever is larger, is asked."""

ITERATIONS = 14

DURATION = 2.0
"""s of the closure that are compared: the reference's rise and fall.  After it the motor overshoots the open hand:
wires go slack, the forces transmission pushes, and no parameter of it can help that."""

_COLUMNS = [JOINT_NAMES.index(joint) for joint in FLEXED]


def closure(plant: MujocoPlant, model: Model) -> Array:
    """Angles (n, 9) of the flexed joints, rad, every 4 ms of one void closure from rest."""
    controller = DoublePID.of_model(model.parameters)
    reference = half_sine()[: round(DURATION / controller.period)]
    return rollout(plant, controller, reference).joint_positions[::4, _COLUMNS]


def variant(model: Model, **options: str) -> Model:
    """The same hand with another mechanism."""
    return replace(model, variant={**model.variant, **options})


class Springs:
    """Torsion springs with free M0 and k; x holds the logarithms of their ratio to the return wire's moments."""

    def __init__(self, model: Model) -> None:
        self.model = variant(model, return_mechanism="torsion_spring")
        self.plant = MujocoPlant(self.model)
        self.given = return_moments(model.parameters)
        self.size = 2 * len(FLEXED)

    def angles(self, x: Array) -> Array:
        m = self.plant.model
        for k, joint in enumerate(FLEXED):
            moment, rate = self.given[joint]
            rate *= math.exp(x[2 * k + 1])
            j = m.joint(joint)
            m.jnt_stiffness[j.id] = rate
            m.qpos_spring[j.qposadr[0]] = -moment * math.exp(x[2 * k]) / rate
        return closure(self.plant, self.model)


class Forces:
    """The forces transmission; x holds logarithms of ratios to the full hand's values.

    Nine flexor arms, and per digit the preload and rate of its return wire and the dry friction as tension: they take
    over what carts and guides did (springs, friction).
    """

    def __init__(self, model: Model) -> None:
        self.model = variant(model, transmission="forces")
        self.names = (
            *(f"pulleys.{joint}" for joint in FLEXED),
            *(f"springs.{digit}_{what}" for digit in DIGITS for what in ("preload", "rate")),
        )
        self.size = len(self.names) + len(DIGITS)

    def angles(self, x: Array) -> Array:
        v = self.model.parameters.value
        plant = MujocoPlant(
            self.model.with_values({name: v(name) * math.exp(x[k]) for k, name in enumerate(self.names)})
        )
        plant.set_dry_friction(
            {
                joint: v("joints.friction_tension") * v(f"pulleys.{joint}") * math.exp(x[len(self.names) + k])
                for k, digit in enumerate(DIGITS)
                for joint in joints_of(digit)
            }
        )
        return closure(plant, self.model)


def rmse(a: Array, b: Array) -> Array:
    """Root mean square difference of every column."""
    out: Array = np.sqrt(((a - b) ** 2).mean(axis=0))
    return out


def identify(
    kind: Springs | Forces,
    wanted: Array,
    *,
    iterations: int = ITERATIONS,
    tick: Callable[[], None] = lambda: None,
) -> tuple[Array, Array]:
    """Parameters x and angles (n, 9) with the least RMSE over the joints, by damped Gauss-Newton."""
    x = np.zeros(kind.size)
    best = kind.angles(x)
    damping = 1e-2
    for _ in range(iterations):
        jacobian = np.empty((wanted.size, x.size))
        for k in range(x.size):
            step = np.zeros(x.size)
            step[k] = 0.03
            tick()
            jacobian[:, k] = ((kind.angles(x + step) - best) / 0.03).ravel()
        residual = (wanted - best).ravel()
        square, gradient = jacobian.T @ jacobian, jacobian.T @ residual
        better = False
        for _ in range(6):
            scale = np.diag(np.diag(square) + 1e-3 * float(np.mean(np.diag(square))))
            move = np.clip(np.linalg.solve(square + damping * scale, gradient), -0.4, 0.4)
            try:
                trial = kind.angles(x + move)
            except PlantDiverged:
                trial = np.full_like(wanted, np.inf)
            if ((wanted - trial) ** 2).sum() < ((wanted - best) ** 2).sum():
                x, best, better = x + move, trial, True
                damping = max(damping / 5.0, 1e-5)
                break
            damping *= 10.0
        if not better:
            break
    return x, best


def run(model: Model, which: str, progress: Progress = silent) -> Section:
    """R14 (`springs`) or R15 (`forces`)."""
    base = variant(model, return_mechanism="return_wire", transmission="wires")
    # R15 compares the transmissions alone; friction in proportion to a master wire that the forces have not is off.
    base = base.without_effects() if which == "forces" else base
    wanted = closure(MujocoPlant(base), base)
    kind: Springs | Forces = Springs(base) if which == "springs" else Forces(base)
    done = [0]

    def tick() -> None:
        done[0] += 1
        progress(done[0], ITERATIONS * kind.size, f"{'R14' if which == 'springs' else 'R15'}: identification")

    start = kind.angles(np.zeros(kind.size))
    x, best = identify(kind, wanted, tick=tick)
    before, after = rmse(wanted, start), rmse(wanted, best)
    given = SPRINGS if which == "springs" else FORCES
    row = "R14" if which == "springs" else "R15"
    figures = []
    for k, joint in enumerate(FLEXED):
        if joint in given:
            figures.append(
                Figure(
                    row,
                    f"{joint}, RMSE",
                    "rad",
                    max(FLOOR, 0.5 * given[joint]),
                    given[joint],
                    float(after[k]),
                    kind="at_most",
                    role="fitted",
                )
            )
    what = (
        "torsion springs (two numbers per joint, 18 in all)"
        if which == "springs"
        else "forces on the joints (an arm per joint; preload, rate and dry friction per digit: 24 numbers)"
    )
    names = ("return wires", "torsion springs") if which == "springs" else ("pulleys and wires", "forces")
    time = 0.004 * np.arange(wanted.shape[0])
    title = f"{names[0]} against {names[1]}"
    still = [j for k, j in enumerate(FLEXED) if np.ptp(wanted[:, k]) < math.radians(1.0)]
    notes = [
        f"{what} identified by least squares from the full hand's own angles over one void closure, closing and "
        f"opening ({DURATION:g} s; after it the motor overshoots the open hand, wires go slack and forces push). "
        "Root mean square over all joints before the identification "
        f"{math.sqrt(float((before**2).mean())):.4f} rad, after it {math.sqrt(float((after**2).mean())):.4f} rad."
    ]
    if still:
        notes.append(f"{', '.join(still)} turns less than 1 deg in this closure; its RMSE says nothing.")
    return Section(
        (row,),
        title,
        tuple(figures),
        tuple(notes),
        {
            "time": time,
            "full": wanted,
            "simple": best,
            "names": names,
            "joints": FLEXED,
            "x": x,
            "fingers": FINGERS,
        },
    )
