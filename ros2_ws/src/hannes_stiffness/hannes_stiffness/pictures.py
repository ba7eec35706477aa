"""Pictures of an evaluation: closures with what was answered, confusion, reliability, latency and stiffness.

The closures are drawn as the thesis' Figures 96 to 100 show its classifier's answers: the current over time, each
sample in the colour of its answer, the truth below.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.signals import STIFFNESS_CLASSES

from .classifier import NOT_SURE, class_label
from .evaluation import BINS, Answered
from .models import COVERAGE

COLOURS: Mapping[int, str] = {0: "#7a8798", 1: "#d1495b", 2: "#2a9d8f", NOT_SURE: "#e0a100"}
"""Colour by answered class."""


def draw(answered: Sequence[Answered], scores: Mapping[str, Any], folder: str | Path) -> list[Path]:
    """Write closures.png and scores.png into `folder`; answer their paths."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    folder = Path(folder)
    paths = []
    for name, figure in (("closures", _closures(answered)), ("scores", _scores(answered, scores))):
        path = folder / f"{name}.png"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            figure.savefig(path, dpi=110)
        except OSError as error:
            raise HannesError(f"Cannot write the picture '{path}': {error}.") from error
        finally:
            plt.close(figure)
        paths.append(path)
    return paths


def _closures(answered: Sequence[Answered]) -> Any:
    """One closure of every object (at most ten): the middle one of its samples answered rightly."""
    import matplotlib.pyplot as plt

    by_object: dict[str, list[Answered]] = {}
    for a in answered:
        by_object.setdefault(a.closure.scene.object, []).append(a)
    chosen = []
    for rows in list(by_object.values())[:10]:
        right = [float(np.mean(a.classes == a.truth)) for a in rows]
        chosen.append(rows[int(np.argsort(right)[len(rows) // 2])])
    columns = min(len(chosen), 2)
    rows_ = -(-len(chosen) // columns)
    figure, axes = plt.subplots(
        rows_, columns, figsize=(6.0 * columns, 2.1 * rows_ + 0.6), layout="constrained", squeeze=False
    )
    for axis, a in zip(axes.flat, chosen, strict=False):
        said = a.answers.sure(a.least)
        axis.plot(a.time, a.current, color="#c9d1da", linewidth=0.8, zorder=1)
        for number, colour in COLOURS.items():
            here = said == number
            axis.scatter(
                a.time[here], a.current[here], s=9, color=colour, label=class_label(number), zorder=2
            )
        top = 1.08 * max(0.35, float(a.current.max()))
        bottom = -0.09 * top
        for number in range(len(STIFFNESS_CLASSES)):
            here = a.truth == number
            axis.scatter(
                a.time[here], np.full(here.sum(), 0.5 * bottom), s=14, marker="s", color=COLOURS[number]
            )
        axis.axhline(0.3, color="#b0b8c0", linewidth=0.6, linestyle=":")
        if math.isfinite(a.closure.touched):
            axis.axvline(a.closure.touched, color="#333333", linewidth=0.6, linestyle="--")
        axis.set_ylim(bottom, top)
        axis.set_xlim(a.time[0], a.time[-1])
        title = a.closure.scene.object
        grasp = a.closure.scene.grasp
        if grasp is not None and a.closure.scene.known:
            title += f"  ({grasp.stiffness / 1e3:g} kN/m"
            if math.isfinite(a.estimate[0]):
                v, low, high = a.estimate / 1e3
                title += f"; estimate {v:.2g}, {low:.2g} to {high:.2g}"
            title += ")"
        axis.set_title(title, fontsize=9)
        axis.tick_params(labelsize=7)
        axis.set_ylabel("current, A", fontsize=8)
    for axis in axes.flat[len(chosen) :]:
        axis.set_axis_off()
    for axis in axes[-1]:
        axis.set_xlabel("time, s", fontsize=8)
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, fontsize=8, frameon=False)
    figure.supxlabel(
        "Each sample in the colour of its answer; squares below: the truth; dashed: first contact.",
        fontsize=8,
    )
    return figure


def _scores(answered: Sequence[Answered], scores: Mapping[str, Any]) -> Any:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(9.0, 7.6), layout="constrained")
    confusion, reliable, late, stiff = axes.flat
    counts = np.array(scores["overlap_50ms"]["pooled"]["confusion"])
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    confusion.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0)
    for row in range(len(counts)):
        for column in range(len(counts)):
            confusion.text(
                column, row, f"{100 * share[row, column]:.1f} %\n{counts[row, column]}", ha="center", va="center",
                fontsize=8, color="white" if share[row, column] > 0.5 else "#222222",
            )  # fmt: skip
    confusion.set_xticks(range(len(counts)), STIFFNESS_CLASSES)
    confusion.set_yticks(range(len(counts)), STIFFNESS_CLASSES)
    confusion.set(xlabel="answered", ylabel="true", title="windows of 200 ms, hop 150 ms")

    rows = scores["reliability"]["bins"]
    reliable.plot([0, 1], [0, 1], color="#b0b8c0", linewidth=0.8)
    reliable.plot([r["probability"] for r in rows], [r["right"] for r in rows], "o-", color=COLOURS[2])
    biggest = max((r["samples"] for r in rows), default=1)
    reliable.bar(
        [r["probability"] for r in rows], [0.25 * r["samples"] / biggest for r in rows], 0.6 / BINS, color="#dde3ea"
    )  # fmt: skip
    error = scores["reliability"]["expected_calibration_error"]
    reliable.set(
        xlim=(0.3, 1), ylim=(0, 1), xlabel="probability of the answer", ylabel="part that is right",
        title=f"reliability (mean error {error})",
    )  # fmt: skip

    times = [a.latency(a.closure.touched) for a in answered if a.kind and math.isfinite(a.closure.touched)]
    times = [1e3 * t for t in times if math.isfinite(t)]
    if times:
        late.hist(times, bins=30, color=COLOURS[2])
    late.axvline(100.0, color="#b0b8c0", linewidth=0.8)
    late.set(xlabel="first contact to first lasting right answer, ms", ylabel="grasps", title="latency")

    for a in answered:
        grasp = a.closure.scene.grasp
        if grasp is not None and a.closure.scene.known and a.kind and math.isfinite(a.estimate[0]):
            value, low, high = a.estimate
            stiff.plot([grasp.stiffness] * 2, [low, high], color=COLOURS[a.kind], linewidth=0.4, alpha=0.4)
            stiff.plot(grasp.stiffness, value, ".", color=COLOURS[a.kind], markersize=3)
    line = np.array([100.0, 100e3])
    for factor, style in ((1.0, "-"), (1.5, ":"), (1 / 1.5, ":")):
        stiff.plot(line, factor * line, style, color="#b0b8c0", linewidth=0.8)
    stiff.set(
        xscale="log", yscale="log", xlim=line, ylim=line, xlabel="stiffness of the object, N/m",
        ylabel=f"estimate and {100 * COVERAGE:.0f} % interval, N/m", title="stiffness",
    )  # fmt: skip
    return figure
