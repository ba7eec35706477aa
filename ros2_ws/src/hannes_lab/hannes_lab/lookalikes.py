"""Which effects look alike: how well one imitates another, once the hand's own parameters are fitted.

An effect's signature is the change of the whitened residual that it makes on data in which nothing is missing, with
what the nuisance parameters can take over projected out (against their priors).  B imitates A by the cosine between
A's signature and its projection onto what B's strengths can do inside their bounds (a friction cannot be negative), at
the best of B's shape starts.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from hannes_description.model import Model
from numpy.typing import NDArray
from scipy.optimize import nnls

from .diagnose import effect_sources
from .hide import make_set
from .prepare import prepare
from .recorded import make_trial
from .search import Search

Array = NDArray[np.float64]

VISIBLE = 30.0
"""Whitened norm to which a signature is scaled: clearly seen, and not yet far from linear."""

SEED, CLOSURES = 7, 13


@dataclass(frozen=True)
class LookAlikes:
    """What one effect is confused with.

    effects      other effect -> cosine, 0..1
    taken_over   part of the squared signature that the nuisance parameters take over, 0..1
    parameter    the nuisance parameter that alone takes over most
    """

    effects: Mapping[str, float]
    taken_over: float
    parameter: str


def look_alikes(names: Sequence[str], model: Model | None = None) -> dict[str, LookAlikes]:
    """For each effect (catalogue name or path.py:Class) what it is confused with, on slow, fast and grasp closures.

    The loggers are the thesis' (30 Hz, rectified); with better ones fewer effects look alike.
    """
    model = model or Model.load("nominal")
    recordings, _ = make_set(model, [], seed=SEED, closures=CLOSURES)
    prepared = prepare([make_trial(r) for r in recordings], model)
    search = Search(prepared.problem, model, prepared.nuisances, effect_sources(only=names))
    null = search.null().fit
    prior = np.diag([1.0] * len(null.coordinates))
    basis = np.linalg.qr(np.vstack([null.jacobian, prior]))[0]

    def left(columns: Array) -> Array:
        padded = np.vstack([columns, np.zeros((prior.shape[0], columns.shape[1]))])
        return padded - basis @ (basis.T @ padded)

    raw = {name: _signatures(search, name) for name in search.sources}
    clean = {name: [left(shape) for shape in shapes] for name, shapes in raw.items()}
    out = {}
    for name, shapes in raw.items():
        if not shapes:
            out[name] = LookAlikes({}, 0.0, "nothing")
            continue
        # The first shape start and strength are the typical ones.
        whole, rest = shapes[0][:, 0], clean[name][0][:, 0]
        alone = np.abs(whole @ null.jacobian) / np.sqrt((null.jacobian**2).sum(axis=0) + 1.0)
        out[name] = LookAlikes(
            {b: max((_imitated(rest, s) for s in clean[b]), default=0.0) for b in clean if b != name},
            1.0 - float(rest @ rest / (whole @ whole)),
            null.coordinates[int(np.argmax(alone))].name,
        )
    return out


def _signatures(search: Search, name: str) -> list[Array]:
    """Per shape start, changes (size, k) that the strengths make, none much above VISIBLE; the typical one first.

    A strength that may go both ways has a column for each.
    """
    null = search.null().fit
    kind = search.effect(name)
    model, coordinates = search.with_effects((name,))
    here = null.values
    shapes = [
        [(f"{name}.{p.name}", v) for v in dict.fromkeys((p.typical, *p.starts))]
        for p in kind.parameters
        if p.vanishing is None
    ]
    strengths = [p for p in kind.parameters if p.vanishing is not None]
    typical_first = sorted(strengths, key=lambda p: p.typical == p.vanishing)
    out = []
    for shape in itertools.product(*shapes):
        off = {c.name: c.value(0.0) for c in coordinates if not c.prior} | here | dict(shape)
        still = search.problem.residual(model, off)
        columns = []
        for p in typical_first:
            vanishing = float(p.vanishing or 0.0)
            away = (p.typical - vanishing) or 0.05 * (p.upper - p.lower)
            factor, change = 0.5, np.zeros(0)
            for _ in range(3):
                moved = {**off, f"{name}.{p.name}": vanishing + factor * away}
                change = search.problem.residual(model, moved) - still
                size = float(np.linalg.norm(change))
                if size <= 1.5 * VISIBLE:
                    break
                factor *= VISIBLE / size
            if np.linalg.norm(change) > 0.0:
                columns += [change, -change] if p.lower < vanishing < p.upper else [change]
        if columns:
            out.append(np.column_stack(columns))
    return out


def _imitated(rest: Array, columns: Array) -> float:
    strengths, _ = nnls(columns, rest)
    return float(np.linalg.norm(columns @ strengths) / np.linalg.norm(rest))
