"""tools/environment.py: what it installs is what the packages declare, and its refusals say what to do."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from workspace import PACKAGES, SOURCES

TOOL = SOURCES.parents[1] / "tools" / "environment.py"


@pytest.fixture
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("hannes_environment", TOOL)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def names(requirements: list[str]) -> set[str]:
    return {re.split(r"[\s<>=!~\[;]", line)[0].lower().replace("_", "-") for line in requirements}


def pins(text: str) -> dict[str, str]:
    return dict(line.split("==") for line in text.splitlines() if line and not line.startswith("#"))


def test_everything_that_is_declared_is_installed_and_pinned(tool: ModuleType) -> None:
    declared = set().union(*(package.requirements for package in PACKAGES.values())) - set(PACKAGES)
    wanted = names(tool.requirements_lines(apt_ros=False))
    assert declared <= wanted
    assert {
        "pytest",
        "ruff",
        "mypy",
        "colcon-core",
        "ros-jazzy-rclpy",
        "ros-jazzy-common-interfaces",
    } <= wanted
    assert wanted <= set(pins(tool.constraints_text(apt_ros=False)))


def test_pins_hold_what_jazzy_needs(tool: ModuleType) -> None:
    pinned = pins(tool.constraints_text(apt_ros=False))
    assert pinned["ros-rclpy"] == "7.1.6"
    assert int(pinned["setuptools"].split(".")[0]) < 80


def test_beside_an_apt_ros_no_wheel_of_ros_is_installed(tool: ModuleType) -> None:
    wanted = names(tool.requirements_lines(apt_ros=True))
    assert not {name for name in wanted if name.startswith(("ros-", "colcon"))}
    assert pins(tool.constraints_text(apt_ros=True))["numpy"] == "1.26.4"


def test_what_is_installed_beside_an_apt_ros_agrees_with_its_numpy(tool: ModuleType) -> None:
    """What is asked for requires of one another no version but the pinned one, as far as those are here."""
    from importlib import metadata

    from packaging.requirements import Requirement

    pinned = pins(tool.constraints_text(apt_ros=True))
    todo, done, apart = [Requirement(line) for line in tool.requirements_lines(apt_ros=True)], set(), []
    while todo:
        requirement = todo.pop()
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        if name in pinned and not requirement.specifier.contains(pinned[name]):
            apart.append(f"{requirement} with {name} {pinned[name]}")
        if name in done or name not in pinned:
            continue
        done.add(name)
        if metadata.version(name) != pinned[name]:
            continue  # of a version that is not here nothing is known
        for text in metadata.distribution(name).requires or []:
            child = Requirement(text)
            if child.marker is None or child.marker.evaluate({"extra": ""}):
                todo.append(child)
    assert "numpy" in done and not apart


def test_this_environment_has_the_pinned_versions(tool: ModuleType) -> None:
    from importlib import metadata

    pinned = pins(tool.constraints_text(apt_ros=bool(os.environ.get("ROS_DISTRO"))))
    for name in ("numpy", "mujoco", "numba", "scikit-learn", "onnxruntime", "rosbags", "mcap", "typer"):
        assert metadata.version(name) == pinned[name], name


def test_the_stamp_changes_with_the_requirements(tool: ModuleType, tmp_path: Path) -> None:
    before = tool.fingerprint(False)
    assert before == tool.fingerprint(False) != tool.fingerprint(True)
    for name in ("ros2_ws/src/hannes_sim", "requirements"):
        (tmp_path / name).mkdir(parents=True)
    cfg = tmp_path / "ros2_ws" / "src" / "hannes_sim" / "setup.cfg"
    cfg.write_text("[options]\ninstall_requires =\n    numpy\n")
    cfg.with_name("pyproject.toml").touch()
    tool.ROOT, tool.SOURCES = tmp_path, tmp_path / "ros2_ws" / "src"
    first = tool.fingerprint(False)
    cfg.write_text("[options]\ninstall_requires =\n    scipy\n")
    assert tool.fingerprint(False) != first


def run_tool(tmp_path: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    variables = {name: value for name, value in os.environ.items() if name not in ("ROS_DISTRO", "PYTHON")}
    return subprocess.run(
        [sys.executable, str(TOOL)],
        capture_output=True,
        text=True,
        env={**variables, "VENV": str(tmp_path / "venv"), **environment},
    )


def script(folder: Path, name: str, text: str) -> str:
    file = folder / name
    file.write_text(f"#!/bin/sh\n{text}\n")
    file.chmod(0o755)
    return str(file)


def test_another_python_is_refused(tmp_path: Path) -> None:
    answer = run_tool(tmp_path, PYTHON=script(tmp_path, "python3.10", "echo 3.10"))
    assert answer.returncode == 2
    assert "Python 3.11 or 3.12 is needed" in answer.stderr and "Python 3.10" in answer.stderr


def test_a_missing_python_is_named(tmp_path: Path) -> None:
    answer = run_tool(tmp_path, PYTHON="/nowhere/python3.12")
    assert answer.returncode == 2 and "/nowhere/python3.12: not found" in answer.stderr


def test_a_missing_venv_module_is_named(tmp_path: Path) -> None:
    fake = script(tmp_path, "python3.12", 'case "$2" in *ensurepip*) exit 1;; *) echo 3.12;; esac')
    answer = run_tool(tmp_path, PYTHON=fake)
    assert answer.returncode == 2
    assert "apt install python3-venv" in answer.stderr and "python3.12-venv" in answer.stderr


def test_another_ros_is_refused(tmp_path: Path) -> None:
    answer = run_tool(tmp_path, ROS_DISTRO="humble")
    assert answer.returncode == 2 and "humble" in answer.stderr


def test_a_jazzy_that_does_not_import_is_refused(tmp_path: Path) -> None:
    answer = run_tool(tmp_path, ROS_DISTRO="jazzy", PYTHON=script(tmp_path, "python3.12", "exit 1"))
    assert answer.returncode == 2 and "cannot import rclpy" in answer.stderr


@pytest.mark.parametrize(("system", "apt_ros"), [("true", False), ("false", True)])
def test_the_two_kinds_of_ros_are_never_mixed(
    tool: ModuleType, tmp_path: Path, system: str, apt_ros: bool
) -> None:
    (tmp_path / "bin").mkdir()
    script(tmp_path / "bin", "python", "echo 3.12")
    (tmp_path / "pyvenv.cfg").write_text(f"include-system-site-packages = {system}\n")
    with pytest.raises(tool.SetupError, match="never mixed"):
        tool.check_venv(tmp_path, apt_ros)


def test_rosdep_leaves_pip_keys_to_the_environment(tool: ModuleType) -> None:
    line = tool.rosdep_line()
    assert "python3-mujoco-pip" in line.split("--skip-keys")[1]
    assert "--from-paths ros2_ws/src" in line


def test_makefile_and_ci_run_the_tests() -> None:
    root = SOURCES.parents[1]
    ci = (root / ".ci" / "run").read_text()
    assert os.access(root / ".ci" / "run", os.X_OK)
    assert "make test" in ci and "make check" in ci
    help_text = subprocess.run(
        ["make", "-s", "help"], cwd=root, capture_output=True, text=True, check=True
    ).stdout
    for target in ("setup", "demo", "test", "check", "bench", "build"):
        assert f"make {target} " in help_text
