"""The sets of the benchmark of hidden effects can be made from the catalogue as it is."""

from __future__ import annotations

import importlib
import sys
from typing import Any

import pytest
from hannes_sim.effect import catalogue
from workspace import SOURCES


@pytest.fixture
def identification(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(SOURCES.parents[1] / "bench"))
    yield importlib.import_module("identification")
    for name in ("identification", "outside_effects"):
        sys.modules.pop(name, None)


def test_every_set_hides_what_it_says(identification: Any) -> None:
    cases = identification.cases(list(identification.SETS), dict.fromkeys(catalogue(), 1.0), quick=False)
    assert {case.kind for case in cases} == set(identification.SETS)
    assert len({case.key for case in cases}) == len(cases)
    assert all([e.name for e in case.entries()] for case in cases if case.kind not in ("nothing", "mismatch"))
    shaped = [case for case in cases if case.kind == "shapes"]
    for name, parameter in identification.SHAPES:
        values = {dict(v)[parameter] for case in shaped for effect, v in case.effects if effect == name}
        assert values == set(identification.SHAPES[name, parameter])
