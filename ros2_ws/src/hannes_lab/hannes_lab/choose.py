"""Which set of effects is the answer: the smallest that explains all, or what lowers the held-out error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from hannes_description.errors import HannesError

from .adequacy import (
    AS_IT_REPEATS,
    disbelieved,
    distorted,
    is_adequate,
    leads_back,
    led_off,
    shortfall,
    unshown,
)
from .chance import Chance, chance
from .diagnosis import Rank
from .features import Features
from .greedy import (
    JUDGED,
    as_it_repeats,
    grown_straight,
    held_out_error,
    largest_error,
    stands_out,
)
from .report_text import listed
from .search import HOPELESS, PENALTY, Candidate, Search, key_of

WORTHWHILE = 0.05
"""A further effect must remove at least this part of the cost."""

EACH_TAKES = 0.15
"""Part of the mean square error on held-out conditions that an effect must take where they are added one after another:
what takes less may as well be what another one's form is off.  Of the effects of EMPS each takes 23 % or more."""

OWN_ERROR_PART = 0.12
"""The same where the model has an error of its own, also within chance: its width is assumed, and it is not noise.
There a second effect must remove FURTHER times as much.  Not so one that leads back what is far off without it: the
hand's own parameters had taken it over, and what is left of it is small."""

OWN_ERROR_CHANCE = 1.5
"""Where the model has an error of its own, how many times what chance gains an effect must gain: that error is the form
of another machine, which repeats, and the curves of an effect may follow it."""

TIE = 6.0
"""Sets whose penalised costs differ by less cannot be told apart: a likelihood ratio of e^3 = 20.  The best is the
wrong one beyond it in 0.7 % at worst, of sets that are as far apart as that (normal tail at the root of 6)."""

OWN_ERROR_TIE = 12.0
TIED_PART = 0.5
"""The same where the model has an error of its own: at least so much, and this part of what an effect must remove."""

NEAR = 1.25
"""Where one effect of a set is exchanged for another, fits are carried on that promise at most so many times the cost
of the set: two look-alikes beside a third effect tied when fitted to the end, at 599 both, of which one had been given
up at 666."""

RIVAL = 2.0
"""Sets whose cost is at most so many times that of the best are judged beside it with the noise found at it."""

FURTHER = 1.5
"""Where all is explained within chance, a further effect must gain so many times what chance gains."""

HALF = 0.5
"""Effects that were added one after another are the answer where the error on held-out conditions, above the
repeatability, falls to this part; where more is left, what is missing is something else."""

COUNTS = {1: "one", 2: "two", 3: "three"}

WIDE = (4, 3)
"""How many of the best singles and pairs are extended by every further effect."""

LEFT_MOST = 0.5
FAR_OFF = 3.0
"""Where the best pair leaves more than this part of what the best single effect left above chance, and still so many
times what chance reaches, triples are not tried: of three effects of the catalogue the second one found explains more
than the third will."""


@dataclass(frozen=True)
class Choice:
    """The set that was chosen, the search (with its noise) in which it was judged, and its rivals of the same size.

    enough   it removes most of the error on held-out conditions, or leaves no more than the machine repeats, though
             chance does not explain the rest
    idle     where no effect is named: a sentence on those that fit better, but foretell no better what took no part in
             the fit
    left     a sentence on what a greedy choice leaves, where something is
    alone    what was recorded once and is missed by more than the others repeat, where no effect is named
    other_model  that is no more than the machine repeats, but with a model that is not believed
    excluded effects that are not looked for
    taken_back effects that joined a greedy search, and are none all the same
    """

    search: Search
    best: Candidate
    limits: Chance
    adequate: bool
    ranking: tuple[Rank, ...]
    rivals: tuple[Candidate, ...] = ()
    notes: tuple[str, ...] = ()
    enough: bool = False
    idle: str = ""
    left: str = ""
    alone: str = ""
    other_model: bool = False
    excluded: tuple[str, ...] = ()
    taken_back: tuple[str, ...] = ()

    @property
    def sought(self) -> list[str]:
        """The effects that are looked for."""
        return [name for name in self.search.sources if name not in self.excluded]


def choose(
    search: Search, null: Candidate, limits: Chance, max_effects: int, excluded: tuple[str, ...] = ()
) -> Choice:
    """Smallest adequate set of effects, of which none is `excluded`.

    Sets of one, two and three effects in turn; each round extends the best of the round before by every effect, so that
    two effects of which neither is best alone are found too.  After each round noise, scatter and critical values are
    estimated afresh at the best point: those of a wrong model are wrong.  Where the misfit is within chance already,
    only sets that are as good as the best within chance are extended.  A set of which an effect must be bent into
    another form counts only where there is no other.
    """
    choice = Choice(search, null, limits, is_adequate(search, null, limits), (), excluded=excluded)
    front, far = [null], list[Candidate]()
    for size in range(1, max_effects + 1):
        enough = is_adequate(choice.search, choice.best, choice.limits, room=1.0)
        if enough and size > 1:
            room = choice.limits.misfit - choice.limits.median
            front, far = [c for c in front if c.penalised <= front[0].penalised + room], []
        first_one = size == 1
        worth = choice.best.penalised - 0.5 * needed_gain(choice, choice.best, first=first_one)
        text = f"{COUNTS.get(size, size)} effect{'s' * (size > 1)}"
        round_ = _extended(choice, front, far, text, worth)
        if not round_:
            break
        if first_one and (names := _thoroughly(choice, round_[0])):
            again = search.thoroughly().extend(front, names, "one effect, thoroughly", worth)
            round_ = _best_of(round_, again)
        round_ = [c for c in round_ if not distorted(choice.search, c)] or round_
        if enough and round_[0].penalised < worth and set(choice.best.names) < set(round_[0].names):
            # The set without it may find its way further down from there; what is left is the gain.
            (base,) = choice.search.without(round_[0], [choice.best.names])
            choice = replace(choice, best=base)
        choice, round_, joins = _joining(choice, round_, text, first=first_one)
        # Those that fit better, but gain less than is asked of them, are no rivals of the first that joins.
        short = round_[: joins or 0]
        round_ = [c for c in round_ if c not in short]
        # Within chance there is nothing to explain, unless an effect gains more than chance does.
        whole = limits.median if joins is None else min(round_[0].fit.cost, limits.median)
        ranked = [*round_[:1], *short, *round_[1:]]
        ranking = choice.ranking or tuple(Rank.of(c, _share(null, c, whole)) for c in ranked)
        if joins is None:
            choice = replace(choice, ranking=ranking)
            break
        new = choice.search.renewed(round_[0])
        wide = [
            c
            for c in round_[: WIDE[min(size - 1, len(WIDE) - 1)]]
            if c.penalised <= HOPELESS * round_[0].penalised
        ]
        rivals = [c for c in wide if c.penalised <= RIVAL * round_[0].penalised]
        near = sorted(new.refitted(rivals), key=lambda c: c.penalised)
        # On a slow plant the refit was one with all derivatives afresh.
        best = near[0] if new.slow else new.polish(near[0])
        limits_new = chance(new.problem, best.fit, new.signatures(best))
        close = tuple(c for c in near[1:] if c.penalised <= best.penalised + tie_width(new, best))
        adequate = is_adequate(new, best, limits_new)
        left = 1.0 - _share(choice.best, round_[0], choice.limits.median)
        choice = Choice(new, best, limits_new, adequate, ranking, close, excluded=excluded)
        if 1 < size < max_effects and left > LEFT_MOST and best.fit.cost > FAR_OFF * limits_new.misfit:
            choice = replace(choice, notes=(_ended_early(size, left, best, limits_new),))
            break
        front, far = [best, *near[1:]], [c for c in wide if c not in rivals]
    return pruned(choice)


def _joining(
    choice: Choice, round_: list[Candidate], text: str, *, first: bool
) -> tuple[Choice, list[Candidate], int | None]:
    """Which of a round's candidates, best first, is the next chosen set, by its place; None if none gains enough.

    With it the choice, with a note on what is not named all the same, and the round as it was polished.
    """
    # What chance gains was found for effects of one free strength; further parameters pay their penalty.
    gains = [choice.best.penalised + PENALTY - c.penalised for c in round_]
    needed = [needed_gain(choice, choice.best, c, first=first) for c in round_]
    joins = next((k for k, gain in enumerate(gains) if gain >= needed[k]), None)
    if joins is None and not first and _may_halve(choice, choice.best, round_[0]):
        # A small gain is not polished by itself, and what it is, and foretells, depends on where the fit has come.
        better = choice.search.polished(round_, round_[:JUDGED], text)
        if _halves(choice, choice.best, better[0]):
            joins, round_ = 0, better
    if joins is not None and (why := _settled(choice)):
        return (
            with_unnamed(choice, f"{' and '.join(round_[joins].names)} would fit better: {why}"),
            round_,
            None,
        )
    return choice, round_, joins


def with_unnamed(choice: Choice, said: str) -> Choice:
    """The choice with a sentence on effects that fit better and are not named: in the summary where none is."""
    return replace(choice, notes=(*choice.notes, said)) if choice.best.names else replace(choice, idle=said)


def can_be_held_out(features: Features) -> bool:
    """Whether the error on conditions that are left out can be judged: there are two, and repeats to judge it by."""
    return len(features.conditions) > 1 and features.repeated


def must_be_held_out(features: Features) -> None:
    """Refuse a greedy search where no condition can be left out."""
    if len(features.conditions) < 2:
        raise HannesError(
            "--greedy judges by conditions that took no part in the fit, and there is one condition only: record "
            "another speed or load, or say --no-greedy."
        )


def choose_greedily(search: Search, null: Candidate, limits: Chance, max_effects: int) -> Choice:
    """Effects one after another while the mean square error on held-out conditions falls by at least EACH_TAKES."""
    grown = grown_straight(search, null, max_effects, EACH_TAKES)
    ranking = tuple(Rank.of(c, _share(null, c, limits.median)) for c in grown.first)
    choice = Choice(search, grown.best, limits, False, ranking, grown.rivals, grown.notes)
    return judged_by_conditions(choice, null, grown.errors[0], grown.errors[-1])


def judged_by_conditions(choice: Choice, null: Candidate, first: float, last: float) -> Choice:
    """The choice of a greedy search with whether it is an answer, and what it leaves.

    first, last  error on held-out conditions of the fitted nominal model, and of the chosen one, in multiples of the
                 repeatability, or of the first where there is none
    """
    search, best, left, other_model = choice.search, choice.best, "", False
    known = search.problem.features.repeated
    # Without repeats a guess stands for the scatter, and what it explains says nothing for an effect.
    explained = is_adequate(search, best, choice.limits)
    adequate = explained and (known or not best.names)
    missed = stands_out(search, best) if known else ""
    # Of the fitted nominal model its errors in the fit count too.
    fits = known and not best.names and largest_error(search, best) <= AS_IT_REPEATS
    repeats = known and not missed and (last <= AS_IT_REPEATS or fits)
    enough = repeats or (bool(best.names) and (halved(first, last) if known else last <= HALF * first))
    instead = ""
    if best.names:
        instead = (
            disbelieved(search, best) or led_off(null, best) or (unshown(search, best, last) if known else "")
        )
    if enough and instead:
        adequate = enough = False
        other_model = repeats
        leaves = "no more than the machine repeats" if repeats else "less than half"
        left = f"what was added leaves {leaves}, but {instead}"
    elif enough and not known and (doubt := _doubtful(best)):
        enough = False
        left = (
            f"what was added leaves less than half, but takes {doubt}, and nothing was repeated that would tell an "
            "effect from scatter"
        )
    elif enough and not explained and not repeats:
        left = (
            f"the {shortfall(search, best, choice.limits)}: something smaller is left that the "
            "catalogue does not explain"
        )
    elif best.names and not (adequate or enough):
        above = ", as far as it is above the repeatability" if known else ""
        left = f"of the error on conditions that were left out{above}, more than half is left"
    # What was repeated, and is missed all the same, tells that something is missing.
    alone = missed if fits and not (adequate or enough) else ""
    return replace(choice, adequate=adequate, enough=enough, left=left, alone=alone, other_model=other_model)


def _doubtful(best: Candidate) -> str:
    """What a fit takes beyond where it is believed without repeats, in words; empty if nothing."""
    if best.far_off:
        return "parameters far outside their tolerances"
    own = [c.name for c in best.fit.at_end if c.name.partition(".")[0] in best.names]
    return f"{listed(own)} to the end of its range" if own else ""


def halved(first: float, last: float) -> bool:
    """Whether an error in multiples of the repeatability, as far as it is above that, falls to HALF."""
    return last - 1.0 <= HALF * (first - 1.0)


def _thoroughly(choice: Choice, first: Candidate) -> Sequence[str]:
    """Which effects must be tried thoroughly.

    All, where the model as it is went far off and no effect explains enough.  Where the model has an error of its own,
    much is explained by what is wrong, and a machine that is far off may explain all: then always.  Else the best, if
    it does not explain all: where its fit has ended may not be where it leads.
    """
    if choice.search.slow:
        return ()
    adequate = choice.adequate or is_adequate(choice.search, first, choice.limits)
    if choice.search.problem.discrepancy:
        hard = choice.best.far_off if choice.adequate else choice.best.pulled
    else:
        hard = choice.best.pulled and not adequate
    if hard:
        return choice.sought
    return () if adequate else first.names


def _ended_early(size: int, left: float, best: Candidate, limits: Chance) -> str:
    return (
        f"the best {size} effects leave {100 * left:.0f} % of the misfit that {size - 1} left, and "
        f"{best.fit.cost / limits.misfit:.0f} times what chance reaches: sets of more effects were not tried"
    )


def tie_width(search: Search, best: Candidate) -> float:
    """By how much the penalised cost of a set that ties with the best may be larger."""
    if not search.problem.discrepancy:
        return TIE
    return max(OWN_ERROR_TIE, TIED_PART * OWN_ERROR_PART * best.fit.cost)


def needed_gain(
    choice: Choice, base: Candidate, extended: Candidate | None = None, *, first: bool = False
) -> float:
    """By how much a further effect must lower the penalised cost of a base; `first`: it is the first of the search.

    extended    the base with that effect; without it, what the least is that any must gain
    """
    limits = choice.limits
    enough = is_adequate(choice.search, base, limits, room=1.0)
    further = FURTHER if enough and not first else 1.0
    back = leads_back(base, extended)
    if choice.search.problem.discrepancy:
        part = 0.0 if back else OWN_ERROR_PART
        return max(OWN_ERROR_CHANCE * limits.gain, part * base.fit.cost) * further
    if scatter_is_a_guess(choice.search):
        return max(limits.gain, HALF * base.fit.cost)
    return max(limits.gain, 0.0 if enough or back else WORTHWHILE * base.fit.cost) * further


def _settled(choice: Choice) -> str:
    """Why the chosen set needs no further effect where the model has an error of its own, in words; empty if it may.

    What repeats as badly as that hides the form of another machine too, which may be all that an effect would follow;
    held-out conditions then say how well the others tell the parameters, and no more.  What is far off is told.
    """
    search, best = choice.search, choice.best
    judged = search.problem.discrepancy and is_adequate(search, best, choice.limits)
    why = as_it_repeats(search, best) if judged else ""
    return "" if why and stands_out(search, best) else why


def scatter_is_a_guess(search: Search) -> bool:
    """Whether nothing was repeated of a machine of others: then neither repeats nor chance tell an effect from what the
    model's form is off by, and one must take half of the misfit.
    """
    problem = search.problem
    return problem.rig.foreign and not (problem.discrepancy or problem.features.repeated)


def _may_halve(choice: Choice, base: Candidate, extended: Candidate) -> bool:
    """Whether effects gain more than chance does, and held-out conditions can tell what more they are."""
    search = choice.search
    gain = base.penalised + PENALTY - extended.penalised
    fast = not search.slow and can_be_held_out(search.problem.features)
    return fast and bool(search.problem.discrepancy) and gain >= choice.limits.gain


def _halves(choice: Choice, base: Candidate, extended: Candidate) -> bool:
    """Whether effects halve the held-out error where the model's own error has room for what a base leaves.

    That error's width is assumed; where effects foretell what took no part in the fit so much better, it was wide for
    this machine, and what they gain is not its form.  What halves is the mean square above the repeatability's.
    """
    if not _may_halve(choice, base, extended):
        return False
    before, after = choice.search.each(held_out_error, [(base,), (extended,)], "held-out conditions")
    return before > AS_IT_REPEATS and after**2 - 1.0 <= HALF * (before**2 - 1.0)


def pruned(choice: Choice) -> Choice:
    """Without what a later effect made superfluous: sets grow one by one, and an early one may be a stopgap."""
    while choice.adequate and len(choice.best.names) > 1:
        best = choice.best
        parts = [tuple(n for n in best.names if n != name) for name in best.names]
        part = min(choice.search.without(best, parts), key=lambda c: c.penalised)
        gain = part.penalised + PENALTY - best.penalised
        if gain >= needed_gain(choice, part, best) or not is_adequate(choice.search, part, choice.limits):
            break
        if _halves(choice, part, best):
            break
        choice = cut_to(choice, part)
    return choice


def cut_to(choice: Choice, part: Candidate) -> Choice:
    """The choice of a smaller set, which explains all too, with the sets of its size that do so as well."""
    search = choice.search
    alike = [
        c
        for names, c in search.found.items()
        if len(names) == len(part.names)
        and not set(names) & set(choice.excluded)
        and set(names) != set(part.names)
        and c.penalised <= part.penalised + tie_width(search, part)
        and is_adequate(search, c, choice.limits)
    ]
    return replace(choice, best=part, rivals=tuple(alike))


def _extended(
    choice: Choice, front: Sequence[Candidate], far: Sequence[Candidate], text: str, worth: float
) -> list[Candidate]:
    """The front with one further effect each, best first; and `far`, of another problem, if that does not explain all.

    What ties with the best of the front is extended first, and the others if that does not explain all either.
    Where the best set holds a smaller one that was not extended, that is extended too: the other effect of a pair may
    be the right one though it was not among the best alone.
    """
    search, names = choice.search, choice.sought
    alike = front[0].penalised + tie_width(search, front[0])
    explained = is_adequate(search, front[0], choice.limits, room=1.0)
    first = [c for c in front if explained or c.penalised <= alike]
    round_, extended = search.extend(first, names, text, worth), {frozenset(c.names) for c in first}
    if not (explained or (round_ and is_adequate(search, round_[0], choice.limits))):
        others = [*(c for c in front if c not in first), *search.refitted(far)]
        if others:
            round_ = _best_of(round_, search.extend(others, names, f"{text}, from others", worth))
            extended |= {frozenset(c.names) for c in others}
    while round_ and round_[0].penalised < worth and len(round_[0].names) > 1:
        parts = [frozenset(n for n in round_[0].names if n != one) for one in round_[0].names]
        left = [p for p in parts if p not in extended]
        if not left:
            break
        bases = [search.fitted(key_of(p)) for p in left]
        extended |= set(left)
        # Of a set that ends as a tie the straight lines promise too little on a bent way: what is near is carried on.
        near = round_[0].penalised if search.slow else min(worth, NEAR * round_[0].penalised)
        better = search.extend(bases, names, f"{text}, exchanged", near)
        round_ = _best_of(round_, better)
    return round_


def _best_of(some: Sequence[Candidate], others: Sequence[Candidate]) -> list[Candidate]:
    """Each set once, as it was fitted best; best first."""
    sets = {frozenset(c.names): c for c in sorted((*some, *others), key=lambda c: -c.penalised)}
    return sorted(sets.values(), key=lambda c: c.penalised)


def _share(base: Candidate, candidate: Candidate, least: float) -> float:
    """Part of the base's misfit above a complete model's that the candidate removes, 0..1."""
    excess = base.fit.cost - least
    return float(np.clip((base.fit.cost - candidate.fit.cost) / excess, 0.0, 1.0)) if excess > 0 else 0.0


def tied_sets(choice: Choice) -> tuple[tuple[str, ...], ...]:
    """Sets of the same size that fit as well as the best, within what chance can gain; the best comes first."""
    return (choice.best.names, *(c.names for c in sorted(choice.rivals, key=lambda c: c.penalised)))
