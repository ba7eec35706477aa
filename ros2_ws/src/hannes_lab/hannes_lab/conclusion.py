"""What a search came to, in a sentence or two."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from .adequacy import shortfall
from .chance import Chance
from .choose import Choice
from .diagnosis import Fall, FoundEffect
from .errors import SignalError
from .falls import fall_sentence
from .prepare import FEW
from .problem import Problem
from .report_text import UNKNOWN, listed, words
from .search import Candidate, Search
from .twins import twins
from .wording import NAMED, Clock, explains_most, far_off, far_values, nearest_sentence, unforetold

MUCH = 2.0
"""Error of a signal in a condition, in multiples of the repeatability, from which "nothing" says where it is."""

CLOCK_LEADS = 0.5
"""Part from which it is said in the summary: what is left after that may need no effect."""


@dataclass(frozen=True)
class Conclusion:
    """A verdict, and what it rests on.

    verdict  "nothing", "effects" or "unknown"
    best     the set that is shown, with its effects; tied: sets that tie with it, itself first
    bent     why the set that chance explains is no answer, if it is none
    only     the effects that were looked for, where those are not the whole catalogue
    greedy   whether effects were added one after another
    clock    what another clock of the reference would remove
    """

    choice: Choice
    best: Candidate
    verdict: str
    effects: tuple[FoundEffect, ...]
    tied: tuple[tuple[str, ...], ...]
    falls: tuple[Fall, ...]
    bent: str
    only: Sequence[str]
    greedy: bool
    clock: Clock | None

    @property
    def search(self) -> Search:
        return self.choice.search

    @property
    def limits(self) -> Chance:
        return self.choice.limits

    @cached_property
    def lost(self) -> tuple[str, ...]:
        """A sentence on an effect that explains most of the misfit, where what was left out is foretold no better."""
        return unforetold(self.choice) if self.greedy and self.verdict == "unknown" else ()

    @cached_property
    def kind(self) -> str:
        """Which kind of "unknown" it is, a key of UNKNOWN; empty for another verdict.

        What fewer than FEW repeats do not bear out may be in the catalogue all the same.
        """
        if self.verdict != "unknown":
            return ""
        features, choice = self.search.problem.features, self.choice
        few = self.greedy and max(features.closures_of.values()) < FEW
        if not (self.effects or self.bent or (features.repeated and not choice.alone)):
            return "no_repeats"
        if self.greedy and explains_most(choice):
            return "not_foretold"
        if choice.other_model or not features.repeated or (self.bent and not self.effects):
            return "model_or_effect"
        if self.only:
            return "not_looked_for"
        return "not_foretold" if few else "not_in_catalogue"

    @property
    def summary(self) -> str:
        """What is missing, how the error falls, and what to be careful with."""
        said = {"nothing": self._nothing, "effects": self._effects, "unknown": self._unknown}
        return said[self.verdict]()

    def _nothing(self) -> str:
        choice, best, limits = self.choice, self.best, self.limits
        explained = (
            f"the model's misfit {best.fit.cost:.0f} is {'below' if best.fit.cost < limits.misfit else 'little above'} "
            f"what chance reaches ({limits.misfit:.0f})"
            if choice.adequate
            else "the model is as close to the recordings as they repeat"
        )
        other = choice.idle and f", though {choice.idle}"
        if not other and choice.adequate and choice.ranking:
            some = f"none of {_named(self.only)}" if self.only else "no effect of the catalogue"
            other = f", and {some} " + (
                "brings the error on conditions that were left out down by enough"
                if self.greedy
                else "gains more than chance would"
            )
        if not self.search.problem.features.repeated:
            other += "; but nothing was repeated, and a guess stands for the scatter"
        nearest = "" if choice.idle or self.greedy else nearest_sentence(choice)
        far = self._far
        return (
            f"Nothing is missing: with its own parameters fitted, {explained}{other}. {self._fall}"
            f"{missed_most(self.search.problem, self.falls[-1].signals, choice.adequate)}{far and far + nearest}"
        )

    def _effects(self) -> str:
        tie = ""
        if len(self.tied) > 1:
            others = "; ".join(" + ".join(names) for names in self.tied[1:])
            tie = f" With these data it ties with: {others}."
        return f"Missing: {self._titles}. {self._fall}{tie}{self._far}"

    def _unknown(self) -> str:
        choice, kind = self.choice, self.kind
        if self.bent and not self.effects:
            return f"{UNKNOWN[kind]}: {self.bent}. {self._fall}{nearest_sentence(choice)}"
        clock = self.clock
        first = f" First look at the clock: {clock.said}." if clock and clock.part >= CLOCK_LEADS else ""
        if kind == "no_repeats" and choice.alone:
            return (
                f"{UNKNOWN[kind]}: what was recorded once is missed by more than the others repeat, and may be "
                f"scatter or an effect: {choice.alone}. Record it again.{first} {self._fall}{self._far}"
            )
        why = self.bent or choice.left or f"the best model's {shortfall(self.search, self.best, self.limits)}"
        if kind == "no_repeats":
            held = len(self.search.problem.features.conditions) > 1
            nearer = (
                ", and what was looked for brings nothing that was left out nearer by enough" if held else ""
            )
            return (
                f"{UNKNOWN[kind]}, for nothing was repeated: {why}, but a guess stands for the "
                f"scatter{nearer}.{first} {self._fall}{self._far}"
            )
        looked_for = f" ({_named(self.only)})" if kind == "not_looked_for" else ""
        part = f" Nearest comes {self._titles}, which is not enough." if self.effects else ""
        far = "" if choice.other_model or self.bent else self._far
        return f"{UNKNOWN[kind]}{looked_for}: {why}.{first}{part} {self._fall}{far}"

    @property
    def _titles(self) -> str:
        return " and ".join(effect.title for effect in self.effects)

    @property
    def _fall(self) -> str:
        return fall_sentence(self.falls, self.greedy)

    @property
    def _far(self) -> str:
        return _moved_far(self.best, twins(self.search, self.best, far_off(self.best)))


def missed_most(problem: Problem, errors: Sequence[SignalError], adequate: bool) -> str:
    """Where a model that has an error of its own, or is not adequate, misses most; empty where it is little."""
    known = [e for e in errors if math.isfinite(e.ratio)]
    worst = max(known, key=lambda e: e.ratio, default=None)
    if worst is None or worst.ratio < MUCH or (adequate and not problem.discrepancy):
        return ""
    where = f" It is largest in {words(worst.signal)} of '{worst.condition}', {worst.ratio:.1f} times the repeatability"
    if not problem.discrepancy:
        return f"{where}: something may act there alone."
    return f"{where}: of another machine the form of the model may be off by as much, and what leaves less is not seen."


def _named(names: Sequence[str]) -> str:
    """A few names, or how many there are."""
    return ", ".join(names) if len(names) <= NAMED else f"{len(names)} effects"


def _moved_far(best: Candidate, twins: Mapping[str, Sequence[str]]) -> str:
    """A sentence on nominal parameters far from their values: this machine's, or an effect of the same form."""
    far = far_values(best)
    if not far:
        return ""
    same = "".join(
        f" With these data {listed(names, 'or')} would do the same as {parameter}."
        for parameter, names in twins.items()
    )
    return (
        f" But it takes {far}, far outside the tolerance: is the nominal model that of this machine, or is "
        f"there an effect of the same form?{same}"
    )
