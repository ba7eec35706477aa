"""What a classifier is worth: answers to measured closures, and every score of them.

Windows as the thesis scores them, grasps, latency from the first contact, reliability of the probabilities, and the
stiffness in N/m with its interval. A "not sure" is a refusal in use; for the scores of windows and grasps the most
probable class counts nevertheless, so that they can be held against figures of classifiers that always answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from numpy.typing import NDArray

from .classifier import NOT_SURE, Answers, StiffnessClassifier
from .dataset import CONTACT_FORCE, Closure, label
from .features import extract
from .scoring import HOPS, score, score_closures

LASTING = 3
"""Samples in a row from which an answer lasts (100 ms at 30 Hz)."""
FACTOR = 1.5
"""An estimate is near where it is within this factor of the truth."""
GRIP_FORCE = 2.0
"""Grip force, N, that the motor can feel: the thesis' 0.3 A are 0.05 A above its void current (R07), and its hand
presses with 92 N at 2.6 A (R10, R13), 39 N per ampere."""
BINS = 10
"""Bins of the reliability diagram."""


@dataclass(frozen=True)
class Answered:
    """The answers to one closure.

    closure  what was measured
    time     (n,) s of the answers
    void     (n,) bool, void by rule
    truth    (n,) true class; without contact it is void (X18)
    rule     (n,) true class by the thesis' rule alone (P19)
    current  (n,) A, the feature
    answers  what was answered
    least    least probability of a sure answer
    """

    closure: Closure
    time: NDArray[np.float64]
    void: NDArray[np.bool_]
    truth: NDArray[np.int64]
    rule: NDArray[np.int64]
    current: NDArray[np.float64]
    answers: Answers
    least: float

    @property
    def classes(self) -> NDArray[np.int64]:
        """Most probable class (n,)."""
        return self.answers.classes

    @property
    def kind(self) -> int:
        """What the closure truly is: the object's class where its samples show it for `LASTING`, else void."""
        found = self.truth[self.truth > 0]
        return int(found[0]) if len(found) >= LASTING else 0

    @property
    def grasp(self) -> int:
        """What the closure is answered to be, at its end: void without `LASTING` answers that say otherwise, else the
        class with the most probability over the samples that are not answered void."""
        touching = self.classes > 0
        if np.count_nonzero(touching) < LASTING:
            return 0
        return 1 + int(np.argmax(self.answers.probabilities[touching][:, 1:].sum(axis=0)))

    @property
    def estimate(self) -> NDArray[np.float64]:
        """Stiffness (3,) N/m of the grasp: the answered samples together, each by the inverse square of its interval's
        width in decades; the interval is the weighted mean of theirs, since their errors are one. NaN without one."""
        use = (self.classes > 0) & np.isfinite(self.answers.stiffness[:, 0])
        if not use.any():
            return np.full(3, np.nan)
        decades = np.log10(self.answers.stiffness[use])
        weight = 1.0 / np.maximum(decades[:, 2] - decades[:, 1], 0.02) ** 2
        return np.asarray(10.0 ** (weight @ decades / weight.sum()))

    def latency(self, since: float) -> float:
        """Time from `since` (s) to the first of `LASTING` right answers in a row; infinite where there are none."""
        right = (self.classes == self.kind) & (self.time >= since - 1e-9)
        lasting = np.convolve(right, np.ones(LASTING), "valid") >= LASTING - 0.5
        return float(self.time[np.argmax(lasting)] - since) if lasting.any() else math.inf


def answer(classifier: StiffnessClassifier, closures: Iterable[Closure]) -> list[Answered]:
    """What the classifier says to measured closures."""
    out = []
    for closure in closures:
        f = extract(closure.time, closure.current, closure.reference, closure.encoder, classifier.spec)
        out.append(
            Answered(
                closure,
                f.time,
                f.void,
                label(f, closure),
                label(f, closure, contact=False),
                f.values[:, 0].astype(float),
                classifier.answer(f.values, f.void),
                classifier.least,
            )
        )
    return out


def split_grasps(closure: Closure) -> list[Closure]:
    """A long recording cut into its grasps, before each rise of the reference from its rest."""
    r = closure.reference
    known = np.isfinite(r)
    if not known.any():
        return [closure]
    low = np.nanmin(r) + 0.05 * (np.nanmax(r) - np.nanmin(r))
    resting = ~(r > low)
    rises = np.flatnonzero(resting[:-1] & ~resting[1:])
    cuts = rises[1:]  # what comes before the first rise belongs to the first grasp
    if not len(cuts):
        return [closure]
    names = ("time", "current", "reference", "encoder", "force")
    parts = zip(*(np.split(getattr(closure, name), cuts) for name in names), strict=True)
    return [
        Closure(closure.scene, time, current, reference, encoder, force, _first_contact(time, force))
        for time, current, reference, encoder, force in parts
    ]


def _first_contact(time: NDArray[np.float64], force: NDArray[np.float64]) -> float:
    above = np.flatnonzero(force > CONTACT_FORCE)
    return float(time[above[0]]) if len(above) else math.nan


def _number(value: float, digits: int = 4) -> float | None:
    return round(float(value), digits) if math.isfinite(value) else None


def scores_of(answered: Sequence[Answered], name: Callable[[Answered], str] | None = None) -> dict[str, Any]:
    """All scores as plain types; `name` gives the rows of the scores per object, by default the object's name."""
    if not answered:
        raise HannesError("There is no closure to score.")
    named = [(a.closure.scene.object if name is None else name(a), a) for a in answered]
    out: dict[str, Any] = {
        "closures": len(answered),
        "samples": score(
            np.concatenate([a.truth for a in answered]), np.concatenate([a.classes for a in answered])
        ).to_dict(),
    }
    for hop, seconds in HOPS.items():
        out[hop] = score_closures(((n, a.time, a.truth, a.classes) for n, a in named), seconds).to_dict()
        rule = score_closures(((n, a.time, a.rule, a.classes) for n, a in named), seconds)
        out[hop]["by_rule_alone"] = rule.pooled.to_dict()
    return out | {
        "grasps": grasp_scores(named),
        "latency": latencies(named),
        "reliability": reliability(answered),
        "not_sure": refusals(answered),
        "stiffness": stiffness_scores(answered),
    }


def grasp_scores(named: Sequence[tuple[str, Answered]]) -> dict[str, Any]:
    """Scores of whole grasps, pooled and per object; `hidden` counts the closures whose object never showed."""

    def of(rows: Sequence[Answered]) -> dict[str, Any]:
        return score([a.kind for a in rows], [a.grasp for a in rows]).to_dict() | {
            "hidden": sum(a.closure.scene.grasp is not None and a.kind == 0 for a in rows)
        }

    objects = list(dict.fromkeys(n for n, _ in named))
    return {
        "pooled": of([a for _, a in named]),
        "objects": {o: of([a for n, a in named if n == o]) for o in objects},
    }


def latencies(named: Sequence[tuple[str, Answered]]) -> dict[str, Any]:
    """Times to the first lasting right answer: from the first contact, from a grip of `GRIP_FORCE`, and from the first
    sample not void (P19). An answer that was there before counts as 0.

    Over the grasps whose object showed; a grasp that is never answered rightly counts as infinitely late.
    """

    def of(rows: Sequence[tuple[float, ...]]) -> dict[str, Any]:
        touch, grip, between = (np.array([r[k] for r in rows if not math.isnan(r[k])]) for k in (0, 1, 3))
        shown = np.array([r[2] for r in rows])
        late = shown[np.isfinite(shown)]
        return {
            "grasps": len(rows),
            "never": int(np.count_nonzero(~np.isfinite(shown))),
            "from_contact_median_s": _number(float(np.median(touch))) if len(touch) else None,
            "from_contact_90_s": _number(float(np.quantile(touch, 0.9, method="higher")))
            if len(touch)
            else None,
            "from_grip_median_s": _number(float(np.median(grip))) if len(grip) else None,
            "contact_to_grip_median_s": _number(float(np.median(between))) if len(between) else None,
            "from_void_current_median_s": _number(float(np.median(shown))) if len(shown) else None,
            "from_void_current_mean_s": _number(float(late.mean())) if len(late) else None,
        }

    rows = []
    for name, a in named:
        if a.kind:
            shown = float(a.time[np.argmax(a.truth > 0)])
            touched, gripped = a.closure.touched, a.closure.time[a.closure.force > GRIP_FORCE]
            rows.append(
                (
                    name,
                    a.latency(touched) if math.isfinite(touched) else math.nan,
                    a.latency(float(gripped[0])) if len(gripped) else math.nan,
                    a.latency(shown),
                    float(gripped[0]) - touched if len(gripped) else math.nan,
                )
            )
    return {
        "pooled": of([r[1:] for r in rows]),
        "objects": {o: of([r[1:] for r in rows if r[0] == o]) for o in dict.fromkeys(r[0] for r in rows)},
    }


def reliability(answered: Sequence[Answered]) -> dict[str, Any]:
    """Of the samples on which no rule decides: how often the most probable class is right, by its probability.

    expected_calibration_error is the mean difference of the two, weighted by the samples of a bin.
    """
    sure = np.concatenate([a.answers.probabilities.max(axis=1)[~a.void] for a in answered])
    right = np.concatenate([(a.classes == a.truth)[~a.void] for a in answered])
    bins = np.clip((sure * BINS).astype(int), 0, BINS - 1)
    rows, error = [], 0.0
    for k in range(BINS):
        here = bins == k
        if here.any():
            said, was = float(sure[here].mean()), float(right[here].mean())
            error += here.mean() * abs(said - was)
            rows.append({"probability": round(said, 4), "right": round(was, 4), "samples": int(here.sum())})
    return {"bins": rows, "expected_calibration_error": round(error, 4) if len(sure) else None}


def refusals(answered: Sequence[Answered]) -> dict[str, Any]:
    """Of the samples on which no rule decides: the part answered "not sure", and how often the others are right."""
    said = np.concatenate([a.answers.sure(a.least)[~a.void] for a in answered])
    truth = np.concatenate([a.truth[~a.void] for a in answered])
    sure = said != NOT_SURE
    return {
        "least_probability": answered[0].least,
        "part": _number(float(1.0 - sure.mean())) if len(said) else None,
        "right_when_sure": _number(float((said == truth)[sure].mean())) if sure.any() else None,
        "right_if_forced": _number(
            float(np.concatenate([(a.classes == a.truth)[~a.void] for a in answered]).mean())
        )
        if len(said)
        else None,
    }


def stiffness_scores(answered: Sequence[Answered]) -> dict[str, Any]:
    """Estimates against the object's stiffness: per sample, per grasp, and per grasp by decade."""
    rows = []
    samples = []
    for a in answered:
        grasp = a.closure.scene.grasp
        if grasp is None or a.kind == 0 or not a.closure.scene.known:
            continue
        use = (a.truth > 0) & np.isfinite(a.answers.stiffness[:, 0])
        samples += [(grasp.stiffness, *row) for row in a.answers.stiffness[use]]
        if np.isfinite(a.estimate[0]):
            rows.append((grasp.stiffness, *a.estimate))

    def of(values: Sequence[tuple[float, ...]]) -> dict[str, Any]:
        if not values:
            return {"count": 0}
        truth, value, low, high = np.array(values).T
        off = np.abs(np.log(value / truth))
        return {
            "count": len(values),
            "within_factor": _number(float(np.mean(off <= math.log(FACTOR) + 1e-12))),
            "median_factor": _number(float(np.exp(np.median(off)))),
            "covered": _number(float(np.mean((low <= truth * 1.0001) & (truth <= high * 1.0001)))),
            "interval_factor": _number(float(np.exp(np.median(np.log(high / low)) / 2.0))),
        }

    edges = (0.0, 1e3, 1e4, math.inf)
    names = ("below 1 kN/m", "1 to 10 kN/m", "above 10 kN/m")
    return {
        "factor": FACTOR,
        "samples": of(samples),
        "grasps": of(rows),
        "by_stiffness": {
            n: of([r for r in rows if low <= r[0] < high])
            for n, low, high in zip(names, edges[:-1], edges[1:], strict=True)
        },
    }


def kind_name(a: Answered) -> str:
    """Void, rigid or soft, by the object."""
    return a.closure.scene.kind
