"""The silent failures of a wire-driven multi-body model: each would give plausible pictures and wrong numbers."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hannes_description.joints import DIGITS, FINGERS, JOINT_LIMITS
from hannes_description.mjcf import (
    CARTS,
    MASTER,
    PAIRS,
    SLAVES,
    build_spec,
    contact_stiffness,
    joints_of,
    return_moments,
    tension_shares,
    wire_arms,
)
from hannes_description.parameters import ParameterSet, load_parameters
from hannes_sim.objects import RIGID_DYNAMOMETER, SOFT_BALL, GraspObject

PARAMETERS = load_parameters("hannes")

FRICTIONLESS = {"friction.coulomb": 0.0, "joints.friction_tension": 0.0, "carts.friction": 0.0}
UNSPRUNG = {f"springs.{digit}_preload": 0.0 for digit in DIGITS} | {
    f"springs.{digit}_rate": 1e-9 for digit in DIGITS
}
WEIGHTLESS = {"gravity.palmar": 0.0, "gravity.radial": 0.0, "gravity.distal": 0.0}


class Bench:
    """A hand whose wire is pulled with a given force."""

    def __init__(
        self,
        parameters: ParameterSet = PARAMETERS,
        grasp: GraspObject | None = None,
        dt: float = 0.25e-3,
        **variant: object,
    ) -> None:
        # The real motor's back-EMF keeps it from running away; here a viscous friction does.
        parameters = parameters.with_values({"friction.viscous": 0.002})
        spec = build_spec(parameters, variant, grasp)
        spec.option.timestep = dt
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.parameters = parameters

    def pull(self, force: float, seconds: float, ramp: float = 0.1) -> None:
        """Raise the force [N] on the master wire over `ramp` and hold it for `seconds` in all."""
        motor = self.model.joint("motor").dofadr[0]
        start = self.data.qfrc_applied[motor]
        steps = round(seconds / self.model.opt.timestep)
        for k in range(steps):
            share = min(1.0, k * self.model.opt.timestep / ramp)
            self.data.qfrc_applied[motor] = start + share * (force - start)
            mujoco.mj_step(self.model, self.data)
        assert not any(self.data.warning.number)

    def tension(self, wire: str) -> float:
        return float(self.data.sensor(f"tension_{wire}").data[0])

    def stretch(self, wire: str) -> float:
        return float(self.data.ten_length[self.model.tendon(wire).id])

    def angle(self, joint: str) -> float:
        return float(self.data.joint(joint).qpos[0])


@pytest.mark.parametrize("stiffness", [2.0e4, 1.0e5, 3.0e5])
def test_a_wire_stretches_by_force_over_stiffness(stiffness: float) -> None:
    bench = Bench(PARAMETERS.with_values({"wires.master_stiffness": stiffness}))
    bench.pull(120.0, 2.0, ramp=0.8)
    slaves = PARAMETERS.value("wires.slave_stiffness")
    for wire, expected in zip((MASTER, *SLAVES), (stiffness, slaves, slaves), strict=True):
        assert bench.tension(wire) > 50.0
        assert bench.stretch(wire) == pytest.approx(bench.tension(wire) / expected, rel=2e-4)


def test_at_rest_the_wire_carries_the_motors_force() -> None:
    bench = Bench(PARAMETERS.with_values({"friction.coulomb": 0.0}))
    bench.pull(60.0, 6.0, ramp=0.8)
    assert bench.tension(MASTER) == pytest.approx(60.0, rel=1e-3)


@pytest.mark.parametrize("joint", ["index_mcp", "index_pip", "little_mcp", "little_pip", "thumb_abd"])
def test_a_joint_does_not_bounce_from_its_stop(joint: str) -> None:
    """Thrown at its stop it comes back with a third of its speed at most, and has not gone through by a degree."""
    bench = Bench(PARAMETERS.with_values(FRICTIONLESS | WEIGHTLESS | UNSPRUNG))
    bench.data.joint("motor").qpos[0] = -0.1
    limit, speed = JOINT_LIMITS[joint].upper, 5.0
    bench.data.joint(joint).qpos[0] = limit - 0.01
    bench.data.joint(joint).qvel[0] = speed
    deepest = slowest = 0.0
    for _ in range(200):
        mujoco.mj_step(bench.model, bench.data)
        deepest = max(deepest, bench.angle(joint) - limit)
        slowest = min(slowest, float(bench.data.joint(joint).qvel[0]))
    assert 0.0 < np.degrees(deepest) < 1.0
    assert -slowest < 0.3 * speed


def test_a_stop_gives_way_by_moment_over_stiffness() -> None:
    bench = Bench(PARAMETERS.with_values(WEIGHTLESS))
    bench.pull(100.0, 3.0, ramp=1.0)
    stop = PARAMETERS.value("joints.stop_stiffness")
    for joint in (joint for digit in DIGITS for joint in joints_of(digit)):
        # The stop carries what the wire's moment exceeds the return wire's, give or take the dry friction.
        wire = sum(
            -bench.tension(w) * float(bench.data.ten_J.flat[at]) for w, at in wire_entries(bench, joint)
        )
        carried = wire + float(bench.data.joint(joint).qfrc_passive[0])
        friction = float(bench.model.dof_frictionloss[bench.model.joint(joint).dofadr[0]])
        assert carried > 5.0 * friction
        assert stop * (bench.angle(joint) - JOINT_LIMITS[joint].upper) == pytest.approx(
            carried, abs=friction + 1e-6
        )


def wire_entries(bench: Bench, joint: str) -> list[tuple[str, int]]:
    """Wires that act on a joint, with the place of the arm in the sparse tendon Jacobian."""
    dof = bench.model.joint(joint).dofadr[0]
    out = []
    for wire in (MASTER, *SLAVES):
        k = bench.model.tendon(wire).id
        row = bench.model.ten_J_rowadr[k] + np.arange(bench.model.ten_J_rownnz[k])
        out += [(wire, int(at)) for at in row if bench.model.ten_J_colind[at] == dof]
    return out


def test_friction_holds_a_load_for_seconds() -> None:
    """A force below the breakaway moves nothing: the motor by less than 1 um/s, no joint by 0.03 deg/s."""
    parameters = PARAMETERS.with_values(
        {"friction.coulomb": 0.03, "joints.friction_tension": 3.0} | WEIGHTLESS
    )
    bench = Bench(parameters)
    bench.pull(20.0, 0.6)
    assert bench.angle("index_mcp") > 0.2
    bench.pull(8.0, 0.5, ramp=0.2)
    names = ["motor", *CARTS, *(joint for digit in DIGITS for joint in joints_of(digit))]
    before = {name: bench.angle(name) for name in names}
    bench.pull(8.0, 3.0)
    after = {name: bench.angle(name) for name in names}
    assert abs(after["motor"] - before["motor"]) < 3e-6
    for name in names[3:]:
        assert np.degrees(abs(after[name] - before[name])) < 0.1, name


def test_carts_balance_and_wires_move_joints_by_tension_times_arm() -> None:
    """P14: with F on the master wire, a slave wire has 2F less the cart's spring; finger a gets rb/(ra+rb) of it."""
    parameters = PARAMETERS.with_values(
        FRICTIONLESS | WEIGHTLESS | {"pulleys.index_lever": 0.004, "pulleys.middle_lever": 0.006}
    )
    # Stiff return springs, so that every joint comes to rest between its stops.
    parameters = parameters.with_values({f"springs.{digit}_rate": 3000.0 for digit in DIGITS})
    bench = Bench(parameters, return_mechanism="torsion_spring")
    bench.pull(10.0, 6.0, ramp=0.5)
    force = bench.tension(MASTER)
    assert force == pytest.approx(10.0, rel=1e-3)
    shares, arms, moments = tension_shares(parameters), wire_arms(parameters), return_moments(parameters)
    for wire, cart in zip(SLAVES, CARTS, strict=True):
        spring = parameters.value("carts.preload") + parameters.value("carts.stiffness") * bench.angle(cart)
        assert bench.tension(wire) == pytest.approx(2.0 * force - spring, rel=1e-3)
    between = 0
    for digit in DIGITS:
        tension = force
        if digit != "thumb":
            wire = SLAVES[[digit in pair for pair in PAIRS].index(True)]
            tension = 0.5 * shares[digit] * bench.tension(wire)
        for joint in joints_of(digit):
            limit = JOINT_LIMITS[joint]
            if limit.lower + 0.01 < bench.angle(joint) < limit.upper - 0.01:
                m0, k = moments[joint]
                assert m0 + k * bench.angle(joint) == pytest.approx(arms[joint] * tension, rel=2e-3), joint
                between += 1
    assert between >= 4
    assert shares["index"] / shares["middle"] == pytest.approx(1.5)


def test_a_slack_wire_neither_pulls_nor_pushes() -> None:
    bench = Bench()
    bench.pull(20.0, 0.4)
    bench.pull(-12.0, 1.0, ramp=0.05)
    assert bench.angle("motor") < -1e-3
    assert bench.stretch(MASTER) < 0.0
    assert bench.tension(MASTER) == 0.0
    for finger in FINGERS:
        assert bench.angle(f"{finger}_mcp") > -0.01
    lowest = 0.0
    for force in (8.0, 0.0, 15.0, -3.0, 30.0):
        bench.pull(force, 0.05, ramp=0.01)
        lowest = min([lowest, *(bench.tension(wire) for wire in (MASTER, *SLAVES))])
    assert lowest >= 0.0


@pytest.mark.parametrize("grasp", [SOFT_BALL, RIGID_DYNAMOMETER], ids=["soft", "rigid"])
def test_a_contact_gives_way_by_force_over_stiffness(grasp: GraspObject) -> None:
    bench = Bench(PARAMETERS, grasp)
    bench.pull(30.0, 1.5)
    stiffness, damping = contact_stiffness(grasp)
    force = np.zeros(6)
    total = 0.0
    assert bench.data.ncon >= 3
    for k in range(bench.data.ncon):
        mujoco.mj_contactForce(bench.model, bench.data, k, force)
        contact = bench.data.contact[k]
        speed = -float(bench.data.efc_vel[contact.efc_address])
        assert force[0] == pytest.approx(-stiffness * contact.dist + damping * speed, rel=2e-3, abs=2e-3)
        total += force[0]
    assert bench.data.sensor("grip_force").data[0] == pytest.approx(total, rel=1e-6)


def test_a_falling_finger_keeps_its_energy() -> None:
    """No friction, no springs, wires slack: what gravity gives is kinetic energy."""
    off = UNSPRUNG | {"joints.damping_tension": 0.0, "joints.abd_damping": 0.0, "gravity.palmar": 9.80665}
    drift = []
    for dt in (0.25e-3, 0.125e-3):
        bench = Bench(PARAMETERS.with_values(off | FRICTIONLESS), dt=dt)
        bench.model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
        bench.data.joint("motor").qpos[0] = -0.1
        for finger in FINGERS:
            bench.data.joint(f"{finger}_mcp").qpos[0] = 0.2
            bench.data.joint(f"{finger}_pip").qpos[0] = 0.4
        mujoco.mj_forward(bench.model, bench.data)
        start = bench.data.energy.sum()
        mujoco.mj_step(bench.model, bench.data, round(0.03 / dt))
        mujoco.mj_forward(bench.model, bench.data)
        given = bench.data.energy[1]
        assert given > 2e-4
        moving = [joint for finger in FINGERS for joint in joints_of(finger)]
        assert all(0.0 < bench.angle(joint) < JOINT_LIMITS[joint].upper for joint in moving)
        drift.append(abs(bench.data.energy.sum() - start) / given)
    assert drift[0] < 0.01
    assert drift[1] < 0.6 * drift[0]
