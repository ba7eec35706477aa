"""What a plant is: it takes volts and gives measurements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from hannes_description.errors import HannesError
from numpy.typing import NDArray

from .ports import (
    N_JOINTS,
    R_CURRENT,
    R_EFFORT,
    R_FORCE,
    R_JOINTS,
    R_POSITION,
    R_TIME,
    R_VELOCITY,
)

DEFAULT_DT = 0.25e-3
"""s; the step for use. Identification and convergence checks halve it."""


POSITIVE = ("supply.voltage", "motor.kt", "motor.armature", "motor.resistance", "gear.ratio")
"""Parameters of a drive that is there: without one of them above 0 nothing moves, or everything at once."""

NOT_NEGATIVE = (
    "motor.inductance",
    "gear.efficiency",
    "encoder.resolution",
    "friction.coulomb",
    "friction.viscous",
    "wire.stiffness",
    "wire.damping",
    "hand.inertia",
    "hand.stiffness",
    "hand.coulomb",
    "hand.viscous",
    "hand.stop_stiffness",
)
"""Parameters of which less than 0 is no matter: it would give energy away."""


class PlantDiverged(HannesError, RuntimeError):
    """The simulation became unstable or non-finite; the message names the time and the coordinate."""


@dataclass(frozen=True)
class Reading:
    """What the sensors of a hand show at one instant.

    time s; position rad and velocity rad/s of the encoder, at the pulley; current A, signed; effort N.m (nominal
    kt x ratio x current); grip_force N; joint_positions (13,) rad and joint_velocities (13,) rad/s in the order of
    hannes_description.joints.JOINT_NAMES.
    """

    time: float
    position: float
    velocity: float
    current: float
    effort: float
    grip_force: float
    joint_positions: NDArray[np.float64]
    joint_velocities: NDArray[np.float64]

    @classmethod
    def of(cls, reading: NDArray[np.float64]) -> Reading:
        """From the flat reading buffer of a plant (ports.R_*)."""
        joints = reading[R_JOINTS : R_JOINTS + 2 * N_JOINTS].copy()
        return cls(
            float(reading[R_TIME]),
            float(reading[R_POSITION]),
            float(reading[R_VELOCITY]),
            float(reading[R_CURRENT]),
            float(reading[R_EFFORT]),
            float(reading[R_FORCE]),
            joints[:N_JOINTS],
            joints[N_JOINTS:],
        )


class Plant(Protocol):
    """A hand or another drive.

    dt             s, integration step
    address        address of the compiled `advance(handle, voltage, steps)`
    handle         int64 addresses of the plant's buffers (ports.H_*)
    reading        float64 (N_READING,), filled by every advance, but for the joints where show_joints gives them
    """

    dt: float
    address: int
    handle: NDArray[np.int64]
    reading: NDArray[np.float64]

    def reset(self) -> None:
        """Back to the open hand at rest; clears every state, so that a run repeats bit for bit."""

    def advance(self, voltage: float, steps: int) -> None:
        """Hold the voltage [V] for `steps` steps of dt; raises PlantDiverged, HannesError where an effect raises."""

    def show_joints(self, readings: NDArray[np.float64]) -> None:
        """Fill the finger joints of readings (n, N_READING) where `advance`, to be fast, left them out."""

    def read(self) -> Reading:
        """The sensors now."""

    def check(self) -> None:
        """Raise PlantDiverged if the last advance was not finite or not stable."""

    @property
    def names(self) -> tuple[str, ...]:
        """Dotted names of the parameters that `set` and `get` take."""

    def get(self, name: str) -> float:
        """The present value of a parameter."""

    def set(self, name: str, value: float) -> None:
        """Change one parameter (dotted name, or effect.parameter) without rebuilding."""
