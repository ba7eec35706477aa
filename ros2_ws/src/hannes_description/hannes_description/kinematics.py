"""The tree of links and joints, from the parameters; MJCF and URDF are both written from it.

Palm frame (REP-103 units, base_link): x palmar, y radial, z distal, origin at the wrist.  Every moving link's frame
sits in its joint with z along the straight finger and y the flexion axis, so that a positive angle flexes.  ABD turns
about -x: positive is radial.  The thumb's rotation is a weld at one of the stops.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import HannesError
from .joints import FINGERS, JOINT_LIMITS, JOINT_NAMES, THUMB_STOPS_DEG, JointLimit
from .parameters import Parameter

Array = NDArray[np.float64]
Parameters = Mapping[str, Parameter]

ROOT = "base_link"
"""Name of the palm, the root of the tree."""


def value(parameters: Parameters, name: str) -> float:
    """The value of one parameter; the error names what is missing."""
    if name not in parameters:
        raise HannesError(f"The hand's mechanics need the parameter '{name}', which the set does not have.")
    return parameters[name].value


@dataclass(frozen=True)
class Joint:
    """A hinge: name, unit axis in the link's own frame, range in rad."""

    name: str
    axis: tuple[float, float, float]
    limit: JointLimit


@dataclass(frozen=True)
class Link:
    """One rigid link, in SI.

    parent        name of the parent link
    position      (3,) of the link's frame in the parent's, m
    rpy           roll, pitch, yaw of the frame, rad: R = Rz(yaw) Ry(pitch) Rx(roll) (URDF's convention)
    joint         the hinge at the origin of the frame, or None for a weld
    mass, com     kg; distance of the centre of mass along z, m
    inertia       (3,) principal moments about the centre of mass along x, y (flexion), z, kg m2
    length        distance along z to the next joint or the tip pad, m; 0 for links without a shape
    radius        half the thickness, m
    overhang      length of the finger beyond the tip pad, m
    """

    name: str
    parent: str
    position: tuple[float, float, float]
    rpy: tuple[float, float, float]
    joint: Joint | None
    mass: float
    com: float
    inertia: tuple[float, float, float]
    length: float = 0.0
    radius: float = 0.0
    overhang: float = 0.0


def _moments(flexion: float) -> tuple[float, float, float]:
    # A slender link: the two transverse moments are equal, the one about its length is small.  Only flexion is given
    # by the source; the other two move nothing but the stiffly sprung ABD.
    return flexion, flexion, 0.25 * flexion


def check_thumb_stop(thumb_stop_deg: float) -> int:
    """The stop in degrees if it is one of the thumb's three stops, otherwise an error that lists them."""
    if thumb_stop_deg not in THUMB_STOPS_DEG:
        raise HannesError(
            f"The thumb's rotation stop is {thumb_stop_deg} deg; valid are "
            f"{', '.join(str(s) for s in THUMB_STOPS_DEG)}."
        )
    return int(thumb_stop_deg)


def links(parameters: Parameters, thumb_stop_deg: float = 0) -> tuple[Link, ...]:
    """All moving links and the welded thumb base, parents before children.

    Sources: thesis P04-P08 for the tree and its limits, section 4 for lengths, masses and inertias.
    """
    stop = check_thumb_stop(thumb_stop_deg)

    def v(name: str) -> float:
        return value(parameters, name)

    out: list[Link] = []
    flex = (0.0, 1.0, 0.0)
    for finger in FINGERS:
        place = (v(f"geometry.{finger}_x"), v(f"geometry.{finger}_y"), v(f"geometry.{finger}_z"))
        radius = v(f"geometry.{finger}_radius")
        proximal, distal = v(f"geometry.{finger}_proximal"), v(f"geometry.{finger}_distal")
        base = v("inertia.base_inertia")
        abd, mcp, pip = (f"{finger}_{joint}" for joint in ("abd", "mcp", "pip"))
        out.append(
            Link(
                f"{finger}_base",
                ROOT,
                place,
                (0.0, 0.0, 0.0),
                Joint(abd, (-1.0, 0.0, 0.0), JOINT_LIMITS[abd]),
                v("inertia.base_mass"),
                0.0,
                (base, base, base),
            )
        )
        out.append(
            Link(
                f"{finger}_phalanx",
                f"{finger}_base",
                (0.0, 0.0, 0.0),
                (0.0, 0.0, 0.0),
                Joint(mcp, flex, JOINT_LIMITS[mcp]),
                v(f"inertia.{finger}_m1"),
                v(f"inertia.{finger}_lm1"),
                _moments(v(f"inertia.{finger}_j1")),
                proximal,
                radius,
            )
        )
        out.append(
            Link(
                f"{finger}_middle",
                f"{finger}_phalanx",
                (0.0, 0.0, proximal),
                (0.0, 0.0, 0.0),
                Joint(pip, flex, JOINT_LIMITS[pip]),
                v(f"inertia.{finger}_m2"),
                v(f"inertia.{finger}_lm2"),
                _moments(v(f"inertia.{finger}_j2")),
                distal,
                0.92 * radius,
                v("geometry.tip_overhang"),
            )
        )
    place = (v("geometry.thumb_x"), v("geometry.thumb_y"), v("geometry.thumb_z"))
    # The rotation turns the whole thumb about the palm's long axis.  A stop of -60 deg lays it beside the index.
    yaw = v("geometry.thumb_yaw") - math.radians(stop)
    rpy = (v("geometry.thumb_roll"), v("geometry.thumb_pitch"), yaw)
    base = v("inertia.base_inertia")
    out.append(Link("thumb_base", ROOT, place, rpy, None, v("inertia.base_mass"), 0.0, (base, base, base)))
    out.append(
        Link(
            "thumb",
            "thumb_base",
            (0.0, 0.0, 0.0),
            (0.0, 0.0, 0.0),
            Joint("thumb_abd", flex, JOINT_LIMITS["thumb_abd"]),
            v("inertia.thumb_m1"),
            v("inertia.thumb_lm1"),
            _moments(v("inertia.thumb_j1")),
            v("geometry.thumb_length"),
            v("geometry.thumb_radius"),
            v("geometry.tip_overhang"),
        )
    )
    return tuple(out)


def rotation(rpy: tuple[float, float, float]) -> Array:
    """Rotation matrix (3, 3) of roll, pitch, yaw: Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr = math.cos(rpy[0]), math.sin(rpy[0])
    cp, sp = math.cos(rpy[1]), math.sin(rpy[1])
    cy, sy = math.cos(rpy[2]), math.sin(rpy[2])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def quaternion(rpy: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z) of roll, pitch, yaw."""
    cr, sr = math.cos(rpy[0] / 2), math.sin(rpy[0] / 2)
    cp, sp = math.cos(rpy[1] / 2), math.sin(rpy[1] / 2)
    cy, sy = math.cos(rpy[2] / 2), math.sin(rpy[2] / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def axis_rotation(axis: tuple[float, float, float], angle: float) -> Array:
    """Rotation matrix (3, 3) about a unit axis by an angle in rad (Rodrigues)."""
    x, y, z = axis
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    out: Array = np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * (k @ k)
    return out


def forward_kinematics(tree: tuple[Link, ...], positions: Array) -> dict[str, tuple[Array, Array]]:
    """Position (3,) in m and rotation (3, 3) of every link in the palm frame, for joint positions (13,) in rad."""
    if np.shape(positions) != (len(JOINT_NAMES),):
        raise HannesError(
            f"Joint positions must have shape ({len(JOINT_NAMES)},), not {np.shape(positions)}."
        )
    angle = dict(zip(JOINT_NAMES, positions, strict=True))
    poses: dict[str, tuple[Array, Array]] = {ROOT: (np.zeros(3), np.eye(3))}
    for link in tree:
        origin, frame = poses[link.parent]
        own = rotation(link.rpy)
        if link.joint is not None:
            own = own @ axis_rotation(link.joint.axis, angle[link.joint.name])
        poses[link.name] = (origin + frame @ np.array(link.position), frame @ own)
    return poses
