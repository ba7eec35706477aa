"""colcon builds the workspace, and each executable runs from where `ros2 run` looks for it."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hannes_bags.recording import Channel, Recording
from hannes_bags.writing import write_recording
from hannes_description.signals import SIGNALS
from patience import PATIENCE
from workspace import PACKAGES, SOURCES

EXECUTABLES = sorted((package.name, name) for package in PACKAGES.values() for name in package.entry_points)
NODES = [pair for pair in EXECUTABLES if pair[1] not in ("hannes", "hannes_ros2")]

NEEDED = {"player": ["-p", "bag:={bag}"], "recorder": ["-p", "output:={folder}/recorded"]}
"""Parameters without which a node has nothing to do."""

pytestmark = pytest.mark.slow


def colcon(*words: str, **options: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "colcon", *words],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=800,
        **options,
    )


@pytest.fixture(scope="session")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with a copy of our sources, built and installed."""
    root = tmp_path_factory.mktemp("ws")
    ignore = shutil.ignore_patterns("__pycache__", "*.egg-info", "build")
    shutil.copytree(SOURCES, root / "src", ignore=ignore)
    answer = colcon("build", cwd=root)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    return root


@pytest.fixture(scope="session")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of a minute of motor current, for the player."""
    time = np.arange(600) * 0.1
    channel = Channel(time, np.sin(time), SIGNALS["motor_current"].unit, "motor_current")
    recording = Recording({"motor_current": channel}, {}, "memory", "")
    return write_recording(recording, tmp_path_factory.mktemp("bag") / "bag")


@pytest.fixture(scope="session")
def overlay(workspace: Path) -> dict[str, str]:
    """The environment after `source install/setup.bash`."""
    answer = subprocess.run(
        ["bash", "-c", "source install/setup.bash && env -0"],
        cwd=workspace,
        capture_output=True,
        text=True,
        check=True,
    )
    return dict(pair.split("=", 1) for pair in answer.stdout.split("\0") if "=" in pair)


@pytest.fixture
def sourced(overlay: dict[str, str], ros_environment: dict[str, str]) -> dict[str, str]:
    """The same, on the test's own domain."""
    return overlay | {
        name: ros_environment[name] for name in ("ROS_DOMAIN_ID", "ROS_LOG_DIR", "PYTHONUNBUFFERED")
    }


def test_colcon_sees_ros_packages(tmp_path: Path) -> None:
    """An invalid package.xml would silently make a plain Python package of it."""
    answer = colcon("--log-base", str(tmp_path), "list", "--base-paths", str(SOURCES))
    assert answer.returncode == 0, answer.stderr
    seen = {line.split()[0]: line.split()[-1] for line in answer.stdout.splitlines()}
    assert seen == dict.fromkeys(PACKAGES, "(ros.ament_python)")


def test_everything_is_installed_where_ros_looks(workspace: Path) -> None:
    for package, executable in EXECUTABLES:
        file = workspace / "install" / package / "lib" / package / executable
        assert os.access(file, os.X_OK), file
    for name, package in PACKAGES.items():
        share = workspace / "install" / name / "share"
        assert (share / "ament_index" / "resource_index" / "packages" / name).is_file()
        assert (share / name / "package.xml").is_file()
        for folder, files in package.config["options.data_files"].items():
            for file in files.split():
                assert (workspace / "install" / name / folder / Path(file).name).is_file()
    launch = workspace / "install" / "hannes_bringup" / "share" / "hannes_bringup" / "launch"
    assert (launch / "hand.launch.py").is_file()


def test_installed_packages_carry_their_data(workspace: Path, sourced: dict[str, str]) -> None:
    """Read through importlib.resources from the installed copy, not from the sources."""
    code = (
        "import hannes_description, sys; from hannes_description.model import Model; Model.load('nominal')\n"
        "print(hannes_description.__file__)"
    )
    answer = subprocess.run([sys.executable, "-c", code], env=sourced, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout.startswith(str(workspace / "install"))


@pytest.mark.ros
@pytest.mark.parametrize(("package", "executable"), NODES, ids=[name for _, name in NODES])
def test_node_runs_and_ends_quietly(
    bag: Path, sourced: dict[str, str], tmp_path: Path, package: str, executable: str
) -> None:
    """`ros2 run PACKAGE EXECUTABLE` for a second, then SIGINT: exit code 0 and no traceback."""
    words = [word.format(bag=bag, folder=tmp_path) for word in NEEDED.get(executable, [])]
    command = ["run", package, executable, "--ros-args", *words]
    child = subprocess.Popen(
        [sys.executable, "-m", "hannes_bringup.ros2_standin", *command],
        env=sourced,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        wait_for_node(child, sourced)
        child.send_signal(signal.SIGINT)
        output, _ = child.communicate(timeout=PATIENCE)
    finally:
        child.kill()
    assert child.returncode == 0, output
    assert "Traceback" not in output


WATCH = """
import sys, time, rclpy
rclpy.init(); node = rclpy.create_node("watcher")
while not [name for name in node.get_node_names() if name not in ("watcher", "_ros2cli")]:
    time.sleep(0.05)
"""


def wait_for_node(child: subprocess.Popen[str], environment: dict[str, str]) -> None:
    """Until a node is in the graph, then a second more."""
    watcher = subprocess.Popen([sys.executable, "-c", WATCH], env=environment)
    try:
        end = time.monotonic() + PATIENCE
        while watcher.poll() is None and child.poll() is None and time.monotonic() < end:
            time.sleep(0.05)
    finally:
        watcher.kill()
    try:
        child.wait(timeout=1.0)
    except subprocess.TimeoutExpired:
        return
    output, _ = child.communicate()
    # a node that has nothing more to do may end by itself
    assert child.returncode == 0, f"the node ended with exit code {child.returncode}: {output}"


@pytest.mark.ros
def test_unknown_parameter_is_one_line(workspace: Path, sourced: dict[str, str]) -> None:
    file = workspace / "install" / "hannes_sim" / "lib" / "hannes_sim" / "hand_sim"
    answer = subprocess.run(
        [file, "--ros-args", "-p", "wibble:=3"], env=sourced, capture_output=True, text=True, timeout=PATIENCE
    )
    assert answer.returncode == 2
    assert re.search("wibble", answer.stderr) and "Traceback" not in answer.stderr


def test_hannes_from_the_workspace(workspace: Path, sourced: dict[str, str]) -> None:
    file = workspace / "install" / "hannes_bringup" / "lib" / "hannes_bringup" / "hannes"
    answer = subprocess.run([file, "--help"], env=sourced, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    assert "nodes" in answer.stdout
