"""From bags to a problem that can be searched: outliers out, noise estimated, nominal fitted."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from hannes_bags.reading import read_bag
from hannes_bags.storage import existing, find_bags
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_sim.effect import call_own
from numpy.typing import NDArray

from .adapter import check_rig, check_trials, current_is_known, other_units
from .blocks import in_blocks, told_apart
from .drift import drift_of, drift_together
from .features import Features, build_features
from .fit import fit
from .frozen import without_frozen
from .gaps import misses_samples
from .grasp import with_seen_objects
from .hand import HandRig, other_plant
from .join import Loaded, join_repeats, join_trials
from .lags import with_one_clock
from .law_check import law_notes
from .own_law import check_own_code
from .problem import Problem, build_problem, nuisance_coordinate
from .recorded import compared, trial_of
from .report_text import listed
from .rig import Nuisance, PlantRig, Rig, check_parameters
from .settle import settle
from .surrogate import rig_for
from .trials import SIGNALS, Closure, NoClosure, OfAll, Trial, curves_of, stem_of, unique_names
from .units import in_si

OUTLIER = 6.0
"""A closure whose distance from the median closure exceeds this multiple of the median distance is left out."""

FIRST_APART = 3.0
"""The same from which it is said that the first closure of a recording, which stays, is unlike the others: the machine
began elsewhere, in its slack, its friction or its grease."""

NOISELESS = 1e-4
"""Part of a signal's span within which closures without noise repeat each other: a simulator's in lock-step."""

BEGAN_ELSEWHERE = 2.5e-3
"""Part of the reference's span by which the position is off it when such a recording begins, from which on the first
closure, if it is not as the others, is left out: nothing scatters, and a fit would take that for an effect."""

FEW = 5
"""Closures of a condition below which its scatter is no more than guessed, and no test is made (compare.py)."""


@dataclass(frozen=True)
class Prepared:
    """A data set, ready: the rig, the statistical problem and the nuisance parameters of a model."""

    rig: PlantRig
    model: Model
    features: Features
    problem: Problem
    nuisances: tuple[Nuisance, ...]
    notes: tuple[str, ...]


def load_trials(
    paths: Sequence[str | Path],
    signals: Sequence[str] = SIGNALS,
    scale: Mapping[str, float] | None = None,
    objects: Mapping[str, str] | None = None,
    topics: Mapping[str, str | None] | None = None,
) -> list[Trial]:
    """Trials of all bags below the paths; names are made unique.

    scale    factors to SI by signal name; other units and signs are guessed from all recordings together
    objects  what was grasped, by the name of the condition or of the bag; of several conditions in one bag by theirs
    topics   by signal name, the topic that carries it in all bags; None leaves the signal out
    Bags of a few closures each that repeat one condition become one trial (join.py).  Bags without a whole closure, and
    those that are there already, are left out with a note.
    """
    loaded: list[Loaded] = []
    empty: list[NoClosure] = []
    left_out: list[str] = []
    bags = find_bags(paths)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the reader's warnings are kept in the trial's notes
        read = [compared(read_bag(bag, topics=topics), signals) for bag in bags]
    for bag, recording in zip(bags, in_si(read, scale or {}), strict=True):
        try:
            trial = without_frozen(trial_of(recording))
        except NoClosure as none:
            empty.append(none)
            left_out.append(f"'{bag}': {none}")
            continue
        twin = next((one.trial for one in loaded if one.trial.sha256 == trial.sha256 != ""), None)
        if twin is not None:
            left_out.append(f"'{bag}' is the same recording as '{twin.source}'")
            continue
        condition = recording.metadata.get("condition")
        step = recording["reference_position"].period
        given = objects or {}
        for part in in_blocks(told_apart(trial)):
            said = [given[name] for name in (part.name, stem_of(str(bag)), trial.name) if name in given]
            if said:
                part = _with_said(part, said[0])
            loaded.append(Loaded(part, None if condition is None else str(condition), step))
    if not loaded:
        raise empty[0] if empty else HannesError("No bag was given.")
    first, *others = unique_names(join_repeats(loaded))
    return [replace(first, notes=(*first.notes, *(OfAll(f"left out: {why}") for why in left_out))), *others]


def _with_said(trial: Trial, given: str) -> Trial:
    """The trial with the object that the user says, and a note where the recording says something else."""
    there = trial.options.get("object")
    other = there.get("name", "something else") if isinstance(there, Mapping) else there
    note = f"it was said that its object is {given}, but the recording itself says {other}; taken as said"
    notes = trial.notes if other in (None, given) else (*trial.notes, note)
    return replace(trial, options={**trial.options, "object": given}, notes=notes)


def read_trials(rig: type[PlantRig], paths: Sequence[Path]) -> list[Trial]:
    """Trials of the files that a rig's adapter reads, checked."""
    found = call_own(f"{rig.__name__}.read", rig.read, [existing(path, "recording") for path in paths])
    return check_trials(found, rig.__name__)


def as_compared(
    trials: Sequence[Trial],
    rig: type[PlantRig] | None,
    leave_out: Mapping[str, Sequence[int]] | None = None,
    *,
    typical: bool = False,
) -> Sequence[Trial]:
    """Trials as they are held against a model, without closures far from the others.

    Those of a rig are checked; those that repeat one condition become one, with closures that begin at the same moment.

    leave_out  closures that the user does not want, by condition: numbers from 1 on
    typical  closures far from the others are left out already
    """
    if rig is not None:
        sound = [without_frozen(trial) for trial in check_trials(trials, rig.__name__)]
        trials = [trial.aligned() for trial in join_trials(sound)]
    if not typical:
        trials = [without_outliers(trial) for trial in trials]
    # Numbers are those of `hannes trials`, which shows what is left of them.
    return without_named(trials, leave_out) if leave_out else trials


def without_named(trials: Sequence[Trial], given: Mapping[str, Sequence[int]]) -> list[Trial]:
    """Leave out the closures that the user names: numbers, from 1 on, by condition."""
    known = {name for trial in trials for name in trial.conditions}
    for name in given:
        if name not in known:
            raise HannesError(
                f"--leave-out names the unknown condition '{name}'; these recordings have {', '.join(sorted(known))}."
            )
    out = []
    for trial in trials:
        gone: set[int] = set()
        notes = []
        for name in (name for name in given if name in trial.conditions):
            own, numbers = trial.numbers[name], sorted(set(given[name]))
            if numbers[-1] > len(own):
                raise HannesError(f"--leave-out {name}={numbers[-1]}: '{name}' has {len(own)} closures only.")
            if len(numbers) == len(own):
                raise HannesError(
                    f"--leave-out leaves no closure of '{name}'; leave its recordings out instead."
                )
            gone.update(own[number - 1] for number in numbers)
            named = [
                f"{n} of '{name}', at {max(trial.closures[own[n - 1]].start, 0.0):.1f} s" for n in numbers
            ]
            notes.append(f"left out, as asked for: closure {listed(named)}")
        needed = {k for k in gone if _is_simulated(trial, trial.closures[k])}
        if needed:
            raise HannesError(
                f"--leave-out: closure {min(needed) + 1} of '{trial.name}' is of '{trial.parts[0].source}', which the "
                "other recordings of that condition repeat: leave that recording out instead."
            )
        kept = [closure for k, closure in enumerate(trial.closures) if k not in gone]
        out.append(replace(trial, closures=tuple(kept), notes=(*trial.notes, *notes)) if gone else trial)
    return out


def _is_simulated(trial: Trial, closure: Closure) -> bool:
    """Whether it is of the recording as which the others, that begin anew, are simulated: the most typical of them."""
    return trial.anew and closure.start < trial.parts[1].begin


def without_outliers(trial: Trial) -> Trial:
    """Leave out closures that are far from the others of their condition (at least five closures needed).

    Of closures without noise the first one, where the hand was elsewhere when the recording began.
    """
    kept: list[Closure] = []
    dropped: list[Closure] = []
    said: list[str] = []
    apart: dict[str, float] = {}
    elsewhere: list[str] = []
    for condition in trial.conditions:
        closures = trial.of(condition)
        if len(closures) < 5:
            kept += list(closures)
            continue
        if not _is_simulated(trial, closures[0]) and _began_elsewhere(trial, closures):
            elsewhere.append(condition)
            kept += closures[1:]
            continue
        distance = np.zeros(len(closures))
        for time, values in trial.signals.values():
            curves = curves_of(closures, time, values)
            away = _distances(curves, curves)
            distance = np.maximum(
                distance, away / max(float(np.median(away)), 1e-3 * float(np.ptp(curves)), 1e-12)
            )
        for closure, far in zip(closures, distance, strict=True):
            (dropped if far > OUTLIER and not _is_simulated(trial, closure) else kept).append(closure)
        if FIRST_APART < distance[0] <= OUTLIER:
            apart[condition] = float(distance[0])
    if apart:
        several = len(trial.conditions) > 1
        of = f" of {listed([repr(c) for c in apart])}" if several else ""
        is_, it = ("is", "it stays") if len(apart) == 1 else ("are", "they stay")
        said.append(
            f"the first closure{of} {is_} {listed([f'{far:.1f}' for far in apart.values()])} times as far from the "
            f"median closure as half of them are: {it} (from {OUTLIER:g} times on one is left out) and count"
            f"{'s' if len(apart) == 1 else ''} as scatter, and errors look small against that (--leave-out "
            f"{next(iter(apart))}=1 leaves it out)"
        )
    if dropped:
        several = len(trial.conditions) > 1
        note = f"{len(dropped)} closure(s) far from the others are left out, starting at " + ", ".join(
            f"{max(c.start, 0.0):.1f} s{f' ({c.condition})' if several else ''}{_missing(trial, c)}"
            for c in dropped
        )
        said.insert(0, note)
    if elsewhere:
        of = f" of {listed([repr(c) for c in elsewhere])}" if len(trial.conditions) > 1 else ""
        said.append(
            f"the first closure{of} is left out: the others repeat to {100 * NOISELESS:g} % of each signal's span, and "
            "it does not: the hand was elsewhere when it began"
        )
    if not said:
        return trial
    return replace(trial, closures=tuple(sorted(kept, key=lambda c: c.start)), notes=(*trial.notes, *said))


def _distances(curves: NDArray[np.float64], among: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square distance of each curve (n, p) from the median of some of them: (n,)."""
    return np.asarray(np.sqrt(((curves - np.median(among, axis=0)) ** 2).mean(axis=1)))


def _began_elsewhere(trial: Trial, closures: Sequence[Closure]) -> bool:
    """Whether closures repeat as a simulator's without noise do, but for the first, which began off the reference.

    A simulated hand that was moved before the recording does; one that was started for it begins at rest at nought.
    """
    place = trial.signals.get("encoder_position")
    if place is None:
        return False
    start = max(closures[0].start, 0.0)
    off = float(np.interp(start, *place)) - float(trial.reference[round(start / trial.period)])
    if abs(off) <= BEGAN_ELSEWHERE * trial.span:
        return False
    first = 0.0
    for time, values in trial.signals.values():
        curves = curves_of(closures, time, values)
        away = _distances(curves, curves[1:]) / (float(np.ptp(curves)) or 1.0)
        if away[1:].max() > NOISELESS:
            return False
        first = max(first, float(away[0]))
    return first > NOISELESS


def _missing(trial: Trial, closure: Closure) -> str:
    """Of which signals samples are missing in a closure, behind its start."""
    short = [n for n, (time, _) in trial.signals.items() if misses_samples(time, closure.start, closure.stop)]
    return f" (samples of {' and '.join(short)} are missing in it)" if short else ""


def prepare(
    trials: Sequence[Trial],
    model: Model,
    *,
    rig: type[PlantRig] | None = None,
    signals: Sequence[str] | None = None,
    surrogate: bool = False,
    threads: int = 1,
    typical: bool = False,
    leave_out: Mapping[str, Sequence[int]] | None = None,
) -> Prepared:
    """Estimate noise and scatter at the fitted nominal model.

    rig      the class of another machine's rig; the hand's if None
    signals  which signals take part; all that are there if None
    surrogate  search a slow plant through a fast one (surrogate.py); `rig` of the result is the exact one
    threads  among which the slow plant's simulations are divided while this process works alone
    typical  closures far from the others are left out already
    leave_out  see as_compared
    """
    trials = as_compared(trials, rig, leave_out, typical=typical)
    made: PlantRig = (rig or HandRig)(trials)
    check_parameters(made, model)
    check_own_code(made, model)
    if rig is None:
        trials = with_seen_objects(with_one_clock(trials, model), model)
        made = HandRig(trials)
    wired = "wire.stiffness" in model.names and model.named("wire.stiffness").value > 0.0
    made.one_mass = model.plant == "reduced" and not wired
    told = [] if isinstance(made, HandRig) else [*check_rig(made), *law_notes(made, model)]
    features = build_features(
        trials, _present(trials, signals), made.points, made.finest, made.same, made.coarse
    )
    nuisances = tuple(made.nuisances(model))
    coordinates = [nuisance_coordinate(n) for n in nuisances]
    view = rig_for(made, model, coordinates, threads) if surrogate else made
    problem = build_problem(view, features, model, nuisances, {})
    found = fit(problem, model, coordinates, {}, evaluations=15)
    # Near is enough for the noise; the search fits the model as it is again, to the end.
    settled, found = settle(problem, found, moves=3)
    problem = build_problem(settled.rig, features, model, nuisances, found.values, problem.counts)
    if isinstance(made, HandRig):
        of_plant = other_plant(trials, model)
    else:
        of_plant = [*told, *other_units(made, model, features), *_nominal_of_another(model)]
    notes = (*notes_of(trials), *of_plant, *_what_is_missing(trials, features, made, model))
    return Prepared(made, model, features, problem, nuisances, tuple(dict.fromkeys(notes)))


def _present(trials: Sequence[Trial], signals: Sequence[str] | None) -> list[str]:
    """Which signals take part: those that are asked for, or all that are there; HannesError for one that is not."""
    known = dict.fromkeys((*SIGNALS, "motor_effort", *(s for t in trials for s in t.signals)))
    present = [s for s in (signals or known) if any(s in t.signals for t in trials)]
    unknown = [s for s in signals or () if s not in present]
    if unknown:
        there = dict.fromkeys(s for t in trials for s in t.signals)
        raise HannesError(f"No recording has the signal {', '.join(unknown)}; they have {', '.join(there)}.")
    return present


def _nominal_of_another(model: Model) -> list[str]:
    """A note where a rig's model names no parameters, and so has the hand's."""
    if model.base != Model.base:
        return []
    return [
        f"the parameters of model '{model.name}' are the Hannes hand's, for it names no others: give its model file a "
        "line `parameters: FILE.yaml`"
    ]


def _what_is_missing(trials: Sequence[Trial], features: Features, rig: Rig, model: Model) -> list[str]:
    """What these recordings cannot say: conditions, signals and closures that are not there, closures that drift."""
    present = dict.fromkeys(block.signal for block in features.blocks)
    notes = []
    if len(features.conditions) < 2:
        notes.append(
            "there is one condition only: what fits it may fail elsewhere; record another speed, and another load"
        )
    if not (any(signal in present for signal in rig.drive_signals) or current_is_known(rig, model)):
        drive = (*rig.drive_signals, "motor_current")[0].removeprefix("motor_").replace("_", " ")
        only = "" if isinstance(rig, HandRig) else f" (only {', '.join(present)})"
        notes.append(
            f"no {drive} is recorded{only}: friction, torque constant and inertia are hard to tell apart"
        )
    if "encoder_position" not in present:
        notes.append(
            "no encoder position is recorded: sensor offsets, slack and backlash cannot be told apart, and the "
            "period of a ripple is hard to find"
        )
    for signal in present:
        where = [trial.name for trial in trials if signal in trial.signals]
        if len(where) < len(trials):
            notes.append(f"{signal} is recorded only in {', '.join(where)}")
    notes += drifts(features, rig.machine)
    if exact := {block.signal: None for block in features.blocks if block.known_to}:
        notes.append(
            f"{listed(list(exact))} repeat{'s' if len(exact) == 1 else ''} as those of a simulator without noise do: "
            f"{100.0 * rig.coarse:g} % of the span counts as scatter, for what sensors round is the same in each"
        )
    single = [c for c, n in features.closures_of.items() if n == 1]
    if single:
        notes.append(
            f"one closure of {', '.join(single)}: how well it repeats is not known, and what the fit takes for scatter "
            f"is a guess, from the tolerances and the rig's `floor` ({rig.floor:g} of each signal's span)"
        )
    few = [c for c, n in features.closures_of.items() if 1 < n < FEW]
    if few:
        notes.append(
            f"fewer than five closures of {', '.join(few)}: what the fit takes for scatter is a guess from the priors "
            "in part, and no error is called beyond chance"
        )
    return notes


def notes_of(trials: Sequence[Trial]) -> list[str]:
    """What is to be said of the recordings; what is said of several of them stands once, with all their names.

    What is of no recording alone stands without the name of the one that carries it.
    """
    of: dict[str, list[str]] = {}
    for trial in trials:
        for note in trial.notes:
            of.setdefault(note, []).append(trial.name)
    return [
        str(note) if isinstance(note, OfAll) else f"{', '.join(dict.fromkeys(names))}: {note}"
        for note, names in of.items()
    ]


def drifts(features: Features, machine: str = "hand") -> list[str]:
    """A sentence for each condition whose closures change steadily from the first to the last, or for all together."""
    out = []
    advice = (
        f"which the repeatability holds for chance: let the {machine} warm up or run in, then record again"
    )
    for condition in features.conditions:
        own = {block.signal: drift_of(block) for block in features.blocks if block.condition == condition}
        if any(own.values()):
            shares = ", ".join(
                f"{100.0 * share:.0f} % of the scatter of {signal}" for signal, share in own.items() if share
            )
            out.append(f"{condition}: the closures drift from the first to the last ({shares}), {advice}")
    return out or _drifts_together(features, advice)


def _drifts_together(features: Features, advice: str) -> list[str]:
    """The same of all conditions, where none shows it alone."""
    curves: dict[str, list[NDArray[np.float64]]] = {}
    for block in features.blocks:
        # Of recordings that begin anew the most typical one stands first, the others in their order.
        trial = features.trials[block.trial]
        first = sum(c.start < trial.parts[1].begin for c in trial.closures) if trial.anew else 0
        curves.setdefault(block.signal, []).append(block.measured[first:])
    shares = {signal: drift_together(own) for signal, own in curves.items() if len(own) > 1}
    said = ", ".join(f"{100.0 * share:.0f} % of the scatter of {s}" for s, share in shares.items() if share)
    return (
        [f"in all conditions alike the closures drift from the first to the last ({said}), {advice}"]
        if said
        else []
    )
