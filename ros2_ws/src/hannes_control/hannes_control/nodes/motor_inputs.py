"""What the motor's controller is told, decoded and judged: what no hand gives is counted, reported, not driven on."""

from __future__ import annotations

import math
from time import monotonic

from hannes_description.errors import HannesError
from hannes_description.joints import RAD_PER_COUNT
from hannes_description.parameters import ParameterSet
from hannes_ros import convert
from hannes_ros.diagnostics import ERROR, WARN, Health

from ..reference import travel_of

INPUTS = ("encoder_position", "motor_current", "reference_position")
"""Signals that the controller hears; the last one only without a profile of its own."""

_STALLED = 3.0
"""Multiples of the current of the stalled motor above which a reading is none: driven backwards at full speed it draws
twice that."""


class MotorInputs:
    """Messages in, values out; what is wrong with them goes into a node's health.

    reference     rad, the last good one, None if there was none
    reference_at  s (monotonic), when that came; 0 if there was none
    impossible    readings that no hand gives, since that was last put to 0
    """

    def __init__(self, parameters: ParameterSet, health: Health) -> None:
        self._health = health
        self._travel = travel_of(parameters)
        known = {"supply.voltage", "motor.resistance"} <= set(parameters)
        self._most_current = (
            _STALLED * parameters.value("supply.voltage") / parameters.value("motor.resistance")
            if known
            else math.inf
        )
        self.reference: float | None = None
        self.reference_at = 0.0
        self.impossible = 0

    def believable(self, position: float, current: float) -> bool:
        """Whether the hand can be there, and draw that: its encoder may be zeroed anywhere along its way."""
        return self._is_place(position) and self._is_drawn(current)

    def _is_place(self, position: float) -> bool:
        return not (position < -self._travel or position > 2.0 * self._travel)

    def _is_drawn(self, current: float) -> bool:
        return not abs(current) > self._most_current

    def state(self, data: bytes) -> convert.JointSample | None:
        """A motor/state; None where it has not the joint."""
        try:
            sample = convert.MOTOR_STATE.decode(data)
        except HannesError as error:
            self.reject_state(ERROR, str(error))
            return None
        name, position = "position of motor/state", sample.position[0]
        if self._finite(name, position, ERROR, "0 V"):
            most = 2.0 * self._travel
            self._possible(
                name,
                self._is_place(position),
                f"{position:g} rad",
                f"{-self._travel:g} .. {most:g} rad: in rad?",
            )
        return sample

    def reject_state(self, level: bytes, why: str) -> None:
        """A motor/state is not used."""
        self._health.count("rejected_states")
        self._health.faults.bad("motor/state", level, f"motor/state is rejected: {why}")

    def current(self, data: bytes) -> float:
        """A motor/current, A."""
        current = convert.float64_value(data)
        if self._finite("motor/current", current, ERROR, "0 V"):
            self._possible(
                "motor/current",
                self._is_drawn(current),
                f"{current:g} A",
                f"{self._most_current:.3g} A: in A?",
            )
        return current

    def take_reference(self, data: bytes) -> float | None:
        """The reference (rad) from here on: within the hand's travel, beyond which the motor would stall or unwind.

        One that is not finite leaves the last good one, None if there was none.
        """
        value = convert.float64_value(data)
        instead = "0 V" if self.reference is None else "the last good one holds"
        if self._finite("reference_position", value, WARN, instead):
            self.reference, self.reference_at = self._limited(value), monotonic()
        return self.reference

    def _limited(self, reference: float) -> float:
        limited = min(max(reference, 0.0), self._travel)
        if abs(reference - limited) <= RAD_PER_COUNT:  # rounding
            self._health.faults.good("travel")
            return reference
        self._health.count("limited_references")
        self._health.faults.bad(
            "travel",
            WARN,
            f"reference_position of {reference:g} rad is limited to 0 .. {self._travel:g} rad, the travel of the hand",
        )
        return limited

    def _possible(self, name: str, is_so: bool, value: str, most: str) -> None:
        """Count and report an input that no hand gives: one in another unit would be driven against."""
        if is_so:
            self._health.faults.good(f"{name}, its range")
            return
        self._health.count("rejected_inputs")
        self.impossible += 1
        self._health.faults.bad(
            f"{name}, its range", ERROR, f"{name} of {value} is beyond what this hand has, {most} 0 V"
        )

    def _finite(self, name: str, value: float, level: bytes, instead: str) -> bool:
        """Whether an input is finite; if not it is counted and reported, with what is done instead."""
        if math.isfinite(value):
            self._health.faults.good(name)
            return True
        self._health.count("rejected_inputs")
        self._health.faults.bad(name, level, f"{name} is not finite ({value}): {instead}")
        return False
