"""What the packages of ros2_ws/src declare and import, read from their files."""

from __future__ import annotations

import ast
import configparser
import re
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

SOURCES = Path(__file__).resolve().parents[1] / "ros2_ws" / "src"

ROSDEP_KEYS = {
    "jinja2": "python3-jinja2",
    "joblib": "python3-joblib",
    "matplotlib": "python3-matplotlib",
    "mujoco": "python3-mujoco-pip",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "onnxruntime": "python3-onnxruntime-pip",
    "pillow": "python3-pil",
    "pyyaml": "python3-yaml",
    "rich": "python3-rich",
    "rosbags": "python3-rosbags-pip",
    "scikit-learn": "python3-sklearn",
    "scipy": "python3-scipy",
    "typer": "python3-typer",
    # no rosdep key known, or a part of another package; by pip only
    "llvmlite": None,
    "markupsafe": None,
    "lz4": None,
    "mcap": None,
    "onnx": None,
    "skl2onnx": None,
    "zstandard": None,
}
"""Name on PyPI (lower case) -> rosdep key."""

DISTRIBUTIONS = {"yaml": "pyyaml", "sklearn": "scikit-learn", "PIL": "pillow"}
"""Module -> name on PyPI, where they differ."""

ROS_PACKAGES = {
    "ament_index_python",
    "builtin_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "launch",
    "launch_ros",
    "launch_yaml",
    "lifecycle_msgs",
    "rcl_interfaces",
    "rclpy",
    "robot_state_publisher",
    "ros2launch",
    "rosgraph_msgs",
    "rviz2",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
}


@dataclass(frozen=True)
class Package:
    """One package of the workspace."""

    folder: Path

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def module(self) -> Path:
        return self.folder / self.name

    @property
    def config(self) -> configparser.ConfigParser:
        config = configparser.ConfigParser(interpolation=None)
        config.read(self.folder / "setup.cfg", encoding="utf-8")
        return config

    def lines(self, section: str, option: str) -> list[str]:
        stripped = (
            line.split("#")[0].strip() for line in self.config.get(section, option, fallback="").splitlines()
        )
        return [line for line in stripped if line]

    @property
    def requirements(self) -> set[str]:
        """Names in install_requires, lower case; our own packages as they are spelt."""
        return {
            re.split(r"[\s<>=!~\[;]", line)[0].lower() for line in self.lines("options", "install_requires")
        }

    @property
    def optional(self) -> set[str]:
        """Names in the extras, lower case."""
        extras = "options.extras_require"
        names = self.config[extras] if self.config.has_section(extras) else ()
        return {
            re.split(r"[\s<>=!~\[;]", line)[0].lower() for name in names for line in self.lines(extras, name)
        }

    @property
    def entry_points(self) -> dict[str, str]:
        pairs = (line.split("=", 1) for line in self.lines("options.entry_points", "console_scripts"))
        return {name.strip(): target.strip() for name, target in pairs}

    @property
    def manifest(self) -> ElementTree.Element:
        return ElementTree.parse(self.folder / "package.xml").getroot()

    def depends(self, tag: str) -> set[str]:
        return {str(element.text) for element in self.manifest.findall(tag)}

    @property
    def files(self) -> list[Path]:
        return sorted(self.module.rglob("*.py"))

    def imports(self, file: Path) -> set[str]:
        """Top-level modules that a file imports, the standard library and its own package left out."""
        found = set()
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                found.add(node.module.split(".")[0])
        return found - sys.stdlib_module_names - {self.name}


PACKAGES = {
    folder.name: Package(folder) for folder in sorted(p.parent for p in SOURCES.glob("*/package.xml"))
}
