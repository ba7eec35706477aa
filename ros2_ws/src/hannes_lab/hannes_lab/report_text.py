"""Numbers, units and names as people read them: sensible digits, a dash for what is not known."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

DASH = "–"
_SUPERSCRIPT = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")

UNKNOWN = {
    "not_in_catalogue": "Something is missing that is not in the catalogue",
    "not_looked_for": "Something is missing that is not one of those that were looked for",
    "not_foretold": "Something is missing, and these conditions cannot tell what",
    "model_or_effect": "Something is missing, or the nominal model is not that of this machine",
    "no_repeats": "Whether something is missing cannot be told",
}
"""What is said first of each kind of "unknown" (`Diagnosis.unknown_kind`).

Where conditions do not foretell one another, an effect may explain most of them all and yet not be borne out
(`not_foretold`); nobody can tell another machine's model from an effect; the last is where nothing was repeated, and
nothing brings what was left out nearer, or where something was recorded once and is missed by more than the rest
repeats.
"""


def unsure(identified: bool, at_end: bool) -> str:
    """What is to be said of an estimate that the data do not tell; empty if they do."""
    return "" if identified else "at the end of its range" if at_end else "not identified by these data"


NO_FINDING = "These effects come nearest. They are no finding, whatever their intervals: more is missing."


def known(value: Any) -> float | None:
    """The value as a float; None for what is no finite number (None, NaN, infinity, a text)."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def minus(text: str) -> str:
    """With the minus sign that is as wide as the plus."""
    return text.replace("-", "−")


def superscript(exponent: int) -> str:
    """A power of ten as people write it: -3 -> 10⁻³."""
    return "10" + str(exponent).translate(_SUPERSCRIPT)


def decimals(value: float, digits: int) -> int:
    """Decimals that show `digits` significant digits of the value; negative where it has more integer digits."""
    return digits - 1 - math.floor(math.log10(abs(value))) if value else 0


def fixed(value: float, places: int) -> str:
    """The value with a number of decimals; no minus sign before zero."""
    text = f"{round(value, places):.{max(0, places)}f}"
    return minus(text.removeprefix("-") if float(text) == 0.0 else text)


def number(value: Any, digits: int = 3) -> str:
    """A number with some significant digits; a power of ten only where the zeros would be too many to count."""
    v = known(value)
    if v is None:
        return DASH
    if v == 0.0:
        return "0"
    if not 1e-4 <= abs(v) < 10.0 ** max(5, digits):
        exponent = math.floor(math.log10(abs(v)))
        return f"{fixed(v / 10.0**exponent, digits - 1)} × {superscript(exponent)}"
    return fixed(v, max(0, decimals(v, digits)))


def ratio(value: Any) -> str:
    """A multiple of the repeatability: two decimals below ten, none from a hundred on."""
    v = known(value)
    if v is None:
        return DASH
    return fixed(v, 2 if abs(v) < 9.995 else 1 if abs(v) < 99.95 else 0)


def percent(value: Any, places: int = 0) -> str:
    """A part of one in percent; what is not quite all or nothing is not rounded to it."""
    v = known(value)
    if v is None:
        return DASH
    if 0.0 < v < 0.5 * 10.0 ** (-2 - places):
        return f"< {fixed(10.0**-places, places)}\u00a0%"
    if 1.0 - 0.5 * 10.0 ** (-2 - places) < v < 1.0:
        return f"> {fixed(100.0 - 10.0**-places, places)}\u00a0%"
    return f"{fixed(100.0 * v, places)}\u00a0%"


def relative_error(metric: Mapping[str, Any]) -> str:
    """That of a figure of the thesis: in percent, in words where it is many times too large, unknown beside nothing."""
    if not metric.get("nonzero", True):
        return DASH
    return str(metric.get("many_times") or "").replace(" x ", "\u00a0× ") or signed_percent(
        metric.get("relative_error_percent")
    )


def signed_percent(value: Any) -> str:
    """A relative error that is in percent already, with its sign."""
    v = known(value)
    if v is None:
        return DASH
    text = fixed(v, 1 if abs(v) < 99.95 else 0)
    return f"{'+' if v > 0 and text.strip('0.') else ''}{text}\u00a0%"


def plus_minus(value: Any, sd: Any, digits: int = 3) -> str:
    """Mean and standard deviation, rounded to the second digit of the standard deviation."""
    v, s = known(value), known(sd)
    if v is None:
        return DASH
    if s is None:
        return number(v, digits)
    if s <= 1e-9 * abs(v):
        return f"{number(v, digits)} ± 0"
    places = decimals(s, 2)
    if not 0 <= places <= 6:
        return f"{number(v, digits)} ± {number(s, 2)}"
    return f"{fixed(v, places)} ± {fixed(s, places)}"


def unit(text: Any) -> str:
    """N.m/rad3 -> N·m/rad³; nothing for a number without a dimension."""
    if str(text) == "1":
        return ""
    return re.sub(
        r"(?<=[A-Za-z])(-?\d+)", lambda m: m.group(1).translate(_SUPERSCRIPT), str(text).replace(".", "·")
    )


def interval(value: Any, low: Any, high: Any, unit_text: Any) -> dict[str, str]:
    """A value and its interval on one power of ten, which joins the unit, so that the digits stand in line.

    Digits reach to the second one of the interval's half width.
    """
    v, a, b = known(value), known(low), known(high)
    pretty = unit(unit_text)
    if v is None:
        return {"value": DASH, "low": DASH, "high": DASH, "unit": pretty}
    largest = max(abs(x) for x in (v, a or 0.0, b or 0.0))
    exponent = 0
    if largest > 0.0 and not 0.01 <= largest < 1e4:
        exponent = 3 * math.floor(math.log10(largest) / 3.0)
    scale = 10.0**exponent
    half = (b - a) / 2.0 / scale if a is not None and b is not None else 0.0
    places = min(6, max(0, decimals(half, 2))) if half > 0.0 else max(0, decimals(v / scale, 4))
    return {
        "value": fixed(v / scale, places),
        "low": DASH if a is None else fixed(a / scale, places),
        "high": DASH if b is None else fixed(b / scale, places),
        "unit": f"{superscript(exponent)} {pretty}".strip() if exponent else pretty,
    }


def words(name: Any) -> str:
    """A field's name as words: motor_current -> motor current."""
    return str(name).replace("_", " ")


def shortened(sentence: str, most: int) -> str:
    """The beginning of a sentence, whole words of at most so many characters, with dots where it goes on."""
    return sentence if len(sentence) <= most else f"{sentence[:most].rsplit(None, 1)[0].rstrip(',;:')} …"


def listed(texts: Sequence[str], last: str = "and") -> str:
    """a, b and c."""
    if len(texts) < 2:
        return "".join(texts)
    return f"{', '.join(texts[:-1])} {last} {texts[-1]}"


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Round values between two ends of a linear scale."""
    span = high - low
    if not (math.isfinite(span) and span > 0.0):
        return [low] if math.isfinite(low) else []
    raw = span / max(1, most)
    base = 10.0 ** math.floor(math.log10(raw))
    step = next(m * base for m in (1.0, 2.0, 5.0, 10.0) if m * base >= raw * (1.0 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def log_ticks(low: float, high: float, most: int = 7) -> list[float]:
    """1, 2, 5 or 1, 3 or powers of ten between two ends of a logarithmic scale, as many as fit."""
    first, last = math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 1
    for steps in ((1.0, 2.0, 5.0), (1.0, 3.0), (1.0,)):
        out = [m * 10.0**k for k in range(first, last) for m in steps if low <= m * 10.0**k <= high]
        if len(out) <= most:
            break
    return out
