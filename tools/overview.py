"""Composes docs/figures/overview.png from what `make demo` has left in demo_out.

    make demo && .venv/bin/python tools/overview.py

Above: the hand at its tightest on each object, from the bags of the node graph. Below: one recorded condition against
the model before and after, and the error on held-out closures, as the demo's model file has it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from hannes_bags.reading import read_bag
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_lab.compare import compare
from hannes_lab.prepare import load_trials, prepare
from hannes_sim.objects import named_object
from hannes_sim.render import HandRenderer

ROOT = Path(__file__).resolve().parent.parent
OBJECTS = {"none": "on nothing", "soft": "on a soft ball", "rigid": "on a dynamometer"}
INK, SOFT, BEFORE, AFTER, FLOOR = "#1b1e23", "#5d6570", "#c8501a", "#1264a8", "#1c7a4a"


def hand(bag: Path, grasp: str) -> np.ndarray[Any, Any]:
    """The hand at its tightest in a bag, cropped to what is of interest."""
    model = Model.load("nominal_mujoco")
    joints = np.asarray(read_bag(bag)["joint_positions"].values, dtype=float)
    with HandRenderer(
        model.parameters, model.variant, named_object(grasp), width=1000, height=1000
    ) as renderer:
        image = renderer.draw(joints[int(np.argmax(joints.sum(axis=1)))])
    return image[190:830, 180:820]


def draw(demo: Path, bags: Path, condition: str, signal: str, out: Path) -> Path:
    """The whole picture."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 9.0, "text.color": INK, "axes.labelcolor": SOFT, "xtick.color": SOFT,
                         "ytick.color": SOFT, "axes.edgecolor": "#c9cdd2", "axes.spines.top": False,
                         "axes.spines.right": False})  # fmt: skip
    prepared = prepare(load_trials([bags]), Model.load("nominal"))
    found = Model.load(demo / "my_hand.yaml")
    before = compare(prepared, fitted=True)
    after = compare(prepare(load_trials([bags]), found), fitted=True)
    curves = [
        next(o for o in c.overlays if (o.condition, o.signal) == (condition, signal)) for c in (before, after)
    ]
    falls = found.provenance["falls"]
    titles = {e.name: f"+ {e.name.replace('_', ' ')}" for e in found.effects}

    figure = plt.figure(figsize=(9.6, 6.4), layout="constrained", facecolor="white")
    grid = figure.add_gridspec(2, 1, height_ratios=[1.15, 1.0])
    top = grid[0].subgridspec(1, 3, wspace=0.02)
    for k, (grasp, title) in enumerate(OBJECTS.items()):
        axis = figure.add_subplot(top[k])
        axis.imshow(hand(demo / f"graph_{grasp}", grasp))
        axis.set_axis_off()
        axis.set_title(title, fontsize=10)
    low = grid[1].subgridspec(1, 2, width_ratios=[1.25, 1.0])
    axis = figure.add_subplot(low[0])
    axis.fill_between(curves[0].time, curves[0].low, curves[0].high, color="#d7dade", lw=0,
                      label="recorded, mean ± 2 sd")  # fmt: skip
    axis.plot(curves[0].time, curves[0].measured, color=INK, lw=1.0)
    axis.plot(curves[0].time, curves[0].model, color=BEFORE, lw=1.3, label="nominal model, fitted")
    axis.plot(curves[1].time, curves[1].model, color=AFTER, lw=1.3, ls="--", label=", ".join(titles.values()))
    axis.set(xlabel="time in the closure / s", ylabel="motor current / A", title=f"{condition} closure")
    axis.legend(frameon=False, fontsize=8.5)
    axis = figure.add_subplot(low[1])
    values = [float(f["held_out"]) for f in falls]
    names = [titles.get(f["added"], f["added"]) for f in falls]
    colours = [*[BEFORE] * (len(falls) - len(titles)), *[AFTER] * len(titles)]
    axis.barh(range(len(falls)), values, color=colours, height=0.55)
    for k, value in enumerate(values):
        axis.text(max(value, 1.0) * 1.08, k, f"{value:.2g}", va="center", color=INK)
    axis.axvline(1.0, color=FLOOR, lw=1.2)
    axis.text(
        1.0, -0.62, "as good as the\nhand repeats itself", color=FLOOR, fontsize=8, ha="left", va="bottom"
    )
    axis.set_xscale("log")
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter("")
    axis.set_xlim(0.5, 2.2 * max(values))
    axis.set_ylim(len(falls) - 0.4, -1.15)
    axis.set_yticks(range(len(falls)), names)
    axis.set(xlabel="error on held-out closures / repeatability", title="the error falls")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=120)
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description="Compose the README's picture from demo_out.")
    parser.add_argument("--demo", type=Path, default=ROOT / "demo_out")
    parser.add_argument("--bags", type=Path, default=ROOT / "bags" / "recorded_hand")
    parser.add_argument("--condition", default="slow")
    parser.add_argument("--signal", default="motor_current")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "figures" / "overview.png")
    given = parser.parse_args()
    try:
        print(draw(given.demo, given.bags, given.condition, given.signal, given.out))
    except HannesError as error:
        print(f"overview: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
