"""A servo joint that lifts an arm: what is known to weigh on a machine, and effects that act on that load."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hannes_description.control_ports import C_POSITION, C_REFERENCE, C_VELOCITY
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_lab.adapter import check_rig
from hannes_lab.closures import find_moves
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.rig import PlantRig
from hannes_lab.trials import Closure, Trial
from hannes_sim.effect import load_effect
from hannes_sim.native import CONTROL_SIGNATURE
from hannes_sim.ports import R_LOAD
from numba import cfunc

WEIGHT, RATIO, KT, COULOMB, INERTIA = 3.0, 100.0, 0.03, 0.4, 0.5
PARAMETERS = f"""
supply: {{voltage: {{value: 24.0, unit: V, lower: 1.0, upper: 50.0, status: assumed, source: test, fixed: true}}}}
motor:
  resistance: {{value: 2.0, unit: ohm, lower: 1.0, upper: 4.0, status: assumed, source: test}}
  kt: {{value: {KT}, unit: N.m/A, lower: 0.01, upper: 0.1, status: assumed, source: test}}
  armature: {{value: {INERTIA / RATIO**2}, unit: kg.m2, lower: 1.0e-6, upper: 1.0e-3, status: assumed, source: test}}
gear: {{ratio: {{value: {RATIO}, unit: "1", lower: 100.0, upper: 100.0, status: assumed, source: test, fixed: true}}}}
friction:
  coulomb: {{value: {COULOMB}, unit: N.m, lower: 0.0, upper: 5.0, status: assumed, source: test}}
  viscous: {{value: 0.3, unit: N.m.s/rad, lower: 0.0, upper: 5.0, status: assumed, source: test}}
"""
MODEL = f"""
schema: hannes/model/1
name: joint
plant: reduced
controller: 'law.py:Law'
parameters: parameters.yaml
effects:
  - name: gravity
    parameters:
      cosine: {{value: 0.0, unit: N.m, lower: -1.0, upper: 1.0, status: assumed, source: test}}
      sine: {{value: {WEIGHT}, unit: N.m, lower: 0.0, upper: 20.0, status: measured, source: test}}
      turn: {{value: 1.0, unit: "1", lower: 1.0, upper: 1.0, status: measured, source: test}}
"""
TOLERANCES = """
motor.kt: {sd: 0.03, closure_sd: 0.0, unit: "1", source: test}
friction.coulomb: {sd: 0.12, closure_sd: 0.0, unit: "1", source: test}
friction.viscous: {sd: 0.2, closure_sd: 0.0, unit: "1", source: test}
gravity.sine: {sd: 0.05, closure_sd: 0.0, unit: "1", source: "the arm's weight and centre"}
"""
LAW = "from lab.test_pendulum import Law\n"


def control(x: Any, p: Any, s: Any) -> Any:
    return p[0] * (x[C_REFERENCE] - x[C_POSITION]) - p[1] * x[C_VELOCITY]


COMPILED = cfunc(CONTROL_SIGNATURE)(control)


class Law:
    def __init__(self, parameters: object, period: float) -> None:
        self.address, self.period = COMPILED.address, period
        self.parameters, self.states = np.array([120.0, 1.2]), np.zeros(1)

    def reset(self) -> None:
        self.states[:] = 0.0


class Joint(PlantRig):
    machine = "joint"
    sizes = {"N.m": 3.0, "rad": 1.4, "V": 4.0, "A": 1.0}
    drive_signals = ("motor_current",)


def reference(seconds: float, laps: int = 6) -> np.ndarray:
    """There and back with a stand at each end."""
    u = np.linspace(0.0, 1.0, round(seconds / 0.002))
    up = 1.4 * (u - np.sin(2 * np.pi * u) / (2 * np.pi))
    lap = np.concatenate([np.zeros(150), up, np.full(150, 1.4), up[::-1]])
    return np.concatenate([np.tile(lap, laps), np.zeros(150)])


def trial_of(name: str, ref: np.ndarray) -> Trial:
    time = np.arange(ref.size) * 0.002
    moves = [
        Closure(a, b, f"{name} {'up' if ref[round(b / 0.002)] > ref[round(a / 0.002)] else 'down'}")
        for a, b in find_moves(ref, 0.002)
    ]
    signals = {"encoder_position": (time, np.zeros(ref.size)), "motor_current": (time, np.zeros(ref.size))}
    return Trial(name, 0.002, ref, signals, tuple(moves))


@pytest.fixture
def joint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Model:
    """The nominal joint, whose adapter says what gravity needs to know."""
    for name, text in (
        ("parameters.yaml", PARAMETERS),
        ("joint.yaml", MODEL),
        ("t.yaml", TOLERANCES),
        ("law.py", LAW),
    ):
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(Joint, "population", tmp_path / "t.yaml")
    monkeypatch.setattr(Joint, "known", {"gravity.turn": 1.0})
    return Model.load(tmp_path / "joint.yaml")


def measured(model: Model, values: dict[str, float]) -> list[Trial]:
    """What loggers show of a joint with these parameters, with noise."""
    rng = np.random.default_rng(5)
    out = []
    for name, seconds in (("slow", 1.6), ("fast", 0.7)):
        trial = trial_of(name, reference(seconds))
        run = Joint([trial]).run(model, values, trial, trial.reference)
        noisy = {
            "encoder_position": run.encoder_position + 2e-4 * rng.standard_normal(run.time.size),
            "motor_current": run.motor_current + 0.01 * rng.standard_normal(run.time.size),
        }
        out.append(replace(trial, signals={n: (trial.signals[n][0], v) for n, v in noisy.items()}))
    return out


def prepared(model: Model, trials: list[Trial]) -> Prepared:
    return prepare(trials, model, rig=Joint)


def test_a_held_arm_takes_the_current_of_its_weight(joint: Model) -> None:
    """At rest the motor holds M sin q within dry friction, and the load that effects see is that weight."""
    ref = np.concatenate([1.2 * np.linspace(0.0, 1.0, 500), np.full(1000, 1.2)])
    trial = replace(trial_of("hold", reference(1.0)), reference=ref)
    run = Joint([trial]).run(joint, {}, trial, ref)
    weight = WEIGHT * np.sin(run.encoder_position[-1])
    assert run.raw[-1, R_LOAD] == pytest.approx(weight, rel=1e-3)
    assert RATIO * KT * run.motor_current[-1] == pytest.approx(weight, abs=COULOMB)
    loaded = joint.with_effect(
        load_effect("load_dependent_friction").entry({"coefficient": 0.5, "share": 0.0})
    )
    up = Joint([trial]).run(loaded, {}, trial, ref)
    moving = slice(300, 480)
    more = RATIO * KT * (up.motor_current - run.motor_current)[moving]
    assert more == pytest.approx(0.5 * WEIGHT * np.sin(run.encoder_position[moving]), rel=0.1)


def test_an_arm_of_another_weight_lacks_nothing(joint: Model, tmp_path: Path) -> None:
    """Its weight is a parameter of an effect that the model has: it is fitted, and written into the model file."""
    mine = prepared(joint, measured(joint, {"gravity.sine": 3.2, "friction.coulomb": 0.43}))
    found = diagnose(mine, effect_sources(only=("coulomb_friction", "load_dependent_friction"), model=joint))
    assert found.verdict == "nothing", found.summary
    assert found.values["gravity.sine"] == pytest.approx(3.2, rel=0.02)
    written = Model.load(found.model.save(tmp_path / "mine.yaml"))
    assert written.named("gravity.sine").value == pytest.approx(3.2, rel=0.02)
    assert written.named("gravity.sine").status == "identified" and written.named("gravity.turn").value == 1.0


def test_friction_that_grows_with_the_weight_is_found_on_a_single_mass(joint: Model) -> None:
    hidden = joint.with_effect(
        load_effect("load_dependent_friction").entry({"coefficient": 0.2, "share": 0.0})
    )
    mine = prepared(joint, measured(hidden, {"gravity.sine": 3.1}))
    names = (
        "load_dependent_friction",
        "viscous_friction",
        "direction_dependent_friction",
        "stribeck_friction",
    )
    found = diagnose(mine, effect_sources(only=names, model=joint))
    assert [e.name for e in found.effects] == ["load_dependent_friction"], found.summary
    assert found.effects[0].parameters["coefficient"].value == pytest.approx(0.2, rel=0.1)


def test_a_weight_that_nobody_told_is_found_where_the_adapter_knows_how_it_turns(
    joint: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    trials, bare = measured(joint, {}), joint.without_effects()
    monkeypatch.setattr(Joint, "population", _without_weight(Joint.population))
    names = ("gravity", "direction_dependent_friction", "current_sensor", "encoder_eccentricity")
    found = diagnose(prepared(bare, trials), effect_sources(only=names))
    assert [e.name for e in found.effects] == ["gravity"], found.summary
    assert found.effects[0].parameters["sine"].value == pytest.approx(WEIGHT, rel=0.05)
    assert found.model.named("gravity.turn").value == 1.0
    assert any(
        "encoder_eccentricity is not considered: the adapter's `known`" in note for note in found.notes
    )
    monkeypatch.setattr(Joint, "known", {})
    again = diagnose(prepared(bare, trials), effect_sources(only=names))
    assert any("does not say 'gravity.turn'" in note for note in again.notes)
    assert "gravity" not in [e.name for e in again.effects]


def _without_weight(path: str | Path) -> Path:
    out = Path(path).with_name("bare.yaml")
    out.write_text("\n".join(line for line in TOLERANCES.splitlines() if "gravity" not in line))
    return out


@pytest.mark.parametrize(
    "known", [{"gravity.speed": 1.0}, {"gravity.turn": float("nan")}, {"gravity.turn": "1"}]
)
def test_figures_that_no_effect_needs_are_refused(
    known: dict[str, float], joint: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Joint, "known", known)
    with pytest.raises(HannesError, match=r"Joint.known: .* it takes numbers for encoder_eccentricity.ratio"):
        check_rig(Joint([trial_of("a", reference(1.0))]))


def test_an_effect_in_a_model_file_is_found_beside_it(tmp_path: Path) -> None:
    """As plant and controller are."""
    (tmp_path / "parameters.yaml").write_text(PARAMETERS)
    (tmp_path / "mine.py").write_text("from hannes_sim.effects.gravity import Gravity as Weight\n")
    text = MODEL.replace("  - name: gravity\n", "  - name: gravity\n    source: mine.py:Weight\n")
    (tmp_path / "joint.yaml").write_text(text)
    model = Model.load(tmp_path / "joint.yaml")
    assert model.effects[0].source == f"{tmp_path / 'mine.py'}:Weight"
