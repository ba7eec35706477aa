"""A load on an elastic shaft, belt or rope: an effect of one's own (`--effect elastic_load.py:ElasticLoad`).

Set INERTIA and FREQUENCY to what your machine may have, in the units in which its plant counts; a diagnosis that says
"oscillates at 5.7 Hz in all conditions" gives the second.
"""

import math

from hannes_sim.effect import Effect, EffectParameter
from hannes_sim.ports import DT, TORQUE, Q, V
from hannes_sim.ports import INERTIA as ADDED_INERTIA

INERTIA = 0.04
"""kg.m2 of the load (kg on a linear rig), less than `motor.armature` x `gear.ratio`², of which it is a part."""

FREQUENCY = 6.0
"""Hz of the load while the motor is held."""


class ElasticLoad(Effect):
    """A part J of the moving mass hangs on a spring and damper instead of being rigid.

    Equation: J y'' = k (q - y) + c (q' - y'), k = J (2 pi f)^2, c = 2 d J 2 pi f; the motor is without J, and feels the
    same force in return (two-mass resonance).  Slow motion is that of the rigid machine.
    Limits: one mode; the load's own friction is left with the motor.
    """

    name = "elastic_load"
    title = "load on an elastic shaft"
    parameters = (
        EffectParameter("inertia", "kg.m2", 0.0, 1.9 * INERTIA, INERTIA, 0.0, "part J of it that is elastic"),
        EffectParameter(
            "frequency", "Hz", 0.2 * FREQUENCY, 5.0 * FREQUENCY, FREQUENCY, None, "f, motor held"
        ),
        EffectParameter("damping", "1", 0.0, 1.0, 0.05, None, "d of the aperiodic limit", part=True),
    )
    states = 3
    looks_like = "position and current swing after each change of speed, at one frequency whatever the speed"
    told_by = "quick starts and stops, logged fast"

    @staticmethod
    def contribute(x, p, s, y):
        if s[2] == 0.0:
            s[0], s[2] = x[Q], 1.0
        rate = 2.0 * math.pi * p[1]
        spring, damper = rate * rate, 2.0 * p[2] * rate
        force = spring * (x[Q] - s[0]) + damper * (x[V] - s[1])
        y[TORQUE] -= p[0] * force
        y[ADDED_INERTIA] -= p[0]
        # One force on both masses, velocities before places, as the plant does: no damping of the integration's own.
        s[1] += x[DT] * force
        s[0] += x[DT] * s[1]
