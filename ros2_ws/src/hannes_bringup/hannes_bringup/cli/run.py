"""`hannes run`: the node graph, or one node."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Annotated

import typer
from hannes_description.errors import HannesError
from hannes_description.model import Model

from hannes_bringup.environment import require_ros, ros_environment
from hannes_bringup.ros2_standin import (
    find_command,
    has_real_ros2,
    launch,
    launch_path,
    parse_launch_arguments,
    share_folder,
)

NODES = {
    "hand_sim": "hannes_sim",
    "motor_controller": "hannes_control",
    "emg_reference": "hannes_control",
    "emg_source": "hannes_control",
    "stiffness_classifier": "hannes_stiffness",
    "recorder": "hannes_bags",
    "player": "hannes_bags",
    "hannes_composed": "hannes_bringup",
}
"""Executable -> package, of every node."""

LAUNCH_FILE = "hand.launch.yaml"

app = typer.Typer(
    help="Start the whole node graph, or one node: `hannes run hand_sim --ros-args -p clock:=lockstep`.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.command()
def graph(
    clock: Annotated[
        str, typer.Option(help="realtime, or lockstep (deterministic, as fast as it goes).")
    ] = "realtime",
    object: Annotated[str, typer.Option(help="What the hand closes on: none, soft or rigid.")] = "none",
    model: Annotated[
        str, typer.Option(help="Name or path of the model that hand_sim simulates.")
    ] = "nominal",
    emg: Annotated[str, typer.Option(help="Two-channel EMG recording (.csv); empty for synthetic EMG.")] = "",
    duration: Annotated[
        float, typer.Option(min=0.0, help="End after this simulated time, s; 0 for never.")
    ] = 0.0,
    record: Annotated[str, typer.Option(help="Folder of a new bag to record into; empty for none.")] = "",
    arguments: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME:=VALUE]...", help="More arguments of the launch file."),
    ] = None,
) -> None:
    """Start the whole node graph; Ctrl-C stops it.

    EMG source -> emg_reference -> motor_controller -> hand_sim -> stiffness_classifier, each a process.
    Uses `ros2 launch` where a ROS 2 with this workspace is sourced, else a stand-in that reads the same launch file.
    """
    require_ros()
    environment = ros_environment()
    given = {
        "clock": clock,
        "object": object,
        "model": _absolute(model),
        "emg": _absolute(emg),
        "duration": str(duration),
    }
    if record:
        given |= {"record": "true", "bag": os.path.abspath(record)}
    given |= parse_launch_arguments(arguments or [])
    _check_files(given)
    if has_real_ros2(environment):
        words = [f"{name}:={value}" for name, value in given.items()]
        os.execvpe("ros2", ["ros2", "launch", "hannes_bringup", LAUNCH_FILE, *words], environment)
    from hannes_bringup.launch_file import read_launch_file

    path = launch_path("hannes_bringup", LAUNCH_FILE, environment)
    plan = read_launch_file(path, given, lambda package: share_folder(package, environment))
    raise typer.Exit(launch(plan, environment))


def _check_files(given: Mapping[str, str]) -> None:
    """Refuse a model or an EMG recording that is not there before anything is started, and not by a node after it."""
    Model.load(given["model"])
    if given["emg"] and not os.path.isfile(given["emg"]):
        raise HannesError(
            f"No EMG recording '{given['emg']}': give the path of a .csv file, or none for synthetic EMG."
        )
    if given.get("config") and not os.path.isfile(given["config"]):
        raise HannesError(f"No parameter file '{given['config']}': give the path of a .yaml file.")


def _absolute(name_or_path: str) -> str:
    """Nodes may run elsewhere: a path is made absolute, a name is kept."""
    return os.path.abspath(name_or_path) if os.path.splitext(name_or_path)[1] else name_or_path


def _add_node(executable: str, package: str) -> None:
    @app.command(
        executable,
        help=f"Run one node of {package}. The words after it go to the node: --ros-args -p name:=value ...",
        context_settings={
            "allow_extra_args": True,
            "ignore_unknown_options": True,
            "allow_interspersed_args": False,
        },
    )
    def node(context: typer.Context) -> None:
        require_ros()
        environment = ros_environment()
        command = find_command(package, executable, environment)
        os.execve(command[0], [*command, *context.args], environment)


for _executable, _package in NODES.items():
    _add_node(_executable, _package)
