"""What the residual depends on: position, velocity, direction, load or time, and how much of it each explains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .features import Features

Array = NDArray[np.float64]

VARIABLES = ("position", "velocity", "direction", "load", "time")
BINS = 10
AT_REST = 1e-3
"""Part of the largest speed below which there is no direction."""


@dataclass(frozen=True)
class Dependence:
    """Residual of one signal against one variable.

    share    part of the variance of the closures' mean residual that the curve explains (adjusted R2), 0..1; an offset
             that is the same everywhere depends on nothing
    centres  (b,) of the variable; curve (b,) mean residual, in the signal's unit
    """

    variable: str
    signal: str
    share: float
    centres: tuple[float, ...]
    curve: tuple[float, ...]

    def to_dict(self) -> dict[str, Any]:
        return {
            "variable": self.variable,
            "signal": self.signal,
            "share": self.share,
            "centres": list(self.centres),
            "curve": list(self.curve),
        }


def residual_dependences(
    features: Features, predicted: list[Array], drive: Sequence[str]
) -> tuple[Dependence, ...]:
    """What the residual of the drive's signal depends on, or of the first signal where none is recorded.

    Without an encoder on load and time only; without a drive's signal not on the load, which that tells.

    drive   the signals that show force or torque, see Rig
    """
    residuals: dict[str, list[Array]] = {}
    states: dict[str, list[Array]] = {"position": [], "velocity": [], "direction": [], "load": []}
    for block, closures in zip(features.blocks, predicted, strict=True):
        residuals.setdefault(block.signal, []).append(block.measured - closures)
    signal = next((s for s in drive if s in residuals), next(iter(residuals)))
    by = {(b.trial, b.condition, b.signal): (b, c) for b, c in zip(features.blocks, predicted, strict=True)}
    places = [(b.trial, b.condition) for b in features.blocks if b.signal == signal]
    for trial, condition in places:
        target, load = by[(trial, condition, signal)]
        if signal in drive:
            states["load"].append(load)
        place = by.get((trial, condition, "encoder_position"))
        if place is not None:
            position = np.interp(target.phase, place[0].phase, place[1].mean(axis=0))
            velocity = np.gradient(position, target.phase)
            for name, values in (("position", position), ("velocity", velocity), ("direction", velocity)):
                states[name].append(np.tile(values, (target.n, 1)))
    # Of a set in which the encoder is not logged everywhere, what depends on it is not known.
    known = {name: values for name, values in states.items() if len(values) == len(places)}
    return _dependences(residuals, known, signal)


def _dependences(
    residuals: Mapping[str, list[Array]], states: Mapping[str, list[Array]], signal: str
) -> tuple[Dependence, ...]:
    """Shares of one signal's residual, largest first.

    residuals  signal -> per condition block (n, p) measured - model
    states     variable -> per condition block (n, p)
    """
    r = np.concatenate([a.mean(axis=0) for a in residuals[signal]])
    out = []
    for variable in VARIABLES:
        if variable == "time":
            values = np.concatenate(
                [np.repeat(np.linspace(0.0, 1.0, a.shape[0]), a.shape[1]) for a in residuals[signal]]
            )
            target = np.concatenate([a.ravel() for a in residuals[signal]])
        elif variable not in states:
            continue
        else:
            values = np.concatenate([a.mean(axis=0) for a in states[variable]])
            target = r
        out.append(_dependence(variable, signal, values, target))
    return tuple(sorted(out, key=lambda d: -d.share))


def _dependence(variable: str, signal: str, x: Array, y: Array) -> Dependence:
    if variable == "direction":
        labels = np.sign(x) * (np.abs(x) > AT_REST * np.abs(x).max(initial=0.0))
        groups = np.unique(labels)
        index = np.searchsorted(groups, labels)
    else:
        edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, BINS + 1)))
        if edges.size < 3:
            return Dependence(variable, signal, 0.0, (), ())
        index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, edges.size - 2)
        groups = np.arange(edges.size - 1)
    centres, curve, inside = [], [], 0.0
    for k in range(groups.size):
        own = index == k
        if not own.any():
            continue
        centres.append(float(x[own].mean()))
        curve.append(float(y[own].mean()))
        inside += float(((y[own] - y[own].mean()) ** 2).sum())
    total, level = float(((y - y.mean()) ** 2).sum()), float((y**2).sum())
    k, n = len(centres), y.size
    # Of an offset alone rounding is left.
    share = 1.0 - (inside / max(n - k, 1)) / (total / (n - 1)) if total > 1e-12 * level else 0.0
    return Dependence(variable, signal, float(np.clip(share, 0.0, 1.0)), tuple(centres), tuple(curve))
