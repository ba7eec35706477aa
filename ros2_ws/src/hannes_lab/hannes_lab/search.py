"""Which effects explain the data: scan, refit in closed loop, and compare with what chance reaches."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from hannes_description.model import Model
from hannes_sim.effect import EffectType, load_effect
from joblib import Parallel, delayed
from numpy.typing import NDArray

from .fit import Fit, finite_differences, fit
from .problem import Coordinate, Problem, effect_coordinates, nuisance_coordinate, vanishing_entry
from .rig import Nuisance

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], None]
Names = tuple[str, ...]

STRENGTHS = (0.15, 0.5, 1.5, 4.0)
"""Strengths of the scan, in typical values; both signs where the bounds allow."""


@dataclass(frozen=True)
class Candidate:
    """A set of effects with its fit; penalised = cost + PENALTY per effect parameter."""

    names: Names
    fit: Fit
    penalised: float


PENALTY = 4.0
"""Cost of one parameter (Akaike's 2 doubled, since shape parameters are searched over several starts)."""


def silent(done: int, total: int, text: str) -> None:
    """No progress shown."""


@dataclass
class Search:
    """Fits of effect sets on one problem; each set is fitted once.

    sources     effect name -> what load_effect takes (catalogue name or path.py:Class)
    base        effects that the given model has already; their parameters stay as they are
    """

    problem: Problem
    model: Model
    nuisances: Sequence[Nuisance]
    sources: Mapping[str, str]
    jobs: int = 1
    progress: Progress = silent
    rows: NDArray[np.bool_] | None = None
    found: dict[Names, Candidate] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.coordinates = tuple(nuisance_coordinate(n) for n in self.nuisances)

    # -- pieces -------------------------------------------------------------------------------------------------
    def effect(self, name: str) -> EffectType:
        return load_effect(self.sources[name])

    def null(self) -> Candidate:
        """The model as it is, with its nuisance parameters fitted."""
        if () not in self.found:
            best = fit(self.problem, self.model, self.coordinates, {}, rows=self.rows, evaluations=25)
            self.found[()] = Candidate((), best, best.cost)
        return self.found[()]

    def with_effects(self, names: Names) -> tuple[Model, tuple[Coordinate, ...]]:
        """The model with the effects switched off but movable, and the coordinates to move."""
        model, coordinates = self.model, list(self.coordinates)
        for name in names:
            kind = self.effect(name)
            source = self.sources[name] if ":" in self.sources[name] else None
            model = model.with_effect(vanishing_entry(kind, source))
            coordinates += effect_coordinates(kind)
        return model, tuple(coordinates)

    def starts(self, name: str, base: Fit, model: Model, coordinates: Sequence[Coordinate], keep: int) -> list[dict[str, float]]:
        """Best starting points of one effect on top of a fit, by a scan with the nuisance parameters compensated.

        Scans the strength at every start of the shape parameters; what the nuisance parameters could take over is
        projected out linearly.
        """
        own = {c.name: c for c in effect_coordinates(self.effect(name))}
        here = {c.name: float(z) for c, z in zip(base.coordinates, base.z, strict=True)}
        shapes, strengths = [], []
        for p in self.effect(name).parameters:
            c = own[f"{name}.{p.name}"]
            if p.vanishing is None:
                shapes.append([(c.name, c.z(v)) for v in (p.starts or (p.typical,))])
            else:
                low, high = c.bounds
                strengths.append([(c.name, z) for s in STRENGTHS for z in (s, -s) if low <= z <= high])
        trials: list[dict[str, float]] = []
        for shape in itertools.product(*shapes):
            for group in strengths:
                trials += [dict((*shape, one)) for one in group]
        scored = []
        for start in trials:
            z = {**here, **start}
            values = {c.name: c.value(z.get(c.name, 0.0)) for c in coordinates}
            scored.append((self.compensated(self.problem.residual(model, values), base), start))
        scored.sort(key=lambda item: item[0])
        return [{**here, **start} for _, start in scored[:keep]]

    def compensated(self, residual: Array, base: Fit) -> float:
        """Cost of a residual after the linear best move of the base fit's coordinates."""
        use = slice(None) if self.rows is None else self.rows
        jacobian = base.jacobian[use]
        prior = np.array([1.0 if c.prior else 0.0 for c in base.coordinates])
        a = jacobian.T @ jacobian + np.diag(np.maximum(prior, 1e-9))
        r = residual[use]
        step = -np.linalg.solve(a, jacobian.T @ r + prior * base.z)
        moved, z = r + jacobian @ step, base.z + step
        return float(moved @ moved + (prior * z) @ (prior * z))

    def add(self, base: Candidate, name: str, *, keep: int = 2, polish: bool = True) -> Candidate:
        """Fit the base set plus one effect, from the best points of the scan."""
        names = (*base.names, name)
        key = tuple(sorted(names))
        if key in self.found:
            return self.found[key]
        model, coordinates = self.with_effects(names)
        known = {c.name: base.fit.jacobian[:, j] for j, c in enumerate(base.fit.coordinates) if c.prior}
        best: Fit | None = None
        for start in self.starts(name, base.fit, model, coordinates, keep):
            trial = fit(self.problem, model, coordinates, start, rows=self.rows, known=known, evaluations=12)
            if best is None or trial.cost < best.cost:
                best = trial
        assert best is not None
        if polish:
            best = self.polish(best)
        free = sum(1 for c in best.coordinates if not c.prior)
        candidate = Candidate(names, best, best.cost + PENALTY * free)
        self.found[key] = candidate
        return candidate

    def polish(self, found: Fit, evaluations: int = 10) -> Fit:
        """Refit from a point with all derivatives taken afresh."""
        again = fit(self.problem, found.model, found.coordinates, found.z, rows=self.rows, evaluations=evaluations)
        return again if again.cost <= found.cost else found

    # -- rounds -------------------------------------------------------------------------------------------------
    def extend(self, bases: Sequence[Candidate], names: Sequence[str], text: str) -> list[Candidate]:
        """Every base with every further effect, in parallel; sorted by penalised cost."""
        todo: list[tuple[Candidate, str]] = []
        seen: set[Names] = set()
        for base in bases:
            for name in names:
                key = tuple(sorted((*base.names, name)))
                if name not in base.names and key not in seen:
                    seen.add(key)
                    if key not in self.found:
                        todo.append((base, name))
        done = 0
        if self.jobs == 1:
            for base, name in todo:
                self.add(base, name)
                done += 1
                self.progress(done, len(todo), f"{text}: {name}")
        elif todo:
            results = Parallel(n_jobs=self.jobs, return_as="generator")(
                delayed(_add_in_worker)(self.problem, self.model, tuple(self.nuisances), dict(self.sources), self.rows,
                                        base, name) for base, name in todo)
            for (base, name), (candidate, simulations, failures) in zip(todo, results, strict=True):
                self.found[tuple(sorted((*base.names, name)))] = candidate
                self.problem.simulations += simulations
                self.problem.failures += failures
                done += 1
                self.progress(done, len(todo), f"{text}: {name}")
        return sorted((self.found[key] for key in seen), key=lambda c: c.penalised)

    def signatures(self, base: Candidate) -> dict[str, list[Array]]:
        """Whitened derivative of each effect at vanishing strength, per shape start; for what chance reaches."""
        out: dict[str, list[Array]] = {}
        here = {c.name: c.value(float(z)) for c, z in zip(base.fit.coordinates, base.fit.z, strict=True)}
        for name in self.sources:
            if name in base.names:
                continue
            kind = self.effect(name)
            model, coordinates = self.with_effects((*base.names, name))
            own = [c for c in coordinates if c.name.startswith(f"{name}.")]
            shapes = [[(f"{name}.{p.name}", v) for v in (p.starts or (p.typical,))]
                      for p in kind.parameters if p.vanishing is None]
            strengths = [c for c, p in zip(own, kind.parameters, strict=True) if p.vanishing is not None]
            out[name] = []
            for shape in itertools.product(*shapes):
                z = np.array([c.z({**here, **dict(shape)}.get(c.name, c.offset)) for c in coordinates])
                values = {c.name: c.value(float(v)) for c, v in zip(coordinates, z, strict=True)}
                r = self.problem.residual(model, values)
                columns = [coordinates.index(c) for c in strengths]
                out[name].append(finite_differences(self.problem, model, coordinates, z, r, columns))
        return out


def _add_in_worker(problem: Problem, model: Model, nuisances: tuple[Nuisance, ...], sources: dict[str, str],
                   rows: NDArray[np.bool_] | None, base: Candidate, name: str) -> tuple[Candidate, int, int]:
    problem.simulations = problem.failures = 0
    search = Search(problem, model, nuisances, sources, rows=rows)
    return search.add(base, name), problem.simulations, problem.failures
