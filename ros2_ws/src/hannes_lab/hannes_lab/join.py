"""Recordings of a few closures each that repeat one condition, joined into one: only repeats tell what is scatter."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from hannes_sim.measurement import sample_noise
from numpy.typing import NDArray
from scipy.special import stdtrit

from .closures import group_closures
from .features import stands_for_all
from .trials import OfAll, Part, Trial, curves_of, stem_of

Array = NDArray[np.float64]

ENOUGH = 5
"""Closures with which a recording tells its scatter itself; it stays alone, with its own encoder zero and delays."""

ALIKE = 0.1
"""Root mean square difference of two mean closures, in spans of the larger, up to which they may repeat each other:
another object or speed differs by more, the scatter of a hand by less."""

SAID = 0.2
"""The same of recordings of which an adapter says that they are of one condition."""

CHANCE = 1e-3
LARGE = 1e-3
"""Recordings begin anew where the encoder's rest moves over them with no more than this chance of it being scatter, and
by more than this part of its span."""

STRAY = 3
"""Times as many closures of a condition that agree with one another, ENOUGH of them, as all that do not: those are
left out."""

SHORT = 0.8
"""Part of the usual length below which the shortest closure, to which all are cut, is spoken of."""

_GRID = 200
_REST = 0.1  # s over which a rest position is averaged


@dataclass(frozen=True)
class Loaded:
    """A trial with what its recording says beside it.

    condition   name of the condition if the recording gives one
    step        s between two samples of the logged reference
    """

    trial: Trial
    condition: str | None = None
    step: float = 0.0

    @property
    def kind(self) -> str:
        """What repeats have in common: the condition's name, or the file's without the number or date at its end."""
        return self.condition or re.sub(r"[\d\W_]+$", "", self.trial.name)


def join_repeats(loaded: Sequence[Loaded], alike: float = ALIKE) -> list[Trial]:
    """The trials in their order, those that repeat the condition of an earlier one joined to it.

    Recordings are joined where each has fewer than ENOUGH closures, all of one condition, and they have the same kind,
    signals, units and description (object, logger), the same reference, and mean closures that are `alike`.  What
    is joined already stays as it is.  Whether each begins anew is said by the trials (`fresh`), or seen.
    """
    return _joined_groups(_grouped(loaded, alike))


def _grouped(loaded: Sequence[Loaded], alike: float) -> list[list[Loaded]]:
    groups: list[list[Loaded]] = []
    for one in loaded:
        group = next((g for g in groups if _one_object([*g, one]) and not _unlike(g[0], one, alike)), None)
        if group is None:
            groups.append([one])
        else:
            group.append(one)
    return groups


def _joined_groups(groups: Sequence[list[Loaded]]) -> list[Trial]:
    several = [[one.trial for one in group] for group in groups if len(group) > 1]
    found = _fresh([trials for trials in several if not trials[0].fresh])
    return [trial for group in groups for trial in _one_or_all(group, group[0].trial.fresh or found)]


def join_trials(trials: Sequence[Trial]) -> list[Trial]:
    """A rig's trials, joined as bags are: those that repeat a condition have its name in common.

    Few that differ from many of their condition, which agree, are left out with a note.
    """
    loaded = [Loaded(trial, trial.conditions[0]) for trial in trials]
    groups, left_out = _without_strays(_grouped(loaded, SAID))
    joined = _joined_groups(groups)
    apart: dict[str, list[Trial]] = {}
    for trial in joined:
        if len(trial.conditions) == 1 and (trial.parts or len(trial.closures) < ENOUGH):
            apart.setdefault(trial.conditions[0], []).append(trial)
    said = [
        f"{', '.join(t.name for t in of_one)} are of one condition, '{condition}', and are not taken together: "
        f"{_why_apart([one for one in loaded if one.condition == condition])}"
        for condition, of_one in apart.items()
        if len(of_one) > 1
    ]
    said += left_out
    said += _scattered(joined)
    said += _with_others(joined)
    first, *others = joined
    told = tuple(OfAll(note) for note in said if note not in first.notes)
    return [replace(first, notes=(*first.notes, *told)), *others]


def _without_strays(groups: Sequence[list[Loaded]]) -> tuple[list[list[Loaded]], list[str]]:
    """The groups without those whose recordings differ from STRAY times as many of their condition, and why each is."""
    kept, said = [], []
    for group in groups:
        others = [g for g in groups if g is not group and g[0].kind == group[0].kind]
        many = max(others, key=_closures, default=[])
        apart = _closures(group) + sum(_closures(g) for g in others if g is not many)
        agree = _closures(many) >= max(ENOUGH, STRAY * apart)
        if not (agree and _one_object([*many, *group]) and not _not_comparable(many[0], group[0])):
            kept.append(group)
            continue
        names = ", ".join(one.trial.name for one in group)
        why = _too_far(many[0], group[0], SAID)
        said.append(
            f"left out: {names} of condition '{group[0].condition}', unlike its {_closures(many)} other closures: {why}"
        )
    return kept, said


def _closures(group: Sequence[Loaded]) -> int:
    return sum(len(one.trial.closures) for one in group)


def _with_others(trials: Sequence[Trial]) -> list[str]:
    """A sentence on conditions of one closure each that trials of several share: they are no repeats of each other."""
    places: dict[str, list[Trial]] = {}
    for trial in trials:
        for condition in trial.conditions:
            places.setdefault(condition, []).append(trial)
    shared = {
        condition: own
        for condition, own in places.items()
        if len(own) > 1
        and any(len(trial.conditions) > 1 for trial in own)
        and all(len(trial.of(condition)) == 1 for trial in own)
    }
    if not shared:
        return []
    names = ", ".join(dict.fromkeys(trial.name for own in shared.values() for trial in own))
    return [
        f"{', '.join(shared)}: in several trials ({names}) of which some hold other conditions too, so that these are "
        "not taken for repeats; put all closures into one trial, or each condition into trials of its own"
    ]


def _why_apart(loaded: Sequence[Loaded]) -> str:
    """Why recordings of one condition do not repeat each other."""
    first = loaded[0]
    for other in loaded[1:]:
        if unlike := _not_comparable(first, other):
            return f"{unlike} ({first.trial.name}, {other.trial.name})"
        if unlike := _too_far(first, other, SAID):
            advice = "name what differs as a condition of its own, or leave one out"
            return f"{unlike}; {advice} ({first.trial.name}, {other.trial.name})"
    if first.trial.fresh:
        apart = _joined(loaded, fresh=True).apart
        return (
            f"their references differ by {100 * apart:.1f} % of their span, so that none can be simulated for the "
            "others; record the same one, or name each as a condition of its own"
        )
    return "it is not seen how each began; where each begins as the first does, their trials must say so (fresh=True)"


def _scattered(trials: Sequence[Trial]) -> list[str]:
    """A sentence on recordings that are taken together as the adapter says, though they differ by more than ALIKE."""
    out = []
    for trial in (t for t in trials if t.parts):
        for signal, (time, values) in trial.signals.items():
            curves = curves_of(trial.closures, time, values)
            noise = sample_noise(values)
            apart = math.sqrt(max(2.0 * float(curves.var(axis=0, ddof=1).mean()) - 2.0 * noise**2, 0.0))
            part = apart / (float(np.ptp(curves.mean(axis=0))) or math.inf)
            if part > ALIKE and not _noise(trial, signal):
                out.append(
                    f"{trial.name}: {signal} differs by {100 * part:.0f} % of its span from recording to recording; if "
                    "that has a cause, name what differs as a condition of its own"
                )
    return out


def _one_or_all(group: list[Loaded], fresh: bool | None) -> list[Trial]:
    trials = [one.trial for one in group]
    if len(group) == 1 or fresh is None:
        return trials
    if not fresh:
        return [_joined(group)]
    first = _typical(trials)
    joined = _joined([group[first], *group[:first], *group[first + 1 :]], fresh=True)
    # Where the references do not match, a simulation would go through them as if they were one.
    return [joined] if stands_for_all(joined) else trials


def _fresh(groups: Sequence[Sequence[Trial]]) -> bool | None:
    """Whether the machine did not begin each recording where a closure left it: a simulator that is started anew.

    The encoder's rest after the closures of a recording less that before them, Student's t of its mean over a group.
    None where that cannot be told: no encoder, or recordings that end before the hand rests.
    """
    moved: list[Array] = []
    large: list[float] = []
    for trials in groups:
        if "encoder_position" in trials[0].signals:
            shifts = np.array([_shift(trial) for trial in trials])
            moved.append(shifts[np.isfinite(shifts)])
            spans = [float(np.ptp(trial.signals["encoder_position"][1])) for trial in trials]
            large.append(LARGE * float(np.mean(spans)))
    freedom = sum(max(m.size - 1, 0) for m in moved)
    if not freedom:
        return None
    sd = np.sqrt(sum(float(((m - m.mean()) ** 2).sum()) for m in moved if m.size) / freedom)
    limit = float(stdtrit(freedom, 1.0 - 0.5 * CHANCE))
    return any(
        m.size > 0 and abs(m.mean()) > max(least, limit * sd / m.size**0.5)
        for m, least in zip(moved, large, strict=True)
    )


def _shift(trial: Trial) -> float:
    """Encoder's rest after the closures less that before them; NaN where the recording ends before it rests."""
    time, position = trial.signals["encoder_position"]
    ends = []
    for at in (trial.closures[0].start, trial.closures[-1].stop):
        stop = int(np.searchsorted(time, at)) + 1
        start = min(int(np.searchsorted(time, at - _REST)), stop - 1, time.size - 1)
        ends.append(position[start:stop])
    half = ends[1].size // 2
    drift = float(ends[1][half:].mean() - ends[1][:half].mean()) if half else 0.0
    rests = abs(drift) <= LARGE * float(np.ptp(position))
    return float(ends[1].mean() - ends[0].mean()) if rests else float("nan")


def _typical(trials: Sequence[Trial]) -> int:
    """Number of the trial with the most closures whose mean closure is nearest to the median of all."""
    length = min(c.stop - c.start for t in trials for c in t.closures)
    phase = np.linspace(0.0, length, _GRID)
    away = np.zeros(len(trials))
    for signal in trials[0].signals:
        curves = np.array([t.mean_closure(signal, phase) for t in trials])
        away += np.sqrt(((curves - np.median(curves, axis=0)) ** 2).mean(axis=1)) / max(np.ptp(curves), 1e-12)
    return min(range(len(trials)), key=lambda k: (-len(trials[k].closures), away[k]))


def _one_object(group: Sequence[Loaded]) -> bool:
    """Whether nobody says that different objects were grasped."""
    said = [one.trial.options["object"] for one in group if "object" in one.trial.options]
    return all(one == said[0] for one in said)


def _unlike(one: Loaded, other: Loaded, alike: float) -> str:
    """Why two recordings do not repeat each other; empty if they do.

    alike  most that mean closures may differ by, see ALIKE
    """
    return _not_comparable(one, other) or _too_far(one, other, alike)


def _too_far(one: Loaded, other: Loaded, alike: float) -> str:
    """By how much a signal of two recordings that could be repeats differs, where that is too much."""
    far = {signal: _apart(one.trial, other.trial, signal) for signal in one.trial.signals}
    signal = max(far, key=lambda name: far[name])
    if far[signal] <= alike:
        return ""
    return (
        f"{signal} differs by {100 * far[signal]:.0f} % of its span, where repeats may by {100 * alike:.0f} %"
    )


def _not_comparable(one: Loaded, other: Loaded) -> str:
    """Why two recordings cannot repeat each other, whatever was measured; empty if they can."""
    a, b = one.trial, other.trial
    for trial in (a, b):
        if len(trial.conditions) != 1 or len(trial.closures) >= ENOUGH or trial.parts:
            return f"{trial.name} has several conditions, or closures enough"
    if one.kind != other.kind:
        return "they are of different conditions"
    if a.period != b.period:
        return f"the control period of one is {a.period:g} s, of the other {b.period:g} s"
    if a.fresh != b.fresh:
        return "one of them begins as the first does (fresh=True), the other does not"
    if set(a.signals) != set(b.signals):
        return f"{', '.join(sorted(set(a.signals) ^ set(b.signals)))}: a signal of one of them only"
    units = [name for name in a.signals if a.unit(name) != b.unit(name)]
    if units:
        return f"the units of {', '.join(units)} differ"
    options = _differing(*({k: v for k, v in t.options.items() if k != "object"} for t in (a, b)))
    if options:
        return f"their options differ ({', '.join(options)})"
    if len(_joined([one, other]).conditions) != 1:
        return f"their references differ{_by(a, b)}"
    return ""


def _by(a: Trial, b: Trial) -> str:
    """How much two references differ, in words."""
    shapes = [t.reference[round(t.closures[0].start / t.period) :] for t in (a, b)]
    n = min(shape.size for shape in shapes)
    span = float(np.ptp(shapes[0])) or 1.0
    return (
        f" by up to {100 * float(np.max(np.abs(shapes[0][:n] - shapes[1][:n]))) / span:.1f} % of their span"
    )


def _differing(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[str]:
    """Names of what two descriptions do not share; a rig's may hold arrays."""
    return sorted(k for k in a.keys() | b.keys() if not (k in a and k in b and np.array_equal(a[k], b[k])))


def _apart(a: Trial, b: Trial, signal: str) -> float:
    """Root mean square difference of two mean closures beyond the noise of their samples, in spans of the larger."""
    if _noise(a, signal) and _noise(b, signal):
        return 0.0
    length = min(c.stop - c.start for t in (a, b) for c in t.closures)
    curves = [t.mean_closure(signal, np.linspace(0.0, length, _GRID)) for t in (a, b)]
    span = max(float(np.ptp(curve)) for curve in curves)
    noise = sum(sample_noise(t.signals[signal][1]) ** 2 / len(t.closures) for t in (a, b))
    beyond = float(np.mean((curves[0] - curves[1]) ** 2)) - noise
    return max(beyond, 0.0) ** 0.5 / span if span > 0.0 else 0.0


def _noise(trial: Trial, signal: str) -> bool:
    """Whether neighbouring samples have next to nothing in common: a force sensor that nothing touches."""
    values = trial.signals[signal][1] - trial.signals[signal][1].mean()
    return float(values[1:] @ values[:-1]) <= 0.5 * float(values @ values)


def _joined(group: Sequence[Loaded], fresh: bool = False) -> Trial:
    """One trial: the recordings one after the other, as if there had been no time between them."""
    trials = [one.trial for one in group]
    first = trials[0]
    begins = np.concatenate([[0], np.cumsum([t.reference.size for t in trials])[:-1]]) * first.period
    reference = np.concatenate([t.reference for t in trials])
    # Recordings end sooner or later after the hand has come back; what all of them have is taken.
    length, ends_first = min((c.stop - c.start, k) for k, t in enumerate(trials) for c in t.closures)
    spans = [
        (c.start + begin, c.start + begin + length)
        for t, begin in zip(trials, begins, strict=True)
        for c in t.closures
    ]
    signals = {}
    for name in first.signals:
        inside = [_inside(t, name, k == 0, k == len(trials) - 1) for k, t in enumerate(trials)]
        time = [t.signals[name][0][i] + b for t, i, b in zip(trials, inside, begins, strict=True)]
        values = [t.signals[name][1][i] for t, i in zip(trials, inside, strict=True)]
        signals[name] = np.concatenate(time), np.concatenate(values)
    step = max(one.step for one in group)
    names = [stem_of(t.source) if t.source else t.name for t in trials]
    if len(set(names)) < len(names):  # several in one file
        names = [t.name for t in trials]
    said = f"{len(trials)} recordings repeat one condition and are taken together ({', '.join(names)})"
    usual = float(np.median([c.stop - c.start for t in trials for c in t.closures]))
    if length < SHORT * usual:
        without = f"{usual:.2f} s without {names[ends_first]}, which ends early"
        said += f"; of each closure the first {length:.2f} s ({without})"
    numbers = [number for t in trials for number in range(len(t.closures))]
    closures = group_closures(reference, first.period, spans, first.conditions[0], step)
    ordinals = {start: number for (start, _), number in zip(spans, numbers, strict=True)}
    return replace(
        first,
        options={key: value for t in reversed(trials) for key, value in t.options.items()},
        reference=reference,
        signals=signals,
        closures=tuple(replace(c, number=ordinals[c.start]) for c in closures),
        notes=(*_notes(trials, names), said),
        parts=tuple(
            Part(name, t.source, t.sha256, float(begin))
            for name, t, begin in zip(names, trials, begins, strict=True)
        ),
        fresh=fresh,
    )


def _inside(trial: Trial, name: str, first: bool, last: bool) -> NDArray[np.bool_]:
    """The samples of a signal that lie in no other recording once this one stands between two."""
    time = trial.signals[name][0]
    until = trial.reference.size * trial.period
    inside: NDArray[np.bool_] = (first | (time >= 0.0)) & (last | (time < until))
    return inside


def _notes(trials: Sequence[Trial], names: Sequence[str]) -> list[str]:
    """Every note once, with the recordings that it is about where these are not all."""
    about: dict[str, list[str]] = {}
    for name, trial in zip(names, trials, strict=True):
        for note in trial.notes:
            about.setdefault(note, []).append(name)
    return [n if len(of) == len(trials) else f"{', '.join(of)}: {n}" for n, of in about.items()]
