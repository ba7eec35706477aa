"""What a scan of the strengths and shapes of an effect hands to the fits, and which of these are carried on."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.diagnose import _idle_at_the_end, effect_sources
from hannes_lab.diagnosis import Fall
from hannes_lab.fit import Fit
from hannes_lab.hide import make_set
from hannes_lab.prepare import prepare
from hannes_lab.recorded import make_trial
from hannes_lab.scan import _distinct, _Place, _strengths, tried_periods
from hannes_lab.search import FAR, Candidate, Search
from hannes_lab.spectrum import resolved
from hannes_lab.trials import Closure, Trial
from hannes_sim.effect import load_effect


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


def test_what_a_parameter_took_over_is_tried_in_its_effects_place() -> None:
    """The joints' friction is the hand's own: 0.006 N.m more take it far off, and the hand sticks."""
    hidden = load_effect("joint_friction").entry({"level": 0.006})
    made, _ = make_set(Model.load(), [hidden], seed=31, closures=5, conditions=("fast", "grasp_fast"))
    prepared = prepare([make_trial(one) for one in made], Model.load())
    sources = effect_sources(only=["joint_friction", "viscous_friction"], model=prepared.model)
    search = Search(prepared.problem, prepared.model, prepared.nuisances, sources)
    null = search.null()
    z = null.fit.z_of("hand.coulomb")
    assert z is not None and z > FAR and null.far_off

    def swaps(name: str) -> list[Any]:
        kind, (model, coordinates) = search.effect(name), search.with_effects((name,))
        place = _Place(search.scan, kind, null.fit, model, coordinates)
        (strength,) = _strengths(kind)
        return place.swapped({}, strength)

    ((cost, start),) = swaps("joint_friction")
    more = null.fit.values["hand.coulomb"] - prepared.model.parameters.value("hand.coulomb")
    _, coordinates = search.with_effects(("joint_friction",))
    own = next(c for c in coordinates if c.name == "joint_friction.level")
    assert start["hand.coulomb"] == 0.0 and own.value(start[own.name]) == pytest.approx(more)
    assert cost == pytest.approx(null.fit.cost - z**2, rel=1e-3), "the misfit stays, the prior's charge goes"
    assert swaps("viscous_friction") == [], "it has another unit"
    found = search.extend([null], list(sources), "one")
    assert found[0].names == ("joint_friction",) and not found[0].far_off
    assert found[0].fit.values["joint_friction.level"] == pytest.approx(0.006, rel=0.3)


def test_a_parameter_that_went_to_nought_is_stepped_where_numbers_are() -> None:
    """Less viscous friction than none has no logarithm; the effect in its place may be negative."""
    made, _ = make_set(Model.load(), [], seed=32, closures=5, conditions=("fast",))
    prepared = prepare([make_trial(one) for one in made], Model.load())
    name = "direction_dependent_friction"
    search = Search(
        prepared.problem,
        prepared.model,
        prepared.nuisances,
        effect_sources(only=[name], model=prepared.model),
    )
    found = search.null().fit
    at = [c.name for c in found.coordinates].index("friction.viscous")
    wide = replace(found.coordinates[at], log=True, scale=0.5, lower=0.0)
    z = found.z.copy()
    z[at] = wide.z(1e-5 * wide.offset)
    places = tuple(wide if k == at else c for k, c in enumerate(found.coordinates))
    found = replace(found, coordinates=places, z=z)
    kind, (model, coordinates) = search.effect(name), search.with_effects((name,))
    coordinates = tuple(wide if c.name == wide.name else c for c in coordinates)
    place = _Place(search.scan, kind, found, model, coordinates)
    with np.errstate(all="raise"):
        place.swapped({}, f"{name}.viscous")


def test_a_ripple_that_passes_faster_than_it_is_sampled_is_not_tried() -> None:
    """Its alias is any slow curve: what a wrong model leaves, too."""
    ticks = np.arange(0.0, 4.0, 0.001)
    time = np.arange(0.0, 4.0, 0.02)

    def ramp(at: np.ndarray, speed: float) -> np.ndarray:
        return speed * np.minimum(at, 2.0)

    def trial(name: str, speed: float) -> Trial:
        signals = {"encoder_position": (time, ramp(time, speed))}
        return Trial(name, 0.001, ramp(ticks, speed), signals, (Closure(0.0, 3.9, name),))

    def features(*trials: Trial) -> Any:
        return SimpleNamespace(trials=trials)

    fast, slow = trial("fast", 10.0), trial("slow", 2.0)
    assert resolved(features(fast)) == pytest.approx(2 * 10.0 * 0.02, rel=1e-6)
    assert resolved(features(fast, slow)) == pytest.approx(2 * 2.0 * 0.02, rel=1e-6)
    alone = replace(fast, signals={"motor_current": fast.signals["encoder_position"]})
    assert resolved(features(alone)) == 0.0
    noise = 1e-4 * np.random.default_rng(0).standard_normal(time.size)
    held = replace(slow, name="held", signals={"encoder_position": (time, noise)})
    assert resolved(features(fast, held)) == resolved(features(fast)), "it goes nowhere"
    short = replace(fast, signals={"encoder_position": (time[:1], time[:1])})
    assert resolved(features(short)) == 0.0

    blocks = (SimpleNamespace(signal="encoder_position", measured=ramp(ticks, 10.0)),)
    kind, base = (
        load_effect("cogging"),
        Fit(Model.load(), (), np.zeros(0), 0.0, np.zeros(1), np.zeros((1, 0))),
    )

    def tried(foreign: bool) -> float:
        problem: Any = SimpleNamespace(
            features=SimpleNamespace(trials=(fast,), blocks=blocks), rig=SimpleNamespace(foreign=foreign)
        )
        return min(tried_periods(kind, problem, base))

    assert tried(True) >= 0.4 and tried(False) == pytest.approx(0.5)


def test_an_effect_with_which_conditions_are_foretold_worse_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """It joined by a quick look; the whole fits say another thing."""
    monkeypatch.setattr("hannes_lab.diagnose._may_be_nought", lambda *_: False)
    monkeypatch.setattr("hannes_lab.diagnose.led_off", lambda *_: "")
    features = SimpleNamespace(repeated=False, closures_of={"a": 1, "b": 1}, conditions=("a", "b"))
    search: Any = SimpleNamespace(problem=SimpleNamespace(features=features), fit_of=lambda names: None)
    found: Any = SimpleNamespace(names=("coulomb_friction", "cogging"))
    limits: Any = None  # what judges by them says no here

    def falls(*errors: float) -> list[Fall]:
        return [Fall("", math.nan, math.nan, {}, (), {"encoder_position": error}) for error in errors]

    def why(last: float) -> str:
        return _idle_at_the_end(search, found, limits, falls(0.1, 0.05, 0.016, last), False)

    assert why(0.021) == (
        "the error on held-out conditions rises with it from 0.32 to 0.42 times the fitted nominal model's"
    )
    assert why(0.015) == "" and why(0.01601) == ""
