"""What a row of the validation is: figures with the desired value, the thesis' model and ours."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hannes_description.output import number

Progress = Callable[[int, int, str], None]
"""Called with steps done, steps in all, and what is going on."""


def silent(done: int, total: int, text: str) -> None:
    """No progress."""


@dataclass(frozen=True)
class Figure:
    """One number of a row.

    desired   the real hand's or the analytic value, in unit; NaN where there is none
    thesis    what the thesis' own model gave; NaN where it gave nothing
    ours      what this model gives
    kind      how it is judged: `value` by the relative error, `at_most` and `at_least` by desired as a limit
    limit     largest relative error allowed (0.005 = 0.5 %), None: being closer than the thesis is what is asked
    role      fitted (the calibration saw it), predicted (it did not), computed (no free parameter enters)
    """

    row: str
    name: str
    unit: str
    desired: float
    thesis: float
    ours: float
    kind: str = "value"
    limit: float | None = None
    role: str = "computed"
    note: str = ""

    @property
    def thesis_error(self) -> float:
        """Relative error of the thesis' model, percent (P22: (desired - model) / desired x 100)."""
        return relative(self.desired, self.thesis) if self.kind == "value" else math.nan

    @property
    def error(self) -> float:
        """Relative error of this model, percent."""
        return relative(self.desired, self.ours) if self.kind == "value" else math.nan

    @property
    def closer(self) -> bool | None:
        """Closer to the desired value than the thesis' model; None where there is nothing to be closer than."""
        if self.kind != "value" or not (math.isfinite(self.thesis_error) and math.isfinite(self.error)):
            return None
        return abs(self.error) < abs(self.thesis_error)

    @property
    def met(self) -> bool:
        """The target is reached."""
        if not math.isfinite(self.ours):
            return False
        if self.kind == "at_most":
            return self.ours <= self.desired
        if self.kind == "at_least":
            return self.ours >= self.desired
        if self.limit is not None:
            return abs(self.error) <= 100.0 * self.limit
        return bool(self.closer)

    def to_dict(self) -> dict[str, Any]:
        names = (
            "row",
            "name",
            "unit",
            "desired",
            "thesis",
            "thesis_error",
            "ours",
            "error",
            "closer",
            "met",
            "kind",
            "limit",
            "role",
            "note",
        )
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class Section:
    """A group of rows: its figures, what must be said about them, and the curves for its pictures.

    curves  plain arrays by name; not part of the JSON
    """

    rows: tuple[str, ...]
    title: str
    figures: tuple[Figure, ...]
    notes: tuple[str, ...] = ()
    curves: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def to_dict(self) -> dict[str, Any]:
        return {
            "rows": list(self.rows),
            "title": self.title,
            "notes": list(self.notes),
            "figures": [f.to_dict() for f in self.figures],
        }


def relative(desired: float, value: float) -> float:
    """Relative error in percent (P22); NaN where there is none."""
    if not (math.isfinite(desired) and math.isfinite(value)) or desired == 0.0:
        return math.nan
    return (desired - value) / desired * 100.0


def percent(value: float) -> str:
    """A signed percentage; a dash where there is none."""
    return f"{value:+.2f} %" if math.isfinite(value) else "-"


def target(figure: Figure) -> str:
    """What the figure is asked for, in words."""
    if figure.kind == "at_most":
        return f"at most {number(figure.desired)}"
    if figure.kind == "at_least":
        return f"at least {number(figure.desired)}"
    return f"within {100 * figure.limit:g} %" if figure.limit is not None else "closer than the thesis"


def verdict(figure: Figure) -> str:
    """Yes, or by how much it falls short."""
    if figure.met:
        return "yes"
    if figure.kind in ("at_most", "at_least"):
        return f"**no**, by {number(abs(figure.ours - figure.desired), 3)} {figure.unit}"
    if figure.limit is not None:
        return f"**no**, by {abs(figure.error) - 100 * figure.limit:.2f} points"
    return f"**no**, {abs(figure.error):.1f} against {abs(figure.thesis_error):.1f} %"


def cells(figure: Figure) -> tuple[str, ...]:
    """One line of the table."""
    closer = {True: "closer", False: "**not closer**", None: "-"}[figure.closer]
    desired = number(figure.desired) if figure.kind == "value" else "-"
    return (
        figure.row,
        figure.name,
        figure.unit,
        desired,
        number(figure.thesis),
        percent(figure.thesis_error),
        number(figure.ours),
        percent(figure.error),
        closer,
        target(figure),
        verdict(figure),
        figure.role,
    )


HEADINGS = (
    "row",
    "figure",
    "unit",
    "real hand / analytic",
    "thesis' model",
    "error",
    "this model",
    "error",
    "closer?",
    "target",
    "reached?",
    "role",
)


def markdown(sections: Sequence[Section]) -> str:
    """All sections as Markdown tables with their notes."""
    out: list[str] = []
    for section in sections:
        out += [
            f"## {', '.join(section.rows)}: {section.title}",
            "",
            "| " + " | ".join(HEADINGS) + " |",
            "|" + "---|" * len(HEADINGS),
        ]
        out += ["| " + " | ".join(cells(figure)) + " |" for figure in section.figures]
        out.append("")
        remarks = [f"{f.row} {f.name}: {f.note}" for f in section.figures if f.note]
        out += [f"- {text}" for text in (*section.notes, *remarks)]
        out.append("")
    return "\n".join(out)
