"""The catalogue of effects as a page with one picture each: nominal model against the model with the effect.

`hannes model effects --page docs/effects.md` writes it; `docs/figures/effects/` beside it holds the pictures.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_sim import ports
from hannes_sim.effect import EffectType, catalogue, effect_source, load_effect
from hannes_sim.factory import make_plant
from hannes_sim.objects import named_object
from hannes_sim.rollout import rollout
from numpy.typing import NDArray

from .hand import make_controller
from .hide import CONDITIONS
from .lookalikes import LookAlikes, look_alikes

Array = NDArray[np.float64]

SHOWN = ("slow", "fast", "grasp")
"""Conditions in which an effect is tried; the one that shows most of it is drawn."""

CLOSURES_WITH_MEMORY = 20
"""Closures in a row before the drawn one, for an effect that remembers earlier ones."""

WORTH = {"motor_current": 0.05, "encoder_position": 0.05}
"""A change of this size (A, rad) counts as one, to choose the condition."""

CONFUSED = 0.8
"""Cosine from which another effect is listed as alike."""

POINTS = 300
"""Points of a drawn curve."""

INK, SOFT, NOMINAL, EFFECT = "#1b1e23", "#5d6570", "#8a929c", "#c8501a"


@dataclass(frozen=True)
class Signature:
    """One closure of the nominal model and of the same model with one effect.

    condition   name of hide.CONDITIONS
    time        (n,) s since the closure's start
    nominal, with_effect   signal name -> (n,)
    closures    which closure of a row it is; 1 but for effects with memory
    values      the effect's parameters, in their units
    """

    effect: EffectType
    condition: str
    time: Array
    nominal: Mapping[str, Array]
    with_effect: Mapping[str, Array]
    closures: int
    values: Mapping[str, float]

    @property
    def size(self) -> float:
        """Root mean square change of the signals in units of WORTH."""
        changes = [(self.with_effect[s] - self.nominal[s]) / WORTH[s] for s in WORTH]
        return float(np.sqrt(np.mean([np.mean(c**2) for c in changes])))


def signature(name: str, model: Model | None = None) -> Signature:
    """The effect at its typical values, in the condition of SHOWN in which it changes most.

    name   catalogue name, or path.py:Class
    """
    effect = load_effect(name)
    model = model or Model.load("nominal")
    entry = effect.entry(source=effect_source(name))
    closures = CLOSURES_WITH_MEMORY if effect.memory else 1
    found = []
    for condition in SHOWN:
        nominal, changed = (_closure(m, condition, closures) for m in (model, model.with_effect(entry)))
        time: Array = np.arange(nominal["motor_current"].size, dtype=np.float64) * 1e-3
        found.append(Signature(effect, condition, time, nominal, changed, closures, entry.values))
    return max(found, key=lambda s: s.size)


def _closure(model: Model, condition: str, closures: int) -> dict[str, Array]:
    """The last of some closures in a row, after a rest that lets the controller settle."""
    spec = CONDITIONS[condition]
    plant = make_plant(model, named_object(spec.grasp))
    plant.set("encoder.resolution", 0.0)
    controller = make_controller(model, 1e-3)
    one = spec.reference(1e-3, 250.0)
    rollout(plant, controller, np.zeros(500), joints=False)
    for _ in range(closures):
        run = rollout(plant, controller, one, reset=False, joints=False)
    return {name: np.array(run.signal(name), dtype=np.float64) for name in WORTH}


def draw(found: Signature, path: Path) -> Path:
    """Current and position, and below what the effect changes in them, as .svg or .png."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    style = {
        "font.size": 8.0, "text.color": INK, "axes.labelcolor": SOFT, "axes.edgecolor": "#c9cdd2",
        "xtick.color": SOFT, "ytick.color": SOFT, "axes.linewidth": 0.7, "lines.linewidth": 1.1,
        "axes.spines.top": False, "axes.spines.right": False, "svg.hashsalt": "hannes", "svg.fonttype": "none",
    }  # fmt: skip
    pick = np.linspace(0, found.time.size - 1, min(POINTS, found.time.size)).round().astype(int)
    time = found.time[pick]
    with mpl.rc_context(style):
        figure = Figure(figsize=(7.2, 2.9), layout="constrained", facecolor="white")
        FigureCanvasAgg(figure)
        axes = figure.subplots(2, 2, sharex=True, height_ratios=[1.6, 1.0])
        for k, (signal, label) in enumerate(
            (("motor_current", "current / A"), ("encoder_position", "position / rad"))
        ):
            nominal, changed = found.nominal[signal][pick], found.with_effect[signal][pick]
            axes[0, k].plot(time, nominal, color=NOMINAL, label="nominal")
            axes[0, k].plot(time, changed, color=EFFECT, label="with the effect")
            axes[0, k].set_ylabel(label)
            axes[1, k].axhline(0.0, color="#c9cdd2", lw=0.7)
            axes[1, k].plot(time, changed - nominal, color=EFFECT)
            axes[1, k].set_ylabel("change")
            axes[1, k].set_xlabel("time / s")
            # A change far below what a sensor shows must not look like one.
            low, high = axes[1, k].get_ylim()
            least = 0.2 * WORTH[signal]
            axes[1, k].set_ylim(min(low, -least), max(high, least))
        axes[0, 0].legend(frameon=False, fontsize=7.5)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            figure.savefig(path, dpi=110, metadata={"Date": None} if path.suffix == ".svg" else {})
        except (OSError, ValueError) as error:
            raise HannesError(f"The picture cannot be written to '{path}': {error}.") from error
    return path


def describe(effect: EffectType) -> dict[str, Any]:
    """What the catalogue says of an effect, in plain types."""
    return {
        "name": effect.name,
        "title": effect.title,
        "looks_like": effect.looks_like,
        "told_by": effect.told_by,
        "memory": effect.memory,
        "parameters": [
            {
                "name": p.name, "unit": p.unit, "lower": p.lower, "upper": p.upper, "typical": p.typical,
                "vanishing": p.vanishing, "description": p.description,
            }
            for p in effect.parameters
        ],
        "known": [
            {"name": p.name, "unit": p.unit, "of_the_hand": p.typical, "description": p.description}
            for p in effect.known
        ],
    }  # fmt: skip


def _condition(found: Signature) -> str:
    spec = CONDITIONS[found.condition]
    grasp = {"none": "on nothing", "rigid": "on a rigid bar"}.get(spec.grasp, f"on {spec.grasp}")
    text = f"{found.condition}: half sine of {spec.amplitude:g} rad in {spec.period:g} s, {grasp}"
    return text + (f"; closure {found.closures} of a row" if found.closures > 1 else "")


def confusion(known: LookAlikes) -> list[str]:
    """Sentences on what an effect is confused with."""
    alike = sorted(
        ((c, name) for name, c in known.effects.items() if c >= CONFUSED),
        key=lambda item: (-round(item[0], 2), item[1]),
    )
    others = ", ".join(f"`{name}` ({c:.2f})" for c, name in alike) or "no other effect of the catalogue"
    part = "more than 99" if known.taken_over > 0.99 else f"{100.0 * known.taken_over:.0f}"
    return [
        f"Confused with: {others}.  ",
        f"The hand's own parameters take over {part} % of it, `{known.parameter.partition('@')[0]}` above all.",
        "",
    ]


def section(found: Signature, picture: str, known: LookAlikes) -> str:
    """One effect in Markdown."""
    effect = found.effect
    doc = inspect.cleandoc(effect.__doc__ or "")
    out = [f"## {effect.title}", "", f"`{effect.name}`", ""]
    out += [textwrap.fill(" ".join(part.split()), 118) + "\n" for part in _paragraphs(doc)]
    out += [f"Looks like: {effect.looks_like}.  ", f"Best shown by: {effect.told_by}.  "]
    out += confusion(known)
    out += ["| parameter | unit | range | typical | off | |", "|---|---|---|---|---|---|"]
    for p in effect.parameters:
        off = "shape" if p.vanishing is None else f"{p.vanishing:g}"
        out.append(
            f"| `{p.name}` | {p.unit} | {p.lower:g} .. {p.upper:g} | {p.typical:g} | {off} | {p.description} |"
        )
    out += [
        f"| `{p.name}` | {p.unit} | known of the machine | {p.typical:g} | | {p.description} |"
        for p in effect.known
    ]
    values = ", ".join(f"{n} {v:g}" for n, v in found.values.items())
    out += [
        "",
        f"![{effect.title}: nominal against effect]({picture})",
        "",
        f"{_condition(found)}. Drawn: {values}.",
        "",
    ]
    return "\n".join(out)


def _paragraphs(doc: str) -> list[str]:
    """The docstring's paragraphs; a line that begins with Equation or Limits starts one."""
    parts: list[list[str]] = [[]]
    for line in doc.splitlines():
        if not line.strip() or line.lstrip().startswith(("Equation:", "Limits:")):
            parts.append([])
        parts[-1].append(line)
    return [text for part in parts if (text := "\n".join(part).strip())]


HEAD = """\
# The effects

One physical effect, one file in `ros2_ws/src/hannes_sim/hannes_sim/effects/`. At its `off` value an effect contributes
exactly nothing. A `shape` parameter has no such value; the search starts from several.

Each picture shows one closure of the nominal model (grey) and of the same model with the effect at its typical value
(orange), in closed loop with the same reference, and below what changed. Shown is that of the conditions slow, fast and
grasp in which most changes; the scales differ from picture to picture.

"Confused with" lists the effects that imitate it in slow, fast and grasp closures with a 30 Hz rectified current: the
cosine between what it does to the data and the best that the other can do, both after the hand's own parameters have
taken over what they can (`hannes_lab/lookalikes.py`). At 1.00 such data cannot tell them apart; below 0.80 none is
listed. The experiment named before it, or better loggers, can.

Written by `hannes model effects --page docs/effects.md`.

| effect | looks like |
|---|---|
"""


PORTS = """\
## Inputs and outputs of an effect

What `contribute(x, p, s, y)` reads in `x` and adds to in `y`, by the names of `hannes_sim.ports`. Angles, speeds,
currents and torques are positive where they close the hand (of another machine: where the reference grows). A torque
in `y` acts on the machine; a friction, a damping, an inertia, a slack or a compliance is positive where there is more
of it. All outputs are zero before each step, and those of several effects add up.

"""


def ports_section() -> str:
    """Inputs and outputs of an effect with their units in Markdown, from the file that declares them."""
    text = inspect.getsource(ports)
    tables = []
    for letter, what, begin, end in (
        ("x", "input", "# Inputs of an effect", "N_INPUTS"),
        ("y", "output", "# Outputs of an effect", "N_OUTPUTS"),
    ):
        rows = re.findall(
            r"^([A-Z_]+) = \d+  # ([^,]+), (.+)$", text.split(begin)[1].split(end)[0], re.MULTILINE
        )
        lines = [f"| {what} | unit | |", "|---|---|---|"]
        tables.append(
            "\n".join([*lines, *(f"| `{letter}[{n}]` | {unit} | {words} |" for n, unit, words in rows)])
        )
    return PORTS + "\n\n".join(tables) + "\n"


def write_page(page: str | Path, names: Sequence[str], *, progress: Any = None) -> Path:
    """Write the page and, in figures/effects/ beside it, one .svg per effect."""
    page = Path(page)
    folder = page.parent / "figures" / "effects"
    rows, sections = [], []
    alike = look_alikes([*catalogue(), *(n for n in names if n not in catalogue())])
    for k, name in enumerate(names):
        found = signature(name)
        effect = found.effect
        draw(found, folder / f"{effect.name}.svg")
        anchor = "".join(c for c in effect.title.lower().replace(" ", "-") if c.isalnum() or c in "-_")
        rows.append(f"| [{effect.title}](#{anchor}) `{effect.name}` | {effect.looks_like} |")
        sections.append(section(found, f"figures/effects/{effect.name}.svg", alike[effect.name]))
        if progress:
            progress(k + 1, len(names), effect.name)
    try:
        page.write_text(
            HEAD + "\n".join(rows) + "\n\n" + "\n".join([*sections, ports_section()]), encoding="utf-8"
        )
    except OSError as error:
        raise HannesError(f"The page cannot be written to '{page}': {error.strerror or error}.") from error
    return page
