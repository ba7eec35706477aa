"""Indices of the flat float64 arrays that plants, effects and control laws exchange.

Everything is in SI units with angles in rad at the motor pulley.  The constants are plain integers so that the
same function reads `x[V]` in Python and in compiled code.
"""

from __future__ import annotations

# Inputs of an effect: x[...]
T = 0  # s, time since reset
DT = 1  # s, integration step
Q = 2  # rad, motor side position
V = 3  # rad/s, motor side velocity
QL = 4  # rad, load side of the wire, referred to the pulley
VL = 5  # rad/s, load side velocity
CURRENT = 6  # A, true signed motor current
VOLTAGE = 7  # V, commanded terminal voltage, after delay and limit
LOAD = 8  # N.m, torque that the wire transmits (tension x pulley radius)
CONTACT = 9  # N.m, object torque referred to the pulley
RESISTANCE = 10  # ohm, nominal terminal resistance
SUPPLY = 11  # V, nominal supply
N_INPUTS = 12

# Outputs of an effect: y[...], zeroed before every step, summed over the effects
TORQUE = 0  # N.m, added to the motor side
FRICTION = 1  # N.m, added to the dry friction level of the motor side
DAMPING = 2  # N.m.s/rad, added to the viscous coefficient of the motor side
INERTIA = 3  # kg.m2, added to the inertia of the motor side
LOAD_TORQUE = 4  # N.m, added to the load side
LOAD_FRICTION = 5  # N.m, added to the dry friction level of the load side
LOAD_DAMPING = 6  # N.m.s/rad, added to the viscous coefficient of the load side
SLACK = 7  # rad, added to the free length of the wire
COMPLIANCE = 8  # rad/(N.m), added to the compliance of the wire
VOLTAGE_DROP = 9  # V, subtracted from the terminal voltage
RESISTANCE_REL = 10  # 1, relative change of the resistance
KT_REL = 11  # 1, relative change of the torque (and back-EMF) constant
SENSE_POSITION = 12  # rad, added to the measured position
SENSE_CURRENT = 13  # A, added to the measured current
SENSE_CURRENT_GAIN = 14  # 1, relative change of the current sensor's gain
DELAY = 15  # s, added to the delay of the command
OBJECT_DAMPING = 16  # N.m.s/rad, added to the damping of the object
BRUSH = 17  # V, added to the dry voltage drop against the current (solved implicitly)
N_OUTPUTS = 18

# What can be read from a plant after each advance: reading[...]
R_TIME = 0  # s
R_POSITION = 1  # rad, encoder (with sensor effects and quantiser)
R_VELOCITY = 2  # rad/s, difference of the encoder over the last advance
R_CURRENT = 3  # A, current sensor, signed
R_EFFORT = 4  # N.m, nominal kt x ratio x measured current
R_FORCE = 5  # N, total fingertip force on the object
R_Q = 6  # rad, true motor side position
R_QL = 7  # rad, true load side position
R_LOAD = 8  # N.m, true transmitted torque
R_VL = 9  # rad/s, true load side velocity
R_WARNING = 10  # 0 fine, UNDEFINED, or another number of the plant's where it diverged
R_JOINTS = 11  # rad, 13 finger joints, then 13 velocities in rad/s
N_JOINTS = 13
N_READING = R_JOINTS + 2 * N_JOINTS

UNDEFINED = 1e6  # in R_WARNING: an effect gave NaN or infinity

# Handle of a plant: int64 addresses of its buffers
H_PARAMETERS = 0  # float64
H_STATE = 1  # float64
H_READING = 2  # float64, N_READING
H_INPUTS = 3  # float64, N_INPUTS
H_OUTPUTS = 4  # float64, N_OUTPUTS
H_EFFECTS = 5  # int64: count, then (function, parameters, states) for each effect
H_DELAY = 6  # float64: ring of past commands
N_HANDLE_COMMON = 7  # a plant may append entries of its own

# Parameters that every plant has in common: parameters[...]
P_DT = 0  # s
P_SUPPLY = 1  # V
P_RESISTANCE = 2  # ohm
P_INDUCTANCE = 3  # H
P_KT = 4  # N.m/A (and V.s/rad), at the motor shaft
P_RATIO = 5  # motor turns per pulley turn
P_EFFICIENCY = 6  # gear efficiency on the torque
P_INERTIA = 7  # kg.m2, rotor and gear at the pulley
P_RESOLUTION = 8  # rad, encoder quantum; 0 = off
P_ZERO = 9  # rad, encoder zero error
P_CURRENT_OFFSET = 10  # A, current sensor offset
P_DELAY = 11  # s, delay of the command
P_KT_NOMINAL = 12  # N.m/A, what the motor board believes
P_EMF_COMPENSATED = 13  # 1, part of the back-EMF that the amplifier makes up for; 0 = voltage drive
N_PARAMETERS_COMMON = 14

# State that every plant has in common: state[...]
S_TIME_STEPS = 0  # number of steps since reset (exact in float64)
S_CURRENT = 1  # A
S_LOAD = 2  # N.m of the last step
S_CONTACT = 3  # N.m of the last step
S_POSITION_READ = 4  # rad, last encoder reading
S_DELAY_INDEX = 5  # write position in the ring of commands
S_RATE = (
    6  # dt over the electrical time constant of the last step; it seldom changes, and what follows takes long
)
S_DECAY = 7  # exp(-rate)
S_MEAN = 8  # (1 - exp(-rate)) / rate
S_UNDEFINED = 9  # 1 once an effect gave NaN or infinity
N_STATE_COMMON = 10

DELAY_RING = 512  # commands kept; the longest delay is DELAY_RING x dt
