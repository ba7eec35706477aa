"""A model file: nominal parameters plus the physical effects that were added, with their values."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from .errors import HannesError
from .files import write_whole
from .parameters import Parameter, ParameterSet, data_path, load_parameters, read_yaml

SCHEMA = "hannes/model/1"
_KEYS = (
    "schema",
    "name",
    "plant",
    "controller",
    "variant",
    "parameters",
    "overrides",
    "effects",
    "provenance",
)


@dataclass(frozen=True)
class EffectEntry:
    """An effect of a model: its catalogue name (or `path.py:Class` as source) and the values of its parameters."""

    name: str
    parameters: Mapping[str, Parameter]
    source: str | None = None

    @property
    def values(self) -> dict[str, float]:
        return {name: parameter.value for name, parameter in self.parameters.items()}

    def to_dict(self) -> dict[str, Any]:
        out: dict[str, Any] = {"name": self.name}
        if self.source:
            out["source"] = self.source
        return out | {"parameters": {name: p.to_dict() for name, p in self.parameters.items()}}


@dataclass(frozen=True)
class Model:
    """Everything that is needed to simulate one hand (or another drive).

    plant       `reduced`, `mujoco`, or `path.py:Class` of a user's own plant
    controller  `double_pid`, or `path.py:Class` of a user's own control law
    variant     options of the plant by name (return_mechanism, transmission, thumb_stop_deg)
    parameters  all parameters with provenance
    effects     the effects beyond the nominal model, in the order in which they were added
    provenance  how the file was made: bags with hashes, errors, command
    """

    name: str
    plant: str
    parameters: ParameterSet
    base: str = "hannes"
    controller: str = "double_pid"
    variant: Mapping[str, Any] = field(default_factory=dict)
    effects: tuple[EffectEntry, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [effect.name for effect in self.effects]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise HannesError(
                f"Model '{self.name}': effect {twice[0]} is listed twice; give each effect once."
            )

    # -- change -------------------------------------------------------------------------------------------------
    def with_plant(self, plant: str) -> Model:
        return replace(self, plant=plant)

    def with_values(
        self, values: Mapping[str, float], *, status: str | None = None, source: str | None = None
    ) -> Model:
        """Other values of named parameters (dotted names), of the model or of its effects."""

        def changed(name: str, p: Parameter) -> Parameter:
            return p.at(values[name], status=status, source=source) if name in values else p

        effects = tuple(
            replace(e, parameters={n: changed(f"{e.name}.{n}", p) for n, p in e.parameters.items()})
            for e in self.effects
        )
        theirs = self._of_effects
        own = {name: value for name, value in values.items() if name not in theirs}
        parameters = self.parameters.with_values(own, status=status, source=source)
        return replace(self, parameters=parameters, effects=effects)

    def named(self, name: str) -> Parameter:
        """A parameter by its dotted name: one of an effect of the model, or one of its own."""
        own = self._of_effects.get(name)
        return self.parameters[name] if own is None else own

    @property
    def names(self) -> frozenset[str]:
        """Dotted names of all parameters, of the model and of its effects."""
        return frozenset((*self.parameters, *self._of_effects))

    @property
    def _of_effects(self) -> dict[str, Parameter]:
        return {f"{e.name}.{n}": p for e in self.effects for n, p in e.parameters.items()}

    def with_effect(self, entry: EffectEntry) -> Model:
        """Add an effect, or replace the one of the same name."""
        kept = tuple(effect for effect in self.effects if effect.name != entry.name)
        return replace(self, effects=(*kept, entry))

    def without_effects(self) -> Model:
        return replace(self, effects=())

    # -- file ---------------------------------------------------------------------------------------------------
    @property
    def sha256(self) -> str:
        """Hash of all that changes the simulation (not of name and provenance)."""
        content = {
            "plant": self.plant,
            "controller": self.controller,
            "variant": dict(self.variant),
            "parameters": self.parameters.sha256,
            "effects": [[e.name, e.source, e.values] for e in self.effects],
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """Plain types; the parameters as overrides of the base set."""
        base = load_parameters(self.base)
        overrides = {n: p.to_dict() for n, p in self.parameters.items() if n not in base or base[n] != p}
        return {
            "schema": SCHEMA,
            "name": self.name,
            "plant": self.plant,
            "controller": self.controller,
            "variant": dict(self.variant),
            "parameters": self.base,
            "overrides": overrides,
            "effects": [effect.to_dict() for effect in self.effects],
            "provenance": dict(self.provenance),
        }

    def save(self, path: str | Path) -> Path:
        """Write the model as YAML; floats keep all their digits."""
        path = Path(path)
        try:
            write_whole(path, yaml.safe_dump(self.to_dict(), sort_keys=False, allow_unicode=True, width=110))
        except OSError as error:
            raise HannesError(f"Cannot write the model file '{path}': {error}.") from error
        return path

    @classmethod
    def load(cls, name_or_path: str | Path = "nominal") -> Model:
        """Load a shipped model by name (`nominal`) or any model file by path."""
        path = Path(name_or_path)
        if path.suffix not in (".yaml", ".yml"):
            path = data_path("models", f"{name_or_path}.yaml")
            if not path.exists():
                names = sorted(p.stem for p in data_path("models").glob("*.yaml"))
                raise HannesError(
                    f"No model '{name_or_path}'; shipped are {', '.join(names)}, or give the path of a "
                    "model file (.yaml)."
                )
        content = read_yaml(path, "model file")
        where = str(path)
        if not isinstance(content, Mapping):
            raise HannesError(f"{where}: a model file must be a mapping with the keys {', '.join(_KEYS)}.")
        unknown = sorted(set(content) - set(_KEYS), key=str)
        if unknown:
            raise HannesError(f"{where}: unknown keys {unknown}; valid are {', '.join(_KEYS)}.")
        if content.get("schema") != SCHEMA:
            raise HannesError(f"{where}: schema is {content.get('schema')!r}; this version reads {SCHEMA!r}.")
        base = str(content.get("parameters", "hannes"))
        base_path = (path.parent / base).resolve() if base.endswith((".yaml", ".yml")) else base
        parameters = load_parameters(base_path)
        overrides = content.get("overrides") or {}
        if not isinstance(overrides, Mapping):
            raise HannesError(f"{where}: 'overrides' must map parameter names to entries.")
        changed = dict(parameters.entries)
        for name, entry in overrides.items():
            if str(name) not in parameters:
                near = parameters.near(str(name))
                raise HannesError(f"{where}: unknown parameter '{name}'; valid are {', '.join(near)}.")
            own = parameters[str(name)]
            if isinstance(entry, Mapping) and "unit" in entry:
                # A YAML file's `unit: 1` is a number.
                if str(entry["unit"]) != own.unit:
                    raise HannesError(
                        f"{where}: parameter '{name}' is in '{entry['unit']}'; it must be in '{own.unit}', as in "
                        f"{base}: convert value, lower and upper."
                    )
                entry = {"lower": own.lower, "upper": own.upper, **entry}
            changed[str(name)] = Parameter.from_dict(str(name), entry, where)
        variant = content.get("variant") or {}
        provenance = content.get("provenance") or {}
        if not isinstance(variant, Mapping) or not isinstance(provenance, Mapping):
            raise HannesError(f"{where}: 'variant' and 'provenance' must be mappings.")
        effects = _read_effects(content.get("effects") or [], where, path.parent)
        given_here = [*map(str, overrides), *(f"{e.name}.{n}" for e in effects for n in e.parameters)]
        return cls(
            name=str(content.get("name", path.stem)),
            plant=_beside(str(content.get("plant", "reduced")), path.parent),
            parameters=ParameterSet(changed, parameters.source, dict.fromkeys(given_here, where)),
            base=str(base_path),
            controller=_beside(str(content.get("controller", "double_pid")), path.parent),
            variant=variant,
            effects=effects,
            provenance=provenance,
        )


def _beside(name: str, folder: Path) -> str:
    """`path.py:Class` with a path relative to the model file made absolute, where there is such a file."""
    file, _, cls = name.rpartition(":")
    return f"{(folder / file).resolve()}:{cls}" if file and (folder / file).is_file() else name


def _read_effects(content: object, where: str, folder: Path) -> tuple[EffectEntry, ...]:
    if not isinstance(content, list):
        raise HannesError(f"{where}: 'effects' must be a list of entries with name and parameters.")
    entries = []
    for item in content:
        if (
            not isinstance(item, Mapping)
            or "name" not in item
            or not isinstance(item.get("parameters"), Mapping)
        ):
            raise HannesError(f"{where}: every effect needs 'name' and 'parameters'.")
        unknown = sorted(set(item) - {"name", "source", "parameters"}, key=str)
        if unknown:
            raise HannesError(f"{where}: effect '{item['name']}': unknown keys {unknown}.")
        parameters = {
            str(n): Parameter.from_dict(f"{item['name']}.{n}", p, where)
            for n, p in item["parameters"].items()
        }
        source = _beside(str(item["source"]), folder) if item.get("source") else None
        file = source.rpartition(":")[0] if source else ""
        if file and not Path(file).expanduser().is_file():
            raise HannesError(
                f"{where}: effect '{item['name']}' is to come from '{source}', but there is no such file; where it "
                "has moved, correct that effect's `source`."
            )
        entries.append(EffectEntry(str(item["name"]), parameters, source))
    return tuple(entries)
