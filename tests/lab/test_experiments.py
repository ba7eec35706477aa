"""The experiments that are proposed for a tie: worth recording where they tell the models apart, and only there."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
from hannes_description.model import Model
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.executor import Executor
from hannes_lab.experiments import VISIBLE, separating_experiments
from hannes_lab.hand import HandRig
from hannes_lab.hide import make_set
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.recorded import make_trial
from hannes_lab.search import Candidate, Search
from hannes_lab.trials import Trial
from hannes_sim.effect import strength_of
from hannes_sim.plant import PlantDiverged

QUICK = ("fast", "grasp_fast")


def distance_of_fits(prepared: Prepared, names: Sequence[str], executor: Executor) -> float:
    search = Search(
        prepared.problem,
        prepared.model,
        prepared.nuisances,
        effect_sources(only=names, model=prepared.model),
        executor=executor,
    )
    search.null()
    tied = [search.fitted((name,)) for name in names]
    return separating_experiments(prepared, tied)[0].distance


@pytest.fixture(scope="module")
def undescribed() -> Prepared:
    """Recordings of a hand on a slack wire that do not say how they were made."""
    recordings, _ = make_set(
        Model.load(), [strength_of("wire_slack", 1.0)], seed=21, closures=4, conditions=QUICK
    )
    trials = [make_trial(r) for r in recordings]
    return prepare([replace(t, options={"object": t.options["object"]}) for t in trials], Model.load())


@pytest.mark.slow
def test_nothing_recorded_in_operation_tells_slack_from_an_encoder_offset(
    undescribed: Prepared, executor: Executor
) -> None:
    only = ["wire_slack", "encoder_offset"]
    found = diagnose(undescribed, effect_sources(only=only, model=undescribed.model), executor=executor)
    assert set(found.tied) == {("wire_slack",), ("encoder_offset",)}
    assert found.experiments[0].distance < VISIBLE
    (note,) = (n for n in found.notes if "no further recording" in n)
    assert "the encoder read before the controller is on" in note


def test_another_recording_tells_slack_from_a_glove(undescribed: Prepared, executor: Executor) -> None:
    assert distance_of_fits(undescribed, ["wire_slack", "glove_stiffness"], executor) > VISIBLE


@pytest.fixture(scope="module")
def tied(undescribed: Prepared, executor: Executor) -> tuple[Search, list[Candidate]]:
    """A search, and two of its sets that are taken to tie."""
    found = undescribed
    search = Search(found.problem, found.model, found.nuisances, effect_sources(only=["gravity"]), executor)
    return search, [search.null(), search.add(search.null(), "gravity")]


def test_what_diverges_in_one_condition_leaves_the_others(
    undescribed: Prepared, tied: tuple[Search, list[Candidate]], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, models = tied
    assert any(e.name == "fast_soft" for e in separating_experiments(undescribed, models, keep=8))
    simulate = HandRig.simulate

    def diverges(self: HandRig, model: Model, values: Any, trial: Trial, reference: Any) -> Any:
        if trial.name == "fast_soft":
            raise PlantDiverged("too fast")
        return simulate(self, model, values, trial, reference)

    monkeypatch.setattr(HandRig, "simulate", diverges)
    left = separating_experiments(undescribed, models, keep=8)
    assert len(left) == 7 and all(e.name != "fast_soft" for e in left)


def test_a_signal_that_never_changes_tells_nothing_apart(
    undescribed: Prepared, tied: tuple[Search, list[Candidate]]
) -> None:
    _, models = tied
    before = separating_experiments(undescribed, models)
    features = undescribed.features
    still = replace(features.blocks[0], signal="grip_force", measured=0.0 * features.blocks[0].measured)
    more = replace(features, blocks=(*features.blocks, still), slices=())
    assert separating_experiments(replace(undescribed, features=more), models) == before
    # One closure: its roughness stands for the noise.
    alone = tuple(
        replace(
            b,
            measured=b.measured[:1],
            full=tuple(a[:1] for a in b.full),
            compact=None,
            beside=None,
        )
        for b in features.blocks
    )
    single = replace(undescribed, features=replace(features, blocks=alone, slices=()))
    found = separating_experiments(single, models)
    assert found[0].distance == pytest.approx(before[0].distance, rel=1.5)
