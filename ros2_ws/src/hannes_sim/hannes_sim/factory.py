"""Plants and controllers by the names that a model file gives."""

from __future__ import annotations

from typing import Any

from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.units import any_unit, linear_unit, same_unit

from .effect import call_own, effect_of, load_class
from .objects import GraspObject
from .plant import DEFAULT_DT, Plant

PLANTS = ("reduced", "mujoco")


def is_plant(name: str) -> bool:
    """True for what a model file may name as its plant: one that ships, or a user's own `path.py:Class`."""
    return name in PLANTS or ":" in name


def check_effects(model: Model) -> None:
    """Raise a HannesError for an effect of the model with wrong parameters, or one in a unit that is not its own."""
    parameters = model.parameters
    inertia = parameters["motor.armature"].unit if "motor.armature" in parameters else "kg.m2"
    # A lead screw's ratio is in rad/m, and leaves the rotor's inertia in kg.m2.
    linear = same_unit(inertia, "kg") or (
        "gear.ratio" in parameters and same_unit(parameters["gear.ratio"].unit, "1/m")
    )
    # A machine of one's own plant, or a linear one that counts in grams, has the units that go together.
    checked = model.plant in PLANTS and (linear or same_unit(inertia, "kg.m2"))
    for entry in model.effects:
        own = {p.name: p.unit for p in effect_of(entry).figures()}
        for name, given in entry.parameters.items():
            wanted = linear_unit(own[name]) if linear else own[name]
            fits = same_unit(given.unit, wanted) or (linear and given.unit == own[name])
            if checked and not (fits or any_unit(wanted, parameters)):
                raise HannesError(
                    f"{parameters.origin(f'{entry.name}.{name}')}: effect '{entry.name}': {name} is in "
                    f"'{given.unit}'; it must be in '{wanted}': convert value, lower and upper."
                )


def make_plant(model: Model, grasp: GraspObject | None = None, *, dt: float | None = None) -> Plant:
    """The plant of a model: `reduced`, `mujoco`, or a user's own `path.py:Class` called with (model, grasp, dt=...)."""
    step = DEFAULT_DT if dt is None else dt
    check_effects(model)
    if model.plant == "reduced":
        if model.variant:  # which this plant has not, but a misspelt one is one here too
            from hannes_description.mjcf import Variant

            Variant.of(model.variant)
        from .reduced import ReducedPlant

        return ReducedPlant(model, grasp, dt=step)
    if model.plant == "mujoco":
        from .mujoco_plant import MujocoPlant

        return MujocoPlant(model, grasp, dt=step)
    if ":" in model.plant:
        file, _, name = model.plant.rpartition(":")
        kind = load_class(file, name, "plant")
        plant: Any = call_own(
            f"{name}(model, grasp, dt=...) in '{file}'", lambda: kind(model, grasp, dt=step)
        )
        members = [*Plant.__annotations__, *(n for n in vars(Plant) if not n.startswith("_"))]
        if missing := [n for n in members if not hasattr(plant, n)]:
            raise HannesError(
                f"The plant '{model.plant}' has no {', '.join(missing)}; a plant has {', '.join(members)} "
                "(hannes_sim/plant.py says what they are; a subclass of hannes_sim.reduced.ReducedPlant has them)."
            )
        return plant  # type: ignore[no-any-return]
    raise HannesError(
        f"Model '{model.name}': unknown plant '{model.plant}'; valid are {', '.join(PLANTS)}, or "
        "path.py:Class for your own."
    )
