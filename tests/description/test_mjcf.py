"""The MuJoCo model: variants, wires and the mapping of stiffness."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hannes_description.errors import HannesError
from hannes_description.joints import DIGITS, JOINT_LIMITS, JOINT_NAMES
from hannes_description.mjcf import (
    RETURN_MECHANISMS,
    TRANSMISSIONS,
    Variant,
    build_spec,
    joints_of,
    reflected_mass,
    return_moments,
    tension_shares,
    transmission_jacobian,
)
from hannes_description.parameters import load_parameters

PARAMETERS = load_parameters("hannes")


@pytest.mark.parametrize("transmission", TRANSMISSIONS)
@pytest.mark.parametrize("mechanism", RETURN_MECHANISMS)
def test_every_variant_compiles_with_all_joints(mechanism: str, transmission: str) -> None:
    model = build_spec(PARAMETERS, {"return_mechanism": mechanism, "transmission": transmission}).compile()
    assert {model.joint(k).name for k in range(model.njnt)} >= set(JOINT_NAMES)
    assert model.nv == (16 if transmission == "wires" else 14)
    for name in JOINT_NAMES:
        np.testing.assert_allclose(
            model.joint(name).range, [JOINT_LIMITS[name].lower, JOINT_LIMITS[name].upper]
        )


def test_unknown_options_are_named() -> None:
    with pytest.raises(HannesError, match="return_wire, torsion_spring"):
        Variant(return_mechanism="rubber")
    with pytest.raises(HannesError, match="wires, forces"):
        Variant(transmission="belt")
    with pytest.raises(HannesError, match="unknown options colour"):
        Variant.of({"colour": "red"})
    without = {name: p for name, p in PARAMETERS.items() if name != "carts.mass"}
    with pytest.raises(HannesError, match=r"carts\.mass"):
        build_spec(without)


def test_the_differential_shares_the_tension_as_the_thesis_says() -> None:
    ra, rb = 0.004, 0.007
    shares = tension_shares(PARAMETERS.with_values({"pulleys.index_lever": ra, "pulleys.middle_lever": rb}))
    assert shares["index"] == pytest.approx(2.0 * rb / (ra + rb))
    assert shares["middle"] == pytest.approx(2.0 * ra / (ra + rb))
    assert shares["thumb"] == 1.0


def test_all_wires_together_take_up_the_pulley_range() -> None:
    taken = sum(arm * JOINT_LIMITS[name].upper for name, arm in transmission_jacobian(PARAMETERS).items())
    assert taken == pytest.approx(
        PARAMETERS.value("hand.travel") * PARAMETERS.value("pulley.radius"), rel=0.01
    )


@pytest.mark.parametrize("transmission", TRANSMISSIONS)
def test_the_rotor_is_felt_at_the_wire(transmission: str) -> None:
    """A force on the taut wire accelerates rotor and hand together: nearly F/m, since the hand is light."""
    off = {
        "friction.coulomb": 0.0,
        "friction.viscous": 0.0,
        "joints.friction_tension": 0.0,
        "carts.friction": 0.0,
        "joints.damping_tension": 0.0,
        "carts.damping": 0.0,
    }
    model = build_spec(PARAMETERS.with_values(off), {"transmission": transmission}).compile()
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SPRING | mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    data = mujoco.MjData(model)
    data.joint("motor").qfrc_applied[0] = 10.0
    mujoco.mj_step(model, data, 400)
    speed = float(data.joint("motor").qvel[0])
    assert 0.9 < speed / (10.0 / reflected_mass(PARAMETERS) * data.time) < 1.0
    assert sum(data.joint(name).qvel[0] > 0.01 for name in transmission_jacobian(PARAMETERS)) >= 5


def test_torsion_springs_have_the_return_wires_moments_at_both_ends() -> None:
    wires = build_spec(PARAMETERS).compile()
    springs = build_spec(PARAMETERS, {"return_mechanism": "torsion_spring"}).compile()
    moments = return_moments(PARAMETERS)
    for share in (0.0, 1.0):
        passive = []
        for model in (wires, springs):
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
            data = mujoco.MjData(model)
            for name in moments:
                data.joint(name).qpos[0] = share * JOINT_LIMITS[name].upper
            mujoco.mj_forward(model, data)
            passive.append([float(data.joint(name).qfrc_passive[0]) for name in moments])
        np.testing.assert_allclose(passive[0], passive[1], rtol=1e-9)
        expected = [-(m0 + k * share * JOINT_LIMITS[name].upper) for name, (m0, k) in moments.items()]
        np.testing.assert_allclose(passive[1], expected, rtol=1e-9)


def test_every_digit_has_a_return_wire() -> None:
    model = build_spec(PARAMETERS).compile()
    names = {model.tendon(k).name for k in range(model.ntendon)}
    assert {f"return_{digit}" for digit in DIGITS} <= names
    assert all(joints_of(digit) for digit in DIGITS)
