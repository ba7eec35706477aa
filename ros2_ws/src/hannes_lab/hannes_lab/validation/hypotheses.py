"""What R12 takes: the laws of `fitting.LAWS`, each calibrated on the void phases and the rigid column.

The first law is that of the shipped hand.  The others' values are kept in data/r12_laws.yaml (written by
`hannes validate --laws`); the page simulates them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.parameters import read_yaml
from hannes_sim.objects import RIGID_DYNAMOMETER, SOFT_BALL

from ..search import Progress
from . import fitting
from .currents import figures, simulate

FILE = Path(__file__).parents[1] / "data" / "r12_laws.yaml"

SHIPPED = "proportional"
OTHERS = tuple(name for name in fitting.LAWS if name != SHIPPED)

SHOWN = (
    ("R09", "slope_closing", "A/s"),
    ("R10", "maximum", "A"),
    ("R11", "average_opening", "A"),
    ("R12", "slope_opening", "A/s"),
)


def write(*, starts: int, cache: Path | None, progress: Progress, file: Path = FILE) -> Path:
    """Calibrate every law but the shipped hand's own, and keep the values."""
    out: dict[str, Any] = {}
    for name in OTHERS:

        def inner(done: int, total: int, text: str, name: str = name) -> None:
            progress(done, total, f"{name}: {text}")

        found = fitting.calibrate_thesis(law=name, starts=starts, cache=cache, progress=inner)
        out[name] = {
            "values": {n: float(v) for n, v in found.best.values.items()},
            "cost": float(found.costs[0]),
            "misfit": float(found.best.misfit),
            "free": len(found.parameters),
            "targets": len(fitting.targets_of(name)),
            "starts": len(found.costs),
            "agree": found.agree,
            "soft_stiffness": found.model.provenance["objects"]["soft"]["stiffness"],
        }
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(
            "# Calibrations of the laws that R12 is tried with, made by `hannes validate --laws`. Do not edit.\n"
            + yaml.safe_dump(out, sort_keys=False),
            encoding="utf-8",
        )
    except OSError as error:
        raise HannesError(f"Cannot write '{file}': {error}.") from error
    return file


def notes(
    model: Model,
    own: Mapping[str, Mapping[str, float]],
    closing: float,
    real: Mapping[str, Mapping[str, float]],
) -> tuple[str, ...]:
    """One line per law: fitted rigid column and predicted soft column.

    own  the model's own figures by column; closing  its closure time [s]; real  the real hand's figures by column
    """
    fitted = {**own["rigid"], "plateau": own["void"]["plateau"], "closure_time": closing}
    misfit = sum(((t.value - fitted.get(t.name, math.nan)) / t.sd) ** 2 for t in fitting.TARGETS)
    mine = {name: own[name] for name in ("rigid", "soft")}
    out = [_line(fitting.LAWS[SHIPPED].text, model.provenance, misfit, mine, real)]
    kept = read_yaml(FILE, "laws of R12")
    for name in OTHERS:
        entry = kept[name]
        hand = fitting.applied(fitting.base_model(law=name), entry["values"], name)
        found = {
            "rigid": figures(simulate(hand, RIGID_DYNAMOMETER)),
            "soft": figures(simulate(hand, replace(SOFT_BALL, stiffness=float(entry["soft_stiffness"])))),
        }
        out.append(_line(fitting.LAWS[name].text, entry, float(entry["misfit"]), found, real))
    return tuple(out)


def _line(
    text: str,
    entry: Mapping[str, Any],
    misfit: float,
    found: Mapping[str, Mapping[str, float]],
    real: Mapping[str, Mapping[str, float]],
) -> str:
    columns = "; ".join(
        f"{column} "
        + ", ".join(f"{row} {own.get(key, math.nan):.3g} ({real[column][key]:g})" for row, key, _ in SHOWN)
        for column, own in found.items()
    )
    return (
        f"R12 tried with {text}: {entry.get('free', entry.get('free_parameters'))} free, {entry.get('targets')} "
        f"targets, sum of squares {misfit:.0f}; this law (real hand): {columns}."
    )
