"""Which effects of the catalogue have a meaning on this machine with these data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from hannes_description.model import Model
from hannes_sim.effect import EffectType, is_own_effect, load_effect

from .directions import never_turns
from .prepare import Prepared
from .problem import vanishing_entry
from .scan import period_of

MOVES = 1e-6
"""Least change of the whitened prediction (root of the sum of squares) that counts as movement."""


@dataclass(frozen=True)
class Usable:
    """Effects to search, by name, and why the others are left out (in sentences)."""

    sources: dict[str, str]
    notes: tuple[str, ...]


def usable_effects(prepared: Prepared, sources: Mapping[str, str]) -> Usable:
    """Leave out what the rig says has no meaning, and what moves no compared signal when switched on.

    An effect that moves nothing would be fitted to noise or stay where it starts, and nobody would notice.  One that
    acts on another (friction that is smaller at rest, where the model has none) counts where it moves a signal beside
    that other.
    """
    without = prepared.rig.without
    notes = [f"{name} is not considered: {without[name]}" for name in sources if name in without]
    offered = {name: source for name, source in sources.items() if name not in without}
    if never_turns(prepared.features.trials):
        turning = [name for name, source in offered.items() if load_effect(source).both_ways]
        notes += [f"{name} is not considered: every condition goes the same way" for name in turning]
        offered = {name: source for name, source in offered.items() if name not in turning}
    notes += [
        f"{effect.name} is in the model already: a second one, of another period, is not looked for (give one as an "
        "effect of your own)"
        for effect in prepared.model.effects
        if period_of(load_effect(effect.source or effect.name))
    ]
    silent = silent_effects(prepared, offered)
    if silent:
        notes.append(
            f"{', '.join(silent)} would move none of the compared signals on this machine and "
            f"{'is' if len(silent) == 1 else 'are'} not considered"
        )
    return Usable({name: source for name, source in offered.items() if name not in silent}, tuple(notes))


def silent_effects(prepared: Prepared, sources: Mapping[str, str]) -> list[str]:
    """Names of the effects that move no compared signal when switched on, neither alone nor beside another of them."""
    alone = _moving(prepared, sources)
    moving = set(alone)
    for other in (name for name in sources if name in alone):
        moving |= _moving(prepared, {n: s for n, s in sources.items() if n not in moving}, sources[other])
    return [name for name in sources if name not in moving]


def _moving(prepared: Prepared, sources: Mapping[str, str], other: str | None = None) -> set[str]:
    """Names of the effects that move a compared signal when switched on, on the model or beside another effect."""
    if not sources:
        return set()
    model, values = prepared.model, dict[str, float]()
    if other is not None:
        model = _with(prepared, model, other)
        values = _switched_on(prepared.rig.effect(load_effect(other)))
    base = prepared.problem.residual(model, values)
    out = set()
    for name, source in sources.items():
        switched = _switched_on(prepared.rig.effect(load_effect(source)))
        moved = prepared.problem.residual(_with(prepared, model, source), {**values, **switched}) - base
        if float(np.linalg.norm(moved)) > MOVES:
            out.add(name)
    return out


def _with(prepared: Prepared, model: Model, source: str) -> Model:
    """The model with an effect that is switched off."""
    kind = prepared.rig.effect(load_effect(source))
    return model.with_effect(vanishing_entry(kind, source if is_own_effect(source) else None))


def _switched_on(kind: EffectType) -> dict[str, float]:
    """All strengths away from their vanishing value."""
    out = {}
    for p in kind.parameters:
        value = p.typical if p.typical != p.vanishing else p.typical + 0.1 * (p.upper - p.typical)
        out[f"{kind.name}.{p.name}"] = value
    return out
