"""The closed loop in one process: any plant, any control law, the same machine code as in the nodes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from hannes_description.control_ports import (
    C_CURRENT,
    C_PERIOD,
    C_POSITION,
    C_REFERENCE,
    C_TIME,
    C_VELOCITY,
    N_CONTROL_INPUTS,
)
from hannes_description.errors import HannesError
from numba import cfunc, njit
from numpy.typing import NDArray

from .effect import BoundEffects
from .native import CONTROL_SIGNATURE, call_advance, call_control
from .plant import DEFAULT_DT, Plant
from .ports import (
    N_JOINTS,
    N_READING,
    R_CURRENT,
    R_EFFORT,
    R_FORCE,
    R_JOINTS,
    R_POSITION,
    R_TIME,
    R_VELOCITY,
    R_WARNING,
)
from .raised import Raised, watched

Array = NDArray[np.float64]


class Controller(Protocol):
    """A control law: address of the compiled function, flat parameters and states, period in s."""

    address: int
    period: float
    parameters: Array
    states: Array

    def reset(self) -> None: ...


_BY_PLANT = 2
"""Flag of an exception that the plant raised, and not the control law."""


@njit(cache=True, nogil=True)
def _closed_loop(  # type: ignore[no-untyped-def]
    advance, handle, reading, control, cx, cp, cs, reference, begin, period, substeps, out, voltages, raised
):
    cx_at, cp_at, cs_at, handle_at = cx.ctypes.data, cp.ctypes.data, cs.ctypes.data, handle.ctypes.data
    n = reference.shape[0]
    for k in range(n):
        cx[C_REFERENCE] = reference[k]
        cx[C_POSITION] = reading[R_POSITION]
        cx[C_VELOCITY] = reading[R_VELOCITY]
        cx[C_CURRENT] = reading[R_CURRENT]
        cx[C_PERIOD] = period
        cx[C_TIME] = (begin + k) * period
        voltage = call_control(control, cx_at, cp_at, cs_at)
        if raised[0] != 0:
            return k
        for j in range(out.shape[1]):
            out[k, j] = reading[j]
        voltages[k] = voltage
        if reading[R_WARNING] != 0.0 or not math.isfinite(voltage):
            return k
        call_advance(advance, handle_at, voltage, substeps)
        if raised[0] != 0:
            raised[0] = _BY_PLANT
            return k
    return n


def _playback(x: Any, p: Any, s: Any) -> Any:
    return x[C_REFERENCE]


_compiled_playback = cfunc(CONTROL_SIGNATURE, cache=True)(_playback)


class VoltagePlayback:
    """A control law that plays its reference as the voltage: the model open loop on a recorded command."""

    def __init__(self, period: float = 1e-3) -> None:
        self.address: int = _compiled_playback.address
        self.period = period
        self.parameters: Array = np.zeros(1)
        self.states: Array = np.zeros(1)

    def reset(self) -> None:
        """Nothing to clear."""


@dataclass(frozen=True)
class Rollout:
    """What a closed loop did, on the grid of control ticks.

    All arrays (n,) in SI with angles at the pulley: time, reference_position, encoder_position, encoder_velocity,
    motor_current (as the sensor sees it, signed), motor_voltage (command), motor_effort, grip_force;
    joint_positions and joint_velocities (n, 13), which raise HannesError where they were left out (`rollout`);
    raw (n, N_READING), or without joints (n, R_JOINTS), has what ports.R_* names.
    Row k holds the reading before the command of tick k.
    """

    time: Array
    reference_position: Array
    motor_voltage: Array
    raw: Array

    @property
    def encoder_position(self) -> Array:
        return self.raw[:, R_POSITION]

    @property
    def encoder_velocity(self) -> Array:
        return self.raw[:, R_VELOCITY]

    @property
    def motor_current(self) -> Array:
        return self.raw[:, R_CURRENT]

    @property
    def motor_effort(self) -> Array:
        return self.raw[:, R_EFFORT]

    @property
    def grip_force(self) -> Array:
        return self.raw[:, R_FORCE]

    @property
    def joint_positions(self) -> Array:
        return self._joints(R_JOINTS)

    @property
    def joint_velocities(self) -> Array:
        return self._joints(R_JOINTS + N_JOINTS)

    def _joints(self, first: int) -> Array:
        if self.raw.shape[1] < N_READING:
            raise HannesError("This rollout was made without the finger joints: make it with joints=True.")
        return self.raw[:, first : first + N_JOINTS]

    def copy(self) -> Rollout:
        """The same in arrays of its own."""
        own = (self.time, self.reference_position, self.motor_voltage, self.raw)
        return Rollout(*(values.copy() for values in own))

    def followed_by(self, other: Rollout) -> Rollout:
        """This one and then another, which went on from where it ended."""
        return Rollout(
            np.concatenate([self.time, other.time]),
            np.concatenate([self.reference_position, other.reference_position]),
            np.concatenate([self.motor_voltage, other.motor_voltage]),
            np.concatenate([self.raw, other.raw]),
        )

    def signal(self, name: str) -> Array:
        """A signal by its canonical name."""
        if name not in ROLLOUT_SIGNALS:
            raise HannesError(f"A rollout has no signal '{name}'; it has {', '.join(ROLLOUT_SIGNALS)}.")
        value: Array = getattr(self, name)
        return value


ROLLOUT_SIGNALS = (
    "reference_position",
    "encoder_position",
    "encoder_velocity",
    "motor_current",
    "motor_voltage",
    "motor_effort",
    "grip_force",
    "joint_positions",
    "joint_velocities",
)


def substeps_of(period: float, dt: float) -> int:
    """How many plant steps make a control period; they must divide."""
    steps = round(period / dt)
    if steps < 1 or abs(steps * dt - period) > 1e-9 * period:
        raise HannesError(
            f"The control period {period:g} s is not a multiple of the plant's step {dt:g} s: take a multiple, or make "
            "the plant with a step that divides it, make_plant(model, dt=step_of(period))."
        )
    return steps


def step_of(period: float) -> float:
    """The plant's step that divides a control period [s]: the usual one, or the next shorter one that does."""
    steps = period / DEFAULT_DT
    if abs(round(steps) * DEFAULT_DT - period) <= 1e-9 * period:
        return DEFAULT_DT
    return period / math.ceil(steps)


def rollout(
    plant: Plant,
    controller: Controller,
    reference: Array,
    *,
    reset: bool = True,
    begin: int = 0,
    joints: bool = True,
) -> Rollout:
    """Run the closed loop over a reference (n,) of one value per control period.

    Each tick: read, control, log, advance (the order of the lock-step node graph, which gives the same trajectory).
    reset=False goes on from the present state, `begin` ticks after what a law takes for its beginning; joints=False
    leaves the finger joints out of the log, which is faster.
    Raises PlantDiverged where the simulation does; HannesError for a reference that is not finite, and where the
    law or an effect raises an exception.
    """
    reference = np.ascontiguousarray(reference, dtype=np.float64)
    if reference.ndim != 1 or reference.size == 0:
        raise HannesError(f"The reference must be a non-empty 1-D array, not of shape {reference.shape}.")
    bad = np.flatnonzero(~np.isfinite(reference))
    if bad.size:
        raise HannesError(f"The reference is not finite at sample {bad[0]} ({bad.size} samples in all).")
    substeps = substeps_of(controller.period, plant.dt)
    if reset:
        plant.reset()
        controller.reset()
    n = reference.size
    out = np.empty((n, N_READING if joints else R_JOINTS))
    voltages = np.empty(n)
    with watched() as raised:
        done = _closed_loop(
            plant.address,
            plant.handle,
            plant.reading,
            controller.address,
            np.zeros(N_CONTROL_INPUTS),
            controller.parameters,
            controller.states,
            reference,
            begin,
            controller.period,
            substeps,
            out,
            voltages,
            raised.flag,
        )
    if raised.said:
        raise _failed(plant, raised, (begin + done) * controller.period)
    plant.check()
    if done < n:
        raise HannesError(
            f"The controller returned a non-finite voltage at t = {(begin + done) * controller.period:.3f} s; "
            "check its gains."
        )
    if joints:
        plant.show_joints(out)
    return Rollout(out[:, R_TIME].copy(), reference, voltages, out)


def _failed(plant: Plant, raised: Raised, time: float) -> HannesError:
    """The error of whichever raised an exception at a time [s]."""
    if raised.flag[0] != _BY_PLANT:
        return HannesError(f"The control law failed at t = {time:.4g} s: {raised.said}.")
    effects = getattr(plant, "effects", None)
    if isinstance(effects, BoundEffects) and effects.effects:
        return effects.failed(raised.said, plant.reading[R_TIME])
    return HannesError(f"The plant failed at t = {time:.4g} s: {raised.said}.")
