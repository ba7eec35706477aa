"""The motor's drive, whatever tells it when: the law on inputs that were judged, a profile of its own, the command."""

from __future__ import annotations

from collections.abc import Callable

from hannes_description.errors import HannesError
from hannes_ros import convert
from hannes_ros.diagnostics import Health

from ..double_pid import DoublePID
from ..reference import Profile
from .motor_inputs import MotorInputs

Send = Callable[[bytes], None]
ZERO = convert.float64_bytes(0.0)


class MotorDrive:
    """Commands the motor.

    pid      the law
    inputs   what it is told
    profile  reference (n,) in rad of its own, None where a topic gives it
    send     publishes motor/voltage
    show     publishes the reference of a profile of its own: who records wants it on its topic
    """

    def __init__(
        self,
        pid: DoublePID,
        inputs: MotorInputs,
        profile: Profile | None,
        health: Health,
        send: Send,
        show: Send | None,
    ) -> None:
        self.inputs, self.health = inputs, health
        self.follows_topic = profile is None
        self._pid, self._limit = pid, pid.settings.voltage_limit
        self._profile, self._send, self._show = profile, send, show

    @property
    def saving(self) -> bool:
        """Whether the law saves the battery just now."""
        return self._pid.saving

    def clear(self) -> None:
        """Integrators and timers of the law at 0."""
        self._pid.reset()
        self.health.count("resets")

    def profile_at(self, tick: int) -> float:
        """Reference (rad) of a tick of the profile, its ends before and after; shown."""
        assert self._profile is not None and self._show is not None
        reference = float(self._profile[min(max(tick, 0), self._profile.size - 1)])
        self._show(convert.float64_bytes(reference))
        return reference

    def drive(self, reference: float | None, position: float, current: float) -> None:
        """Command the voltage that the law wants."""
        self._publish(self._voltage(reference, position, current))

    def coast(self) -> None:
        """Command 0 V as a cycle of the loop: there is nothing to drive on."""
        self._publish(0.0)

    def end(self) -> None:
        """Command 0 V, the last one."""
        self._send(ZERO)

    def _publish(self, voltage: float) -> None:
        self._send(convert.float64_bytes(voltage))
        self.health.cycles += 1

    def _voltage(self, reference: float | None, position: float, current: float) -> float:
        """Voltage (V), clamped; a sensor that is not finite, or beyond what the hand has, gives 0 V and a cleared
        controller, no reference 0 V."""
        if reference is None:
            return 0.0
        if not self.inputs.believable(position, current):
            self.clear()
            return 0.0
        try:
            voltage = self._pid.update(reference, position, current)
        except HannesError:
            self.clear()
            return 0.0
        return min(max(voltage, -self._limit), self._limit)
