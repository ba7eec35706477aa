"""A slow plant seen through the fast one: exact at the anchor, right to first order around it."""

from dataclasses import replace

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.chance import chance
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.features import compact_end
from hannes_lab.hand import HandRig
from hannes_lab.hide import make_set
from hannes_lab.prepare import prepare
from hannes_lab.problem import nuisance_coordinate
from hannes_lab.recorded import make_trial
from hannes_lab.search import Search
from hannes_lab.settle import _sloped
from hannes_lab.surrogate import AnchoredRig, of_length, rig_for
from hannes_lab.trials import Trial
from hannes_sim.effect import strength_of
from hannes_sim.plant import PlantDiverged

FULL = Model.load("nominal_mujoco")


@pytest.fixture(scope="module")
def trial() -> Trial:
    recordings, _ = make_set(Model.load(), [], seed=31, closures=3, conditions=("fast",))
    return make_trial(recordings[0])


@pytest.fixture(scope="module")
def rig(trial: Trial) -> AnchoredRig:
    exact = HandRig([trial])
    wanted = [n for n in exact.nuisances(FULL) if n.name == "hand.stiffness"]
    made = rig_for(exact, FULL, [nuisance_coordinate(n) for n in wanted])
    assert isinstance(made, AnchoredRig)
    return made


def simulated(rig, trial, values):
    reference = trial.reference[: compact_end(trial)]
    run = rig.simulate(FULL, values, trial, reference)
    return np.concatenate([run[name] for name in ("encoder_position", "motor_current")])


def test_at_its_anchor_it_is_the_slow_plant(rig, trial):
    values = {"friction.viscous": 1.1 * FULL.parameters.value("friction.viscous")}
    moved = rig.anchored(FULL, values)
    np.testing.assert_allclose(
        simulated(moved, trial, values), simulated(rig.exact, trial, values), atol=1e-12
    )


def test_slopes_of_the_slow_plant_make_it_right_around_the_anchor(rig, trial):
    values = {"hand.stiffness": 1.1 * FULL.parameters.value("hand.stiffness")}
    true = simulated(rig.exact, trial, values)
    bare = AnchoredRig(rig.exact, FULL, {})
    wrong = np.linalg.norm(simulated(bare, trial, values) - true)
    assert np.linalg.norm(simulated(rig, trial, values) - true) < 0.5 * wrong


def test_a_move_teaches_the_slopes_what_they_missed(rig, trial):
    here = {"hand.stiffness": 1.1 * FULL.parameters.value("hand.stiffness")}
    there = {"hand.stiffness": 1.5 * FULL.parameters.value("hand.stiffness")}
    before, after = rig.anchored(FULL, here), rig.anchored(FULL, there)
    true = simulated(rig.exact, trial, here)
    assert not np.allclose(simulated(after, trial, here), true, atol=1e-6)
    taught = after.taught(before, {"hand.stiffness": 1.0})
    np.testing.assert_allclose(simulated(taught, trial, here), true, atol=1e-9)
    np.testing.assert_allclose(
        simulated(taught, trial, there), simulated(rig.exact, trial, there), atol=1e-12
    )


def test_where_the_slow_plant_diverges_slopes_are_left_out_and_starts_are_seen_from_the_fit(trial):
    prepared = prepare([trial], FULL, surrogate=True)
    search = Search(prepared.problem, FULL, prepared.nuisances, {})
    null = search.null().fit
    c = next(c for c in null.coordinates if c.name == "hand.stiffness")
    wild = replace(c, scale=1e6, upper=np.inf)
    coordinates = tuple(wild if one is c else one for one in null.coordinates)
    failures = search.problem.failures
    problem = _sloped(search.problem, replace(null, coordinates=coordinates), afresh=True)
    assert problem.failures == failures + 1
    assert problem.rig is search.problem.rig
    seen = search._seen_from_start(FULL, coordinates, {"hand.stiffness": 1.0}, null)
    np.testing.assert_allclose(seen.residual(null.model, null.values), null.residual, atol=1e-9)
    assert seen.failures == failures + 2
    near = search._seen_from_start(FULL, null.coordinates, null.point, null)
    assert near.failures == failures + 2


@pytest.mark.parametrize("model", [FULL, Model.load()], ids=lambda m: m.plant)
def test_what_is_unknown_of_a_recording_of_others_can_be_moved_on_every_plant(trial, model):
    strange = replace(trial, options={"object": "soft"})
    rig = HandRig([strange])
    unknown = rig.nuisances(model)
    assert {"control.kp", "log.current_window"} < {n.name for n in unknown}
    for nuisance in unknown:
        moved = {nuisance.name: nuisance_coordinate(nuisance).value(0.5)}
        run = rig.simulate(model, moved, strange, strange.reference[:300])
        assert all(np.isfinite(signal).all() for signal in run.values()), nuisance.name


@pytest.mark.slow
def test_the_full_hand_fits_its_own_recordings_also_without_a_description():
    recordings, _ = make_set(FULL, [], seed=31, closures=4, conditions=("grasp_fast",))
    trials = [make_trial(r) for r in recordings]
    strange = [replace(t, options={k: v for k, v in t.options.items() if k != "sensors"}) for t in trials]
    prepared = prepare(strange, FULL, surrogate=True)
    search = Search(prepared.problem, FULL, prepared.nuisances, effect_sources(only=["cogging"]))
    null = search.null().fit
    limits = chance(search.problem, null, {})
    assert null.cost < limits.misfit
    far = {c.name: z for c, z in zip(null.coordinates, null.z, strict=True) if abs(z) > 3.0}
    assert not any(name.startswith(("hand.", "friction.", "motor.")) for name in far), far


def test_later_closures_repeat_the_second(trial):
    reference = trial.reference[: compact_end(trial)]
    known = np.vstack([reference, -reference])
    whole = of_length(known, trial, trial.reference.size)
    assert whole.shape == (2, trial.reference.size)
    np.testing.assert_array_equal(whole[:, : reference.size], known)
    span = np.ptp(trial.reference)
    assert np.mean(np.abs(whole[0] - trial.reference)) < 0.01 * span


def test_what_belongs_to_one_trial_does_not_simulate_the_others_again():
    recordings, _ = make_set(Model.load(), [], seed=32, closures=3, conditions=("slow", "fast"))
    trials = [make_trial(r) for r in recordings]
    rig, model = HandRig(trials), Model.load()
    before = [rig.simulate(model, {}, t, t.reference) for t in trials]
    after = [rig.simulate(model, {"encoder.zero@slow": 0.01}, t, t.reference) for t in trials]
    assert after[1] is before[1]
    assert after[0] is not before[0]
    assert any(np.any(after[0][name] != before[0][name]) for name in before[0])


@pytest.mark.slow
def test_an_effect_hidden_in_the_full_hand_is_found_with_its_size():
    recordings, truth = make_set(
        FULL, [strength_of("glove_stiffness", 1.0)], seed=33, closures=5, conditions=("fast",)
    )
    prepared = prepare([make_trial(r) for r in recordings], FULL, surrogate=True)
    found = diagnose(prepared, effect_sources(only=["glove_stiffness"]), max_effects=1)
    assert [e.name for e in found.effects] == ["glove_stiffness"]
    estimate = found.effects[0].parameters["stiffness"]
    true = truth.effects[0].values["stiffness"]
    # The valley between the glove and the hand's own spring is long: one condition of five closures ends within 15 %.
    assert estimate.value == pytest.approx(true, rel=0.15)
    assert found.falls[-1].held_out < 0.7 * found.falls[1].held_out


def test_threads_give_the_same_numbers_and_the_same_errors(trial):
    wanted = [n for n in HandRig([trial]).nuisances(FULL) if n.name.startswith("friction.")]
    coordinates = [nuisance_coordinate(n) for n in wanted]
    assert len(coordinates) == 2
    one, two = (rig_for(HandRig([trial]), FULL, coordinates, threads) for threads in (1, 2))
    values = {"friction.viscous": 1.1 * FULL.parameters.value("friction.viscous")}
    np.testing.assert_array_equal(simulated(one, trial, values), simulated(two, trial, values))
    bad = replace(coordinates[0], name="hand.stiffness", offset=1e6, upper=np.inf)
    with pytest.raises(PlantDiverged):
        two.sloped([bad, bad])
