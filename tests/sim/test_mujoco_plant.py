"""The MuJoCo plant: effects, sensors, reset, divergence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hannes_control.double_pid import DoublePID
from hannes_control.reference import half_sine
from hannes_description.errors import HannesError
from hannes_description.joints import JOINT_LIMITS, JOINT_NAMES
from hannes_description.model import Model
from hannes_sim.effect import load_effect
from hannes_sim.mujoco_plant import MujocoPlant, load_curve
from hannes_sim.objects import RIGID_DYNAMOMETER, SOFT_BALL, GraspObject
from hannes_sim.plant import PlantDiverged
from hannes_sim.ports import R_LOAD, R_Q, R_QL
from hannes_sim.rollout import Rollout, rollout

MODEL = Model.load("nominal_mujoco")
CLOSURE = half_sine()[:2000]

VARIANTS = [
    {"return_mechanism": mechanism, "transmission": transmission}
    for mechanism in ("return_wire", "torsion_spring")
    for transmission in ("wires", "forces")
]


def close(
    model: Model = MODEL,
    grasp: GraspObject | None = None,
    *,
    dt: float = 0.25e-3,
    reference: np.ndarray = CLOSURE,
) -> Rollout:
    return rollout(MujocoPlant(model, grasp, dt=dt), DoublePID.of_model(model.parameters), reference)


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: "-".join(v.values()))
def test_every_variant_closes_and_opens(variant: dict[str, str]) -> None:
    run = close(replace(MODEL, variant=variant), reference=half_sine())
    assert 13.5 < run.encoder_position.max() < 14.6
    closed = run.joint_positions[1000]
    for name in ("index_mcp", "middle_mcp", "ring_mcp", "little_mcp", "thumb_abd"):
        assert closed[JOINT_NAMES.index(name)] > 0.95 * JOINT_LIMITS[name].upper
    assert np.abs(run.joint_positions[-1]).max() < 0.1
    assert np.abs(run.encoder_position[-1]) < 0.3


def test_a_rigid_object_takes_current_and_force_a_soft_one_less() -> None:
    void, soft, rigid = (
        close(grasp=g, reference=CLOSURE[:1100]) for g in (None, SOFT_BALL, RIGID_DYNAMOMETER)
    )
    peak = [np.abs(run.motor_current[300:]).max() for run in (void, soft, rigid)]
    assert peak[0] < 0.3 < peak[1] < 1.0 < 1.8 < peak[2] < 4.6
    assert void.grip_force.max() == 0.0
    assert 5.0 < soft.grip_force[1000] < 30.0
    assert 70.0 < rigid.grip_force.max() < 130.0
    assert rigid.encoder_position.max() < soft.encoder_position.max() < void.encoder_position.max()


def test_repeats_are_bit_equal_in_one_plant_and_in_a_new_one() -> None:
    plant, controller = MujocoPlant(MODEL, RIGID_DYNAMOMETER), DoublePID.of_model(MODEL.parameters)
    first = rollout(plant, controller, CLOSURE)
    again = rollout(plant, controller, CLOSURE)
    other = close(grasp=RIGID_DYNAMOMETER)
    assert first.raw.tobytes() == again.raw.tobytes() == other.raw.tobytes()


def test_halving_the_step_changes_a_closure_little() -> None:
    for grasp in (None, RIGID_DYNAMOMETER):
        coarse, fine = close(grasp=grasp), close(grasp=grasp, dt=0.125e-3)
        assert np.abs(coarse.encoder_position - fine.encoder_position).max() < 0.03
        peak = np.abs(fine.motor_current).max()
        assert np.abs(coarse.motor_current - fine.motor_current).max() < 0.05 * peak
        if grasp is not None:
            assert coarse.grip_force.max() == pytest.approx(fine.grip_force.max(), rel=0.01)


def test_an_effect_at_its_vanishing_value_changes_no_bit() -> None:
    effect = load_effect("viscous_friction")
    off = {p.name: p.vanishing for p in effect.parameters if p.vanishing is not None}
    assert close(MODEL.with_effect(effect.entry(off))).raw.tobytes() == close().raw.tobytes()


def test_a_motor_side_effect_is_the_parameter_that_it_adds_to() -> None:
    effect = load_effect("viscous_friction")
    extra = 5e-4
    name = effect.strength().name
    with_effect = close(MODEL.with_effect(effect.entry({name: extra})))
    base = MODEL.parameters.value("friction.viscous")
    with_parameter = close(MODEL.with_values({"friction.viscous": base + extra}))
    # the controller's gains do not depend on friction.viscous
    np.testing.assert_allclose(with_effect.encoder_position, with_parameter.encoder_position, atol=1e-9)
    assert np.abs(with_effect.encoder_position - close().encoder_position).max() > 0.01


@pytest.fixture(scope="module")
def constant_effects(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Effects of constant output, one class for each, as a user's own file."""
    path = tmp_path_factory.mktemp("effects") / "constant.py"
    lines = ["from hannes_sim.effect import Effect, EffectParameter", "from hannes_sim import ports", ""]
    for port in (
        "TORQUE",
        "FRICTION",
        "INERTIA",
        "LOAD_TORQUE",
        "LOAD_FRICTION",
        "LOAD_DAMPING",
        "SLACK",
        "COMPLIANCE",
        "OBJECT_DAMPING",
    ):
        lines += [
            f"{port} = ports.{port}",
            f"class C{port}(Effect):",
            f"    name = 'constant_{port.lower()}'",
            "    parameters = (EffectParameter('level', 'SI', -10.0, 10.0, typical=0.0, vanishing=0.0),)",
            "    @staticmethod",
            "    def contribute(x, p, s, y):",
            f"        y[{port}] += p[0]",
            "",
        ]
    path.write_text("\n".join(lines))
    return str(path)


def constant(file: str, port: str, level: float) -> Model:
    source = f"{file}:C{port}"
    return MODEL.with_effect(load_effect(source).entry({"level": level}, source=source))


def test_slack_delays_the_fingers_and_is_a_wire_of_that_length(constant_effects: str) -> None:
    slack = 1.5
    run = close(constant(constant_effects, "SLACK", slack))
    moving = run.raw[:, R_QL] > 0.5
    first = np.argmax(moving)
    assert run.raw[first, R_Q] - run.raw[first, R_QL] == pytest.approx(slack, abs=0.05)


def test_compliance_adds_to_the_wires(constant_effects: str) -> None:
    extra = 0.3
    stiff = close(grasp=RIGID_DYNAMOMETER)
    soft = close(constant(constant_effects, "COMPLIANCE", extra), RIGID_DYNAMOMETER)
    k = 1000
    gap = [float(run.raw[k, R_Q] - run.raw[k, R_QL]) / float(run.raw[k, R_LOAD]) for run in (stiff, soft)]
    assert gap[1] - gap[0] == pytest.approx(extra, rel=0.05)


def test_load_torque_is_felt_at_the_pulley(constant_effects: str) -> None:
    plain = load_through(MODEL)
    loaded = load_through(constant(constant_effects, "LOAD_TORQUE", -0.01))
    assert loaded - plain == pytest.approx(0.01, rel=0.1)


def load_through(model: Model) -> float:
    """Mean torque through the wire [N.m] while the void hand closes from 3 to 8 rad."""
    run = close(model, reference=half_sine(period=16.0)[:4000])
    q = run.raw[:, R_Q]
    return float(run.raw[(q > 3.0) & (q < 8.0), R_LOAD].mean())


@pytest.mark.parametrize(("port", "level"), [("LOAD_FRICTION", 0.01), ("LOAD_DAMPING", 0.003)])
def test_load_friction_and_damping_are_felt_at_the_pulley(
    constant_effects: str, port: str, level: float
) -> None:
    run = close(constant(constant_effects, port, level), reference=half_sine(period=16.0)[:4000])
    q, v = run.raw[:, R_Q], np.gradient(run.raw[:, R_Q], run.time)
    inside = (q > 3.0) & (q < 8.0)
    expected = level if port == "LOAD_FRICTION" else level * v[inside].mean()
    assert float(run.raw[inside, R_LOAD].mean()) - load_through(MODEL) == pytest.approx(expected, rel=0.15)


def test_inertia_adds_to_the_rotor(constant_effects: str) -> None:
    own = MODEL.parameters.value("motor.armature") * MODEL.parameters.value("gear.ratio") ** 2
    with_effect = close(constant(constant_effects, "INERTIA", own), reference=CLOSURE[:600])
    doubled = close(
        MODEL.with_values({"motor.armature": 2.0 * MODEL.parameters.value("motor.armature")}),
        reference=CLOSURE[:600],
    )
    np.testing.assert_allclose(with_effect.encoder_position, doubled.encoder_position, atol=2e-2)
    assert np.abs(with_effect.encoder_position - close(reference=CLOSURE[:600]).encoder_position).max() > 0.05


def test_set_is_the_same_as_a_model_with_that_value() -> None:
    for name, value in (
        ("motor.resistance", 2.0),
        ("friction.coulomb", 0.02),
        ("springs.index_preload", 7.0),
        ("pulley.radius", 0.0045),
        ("wires.master_stiffness", 3e4),
        ("hand.preload", 0.02),
        ("hand.stiffness", 0.003),
        ("hand.coulomb", 0.016),
    ):
        plant = MujocoPlant(MODEL)
        plant.set(name, value)
        assert plant.get(name) == value
        run = rollout(plant, DoublePID.of_model(MODEL.parameters), CLOSURE[:300])
        other = MujocoPlant(MODEL.with_values({name: value}))
        expected = rollout(other, DoublePID.of_model(MODEL.parameters), CLOSURE[:300])
        assert run.raw.tobytes() == expected.raw.tobytes(), name


def test_every_name_can_be_read_and_a_wrong_one_is_refused() -> None:
    plant = MujocoPlant(MODEL, SOFT_BALL)
    assert all(np.isfinite(plant.get(name)) for name in plant.names)
    plant.set("object.stiffness", 900.0)
    assert plant.get("object.stiffness") == 900.0
    with pytest.raises(HannesError, match=r"no parameter 'springs\.nose_rate'"):
        plant.set("springs.nose_rate", 1.0)
    with pytest.raises(HannesError, match=r"object\.stiffness"):
        MujocoPlant(MODEL).set("object.stiffness", 1.0)
    with pytest.raises(HannesError, match="integration step"):
        MujocoPlant(MODEL, dt=0.01)


@pytest.mark.parametrize("mechanism", ["return_wire", "torsion_spring"])
def test_preload_rate_and_friction_of_the_hand_scale_the_load_curve(mechanism: str) -> None:
    model = replace(MODEL, variant={"return_mechanism": mechanism})

    def curve(**values: float) -> tuple[np.ndarray, np.ndarray]:
        changed = model.with_values({name.replace("_", ".", 1): value for name, value in values.items()})
        found = load_curve(changed, speed=4.0, samples=30)
        inside = (found["angle"] > 1.0) & (found["angle"] < 11.0)
        half_sum, half_difference = found["closing"] + found["opening"], found["closing"] - found["opening"]
        return 0.5 * half_sum[inside], 0.5 * half_difference[inside]

    springs, friction = curve()
    preloaded, _ = curve(hand_preload=1.5 * 0.0107)
    assert np.mean(preloaded - springs) == pytest.approx(0.5 * 0.0107, rel=0.35)
    stiffer, _ = curve(hand_stiffness=2.0 * 0.0015)
    assert np.mean(np.diff(stiffer)) > 1.3 * np.mean(np.diff(springs))
    _, easier = curve(hand_coulomb=0.5 * 0.008)
    assert np.mean(easier) == pytest.approx(0.5 * np.mean(friction), rel=0.15)


def test_a_change_between_closures_leaves_the_state_as_it_is() -> None:
    plant = MujocoPlant(MODEL, SOFT_BALL)
    for _ in range(400):
        plant.advance(4.0, 4)
    before = plant.read()
    for name, factor in (
        ("springs.index_preload", 1.1),
        ("hand.preload", 1.1),
        ("object.position", 0.98),
        ("object.stiffness", 1.2),
        ("friction.coulomb", 1.1),
    ):
        plant.set(name, factor * plant.get(name))
        joints = [plant.data.joint(joint).qpos[0] for joint in JOINT_NAMES]
        np.testing.assert_array_equal(joints, before.joint_positions)
    plant.advance(4.0, 4)
    after = plant.read()
    assert after.time == pytest.approx(before.time + 1e-3)
    assert np.abs(after.joint_positions - before.joint_positions).max() < 0.05
    assert abs(after.position - before.position) < 0.05


def test_the_objects_position_is_its_size_and_moves_the_touch() -> None:
    touched = []
    for shift in (0.0, -1.0):
        plant = MujocoPlant(MODEL, RIGID_DYNAMOMETER)
        plant.set("object.position", plant.get("object.position") + shift)
        run = rollout(plant, DoublePID.of_model(MODEL.parameters), CLOSURE[:1100])
        touched.append(run.encoder_position.max())
        other = replace(RIGID_DYNAMOMETER, size=RIGID_DYNAMOMETER.size - shift * 0.006)
        again = close(grasp=other, reference=CLOSURE[:1100])
        np.testing.assert_allclose(run.encoder_position, again.encoder_position, atol=1e-9)
    assert 0.3 < touched[0] - touched[1] < 2.0


def test_divergence_names_the_joint_and_leaves_no_log_file(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    plant = MujocoPlant(MODEL)
    plant.data.joint("ring_pip").qvel[0] = np.nan
    with pytest.raises(PlantDiverged, match="ring_"):
        plant.advance(1.0, 4)
    plant.reset()
    plant.advance(1.0, 4)
    plant.data.time = 7.0
    with pytest.raises(PlantDiverged, match="time"):
        plant.advance(1.0, 4)
    assert list(tmp_path.iterdir()) == []


def test_an_unstable_hand_is_reported_by_the_rollout() -> None:
    wild = MODEL.with_values({"joints.stop_stiffness": 500.0, "joints.stop_damping_ratio": 1.0})
    plant = MujocoPlant(wild, dt=5e-4)
    with pytest.raises(PlantDiverged, match="reduce dt"):
        rollout(plant, DoublePID.of_model(wild.parameters), CLOSURE)


def test_readings_are_consistent() -> None:
    plant = MujocoPlant(MODEL, RIGID_DYNAMOMETER)
    for _ in range(500):
        plant.advance(6.0, 4)
    reading = plant.read()
    assert reading.time == pytest.approx(0.5)
    assert reading.effort == pytest.approx(MODEL.parameters.value("motor.kt") * 19.0 * reading.current)
    np.testing.assert_allclose(reading.joint_positions, [plant.data.joint(n).qpos[0] for n in JOINT_NAMES])
    np.testing.assert_allclose(reading.joint_velocities, [plant.data.joint(n).qvel[0] for n in JOINT_NAMES])
    radius = MODEL.parameters.value("pulley.radius")
    assert reading.position == pytest.approx(plant.data.joint("motor").qpos[0] / radius, abs=2e-4)
    assert plant.reading[R_LOAD] == pytest.approx(plant.tensions()["master"] * radius)


def test_the_load_curve_is_that_of_the_thesis_fit() -> None:
    """Section 4 [F]: preload 10.7 mN.m, 1.5 mN.m/rad over the closure, the load's share of the dry friction 8 mN.m."""
    curve = load_curve(MODEL, speed=3.0, samples=40)
    inside = (curve["angle"] > 0.5) & (curve["angle"] < 14.5)
    springs = 0.5 * (curve["closing"] + curve["opening"])[inside]
    friction = 0.5 * (curve["closing"] - curve["opening"])[inside]
    fitted = 0.0107 + 0.0015 * curve["angle"][inside]
    assert springs[0] == pytest.approx(0.0107, abs=0.002)
    assert np.mean(springs) == pytest.approx(np.mean(fitted), abs=0.004)
    assert np.all(np.diff(springs) > -2e-3)
    assert np.mean(friction) == pytest.approx(MODEL.parameters.value("hand.coulomb"), rel=0.15)
