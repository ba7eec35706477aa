"""Which effects of the catalogue have a meaning on this machine with these data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from hannes_description.model import Model
from hannes_sim.effect import EffectType, load_effect

from .prepare import Prepared
from .problem import vanishing_entry

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
    kept: dict[str, str] = {}
    silent: dict[str, str] = {}
    notes: list[str] = []
    for name, source in sources.items():
        if name in prepared.rig.without:
            notes.append(f"{name} is not considered: {prepared.rig.without[name]}")
        elif _moves(prepared, source):
            kept[name] = source
        else:
            silent[name] = source
    beside = {n: s for n, s in silent.items() if any(_moves(prepared, s, other) for other in kept.values())}
    usable = {n: s for n, s in sources.items() if n in kept or n in beside}
    left_out = [n for n in silent if n not in beside]
    if left_out:
        notes.append(
            f"{', '.join(left_out)} would move none of the compared signals on this machine and are not considered"
        )
    return Usable(usable, tuple(notes))


def _moves(prepared: Prepared, source: str, other: str | None = None) -> bool:
    """Whether an effect that is switched on moves a compared signal, on the model or beside another effect."""
    model, values = prepared.model, dict[str, float]()
    if other is not None:
        model = _with(prepared, model, other)
        values = _switched_on(prepared.rig.effect(load_effect(other)))
    base = prepared.problem.residual(model, values)
    switched = _switched_on(prepared.rig.effect(load_effect(source)))
    moved = prepared.problem.residual(_with(prepared, model, source), {**values, **switched}) - base
    return float(np.linalg.norm(moved)) > MOVES


def _with(prepared: Prepared, model: Model, source: str) -> Model:
    """The model with an effect that is switched off."""
    kind = prepared.rig.effect(load_effect(source))
    return model.with_effect(vanishing_entry(kind, source if ":" in source else None))


def _switched_on(kind: EffectType) -> dict[str, float]:
    """All strengths away from their vanishing value."""
    out = {}
    for p in kind.parameters:
        value = p.typical if p.typical != p.vanishing else p.typical + 0.1 * (p.upper - p.typical)
        out[f"{kind.name}.{p.name}"] = value
    return out
