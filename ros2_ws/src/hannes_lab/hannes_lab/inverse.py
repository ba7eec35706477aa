"""Inverse dynamics: the force that a model needs for the motion that was measured, against the force that was measured.

For machines of a single mass (no wire) whose drive signal is a force or torque at the encoder:

    F = (J + INERTIA) a + (B + DAMPING) v + (C + FRICTION) sign v - TORQUE - LOAD_TORQUE

with the outputs of the effects along the measured motion.  Nothing is simulated, so the controller plays no part.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_sim.effect import effect_of
from hannes_sim.ports import (
    CURRENT,
    DAMPING,
    DELAY,
    DT,
    FRICTION,
    INERTIA,
    LOAD_TORQUE,
    N_INPUTS,
    N_OUTPUTS,
    QL,
    TORQUE,
    VL,
    Q,
    T,
    V,
)
from numba import njit
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from .rig import PlantRig, Rig
from .trials import Trial

Array = NDArray[np.float64]

CUTOFF = 100.0
"""Hz; motion and force go through the same low-pass (Butterworth of fourth order, forwards and backwards)."""


def force_residual(
    rig: Rig, model: Model, values: Mapping[str, float], trial: Trial, cutoff: float = CUTOFF
) -> Array:
    """Measured - needed force on the control grid (n,), in the unit of the drive signal.

    Raises HannesError where the plant is no single mass, or the drive or the position was not logged.
    """
    drive = next((s for s in rig.drive_signals if s in trial.signals), None)
    plant = rig.plant(model, trial) if isinstance(rig, PlantRig) else None
    if (
        plant is None
        or drive is None
        or "encoder_position" not in trial.signals
        or plant.get("wire.stiffness") > 0.0
    ):
        raise HannesError(
            f"Trial '{trial.name}': inverse dynamics needs a single mass with its position and drive logged."
        )
    for name, value in values.items():
        plant.set(name, value)
    dt = trial.period
    grid = np.asarray(np.arange(trial.reference.size) * dt, dtype=np.float64)
    low = butter(4, cutoff, fs=1.0 / dt, output="sos")
    q = sosfiltfilt(low, np.interp(grid, *trial.signals["encoder_position"]))
    measured = sosfiltfilt(low, np.interp(grid, *trial.signals[drive]))
    v = np.gradient(q, dt)
    a = np.gradient(v, dt)
    outputs = _outputs(model, plant.get, dt, q, v, measured)
    # The command is held for one period: on average it acts half a period after its sample.
    delay = float(outputs[:, DELAY].mean()) + 0.5 * dt
    measured = np.interp(grid - delay, grid, measured)
    inertia = plant.get("motor.armature") * plant.get("gear.ratio") ** 2 + outputs[:, INERTIA]
    damping = np.maximum(plant.get("friction.viscous") + outputs[:, DAMPING], 0.0)
    free = inertia * a + damping * v
    free -= outputs[:, TORQUE] + outputs[:, LOAD_TORQUE]
    level = np.maximum(plant.get("friction.coulomb") + outputs[:, FRICTION], 0.0)
    # At rest dry friction takes whatever is left, up to its level.
    rest = np.abs(v) < 1e-3 * float(np.abs(v).max())
    dry = np.where(rest, np.clip(measured - free, -level, level), level * np.sign(v))
    error: Array = measured - free - dry
    return error


def rows(trial: Trial, condition: str) -> NDArray[np.bool_]:
    """Which ticks of the control grid (n,) belong to a condition."""
    grid = np.arange(trial.reference.size) * trial.period
    own = np.zeros(grid.size, dtype=bool)
    for c in trial.of(condition):
        own |= (grid >= c.start) & (grid < c.stop)
    return own


def _outputs(model: Model, get: Any, dt: float, q: Any, v: Any, force: Array) -> Array:
    """What the effects add along a motion (n, N_OUTPUTS), their states stepped in its order."""
    out = np.zeros((q.size, N_OUTPUTS))
    for entry in model.effects:
        kind = effect_of(entry)
        p = np.array([get(f"{entry.name}.{parameter.name}") for parameter in kind.figures()])
        _along(_compiled(kind.contribute), p, np.zeros(max(1, kind.states)), dt, q, v, force, out)
    return out


@cache
def _compiled(contribute: Any) -> Any:
    return njit(contribute)


@njit
def _along(contribute, p, s, dt, q, v, force, out):  # type: ignore[no-untyped-def]
    x = np.zeros(N_INPUTS)
    x[DT] = dt
    for k in range(q.size):
        x[T], x[Q], x[V], x[QL], x[VL], x[CURRENT] = k * dt, q[k], v[k], q[k], v[k], force[k]
        contribute(x, p, s, out[k])
