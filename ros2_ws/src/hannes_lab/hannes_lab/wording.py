"""What is said beside an answer: notes, and the sentences of which its summary (conclusion.py) is made."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from hannes_description.output import number, with_unit
from scipy.sparse.csgraph import connected_components

from .adequacy import disbelieved, unshown, waves_of
from .chance import Chance
from .choose import Choice, can_be_held_out, halved, needed_gain
from .clock import REFERENCE_DELAY, REFERENCE_DELAY_SD
from .diagnosis import Fall, FoundEffect, Rank
from .directions import ways
from .experiments import VISIBLE, Experiment
from .falls import NOMINAL_FITTED, WITHOUT_EFFECT, clearly_less, deciding_errors, left_out_errors
from .fit import Fit, fit
from .intervals import grain_widens
from .problem import Coordinate, Problem, nuisance_coordinate
from .report_text import listed
from .rig import Nuisance
from .scan import period_of
from .search import FAR, PENALTY, Candidate, Search, key_of
from .trials import Trial

ANY_DIFFERENCE = (
    "a difference of any size counts here that chance does not explain; no simple model of a real machine is that "
    "exact: --greedy adds effects for as long as the error on conditions that were left out of the fit falls"
)

CLOCK_PART = 0.25
"""Part of the misfit that another clock of the reference must remove to be worth a note."""

CLOCK_STEPS = 6
"""Length of the fit that tells it."""

LEFT = 1.5
"""Error on held-out closures, over the repeatability, from which a machine that is far outside its tolerances is no
explanation: clean machines of others have not been seen to be."""

_NOT_OF_MACHINE = ("control", "log", "encoder", "object")

MOVED_BY = 1.0
"""Tolerances from which a fitted parameter is worth a line of `compare --fitted`."""

UNUSUAL = 1.5
"""Standard deviations of a wide prior from which a parameter that stands for an effect is worth a note."""

HELD = 0.01
"""Standard deviations of its prior from a bound within which a parameter is held by it."""

SHOWN_WAVES = 2.0
"""Waves within the way below which it is worth a note that a ripple has not been seen to repeat."""

MOST = 0.75
"""Part of the excess misfit that an effect explains alone from which it is worth a note where it does not join."""

NOUGHT = 1e-9
"""What is less is said as 0: no parameter of a machine is that small in SI."""

NAMED = 4
"""Effects that a sentence names; of more, it says how many."""

MANY_FAILURES = 0.05
"""Part of the simulations that did not stay finite from which on their parameters are worth a look."""


def bent_sentence(choice: Choice, falls: Sequence[Fall]) -> str:
    """Why what leaves no more than chance and the model's own error is no answer; empty if it is one.

    Where a set of effects takes a machine far outside its tolerances as well, and the error on what took no part in the
    fit does not fall to half of what it is above the repeatability, the effects only help to bend the model.  Where the
    model alone does so, and leaves more than LEFT, something of the same form may be missing: nobody can tell.  Nor
    does a wave of which the way shows too little, see unshown, nor do effects with which all that was left out is
    foretold clearly worse.
    """
    best, before, after = choice.best, falls[NOMINAL_FITTED], falls[-1]
    if why := unshown(choice.search, best, after.held_out):
        return why
    pairs = ((before.held_out, after.held_out), (before.held_out_conditions, after.held_out_conditions))
    known = [(a, b) for a, b in pairs if np.isfinite([a, b]).all()]
    if best.names and known and all(clearly_less(a, b) for a, b in known):
        return (
            f"{' and '.join(best.names)} would bring the misfit within chance, but "
            f"{'foretells' if len(best.names) == 1 else 'foretell'} what took no part in the fit clearly worse: the "
            f"error there rises from {' and '.join(number(a) for a, _ in known)} to "
            f"{' and '.join(number(b) for _, b in known)} times the repeatability"
        )
    if not (best.far_off and choice.search.problem.discrepancy):
        return ""
    if not best.names:
        far = _far_above(choice.search, best)
        return (
            f"it would explain all only with {far}, far outside the tolerance"
            if far and after.held_out > LEFT
            else ""
        )
    if not known or any(halved(a, b) for a, b in known):
        return ""
    return (
        f"{' and '.join(best.names)} would bring the misfit within chance only with {far_values(best)}, far outside "
        "the tolerance, and still leave more than half of the error on held-out closures"
    )


PULLED_APART = 2.0
"""How many times worse a fit may foretell conditions that were left out than the model as given before it is said."""


def worse_fitted(falls: Sequence[Fall]) -> tuple[str, ...]:
    """Sentences where the fit of the nominal model has a larger error than the nominal model itself."""
    given, fitted = left_out_errors(falls)[:WITHOUT_EFFECT]
    out = []
    if fitted > given:
        said = f"{fitted:.2f}) than as given ({given:.2f} times the repeatability"
        if not np.isfinite(falls[NOMINAL_FITTED].held_out):
            said = f"on conditions that were left out) than as given ({given:.2f} of the error"
        out.append(
            f"the nominal model is further off as fitted ({said}): a fit weighs each sample by how well it is known "
            "and how far a model of this form may be off, and pays for tolerances; these errors do not"
        )
    given, fitted = deciding_errors(falls)[:WITHOUT_EFFECT]
    if math.inf > fitted > PULLED_APART * given > 0.0:
        out.append(
            f"the fitted nominal model foretells conditions that were left out {fitted / given:.1f} times worse than "
            "the one as given: each pulls the parameters elsewhere. Perhaps the gains, the supply or the load of a "
            "recording are not those that the model has for it"
        )
    return tuple(out)


APART, THAN_OTHERS = 2.5, 2.0
"""Multiples of its repeatability, and of what the worst of the others is missed by, from which a condition that was
left out of the fit is worth a note."""


def condition_apart(falls: Sequence[Fall]) -> tuple[str, ...]:
    """A sentence on the condition that is foretold much worse than the others, if there is one."""
    known = {name: error for name, error in falls[-1].by_condition.items() if np.isfinite(error)}
    worst = max(known, key=known.__getitem__, default="")
    others = [error for name, error in known.items() if name != worst]
    if not others or known[worst] < max(APART, THAN_OTHERS * max(others)):
        return ()
    return (
        f"'{worst}' is foretold much worse ({known[worst]:.1f} times its repeatability) than the other conditions (at "
        f"most {max(others):.1f}) when it takes no part in the fit: either something acts there only, or it alone "
        "shows what acts",
    )


def notes(
    search: Search,
    best: Candidate,
    verdict: str,
    effects: Sequence[FoundEffect],
    experiments: Sequence[Experiment],
    greedy: bool,
    clock: Clock | None,
) -> tuple[str, ...]:
    """What else a user must know of an answer, a sentence each."""
    return (
        *_any_difference(search, verdict, greedy),
        *((clock.said,) if clock else ()),
        *_inseparable(search, experiments),
        *_ends(search, best, effects),
        *(_one_way(search.problem.features.trials) if greedy and verdict != "nothing" else ()),
        *_few_waves(search, best),
        *_coasting(search, best),
        *unmoved(best.fit),
        *_undescribed(best),
        *_taken_for_its_own(search, best),
        *_identifiability(best),
        *failure_notes(search.problem),
    )


JUMPS = 2.0
"""How many times wider intervals are for the misfit's jumps from which it is said that it jumps."""


def jumps(found: Fit, limits: Chance) -> list[str]:
    """That the misfit jumps where parameters change little, and what follows of it."""
    times = grain_widens(found, limits)
    if times < JUMPS:
        return []
    return [
        f"the misfit jumps by some {number(found.grain, 2)} where parameters change by a part of their intervals, as "
        "a control law that computes in whole numbers makes it: fits from other starts may end elsewhere, and "
        f"intervals are {times:.1f} times as wide as they would be without that, or more"
    ]


def unmoved(found: Fit) -> list[str]:
    """What has a tolerance and moves nothing."""
    names = list(dict.fromkeys(name.partition("@")[0] for name in found.unmoved))
    have = "has a tolerance, but moves" if len(names) == 1 else "have tolerances, but move"
    return [
        f"{_some(names)}: {have} none of the compared signals in these recordings, and is no result"
    ] * bool(names)


def _some(names: Sequence[str]) -> str:
    """The first NAMED of some names, and how many more there are."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return f"{', '.join(names[:NAMED])}{more}"


def _one_way(trials: Sequence[Trial]) -> list[str]:
    """Of conditions that each go one way: which one is alone in its direction, which no other one foretells."""
    found = ways(trials)
    if 0.0 in found.values():
        return []
    if len(set(found.values())) == 1:
        return [
            "every condition goes the same way: a constant force, Coulomb friction and one that depends on the "
            "direction are the same thing here; record a move back"
        ]
    alone = [name for name, way in found.items() if list(found.values()).count(way) == 1]
    return [
        f"'{name}' is the only condition that goes its way: what acts in that direction alone is not foretold from the "
        "others, so that an effect of it cannot be confirmed; record another amplitude or speed each way, or make one "
        "condition of both"
        for name in alone[:1]
    ]


TURNED = 0.5
"""rad by which the phase of a wave moves when a condition is left out, from which it is told; its amplitude may fall to
half at most."""


def phase_moves(search: Search, found: Candidate, fall: Fall) -> str:
    """That the last effect is a wave of another phase in each condition, in words; empty if it is not.

    fall    the errors with it, with what the fits without a condition made of its strengths
    """
    name = found.names[-1]
    strengths = search.strengths(name)
    if period_of(search.effect(name)) is None or len(strengths) != 2:
        return ""
    here = complex(*(found.fit.z_of(strength) or 0.0 for strength in strengths))
    there = [complex(*(z.get(s, 0.0) for s in strengths)) for z in fall.left_out.values()]
    if not there or here == 0.0 or min(map(abs, there)) < 0.5 * abs(here):
        return ""
    turned = max(abs(cmath.phase(z / here)) for z in there)
    if turned < TURNED:
        return ""
    return (
        f" (its amplitude stays, but its phase moves by up to {turned:.1f} rad when a condition is left out: is the "
        "position that of one scale in all of them, and does the reference begin where it does?)"
    )


def _few_waves(search: Search, best: Candidate) -> list[str]:
    """Of a ripple of which the way shows no second wave whole: that it repeats is assumed."""
    return [
        f"{name}: the whole way is {waves:.3g} of its waves, so that it repeats is not shown: whatever goes with the "
        "position in about that form would look the same (a longer way tells)"
        for name in best.names
        if (waves := waves_of(search, best, name)) < SHOWN_WAVES
    ]


def _coasting(search: Search, best: Candidate) -> list[str]:
    """What a torque constant far below its nominal value is, too, on a machine whose voltage alone is known."""
    problem = search.problem
    blocks = {block.signal for block in problem.features.blocks}
    name, known = "motor.emf_compensated", search.model.parameters
    of_current = name in known and known.value(name) > 0.0
    if not problem.rig.foreign or of_current or "motor_current" in blocks:
        return []
    offered = any("CoastingBridge" in source for source in search.sources.values())
    low = (
        c
        for c, off in best.fit.off
        if c.name == "motor.kt" and off > FAR and c.z(best.fit.values[c.name]) < 0.0
    )
    ratio = known.value("gear.ratio") if "gear.ratio" in known else 1.0
    return [
        "motor.kt comes out far too low where a bridge coasts between its pulses, too: it brakes less than the model "
        "by its back-EMF. examples/effects/coasting_bridge.py of the project is an effect for that: set EMF in it to "
        f"motor.kt x gear.ratio ({c.value(0.0) * ratio:.3g} {c.unit}), and give --effect FILE:CoastingBridge"
        for c in low
        if not offered
    ]


def explains_most(choice: Choice) -> Rank | None:
    """The effect that explains most of the fit's misfit alone, and yet is not named, if there is one."""
    first = max(choice.ranking, key=lambda rank: rank.explained, default=None)
    known = choice.search.problem.features.repeated
    return None if first is None or choice.best.names or not known or first.explained < MOST else first


def unforetold(choice: Choice) -> tuple[str, ...]:
    """A sentence on an effect that explains most of the fit's misfit alone, and yet does not join."""
    first = explains_most(choice)
    if first is None or first.names[0] in choice.taken_back:
        return ()  # with what was taken back they were foretold better
    names = " + ".join(first.names)
    return (
        f"{names} alone explains {100 * first.explained:.0f} % of the excess misfit of a fit to all conditions, but "
        "those that were left out of a fit are foretold no better with it: they may be too unlike to foretell one "
        f"another. `hannes add --effect {first.names[0]}` shows what it does to closures that were left out",
    )


def idle_sentence(whole: Candidate, part: Candidate, with_all: Fall, with_part: Fall) -> str:
    """Why effects of a set that fits better are not named."""
    pairs = (
        ("closures", with_part.held_out, with_all.held_out),
        ("conditions", with_part.held_out_conditions, with_all.held_out_conditions),
    )
    errors = " and ".join(
        f"{b:.2f} instead of {a:.2f} on {what}" for what, a, b in pairs if np.isfinite([a, b]).all()
    )
    numbers = (
        f": an error of {errors} that were left out, in multiples of the repeatability" if errors else ""
    )
    return (
        f"{_further(whole, part)} would fit better (misfit {whole.fit.cost:.0f} instead of {part.fit.cost:.0f}), but "
        f"not foretell better what took no part in the fit{numbers}"
    )


def law_sentence(effect: str, how: str, with_it: float, without: float) -> str:
    """Why an effect is not named that is no more than how another machine's law sets in."""
    better = (
        f" (an error of {with_it:.2f} instead of {without:.2f} on held-out closures)"
        if np.isfinite([with_it, without]).all()
        else ""
    )
    return (
        f"{effect} would fit better{better}, but so little of it ({how}) is how the law of any other machine sets in, "
        f"for which there is room in what a model of this form may be off: `hannes add --effect {effect}` brings the "
        "model nearer"
    )


def led_back_sentence(whole: Candidate, part: Candidate) -> str:
    """Why effects are named without which what took no part in the fit is foretold as well."""
    return (
        f"without {_further(whole, part)} the model foretells as well, but only with {far_values(part)}, far outside "
        "the tolerance"
    )


def _further(whole: Candidate, part: Candidate) -> str:
    """The effects of a set that a part of it lacks."""
    return " and ".join(name for name in whole.names if name not in part.names)


def nearest_sentence(choice: Choice) -> str:
    """A sentence on the effect that would gain most where nothing is missing, and on what it would have to gain."""
    if choice.best.names or not choice.ranking:
        return ""
    first = choice.ranking[0]
    gain = choice.best.penalised + PENALTY - first.cost
    asked = needed_gain(choice, choice.best, choice.search.found.get(key_of(first.names)), first=True)
    return (
        f" The effect that comes nearest is {' + '.join(first.names)}: it lowers the misfit by {max(gain, 0.0):.0f}, "
        f"and {asked:.0f} are asked for."
    )


LEAD = 3.0
"""Multiples of the repeatability by which a signal of a condition is still missed, from which the effect is told that
would lower the misfit most."""

LEAST_LEAD = 0.5
"""Part of what chance gains that it must lower it by."""


def lead(choice: Choice, falls: Sequence[Fall]) -> tuple[str, ...]:
    """What is still missed where effects were found on a machine of others, and the effect that would come next.

    The error that a model of another machine is allowed hides what is smaller than it.
    """
    search, best = choice.search, choice.best
    errors = [e for e in falls[-1].signals if np.isfinite(e.ratio)]
    worst = max(errors, key=lambda e: e.ratio, default=None)
    if not (search.problem.discrepancy and best.names and worst is not None and worst.ratio >= LEAD):
        return ()
    further = [
        c
        for c in search.found.values()
        if set(c.names) > set(best.names)
        and len(c.names) == len(best.names) + 1
        and not disbelieved(search, c)
    ]
    if not further:
        return ()
    following = min(further, key=lambda c: c.penalised)
    gain = best.penalised + PENALTY - following.penalised
    if gain < LEAST_LEAD * choice.limits.gain:
        return ()
    (name,) = set(following.names) - set(best.names)
    asked = needed_gain(choice, best, following)
    return (
        f"{worst.signal} of '{worst.condition}' is still missed by {worst.ratio:.1f} times the repeatability, which "
        f"the model of another machine may be off by. What would lower the misfit most is {name}, by {gain:.0f} "
        f"(chance: {choice.limits.gain:.0f}, and {asked:.0f} are asked for): no finding, but worth a look with "
        f"`hannes add ... {' '.join(f'--effect {search.sources[n]}' for n in (*best.names, name))}`",
    )


def far_off(best: Candidate) -> list[Coordinate]:
    """The nominal parameters that are far from their values."""
    return [c for c, off in best.fit.off if off > FAR]


def far_values(best: Candidate) -> str:
    """The nominal parameters that are far from their values, with what they would be."""
    return _said_far(best.fit, far_off(best))


def _far_above(search: Search, best: Candidate) -> str:
    """The same of what a machine keeps (not its controller's and loggers', nor a recording's own) and has too much of.

    An effect adds to the nominal value.  What stands for an effect in each recording (the damping of its object) counts
    too, where all have too much.
    """
    far = [c for c in far_off(best) if best.fit.values[c.name] > c.value(0.0)]
    stands_for = {n.name: n.effect for n in search.nuisances if n.effect}
    names = {c.name for c in far}
    spared = {effect for name, effect in stands_for.items() if name not in names}
    return _said_far(
        best.fit,
        [
            c
            for c in far
            if ("@" not in c.name and c.name.split(".")[0] not in _NOT_OF_MACHINE)
            or stands_for.get(c.name, "") not in {"", *spared}
        ],
    )


def _said_far(found: Fit, far: Sequence[Coordinate]) -> str:
    values, off = found.values, {c.name: z for c, z in found.off}
    return ", ".join(
        f"{c.name} {with_unit(values[c.name], c.unit, 3)} instead of {c.value(0.0):.3g} ({off[c.name]:.0f} tolerances)"
        for c in far
    )


def failure_notes(problem: Problem) -> list[str]:
    """How many simulations did not stay finite, and whether that matters; a fit takes them for very bad."""
    if not problem.failures:
        return []
    few = problem.failures < MANY_FAILURES * problem.simulations
    meaning = (
        "harmless: values that the search tried and left"
        if few
        else f"above {100 * MANY_FAILURES:.0f} % the search may have missed the best values: look at the model's "
        "parameters and at effects of your own"
    )
    return [
        f"{problem.failures} of {problem.simulations} simulations did not stay finite and counted as very bad fits "
        f"({meaning})"
    ]


LATE_COMMAND = (
    "; if the clock is right and the drive answers that late, it is command_delay, which `diagnose` looks for in what "
    "was recorded"
)


@dataclass(frozen=True)
class Clock:
    """Another clock of the reference: what part of the misfit it would remove, and a sentence on it."""

    part: float
    said: str


def other_clock(problem: Problem, found: Fit) -> Clock | None:
    """Whether what is left looks as if the reference had been logged earlier or later, where that is not fitted yet.

    Only on machines of others, see Rig.foreign: a hand's recordings tell their clock, or it is fitted.
    """
    rig, fitted = problem.rig, {c.name for c in found.coordinates}
    if REFERENCE_DELAY in fitted or not rig.foreign or rig.approximate or found.cost <= 0.0:
        return None
    tick = min(trial.period for trial in problem.features.trials)
    clock = Nuisance(
        REFERENCE_DELAY, 0.0, REFERENCE_DELAY_SD, False, unit="s", step=0.5 * tick / REFERENCE_DELAY_SD
    )
    coordinates = (*found.coordinates, nuisance_coordinate(clock))
    moved = fit(problem, found.model, coordinates, found.point, evaluations=CLOCK_STEPS)
    part, delay = 1.0 - moved.cost / found.cost, moved.values[REFERENCE_DELAY]
    if part < CLOCK_PART:
        return None
    return Clock(
        part,
        f"what is left looks as if the signals were {'later' if delay > 0.0 else 'earlier'} than the reference's clock "
        f"says, by {1e3 * abs(delay):.2g} ms: that alone would remove {100.0 * part:.0f} % of the misfit; mend it "
        f"where the recordings are read, or let it be fitted ({REFERENCE_DELAY} in an adapter's tolerances)"
        + (LATE_COMMAND if delay > 0.0 else ""),
    )


def _any_difference(search: Search, verdict: str, greedy: bool) -> list[str]:
    """What else can be tried where chance does not explain what is left, and the model may be off by nothing."""
    problem = search.problem
    may = verdict == "unknown" and not greedy and not problem.discrepancy
    return [ANY_DIFFERENCE] if may and can_be_held_out(problem.features) else []


def _inseparable(search: Search, experiments: Sequence[Experiment]) -> list[str]:
    """What shows each of the tied effects, where no experiment that was considered tells them apart."""
    if not experiments or experiments[0].distance >= VISIBLE:
        return []
    names = dict.fromkeys(name for tied in experiments[0].separates for name in tied)
    shown = "; ".join(f"{name} by: {search.effect(name).told_by or '(not said)'}" for name in names)
    return [
        f"no further recording that was considered tells {', '.join(' + '.join(t) for t in experiments[0].separates)} "
        f"apart (they differ by {experiments[0].distance:.1f} standard deviations of the noise at most); what shows "
        f"each: {shown}"
    ]


def _ends(search: Search, best: Candidate, effects: Sequence[FoundEffect]) -> list[str]:
    """The parameters that the end of their range holds, and the effects' of which the 95 % interval is cut there."""
    out = [
        f"{c.name} lies at the end of its range ({c.lower:g} to {with_unit(c.upper, c.unit, 6)}): the true value may "
        "lie beyond it, or it is another effect of a similar form"
        for c in best.fit.at_end
    ]
    known = {c.name: c for c in best.fit.coordinates}
    wider = ", or the adapter's `sizes` are too small" if getattr(search.problem.rig, "sizes", None) else ""
    for effect in effects:
        for name, p in effect.parameters.items():
            c = known[f"{effect.name}.{name}"]
            if p.identified and any(c.at_end(c.z(end)) for end in (p.low, p.high)):
                out.append(
                    f"the 95 % interval of {c.name} ({number(p.low, 3)} .. {with_unit(p.high, c.unit, 3)}) is cut at "
                    f"the end of its range ({c.lower:g} to {c.upper:g}): the true value may lie beyond it{wider}"
                )
    return out + held_notes(best.fit)


def moved_notes(found: Fit) -> list[str]:
    """The parameters that a fit took away from their nominal values, farthest first."""
    moved = [c for c, off in found.off if off >= MOVED_BY]
    return [f"the fit has {_said_far(found, moved)}"] if moved else []


def held_notes(found: Fit) -> list[str]:
    """The parameters of the model's file that the end of their range holds."""
    return [
        f"the fit holds {c.name} at {with_unit(c.value(float(z)), c.unit)}, {_held_at(found, c, float(z))}?"
        for c, z in zip(found.coordinates, found.z, strict=True)
        if c.nuisance and c.name in found.model.names and any(abs(z - end) < HELD for end in c.bounds)
    ]


def _held_at(found: Fit, c: Coordinate, z: float) -> str:
    """Which end holds a parameter: that of its range in the file, or next to nothing of it, as little as is tried."""
    given = found.model.parameters[c.name]
    if abs(z - c.bounds[0]) < HELD and c.lower > given.lower:
        return "next to nothing, as little as a fit makes of it: is it there at all"
    return (
        f"the end of its range in the model's file ({given.lower:g} to {given.upper:g}): is that range right, or is "
        "there an effect of the same form"
    )


def untold(nuisances: Sequence[Nuisance]) -> list[str]:
    """What the recordings do not say of the machine, and of each of them, where nothing was fitted."""
    wide = sorted((n.name for n in nuisances if nuisance_coordinate(n).wide), key=lambda name: "@" in name)
    names = list(dict.fromkeys(name.partition("@")[0] for name in wide))
    return [
        f"the recordings do not tell {_some(names)}: here they are the model's, --fitted fits them"
    ] * bool(names)


def _undescribed(best: Candidate) -> list[str]:
    """What the recordings do not say of the machine as a whole, and of each recording, as it was fitted."""
    fitted: dict[str, list[str]] = {"": []}
    for c, value in zip(best.fit.coordinates, best.fit.values.values(), strict=True):
        name, _, place = c.name.partition("@")
        if c.wide:
            shown = value if abs(value) > NOUGHT else 0.0
            fitted.setdefault(place, []).append(f"{name} {with_unit(shown, c.unit, 3)}")
    whole = fitted.pop("")
    return [f"the recordings do not tell these, so they were fitted: {', '.join(whole)}"] * bool(whole) + [
        f"{place}: fitted too, as the recording does not tell them exactly: {', '.join(own)}"
        for place, own in fitted.items()
    ]


def _taken_for_its_own(search: Search, best: Candidate) -> list[str]:
    """Parameters of a recording that an effect would move too, and that are larger than usual without being far off."""
    notes = []
    for n in search.nuisances:
        z = best.fit.point.get(n.name, 0.0)
        if n.effect in search.sources and n.effect not in best.names and UNUSUAL < z <= FAR:
            name, _, place = n.name.partition("@")
            value = best.fit.values[n.name]
            notes.append(
                f"{place or 'all recordings'}: {name} is fitted at {value / n.mean:.0f} times the nominal, as the "
                f"recording does not tell how well it is known (an object's `tolerance` does); if it is no larger than "
                f"usual, {n.effect} is missing"
            )
    return notes


ALIKE = 0.97
"""Correlation of two parameters from which it is said that they cannot be told apart well."""


def _identifiability(best: Candidate) -> list[str]:
    """What this data cannot tell: effect and nuisance parameters that move the data alike, each set of them once."""
    covariance = best.fit.covariance()
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    known = np.array([bool(c.prior) for c in best.fit.coordinates])
    alike = (np.abs(correlation) > ALIKE) & ~np.logical_and.outer(known, known)
    np.fill_diagonal(alike, False)
    count, sets = connected_components(alike, directed=False)
    notes = []
    for own in (np.flatnonzero(sets == k) for k in range(count)):
        if own.size < 2:
            continue
        within = correlation[np.ix_(own, own)][alike[np.ix_(own, own)]]
        names = [best.fit.coordinates[k].name for k in sorted(own, key=known.__getitem__)]  # effects first
        how = (
            f"correlation {within[0]:+.3f}"
            if own.size == 2
            else f"correlations up to {np.abs(within).max():.3f}"
        )
        notes.append(f"{listed(names)} cannot be told apart well with these data ({how})")
    return notes
