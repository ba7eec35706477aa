"""`hannes record` and `hannes play`: the nodes of hannes_bags with options for parameters; and `hannes recover`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer
from hannes_description.errors import HannesError
from hannes_description.output import print_json

from .options import JsonOption

TopicOption = Annotated[
    list[str] | None, typer.Option("--topic", help="Only this topic; may be given several times.")
]
MoreArgument = Annotated[
    list[str] | None, typer.Argument(metavar="[NAME:=VALUE]...", help="More parameters of the node.")
]


def record(
    output: Annotated[Path, typer.Argument(help="Folder of the new bag; it must not exist.")],
    condition: Annotated[str, typer.Option(help="What was done, for instance slow, fast or grasp.")] = "",
    object: Annotated[str, typer.Option(help="What the hand closed on.")] = "",
    topic: TopicOption = None,
    namespace: Annotated[
        str, typer.Option(help="Where the hand's topics are, if not /hannes: /left for /left/motor/state.")
    ] = "",
    profile: Annotated[
        str,
        typer.Option(help="Drive the hand too: half_sine, ramp_hold or reversals, by a motor_controller."),
    ] = "",
    closures: Annotated[
        int | None, typer.Option(min=1, help="With --profile: how often; without it 13 times.")
    ] = None,
    period: Annotated[
        float, typer.Option(min=0.0, help="With --profile: s of one closure; 0: its own.")
    ] = 0.0,
    amplitude: Annotated[
        float, typer.Option(min=0.0, help="With --profile: rad at the motor pulley; 0: a full closure.")
    ] = 0.0,
    model: Annotated[
        str,
        typer.Option(
            help="With --profile: model (a name or a file) whose gains and travel the controller has."
        ),
    ] = "",
    more: MoreArgument = None,
) -> None:
    """Record the topics of the hand into a bag (MCAP, safe against a crash); Ctrl-C ends it.

    With --profile a motor_controller is started too, which closes the hand that is running (hand_sim, in real time or
    in lock-step, or the real one) along a reference profile; the recording ends with the profile.
    """
    import json

    said = {key: text for key, text in (("condition", condition), ("object", object)) if text}
    parameters: dict[str, Any] = {"output": str(output.absolute())}
    if said:
        parameters["metadata"] = json.dumps(said)
    if topic:
        parameters["topics"] = topic
    if profile:
        if namespace:
            raise HannesError(
                "--profile moves the hand of /hannes: start a controller in --namespace yourself."
            )
        _record_profile(parameters, profile, closures or 13, period, amplitude, model, more or [])
    else:
        given = {"--closures": closures, "--period": period, "--amplitude": amplitude, "--model": model}
        if idle := ", ".join(name for name, value in given.items() if value):
            raise HannesError(f"{idle}: only --profile, which drives the hand, makes use of that.")
        _become("recorder", parameters, more or [], namespace)


SEEK = 10.0
"""s in which a hand that runs is found."""

BEFORE = 0.5
"""s of rest that are recorded before a profile: of a closure that begins with its recording, that is missing."""


def _record_profile(
    recorder: dict[str, Any],
    profile: str,
    closures: int,
    period: float,
    amplitude: float,
    model: str,
    more: list[str],
) -> None:
    """Recorder and controller as child processes for as long as the profile lasts."""
    from hannes_control.reference import FULL_CLOSURE, check_travel, make_profile
    from hannes_description.model import Model

    from hannes_bringup.environment import apply_ros_environment, require_ros, ros_environment
    from hannes_bringup.processes import Interrupted, ProcessGroup, raise_on_signals
    from hannes_bringup.ros2_standin import find_command

    from .run import NODES

    given = {name: value for name, value in (("period", period), ("amplitude", amplitude)) if value > 0.0}
    seconds = BEFORE + make_profile(profile, closures=closures, **given).size * 1e-3
    name = str(Path(model).absolute()) if Path(model).suffix in (".yaml", ".yml") else model or "nominal"
    loaded = Model.load(name)
    check_travel(amplitude or FULL_CLOSURE, loaded.parameters)
    if loaded.controller != "double_pid":
        raise HannesError(
            f"Model '{loaded.name}' has the control law '{loaded.controller}', which motor_controller does not run: "
            "move the hand by a controller of your own, and record without --profile."
        )
    controller: dict[str, Any] = {"reference": profile, "reference_closures": closures, "model": name}
    controller["reference_rest"] = BEFORE
    controller |= {f"reference_{name}": value for name, value in given.items()}
    require_ros()
    apply_ros_environment()
    from hannes_bringup.graph_watch import (
        REFERENCE,
        VOLTAGE,
        find_free_hand,
        follow_profile,
        is_recorded,
        wait_for_recorder,
    )

    recorded = [] if any(word.startswith("topics:=") for word in more) else recorder.get("topics")
    # `follow_profile` hears the reference from its begin on too, and the hand the voltage
    controller["reference_subscribers"] = 1 + is_recorded(REFERENCE, recorded)
    lockstep = find_free_hand(SEEK)
    if lockstep:
        controller |= {"clock": "lockstep", "subscribers": 1 + is_recorded(VOLTAGE, recorded)}
    environment = ros_environment()
    raise_on_signals()
    with ProcessGroup(lambda text: typer.echo(text, err=True), environment) as group:
        try:
            recording = [*find_command(NODES["recorder"], "recorder", environment), *_words(recorder, more)]
            group.start("recorder", recording)
            wait_for_recorder(lambda: bool(group.running))
            if not group.running:
                raise typer.Exit(2)
            driving = find_command(NODES["motor_controller"], "motor_controller", environment)
            group.start("motor_controller", [*driving, *_words(controller, [])])
            disturbed = follow_profile(seconds, lambda: len(group.running) == 2, lockstep=lockstep)
            if len(group.running) < 2:
                raise typer.Exit(1)
            if disturbed:
                typer.echo(f"note: {disturbed}", err=True)
        except Interrupted:
            typer.echo("interrupted: what was recorded is kept", err=True)


def play(
    bag: Annotated[Path, typer.Argument(help="The bag: a rosbag2 folder, an .mcap or a .db3 file.")],
    rate: Annotated[float, typer.Option(min=0.001, max=1000.0, help="Played seconds in a second.")] = 1.0,
    fast: Annotated[
        bool, typer.Option("--fast", help="5000 ticks a second, or as fast as a hand in lock-step answers.")
    ] = False,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end.")] = False,
    start: Annotated[float, typer.Option(min=0.0, help="Time to skip at the beginning, s.")] = 0.0,
    topic: Annotated[
        list[str] | None,
        typer.Option(
            "--topic", help="Only this topic; may be given several times. Without it all but /diagnostics."
        ),
    ] = None,
    beside: Annotated[
        bool, typer.Option("--beside", help="Play topics too that another node publishes.")
    ] = False,
    more: MoreArgument = None,
) -> None:
    """Play a bag back onto its topics, with /clock.

    A topic that another node publishes already is refused: motor/voltage of a bag would drive the motor too.
    """
    parameters: dict[str, Any] = {"bag": str(bag.absolute()), "rate": rate, "start": start}
    parameters |= {
        name: True for name, wanted in (("fast", fast), ("loop", loop), ("beside", beside)) if wanted
    }
    if topic:
        parameters["topics"] = topic
    _become("player", parameters, more or [])


def recover(
    bag: Annotated[Path, typer.Argument(help="The damaged bag: a folder, an .mcap or a .db3 file.")],
    output: Annotated[Path, typer.Argument(help="Folder of the new bag; it must not exist.")],
    json: JsonOption = False,
) -> None:
    """Save what can be read of a cut or damaged bag into a new one, and verify it."""
    from hannes_bags.recover import recover as save

    saved = save(bag, output)
    if json:
        print_json(saved.as_dict())
        return
    typer.echo(f"{saved.output}: {saved.messages} messages, {saved.duration:.3f} s saved from {saved.source}")
    typer.echo(saved.losses)
    for line in saved.damage:
        typer.echo(f"damage: {line}")


def _words(parameters: dict[str, Any], more: list[str]) -> list[str]:
    """Parameters as words for a node's command line."""
    import json

    from hannes_bringup.ros2_standin import parse_launch_arguments

    words = ["--ros-args"]
    for name, value in parameters.items():
        words += ["-p", f"{name}:={json.dumps(value)}"]
    for name, text in parse_launch_arguments(more).items():
        words += ["-p", f"{name}:={text}"]
    return words


def _become(executable: str, parameters: dict[str, Any], more: list[str], namespace: str = "") -> None:
    """Turn this process into the node, in a namespace of its own if one is given."""
    from hannes_bringup.environment import require_ros, ros_environment
    from hannes_bringup.ros2_standin import find_command

    require_ros()
    environment = ros_environment()
    command = find_command("hannes_bags", executable, environment)
    words = _words(parameters, more) + (["-r", f"__ns:=/{namespace.strip('/')}"] if namespace else [])
    os.execve(command[0], [*command, *words], environment)
