"""Which effects of the catalogue have a meaning on this machine with these data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
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

    An effect that moves nothing would be fitted to noise or stay where it starts, and nobody would notice.
    """
    problem, model = prepared.problem, prepared.model
    base = problem.residual(model, {})
    kept: dict[str, str] = {}
    silent: list[str] = []
    notes: list[str] = []
    for name, source in sources.items():
        if name in prepared.rig.without:
            notes.append(f"{name} is not considered: {prepared.rig.without[name]}")
            continue
        kind = prepared.rig.effect(load_effect(source))
        switched = model.with_effect(vanishing_entry(kind, source if ":" in source else None))
        moved = problem.residual(switched, _switched_on(kind)) - base
        if float(np.linalg.norm(moved)) > MOVES:
            kept[name] = source
        else:
            silent.append(name)
    if silent:
        notes.append(
            f"{', '.join(silent)} would move none of the compared signals on this machine and are not considered"
        )
    return Usable(kept, tuple(notes))


def _switched_on(kind: EffectType) -> dict[str, float]:
    """All strengths away from their vanishing value."""
    out = {}
    for p in kind.parameters:
        value = p.typical if p.typical != p.vanishing else p.typical + 0.1 * (p.upper - p.typical)
        out[f"{kind.name}.{p.name}"] = value
    return out
