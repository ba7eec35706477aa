"""The library of bench/comparison.py's sparse regression: torque terms at the motor pulley, and their way back.

    residual = torque of the motor - what the nominal model needs for the measured motion = sum of c_k term_k(q, v, a)

The nominal model is that of the reduced plant with a rigid wire; current and motion are those of the log.
"""

import math
from typing import Any

import numpy as np
from hannes_lab.hand import object_of
from hannes_lab.prepare import Prepared
from hannes_sim.effect import Effect, EffectParameter
from hannes_sim.factory import make_plant
from hannes_sim.ports import DAMPING, FRICTION, INERTIA, TORQUE, Q, V
from numpy.typing import NDArray
from scipy.signal import savgol_filter

Array = NDArray[np.float64]

TITLES = {
    "constant": "1", "linear": "q", "square": "q^2", "cube": "q^3", "viscous": "v", "quadratic": "v|v|",
    "coulomb": "sign v", "inertia": "a",
}  # fmt: skip
NAMES = tuple(TITLES)


class SparseTerms(Effect):
    """The terms with their coefficients, in closed loop; friction opposes the motion and never drives it."""

    name = "sparse_terms"
    title = "terms of a sparse regression"
    parameters = tuple(
        EffectParameter(name, "1", low, high, typical, 0.0, TITLES[name])
        for name, low, high, typical in (
            ("constant", -0.2, 0.2, 0.01), ("linear", -0.05, 0.05, 1e-3), ("square", -5e-3, 5e-3, 1e-4),
            ("cube", -5e-4, 5e-4, 1e-5), ("viscous", -3e-4, 0.02, 1e-3), ("quadratic", -1e-3, 1e-3, 1e-5),
            ("coulomb", -0.02, 0.2, 0.01), ("inertia", -1e-4, 5e-3, 1e-4),
        )
    )  # fmt: skip

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        q, v = x[Q], x[V]
        y[TORQUE] -= p[0] + p[1] * q + p[2] * q * q + p[3] * q * q * q + p[5] * v * abs(v)
        y[DAMPING] += p[4]
        y[FRICTION] += p[6]
        y[INERTIA] += p[7]


def terms(q: Array, v: Array, a: Array) -> Array:
    """The library (n, k) along a motion."""
    moving = np.tanh(v / 0.05)
    return np.column_stack([np.ones_like(q), q, q**2, q**3, v, v * np.abs(v), moving, a])


def regression(prepared: Prepared, training: bool) -> tuple[Array, Array, NDArray[np.int64]]:
    """Library (n, k), torque residual (n,) and number of the closure (n,), of void closures at rest or in motion.

    training  every second closure only
    """
    plant = make_plant(prepared.model)
    get = plant.get
    gain = get("motor.kt") * get("gear.ratio") * get("gear.efficiency")
    inertia = get("motor.armature") * get("gear.ratio") ** 2 + get("hand.inertia")
    dry, viscous = (
        get("friction.coulomb") + get("hand.coulomb"),
        get("friction.viscous") + get("hand.viscous"),
    )
    thetas, residuals, groups = [], [], []
    for trial in prepared.features.trials:
        if object_of(trial) is not None:
            continue
        time, position = trial.signals["encoder_position"]
        _, current = trial.signals["motor_current"]
        step = float(np.median(np.diff(time)))
        q, v, a = (np.asarray(savgol_filter(position, 7, 3, deriv=d, delta=step)) for d in range(3))
        # The log has the current's size, averaged over the sample before: its sign is that of the torque needed,
        # and the motion is averaged over the same time.
        q, v, a = (0.5 * (z + np.concatenate([z[:1], z[:-1]])) for z in (q, v, a))
        needed = (
            inertia * a
            + viscous * v
            + dry * np.tanh(v / 0.05)
            + get("hand.preload")
            + get("hand.stiffness") * q
        )
        residual = np.copysign(gain * current, needed) - needed
        for number, closure in enumerate(trial.closures):
            if training and number % 2:
                continue
            own = (time >= closure.start) & (time < closure.stop) & (np.abs(v) > 0.2) & (q > 0.0)
            own &= q < get("hand.travel")
            if math.isfinite(float(residual[own].sum())) and own.any():
                thetas.append(terms(q[own], v[own], a[own]))
                residuals.append(residual[own])
                groups.append(np.full(int(own.sum()), number))
    return np.concatenate(thetas), np.concatenate(residuals), np.concatenate(groups)
