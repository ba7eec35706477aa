"""Features of a window and of the grasp so far: what one sample cannot tell, in one compiled function.

The machine code is the same for a stream (one call a sample) and for whole arrays (`window_series`).

Why these. A motor that presses an object slowly is in balance, kt i = M(friction, springs) + k (q - q_contact): the
current over the encoder's increment is the object's stiffness in series with the wire, whatever the hand's own
friction M is, and what the current was before the contact is M. So a closure keeps

- its free level, the mean of the load current while the hand still closed freely. The load current is the current less
  what the nominal hand needs to accelerate, to turn and to stretch its springs (`INERTIA`, `VISCOUS`, `SPRING`), so
  that a closure's start is not taken for an object;
- its contact, the last sample at which the load current was within `LIFT` of that level;
- the line load current over encoder since the contact, while the encoder goes on closing (least squares), its steepest
  parts, and how far the two have come; and the same with a damper beside the spring (Kelvin-Voigt);
- the line load current over encoder before the contact, and how far the load current is above it now.

A closure begins where the reference rises after it had fallen by `FALL` (a ripple is no new closure). Slopes are given
as log(1 + x / scale) with the sign of x: they range over three decades.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

WINDOW_NAMES = (
    "current",
    "reference",
    "encoder",
    "current_mean",
    "current_slope",
    "current_step",
    "current_range",
    "encoder_velocity",
    "reference_velocity",
    "tracking_error",
    "tracking_error_rate",
    "current_per_encoder",
    "current_per_encoder_step",
    "free_level",
    "above_contact",
    "contact_encoder",
    "contact_velocity",
    "time_since_contact",
    "travel_since_contact",
    "rise_per_travel",
    "loading_line",
    "steepest_slope",
    "steepest_per_encoder",
    "largest_rise",
    "largest_travel",
    "loading_share",
    "load_current",
    "load_above_free",
    "load_rise",
    "load_secant",
    "acceleration",
    "closing_time",
    "viscoelastic_stiffness",
    "viscoelastic_damping",
    "free_slope",
    "load_above_free_line",
)
"""Currents A; angles rad at the pulley; velocities rad/s; times s; per-encoder figures and slopes as logarithms."""

SAMPLES = 7
"""Samples of a window: 200 ms at 30 Hz."""
LIFT = 0.05
"""Rise of the load current above the free level, A, from which there is a load."""
INERTIA, VISCOUS, SPRING = 1.55e-3, 3.3e-3, 9.4e-3
"""Current of a free closure per rad/s2, rad/s and rad: least squares over closures of both nominal hands on nothing."""
FORGET = 0.25
"""Weight of the newest sample in the free level."""
FALL = 3.0
"""Fall of the reference, rad, after which a rise is a new closure: a fifth of a full one."""
LONGEST = 2.0
"""Longest time since the contact that is told apart, s."""
_RISES, _RESTS = 0.5, 0.05
"""Rates of the reference, rad/s, above which it rises and below which it may rise again (hysteresis)."""
_CLOSES = 0.3
"""Encoder velocity, rad/s, above which the hand closes."""
_SLOPE, _RATIO, _DAMPING = 0.2, 0.01, 0.01
"""Scales of the logarithms: A/s, A/rad, A s/rad."""
_RIDGE_Q, _RIDGE_V, _RIDGE_FREE = 1e-3, 1e-2, 1.0
"""What a sample adds to the squares of travel (rad2), velocity (rad2/s2) and free travel (rad2), so that a fit without
spread gives nothing rather than anything."""

# Places in the state
_COUNT, _RISING, _PEAK, _ONSET, _FREE, _LOADED, _Q0, _I0, _T0, _V0, _STEEP, _STEEP_Q, _RISE, _TRAVEL, _N, _SQ, _SI, \
    _SQQ, _SQI, _SEEN, _LOAD0, _LOAD_RISE, _SZZ, _SQZ, _SZI, _FN, _FQ, _FI, _FQQ, _FQI = range(30)  # fmt: skip
_RING = 30
STATE = _RING + 4 * SAMPLES


def new_window_state() -> NDArray[np.float64]:
    """The state before the first sample."""
    state = np.zeros(STATE)
    _begin(state, -np.inf, -np.inf)
    return state


@njit(cache=True)
def _begin(s: Any, onset: float, peak: float) -> None:
    """A closure begins: forget the last one's grasp."""
    s[_ONSET], s[_PEAK] = onset, peak
    s[_FREE] = 0.0
    for k in range(_LOADED, _RING):
        s[k] = 0.0


@njit(cache=True)
def _logarithm(x: float, scale: float) -> float:
    return math.copysign(math.log1p(abs(x) / scale), x)


@njit(cache=True)
def _place(back: int, s: Any) -> int:
    """Where in the state the sample before so many others stands: time, current, reference, encoder."""
    return int(_RING + 4 * ((int(s[_COUNT]) - 1 - back) % SAMPLES))


@njit(cache=True)
def _take(s: Any, t: float, i: float, r: float, q: float) -> None:
    """One more sample; where the reference sets off again, a closure begins."""
    if s[_COUNT] > 0.0:
        last = _place(0, s)
        rate = (r - s[last + 2]) / (t - s[last])
        if rate > _RISES and s[_RISING] == 0.0:
            s[_RISING] = 1.0
            if s[_PEAK] - s[last + 2] >= FALL or s[_ONSET] == -np.inf:
                _begin(s, t, r)
        elif rate <= _RESTS:
            s[_RISING] = 0.0
    s[_PEAK] = max(s[_PEAK], r)
    s[_COUNT] += 1.0
    at = _place(0, s)
    s[at], s[at + 1], s[at + 2], s[at + 3] = t, i, r, q


@njit(cache=True)
def _over_window(s: Any, m: int) -> tuple[float, float, float, float, float, float]:
    """Of the newest m samples: mean and range of the current, least-squares slopes of current, reference and encoder
    over time, and of current over encoder."""
    mt = mi = mr = mq = 0.0
    low, high = 1e9, -1e9
    for k in range(m):
        a = _place(k, s)
        mt += s[a]
        mi += s[a + 1]
        mr += s[a + 2]
        mq += s[a + 3]
        low, high = min(low, s[a + 1]), max(high, s[a + 1])
    mt, mi, mr, mq = mt / m, mi / m, mr / m, mq / m
    tt = ti = tr = tq = qq = qi = 0.0
    for k in range(m):
        a = _place(k, s)
        dt, di, dr, dq = s[a] - mt, s[a + 1] - mi, s[a + 2] - mr, s[a + 3] - mq
        tt += dt * dt
        ti += dt * di
        tr += dt * dr
        tq += dt * dq
        qq += dq * dq
        qi += dq * di
    ratio = qi / max(qq, m * 1e-4)
    if m < 2:
        return mi, high - low, 0.0, 0.0, 0.0, ratio
    return mi, high - low, ti / tt, tr / tt, tq / tt, ratio


@njit(cache=True)
def _last_step(s: Any, m: int) -> tuple[float, float]:
    """Change of the current over the last step, per time and per encoder."""
    if m < 2:
        return 0.0, 0.0
    a, b = _place(0, s), _place(1, s)
    change = s[a + 1] - s[b + 1]
    # A hundredth of a radian is thirty counts: below it the encoder stands, and the ratio says nothing more.
    return change / (s[a] - s[b]), change / max(abs(s[a + 3] - s[b + 3]), 0.01)


@njit(cache=True)
def _motion(s: Any, m: int, velocity: float) -> tuple[float, float]:
    """Velocity and acceleration by a parabola through the newest samples, in the middle of the last step, which is what
    an averaged current belongs to; that velocity, and none, of too few samples."""
    if m < 4:
        return velocity, 0.0
    used, a0 = min(m, 5), _place(0, s)
    s1 = s2 = s3 = s4 = y0 = y1 = y2 = 0.0
    for k in range(used):
        a = _place(k, s)
        x, y = s[a] - s[a0], s[a + 3] - s[a0 + 3]
        s1 += x
        s2 += x * x
        s3 += x * x * x
        s4 += x * x * x * x
        y0 += y
        y1 += x * y
        y2 += x * x * y
    c2, c3, c4 = s2 - s1 * s1 / used, s3 - s1 * s2 / used, s4 - s2 * s2 / used
    d1, d2 = y1 - s1 * y0 / used, y2 - s2 * y0 / used
    determinant = c2 * c4 - c3 * c3
    if determinant <= 1e-18:
        return velocity, 0.0
    acceleration = 2.0 * ((c2 * d2 - c3 * d1) / determinant)
    back = 0.5 * (s[_place(1, s)] - s[a0])
    return (c4 * d1 - c3 * d2) / determinant + acceleration * back, acceleration


@njit(cache=True)
def _follow(
    s: Any,
    t: float,
    i: float,
    q: float,
    load: float,
    velocity: float,
    speed: float,
    steepest: float,
    ratio: float,
) -> None:
    """Take a sample of a closure into what is kept of its free way, its contact and the way from there."""
    first = s[_SEEN] == 0.0
    s[_SEEN] = 1.0
    if first:
        s[_FREE] = load
    above = load - s[_FREE]
    if first or (above < LIFT and (s[_LOADED] == 0.0 or velocity > _CLOSES)):
        if velocity > _CLOSES:
            s[_FREE] += FORGET * above
        s[_LOADED] = 0.0
        s[_Q0], s[_I0], s[_T0], s[_V0], s[_LOAD0] = q, abs(i), t, velocity, load
        s[_STEEP] = s[_STEEP_Q] = s[_RISE] = s[_TRAVEL] = s[_LOAD_RISE] = 0.0
        s[_N], s[_SQ], s[_SI], s[_SQQ], s[_SQI] = 1.0, 0.0, 0.0, 0.0, 0.0
        s[_SZZ], s[_SQZ], s[_SZI] = 0.0, 0.0, 0.0
        if velocity > _CLOSES:
            s[_FN] += 1.0
            s[_FQ] += q
            s[_FI] += load
            s[_FQQ] += q * q
            s[_FQI] += q * load
    elif q - s[_Q0] >= s[_TRAVEL] or load - s[_LOAD0] > s[_LOAD_RISE]:
        s[_LOADED] = 1.0
        x, y = q - s[_Q0], load - s[_LOAD0]
        s[_TRAVEL], s[_LOAD_RISE] = max(s[_TRAVEL], x), max(s[_LOAD_RISE], y)
        s[_RISE] = max(s[_RISE], abs(i) - s[_I0])
        s[_STEEP] = max(s[_STEEP], steepest)
        s[_STEEP_Q] = max(s[_STEEP_Q], ratio)
        s[_N] += 1.0
        s[_SQ] += x
        s[_SI] += y
        s[_SQQ] += x * x
        s[_SQI] += x * y
        s[_SZZ] += speed * speed
        s[_SQZ] += x * speed
        s[_SZI] += speed * y


@njit(cache=True)
def _since_contact(s: Any) -> tuple[float, float, float]:
    """Slope of the load current over the way since the contact; and of a spring with a damper beside it, load = k
    travel + c velocity, both: a damped plush that is closed on fast feels rigid."""
    number = max(s[_N], 1.0)
    spread = s[_SQQ] - s[_SQ] * s[_SQ] / number
    line = (s[_SQI] - s[_SQ] * s[_SI] / number) / max(spread, number * 1e-4)
    xx, zz = s[_SQQ] + _RIDGE_Q * number, s[_SZZ] + _RIDGE_V * number
    determinant = xx * zz - s[_SQZ] * s[_SQZ]
    spring = (s[_SQI] * zz - s[_SZI] * s[_SQZ]) / determinant
    damper = (s[_SZI] * xx - s[_SQI] * s[_SQZ]) / determinant
    return line, spring, damper


@njit(cache=True)
def _before_contact(s: Any, q: float, load: float) -> tuple[float, float]:
    """Slope of the load current over the encoder on the way there (with a glove or a spring it rises without an
    object), and how far a load is above that line."""
    frees = max(s[_FN], 1.0)
    mean_q, mean_load = s[_FQ] / frees, s[_FI] / frees
    rise = (s[_FQI] - frees * mean_q * mean_load) / (s[_FQQ] - frees * mean_q * mean_q + _RIDGE_FREE * frees)
    expected = mean_load + rise * (q - mean_q) if s[_FN] > 0.0 else load
    return rise, load - expected


@njit(cache=True)
def window_features(s: Any, t: float, i: float, r: float, q: float, mask: float, out: Any) -> bool:
    """Take one sample into the state s and write its features (len(WINDOW_NAMES),) to out.

    t s; i A; r, q rad; mask s. True where the start of a closure makes the sample void.
    """
    t, i, r, q = float(t), float(i), float(r), float(q)
    _take(s, t, i, r, q)
    m = min(int(s[_COUNT]), SAMPLES)
    mean, extent, slope, reference_velocity, velocity, ratio = _over_window(s, m)
    step, step_q = _last_step(s, m)
    speed, acceleration = _motion(s, m, velocity)
    load = abs(i) - INERTIA * acceleration - VISCOUS * speed - SPRING * q
    blind = t - s[_ONSET] < mask
    if not blind:
        _follow(s, t, i, q, load, velocity, speed, max(slope, step), ratio)
    line, spring, damper = _since_contact(s)
    rise, above_line = _before_contact(s, q, load)
    seen = s[_SEEN] > 0.0
    free = s[_FREE] if seen else load
    above = abs(i) - s[_I0] if seen else 0.0
    travel = q - s[_Q0] if seen else 0.0
    # In the order of WINDOW_NAMES; a longer tuple is none to numba.
    window = (
        i,
        r,
        q,
        mean,
        _logarithm(slope, _SLOPE),
        _logarithm(step, _SLOPE),
        extent,
        velocity,
        reference_velocity,
        r - q,
        reference_velocity - velocity,
        _logarithm(ratio, _RATIO),
        _logarithm(step_q, _RATIO),
    )
    grasp = (
        free,
        above,
        s[_Q0],
        s[_V0],
        min(t - s[_T0], LONGEST) if seen else 0.0,
        travel,
        _logarithm(above / max(abs(travel), 0.01), _RATIO),
        _logarithm(line, _RATIO),
        _logarithm(s[_STEEP], _SLOPE),
        _logarithm(s[_STEEP_Q], _RATIO),
        s[_RISE],
        s[_TRAVEL],
        (abs(i) - s[_I0]) / max(s[_RISE], 0.02),
        load,
        load - free,
        s[_LOAD_RISE],
        _logarithm(s[_LOAD_RISE] / max(s[_TRAVEL], 0.02), _RATIO),
        acceleration,
        min(t - s[_ONSET], 2.0 * LONGEST),
        _logarithm(spring, _RATIO),
        _logarithm(damper, _DAMPING),
        rise,
        above_line,
    )
    for k in range(len(window)):
        out[k] = window[k]
    for k in range(len(grasp)):
        out[len(window) + k] = grasp[k]
    return blind


@njit(cache=True)
def window_series(t: Any, i: Any, r: Any, q: Any, ticks: Any, mask: float, width: int) -> Any:
    """Features (n, width) and blind (n,) of whole arrays (n,); a sample that is no tick leaves no trace."""
    state = np.zeros(STATE)
    _begin(state, -np.inf, -np.inf)
    values, blind = np.empty((len(t), width)), np.empty(len(t), dtype=np.bool_)
    for k in range(len(t)):
        used = state if ticks[k] else state.copy()
        blind[k] = window_features(used, t[k], i[k], r[k], q[k], mask, values[k])
    return values, blind
