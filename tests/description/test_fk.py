"""URDF, MJCF and the link tree describe one and the same hand."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest
from hannes_description.errors import HannesError
from hannes_description.joints import JOINT_LIMITS, JOINT_NAMES, THUMB_STOPS_DEG
from hannes_description.kinematics import axis_rotation, forward_kinematics, links, quaternion, rotation
from hannes_description.mjcf import build_spec
from hannes_description.parameters import load_parameters
from hannes_description.urdf import build_urdf, urdf_path

PARAMETERS = load_parameters("hannes")


def urdf_kinematics(text: str, positions: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Forward kinematics of a URDF, independent of the project's own."""
    angle = dict(zip(JOINT_NAMES, positions, strict=True))
    robot = ET.fromstring(text)
    poses = {"base_link": (np.zeros(3), np.eye(3))}
    for joint in robot.findall("joint"):
        origin = joint.find("origin")
        xyz = np.array([float(c) for c in origin.get("xyz").split()])
        roll, pitch, yaw = (float(c) for c in origin.get("rpy").split())
        rx = axis_rotation((1.0, 0.0, 0.0), roll)
        ry = axis_rotation((0.0, 1.0, 0.0), pitch)
        rz = axis_rotation((0.0, 0.0, 1.0), yaw)
        frame = rz @ ry @ rx
        if joint.get("type") == "revolute":
            axis = tuple(float(c) for c in joint.find("axis").get("xyz").split())
            frame = frame @ axis_rotation(axis, angle[joint.get("name")])
        place, turn = poses[joint.find("parent").get("link")]
        poses[joint.find("child").get("link")] = (place + turn @ xyz, turn @ frame)
    return poses


@pytest.mark.parametrize("stop", THUMB_STOPS_DEG)
def test_urdf_and_mjcf_agree_for_random_joint_positions(stop: int) -> None:
    rng = np.random.default_rng(7)
    model = build_spec(PARAMETERS, {"thumb_stop_deg": stop}).compile()
    data = mujoco.MjData(model)
    text = build_urdf(PARAMETERS, stop)
    tree = links(PARAMETERS, stop)
    low = np.array([JOINT_LIMITS[name].lower for name in JOINT_NAMES])
    high = np.array([JOINT_LIMITS[name].upper for name in JOINT_NAMES])
    for _ in range(20):
        positions = rng.uniform(low, high)
        for name, position in zip(JOINT_NAMES, positions, strict=True):
            data.joint(name).qpos[0] = position
        mujoco.mj_kinematics(model, data)
        from_urdf = urdf_kinematics(text, positions)
        from_tree = forward_kinematics(tree, positions)
        assert set(from_urdf) == set(from_tree)
        for name, (place, frame) in from_urdf.items():
            body = data.body(name)
            np.testing.assert_allclose(place, body.xpos, atol=1e-9)
            np.testing.assert_allclose(frame, body.xmat.reshape(3, 3), atol=1e-9)
            np.testing.assert_allclose(place, from_tree[name][0], atol=1e-12)
            np.testing.assert_allclose(frame, from_tree[name][1], atol=1e-12)


def test_shipped_urdf_is_what_the_generator_writes() -> None:
    assert urdf_path().read_text(encoding="utf-8") == build_urdf(PARAMETERS)


def test_urdf_has_the_masses_inertias_and_limits_of_the_mujoco_model() -> None:
    robot = ET.fromstring(build_urdf(PARAMETERS))
    model = build_spec(PARAMETERS).compile()
    for link in robot.findall("link"):
        inertial = link.find("inertial")
        if inertial is None:
            continue
        body = model.body(link.get("name"))
        assert float(inertial.find("mass").get("value")) == pytest.approx(body.mass[0], rel=1e-12)
        assert float(inertial.find("origin").get("xyz").split()[2]) == pytest.approx(body.ipos[2], abs=1e-15)
        written = [float(inertial.find("inertia").get(k)) for k in ("ixx", "iyy", "izz")]
        np.testing.assert_allclose(sorted(written), sorted(body.inertia), rtol=1e-9)
    revolute = {j.get("name"): j for j in robot.findall("joint") if j.get("type") == "revolute"}
    assert tuple(revolute) == JOINT_NAMES
    for name, joint in revolute.items():
        written = [float(joint.find("limit").get(k)) for k in ("lower", "upper")]
        np.testing.assert_allclose(written, [JOINT_LIMITS[name].lower, JOINT_LIMITS[name].upper], rtol=1e-15)


def test_it_is_a_right_hand_and_flexion_moves_the_fingertips_to_the_palm() -> None:
    tree = links(PARAMETERS)
    straight = forward_kinematics(tree, np.zeros(len(JOINT_NAMES)))
    # x palmar, y radial, z distal: thumb palmar and radial of the middle finger, index radial of the little one
    assert straight["thumb"][0][0] > straight["middle_phalanx"][0][0]
    assert straight["index_phalanx"][0][1] > straight["little_phalanx"][0][1]
    assert np.linalg.det(np.column_stack([[1, 0, 0], [0, 1, 0], [0, 0, 1]])) == 1.0
    bent = np.array([0.5 if name.endswith(("mcp", "pip")) else 0.0 for name in JOINT_NAMES])
    flexed = forward_kinematics(tree, bent)
    for finger in ("index", "middle", "ring", "little"):
        assert flexed[f"{finger}_middle"][0][0] > straight[f"{finger}_middle"][0][0] + 0.01
    aside = np.array([0.08 if name == "index_abd" else 0.0 for name in JOINT_NAMES])
    assert forward_kinematics(tree, aside)["index_middle"][0][1] > straight["index_middle"][0][1]


def test_quaternion_is_the_rotation() -> None:
    rng = np.random.default_rng(3)
    for _ in range(10):
        rpy = tuple(rng.uniform(-3.0, 3.0, 3))
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, np.array(quaternion(rpy)))
        np.testing.assert_allclose(matrix.reshape(3, 3), rotation(rpy), atol=1e-14)


def test_wrong_input_is_named() -> None:
    with pytest.raises(HannesError, match="valid are 0, -30, -60"):
        links(PARAMETERS, 15)
    with pytest.raises(HannesError, match=r"geometry\.index_x"):
        links({name: p for name, p in PARAMETERS.items() if name != "geometry.index_x"})
    with pytest.raises(HannesError, match="shape"):
        forward_kinematics(links(PARAMETERS), np.zeros(4))
