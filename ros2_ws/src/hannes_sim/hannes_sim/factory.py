"""Plants and controllers by the names that a model file gives."""

from __future__ import annotations

from typing import Any

from hannes_description.errors import HannesError
from hannes_description.model import Model

from .effect import load_class
from .objects import GraspObject
from .plant import DEFAULT_DT, Plant

PLANTS = ("reduced", "mujoco")


def is_plant(name: str) -> bool:
    """True for what a model file may name as its plant: one that ships, or a user's own `path.py:Class`."""
    return name in PLANTS or ":" in name


def make_plant(model: Model, grasp: GraspObject | None = None, *, dt: float | None = None) -> Plant:
    """The plant of a model: `reduced`, `mujoco`, or a user's own `path.py:Class` called with (model, grasp, dt=...)."""
    step = DEFAULT_DT if dt is None else dt
    if model.plant == "reduced":
        from .reduced import ReducedPlant

        return ReducedPlant(model, grasp, dt=step)
    if model.plant == "mujoco":
        from .mujoco_plant import MujocoPlant

        return MujocoPlant(model, grasp, dt=step)
    if ":" in model.plant:
        file, _, name = model.plant.rpartition(":")
        plant: Any = load_class(file, name, "plant")(model, grasp, dt=step)
        return plant  # type: ignore[no-any-return]
    raise HannesError(
        f"Model '{model.name}': unknown plant '{model.plant}'; valid are {', '.join(PLANTS)}, or "
        "path.py:Class for your own."
    )
