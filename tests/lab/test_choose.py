"""Which of the sets of one size is taken, on made-up costs."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hannes_lab import choose as module
from hannes_lab.chance import Chance
from hannes_lab.choose import OWN_ERROR_PART, choose
from hannes_lab.search import PENALTY, Candidate
from hannes_lab.wording import nearest_sentence

LIMITS = Chance(misfit=1100.0, gain=20.0, median=900.0, draws=0, resampled=False)


def made(names: tuple[str, ...], cost: float, spring: float) -> Candidate:
    """A set of that cost, with the hand's spring so many tolerances off."""
    fit: Any = SimpleNamespace(cost=cost, spring=spring, off=[], coordinates=(), values={})
    return Candidate(names, fit, cost + PENALTY * len(names))


class Made:
    """A search that finds what it is given, of recordings of another machine.

    It has of Search what `choose` calls, and no more.
    """

    problem, slow, sources = SimpleNamespace(discrepancy=True), False, ("a", "b")

    def __init__(self, *found: Candidate) -> None:
        self.found = {c.key: c for c in found}

    def renewed(self, best: Candidate) -> "Made":
        return self

    def refitted(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        return list(candidates)

    def polish(self, candidate: Candidate) -> Candidate:
        return candidate

    def signatures(self, base: Candidate) -> dict[str, list[Any]]:
        return {}

    def without(self, larger: Candidate, names: tuple[str, ...]) -> Candidate:
        return NULL


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
    return monkeypatch


def test_what_leads_back_joins_though_another_fits_better(given: pytest.MonkeyPatch) -> None:
    """The other gains 8 % where OWN_ERROR_PART is asked of it: it is neither the answer nor a tie."""
    assert np.isclose(OWN_ERROR_PART, 0.12)
    given.setattr(module, "_extended", lambda choice, front, *rest: [MORE, BACK] if front == [NULL] else [])
    choice = choose(search_of(MORE, BACK), NULL, LIMITS, 2)
    assert choice.best.names == ("b",) and choice.rivals == ()
    assert [rank.names for rank in choice.ranking] == [("b",), ("a",)]


def test_what_was_asked_of_the_nearest_effect_is_said(given: pytest.MonkeyPatch) -> None:
    given.setattr(module, "_extended", lambda choice, front, *rest: [MORE])
    choice = choose(search_of(MORE), NULL, LIMITS, 1)
    assert choice.best.names == ()
    assert np.isclose(MORE.fit.cost, 920.0)
    assert "lowers the misfit by 80, and 120 are asked for" in nearest_sentence(choice)
