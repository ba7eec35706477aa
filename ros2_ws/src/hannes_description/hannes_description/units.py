"""Units as text, such as N.m.s/rad or rad/(N.m): which of them mean the same."""

from __future__ import annotations

import re
from collections.abc import Container
from functools import lru_cache

_SI = {
    "N.m": (1, 2, -2, 0),
    "kg.m2": (1, 2, 0, 0),
    "N": (1, 1, -2, 0),
    "V": (1, 2, -3, -1),
    "ohm": (1, 2, -3, -2),
    "H": (1, 2, -2, -2),
    "kg": (1, 0, 0, 0),
    "m": (0, 1, 0, 0),
    "s": (0, 0, 1, 0),
    "A": (0, 0, 0, 1),
    "rad": (0, 0, 0, 0),
}
"""Exponents of kg, m, s and A: units of SI that have the same are the same, as N.m/A and V.s/rad are."""


@lru_cache(maxsize=1024)
def tokens(unit: str) -> tuple[tuple[str, float], ...]:
    """Base units of a unit such as N.m.s/rad or rad/(N.m), with exponents."""
    out: list[tuple[str, float]] = []
    marked = unit.replace("kg.m2", "J").replace("N.m", "T")
    for part, sign in zip(marked.split("/"), (1.0, *[-1.0] * marked.count("/")), strict=True):
        for token in part.strip("()").split("."):
            match = re.fullmatch(r"([A-Za-z]+)(\d*)", token)
            if match:
                power = sign * float(match.group(2) or 1)
                name = {"T": "N.m", "J": "kg.m2"}.get(match.group(1), match.group(1))
                out.append((name, power))
    return tuple(out)


def same_unit(unit: str, other: str) -> bool:
    """Whether a number means the same in both units."""

    def powers(unit: str) -> list[float] | None:
        found = tokens(unit)
        if (unit != "1" and not found) or any(token not in _SI for token, _ in found):
            return None
        return [sum(power * _SI[token][k] for token, power in found) for k in range(4)]

    return unit == other or (powers(unit) is not None and powers(unit) == powers(other))


def linear_unit(unit: str) -> str:
    """The unit of the same quantity where the drive is linear: N for N.m, m for rad."""
    for a, b in (("kg.m2", "kg"), ("(N.m)", "N"), ("N.m", "N"), ("rad", "m")):
        unit = unit.replace(a, b)
    return unit


def in_volts(parameters: Container[str]) -> bool:
    """Whether the command of a drive of these parameters is a voltage, against resistance and back-EMF."""
    return "motor.resistance" in parameters and "motor.emf_compensated" not in parameters


def any_unit(unit: str, parameters: Container[str]) -> bool:
    """Whether a drive of these parameters may give such a quantity in whatever its command is in.

    Without a resistance or a back-EMF the command may be a current or a torque, and nothing is in volts or amperes.
    """
    return not in_volts(parameters) and any(token in ("V", "A", "ohm") for token, _ in tokens(unit))
