"""An effect joins the model: fitted with the nuisance parameters, the error's fall shown on held-out closures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_sim.effect import is_own_effect, load_effect
from hannes_sim.plant import PlantDiverged

from .chance import chance
from .delays import in_time
from .diagnose import fitted_model, found_effects, spans_of
from .diagnosis import Fall, FoundEffect, both_models, error_of
from .executor import Executor
from .falls import error_falls, fall_sentence
from .features import data_used
from .prepare import Prepared
from .screen import silent_effects
from .search import Progress, Search, silent
from .wording import jumps


@dataclass(frozen=True)
class Addition:
    """The model with the effects, and what they are worth on data that took no part in their fit.

    given   the model to which they were added
    nominal  its values, fitted without them
    moved   see Diagnosis
    """

    given: Model
    model: Model
    effects: tuple[FoundEffect, ...]
    falls: tuple[Fall, ...]
    data: tuple[Mapping[str, Any], ...]
    notes: tuple[str, ...]
    values: Mapping[str, float]
    nominal: Mapping[str, float]
    moved: Prepared | None = field(default=None, repr=False, compare=False)

    def to_dict(self) -> dict[str, Any]:
        return {
            "verdict": "added",
            "summary": fall_sentence(self.falls),
            "effects": [e.to_dict() for e in self.effects],
            "falls": [f.to_dict() for f in self.falls],
            "error": error_of(self.falls),
            "data": [dict(d) for d in self.data],
            "notes": list(self.notes),
            **both_models(self.given, self.model),
        }


def add_effects(
    prepared: Prepared,
    sources: Mapping[str, str],
    *,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> Addition:
    """Fit the effects one after another in the given order, all parameters free from the first on.

    sources   effect name -> what load_effect takes
    executor  where the work is done, and where its results are kept; this process if None
    """
    if not sources:
        raise HannesError(
            "No effect to add: those that were named are in the model already, or none was named; give --effect NAME "
            "(see `hannes model effects`) or path.py:Class."
        )
    check_effects(prepared, sources)
    silent = [
        f"{name} moves none of the compared signals at its typical values, so that what is fitted of it says nothing: "
        "does it act where this machine moves, and are its figures in this machine's units?"
        for name in silent_effects(prepared, sources)
    ]
    search = Search(
        prepared.problem,
        prepared.model,
        prepared.nuisances,
        sources,
        executor=executor or Executor(),
        progress=progress,
    )
    given = prepared
    prepared, search = in_time(given, search)
    best = null = search.null()
    for k, name in enumerate(sources):
        progress(k, len(sources), f"fit with {name}")
        base, best = best, search.polish(search.add(best, name))
        if not (base.names or search.slow):
            # Where the model as it is has taken over the effect, the way from there may end early.
            afresh = search.thoroughly().extend([base], [name], f"{name} afresh")
            best = min(best, *afresh, key=lambda c: c.penalised)
    # As a diagnosis does: noise and scatter are estimated where the fit has come.
    first, (search, best) = search, search.fitted_afresh(best)
    best = search.with_spread(best)
    limits = chance(search.problem, best.fit, search.signatures(best))
    falls = error_falls(replace(prepared, problem=search.problem), search, best, first=first)
    intervals = spans_of(search, best, limits, falls)
    return Addition(
        prepared.model,
        fitted_model(prepared, search, best, intervals, falls),
        found_effects(search, best, intervals, falls),
        falls,
        data_used(prepared.features),
        (*silent, *prepared.notes, *jumps(best.fit, limits)),
        best.fit.values,
        null.fit.values,
        None if prepared is given else prepared,
    )


def check_effects(prepared: Prepared, sources: Mapping[str, str]) -> None:
    """Refuse an effect with which the plant diverges at its typical values; HannesError names it."""
    for name, source in sources.items():
        kind = prepared.rig.effect(load_effect(source))
        model = prepared.model.with_effect(kind.entry(source=source if is_own_effect(source) else None))
        for trial in prepared.rig.trials:
            try:
                prepared.rig.simulate(model, {}, trial, trial.reference[: round(5.0 / trial.period)])
            except PlantDiverged as error:
                raise HannesError(
                    f"Effect '{name}' makes the plant diverge at its typical values, in '{trial.name}': {error} "
                    "Check its equation, its sign and its typical values."
                ) from error
