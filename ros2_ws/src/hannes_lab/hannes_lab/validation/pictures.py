"""The thesis' pictures: currents and encoder, forces, mechanisms against each other, drop times, the band of hands."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.joints import FINGERS
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Picture

from .columns import REAL
from .double_pendulum import ANALYTIC, LINKS, SIMULATED
from .table import Section

COLOURS = {
    "reference": "#8a8f98",
    "encoder": "#1264a8",
    "current": "#c8501a",
    "force": "#1c7a4a",
    "band": "#c8501a",
    "simple": "#c8501a",
    "full": "#1264a8",
    "other": "#49525e",
}


def _save(picture: Picture, path: Path) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        picture.savefig(path, dpi=130, metadata={"Software": None})
    except OSError as error:
        raise HannesError(f"Cannot write the picture '{path}': {error}.") from error
    return path


def _picture(rows: int, columns: int, size: tuple[float, float]) -> tuple[Picture, Any]:
    picture = Picture(figsize=size, layout="constrained")
    FigureCanvasAgg(picture)
    axes = np.atleast_2d(picture.subplots(rows, columns, squeeze=False))
    for a in axes.flat:
        a.spines[["top", "right"]].set_visible(False)
        a.grid(alpha=0.25)
    return picture, axes


def currents(curves: Mapping[str, Any]) -> Picture:
    """Current and encoder against the reference, rigid and soft (thesis' bench test), with the force below."""
    picture, axes = _picture(3, 2, (10.0, 8.5))
    for k, kind in enumerate(("rigid", "soft")):
        c = curves["nominal"][kind]
        top, middle, low = axes[:, k]
        for band in curves["bands"][kind]:
            top.plot(band.time, band.current, color=COLOURS["band"], alpha=0.12, lw=0.8)
        top.plot(c.time, c.current, color=COLOURS["current"], label="|current|, this model")
        top.plot([], [], color=COLOURS["band"], alpha=0.4, label=f"{len(curves['bands'][kind])} hands, 30 Hz")
        for name, style in (("maximum", "--"), ("average_opening", ":")):
            top.axhline(
                REAL[kind][name],
                color=COLOURS["other"],
                ls=style,
                lw=1,
                label=f"real hand, {name.replace('_', ' ')} {REAL[kind][name]:g} A",
            )
        top.set(title=f"{kind} object", ylabel="current / A", ylim=(0, 1.35 * REAL[kind]["maximum"]))
        top.legend(fontsize=7, loc="upper right")
        middle.plot(c.time, c.reference, color=COLOURS["reference"], label="reference")
        middle.plot(c.time, c.encoder, color=COLOURS["encoder"], label="encoder")
        middle.set(ylabel="pulley / rad")
        middle.legend(fontsize=7)
        low.plot(c.time, c.force, color=COLOURS["force"], label="grip force")
        if kind == "rigid":
            low.axhline(92.3, color=COLOURS["other"], ls="--", lw=1, label="real hand, largest 92.3 N")
        low.set(ylabel="force / N", xlabel="time / s", ylim=(0, None))
        low.legend(fontsize=7)
    picture.suptitle("Bench test: current, encoder and force (R08 to R13)", fontsize=11)
    return picture


def band(curves: Mapping[str, Any]) -> Picture:
    """Void currents of a population of hands (R07)."""
    picture, axes = _picture(1, 1, (7.5, 4.2))
    a = axes[0, 0]
    closures = curves["bands"]["void"]
    for c in closures:
        a.plot(c.time, c.current, color=COLOURS["band"], alpha=0.18, lw=0.9)
    values = np.array([c.current for c in closures])
    a.plot(closures[0].time, values.mean(axis=0), color=COLOURS["encoder"], label="mean of the hands")
    a.hlines(0.25, 0.4, 1.0, color=COLOURS["other"], ls="--", label="R07: plateau of 0.25 A")
    a.set(
        xlabel="time / s",
        ylabel="|current| / A",
        ylim=(0, None),
        title=f"Void closure of {len(closures)} hands of the population, 30 Hz log (R07)",
    )
    a.legend(fontsize=8)
    return picture


def mechanisms(curves: Mapping[str, Any], title: str) -> Picture:
    """Joint angles of the full hand and of the simpler mechanism identified from it."""
    picture, axes = _picture(3, 3, (10.0, 8.0))
    full, simple = curves["names"]
    for k, joint in enumerate(curves["joints"]):
        a = axes.flat[k]
        a.plot(curves["time"], np.degrees(curves["full"][:, k]), color=COLOURS["full"], label=full)
        a.plot(
            curves["time"], np.degrees(curves["simple"][:, k]), color=COLOURS["simple"], ls="--", label=simple
        )
        error = math.sqrt(float(((curves["full"][:, k] - curves["simple"][:, k]) ** 2).mean()))
        a.set_title(f"{joint}   RMSE {error:.4f} rad", fontsize=9)
        if k >= 6:
            a.set_xlabel("time / s")
        if k % 3 == 0:
            a.set_ylabel("angle / deg")
    axes[0, 0].legend(fontsize=8)
    picture.suptitle(title, fontsize=11)
    return picture


def drops(curves: Mapping[str, Any]) -> Picture:
    """Drop times: the thesis' analytic and simulated, MuJoCo's (R01 to R03)."""
    picture, axes = _picture(1, 2, (10.0, 4.0))
    for k in range(len(LINKS)):
        a = axes[0, k]
        x = np.arange(len(FINGERS))
        series = (
            ("analytic (thesis)", ANALYTIC, "#8a8f98"),
            ("thesis' simulation", SIMULATED, "#c8501a"),
            ("MuJoCo", curves["simulated"], "#1264a8"),
        )
        for n, (name, values, colour) in enumerate(series):
            a.bar(x + 0.27 * (n - 1), [1e3 * values[f][k] for f in FINGERS], 0.25, color=colour, label=name)
        a.set_xticks(x, FINGERS)
        least = min(1e3 * values[f][k] for _, values, _ in series for f in FINGERS)
        a.set(
            title=f"{'phalanx to 82 deg' if k == 0 else 'middle to 50 deg'}",
            ylabel="drop time / ms",
            ylim=(0.9 * least, None),
        )
    axes[0, 0].legend(fontsize=8)
    picture.suptitle(
        "Drop of a finger as a double pendulum (R01 to R03); the axis does not start at 0", fontsize=11
    )
    return picture


def write(sections: list[Section], folder: Path) -> list[Path]:
    """Every picture whose section was run; returns their paths."""
    out = []
    for section in sections:
        if "R01" in section.rows:
            out.append(_save(drops(section.curves), folder / "validation_drop_times.png"))
        if "R07" in section.rows:
            out.append(_save(currents(section.curves), folder / "validation_currents.png"))
            out.append(_save(band(section.curves), folder / "validation_void_currents.png"))
        if "R14" in section.rows:
            out.append(
                _save(
                    mechanisms(section.curves, "Return wires against torsion springs (R14)"),
                    folder / "validation_torsion_springs.png",
                )
            )
        if "R15" in section.rows:
            out.append(
                _save(
                    mechanisms(section.curves, "Pulleys and wires against forces (R15)"),
                    folder / "validation_forces.png",
                )
            )
    return out
