"""How a command shows its results: text and tables for people, JSON for programs."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

TEXT_WIDTH = 110
"""Columns of text where the output is no terminal."""

PIPED_WIDTH = 200
"""Columns of a table there: whole lines, for `grep`."""

GAP = 2
"""Blanks between two columns."""


def print_json(result: Any) -> None:
    """Print as JSON; NaN and infinity, which JSON has not, become null."""
    json.dump(finite(result), sys.stdout, indent=2, ensure_ascii=False, allow_nan=False)
    sys.stdout.write("\n")


def finite(value: Any) -> Any:
    """The same data in plain dicts and lists, with None for the numbers that JSON cannot say."""
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def number(value: float | None, digits: int = 4) -> str:
    """A number for a table or a sentence; a dash where there is none."""
    return "-" if value is None or not math.isfinite(value) else f"{value + 0.0:.{digits}g}"  # -0 is 0


def with_unit(value: float, unit: str, digits: int = 4) -> str:
    """A number with its unit; one without a dimension alone."""
    return number(value, digits) if unit in ("", "1") else f"{number(value, digits)} {unit}"


def between(low: float, high: float, digits: int = 4) -> str:
    """A range, or one number where its ends read the same."""
    return " .. ".join(dict.fromkeys((number(low, digits), number(high, digits))))


def estimate(value: float, low: float | None, high: float | None, unit: str) -> tuple[str, str]:
    """A value with its unit, and its interval, with two digits of the interval's half width and four at least."""
    digits = 4
    if low is not None and high is not None and math.isfinite(low) and math.isfinite(high) and low < high:
        largest, half = max(abs(low), abs(high)), 0.5 * (high - low)
        digits = min(8, max(digits, 2 + math.floor(math.log10(largest)) - math.floor(math.log10(half))))
    return with_unit(value, unit, digits), f"{number(low, digits)} .. {number(high, digits)}"


def text_console(width: int | None = None) -> Console:
    """Where text is printed: as wide as the terminal, or TEXT_WIDTH; brackets in names are brackets."""
    return Console(
        width=width or (None if sys.stdout.isatty() else TEXT_WIDTH), highlight=False, markup=False
    )


def show_table(table: Table, whole: int) -> None:
    """Print a table, where the terminal is narrower, as wide as it needs to be, but at most `whole` columns."""
    to = text_console()
    needed = Measurement.get(to, to.options.update(max_width=1000), table).maximum
    text_console(max(to.width, min(needed, whole))).print(table)


def print_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[object]], right: Sequence[int] = ()
) -> None:
    """Print a table: its sentences are folded where it is wider than the terminal, but no number or name is cut.

    right  indices of the columns that are aligned there
    """
    texts = [["" if cell is None else str(cell) for cell in row] for row in rows]
    cells = [[column, *(row[k] for row in texts)] for k, column in enumerate(columns)]
    least = [max(cell_len(word) for cell in column for word in cell.split(" ")) for column in cells]
    widths = [max(map(cell_len, column)) for column in cells]
    room = (text_console().width if sys.stdout.isatty() else PIPED_WIDTH) - GAP * (len(columns) - 1)
    while sum(widths) > room and widths != least:
        widest = max((k for k, width in enumerate(widths) if width > least[k]), key=widths.__getitem__)
        widths[widest] -= 1
    table = Table(title=title or None, title_justify="left", box=None, pad_edge=False, header_style="bold")
    for k, (column, width) in enumerate(zip(columns, widths, strict=True)):
        table.add_column(column, justify="right" if k in right else "left", width=width)
    for row in texts:
        table.add_row(*row)
    text_console(max(sum(widths) + GAP * len(columns), len(title))).print(table)
