"""Scores as the thesis makes them: the mode of the labels in 200 ms windows, then precision, recall and F1.

The thesis' formulas of precision and recall are swapped (X04); here they are the usual ones, F1 is the
same. Its "200 ms windows with 50 ms overlap" is taken literally as a hop of 150 ms, and a hop of 50 ms is
reported beside it (X20).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.signals import STIFFNESS_CLASSES
from numpy.typing import ArrayLike, NDArray

WINDOW = 0.2
"""Length of a window, s (P21)."""
HOPS: Mapping[str, float] = {"overlap_50ms": 0.15, "hop_50ms": 0.05}
"""Both readings of the thesis' windows, s between their starts."""


@dataclass(frozen=True)
class ClassScore:
    """Precision tp/(tp+fp), recall tp/(tp+fn), F1 2 tp/(2 tp+fp+fn), and how many truly are of the class.

    All are NaN where the class occurs neither in the truth nor in the answers.
    """

    precision: float
    recall: float
    f1: float
    support: int


@dataclass(frozen=True)
class Score:
    """Scores of one set of windows or samples.

    confusion  (3, 3) counts, row = truth, column = answer, order void, rigid, soft
    classes    score per class name
    """

    confusion: NDArray[np.int64]
    classes: Mapping[str, ClassScore]

    @property
    def count(self) -> int:
        """How many were scored."""
        return int(self.confusion.sum())

    @property
    def accuracy(self) -> float:
        """Part that was answered rightly; NaN where nothing was scored."""
        return float(np.trace(self.confusion) / self.count) if self.count else float("nan")

    @property
    def macro_f1(self) -> float:
        """Mean F1 of the classes that truly occur; the figure that is reported as "F1"."""
        present = [s.f1 for s in self.classes.values() if s.support]
        return float(np.mean(present)) if present else float("nan")

    def to_dict(self) -> dict[str, object]:
        """Plain types for JSON; None where a score does not exist."""

        def number(value: float) -> float | None:
            return None if np.isnan(value) else round(float(value), 6)

        return {
            "count": self.count,
            "f1": number(self.macro_f1),
            "accuracy": number(self.accuracy),
            "classes": {
                n: {
                    "precision": number(s.precision),
                    "recall": number(s.recall),
                    "f1": number(s.f1),
                    "support": s.support,
                }
                for n, s in self.classes.items()
            },
            "confusion": self.confusion.tolist(),
        }


def _labels(values: ArrayLike, what: str) -> NDArray[np.int64]:
    labels = np.asarray(values)
    if labels.ndim != 1 or (labels.size and not np.isin(labels, range(len(STIFFNESS_CLASSES))).all()):
        raise HannesError(
            f"{what} must be a list of class numbers; valid are "
            + ", ".join(f"{k} ({n})" for k, n in enumerate(STIFFNESS_CLASSES))
            + "."
        )
    return labels.astype(np.int64)


def score(truth: ArrayLike, answer: ArrayLike) -> Score:
    """Confusion and the usual scores of class numbers; both (n,)."""
    t, a = _labels(truth, "The truth"), _labels(answer, "The answers")
    if len(t) != len(a):
        raise HannesError(f"There are {len(t)} true labels and {len(a)} answers; they must be as many.")
    size = len(STIFFNESS_CLASSES)
    confusion = np.bincount(size * t + a, minlength=size * size).reshape(size, size)
    return _from_confusion(confusion)


def pool(scores: Iterable[Score]) -> Score:
    """The score of all windows of several sets together (counts added, not averages averaged)."""
    size = len(STIFFNESS_CLASSES)
    return _from_confusion(sum((s.confusion for s in scores), np.zeros((size, size), dtype=np.int64)))


def _from_confusion(confusion: NDArray[np.int64]) -> Score:
    classes = {}
    for k, name in enumerate(STIFFNESS_CLASSES):
        right, answered, true = int(confusion[k, k]), int(confusion[:, k].sum()), int(confusion[k].sum())
        either = answered + true
        nothing = float("nan") if either == 0 else 0.0
        classes[name] = ClassScore(
            right / answered if answered else nothing,
            right / true if true else nothing,
            2 * right / either if either else nothing,
            true,
        )
    return Score(confusion.astype(np.int64), classes)


def mode(labels: Sequence[int] | NDArray[np.int64]) -> int:
    """The most frequent label; of several equally frequent ones, the one seen last (the newest evidence)."""
    values = np.asarray(labels, dtype=np.int64)
    if not values.size:
        raise HannesError("A window without samples has no mode.")
    counts = np.bincount(values, minlength=len(STIFFNESS_CLASSES))
    best = counts == counts.max()
    return int(values[np.flatnonzero(best[values])[-1]])


@dataclass(frozen=True)
class Windows:
    """Windows of labels: end (m,) s of each window, labels (k, m) the mode of each of the k label rows in
    it."""

    end: NDArray[np.float64]
    labels: NDArray[np.int64]


def windows(time: ArrayLike, *rows: ArrayLike, hop: float, window: float = WINDOW) -> Windows:
    """Mode of each row of labels in the windows [start + k hop, start + k hop + window).

    time (n,) ascending s; rows (n,) class numbers. Only whole windows count; windows without a sample are
    left out.
    """
    t = np.asarray(time, dtype=float)
    if not (hop > 0.0 and window > 0.0):
        raise HannesError(
            f"Windows of {window:g} s with a hop of {hop:g} s are not possible; both must be positive."
        )
    labels = [_labels(row, f"Label row {k}") for k, row in enumerate(rows)]
    if any(len(row) != len(t) for row in labels):
        raise HannesError(f"Label rows of {[len(row) for row in labels]} samples do not fit {len(t)} times.")
    if not len(t):
        return Windows(np.empty(0), np.empty((len(rows), 0), dtype=np.int64))
    # A nanosecond of slack: sample times are multiples of the period, rounded.
    slack = 1e-9
    period = float(np.median(np.diff(t))) if len(t) > 1 else window
    count = max(0, int(np.floor((t[-1] - t[0] + period - window) / hop + 1e-6)) + 1)
    start = t[0] + hop * np.arange(count)
    first = np.searchsorted(t, start - slack, side="left")
    last = np.searchsorted(t, start + window - slack, side="left")
    filled = last > first
    spans = list(zip(first[filled], last[filled], strict=True))
    return Windows(
        start[filled] + window,
        np.array([[mode(row[a:b]) for a, b in spans] for row in labels], dtype=np.int64).reshape(
            len(labels), len(spans)
        ),
    )


@dataclass(frozen=True)
class WindowScores:
    """Scores of a set of closures: per object and pooled, for one hop."""

    hop: float
    objects: Mapping[str, Score]
    pooled: Score

    def to_dict(self) -> dict[str, object]:
        """Plain types for JSON."""
        return {
            "window_s": WINDOW,
            "hop_s": self.hop,
            "pooled": self.pooled.to_dict(),
            "objects": {name: s.to_dict() for name, s in self.objects.items()},
        }


def score_closures(
    closures: Iterable[tuple[str, ArrayLike, ArrayLike, ArrayLike]], hop: float
) -> WindowScores:
    """Window scores of closures given as (object name, time s, true labels, answered labels)."""
    by_object: dict[str, list[Score]] = {}
    for name, time, truth, answer in closures:
        cut = windows(time, truth, answer, hop=hop)
        by_object.setdefault(name, []).append(score(cut.labels[0], cut.labels[1]))
    objects = {name: pool(parts) for name, parts in by_object.items()}
    return WindowScores(hop, objects, pool(objects.values()))
