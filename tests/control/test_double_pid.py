"""The control law: limits, anti-windup, battery saver, and the same numbers compiled and in Python."""

from dataclasses import replace

import numpy as np
import pytest
from hannes_control.double_pid import N_STATES, DoublePID, DoublePIDParameters, control
from hannes_control.reference import FULL_CLOSURE, PROFILES, half_sine, make_profile, ramp_hold, reversals
from hannes_description.control_ports import C_CURRENT, C_PERIOD, C_POSITION, C_REFERENCE, N_CONTROL_INPUTS
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.parameters import load_parameters
from hannes_sim.factory import make_plant
from hannes_sim.rollout import rollout


@pytest.fixture
def law() -> DoublePID:
    return DoublePID.of_model(load_parameters("hannes"))


def test_compiled_law_equals_plain_python(law: DoublePID) -> None:
    rng = np.random.default_rng(0)
    states = np.zeros(N_STATES)
    x = np.zeros(N_CONTROL_INPUTS)
    x[C_PERIOD] = law.period
    for _ in range(500):
        reference, position, current = rng.normal(5, 4), rng.normal(5, 4), rng.normal(0, 2)
        x[C_REFERENCE], x[C_POSITION], x[C_CURRENT] = reference, position, current
        assert law.update(reference, position, current) == pytest.approx(
            control(x, law.parameters, states), abs=1e-12
        )


def test_limits_hold_and_integrator_does_not_wind_up(law: DoublePID) -> None:
    for _ in range(3000):
        voltage = law.update(100.0, 0.0, 0.0)
        assert abs(voltage) <= 12.0
        assert abs(law.current_reference) <= 4.6
    # A wound-up integrator would hold the limit long after the error has changed its sign.
    after = [law.update(-100.0, 0.0, 0.0) for _ in range(20)]
    assert after[-1] < 0.0


def test_battery_saver_drops_and_releases(law: DoublePID) -> None:
    settings = law.settings
    ticks = round((settings.saver_time + 0.1) / law.period)
    for _ in range(ticks):
        law.update(10.0, 3.0, settings.saver_current + 0.2)
    assert law.saving
    for _ in range(50):
        law.update(10.0, 3.0, 0.0)
    assert law.saving and law.current_reference == pytest.approx(0.0)
    law.update(10.0 - 1.5 * settings.saver_release, 3.0, 0.0)
    assert law.saving, "a reference that still asks to close must not close the hand again"
    law.update(2.5, 3.0, 0.0)
    assert not law.saving and law.current_reference < 0.0


def test_battery_saver_ends_when_more_is_asked_for(law: DoublePID) -> None:
    settings = law.settings
    for _ in range(round((settings.saver_time + 0.1) / law.period)):
        law.update(10.0, 3.0, settings.saver_current + 0.2)
    assert law.saving
    law.update(10.0 + 1.5 * settings.saver_release, 3.0, 0.0)
    assert not law.saving and law.current_reference > 0.0


def test_reset_clears_everything(law: DoublePID) -> None:
    first = [law.update(5.0, 0.0, 0.1) for _ in range(10)]
    law.reset()
    assert [law.update(5.0, 0.0, 0.1) for _ in range(10)] == first


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_non_finite_input_is_refused(law: DoublePID, bad: float) -> None:
    with pytest.raises(HannesError, match="not finite"):
        law.update(bad, 0.0, 0.0)


def test_parameters_are_checked() -> None:
    good = DoublePIDParameters.from_parameters(load_parameters("hannes"))
    with pytest.raises(HannesError, match="kp"):
        DoublePIDParameters(**{**good.__dict__, "kp": -1.0})
    with pytest.raises(HannesError, match="voltage_limit"):
        DoublePIDParameters(**{**good.__dict__, "voltage_limit": 0.0})


def test_profiles() -> None:
    sine = half_sine(2)
    assert sine.max() == pytest.approx(FULL_CLOSURE, rel=1e-6) and sine.min() == 0.0 and sine.size == 8000
    assert np.all(sine[2001:3999] == 0.0)
    ramp = ramp_hold(1, 10.0, 3.0, hold=0.2, rest=0.2)
    assert (
        np.all(ramp[900:1500] == 10.0) and np.all(ramp[2400:] == 0.0) and np.abs(np.diff(ramp)).max() < 0.02
    )
    assert np.any(np.diff(reversals()[:1500]) < 0.0), "reversals must reverse while closing"
    first, second = np.split(reversals(closures=2, period=8.0), 2)
    np.testing.assert_allclose(first, second, atol=1e-9, err_msg="closures of one condition must repeat it")
    with pytest.raises(HannesError, match=r"half_sine, ramp_hold, reversals"):
        make_profile("square")
    with pytest.raises(HannesError, match="amplitude"):
        make_profile("half_sine", amplitude=-1.0)
    with pytest.raises(HannesError, match="speed"):
        make_profile("half_sine", speed=2.0)


def test_an_identified_motor_does_not_change_the_controller() -> None:
    """The gains were set once; a fit that finds another resistance must leave them as they are."""
    nominal = load_parameters("hannes")
    other = nominal.with_values({"motor.resistance": 1.7, "motor.inductance": 2e-4, "motor.kt": 0.018})
    assert DoublePIDParameters.from_parameters(other) == DoublePIDParameters.from_parameters(nominal)
    assert DoublePIDParameters.from_parameters(nominal).current_ki == pytest.approx(1.49 / 0.005)


def test_an_outer_integral_takes_away_what_a_spring_leaves() -> None:
    """A board whose outer loop integrates, on a hand that a spring pulls open: without, it stays short by i / kp."""
    model = Model.load()
    left = {}
    for ki in (0.0, 2.0):
        known = model.with_values({"control.ki": ki})
        run = rollout(make_plant(known), DoublePID.of_model(known.parameters), np.full(3000, 10.0))
        left[ki] = abs(10.0 - float(run.encoder_position[-1]))
        assert np.abs(run.motor_current).max() <= 4.6
    assert left[2.0] < 0.5 * left[0.0]


def test_the_outer_integral_does_not_wind_up() -> None:
    law = DoublePID(replace(DoublePID.of_model(load_parameters("hannes")).settings, ki=5.0))
    for _ in range(3000):
        law.update(100.0, 0.0, 0.0)
        assert abs(law.current_reference) <= 4.6
    after = [law.update(-1.0, 0.0, 0.0) and law.current_reference for _ in range(20)]
    assert after[-1] < 0.0


def test_a_profile_of_more_samples_than_memory_holds_is_refused() -> None:
    for make in PROFILES.values():
        with pytest.raises(HannesError, match="at most 100000000 are made"):
            make(closures=1000, period=1e6)
