"""What a scan of the strengths and shapes of an effect hands to the fits, and which of these are carried on."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from hannes_description.model import Model
from hannes_lab.fit import Fit
from hannes_lab.scan import _distinct
from hannes_lab.search import Candidate, Search


def test_of_points_of_one_period_the_best_stays_in_its_place() -> None:
    scored = [(float(cost), {"period": period}) for cost, period in enumerate((2.0, 3.0, 2.0, 5.0, 3.0))]
    assert _distinct(scored, "period") == [scored[0], scored[1], scored[3]]


def test_what_can_no_longer_tie_is_not_polished() -> None:
    """The best explains all: what costs ten times as much cannot come down to it, and fitting it would take long."""
    model = Model.load()

    def candidate(name: str, cost: float) -> Candidate:
        return Candidate((name,), Fit(model, (), np.zeros(0), cost, np.zeros(50), np.zeros((50, 0))), cost)

    search: Any = SimpleNamespace(slow=False, problem=SimpleNamespace(features=SimpleNamespace(size=50)))
    whole = [candidate("gravity", 40.0), candidate("cogging", 4000.0)]
    assert Search._rivals(search, whole, 1e6) == 400.0
    assert Search._rivals(search, whole, 100.0) == 100.0
    assert Search._rivals(search, whole[1:], 1e6) == 1e6, "nothing explains all: whatever may help is tried"
    assert Search._rivals(search, [], 1e6) == 1e6
