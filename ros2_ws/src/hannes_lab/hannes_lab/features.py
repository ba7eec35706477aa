"""From signals to what the fit sees: per condition and signal the mean closure and its drift over the closures.

A feature vector is linear in the signals, and the same for measurement and simulation: each closure is sampled at the
measured instants, interpolated onto a phase grid, and combined over the closures.  The simulation of a model without
memory repeats itself from the second closure of a condition on, so it ends with the second of each and the rest is
taken from that; where the second does not end as the first did, a rig simulates more (`PlantRig`).  Recordings that
each begin anew repeat the first of them.  Where the references of the closures differ a little (an operator's
amplitude), so do the closures: by how much is taken from one whole simulation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_sim.effect import load_effect
from hannes_sim.plant import PlantDiverged
from numpy.typing import NDArray

from .repeats import end_of
from .rig import Rig
from .trials import SAME, Closure, Trial

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MAX_PHASES = 160
"""Points of the phase grid of one closure at most."""

MIN_CLOSURES_FOR_DRIFT = 4

EXACT = 1e-9
FINEST = 1e-5
"""Of a signal's span.  Closures that differ by no more than the first are those of a simulator without noise, which
repeats itself bit for bit; they are taken to be known by the second, as by a sensor of 17 bits, or as another machine's
rig says (`finest`)."""

NOISELESS = 0.1
"""Scatter between closures, as a part of what stands for it then (Block.coarse), up to which it is no noise."""

NEARLY = 0.02
"""Mean difference of the references of two closures, in their span, up to which one repeats the other but for a
difference that hardly depends on the model."""


def alike(closures: Array) -> Array:
    """Closures (n, p) without the first of four or more, which starts from another state than the others."""
    return closures[1:] if closures.shape[0] >= 4 else closures


@cache
def _mean_and_drift(n: int) -> Array:
    """(2, n): what makes of n closures their mean and their change from the first to the last."""
    ramp = np.linspace(-0.5, 0.5, n)
    return np.stack([np.full(n, 1.0 / n), ramp / (ramp @ ramp)])


@dataclass(frozen=True)
class Block:
    """One signal of one condition of one trial.

    phase      (p,) s since the closure's start
    measured   (n, p) the closures on the phase grid
    full       three arrays (n, p): of each point the ticks of the simulation before and after it, and the weight of the
               one after
    compact    the same three for a simulation of the closures only that others repeat; None where that does not hold
    beside     (n, p) what closures differ by from those of a compact simulation, where they repeat each other nearly
    finest     of the signal's span: scatter that is assumed where closures are all the same
    coarse     of the signal's span: scatter that is assumed where closures scatter by next to nothing against it; 0:
               they are taken as they are
    """

    trial: int
    condition: str
    signal: str
    phase: Array
    measured: Array
    full: tuple[Index, Index, Array]
    compact: tuple[Index, Index, Array] | None
    unit: str = ""
    finest: float = FINEST
    coarse: float = 0.0
    beside: Array | None = None

    @property
    def n(self) -> int:
        return int(self.measured.shape[0])

    @property
    def alike(self) -> Array:
        """The closures without the first of four or more, which starts from another state than the others."""
        return alike(self.measured)

    @property
    def floor(self) -> float:
        """Scatter that is assumed of closures that are, or nearly are, all the same, in the signal's unit; 0 of
        others."""
        return self.floor_in(slice(None))

    def floor_in(self, phases: slice | NDArray[np.bool_]) -> float:
        """The same of a part of the phases: a coarse sensor shows the same again and again while nothing moves."""
        span = float(np.ptp(self.measured))
        same = self.n > 1 and float(np.ptp(self.alike[:, phases], axis=0).max()) <= EXACT * span
        return max(self.finest * span if same else 0.0, self.known_to)

    @cached_property
    def known_to(self) -> float:
        """What stands for the scatter of closures that repeat as those of a simulator without noise do; 0 of others.

        They differ by rounding alone, and what its sensors round away is the same in each: no model that does not round
        likewise comes as near as they repeat.
        """
        width = self.coarse * float(np.ptp(self.measured))
        if not (width and self.n > 1):
            return 0.0
        scatter = float(np.sqrt(self.alike.var(axis=0, ddof=1).mean()))
        return width if scatter <= NOISELESS * width else 0.0

    @property
    def size(self) -> int:
        """Number of features: the mean closure, and its drift if there are enough closures."""
        return self.phase.size * (2 if self.n >= MIN_CLOSURES_FOR_DRIFT else 1)

    def combine(self, closures: Array) -> Array:
        """Features (size,) of closures (n, p): the mean, then the change from the first to the last (linear trend)."""
        if self.n < MIN_CLOSURES_FOR_DRIFT:
            return np.asarray(closures.mean(axis=0))
        return (_mean_and_drift(self.n) @ closures).ravel()

    def predicted(self, ticks: Array, compact: bool) -> Array:
        """Closures (n, p) from a simulated signal on the control grid."""
        before, after, weight = self.compact if compact and self.compact is not None else self.full
        closures: Array = ticks[before] * (1.0 - weight) + ticks[after] * weight
        return closures + self.beside if compact and self.beside is not None else closures


@dataclass(frozen=True)
class Features:
    """The operator from trials to features; build it once per data set.

    blocks         one per trial, condition and signal
    ends           per trial, ticks that a compact simulation needs (None: it must be simulated whole)
    nearly         trials whose closures repeat each other only nearly: a compact simulation will do where `beside` is
                   known (see `compacted`)
    """

    trials: tuple[Trial, ...]
    blocks: tuple[Block, ...]
    ends: tuple[int | None, ...]
    nearly: tuple[int, ...] = ()
    slices: tuple[slice, ...] = field(default=())
    _wanted: tuple[tuple[str, ...], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        at, slices = 0, []
        for block in self.blocks:
            slices.append(slice(at, at + block.size))
            at += block.size
        object.__setattr__(self, "slices", tuple(slices))
        wanted: list[dict[str, None]] = [{} for _ in self.trials]
        for block in self.blocks:
            wanted[block.trial][block.signal] = None
        object.__setattr__(self, "_wanted", tuple(tuple(names) for names in wanted))

    @property
    def size(self) -> int:
        return self.slices[-1].stop if self.slices else 0

    @property
    def conditions(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(block.condition for block in self.blocks))

    @property
    def units(self) -> frozenset[str]:
        """Of what is compared."""
        return frozenset(block.unit for block in self.blocks)

    @property
    def repeated(self) -> bool:
        """Whether anything was recorded more than once, so that there is a repeatability."""
        return any(block.n > 1 for block in self.blocks)

    @property
    def closures_of(self) -> dict[str, int]:
        """Closures by condition, of the signal of which there are most."""
        out: dict[str, int] = {}
        for block in self.blocks:
            out[block.condition] = max(out.get(block.condition, 0), block.n)
        return out

    @property
    def measured(self) -> Array:
        """Features of the measurement (size,)."""
        return np.concatenate([block.combine(block.measured) for block in self.blocks])

    def rows(self, condition: str) -> NDArray[np.bool_]:
        """Which features belong to a condition."""
        return self._rows([block.condition == condition for block in self.blocks])

    def rows_of(self, trial: int) -> NDArray[np.bool_]:
        """Which features belong to a trial, by its number."""
        return self._rows([block.trial == trial for block in self.blocks])

    def _rows(self, belongs: Sequence[bool]) -> NDArray[np.bool_]:
        """Which features are those of some blocks."""
        out = np.zeros(self.size, dtype=bool)
        for own, rows in zip(belongs, self.slices, strict=True):
            out[rows] = own
        return out

    def closures(self, rig: Rig, model: Model, values: Mapping[str, float]) -> list[Array]:
        """Predicted closures (n, p) of every block."""
        memory = has_memory(model)
        known = {block.trial for block in self.blocks if block.beside is not None}
        runs: list[tuple[Mapping[str, Array], bool]] = []
        for number, (trial, end) in enumerate(zip(self.trials, self.ends, strict=True)):
            compact = end is not None and (trial.anew or not memory)
            compact &= number not in self.nearly or number in known
            runs.append(self.simulated(rig, model, values, number, whole=not compact))
        out = [
            block.predicted(runs[block.trial][0][block.signal], runs[block.trial][1]) for block in self.blocks
        ]
        for block, closures in zip(self.blocks, out, strict=True):
            if not np.isfinite(closures).all():
                raise PlantDiverged(
                    f"{_logged(rig)} makes '{block.signal}' of trial '{self.trials[block.trial].name}' NaN or infinite "
                    f"in condition '{block.condition}': it must give finite numbers wherever the machine moves."
                )
        return out

    def simulated(
        self, rig: Rig, model: Model, values: Mapping[str, float], number: int, *, whole: bool = False
    ) -> tuple[Mapping[str, Array], bool]:
        """Signals of a trial, at the control ticks, and whether they end before the trial does.

        They last as long as is needed for a closure of each condition that is not its first, or are whole.
        """
        trial, end = self.trials[number], None if whole else self.ends[number]
        references = np.split(trial.reference, trial.anew_at) if end is None else [trial.reference[:end]]
        runs = [rig.simulate(model, values, trial, reference) for reference in references]
        for signals, reference in zip(runs, references, strict=True):
            check_simulated(signals, self._wanted[number], trial, reference.size, rig)
        if len(runs) == 1:
            return runs[0], end is not None and not _whole(runs[0], trial)
        shared = set.intersection(*(set(run) for run in runs))
        return {name: np.concatenate([run[name] for run in runs]) for name in shared}, False

    def compacted(self, rig: Rig, model: Model, values: Mapping[str, float]) -> Features:
        """The same, so that compact simulations will do where closures repeat each other nearly.

        What they differ by is taken from a whole simulation at these values.  A model with a memory, or one that
        diverges or does not come back to where it was, does not tell it: then what was known before stays.
        """
        if not self.nearly or has_memory(model):
            return self
        blocks = list(self.blocks)
        for number in self.nearly:
            try:
                short, compact = self.simulated(rig, model, values, number)
                if not compact:
                    continue
                whole, _ = self.simulated(rig, model, values, number, whole=True)
            except PlantDiverged:
                continue
            for k, block in enumerate(blocks):
                if block.trial == number:
                    bare = replace(block, beside=None)
                    beside = bare.predicted(whole[block.signal], False) - bare.predicted(
                        short[block.signal], True
                    )
                    if np.isfinite(beside).all():
                        blocks[k] = replace(block, beside=beside)
        return replace(self, blocks=tuple(blocks), slices=())

    def predict(self, rig: Rig, model: Model, values: Mapping[str, float]) -> Array:
        """Features of the model (size,)."""
        closures = self.closures(rig, model, values)
        return np.concatenate([b.combine(c) for b, c in zip(self.blocks, closures, strict=True)])


def _logged(rig: Rig) -> str:
    return f"{type(rig).__name__}.logged"


def kind_of(value: object) -> str:
    """What a value of the wrong type is, in words."""
    return "nothing (None)" if value is None else f"a {type(value).__name__}"


def check_simulated(
    signals: Mapping[str, Array], wanted: Sequence[str], trial: Trial, ticks: int, rig: Rig
) -> None:
    """Raise HannesError where a rig does not give a number per tick for each signal that is compared.

    ticks  of the reference; a rig may give the whole trial instead
    """
    who = f"{_logged(rig)}, trial '{trial.name}'"
    if not isinstance(signals, Mapping):
        raise HannesError(
            f"{who}: it returned {kind_of(signals)}; it must return a mapping of signals, name -> values."
        )
    missing = [name for name in wanted if name not in signals]
    if missing:
        raise HannesError(
            f"{who}: it gives no {', '.join(missing)}, which was recorded; it gives {', '.join(signals) or 'nothing'}. "
            "Return what that logger shows of a simulation, under the name that the trial has, or leave the signal out "
            "of the trial."
        )
    for name in wanted:
        shape = np.shape(signals[name])
        if not isinstance(signals[name], np.ndarray) or shape not in ((ticks,), (trial.reference.size,)):
            raise HannesError(
                f"{who}: it gives '{name}' as {type(signals[name]).__name__} of shape {shape}; it must be an array "
                f"with one value for each of the {ticks} control periods."
            )


def _whole(signals: Mapping[str, Array], trial: Trial) -> bool:
    """True where a rig gave the whole trial though it was asked for its first closures."""
    return all(signals[name].size == trial.reference.size for name in trial.signals if name in signals)


def has_memory(model: Model) -> bool:
    """True where an effect of the model makes later closures differ from the second."""
    return any(load_effect(effect.source or effect.name).memory for effect in model.effects)


def build_features(
    trials: Sequence[Trial],
    signals: Sequence[str],
    points: int = MAX_PHASES,
    finest: float = FINEST,
    same: float = SAME,
    coarse: float = 0.0,
) -> Features:
    """The operator for these trials and signals, with at most `points` phases to a closure.

    finest, coarse  see Block
    same    see Rig
    Raises HannesError where no trial has any of the signals.
    """
    blocks: list[Block] = []
    ends: list[int | None] = []
    for number, trial in enumerate(trials):
        end = compact_end(trial)
        ends.append(end)
        for condition in trial.conditions:
            for signal in signals:
                if signal in trial.signals:
                    block = _block(trial, number, condition, signal, end, points, finest, coarse)
                    if block is not None:
                        blocks.append(block)
    if not blocks:
        raise HannesError(
            f"None of the signals {', '.join(signals)} covers a whole closure in these recordings."
        )
    nearly = [k for k, end in enumerate(ends) if end is not None and compact_end(trials[k], same) is None]
    return Features(tuple(trials), tuple(blocks), tuple(ends), tuple(nearly))


def compact_end(trial: Trial, most: float = NEARLY) -> int | None:
    """Ticks up to the end of the last closure that others repeat, if those have (nearly) its reference.

    most  mean difference of the references, in their span
    """
    bases = set(trial.repeats)
    alone = len(trial.closures) <= len(bases) or (trial.anew and len(trial.conditions) != 1)
    # Conditions one after the other: what is simulated holds most closures, which need not repeat the second.
    alone |= not trial.anew and max(bases) + 1 > len(bases)
    if alone or not trial.in_turn or trial.apart > most:
        return None
    return end_of(trial, max(bases) + 1)


def stands_for_all(trial: Trial) -> bool:
    """False where parts begin anew, but a simulation of the first would not be one of the others."""
    if not trial.anew:
        return True
    later = [c for c in trial.closures if trial.part_of(c) > 0]
    return not later or compact_end(trial) is not None


def _block(
    trial: Trial,
    number: int,
    condition: str,
    signal: str,
    limit: int | None,
    most: int,
    finest: float,
    coarse: float,
) -> Block | None:
    time, values = trial.signals[signal]
    closures = trial.of(condition)
    length = min(c.stop - c.start for c in closures)
    step = float(np.median(np.diff(time))) if time.size > 1 else length
    points = int(min(most, max(8, round(length / step))))
    phase = (np.arange(points) + 0.5) * (length - step) / points
    ticks = trial.reference.size
    sample_tick = np.clip(np.floor(time / trial.period + 1e-4).astype(np.int64), 0, ticks - 1)
    full: list[tuple[Index, Index, Array]] = []
    compact: list[tuple[Index, Index, Array]] = []
    measured = []
    bases = [
        trial.closures[k]
        for k, c in zip(trial.repeats, trial.closures, strict=True)
        if c.condition == condition
    ]
    for closure, base in zip(closures, bases, strict=True):
        at = closure.start + phase
        right = np.searchsorted(time, at)
        if right[0] == 0 or right[-1] >= time.size:
            inside = (at >= time[0] - step) & (at <= time[-1] + step)
            if not inside.all():
                continue
            right = np.clip(right, 1, time.size - 1)
        first, last = _own_samples(trial, closure, time)
        if first < last:  # no line goes from the end of one recording to the begin of the next
            right = np.clip(right, first + 1, last)
        left = right - 1
        weight = np.clip((at - time[left]) / np.maximum(time[right] - time[left], 1e-12), 0.0, 1.0)
        measured.append(values[left] * (1.0 - weight) + values[right] * weight)
        full.append((sample_tick[left], sample_tick[right], weight))
        if limit is not None:
            here = round(base.start / trial.period)
            shift = 0 if closure is base else here - trial.same_place(closure, base)
            compact.append(
                (
                    np.clip(sample_tick[left] + shift, 0, limit - 1),
                    np.clip(sample_tick[right] + shift, 0, limit - 1),
                    weight,
                )
            )
    if not measured:
        return None

    def stack(parts: list[tuple[Index, Index, Array]]) -> tuple[Index, Index, Array]:
        a, b, w = zip(*parts, strict=True)
        return np.array(a), np.array(b), np.array(w)

    return Block(
        number,
        condition,
        signal,
        phase,
        np.array(measured),
        stack(full),
        stack(compact) if compact else None,
        trial.unit(signal),
        finest,
        coarse,
    )


def _own_samples(trial: Trial, closure: Closure, time: Array) -> tuple[int, int]:
    """Numbers of the first and the last sample of the recording that a closure of a joined trial is of."""
    begins, part = [part.begin - 1e-9 for part in trial.parts], trial.part_of(closure)
    first = int(np.searchsorted(time, begins[part])) if part > 0 else 0
    last = int(np.searchsorted(time, begins[part + 1])) if part + 1 < len(begins) else time.size
    return first, last - 1


def _each(texts: Iterable[str]) -> str:
    """Each text once, those that say nothing left out."""
    return ", ".join(filter(None, dict.fromkeys(texts)))


def data_used(features: Features) -> tuple[dict[str, Any], ...]:
    """What data took part: per trial its conditions, closures and signals, and of which bags, by their hash, it is."""
    return tuple(
        {
            "name": t.name,
            "source": _each([p.source for p in t.parts]) or t.source,
            "sha256": _each([p.sha256 for p in t.parts]) or t.sha256,
            "conditions": list(t.conditions),
            "closures": len(t.closures),
            "signals": sorted(t.signals),
        }
        for t in features.trials
    )
