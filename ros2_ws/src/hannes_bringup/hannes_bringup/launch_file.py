"""Reads launch files of the YAML front end of ROS 2 into the processes that they ask for.

Only for where there is no `ros2 launch`. Understood are the actions arg, let and node (with param, remap, if, unless,
args, namespace, name) and the substitutions $(var NAME) and $(find-pkg-share PACKAGE); anything else is refused with
one sentence, so that a file that works here works under `ros2 launch` too.
Source: https://docs.ros.org/en/jazzy/How-To-Guides/Launch-file-different-formats.html and, for what a node becomes on
the command line, https://docs.ros.org/en/jazzy/How-To-Guides/Node-arguments.html.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hannes_description.errors import HannesError
from hannes_description.parameters import yaml_fault

ACTION_KEYS = {
    "arg": ("name", "default", "description", "choice"),
    "let": ("name", "value", "if", "unless"),
    "node": (
        "pkg",
        "exec",
        "name",
        "namespace",
        "param",
        "remap",
        "args",
        "output",
        "on_exit",
        "if",
        "unless",
    ),
}
_SUBSTITUTION = re.compile(r"\$\(([^()]*)\)")


@dataclass(frozen=True)
class Argument:
    """A declared argument of a launch file; `default` None means that it must be given."""

    name: str
    default: str | None
    description: str
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class NodeProcess:
    """A node to start: package, executable, the name to show, and what follows the program on the command line.

    required  `on_exit: shutdown`: when it ends, all end
    """

    package: str
    executable: str
    name: str
    arguments: tuple[str, ...]
    required: bool = False


@dataclass(frozen=True)
class LaunchPlan:
    """What a launch file asks for with given arguments."""

    arguments: tuple[Argument, ...]
    nodes: tuple[NodeProcess, ...]


def read_arguments(path: Path) -> tuple[Argument, ...]:
    """The arguments that a launch file declares, in its order."""
    return tuple(_argument(path, body) for kind, body in _actions(path) if kind == "arg")


def read_launch_file(path: Path, given: Mapping[str, str], share_of: Callable[[str], Path]) -> LaunchPlan:
    """What the launch file at `path` asks for.

    given     argument values by name; an undeclared name is an error
    share_of  the share folder of a package, for $(find-pkg-share)
    """
    actions = _actions(path)
    arguments = read_arguments(path)
    names = [argument.name for argument in arguments]
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise HannesError(
            f"{path.name} has no argument '{unknown[0]}'; valid are {', '.join(names) or 'none'}."
        )
    reader = _Reader(path, dict(given), share_of)
    nodes = [node for kind, body in actions if (node := reader.action(kind, body)) is not None]
    return LaunchPlan(arguments, tuple(nodes))


def _actions(path: Path) -> list[tuple[str, dict[str, Any]]]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise HannesError(f"Cannot read launch file '{path}': {error}.") from error
    except yaml.YAMLError as error:
        raise HannesError(f"Launch file '{path}' is not valid YAML: {yaml_fault(error)}.") from error
    if not isinstance(content, dict) or set(content) != {"launch"} or not isinstance(content["launch"], list):
        raise HannesError(f"{path}: a launch file is a mapping with the one key 'launch', a list of actions.")
    actions = []
    for number, item in enumerate(content["launch"], 1):
        if not isinstance(item, dict) or len(item) != 1:
            raise HannesError(
                f"{path}: action {number} must be one of {', '.join(ACTION_KEYS)}, with its keys below it."
            )
        kind, body = next(iter(item.items()))
        if kind not in ACTION_KEYS:
            raise HannesError(
                f"{path}: action {number}: '{kind}' is not understood; valid are {', '.join(ACTION_KEYS)}."
            )
        if not isinstance(body, dict):
            raise HannesError(f"{path}: action {number} ({kind}) must be a mapping.")
        unknown = sorted(map(str, set(body) - set(ACTION_KEYS[kind])))
        if unknown:
            valid = ", ".join(ACTION_KEYS[kind])
            raise HannesError(
                f"{path}: action {number} ({kind}): unknown key '{unknown[0]}'; valid are {valid}."
            )
        actions.append((str(kind), body))
    return actions


def _argument(path: Path, body: Mapping[str, Any]) -> Argument:
    choices = tuple(str(item["value"]) for item in body.get("choice", ()))
    default = None if body.get("default") is None else str(body["default"])
    return Argument(
        str(_required(path, "arg", body, "name")), default, str(body.get("description", "")), choices
    )


def _required(path: Path, kind: str, body: Mapping[str, Any], key: str) -> Any:
    if key not in body:
        raise HannesError(f"{path}: a {kind} lacks the key '{key}'.")
    return body[key]


class _Reader:
    """Carries out the actions in order, with the launch configurations so far."""

    def __init__(self, path: Path, configurations: dict[str, str], share_of: Callable[[str], Path]) -> None:
        self.path = path
        self.configurations = configurations
        self.share_of = share_of

    def action(self, kind: str, body: Mapping[str, Any]) -> NodeProcess | None:
        if kind == "arg":
            self._declare(_argument(self.path, body))
            return None
        if not self._wanted(body):
            return None
        if kind == "let":
            name = str(_required(self.path, kind, body, "name"))
            self.configurations[name] = self._text(_required(self.path, kind, body, "value"))
            return None
        return self._node(body)

    def _declare(self, argument: Argument) -> None:
        if argument.name not in self.configurations:
            if argument.default is None:
                raise HannesError(
                    f"{self.path.name}: argument '{argument.name}' must be given ({argument.description})."
                )
            self.configurations[argument.name] = self._text(argument.default)
        value = self.configurations[argument.name]
        if argument.choices and value not in argument.choices:
            valid = ", ".join(argument.choices)
            raise HannesError(
                f"{self.path.name}: argument '{argument.name}' is '{value}'; valid are {valid}."
            )

    def _wanted(self, body: Mapping[str, Any]) -> bool:
        if "if" in body and not self._truth(body["if"]):
            return False
        return not ("unless" in body and self._truth(body["unless"]))

    def _truth(self, value: object) -> bool:
        # as launch.conditions.IfCondition
        text = self._text(value).strip().lower()
        if text in ("true", "1"):
            return True
        if text in ("false", "0"):
            return False
        raise HannesError(
            f"{self.path.name}: the condition '{value}' is '{text}'; valid are true, false, 1, 0."
        )

    def _node(self, body: Mapping[str, Any]) -> NodeProcess:
        package = self._text(_required(self.path, "node", body, "pkg"))
        executable = self._text(_required(self.path, "node", body, "exec"))
        name = self._text(body["name"]) if "name" in body else executable
        command = self._text(body.get("args", "")).split()
        command.append("--ros-args")
        if "name" in body:
            command += ["-r", f"__node:={name}"]
        if "namespace" in body:
            namespace = self._text(body["namespace"])
            command += ["-r", f"__ns:={namespace if namespace.startswith('/') else '/' + namespace}"]
        for item in self._items(body, "param", ("name", "value", "from")):
            if "from" in item:
                command += ["--params-file", self._text(item["from"])]
            else:
                value = item["value"]
                typed = self._typed(value) if isinstance(value, str) else value
                command += ["-p", f"{self._text(item['name'])}:={json.dumps(typed)}"]
        for item in self._items(body, "remap", ("from", "to")):
            command += ["-r", f"{self._text(item['from'])}:={self._text(item['to'])}"]
        on_exit = body.get("on_exit")
        if on_exit not in (None, "shutdown"):
            raise HannesError(f"{self.path.name}: on_exit of {name} is '{on_exit}'; valid is shutdown.")
        return NodeProcess(package, executable, name, tuple(command), required=on_exit is not None)

    def _typed(self, value: str) -> Any:
        """A parameter's text as YAML, as launch_ros does: `3` is a number, nothing is the empty text."""
        text = self._text(value)
        try:
            typed = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise HannesError(
                f"{self.path.name}: the value '{text}' of a parameter is not valid YAML."
            ) from error
        return "" if typed is None else typed

    def _items(self, body: Mapping[str, Any], key: str, valid: tuple[str, ...]) -> list[dict[str, Any]]:
        items = body.get(key) or []
        if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
            raise HannesError(
                f"{self.path}: '{key}' of a node must be a list of mappings with {', '.join(valid)}."
            )
        for item in items:
            shapes = ({"name", "value"}, {"from"}) if key == "param" else ({"from", "to"},)
            if set(item) not in shapes:
                expected = " or ".join(" + ".join(sorted(shape)) for shape in shapes)
                raise HannesError(
                    f"{self.path}: a '{key}' has the keys {', '.join(sorted(map(str, item)))}; valid are {expected}."
                )
        return items

    def _text(self, value: object) -> str:
        """The text with its substitutions carried out."""
        text = str(value).lower() if isinstance(value, bool) else str(value)
        replaced = _SUBSTITUTION.sub(lambda match: self._substitute(match.group(1)), text)
        if "$(" in replaced:
            raise HannesError(
                f"{self.path.name}: '{text}': nested or broken substitutions are not understood."
            )
        return replaced

    def _substitute(self, inner: str) -> str:
        kind, _, operand = inner.strip().partition(" ")
        operand = operand.strip().strip("'\"")
        if kind == "var":
            if operand not in self.configurations:
                known = ", ".join(self.configurations)
                raise HannesError(
                    f"{self.path.name}: $(var {operand}) is not declared before its use; known are {known}."
                )
            return self.configurations[operand]
        if kind == "find-pkg-share":
            return str(self.share_of(operand))
        raise HannesError(
            f"{self.path.name}: $({inner}) is not understood; valid are $(var NAME), $(find-pkg-share PACKAGE)."
        )
