"""setup.cfg is the one source of truth; package.xml, the imports and the environment agree with it."""

from __future__ import annotations

import importlib
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest
from workspace import DISTRIBUTIONS, PACKAGES, ROS_PACKAGES, ROSDEP_KEYS, Package

ALL = pytest.mark.parametrize("package", PACKAGES.values(), ids=PACKAGES)

CORE = {"hannes_description"}
ALLOWED = {
    "hannes_description": set(),
    "hannes_sim": CORE,
    "hannes_control": CORE,
    "hannes_bags": CORE,
    "hannes_ros": CORE,
    "hannes_stiffness": CORE | {"hannes_sim", "hannes_control", "hannes_bags"},
    "hannes_lab": CORE | {"hannes_sim", "hannes_control", "hannes_bags"},
    "hannes_can": CORE | {"hannes_sim", "hannes_control", "hannes_bags"},
    "hannes_bringup": set(PACKAGES),
}
"""Which of our packages the ordinary files of a package may import; node files may import hannes_ros too."""


def is_node_file(package: Package, file: Path) -> bool:
    """A node, or what nodes are made of."""
    of_nodes = file.name.endswith("_node.py") or file.parent.name == "nodes"
    return of_nodes or package.name in ("hannes_ros", "hannes_bringup")


def test_every_package_of_the_house_is_there() -> None:
    assert set(PACKAGES) >= {
        f"hannes_{part}"
        for part in ("description", "sim", "control", "bags", "ros", "stiffness", "lab", "bringup")
    }


@ALL
def test_package_xml_and_setup_cfg_say_the_same(package: Package) -> None:
    metadata, manifest = package.config["metadata"], package.manifest
    assert manifest.get("format") == "3"
    for key, tag in (
        ("name", "name"),
        ("version", "version"),
        ("description", "description"),
        ("license", "license"),
        ("maintainer", "maintainer"),
    ):
        assert metadata[key] == manifest.findtext(tag), f"{package.name}: {tag}"
    assert metadata["maintainer_email"] == manifest.find("maintainer").get("email")
    assert manifest.findtext("export/build_type") == "ament_python"
    own = {name for name in package.requirements if name in PACKAGES}
    outside = package.requirements - own
    assert outside <= set(ROSDEP_KEYS), (
        f"name the rosdep keys in tests/workspace.py: {outside - set(ROSDEP_KEYS)}"
    )
    keys = {ROSDEP_KEYS[name] for name in outside} - {None}
    depends = package.depends("exec_depend")
    assert depends - ROS_PACKAGES == own | keys
    assert package.depends("test_depend") == {"python3-pytest"}


@ALL
def test_versions_are_one(package: Package) -> None:
    assert package.config["metadata"]["version"] == importlib.import_module(package.name).__version__
    assert len({other.config["metadata"]["version"] for other in PACKAGES.values()}) == 1


@ALL
def test_everything_that_is_imported_is_declared(package: Package) -> None:
    modules = set().union(*(package.imports(file) for file in package.files))
    ros = modules & ROS_PACKAGES
    declared_ros = package.depends("exec_depend") & ROS_PACKAGES
    assert ros <= declared_ros, f"{package.name}/package.xml lacks {ros - declared_ros}"
    rest = {DISTRIBUTIONS.get(module, module).lower() for module in modules - ROS_PACKAGES}
    declared = package.requirements | package.optional
    assert rest <= declared, f"{package.name}/setup.cfg lacks {rest - declared}"


@ALL
def test_nothing_is_declared_that_is_not_imported(package: Package) -> None:
    modules = set().union(*(package.imports(file) for file in package.files))
    used = {DISTRIBUTIONS.get(module, module).lower() for module in modules}
    own = set(PACKAGES)
    # bringup starts everything; the launch packages are used by the launch files' front end
    if package.name != "hannes_bringup":
        unused = package.requirements - used - own
        assert not unused, f"{package.name}/setup.cfg declares {unused}"
        unused = (package.depends("exec_depend") & ROS_PACKAGES) - used
        assert not unused, f"{package.name}/package.xml declares {unused}"


@ALL
def test_imports_run_one_way(package: Package) -> None:
    for file in package.files:
        imported = package.imports(file)
        where = file.relative_to(package.folder)
        allowed = ALLOWED[package.name] | ({"hannes_ros"} if is_node_file(package, file) else set())
        ours = imported & set(ALLOWED)
        assert ours <= allowed, f"{where} may not import {ours - allowed}"
        if not is_node_file(package, file):
            assert not imported & ROS_PACKAGES, (
                f"{where}: only *_node.py files, and those in nodes/, import ROS 2"
            )


@ALL
def test_colcon_resources(package: Package) -> None:
    name = package.name
    assert (package.folder / "resource" / name).is_file()
    data = package.config["options.data_files"]
    assert data["share/ament_index/resource_index/packages"].strip() == f"resource/{name}"
    assert "package.xml" in data[f"share/{name}"].split()
    assert package.config["develop"]["script_dir"] == f"$base/lib/{name}"
    assert package.config["install"]["install_scripts"] == f"$base/lib/{name}"
    for folder, files in data.items():
        for file in files.split():
            assert (package.folder / file).is_file(), f"{name}: data_files {folder}: {file} is missing"


@ALL
def test_data_files_are_package_data(package: Package) -> None:
    """Every file that is not Python is shipped: matched by a pattern of package_data."""
    patterns = package.lines("options.package_data", package.name)
    shipped = {file for pattern in patterns for file in package.module.glob(pattern)}
    data = {file for file in package.module.rglob("*") if file.is_file() and file.suffix != ".py"}
    data = {file for file in data if "__pycache__" not in file.parts}
    assert data <= shipped, f"{package.name}: not in package_data: {sorted(map(str, data - shipped))}"


@ALL
def test_entry_points_exist(package: Package) -> None:
    for name, target in package.entry_points.items():
        module, _, function = target.partition(":")
        assert callable(getattr(importlib.import_module(module), function)), f"{name} = {target}"


def test_executables_of_the_nodes() -> None:
    declared = {(package.name, name) for package in PACKAGES.values() for name in package.entry_points}
    assert declared >= {
        ("hannes_sim", "hand_sim"),
        ("hannes_control", "motor_controller"),
        ("hannes_control", "emg_reference"),
        ("hannes_control", "emg_source"),
        ("hannes_bags", "recorder"),
        ("hannes_bags", "player"),
        ("hannes_stiffness", "stiffness_classifier"),
        ("hannes_bringup", "hannes"),
    }


def test_the_core_is_importable_without_ros() -> None:
    """Files that are no nodes load where there is no rclpy at all."""
    modules = [
        ".".join((package.name, *file.relative_to(package.module).with_suffix("").parts)).removesuffix(
            ".__init__"
        )
        for package in PACKAGES.values()
        for file in package.files
        if not is_node_file(package, file)
    ]
    code = f"""
import importlib, json, sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {sorted(ROS_PACKAGES)!r}:
            raise ModuleNotFoundError("no ROS 2 here: " + name)
sys.meta_path.insert(0, Refuse())
failed = {{}}
for name in {modules!r}:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        failed[name] = str(error)
print(json.dumps(failed))
"""
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(answer.stdout.splitlines()[-1]) == {}
