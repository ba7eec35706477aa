"""Recordings of one plant, fitted by another: the model is an approximation of what made them, and knows it."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.adequacy import OWN_ERROR_MOST, is_adequate, shortfall, worst_error
from hannes_lab.chance import chance
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.diagnosis import Diagnosis
from hannes_lab.hand import OWN_ERROR_DRIVE, model_of
from hannes_lab.hide import make_set
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.recorded import make_trial
from hannes_lab.search import Search
from hannes_lab.trials import Trial
from hannes_sim.effect import strength_of

QUICK = ("fast", "grasp_fast")
FEW = ("viscous_friction", "glove_stiffness", "wire_slack")


def diagnosed(*effects: str) -> Diagnosis:
    """The reduced plant's answer to closures of the full hand."""
    made, _ = make_set(
        Model.load("nominal_mujoco"),
        [strength_of(name, 1.0) for name in effects],
        seed=23,
        closures=4,
        conditions=QUICK,
    )
    assert {recording.metadata["plant"] for recording in made} == {"mujoco"}
    trials = [make_trial(recording) for recording in made]
    assert model_of(trials) == "nominal_mujoco"
    silent = replace(trials[0], options={"plant": "mujoco"})
    assert model_of([silent, *trials[1:]]) == "nominal", "one does not describe itself"
    prepared = prepare(trials, Model.load())
    assert "wire.stiffness" in [n.name for n in prepared.nuisances]
    assert prepared.problem.discrepancy
    (said,) = (note for note in prepared.notes if "made them" in note)
    assert (
        "plant 'mujoco' made them, and model 'nominal' has 'reduced'" in said
        and "--model nominal_mujoco" in said
    )
    return diagnose(prepared, effect_sources(only=FEW), max_effects=1)


def test_the_full_hand_lacks_nothing_to_the_reduced_one() -> None:
    assert diagnosed().verdict == "nothing"


def test_an_effect_of_the_full_hand_is_found_by_the_reduced_one() -> None:
    found = diagnosed("glove_stiffness")
    assert found.verdict == "effects" and [e.name for e in found.effects] == ["glove_stiffness"]
    # The full hand's own spring, felt at the pulley, is softer than the reduced one's: the glove makes up for it.
    assert found.effects[0].parameters["stiffness"].value == pytest.approx(0.002, rel=0.5)


def test_an_error_in_one_signal_of_one_condition_is_not_lost_in_the_sum_over_all() -> None:
    made, _ = make_set(Model.load(), [], seed=23, closures=5)
    others = [replace(one, metadata={**one.metadata, "plant": "another"}) for one in made]
    prepared = prepare([make_trial(recording) for recording in others], Model.load())
    search = Search(prepared.problem, prepared.model, prepared.nuisances, {})
    null = search.null()
    limits = chance(search.problem, null.fit, {})
    where, error = worst_error(search, null)
    assert error < 1.0 and is_adequate(search, null, limits)

    problem, k = search.problem, 2
    block, rows = problem.features.blocks[k], problem.features.slices[k]
    wave = np.zeros(problem.features.size)
    wave[rows][: block.phase.size] = np.sqrt(np.diag(problem.rig.own_error([block], prepared.model)))
    wave = 3.0 * problem.whiten(wave)
    off = replace(null, fit=replace(null.fit, residual=wave, cost=float(wave @ wave)))
    assert off.fit.cost < limits.misfit, "in the sum it is small"
    where, error = worst_error(search, off)
    assert where == f"{block.signal} of '{block.condition}'"
    assert error == pytest.approx(3.0, rel=1e-3) and error > OWN_ERROR_MOST
    assert not is_adequate(search, off, limits)
    said = shortfall(search, off, limits)
    assert said.startswith(f"error in {where} is 3.0 times"), said


@pytest.mark.parametrize("lowest", [-np.inf, 0.0])
def test_the_noise_of_a_dynamometer_on_which_nothing_presses_is_no_error_of_the_model(lowest: float) -> None:
    """Also where the recording ends at nought, so that its mean does not."""
    made, _ = make_set(Model.load(), [], seed=23, closures=4, conditions=("slow", "fast"))
    trials, rng = [], np.random.default_rng(2)
    for recording in made:
        trial = make_trial(replace(recording, metadata={**recording.metadata, "plant": "another"}))
        time = trial.signals["encoder_position"][0]
        noise = (time, np.maximum(0.4 * rng.standard_normal(time.size), lowest))
        trials.append(replace(trial, signals={**trial.signals, "grip_force": noise}))
    prepared = prepare(trials, Model.load())
    found = Search(prepared.problem, prepared.model, prepared.nuisances, {}).null().fit
    errors = [e for b, e in prepared.problem.own_errors(found.residual) if b.signal == "grip_force"]
    blocks = [b for b in prepared.features.blocks if b.signal == "grip_force"]
    assert len(errors) == len(blocks) == 2 and max(errors) < OWN_ERROR_MOST
    for block in blocks:
        of_span = OWN_ERROR_DRIVE * float(np.ptp(block.measured))
        mean = float(np.sqrt((block.measured.mean(axis=0) ** 2).mean()))
        assert mean > OWN_ERROR_MOST * of_span, "by its span alone it would be"


def test_who_says_how_another_machine_was_logged_says_no_more_of_it() -> None:
    """Its gains are its own, though the loggers are those that the recordings name."""
    gains = {"control.kp": 0.46, "control.damping": 0.026}
    hand = Model.load().with_values({"friction.coulomb": 0.018, **gains})
    made, _ = make_set(hand, [], seed=23, closures=5, conditions=("slow", "fast"))
    for said in ({"plant": "my_simulator"}, {}):
        metadata = [{k: v for k, v in one.metadata.items() if k != "plant"} | said for one in made]
        recordings = [replace(one, metadata=meta) for one, meta in zip(made, metadata, strict=True)]
        trials = [make_trial(one) for one in recordings]
        prepared = prepare(trials, Model.load())
        assert "log.current_window" not in {n.name for n in prepared.nuisances}
        found = Search(prepared.problem, prepared.model, prepared.nuisances, {}).null().fit
        assert {n: found.values[n] for n in gains} == pytest.approx(gains, rel=0.15)
        # A third less dry friction is within what a hand that is not this simulator's may have.
        z = found.z_of("friction.coulomb")
        assert z is not None and -2.0 < z < -0.5
        assert max(error for _, error in prepared.problem.own_errors(found.residual)) < 0.5


def undescribed(window: float = 0.0, without: str = "") -> list[Trial]:
    """Closures of the reduced plant of which nothing is told, the voltage averaged over the `window` before it [s]."""
    made, _ = make_set(Model.load(), [], seed=23, closures=4, conditions=("fast",), sensors="bench")
    out = []
    for recording in made:
        trial = make_trial(recording)
        time, volts = trial.signals["motor_voltage"]
        fine = np.arange(0.0, 1.0, 0.05) * window
        averaged = np.interp(time[:, None] - fine, time, volts).mean(axis=1)
        signals = {n: v for n, v in trial.signals.items() if n not in ("grip_force", without)}
        options = {k: v for k, v in trial.options.items() if k not in ("sensors", "plant")}
        if "motor_voltage" in signals:
            signals["motor_voltage"] = time, averaged
        out.append(replace(trial, signals=signals, options=options))
    return out


def test_of_a_voltage_more_is_known_beside_current_and_position() -> None:
    def own_error(prepared: Prepared) -> tuple[float, float]:
        """Standard deviation of the voltage while a fast closure closes: of its mean over the phases, and of one."""
        block = next(
            b for b in prepared.features.blocks if (b.signal, b.condition) == ("motor_voltage", "fast")
        )
        covariance = prepared.rig.own_error([block], prepared.model)
        moving = slice(block.phase.size // 4, block.phase.size // 2)
        part = covariance[moving, moving]
        return math.sqrt(part.mean()), math.sqrt(part.diagonal().mean())

    beside, alone = (own_error(prepare(undescribed(without=w), Model.load())) for w in ("", "motor_current"))
    assert beside[0] < 0.3 * alone[0], "what it is on the whole follows from R i + k w"
    assert beside[1] > 2.0 * beside[0], "the speed may stray at once"


def test_the_own_error_is_the_same_to_the_last_digit_in_every_process() -> None:
    """Results are kept under a hash of it; the order of a set of names differs from process to process."""
    printed = set()
    for seed in ("1", "2"):
        code = (
            "from lab.test_other_plant import *; p = prepare(undescribed(), Model.load()); "
            "blocks = [b for b in p.features.blocks if b.condition == 'fast']; "
            "print(p.rig.own_error(blocks, p.model).tobytes().hex())"
        )
        paths = [str(Path(__file__).parents[1]), *filter(None, sys.path)]
        environment = os.environ | {"PYTHONHASHSEED": seed, "PYTHONPATH": os.pathsep.join(paths)}
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stderr
        printed.add(done.stdout)
    assert len(printed) == 1


@pytest.mark.parametrize("window", [0.0, 0.02])
def test_a_voltage_that_was_averaged_is_seen_to_be(window: float) -> None:
    prepared = prepare(undescribed(window), Model.load())
    found = Search(prepared.problem, prepared.model, prepared.nuisances, {}).null().fit
    assert found.values["log.voltage_window"] == pytest.approx(window, abs=3e-3)
    errors = prepared.problem.own_errors(found.residual)
    assert max(error for _, error in errors) < 0.5


def test_to_its_own_plant_a_model_has_no_error_of_its_own() -> None:
    made, _ = make_set(Model.load(), [], seed=23, closures=5, conditions=("slow",))
    prepared = prepare([make_trial(recording) for recording in made], Model.load())
    assert not prepared.problem.discrepancy and not any("made them" in note for note in prepared.notes)
    assert "wire.stiffness" not in [n.name for n in prepared.nuisances]
