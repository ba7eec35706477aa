"""One self-contained page of a comparison and a diagnosis: for people who want to look before they believe.

The page is made of the same dictionaries that `--json` prints, carries them inside for others to read, and loads
nothing: script, styles and data are in the file, and its content security policy forbids every request.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import platform
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from hannes_description.errors import HannesError
from hannes_description.files import write_whole
from hannes_description.output import finite
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from . import report_text as text
from .depends import INERTIA
from .diagnosis import has_excess
from .experiments import VISIBLE
from .falls import WITHOUT_EFFECT, before, before_in_units, errors_in_units, step_name
from .report_next import SHOWN, how_sure, next_step, runner_up
from .report_svg import curve_svg, overlay_svg, tick_text

Part = Mapping[str, Any]

HERE = Path(__file__).parent

PHASES = ("void", "grasp", "hold", "opening", "rest")

HOT = 30.0
"""Multiple of the repeatability at which the failure map's colour is full; 1 is where it begins."""

DECADES = 8.0
"""Ratio of largest to smallest error from which the error's fall is shown on a logarithmic scale."""

FIGURES = 3
"""Signals of which the verdict's card shows the error, where it is known in their units only."""

RANKS = 8
"""Rows of the ranking that are open at first."""

NOTES = 5
"""Notes that are open at first."""

LONG_NOTE, NOTE = 260, 150
"""Characters from which a note is folded, and of its beginning that stays open."""

PACKAGES = ("hannes_lab", "hannes_sim", "mujoco", "numba", "numpy", "scipy")


def write_report(
    path: str | Path,
    *,
    comparison: Part | None,
    after: Part | None = None,
    diagnosis: Part | None = None,
    title: str = "Model against closures",
    command: str = "",
    created: str = "",
) -> Path:
    """Write the page and return its path.

    comparison  Comparison.to_dict() of the model as it was
    after       Comparison.to_dict() of the model with the effects added
    diagnosis   Diagnosis.to_dict()
    command     what to run to get this page again; created: date and time as they are to be shown
    Raises HannesError if there is nothing to report or the file cannot be written.
    """
    page = render_report(
        comparison=comparison, after=after, diagnosis=diagnosis, title=title, command=command, created=created
    )
    out = Path(path)
    try:
        write_whole(out, page)
    except OSError as error:
        raise HannesError(f"The report cannot be written to '{out}': {error.strerror or error}.") from error
    return out


def render_report(
    *,
    comparison: Part | None,
    after: Part | None = None,
    diagnosis: Part | None = None,
    title: str = "Model against closures",
    command: str = "",
    created: str = "",
) -> str:
    """The page as a text; see write_report."""
    if comparison is None:
        comparison, after = after, None
    if comparison is None and diagnosis is None:
        raise HannesError("There is nothing to report: neither a comparison nor a diagnosis was given.")
    scripts = {"uplot": _asset("uPlot.iife.min.js"), "page": _asset("report.js")}
    data = {
        "title": title,
        "command": command,
        "created": created,
        "versions": versions(),
        "comparison": comparison,
        "after": after,
        "diagnosis": diagnosis,
    }
    before_name, after_name = _model_names(comparison, after, diagnosis)
    environment = Environment(
        loader=FileSystemLoader(HERE / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        number=text.number,
        ratio=text.ratio,
        percent=text.percent,
        words=text.words,
        unit=text.unit,
        relative_error=text.relative_error,
        plus_minus=text.plus_minus,
        fixed=lambda v, n=2: text.DASH if text.known(v) is None else text.fixed(v, n),
    )
    sources = [part for part in (diagnosis, comparison) if part is not None]
    verdict, found, ranks = verdict_of(comparison, after, diagnosis), effects(diagnosis), ranking(diagnosis)
    kind = str(diagnosis.get("verdict", "")) if diagnosis is not None else "comparison"
    context = {
        "title": title,
        "command": command,
        "created": created,
        "versions": data["versions"],
        "before_name": before_name,
        "after_name": after_name,
        "both": after is not None,
        "no_finding": text.NO_FINDING,
        "verdict": verdict,
        "sure": how_sure(found),
        "more_effects": max(0, len(found) - SHOWN),
        "runner_up": runner_up(ranks, diagnosis) if kind in ("effects", "unknown") else None,
        "next": next_step(kind, diagnosis, command),
        "fall": error_fall(diagnosis),
        "conditions": overlay_groups(comparison, after),
        "references": any(o.get("reference") for o in _list(comparison, "overlays")),
        "repeated": any(text.known(e.get("repeatability")) is not None for e in _list(comparison, "errors")),
        "maps": failure_maps(comparison, after),
        "dependences": dependences(comparison, after, diagnosis),
        "effects": found,
        "tied": tied(diagnosis),
        "experiments": _list(diagnosis, "experiments"),
        "separable": any(
            (text.known(x.get("distance")) or 0.0) >= VISIBLE for x in _list(diagnosis, "experiments")
        ),
        "ranking": ranks,
        "metrics": metric_groups(comparison, after),
        "nuisances": nuisances(diagnosis),
        "data": _list(sources[0], "data") or _list(sources[-1], "data"),
        "notes": notes([*sources, after]),
        "models": _models(comparison, after, diagnosis),
        "json": Markup(embedded_json(data)),
        "scripts": {name: Markup(body) for name, body in scripts.items()},
        "styles": Markup(_asset("uPlot.min.css") + _asset("report.css")),
        "policy": content_policy(scripts.values()),
        "uplot_licence": _asset("uPlot.LICENSE"),
    }
    return environment.get_template("report.html.j2").render(context)


def notes(parts: Sequence[Part | None]) -> dict[str, list[dict[str, str]]]:
    """Every note once, in the words of the command line: what is open at first, and what is folded.

    Of a long note the beginning is open.
    """
    texts = list(dict.fromkeys(str(n) for part in parts for n in _list(part, "notes")))
    rows = [
        {"text": note, "short": text.shortened(note, NOTE) if len(note) > LONG_NOTE else ""} for note in texts
    ]
    # one that would be folded alone stands with the others
    shown = len(rows) if len(rows) <= NOTES + 1 else NOTES
    return {"first": rows[:shown], "rest": rows[shown:]}


def embedded_json(data: Any) -> str:
    """JSON that may stand inside a script element: no NaN (null instead), nothing that could end the element."""
    body = json.dumps(finite(data), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for sign in "<>&\u2028\u2029":
        body = body.replace(sign, f"\\u{ord(sign):04x}")
    return body


def content_policy(scripts: Iterable[str]) -> str:
    """Nothing may be requested, and no script but these may run, whatever the data hold."""
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'" for s in scripts
    )
    return f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"


def versions() -> dict[str, str]:
    """What made the page."""
    out = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            continue
    return out


def verdict_of(comparison: Part | None, after: Part | None, diagnosis: Part | None) -> dict[str, Any]:
    """Kind (the colour), one plain sentence, the reason, and the figures that matter.

    diagnosis   what Diagnosis or Addition says of itself
    """
    kind = str(diagnosis.get("verdict", "")) if diagnosis is not None else "comparison"
    names = [str(e.get("title") or text.words(e.get("name", ""))) for e in _list(diagnosis, "effects")]
    overall = text.known((comparison or {}).get("overall"))
    if kind == "nothing":
        headline = "Nothing is missing from the model."
    elif kind == "effects":
        headline = lacking(diagnosis, names)
    elif kind == "unknown":
        headline = f"{text.UNKNOWN[_unknown_kind(diagnosis)]}."
    elif kind == "added":
        headline = f"The model has {text.listed(names)} now."
    elif kind != "comparison":
        headline, kind = f"Verdict: {kind or 'none was given'}.", "other"
    elif overall is None:
        headline = (
            "The model beside the measurement; without repeated closures there is no scale to judge it by."
        )
    else:
        headline = (
            f"The model misses the closures by {text.ratio(overall)} times what they differ among themselves."
            if overall > 1.2
            else f"The model follows the closures to {text.ratio(overall)} times what they differ among themselves."
        )
    label = {
        "nothing": "Complete",
        "effects": "Effects found" if len(names) > 1 else "Effect found",
        "unknown": "Unknown effect" if _unknown_kind(diagnosis).startswith("not_") else "Unknown",
        "comparison": "Comparison",
        "added": "Added",
    }.get(kind, "Verdict")
    return {
        "kind": kind if kind in ("nothing", "effects", "unknown") else "other",
        "label": label,
        "headline": headline,
        "summary": str(diagnosis.get("summary", "")) if diagnosis is not None else "",
        "figures": _figures(comparison, after, diagnosis),
    }


def _unknown_kind(diagnosis: Part | None) -> str:
    return str((diagnosis or {}).get("unknown_kind") or "not_in_catalogue")


def lacking(diagnosis: Part | None, titles: Sequence[str]) -> str:
    """What is missing, in a sentence; of tied sets, what they share and what cannot be told apart."""
    if not titles:
        return "The model lacks an effect."
    groups = [[str(n) for n in group] for group in _list(diagnosis, "tied")]
    if len(groups) < 2:
        return f"The model lacks {text.listed(titles)}."
    named = {str(e.get("name")): title for e, title in zip(_list(diagnosis, "effects"), titles, strict=True)}
    shared = [n for n in groups[0] if all(n in group for group in groups)]
    options = [
        " with ".join(named.get(n, text.words(n)) for n in group if n not in shared) for group in groups
    ]
    either = text.listed([o for o in options if o], "or")
    sure = text.listed([named.get(n, text.words(n)) for n in shared])
    if sure:
        return f"The model lacks {sure} and one of these: {either}. The data cannot tell which."
    return f"The model lacks {either}: these data cannot tell which."


def _figures(comparison: Part | None, after: Part | None, diagnosis: Part | None) -> list[dict[str, str]]:
    out = []
    falls = _list(diagnosis, "falls")
    now = after if after is not None else comparison
    in_units = fall_in_units(falls)
    if in_units is not None and len(falls) > 1:
        nearer = before_in_units(errors_in_units(falls)[1]) if len(falls) > WITHOUT_EFFECT else 0
        start, end = in_units["rows"][nearer], in_units["rows"][-1]
        where = "on conditions that were left out of the fit" if in_units["held"] else "of the fit"
        for k, (signal, unit) in enumerate(in_units["signals"][:FIGURES]):
            out.append(
                {
                    "value": f"{text.number(end['values'][k])}\u00a0{unit}".strip(),
                    "was": text.number(start["values"][k]),
                    "label": f"error of {text.words(signal)} {where}; before: {start['label']}",
                }
            )
    elif len(falls) > 1:
        whole = by_conditions(diagnosis)
        key, what = ("held_out_conditions", "conditions") if whole else ("held_out", "closures")
        errors = [text.known(fall.get(key)) for fall in falls]
        nearer = before([math.nan if e is None else e for e in errors])
        first = falls[nearer if len(falls) > WITHOUT_EFFECT else 0]
        out.append(
            {
                "value": text.ratio(falls[-1].get(key)),
                "was": text.ratio(first.get(key)),
                "label": f"error on held-out {what}, in multiples of the repeatability; before: "
                f"{first.get('added', '')}",
            }
        )
    elif now is not None and text.known(now.get("overall")) is None:
        was = (comparison or {}).get("by_signal") or {} if after is not None else {}
        for signal, error in list((now.get("by_signal") or {}).items())[:FIGURES]:
            unit = text.unit(_unit_of(signal, comparison, after))
            out.append(
                {
                    "value": f"{text.number(error)}\u00a0{unit}".strip(),
                    "was": text.number(was[signal]) if signal in was else "",
                    "label": f"error of {text.words(signal)}",
                }
            )
    elif comparison is not None and now is not None:
        out.append(
            {
                "value": text.ratio(now.get("overall")),
                "was": text.ratio(comparison.get("overall")) if after is not None else "",
                "label": "error in multiples of the repeatability",
            }
        )
    cells = _list(comparison, "cells")
    judged = [c for c in cells if text.known(c.get("p_value")) is not None]
    if judged:
        now_cells = [c for c in _list(after, "cells") or cells if text.known(c.get("p_value")) is not None]
        out.append(
            {
                "value": f"{sum(bool(c.get('fails')) for c in now_cells)} of {len(now_cells)}",
                "was": str(sum(bool(c.get("fails")) for c in cells)) if after is not None else "",
                "label": "signals × phases beyond chance (5\u00a0% false discoveries)",
            }
        )
    data = _list(diagnosis, "data") or _list(comparison, "data")
    closures = [text.known(d.get("closures")) for d in data]
    if data and all(n is not None for n in closures):
        conditions = {str(c) for d in data for c in d.get("conditions", [])}
        total = sum(int(n) for n in closures if n is not None)
        out.append(
            {
                "value": str(total),
                "was": "",
                "label": f"{'closure' if total == 1 else 'closures'} of {len(conditions)} "
                f"{'condition' if len(conditions) == 1 else 'conditions'}",
            }
        )
    simulations = text.known((diagnosis or {}).get("simulations"))
    if simulations is not None:
        out.append(
            {
                "value": f"{simulations:,.0f}".replace(",", "\u202f"),
                "was": "",
                "label": "simulations run to find out",
            }
        )
    return out


def fall_in_units(falls: Sequence[Part]) -> dict[str, Any] | None:
    """The error's fall by signal in its unit, where no repeatability is known; None where one is.

    On conditions that were left out of the fit; where there is but one, on those of the fit.
    """
    if not falls or any(text.known(f.get("held_out")) is not None for f in falls):
        return None
    units = {str(e.get("signal")): str(e.get("unit", "")) for f in falls for e in f.get("signals", [])}
    held, steps = errors_in_units(falls)
    signals = [s for s in units if not held or s in steps[-1]]
    rows: list[dict[str, Any]] = []
    for k, (fall, errors) in enumerate(zip(falls, steps, strict=True)):
        values = [text.known(errors.get(s)) for s in signals]
        added = str(fall.get("added", ""))
        label, kind = step_name(k, text.words(added)), "before" if k < WITHOUT_EFFECT else "after"
        rows.append({"label": label, "kind": kind, "values": values})
    if not signals:
        return None
    largest = [max((r["values"][k] or 0.0 for r in rows), default=0.0) for k in range(len(signals))]
    for row in rows:
        row["widths"] = [
            round(100.0 * (v or 0.0) / top, 2) if top else 0.0
            for v, top in zip(row["values"], largest, strict=True)
        ]
    return {"held": held, "signals": [(s, text.unit(units[s])) for s in signals], "rows": rows}


def by_conditions(diagnosis: Part | None) -> bool:
    """Whether the error on conditions that were left out decided, and not that on closures."""
    return bool((diagnosis or {}).get("greedy"))


def error_fall(diagnosis: Part | None) -> dict[str, Any] | None:
    """Bars of the error, step by step, on one scale: places in percent of the track."""
    falls = _list(diagnosis, "falls")
    if not falls:
        return None
    in_units = fall_in_units(falls)
    conditions = list(dict.fromkeys(str(c) for f in falls for c in f.get("by_condition", {})))
    values = [
        v
        for f in falls
        for v in map(text.known, (f.get("train"), f.get("held_out"), *f.get("by_condition", {}).values()))
        if v and v > 0.0
    ]
    low, high = min([1.0, *values]), max([1.0, *values])
    log = high / low >= DECADES
    start, stop = (low / 1.5, high * 1.15) if log else (0.0, high * 1.08)

    def place(value: Any) -> float | None:
        v = text.known(value)
        if v is None or v <= 0.0:
            return None
        part = math.log(v / start) / math.log(stop / start) if log else (v - start) / (stop - start)
        return round(100.0 * min(1.0, max(0.0, part)), 2)

    rows = []
    for k, fall in enumerate(falls):
        added = str(fall.get("added", ""))
        by_condition = fall.get("by_condition", {})
        rows.append(
            {
                "label": step_name(k, text.words(added)),
                "kind": "before" if k < WITHOUT_EFFECT else "after",
                "train": fall.get("train"),
                "held_out": fall.get("held_out"),
                "train_at": place(fall.get("train")),
                "held_out_at": place(fall.get("held_out")),
                "held_out_conditions": fall.get("held_out_conditions"),
                "held_out_conditions_at": place(fall.get("held_out_conditions")),
                "fitted": k > 0,
                "dots": [
                    {"condition": c, "value": by_condition.get(c), "at": place(by_condition.get(c))}
                    for c in conditions
                ],
            }
        )
    signals = list(
        dict.fromkeys(
            (str(s.get("condition")), str(s.get("signal")), str(s.get("unit", "")))
            for f in falls
            for s in f.get("signals", [])
        )
    )
    table: list[dict[str, Any]] = []
    for c, s, u in signals:
        steps: list[Part] = [
            next((e for e in f.get("signals", []) if (e.get("condition"), e.get("signal")) == (c, s)), {})
            for f in falls
        ]
        table.append({"condition": c, "signal": s, "unit": u, "steps": steps})
    marks = text.log_ticks(start, stop) if log else text.ticks(start, stop)
    return {
        "in_units": in_units,
        "by_conditions": by_conditions(diagnosis),
        "rows": rows,
        "log": log,
        "floor": place(1.0),
        "conditions": conditions,
        "table": table,
        "ticks": [{"at": place(v) or 0.0, "label": tick_text(v)} for v in marks],
    }


def overlay_groups(comparison: Part | None, after: Part | None) -> list[dict[str, Any]]:
    """Overlays by condition, each beside its counterpart of the model after."""
    overlays = _list(comparison, "overlays")
    later = _occurrences(_list(after, "overlays"))
    errors, errors_later = _occurrences(_list(comparison, "errors")), _occurrences(_list(after, "errors"))
    groups: dict[str, list[dict[str, Any]]] = {}
    for key, k in _occurrences(overlays).items():
        overlay, j = overlays[k], later.get(key)
        before = _list(comparison, "errors")[errors[key]] if key in errors else {}
        now = _list(after, "errors")[errors_later[key]] if key in errors_later else None
        groups.setdefault(key[0], []).append(
            {
                "index": k,
                "after": j,
                "signal": key[1],
                "unit": str(overlay.get("unit", "")),
                "before_error": before,
                "after_error": now,
                "scaled": any(text.known((e or {}).get("ratio")) is not None for e in (before, now)),
                "svg": overlay_svg(overlay, _list(after, "overlays")[j] if j is not None else None),
            }
        )
    return [{"condition": name, "panels": panels} for name, panels in groups.items()]


def failure_maps(comparison: Part | None, after: Part | None) -> list[dict[str, Any]]:
    """Condition x signal x phase, of the model before and after; columns are the phases that occur."""
    cells = _list(comparison, "cells")
    names = list(dict.fromkeys(str(c.get("phase", "")) for c in cells))
    phases = [p for p in PHASES if p in names] + [p for p in names if p not in PHASES]
    out = []
    for kind, source in (("before", cells), ("after", _list(after, "cells"))):
        if not source:
            continue
        by = {(str(c.get("condition")), str(c.get("signal")), str(c.get("phase"))): c for c in source}
        groups: dict[str, dict[str, list[Any]]] = {}
        for condition, signal, _ in by:
            groups.setdefault(condition, {})[signal] = [
                {**by[condition, signal, p], "heat": heat(by[condition, signal, p].get("ratio"))}
                if (condition, signal, p) in by
                else None
                for p in phases
            ]
        out.append(
            {
                "kind": kind,
                "phases": phases,
                "groups": groups,
                "cells": source,
                "fails": sum(bool(c.get("fails")) for c in source),
                "judged": sum(text.known(c.get("p_value")) is not None for c in source),
                "scaled": any(text.known(c.get("ratio")) is not None for c in source),
            }
        )
    return out


def heat(value: Any) -> float | None:
    """0..1 on a logarithmic scale from the repeatability to HOT times it."""
    v = text.known(value)
    if v is None:
        return None
    return round(min(1.0, max(0.0, math.log(v) / math.log(HOT))), 3) if v > 0.0 else 0.0


def dependences(comparison: Part | None, after: Part | None, diagnosis: Part | None) -> dict[str, Any] | None:
    """What the residual depends on: curves of the model before and after on common axes."""
    found = bool(_list(diagnosis, "effects"))
    before = (comparison or (diagnosis if not found else None) or {}).get("depends_on") or {}
    later = ((diagnosis if found else after) or {}).get("depends_on") or {}
    rows = []
    for name in dict.fromkeys([*before, *later]):
        sources = [(kind, s[name]) for kind, s in (("before", before), ("after", later)) if name in s]
        curves = [
            (kind, [text.known(v) for v in d.get("centres", [])], [text.known(v) for v in d.get("curve", [])])
            for kind, d in sources
        ]
        signal = str(sources[0][1].get("signal", ""))
        signal_unit = _unit_of(signal, comparison, after)
        xs = [v for _, x, _ in curves for v in x if v is not None]
        ys = [v for _, _, y in curves for v in y if v is not None]
        steps = name == "direction"
        clearest = max((d for _, d in sources), key=lambda d: text.known(d.get("share")) or 0.0)
        at, unit = text.known(clearest.get("at")), str(clearest.get("unit", ""))
        where = "" if at is None else f", {text.number(at, 2)} {text.unit(unit)}"
        rows.append(
            {
                "name": name,
                "where": where,
                "signal": signal,
                "unit": f"{signal_unit}/({unit}/s2)" if name == INERTIA else signal_unit,
                "variable_unit": unit,
                "shares": {kind: d.get("share") for kind, d in sources},
                "svg": curve_svg(curves, steps=steps) if len(xs) > 1 else None,
                "ends": _ends(name, xs, unit),
                "top": max([0.0, *ys]),
                "bottom": min([0.0, *ys]),
            }
        )
    if not rows:
        return None
    key = "after" if later else "before"
    rows.sort(key=lambda r: -(text.known(r["shares"].get(key)) or 0.0))
    strongest = [r for r in rows if (text.known(r["shares"].get(key)) or 0.0) >= 0.05][:3]
    return {
        "rows": rows,
        "signal": rows[0]["signal"],
        "kinds": [k for k, s in (("before", before), ("after", later)) if s],
        "strongest": [(text.words(r["name"]) + r["where"], r["shares"][key]) for r in strongest],
    }


def _ends(name: str, xs: Sequence[float], unit: str) -> list[str]:
    """What to write below a curve: its ends, or the groups' names."""
    if name == "direction":
        return ["position falls", "stands", "rises"]
    if name == "time":
        return ["first closure", "last"]
    if not xs:
        return []
    return [text.number(min(xs), 2), f"{text.number(max(xs), 2)} {text.unit(unit)}".strip()]


def effects(diagnosis: Part | None) -> list[dict[str, Any]]:
    """The effects of the verdict, parameters with intervals on a power of ten that suits them."""
    out = []
    for effect in _list(diagnosis, "effects"):
        parameters = [
            {
                "name": name,
                "unsure": text.unsure(p.get("identified", True), p.get("at_end", False)),
                **text.interval(p.get("value"), p.get("low"), p.get("high"), p.get("unit", "")),
            }
            for name, p in effect.get("parameters", {}).items()
        ]
        out.append(
            {
                "name": str(effect.get("name", "")),
                "title": effect.get("title") or text.words(effect.get("name", "")),
                "source": effect.get("source"),
                "why": effect.get("why", ""),
                "parameters": parameters,
            }
        )
    return out


def tied(diagnosis: Part | None) -> list[str]:
    """Sets of effects that fit equally well; empty if there is one only."""
    groups = [" + ".join(text.words(n) for n in names) for names in _list(diagnosis, "tied")]
    return groups if len(groups) > 1 else []


def ranking(diagnosis: Part | None) -> dict[str, Any] | None:
    """Every effect alone: the share of the excess misfit that it explains, and what is left in multiples of chance."""
    rows = _list(diagnosis, "ranking")
    if diagnosis is None or not rows:
        return None
    critical, nominal = (
        text.known((diagnosis.get("costs") or {}).get(k)) for k in ("critical_nominal", "nominal_fitted")
    )
    found = {str(e.get("name")) for e in _list(diagnosis, "effects")}
    excess = has_excess(diagnosis.get("costs") or {}, bool(found))
    out = []
    for row in rows:
        left, share = text.known(row.get("misfit")), text.known(row.get("explained")) if excess else None
        out.append(
            {
                "label": " + ".join(text.words(n) for n in row.get("names", [])),
                "misfit": left,
                "explained": share,
                "of_chance": left / critical if left is not None and critical else None,
                "width": round(100.0 * min(1.0, max(0.0, share or 0.0)), 2),
                "found": set(row.get("names", [])) <= found and bool(found),
            }
        )
    out.sort(key=lambda row: -(text.known(row["explained"]) or 0.0))
    return {
        "first": out[:RANKS],
        "rest": out[RANKS:],
        "critical": critical,
        "draws": (diagnosis.get("chance") or {}).get("draws"),
        "excess": excess,
        "nominal": nominal / critical if nominal is not None and critical else None,
    }


def metric_groups(comparison: Part | None, after: Part | None) -> list[dict[str, Any]]:
    """The thesis' figures by condition, measured beside the model before and after."""
    later = {(m.get("condition"), m.get("name")): m for m in _list(after, "metrics")}
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in _list(comparison, "metrics"):
        now = later.get((row.get("condition"), row.get("name")))
        groups.setdefault(str(row.get("condition", "")), []).append(
            {"before": row, "after": now, "off_before": _off(row), "off_after": now is not None and _off(now)}
        )
    return [{"condition": name, "rows": rows} for name, rows in groups.items()]


def _off(metric: Part) -> bool:
    """Whether the model's figure is more than two standard deviations of the closures away."""
    measured, sd, model = (text.known(metric.get(k)) for k in ("measured", "sd", "model"))
    if measured is None or sd is None or model is None:
        return False
    return abs(measured - model) > max(2.0 * sd, 1e-9 * abs(measured))


def nuisances(diagnosis: Part | None) -> dict[str, Any] | None:
    """How far the fit moved the nominal parameters, in standard deviations of their priors; farthest first."""
    table = (diagnosis or {}).get("nuisances") or {}
    rows = []
    for name, row in table.items():
        z = text.known(row.get("prior_sds"))
        rows.append(
            {
                "name": name,
                "z": z,
                **{k: row.get(k) for k in ("value", "nominal", "low", "high")},
                "unit": str(row.get("unit", "")),
            }
        )
    if not rows:
        return None
    rows.sort(key=lambda r: -abs(r["z"] or 0.0))
    span = max(4.0, *(math.ceil(abs(r["z"] or 0.0)) for r in rows))
    for row in rows:
        row["at"] = None if row["z"] is None else round(50.0 + 50.0 * row["z"] / span, 2)
        row["far"] = row["z"] is not None and abs(row["z"]) > 2.0
    step = max(1, math.ceil(span / 4.0)) if span > 4.0 else 2
    marks = [k for k in range(-int(span), int(span) + 1) if k % step == 0]
    return {
        "rows": rows,
        "usual": [50.0 - 100.0 / span, 200.0 / span],
        "ticks": [
            {"at": 50.0 + 50.0 * k / span, "label": text.minus(f"{k:+d}" if k else "0")} for k in marks
        ],
    }


def _model_names(comparison: Part | None, after: Part | None, diagnosis: Part | None) -> tuple[str, str]:
    if comparison is None:
        return "", ""
    state = "own parameters fitted" if comparison.get("fitted") else "as given"
    added = [str(e.get("title") or text.words(e.get("name", ""))) for e in _list(diagnosis, "effects")]
    return state, f"with {' + '.join(added)}" if added else "refitted" if after is not None else ""


def _models(comparison: Part | None, after: Part | None, diagnosis: Part | None) -> list[dict[str, str]]:
    """The models with what was added to each; one row for those that are the same."""
    added = "".join(f" + {e.get('name', '')}" for e in _list(diagnosis, "effects"))
    rows = [
        ("before" if after is not None else "compared", comparison, ""),
        ("diagnosed", diagnosis, ""),
        ("after", after, added),
    ]
    out: list[dict[str, str]] = []
    for role, part, more in rows:
        model = (part or {}).get("model") or {}
        name, sha256 = str(model.get("name", "")), str(model.get("sha256", ""))
        same = next((m for m in out if sha256 and m["sha256"] == sha256), None)
        if same is not None:
            same["role"] += f", {role}"
        elif name or sha256:
            out.append({"role": role, "name": name + more, "sha256": sha256})
    return out


def _unit_of(signal: str, *parts: Part | None) -> str:
    rows = (row for part in parts for row in _list(part, "errors"))
    return next((str(row.get("unit", "")) for row in rows if row.get("signal") == signal), "")


def _occurrences(rows: Sequence[Part]) -> dict[tuple[str, str, int], int]:
    """Place of every row by condition, signal and which of those (two recordings may share a condition's name)."""
    seen: Counter[tuple[str, str]] = Counter()
    out = {}
    for k, row in enumerate(rows):
        key = (str(row.get("condition", "")), str(row.get("signal", "")))
        out[*key, seen[key]] = k
        seen[key] += 1
    return out


def _list(part: Part | None, key: str) -> list[Any]:
    value = (part or {}).get(key)
    return list(value) if isinstance(value, list | tuple) else []


def _asset(name: str) -> str:
    return (HERE / "static" / name).read_text(encoding="utf-8")
