"""Dataclass to ROS parameters and back."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hannes_description.errors import HannesError
from hannes_ros.node_parameters import declare, help_text, parameter
from rclpy.node import Node
from rclpy.parameter import Parameter


@dataclass(frozen=True)
class Settings:
    speed: float = parameter(1.5, "how fast", lower=0.0, upper=10.0, unit="rad/s")
    count: int = parameter(3, "how many", lower=1)
    name: str = parameter("a", "which", choices=("a", "b"))
    on: bool = parameter(True, "whether")
    topics: tuple[str, ...] = parameter((), "which ones")


@pytest.fixture
def declared(ros_context):
    nodes = []

    def make(**values):
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        nodes.append(
            Node("thing", context=ros_context, parameter_overrides=overrides, use_global_arguments=False)
        )
        return declare(nodes[-1], Settings), nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()


def test_defaults_and_overrides(declared):
    assert declared()[0] == Settings(1.5, 3, "a", True, ())
    assert declared(speed=2.0, count=7, name="b", on=False, topics=["x", "y"])[0] == Settings(
        2.0, 7, "b", False, ("x", "y")
    )


def test_an_integer_will_do_for_a_number(declared):
    settings, _ = declared(speed=2)
    assert isinstance(settings.speed, float)
    assert settings.speed == 2.0


def test_descriptors_tell_range_and_unit_and_nothing_changes_at_run_time(declared):
    _, node = declared()
    descriptor = node.describe_parameter("speed")
    assert descriptor.description == "how fast [rad/s]"
    assert descriptor.read_only
    assert (descriptor.floating_point_range[0].from_value, descriptor.floating_point_range[0].to_value) == (
        0.0,
        10.0,
    )
    assert node.describe_parameter("count").integer_range[0].from_value == 1
    assert not node.set_parameters([Parameter("speed", value=2.0)])[0].successful


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sped": 1.0}, "Node 'thing' has no parameter 'sped'; valid are speed, count, name, on, topics"),
        ({"speed": 11.0}, "'speed' of node 'thing' is 11.0; it must be between 0.0 and 10.0 rad/s"),
        ({"speed": float("nan")}, "'speed' of node 'thing' is nan; give a finite number"),
        ({"speed": "fast"}, "'speed' of node 'thing' is 'fast'; it must be a number"),
        ({"count": 0}, "must be between 1 and inf"),
        ({"count": 1.5}, "it must be an integer"),
        ({"name": "c"}, "'name' of node 'thing' is 'c'; valid are a, b"),
        ({"on": 1}, "it must be true or false"),
        ({"topics": "x"}, "it must be a list of texts"),
    ],
)
def test_mistakes_are_one_clear_sentence(declared, values, message):
    with pytest.raises(HannesError, match=message):
        declared(**values)


def test_help_names_everything():
    text = help_text(Settings)
    assert "speed := 1.5" in text
    assert "how fast [rad/s] (0..10)" in text
    assert "one of a, b" in text
