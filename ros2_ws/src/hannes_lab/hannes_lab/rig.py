"""What the lab must know of a machine: what was recorded, its uncertain parameters, and how to simulate a trial.

`Rig` is all that the lab calls.  `PlantRig` does most of it for a machine with one drive and a control law in the
loop; an adapter derives from it and gives a reader, a model, tolerances and the sizes of the machine.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
from hannes_control import double_pid
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.parameters import Parameter, read_yaml
from hannes_description.units import any_unit, linear_unit, same_unit, tokens
from hannes_sim import reduced
from hannes_sim.effect import EffectType, call_own, catalogue, load_class
from hannes_sim.factory import PLANTS, make_plant
from hannes_sim.plant import Plant
from hannes_sim.rollout import Controller, Rollout, rollout, step_of
from numpy.typing import NDArray

from .clock import REFERENCE_DELAY, moved
from .repeats import came_back, end_of, few, few_will_do, repeated
from .trials import EXACTLY, SAME, Trial

if TYPE_CHECKING:
    from .features import Block

Array = NDArray[np.float64]

REFERENCE_SIZES = {"N.m": 0.05, "rad": 14.57, "V": 12.0, "A": 1.0, "s": 1.0}
"""What the catalogue's typical values and bounds are made for: a drive that needs 0.05 N.m to move freely over
14.57 rad at up to 12 V and about 1 A.  Another machine's follow from these by dimension."""


NARROW = 0.25
LEAST = 0.01
"""Relative tolerances up to the first are on a linear scale: an effect that adds to the parameter then leaves a
straight valley, along which a fit finds its way.  All go down to the second part of the nominal value."""

EACH = "each"
"""In a file of tolerances, `NAME@each`: each recording has a value of its own."""

REMEMBERED = 48
"""Simulations whose signals are kept: those of a whole Jacobian of three trials."""


STEP = 0.5
WIDE_STEP = 0.1
"""Steps of finite differences in standard deviations of a prior: half of one is well above the simulation's own
roughness, but half the width of a wide prior leads past every bend of the signals."""


@dataclass(frozen=True)
class Nuisance:
    """A nominal parameter that is not known exactly; the fit may move it within its prior.

    name         parameter that the rig's `simulate` takes; `name@condition` acts on one condition's trial only
    mean         nominal value
    sd           standard deviation of the prior, in the parameter's unit, or of its logarithm if `log`
    log          positive parameter, treated on a logarithmic scale
    closure_sd   scatter from closure to closure, same scale as sd
    wide         True where the prior tells next to nothing: another value is no sign that an effect is missing
    step         of finite differences, in sd; None: STEP, or WIDE_STEP where the prior is wide
    lower, upper  least and largest value
    apart        sd that the one of a recording may be from the mean over all recordings; beyond, no set of effects is
                 adequate
    effect       effect of the catalogue that is the same thing, if there is one: a value that is far off is that effect
    below        standard deviation of values less than the mean, on a linear scale, if it is another; if `log`, as a
                 part of the mean; 0: it is not
    """

    name: str
    mean: float
    sd: float
    log: bool
    closure_sd: float = 0.0
    unit: str = ""
    wide: bool = False
    step: float | None = None
    lower: float = -math.inf
    upper: float = math.inf
    apart: float = math.inf
    effect: str = ""
    below: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.sd) and self.sd > 0.0):
            raise HannesError(f"Nuisance '{self.name}': sd is {self.sd}; it must be positive.")
        if self.log and self.mean <= 0.0:
            raise HannesError(f"Nuisance '{self.name}': mean {self.mean} cannot be on a logarithmic scale.")


def relative_prior(name: str, own: Parameter, sd: float, scatter: float = 0.0) -> Nuisance:
    """The prior of a positive parameter whose standard deviations, from machine to machine and from closure to closure,
    are parts of its value."""
    mean = own.value
    if sd <= NARROW:
        return Nuisance(name, mean, sd * mean, False, scatter * mean, own.unit, lower=LEAST * mean)
    # As a logarithm what is many times too small would be as far off as what is many times too large; but a
    # friction may be nought.
    return Nuisance(name, mean, sd, True, scatter, own.unit, lower=LEAST * mean, below=sd)


COMES_BACK = 1e-4
"""Part of the reference's span within which a closure ends where the one before it did."""


class Rig(Protocol):
    """A machine: plant and controller behind one call.

    trials    what was recorded
    floor     smallest standard deviation of a sample, relative to the span of its signal, that the simulation of a
              logged reference can promise
    points    points of the phase grid of one closure at most
    same      mean difference of the references of two closures, in their span, up to which one is a copy of the other
    without   effects that have no meaning on this machine, with the reason
    drive_signals  signals that tell force or torque of the drive
    phases    other names for the phases void, grasp, hold, opening, rest
    figures   True where the figures of a hand's closure (closing time, grip force ...) have a meaning
    machine   what it is called in sentences
    experiments  True where `hannes record` can run the experiments that separate effects
    pooled    True: in a fit every sample of a signal counts the same, and the fit is of least square error.  For
              machines that repeat far better than any model will fit; the exact moments would rule the fit otherwise
    approximate  True where a plant is seen through another one: how the first closure differs is not seen well then
    foreign      True where the recordings are of another machine than the simulator's, so that no model has its form
    """

    trials: tuple[Trial, ...]
    floor: float
    points: int
    same: float
    drive_signals: tuple[str, ...]
    pooled: bool
    approximate: bool
    foreign: bool
    figures: bool
    phases: Mapping[str, str]
    machine: str
    experiments: bool
    without: Mapping[str, str]

    @property
    def finest(self) -> float:
        """Scatter of closures that is assumed where a coarse sensor shows none, relative to the signal's span."""

    @property
    def coarse(self) -> float:
        """Scatter that is assumed of closures without noise, relative to the signal's span; see Block."""

    def nuisances(self, model: Model) -> Sequence[Nuisance]:
        """The uncertain nominal parameters with their priors."""

    def own_error(self, blocks: Sequence[Block], model: Model) -> Array:
        """Covariance (p, p) of the model's own error over the phases of the blocks of one recording and condition, one
        after another, in the signals' units.

        No model has exactly the machine's form: so far the best parameters may leave it.  0: any difference counts.
        """

    def effect(self, kind: EffectType) -> EffectType:
        """An effect with typical values, bounds and units for this machine; a user's own has them already."""

    def simulate(
        self, model: Model, values: Mapping[str, float], trial: Trial, reference: Array
    ) -> Mapping[str, Array]:
        """Logged signals on the control grid for a reference (n,): what each logger would show at tick k.

        `values` overrides parameters of the model by name (nominal ones, and effect.parameter).  A reference that is
        cut after the second closure says that the later ones repeat it.  Where they would not, since the machine does
        not come back to where it was, the signals of the whole trial are given.  Raises PlantDiverged.
        """


class PlantRig:
    """A machine with one drive, simulated by the plant and the control law of a model file.

    An adapter gives:

    model        the nominal model: a shipped name or a path
    population   path of the tolerances: parameter -> {sd, closure_sd, unit, source}; unit "1" is relative (logarithmic)
    read         recordings into trials
    logged       what the loggers show of a rollout (default: position, current, voltage)
    sizes        force or torque ("N.m") that moves the machine freely, travel ("rad"), and whatever else differs
                 from REFERENCE_SIZES; effects are scaled by them
    linear       True where position is in m and the drive gives N: units are named so
    without      effects that have no meaning here, with the reason
    known        figures of this machine that effects need, as "gravity.turn": 1.0; without them those have no meaning
    floor, points, drive_signals, pooled, approximate, foreign, phases, machine, figures, experiments  see Rig

    one_mass     nothing is beyond a wire; `prepare` says so, which knows the model
    law_used     the control law of the last simulation, with the gains that `run` gave it; None before

    Plants are built once per (model structure, trial) and then only re-parametrised.
    """

    model: ClassVar[str | Path] = "nominal"
    population: ClassVar[str | Path] = ""
    sizes: ClassVar[Mapping[str, float]] = {}
    linear: ClassVar[bool] = False
    without: Mapping[str, str] = {}
    known: ClassVar[Mapping[str, float]] = {}
    floor: float = 2e-4  # replay of a reference logged by messages, and a plant of finite step
    points: int = 160
    same: float = EXACTLY
    drive_signals: tuple[str, ...] = ("motor_current", "motor_effort")
    pooled: bool = False
    approximate: bool = False
    foreign: bool = True
    phases: Mapping[str, str] = {"void": "forward", "opening": "back"}
    machine: str = "machine"
    figures: bool = False
    experiments: bool = False
    source: ClassVar[str] = ""

    def __init__(self, trials: Sequence[Trial]) -> None:
        self.trials = tuple(trials)
        without = type(self).without
        if not isinstance(without, Mapping):
            raise HannesError(
                f"{type(self).__name__}.without is a {type(without).__name__}; it takes a mapping of effects to "
                'reasons, such as {"gravity": "the axis is level"}.'
            )
        self.without = {**self._unknown(), **without}
        self._plants: dict[tuple[str, ...], tuple[Plant, Controller, dict[str, float]]] = {}
        self._signals: OrderedDict[tuple[Any, ...], dict[str, Array]] = OrderedDict()
        self._came_back = True
        self._latest: _Latest | None = None
        self._model: tuple[Model, tuple[str, ...], dict[str, float]] | None = None
        self.law_used: Controller | None = None
        self.one_mass = False

    def __reduce__(self) -> tuple[Any, ...]:
        # A class from a user's file cannot be imported by name in another process.
        return (_rebuild, (self.source or type(self), self.trials, self.one_mass))

    def _unknown(self) -> dict[str, str]:
        """Effects that need a figure of a machine which is not the hand, and which its adapter does not give."""
        if not (self.sizes or self.linear):
            return {}
        return {
            name: f"the adapter's `known` does not say '{name}.{p.name}' ({p.description})"
            for name, kind in catalogue().items()
            for p in kind.known
            if f"{name}.{p.name}" not in self.known
        }

    @property
    def finest(self) -> float:
        """See Rig; an adapter says it by `floor`."""
        return self.floor

    @property
    def coarse(self) -> float:
        """See Rig: an adapter's `floor` counts beside what the closures scatter, however little that is."""
        return 0.0

    def identity(self) -> tuple[Any, ...]:
        """What its simulations depend on beside the model: for the hash under which results are kept."""
        return (self.source or type(self), self.trials)

    @classmethod
    def read(cls, paths: Sequence[Path]) -> list[Trial]:
        """Trials of the given files; raises HannesError that names the file."""
        raise HannesError(f"The rig '{cls.__name__}' has no reader: define `read(cls, paths)`.")

    def nuisances(self, model: Model) -> list[Nuisance]:
        """Priors from the file of tolerances, around the model's values."""
        if not self.population:
            raise HannesError(
                f"{type(self).__name__} names no file of tolerances: give `population`, the path of a YAML file that "
                "says which parameters are uncertain, and by how much."
            )
        table = read_yaml(Path(self.population), "file of tolerances")
        if not isinstance(table, Mapping) or not table:
            raise HannesError(
                f"{self.population}: there are no tolerances in it; give a line for each uncertain parameter, such as "
                '`motor.kt: {sd: 0.03, closure_sd: 0.0, unit: "1", source: magnets}`.'
            )
        usual = [
            self._within(self._nuisance(name, entry, model), model)
            for name, entry in self._for_each(table, model)
        ]
        return self.as_told(usual, model)

    def _for_each(self, table: Mapping[str, Any], model: Model) -> list[tuple[str, Any]]:
        """Tolerances by name; one of `NAME@each` stands for a value of its own of each recording, `NAME@recording`."""
        out: list[tuple[str, Any]] = []
        for name, entry in table.items():
            own, at, where = str(name).partition("@")
            if not at:
                out.append((name, entry))
                continue
            twice = own in table or (own in model.names and model.named(own).tolerance is not None)
            if where != EACH or twice or self.is_gain(own):
                raise HannesError(
                    f"{self.population}: '{name}': a parameter of which each recording has a value of its own is "
                    f"called {own}@{EACH}, has no tolerance for all of them beside it, and is no gain of the law."
                )
            out += [(f"{own}@{trial.name}", entry) for trial in self.trials]
        return out

    def as_told(self, usual: Sequence[Nuisance], model: Model) -> list[Nuisance]:
        """Priors where the model's file says itself how well a value is known.

        A tolerance of its own goes before the usual one, and makes a nuisance of a parameter that is none; what is
        known (0) is none.
        """
        told = {name: p for name in model.names if (p := model.named(name)).tolerance is not None}
        out = []
        for nuisance in usual:
            own = told.pop(nuisance.name, None)
            if own is None:
                out.append(nuisance)
            elif own.tolerance:
                scatter = nuisance.closure_sd if nuisance.log else nuisance.closure_sd / own.value
                told_here = relative_prior(nuisance.name, own, own.tolerance, scatter)
                out.append(self._within(told_here, model, model.parameters.origin(nuisance.name)))
        for name, own in sorted(told.items()):
            if own.tolerance:
                where = model.parameters.origin(name)
                if not (name in self._plant(model, self.trials[0])[0].names or self.is_gain(name)):
                    raise HannesError(
                        f"{where}: '{name}' has a tolerance, but no fit can move it on the plant '{model.plant}': take "
                        "the tolerance out."
                    )
                out.append(self._within(relative_prior(name, own, own.tolerance), model, where))
        return out

    def _within(self, nuisance: Nuisance, model: Model, said_in: str | Path = "") -> Nuisance:
        """The same, kept inside the bounds that the model's file gives its parameter.

        said_in  the file that says the tolerance, if it is not that of the tolerances
        """
        name = nuisance.name.partition("@")[0]
        if name not in model.names:
            return nuisance
        own = model.named(name)
        if own.lower >= own.upper:
            raise HannesError(
                f"{said_in or self.population}: '{nuisance.name}' has a tolerance, but its bounds hold it at "
                f"{own.value:g} {own.unit}: take that out, or give it lower and upper bounds."
            )
        return replace(nuisance, lower=max(nuisance.lower, own.lower), upper=min(nuisance.upper, own.upper))

    def _nuisance(self, name: str, entry: Mapping[str, Any], model: Model) -> Nuisance:
        try:
            sd, scatter = float(entry.get("sd", entry.get("hand_sd"))), float(entry["closure_sd"])
            relative = str(entry["unit"]) == "1"
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise HannesError(
                f"{self.population}: '{name}' needs the numbers sd and closure_sd, and a unit ({error})."
            ) from error
        if not (math.isfinite(sd) and sd > 0.0):
            raise HannesError(f"{self.population}: '{name}': sd is {sd:g}; it must be a number above 0.")
        of_all = name.partition("@")[0]
        if of_all == REFERENCE_DELAY:
            if str(entry["unit"]) != "s":
                raise HannesError(f"{self.population}: '{name}' is a time in s, not in {entry['unit']!r}.")
            return Nuisance(name, 0.0, sd, False, scatter, "s")
        own = model.named(of_all)
        unit, mean = own.unit, own.value
        if relative and mean <= 0.0:
            raise HannesError(
                f"{self.population}: '{name}' has a relative tolerance (unit \"1\"), but is {mean:g} {unit} in "
                f"{model.parameters.origin(of_all)}: give it a value above 0, or a tolerance in {unit!r}."
            )
        if not relative:
            return Nuisance(name, mean, sd, False, scatter, unit)
        return relative_prior(name, own, sd, scatter)

    def is_gain(self, name: str) -> bool:
        """Whether a parameter's name is that of a gain of the control law, which `run` gives it."""
        return name.startswith("control.")

    def own_error(self, blocks: Sequence[Block], model: Model) -> Array:
        """See Rig."""
        return np.zeros((sum(block.phase.size for block in blocks),) * 2)

    def effect(self, kind: EffectType) -> EffectType:
        """See Rig."""
        if catalogue().get(kind.name) is not kind:
            return kind
        sizes, known = tuple(sorted(self.sizes.items())), tuple(sorted(self.known.items()))
        return scaled_effect(kind, sizes, self.linear, known, self.one_mass)  # type: ignore[arg-type]  # a class is hashable

    def comes_back(self, model: Model, trial: Trial) -> float:
        """Part of the reference's span within which a closure ends where the one before it did, if all repeat it.

        Where closures repeat each other only nearly, their ends differ too.
        """
        return COMES_BACK + (trial.apart if trial.apart > SAME else 0.0)

    def controller(self, model: Model, period: float) -> Controller:
        """The control law in the loop."""
        return make_controller(model, period)

    def plant(self, model: Model, trial: Trial) -> Plant:
        """The plant for one trial, encoder quantiser off: a fit needs signals that are smooth in the parameters.

        Its step divides the trial's control period.
        """
        plant = make_plant(model, dt=step_of(trial.period))
        if "encoder.resolution" in plant.names:
            plant.set("encoder.resolution", 0.0)
        return plant

    def logged(self, run: Rollout, trial: Trial) -> dict[str, Array]:
        """Signals by name on the control grid."""
        return {
            "encoder_position": run.encoder_position,
            "motor_current": run.motor_current,
            "motor_voltage": run.motor_voltage,
        }

    def simulate(
        self, model: Model, values: Mapping[str, float], trial: Trial, reference: Array
    ) -> dict[str, Array]:
        """See Rig.

        The last simulations are remembered: a parameter of one trial (`name@trial`) does not move the others.
        """
        wanted = self._wanted(model, values, trial)
        key = (*self._key(model, trial), tuple(sorted(wanted.items())), reference.tobytes())
        if key in self._signals:
            self._signals.move_to_end(key)
        else:
            self._came_back = True
            signals = self.observed(model, values, trial, reference)
            if not (self._came_back or trial.anew) and reference.size < trial.reference.size:
                signals = self._longer(model, values, trial)
            self._signals[key] = signals
            if len(self._signals) > REMEMBERED:
                self._signals.popitem(last=False)
        return self._signals[key]

    def _longer(self, model: Model, values: Mapping[str, float], trial: Trial) -> dict[str, Array]:
        """Signals of the whole trial, where the second closure does not end as the first did."""
        if few_will_do(trial, self.same):
            self._came_back = True
            signals = self.observed(model, values, trial, trial.reference[: end_of(trial, few(trial))])
            if self._came_back:
                return repeated(signals, trial)
        return self.observed(model, values, trial, trial.reference)

    def observed(
        self, model: Model, values: Mapping[str, float], trial: Trial, reference: Array
    ) -> dict[str, Array]:
        """Signals by name, simulated afresh."""
        run = self.run(model, values, trial, reference)
        signals: dict[str, Array] = call_own(
            f"{type(self).__name__}.logged, trial '{trial.name}',", self.logged, run, trial
        )
        return signals

    def run(self, model: Model, values: Mapping[str, float], trial: Trial, reference: Array) -> Rollout:
        """The rollout itself, with all that the plant can show."""
        return self._run(model, values, trial, reference)

    def _run(
        self,
        model: Model,
        values: Mapping[str, float],
        trial: Trial,
        reference: Array,
        before: Array | None = None,
    ) -> Rollout:
        """The rollout from reset, or from where the reference `before` leads.

        Where the latest one was the beginning of the same, it goes on from there.
        """
        plant, controller, base = self._plant(model, trial)
        self.law_used = controller
        wanted = self._wanted(model, values, trial)
        reference = moved(reference, wanted.pop(REFERENCE_DELAY, 0.0), 0.0, trial)
        asked = (wanted, controller.parameters.tobytes(), b"" if before is None else before.tobytes())
        begun, self._latest = self._latest, None
        if begun is None or not begun.begins(plant, controller, asked, reference):
            _give(plant, base, wanted)
            if before is not None:
                rollout(plant, controller, before, joints=False)
            done = rollout(plant, controller, reference, reset=before is None, joints=False)
        else:
            n = begun.run.time.size
            rest = rollout(plant, controller, reference[n:], reset=False, begin=n, joints=False)
            done = begun.run.followed_by(rest)
        if reference.size < trial.reference.size:
            kept = done.copy()  # an adapter may work in the arrays of the one that it gets
            self._latest = _Latest(
                plant, controller, asked, kept, controller.states.copy(), plant.reading.copy()
            )
        self._came_back = came_back(done, trial, self.comes_back(model, trial))
        return done

    def _of(self, model: Model) -> tuple[tuple[str, ...], dict[str, float]]:
        """What tells its plant from another, and the values of its effects; kept while the model is the same."""
        if self._model is None or self._model[0] is not model:
            structure = (effect.source or effect.name for effect in model.effects)
            variant = repr(sorted(model.variant.items()))
            key = (model.plant, model.controller, model.parameters.sha256, variant, *structure)
            values = {f"{e.name}.{n}": p.value for e in model.effects for n, p in e.parameters.items()}
            self._model = (model, key, values)
        return self._model[1:]

    def _key(self, model: Model, trial: Trial) -> tuple[str, ...]:
        """What tells one plant from another, but for the values of its parameters."""
        return (trial.name, *self._of(model)[0])

    def _wanted(self, model: Model, values: Mapping[str, float], trial: Trial) -> dict[str, float]:
        """Parameters of the plant by name, for one trial."""
        wanted = dict(self._of(model)[1])
        for name, parameter in _of_trial(tuple(values), trial.name):
            wanted[parameter] = values[name]
        return wanted

    def _plant(self, model: Model, trial: Trial) -> tuple[Plant, Controller, dict[str, float]]:
        key = self._key(model, trial)
        if key not in self._plants:
            who = type(self).__name__
            plant: Plant = call_own(f"{who}.plant", self.plant, model, trial)
            law: Controller = call_own(f"{who}.controller", self.controller, model, trial.period)
            _check_compiled(plant, f"The plant '{model.plant}'")
            _check_law(law, trial.period, f"The control law '{model.controller}'")
            self._plants[key] = (plant, law, {})
        return self._plants[key]


def _give(plant: Plant, base: dict[str, float], wanted: Mapping[str, float]) -> None:
    """Give a plant the wanted parameters, and those of `base`, its own, that are not among them."""
    for name in set(base) - set(wanted):
        plant.set(name, base[name])
    for name, value in wanted.items():
        if name not in base:
            if name.startswith("control.") and name not in plant.names:
                raise HannesError(
                    f"'{name}' is a gain of the control law, which the plant does not know: in the adapter's "
                    "`run`, take it out of `values`, and give the law a model that has it (model.with_values)."
                )
            base[name] = plant.get(name)
        plant.set(name, value)


@dataclass(frozen=True)
class _Latest:
    """The latest rollout, and what a longer one must share with it to go on from where it ended.

    asked    parameters of the plant, those of the law, and the reference before
    run      in arrays of its own
    states   of the law, and reading of the plant, at its end
    """

    plant: Plant
    law: Controller
    asked: tuple[Mapping[str, float], bytes, bytes]
    run: Rollout
    states: Array
    reading: Array

    def begins(
        self, plant: Plant, law: Controller, asked: tuple[Mapping[str, float], bytes, bytes], reference: Array
    ) -> bool:
        """Whether it is the beginning of what is asked, and nothing moved plant or law since."""
        n = self.run.reference_position.size
        return (
            plant is self.plant
            and law is self.law
            and asked == self.asked
            and n < reference.size
            and np.array_equal(self.run.reference_position, reference[:n])
            and np.array_equal(law.states, self.states)
            and np.array_equal(plant.reading, self.reading)
        )


@lru_cache(maxsize=512)
def _of_trial(names: tuple[str, ...], trial: str) -> tuple[tuple[str, str], ...]:
    """Which of the values' names concern a trial, and the parameters that they mean (`name@trial`)."""
    parts = ((name, *name.partition("@")) for name in names)
    return tuple((name, parameter) for name, parameter, _, where in parts if where in ("", trial))


def make_controller(model: Model, period: float) -> Controller:
    """The control law that a model file names."""
    if model.controller == "double_pid":
        return double_pid.DoublePID.of_model(model.parameters, period)
    if ":" in model.controller:
        file, _, name = model.controller.rpartition(":")
        kind = load_class(file, name, "controller")
        law: Controller = call_own(f"{name}(parameters, period) in '{file}'", kind, model.parameters, period)
        return law
    raise HannesError(
        f"Model '{model.name}': unknown controller '{model.controller}'; valid are double_pid, or "
        "path.py:Class for your own."
    )


def check_parameters(rig: Rig, model: Model) -> None:
    """Raise one HannesError that names all parameters which the model's plant and control law lack, or one in a unit
    that they do not take."""
    own_law = isinstance(rig, PlantRig) and type(rig).controller is not PlantRig.controller
    needs = {
        "the reduced plant": reduced.NEEDED if model.plant == "reduced" else (),
        "the control law double_pid": double_pid.NEEDED
        if model.controller == "double_pid" and not own_law
        else (),
    }
    model.parameters.require(needs)
    if isinstance(rig, PlantRig) and not rig.linear and model.plant in PLANTS:
        _check_units(model, control=bool(needs["the control law double_pid"]))


def _check_units(model: Model, *, control: bool) -> None:
    """Units of a turning machine, as the shipped plants take them; `control` where their control law is used too.

    A linear machine's are only those that go together.
    """
    theirs, parameters = Model.load().parameters, model.parameters
    for name in parameters:
        if name not in theirs or (name.startswith("control.") and not control):
            continue
        given, wanted = parameters[name].unit, theirs[name].unit
        if not (any_unit(wanted, parameters) or same_unit(given, wanted)):
            raise HannesError(
                f"{parameters.origin(name)}: parameter '{name}' is in '{given}'; the plant '{model.plant}' takes "
                f"'{wanted}': convert value, lower and upper."
            )


def _check_compiled(made: Plant | Controller, what: str) -> None:
    address = getattr(made, "address", None)
    if not isinstance(address, int | np.integer) or address <= 0:
        raise HannesError(
            f"{what}: its address is {address!r}; it must be that of a compiled function, the "
            "`.address` of a numba cfunc, which the class keeps."
        )


def _check_law(law: Controller, period: float, what: str) -> None:
    """Refuse what compiled code would take for numbers without being ones, or what is not run at the trial's period."""
    _check_compiled(law, what)
    for name in ("parameters", "states"):
        array = getattr(law, name, None)
        if not isinstance(array, np.ndarray) or array.dtype != np.float64 or not array.flags.c_contiguous:
            raise HannesError(
                f"{what}: its `{name}` must be a numpy array of floats (float64, contiguous), which "
                "the compiled law reads."
            )
    if not callable(getattr(law, "reset", None)):
        raise HannesError(f"{what}: it needs `reset(self)`, which sets its states to the start.")
    given = getattr(law, "period", None)
    if not isinstance(given, int | float | np.number) or abs(given - period) > 1e-9 * period:
        raise HannesError(
            f"{what}: its period is {given!r} s, that of the trial {period:.6g} s; it must be the "
            "one that it is made with."
        )


def load_rig(source: str) -> type[PlantRig]:
    """The rig class of an adapter, given as path.py:Class."""
    file, _, name = source.rpartition(":")
    if not file:
        raise HannesError(f"--rig {source}: give path.py:Class, the adapter of your machine.")
    found = load_class(file, name, "rig")
    if not (isinstance(found, type) and issubclass(found, PlantRig)):
        raise HannesError(f"'{name}' in '{file}' is not a subclass of hannes_lab.rig.PlantRig.")
    found.source = f"{Path(file).expanduser().resolve()}:{name}"
    return found


def _rebuild(rig: str | type[PlantRig], trials: tuple[Trial, ...], one_mass: bool) -> PlantRig:
    made = (load_rig(rig) if isinstance(rig, str) else rig)(trials)
    made.one_mass = one_mass
    return made


# -- effects of the catalogue on a machine of another size ----------------------------------------------------------
def unit_factor(unit: str, sizes: Mapping[str, float]) -> float:
    """How much larger a quantity of this unit is on a machine of the given sizes than on the reference machine."""
    ratio = {token: sizes.get(token, size) / size for token, size in REFERENCE_SIZES.items()}
    ratio["kg.m2"] = ratio["N.m"] * ratio["s"] ** 2 / ratio["rad"]
    ratio["ohm"] = ratio["V"] / ratio["A"]
    return math.prod(ratio.get(token, 1.0) ** power for token, power in tokens(unit))


@lru_cache(maxsize=512)
def scaled_effect(
    kind: EffectType,
    sizes: tuple[tuple[str, float], ...],
    linear: bool,
    known: tuple[tuple[str, float], ...] = (),
    one_mass: bool = False,
) -> EffectType:
    """The effect with bounds, typical values and starts scaled by dimension to a machine of other sizes.

    known     the machine's figures by effect.name
    one_mass  nothing is beyond a wire: a parameter that says which part of the effect is there is known, 0
    """
    beyond = tuple(p for p in kind.parameters if one_mass and p.beyond_wire)
    if not (sizes or linear or known or beyond):
        return kind
    parameters = []
    for p in kind.parameters:
        if p in beyond:
            continue
        f = unit_factor(p.unit, dict(sizes))
        parameters.append(
            replace(
                p,
                unit=linear_unit(p.unit) if linear else p.unit,
                lower=p.lower * f,
                upper=p.upper * f,
                typical=p.typical * f,
                vanishing=None if p.vanishing is None else p.vanishing * f,
                sd=p.sd * f,
                starts=tuple(min(max(v * f, p.lower * f), p.upper * f) for v in p.starts),
            )
        )
    made: EffectType = type(
        kind.__name__,
        (kind,),
        {
            "parameters": tuple(parameters),
            "known": (
                *beyond,
                *(
                    replace(p, typical=dict(known).get(f"{kind.name}.{p.name}", p.typical))
                    for p in kind.known
                ),
            ),
            "__doc__": kind.__doc__,
        },
    )
    return made
