"""What every plant has in common at its drive: effects, command delay, electrical motor, sensors."""

from __future__ import annotations

import math

from numba import njit

from .native import call_effect, pointer_f8, pointer_i8
from .ports import (
    BRUSH,
    CONTACT,
    CURRENT,
    DELAY,
    DELAY_RING,
    DT,
    H_DELAY,
    H_EFFECTS,
    H_INPUTS,
    H_OUTPUTS,
    H_PARAMETERS,
    H_READING,
    H_STATE,
    KT_REL,
    LOAD,
    N_OUTPUTS,
    P_CURRENT_OFFSET,
    P_DELAY,
    P_DT,
    P_EFFICIENCY,
    P_EMF_COMPENSATED,
    P_INDUCTANCE,
    P_KT,
    P_KT_NOMINAL,
    P_RATIO,
    P_RESISTANCE,
    P_RESOLUTION,
    P_SUPPLY,
    P_ZERO,
    QL,
    R_CURRENT,
    R_EFFORT,
    R_POSITION,
    R_TIME,
    R_VELOCITY,
    RESISTANCE,
    RESISTANCE_REL,
    S_CURRENT,
    S_DECAY,
    S_DELAY_INDEX,
    S_MEAN,
    S_POSITION_READ,
    S_RATE,
    S_TIME_STEPS,
    S_UNDEFINED,
    SENSE_CURRENT,
    SENSE_CURRENT_GAIN,
    SENSE_POSITION,
    SUPPLY,
    VL,
    VOLTAGE,
    VOLTAGE_DROP,
    Q,
    T,
    V,
)  # fmt: skip

_compiled = njit(cache=True, error_model="numpy")
"""Divisions without Python's check for 0, which takes time: what is not finite is seen in the reading."""

_inlined = njit(cache=True, error_model="numpy", inline="always")
"""The same as part of its caller's loop: a call there costs a sixth of a step."""

SAME_RATE = 1e-5
"""Part of the winding's decay over a step by which it may be off: a motor that warms up changes it a little with every
step, and what follows from it takes long."""

FASTEST = 1e4
"""rad/s or m/s; a machine that is faster has diverged, whatever its effects give."""


@_compiled
def evaluate_effects(handle):  # type: ignore[no-untyped-def]
    """Sum the contributions of all active effects into the outputs; the inputs must be filled before."""
    x, y = handle[H_INPUTS], handle[H_OUTPUTS]
    table = pointer_i8(handle[H_EFFECTS])
    if table[0] == 0:
        return  # the outputs are zero since the reset
    out = pointer_f8(y)
    for k in range(N_OUTPUTS):
        out[k] = 0.0
    for k in range(table[0]):
        call_effect(table[1 + 3 * k], x, table[2 + 3 * k], table[3 + 3 * k], y)


@_compiled
def watch_outputs(handle, place, speed):  # type: ignore[no-untyped-def]
    """Keep in mind that what the effects gave last is not finite, though the machine was: a limiter may hide it.

    place, speed   of the machine before they gave it
    """
    if pointer_i8(handle[H_EFFECTS])[0] == 0:
        return
    out, total = pointer_f8(handle[H_OUTPUTS]), 0.0
    for k in range(N_OUTPUTS):
        total += out[k]
    if not math.isfinite(total) and math.isfinite(place) and abs(speed) < FASTEST:
        pointer_f8(handle[H_STATE])[S_UNDEFINED] = 1.0


@_inlined
def begin_step(handle, voltage, q, v):  # type: ignore[no-untyped-def]
    """Time, delayed and limited command [V], and motor position into the inputs; returns the command.

    The delay is the parameter plus the effects' DELAY of the previous step, interpolated between the stored
    commands (one a step), so that it is continuous in the delay.
    """
    p, s = pointer_f8(handle[H_PARAMETERS]), pointer_f8(handle[H_STATE])
    x, y, ring = pointer_f8(handle[H_INPUTS]), pointer_f8(handle[H_OUTPUTS]), pointer_f8(handle[H_DELAY])
    limit = p[P_SUPPLY]
    command = min(max(voltage, -limit), limit)
    index = int(s[S_DELAY_INDEX])
    ring[index] = command
    s[S_DELAY_INDEX] = float((index + 1) % DELAY_RING)
    steps = (p[P_DELAY] + y[DELAY]) / p[P_DT]
    steps = min(max(steps, 0.0), DELAY_RING - 2.0)
    if steps > 0.0:
        whole = int(steps)
        part = steps - whole
        newer = ring[(index - whole) % DELAY_RING]
        older = ring[(index - whole - 1) % DELAY_RING]
        command = newer + part * (older - newer)
    x[T] = s[S_TIME_STEPS] * p[P_DT]
    x[DT] = p[P_DT]
    x[Q] = q
    x[V] = v
    x[CURRENT] = s[S_CURRENT]
    x[VOLTAGE] = command
    x[RESISTANCE] = p[P_RESISTANCE]
    x[SUPPLY] = limit
    return command


@_compiled
def stand(handle, q, ql):  # type: ignore[no-untyped-def]
    """What the effects give of a machine that stands, so that the first reading of its sensors has it."""
    begin_step(handle, 0.0, q, 0.0)
    x = pointer_f8(handle[H_INPUTS])
    x[QL], x[VL], x[LOAD], x[CONTACT] = ql, 0.0, 0.0, 0.0
    evaluate_effects(handle)


@_inlined
def motor_torque(handle, command, v):  # type: ignore[no-untyped-def]
    """Torque at the pulley [N.m] of the brushed motor after a step of a command [V] at a speed v [rad/s].

    L di/dt = u - R i - Ke w, integrated exactly over the step for constant u and w (the electrical time constant,
    about 0.1 ms, is shorter than a step); torque = efficiency kt ratio i, with the mean current of the step so that
    the impulse is exact too.  Without inductance the current follows at once.  A dry voltage drop (brushes) is
    solved implicitly, in the proximal form of dry_friction, because at zero current it is steeper than R.
    An amplifier with a current loop of its own makes up for the back-EMF (compensated = 1): the command is then a
    current in units of its gain.
    """
    p, s = pointer_f8(handle[H_PARAMETERS]), pointer_f8(handle[H_STATE])
    y = pointer_f8(handle[H_OUTPUTS])
    kt = p[P_KT] * (1.0 + y[KT_REL])
    resistance = p[P_RESISTANCE] * (1.0 + y[RESISTANCE_REL])
    drive = command - y[VOLTAGE_DROP] - kt * p[P_RATIO] * v * (1.0 - p[P_EMF_COMPENSATED])
    final = drive * (1.0 / resistance)  # the reciprocal is known before the drive, and divisions take long
    before = s[S_CURRENT]
    rate = resistance / p[P_INDUCTANCE] * p[P_DT] if p[P_INDUCTANCE] > 0.0 else math.inf
    if abs(rate - s[S_RATE]) > SAME_RATE * rate:
        s[S_RATE] = rate
        s[S_DECAY] = math.exp(-rate)
        s[S_MEAN] = (1.0 - s[S_DECAY]) / rate
    decay = s[S_DECAY]
    if y[BRUSH] > 0.0:
        held = drive + decay * resistance / (1.0 - decay) * before
        final = (
            (max(held - y[BRUSH], 0.0) + min(held + y[BRUSH], 0.0)) * (1.0 - decay) / resistance
            - decay * before
        ) / (1.0 - decay)
    if rate < math.inf:
        after = final + (before - final) * decay
        mean = final + (before - final) * s[S_MEAN]
    else:
        after = final
        mean = final
    s[S_CURRENT] = after
    return p[P_EFFICIENCY] * kt * p[P_RATIO] * mean


@_compiled
def sense(handle, q, steps):  # type: ignore[no-untyped-def]
    """Fill time, encoder, current and effort of the reading after `steps` steps."""
    p, s = pointer_f8(handle[H_PARAMETERS]), pointer_f8(handle[H_STATE])
    y, out = pointer_f8(handle[H_OUTPUTS]), pointer_f8(handle[H_READING])
    position = q + p[P_ZERO] + y[SENSE_POSITION]
    if p[P_RESOLUTION] > 0.0:
        position = math.floor(position / p[P_RESOLUTION] + 0.5) * p[P_RESOLUTION]
    current = s[S_CURRENT] * (1.0 + y[SENSE_CURRENT_GAIN]) + p[P_CURRENT_OFFSET] + y[SENSE_CURRENT]
    out[R_TIME] = s[S_TIME_STEPS] * p[P_DT]
    out[R_VELOCITY] = (position - s[S_POSITION_READ]) / (steps * p[P_DT]) if steps > 0 else 0.0
    out[R_POSITION] = position
    out[R_CURRENT] = current
    out[R_EFFORT] = p[P_KT_NOMINAL] * p[P_RATIO] * current
    s[S_POSITION_READ] = position


@_compiled
def dry_friction(momentum, impulse, mobility):  # type: ignore[no-untyped-def]
    """Velocity after an implicit dry-friction impulse: sticks exactly, never reverses the motion.

    The proximal form of Coulomb's law (Moreau): the friction impulse is at most `impulse` (level x dt) and opposes the
    momentum.  mobility is one over the inertia: it is known before the momentum, and divisions take long.
    """
    change = max(impulse, 0.0)
    if momentum > change:
        return (momentum - change) * mobility
    if momentum < -change:
        return (momentum + change) * mobility
    return 0.0
