"""What is said of a set before anything is fitted."""

from dataclasses import replace
from typing import Any

import pytest
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_lab.features import build_features
from hannes_lab.hand import HandRig
from hannes_lab.hide import make_set
from hannes_lab.prepare import drifts, notes_of
from hannes_lab.recorded import make_trial
from hannes_lab.rig import Nuisance


def known(model: Model, **entries: dict[str, Any]) -> Model:
    """The model whose file says of some parameters how well they are known; `__` stands for the dot."""
    changed = {
        name: replace(model.parameters[name], **entry)
        for name, entry in ((key.replace("__", "."), entry) for key, entry in entries.items())
    }
    parameters = replace(model.parameters, entries={**model.parameters.entries, **changed}, _hash=[])
    return replace(model, parameters=parameters)


def priors(model: Model, condition: str, **options: Any) -> dict[str, Nuisance]:
    """Of closures that somebody recorded whose bag says no more than these options."""
    (recording,), _ = make_set(Model.load(), [], seed=5, closures=2, conditions=(condition,))
    trial = replace(make_trial(recording), options=options)
    return {nuisance.name: nuisance for nuisance in HandRig([trial]).nuisances(model)}


def test_what_a_model_file_says_of_its_tolerances_goes_before_what_is_usual() -> None:
    usual = priors(Model.load(), "slow")
    assert usual["wire.stiffness"].wide and usual["control.kp"].wide
    told = known(
        Model.load(),
        wire__stiffness={"tolerance": 0.1},
        motor__resistance={"tolerance": 0.3},
        control__kp={"fixed": False, "tolerance": 0.0},
        supply__voltage={"fixed": False, "tolerance": 0.02},
    )
    mine, values = priors(told, "slow"), told.parameters
    wire, volts = mine["wire.stiffness"], mine["supply.voltage"]
    assert (wire.mean, wire.log, wire.wide) == (values.value("wire.stiffness"), False, False)
    assert wire.sd == pytest.approx(0.1 * wire.mean)
    winding, before = mine["motor.resistance"], usual["motor.resistance"]
    assert (winding.sd, winding.log) == (0.3, True)
    assert winding.closure_sd * winding.mean == pytest.approx(before.closure_sd), "the same scatter"
    assert volts.sd == pytest.approx(0.02 * 12.0) and "supply.voltage" not in usual
    assert "control.kp" not in mine and "control.damping" in mine
    assert mine["friction.coulomb"] == usual["friction.coulomb"]


def test_a_tolerance_of_what_nothing_moves_is_refused() -> None:
    strange = known(Model.load(), pulley__radius={"tolerance": 0.1})
    with pytest.raises(
        HannesError, match=r"'pulley\.radius' has a tolerance, but no fit can move it on the plant"
    ):
        priors(strange, "slow")


def test_an_object_may_be_known_well() -> None:
    """As the pulley feels it: of one of which nothing more is said the fit may make what it likes."""
    data = {"shape": "box", "size": 0.06, "stiffness": 20000.0, "damping": 10.0}
    usual, mine = (
        priors(Model.load(), "grasp", object={**data, **more}) for more in ({}, {"tolerance": 0.2})
    )
    for name in ("object.stiffness@grasp", "object.damping@grasp"):
        assert usual[name].wide and usual[name].sd > 1.0
        assert (mine[name].wide, mine[name].sd, mine[name].mean) == (False, 0.2, usual[name].mean)
    assert mine["object.damping@grasp"].effect == "object_damping"
    assert mine["object.position@grasp"] == usual["object.position@grasp"], "the encoder shows it"
    undamped = priors(Model.load(), "grasp", object={**data, "damping": 0.0})
    assert "object.stiffness@grasp" in undamped and "object.damping@grasp" not in undamped
    exactly = priors(Model.load(), "grasp", object={**data, "tolerance": 0.0})
    assert [name for name in exactly if name.startswith("object.")] == ["object.position@grasp"]
    with pytest.raises(HannesError, match=r"tolerance is -0\.1; it must be 0 \(known\) or more"):
        priors(Model.load(), "grasp", object={**data, "tolerance": -0.1})


def test_what_is_said_of_several_recordings_stands_once() -> None:
    recordings, _ = make_set(Model.load(), [], seed=5, closures=2, conditions=("fast", "slow", "grasp"))
    a, b, c = (make_trial(r) for r in recordings)
    noted = [replace(a, notes=("one", "two")), replace(b, notes=("two",)), c]
    assert notes_of(noted) == [f"{a.name}: one", f"{a.name}, {b.name}: two"]


def test_closures_that_drift_are_said_to() -> None:
    """A friction that wears off: each closure asks for a little less current than the one before."""
    recordings, _ = make_set(Model.load(), [], seed=5, closures=12, conditions=("fast", "slow"))
    trials = [make_trial(r) for r in recordings]
    assert drifts(build_features(trials, ["motor_current"])) == []
    fast = trials[0]
    time, current = fast.signals["motor_current"]
    less = (time, current * (1.0 - 0.2 * time / time[-1]))
    worn = replace(fast, signals={**fast.signals, "motor_current": less})
    (said,) = drifts(build_features([worn, trials[1]], ["motor_current"]))
    assert said.startswith("fast: the closures drift") and "of the scatter of motor_current" in said


def test_few_closures_of_each_condition_show_a_drift_together() -> None:
    recordings, _ = make_set(Model.load(), [], seed=5, closures=5, conditions=("fast", "slow", "grasp"))
    trials = [make_trial(r) for r in recordings]
    assert drifts(build_features(trials, ["motor_current"])) == []
    worn = []
    for trial in trials:
        time, current = trial.signals["motor_current"]
        signals = {**trial.signals, "motor_current": (time, current * (1.0 - 0.2 * time / time[-1]))}
        worn.append(replace(trial, signals=signals))
    (said,) = drifts(build_features(worn, ["motor_current"]))
    assert said.startswith("in all conditions alike the closures drift from the first to the last")
    # what changes one way in one condition and the other way in another is no drift of the machine
    opposite = worn[0].signals["motor_current"]
    there = (opposite[0], trials[0].signals["motor_current"][1] * (0.8 + 0.2 * opposite[0] / opposite[0][-1]))
    worn[0] = replace(worn[0], signals={**worn[0].signals, "motor_current": there})
    assert drifts(build_features(worn, ["motor_current"])) == []
