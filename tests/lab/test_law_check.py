"""A control law that does not give what was recorded is said before anything is fitted with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hannes_description.control_ports import C_PERIOD, C_POSITION, C_REFERENCE, C_VELOCITY
from hannes_description.model import Model
from hannes_lab.closures import find_moves
from hannes_lab.join import join_trials
from hannes_lab.law_check import law_notes
from hannes_lab.prepare import prepare
from hannes_lab.rig import PlantRig, load_rig
from hannes_lab.trials import Closure, Trial
from hannes_sim.factory import make_plant
from hannes_sim.native import CONTROL_SIGNATURE
from hannes_sim.rollout import Rollout, rollout
from lab.single_mass_rig import Law, reference, write_files
from numba import cfunc


def integrating(x, p, s):  # type: ignore[no-untyped-def]
    s[0] += 40.0 * x[C_PERIOD] * p[0] * (x[C_REFERENCE] - x[C_POSITION])
    return p[0] * (x[C_REFERENCE] - x[C_POSITION]) - p[1] * x[C_VELOCITY] + s[0]


INTEGRATING = cfunc(CONTROL_SIGNATURE)(integrating)
ADAPTER = f"{Path(__file__).parent / 'single_mass_rig.py'}:SingleMass"


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> tuple[type[PlantRig], Model, Trial]:
    """An axis, its model, and a recording of it at every tick; its mass is another one than the model's."""
    folder = tmp_path_factory.mktemp("axis")
    write_files(folder)
    base, model = load_rig(ADAPTER), Model.load(folder / "mass.yaml")
    rig = type("Axis", (base,), {"population": folder / "tolerances.yaml"})
    path = reference(2)
    true = model.with_values({"motor.armature": 2.6})
    run = rollout(make_plant(true), rig([]).controller(true, 1e-3), path)
    moves = [
        Closure(a, b, f"{path[round(a / 1e-3)]:.2f} to {path[round(b / 1e-3)]:.2f}")
        for a, b in find_moves(path, 1e-3)
    ]
    signals = {
        "encoder_position": (run.time, run.encoder_position),
        "drive_force": (run.time, run.motor_voltage),
    }
    trial = Trial(
        "axis", 1e-3, path, signals, tuple(moves), units={"drive_force": "N", "encoder_position": "m"}
    )
    return rig, model, trial


def with_signals(trial: Trial, **signals: tuple[np.ndarray, np.ndarray]) -> Trial:
    return replace(trial, signals={**trial.signals, **signals})


def noisy(trial: Trial) -> Trial:
    rng = np.random.default_rng(1)
    (time, position), (_, force) = trial.signals["encoder_position"], trial.signals["drive_force"]
    return with_signals(
        trial,
        encoder_position=(time, position + 1e-6 * rng.standard_normal(time.size)),
        drive_force=(time, force + 0.02 * rng.standard_normal(time.size)),
    )


def of_gains(rig: type[PlantRig], kp: float, kd: float) -> type[PlantRig]:
    """The same adapter with another law."""

    class Other(Law):
        def __init__(self, parameters: object, period: float) -> None:
            super().__init__(parameters, period)
            self.parameters = np.array([kp, kd])

    return type("Other", (rig,), {"controller": lambda self, model, period: Other(None, period)})


def test_the_law_of_the_machine_is_not_spoken_of(machine: tuple[type[PlantRig], Model, Trial]) -> None:
    rig, model, trial = machine
    assert law_notes(rig([trial]), model) == law_notes(rig([noisy(trial)]), model) == []


@pytest.mark.parametrize(("kp", "kd"), [(800.0 * 180.0 / np.pi, 60.0), (800.0, 0.06), (1600.0, 60.0)])
def test_a_gain_in_another_unit_is_said(
    kp: float, kd: float, machine: tuple[type[PlantRig], Model, Trial]
) -> None:
    rig, model, clean = machine
    trial = noisy(clean)
    (said,) = law_notes(of_gains(rig, kp, kd)([trial]), model)
    assert "the control law gives a drive_force that differs from the recorded one by" in said
    assert said in prepare([trial], model, rig=of_gains(rig, kp, kd)).notes


@pytest.mark.parametrize(("kp", "right"), [(800.0, True), (1600.0, False)])
def test_a_gain_of_each_recording_that_run_gives_is_the_one_that_is_asked(
    kp: float, right: bool, machine: tuple[type[PlantRig], Model, Trial]
) -> None:
    """The model file says another one: `run` gives the law a model that has the recording's."""
    rig, model, clean = machine
    trial = replace(noisy(clean), options={"kp": kp})

    class Own(Law):
        def __init__(self, gain: float, period: float) -> None:
            super().__init__(None, period)
            self.parameters = np.array([gain, 60.0])

    def run(
        self: PlantRig, model: Model, values: Mapping[str, float], trial: Trial, reference: np.ndarray
    ) -> Rollout:
        return rig.run(self, replace(model, controller=str(trial.options["kp"])), values, trial, reference)

    def controller(self: PlantRig, model: Model, period: float) -> Law:
        return Own(float(model.controller) if model.controller[:1].isdigit() else 200.0, period)

    own = type("Own", (rig,), {"run": run, "controller": controller})
    assert (law_notes(own([trial]), model) == []) is right


@pytest.mark.parametrize(("shift", "row"), [(1, "before"), (-1, "after")])
def test_a_command_that_stands_a_row_off_is_said(
    shift: int, row: str, machine: tuple[type[PlantRig], Model, Trial]
) -> None:
    rig, model, trial = machine
    time, force = trial.signals["drive_force"]
    (said,) = law_notes(rig([with_signals(trial, drive_force=(time, np.roll(force, shift)))]), model)
    assert f"the recorded drive_force is what the control law gives for the row {row} it" in said


def test_a_law_that_integrates_begins_anew_with_each_file_that_does(
    machine: tuple[type[PlantRig], Model, Trial],
) -> None:
    """Files that end with something left in the integral, one after the other in one trial."""
    rig, model, _ = machine

    class Integrating(Law):
        def __init__(self, parameters: object, period: float) -> None:
            super().__init__(parameters, period)
            self.address, self.states = INTEGRATING.address, np.zeros(1)

    axis = type("Axis", (rig,), {"controller": lambda self, model, period: Integrating(None, period)})
    path = np.concatenate(
        [np.zeros(100), 0.05 * np.sin(np.linspace(0.0, 0.5 * np.pi, 800)) ** 2, np.full(300, 0.05)]
    )
    run = rollout(make_plant(model), axis([]).controller(model, 1e-3), path)
    files = []
    for k in range(5):
        signals = {
            "encoder_position": (run.time, run.encoder_position),
            "drive_force": (run.time, run.motor_voltage),
        }
        closure = Closure(0.0, float(run.time[-1]), "push")
        units = {"drive_force": "N", "encoder_position": "m"}
        files.append(Trial(f"push{k}", 1e-3, path, signals, (closure,), units=units, fresh=True))
    (joined,) = join_trials(files)
    assert joined.anew
    assert law_notes(axis([files[0]]), model) == law_notes(axis([joined]), model) == []
    (said,) = law_notes(rig([joined]), model)
    assert "are its form, its gains" in said


def test_files_that_are_too_short_for_a_mean_are_not_asked(
    machine: tuple[type[PlantRig], Model, Trial],
) -> None:
    rig, model, trial = machine
    few = slice(0, 12)
    signals = {name: (time[few], values[few]) for name, (time, values) in trial.signals.items()}
    closure = Closure(0.0, 0.011, "push")
    short = replace(trial, reference=trial.reference[few], signals=signals, closures=(closure,))
    assert law_notes(of_gains(rig, 8.0, 0.6)([short]), model) == []


def test_a_log_that_is_slower_than_the_loop_cannot_tell(
    machine: tuple[type[PlantRig], Model, Trial],
) -> None:
    rig, model, trial = machine
    time, position = trial.signals["encoder_position"]
    slow = with_signals(trial, encoder_position=(time[::10], position[::10]))
    assert law_notes(of_gains(rig, 8.0, 0.6)([slow]), model) == []
