"""Parameters with provenance: value, unit, bounds, status and source of every number."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from numbers import Real
from pathlib import Path
from typing import Any

import yaml

from .errors import HannesError

STATUSES = ("datasheet", "published", "measured", "identified", "assumed")
_KEYS = ("value", "unit", "lower", "upper", "status", "source", "fixed", "tolerance")


@dataclass(frozen=True)
class Parameter:
    """One number of a model.

    value, lower, upper  in `unit`; lower <= value <= upper
    status               one of STATUSES
    source               where the number comes from
    fixed                applied, never optimised
    tolerance            standard deviation of what the machine's value may be, as a part of `value`; 0: known; None
                         where nobody said how well
    """

    value: float
    unit: str
    lower: float
    upper: float
    status: str
    source: str
    fixed: bool = False
    tolerance: float | None = None

    def __post_init__(self) -> None:
        for key in ("value", "lower", "upper"):
            if not math.isfinite(getattr(self, key)):
                raise HannesError(f"{key} is {getattr(self, key)}; it must be a finite number.")
        if not self.lower <= self.value <= self.upper:
            raise HannesError(
                f"value {self.value} {self.unit} is outside its bounds [{self.lower}, {self.upper}]."
            )
        if self.status not in STATUSES:
            raise HannesError(f"status {self.status!r} is unknown; valid are {', '.join(STATUSES)}.")
        if self.tolerance is not None:
            self._check_tolerance(self.tolerance)

    def _check_tolerance(self, tolerance: float) -> None:
        if not (math.isfinite(tolerance) and tolerance >= 0.0):
            raise HannesError(
                f"tolerance is {tolerance}; it must be 0 (known) or more, a part of the value (0.1: within 10 %)."
            )
        if tolerance and self.fixed:
            raise HannesError("it is fixed and has a tolerance: leave one of the two out.")
        if tolerance and self.value <= 0.0:
            raise HannesError(
                f"tolerance is a part of the value, which is {self.value:g} {self.unit} and must be above 0 for that."
            )

    def at(self, value: float, *, status: str | None = None, source: str | None = None) -> Parameter:
        """The same parameter with another value; the bounds are widened where they would exclude it.

        A tolerance is a part of a value: of one that is not above nought there is none.
        """
        return replace(
            self,
            tolerance=None if self.tolerance and value <= 0.0 else self.tolerance,
            value=float(value),
            lower=min(self.lower, float(value)),
            upper=max(self.upper, float(value)),
            status=status or self.status,
            source=source or self.source,
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain types, for YAML and JSON; `fixed` and `tolerance` only where they are set."""
        out: dict[str, Any] = {
            "value": self.value,
            "unit": self.unit,
            "lower": self.lower,
            "upper": self.upper,
            "status": self.status,
            "source": self.source,
        }
        if self.tolerance is not None:
            out["tolerance"] = self.tolerance
        return out | {"fixed": True} if self.fixed else out

    @classmethod
    def from_dict(cls, name: str, entry: object, where: str) -> Parameter:
        """Read one entry of a YAML file; errors name the parameter and the file."""
        if not isinstance(entry, Mapping):
            value = entry if isinstance(entry, Real) and not isinstance(entry, bool) else 1.0
            raise HannesError(
                f"{where}: parameter '{name}' must be a mapping with the keys {', '.join(_KEYS)}, such as "
                f"{{value: {value}, unit: the unit, status: assumed, source: where it is from}} for an override."
            )
        unknown = sorted(set(entry) - set(_KEYS), key=str)
        missing = [key for key in _KEYS[:6] if key not in entry]
        if unknown or missing:
            raise HannesError(
                f"{where}: parameter '{name}': "
                + (f"unknown keys {unknown}; " if unknown else "")
                + (f"missing keys {missing}; " if missing else "")
                + f"valid keys are {', '.join(_KEYS)}."
            )
        numbers = ("value", "lower", "upper", *(("tolerance",) if "tolerance" in entry else ()))
        for key in numbers:
            if isinstance(entry[key], bool) or not isinstance(entry[key], Real):
                raise HannesError(
                    f"{where}: parameter '{name}': {key} is {entry[key]!r}; it must be a number."
                )
        try:
            return cls(
                float(entry["value"]),
                str(entry["unit"]),
                float(entry["lower"]),
                float(entry["upper"]),
                str(entry["status"]),
                str(entry["source"]),
                bool(entry.get("fixed", False)),
                float(entry["tolerance"]) if "tolerance" in entry else None,
            )
        except (TypeError, ValueError) as error:
            raise HannesError(f"{where}: parameter '{name}': {error}") from error


@dataclass(frozen=True)
class ParameterSet(Mapping[str, Parameter]):
    """Parameters by dotted name, such as `motor.resistance`; immutable.

    source   the file that they are from
    origins  the file of those that are from another one, and of those of a model's effects, by name
    """

    entries: Mapping[str, Parameter]
    source: str = "memory"
    origins: Mapping[str, str] = field(default_factory=dict, repr=False, compare=False)
    _hash: list[str] = field(default_factory=list, repr=False, compare=False)

    def __getitem__(self, name: str) -> Parameter:
        try:
            return self.entries[name]
        except KeyError:
            raise HannesError(
                f"Unknown parameter '{name}' in {self.source}; valid are {', '.join(self.near(name))}."
            ) from None

    def near(self, name: str) -> list[str]:
        """The names of the group of a name, or where there is no such group the groups."""
        group = name.split(".")[0]
        own = [n for n in self.entries if n.split(".")[0] == group]
        return own or sorted({n.split(".")[0] + ".*" for n in self.entries})

    def __contains__(self, name: object) -> bool:
        return name in self.entries

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def value(self, name: str) -> float:
        """The value of one parameter in its unit."""
        return self[name].value

    def origin(self, name: str) -> str:
        """The file that gives a parameter its value."""
        return self.origins.get(name, self.source)

    def require(self, needs: Mapping[str, Sequence[str]]) -> None:
        """Raise one HannesError that names all parameters that are not there, by who needs them."""
        missing = {who: [name for name in names if name not in self] for who, names in needs.items()}
        said = [f"{', '.join(names)} ({who} cannot do without)" for who, names in missing.items() if names]
        if said:
            raise HannesError(f"{self.source}: missing parameters: {'; '.join(said)}.")

    def require_positive(self, names: Iterable[str], who: str) -> None:
        """Raise a HannesError for the first of the named parameters, where it is there, that is not above 0."""
        for name in names:
            if name in self and self.value(name) <= 0.0:
                raise HannesError(
                    f"{self.origin(name)}: {name} is {self.value(name):g} {self[name].unit}; {who} needs more than 0."
                )

    def require_not_negative(self, names: Iterable[str], who: str) -> None:
        """Raise a HannesError for the first of the named parameters, where it is there, that is below 0."""
        for name in names:
            if name in self and self.value(name) < 0.0:
                raise HannesError(
                    f"{self.origin(name)}: {name} is {self.value(name):g} {self[name].unit}; {who} needs 0 or more."
                )

    def values_of(self, group: str) -> dict[str, float]:
        """All values of a group, by the name after the dot: `values_of("motor")["resistance"]`."""
        out = {n.split(".", 1)[1]: p.value for n, p in self.entries.items() if n.split(".", 1)[0] == group}
        if not out:
            raise HannesError(f"No parameter group '{group}' in {self.source}.")
        return out

    def with_values(
        self, values: Mapping[str, float], *, status: str | None = None, source: str | None = None
    ) -> ParameterSet:
        """A new set in which the named parameters have other values."""
        changed = {name: self[name].at(value, status=status, source=source) for name, value in values.items()}
        return replace(self, entries={**self.entries, **changed}, _hash=[])

    def to_dict(self) -> dict[str, Any]:
        return {name: parameter.to_dict() for name, parameter in self.entries.items()}

    @property
    def sha256(self) -> str:
        """Hash of names and values."""
        if not self._hash:
            text = json.dumps({n: [p.value, p.unit] for n, p in self.entries.items()}, sort_keys=True)
            self._hash.append(hashlib.sha256(text.encode()).hexdigest())
        return self._hash[0]

    @classmethod
    def from_dict(cls, content: object, where: str) -> ParameterSet:
        """Nested groups or dotted names: `motor: {resistance: {value: ...}}`."""
        if not isinstance(content, Mapping):
            raise HannesError(f"{where}: expected a mapping of parameters.")
        entries: dict[str, Parameter] = {}
        for group, members in content.items():
            if isinstance(members, Mapping) and "value" in members:
                entries[str(group)] = Parameter.from_dict(str(group), members, where)
            elif isinstance(members, Mapping):
                for name, entry in members.items():
                    entries[f"{group}.{name}"] = Parameter.from_dict(f"{group}.{name}", entry, where)
            else:
                raise HannesError(f"{where}: '{group}' must be a group of parameters or a parameter.")
        return cls(entries, where)


MAX_YAML_BYTES = 4_000_000


class _OneOfEach:
    """What a YAML loader lacks: a key that is given twice is refused, and 1e-6 is a number as it is everywhere else."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        given: set[tuple[str, str]] = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if isinstance(key, yaml.ScalarNode):
                if (key.tag, key.value) in given:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"the key '{key.value}' is given twice", key.start_mark
                    )
                given.add((key.tag, key.value))
        return super().construct_mapping(node, deep)  # type: ignore[misc]


class _SafeLoader(_OneOfEach, yaml.SafeLoader):
    pass


class _FastSafeLoader(_OneOfEach, getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    pass


for _loader in (_SafeLoader, _FastSafeLoader):
    _loader.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
    )


def read_yaml(path: Path, what: str) -> Any:
    """Read YAML safely; one clear error for a missing, unreadable, oversized or broken file.

    The pure Python loader for the files of others: libyaml's is ten times as fast, but crashes on deep nesting.
    """
    loader = _FastSafeLoader if path.is_relative_to(data_path()) else _SafeLoader
    try:
        if path.stat().st_size > MAX_YAML_BYTES:
            raise HannesError(f"{what} '{path}' has more than {MAX_YAML_BYTES} bytes; that is no such file.")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise HannesError(f"Cannot read {what} '{path}': {error}.") from error
    try:
        return loader(text).get_single_data()
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise HannesError(f"{what} '{path}' is not valid YAML: {yaml_fault(error)}.") from error


def yaml_fault(error: Exception) -> str:
    """What is wrong with a YAML text, in one line, and where."""
    mark = getattr(error, "problem_mark", None)
    if mark is None:
        return str(error).splitlines()[0]
    context, problem = (getattr(error, name, None) for name in ("context", "problem"))
    return f"line {mark.line + 1}, column {mark.column + 1}: {', '.join(filter(None, (context, problem)))}"


def data_path(*parts: str) -> Path:
    """Path of a data file that the package ships."""
    return Path(str(resources.files("hannes_description").joinpath("data", *parts)))


def load_parameters(name_or_path: str | Path) -> ParameterSet:
    """Load a shipped set by name (`hannes`) or any file by path."""
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        path = data_path("parameters", f"{name_or_path}.yaml")
        if not path.exists():
            names = sorted(p.stem for p in data_path("parameters").glob("*.yaml"))
            raise HannesError(
                f"No parameter set '{name_or_path}'; shipped are {', '.join(names)}, or give a .yaml path."
            )
    return ParameterSet.from_dict(read_yaml(path, "parameter file"), str(path))
