"""What a rig's adapter gives, checked where it enters the lab.

An adapter is a user's own code: whatever is wrong with its recordings, its simulated signals or its control law becomes
one error that says what, of which class, trial and signal, and what to do.  Nothing here knows that the machine is a
hand.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.signals import SIGNALS
from hannes_sim.effect import catalogue
from hannes_sim.plant import PlantDiverged
from hannes_sim.rollout import VoltagePlayback
from numpy.typing import NDArray

from .features import Features, kind_of, stands_for_all
from .gaps import has_gap, widest_gap
from .rig import REFERENCE_SIZES, PlantRig, Rig
from .trials import EARLY, Closure, NoClosure, OfAll, Part, Trial, left_out, unique_names
from .units import AGAINST, ENCODER, FOLLOWS, STANDS, follows

Array = NDArray[np.float64]
Samples = tuple[Array, Array]

OTHER_LENGTH = 2.0
LENGTH = 1.1
"""Times by which the reference and the signals may differ in length: more is another period, or time stamps that are
not in seconds.  From the second on it is said."""

FAR_OFF = 100.0
"""Times that a signal and its simulation may differ in range; a guessed mass or friction makes for less."""

OTHER_SIZE = 20.0
"""Times that a travel may differ from that of an adapter's `sizes`; degrees for rad are 57."""

SUPPLY, COMPENSATED = "supply.voltage", "motor.emf_compensated"

SHORTEST = 3.0
"""Control periods that a closure lasts at least."""

FEWEST = 2
"""Points to a closure with which there is anything to compare."""

OTHER_MOVE = 0.3
"""Mean difference of the references of two closures, in what they go over, from which one does not repeat the other."""

CLEARLY = 1.25
"""Times `floor` from which what rounding makes is worth a note."""

STANDS_STILL = 0.3
"""Part of the samples that are the one before again from which steps of a signal are no noise."""

LEVELS = 10
"""Different values of a signal at least: of fewer it may be a command that is switched."""

WHOLE = 0.05
"""Part of a step by which multiples of it may be off: logs have few digits."""


def check_rig(rig: Rig) -> list[str]:
    """Refuse what an adapter's class says wrongly, and give what it leaves out, in sentences."""
    if not isinstance(rig, PlantRig):
        return []
    who, sizes = type(rig).__name__, dict(rig.sizes)
    _check_grid(rig, who)
    _check_drive(rig, who)
    for token, size in sizes.items():
        if token not in REFERENCE_SIZES or not (_finite(size) and size > 0.0):
            raise HannesError(
                f"{who}.sizes: '{token}': {size!r}; it takes positive numbers for {', '.join(REFERENCE_SIZES)} (on a "
                "linear machine too, where they count as N and m)."
            )
    unknown = next((name for name in rig.without if name not in catalogue()), None)
    if unknown is not None:
        near = get_close_matches(unknown, catalogue(), 1)
        meant = f"; is '{near[0]}' meant?" if near else f": {', '.join(catalogue())}."
        raise HannesError(f"{who}.without names '{unknown}', which is no effect of the catalogue{meant}")
    figures = [f"{name}.{p.name}" for name, kind in catalogue().items() for p in kind.known]
    for name, value in rig.known.items():
        if name not in figures or not _finite(value):
            raise HannesError(f"{who}.known: '{name}': {value!r}; it takes numbers for {', '.join(figures)}.")
    notes = []
    if not sizes:
        usual = ", ".join(f"{size:g} {token}" for token, size in REFERENCE_SIZES.items() if token != "s")
        notes.append(
            f"{who} gives no `sizes`: the effects of the catalogue have bounds and typical values of a drive of {usual}"
        )
    return notes + _coarse(rig)


def _coarse(rig: PlantRig) -> list[str]:
    """Where the encoder is read in steps that are no noise and larger than `floor` takes for noise: at its worst."""
    read = [(trial, count_of(trial.signals[ENCODER][1])) for trial in rig.trials if ENCODER in trial.signals]
    parts = [
        (step / math.sqrt(12.0) / float(np.ptp(trial.signals[ENCODER][1])), step, trial)
        for trial, step in read
        if step > 0.0
    ]
    part, step, trial = max(parts, key=lambda one: one[0], default=(0.0, 0.0, None))
    if trial is None or part <= CLEARLY * rig.floor:
        return []
    return [
        f"{ENCODER} is read in steps of {step:.3g} {trial.unit(ENCODER)} in '{trial.name}': rounding alone is "
        f"{part:.2g} of its span, and the class's `floor` takes {rig.floor:g} for noise: make it {part:.1g}"
    ]


def count_of(values: Array) -> float:
    """The step in which a signal (n,) is logged; 0 where none is seen, or where noise goes over many steps."""
    levels = np.unique(values)
    gaps = np.diff(levels)
    if levels.size < LEVELS or np.mean(np.diff(values) == 0.0) < STANDS_STILL:
        return 0.0
    step = float(np.median(gaps[gaps < 1.5 * float(np.quantile(gaps, 0.1))]))
    off = np.abs(gaps / step - np.rint(gaps / step))
    return step if bool(np.all(off <= WHOLE)) else 0.0


def _check_grid(rig: PlantRig, who: str) -> None:
    if not (isinstance(rig.points, int | np.integer) and rig.points >= FEWEST):
        raise HannesError(
            f"{who}.points is {rig.points!r}; it is how many points of a closure are compared at most: a whole number, "
            f"at least {FEWEST}."
        )
    if not (_finite(rig.floor) and rig.floor > 0.0):
        raise HannesError(
            f"{who}.floor is {rig.floor!r}; it is a part of a signal's span, such as 2e-4: a number above 0."
        )


def _check_drive(rig: PlantRig, who: str) -> None:
    """Refuse names of drive signals that are no names, or another's misspelt."""
    names = rig.drive_signals
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise HannesError(
            f"{who}.drive_signals is {names!r}; it takes a tuple of names, such as ('motor_current',) with its "
            "comma, or () where no signal shows what the drive gives."
        )
    recorded = dict.fromkeys(s for trial in rig.trials for s in trial.signals)
    for name in names:
        near = get_close_matches(name, recorded, 1, 0.8)
        if near and name not in (*SIGNALS, *recorded):
            raise HannesError(
                f"{who}.drive_signals names '{name}', which is no signal of the recordings; they have "
                f"{', '.join(recorded)}: is '{near[0]}' meant?"
            )


def _finite(value: Any) -> bool:
    """Whether a value is a number that is one."""
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return number and math.isfinite(value)


def check_trials(found: object, rig: str) -> list[Trial]:
    """The trials that an adapter's `read` returned, in plain arrays, closures with gaps left out.

    rig   name of the adapter's class
    Raises HannesError for whatever cannot be compared with a simulation.
    """
    given = [found] if isinstance(found, Trial) else found
    if isinstance(found, Trial | str | Mapping) or not isinstance(given, Iterable):
        raise HannesError(
            f"{rig}.read returned {kind_of(found)}; it must return a list of trials, one for each recording."
        )
    trials = list(given)
    if not trials:
        raise HannesError(
            f"{rig}.read returned no trial: it found no recording in the files that were given."
        )
    strange = next((one for one in trials if not isinstance(one, Trial)), None)
    if strange is not None:
        raise HannesError(
            f"{rig}.read returned a list with {kind_of(strange)} in it; each must be a hannes_lab.trials.Trial."
        )
    kept: list[Trial] = []
    without: list[NoClosure] = []
    for trial in trials:
        try:
            kept.append(_checked(trial, f"{rig}, trial '{trial.name}'"))
        except NoClosure as none:
            without.append(none)
    if not kept:
        raise without[0]
    notes = (*kept[0].notes, *(OfAll(f"left out: {none}") for none in without))
    return unique_names([replace(kept[0], notes=notes), *kept[1:]], conditions=False)


def _checked(trial: Trial, where: str) -> Trial:
    period = _period(trial.period, where)
    reference = _numbers(trial.reference, f"{where}: the reference", "every control period needs one")
    signals = _signals(trial.signals, where)
    trial = replace(
        trial, period=period, reference=reference, signals=signals, closures=_closures(trial, where)
    )
    _check_times(trial, where)
    trial = _noticed(trial, where)
    _check_repeats(trial, where)
    _check_parts(trial, where)
    return trial


def _period(period: object, where: str) -> float:
    if isinstance(period, int | float | np.number) and math.isfinite(period) and period > 0.0:
        return float(period)
    raise HannesError(
        f"{where}: its period is {period!r}; it must be the control period in seconds, above 0."
    )


def _numbers(values: object, what: str, hint: str) -> Array:
    """A row of finite numbers."""
    try:
        row = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise HannesError(f"{what} must be a row of numbers, not {kind_of(values)} ({error}).") from error
    if row.ndim != 1:
        raise HannesError(f"{what} has the shape {row.shape}; it must be one row of numbers.")
    bad = np.flatnonzero(~np.isfinite(row))
    if bad.size:
        raise HannesError(
            f"{what} has {bad.size} of {row.size} values that are no numbers (NaN or infinite), the first at sample "
            f"{bad[0]}: {hint}."
        )
    return np.ascontiguousarray(row)


def _signals(signals: object, where: str) -> dict[str, tuple[Array, Array]]:
    if not isinstance(signals, Mapping) or not signals:
        raise HannesError(
            f"{where}: it has no signals, so nothing could be compared: give a mapping name -> (time, values)."
        )
    out = {}
    for name, given in signals.items():
        if not isinstance(given, Sequence) or isinstance(given, str) or len(given) != 2:
            raise HannesError(f"{where}: the signal '{name}' must be a pair (time, values).")
        hint = "leave such samples out in `read`, with their time stamps, or fill them"
        time = _numbers(given[0], f"{where}: the time of '{name}'", hint)
        values = _numbers(given[1], f"{where}: the signal '{name}'", hint)
        if time.size != values.size:
            raise HannesError(
                f"{where}: the signal '{name}' has {time.size} time stamps and {values.size} values; each value needs "
                "its time stamp."
            )
        if time.size < 2:
            raise HannesError(
                f"{where}: the signal '{name}' has {time.size} sample; nothing can be compared."
            )
        back = np.flatnonzero(np.diff(time) < 0.0)
        if back.size:
            k = int(back[0])
            raise HannesError(
                f"{where}: the time stamps of '{name}' go back from {time[k]:.6g} to {time[k + 1]:.6g} s at sample "
                f"{k + 1}: sort the samples by time."
            )
        out[str(name)] = (time, values)
    return out


def _closures(trial: Trial, where: str) -> tuple[Closure, ...]:
    """The closures, each with its number in its own recording."""
    closures = tuple(trial.closures)
    for number, closure in enumerate(closures):
        if not isinstance(closure, Closure):
            raise HannesError(
                f"{where}: closure {number + 1} is {kind_of(closure)}; give Closure(start, stop, condition)."
            )
        if not closure.stop - closure.start >= SHORTEST * trial.period * (1.0 - 1e-9):
            raise HannesError(
                f"{where}: closure {number + 1} ('{closure.condition}') runs from {closure.start:.6g} to "
                f"{closure.stop:.6g} s; it must stop later than it starts, by {SHORTEST:.0f} control periods of "
                f"{trial.period:.6g} s at least."
            )
    begins = np.array([part.begin for part in trial.parts])
    if begins.size and not (np.diff(begins) > 0.0).all():
        raise HannesError(f"{where}: its parts must begin one after the other.")
    of = [trial.part_of(c) for c in closures]
    if len({(c.number, part) for c, part in zip(closures, of, strict=True)}) == len(closures):
        return closures
    return tuple(replace(c, number=of[:k].count(of[k])) for k, c in enumerate(closures))


def _check_times(trial: Trial, where: str) -> None:
    """Reference, signals and closures have one time."""
    period, end = trial.period, (trial.reference.size - 1) * trial.period
    hint = f"are time stamps in seconds from the start of the reference, and is its period of {period:.6g} s right?"
    for name, (time, _) in trial.signals.items():
        if time[-1] < 0.0 or time[0] > end:
            raise HannesError(
                f"{where}: '{name}' was recorded from {time[0]:.6g} to {time[-1]:.6g} s, the reference from 0 to "
                f"{end:.6g} s; they do not overlap: {hint}"
            )
        if time[-1] - time[0] > OTHER_LENGTH * end:
            raise HannesError(
                f"{where}: '{name}' lasts {time[-1] - time[0]:.6g} s and the reference {end:.6g} s: {hint}"
            )
    longest = max(float(time[-1]) for time, _ in trial.signals.values())
    if end > OTHER_LENGTH * longest:
        raise HannesError(
            f"{where}: the reference lasts {end:.6g} s and all signals end at {longest:.6g} s: {hint}"
        )
    for number, closure in enumerate(trial.closures):
        if closure.start < -EARLY or closure.stop > end + 1.5 * period:
            raise HannesError(
                f"{where}: closure {number + 1} ('{closure.condition}') runs from {closure.start:.6g} to "
                f"{closure.stop:.6g} s, but the reference from 0 to {end:.6g} s: {hint}"
            )
    shortest = min(closure.stop - closure.start for closure in trial.closures)
    for name, (time, _) in trial.signals.items():
        step = float(np.median(np.diff(time)))
        if step > shortest:
            raise HannesError(
                f"{where}: '{name}' has a sample every {step:.3g} s, but a closure lasts {shortest:.3g} s only: {hint}"
            )


def _check_repeats(trial: Trial, where: str) -> None:
    """Closures of one condition repeat each other: moves there and back, under one name, would scatter by their way."""
    ticks = np.arange(trial.reference.size) * trial.period
    for condition in trial.conditions:
        first, *others = trial.of(condition)
        for other in others:
            phase = np.arange(0.0, min(c.stop - c.start for c in (first, other)), trial.period)
            one, two = (np.interp(c.start + phase, ticks, trial.reference) for c in (first, other))
            span = max(float(np.ptp(one)), float(np.ptp(two)))
            apart = float(np.abs(one - two).mean())
            if apart > OTHER_MOVE * max(span, STANDS * trial.span):
                raise HannesError(
                    f"{where}: the closures at {first.start:.6g} and {other.start:.6g} s are both '{condition}', but "
                    f"their references are {apart:.3g} apart in the mean and go over {span:.3g}: they do not repeat "
                    "one another. Give each move, and each direction, a condition of its own, and let repeats begin at "
                    "the same moment of it."
                )


def _covers(time: Array, closure: Closure) -> bool:
    step = float(np.median(np.diff(time)))
    return bool(time[0] - step <= closure.start + step and closure.stop - step <= time[-1] + step)


def _noticed(trial: Trial, where: str) -> Trial:
    """The trial without closures in which samples are missing; what else is strange of its times is said."""
    times = {name: time for name, (time, _) in trial.signals.items()}
    whole = tuple(
        c
        for c in trial.closures
        if not any(_covers(time, c) and has_gap(time, c.start, c.stop) for time in times.values())
    )
    notes = [left_out(len(trial.closures) - len(whole))] if len(whole) < len(trial.closures) else []
    end, longest = (trial.reference.size - 1) * trial.period, max(float(t[-1]) for t in times.values())
    if not 1.0 / LENGTH <= end / longest <= LENGTH:
        notes.append(
            f"the reference lasts {end:.4g} s, and the signals end at {longest:.4g} s: is its period of "
            f"{trial.period:.6g} s right?"
        )
    for name, time in times.items():
        count = sum(_covers(time, c) for c in whole)
        if not count and not any(_covers(time, c) for c in trial.closures):
            raise HannesError(
                f"{where}: '{name}' was recorded from {time[0]:.6g} to {time[-1]:.6g} s and covers no whole closure."
            )
        if not count:
            raise NoClosure(f"{where}: samples are missing in each of its closures{widest_gap(times)}.")
        if count < len(whole):
            notes.append(f"{name} covers {count} of {len(whole)} closures")
    told = tuple(note for note in notes if note not in trial.notes)
    return replace(trial, closures=whole, notes=(*trial.notes, *told))


def other_units(rig: Rig, model: Model, features: Features) -> list[str]:
    """What is recorded in another unit or sign than the model's, as far as sizes tell.

    The encoder against its reference, where the simulated one follows it; every other signal against its simulation,
    from which a guess of the parameters may be far off.  Of an adapter the encoder against its `sizes`.
    """
    out: dict[str, str] = {}
    travel = getattr(rig, "sizes", {}).get("rad")
    moves = [(t.signals[ENCODER][1], t.unit(ENCODER)) for t in features.trials if ENCODER in t.signals]
    if travel and moves:
        most = max(float(np.ptp(own)) for own, _ in moves)
        whole = max(float(own.max()) for own, _ in moves) - min(float(own.min()) for own, _ in moves)
        if most >= OTHER_SIZE * travel or whole <= travel / OTHER_SIZE:
            out["sizes"] = (
                f"{ENCODER} goes over {most:.3g} {moves[0][1]}, and the adapter's `sizes` say {travel:g}: is one of "
                "them in another unit? The bounds of effects follow from it"
            )
    for trial, end in zip(features.trials, features.ends, strict=True):
        try:
            simulated = rig.simulate(model, {}, trial, trial.reference[:end])
        except PlantDiverged:
            continue
        if said := _cut_off(rig, model, trial):
            out["supply"] = said
        for name, (time, values) in trial.signals.items():
            if name not in simulated or name in out:
                continue
            grid: Array = np.arange(simulated[name].size, dtype=np.float64) * trial.period
            reference = (grid, trial.reference[: grid.size])
            inside = time <= grid[-1]
            ours, theirs = (grid, simulated[name]), (time[inside], values[inside])
            said = _unlike(name, trial.unit(name), reference, ours, theirs)
            if said:
                out[name] = said
    return list(out.values())


def _plays_back(rig: Rig) -> bool:
    """Whether the last simulation was driven by what was recorded of the command, and not by a law."""
    return isinstance(getattr(rig, "law_used", None), VoltagePlayback)


def current_is_known(rig: Rig, model: Model) -> bool:
    """Whether that command was the current itself."""
    own = model.parameters
    return _plays_back(rig) and COMPENSATED in own and own.value(COMPENSATED) == 1.0


def _cut_off(rig: Rig, model: Model, trial: Trial) -> str | None:
    """That a command is played back of which the plant takes only a small part, if so."""
    if not (_plays_back(rig) and SUPPLY in model.parameters):
        return None
    most, limit = float(np.abs(trial.reference).max()), model.parameters.value(SUPPLY)
    if most <= OTHER_SIZE * limit:
        return None
    return (
        f"the command that is played back reaches {most:.4g}, and the plant takes {SUPPLY}, {limit:g}, at most: is it "
        "in another unit?"
    )


def _unlike(name: str, unit: str, reference: Samples, simulated: Samples, measured: Samples) -> str | None:
    there, here = (float(np.ptp(values)) if values.size else 0.0 for _, values in (measured, simulated))
    if name != ENCODER:
        if here > 0.0 and there > 0.0 and not 1.0 / FAR_OFF < there / here < FAR_OFF:
            return f"{name} goes over {there:.3g} {unit}, simulated over {here:.3g}: is it recorded in another unit?"
        return _against(name, simulated, measured)
    ours, theirs = follows(reference, simulated), follows(reference, measured)
    # In closed loop the simulated position follows whatever the parameters are; open loop has another reference.
    if ours is None or theirs is None or ours[1] < -AGAINST or not FOLLOWS[0] < ours[0] < 1.0 / FOLLOWS[0]:
        # a step, or volts: neither follows it
        return _against(name, simulated, measured)
    if theirs[1] < AGAINST:
        return f"{name} moves against its reference, which the simulated one follows: has it the other sign?"
    if not FOLLOWS[0] < theirs[0] < 1.0 / FOLLOWS[0]:
        return (
            f"{name} goes over {there:.3g} {unit}, {theirs[0]:.3g} times its reference, which the simulated one "
            "follows: is it in another unit, or at another shaft?"
        )
    return None


def _against(name: str, simulated: Samples, measured: Samples) -> str | None:
    """That a signal goes against its simulation, if it does."""
    alike = follows(simulated, measured)
    if alike is None or alike[1] >= AGAINST:
        return None
    return f"{name} goes against its simulation (correlation {alike[1]:.2f}): has it the other sign?"


def _check_parts(trial: Trial, where: str) -> None:
    """Parts that begin anew must be what a simulation of the first can stand for."""
    wrong = next((part for part in trial.parts if not isinstance(part, Part)), None)
    if wrong is not None:
        raise HannesError(f"{where}: its parts must be hannes_lab.trials.Part, not {kind_of(wrong)}.")
    if stands_for_all(trial):
        return
    many = (
        f"there are {len(trial.conditions)} conditions in it" if len(trial.conditions) > 1 else "they are not"
    )
    raise HannesError(
        f"{where}: it is `fresh`, so each of its {len(trial.parts)} parts must repeat the first, its reference "
        f"(nearly) equal tick by tick; {many}. Give the recordings as trials of their own: those that repeat one "
        "condition are joined."
    )
