"""Curves as SVG, drawn without a browser's help: what the report shows on paper and where scripts do not run.

All colours come from the page's style sheet by class, all texts are numbers made here or escaped by Markup.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from markupsafe import Markup

from .report_text import known, number, ticks

Values = Sequence[float | None]

LEFT, RIGHT, TOP, GAP, BOTTOM = 46.0, 8.0, 20.0, 16.0, 22.0
"""Margins of the overlay's plots, in the units of its view box."""

WIDTH, MAIN, RESIDUAL = 440.0, 170.0, 74.0


class Scale:
    """From values to places on one axis: `span` of values onto `place`; a span of nothing is widened."""

    def __init__(self, values: Values, first: float, last: float, margin: float = 0.05) -> None:
        finite = [v for v in values if v is not None]
        low, high = (min(finite), max(finite)) if finite else (0.0, 1.0)
        pad = margin * (high - low) if high > low else (0.1 * abs(high) or 1.0)
        if margin or high <= low:
            low, high = low - pad, high + pad
        self.low, self.high, self.first, self.last = low, high, first, last

    def __call__(self, value: float) -> float:
        return self.first + (value - self.low) / (self.high - self.low) * (self.last - self.first)


def series(source: Mapping[str, Any], name: str) -> list[float | None]:
    """A list of numbers of an overlay; what is no finite number becomes None."""
    values = source.get(name)
    return [known(v) for v in values] if isinstance(values, list | tuple) else []


def difference(a: Values, b: Values) -> list[float | None]:
    """A - b, None where either is not known."""
    return [None if x is None or y is None else x - y for x, y in zip(a, b, strict=False)]


def at_times(times: Values, values: Values, wanted: Values) -> list[float | None]:
    """Values between samples, by straight lines; None outside and beside unknown samples."""
    if list(times) == list(wanted):
        return list(values)
    known_ = [(t, v) for t, v in zip(times, values, strict=False) if t is not None and v is not None]
    out: list[float | None] = []
    for w in wanted:
        after = next((k for k, (t, _) in enumerate(known_) if w is not None and t >= w), None)
        if w is None or after is None or (after == 0 and known_[0][0] > w):
            out.append(None)
        elif known_[after][0] == w:
            out.append(known_[after][1])
        else:
            (t0, v0), (t1, v1) = known_[after - 1], known_[after]
            out.append(v0 + (v1 - v0) * (w - t0) / (t1 - t0))
    return out


def path(xs: Values, ys: Values, x: Scale, y: Scale) -> str:
    """The d attribute of a broken line; a new start after every gap."""
    parts, pen = [], "M"
    for a, b in zip(xs, ys, strict=False):
        if a is None or b is None:
            pen = "M"
            continue
        parts.append(f"{pen}{x(a):.1f} {y(b):.1f}")
        pen = "L"
    return "".join(parts)


def area(xs: Values, low: Values, high: Values, x: Scale, y: Scale) -> str:
    """The d attribute of a band."""
    inside = [
        (a, b, c)
        for a, b, c in zip(xs, low, high, strict=False)
        if a is not None and b is not None and c is not None
    ]
    if not inside:
        return ""
    there = [f"{x(a):.1f} {y(c):.1f}" for a, _, c in inside]
    back = [f"{x(a):.1f} {y(b):.1f}" for a, b, _ in reversed(inside)]
    return f"M{'L'.join(there + back)}Z"


def runs(labels: Sequence[str], times: Values) -> list[tuple[str, float, float]]:
    """Stretches of one phase: name, start, stop; borders lie half way between samples."""
    n = min(len(labels), len(times))
    out, k = [], 0
    for name, group in groupby(labels[:n]):
        stop = k + len(list(group))
        ends = [times[max(k - 1, 0)], times[k], times[stop - 1], times[min(stop, n - 1)]]
        if all(t is not None for t in ends):
            a, b, c, d = (float(t) for t in ends if t is not None)
            out.append((str(name), (a + b) / 2.0, (c + d) / 2.0))
        k = stop
    return out


def overlay_svg(overlay: Mapping[str, Any], after: Mapping[str, Any] | None) -> Markup:
    """Closures and models over time, the residuals below."""
    t = series(overlay, "time")
    measured, low, high = (series(overlay, name) for name in ("measured", "low", "high"))
    models = [("before", series(overlay, "model"))]
    if after is not None:
        models.append(("after", at_times(series(after, "time"), series(after, "model"), t)))
    x = Scale(t, LEFT, WIDTH - RIGHT, 0.0)
    y = Scale([*measured, *low, *high, *(v for _, m in models for v in m)], TOP + MAIN, TOP)
    lower = TOP + MAIN + GAP
    residuals = [(name, difference(measured, m)) for name, m in models]
    spread = [(difference(low, measured)), difference(high, measured)]
    r = Scale([*spread[0], *spread[1], *(v for _, m in residuals for v in m)], lower + RESIDUAL, lower)
    bottom = lower + RESIDUAL
    out = [
        Markup('<svg class="static-plot" viewBox="0 0 {:g} {:g}" aria-hidden="true">').format(
            WIDTH, bottom + BOTTOM
        )
    ]
    for name, start, stop in runs([str(p) for p in overlay.get("phase", [])], t):
        a, b = x(start), x(stop)
        out.append(
            Markup('<rect class="phase phase-{}" x="{:.1f}" y="{}" width="{:.1f}" height="{}"/>').format(
                phase_class(name), a, TOP, b - a, bottom - TOP
            )
        )
        if b - a > 34.0:
            out.append(
                Markup('<text x="{:.1f}" y="{}" class="phase-name">{}</text>').format(
                    (a + b) / 2.0, TOP - 6.0, name
                )
            )
    for scale in (y, r):
        for value in ticks(scale.low, scale.high, 5 if scale is y else 3):
            out.append(
                Markup(
                    '<line class="grid" x1="{}" x2="{}" y1="{:.1f}" y2="{:.1f}"/>'
                    '<text class="tick-y" x="{}" y="{:.1f}">{}</text>'
                ).format(
                    LEFT,
                    WIDTH - RIGHT,
                    scale(value),
                    scale(value),
                    LEFT - 5.0,
                    scale(value) + 3.5,
                    tick_text(value),
                )
            )
    for value in ticks(x.low, x.high, 5):
        out.append(
            Markup('<text class="tick-x" x="{:.1f}" y="{}">{}</text>').format(
                x(value), bottom + 15.0, tick_text(value)
            )
        )
    out.append(Markup('<text class="tick-x" x="{}" y="{}">s</text>').format(WIDTH - RIGHT, bottom + 15.0))
    lines = [("band", area(t, low, high, x, y)), ("measured", path(t, measured, x, y))]
    lines += [(name, path(t, m, x, y)) for name, m in models]
    lines += [("band", area(t, spread[0], spread[1], x, r))]
    lines += [(name, path(t, m, x, r)) for name, m in residuals]
    out += [Markup('<path class="line-{}" d="{}"/>').format(name, d) for name, d in lines if d]
    out.append(Markup("</svg>"))
    return Markup("").join(out)


STANDING = 1e-3
"""rad/s below which the machine stands, as in the dependences."""

PHASE_NAMES = ("void", "grasp", "hold", "opening", "rest")


def phase_class(name: str) -> str:
    """A class of the style sheet: data choose among these and cannot bring their own."""
    return name if name in PHASE_NAMES else "other"


def tick_text(value: float) -> str:
    """A tick's label: no zeros behind the decimals."""
    if abs(value) < 1e-12:
        return "0"
    text = number(value, 4)
    return text.rstrip("0").rstrip(".") if "." in text and "×" not in text else text


def curve_svg(
    curves: Sequence[tuple[str, Sequence[float | None], Sequence[float | None]]], *, steps: bool
) -> Markup:
    """Small curves of residual against a variable; stretched by the page, so lines only, no text.

    curves  (class, centres, values); steps: velocities stand for directions, one bar each
    """
    width, height = 200.0, 90.0
    y = Scale([0.0, *(v for _, _, ys in curves for v in ys)], height - 6.0, 6.0, 0.0)
    x = Scale([v for _, xs, _ in curves for v in xs], 6.0, width - 6.0, 0.0)
    zero = y(0.0)
    out = [
        Markup(
            '<svg class="curve" viewBox="0 0 {:g} {:g}" preserveAspectRatio="none" aria-hidden="true">'
            '<line class="zero" x1="0" x2="{:g}" y1="{:.1f}" y2="{:.1f}"/>'
        ).format(width, height, width, zero, zero)
    ]
    for k, (name, xs, ys) in enumerate(curves):
        points = [(a, b) for a, b in zip(xs, ys, strict=False) if a is not None and b is not None]
        if steps:
            # One bar a direction: down, standing, up stand at thirds of the width.
            for a, b in points:
                third = 0 if a < -STANDING else 2 if a > STANDING else 1
                at = width * (third + 0.5) / 3.0 + 12.0 * (k - (len(curves) - 1) / 2.0)
                out.append(
                    Markup('<path class="bar-{}" d="M{:.1f} {:.1f}V{:.1f}"/>').format(name, at, zero, y(b))
                )
            continue
        out.append(Markup('<path class="line-{}" d="{}"/>').format(name, path(xs, ys, x, y)))
        # A line of no length with round caps stays round however the picture is stretched.
        out += [
            Markup('<path class="dot-{}" d="M{:.1f} {:.1f}h.01"/>').format(name, x(a), y(b))
            for a, b in points
        ]
    out.append(Markup("</svg>"))
    return Markup("").join(out)
