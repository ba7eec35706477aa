"""What is said of a set before anything is fitted."""

from dataclasses import replace

from hannes_description.model import Model
from hannes_lab.features import build_features
from hannes_lab.hide import make_set
from hannes_lab.prepare import drifts, notes_of
from hannes_lab.trials import make_trial


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
