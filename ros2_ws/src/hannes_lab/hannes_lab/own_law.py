"""A user's own control law is run in a process of its own before anything is fitted with it.

Compiled code that never returns cannot be interrupted, and what it reads beyond its arrays is whatever lies there.  So
the law runs one closure where a time limit can end it, and then along that closure again, without a plant, between
numbers that it must neither read nor change.
"""

from __future__ import annotations

import gc
import math

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
from hannes_description.model import Model
from hannes_sim.effect import NEEDS_PYTHON, call_own, is_own_effect
from hannes_sim.native import call_control, needs_python
from hannes_sim.plant import PlantDiverged
from hannes_sim.raised import watched
from hannes_sim.rollout import Controller, Rollout, rollout
from numba import njit
from numba.core.ccallback import CFunc
from numpy.typing import NDArray

from .own_effect import TIME_LIMIT, along_reference, apart, check_own_effects, first_closure
from .rig import PlantRig
from .trials import Trial

Array = NDArray[np.float64]

_SHIPPED = ("hannes_control.", "hannes_sim.")

BESIDE = 16
"""Numbers before and after each array of the law that are watched."""

_ARRAYS = (("x", "x"), ("p", "its `parameters`"), ("s", "its `states`"))
_GIVEN = (C_REFERENCE, C_POSITION, C_VELOCITY, C_CURRENT)
_FILL = 1.0
_OTHERS = (0.0, math.nan, -1e6)
"""What lies beside the arrays: another voltage with one of these tells that it was read."""


def check_own_code(rig: PlantRig, model: Model) -> None:
    """Try the control law and the effects that a model file brings, before anything is simulated with them here."""
    check_own_law(rig, model)
    own = [effect.source for effect in model.effects if effect.source and is_own_effect(effect.source)]
    trial, reference = first_closure(rig.trials)
    check_own_effects(
        own, lambda _: rig.simulate(model, {}, trial, reference), along_reference(trial, reference)
    )


def check_own_law(rig: PlantRig, model: Model, *, limit: float = TIME_LIMIT) -> None:
    """Run the law that an adapter or a model file brings; raises one HannesError that says what is wrong with it."""
    if type(rig).controller is PlantRig.controller and ":" not in model.controller:
        return
    trial, reference = first_closure(rig.trials)
    who = f"The control law '{model.controller}'"
    if type(rig).controller is not PlantRig.controller:
        who = f"The control law of {type(rig).__name__}.controller"
    said = apart(
        lambda: _tried(rig, model, trial, reference, who),
        ended=f"{who} ended the process that tried it: it reads or writes outside its arrays x, p, s.",
        endless=f"{who} did not finish one closure within {limit:.0f} s: it has a loop that does not end.",
        limit=limit,
    )
    if said:
        raise HannesError(said)


def _tried(rig: PlantRig, model: Model, trial: Trial, reference: Array, who: str) -> str:
    plant, law, _ = rig._plant(model, trial)
    if type(law).__module__.startswith(_SHIPPED):
        return ""
    functions = [
        f for f in gc.get_objects() if type(f) is CFunc
    ]  # isinstance would ask proxies of what is gone
    if any(f.address == law.address and needs_python(f) for f in functions):
        return f"{who} {NEEDS_PYTHON}; take it out."
    between = _Between(law)
    try:
        run = rollout(plant, between, reference, joints=False)
    except PlantDiverged:
        return ""  # the model's guess, which a fit may mend
    return _outside(between, run, who)


class _Between:
    """A law whose arrays lie between watched numbers."""

    def __init__(self, law: Controller) -> None:
        self.law = law
        self.address, self.period = law.address, law.period
        self.reset()

    def reset(self) -> None:
        """As the law's own reset, with arrays of their own."""
        call_own(f"{type(self.law).__name__}.reset", self.law.reset)
        given = (np.zeros(N_CONTROL_INPUTS), self.law.parameters, self.law.states)
        self.whole = [np.pad(a.ravel(), BESIDE, constant_values=_FILL) for a in given]
        self.inputs, self.parameters, self.states = (a[BESIDE:-BESIDE] for a in self.whole)

    def changed(self, value: float = _FILL) -> tuple[int, int] | None:
        """Array and index of the first watched number that is another than `value` now."""
        for array, whole in enumerate(self.whole):
            same = np.isnan(whole) if math.isnan(value) else whole == value
            at = np.flatnonzero(_beside(whole.size) & ~same)
            if at.size:
                return array, int(at[0]) - BESIDE
        return None


def _beside(size: int) -> NDArray[np.bool_]:
    at = np.arange(size)
    beside: NDArray[np.bool_] = (at < BESIDE) | (at >= size - BESIDE)
    return beside


def _outside(law: _Between, run: Rollout, who: str) -> str:
    """A sentence if the law reads or writes beside its arrays along a run; "" if it does not."""
    usual, verb = _along(law, run), "writes"
    wrong = law.changed()
    if wrong is None and _same(usual, _along(law, run)):  # a law that keeps numbers elsewhere tells nothing
        wrong, verb = _read(law, run, usual), "reads"
    if wrong is None:
        return ""
    array, index = wrong
    name, which = _ARRAYS[array]
    n = law.whole[array].size - 2 * BESIDE
    return f"{who} {verb} {name}[{index}]: index {index} is out of bounds, the length of {which} is {n}."


def _read(law: _Between, run: Rollout, usual: Array) -> tuple[int, int] | None:
    """Array and index of the first watched number on which the voltages depend."""
    for other in _OTHERS:
        voltages = _along(law, run, other)
        if written := law.changed(other):  # where it is what it reads there that makes it write
            return written
        if not _same(usual, voltages):
            places = [
                (a, k) for a, whole in enumerate(law.whole) for k in np.flatnonzero(_beside(whole.size))
            ]
            for array, at in places:
                if not _same(usual, _along(law, run, other, (array, int(at)))):
                    return array, int(at) - BESIDE
    return None


def _along(law: _Between, run: Rollout, value: float = _FILL, place: tuple[int, int] | None = None) -> Array:
    """Voltages (n,) of the law along a run, with another value beside its arrays, or at one place there."""
    law.reset()
    for array, whole in enumerate(law.whole):
        if place is None:
            whole[_beside(whole.size)] = value
        elif place[0] == array:
            whole[place[1]] = value
    given = np.column_stack(
        [run.reference_position, run.encoder_position, run.encoder_velocity, run.motor_current]
    )
    with watched():
        return _replay(law.address, law.inputs, law.parameters, law.states, given, law.period)


def replay(law: Controller, given: Array) -> Array:
    """Commands (n,) of a law for references, positions, velocities and currents (n, 4), from the states that it has."""
    inputs = np.zeros(N_CONTROL_INPUTS)
    commands: Array = _replay(law.address, inputs, law.parameters, law.states, given, law.period)
    return commands


@njit(cache=True)
def _replay(address, x, p, s, given, period):  # type: ignore[no-untyped-def]
    voltages = np.empty(given.shape[0])
    for k in range(voltages.size):
        for j in range(4):
            x[_GIVEN[j]] = given[k, j]
        x[C_PERIOD], x[C_TIME] = period, k * period
        voltages[k] = call_control(address, x.ctypes.data, p.ctypes.data, s.ctypes.data)
    return voltages


def _same(a: Array, b: Array) -> bool:
    return np.array_equal(a, b, equal_nan=True)
