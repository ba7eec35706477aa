"""The hand as URDF, written from the same tree as the MuJoCo model (hannes_description.kinematics).

What URDF cannot say (wires, carts, return springs, the motor) is left out: the file is for tf, RViz and planners.
Frames, limits, masses and inertias are those of the MuJoCo model; `data/urdf/hannes.urdf` is this generator's output
for the shipped parameters and the thumb's stop 0.

    python -m hannes_description.urdf        prints the file
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

from .joints import FINGERS, JOINT_LIMITS
from .kinematics import ROOT, Link, Parameters, links, value
from .parameters import data_path, load_parameters

_MATERIALS = {"shell": "0.80 0.81 0.83 1", "palm": "0.24 0.26 0.30 1"}


def _numbers(*values: float) -> str:
    # 17 digits, so that the frames are those of the MuJoCo model to the last bit
    return " ".join(f"{v + 0.0:.17g}" for v in values)


def _inertial(parent: ET.Element, link: Link) -> None:
    inertial = ET.SubElement(parent, "inertial")
    ET.SubElement(inertial, "origin", xyz=_numbers(0.0, 0.0, link.com), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=_numbers(link.mass))
    ET.SubElement(
        inertial,
        "inertia",
        ixx=_numbers(link.inertia[0]),
        ixy="0",
        ixz="0",
        iyy=_numbers(link.inertia[1]),
        iyz="0",
        izz=_numbers(link.inertia[2]),
    )


def _capsule(parent: ET.Element, length: float, radius: float, material: str) -> None:
    """A cylinder along z from the origin, with a ball on each end (URDF has no capsule)."""
    for centre, size in ((0.0, None), (length, None), (0.5 * length, length)):
        for kind in ("visual", "collision"):
            shape = ET.SubElement(parent, kind)
            ET.SubElement(shape, "origin", xyz=_numbers(0.0, 0.0, centre), rpy="0 0 0")
            geometry = ET.SubElement(shape, "geometry")
            if size is None:
                ET.SubElement(geometry, "sphere", radius=_numbers(radius))
            else:
                ET.SubElement(geometry, "cylinder", radius=_numbers(radius), length=_numbers(size))
            if kind == "visual":
                ET.SubElement(shape, "material", name=material)


def _palm(parent: ET.Element, parameters: Parameters) -> None:
    """Metacarpals as cylinders from the wrist to every MCP; shape only."""
    for finger in FINGERS:
        end = [value(parameters, f"geometry.{finger}_{axis}") for axis in "xyz"]
        start = [0.6 * end[0] - 0.001, 0.62 * end[1], 0.020]
        along = [b - a for a, b in zip(start, end, strict=True)]
        length = math.sqrt(sum(c * c for c in along))
        pitch = math.atan2(math.hypot(along[0], along[1]), along[2])
        visual = ET.SubElement(parent, "visual")
        ET.SubElement(
            visual,
            "origin",
            xyz=_numbers(*(0.5 * (a + b) for a, b in zip(start, end, strict=True))),
            rpy=_numbers(0.0, pitch, math.atan2(along[1], along[0])),
        )
        geometry = ET.SubElement(visual, "geometry")
        ET.SubElement(
            geometry,
            "cylinder",
            length=_numbers(length),
            radius=_numbers(1.22 * value(parameters, f"geometry.{finger}_radius")),
        )
        ET.SubElement(visual, "material", name="palm")


def build_urdf(parameters: Parameters, thumb_stop_deg: float = 0) -> str:
    """The URDF text; raises HannesError for a missing parameter or an unknown thumb stop."""
    robot = ET.Element("robot", name="hannes")
    robot.append(
        ET.Comment(" Generated: python -m hannes_description.urdf; x palmar, y radial, z distal; SI units. ")
    )
    for name, rgba in _MATERIALS.items():
        ET.SubElement(ET.SubElement(robot, "material", name=name), "color", rgba=rgba)
    _palm(ET.SubElement(robot, "link", name=ROOT), parameters)
    for link in links(parameters, thumb_stop_deg):
        element = ET.SubElement(robot, "link", name=link.name)
        _inertial(element, link)
        if link.length > 0.0:
            end = link.length + link.overhang - (link.radius if link.overhang else 0.0)
            _capsule(element, end, link.radius, "shell")
        fixed = link.joint is None
        joint = ET.SubElement(
            robot,
            "joint",
            name=f"{link.name}_rot" if link.joint is None else link.joint.name,
            type="fixed" if fixed else "revolute",
        )
        ET.SubElement(joint, "parent", link=link.parent)
        ET.SubElement(joint, "child", link=link.name)
        ET.SubElement(joint, "origin", xyz=_numbers(*link.position), rpy=_numbers(*link.rpy))
        if link.joint is not None:
            limit = JOINT_LIMITS[link.joint.name]
            ET.SubElement(joint, "axis", xyz=_numbers(*link.joint.axis))
            ET.SubElement(
                joint,
                "limit",
                lower=_numbers(limit.lower),
                upper=_numbers(limit.upper),
                effort="5",
                velocity="20",
            )
    ET.indent(robot, space="  ")
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def urdf_path() -> Path:
    """Path of the URDF that the package ships (stop 0, nominal parameters)."""
    return data_path("urdf", "hannes.urdf")


if __name__ == "__main__":
    print(build_urdf(load_parameters("hannes")), end="")
