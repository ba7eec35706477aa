"""Whether what a set of effects does is believed."""

import numpy as np
from hannes_description.model import Model
from hannes_lab.adequacy import distorted, leads_back
from hannes_lab.fit import Fit
from hannes_lab.hand import WIDE_STEP
from hannes_lab.problem import Coordinate, effect_coordinates, nuisance_coordinate
from hannes_lab.rig import Nuisance
from hannes_lab.search import Candidate
from hannes_sim.effect import load_effect


def candidate(*off: tuple[Coordinate, float]) -> Candidate:
    coordinates, z = zip(*off, strict=True)
    found = Fit(Model.load(), tuple(coordinates), np.array(z), 1.0, np.ones(2), np.zeros((2, len(z))))
    return Candidate(("cogging",), found, 1.0)


def test_what_leads_a_known_parameter_back_is_worth_more() -> None:
    """Where the hand's own spring has taken over a glove, a little gain tells whose it was."""
    spring, wire = (
        nuisance_coordinate(Nuisance(name, 1.0, sd, True, step=step))
        for name, sd, step in (("hand.stiffness", 0.05, 0.5), ("wire.stiffness", 1.0, WIDE_STEP))
    )
    assert wire.wide and not spring.wide
    base = candidate((spring, 5.0), (wire, 0.0))
    assert leads_back(base) and leads_back(base, candidate((spring, 1.0), (wire, 6.0)))
    assert not leads_back(base, candidate((spring, 3.5), (wire, 0.0)))
    assert not leads_back(candidate((spring, 3.5), (wire, 0.0))), "nothing is far off"
    assert not leads_back(candidate((spring, 0.0), (wire, 6.0))), "a wide tolerance says nothing"


def test_an_effect_that_is_bent_into_another_one_explains_nothing() -> None:
    """One place that resists is no ripple, though a wave of three harmonics may be as narrow."""
    forms = [c for c in effect_coordinates(load_effect("cogging")) if c.form]
    assert [c.name.partition(".")[2] for c in forms] == [
        "second_sine",
        "second_cosine",
        "third_sine",
        "third_cosine",
    ]
    assert not distorted(candidate(*((c, 0.9) for c in forms)))
    said = distorted(candidate((forms[0], 2.0), (forms[2], -1.9)))
    assert said.startswith("cogging would be of another form") and "second_sine 0.4" in said
    assert all(c.at_end(2.0, 0.1) for c in forms), "and none may be larger than that"
