"""Names, order and limits of the hand's joints, and the scale of the encoder.

Flexion is positive; every angle is in rad. The order of `JOINT_NAMES` is the order of `joint_positions` everywhere.
Sources: joint layout and limits from the Hannes multi-body thesis (links, limits, gearing); the encoder count is a
hypothesis fitted to the thesis' figures (65536 counts a turn of a magnet behind a further 3.8:1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi, radians
from types import MappingProxyType
from typing import Final

FINGERS: Final[tuple[str, ...]] = ("index", "middle", "ring", "little")
"""The four long fingers, radial to ulnar; each has the joints abd, mcp and pip."""

DIGITS: Final[tuple[str, ...]] = (*FINGERS, "thumb")
"""The fingers and the thumb (the thumb's only moving joint is abd; its rotation is locked at a stop)."""

JOINT_NAMES: Final[tuple[str, ...]] = (
    *(f"{finger}_{joint}" for finger in FINGERS for joint in ("abd", "mcp", "pip")),
    "thumb_abd",
)
"""The 13 joints in the order of `joint_positions`."""

ENCODER_JOINT: Final[str] = "motor_pulley"
"""Name in motor/state of the pulley on which the master wire winds."""

RAD_PER_COUNT: Final[float] = 2.0 * pi * 3.8 / 65536.0
"""Pulley angle per encoder count, rad (hypothesis fitted to the thesis: 40000 counts = 14.57 rad)."""

THUMB_STOPS_DEG: Final[tuple[int, ...]] = (0, -30, -60)
"""Angles at which the thumb's rotation can be locked, degrees."""


@dataclass(frozen=True)
class JointLimit:
    """Range of one joint, rad; `lower` < `upper`."""

    lower: float
    upper: float


def _limits() -> dict[str, JointLimit]:
    table: dict[str, JointLimit] = {}
    for finger in FINGERS:
        table[f"{finger}_abd"] = JointLimit(-radians(5.0), radians(5.0))
        table[f"{finger}_mcp"] = JointLimit(0.0, radians(82.0))
        table[f"{finger}_pip"] = JointLimit(0.0, radians(60.0 if finger == "little" else 50.0))
    table["thumb_abd"] = JointLimit(0.0, radians(60.0))
    return table


JOINT_LIMITS: Final[Mapping[str, JointLimit]] = MappingProxyType(_limits())
"""Limits of every joint by name, rad (thesis: ABD +-5, MCP 0..82, PIP 0..50, little 0..60, thumb ABD 0..60 degrees)."""
