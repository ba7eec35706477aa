"""Whether what a set of effects does is believed."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.adequacy import distorted, exaggerated, in_the_law, leads_back, led_off, unshown
from hannes_lab.diagnose import effect_sources
from hannes_lab.fit import Fit
from hannes_lab.hide import make_set
from hannes_lab.prepare import prepare
from hannes_lab.problem import Coordinate, effect_coordinates, nuisance_coordinate
from hannes_lab.recorded import make_trial
from hannes_lab.rig import Nuisance
from hannes_lab.search import Candidate, Search
from hannes_sim.effect import load_effect


def candidate(*off: tuple[Coordinate, float]) -> Candidate:
    coordinates, z = zip(*off, strict=True)
    found = Fit(Model.load(), tuple(coordinates), np.array(z), 1.0, np.ones(2), np.zeros((2, len(z))))
    return Candidate(("cogging",), found, 1.0)


def test_what_leads_a_known_parameter_back_is_worth_more() -> None:
    """Where the hand's own spring has taken over a glove, a little gain tells whose it was."""
    spring, wire = (
        nuisance_coordinate(Nuisance(name, 1.0, sd, True, wide=wide))
        for name, sd, wide in (("hand.stiffness", 0.05, False), ("wire.stiffness", 1.0, True))
    )
    assert wire.wide and not spring.wide
    base = candidate((spring, 5.0), (wire, 0.0))
    assert leads_back(base) and leads_back(base, candidate((spring, 1.0), (wire, 6.0)))
    assert not leads_back(base, candidate((spring, 3.5), (wire, 0.0)))
    assert not leads_back(candidate((spring, 3.5), (wire, 0.0))), "nothing is far off"
    assert not leads_back(candidate((spring, 0.0), (wire, 6.0))), "a wide tolerance says nothing"


def test_effects_that_take_a_known_parameter_far_off_replace_what_the_model_had() -> None:
    """A drag that grows with the square of the speed is bent into a breakaway friction without any dry friction."""
    dry, wire = (
        nuisance_coordinate(Nuisance(name, 0.02, sd, True, wide=wide))
        for name, sd, wide in (("friction.coulomb", 0.1, False), ("wire.stiffness", 1.0, True))
    )
    base = candidate((dry, -1.3), (wire, 0.0))
    said = led_off(base, candidate((dry, -9.0), (wire, 0.0)))
    assert said.startswith("cogging would take friction.coulomb to") and "9 times its tolerance off" in said
    last = led_off(base, candidate((dry, -9.0), (wire, 0.0)), ["current_sensor"])
    assert last.startswith("current_sensor would take friction.coulomb to")
    assert not led_off(base, candidate((dry, -3.5), (wire, 6.0)))
    assert not led_off(candidate((dry, -3.5)), candidate((dry, -9.0))), "it was off before"


def test_a_wave_that_the_way_does_not_show_repeat_is_believed_where_it_is_all_that_is_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An oval encoder and an eccentric pulley (no catalogue) were ripples of 1.9 and 2.1 waves, and much was left."""
    (dry,) = (nuisance_coordinate(Nuisance("friction.coulomb", 0.02, 0.1, True)),)
    found, waves = candidate((dry, 0.0)), [2.3]
    monkeypatch.setattr("hannes_lab.adequacy.waves_of", lambda *args: waves[0])
    others: Any = SimpleNamespace(problem=SimpleNamespace(of_others=True))
    assert unshown(others, found, 1.6).startswith("cogging, of 2.3 waves in all, would leave 1.60 times")
    assert not unshown(others, found, 1.2), "no more than the machine repeats"
    assert not unshown(others, found, float("nan"))
    own: Any = SimpleNamespace(problem=SimpleNamespace(of_others=False))
    assert not unshown(own, found, 1.6), "of its own simulator chance says what is left"
    waves[0] = 4.0
    assert not unshown(others, found, 1.6)


def test_an_effect_that_is_bent_into_another_one_explains_nothing() -> None:
    """One place that resists is no ripple, though one wave of three harmonics may be as narrow; many waves are one."""
    recordings, _ = make_set(Model.load(), [], seed=5, closures=2, conditions=("slow",))
    prepared = prepare([make_trial(r) for r in recordings], Model.load())
    search = Search(prepared.problem, prepared.model, prepared.nuisances, effect_sources(only=["cogging"]))
    coordinates = {c.name.partition(".")[2]: c for c in effect_coordinates(load_effect("cogging"))}
    travel = prepared.rig.trials[0].span

    def said(waves: float, **shapes: float) -> str:
        period = coordinates["period"]
        off = {name: shapes.get(name, 0.0) for name, c in coordinates.items() if c.form}
        assert list(off) == ["second_sine", "second_cosine", "third_sine", "third_cosine"]
        at = ((coordinates[name], z) for name, z in off.items())
        return distorted(search, candidate((period, period.z(travel / waves)), *at))

    assert not said(1.5, second_sine=1.0, third_cosine=-2.0)
    assert not said(4.0, second_sine=3.0, third_cosine=-4.0)
    assert not said(0.7), "of a recording of this very simulator the catalogue's law is exact"
    search.problem.discrepancy = ((np.zeros(0, dtype=np.int64), np.zeros((0, 0))),)
    assert said(0.7).startswith("cogging, of 0.7 waves in all, would repeat nowhere")
    bent = said(1.5, second_sine=3.0, third_cosine=-4.0)
    assert (
        bent.startswith("cogging, of 1.5 waves in all, would be of another form")
        and "third_cosine -0.8" in bent
    )


def test_no_effect_far_stronger_than_usual_is_believed_of_another_machine() -> None:
    """A catch at one place (no catalogue) was a slack that ends there, beside a weight and a glove."""
    recordings, _ = make_set(Model.load(), [], seed=5, closures=2, conditions=("slow",))
    prepared = prepare([make_trial(r) for r in recordings], Model.load())
    names = ("wire_slack", "glove_stiffness")
    search = Search(prepared.problem, prepared.model, prepared.nuisances, effect_sources(only=names))
    of = {c.name: c for name in names for c in effect_coordinates(load_effect(name))}

    def said(**values: float) -> str:
        at = {f"wire_slack.{n}" if n == "slack" else f"glove_stiffness.{n}": v for n, v in values.items()}
        found = candidate(*((of[name], of[name].z(value)) for name, value in at.items()))
        return exaggerated(search, replace(found, names=names))

    assert not said(slack=4.8), "of a recording of this very simulator an effect may be as strong as it fits"
    search.problem.discrepancy = ((np.zeros(0, dtype=np.int64), np.zeros((0, 0))),)
    assert not said(slack=3.9, stiffness=0.015)
    assert said(slack=4.8).startswith("wire_slack.slack would be 4.8 rad, 10 times what is typical")
    assert said(slack=0.5, stiffness=0.002, hardening=5e-5).startswith("glove_stiffness.hardening would be")

    def alone(slack: float) -> str:
        found = candidate((of["wire_slack.slack"], of["wire_slack.slack"].z(slack)))
        return exaggerated(search, replace(found, names=("wire_slack",)))

    assert not alone(4.8), "one effect that explains all by itself may be stronger than one of two"
    assert "16 times what is typical" in alone(8.2)


def test_how_the_law_of_another_machine_sets_in_is_told_by_its_way() -> None:
    recordings, _ = make_set(Model.load(), [], seed=5, closures=2, conditions=("slow",))
    prepared = prepare([make_trial(r) for r in recordings], Model.load())
    names = ("presliding_friction", "cogging")
    search = Search(prepared.problem, prepared.model, prepared.nuisances, effect_sources(only=names))
    of = {c.name: c for c in effect_coordinates(load_effect("presliding_friction"))}
    length = of["presliding_friction.length"]

    def told(value: float) -> tuple[str, str]:
        return in_the_law(search, replace(candidate((length, length.z(value))), names=names))

    assert told(0.009) == ("", ""), "of a recording of this very simulator the law is exact"
    search.problem.discrepancy = ((np.zeros(0, dtype=np.int64), np.zeros((0, 0))),)
    assert told(0.03) == ("", "")
    effect, how = told(0.009)
    assert effect == "presliding_friction" and how.startswith("length 0.009 rad, 0.06") and "travel" in how
