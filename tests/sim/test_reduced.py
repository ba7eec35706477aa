"""The reduced plant against closed-form solutions, and its convergence."""

import math

import numpy as np
import pytest
from hannes_control.double_pid import DoublePID
from hannes_control.reference import half_sine
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_sim.effect import catalogue
from hannes_sim.factory import make_plant
from hannes_sim.measurement import BENCH, THESIS, Sensors, folded_mean, logger
from hannes_sim.objects import OBJECTS, GraspObject
from hannes_sim.plant import PlantDiverged
from hannes_sim.ports import R_Q
from hannes_sim.reduced import ReducedPlant
from hannes_sim.rollout import rollout


def single_mass() -> ReducedPlant:
    """A motor alone: no wire, no friction."""
    plant = ReducedPlant(Model.load())
    for name in ("wire.stiffness", "friction.coulomb", "friction.viscous", "encoder.resolution"):
        plant.set(name, 0.0)
    return plant


def test_no_load_speed_and_time_constant() -> None:
    """w(t) = w0 (1 - exp(-t/tau)), w0 = u/(kt n), tau = R J/(eta kt^2 n^2) for a motor without load."""
    plant = single_mass()
    plant.set("motor.inductance", 0.0)
    kt, n, r, eta = 17.45e-3, 19.0, 1.49, 0.70
    tau = r * 1.1e-6 * n**2 / (eta * (kt * n) ** 2)
    plant.reset()
    plant.advance(6.0, 100_000)
    plant.advance(6.0, 400)
    assert plant.read().velocity == pytest.approx(6.0 / (kt * n), rel=1e-6)
    fine = ReducedPlant(Model.load(), dt=1e-6)
    for name in (
        "wire.stiffness",
        "friction.coulomb",
        "friction.viscous",
        "encoder.resolution",
        "motor.inductance",
    ):
        fine.set(name, 0.0)
    fine.reset()
    steps = round(tau / 1e-6)
    fine.advance(6.0, steps)
    wanted = 6.0 / (kt * n) * (steps * 1e-6 - tau * (1 - math.exp(-steps * 1e-6 / tau)))
    assert fine.read().position == pytest.approx(wanted, rel=1e-3)


def test_stall_current_and_grip() -> None:
    """Stalled on a rigid object: i = u/R, force x travel = eta kt n i - friction - springs."""
    plant = ReducedPlant(Model.load(), OBJECTS["rigid"])
    plant.reset()
    plant.advance(2.0, 40_000)
    reading = plant.read()
    assert reading.current == pytest.approx(2.0 / 1.49, rel=1e-6)
    torque = 0.70 * 17.45e-3 * 19 * reading.current
    most = torque / 0.006
    resisting = (
        plant.get("friction.coulomb")
        + plant.get("hand.coulomb")
        + plant.get("hand.preload")
        + plant.get("hand.stiffness") * 10.0
    )
    held = (torque - resisting) / 0.006
    assert held < reading.grip_force < most


def test_dry_friction_sticks_without_creep() -> None:
    plant = ReducedPlant(Model.load())
    plant.reset()
    plant.advance(0.04, 4000)
    start = plant.read().position
    plant.advance(0.04, 400_000)
    assert plant.read().position == start, "100 s below breakaway must not creep at all"


def test_halving_the_step_changes_a_closure_by_less_than_one_percent() -> None:
    model = Model.load()
    law = DoublePID.of_model(model.parameters)
    for grasp in OBJECTS.values():
        coarse = rollout(make_plant(model, grasp), law, half_sine(1))
        fine = rollout(make_plant(model, grasp, dt=0.125e-3), law, half_sine(1))
        for name in ("encoder_position", "motor_current"):
            a, b = coarse.signal(name), fine.signal(name)
            assert np.sqrt(((a - b) ** 2).mean()) < 0.01 * np.sqrt((b**2).mean())


def test_divergence_is_an_error_that_names_the_coordinate() -> None:
    plant = ReducedPlant(Model.load())
    plant.set("wire.stiffness", 1e9)
    with pytest.raises(PlantDiverged, match=r"diverged at t = .*pulley|hand"):
        plant.advance(12.0, 4000)


def test_object_place_follows_its_size() -> None:
    small, large = GraspObject(size=0.03), GraspObject(size=0.06)
    assert ReducedPlant(Model.load(), small).get("object.position") - ReducedPlant(Model.load(), large).get(
        "object.position"
    ) == pytest.approx(0.03 / 0.006)


def test_sensors_rectify_average_and_sample() -> None:
    model = Model.load()
    run = rollout(make_plant(model), DoublePID.of_model(model.parameters), half_sine(1))
    thesis, bench = THESIS.sample(run), BENCH.sample(run)
    assert set(thesis) == {"reference_position", "encoder_position", "motor_current"}
    assert thesis["motor_current"][1].min() >= 0.0 > bench["motor_current"][1].min()
    assert np.diff(thesis["motor_current"][0]) == pytest.approx(1 / 30)
    again = THESIS.sample(run, np.random.default_rng(1))
    assert 0.002 < np.std(again["motor_current"][1] - thesis["motor_current"][1]) < 0.008
    with pytest.raises(ValueError, match="motor_rate"):
        Sensors(motor_rate=0.0)
    for name, value in (("current_window", "0.03"), ("force_noise", None), ("motor_rate", True)):
        with pytest.raises(HannesError, match=f"{name} is .*must be a number"):
            Sensors.from_dict({name: value})
    with pytest.raises(HannesError, match="current_rectified is 1; it must be true or false"):
        Sensors.from_dict({"current_rectified": 1})


def test_trailing_average_and_folded_noise() -> None:
    ramp = np.arange(100.0)
    assert logger(ramp, 1e-3, rectified=False, window=0.01)[50] == pytest.approx(np.mean(np.arange(41, 51)))
    rng = np.random.default_rng(0)
    for mean in (0.0, 0.003, 0.02):
        sampled = np.abs(mean + 0.005 * rng.standard_normal(200_000)).mean()
        assert folded_mean(np.array([mean]), 0.005)[0] == pytest.approx(sampled, rel=0.01)


@pytest.mark.parametrize(("name", "pushed"), [("glove_stiffness", 200), ("gravity", 0)])
def test_a_mass_on_a_spring_or_with_a_weight_keeps_its_energy(name: str, pushed: int) -> None:
    """Without friction it swings on for ever: a force of where it was a step ago would push it."""
    model = Model.load().with_effect(catalogue()[name].entry())
    plant = ReducedPlant(model)
    for parameter in ("wire.stiffness", "friction.coulomb", "friction.viscous", "encoder.resolution"):
        plant.set(parameter, 0.0)
    plant.set("motor.emf_compensated", 1.0)
    if pushed:
        plant.advance(3.0, pushed)  # away from where it rests
    places = []
    for _ in range(20_000):
        plant.advance(0.0, 4)
        places.append(plant.reading[R_Q])
    swings = [float(np.ptp(places[k : k + 5000])) for k in range(0, 20_000, 5000)]
    assert max(swings) < 1.002 * min(swings)
