"""Which of the sets of one size is taken, on made-up costs."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hannes_description.errors import HannesError
from hannes_lab import choose as module
from hannes_lab import wording
from hannes_lab.chance import Chance
from hannes_lab.choose import (
    OWN_ERROR_PART,
    Choice,
    _thoroughly,
    choose,
    choose_greedily,
    judged_by_conditions,
)
from hannes_lab.diagnose import _behind_the_law, effect_sources
from hannes_lab.search import PENALTY, Candidate
from hannes_lab.wording import lead, nearest_sentence

LIMITS = Chance(misfit=1100.0, gain=20.0, median=900.0, draws=0, resampled=False)


def made(names: tuple[str, ...], cost: float, spring: float) -> Candidate:
    """A set of that cost, with the hand's spring so many tolerances off."""
    fit: Any = SimpleNamespace(cost=cost, spring=spring, off=[], coordinates=(), values={})
    return Candidate(names, fit, cost + PENALTY * len(names))


class Made:
    """A search that finds what it is given, of recordings of another machine.

    It has of Search what `choose` calls, and no more.
    """

    problem: Any = SimpleNamespace(
        discrepancy=True,
        features=SimpleNamespace(conditions=("slow", "fast"), blocks=(SimpleNamespace(n=5),), repeated=True),
    )
    slow, sources = False, {"a": "a", "b": "b"}

    def __init__(self, *found: Candidate) -> None:
        self.found = {c.key: c for c in found}
        self.held_out: dict[tuple[str, ...], float] = {}

    def each(self, function: Any, items: Sequence[tuple[Candidate]], text: str) -> list[float]:
        return [self.held_out[candidate.names] for (candidate,) in items]

    def polished(self, ranked: Sequence[Candidate], some: Sequence[Candidate], text: str) -> list[Candidate]:
        return list(ranked)

    def renewed(self, best: Candidate) -> "Made":
        return self

    def refitted(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        return list(candidates)

    def polish(self, candidate: Candidate) -> Candidate:
        return candidate

    def signatures(self, base: Candidate) -> dict[str, list[Any]]:
        return {}

    def without(self, larger: Candidate, parts: Sequence[tuple[str, ...]]) -> list[Candidate]:
        return [self.found[part] for part in parts]


def search_of(*found: Candidate) -> Any:
    return Made(*found)


NULL = made((), 1000.0, 5.0)
MORE = made(("a",), 1000.0 - 0.08 * 1000.0, 5.0)
BACK = made(("b",), 1000.0 - 0.05 * 1000.0, 1.0)


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    def leads_back(base: Any, other: Any = None) -> bool:
        return base.fit.spring > 4.0 and (other is None or abs(other.fit.spring) < 3.0)

    monkeypatch.setattr(module, "leads_back", leads_back)
    monkeypatch.setattr(module, "is_adequate", lambda s, c, limits, room=1.0: c.fit.cost <= limits.misfit)
    monkeypatch.setattr(module, "chance", lambda *a: LIMITS)
    monkeypatch.setattr(module, "distorted", lambda search, c: "")
    monkeypatch.setattr(module, "stands_out", lambda *args: "")
    monkeypatch.setattr(module, "as_it_repeats", lambda *args: "")
    return monkeypatch


def test_what_leads_back_joins_though_another_fits_better(given: pytest.MonkeyPatch) -> None:
    """The other gains 8 % where OWN_ERROR_PART is asked of it: it is neither the answer nor a tie."""
    assert np.isclose(OWN_ERROR_PART, 0.12)
    given.setattr(module, "_extended", lambda choice, front, *rest: [MORE, BACK] if front == [NULL] else [])
    choice = choose(search_of(NULL, MORE, BACK), NULL, LIMITS, 2)
    assert choice.best.names == ("b",) and choice.rivals == ()
    assert [rank.names for rank in choice.ranking] == [("b",), ("a",)]


@pytest.mark.parametrize(
    ("gain", "before", "after", "joins"),
    [
        (0.10, 4.0, 2.5, True),
        (0.10, 4.0, 3.0, False),
        (0.03, 4.0, 2.5, True),
        (0.02, 4.0, 2.5, False),
        (0.10, 1.2, 1.0, False),
    ],
    ids=["halves", "does not", "hardly more than chance", "chance", "as it repeats"],
)
def test_a_small_second_effect_joins_where_it_halves_what_was_left_out(
    given: pytest.MonkeyPatch, gain: float, before: float, after: float, joins: bool
) -> None:
    """It gains less than OWN_ERROR_PART: the error on conditions that were left out decides."""
    one = made(("a",), 700.0, 1.0)
    two = made(("a", "b"), (1.0 - gain) * 700.0, 1.0)
    given.setattr(module, "_extended", lambda choice, front, *rest: [one] if front == [NULL] else [two])
    search = search_of(NULL, one, made(("b",), 990.0, 1.0), two)
    search.held_out = {one.names: before, two.names: after}
    choice = choose(search, NULL, LIMITS, 2)
    assert choice.best is (two if joins else one)


def test_what_misses_nothing_by_more_than_it_repeats_lacks_nothing(given: pytest.MonkeyPatch) -> None:
    """A current sensor was named of a hand without an error of it, for one condition that two others did not tell."""
    one = made(("a",), 500.0, 5.0)
    given.setattr(module, "_extended", lambda *args: [one])
    given.setattr(module, "is_adequate", lambda *args, **room: True)
    given.setattr(module, "as_it_repeats", lambda *args: "it repeats no better")
    choice = choose(search_of(NULL, one), NULL, LIMITS, 1)
    assert choice.best is NULL and [rank.names for rank in choice.ranking] == [("a",)]
    assert choice.idle == "a would fit better: it repeats no better" and not choice.notes

    given.setattr(module, "stands_out", lambda *args: "one recorded once")
    assert choose(search_of(NULL, one), NULL, LIMITS, 1).best is one


@pytest.mark.parametrize(
    ("at_end", "repeated", "verdict"),
    [
        ("brush_drop.voltage", False, "doubt"),
        ("motor.kt", False, "enough"),
        ("brush_drop.voltage", True, "enough"),
    ],
)
def test_an_effect_at_the_end_of_its_range_is_no_answer_without_repeats(
    monkeypatch: pytest.MonkeyPatch, at_end: str, repeated: bool, verdict: str
) -> None:
    """A brush drop of 1.5 V, the end, stood for a bridge that coasts."""
    fit: Any = SimpleNamespace(at_end=[SimpleNamespace(name=at_end)], off=[], model=SimpleNamespace(names=()))
    best = cast(Any, SimpleNamespace(names=("brush_drop",), fit=fit, far_off=False, penalised=1.0))
    monkeypatch.setattr(module, "is_adequate", lambda *args: False)
    for quiet in ("stands_out", "disbelieved", "led_off", "unshown"):
        monkeypatch.setattr(module, quiet, lambda *args: "")
    monkeypatch.setattr(module, "shortfall", lambda *args: "misfit")
    search: Any = SimpleNamespace(problem=SimpleNamespace(features=SimpleNamespace(repeated=repeated)))
    choice = judged_by_conditions(Choice(search, best, LIMITS, False, ()), NULL, 4.0, 1.4)
    assert choice.enough is (verdict == "enough")
    assert ("brush_drop.voltage to the end of its range" in choice.left) is (verdict == "doubt")


@pytest.mark.parametrize("largest", [1.1, 27.0])
def test_what_was_recorded_once_leads_only_where_what_was_repeated_is_met(
    monkeypatch: pytest.MonkeyPatch, largest: float
) -> None:
    monkeypatch.setattr(module, "is_adequate", lambda *args: False)
    monkeypatch.setattr(module, "stands_out", lambda *args: "speed of '40 rpm'")
    monkeypatch.setattr(module, "largest_error", lambda *args: largest)
    search: Any = SimpleNamespace(problem=SimpleNamespace(features=SimpleNamespace(repeated=True)))
    choice = judged_by_conditions(Choice(search, NULL, LIMITS, False, ()), NULL, 4.0, 4.0)
    assert choice.alone == ("speed of '40 rpm'" if largest < 2.0 else "")


def test_the_form_of_another_machine_is_no_effect(given: pytest.MonkeyPatch) -> None:
    """A first effect must gain half as much again as chance does, where the model has an error of its own."""
    small = made((), 100.0, 1.0)
    for gain, names in ((25.0, ()), (35.0, ("a",))):
        first = made(("a",), 100.0 - gain, 1.0)
        given.setattr(module, "_extended", lambda *a, first=first: [first])
        assert choose(search_of(small, first), small, LIMITS, 1).best.names == names


@pytest.mark.parametrize(("gain", "named"), [(0.15, True), (0.05, False)], ids=["enough", "too little"])
def test_what_another_machines_law_had_hidden_is_looked_for(
    given: pytest.MonkeyPatch, gain: float, named: bool
) -> None:
    """The law gains more than what is hidden beside it; only where that gains enough by itself a search is made."""
    law, other = made(("a",), 700.0, 5.0), made(("b",), (1.0 - gain) * 1000.0, 5.0)
    tried: list[list[str]] = []

    def extended(choice: Choice, front: Sequence[Candidate], *rest: Any) -> list[Candidate]:
        tried.append(choice.sought)
        return [c for c in (law, other) if set(c.names) <= set(choice.sought)] if front == [NULL] else []

    given.setattr(module, "_extended", extended)
    given.setattr("hannes_lab.diagnose.is_adequate", lambda s, c, limits, room=1.0: True)
    search = search_of(NULL, law, other)
    found = _behind_the_law(search, NULL, LIMITS, 2, "a")
    assert (found is not None) == named and ("a" not in tried[0] if named else not tried)
    assert found is None or (found.best.names == ("b",) and found.rivals == ())
    alike = choose(search_of(NULL, law, other), NULL, LIMITS, 1)
    assert alike.best.names == ("a",)


def test_what_is_tried_thoroughly_is_all_of_a_machine_far_off_else_the_best_that_explains_too_little(
    given: pytest.MonkeyPatch,
) -> None:
    def made_at(cost: float, *names: str, **flags: bool) -> Any:
        return SimpleNamespace(fit=SimpleNamespace(cost=cost), names=names, **flags)

    def tried(
        cost: float, other: bool = True, slow: bool = False, best: float = 2000.0, **flags: bool
    ) -> str:
        flags = {"far_off": False, "pulled": False, **flags}
        search: Any = SimpleNamespace(
            slow=slow, problem=SimpleNamespace(discrepancy=other), sources=("a", "b")
        )
        choice = Choice(search, made_at(cost, **flags), LIMITS, cost <= LIMITS.misfit, ())
        return "".join(_thoroughly(choice, made_at(best, "b")))

    assert tried(900.0, far_off=True) == "ab" and tried(900.0) == ""
    assert tried(900.0, far_off=True, slow=True) == ""
    assert tried(900.0, other=False, far_off=True, pulled=True) == "", "chance explains all there"
    assert tried(2000.0, pulled=True) == "ab" and tried(2000.0, far_off=True) == "b"
    assert tried(2000.0, other=False, pulled=True) == "ab"
    assert tried(2000.0, other=False) == "b", "where the fit of the best has ended may not be where it leads"
    assert tried(2000.0, other=False, pulled=True, best=900.0) == "", "it explains all"


def test_what_was_asked_of_the_nearest_effect_is_said(given: pytest.MonkeyPatch) -> None:
    given.setattr(module, "_extended", lambda choice, front, *rest: [MORE])
    choice = choose(search_of(NULL, MORE), NULL, LIMITS, 1)
    assert choice.best.names == ()
    assert np.isclose(MORE.fit.cost, 920.0)
    assert "lowers the misfit by 80, and 120 are asked for" in nearest_sentence(choice)


@pytest.mark.parametrize("why", ["", "a would take friction.coulomb far off"])
@pytest.mark.parametrize("reason", ["disbelieved", "led_off", "unshown"])
def test_effects_that_only_replace_what_the_model_had_are_no_answer(
    given: pytest.MonkeyPatch, why: str, reason: str
) -> None:
    """However much of the error on conditions that were left out they take."""
    best = made(("a",), 500.0, 5.0)
    grown = SimpleNamespace(best=best, first=(best,), errors=(4.0, 1.1), rivals=(), notes=())
    given.setattr(module, "grown_straight", lambda *args: grown)
    given.setattr(module, "stands_out", lambda *args: "")
    given.setattr(module, "disbelieved", lambda search, c: why if reason == "disbelieved" else "")
    given.setattr(module, "led_off", lambda base, c: why if reason == "led_off" else "")
    given.setattr(module, "unshown", lambda search, c, error: why if reason == "unshown" else "")
    choice = choose_greedily(search_of(NULL, best), NULL, LIMITS, 3)
    assert choice.enough == choice.adequate == (not why)
    assert (why in choice.left and "no more than the machine repeats" in choice.left) == bool(why)
    assert choice.other_model == bool(why)


@pytest.mark.parametrize(
    ("ratio", "gain", "said"),
    [(5.2, 15.0, True), (2.0, 15.0, False), (5.2, 5.0, False)],
    ids=["", "near", "chance"],
)
def test_what_would_come_next_is_told_where_much_is_left(
    given: pytest.MonkeyPatch, ratio: float, gain: float, said: bool
) -> None:
    """No finding: what the form of another machine may be off by hides it."""
    given.setattr(wording, "disbelieved", lambda search, c: "")
    one = made(("a",), 700.0, 1.0)
    search = search_of(NULL, one, made(("a", "b"), 700.0 - gain, 1.0), made(("a", "c"), 699.0, 1.0))
    choice = Choice(search, one, LIMITS, True, ())
    error = SimpleNamespace(signal="motor_voltage", condition="fast", ratio=ratio)
    fall: Any = SimpleNamespace(signals=(error,))
    notes = lead(choice, (fall,))
    assert bool(notes) == said
    if said:
        assert "motor_voltage of 'fast' is still missed by 5.2 times" in notes[0]
        assert "is b, by 15 (chance: 20, and " in notes[0] and "--effect a --effect b" in notes[0]


def test_an_effect_of_ones_own_may_be_among_those_that_alone_take_part() -> None:
    own = f"{Path(__file__).parent / 'outside_effect.py'}:Worn"
    assert effect_sources([own], only=["worn", "cogging"]) == {"cogging": "cogging", "worn": own}
    with pytest.raises(HannesError, match="worn"):
        effect_sources(only=["worn"])
