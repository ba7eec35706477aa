"""Where the model fails.

Aligned closures, errors per signal and phase, the thesis' figures, and the residual's pattern.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from hannes_description.model import Model
from hannes_sim.rollout import VoltagePlayback
from numpy.typing import NDArray

from .delays import in_time
from .depends import Dependence, residual_dependences
from .errors import SignalError, overall, per_signal, signal_errors
from .executor import Executor
from .features import Block, Features, data_used
from .fit import nuisance_table
from .phases import METRICS, PHASES, metrics, phase_of
from .prepare import FEW, Prepared
from .search import Progress, Search, silent
from .wording import held_notes, moved_notes, other_clock, unmoved, untold

Array = NDArray[np.float64]

CONTACT, CONTACT_OVER_NOISE = 0.02, 5.0
"""There is contact where the grip force exceeds what it is at rest by this part of its greatest value, and by this
multiple of what it varies there."""

FALSE_DISCOVERY_RATE = 0.05
DRAWS = 2000


@dataclass(frozen=True)
class Cell:
    """One signal in one phase of one condition.

    rmse, repeatability  in unit; ratio of both
    p_value              chance of such a mean residual if only the scatter between closures were at work
    fails                beyond chance at a false-discovery rate of 5 % over all cells
    """

    condition: str
    signal: str
    phase: str
    unit: str
    rmse: float
    bias: float
    repeatability: float
    ratio: float
    p_value: float
    fails: bool

    def to_dict(self) -> dict[str, Any]:
        return self.__dict__.copy()


@dataclass(frozen=True)
class Overlay:
    """Mean closure of a signal with its band, the model beside it, and the phase of every instant.

    reference  of the position, in its unit; None where it is a command that is played, without a controller
    """

    condition: str
    signal: str
    unit: str
    time: Array
    measured: Array
    low: Array
    high: Array
    model: Array
    reference: Array | None
    phase: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        out: dict[str, Any] = {
            "condition": self.condition,
            "signal": self.signal,
            "unit": self.unit,
            "phase": list(self.phase),
        }
        for name in ("time", "measured", "low", "high", "model", "reference"):
            values = getattr(self, name)
            out[name] = None if values is None else [float(f"{v:.6g}") for v in values]
        return out


MANY_TIMES = 5.0
"""Model over measured value from which their ratio is shown instead of the relative error."""


@dataclass(frozen=True)
class MetricRow:
    """One of the thesis' figures: mean over closures, standard deviation, model, relative error in percent (P22)."""

    condition: str
    name: str
    unit: str
    measured: float
    sd: float
    model: float
    relative_error_percent: float

    @property
    def nonzero(self) -> bool:
        """Whether the measured value differs from 0 by more than it scatters: else a relative error says nothing."""
        return bool(abs(self.measured) > (self.sd if np.isfinite(self.sd) else 0.0))

    @property
    def many_times(self) -> str:
        """By how many times the model is too large, in words, where that says more than percent; else empty."""
        ratio = self.model / self.measured if self.nonzero else 0.0
        if abs(ratio) < MANY_TIMES:
            return ""
        return f"{abs(ratio):.2g} x too large" + (", other sign" if ratio < 0.0 else "")

    def to_dict(self) -> dict[str, Any]:
        return {**self.__dict__, "nonzero": self.nonzero, "many_times": self.many_times}


@dataclass(frozen=True)
class Comparison:
    """All of it; `to_dict` is what --json and the report show.

    overall    root mean square of the errors in multiples of the repeatability; NaN where nothing was repeated
    by_signal  root mean square error of each signal over the conditions, in its unit
    values     parameters that were fitted, by name, in their units; nuisances the same as fit.nuisance_table has them
    """

    model: Model
    fitted: bool
    errors: tuple[SignalError, ...]
    overall: float
    cells: tuple[Cell, ...]
    overlays: tuple[Overlay, ...]
    metrics: tuple[MetricRow, ...]
    depends_on: tuple[Dependence, ...]
    data: tuple[Mapping[str, Any], ...]
    notes: tuple[str, ...]
    by_signal: Mapping[str, float] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)
    nuisances: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        return {
            "model": {"name": self.model.name, "sha256": self.model.sha256},
            "fitted": self.fitted,
            "overall": self.overall,
            "by_signal": dict(self.by_signal),
            "values": dict(self.values),
            "nuisances": {n: dict(row) for n, row in self.nuisances.items()},
            "errors": [e.to_dict() for e in self.errors],
            "cells": [c.to_dict() for c in self.cells],
            "overlays": [o.to_dict() for o in self.overlays],
            "metrics": [m.to_dict() for m in self.metrics],
            "depends_on": {d.variable: d.to_dict() for d in self.depends_on},
            "data": [dict(d) for d in self.data],
            "notes": list(self.notes),
        }


def compare(
    prepared: Prepared,
    *,
    fitted: bool = False,
    values: Mapping[str, float] | None = None,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> Comparison:
    """Compare the prepared model as it is, or with its nuisance parameters fitted first, as a diagnosis fits them.

    values    parameters to use instead (those of a diagnosis, with its model in `prepared`)
    executor  where the fit is done, and where its results are kept; this process if None
    """
    features, model = prepared.features, prepared.model
    own: list[str] = []
    table: dict[str, dict[str, Any]] = {}
    if values is None:
        values = {}
        if not fitted:
            own = untold(prepared.nuisances)
        else:
            search = Search(
                prepared.problem,
                model,
                prepared.nuisances,
                {},
                executor=executor or Executor(),
                progress=progress,
            )
            prepared, search = in_time(prepared, search)
            found = search.null().fit
            table = nuisance_table(found)
            features, values, clock = prepared.features, found.values, other_clock(prepared.problem, found)
            own = [*([clock.said] if clock else []), *moved_notes(found), *held_notes(found), *unmoved(found)]
    predicted = features.closures(prepared.rig, model, values)
    contact = _contact(prepared, values)
    labels = [_labels(features, block, contact) for block in features.blocks]
    titles = _titles(features)
    of_blocks = signal_errors(features, predicted)
    errors = tuple(replace(e, condition=title) for e, title in zip(of_blocks, titles, strict=True))
    names = [prepared.rig.phases.get(name, name) for name in PHASES]
    return Comparison(
        model,
        fitted,
        errors,
        overall(errors),
        _cells(features, predicted, labels, seed, names, titles),
        tuple(
            replace(_overlay(prepared, b, p, lab, names), condition=title)
            for b, p, lab, title in zip(features.blocks, predicted, labels, titles, strict=True)
        ),
        _metrics(features, predicted, labels) if prepared.rig.figures else (),
        residual_dependences(features, predicted, prepared.rig.drive_signals),
        data_used(features),
        (*prepared.notes, *own),
        per_signal(features, [of_blocks]),
        values if fitted else {},
        table,
    )


def _titles(features: Features) -> list[str]:
    """Per block its condition's name, with the trial's where several trials have that condition."""
    trials: dict[str, set[int]] = {}
    for block in features.blocks:
        trials.setdefault(block.condition, set()).add(block.trial)
    return [
        f"{b.condition} ({features.trials[b.trial].name})" if len(trials[b.condition]) > 1 else b.condition
        for b in features.blocks
    ]


def _contact(prepared: Prepared, values: Mapping[str, float]) -> dict[int, tuple[Array, Array] | None]:
    """Per trial, when there is contact, at its samples: from the measured force, else from the model's.

    None where there is no force, or none that stands out from its own noise.
    """
    out: dict[int, tuple[Array, Array] | None] = {}
    for k, trial in enumerate(prepared.features.trials):
        if "grip_force" in trial.signals:
            time, force = trial.signals["grip_force"]
        else:
            run, _ = prepared.features.simulated(prepared.rig, prepared.model, values, k)
            if "grip_force" not in run:
                out[k] = None
                continue
            force = run["grip_force"]
            time = np.arange(force.size, dtype=np.float64) * trial.period
        ticks = np.arange(trial.reference.size) * trial.period
        away = np.interp(time, ticks, trial.reference - trial.reference[0])
        rest = force[np.abs(away) < CONTACT * trial.span]
        zero, noise = (float(np.median(rest)), float(rest.std())) if rest.size else (0.0, 0.0)
        touching = force - zero > max(CONTACT * float((force - zero).max()), CONTACT_OVER_NOISE * noise)
        out[k] = (time, touching.astype(float)) if touching.any() else None
    return out


def _labels(
    features: Features, block: Block, contact: Mapping[int, tuple[Array, Array] | None]
) -> NDArray[np.int64]:
    trial = features.trials[block.trial]
    own = trial.of(block.condition)
    closure = own[0 if trial.anew else min(1, len(own) - 1)]
    touching = contact[block.trial]
    mask: NDArray[np.bool_] | None = None
    if touching is not None:
        mask = np.interp(closure.start + block.phase, *touching) > 0.5
    return phase_of(trial, closure, block.phase, mask)


def _cells(
    features: Features,
    predicted: list[Array],
    labels: list[NDArray[np.int64]],
    seed: int,
    names: Sequence[str],
    titles: Sequence[str],
) -> tuple[Cell, ...]:
    rng = np.random.default_rng(seed)
    rows: list[dict[str, Any]] = []
    for block, model, label, title in zip(features.blocks, predicted, labels, titles, strict=True):
        e = block.measured - block.measured.mean(axis=0)
        residual = block.measured.mean(axis=0) - model.mean(axis=0)
        n = block.n
        for k, name in enumerate(names):
            own = label == k
            if own.sum() < 3:
                continue
            scatter = float(np.sqrt((e[:, own] ** 2).sum() / max(1, (n - 1) * own.sum())))
            floor = block.floor_in(own)
            repeat = max(scatter, floor) if n > 1 else float("nan")
            rmse = float(np.sqrt(((block.measured - model)[:, own] ** 2).mean()))
            seen = float((residual[own] ** 2).mean())
            p = float("nan")
            if n >= FEW and floor > 0.0 and seen <= floor**2:
                p = 1.0  # the same closures again and again, and the model as near as can be told
            elif n >= FEW:
                # Means of randomly signed deviations: what the mean residual would be by scatter alone.
                draws = rng.choice([-1.0, 1.0], size=(DRAWS, n)) @ e[:, own] / n * np.sqrt(n / (n - 1.0))
                p = float((1 + ((draws**2).mean(axis=1) >= seen).sum()) / (1 + DRAWS))
            rows.append(
                {
                    "condition": title,
                    "signal": block.signal,
                    "phase": name,
                    "unit": block.unit,
                    "rmse": rmse,
                    "bias": float(residual[own].mean()),
                    "repeatability": repeat,
                    "ratio": rmse / repeat if repeat > 0 else float("nan"),
                    "p_value": p,
                }
            )
    limit = _benjamini_hochberg([r["p_value"] for r in rows])
    return tuple(Cell(**r, fails=bool(r["p_value"] <= limit)) for r in rows)


def _benjamini_hochberg(p_values: list[float]) -> float:
    """Largest p-value that is still a discovery (Benjamini, Hochberg 1995); -1 if none is."""
    p = np.sort([v for v in p_values if np.isfinite(v)])
    if p.size == 0:
        return -1.0
    passed = p <= FALSE_DISCOVERY_RATE * np.arange(1, p.size + 1) / p.size
    return float(p[passed].max()) if passed.any() else -1.0


def _overlay(
    prepared: Prepared, block: Block, predicted: Array, label: NDArray[np.int64], names: Sequence[str]
) -> Overlay:
    trial = prepared.features.trials[block.trial]
    closure = trial.of(block.condition)[0]
    spread = 2.0 * block.measured.std(axis=0, ddof=1) if block.n > 1 else np.zeros(block.phase.size)
    mean = block.measured.mean(axis=0)
    grid = np.arange(trial.reference.size) * trial.period
    played = isinstance(prepared.rig.controller(prepared.model, trial.period), VoltagePlayback)
    return Overlay(
        block.condition,
        block.signal,
        block.unit,
        block.phase,
        mean,
        mean - spread,
        mean + spread,
        predicted.mean(axis=0),
        None if played else np.interp(closure.start + block.phase, grid, trial.reference),
        tuple(names[k] for k in label),
    )


def _metrics(
    features: Features, predicted: list[Array], labels: list[NDArray[np.int64]]
) -> tuple[MetricRow, ...]:
    out = []
    for condition in features.conditions:
        own = [k for k, b in enumerate(features.blocks) if b.condition == condition]
        first = next((k for k in own if features.blocks[k].signal == "motor_current"), own[0])
        phase, label = features.blocks[first].phase, labels[first]

        def curves(signal: str, of: list[Array], own: list[int] = own, phase: Array = phase) -> Array | None:
            k = next((k for k in own if features.blocks[k].signal == signal), None)
            if k is None:
                return None
            return np.array([np.interp(phase, features.blocks[k].phase, row) for row in of[k]])

        measured_all = [b.measured for b in features.blocks]
        sets = []
        for source in (measured_all, predicted):
            parts = [curves(s, source) for s in ("encoder_position", "motor_current", "grip_force")]
            n = max((p.shape[0] for p in parts if p is not None), default=0)
            sets.append(
                [
                    metrics(phase, label, *(None if p is None else p[min(k, p.shape[0] - 1)] for p in parts))
                    for k in range(n)
                ]
            )
        for name, unit in METRICS.items():
            m = np.array([row[name] for row in sets[0]])
            s = np.array([row[name] for row in sets[1]])
            if np.isfinite(m).any() and np.isfinite(s).any():
                mean, model = float(np.nanmean(m)), float(np.nanmean(s))
                sd = float(np.nanstd(m, ddof=1)) if np.isfinite(m).sum() > 1 else float("nan")
                out.append(
                    MetricRow(
                        condition,
                        name,
                        unit,
                        mean,
                        sd,
                        model,
                        (mean - model) / mean * 100.0 if mean else float("nan"),
                    )
                )
    return tuple(out)
