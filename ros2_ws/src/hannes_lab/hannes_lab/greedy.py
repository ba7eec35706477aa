"""Many small effects, one after another: the way to a model of a real machine.

Real residuals are correlated along the motion and never become noise, so that a test against chance does not stop.
Here each round adds the effect with the least error on conditions that took no part in its fit, and the search stops
when the next one would lower its mean square by less than a given part.  Errors count in multiples of the
repeatability; where nothing was repeated, of what the fitted nominal model leaves of each signal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from .adequacy import AS_IT_REPEATS, distorted
from .errors import apart_alone, condition_error, held_out_condition_errors, per_signal, signal_errors
from .report_text import listed, words
from .search import Candidate, Search

JUDGED = 3
"""Candidates of each round (the best fits) whose error on held-out conditions is found, beside those of the user's own
effects that fit better: what is offered must not cost what is found without it."""

TWIN = 0.002
"""Part of its cost by which a further candidate may differ from one of these, and be judged too: where the two are the
same thing on a machine (a friction by a load that is constant, and Coulomb friction), chance says which comes first."""

POLISH_STEPS = 40
"""Limit on the steps of the last fit of each of them: valleys of friction laws are long."""

ALIKE = 0.02
"""Candidates whose held-out error is this close to the best, as a part of it, tie with it."""

SIMPLER = 0.05
"""The same of one with fewer parameters, which then comes first: a further parameter must be worth more than this."""

ALIKE_WITHIN_CHANCE = 0.06
"""The same of candidates that all leave no more than the machine repeats (AS_IT_REPEATS): what is left is scatter,
which decides by which of them a condition is foretold a little better.  The better fit comes first then."""


OF_NOMINAL = " times the fitted nominal model's"
"""What errors count in where nothing was repeated, in words."""

LEFT_OPEN = 0.5
"""An effect of which the data leave a parameter open to the end of its range, or all strengths to nought, joins only if
it leaves this part of the mean square error at most: it stands for something else, or for nothing."""


@dataclass(frozen=True)
class Grown:
    """The effects in the order in which they joined.

    first    the first round's candidates, best fit first
    errors   held-out error of the nominal and after each effect, in multiples of the repeatability (of the nominal's,
             where there is none)
    rivals   candidates of the last accepted round that tie with it
    notes    close calls of earlier rounds, and what the next effect would have gained
    """

    best: Candidate
    first: tuple[Candidate, ...]
    errors: tuple[float, ...]
    rivals: tuple[Candidate, ...]
    notes: tuple[str, ...]


Units = tuple[tuple[str, float], ...]
"""What the error of each signal counts in, by its name; none: its repeatability."""


def held_out_error(search: Search, candidate: Candidate, quickly: bool = False, units: Units = ()) -> float:
    """Error on conditions that took no part in the fit, in multiples of the repeatability; see errors.condition_error.

    quickly   the derivatives of the fit to all conditions serve for all refits: leaving one out moves it little
    """
    fit = candidate.fit
    known = {c.name: fit.jacobian[:, j] for j, c in enumerate(fit.coordinates)} if quickly else None
    errors = held_out_condition_errors(search.problem, fit.model, fit.coordinates, fit.z, known=known)
    return condition_error(search.problem.features, errors.values(), dict(units) or None)


def units_of(search: Search, null: Candidate) -> Units:
    """What errors count in where nothing was repeated: those of the fitted nominal model on held-out conditions."""
    return () if search.problem.features.repeated else search.once(_units, null, text="nominal: its errors")


def _units(search: Search, null: Candidate) -> Units:
    fit = null.fit
    errors = held_out_condition_errors(search.problem, fit.model, fit.coordinates, fit.z)
    return tuple(per_signal(search.problem.features, errors.values()).items())


def largest_error(search: Search, candidate: Candidate) -> float:
    """The largest error of a signal in a condition of the fit, in multiples of the repeatability; infinite if none is
    known.

    Up to AS_IT_REPEATS the recordings show nothing that the nominal model lacks.  Fitted on some of the conditions it
    may still foretell another badly: then these do not tell its parameters apart.
    """
    problem, fit = search.problem, candidate.fit
    features = problem.features
    errors = signal_errors(features, features.closures(problem.rig, fit.model, fit.values))
    return max((e.ratio for e in errors if math.isfinite(e.ratio)), default=math.inf)


def as_it_repeats(search: Search, candidate: Candidate) -> str:
    """That a fit misses nothing by more than chance may, in words; empty where it does."""
    largest = largest_error(search, candidate)
    if largest > AS_IT_REPEATS:
        return ""
    return (
        f"in no signal of any condition is the error of the fit more than {largest:.2f} times the repeatability (up to "
        f"{AS_IT_REPEATS} it may be chance)"
    )


def stands_out(search: Search, candidate: Candidate) -> str:
    """Which conditions that were recorded once a fit misses by more than the others repeat; empty if it misses none.

    The repeatability knows nothing of them, and an error over all conditions little.
    """
    problem, fit = search.problem, candidate.fit
    features = problem.features
    closures = features.closures(problem.rig, fit.model, fit.values)
    return listed(
        [
            f"{words(e.signal)} of '{e.condition}' by {e.rmse:.3g} {e.unit} "
            f"({e.ratio:.1f} times what others repeat to)"
            for e in apart_alone(features, closures, AS_IT_REPEATS)
        ]
    )


def grown_straight(search: Search, null: Candidate, max_effects: int, gain: float) -> Grown:
    """As `grow`, once more without an effect that ends as another form than is usual of it, beside others.

    What joined later may have bent it: it stands for something else, and what is real beside it need not fall with it.
    """
    without: list[str] = []
    first = grown = grow(search, null, max_effects, gain)
    while len(grown.best.names) > 1 and (
        bent := [name for name in grown.best.names if distorted(search, grown.best, [name])]
    ):
        without += bent
        grown = grow(search, null, max_effects, gain, without)
    if not without or not grown.best.names:
        return first
    said = (
        f"{' and '.join(without)} joined too, and ended as no form that is usual of it: it stood for something else, "
        "and the search went without"
    )
    return replace(grown, notes=(said, *grown.notes))


def grow(
    search: Search, null: Candidate, max_effects: int, gain: float, without: Sequence[str] = ()
) -> Grown:
    """Add effects until the mean square of the held-out error falls by less than the part `gain`, or none is left.

    An effect that others, which joined later, leave less than that to take goes again.  None joins that is `without`.

    An error that the machine's own repeats explain is not looked into: what joined would be fitted to chance.
    The candidates of a round are compared quickly; whether the best of them joins is decided by refits of their own.
    """
    best = null
    first: tuple[Candidate, ...] = ()
    units = units_of(search, null)
    errors = [1.0 if units else search.once(held_out_error, null, text="nominal: held-out conditions")]
    rivals: tuple[Candidate, ...] = ()
    notes: list[str] = []
    names = [name for name in search.sources if name not in without]
    while len(best.names) < max_effects:
        missed = "" if units else stands_out(search, best)
        if not (units or missed) and errors[-1] <= AS_IT_REPEATS:
            notes.append(
                f"the held-out error of {errors[-1]:.2f} times the repeatability leaves nothing to look for (up to "
                f"{AS_IT_REPEATS} it may be chance): the search stops here"
            )
            break
        if not (units or missed or best.names) and (why := as_it_repeats(search, best)):
            notes.append(
                f"{why}: there is nothing to look for. That on conditions that were left out ({errors[-1]:.2f}) says "
                "how well the others tell the parameters"
            )
            break
        text = f"effect {len(best.names) + 1}"
        singles = search.extend([best], names, text)
        if not singles:
            break
        first = first or tuple(singles)
        found = _judge(search, singles, text, best, gain, errors[-1], units)
        if not found.falls(errors[-1]) and len(best.names) + 2 <= max_effects:
            # Two effects may be worth it of which neither is alone.
            pairs = search.extend(singles[:JUDGED], names, f"{text}, as a pair")
            asked = 1.0 - (1.0 - gain) ** 2
            two = _judge(search, pairs, text, best, asked, errors[-1], units) if pairs else found
            if two.falls(errors[-1]):
                found = two
        if not found.falls(errors[-1]):
            why = f", for the data leave {found.left_open} open" if found.left_open else ""
            notes.append(
                f"the next effect, {found.best.names[-1]}, would "
                f"{'raise' if found.error > errors[-1] else 'change'} the held-out error from {errors[-1]:.3g} to "
                f"{found.error:.3g}{OF_NOMINAL if units else ''}; its mean square must fall by "
                f"{100 * (1.0 - found.most):.0f} %{why}: the search stops here"
            )
            break
        if rivals:
            notes.append(_close_call(best, rivals))
        best, rivals = found.best, found.rivals
        errors.append(found.error)
    while len(best.names) > 2:
        less = _superfluous(search, best, gain, errors[-1], units)
        if less is None:
            break
        gone = next(name for name in best.names if name not in less[0].names)
        notes.append(
            f"{gone} joined before the others did; without it the held-out error is {less[1]:.2f} instead of "
            f"{errors[-1]:.2f}{OF_NOMINAL if units else ''}: it went again"
        )
        rivals = tuple(search.without(r, [tuple(n for n in r.names if n != gone)])[0] for r in rivals)
        best = less[0]
        errors.append(less[1])
    return Grown(best, first, tuple(errors), rivals, tuple(notes))


def _superfluous(
    search: Search, best: Candidate, gain: float, error: float, units: Units
) -> tuple[Candidate, float] | None:
    """The set without the effect that takes least of the mean square held-out error, if that is less than `gain`.

    Its error comes with it.  What joined last has just been judged.
    """
    parts = search.without(best, [tuple(n for n in best.names if n != name) for name in best.names[:-1]])
    held = search.each(held_out_error, [(c, True, units) for c in parts], "held-out conditions without one")
    part = parts[min(range(len(parts)), key=lambda k: held[k])]
    left = search.once(held_out_error, part, False, units, text="held-out conditions without one")
    return (part, left) if (1.0 - gain) * left**2 <= error**2 else None


@dataclass(frozen=True)
class _Judged:
    """The best of some candidates, its held-out error, and those that are alike.

    most    part of the mean square error without it that may be left if it is to join
    left_open  what the data leave open of it
    """

    best: Candidate
    error: float
    rivals: tuple[Candidate, ...]
    most: float
    left_open: str = ""

    def falls(self, before: float) -> bool:
        """Whether the error is as much smaller than the one before as it must be."""
        return self.error <= math.sqrt(self.most) * before


def _judge(
    search: Search,
    candidates: Sequence[Candidate],
    text: str,
    base: Candidate,
    gain: float,
    before: float,
    units: Units,
) -> _Judged:
    """The best of the best fits by held-out error; of those that are alike, the one with the fewest parameters.

    One that would join too, and foretells as well, ties with it: also one of which the data leave something open.
    Of those that all leave no more than the machine repeats, the better fit.

    An effect that must be bent into another form is no candidate while there are others.
    Each error counts in multiples of what it may be at most (LEFT_OPEN, or 1 - gain, of the mean square without it).
    """
    sound = [c for c in candidates if not distorted(search, c)] or candidates
    chosen = to_judge(sound, [search.own(c.names[-1]) for c in sound])
    judged = search.each(_polish_in_worker, [(c,) for c in chosen], f"{text}: polish")
    held = search.each(held_out_error, [(c, True, units) for c in judged], f"{text}: held-out conditions")
    left_open = [_left_open(search, candidate, base) for candidate in judged]
    most = [min(LEFT_OPEN, 1.0 - gain) if names else 1.0 - gain for names in left_open]
    scores = [error / math.sqrt(part) for error, part in zip(held, most, strict=True)]
    within = not units and min(held) <= AS_IT_REPEATS
    near = 1.0 + (ALIKE_WITHIN_CHANCE if within else ALIKE)
    sizes = [len(candidate.fit.coordinates) for candidate in judged]
    alike = as_good(scores, sizes, near)
    if within:
        alike = [k for k in alike if held[k] <= AS_IT_REPEATS] or alike
    joins = [error <= math.sqrt(part) * before for error, part in zip(held, most, strict=True)]
    # A simpler one that does not join is no end of the search.
    alike = [k for k in alike if joins[k]] or alike
    if not alike:
        return _Judged(judged[0], float("nan"), (), 1.0 - gain)
    for candidate in judged:
        search.keep(candidate)
    # Of as many fitted parameters, what has fewer where nothing of it is idle: Coulomb friction before one by the load.
    whole = [sum(len(search.effect(name).parameters) for name in c.names) for c in judged]
    winner = min(alike, key=lambda k: (sizes[k], whole[k], judged[k].penalised if within else scores[k]))
    others = [
        k
        for k in range(len(judged))
        if k != winner
        and ((k in alike and most[k] == most[winner]) or (joins[k] and held[k] <= near * held[winner]))
    ]
    rivals = tuple(judged[k] for k in sorted(others, key=lambda k: held[k]))
    error = search.once(held_out_error, judged[winner], False, units, text=f"{text}: held-out conditions")
    return _Judged(judged[winner], error, rivals, most[winner], left_open[winner])


def to_judge(candidates: Sequence[Candidate], own: Sequence[bool]) -> list[Candidate]:
    """The best fits of a round, best first, and their twins; those of `own` effects take nobody's place."""
    known = [k for k, one in enumerate(own) if not one]
    count = known[JUDGED - 1] + 1 if len(known) >= JUDGED else len(candidates)
    first = list(candidates[:count])
    twins = [
        c
        for c in candidates[count:]
        if any(abs(c.penalised - one.penalised) <= TWIN * one.penalised for one in first)
    ]
    return [*first, *twins[:JUDGED]]


def as_good(scores: Sequence[float], sizes: Sequence[int], near: float) -> list[int]:
    """Which candidates are as good as the best: within a factor `near` of its score, and of those with fewer
    parameters than all of these also the ones within SIMPLER."""
    least = min(scores)
    fewest = min(
        (size for size, score in zip(sizes, scores, strict=True) if score <= near * least), default=0
    )
    far = max(near, 1.0 + SIMPLER)
    return [
        k
        for k, (size, score) in enumerate(zip(sizes, scores, strict=True))
        if score <= (far if size < fewest else near) * least
    ]


def _left_open(search: Search, candidate: Candidate, base: Candidate) -> str:
    """What the data leave open of the effects beyond a base's, by 95 % intervals: names of parameters.

    Those whose interval reaches the end of their range, and the strengths of an effect that may all be nought.
    """
    fit = candidate.fit
    widths = 1.96 * fit.sd(max(1.0, fit.cost / fit.residual.size))
    known = {c.name: (c, float(z), float(w)) for c, z, w in zip(fit.coordinates, fit.z, widths, strict=True)}
    out = []
    for name in candidate.names:
        if name in base.names:
            continue
        parameters = search.effect(name).parameters
        own = {f"{name}.{p.name}": p.vanishing is not None for p in parameters if not p.sd}
        out += [n for n in own if known[n][0].at_end(*known[n][1:])]
        # z is 0 where a strength vanishes.
        strengths = [n for n, strength in own.items() if strength]
        if all(abs(known[n][1]) <= known[n][2] for n in strengths):
            out += [n for n in strengths if n not in out]
    return ", ".join(out)


def _close_call(best: Candidate, rivals: Sequence[Candidate]) -> str:
    names = " or ".join(" + ".join(n for n in c.names if n not in best.names) for c in rivals)
    return f"when {best.names[-1]} joined, {names} would have foretold about as well"


def _polish_in_worker(search: Search, candidate: Candidate) -> Candidate:
    return search.polish(candidate, evaluations=POLISH_STEPS)
