"""The full hand: MuJoCo's multi-body dynamics behind the same drive, effects and sensors as the reduced plant.

Each step (compiled, no Python): command and effects -> motor current and torque -> outputs of the effects onto
MuJoCo's arrays -> mj_step.  How the outputs are mapped (r = pulley radius; J = pulley rad per joint rad while all
wires are taut):

    TORQUE, FRICTION, DAMPING, INERTIA   the slide of the motor: / r, / r, / r^2, / r^2
    LOAD_TORQUE, LOAD_FRICTION           the flexed joints: x J (the same power at the pulley)
    LOAD_DAMPING                         the flexed joints: x J w, w = pulley range / joint range (the same torque
                                         while all joints close together), kept implicit and diagonal
    SLACK, COMPLIANCE                    limit and stiffness of the master wire (no slack in the forces variant)
    OBJECT_DAMPING                       the contacts, by hand.fingertip_travel

Inputs: QL, VL are the finger joints through J; LOAD is the master wire's tension x r; CONTACT is the grip force x
hand.fingertip_travel.  Dry friction and damping are MuJoCo's own (solved implicitly); an explicit friction torque
would be unstable above 0.05 ms.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from hannes_description.errors import HannesError
from hannes_description.joints import JOINT_LIMITS, JOINT_NAMES
from hannes_description.mjcf import (
    CARTS,
    CONTACT_STEPS,
    DRIVE,
    MASTER,
    MOTOR,
    PRISM_SIDES,
    WIRE_IMPEDANCE,
    Variant,
    build_spec,
    contact_stiffness,
    direct_solref,
    transmission_jacobian,
)
from hannes_description.model import Model
from numba import cfunc
from numpy.typing import NDArray

from .effect import BoundEffects
from .motor import FASTEST, begin_step, evaluate_effects, motor_torque, sense, stand, watch_outputs
from .native import ADVANCE_SIGNATURE, call_2, pointer_f8, pointer_i8
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
    SLACK,
    TORQUE,
    UNDEFINED,
    VL,
)  # fmt: skip
from .raised import watched

# Parameters of this plant, after the common ones
_RADIUS, _COULOMB, _VISCOUS, _TIP, _WIRE_K, _WIRE_B, _WIRE_GAIN, _OBJECT_K, _OBJECT_B = range(
    N_PARAMETERS_COMMON, N_PARAMETERS_COMMON + 9
)
_N_PARAMETERS = N_PARAMETERS_COMMON + 9

# Entries of the handle after the common ones: addresses of MuJoCo's structs and arrays
(
    _MODEL,
    _DATA,
    _STEP,
    _COUNTS,
    _QPOS,
    _QVEL,
    _APPLIED,
    _FRICTION,
    _DAMPING,
    _ARMATURE,
    _WIRE_RANGE,
    _WIRE_SOLREF,
    _PAIR_SOLREF,
    _PAIR_SOLIMP,
    _SENSORS,
    _WARNINGS,
    _TABLE,
    _MASS,
) = range(N_HANDLE_COMMON, N_HANDLE_COMMON + 18)
_N_HANDLE = N_HANDLE_COMMON + 18

# Counts: int64
_C_NQ, _C_WIRES, _C_MOTOR, _C_TENSION, _C_GRIP, _C_PAIRS, _C_JOINTS = 0, 1, 2, 3, 4, 5, 6
_N_COUNTS = _C_JOINTS + N_JOINTS

# Table: float64 rows of N_JOINTS: J, w J, base dry friction, base damping; then the contacts' weights A
_T_J, _T_W, _T_FRICTION, _T_DAMPING, _T_PAIRS = 0, N_JOINTS, 2 * N_JOINTS, 3 * N_JOINTS, 4 * N_JOINTS

_N_IMPEDANCE = mujoco.mjNIMP

_FATAL = tuple(
    int(w)
    for w in (
        mujoco.mjtWarning.mjWARN_INERTIA,
        mujoco.mjtWarning.mjWARN_CONTACTFULL,
        mujoco.mjtWarning.mjWARN_CNSTRFULL,
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
)
_WARNING_SHIFT = 32  # mjWarningStat is (int lastinfo, int number); the count is the upper half of an int64
_N_WARNINGS = len(_FATAL)


def _advance(handle, voltage, steps):  # type: ignore[no-untyped-def]
    p, s = pointer_f8(handle[H_PARAMETERS]), pointer_f8(handle[H_STATE])
    x, y, out = pointer_f8(handle[H_INPUTS]), pointer_f8(handle[H_OUTPUTS]), pointer_f8(handle[H_READING])
    count, table = pointer_i8(handle[_COUNTS]), pointer_f8(handle[_TABLE])
    qpos, qvel, applied = pointer_f8(handle[_QPOS]), pointer_f8(handle[_QVEL]), pointer_f8(handle[_APPLIED])
    friction, damping = pointer_f8(handle[_FRICTION]), pointer_f8(handle[_DAMPING])
    armature, mass, sensors = (
        pointer_f8(handle[_ARMATURE]),
        pointer_f8(handle[_MASS]),
        pointer_f8(handle[_SENSORS]),
    )
    r, motor = p[_RADIUS], count[_C_MOTOR]
    wires = count[_C_WIRES] != 0
    q = ql = v = vl = bad = 0.0
    for k in range(steps + 1):
        ql = vl = 0.0
        for j in range(N_JOINTS):
            ql += table[_T_J + j] * qpos[count[_C_JOINTS + j]]
            vl += table[_T_J + j] * qvel[count[_C_JOINTS + j]]
        q, v = qpos[motor] / r, qvel[motor] / r
        for j in range(count[_C_NQ]):
            if bad == 0.0 and not (math.isfinite(qpos[j]) and abs(qvel[j]) < FASTEST):
                bad = 1.0 + j
        if k == steps or bad != 0.0:
            break
        command = begin_step(handle, voltage, q, v)
        x[QL], x[VL], x[LOAD], x[CONTACT] = ql, vl, s[S_LOAD], s[S_CONTACT]
        evaluate_effects(handle)
        watch_outputs(handle, q + ql, v)
        torque = motor_torque(handle, command, v) + y[TORQUE]
        level = max(0.0, p[_COULOMB] + y[FRICTION]) / r
        viscous = max(0.0, p[_VISCOUS] + y[DAMPING]) / (r * r)

        for j in range(N_JOINTS):
            jacobian = table[_T_J + j]
            if jacobian > 0.0:
                at = count[_C_JOINTS + j]
                applied[at] = y[LOAD_TORQUE] * jacobian
                friction[at] = max(0.0, table[_T_FRICTION + j] + y[LOAD_FRICTION] * jacobian)
                damping[at] = max(0.0, table[_T_DAMPING + j] + y[LOAD_DAMPING] * table[_T_W + j])
        applied[motor] = torque / r
        friction[motor] = level
        damping[motor] = viscous
        # MuJoCo takes the inertia of a body on a single slide from dof_M0, that of any other from dof_armature.
        armature[motor] = y[INERTIA] / (r * r)
        mass[motor] = (p[P_INERTIA] + y[INERTIA]) / (r * r)
        stiffness = p[_WIRE_K] / (1.0 + p[_WIRE_K] * max(0.0, y[COMPLIANCE]) * r * r)
        pointer_f8(handle[_WIRE_SOLREF])[0] = -stiffness * p[_WIRE_GAIN]
        if wires:
            pointer_f8(handle[_WIRE_RANGE])[1] = y[SLACK] * r
        if count[_C_PAIRS] > 0:
            pairs, impedance = pointer_f8(handle[_PAIR_SOLREF]), pointer_f8(handle[_PAIR_SOLIMP])
            object_damping = p[_OBJECT_B] + y[OBJECT_DAMPING] / (5.0 * p[_TIP] * p[_TIP])
            span = CONTACT_STEPS * p[P_DT]
            for j in range(count[_C_PAIRS]):
                # mjcf.contact_impedance: the damping of an effect may change from step to step
                ratio = table[_T_PAIRS + j] * span * (p[_OBJECT_K] * span + object_damping)
                share = min(max(ratio / (1.0 + ratio), 1e-4), 0.9999)
                impedance[_N_IMPEDANCE * j] = impedance[_N_IMPEDANCE * j + 1] = share
                pairs[2 * j] = -p[_OBJECT_K] * (1.0 - share) * table[_T_PAIRS + j]
                pairs[2 * j + 1] = -object_damping * (1.0 - share) * table[_T_PAIRS + j]

        call_2(handle[_STEP], handle[_MODEL], handle[_DATA])
        s[S_TIME_STEPS] += 1.0
        if wires:
            s[S_LOAD] = sensors[count[_C_TENSION]] * r
        else:
            s[S_LOAD] = (stiffness * (q - ql) + p[_WIRE_B] * (v - vl)) * r * r
        s[S_CONTACT] = sensors[count[_C_GRIP]] * p[_TIP] if count[_C_GRIP] >= 0 else 0.0

    if steps == 0:
        stand(handle, q, ql)
    sense(handle, q, steps)
    out[R_FORCE] = sensors[count[_C_GRIP]] if count[_C_GRIP] >= 0 else 0.0
    out[R_Q], out[R_QL], out[R_LOAD], out[R_VL] = q, ql, s[S_LOAD], vl
    for j in range(N_JOINTS):
        out[R_JOINTS + j] = qpos[count[_C_JOINTS + j]]
        out[R_JOINTS + N_JOINTS + j] = qvel[count[_C_JOINTS + j]]
    if bad == 0.0:
        warnings = pointer_i8(handle[_WARNINGS])
        for j in range(_N_WARNINGS):
            if warnings[j] >> _WARNING_SHIFT:
                bad = -1.0 - j
    out[R_WARNING] = UNDEFINED if s[S_UNDEFINED] > 0.0 else bad


_compiled = cfunc(ADVANCE_SIGNATURE, cache=True)(_advance)


def _library() -> ctypes.CDLL:
    """The MuJoCo library that the Python package itself has loaded."""
    folder = Path(mujoco.__file__).parent
    patterns = ("libmujoco.so*", "libmujoco*.dylib", "mujoco.dll")
    found = sorted(path for pattern in patterns for path in folder.glob(pattern))
    if not found:
        raise HannesError(f"No MuJoCo library in {folder}; reinstall the package mujoco.")
    return ctypes.CDLL(str(found[0]))


_mujoco_library = _library()
_STEP_ADDRESS = ctypes.cast(_mujoco_library.mj_step, ctypes.c_void_p).value

# MuJoCo would print its warnings and append them to MUJOCO_LOG.TXT in the working directory; the plant counts them and
# raises PlantDiverged instead.  A handler that the user has set stays.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(lambda message: None)

# MuJoCo's profiler (mjData.timer) reads the clock some thirty times a step, 7 % of a step of the hand.  The Python
# package switches it on, and set_mjcb_time(None) leaves its clock where it is; a clock that the user has set stays.
if mujoco.get_mjcb_time() is None:
    ctypes.c_void_p.in_dll(_mujoco_library, "mjcb_time").value = None

_NAMES = {
    "supply.voltage": P_SUPPLY,
    "motor.resistance": P_RESISTANCE,
    "motor.inductance": P_INDUCTANCE,
    "motor.kt": P_KT,
    "motor.emf_compensated": P_EMF_COMPENSATED,
    "gear.efficiency": P_EFFICIENCY,
    "encoder.resolution": P_RESOLUTION,
    "encoder.zero": P_ZERO,
    "current.offset": P_CURRENT_OFFSET,
    "command.delay": P_DELAY,
    "friction.coulomb": _COULOMB,
    "friction.viscous": _VISCOUS,
    "hand.fingertip_travel": _TIP,
}
_GROUPS = ("geometry", "inertia", "gravity", "pulleys", "springs", "joints", "carts", "wires")
_NOT_NEGATIVE_GROUPS = ("inertia", "springs", "joints", "carts", "wires")
_REBUILD = ("motor.armature", "gear.ratio", "pulley.radius")

_SCALED = {"hand.preload": 0.0107, "hand.stiffness": 0.0015, "hand.coulomb": 0.008}
"""Parameters at the pulley that the reduced plant has too, with the value for which the groups springs, joints and
carts are given.  Another value scales all preloads, all rates, or all dry friction of joints and carts alike."""

_OBJECT_NAMES = ("object.stiffness", "object.damping", "object.position")
"""As in the reduced plant: object.position [rad] is the pulley angle at which the object is touched, by its size;
object.stiffness [N.m/rad] and object.damping [N.m.s/rad] are those of the whole grasp, referred to the pulley."""


class MujocoPlant:
    """The multi-body plant of a model; see the module's docstring and hannes_description.mjcf for its equations.

    `spec`, `model` and `data` are MuJoCo's own objects, for measurements, without what is only seen (render.py shows
    it); the plant writes into them.
    """

    def __init__(self, model: Model, grasp: GraspObject | None = None, *, dt: float = DEFAULT_DT) -> None:
        if not (math.isfinite(dt) and 0.0 < dt <= 5e-4):
            raise HannesError(
                f"The integration step is {dt} s; the multi-body plant needs one in (0, 0.0005]."
            )
        self.dt = dt
        self.variant = Variant.of(model.variant)
        self.grasp = grasp
        self._values = model.parameters
        self._values.require_positive(POSITIVE, "the multi-body plant")
        matter = [name for name in self._values if name.split(".")[0] in _NOT_NEGATIVE_GROUPS]
        self._values.require_not_negative([*NOT_NEGATIVE, *matter], "the multi-body plant")
        self._scaled = {
            name: self._values.value(name) if name in self._values else given
            for name, given in _SCALED.items()
        }
        self.effects = BoundEffects.of(model.effects)
        self.parameters: NDArray[np.float64] = np.zeros(_N_PARAMETERS)
        self.states: NDArray[np.float64] = np.zeros(N_STATE_COMMON)
        self.reading: NDArray[np.float64] = np.zeros(N_READING)
        self._inputs = np.zeros(N_INPUTS)
        self._outputs = np.zeros(N_OUTPUTS)
        self._delay = np.zeros(DELAY_RING)
        self.handle: NDArray[np.int64] = np.zeros(_N_HANDLE, dtype=np.int64)
        self.handle[:N_HANDLE_COMMON] = [
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
        for name, index in _NAMES.items():
            if name in self._values:
                self.parameters[index] = self._values.value(name)
        self.parameters[P_KT_NOMINAL] = self._values.value(
            "control.motor_kt" if "control.motor_kt" in self._values else "motor.kt"
        )
        self._build()
        self.reset()

    # -- building -----------------------------------------------------------------------------------------------
    def _build(self) -> None:
        """Compile the multi-body model from the present parameters and take the addresses of its arrays."""
        values = self._values
        self.spec = build_spec(values, self.variant, self.grasp)
        self.spec.option.timestep = self.dt
        # What is only seen costs a step's kinematics and moves nothing; pictures are made by render.py.
        self.spec.compiler.discardvisual = True
        try:
            self.model = self.spec.compile()
        except ValueError as error:
            raise HannesError(f"The hand cannot be built from these parameters: {error}") from error
        self.data = mujoco.MjData(self.model)
        m, d, p = self.model, self.data, self.parameters
        radius = values.value("pulley.radius")
        p[_RADIUS], p[P_RATIO] = radius, values.value("gear.ratio")
        p[P_INERTIA] = values.value("motor.armature") * p[P_RATIO] ** 2
        wires = self.variant.transmission == "wires"

        self._counts: NDArray[np.int64] = np.zeros(_N_COUNTS, dtype=np.int64)
        self._counts[_C_NQ], self._counts[_C_WIRES] = m.nv, int(wires)
        self._counts[_C_JOINTS:] = [m.joint(name).dofadr[0] for name in JOINT_NAMES]
        self._counts[_C_MOTOR] = m.joint(MOTOR).dofadr[0]
        self._counts[_C_TENSION] = m.sensor(f"tension_{MASTER}").adr[0] if wires else -1
        self._counts[_C_GRIP] = m.sensor("grip_force").adr[0] if self.grasp is not None else -1
        self._counts[_C_PAIRS] = m.npair

        self._table = np.zeros(_T_PAIRS + max(1, m.npair))
        jacobian = transmission_jacobian(values)
        travel = sum(arm * JOINT_LIMITS[name].upper for name, arm in jacobian.items())
        for k, name in enumerate(JOINT_NAMES):
            dof = int(self._counts[_C_JOINTS + k])
            arm = jacobian.get(name, 0.0)
            self._table[_T_J + k] = arm / radius
            self._table[_T_W + k] = arm / radius**2 * travel / JOINT_LIMITS[name].upper
            self._table[_T_FRICTION + k], self._table[_T_DAMPING + k] = (
                m.dof_frictionloss[dof],
                m.dof_damping[dof],
            )
        for k in range(m.npair):
            bodies = m.geom_bodyid[[m.pair_geom1[k], m.pair_geom2[k]]]
            self._table[_T_PAIRS + k] = float(np.sum(m.body_invweight0[bodies, 0]))

        spare = self._delay.ctypes.data  # never read or written where the variant lacks the array
        addresses = [
            m._address,
            d._address,
            _STEP_ADDRESS,
            self._counts.ctypes.data,
            d.qpos.ctypes.data,
            d.qvel.ctypes.data,
            d.qfrc_applied.ctypes.data,
            m.dof_frictionloss.ctypes.data,
            m.dof_damping.ctypes.data,
            m.dof_armature.ctypes.data,
        ]
        wire = m.tendon(MASTER if wires else DRIVE).id
        p[_WIRE_K], p[_WIRE_B] = values.value("wires.master_stiffness"), values.value("wires.damping")
        p[_WIRE_GAIN] = -direct_solref(1.0, 0.0, WIRE_IMPEDANCE, float(m.tendon_invweight0[wire]))[0]
        stretch = m.tendon_solref_lim[wire] if wires else m.eq_solref[m.equality(DRIVE).id]
        addresses += [m.tendon_range[wire].ctypes.data, stretch.ctypes.data]
        addresses += [
            m.pair_solref.ctypes.data if m.npair else spare,
            m.pair_solimp.ctypes.data if m.npair else spare,
            d.sensordata.ctypes.data if m.nsensor else spare,
            d.warning.number.ctypes.data - 4,
            self._table.ctypes.data,
            m.dof_M0.ctypes.data,
        ]
        self.handle[N_HANDLE_COMMON:] = addresses
        self._given = {
            "springlength": m.tendon_lengthspring.copy(),
            "rate": m.tendon_stiffness.copy(),
            "springref": m.qpos_spring.copy(),
            "torsion": m.jnt_stiffness.copy(),
            "friction": self._table[_T_FRICTION:_T_DAMPING].copy(),
            "carts": m.dof_frictionloss.copy(),
        }
        self._scale()
        self._shape_object()

    def _scale(self) -> None:
        """Put hand.preload, hand.stiffness and hand.coulomb into the compiled model."""
        m, given = self.model, self._given
        preload, rate, friction = (self._scaled[name] / reference for name, reference in _SCALED.items())
        if rate <= 0.0:
            raise HannesError(
                f"hand.stiffness must be above 0, not {self._scaled['hand.stiffness']} N.m/rad."
            )
        # Preload = rate x spring length, so the length takes the preload's factor over the rate's.
        m.tendon_stiffness[:] = given["rate"] * rate
        m.tendon_lengthspring[:] = given["springlength"] * (preload / rate)
        for name in transmission_jacobian(self._values):
            joint = m.joint(name)
            m.jnt_stiffness[joint.id] = given["torsion"][joint.id] * rate
            at = joint.qposadr[0]
            m.qpos_spring[at] = given["springref"][at] * (preload / rate)
        self._table[_T_FRICTION:_T_DAMPING] = given["friction"] * friction
        m.dof_frictionloss[self._counts[_C_JOINTS:]] = self._table[_T_FRICTION:_T_DAMPING]
        if self.variant.transmission == "wires":
            for name in CARTS:
                dof = m.joint(name).dofadr[0]
                m.dof_frictionloss[dof] = given["carts"][dof] * friction

    def _shape_object(self) -> None:
        """Put the object's size, stiffness and damping into the compiled model."""
        if self.grasp is None:
            return
        m = self.model
        self.parameters[_OBJECT_K], self.parameters[_OBJECT_B] = contact_stiffness(self.grasp)
        if self.grasp.shape in PRISM_SIDES:
            return  # a mesh keeps the size that it was compiled with
        geom = m.geom("object").id
        half = 0.5 * self.grasp.size
        m.geom_size[geom, 0] = half
        if self.grasp.shape == "box":
            m.geom_size[geom, 2] = half
        # The radius of the sphere that holds the geom; collision starts from it.
        sizes = m.geom_size[geom]
        m.geom_rbound[geom] = {
            "sphere": half,
            "capsule": half + sizes[1],
            "box": float(np.linalg.norm(sizes)),
        }[self.grasp.shape]

    # -- parameters ---------------------------------------------------------------------------------------------
    @property
    def names(self) -> tuple[str, ...]:
        effects = tuple(f"{effect}.{parameter}" for effect, parameter in self.effects.index)
        mechanics = tuple(name for name in self._values if name.split(".")[0] in _GROUPS)
        objects = _OBJECT_NAMES if self.grasp is not None else ()
        return (*_NAMES, *_SCALED, *_REBUILD, *objects, *mechanics, *effects)

    def set(self, name: str, value: float) -> None:
        """Change a parameter; the state goes on.  One of the mechanics rebuilds the multi-body model (10 ms)."""
        self.set_many({name: value})

    def set_many(self, values: dict[str, float]) -> None:
        """Change several parameters with at most one rebuild."""
        rebuild = False
        for name, value in values.items():
            effect, _, parameter = name.partition(".")
            if (effect, parameter) in self.effects.index:
                self.effects.set(effect, parameter, value)
            elif name in _NAMES:
                self.parameters[_NAMES[name]] = value
            elif name in _OBJECT_NAMES and self.grasp is not None:
                if name == "object.position":
                    self.grasp = replace(self.grasp, size=self._opening() - value * self.parameters[_TIP])
                    rebuild = rebuild or self.grasp.shape in PRISM_SIDES
                elif name == "object.stiffness":
                    self.grasp = replace(self.grasp, stiffness=value / self.parameters[_TIP] ** 2)
                else:
                    self.grasp = replace(self.grasp, damping=value / self.parameters[_TIP] ** 2)
                self._shape_object()
            elif name in _SCALED:
                self._scaled[name] = value
                self._scale()
            elif name in _REBUILD or (name.split(".")[0] in _GROUPS and name in self._values):
                self._values = self._values.with_values({name: value})
                rebuild = True
            else:
                raise HannesError(
                    f"The MuJoCo plant has no parameter '{name}'; valid are {', '.join(self.names)}."
                )
        if rebuild:
            old = self.data
            self._build()
            self.data.time = old.time
            self.data.qpos[:], self.data.qvel[:] = old.qpos, old.qvel
            self.data.qacc_warmstart[:] = old.qacc_warmstart

    def set_dry_friction(self, levels: dict[str, float]) -> None:
        """Dry friction [N.m] of joints by name, in place of what follows from the parameters until the next rebuild."""
        for name, level in levels.items():
            if name not in JOINT_NAMES:
                raise HannesError(f"No joint '{name}'; valid are {', '.join(JOINT_NAMES)}.")
            if not (math.isfinite(level) and level >= 0.0):
                raise HannesError(
                    f"The dry friction of joint '{name}' is {level} N.m; it must be finite, at least 0."
                )
            index = JOINT_NAMES.index(name)
            self._table[_T_FRICTION + index] = level
            self.model.dof_frictionloss[self._counts[_C_JOINTS + index]] = level

    def _opening(self) -> float:
        return self._values.value("hand.opening")

    def get(self, name: str) -> float:
        """The present value of a parameter that `set` takes."""
        effect, _, parameter = name.partition(".")
        if (effect, parameter) in self.effects.index:
            return float(self.effects.parameters[self.effects.index[(effect, parameter)]])
        if name in _NAMES:
            return float(self.parameters[_NAMES[name]])
        if name in _SCALED:
            return self._scaled[name]
        if name == "object.position" and self.grasp is not None:
            return float((self._opening() - self.grasp.size) / self.parameters[_TIP])
        if name in _OBJECT_NAMES and self.grasp is not None:
            return float(getattr(self.grasp, name.split(".")[1]) * self.parameters[_TIP] ** 2)
        if name in _REBUILD or (name.split(".")[0] in _GROUPS and name in self._values):
            return self._values.value(name)
        raise HannesError(f"The MuJoCo plant has no parameter '{name}'; valid are {', '.join(self.names)}.")

    # -- running ------------------------------------------------------------------------------------------------
    def reset(self) -> None:
        """The open hand at rest at encoder zero; every state, the solver's warm start among them, as when new."""
        mujoco.mj_resetData(self.model, self.data)
        self.states[:] = 0.0
        self.effects.states[:] = 0.0
        self._inputs[:] = 0.0
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
        """Raise PlantDiverged where a coordinate is not finite or too fast, MuJoCo warned, or its time went astray."""
        code = self.reading[R_WARNING]
        steps = self.states[S_TIME_STEPS]
        expected = steps * self.dt
        if code == 0.0 and abs(self.data.time - expected) <= 1e-6 * max(1.0, expected):
            return
        if code == UNDEFINED:
            raise self.effects.undefined(expected)
        joint = self._suspect(code)
        reason = "its time does not match the steps taken"
        if code > 0.0:
            reason = f"joint '{joint}' is not finite or faster than {FASTEST:.0e}"
        elif code < 0.0:
            warning = mujoco.mjtWarning(int(-code) - 1).name.removeprefix("mjWARN_")
            reason = f"MuJoCo warns of {warning}, joint '{joint}'"
        raise PlantDiverged(
            f"The MuJoCo plant diverged at t = {expected:.4f} s ({reason}); reduce dt or check the "
            "parameters' magnitudes."
        )

    def _suspect(self, code: float) -> str:
        """The joint to name: the one that is not finite, else the one that MuJoCo's warning names, else the fastest."""
        m, d = self.model, self.data
        if code > 0.0:
            dof = int(code) - 1
        elif code < 0.0 and int(-code) - 1 in _FATAL[3:] + _FATAL[:1]:
            dof = int(d.warning.lastinfo[int(-code) - 1])
        else:
            dof = int(np.argmax(np.abs(np.nan_to_num(d.qvel, nan=np.inf))))
        dof = min(max(dof, 0), m.nv - 1)
        return str(m.joint(int(m.dof_jntid[dof])).name)

    def show_joints(self, readings: NDArray[np.float64]) -> None:
        """Nothing to do: they are read with all else."""

    def read(self) -> Reading:
        return Reading.of(self.reading)

    # -- measurements for tests, pictures and the reduced plant ----------------------------------------------------
    def tensions(self) -> dict[str, float]:
        """Tension [N] of the three wires at the last step, by name; empty without wires."""
        m, d = self.model, self.data
        return {
            m.sensor(k).name.removeprefix("tension_"): float(d.sensordata[m.sensor_adr[k]])
            for k in range(m.nsensor)
            if m.sensor(k).name.startswith("tension_")
        }


def load_curve(
    model: Model,
    grasp: GraspObject | None = None,
    *,
    speed: float = 1.0,
    samples: int = 200,
    dt: float = DEFAULT_DT,
) -> dict[str, NDArray[np.float64]]:
    """Torque that the hand asks of the pulley, closing and opening slowly: what a reduced plant is derived from.

    The motor's own friction is off: the pulley is led by a stiff spring and damper along the ramp
    0 -> hand.travel -> 0 at `speed` [rad/s], and the torque that leads it is recorded.  Half the sum of both directions
    is the springs and the object, half the difference the dry friction of joints and carts.

    Returns arrays (samples,): angle [rad], closing [N.m], opening [N.m], each the mean over a bin of angle, since the
    joints let go one after the other.
    """
    plant = MujocoPlant(model, grasp, dt=dt)
    m, d = plant.model, plant.data
    radius, travel = plant.get("pulley.radius"), model.parameters.value("hand.travel")
    motor = int(plant._counts[_C_MOTOR])
    m.dof_frictionloss[motor] = m.dof_damping[motor] = 0.0
    mass = plant.parameters[P_INERTIA] / radius**2
    stiffness, damping = mass * 300.0**2, 2.0 * mass * 300.0
    steps = int(travel / speed / dt)
    angle = np.linspace(0.0, travel, samples)
    edges = 0.5 * (angle[1:] + angle[:-1])
    curves = []
    for direction in (1, -1):
        torque, at = np.empty(steps), np.empty(steps)
        for k in range(steps):
            target = travel * (k / steps if direction > 0 else 1.0 - k / steps) * radius
            force = stiffness * (target - d.qpos[motor]) + damping * (
                direction * speed * radius - d.qvel[motor]
            )
            d.qfrc_applied[motor] = force
            mujoco.mj_step(m, d)
            torque[k], at[k] = force * radius, d.qpos[motor] / radius
        if not np.all(np.isfinite(at)):
            raise PlantDiverged(f"The load curve diverged near {travel:.1f} rad of pulley; reduce dt.")
        bins = np.searchsorted(edges, at)
        number = np.bincount(bins, minlength=samples)
        total = np.bincount(bins, weights=torque, minlength=samples)
        filled = number > 0
        curves.append(np.interp(angle, angle[filled], total[filled] / number[filled]))
    return {"angle": angle, "closing": curves[0], "opening": curves[1]}


def describe(plant: MujocoPlant) -> dict[str, Any]:
    """Sizes of the compiled model, for benchmarks and reports."""
    m = plant.model
    return {
        "nv": m.nv,
        "nbody": m.nbody,
        "ntendon": m.ntendon,
        "npair": m.npair,
        "dt": plant.dt,
        "variant": {
            "return_mechanism": plant.variant.return_mechanism,
            "transmission": plant.variant.transmission,
            "thumb_stop_deg": plant.variant.thumb_stop_deg,
        },
    }
