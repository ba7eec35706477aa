"""Gain and offset error of the current sensor."""

from typing import Any

from ..effect import Effect, EffectParameter
from ..ports import SENSE_CURRENT, SENSE_CURRENT_GAIN


class CurrentSensor(Effect):
    """The logged (and controlled) current is not the true one.

    Equation: i_measured = (1 + g) i + i_0.
    Limits: linear, no drift.
    """

    name = "current_sensor"
    title = "current-sensor gain and offset"
    parameters = (
        EffectParameter("gain", "1", -0.5, 0.5, 0.1, 0.0, "gain error g"),
        EffectParameter("offset", "A", -0.2, 0.2, 0.02, 0.0, "offset i_0"),
    )
    looks_like = "the current is not zero at rest; all currents scale"
    told_by = "the current at rest; a stall with a known force"

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        y[SENSE_CURRENT_GAIN] += p[0]
        y[SENSE_CURRENT] += p[1]
