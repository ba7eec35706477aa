"""The motor controller of Hannes: an outer position loop that asks for current, an inner current loop that gives PWM.

Thesis P12: outer P on the position error gives the current reference, limited to +-4.6 A (P11); inner PI on the
current error gives the voltage, limited to +-12 V.  The outer loop needs damping: P alone rings with the rotor's
inertia.  Boards whose outer loop integrates too have a gain for that; nominally it is 0.  Battery saver: when the
current stays above a threshold for a time, the outer gain drops to zero and dry friction holds the grip until the
reference asks for less than the hand's position, or for more than before.

The law is one pure function, called by the node and, compiled, by the simulator's rollout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import numpy as np
from hannes_description.control_ports import (
    C_CURRENT,
    C_PERIOD,
    C_POSITION,
    C_REFERENCE,
    N_CONTROL_INPUTS,
)
from hannes_description.errors import HannesError
from hannes_description.parameters import ParameterSet
from numba import cfunc, types
from numpy.typing import NDArray

# Order of the parameters in the flat array = order of the fields of DoublePIDParameters.
_KP, _DAMPING, _FILTER, _CURRENT_KP, _CURRENT_KI, _I_MAX, _U_MAX, _SAVER_I, _SAVER_T, _SAVER_RELEASE, _KI = (
    range(11)
)

# States
_INTEGRAL, _LAST_POSITION, _VELOCITY, _STARTED, _SAVER_CLOCK, _SAVING, _SAVED_REFERENCE, _I_REF, _OUTER = (
    range(9)
)
N_STATES = 9


NEEDED = (
    *(f"control.{n}" for n in ("kp", "damping", "velocity_filter", "current_kp", "current_ki")),
    *(f"control.saver_{n}" for n in ("current", "time", "release")),
    "motor.current_limit",
    "supply.voltage",
)
"""Parameters of a model without which the law cannot be made."""


@dataclass(frozen=True)
class DoublePIDParameters:
    """Gains and limits of the double PID.

    kp             A/rad, outer proportional gain at the pulley
    damping        A.s/rad, outer gain on the measured velocity
    velocity_filter  s, time constant of the first-order filter of the differentiated encoder
    current_kp     V/A, inner proportional gain (L/tau for a closed current loop of time constant tau)
    current_ki     V/(A.s), inner integral gain (R/tau)
    current_limit  A, limit of the current reference
    voltage_limit  V, limit of the command (the supply)
    saver_current  A, battery saver: threshold of |current|
    saver_time     s, battery saver: time above the threshold before the outer gain drops to zero
    saver_release  rad, battery saver: a reference that rises by this much closes further; one below the hand's position
                   opens it
    ki             A/(rad.s), outer integral gain at the pulley
    """

    kp: float
    damping: float
    velocity_filter: float
    current_kp: float
    current_ki: float
    current_limit: float
    voltage_limit: float
    saver_current: float
    saver_time: float
    saver_release: float
    ki: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not math.isfinite(value) or value < 0.0:
                raise HannesError(
                    f"Controller parameter '{item.name}' is {value}; it must be finite and at least 0."
                )
        for name in ("current_limit", "voltage_limit"):
            if getattr(self, name) == 0.0:
                raise HannesError(f"Controller parameter '{name}' is 0: the motor could never move.")

    @classmethod
    def from_parameters(cls, parameters: ParameterSet) -> DoublePIDParameters:
        """Gains from a parameter set: groups `control`, `motor` and `supply`.

        The gains are numbers of their own: they were set once, and a motor that turns out to be another (an identified
        resistance) does not change them.  kp = L/tau and ki = R/tau cancel the winding's pole and give a closed current
        loop of time constant tau.
        """
        parameters.require({"double_pid": NEEDED})
        c, m = parameters.values_of("control"), parameters.values_of("motor")
        return cls(
            kp=c["kp"],
            damping=c["damping"],
            velocity_filter=c["velocity_filter"],
            current_kp=c["current_kp"],
            current_ki=c["current_ki"],
            current_limit=m["current_limit"],
            voltage_limit=parameters.value("supply.voltage"),
            saver_current=c["saver_current"],
            saver_time=c["saver_time"],
            saver_release=c["saver_release"],
            ki=c.get("ki", 0.0),
        )

    def to_array(self) -> NDArray[np.float64]:
        return np.array([getattr(self, item.name) for item in fields(self)], dtype=np.float64)


def control(x: Any, p: Any, s: Any) -> float:
    """One period of the law: voltage [V] from inputs x (control_ports), parameters p and states s.

    Outer: i_ref = clamp(kp e + ki (integral of e) - damping velocity, +-current_limit) of e = reference - position;
    inner PI on i_ref - current.  Both with conditional integration: an integrator stops when its output is clamped and
    the error would push further.  The battery saver empties the outer one.
    """
    dt = x[C_PERIOD]
    position = x[C_POSITION]
    if s[_STARTED] == 0.0:
        s[_STARTED] = 1.0
        s[_LAST_POSITION] = position
    raw = (position - s[_LAST_POSITION]) / dt
    s[_LAST_POSITION] = position
    s[_VELOCITY] += dt / (dt + p[_FILTER]) * (raw - s[_VELOCITY])

    gain = p[_KP]
    if abs(x[C_CURRENT]) > p[_SAVER_I]:
        s[_SAVER_CLOCK] += dt
    else:
        s[_SAVER_CLOCK] = 0.0
    if s[_SAVING] == 0.0 and s[_SAVER_CLOCK] >= p[_SAVER_T]:
        s[_SAVING] = 1.0
        s[_SAVED_REFERENCE] = x[C_REFERENCE]
    if s[_SAVING] == 1.0:
        # An open command is a reference on the open side of the hand: until it is there, it would close the hand again.
        if x[C_REFERENCE] < position or x[C_REFERENCE] > s[_SAVED_REFERENCE] + p[_SAVER_RELEASE]:
            s[_SAVING] = 0.0
            s[_SAVER_CLOCK] = 0.0
        else:
            gain = 0.0

    away = x[C_REFERENCE] - position
    outer = s[_OUTER] + p[_KI] * dt * away if s[_SAVING] == 0.0 else 0.0
    i_ref = gain * away + outer - p[_DAMPING] * s[_VELOCITY]
    if (i_ref > p[_I_MAX] and away > 0.0) or (i_ref < -p[_I_MAX] and away < 0.0):
        outer = s[_OUTER]
    s[_OUTER] = min(max(outer, -p[_I_MAX]), p[_I_MAX])
    i_ref = min(max(i_ref, -p[_I_MAX]), p[_I_MAX])
    s[_I_REF] = i_ref
    error = i_ref - x[C_CURRENT]
    integral = s[_INTEGRAL] + p[_CURRENT_KI] * dt * error
    wanted = p[_CURRENT_KP] * error + integral
    limit = p[_U_MAX]
    voltage = min(max(wanted, -limit), limit)
    if (wanted > limit and error > 0.0) or (wanted < -limit and error < 0.0):
        integral = s[_INTEGRAL]
    s[_INTEGRAL] = min(max(integral, -limit), limit)
    return voltage


@cache
def compiled_control() -> Any:
    """The law as a C function; `.address` for the rollout, `.ctypes` to call it."""
    pointer = types.CPointer(types.float64)
    return cfunc(types.float64(pointer, pointer, pointer), cache=True)(control)


class DoublePID:
    """The law with its states, for one motor.

    address      address of the compiled function, for the rollout
    parameters   flat float64 array, states: flat float64 array
    """

    def __init__(self, parameters: DoublePIDParameters, period: float = 1e-3) -> None:
        if not (math.isfinite(period) and period > 0.0):
            raise HannesError(f"The control period is {period} s; it must be a positive number.")
        self.period = period
        self.settings = parameters
        self.parameters = parameters.to_array()
        self.states: NDArray[np.float64] = np.zeros(N_STATES)
        self._inputs: NDArray[np.float64] = np.zeros(N_CONTROL_INPUTS)
        self._function = compiled_control()
        self.address: int = self._function.address
        self._call = self._function.ctypes
        self._pointers = [
            a.ctypes.data_as(self._call.argtypes[k])
            for k, a in enumerate((self._inputs, self.parameters, self.states))
        ]

    @classmethod
    def of_model(cls, parameters: ParameterSet, period: float = 1e-3) -> DoublePID:
        return cls(DoublePIDParameters.from_parameters(parameters), period)

    def reset(self) -> None:
        """Clear integrator, filter and battery saver."""
        self.states[:] = 0.0

    def update(self, reference: float, position: float, current: float) -> float:
        """Voltage [V] for one period from reference [rad], encoder position [rad] and current [A].

        Raises HannesError when an input is not finite: such a value must never reach the motor.
        """
        if not (math.isfinite(reference) and math.isfinite(position) and math.isfinite(current)):
            raise HannesError(
                f"Controller input is not finite: reference {reference}, position {position}, "
                f"current {current}."
            )
        self._inputs[C_REFERENCE] = reference
        self._inputs[C_POSITION] = position
        self._inputs[C_CURRENT] = current
        self._inputs[C_PERIOD] = self.period
        return float(self._call(*self._pointers))

    @property
    def current_reference(self) -> float:
        """A, of the last update."""
        return float(self.states[_I_REF])

    @property
    def saving(self) -> bool:
        """True while the battery saver holds."""
        return bool(self.states[_SAVING])
