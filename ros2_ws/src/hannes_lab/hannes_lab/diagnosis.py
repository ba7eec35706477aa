"""What a diagnosis says: the answer as --json, the report and the page show it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hannes_description.model import Model

from .chance import Chance
from .depends import Dependence
from .errors import SignalError
from .experiments import Experiment
from .prepare import Prepared
from .search import Candidate


@dataclass(frozen=True)
class ParameterEstimate:
    """Value and 95 % interval.

    Identified is False where the value lies on its bound (`at_end`) or the interval spans the range.
    """

    value: float
    low: float
    high: float
    unit: str
    identified: bool
    at_end: bool = False

    def to_dict(self) -> dict[str, Any]:
        return self.__dict__.copy()


@dataclass(frozen=True)
class FoundEffect:
    """An effect of the verdict, with its parameters."""

    name: str
    title: str
    source: str | None
    parameters: Mapping[str, ParameterEstimate]
    why: str

    def to_dict(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "title": self.title,
            "source": self.source,
            "why": self.why,
            "parameters": {n: p.to_dict() for n, p in self.parameters.items()},
        }


@dataclass(frozen=True)
class Fall:
    """One step of the error's fall, in multiples of the repeatability.

    train, held_out   fitted on every second closure, judged on the others
    by_condition      error on each condition when it took no part in the fit
    held_out_conditions  one number for them all (errors.condition_error); with `--greedy` it decides
    held_out_signals  the same per signal, root mean square over the conditions in the signal's unit
    left_out          condition -> where the fit without it ended, z by parameter
    """

    added: str
    train: float
    held_out: float
    by_condition: Mapping[str, float]
    signals: tuple[SignalError, ...]
    held_out_signals: Mapping[str, float] = field(default_factory=dict)
    held_out_conditions: float = math.nan
    left_out: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        return {
            "added": self.added,
            "train": self.train,
            "held_out": self.held_out,
            "by_condition": dict(self.by_condition),
            "signals": [s.to_dict() for s in self.signals],
            "held_out_signals": dict(self.held_out_signals),
            "held_out_conditions": self.held_out_conditions,
        }


ERROR_UNIT = "multiples of the repeatability between closures"


def error_of(falls: Sequence[Fall]) -> dict[str, Any]:
    """The error on held-out closures of the nominal model as given and of the last, in ERROR_UNIT; NaN where nothing
    was repeated, which leaves no closure to hold out and no repeatability to count in."""
    nominal, final = falls[0].held_out, falls[-1].held_out
    known = math.isfinite(final)
    return {
        "nominal": nominal,
        "final": final,
        "repeatability": 1.0 if known else math.nan,
        "held_out": known,
        "unit": ERROR_UNIT,
    }


@dataclass(frozen=True)
class Rank:
    """One row of the ranking: what is left of the misfit with this effect (or set) added to the nominal model.

    The noise is that which the nominal model shows.  Only the best are fitted to the end: of the others more is left
    than need be.

    misfit     squared residuals over noise, and what the tolerances charge
    cost       the same, and PENALTY for each parameter of the effects
    explained  part of the nominal model's excess misfit, by `cost`
    """

    names: tuple[str, ...]
    misfit: float
    cost: float
    explained: float

    @classmethod
    def of(cls, candidate: Candidate, explained: float) -> Rank:
        return cls(candidate.names, candidate.fit.cost, candidate.penalised, explained)

    def to_dict(self) -> dict[str, Any]:
        return {
            "names": list(self.names),
            "misfit": self.misfit,
            "cost": self.cost,
            "explained": self.explained,
        }


def has_excess(costs: Mapping[str, Any], named: bool) -> bool:
    """Whether there is a misfit to share out among effects: none below what chance reaches, unless one was named.

    costs  as Diagnosis has them
    """
    critical, nominal = costs.get("critical_nominal"), costs.get("nominal_fitted")
    return named or critical is None or nominal is None or nominal > critical


def both_models(given: Model, fitted: Model) -> dict[str, Any]:
    """What an answer says of the model that was given and of the fitted one, with its effects, for a report."""
    return {
        "model": {"name": given.name, "sha256": given.sha256},
        "fitted_model": {"sha256": fitted.sha256},
    }


@dataclass(frozen=True)
class Diagnosis:
    """The answer; `to_dict` is what --json, the report and the page show.

    unknown_kind  of the verdict "unknown", one of report_text.UNKNOWN; else empty
    costs   misfits: nominal_fitted and what chance reaches there (critical_nominal, with the noise that the nominal
            model shows), final and critical (with the noise that the answer shows)
    given   the model in which effects were looked for
    model   the same with what was found, fitted; `values` are those of all that was free
    nominal  those of the given model, fitted without effects
    greedy  the error on conditions that were left out decided
    moved   the recordings with signals moved back to one clock, prepared anew; None where all were in time
    """

    verdict: str
    summary: str
    effects: tuple[FoundEffect, ...]
    tied: tuple[tuple[str, ...], ...]
    experiments: tuple[Experiment, ...]
    falls: tuple[Fall, ...]
    ranking: tuple[Rank, ...]
    depends_on: tuple[Dependence, ...]
    chance: Chance
    costs: Mapping[str, float]
    nuisances: Mapping[str, Mapping[str, Any]]
    notes: tuple[str, ...]
    simulations: int
    data: tuple[Mapping[str, Any], ...]
    given: Model
    model: Model
    values: Mapping[str, float]
    nominal: Mapping[str, float]
    unknown_kind: str = ""
    greedy: bool = False
    moved: Prepared | None = field(default=None, repr=False, compare=False)

    def to_dict(self) -> dict[str, Any]:
        falls = self.falls
        return {
            "verdict": self.verdict,
            "unknown_kind": self.unknown_kind,
            "summary": self.summary,
            "effects": [e.to_dict() for e in self.effects],
            "tied": [list(names) for names in self.tied],
            "greedy": self.greedy,
            "experiments": [e.to_dict() for e in self.experiments],
            "error": error_of(falls),
            "falls": [f.to_dict() for f in falls],
            "ranking": [r.to_dict() for r in self.ranking],
            "depends_on": {d.variable: d.to_dict() for d in self.depends_on},
            "chance": self.chance.__dict__.copy(),
            "costs": dict(self.costs),
            "nuisances": {n: dict(v) for n, v in self.nuisances.items()},
            "notes": list(self.notes),
            "simulations": self.simulations,
            "data": [dict(d) for d in self.data],
            **both_models(self.given, self.model),
        }
