"""A physical effect: one class in one file, found by name or by `path.py:Class`."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache, lru_cache
from importlib.metadata import EntryPoint, entry_points
from multiprocessing import parent_process
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import EffectEntry
from hannes_description.parameters import Parameter
from numba import cfunc
from numpy.typing import NDArray

from .native import EFFECT_SIGNATURE, needs_python
from .plant import PlantDiverged
from .ports import N_INPUTS, N_OUTPUTS

NEEDS_PYTHON = "calls print, or something else that needs Python, which compiled code has not"

ENTRY_POINTS = "hannes.effects"
"""Entry-point group in which another package offers its effects."""


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    unit           SI
    lower, upper   bounds of the search; what physics allows
    typical        a value that a hand may show; sets the scale of the search, and in recordings of another machine than
                   the simulator's no strength beyond eight times this is believed
    vanishing      the value at which the effect contributes exactly nothing, or None for a shape parameter
    starts         values from which a search starts, where the error has several minima; without them a strength is
                   searched at multiples of its typical value
    description    what it is
    part           True for a part of a whole: both ends of its range are values like any other
    beyond_wire    True for the part that acts beyond the wire: one mass has none, and nothing tells it there
    period         True for a period in the motor's position: a search also starts from the lines in the spectrum of
                   the residual over the position
    sd             of a shape: standard deviation of what is usual about `typical`.  Fits begin there and pay for what
                   is farther off, as for a parameter of the machine; 0 where one value is as good as another
    """

    name: str
    unit: str
    lower: float
    upper: float
    typical: float
    vanishing: float | None = None
    description: str = ""
    starts: tuple[float, ...] = ()
    period: bool = False
    part: bool = False
    beyond_wire: bool = False
    sd: float = 0.0

    def __post_init__(self) -> None:
        if self.sd < 0.0 or (self.sd and self.vanishing is not None):
            raise HannesError(
                f"Effect parameter '{self.name}': sd {self.sd}; it is at least 0, and of a shape (no `vanishing`) only."
            )
        if not self.lower <= self.typical <= self.upper:
            raise HannesError(
                f"Effect parameter '{self.name}': typical {self.typical} is outside "
                f"[{self.lower}, {self.upper}]."
            )
        if self.vanishing is not None and not self.lower <= self.vanishing <= self.upper:
            raise HannesError(
                f"Effect parameter '{self.name}': vanishing {self.vanishing} is outside "
                f"[{self.lower}, {self.upper}]."
            )
        outside = [value for value in self.starts if not self.lower <= value <= self.upper]
        if outside:
            raise HannesError(
                f"Effect parameter '{self.name}': starts {outside} are outside [{self.lower}, {self.upper}]."
            )


class Effect:
    """Base of all effects; subclasses are declarations and never instantiated.

    name        identifier in model files and on the command line
    title       what people read
    parameters  the effect's parameters; at least one has a vanishing value
    known       figures of the machine, which no search moves (`typical` is that of the hand); they follow in p
    states      number of own states (float64, zero at reset)
    memory      True where the effect remembers earlier closures (temperature, say), so that every closure of a
                recording has to be simulated in turn
    law_below   (parameter, part of the machine's travel) below which it is no more than how the law of any other
                machine sets in, which this simulator leaves out: there it is told, but not named as missing
    both_ways   True where it compares the two directions: a machine that never turns back does not show it
    looks_like  one sentence: what it looks like in the data
    told_by     one sentence: the experiment that shows it best

    `contribute(x, p, s, y)` reads the inputs x and the parameters p, may advance its own states s by one step
    x[DT], and ADDS to the outputs y (indices in ports.py).  It is compiled by numba as a C function: plain
    arithmetic, `math` functions and constants only.
    """

    name: ClassVar[str] = ""
    title: ClassVar[str] = ""
    parameters: ClassVar[tuple[EffectParameter, ...]] = ()
    known: ClassVar[tuple[EffectParameter, ...]] = ()
    states: ClassVar[int] = 0
    memory: ClassVar[bool] = False
    law_below: ClassVar[tuple[str, float] | None] = None
    both_ways: ClassVar[bool] = False
    looks_like: ClassVar[str] = ""
    told_by: ClassVar[str] = ""

    @staticmethod
    def contribute(x: Any, p: Any, s: Any, y: Any) -> None:
        raise NotImplementedError

    @classmethod
    def strength(cls) -> EffectParameter:
        """The first parameter that has a vanishing value: at that value the effect is off."""
        return next(p for p in cls.parameters if p.vanishing is not None)

    @classmethod
    def figures(cls) -> tuple[EffectParameter, ...]:
        """All that `contribute` finds in p, in this order."""
        return (*cls.parameters, *cls.known)

    @classmethod
    def entry(
        cls,
        values: Mapping[str, float] | None = None,
        *,
        source: str | None = None,
        status: str = "assumed",
        where: str = "typical value of the effect",
    ) -> EffectEntry:
        """An entry for a model file; parameters that are not given take their typical value."""
        values = dict(values or {})
        unknown = sorted(set(values) - {p.name for p in cls.figures()})
        if unknown:
            raise HannesError(
                f"Effect '{cls.name}' has no parameter {', '.join(unknown)}; "
                f"valid are {', '.join(p.name for p in cls.figures())}."
            )
        entries = {}
        for p in cls.figures():
            value = float(values.get(p.name, p.typical))
            if not p.lower <= value <= p.upper:
                raise HannesError(
                    f"Effect '{cls.name}': {p.name} = {value} {p.unit} is outside [{p.lower}, {p.upper}]."
                )
            entries[p.name] = Parameter(value, p.unit, p.lower, p.upper, status, where)
        return EffectEntry(cls.name, entries, source)


EffectType = type[Effect]


def check_effect(effect: EffectType, where: str) -> EffectType:
    """Check a declaration once; errors say what is wrong with which effect."""
    if not effect.name or not effect.name.isidentifier():
        raise HannesError(f"{where}: the effect needs a `name` that is an identifier, not {effect.name!r}.")
    if not effect.parameters:
        raise HannesError(f"{where}: effect '{effect.name}' declares no parameters.")
    if all(p.vanishing is None for p in effect.parameters):
        raise HannesError(
            f"{where}: effect '{effect.name}' needs a parameter with a `vanishing` value (off)."
        )
    names = [p.name for p in effect.figures()]
    if any(p.vanishing is not None for p in effect.known) or len(set(names)) < len(names):
        raise HannesError(
            f"{where}: effect '{effect.name}': each parameter needs a name of its own, and what is `known` no "
            "`vanishing` value."
        )
    if not isinstance(effect.states, int) or isinstance(effect.states, bool) or effect.states < 0:
        raise HannesError(
            f"{where}: effect '{effect.name}': `states` is {effect.states!r}; it must be how many it has."
        )
    if "contribute" not in effect.__dict__ and all(
        "contribute" not in b.__dict__ for b in effect.__mro__[:-2]
    ):
        raise HannesError(f"{where}: effect '{effect.name}' defines no `contribute(x, p, s, y)`.")
    if not effect.title:
        effect.title = effect.name.replace("_", " ")
    return effect


def _effects_in(module: ModuleType) -> list[EffectType]:
    return [
        c
        for _, c in inspect.getmembers(module, inspect.isclass)
        if issubclass(c, Effect) and c is not Effect and c.__module__ == module.__name__ and c.name
    ]


@cache
def catalogue() -> Mapping[str, EffectType]:
    """All effects by name: the files of hannes_sim/effects and the entry points of other packages.

    An entry point that gives no effect is left out, with one line that says why.
    """
    found: dict[str, EffectType] = {}
    package = importlib.import_module("hannes_sim.effects")
    for info in sorted(pkgutil.iter_modules(package.__path__), key=lambda i: i.name):
        for effect in _effects_in(importlib.import_module(f"hannes_sim.effects.{info.name}")):
            found[effect.name] = check_effect(effect, f"hannes_sim/effects/{info.name}.py")
    for point in entry_points(group=ENTRY_POINTS):
        try:
            effect = _offered(point, found)
        except HannesError as error:
            # to stderr, and not by the processes that compute beside this one
            if parent_process() is None:
                print(f"warning: {str(error).rstrip('.')}; it is left out", file=sys.stderr, flush=True)
            continue
        found[effect.name] = effect
    return found


def _offered(point: EntryPoint, found: Mapping[str, EffectType]) -> EffectType:
    """The effect of another package's entry point; HannesError where it is none, or `found` has its name."""
    where = f"effect '{point.name}' of {point.dist.name if point.dist else 'a package'} ({point.value})"
    try:
        effect = point.load()
    except Exception as error:  # whatever another package's import raises
        raise HannesError(f"{where} cannot be imported: {reason(error)}") from error
    if not (inspect.isclass(effect) and issubclass(effect, Effect)):
        raise HannesError(f"{where} is not a subclass of hannes_sim.effect.Effect")
    if call_own(where, check_effect, effect, where).name in found:
        raise HannesError(f"{where}: an effect named '{effect.name}' exists already")
    return effect


@lru_cache(maxsize=256)
def load_effect(name_or_source: str) -> EffectType:
    """An effect by catalogue name, or a user's own by `path.py:Class` (the file is executed, as any import is)."""
    if not is_own_effect(name_or_source):
        found = catalogue()
        if name_or_source not in found:
            near = get_close_matches(name_or_source, found, 1)
            meant = f"did you mean {near[0]}? The" if near else "the"
            raise HannesError(
                f"Unknown effect '{name_or_source}'; {meant} catalogue has {', '.join(sorted(found))}; "
                "an own effect is given as path.py:Class."
            )
        return found[name_or_source]
    file, _, class_name = name_or_source.rpartition(":")
    if file in catalogue() and not Path(file).exists():
        raise HannesError(
            f"'{name_or_source}': an effect of the catalogue is given by its name alone, {file}; values of its "
            "parameters stand in a model file (`hannes add` writes one)."
        )
    effect = load_class(file, class_name, "effect")
    if not (inspect.isclass(effect) and issubclass(effect, Effect)):
        raise HannesError(f"'{class_name}' in '{file}' is not a subclass of hannes_sim.effect.Effect.")
    return check_effect(effect, f"{file}, class {class_name}")


def reason(error: BaseException) -> str:
    """One line of what an error says; numba's, which are long, with what it is about and where."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    said = [line for line in lines if not line.startswith("Failed in nopython mode")]
    where = next((f" ({line.rstrip(':')})" for line in lines[1:] if line.startswith('File "')), "")
    return f"{type(error).__name__}: {(said or lines or [''])[0].rstrip('.')}{where}"


def call_own(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """What a user's function gives; whatever it raises becomes one error that says where."""
    try:
        return function(*arguments)
    except HannesError:
        raise
    except Exception as error:  # a user's code may raise whatever it likes
        frames = traceback.extract_tb(error.__traceback__)[1:]
        own = [frame for frame in frames if frame.filename == frames[0].filename]
        where = f" ({own[-1].filename}, line {own[-1].lineno})" if own else ""
        raise HannesError(f"{what} failed: {reason(error)}{where}.") from error


def load_class(file: str, class_name: str, what: str) -> Any:
    """An attribute of a user's own Python file; the file is executed once per process."""
    path = Path(file).expanduser().resolve()
    if not path.is_file():
        raise HannesError(f"No file '{file}' for the {what} '{class_name}'; give path.py:Class.")
    module_name = f"hannes_user_{abs(hash(str(path))):x}"
    if module_name in sys.modules:
        module = sys.modules[module_name]
    else:
        spec = importlib.util.spec_from_file_location(module_name, path)
        if spec is None or spec.loader is None:
            raise HannesError(f"'{file}' cannot be loaded as a Python module.")
        module = importlib.util.module_from_spec(spec)
        sys.modules[module_name] = module
        try:
            spec.loader.exec_module(module)
        except Exception as error:  # whatever a user's file raises is reported as one clear error
            del sys.modules[module_name]
            own = [f for f in traceback.extract_tb(error.__traceback__) if f.filename == str(path)]
            inside = f", in {own[-1].name}" if own and own[-1].name != "<module>" else ""
            where = f" (line {own[-1].lineno}{inside})" if own else ""
            raise HannesError(f"'{file}' cannot be imported: {reason(error)}{where}.") from error
    if not hasattr(module, class_name):
        names = ", ".join(
            c.__name__ for _, c in inspect.getmembers(module, inspect.isclass) if c.__module__ == module_name
        )
        raise HannesError(f"'{file}' has no '{class_name}'; it has {names or 'no classes'}.")
    return getattr(module, class_name)


@cache
def compile_effect(effect: EffectType) -> Any:
    """The compiled C function of an effect (kept alive by the cache); `.address` is what a plant calls."""
    try:
        compiled = cfunc(EFFECT_SIGNATURE, cache=_cacheable(effect))(effect.contribute)
    except Exception as error:  # numba's errors are long; the user needs the effect and the reason
        raise HannesError(
            f"Effect '{effect.name}': contribute(x, p, s, y) cannot be compiled: {reason(error)} "
            "(plain arithmetic, math functions and the constants of hannes_sim.ports are allowed)."
        ) from error
    if needs_python(compiled):
        raise HannesError(f"Effect '{effect.name}': contribute(x, p, s, y) {NEEDS_PYTHON}; take it out.")
    return compiled


def _cacheable(effect: EffectType) -> bool:
    # The disk cache is keyed by file and time stamp of its directory; a user's folder may be read-only.
    return effect.__module__.startswith("hannes_sim.")


def effect_of(entry: EffectEntry) -> EffectType:
    """The effect of a model's entry; HannesError where the entry lacks one of its parameters or has another.

    A refinement (a part of a whole, or what has a usual value) may be left out: it is then what is typical.
    """
    kind = load_effect(entry.source or entry.name)
    names, given = [p.name for p in kind.figures()], set(entry.parameters)
    wrong = [f"has no parameter {n}" for n in sorted(given.difference(names))]
    wrong += [
        f"needs a value of {p.name}" for p in kind.figures() if p.name not in given and not (p.part or p.sd)
    ]
    if wrong:
        raise HannesError(
            f"Effect '{kind.name}' of the model {' and '.join(wrong)}; its parameters are {', '.join(names)}."
        )
    return kind


class ContributeFailed(HannesError):
    """An effect raised an exception while it ran; the message names effect, time and reason."""


class BoundEffects:
    """The active effects of a plant: their functions, parameters and states as flat buffers.

    table       int64 (1 + 3 n): count, then the addresses (function, parameters, states) of each
    parameters  float64, concatenated; change in place with `set`
    states      float64, concatenated; zeroed by the plant's reset
    """

    def __init__(self, effects: tuple[tuple[EffectType, Mapping[str, float]], ...]) -> None:
        self.effects = tuple(effect for effect, _ in effects)
        self.index = {(effect.name, p.name): 0 for effect in self.effects for p in effect.figures()}
        self._functions = [compile_effect(effect) for effect in self.effects]  # type: ignore[arg-type]  # a class is hashable
        n_parameters = len(self.index)
        self.parameters: NDArray[np.float64] = np.zeros(max(1, n_parameters))
        self.states: NDArray[np.float64] = np.zeros(max(1, sum(effect.states for effect in self.effects)))
        self.table: NDArray[np.int64] = np.zeros(1 + 3 * len(self.effects), dtype=np.int64)
        self.table[0] = len(self.effects)
        at_p = at_s = 0
        for k, (effect, values) in enumerate(effects):
            self.table[1 + 3 * k] = self._functions[k].address
            self.table[2 + 3 * k] = self.parameters.ctypes.data + 8 * at_p
            self.table[3 + 3 * k] = self.states.ctypes.data + 8 * at_s
            for j, p in enumerate(effect.figures()):
                self.index[(effect.name, p.name)] = at_p + j
                self.parameters[at_p + j] = values.get(p.name, p.typical)
            at_p += len(effect.figures())
            at_s += effect.states

    def set(self, effect: str, parameter: str, value: float) -> None:
        """Change one parameter of an active effect."""
        self.parameters[self.index[(effect, parameter)]] = value

    def failed(self, said: str, time: float) -> ContributeFailed:
        """The error of an effect that raised an exception at a time [s]."""
        return ContributeFailed(f"{self._blamed} failed at t = {time:.4g} s: {said}.")

    def undefined(self, time: float) -> PlantDiverged:
        """The error of an effect that gave no number until a time [s]."""
        return PlantDiverged(
            f"{self._blamed} gave NaN or infinity before t = {time:.4g} s; it must give finite numbers wherever the "
            "machine goes."
        )

    @property
    def _blamed(self) -> str:
        own = [effect.name for effect in self.effects if effect.name not in catalogue()]
        which = "' or '".join(own or [effect.name for effect in self.effects])
        return f"Effect '{which}': contribute(x, p, s, y)"

    @classmethod
    def of(cls, entries: tuple[EffectEntry, ...]) -> BoundEffects:
        return cls(tuple((effect_of(e), e.values) for e in entries))


def evaluate(
    effect: EffectType,
    values: Mapping[str, float],
    inputs: Mapping[int, float],
    states: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Outputs (N_OUTPUTS,) of one effect for given inputs, in plain Python; for tests and pictures."""
    x = np.zeros(N_INPUTS)
    for index, value in inputs.items():
        x[index] = value
    y = np.zeros(N_OUTPUTS)
    s = np.zeros(max(1, effect.states)) if states is None else states
    effect.contribute(x, np.array([values.get(p.name, p.typical) for p in effect.figures()]), s, y)
    return y


def is_own_effect(given: str) -> bool:
    """Whether a name or path.py:Class is the user's own effect, and not one of the catalogue."""
    return ":" in given


def effect_source(given: str) -> str | None:
    """What a model file stores so that the effect is found again.

    None for the catalogue, else an absolute path:Class.
    """
    if not is_own_effect(given):
        return None
    file, _, class_name = given.rpartition(":")
    return f"{Path(file).expanduser().resolve()}:{class_name}"


def strength_of(effect: str, factor: float) -> EffectEntry:
    """An effect at `factor` times its typical strength; shape parameters stay typical."""
    kind = load_effect(effect)
    values = {}
    for p in kind.parameters:
        scale = factor if p.vanishing is not None else 1.0
        values[p.name] = min(max(p.typical * scale, p.lower), p.upper)
    where = (
        "typical value of the effect" if factor == 1.0 else f"{factor:g} times the effect's typical strength"
    )
    return kind.entry(values, source=effect_source(effect), where=where)
