"""The fast plant: one motor, one wire, one hand coordinate, all referred to the motor pulley.

    motor side  (J + dJ) q'' = torque - tension - friction(q')          encoder here
    wire        tension = k max(0, q - ql - slack) + b (q' - ql'), never negative
    load side   J_h ql'' = tension - return(ql) - stops(ql) - object(ql) - friction(ql')

return(ql) = preload + stiffness ql; the object is a spring and damper that pushes back only.  Dry friction (it sticks
exactly) and the damping of hand and object are solved implicitly, the rest semi-implicitly.  A wire of zero stiffness
switches the load side off: a single mass with a motor, which is what many single-drive machines are; its load is what
weighs on it.  Where it is known
that the encoder never reads less than some value of an open hand (`encoder.lowest`), the motor side stops there.

Limits: no single fingers, no gravity along the motion, constant moment arms; the MuJoCo plant has these.
Source of the structure: thesis section 4, "at the pulley"; of the friction form: dry_friction in motor.py.
"""

from __future__ import annotations

import math

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.joints import JOINT_LIMITS, JOINT_NAMES
from hannes_description.model import Model
from numba import cfunc
from numpy.typing import NDArray

from .effect import BoundEffects
from .motor import begin_step, dry_friction, evaluate_effects, motor_torque, sense, stand, watch_outputs
from .native import ADVANCE_SIGNATURE, pointer_f8
from .objects import GraspObject
from .plant import DEFAULT_DT, NOT_NEGATIVE, POSITIVE, PlantDiverged, Reading
from .ports import (
    COMPLIANCE,
    CONTACT,
    DAMPING,
    DELAY_RING,
    FRICTION,
    H_INPUTS,
    H_OUTPUTS,
    H_PARAMETERS,
    H_READING,
    H_STATE,
    INERTIA,
    LOAD,
    LOAD_DAMPING,
    LOAD_FRICTION,
    LOAD_TORQUE,
    N_HANDLE_COMMON,
    N_INPUTS,
    N_JOINTS,
    N_OUTPUTS,
    N_PARAMETERS_COMMON,
    N_READING,
    N_STATE_COMMON,
    OBJECT_DAMPING,
    P_CURRENT_OFFSET,
    P_DELAY,
    P_DT,
    P_EFFICIENCY,
    P_EMF_COMPENSATED,
    P_INDUCTANCE,
    P_INERTIA,
    P_KT,
    P_KT_NOMINAL,
    P_RATIO,
    P_RESISTANCE,
    P_RESOLUTION,
    P_SUPPLY,
    P_ZERO,
    QL,
    R_FORCE,
    R_JOINTS,
    R_LOAD,
    R_Q,
    R_QL,
    R_VL,
    R_WARNING,
    S_CONTACT,
    S_LOAD,
    S_TIME_STEPS,
    S_UNDEFINED,
    SENSE_POSITION,
    SLACK,
    TORQUE,
    UNDEFINED,
    VL,
)  # fmt: skip
from .raised import watched

# Parameters of this plant, after the common ones
(
    _COULOMB,
    _VISCOUS,
    _WIRE_K,
    _WIRE_B,
    _J_LOAD,
    _PRELOAD,
    _STIFFNESS,
    _LOAD_COULOMB,
    _LOAD_VISCOUS,
    _TRAVEL,
    _STOP_K,
    _OBJECT_K,
    _OBJECT_B,
    _OBJECT_AT,
    _TIP,
    _LOWEST,
) = range(N_PARAMETERS_COMMON, N_PARAMETERS_COMMON + 16)
_N_PARAMETERS = N_PARAMETERS_COMMON + 16

# States of this plant, after the common ones
_SQ, _SV, _SQL, _SVL = range(N_STATE_COMMON, N_STATE_COMMON + 4)
_N_STATES = N_STATE_COMMON + 4

NO_OBJECT = 1e9
"""rad; where the object is when there is none."""

NO_LOWEST = -1e9
"""rad; the lowest reading of an encoder of which none is known."""

# Finger joints of the closed hand; the long fingers' abduction is passive and stays in the middle.
_CLOSED = np.array(
    [
        0.0 if name.endswith("_abd") and not name.startswith("thumb") else JOINT_LIMITS[name].upper
        for name in JOINT_NAMES
    ]
)


def _advance(handle, voltage, steps):  # type: ignore[no-untyped-def]
    p, s = pointer_f8(handle[H_PARAMETERS]), pointer_f8(handle[H_STATE])
    x, y, out = pointer_f8(handle[H_INPUTS]), pointer_f8(handle[H_OUTPUTS]), pointer_f8(handle[H_READING])
    dt = p[P_DT]
    q, v, ql, vl = s[_SQ], s[_SV], s[_SQL], s[_SVL]
    place, speed, load, contact = q + ql, v, s[S_LOAD], s[S_CONTACT]
    if steps == 0:
        stand(handle, q, ql)
    for _ in range(steps):
        command = begin_step(handle, voltage, q, v)
        if p[_WIRE_K] <= 0.0:
            ql, vl = q, v  # one mass: a spring that saw where it was a step ago would give energy
        x[QL], x[VL], x[LOAD], x[CONTACT] = ql, vl, load, contact
        evaluate_effects(handle)
        torque = motor_torque(handle, command, v) + y[TORQUE]

        if p[_WIRE_K] > 0.0:
            stretch = q - ql - y[SLACK]
            load = 0.0
            if stretch > 0.0:
                stiffness = 1.0 / (1.0 / p[_WIRE_K] + max(0.0, y[COMPLIANCE]))
                load = max(0.0, stiffness * stretch + p[_WIRE_B] * (v - vl))
            force = load - p[_PRELOAD] - p[_STIFFNESS] * ql + y[LOAD_TORQUE]
            if ql < 0.0:
                force -= p[_STOP_K] * ql
            elif ql > p[_TRAVEL]:
                force -= p[_STOP_K] * (ql - p[_TRAVEL])
            damping = p[_LOAD_VISCOUS] + y[LOAD_DAMPING]
            inertia = p[_J_LOAD] + dt * (0.0 if damping < 0.0 else damping)  # max(0, NaN) would be 0
            momentum, friction = p[_J_LOAD] * vl + dt * force, p[_LOAD_COULOMB] + y[LOAD_FRICTION]
            vl = dry_friction(momentum, friction * dt, 1.0 / inertia)
            depth, contact = ql - p[_OBJECT_AT], 0.0
            if depth > 0.0:
                # It pushes back, or lets go: which of the two is known once its damping is solved with the velocity.
                spring, damper = p[_OBJECT_K] * depth, p[_OBJECT_B] + y[OBJECT_DAMPING]
                pressed = inertia + dt * damper
                against = dry_friction(momentum - dt * spring, friction * dt, 1.0 / pressed)
                contact = max(0.0, spring + damper * against)
                if contact > 0.0:
                    vl = against
            ql += dt * vl
        else:
            ql, vl, load = q, v, -y[LOAD_TORQUE]

        inertia = p[P_INERTIA] + y[INERTIA]
        damping = p[_VISCOUS] + y[DAMPING]
        damped = inertia + dt * (0.0 if damping < 0.0 else damping)
        friction = p[_COULOMB] + y[FRICTION]
        v = dry_friction(inertia * v + dt * (torque - load), friction * dt, 1.0 / damped)
        q += dt * v
        lowest = p[_LOWEST] - p[P_ZERO] - y[SENSE_POSITION]
        if q < lowest and q < 0.0:
            q, v = min(lowest, 0.0), max(v, 0.0)
        s[S_TIME_STEPS] += 1.0
    s[_SQ], s[_SV], s[_SQL], s[_SVL] = q, v, ql, vl
    s[S_LOAD], s[S_CONTACT] = load, contact
    watch_outputs(handle, place, speed)  # once a control period: what an effect cannot give lasts
    sense(handle, q, steps)
    out[R_FORCE] = contact / p[_TIP] if p[_TIP] > 0.0 else 0.0
    out[R_Q], out[R_QL], out[R_LOAD], out[R_VL] = q, ql, load, vl
    out[R_WARNING] = 0.0 if math.isfinite(q) and math.isfinite(ql) and abs(v) < 1e6 else 1.0
    if s[S_UNDEFINED] > 0.0:
        out[R_WARNING] = UNDEFINED


_compiled = cfunc(ADVANCE_SIGNATURE, cache=True, error_model="numpy")(_advance)

_NAMES = {
    "supply.voltage": P_SUPPLY,
    "motor.resistance": P_RESISTANCE,
    "motor.inductance": P_INDUCTANCE,
    "motor.kt": P_KT,
    "motor.emf_compensated": P_EMF_COMPENSATED,
    "gear.ratio": P_RATIO,
    "gear.efficiency": P_EFFICIENCY,
    "encoder.resolution": P_RESOLUTION,
    "encoder.zero": P_ZERO,
    "current.offset": P_CURRENT_OFFSET,
    "command.delay": P_DELAY,
    "friction.coulomb": _COULOMB,
    "friction.viscous": _VISCOUS,
    "wire.stiffness": _WIRE_K,
    "wire.damping": _WIRE_B,
    "hand.inertia": _J_LOAD,
    "hand.preload": _PRELOAD,
    "hand.stiffness": _STIFFNESS,
    "hand.coulomb": _LOAD_COULOMB,
    "hand.viscous": _LOAD_VISCOUS,
    "hand.travel": _TRAVEL,
    "hand.stop_stiffness": _STOP_K,
    "hand.fingertip_travel": _TIP,
}
_TRIAL_NAMES = {
    "object.stiffness": _OBJECT_K,
    "object.damping": _OBJECT_B,
    "object.position": _OBJECT_AT,
    "encoder.lowest": _LOWEST,
}
"""What a recording says, and no model: its object, and how little its encoder reads."""


NEEDED = ("supply.voltage", "motor.kt", "motor.armature")
"""Parameters without which nothing moves.  Where a model does not name the others, gear.ratio, gear.efficiency and
motor.resistance are 1 and all else is 0."""


class ReducedPlant:
    """The reduced plant of a model; see the module's docstring for its equations."""

    def __init__(self, model: Model, grasp: GraspObject | None = None, *, dt: float = DEFAULT_DT) -> None:
        if not (math.isfinite(dt) and 0.0 < dt <= 1e-2):
            raise HannesError(f"The integration step is {dt} s; it must lie in (0, 0.01].")
        self.dt = dt
        self.effects = BoundEffects.of(model.effects)
        self.parameters: NDArray[np.float64] = np.zeros(_N_PARAMETERS)
        self.states: NDArray[np.float64] = np.zeros(_N_STATES)
        self.reading: NDArray[np.float64] = np.zeros(N_READING)
        self._inputs = np.zeros(N_INPUTS)
        self._outputs = np.zeros(N_OUTPUTS)
        self._delay = np.zeros(DELAY_RING)
        self.handle: NDArray[np.int64] = np.zeros(N_HANDLE_COMMON, dtype=np.int64)
        self.handle[:] = [
            a.ctypes.data
            for a in (
                self.parameters,
                self.states,
                self.reading,
                self._inputs,
                self._outputs,
                self.effects.table,
                self._delay,
            )
        ]
        self.address: int = _compiled.address
        self._call = _compiled.ctypes
        self._handle_pointer = self.handle.ctypes.data_as(self._call.argtypes[0])

        self.parameters[P_DT] = dt
        values = model.parameters
        values.require({"the reduced plant": NEEDED})
        values.require_positive(POSITIVE, "the reduced plant")
        values.require_not_negative(NOT_NEGATIVE, "the reduced plant")
        # A drive without a gearbox, or whose command is a current, need not name these.
        self.parameters[[P_RATIO, P_EFFICIENCY, P_RESISTANCE]] = 1.0
        for name, index in _NAMES.items():
            if name in values:
                self.parameters[index] = values.value(name)
        self.parameters[P_KT_NOMINAL] = values.value(
            "control.motor_kt" if "control.motor_kt" in values else "motor.kt"
        )
        self._armature = values.value("motor.armature")
        self._update_inertia()
        self.parameters[_OBJECT_AT] = NO_OBJECT
        self.parameters[_LOWEST] = NO_LOWEST
        if grasp is not None:
            travel = values.value("hand.fingertip_travel")
            # A fingertip travels `travel` per rad of pulley, so k at the pulley = k travel^2; contact where the
            # opening that is left equals the object's size.
            self.parameters[_OBJECT_K] = grasp.stiffness * travel**2
            self.parameters[_OBJECT_B] = grasp.damping * travel**2
            self.parameters[_OBJECT_AT] = (values.value("hand.opening") - grasp.size) / travel
        self.reset()

    def _update_inertia(self) -> None:
        self.parameters[P_INERTIA] = self._armature * self.parameters[P_RATIO] ** 2
        if self.parameters[P_INERTIA] == 0.0:
            raise PlantDiverged("motor.armature or gear.ratio is 0: the reduced plant has no inertia.")

    @property
    def names(self) -> tuple[str, ...]:
        effects = tuple(f"{effect}.{parameter}" for effect, parameter in self.effects.index)
        return (*_NAMES, *_TRIAL_NAMES, "motor.armature", *effects)

    def set(self, name: str, value: float) -> None:
        if name in _NAMES or name in _TRIAL_NAMES:
            self.parameters[_NAMES.get(name, _TRIAL_NAMES.get(name, 0))] = value
            if name == "gear.ratio":
                self._update_inertia()
        elif name == "motor.armature":
            self._armature = value
            self._update_inertia()
        elif tuple(name.split(".", 1)) in self.effects.index:
            effect, parameter = name.split(".", 1)
            self.effects.set(effect, parameter, value)
        else:
            raise HannesError(
                f"The reduced plant has no parameter '{name}'; valid are {', '.join(self.names)}."
            )

    def get(self, name: str) -> float:
        """The present value of a parameter that `set` takes."""
        if name in _NAMES or name in _TRIAL_NAMES:
            return float(self.parameters[_NAMES.get(name, _TRIAL_NAMES.get(name, 0))])
        if name == "motor.armature":
            return self._armature
        effect, _, parameter = name.partition(".")
        if (effect, parameter) in self.effects.index:
            return float(self.effects.parameters[self.effects.index[(effect, parameter)]])
        raise HannesError(f"The reduced plant has no parameter '{name}'; valid are {', '.join(self.names)}.")

    def reset(self) -> None:
        self.states[:] = 0.0
        self.effects.states[:] = 0.0
        self._outputs[:] = 0.0
        self._delay[:] = 0.0
        self.reading[:] = 0.0
        with watched():  # what an effect raises is said at the first step
            self._call(self._handle_pointer, 0.0, 0)
        self.effects.states[:] = 0.0

    def advance(self, voltage: float, steps: int) -> None:
        with watched() as raised:
            self._call(self._handle_pointer, voltage, steps)
        if raised.said:
            raise self.effects.failed(raised.said, self.states[S_TIME_STEPS] * self.dt)
        self.check()

    def check(self) -> None:
        if self.reading[R_WARNING] == UNDEFINED:
            raise self.effects.undefined(self.states[S_TIME_STEPS] * self.dt)
        if self.reading[R_WARNING] != 0.0:
            which = "motor pulley" if not math.isfinite(self.reading[R_Q]) else "hand coordinate"
            raise PlantDiverged(
                f"The reduced plant diverged at t = {self.states[S_TIME_STEPS] * self.dt:.4f} s "
                f"({which}); reduce dt or check the parameters' magnitudes."
            )

    def show_joints(self, readings: NDArray[np.float64]) -> None:
        """All joints close alike, in proportion to the hand coordinate; they stand still where there is no hand."""
        if travel := self.parameters[_TRAVEL]:
            moved = readings[:, [R_QL, R_VL]] / travel
            readings[:, R_JOINTS:] = (moved[:, :, np.newaxis] * _CLOSED).reshape(-1, 2 * N_JOINTS)

    def read(self) -> Reading:
        self.show_joints(self.reading[np.newaxis])
        return Reading.of(self.reading)
