"""Notes that an answer carries beside its summary."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hannes_description.model import Model
from hannes_lab.fit import Fit, nuisance_table
from hannes_lab.problem import nuisance_coordinate
from hannes_lab.rig import Nuisance
from hannes_lab.search import Candidate
from hannes_lab.trials import Closure, Trial
from hannes_lab.wording import _one_way, _unmoved


def test_a_condition_that_is_alone_in_its_direction_is_told() -> None:
    """What differs between directions is not foretold from the other one; square waves step at a closure's start."""
    ticks = np.arange(4000) * 1e-3
    reference = np.where((ticks % 2.0) < 1.0, 1.0, 0.0)
    place = np.where((ticks % 2.0) < 1.0, 1.0 - np.exp(-(ticks % 1.0) / 0.1), np.exp(-(ticks % 1.0) / 0.1))
    noise = 1e-3 * np.random.default_rng(0).standard_normal(ticks.size)
    names = ("up", "down", "up", "down")
    closures = tuple(Closure(k + 0.005, k + 0.995, name) for k, name in enumerate(names))
    trial = Trial("t", 1e-3, reference, {"encoder_position": (ticks, place + noise)}, closures)
    (said,) = _one_way([trial])
    assert said.startswith("'up' is the only condition that goes its way")
    second = replace(
        trial, name="u", closures=(Closure(2.005, 2.995, "up 2"), Closure(3.005, 3.995, "down 2"))
    )
    assert not _one_way([trial, second]), "each direction has another"
    both = replace(trial, closures=(Closure(0.005, 1.995, "lap"), Closure(2.005, 2.995, "up")))
    assert not _one_way([both]), "a lap goes both ways"


def test_a_tolerance_of_what_moves_nothing_is_no_result() -> None:
    model = Model.load()
    nuisances = [
        Nuisance("friction.coulomb", 0.02, 0.1, True, 0.0, "N.m"),
        Nuisance("log.reference_delay", 0.0, 0.01, False, 0.0, "s"),
    ]
    coordinates = tuple(nuisance_coordinate(n) for n in nuisances)
    jacobian = np.array([[1.0, 0.0], [2.0, 1e-9]])
    found = Fit(model, coordinates, np.array([0.5, 1e-12]), 1.0, np.zeros(2), jacobian)
    assert list(nuisance_table(found)) == ["friction.coulomb"]
    assert _unmoved(Candidate((), found, 1.0)) == [
        "log.reference_delay: has a tolerance, but moves none of the compared signals in these recordings"
    ]
