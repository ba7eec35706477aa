"""What a recording may say of itself in its metadata (`custom_data` of metadata.yaml), and what each entry may be."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from hannes_description.errors import HannesError
from hannes_sim.objects import GraspObject, named_object

if TYPE_CHECKING:
    from hannes_sim.measurement import Sensors

ZERO_ORDER_HOLD_RATE = 90.0
STRANGE_HOLD_RATE = 225.0
"""Hz; a reference logged at least this fast is what the controller received, message by message; a slower log has gaps
that are filled by a smooth curve.  The second is for recordings that do not say how they were logged."""

CONTROL_PERIOD = 1e-3
CONTROL_PERIODS = (1e-4, 1e-1)
"""s; that of a controller of which a recording says nothing, and the shortest and longest that may be said."""


def control_period(metadata: Mapping[str, Any], source: str) -> float:
    """Control period [s] that a recording's metadata say, or the usual one."""
    given = metadata.get("control_period", CONTROL_PERIOD)
    low, high = CONTROL_PERIODS
    if isinstance(given, bool) or not isinstance(given, int | float) or not low <= given <= high:
        raise HannesError(
            f"{source}: its `control_period` is {given!r}; it must be the period of the control loop in "
            f"seconds, {low:g} to {high:g}."
        )
    return float(given)


def hold_rate(metadata: Mapping[str, Any], source: str) -> float:
    """Hz from which on the reference is held from message to message: what the metadata say, or the usual one."""
    held = metadata.get("reference_held")
    if held is None:
        return ZERO_ORDER_HOLD_RATE if "sensors" in metadata else STRANGE_HOLD_RATE
    if not isinstance(held, bool):
        raise HannesError(
            f"{source}: its `reference_held` is {held!r}; it must be true (the controller holds each message "
            "until the next) or false (what was logged is a part of what it reads: filled by a smooth curve)."
        )
    return 0.0 if held else math.inf


def grasp_of(metadata: Mapping[str, Any], source: str) -> GraspObject | None:
    """What the metadata say was grasped: a name, a mapping, or nothing."""
    given = metadata.get("object")
    if given is None:
        return None
    if isinstance(given, str):
        return named_object(given)
    if isinstance(given, Mapping):
        return GraspObject.from_dict(given)
    raise HannesError(f"{source}: 'object' must be a name or a mapping, not {type(given).__name__}.")


def loggers_of(metadata: Mapping[str, Any], source: str) -> Sensors | None:
    """How the metadata say it was logged; None where they do not."""
    from hannes_sim.measurement import Sensors

    given = metadata.get("sensors")
    if given is None:
        return None
    if not isinstance(given, Mapping):
        raise HannesError(
            f'{source}: its `sensors` are {given!r}; they must be a mapping, such as {{"current_rectified": true}}.'
        )
    return Sensors.from_dict(given)


def _name(key: str) -> Callable[[Mapping[str, Any], str], None]:
    def check(metadata: Mapping[str, Any], source: str) -> None:
        given = metadata[key]
        if not (isinstance(given, str) and given.strip()):
            raise HannesError(f"{source}: its `{key}` is {given!r}; it must be a name.")

    return check


def _plant(metadata: Mapping[str, Any], source: str) -> None:
    """Of this project's, or the name of another simulator: one that is meant as the first and is none is refused."""
    from hannes_sim.factory import PLANTS

    _name("plant")(metadata, source)
    given = metadata["plant"].strip()
    if near := [
        name for name in PLANTS if name != given and get_close_matches(given.lower(), [name], 1, 0.8)
    ]:
        raise HannesError(f"{source}: its `plant` is '{given}'; did you mean {near[0]}?")


ENTRIES: Mapping[str, Callable[[Mapping[str, Any], str], object]] = MappingProxyType(
    {
        "condition": _name("condition"),
        "object": grasp_of,
        "sensors": loggers_of,
        "reference_held": hold_rate,
        "control_period": control_period,
        "plant": _plant,
    }
)
"""The entries that the lab reads, each with what raises HannesError where a value will not do."""


NAMES = ("condition", "plant")
"""Those that are a name, whatever it looks like."""


def check_entries(entries: Mapping[str, Any], source: str) -> None:
    """Refuse an entry that the lab does not read, or a value that it could not use; None says nothing of it."""
    for key, value in entries.items():
        if key not in ENTRIES:
            raise HannesError(
                f"{source}: the lab reads nothing called '{key}' in a recording's metadata; valid are "
                f"{', '.join(ENTRIES)}."
            )
        if value is not None:
            ENTRIES[key](entries, source)
