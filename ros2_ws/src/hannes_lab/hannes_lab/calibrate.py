"""Calibration: named parameters of a model identified from recordings, or from published figures.

    z* = argmin |r(z)|^2 + |z|^2        r: whitened residual (Problem or TargetProblem); z: standard deviations
                                        from the prior's mean, inside the bounds

from several starts; intervals from the curvature at the best.  What is held is not exact: a held parameter that is one
standard deviation of its tolerance away moves the estimate by a column of

    G = (J^T J + 1)^-1 J^T H        J, H: derivatives of the residual by the free and by the held parameters

so that the covariance of the estimate is that of the fit plus G G^T.  A parameter whose interval is hardly narrower
than its prior is not identified by the data; of two whose effects on the data are nearly proportional only one
combination is.

Every simulation's residual is kept in a folder under the hash of all that determines it, so that a stopped calibration
goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cache as cache_once
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Protocol, cast

import numpy as np
import typer
from hannes_description.errors import HannesError
from hannes_description.model import EffectEntry, Model
from hannes_description.parameters import Parameter, data_path, read_yaml
from hannes_sim.plant import PlantDiverged
from numpy.typing import NDArray

from .cache import content_hash
from .cli import Scale, Topics, _command, _console, _number, _prepared, _print_json, _Progress
from .errors import held_out_closures, overall, signal_errors
from .executor import interruptible
from .features import data_used
from .fit import Fit, finite_differences, fit
from .hand import HandRig
from .prepare import Prepared
from .problem import FAILED, Coordinate, Problem, build_problem, nuisance_coordinate

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], None]

DEFAULT_SD = 0.3
"""Prior standard deviation of a free parameter without one of its own: of its logarithm, or of its bounds' span."""

WIDEN = 3.0
"""A freed parameter may lie this many times farther from nominal than the population's tolerance says."""

UNIDENTIFIED = 0.7
"""Posterior over prior standard deviation above which the data say next to nothing."""

CONFOUNDED = 0.95
"""Correlation of two parameters' posterior, priors aside, above which they cannot be told apart."""

LARGE_MISFIT = 3.0
"""Multiple of the repeatability above which the model, whatever its parameters, does not explain the recordings."""

EXPLAINS = 0.3
"""Share of the misfit that a held parameter must explain to be named."""

ON_BOUND = 0.01
"""Of the distance between the bounds (on the parameter's own scale): nearer than this is on the bound."""

GAINS = tuple(f"control.{name}" for name in ("kp", "damping", "current_kp", "current_ki"))
"""Gains of the double PID that may be free: a rollout can change them."""

BAG_SOURCES = ("features.py", "rig.py", "trials.py", "problem.py", "hand.py")
FIGURE_SOURCES = ("currents.py", "least_force.py", "fitting.py")
"""Files of the lab that stand between a simulation and its residual: of recordings, of the thesis' figures."""

SPREAD = 0.5
"""Scatter of the further starts, in prior standard deviations."""

RESTARTS = 2
"""How often a search goes on from its own end at most."""

STEP = 0.02
"""Finite-difference step: of the logarithm, or of the prior's standard deviation."""


class Residuals(Protocol):
    """What is fitted: `features.size` whitened residuals of a model with some values (Problem is one)."""

    @property
    def features(self) -> Any: ...

    def residual(self, model: Model, values: Mapping[str, float]) -> Array: ...


@dataclass(frozen=True)
class Target:
    """A published figure to be reached: value and standard deviation in its unit, and the row it stands in."""

    name: str
    row: str
    value: float
    sd: float
    unit: str = ""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.value) and math.isfinite(self.sd) and self.sd > 0.0):
            raise HannesError(
                f"Target '{self.name}': value {self.value} and sd {self.sd} must be finite, sd positive."
            )


@dataclass(frozen=True)
class _Size:
    size: int


@dataclass
class TargetProblem:
    """Published figures as a least-squares problem: residual = (target - predicted) / sd.

    predict  (model, values) -> figures by target name
    digest   what else determines the prediction (the object, the step), for the cache's key
    """

    targets: tuple[Target, ...]
    predict: Callable[[Model, Mapping[str, float]], Mapping[str, float]]
    digest: str = ""
    simulations: int = 0

    @property
    def features(self) -> _Size:
        return _Size(len(self.targets))

    @property
    def key(self) -> str:
        return json.dumps([[t.name, t.value, t.sd] for t in self.targets]) + self.digest

    def residual(self, model: Model, values: Mapping[str, float]) -> Array:
        """Residual (n,) in standard deviations; FAILED where the simulation diverges, 30 where a figure is missing."""
        self.simulations += 1
        try:
            found = self.predict(model, values)
        except PlantDiverged:
            return np.full(len(self.targets), FAILED)
        out = np.array([(t.value - found.get(t.name, math.nan)) / t.sd for t in self.targets])
        return np.where(np.isfinite(out), out, 30.0)


class Remembered:
    """A problem whose residuals are kept in a folder, content-addressed; `folder` None keeps nothing."""

    def __init__(self, problem: Any, key: str, folder: Path | None, progress: Progress | None = None) -> None:
        self.problem, self.key, self.folder = problem, key, folder
        self.hits = 0
        self.done = 0
        self._progress = progress
        self.total, self.text = 1, "simulation"
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise HannesError(
                    f"Cannot use the cache folder '{folder}': {error}; give another --cache."
                ) from error

    @property
    def features(self) -> Any:
        return self.problem.features

    def residual(self, model: Model, values: Mapping[str, float]) -> Array:
        """The residual, from the folder where it is there."""
        self.done += 1
        if self._progress is not None:
            self._progress(self.done, max(self.total, self.done), self.text)
        if self.folder is None:
            return np.asarray(self.problem.residual(model, values), dtype=np.float64)
        text = self.key + model.sha256 + json.dumps(sorted((k, float(v)) for k, v in values.items()))
        path = self.folder / f"{hashlib.sha256(text.encode()).hexdigest()}.f8"
        if path.exists():
            try:
                kept = np.fromfile(path, dtype="<f8")
                if kept.shape == (self.problem.features.size,):
                    self.hits += 1
                    return np.asarray(kept, dtype=np.float64)
            except (OSError, ValueError):
                path.unlink(missing_ok=True)  # cut off while it was written; it is made again
        out = np.asarray(self.problem.residual(model, values), dtype=np.float64)
        part = path.with_suffix(f".{os.getpid()}.part")
        with part.open("wb") as file:
            out.astype("<f8").tofile(file)
        part.replace(path)
        return out


@cache_once
def code_digest(lab: tuple[str, ...]) -> str:
    """Hash of the sources that a simulation depends on: a changed simulator finds no old results.

    lab  files of hannes_lab that count; of the simulator's packages all do
    """
    found = hashlib.sha256()
    for package in ("hannes_description", "hannes_control", "hannes_sim", "hannes_lab"):
        spec = find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
            for path in sorted(Path(folder).rglob("*.py")):
                if package != "hannes_lab" or path.name in lab:
                    found.update(path.name.encode() + path.read_bytes())
    return found.hexdigest()


def default_cache() -> Path:
    """Where residuals are kept when nothing else is said."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hannes" / "calibrate"


@dataclass(frozen=True)
class Identified:
    """One calibrated parameter.

    low, high   95 % interval, with the tolerances of what is held
    narrowing   standard deviation of the estimate over that of the prior
    identified  the data narrowed it and nothing else can take its place
    confounded  the parameter that it cannot be told apart from, with their correlation
    at_bound    the best value lies on a bound
    held        the held parameter whose tolerance widens the interval most, with its share of the variance
    """

    name: str
    unit: str
    value: float
    low: float
    high: float
    narrowing: float
    identified: bool
    confounded: str | None = None
    correlation: float = 0.0
    at_bound: bool = False
    held: str | None = None
    held_share: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        return self.__dict__.copy()


@dataclass(frozen=True)
class Calibration:
    """What a calibration found.

    costs    least-squares cost of every start's end, best first; agree: how many ended as well as the best
    errors   training and held-out error in multiples of the repeatability (recordings), before and after
    """

    model: Model
    parameters: tuple[Identified, ...]
    costs: tuple[float, ...]
    agree: int
    errors: Mapping[str, float]
    warnings: tuple[str, ...]
    simulations: int
    from_cache: int
    best: Fit = field(repr=False)

    def to_dict(self) -> dict[str, Any]:
        return {
            "model": {"name": self.model.name, "sha256": self.model.sha256},
            "parameters": [p.to_dict() for p in self.parameters],
            "costs": list(self.costs),
            "agree": self.agree,
            "errors": dict(self.errors),
            "warnings": list(self.warnings),
            "simulations": self.simulations,
            "from_cache": self.from_cache,
        }


def free_coordinates(
    model: Model, names: Sequence[str], sds: Mapping[str, float] | None = None
) -> list[Coordinate]:
    """Coordinates of named parameters of a model or of its effects, with bounds and priors.

    sds  prior standard deviation by name: of the logarithm for positive parameters, else in the parameter's unit
    Raises HannesError for unknown or repeated names.
    """
    if not names:
        raise HannesError("Nothing is free: give --free NAME,NAME (see `hannes model show` for the names).")
    twice = sorted({n for n in names if list(names).count(n) > 1})
    if twice:
        raise HannesError(f"--free names {', '.join(twice)} twice.")
    table = read_yaml(data_path("parameters", "population.yaml"), "population file")
    own = {f"{e.name}.{n}": p for e in model.effects for n, p in e.parameters.items()}
    out = []
    for name in names:
        p = own[name] if name in own else model.parameters[name]
        log = p.lower >= 0.0 and p.value > 0.0
        sd = (sds or {}).get(name)
        if sd is None:
            known = table.get(name)
            sd = (
                WIDEN * float(known["hand_sd"])
                if known and log
                else DEFAULT_SD * (1.0 if log else p.upper - p.lower)
            )
        if not (math.isfinite(sd) and sd > 0.0):
            raise HannesError(f"The prior of '{name}' has the standard deviation {sd}; it must be positive.")
        out.append(
            Coordinate(
                name,
                p.value,
                sd,
                log,
                max(p.lower, 1e-3 * p.value) if log else p.lower,
                p.upper,
                True,
                STEP / sd if log else STEP,
                p.unit,
            )
        )
    return out


def search(
    problem: Residuals,
    model: Model,
    coordinates: Sequence[Coordinate],
    *,
    starts: int = 3,
    seed: int = 0,
    evaluations: int = 15,
    first: Mapping[str, float] | None = None,
    announce: Callable[[int, int], None] | None = None,
) -> list[Fit]:
    """Fits from the nominal point (or `first`, z by name) and from points drawn from the priors, best first.

    Dry friction makes the figures a little rough, on which a search may stop short; so each goes on from its end with a
    new trust region until that gains nothing.
    """
    if starts < 1:
        raise HannesError(f"A calibration needs at least one start, not {starts}.")
    rng = np.random.default_rng(seed)
    begin = np.array([(first or {}).get(c.name, 0.0) for c in coordinates])
    found = []
    for k in range(starts):
        if announce is not None:
            announce(k, starts)
        z = begin if k == 0 else begin + SPREAD * np.clip(rng.standard_normal(len(coordinates)), -1.5, 1.5)
        best = fit(cast(Problem, problem), model, coordinates, z, evaluations=evaluations)
        for _ in range(RESTARTS):
            again = fit(cast(Problem, problem), model, coordinates, best.z, evaluations=evaluations)
            gain = best.cost - again.cost
            best = min(best, again, key=lambda f: f.cost)
            if gain < _close(best.cost):
                break
        found.append(best)
    return sorted(found, key=lambda f: f.cost)


def held_coordinates(model: Model, free: Sequence[str]) -> list[Coordinate]:
    """The parameters of the model that the population's tolerances speak of and that are not free."""
    out = []
    for name, entry in read_yaml(data_path("parameters", "population.yaml"), "population file").items():
        if name in free or name not in model.parameters or model.parameters.value(name) <= 0.0:
            continue
        out.append(
            Coordinate(
                name,
                model.parameters.value(name),
                float(entry["hand_sd"]),
                entry["unit"] == "1",
                -math.inf,
                math.inf,
                True,
                0.5,
                model.parameters[name].unit,
            )
        )
    return out


def sensitivities(problem: Residuals, best: Fit, held: Sequence[Coordinate]) -> Array:
    """Derivatives (n, len(held)) of the residual at the best point by held parameters, in their standard deviations."""
    k = len(best.coordinates)
    return finite_differences(
        cast(Problem, problem),
        best.model,
        [*best.coordinates, *held],
        np.concatenate([best.z, np.zeros(len(held))]),
        best.residual,
        range(k, k + len(held)),
    )


def identify(
    best: Fit, free: Sequence[str], held: Sequence[Coordinate] = (), by_held: Array | None = None
) -> tuple[Identified, ...]:
    """Intervals of the free parameters and what the data cannot tell, from the curvature at the best point.

    held, by_held  parameters that were held, and the residual's derivatives (n, len(held)) by them (`sensitivities`)

    The covariance of the residual is taken as 1 or, where there are more data than parameters and the misfit is
    larger than that and than what the held parameters' tolerances explain, inflated to it.
    """
    n, k = best.residual.size, len(best.coordinates)
    moved = np.zeros((n, 0)) if by_held is None else by_held
    along = moved.T @ best.residual
    # r^T (1 + H H^T)^-1 r by Woodbury's formula
    explained = (
        along @ np.linalg.solve(np.eye(moved.shape[1]) + moved.T @ moved, along) if along.size else 0.0
    )
    inflate = max(1.0, (best.misfit - float(explained)) / (n - k)) if n > k else 1.0
    fitted = best.covariance(inflate)
    shift = best.covariance() @ best.jacobian.T @ moved
    posterior = fitted + shift @ shift.T
    information = best.jacobian.T @ best.jacobian
    # Without priors; a hair of regularisation keeps what is not seen at all finite.
    alone = np.linalg.pinv(information + 1e-9 * np.eye(k) * max(1.0, float(np.trace(information))))
    spread = np.sqrt(np.maximum(np.diag(alone), 1e-300))
    correlation = alone / np.outer(spread, spread)
    out = []
    for j, c in enumerate(best.coordinates):
        if c.name not in free:
            continue
        sd = math.sqrt(max(float(posterior[j, j]), 0.0))
        z = float(best.z[j])
        low, high = sorted((c.value(z - 1.96 * sd), c.value(z + 1.96 * sd)))
        others = np.abs(np.where(np.arange(k) == j, 0.0, correlation[j]))
        other = int(np.argmax(others)) if k > 1 else -1
        partner = best.coordinates[other].name if other >= 0 and others[other] > CONFOUNDED else None
        lower, upper = c.bounds
        near = ON_BOUND * min(upper - lower, 1.0)
        bound = bool(min(abs(z - lower), abs(upper - z)) < near)
        seen = sd <= UNIDENTIFIED
        widest = int(np.argmax(np.abs(shift[j]))) if shift.shape[1] else -1
        out.append(
            Identified(
                c.name,
                c.unit,
                c.value(z),
                low,
                high,
                sd,
                seen and partner is None and not bound,
                partner,
                float(correlation[j, other]) if other >= 0 else 0.0,
                bound,
                held[widest].name if widest >= 0 else None,
                float(shift[j, widest] ** 2 / max(posterior[j, j], 1e-300)) if widest >= 0 else 0.0,
            )
        )
    return tuple(out)


def warnings_of(parameters: Sequence[Identified], free_count: int, data_count: int) -> list[str]:
    """What the user must know of parameters that the data do not identify."""
    out = []
    pairs: set[frozenset[str]] = set()
    for p in parameters:
        if p.narrowing > UNIDENTIFIED:
            by_held = p.held_share > 0.5
            out.append(
                f"{p.name} is not identified by these data: its interval is {100 * p.narrowing:.0f} % of the "
                "prior's"
                + (
                    f", most of it from the tolerance of {p.held}, which is held: measure {p.held}, or free it."
                    if by_held
                    else ", which decides much of its value"
                    + (f" (confounded with {p.confounded})." if p.confounded else ".")
                )
            )
        elif p.confounded and frozenset((p.name, p.confounded)) not in pairs:
            pairs.add(frozenset((p.name, p.confounded)))
            out.append(
                f"{p.name} and {p.confounded} cannot be told apart by these data (correlation "
                f"{p.correlation:+.3f}); only a combination of both is identified. Fix one of them."
            )
        if p.at_bound:
            out.append(f"{p.name} ends on its bound ({p.value:.4g} {p.unit}); the model may lack something.")
    if free_count >= data_count:
        out.append(
            f"{free_count} free parameters for {data_count} figures: the priors fill in; reaching the figures "
            "is a calibration and proves nothing about the model."
        )
    return out


def calibrated_model(model: Model, parameters: Sequence[Identified], source: str) -> Model:
    """The model with the identified values, their intervals as bounds' comment in the source, status identified."""
    values = {p.name: p for p in parameters}

    def entry(p: Parameter, found: Identified) -> Parameter:
        interval = f"95 % {found.low:.4g} .. {found.high:.4g}"
        doubt = "" if found.identified else "; not identified alone"
        return p.at(found.value, status="identified", source=f"{source}; {interval}{doubt}")

    changed = {n: entry(p, values[n]) for n, p in model.parameters.items() if n in values}
    out = replace(
        model, parameters=replace(model.parameters, entries={**model.parameters.entries, **changed}, _hash=[])
    )
    for e in model.effects:
        own = {
            n: entry(p, values[f"{e.name}.{n}"]) if f"{e.name}.{n}" in values else p
            for n, p in e.parameters.items()
        }
        out = out.with_effect(EffectEntry(e.name, own, e.source))
    return out


def calibrate_targets(
    problem: TargetProblem,
    model: Model,
    coordinates: Sequence[Coordinate],
    *,
    starts: int = 3,
    seed: int = 0,
    evaluations: int = 15,
    cache: Path | None = None,
    first: Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate on published figures."""
    remembered = Remembered(problem, code_digest(FIGURE_SOURCES) + problem.key, cache, progress)
    remembered.total = starts * evaluations * (len(coordinates) + 1)

    def announce(k: int, n: int) -> None:
        remembered.text = f"start {k + 1} of {n}"

    found = search(
        remembered,
        model,
        coordinates,
        starts=starts,
        seed=seed,
        evaluations=evaluations,
        first=first,
        announce=announce,
    )
    free = [c.name for c in coordinates]
    remembered.text = "tolerances of what is held"
    held = held_coordinates(model, free)
    parameters = identify(found[0], free, held, sensitivities(remembered, found[0], held))
    notes = warnings_of(parameters, len(free), len(problem.targets))
    rows = ", ".join(dict.fromkeys(t.row for t in problem.targets))
    costs = tuple(f.cost for f in found)
    return Calibration(
        calibrated_model(model, parameters, f"fitted to {rows}"),
        parameters,
        costs,
        _agree(costs),
        {},
        tuple(notes),
        remembered.done - remembered.hits,
        remembered.hits,
        found[0],
    )


def _close(cost: float) -> float:
    """Difference of two costs that says nothing: 1 % of the cost, or half of one standard deviation of the data."""
    return max(0.01 * cost, 0.5)


def _agree(costs: Sequence[float]) -> int:
    return sum(c <= costs[0] + _close(costs[0]) for c in costs)


def calibrate(
    prepared: Prepared,
    free: Sequence[str],
    *,
    sds: Mapping[str, float] | None = None,
    starts: int = 3,
    seed: int = 0,
    evaluations: int = 15,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate named parameters on recordings.

    Beside them, what belongs to the recording alone (place and stiffness of its object, zeros of its encoder; clock,
    logger and gains where it does not describe them) is fitted with its own prior.  The noise is estimated anew where
    the searches end, and the best of them goes on from there.  Held-out error: every second closure takes no part in a
    further fit.
    Raises HannesError for a name that the plant cannot change.
    """
    model = prepared.model
    _check_names(prepared, free)
    coordinates = free_coordinates(model, free, sds)
    bench = [n for n in prepared.nuisances if _of_the_recording(n.name) and n.name not in free]
    coordinates += [nuisance_coordinate(n) for n in bench]
    own = {c.name for c in coordinates}
    held = [nuisance_coordinate(n) for n in prepared.nuisances if n.name not in own]
    used = data_used(prepared.features)
    # A slow plant may have been prepared through a fast one, which lacks the parameters of the mechanics.
    exact = prepared.problem.with_rig(prepared.rig)
    remembered = Remembered(exact, _key(exact), cache, progress)
    remembered.total = (starts + 1) * evaluations * (len(coordinates) + 1)

    def announce(k: int, n: int) -> None:
        remembered.text = f"start {k + 1} of {n}"

    found = search(
        remembered, model, coordinates, starts=starts, seed=seed, evaluations=evaluations, announce=announce
    )
    costs = tuple(f.cost for f in found)
    problem = build_problem(prepared.rig, prepared.features, model, prepared.nuisances, found[0].values)
    again = Remembered(problem, _key(problem), cache, progress)
    again.done, again.total, again.text = remembered.done, remembered.total, "noise estimated anew"
    best = fit(cast(Problem, again), model, coordinates, found[0].z, evaluations=evaluations)
    again.text = "tolerances of what is held"
    by_held = sensitivities(again, best, held)
    parameters = identify(best, free, held, by_held)
    features = prepared.features
    before = overall(signal_errors(features, features.closures(prepared.rig, model, {})))
    after = overall(signal_errors(features, features.closures(prepared.rig, model, best.values)))
    errors = {"before": before, "after": after}
    if any(b.n > 1 for b in features.blocks):
        if progress is not None:
            progress(again.done, max(again.total, again.done), "held-out closures")

        def problem_of(train: Any) -> Any:
            return build_problem(prepared.rig, train, model, prepared.nuisances, best.values)

        errors["train"], errors["held_out"] = held_out_closures(
            problem_of, features, model, coordinates, best.z
        )
    if progress is not None:
        progress(again.total, again.total, "done")
    bags = ", ".join(str(d["name"]) for d in used)
    made = calibrated_model(model, parameters, f"calibrated on {bags}")
    made = replace(
        made,
        provenance={
            **dict(model.provenance),
            "bags": [{"source": d["source"], "sha256": d["sha256"], "closures": d["closures"]} for d in used],
            "nominal_sha256": model.sha256,
            "free": list(free),
            "intervals_95": {p.name: [float(f"{p.low:.5g}"), float(f"{p.high:.5g}")] for p in parameters},
            "error_unit": "multiples of the repeatability between closures",
            "errors": {k: round(v, 4) for k, v in errors.items() if math.isfinite(v)},
            "recordings": {n: float(f"{v:.6g}") for n, v in best.values.items() if n not in free},
        },
    )
    notes = warnings_of(parameters, len(free), features.size)
    notes += _notes_of_errors(errors, best, explaining(best, held, by_held))
    notes += [
        f"{n} is marked as fixed in the parameter file ({model.parameters[n].source}); it is free because you named it."
        for n in free
        if n in model.parameters and model.parameters[n].fixed
    ]
    if held:
        notes.append(
            f"The intervals hold the tolerances (population.yaml) of {', '.join(c.name for c in held)}; "
            "everything else that is not free is taken as exact."
        )
    if starts > 1 and _agree(costs) == 1:
        notes.append("Only one start reached the best point; try more --starts.")
    return Calibration(
        made,
        parameters,
        costs,
        _agree(costs),
        errors,
        (*notes, *prepared.notes),
        again.done - remembered.hits - again.hits,
        remembered.hits + again.hits,
        best,
    )


def _of_the_recording(name: str) -> bool:
    """A nuisance parameter that says nothing of the hand."""
    return "@" in name or name.startswith(("log.", "control.", "encoder."))


def _key(problem: Problem) -> str:
    """What the residuals depend on beside the model and the parameters' values."""
    whitening = hashlib.sha256(
        b"".join(np.ascontiguousarray(lower).tobytes() for _, lower in problem.whitener)
    )
    return code_digest(BAG_SOURCES) + content_hash(problem.features.trials) + whitening.hexdigest()


def explaining(best: Fit, held: Sequence[Coordinate], by_held: Array) -> list[str]:
    """Held parameters of which one alone, within its tolerance, would take away EXPLAINS of the misfit; best first."""
    # What the free parameters cannot do as well: the part of H that their derivatives do not span.
    rest = by_held - best.jacobian @ (best.covariance() @ (best.jacobian.T @ by_held))
    gain = (rest.T @ best.residual) ** 2 / (1.0 + (rest**2).sum(axis=0)) / max(best.misfit, 1e-300)
    return [held[k].name for k in np.argsort(-gain) if gain[k] > EXPLAINS]


def _notes_of_errors(errors: Mapping[str, float], best: Fit, held: Sequence[str]) -> list[str]:
    """Whether the calibrated model explains the recordings, and whether it says the same of other closures.

    held  held parameters that would explain much of the misfit
    """
    if best.residual.size and np.abs(best.residual).min() >= FAILED:
        return ["The simulation diverged at the best point; nothing was identified."]
    after, train, held_out = (errors.get(k, math.nan) for k in ("after", "train", "held_out"))
    out = []
    if not math.isfinite(after):
        out.append(
            "One closure of each condition: there is no repeatability and no held-out closure to judge the model by."
        )
    elif after > LARGE_MISFIT:
        rest = (
            f"{' or '.join(held[:2])}, which is held, would explain much of it: free it too."
            if held
            else "Run `hannes diagnose`, or free what else is uncertain."
        )
        out.append(
            f"The calibrated model misses the recordings by {after:.1f} times their repeatability: it lacks "
            f"something, the values make up for it, and the intervals may be too narrow. {rest}"
        )
    if held_out > 1.5 * train + 0.5:
        out.append(
            f"Held-out closures are missed by {held_out:.2f}, the others by {train:.2f} times the repeatability: "
            "too many parameters for these closures."
        )
    return out


def _check_names(prepared: Prepared, free: Sequence[str]) -> None:
    if not isinstance(prepared.rig, HandRig):
        return
    settable: set[str] = set()
    for trial in prepared.rig.trials:
        plant, _, _ = prepared.rig._plant(prepared.model, trial)
        settable |= set(plant.names)
    if prepared.model.controller == "double_pid":
        settable |= set(GAINS)
    known = settable & {
        *prepared.model.parameters,
        *(f"{e.name}.{n}" for e in prepared.model.effects for n in e.parameters),
    }
    unknown = [n for n in free if n not in known]
    if unknown:
        close = [m for n in unknown for m in get_close_matches(n, sorted(known), 2)]
        hint = f" Did you mean {' or '.join(dict.fromkeys(close))}?" if close else ""
        valid = sorted(n for n in known if not n.startswith(("geometry.", "inertia.")))
        raise HannesError(
            f"--free {', '.join(unknown)}: not a parameter that the plant '{prepared.model.plant}' can "
            f"change.{hint} Valid are {', '.join(valid)}."
        )


@interruptible
def command(
    bags: Annotated[list[Path], typer.Argument(help="Bags, or folders of bags, of your hand.")],
    free: Annotated[str, typer.Option("--free", help="Names of the free parameters, with commas between.")],
    out: Annotated[Path, typer.Option("--out", help="Model file to write.")] = Path("my_hand.yaml"),
    model: Annotated[
        str, typer.Option("--model", help="Model file, or the name of a shipped model.")
    ] = "nominal",
    prior: Annotated[
        list[str] | None,
        typer.Option(
            "--prior", help="NAME=SD: prior standard deviation, of the logarithm for positive parameters."
        ),
    ] = None,
    scale: Scale = None,
    topics: Topics = None,
    starts: Annotated[int, typer.Option(min=1, help="Searches from different points.")] = 3,
    seed: Annotated[int, typer.Option(help="Seed of the starts.")] = 0,
    cache: Annotated[
        Path | None,
        typer.Option("--cache", help="Folder of finished simulations; a stopped run goes on from it."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """Identify named parameters of your hand from recorded closures, with intervals and warnings."""
    names = [n.strip() for n in free.split(",") if n.strip()]
    if out.suffix not in (".yaml", ".yml"):
        raise HannesError(f"--out {out}: a model file ends in .yaml.")
    if not out.resolve().parent.is_dir():
        raise HannesError(f"--out {out}: the folder '{out.resolve().parent}' does not exist.")
    sds = {}
    for text in prior or ():
        name, _, value = text.partition("=")
        try:
            sds[name] = float(value)
        except ValueError:
            raise HannesError(f"--prior {text}: give NAME=SD with a number.") from None
        if name not in names:
            raise HannesError(f"--prior {text}: '{name}' is not among --free.")
    with _Progress(quiet=json) as progress:
        progress(0, 1, "reading the bags")
        prepared = _prepared(bags, model, None, None, scale=scale, topics=topics)
        found = calibrate(
            prepared,
            names,
            sds=sds,
            starts=starts,
            seed=seed,
            cache=cache or default_cache(),
            progress=progress,
        )
    path = replace(
        found.model, name=out.stem, provenance={**dict(found.model.provenance), "command": _command()}
    ).save(out)
    if json:
        _print_json(found.to_dict() | {"model_file": str(path)})
        return
    console = _console()
    for p in found.parameters:
        note = "" if p.identified else "   not identified"
        console.print(
            f"{p.name} = {_number(p.value)} {p.unit}   95 %: {_number(p.low)} .. {_number(p.high)}{note}"
        )
    console.print(
        f"{found.agree} of {len(found.costs)} starts agree; {found.simulations} simulations, "
        f"{found.from_cache} from the cache."
    )
    console.print(
        "Error in multiples of the repeatability: "
        + ", ".join(f"{k.replace('_', ' ')} {_number(v, 3)}" for k, v in found.errors.items())
    )
    for text in found.warnings:
        console.print(f"warning: {text}", style="dim", markup=False)
    console.print(f"Model file: {path}")
