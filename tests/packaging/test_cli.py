"""The `hannes` command: every subcommand has help, mistakes cost one line and exit code 2, and it starts quickly."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from hannes_bringup.cli import COMMANDS, Command, build_app, load
from hannes_bringup.cli.run import NODES
from patience import PATIENCE
from workspace import PACKAGES


def hannes(*words: str, **options: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "hannes_bringup.cli", *words],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        **options,
    )


def loaded_by(*words: str) -> tuple[str, set[str]]:
    """What a command prints, and which packages it imported for it."""
    code = (
        f"import sys; sys.argv = ['hannes', *{words!r}]\n"
        "from hannes_bringup.cli import main\n"
        "try:\n    main()\n"
        "finally:\n    print('LOADED', *sorted(m for m in sys.modules if '.' not in m), file=sys.stderr)\n"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    return answer.stdout, set(answer.stderr.split("LOADED")[1].split())


def test_help_lists_every_subcommand_and_imports_none() -> None:
    said, loaded = loaded_by("--help")
    for command in COMMANDS:
        assert re.search(rf"^\s+{command.name}\s", said, re.MULTILINE), command.name
    heavy = {"numpy", "rclpy", "mujoco", "numba", "sklearn", "scipy", "matplotlib", "rosbags", "pandas"}
    assert not loaded & heavy


@pytest.mark.parametrize("name", [c.name for c in COMMANDS if c.name not in ("validate", "page")])
def test_help_of_a_command_does_not_wait_for_what_it_works_with(name: str) -> None:
    said, loaded = loaded_by(name, "--help")
    assert "Usage: hannes" in said
    assert not loaded & {"rclpy", "mujoco", "numba", "sklearn", "scipy", "matplotlib", "pandas"}


@pytest.mark.parametrize("command", COMMANDS, ids=[command.name for command in COMMANDS])
def test_every_subcommand_has_help(command: Command) -> None:
    from typer.testing import CliRunner

    answer = CliRunner().invoke(build_app(), [command.name, "--help"])
    assert answer.exit_code == 0, answer.output
    assert f"hannes {command.name}" in answer.output
    assert callable(load(command))


def test_one_subcommand_for_real() -> None:
    answer = hannes("model", "show", "--help")
    assert answer.returncode == 0 and "--json" in answer.stdout


@pytest.mark.parametrize("words", [("model", "show"), ("model", "show", "--json"), ("--version",)])
def test_a_closed_output_is_one_line(words: tuple[str, ...]) -> None:
    answer = hannes(*words, preexec_fn=lambda: os.close(1))
    assert (answer.returncode, answer.stdout) == (1, "")
    assert answer.stderr == "hannes: the output cannot be written: Bad file descriptor.\n"


def test_version() -> None:
    from hannes_bringup import __version__

    answer = hannes("--version")
    assert (answer.returncode, answer.stdout.split()) == (0, ["hannes", __version__])


def test_model_show_says_where_every_number_comes_from() -> None:
    answer = hannes("model", "show", "--json")
    assert answer.returncode == 0, answer.stderr
    shown = json.loads(answer.stdout)
    assert len(shown["sha256"]) == 64
    for name, parameter in shown["parameters"].items():
        assert {"value", "unit", "status", "source"} <= set(parameter), name
    table = hannes("model", "show")
    assert table.returncode == 0
    assert all(name in table.stdout for name in shown["parameters"])


def test_an_effect_in_another_unit_is_not_shown(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    level = "{value: 30.0, unit: mN.m, lower: 0.0, upper: 100.0, status: assumed, source: x}"
    file.write_text(
        f"schema: hannes/model/1\neffects: [{{name: coulomb_friction, parameters: {{level: {level}}}}}]\n"
    )
    answer = hannes("model", "show", str(file))
    assert (answer.returncode, answer.stdout) == (2, "")
    assert f"{file}: effect 'coulomb_friction': level is in 'mN.m'; it must be in 'N.m'" in answer.stderr


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("model", "show", "nope"), "No model 'nope'"),
        (("model", "show", "/nowhere/model.yaml"), "/nowhere/model.yaml"),
        (("run", "graph", "--clock", "sundial"), "valid are realtime, lockstep"),
        (("run", "graph", "--object", "cat"), "valid are none, soft, rigid"),
        (("run", "graph", "--model", "nope"), "No model 'nope'"),
        (("run", "graph", "model:=nope"), "No model 'nope'"),
        (("run", "graph", "--emg", "nope.csv"), "nope.csv': give the path of a .csv file"),
        (("run", "graph", "speed:=3"), "no argument 'speed'"),
        (("run", "graph", "speed"), "name:=value"),
        (("model", "show", "--nonsense"), "--nonsense"),
        *(
            (("record", "/tmp/never", "--profile", name, "--amplitude", "100"), "closed at 15.6 rad")
            for name in ("half_sine", "ramp_hold", "reversals")
        ),
        (("sing",), "sing"),
    ],
)
def test_a_mistake_costs_one_clear_error(words: tuple[str, ...], says: str) -> None:
    answer = hannes(*words)
    assert answer.returncode == 2, answer.stdout + answer.stderr
    assert says in answer.stderr
    assert "Traceback" not in answer.stderr
    if not answer.stderr.startswith("Usage"):
        assert len(answer.stderr.strip().splitlines()) == 1


def test_interrupt_is_130() -> None:
    code = (
        "import sys, hannes_bringup.cli as cli\n"
        "def interrupted(): raise KeyboardInterrupt\n"
        "cli.build_app = lambda: interrupted\n"
        "sys.exit(cli.main())"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (answer.returncode, answer.stderr) == (130, "\nhannes: interrupted\n")


def test_without_ros_the_ros_commands_say_what_to_do() -> None:
    code = (
        "import sys, hannes_bringup.environment as e\n"
        "e.find_spec = lambda name: None\n"
        "sys.argv = ['hannes', 'nodes']\n"
        "from hannes_bringup.cli import main; sys.exit(main())"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.returncode == 2 and "make setup" in answer.stderr and "Traceback" not in answer.stderr


def test_run_knows_every_executable_of_the_workspace() -> None:
    declared = {
        name: package.name
        for package in PACKAGES.values()
        for name in package.entry_points
        if name not in ("hannes", "hannes_ros2")
    }
    assert declared == NODES


@pytest.mark.ros
def test_nodes_sees_a_running_node(ros_environment: dict[str, str], tmp_path: Path) -> None:
    ready = tmp_path / "ready"
    talker = f"""
import pathlib, rclpy
from std_msgs.msg import Float64
rclpy.init()
node = rclpy.create_node("talker", namespace="/hannes")
publisher = node.create_publisher(Float64, "chatter", 10)
node.create_timer(0.01, lambda: publisher.publish(Float64(data=1.0)))
pathlib.Path({str(ready)!r}).touch()
while True:
    rclpy.spin_once(node, timeout_sec=0.1)
"""
    child = subprocess.Popen([sys.executable, "-c", talker], env=ros_environment)
    try:
        answer = hannes("nodes", "--json", "--window", "1", env=ros_environment)
    finally:
        child.kill()
        child.wait()
    assert answer.returncode == 0, answer.stderr
    seen = json.loads(answer.stdout)
    assert [node["name"] for node in seen["nodes"]] == ["/hannes/talker"]
    topic = next(topic for topic in seen["topics"] if topic["name"] == "/hannes/chatter")
    assert topic["type"] == "std_msgs/msg/Float64"
    assert (topic["publishers"], topic["subscribers"]) == (1, 0)
    assert topic["messages"] > 10 and 50 < topic["rate"] < 150 and topic["age"] < 0.5


@pytest.mark.ros
def test_a_profile_without_a_hand_is_refused_before_anything_is_recorded(
    ros_environment: dict[str, str], tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    told = hannes("record", str(bag), "--profile", "half_sine", "--closures", "1", env=ros_environment)
    assert told.returncode == 2 and len(told.stderr.strip().splitlines()) == 1, told.stderr
    assert "No motor/state is seen in ROS domain" in told.stderr and "is hand_sim" in told.stderr
    assert not bag.exists()


def test_what_only_a_profile_uses_is_refused_without_one(tmp_path: Path) -> None:
    told = hannes("record", str(tmp_path / "bag"), "--period", "3", "--closures", "2")
    assert told.returncode == 2 and "--closures, --period: only --profile" in told.stderr, told.stderr
    told = hannes("record", str(tmp_path / "bag"), "--profile", "half_sine", "--model", "no_such_hand")
    assert told.returncode == 2 and "no_such_hand" in told.stderr, told.stderr
    for content, why in (
        ("controller: law.py:Law", "which motor_controller does not run"),
        (
            "overrides: {hand.travel: {value: 12.0, unit: rad, status: measured, source: x}}",
            "a full closure|14.5",
        ),
    ):
        (tmp_path / "own.yaml").write_text(f"schema: hannes/model/1\n{content}\n")
        words = ("--profile", "half_sine", "--model", "own.yaml")
        told = hannes("record", "bag", *words, cwd=tmp_path)
        assert told.returncode == 2 and re.search(why, told.stderr), told.stderr


def test_a_training_that_could_not_end_well_is_refused_before_it_begins(tmp_path: Path) -> None:
    for out, method, why in (
        (tmp_path / "x.onnx", "foo", "Method 'foo' is unknown; valid are best, thesis"),
        (tmp_path / "x.txt", "forest", "must end in .onnx"),
        (Path("/proc/x.onnx"), "forest", "Cannot write the classifier '/proc/x.onnx'"),
    ):
        told = hannes("stiffness", "train", "--out", str(out), "--method", method)
        assert told.returncode == 2 and why in told.stderr and told.stderr.count("\n") == 1, told.stderr


def test_the_demo_says_what_was_noticed_in_a_bag_in_a_line(tmp_path: Path) -> None:
    from bags.bag_samples import foreign_bag, motor_messages
    from hannes_bags.reading import read_and_say

    stamps = np.arange(1, 301, dtype=np.int64) * 1_000_000
    stamps = np.concatenate([stamps[:5], stamps[4:]])
    bag = foreign_bag(tmp_path / "bag", motor_messages(stamps, np.arange(stamps.size) * 1_000_000))
    said: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_and_say(bag, said.append)
    assert len(said) == 1 and "Messages that repeat the one before, its stamp too, were left out" in said[0]


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_command_with_workers_that_is_stopped_leaves_none_behind(
    sent: signal.Signals, code: int, tmp_path: Path
) -> None:
    """`timeout` and batch systems send SIGTERM to the command alone."""
    words = (
        "stiffness",
        "dataset",
        "--out",
        "set",
        "--closures",
        "6000",
        "--model",
        "nominal",
        "--jobs",
        "2",
    )
    begun = subprocess.Popen(
        [sys.executable, "-m", "hannes_bringup.cli", *words],
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    until = time.monotonic() + PATIENCE
    while not list((tmp_path / "set").glob("part_*")) and time.monotonic() < until:
        time.sleep(0.1)
    begun.send_signal(sent)
    _, said = begun.communicate(timeout=PATIENCE)
    assert begun.returncode == code and ("hannes: terminated" in said) == (sent == signal.SIGTERM), said
    assert "Traceback" not in said and "leaked" not in said
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        try:
            os.killpg(begun.pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    os.killpg(begun.pid, signal.SIGKILL)
    pytest.fail("workers are left")
