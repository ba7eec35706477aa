"""What every plant promises: units, determinism, rest, limits, sign of the motion; run on each plant and variant."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hannes_control.double_pid import DoublePID
from hannes_control.reference import half_sine
from hannes_description.control_ports import C_PERIOD, C_POSITION, C_REFERENCE, C_TIME
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.parameters import Parameter
from hannes_sim.effect import load_effect
from hannes_sim.factory import make_plant
from hannes_sim.native import CONTROL_SIGNATURE
from hannes_sim.objects import RIGID_DYNAMOMETER, SOFT_BALL
from hannes_sim.plant import Plant, Reading
from hannes_sim.rollout import ROLLOUT_SIGNALS, VoltagePlayback, rollout
from numba import cfunc

MODELS: dict[str, Callable[[], Model]] = {
    "reduced": lambda: Model.load("nominal"),
    "mujoco": lambda: Model.load("nominal_mujoco"),
    "mujoco-torsion": lambda: _variant(return_mechanism="torsion_spring"),
    "mujoco-forces": lambda: _variant(transmission="forces"),
}


def _variant(**options: str) -> Model:
    model = Model.load("nominal_mujoco")
    return replace(model, variant={**model.variant, **options})


@cfunc(CONTROL_SIGNATURE)
def _swing(x, p, s):
    s[0] += x[C_PERIOD] * (x[C_REFERENCE] - x[C_POSITION])
    return 3.0 * math.sin(9.0 * x[C_TIME]) + s[0]


class _Swinging:
    """A law that swings with the time, with a state."""

    address, period = _swing.address, 1e-3

    def __init__(self) -> None:
        self.parameters, self.states = np.zeros(1), np.zeros(1)

    def reset(self) -> None:
        self.states[:] = 0.0


@pytest.fixture(params=list(MODELS))
def model(request: pytest.FixtureRequest) -> Model:
    return MODELS[request.param]()


@pytest.fixture
def plant(model: Model) -> Plant:
    return make_plant(model)


def test_stays_at_rest_without_voltage(plant: Plant) -> None:
    plant.reset()
    plant.advance(0.0, 4000)
    reading = plant.read()
    assert reading.time == pytest.approx(4000 * plant.dt)
    assert abs(reading.position) < 0.05 and abs(reading.current) < 1e-3 and reading.grip_force == 0.0
    assert reading.joint_positions.shape == (13,) and np.isfinite(reading.joint_positions).all()


def test_positive_voltage_closes(plant: Plant) -> None:
    plant.reset()
    plant.advance(6.0, 800)
    reading = plant.read()
    assert reading.position > 1.0 and reading.velocity > 0.0 and reading.current > 0.0
    assert reading.joint_positions[1] > 0.01, "the index must flex"


def test_voltage_is_clamped_to_the_supply(plant: Plant) -> None:
    plant.reset()
    plant.advance(12.0, 200)
    at_supply = plant.read().position
    plant.reset()
    plant.advance(1000.0, 200)
    assert plant.read().position == at_supply


def test_reset_repeats_bit_for_bit(plant: Plant, model: Model) -> None:
    law = DoublePID.of_model(model.parameters)
    reference = half_sine(1, amplitude=8.0, period=1.0)
    first, second = rollout(plant, law, reference), rollout(plant, law, reference)
    assert np.array_equal(first.raw, second.raw) and np.array_equal(first.motor_voltage, second.motor_voltage)


def test_a_reading_has_what_the_effects_give_from_the_first_one_on(model: Model) -> None:
    """An encoder whose zero is elsewhere, as an effect and as the parameter, is the same bit for bit."""
    kind = load_effect("encoder_offset")
    entry = kind.entry({"offset": 0.3})
    law, reference = DoublePID.of_model(model.parameters), half_sine(1, amplitude=4.0, period=0.4)
    as_effect, as_parameter = make_plant(model.with_effect(entry)), make_plant(model)
    as_parameter.set("encoder.zero", 0.3)
    for plant in (as_effect, as_parameter):
        plant.reset()
        assert plant.read().position == pytest.approx(0.3, abs=1e-3) and plant.read().velocity == 0.0
    assert np.array_equal(rollout(as_effect, law, reference).raw, rollout(as_parameter, law, reference).raw)


def test_an_amplifier_with_a_current_loop_feels_no_back_emf(model: Model) -> None:
    speeds = []
    for compensated in (0.0, 1.0):
        own = Parameter(compensated, "1", 0.0, 1.0, "datasheet", "amplifier")
        entries = {**model.parameters.entries, "motor.emf_compensated": own}
        plant = make_plant(replace(model, parameters=replace(model.parameters, entries=entries)))
        plant.advance(3.0, 400)
        speeds.append(plant.read().velocity)
    assert speeds[1] > 1.3 * speeds[0]


def test_stepwise_equals_rollout(plant: Plant, model: Model) -> None:
    """The node's way (one advance a tick) and the rollout's give the same trajectory."""
    law = DoublePID.of_model(model.parameters)
    reference = half_sine(1, amplitude=8.0, period=0.6)
    run = rollout(plant, law, reference)
    plant.reset()
    law.reset()
    steps = round(law.period / plant.dt)
    for k, wanted in enumerate(reference):
        reading = plant.read()
        assert reading.position == run.encoder_position[k] and reading.current == run.motor_current[k]
        assert np.array_equal(reading.joint_positions, run.joint_positions[k])
        assert np.array_equal(reading.joint_velocities, run.joint_velocities[k])
        voltage = law.update(float(wanted), reading.position, reading.current)
        assert voltage == run.motor_voltage[k]
        plant.advance(voltage, steps)


def test_a_rollout_that_goes_on_is_the_whole_one(plant: Plant) -> None:
    """Of a law that knows the time, too: it goes on where it was."""
    whole = rollout(plant, _Swinging(), np.linspace(0.0, 5.0, 900))
    law, n = _Swinging(), 333
    first = rollout(plant, law, whole.reference_position[:n])
    both = first.followed_by(rollout(plant, law, whole.reference_position[n:], reset=False, begin=n))
    for name in ("time", *ROLLOUT_SIGNALS):
        a, b = (run.time if name == "time" else run.signal(name) for run in (both, whole))
        assert np.array_equal(a, b), name
    assert np.ptp(whole.motor_voltage) > 4.0


def test_a_rollout_without_joints_says_so(plant: Plant, model: Model) -> None:
    law, reference = DoublePID.of_model(model.parameters), half_sine(1, amplitude=8.0, period=0.6)
    with_joints = rollout(plant, law, reference)
    run = rollout(plant, law, reference, joints=False)
    assert np.array_equal(run.encoder_position, with_joints.encoder_position)
    assert with_joints.joint_positions.max() > 0.1
    for name in ("joint_positions", "joint_velocities"):
        with pytest.raises(HannesError, match="without the finger joints"):
            run.signal(name)


def test_object_stops_the_hand_and_feels_force(model: Model) -> None:
    law = DoublePID.of_model(model.parameters)
    reference = half_sine(1, period=2.0)
    free = rollout(make_plant(model), law, reference)
    soft = rollout(make_plant(model, SOFT_BALL), law, reference)
    rigid = rollout(make_plant(model, RIGID_DYNAMOMETER), law, reference)
    assert free.grip_force.max() == 0.0
    assert rigid.grip_force.max() > soft.grip_force.max() > 1.0
    assert rigid.encoder_position.max() < soft.encoder_position.max() < free.encoder_position.max()
    assert rigid.motor_current.max() > 2.0 * free.motor_current.max()


def test_effects_act_on_every_plant(model: Model) -> None:
    """Drive-side effects are the same functions in both plants and move the current the same way."""
    law = DoublePID.of_model(model.parameters)
    reference = half_sine(1, amplitude=10.0, period=2.0)
    base = rollout(make_plant(model), law, reference)
    for name, values in (
        ("viscous_friction", {"coefficient": 3e-3}),
        ("coulomb_friction", {"level": 0.02}),
        ("glove_stiffness", {"stiffness": 4e-3, "hardening": 0.0}),
    ):
        run = rollout(make_plant(model.with_effect(load_effect(name).entry(values))), law, reference)
        closing = slice(200, 450)
        assert run.motor_current[closing].mean() > 1.1 * base.motor_current[closing].mean(), name


@pytest.mark.parametrize("port", ["FRICTION", "DAMPING", "LOAD_FRICTION", "LOAD_DAMPING"])
def test_an_effect_takes_no_more_friction_than_there_is(model: Model, port: str, tmp_path: Path) -> None:
    file = tmp_path / "less.py"
    file.write_text(
        f"from hannes_sim.effect import Effect, EffectParameter\nfrom hannes_sim.ports import {port}\n\n\n"
        "class Less(Effect):\n"
        "    name = 'less'\n"
        "    parameters = (EffectParameter('by', 'N.m', 0.0, 10.0, 0.1, 0.0, 'what is taken away'),)\n\n"
        "    @staticmethod\n"
        "    def contribute(x, p, s, y):\n"
        f"        y[{port}] -= p[0]\n"
    )
    source = f"{file}:Less"
    law, reference = DoublePID.of_model(model.parameters), half_sine(1, amplitude=10.0, period=2.0)[:700]
    runs = [
        rollout(
            make_plant(model.with_effect(load_effect(source).entry({"by": by}, source=source))),
            law,
            reference,
        )
        for by in (0.0, 0.3, 3.0)
    ]
    none_left, more = runs[1:]
    assert np.array_equal(none_left.encoder_position, more.encoder_position)
    nothing_there = model.plant == "reduced" and port == "LOAD_DAMPING"  # hand.viscous is nominally 0
    assert np.array_equal(runs[0].encoder_position, none_left.encoder_position) == nothing_there


def test_friction_beyond_a_gap_is_the_same_in_both_plants() -> None:
    """Against the same gap without it: where and how much the current falls."""
    change = []
    for name in ("nominal", "nominal_mujoco"):
        model = Model.load(name)
        law, reference = DoublePID.of_model(model.parameters), half_sine(1, amplitude=10.0, period=2.0)
        gap = load_effect("gear_backlash")
        bare, held = (
            rollout(make_plant(model.with_effect(gap.entry(values))), law, reference)
            for values in ({"width": 0.15}, {"width": 0.15, "beyond": 0.012})
        )
        change.append(held.motor_current - bare.motor_current)
    reduced, full = change
    assert np.corrcoef(reduced, full)[0, 1] > 0.7
    assert 0.7 < np.linalg.norm(full) / np.linalg.norm(reduced) < 1.4


def test_open_loop_playback_reproduces_the_closed_loop(plant: Plant, model: Model) -> None:
    law = DoublePID.of_model(model.parameters)
    closed = rollout(plant, law, half_sine(1, amplitude=8.0, period=0.8))
    opened = rollout(plant, VoltagePlayback(law.period), closed.motor_voltage)
    assert np.array_equal(closed.raw, opened.raw)


def test_set_and_get_are_one(plant: Plant) -> None:
    for name in ("motor.resistance", "motor.kt", "friction.coulomb", "friction.viscous", "encoder.zero"):
        plant.set(name, 1.25 * plant.get(name) + 1e-4)
        before = plant.get(name)
        plant.set(name, before)
        assert plant.get(name) == before
    with pytest.raises(HannesError, match=r"motor\.resistance"):
        plant.set("motor.resistanse", 1.0)


def test_bad_step_and_reference_are_refused(model: Model) -> None:
    with pytest.raises(HannesError, match="step"):
        make_plant(model, dt=float("nan"))
    plant, law = make_plant(model), DoublePID.of_model(model.parameters)
    with pytest.raises(HannesError, match="not finite at sample 3"):
        rollout(plant, law, np.array([0.0, 0.0, 0.0, np.nan]))


def test_a_plant_of_ones_own_is_told_what_it_lacks(tmp_path: Path) -> None:
    """A subclass of a shipped plant has all that the protocol lists."""
    (tmp_path / "mine.py").write_text(
        "from hannes_sim.reduced import ReducedPlant\n"
        "class Mine(ReducedPlant):\n    pass\n"
        "class Bare:\n    def __init__(self, model, grasp, *, dt):\n        self.dt, self.names = dt, ()\n"
        "class Wrong:\n    def __init__(self, model):\n        pass\n",
        encoding="utf-8",
    )
    model = Model.load()
    mine = make_plant(model.with_plant(f"{tmp_path / 'mine.py'}:Mine"))
    mine.advance(1.0, 4)
    assert mine.read().position == advanced(make_plant(model)).position
    with pytest.raises(HannesError, match=r"has no address, handle, reading, reset, .*a subclass of"):
        make_plant(model.with_plant(f"{tmp_path / 'mine.py'}:Bare"))
    with pytest.raises(HannesError, match=r"Wrong\(model, grasp, dt=...\) in .* failed: TypeError"):
        make_plant(model.with_plant(f"{tmp_path / 'mine.py'}:Wrong"))


def advanced(plant: Plant) -> Reading:
    plant.advance(1.0, 4)
    return plant.read()
