"""Objects to grasp: shape, size, place, stiffness and damping."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from hannes_description.errors import HannesError

SHAPES = ("capsule", "sphere", "box", "prism", "pentagon")
"""prism and pentagon are regular prisms of six and five sides; all but the sphere lie across the fingers."""

LARGEST = 0.5
"""m; more than any hand opens."""


@dataclass(frozen=True)
class GraspObject:
    """An object held fixed in the palm's frame, as on a dynamometer.

    shape      capsule (a bar across the fingers), sphere, box, prism (six sides) or pentagon (five sides)
    size       m, what lies between fingertips and thumb when they touch it (diameter, thickness; of a prism the
               diameter of the circle through its edges)
    stiffness  N/m of the whole grasp, object and fingertip pads together; each of the five digits' contacts has a fifth
    damping    N.s/m
    friction   Coulomb coefficient
    place      m, offset of its centre in the palm frame from the middle of the grasp
    tolerance  standard deviation of what stiffness and damping may be at the pulley, as a part of them; 0: known; None
               where nobody said how well
    """

    shape: str = "capsule"
    size: float = 0.065
    stiffness: float = 400.0
    damping: float = 2.0
    friction: float = 0.8
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tolerance: float | None = None

    def __post_init__(self) -> None:
        if self.shape not in SHAPES:
            raise HannesError(f"Object shape {self.shape!r} is unknown; valid are {', '.join(SHAPES)}.")
        for name, low in (("size", 0.0), ("stiffness", 0.0), ("damping", -1e-12), ("friction", -1e-12)):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > low):
                raise HannesError(
                    f"Object {name} is {value}; it must be a finite number above {max(low, 0.0)}."
                )
        if self.size > LARGEST:
            raise HannesError(
                f"Object size is {self.size:g}; it is in m, and no hand grasps more than {LARGEST:g} m: "
                f"{self.size / 1000.0:g}, if these are mm."
            )
        if len(self.place) != 3 or not all(math.isfinite(c) for c in self.place):
            raise HannesError(f"Object place is {self.place}; it must be three finite numbers in m.")
        if self.tolerance is not None and not (math.isfinite(self.tolerance) and self.tolerance >= 0.0):
            raise HannesError(
                f"Object tolerance is {self.tolerance}; it must be 0 (known) or more, a part of stiffness and damping "
                "(0.2: within 20 %)."
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain types, for JSON; `tolerance` only where it is set."""
        out: dict[str, Any] = {
            "shape": self.shape,
            "size": self.size,
            "stiffness": self.stiffness,
            "damping": self.damping,
            "friction": self.friction,
            "place": list(self.place),
        }
        return out if self.tolerance is None else {**out, "tolerance": self.tolerance}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> GraspObject:
        unknown = sorted(set(content) - set(cls.__dataclass_fields__))
        if unknown:
            raise HannesError(
                f"Object: unknown keys {unknown}; valid are {', '.join(cls.__dataclass_fields__)}."
            )
        values = dict(content)
        try:
            if "place" in values:
                values["place"] = tuple(float(c) for c in values["place"])
            return cls(**values)
        except HannesError:
            raise
        except (TypeError, ValueError):
            raise HannesError(
                f"Object: {values} is not understood; shape is a word, place three numbers in m, all else a number."
            ) from None


SOFT_BALL = GraspObject(
    shape="sphere", size=0.080, stiffness=400.0, damping=2.0, place=(-0.012, -0.002, 0.004)
)
"""A ball that deforms visibly (thesis P18): about 0.4 kN/m in all; all fingers but the little one reach it."""

RIGID_DYNAMOMETER = GraspObject(shape="capsule", size=0.065, stiffness=40000.0, damping=20.0)
"""A hand dynamometer (thesis P17): at least 40 kN/m."""

OBJECTS: Mapping[str, GraspObject | None] = MappingProxyType(
    {"none": None, "soft": SOFT_BALL, "rigid": RIGID_DYNAMOMETER}
)
"""Objects by the names that nodes and the command line take."""


def named_object(name: str) -> GraspObject | None:
    """An object by name; None for `none`."""
    if name not in OBJECTS:
        raise HannesError(f"Unknown object '{name}'; valid are {', '.join(OBJECTS)}.")
    return OBJECTS[name]
