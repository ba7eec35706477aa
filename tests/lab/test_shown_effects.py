"""Effects of one's own that the project shows (`examples/effects`), and how a diagnosis leads to them."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.executor import Executor
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.problem import nuisance_coordinate
from hannes_lab.rig import Nuisance, load_rig
from hannes_lab.wording import _coasting
from hannes_sim.effect import load_effect
from hannes_sim.factory import make_plant
from hannes_sim.rollout import rollout
from lab.single_mass_rig import Law, reference, write_files

ADAPTER = f"{Path(__file__).parent / 'single_mass_rig.py'}:SingleMass"
SHOWN = Path(__file__).parents[2] / "examples" / "effects"
WHOLE, PART, HERTZ, DAMPING = 2.1, 0.7, 6.0, 0.04


def quick(laps: int = 4) -> np.ndarray:
    """Ramps of 0.1 m in 0.2 s and 0.05 m in 0.3 s there, and in 0.5 and 0.4 s back, with stands of 1 s."""
    ways = [(0.0, 0.1, 200), (0.1, 0.0, 500), (0.0, 0.05, 300), (0.05, 0.0, 400)]
    lap = np.concatenate([np.append(np.linspace(a, b, n), np.full(1000, b)) for a, b, n in ways])
    return np.concatenate([np.zeros(1000), *[lap] * laps])


def recorded(folder: Path) -> Path:
    """The single mass of 2.1 kg of which 0.7 kg hang on a spring: two masses, in steps of 20 us."""
    write_files(folder)
    gain, brake = Law(None, 1e-3).parameters
    wanted = quick()
    rate = 2.0 * math.pi * HERTZ
    spring, damper = PART * rate**2, 2.0 * DAMPING * PART * rate
    step, q, v, y, w = 2e-5, 0.0, 0.0, 0.0, 0.0
    position, force = np.zeros(wanted.size), np.zeros(wanted.size)
    before = 0.0
    for k, target in enumerate(wanted):
        position[k] = q
        force[k] = gain * (target - q) - brake * (q - before) / 1e-3
        before = q
        for _ in range(50):
            pull = spring * (q - y) + damper * (v - w)
            v, w = v + step * (force[k] - pull - 5.0 * v) / (WHOLE - PART), w + step * pull / PART
            q, y = q + step * v, y + step * w
    rng = np.random.default_rng(1)
    path = folder / "mass.npz"
    noisy = position + 2e-6 * rng.standard_normal(wanted.size)
    np.savez(path, reference=wanted, position=noisy, force=force + 0.02 * rng.standard_normal(wanted.size))
    return path


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    path = recorded(tmp_path_factory.mktemp("elastic"))
    rig = load_rig(ADAPTER)
    return prepare(rig.read([path]), Model.load(path.parent / "mass.yaml"), rig=rig)


def test_a_bridge_that_coasts_takes_the_back_emf_away_between_its_pulses() -> None:
    """At half the supply a motor without load runs at twice the speed: it is braked half of the time only."""
    source = f"{SHOWN / 'coasting_bridge.py'}:CoastingBridge"
    effect = load_effect(source)
    model = Model.load().with_values({"hand.preload": 0.0, "hand.stiffness": 0.0, "friction.viscous": 0.0})
    model = model.with_values({"friction.coulomb": 0.0, "hand.coulomb": 0.0, "hand.viscous": 0.0})
    emf = model.parameters.value("motor.kt") * model.parameters.value("gear.ratio")
    supply = model.parameters.value("supply.voltage")

    def speed(part: float, share: float) -> float:
        with_it = model.with_effect(effect.entry({"emf": share * emf}, source=source))
        plant = make_plant(with_it)
        plant.set("hand.travel", 1e6)
        plant.advance(part * supply, 8000)
        before = plant.read().position
        plant.advance(part * supply, 400)
        return (plant.read().position - before) / (400 * plant.dt)

    assert speed(0.5, 0.0) == pytest.approx(0.5 * supply / emf, rel=0.02)
    assert speed(0.5, 1.0) == pytest.approx(supply / emf, rel=0.02)
    assert speed(1.0, 1.0) == pytest.approx(speed(1.0, 0.0), rel=1e-6)


class Known(dict[str, float]):
    def value(self, name: str) -> float:
        return self[name]


@pytest.mark.parametrize(
    ("fitted", "signals", "compensated", "source", "told"),
    [
        (0.006, ["encoder_position"], 0.0, "cogging", True),
        (0.04, ["encoder_position"], 0.0, "cogging", False),  # too high
        (
            0.006,
            ["encoder_position", "motor_current"],
            0.0,
            "cogging",
            False,
        ),  # the current tells the torque constant
        (0.006, ["encoder_position"], 1.0, "cogging", False),  # the command is a current
        (0.006, ["encoder_position"], 0.0, "mine/bridge.py:CoastingBridge", False),  # it takes part already
    ],
)
def test_a_torque_constant_that_is_far_too_low_points_at_the_bridge(
    fitted: float, signals: list[str], compensated: float, source: str, told: bool
) -> None:
    kt = nuisance_coordinate(Nuisance("motor.kt", 0.0175, 0.1, True, unit="N.m/A"))
    blocks = [SimpleNamespace(signal=signal) for signal in signals]
    problem = SimpleNamespace(rig=SimpleNamespace(foreign=True), features=SimpleNamespace(blocks=blocks))
    parameters = Known({"motor.emf_compensated": compensated, "gear.ratio": 49.0})
    model = SimpleNamespace(parameters=parameters)
    search = SimpleNamespace(problem=problem, model=model, sources={"one": source})
    best = SimpleNamespace(fit=SimpleNamespace(values={"motor.kt": fitted}, off=[(kt, abs(kt.z(fitted)))]))
    said = _coasting(search, best)  # type: ignore[arg-type]
    assert [("coasting_bridge.py" in note and "(0.858 N.m/A)" in note) for note in said] == [True] * told


@pytest.mark.slow
def test_what_swings_is_unknown_and_its_frequency_is_said(prepared: Prepared, executor: Executor) -> None:
    only = ["coulomb_friction", "cogging", "command_delay", "gearbox_inertia"]
    found = diagnose(prepared, effect_sources(only=only, model=prepared.model), executor=executor)
    assert found.verdict == "unknown"
    first = found.depends_on[0]
    # Of the whole machine in its loop: the load's own frequency with the motor held is a little lower.
    assert first.variable == "frequency" and first.at is not None and HERTZ * 0.9 < first.at < HERTZ * 1.5
    assert any("oscillates at" in note for note in found.notes)


def test_with_the_effect_that_is_shown_it_is_found(
    prepared: Prepared, tmp_path: Path, executor: Executor
) -> None:
    mine = tmp_path / "elastic.py"
    text = (SHOWN / "elastic_load.py").read_text().replace("INERTIA = 0.04\n", "INERTIA = 0.5\n")
    mine.write_text(text.replace("FREQUENCY = 6.0\n", "FREQUENCY = 7.0\n"))
    source = f"{mine}:ElasticLoad"
    found = diagnose(
        prepared, effect_sources(only=["coulomb_friction", source], model=prepared.model), executor=executor
    )
    (effect,) = found.effects
    assert effect.name == "elastic_load"
    for name, true in (("inertia", PART), ("frequency", HERTZ), ("damping", DAMPING)):
        p = effect.parameters[name]
        assert p.low <= true <= p.high or p.value == pytest.approx(true, rel=0.03), name
    assert found.falls[-1].held_out < 0.05 * found.falls[1].held_out


HERE = {"level": 3.0, "place": 0.04, "width": 0.008}


@pytest.mark.parametrize(
    ("file", "kind", "guess", "mine", "values", "variable"),
    [
        (
            "local_friction.py",
            "LocalFriction",
            "10.0, 0.38, 0.05",
            "2.0, 0.05, 0.01",
            HERE,
            "friction_by_position",
        ),
        ("local_torque.py", "LocalTorque", "0.1, 0.7, 0.05", "2.0, 0.05, 0.01", HERE, "position"),
        (
            "position_inertia.py",
            "PositionInertia",
            "0.01, 2.0 * math.pi",
            "0.1, 0.15",
            {"sine": 0.1, "cosine": 0.6, "period": 0.2},
            "inertia_by_position",
        ),
    ],
)
def test_what_acts_by_place_is_said_to_and_found(
    tmp_path: Path,
    file: str,
    kind: str,
    guess: str,
    mine: str,
    values: dict[str, float],
    variable: str,
    executor: Executor,
) -> None:
    """What rubs with 3 N at 40 mm of the way, both ways; or pulls there; or 2 kg that are up to 0.6 kg more or less."""
    write_files(tmp_path)
    rig, model = load_rig(ADAPTER), Model.load(tmp_path / "mass.yaml")
    own = tmp_path / file
    text = (SHOWN / file).read_text()
    assert f" = {guess}\n" in text
    own.write_text(text.replace(f" = {guess}\n", f" = {mine}\n"))
    source = f"{own}:{kind}"
    acts = load_effect(source).entry(values, source=source)
    run = rollout(make_plant(model.with_effect(acts)), rig([]).controller(model, 1e-3), reference(3))
    rng = np.random.default_rng(2)
    position = run.encoder_position + 2e-6 * rng.standard_normal(run.time.size)
    force = run.motor_voltage + 0.05 * rng.standard_normal(run.time.size)
    np.savez(tmp_path / "mass.npz", reference=run.reference_position, position=position, force=force)
    prepared = prepare(rig.read([tmp_path / "mass.npz"]), model, rig=rig)
    only = ["cogging", "stribeck_friction", "direction_dependent_friction"]
    found = diagnose(prepared, effect_sources(only=only, model=prepared.model), executor=executor)
    assert found.verdict == "unknown"
    first = found.depends_on[0]
    assert first.variable == variable
    # A detent pulls most beside its place.
    assert "place" not in values or first.at == pytest.approx(values["place"], abs=0.012)
    assert {d.variable: d.unit for d in found.depends_on} == {
        "position": "m",
        "velocity": "m/s",
        "direction": "",
        "load": "N",
        "time": "",
        "friction_by_position": "m",
        "inertia_by_position": "m",
        "frequency": "Hz",
    }
    assert file in found.notes[0]
    found = diagnose(
        prepared, effect_sources(only=["stribeck_friction", source], model=prepared.model), executor=executor
    )
    (effect,) = found.effects
    for name, true in values.items():
        assert effect.parameters[name].value == pytest.approx(true, rel=0.03), name
