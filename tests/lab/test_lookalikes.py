"""What the catalogue says an effect is confused with is measured, and agrees with what is known."""

import pytest
from hannes_lab.effects_page import confusion
from hannes_lab.lookalikes import LookAlikes, look_alikes

NAMES = ("gearbox_inertia", "current_sensor", "object_damping", "viscous_friction", "glove_stiffness")


@pytest.fixture(scope="module")
def alike() -> dict[str, LookAlikes]:
    return look_alikes(NAMES)


def test_inertia_and_a_wrong_current_sensor_are_one_with_a_slow_log(alike):
    assert alike["gearbox_inertia"].effects["current_sensor"] > 0.95
    assert alike["current_sensor"].effects["gearbox_inertia"] > 0.95


def test_what_acts_in_the_grasp_alone_is_like_nothing_else(alike):
    assert max(alike["object_damping"].effects.values()) < 0.5
    assert alike["object_damping"].taken_over < 0.5


def test_effects_of_the_form_of_a_nominal_parameter_are_taken_over_by_it(alike):
    for name, parameter in (("viscous_friction", "friction.viscous"), ("glove_stiffness", "hand.stiffness")):
        assert alike[name].taken_over > 0.9
        assert alike[name].parameter == parameter


def test_cosines_lie_between_zero_and_one_and_none_is_with_itself(alike):
    for name, known in alike.items():
        assert set(known.effects) == set(NAMES) - {name}
        assert all(0.0 <= c <= 1.0 + 1e-9 for c in known.effects.values())


def test_the_page_names_the_nearest_first_and_leaves_out_what_is_far():
    known = LookAlikes({"a": 0.81, "b": 0.99, "c": 0.5}, 0.996, "object.stiffness@grasp")
    assert confusion(known)[0] == "Confused with: `b` (0.99), `a` (0.81).  "
    assert "more than 99 % of it, `object.stiffness` above all" in confusion(known)[1]
    alone = LookAlikes({"c": 0.5}, 0.2, "motor.kt")
    assert "no other effect" in confusion(alone)[0]
