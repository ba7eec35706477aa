"""The launch file, read by the stand-in; and what the stand-in refuses."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from time import monotonic, sleep

import pytest
import yaml
from hannes_bringup.cli.run import LAUNCH_FILE, NODES
from hannes_bringup.launch_file import read_arguments, read_launch_file
from hannes_bringup.processes import QUIET_FROM_THE_START, ProcessGroup
from hannes_bringup.ros2_standin import find_command, launch_path, main, share_folder
from hannes_description.errors import HannesError
from hannes_description.joints import JOINT_NAMES
from hannes_description.urdf import urdf_path
from patience import PATIENCE
from workspace import PACKAGES

LAUNCH = launch_path("hannes_bringup", LAUNCH_FILE, os.environ)


def share(package: str) -> Path:
    return share_folder(package, os.environ)


def test_arguments_are_declared_with_descriptions() -> None:
    arguments = {argument.name: argument for argument in read_arguments(LAUNCH)}
    assert {"clock", "object", "model", "emg", "record", "bag"} <= set(arguments)
    assert all(argument.description and argument.default is not None for argument in arguments.values())
    assert arguments["object"].choices == ("none", "soft", "rigid")


def test_the_graph() -> None:
    plan = read_launch_file(LAUNCH, {"clock": "lockstep", "object": "soft", "model": "/tmp/a.yaml"}, share)
    nodes = {node.executable: node for node in plan.nodes}
    assert set(nodes) == {
        "hand_sim",
        "motor_controller",
        "emg_reference",
        "emg_source",
        "stiffness_classifier",
    }
    assert all(NODES[name] == node.package for name, node in nodes.items())
    for node in nodes.values():
        assert "__ns:=/hannes" in node.arguments
        config = node.arguments[node.arguments.index("--params-file") + 1]
        assert Path(config).is_file()
    assert [node.executable for node in plan.nodes if node.required] == ["hand_sim"]
    assert 'file:=""' in nodes["emg_source"].arguments
    assert "subscribers:=4" in nodes["hand_sim"].arguments
    assert {'clock:="lockstep"', 'object:="soft"', 'model:="/tmp/a.yaml"'} <= set(nodes["hand_sim"].arguments)


def test_recording_is_asked_for() -> None:
    plan = read_launch_file(LAUNCH, {"record": "true", "bag": "/tmp/bag"}, share)
    recorder = next(node for node in plan.nodes if node.executable == "recorder")
    assert any("/tmp/bag" in word for word in recorder.arguments)


def test_config_is_valid_for_ros() -> None:
    content = yaml.safe_load((share("hannes_bringup") / "config" / "hand.yaml").read_text())
    for pattern, section in content.items():
        assert pattern.startswith("/**") and set(section) == {"ros__parameters"}


def test_python_launch_file_is_thin_and_compiles() -> None:
    text = LAUNCH.with_name("hand.launch.py").read_text()
    compile(text, "hand.launch.py", "exec")
    assert LAUNCH_FILE in text


def test_the_hand_is_displayed_from_what_is_installed() -> None:
    """Not run here: there is no robot_state_publisher among the wheels. Its files are where it looks for them."""
    path = launch_path("hannes_bringup", "display.launch.yaml", os.environ)
    actions = yaml.safe_load(path.read_text(encoding="utf-8"))["launch"]
    nodes = {action["node"]["exec"]: action["node"] for action in actions if "node" in action}
    assert set(nodes) == {"robot_state_publisher", "rviz2"} and nodes["rviz2"]["if"] == "$(var rviz)"
    assert set(nodes) <= PACKAGES["hannes_bringup"].depends("exec_depend")
    assert {a.name: a.default for a in read_arguments(path)}["rviz"] == "false"
    (described,) = (p for p in nodes["robot_state_publisher"]["param"] if p["name"] == "robot_description")
    assert described["type"] == "str"
    used = re.findall(r"\$\(find-pkg-share (\w+)\)/([\w./]+)", described["value"] + nodes["rviz2"]["args"])
    assert [package for package, _ in used] == ["hannes_description", "hannes_bringup"]
    for package, file in used:
        data = PACKAGES[package].config["options.data_files"]
        installed = {
            f"{folder}/{Path(source).name}" for folder, files in data.items() for source in files.split()
        }
        assert f"share/{package}/{file}" in installed


def test_joint_states_are_those_of_the_urdf() -> None:
    joints = ElementTree.parse(urdf_path()).getroot().findall("joint")
    assert {j.get("name") for j in joints if j.get("type") != "fixed"} == set(JOINT_NAMES)


def write(folder: Path, *actions: object) -> Path:
    path = folder / "test.launch.yaml"
    path.write_text(yaml.safe_dump({"launch": list(actions)}))
    return path


def test_substitutions_conditions_and_remaps(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        {"arg": {"name": "who", "default": "a"}},
        {"let": {"name": "full", "value": "$(var who)_node"}},
        {"node": {"pkg": "p", "exec": "e", "name": "$(var full)", "namespace": "n", "if": "true",
                  "param": [{"name": "count", "value": 3}, {"name": "text", "value": "$(var who)"},
                            {"name": "yes", "value": True}, {"name": "list", "value": [1.5, 2.0]}],
                  "remap": [{"from": "x", "to": "/y"}], "args": "--flag $(var who)"}},
        {"node": {"pkg": "p", "exec": "never", "unless": "1"}},
    )  # fmt: skip
    (node,) = read_launch_file(path, {"who": "b"}, share).nodes
    assert node.name == "b_node"
    assert node.arguments == (
        "--flag",
        "b",
        "--ros-args",
        "-r",
        "__node:=b_node",
        "-r",
        "__ns:=/n",
        "-p",
        "count:=3",
        "-p",
        'text:="b"',
        "-p",
        "yes:=true",
        "-p",
        "list:=[1.5, 2.0]",
        "-r",
        "x:=/y",
    )


@pytest.mark.parametrize(
    ("action", "says"),
    [
        ({"node": {"pkg": "p", "exec": "e", "respwan": True}}, "unknown key 'respwan'"),
        ({"group": {}}, "'group' is not understood"),
        ({"node": {"pkg": "p"}}, "lacks the key 'exec'"),
        ({"node": {"pkg": "p", "exec": "$(var nobody)"}}, "not declared"),
        ({"node": {"pkg": "p", "exec": "$(eval 1)"}}, "not understood"),
        ({"node": {"pkg": "p", "exec": "e", "if": "maybe"}}, "valid are true, false"),
        ({"node": {"pkg": "p", "exec": "e", "param": [{"name": "x"}]}}, "valid are"),
        ({"arg": {"name": "needed"}}, "must be given"),
    ],
)
def test_what_it_does_not_understand_is_refused(tmp_path: Path, action: object, says: str) -> None:
    with pytest.raises(HannesError, match=says.replace("(", r"\(")):
        read_launch_file(write(tmp_path, action), {}, share)


def test_broken_yaml_is_one_error(tmp_path: Path) -> None:
    path = tmp_path / "x.launch.yaml"
    path.write_text("launch: [")
    with pytest.raises(HannesError, match="not valid YAML: line 1, column 10: "):
        read_launch_file(path, {}, share)


def prefix_with(folder: Path, package: str, **scripts: str) -> dict[str, str]:
    """An ament prefix with one package whose executables are Python scripts."""
    index = folder / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    (index / package).touch()
    libexec = folder / "lib" / package
    libexec.mkdir(parents=True)
    for name, code in scripts.items():
        (libexec / name).write_text(f"#!{sys.executable}\n{code}")
        (libexec / name).chmod(0o755)
    return {**os.environ, "AMENT_PREFIX_PATH": str(folder)}


def test_run_finds_executables_as_ros2_run_does(tmp_path: Path) -> None:
    environment = prefix_with(tmp_path, "some_package", hello="print('hello')\n")
    assert find_command("some_package", "hello", environment) == [
        str(tmp_path / "lib" / "some_package" / "hello")
    ]
    with pytest.raises(HannesError, match="valid are hello"):
        find_command("some_package", "bye", environment)
    with pytest.raises(HannesError, match="No package"):
        find_command("no_such_package", "bye", environment)


def test_run_becomes_the_executable(tmp_path: Path) -> None:
    environment = prefix_with(tmp_path, "some_package", echo="import sys; print(sys.argv[1:]); sys.exit(7)")
    words = ["run", "some_package", "echo", "--ros-args", "-p", "a:=1"]
    answer = subprocess.run(
        [sys.executable, "-m", "hannes_bringup.ros2_standin", *words],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert answer.returncode == 7
    assert answer.stdout.strip() == "['--ros-args', '-p', 'a:=1']"


GOOD = """
import os, signal, sys, time
signal.signal(signal.SIGINT, lambda *_: sys.exit(0))
os.write(1, b"up\\n")
for _ in range(600):  # a signal just before a sleep is seen after it
    time.sleep(0.1)
"""
STUBBORN = """
import os, signal, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.signal(signal.SIGTERM, signal.SIG_IGN)
os.write(1, b"up\\n")
time.sleep(60)
"""
IMPATIENT = """
import sys, hannes_bringup.processes as processes
processes.GRACE_SIGINT = processes.GRACE_SIGTERM = float(sys.argv.pop(1))
from hannes_bringup.ros2_standin import main
sys.exit(main())
"""


def start_graph(tmp_path: Path, *executables: str, grace: float = 0.5) -> subprocess.Popen[str]:
    """`hannes_ros2 launch` of a file with those executables, each of which prints "up" when it is ready.

    grace  s that each has after a signal before it gets a harder one
    """
    prefix = tmp_path / "prefix"
    environment = prefix_with(prefix, "some_package", good=GOOD, stubborn=STUBBORN, bad="raise SystemExit(3)")
    launch = prefix / "share" / "some_package" / "launch"
    launch.mkdir(parents=True)
    nodes = [
        {"pkg": "some_package", "exec": name, "name": f"{name}{i}"} for i, name in enumerate(executables)
    ]
    write(launch, *({"node": node} for node in nodes))
    return subprocess.Popen(
        [sys.executable, "-c", IMPATIENT, str(grace), "launch", "some_package", "test.launch.yaml"],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def assert_gone(stderr: str, count: int) -> None:
    pids = [int(line.rpartition("pid ")[2]) for line in stderr.splitlines() if "started, pid" in line]
    assert len(pids) == count
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_all_nodes_cleanly(tmp_path: Path, number: signal.Signals) -> None:
    child = start_graph(tmp_path, "good", "good", grace=PATIENCE)
    assert [child.stdout.readline() for _ in range(2)] == ["up\n", "up\n"]
    child.send_signal(number)
    _, stderr = child.communicate(timeout=PATIENCE)
    assert child.returncode == 0, stderr
    assert "Traceback" not in stderr
    assert_gone(stderr, 2)


def test_a_node_that_will_not_stop_is_killed_and_reported(tmp_path: Path) -> None:
    child = start_graph(tmp_path, "stubborn")
    assert child.stdout.readline() == "up\n"
    child.send_signal(signal.SIGINT)
    _, stderr = child.communicate(timeout=PATIENCE)
    assert child.returncode == 1
    assert "SIGTERM" in stderr and "SIGKILL" in stderr
    assert_gone(stderr, 1)


def test_a_node_that_fails_ends_the_graph(tmp_path: Path) -> None:
    child = start_graph(tmp_path, "good", "bad")
    _, stderr = child.communicate(timeout=PATIENCE)
    assert child.returncode == 1
    assert "[bad1] ended with exit code 3" in stderr
    assert_gone(stderr, 2)


def test_launch_refuses_python_files_and_unknown_names(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["launch", "hannes_bringup", "hand.launch.py"]) == 2
    assert "real `ros2 launch`" in capsys.readouterr().err
    assert main(["launch", "hannes_bringup", "foot.launch.yaml"]) == 2
    assert LAUNCH_FILE in capsys.readouterr().err


@pytest.mark.parametrize("after", [0.0, 0.01, 0.02, 0.04])
def test_a_node_that_is_stopped_while_python_starts_says_nothing(
    after: float, capfd: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C within the first second of a graph printed a traceback of Python's own start for each node."""
    code = f"{QUIET_FROM_THE_START}import time; time.sleep(60)"
    with ProcessGroup(lambda text: None, os.environ) as group:
        for name in ("one", "two"):
            group.start(name, [sys.executable, "-c", code])
        sleep(after)
        codes = group.stop()
    assert codes == {"one": 0, "two": 0} and capfd.readouterr() == ("", "")
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, []), "here it is not held back"


def test_ctrl_c_reaches_a_program_that_knows_nothing_of_it() -> None:
    with ProcessGroup(lambda text: None, os.environ) as group:
        group.start("plain", ["sleep", "60"])
        assert group.stop() == {"plain": -signal.SIGINT}


PARENT = """
import sys, time
from hannes_bringup.processes import Interrupted, ProcessGroup, raise_on_signals
raise_on_signals()
with ProcessGroup(lambda text: print(text, flush=True)) as group:
    try:
        group.start("child", [sys.executable, "-c", "import time; print('up', flush=True); time.sleep(600)"])
        while True:
            print("drives", flush=True)
            time.sleep(0.02)
    except Interrupted:
        pass
"""


@pytest.mark.parametrize("how", ["terminal closed", "killed"])
def test_no_child_outlives_a_command_whose_terminal_is_closed_or_that_is_killed(how: str) -> None:
    """The child is a motor controller, which would drive the motor on."""
    parent, terminal = pty.fork()
    if parent == 0:
        os.execv(sys.executable, [sys.executable, "-c", PARENT])
    said = ""
    try:
        while "\nup" not in said:
            said += os.read(terminal, 4096).decode()
        found = re.search(r"\[child\] started, pid (\d+)", said)
        assert found, said
        if how == "killed":
            os.kill(parent, signal.SIGKILL)
    finally:
        os.close(terminal)
        _, status = os.waitpid(parent, 0)
    assert os.waitstatus_to_exitcode(status) == (-signal.SIGKILL if how == "killed" else 0)
    end = monotonic() + PATIENCE
    while is_running(int(found[1])):
        assert monotonic() < end, "the child still runs"
        sleep(0.02)


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
