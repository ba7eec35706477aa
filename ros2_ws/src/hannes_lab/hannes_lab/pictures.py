"""All in one picture: measured and modelled curves, how the error falls, where it fails, what explains it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
from hannes_description.errors import HannesError
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpecFromSubplotSpec
from matplotlib.patches import Rectangle
from matplotlib.transforms import blended_transform_factory

from .report import error_fall, failure_maps, heat, ranking, verdict_of
from .report_svg import at_times, difference, runs, series
from .report_text import log_ticks, percent, ratio, unit, words

Part = Mapping[str, Any]

INK, SOFT, LINE = "#1b1e23", "#5d6570", "#e2e4e7"
BEFORE, AFTER, FLOOR = "#c8501a", "#1264a8", "#1c7a4a"
TONES = {"nothing": FLOOR, "effects": AFTER, "unknown": "#a5571a", "other": "#49525e"}
PHASE_TINTS = {
    "void": "#f3f7fb",
    "grasp": "#fbf1e4",
    "hold": "#fdf8f1",
    "opening": "#eff7f2",
    "rest": "#f6f6f6",
}
HEAT = LinearSegmentedColormap.from_list("heat", ["#f0f1f3", "#de5a26"])
STYLE = {
    "font.size": 9.0,
    "text.color": INK,
    "axes.labelcolor": SOFT,
    "axes.edgecolor": LINE,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "axes.linewidth": 0.8,
    "svg.fonttype": "path",
    "svg.hashsalt": "hannes",
}

WIDTH, HEAD = 14.0, 1.15
"""Inches: the picture's width, and the height of its heading."""

MAX_CONDITIONS, MAX_SIGNALS = 4, 3
"""What one picture can hold: the conditions that are missed most; the report has all."""

ENDINGS = (".png", ".svg", ".pdf")
"""Of files that a picture can be written to."""

Curve = Sequence[float | None]


def write_picture(
    path: str | Path,
    *,
    comparison: Part | None,
    after: Part | None = None,
    diagnosis: Part | None = None,
    title: str = "",
) -> Path:
    """Write the picture as .png or .svg (also .pdf) and return its path.

    comparison, after, diagnosis  as for the report: dictionaries of Comparison and Diagnosis
    Raises HannesError if there is nothing to draw, the ending is not known, or the file cannot be written.
    """
    out = Path(path)
    if out.suffix.lower() not in ENDINGS:
        raise HannesError(
            f"A picture cannot be written as '{out.name}': the name must end in .png, .svg or .pdf."
        )
    figure = draw(comparison=comparison, after=after, diagnosis=diagnosis, title=title)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        # No date inside: the same data give the same file.
        metadata = {".png": {}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}[out.suffix.lower()]
        with mpl.rc_context(STYLE):
            figure.savefig(out, dpi=150, metadata=metadata)
    except OSError as error:
        raise HannesError(f"The picture cannot be written to '{out}': {error.strerror or error}.") from error
    return out


def draw(
    *, comparison: Part | None, after: Part | None = None, diagnosis: Part | None = None, title: str = ""
) -> Figure:
    """The figure, on a canvas of its own: nothing global of matplotlib is touched but within this call."""
    if comparison is None:
        comparison, after = after, None
    if comparison is None and diagnosis is None:
        raise HannesError("There is nothing to draw: neither a comparison nor a diagnosis was given.")
    with mpl.rc_context(STYLE):
        return _draw(comparison, after, diagnosis, title)


def _draw(comparison: Part | None, after: Part | None, diagnosis: Part | None, title: str) -> Figure:
    overlays = list((comparison or {}).get("overlays") or [])
    signals = list(dict.fromkeys(str(o["signal"]) for o in overlays))[:MAX_SIGNALS]
    overlays = [o for o in overlays if str(o["signal"]) in signals]
    named = list(dict.fromkeys(str(o["condition"]) for o in overlays))
    conditions = most_missed(overlays, named)
    verdict = verdict_of(comparison, after, diagnosis)
    if len(conditions) < len(named):
        cut = f"{len(conditions)} of {len(named)} conditions, those that the model misses most"
        title = f"{title or verdict['label']}  ·  {cut}"
    across = len(conditions) == 1  # then the signals stand side by side
    lines = (1 if across else len(signals)) if overlays else 0
    # without repeats there is nothing to hold the errors against
    maps = [m for m in failure_maps(comparison, after) if m["groups"] and m["scaled"]]
    panels = _panels(error_fall(diagnosis), maps, ranking(diagnosis))
    top, bottom = 2.3 * lines, max((p.height for p in panels), default=0.0)
    height = HEAD + top + (0.35 if lines else 0.0) + (bottom + 0.75 if panels else 0.0)
    figure = Figure(figsize=(WIDTH, height), facecolor="white")
    FigureCanvasAgg(figure)
    _heading(figure, verdict, title, height)
    if lines:
        grid = figure.add_gridspec(
            1,
            1,
            left=0.055,
            right=0.985,
            top=1.0 - (HEAD + 0.25) / height,
            bottom=1.0 - (HEAD + top) / height,
        )
        _overlays(
            figure, grid[0], overlays, list((after or {}).get("overlays") or []), conditions, signals, across
        )
    _below(figure, panels, height)
    return figure


def most_missed(overlays: Sequence[Part], named: Sequence[str]) -> list[str]:
    """As many conditions as a picture can hold, in their order: those of which the model misses a signal most, in parts
    of what that signal goes through in all."""
    if len(named) <= MAX_CONDITIONS:
        return list(named)
    spans: dict[str, float] = {}
    missed: dict[str, float] = dict.fromkeys(named, 0.0)
    curves = [
        (str(o["condition"]), str(o["signal"]), series(o, "measured"), series(o, "model")) for o in overlays
    ]
    for _, signal, measured, _ in curves:
        known = [v for v in measured if v is not None]
        spans[signal] = max(spans.get(signal, 0.0), max(known, default=0.0) - min(known, default=0.0))
    for condition, signal, measured, model in curves:
        left = [v for v in difference(measured, model) if v is not None]
        if left and spans[signal] > 0.0:
            rms = math.sqrt(sum(v * v for v in left) / len(left))
            missed[condition] = max(missed[condition], rms / spans[signal])
    worst = sorted(named, key=lambda name: -missed[name])[:MAX_CONDITIONS]
    return [name for name in named if name in worst]


@dataclass(frozen=True)
class Panel:
    """A drawing in the lower row: inches for its labels on the left, itself, and what stands on the right."""

    title: str
    labels: float
    width: float
    right: float
    height: float
    plot: Callable[[Axes], None]


def _panels(fall: Part | None, maps: Sequence[Part], ranks: Part | None) -> list[Panel]:
    out = []
    if fall and not fall["in_units"]:
        out.append(
            Panel(
                f"Error on held-out {'conditions' if fall['by_conditions'] else 'closures'}, × repeatability",
                _inches([r["label"] for r in fall["rows"]]),
                2.2,
                0.3,
                max(1.3, 0.42 * len(fall["rows"])),
                partial(_fall, fall=fall),
            )
        )
    for k, m in enumerate(maps):
        rows = sum(len(g) for g in m["groups"].values()) + 0.35 * len(m["groups"])
        labels = 0.0 if k else _inches([_row_name(c, s) for c, g in m["groups"].items() for s in g])
        name = f"{m['kind'].capitalize()}: " if len(maps) > 1 else ""
        found = f"{m['fails']} of {m['judged']} fail" if m["judged"] else "× repeatability"
        width = 0.56 * len(m["phases"])
        out.append(
            Panel(
                f"{name}{found}",
                labels,
                width,
                max(0.25, _inches([f"{name}{found}"]) - width),
                0.29 * rows,
                partial(_map, table=m, named=k == 0),
            )
        )
    if ranks:
        rows = ranks["first"]
        title = "Explained by each alone" if ranks["excess"] else "Misfit left, × chance"
        if ranks["rest"]:
            title += f" ({len(rows)} of {len(rows) + len(ranks['rest'])})"
        out.append(
            Panel(
                title,
                _inches([r["label"] for r in rows]),
                1.6,
                0.55,
                max(1.0, 0.27 * len(rows)),
                partial(_ranking, ranks=ranks),
            )
        )
    return out


def _inches(labels: Sequence[str]) -> float:
    """Room for the longest label in the font of the axes."""
    return 0.12 + 0.063 * max((len(label) for label in labels), default=0)


def _row_name(condition: str, signal: str) -> str:
    return f"{words(condition)}: {words(signal)}"


def _below(figure: Figure, panels: Sequence[Panel], height: float) -> None:
    """The lower row: drawings spread over the width of the picture, tops in line."""
    if not panels:
        return
    taken = sum(p.labels + p.width + p.right for p in panels)
    # What room is left goes to the drawings in proportion to their widths.
    stretch = min(2.0, max(0.5, 1.0 + (WIDTH - 0.45 - taken) / sum(p.width for p in panels)))
    x, top = 0.3, max(p.height for p in panels) + 0.3
    for p in panels:
        width = p.width * stretch
        figure.text(
            (x + (0.03 if p.labels else 0.0)) / WIDTH,
            (top + 0.32) / height,
            p.title,
            fontsize=9.5,
            weight="bold",
            va="bottom",
        )
        axes = figure.add_axes(
            ((x + p.labels) / WIDTH, (top - p.height) / height, width / WIDTH, p.height / height)
        )
        for spine in axes.spines.values():
            spine.set_visible(False)
        axes.tick_params(length=0, labelsize=8)
        p.plot(axes)
        x += p.labels + width + p.right


ROOM = 0.965
"""Part of the width that a line of the heading may take."""


def _heading(figure: Figure, verdict: Mapping[str, Any], title: str, height: float) -> None:
    tone = TONES[verdict["kind"]]
    figure.text(
        0.018,
        1.0 - 0.30 / height,
        _plain(title or verdict["label"]),
        color=tone,
        fontsize=10,
        weight="bold",
        va="center",
    )
    headline = _plain(verdict["headline"])
    size = 17 if len(headline) < 90 else 12 if len(headline) < 125 else 9
    figure.text(0.018, 1.0 - 0.64 / height, headline, fontsize=size, weight="bold", va="center")
    key = "      ".join(
        f"{f['was'] + ' → ' if f['was'] else ''}{f['value']}  {f['label']}" for f in verdict["figures"][:3]
    )
    line = figure.text(0.018, 1.0 - 0.98 / height, _plain(key), color=SOFT, fontsize=8.5, va="center")
    wide = line.get_window_extent().width / figure.bbox.width
    if wide > ROOM:
        line.set_fontsize(8.5 * ROOM / wide)
    figure.add_artist(_stripe(tone))


def _stripe(colour: str) -> Any:
    return Rectangle((0.0, 0.0), 0.006, 1.0, facecolor=colour, linewidth=0.0)


def _plain(text: str) -> str:
    """A text of the data as it is: a dollar sign must not start mathematics."""
    return text.replace("$", r"\$")


def _overlays(
    figure: Figure,
    cell: Any,
    overlays: list[Part],
    later: list[Part],
    conditions: Sequence[str],
    signals: Sequence[str],
    across: bool,
) -> None:
    shape = (1, len(signals)) if across else (len(signals), len(conditions))
    outer = GridSpecFromSubplotSpec(*shape, subplot_spec=cell, hspace=0.34, wspace=0.2)
    for i, signal in enumerate(signals):
        for j, condition in enumerate(conditions):
            o = next((o for o in overlays if (o["condition"], o["signal"]) == (condition, signal)), None)
            if o is None:
                continue
            a = next((o for o in later if (o["condition"], o["signal"]) == (condition, signal)), None)
            place = outer[(0, i) if across else (i, j)]
            inner = GridSpecFromSubplotSpec(2, 1, subplot_spec=place, height_ratios=(2.4, 1.0), hspace=0.08)
            upper, lower = figure.add_subplot(inner[0]), figure.add_subplot(inner[1])
            _overlay(upper, lower, o, a)
            upper.set_title(
                _plain(f"{words(condition)}: {words(signal)}, {unit(o.get('unit', ''))}"),
                fontsize=9,
                loc="left",
                color=INK,
                pad=4,
            )
            if across or i == len(signals) - 1:
                # beside the last number of the axis, not on it
                lower.annotate(
                    "s",
                    (1.0, 0.0),
                    xytext=(5, -10),
                    xycoords="axes fraction",
                    textcoords="offset points",
                    ha="left",
                    va="center",
                    fontsize=8,
                )
            if i == 0 and j == 0:
                # In the corner of the picture, where no curve is.
                figure.legend(
                    *upper.get_legend_handles_labels(),
                    loc="upper right",
                    bbox_to_anchor=(0.985, 1.0 - 0.12 / figure.get_figheight()),
                    fontsize=8.5,
                    frameon=False,
                    ncols=3,
                    handlelength=1.8,
                    columnspacing=1.6,
                )


def _overlay(upper: Axes, lower: Axes, overlay: Part, after: Part | None) -> None:
    t = series(overlay, "time")
    measured, low, high = (series(overlay, n) for n in ("measured", "low", "high"))
    models = [("before" if after is not None else "model", BEFORE, series(overlay, "model"))]
    if after is not None:
        models.append(("after", AFTER, at_times(series(after, "time"), series(after, "model"), t)))
    for axes in (upper, lower):
        for name, start, stop in runs([str(p) for p in overlay.get("phase", [])], t):
            axes.axvspan(
                start, stop, facecolor=PHASE_TINTS.get(name, PHASE_TINTS["rest"]), linewidth=0.0, zorder=0
            )
        axes.margins(x=0.0)
        axes.tick_params(length=2, labelsize=7.5, pad=2)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    upper.tick_params(labelbottom=False)
    upper.fill_between(_nan(t), _nan(low), _nan(high), color=INK, alpha=0.16, linewidth=0.0)
    repeated = any(h is not None and lo is not None and h > lo for h, lo in zip(high, low, strict=False))
    label = "measured ±2 sd" if repeated else "measured"
    upper.plot(_nan(t), _nan(measured), color=INK, alpha=0.38, linewidth=3.0, label=label)
    lower.fill_between(
        _nan(t),
        _nan(difference(low, measured)),
        _nan(difference(high, measured)),
        color=INK,
        alpha=0.16,
        linewidth=0.0,
    )
    for name, colour, values in models:
        upper.plot(_nan(t), _nan(values), color=colour, linewidth=1.2, label=name)
        lower.plot(_nan(t), _nan(difference(measured, values)), color=colour, linewidth=1.0)
    lower.locator_params(axis="y", nbins=3)
    lower.set_ylabel("residual", fontsize=7, labelpad=2)


def _nan(values: Curve) -> list[float]:
    return [math.nan if v is None else v for v in values]


def _fall(axes: Axes, fall: Mapping[str, Any]) -> None:
    rows = fall["rows"]
    key = "held_out_conditions" if fall["by_conditions"] else "held_out"
    values = [r[key] if r[f"{key}_at"] is not None else math.nan for r in rows]
    places = list(range(len(rows)))
    colours = [BEFORE if r["kind"] == "before" else AFTER for r in rows]
    if fall["log"]:
        axes.set_xscale("log")
    finite = [v for v in [*values, 1.0] if math.isfinite(v)]
    left = min(finite) / 1.5 if fall["log"] else 0.0
    axes.barh(places, [v - left for v in values], left=left, color=colours, height=0.5)
    axes.axvline(1.0, color=FLOOR, linestyle=(0, (3, 2)), linewidth=1.4)
    axes.set_xlim(left, max(finite) * (1.8 if fall["log"] else 1.2))
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_yticks(places, [_plain(r["label"]) for r in rows], color=INK)
    for place, value in zip(places, values, strict=True):
        if math.isfinite(value):
            axes.annotate(
                ratio(value),
                (max(value, 1.0), place),
                xytext=(4, 0),
                textcoords="offset points",
                va="center",
                fontsize=8.5,
                weight="bold",
            )
    if fall["log"]:
        marks = log_ticks(left, max(finite) * 1.8, 5)
        axes.set_xticks(marks, [f"{m:g}" for m in marks])
        axes.minorticks_off()
    axes.grid(axis="x", color=LINE, linewidth=0.7)
    axes.set_axisbelow(True)


def _map(axes: Axes, table: Mapping[str, Any], named: bool) -> None:
    phases, labels, y = table["phases"], [], 0.0
    places: list[float] = []
    for condition, signals in table["groups"].items():
        for signal, row in signals.items():
            for k, c in enumerate(row):
                if c is None:
                    continue
                warm = heat(c.get("ratio"))
                axes.add_patch(_cell(k, y, HEAT(warm or 0.0)))
                mark = " •" if c.get("fails") else ""
                axes.text(
                    k,
                    y,
                    ratio(c.get("ratio")) + mark,
                    ha="center",
                    va="center",
                    fontsize=7.5,
                    weight="bold" if c.get("fails") else "normal",
                )
            labels.append(_plain(_row_name(condition, signal)))
            places.append(y)
            y += 1.0
        y += 0.35
    axes.set_xlim(-0.5, len(phases) - 0.5)
    axes.set_ylim(y - 0.8, -0.6)
    axes.set_yticks(places if named else [], labels if named else [], color=INK, fontsize=8)
    axes.set_xticks(range(len(phases)), [_plain(p) for p in phases])
    axes.xaxis.tick_top()


def _cell(x: float, y: float, colour: Any) -> Any:
    return Rectangle((x - 0.47, y - 0.45), 0.94, 0.9, facecolor=colour, linewidth=0.0)


def _ranking(axes: Axes, ranks: Mapping[str, Any]) -> None:
    rows = ranks["first"]
    places = list(range(len(rows)))
    lengths = [r["width"] if ranks["excess"] else 100.0 * (r["of_chance"] or 0.0) for r in rows]
    axes.barh(places, lengths, color=[AFTER if r["found"] else "#c3c7cd" for r in rows], height=0.55)
    axes.set_xlim(0.0, max(100.0, *lengths))
    if not ranks["excess"]:
        axes.axvline(100.0, color=FLOOR, linestyle=(0, (3, 2)), linewidth=1.4, clip_on=False)
    axes.set_ylim(max(3, len(rows)) - 0.4, -0.6)
    axes.set_yticks(places, [_plain(r["label"]) for r in rows], color=INK)
    axes.set_xticks([])
    beside = blended_transform_factory(axes.transAxes, axes.transData)
    for place, row in zip(places, rows, strict=True):
        text = percent(row["explained"]) if ranks["excess"] else ratio(row["of_chance"])
        axes.text(1.02, place, text, transform=beside, va="center", fontsize=8)
