"""Inputs of a control law: indices of its flat float64 array, shared by the simulator and the controllers.

A control law is a function `control(x, p, s) -> voltage` of inputs x, parameters p and own states s (all float64
arrays), called once a control period.
"""

from __future__ import annotations

C_REFERENCE = 0  # rad at the pulley (or whatever the law takes as its reference)
C_POSITION = 1  # rad, encoder
C_VELOCITY = 2  # rad/s, encoder difference over the last period
C_CURRENT = 3  # A, measured, signed
C_PERIOD = 4  # s
C_TIME = 5  # s
N_CONTROL_INPUTS = 6
