"""Frozen dataclass <-> ROS parameters.

A node's parameters are the fields of one frozen dataclass; `parameter()` gives a field its default, description and
range. `declare` declares them with descriptors, reads what the user gave, refuses unknown names and wrong values with
one sentence, and returns the dataclass, whose own `__post_init__` may check what ranges cannot say.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import MISSING, Field, field
from typing import Any, TypeVar

from hannes_description.errors import HannesError
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

T = TypeVar("T")

_OWN_TO_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides")
_TYPES = {bool: "true or false", int: "an integer", float: "a number", str: "text", list: "a list of texts"}


def parameter(
    default: Any,
    description: str,
    *,
    lower: float | None = None,
    upper: float | None = None,
    choices: Sequence[str] = (),
    unit: str = "",
) -> Any:
    """A dataclass field that is a ROS parameter.

    default      bool, int, float, str or tuple of str; its type is the parameter's type
    description  one sentence, shown by `ros2 param describe` and `--help`
    lower upper  inclusive range of a number, in `unit`
    choices      valid texts
    """
    return field(
        default=default,
        metadata={
            "description": description,
            "lower": lower,
            "upper": upper,
            "choices": tuple(choices),
            "unit": unit,
        },
    )


def _plain(item: Field[Any]) -> Any:
    if item.default is MISSING:
        raise TypeError(f"{item.name} has no default; every node parameter needs one.")
    return list(item.default) if isinstance(item.default, tuple) else item.default


def _describe(item: Field[Any]) -> str:
    meta = item.metadata
    text = meta["description"] + (f" [{meta['unit']}]" if meta["unit"] else "")
    return text + (f"; one of {', '.join(meta['choices'])}" if meta["choices"] else "")


def _descriptor(item: Field[Any]) -> ParameterDescriptor:
    # rclpy takes an empty list for bytes; the type of what the user gave is checked by `declare`
    empty_list = item.default == ()
    descriptor = ParameterDescriptor(description=_describe(item), read_only=True, dynamic_typing=empty_list)
    lower, upper = item.metadata["lower"], item.metadata["upper"]
    if isinstance(item.default, float) and (lower is not None or upper is not None):
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=-math.inf if lower is None else float(lower),
                to_value=math.inf if upper is None else float(upper),
            )
        ]
    elif isinstance(item.default, int) and not isinstance(item.default, bool) and lower is not None:
        descriptor.integer_range = [
            IntegerRange(from_value=int(lower), to_value=2**62 if upper is None else int(upper))
        ]
    return descriptor


def _check(node_name: str, item: Field[Any], value: Any) -> None:
    meta, where = item.metadata, f"Parameter '{item.name}' of node '{node_name}'"
    if isinstance(value, float) and not math.isfinite(value):
        raise HannesError(f"{where} is {value}; give a finite number.")
    lower, upper = meta["lower"], meta["upper"]
    if (lower is not None and value < lower) or (upper is not None and value > upper):
        unit = f" {meta['unit']}" if meta["unit"] else ""
        raise HannesError(
            f"{where} is {value}; it must be between {'-inf' if lower is None else lower} and "
            f"{'inf' if upper is None else upper}{unit}."
        )
    if meta["choices"]:
        for text in value if isinstance(value, list) else [value]:
            if text not in meta["choices"]:
                raise HannesError(f"{where} is '{text}'; valid are {', '.join(meta['choices'])}.")


def declare(node: Node, cls: type[T]) -> T:
    """Declare the fields of `cls` as read-only parameters of the node and return what the user gave as a `cls`.

    Raises HannesError for an unknown name, a wrong type or a value out of range.
    """
    # rclpy has no public way to see overrides of parameters that were never declared; they would be silently ignored.
    given: dict[str, Parameter] = node._parameter_overrides
    items = {item.name: item for item in dataclasses.fields(cls)}  # type: ignore[arg-type]
    unknown = sorted(name for name in given if name not in items and name.split(".")[0] not in _OWN_TO_ROS)
    if unknown:
        raise HannesError(
            f"Node '{node.get_name()}' has no parameter '{unknown[0]}'; valid are {', '.join(items)}."
        )
    values: dict[str, Any] = {}
    for name, item in items.items():
        default = _plain(item)
        if isinstance(default, float) and name in given and given[name].type_ == Parameter.Type.INTEGER:
            given[name] = Parameter(name, Parameter.Type.DOUBLE, float(given[name].value))
        if name in given:
            wanted = Parameter(name, value=default if default != [] else [""]).type_
            if given[name].type_ != wanted:
                raise HannesError(
                    f"Parameter '{name}' of node '{node.get_name()}' is {given[name].value!r}; it must "
                    f"be {_TYPES[type(default)]}."
                )
            _check(node.get_name(), item, given[name].value if default != [] else list(given[name].value))
        try:
            value = node.declare_parameter(name, default, _descriptor(item)).value
        except (
            InvalidParameterTypeException,
            InvalidParameterValueException,
            ParameterUninitializedException,
        ) as error:
            raise HannesError(f"Parameter '{name}' of node '{node.get_name()}': {error}") from None
        values[name] = tuple(value) if isinstance(default, list) else value
    return cls(**values)


def help_text(cls: type) -> str:
    """The parameters of a node as a table: name, default, description, range."""
    lines = []
    for item in dataclasses.fields(cls):
        lower, upper = item.metadata["lower"], item.metadata["upper"]
        span = (
            ""
            if lower is None and upper is None
            else f" ({'' if lower is None else f'{lower:g}'}..{'' if upper is None else f'{upper:g}'})"
        )
        lines.append(f"  {item.name} := {_plain(item)!r}\n      {_describe(item)}{span}")
    return "\n".join(lines)
