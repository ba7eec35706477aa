"""`hannes motor`: the motor of a running hand on or off."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer
from hannes_description.errors import HannesError
from hannes_description.output import print_json

from .options import JsonOption


class Wanted(StrEnum):
    """What the motor shall be."""

    ON = "on"
    OFF = "off"


def motor(
    wanted: Annotated[Wanted | None, typer.Argument(help="on or off; without it the state is shown.")] = None,
    node: Annotated[str, typer.Option(help="Name of the lifecycle node.")] = "/hannes/motor_controller",
    timeout: Annotated[
        float, typer.Option(min=0.5, max=60.0, help="How long to look for it, in seconds.")
    ] = 5.0,
    json: JsonOption = False,
) -> None:
    """Show, or switch, whether a controller drives the motor; also after a pause has switched it off.

    The controller's lifecycle services do it, as `ros2 lifecycle set NODE activate` does: integrators begin cleared.
    """
    from hannes_bringup.environment import apply_ros_environment, require_ros

    require_ros()
    apply_ros_environment()
    from hannes_bringup.motor_switch import switch

    state = switch(node, None if wanted is None else wanted is Wanted.ON, timeout)
    if json:
        print_json({"node": node, "state": state, "motor": "on" if state == "active" else "off"})
    else:
        typer.echo(f"{node} is {state}: the motor is {'on' if state == 'active' else 'off'}.")
    if wanted is not None and (state == "active") is not (wanted is Wanted.ON):
        raise HannesError(f"{node} stayed {state}; what it prints, and `hannes nodes`, say why.")
