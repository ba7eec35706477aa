"""Calibration: a planted truth is recovered, what cannot be known is said, a stopped run goes on."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_lab.calibrate import _key, calibrate
from hannes_lab.hide import make_set
from hannes_lab.identify import free_coordinates, identify, search
from hannes_lab.prepare import prepare
from hannes_lab.recorded import make_trial
from hannes_lab.remembered import Remembered
from hannes_lab.trials import unique_names
from hannes_lab.validation.targets import Target, TargetProblem, calibrate_targets

NOMINAL = Model.load("nominal")
NAMES = ["friction.coulomb", "hand.preload"]


def line(model: Model, values: Mapping[str, float]) -> dict[str, float]:
    a = values.get("friction.coulomb", model.parameters.value("friction.coulomb"))
    b = values.get("hand.preload", model.parameters.value("hand.preload"))
    return {"sum": a + b, "difference": a - b, "product": 100.0 * a * b}


def problem(*names: str, sd: float = 1e-4) -> TargetProblem:
    truth = line(NOMINAL, {"friction.coulomb": 0.030, "hand.preload": 0.012})
    return TargetProblem(tuple(Target(n, "R00", truth[n], sd) for n in names), line)


def test_figures_give_back_their_truth() -> None:
    found = calibrate_targets(
        problem("sum", "difference", "product"), NOMINAL, free_coordinates(NOMINAL, NAMES)
    )
    values = {p.name: p for p in found.parameters}
    assert values["friction.coulomb"].value == pytest.approx(0.030, rel=2e-3)
    assert values["hand.preload"].value == pytest.approx(0.012, rel=2e-3)
    assert all(p.identified and p.low < p.value < p.high for p in found.parameters)
    assert found.agree == 3 and not found.warnings
    entry = found.model.parameters["friction.coulomb"]
    assert entry.status == "identified" and "R00" in entry.source and "95 %" in entry.source


def test_what_figures_cannot_tell_apart_is_said_with_the_pair() -> None:
    found = calibrate_targets(problem("sum"), NOMINAL, free_coordinates(NOMINAL, NAMES))
    assert not any(p.identified for p in found.parameters)
    assert any("friction.coulomb" in text and "hand.preload" in text for text in found.warnings), (
        found.warnings
    )
    assert any("2 free parameters for 1 figures" in text for text in found.warnings)


def test_a_figure_that_does_not_depend_on_it_leaves_the_prior() -> None:
    coordinates = free_coordinates(NOMINAL, ["motor.resistance"])
    best = search(problem("sum"), NOMINAL, coordinates, starts=1)[0]
    (found,) = identify(best, ["motor.resistance"])
    assert not found.identified
    assert found.narrowing == pytest.approx(1.0, abs=0.01)
    assert found.value == pytest.approx(1.49, rel=1e-6)


def test_a_stopped_calibration_goes_on_from_its_folder(tmp_path: Path) -> None:
    class Stopped(Exception):
        pass

    def stop(done: int, total: int, text: str) -> None:
        if done > 5:
            raise Stopped

    coordinates = free_coordinates(NOMINAL, NAMES)
    with pytest.raises(Stopped):
        calibrate_targets(
            problem("sum", "difference"), NOMINAL, coordinates, starts=1, cache=tmp_path, progress=stop
        )
    kept = len(list(tmp_path.glob("*.npz")))
    assert kept == 5
    again = calibrate_targets(problem("sum", "difference"), NOMINAL, coordinates, starts=1, cache=tmp_path)
    fresh = calibrate_targets(problem("sum", "difference"), NOMINAL, coordinates, starts=1)
    assert again.from_cache >= kept
    assert [p.value for p in again.parameters] == [p.value for p in fresh.parameters]
    other = calibrate_targets(
        problem("sum", "difference", sd=2e-4), NOMINAL, coordinates, starts=1, cache=tmp_path
    )
    alone = calibrate_targets(
        problem("sum", "difference", sd=2e-4), NOMINAL, coordinates, starts=1, cache=tmp_path / "alone"
    )
    assert other.from_cache == alone.from_cache, "what was kept is of another noise"
    assert [p.value for p in other.parameters] == [p.value for p in alone.parameters]


def test_a_cut_file_in_the_cache_is_made_again(tmp_path: Path) -> None:
    kept = Remembered(problem("sum"), "key", tmp_path)
    first = kept.residual(NOMINAL, {"friction.coulomb": 0.02})
    (file,) = tmp_path.glob("*.npz")
    file.write_bytes(file.read_bytes()[:20])
    assert np.array_equal(kept.residual(NOMINAL, {"friction.coulomb": 0.02}), first)


@pytest.mark.parametrize(
    ("names", "text"),
    [([], "Nothing is free"), (["friction.coulomb"] * 2, "twice"), (["friction.glue"], "friction.glue")],
)
def test_bad_names_are_refused(names: list[str], text: str) -> None:
    with pytest.raises(HannesError, match=text):
        free_coordinates(NOMINAL, names)


def test_residuals_of_other_signals_of_the_same_bag_are_not_taken_for_these() -> None:
    recordings, _ = make_set(NOMINAL, [], seed=4, closures=2, conditions=("fast",), sensors="bench")
    trial = make_trial(recordings[0])
    time, current = trial.signals["motor_current"]
    other = replace(trial, signals={**trial.signals, "motor_current": (time, current + 0.1)})
    keys = {_key(prepare([t], NOMINAL).problem) for t in (trial, trial, other)}
    assert len(keys) == 2


def test_a_hand_is_recovered_from_its_recordings(tmp_path: Path) -> None:
    hand = NOMINAL.with_values({"friction.coulomb": 0.034, "hand.preload": 0.0085})
    recordings, _ = make_set(
        hand, [], seed=4, closures=4, conditions=("slow", "grasp"), sensors="bench", spread=0.0
    )
    prepared = prepare(unique_names([make_trial(r) for r in recordings]), NOMINAL)
    found = calibrate(prepared, NAMES, starts=1, evaluations=8, cache=tmp_path)
    values = {p.name: p for p in found.parameters}
    assert values["friction.coulomb"].value == pytest.approx(0.034, rel=0.05)
    assert values["hand.preload"].value == pytest.approx(0.0085, rel=0.2)
    assert found.errors["after"] < found.errors["before"]
    assert found.errors["held_out"] < 0.5 * found.errors["before"]
    assert found.model.provenance["bags"] and found.model.provenance["free"] == NAMES
    path = found.model.save(tmp_path / "my_hand.yaml")
    assert Model.load(path).sha256 == found.model.sha256
    with pytest.raises(HannesError, match=r"Did you mean friction\.coulomb"):
        calibrate(prepared, ["friction.colomb"])
    with pytest.raises(HannesError, match=r"control\.saver_time"):
        calibrate(prepared, ["control.saver_time"])


def test_intervals_hold_the_tolerances_of_what_is_not_free() -> None:
    """Hands drawn from the population; `bench/coverage.py` does the same with more of them."""
    names = ["friction.coulomb", "hand.preload", "motor.kt"]
    inside, exact, count = 0, 0, 0
    for seed in range(1010, 1018):
        recordings, truth = make_set(NOMINAL, [], seed=seed, closures=4)
        prepared = prepare(unique_names([make_trial(r) for r in recordings]), NOMINAL)
        for p in calibrate(prepared, names, starts=1).parameters:
            true = NOMINAL.parameters.value(p.name) * float(truth.parameters[p.name].split()[1])
            inside += p.low <= true <= p.high
            alone = 0.5 * np.log(p.high / p.low) * np.sqrt(max(0.0, 1.0 - p.held_share))
            exact += abs(np.log(p.value / true)) <= alone
            count += 1
    assert inside >= 0.8 * count
    assert exact < inside


def test_a_held_parameter_that_is_off_is_named() -> None:
    hand = NOMINAL.with_values({"motor.kt": 0.92 * NOMINAL.parameters.value("motor.kt")})
    recordings, _ = make_set(hand, [], seed=1, closures=4, spread=0.0)
    prepared = prepare(unique_names([make_trial(r) for r in recordings]), NOMINAL)
    found = calibrate(prepared, ["hand.preload"], starts=1)
    assert any("motor.kt" in text and "free it too" in text for text in found.warnings)
    better = calibrate(prepared, ["hand.preload", "motor.kt"], starts=1)
    assert not any("free it too" in text for text in better.warnings)
    assert better.errors["after"] < 0.3 * found.errors["after"]


def test_gains_may_be_free_and_that_they_are_marked_as_fixed_is_said(tmp_path: Path) -> None:
    hand = NOMINAL.with_values({"control.kp": 0.46})
    recordings, _ = make_set(hand, [], seed=1, closures=3, conditions=("slow", "fast"), spread=0.0)
    prepared = prepare(unique_names([make_trial(r) for r in recordings]), NOMINAL)
    found = calibrate(prepared, ["control.kp"], starts=1, cache=tmp_path)
    (kp,) = found.parameters
    assert kp.value == pytest.approx(0.46, rel=0.02)
    assert found.model.parameters.value("control.kp") == kp.value
    assert any("marked as fixed" in text for text in found.warnings)


def test_a_full_disk_ends_the_keeping_and_not_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: object, **_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    kept = Remembered(problem("sum"), "key", tmp_path)
    monkeypatch.setattr(np, "savez", full)
    values = {"friction.coulomb": 0.02}
    assert np.array_equal(kept.residual(NOMINAL, values), problem("sum").residual(NOMINAL, values))
    assert not list(tmp_path.iterdir()), "nothing half written stays"
