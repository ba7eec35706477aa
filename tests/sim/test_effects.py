"""The catalogue: every effect vanishes exactly, moves an output, and is the same function compiled and in Python."""

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hannes_control.double_pid import DoublePID
from hannes_control.reference import half_sine
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_sim.effect import Effect, EffectParameter, catalogue, effect_of, evaluate, load_effect
from hannes_sim.factory import make_plant
from hannes_sim.objects import OBJECTS
from hannes_sim.ports import (
    CURRENT,
    DAMPING,
    DT,
    FRICTION,
    LOAD,
    LOAD_FRICTION,
    QL,
    RESISTANCE,
    SENSE_POSITION,
    SLACK,
    TORQUE,
    Q,
    V,
)
from hannes_sim.rollout import Rollout, rollout

NAMES = sorted(catalogue())
EXPECTED = {
    "viscous_friction",
    "coulomb_friction",
    "stribeck_friction",
    "velocity_strengthening",
    "load_dependent_friction",
    "direction_dependent_friction",
    "wire_slack",
    "wire_elasticity",
    "glove_stiffness",
    "glove_hysteresis",
    "gearbox_inertia",
    "gear_backlash",
    "cogging",
    "gravity",
    "return_preload",
    "winding_heating",
    "supply_sag",
    "brush_drop",
    "current_sensor",
    "encoder_offset",
    "encoder_eccentricity",
    "command_delay",
    "object_damping",
}


def runs(model: Model) -> list[Rollout]:
    law = DoublePID.of_model(model.parameters)
    return [
        rollout(make_plant(model, OBJECTS[grasp]), law, half_sine(1, period=period), joints=False)
        for period, grasp in ((2.0, "none"), (2.0, "rigid"))
    ]


@pytest.fixture(scope="module")
def nominal() -> list[Rollout]:
    return runs(Model.load())


def test_catalogue_has_what_the_design_lists() -> None:
    assert set(NAMES) >= EXPECTED


@pytest.mark.parametrize("name", NAMES)
def test_vanishes_exactly(name: str, nominal: list[Rollout]) -> None:
    effect = load_effect(name)
    off = effect.entry({p.name: p.vanishing for p in effect.parameters if p.vanishing is not None})
    for a, b in zip(runs(Model.load().with_effect(off)), nominal, strict=True):
        assert np.array_equal(a.raw, b.raw) and np.array_equal(a.motor_voltage, b.motor_voltage)


@pytest.mark.parametrize("name", NAMES)
def test_every_parameter_moves_an_output(name: str) -> None:
    """A parameter that does nothing is an error (it would be fitted to noise)."""
    effect = load_effect(name)
    strong = {
        p.name: p.typical if p.typical != p.vanishing else 0.5 * (p.typical + p.upper)
        for p in effect.parameters
    }
    base = runs(Model.load().with_effect(effect.entry(strong)))
    for p in effect.parameters:
        value = p.vanishing if p.vanishing is not None else min(p.upper, 1.7 * strong[p.name] or p.upper)
        moved = runs(Model.load().with_effect(effect.entry({**strong, p.name: value})))
        change = max(np.abs(a.raw - b.raw).max() for a, b in zip(base, moved, strict=True))
        assert change > 1e-6, f"{name}.{p.name} moves nothing"


@pytest.mark.parametrize("name", NAMES)
def test_declaration_is_complete(name: str) -> None:
    effect = load_effect(name)
    assert effect.title and effect.looks_like and effect.told_by
    assert "Equation:" in (effect.__doc__ or "") and "Limits:" in (effect.__doc__ or "")
    assert all(p.unit and p.description for p in effect.parameters)


def test_equations_by_hand() -> None:
    """Values worked out from the equations of the docstrings, not taken from a run."""
    assert evaluate(load_effect("viscous_friction"), {"coefficient": 2e-3}, {})[DAMPING] == 2e-3
    assert evaluate(load_effect("wire_slack"), {"slack": 0.7}, {})[SLACK] == 0.7
    stribeck = {"stiction": 0.02, "velocity": 2.0}
    assert evaluate(load_effect("stribeck_friction"), stribeck, {V: 2.0})[FRICTION] == pytest.approx(
        0.02 / math.e
    )
    rising = {"level": 0.02, "velocity": 0.1}
    assert [
        evaluate(load_effect("velocity_strengthening"), rising, {V: v})[FRICTION] for v in (0.0, 0.1, 2.0)
    ] == pytest.approx([-0.02, -0.02 / math.e, 0.0])
    guided = evaluate(load_effect("load_dependent_friction"), {"coefficient": 0.1}, {LOAD: 0.3})
    assert guided[FRICTION] == pytest.approx(0.03) and guided[LOAD_FRICTION] == 0.0
    guided = evaluate(
        load_effect("load_dependent_friction"), {"coefficient": 0.1, "share": 0.75}, {LOAD: 0.3}
    )
    assert guided[[FRICTION, LOAD_FRICTION]] == pytest.approx([0.0075, 0.0225])
    ripple = {"sine": 0.01, "cosine": 0.02, "period": 3.0}
    along = [evaluate(load_effect("cogging"), ripple, {Q: 3.0 * k / 8})[TORQUE] for k in range(8)]
    assert along[0] == pytest.approx(0.02) and along[2] == pytest.approx(0.01)
    assert sum(along) == pytest.approx(0.0, abs=1e-12)
    wave = ripple | {"second_sine": 0.2, "second_cosine": -0.1, "third_sine": 0.15, "third_cosine": 0.05}
    for q in (0.0, 0.4, 1.1, 2.6):
        x = 2.0 * math.pi * q / 3.0 + math.atan2(0.02, 0.01)
        of_first = math.sin(x) + 0.2 * math.sin(2.0 * x) - 0.1 * math.cos(2.0 * x)
        of_first += 0.15 * math.sin(3.0 * x) + 0.05 * math.cos(3.0 * x)
        there = evaluate(load_effect("cogging"), wave, {Q: q})[TORQUE]
        assert there == pytest.approx(math.hypot(0.01, 0.02) * of_first)
    glove = evaluate(load_effect("glove_stiffness"), {"stiffness": 1e-3, "hardening": 1e-6}, {QL: 10.0})
    assert glove.sum() == pytest.approx(-(1e-3 * 10 + 1e-6 * 1000))
    states = np.zeros(1)
    for _ in range(200_000):
        evaluate(
            load_effect("winding_heating"),
            {"thermal_resistance": 10.0, "time_constant": 5.0},
            {CURRENT: 1.0, RESISTANCE: 1.5, DT: 1e-3},
            states,
        )
    # T = Rth R i2 / (1 - alpha Rth R i2): the resistance grows with the temperature
    assert states[0] == pytest.approx(15.0 / (1 - 0.0039 * 15.0), rel=1e-3)


@pytest.mark.parametrize(
    ("at", "speed", "current", "taken"),
    [
        (0.0, 1.0, 1.0, True),  # in the gap
        (0.06, 1.0, -1.0, False),  # pushes the upper flank
        (0.06, 0.0, 1.0, False),  # rests there, and will push it
        (0.06, 0.0, -1.0, True),  # rests there, and will leave it
        (0.05, -1.0, 1.0, True),
        (-0.06, -1.0, 1.0, False),
        (-0.06, 0.0, 1.0, True),
    ],
)
def test_the_motor_feels_friction_beyond_a_gap_only_at_the_flank_that_it_pushes(
    at: float, speed: float, current: float, taken: bool
) -> None:
    gap = {"width": 0.1, "beyond": 0.012}
    there = evaluate(load_effect("gear_backlash"), gap, {Q: at, V: speed, CURRENT: current}, np.zeros(1))
    assert there[FRICTION] == (-0.012 if taken else 0.0)
    assert there[SENSE_POSITION] == pytest.approx(-at if abs(at) < 0.05 else -math.copysign(0.05, at))


def test_what_is_usual_is_said_of_shapes_only() -> None:
    usual = {"unit": "1", "lower": -1.0, "upper": 1.0, "typical": 0.0}
    assert EffectParameter("form", **usual, sd=0.2).sd == 0.2
    for wrong in ({"sd": -0.1}, {"sd": 0.2, "vanishing": 0.0}):
        with pytest.raises(HannesError, match="'form': sd"):
            EffectParameter("form", **usual, **wrong)


def test_own_effect_from_a_file(tmp_path: Path, nominal: list[Rollout]) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "from hannes_sim.effect import Effect, EffectParameter\n"
        "from hannes_sim.ports import TORQUE, QL\n\n\n"
        "class Spring(Effect):\n"
        "    name = 'my_spring'\n"
        "    parameters = (EffectParameter('k', 'N.m/rad', 0.0, 0.1, 1e-3, 0.0, 'rate'),)\n\n"
        "    @staticmethod\n"
        "    def contribute(x, p, s, y):\n"
        "        y[TORQUE] -= p[0] * x[QL]\n"
    )
    source = f"{file}:Spring"
    effect = load_effect(source)
    model = Model.load().with_effect(effect.entry({"k": 2e-3}, source=source))
    path = model.save(tmp_path / "model.yaml")
    assert Model.load(path).sha256 == model.sha256
    changed = runs(Model.load(path))
    assert np.abs(changed[0].encoder_position - nominal[0].encoder_position).max() > 0.05


STATES = """
from hannes_sim.effect import Effect, EffectParameter
class A(Effect):
    name = "a"
    parameters = (EffectParameter("k", "1", 0.0, 1.0, 0.5, 0.0),)
    states = {}
    def contribute(x, p, s, y):
        pass
"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("class A:\n    pass\n", "not a subclass"),
        ("import nothing_like_this\nclass A: pass\n", "cannot be imported"),
        ("from hannes_sim.effect import Effect\nclass A(Effect):\n    name='a'\n", "declares no parameters"),
        (STATES.format(-3), "`states` is -3"),
        (STATES.format(1.5), "`states` is 1.5"),
    ],
)
def test_broken_effect_files_give_one_clear_error(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / f"broken_{abs(hash(text))}.py"
    file.write_text(text)
    with pytest.raises(HannesError, match=message):
        load_effect(f"{file}:A")


def test_uncompilable_effect_names_itself() -> None:
    class Bad(Effect):
        name = "bad_effect"
        parameters = (EffectParameter("k", "1", 0.0, 1.0, 0.5, 0.0, ""),)

        @staticmethod
        def contribute(x, p, s, y):  # type: ignore[no-untyped-def]
            y["word"] = str(x)

    from hannes_sim.effect import compile_effect

    with pytest.raises(HannesError, match="bad_effect"):
        compile_effect(Bad)


def test_unknown_effect_and_parameter_list_the_valid_ones() -> None:
    with pytest.raises(HannesError, match="wire_slack"):
        load_effect("wire_slak")
    with pytest.raises(HannesError, match="slack"):
        load_effect("wire_slack").entry({"slak": 1.0})
    with pytest.raises(HannesError, match="outside"):
        load_effect("wire_slack").entry({"slack": -1.0})


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("grasp", ["soft", "rigid"])
def test_no_strength_within_the_bounds_upsets_the_integration(name: str, grasp: str) -> None:
    """Also far above the typical strength, where a search looks too, half the step gives nearly the same current."""
    kind = load_effect(name)
    reference = half_sine(period=1.2)[:1200]
    for factor, part in ((1.0, 0.0), (16.0, 0.5), (1e9, 1.0)):
        values = {
            p.name: part
            if p.part
            else float(np.clip(p.typical * (factor if p.vanishing is not None else 1.0), p.lower, p.upper))
            for p in kind.parameters
        }
        model = Model.load("nominal").with_effect(kind.entry(values))
        fine, coarse = (
            rollout(make_plant(model, OBJECTS[grasp], dt=dt), DoublePID.of_model(model.parameters), reference)
            for dt in (0.125e-3, 0.25e-3)
        )
        apart = np.sqrt(np.mean((fine.motor_current - coarse.motor_current) ** 2))
        assert apart < 0.02, (factor, apart)


@pytest.mark.parametrize(
    ("effect", "drop", "add", "said"),
    [
        (
            "load_dependent_friction",
            "coefficient",
            "coeficient",
            "has no parameter coeficient and needs a value of c",
        ),
        ("stribeck_friction", "velocity", "", "needs a value of velocity"),
        ("cogging", "sine", "", "needs a value of sine"),
    ],
)
def test_an_effect_of_a_model_needs_its_own_parameters(effect: str, drop: str, add: str, said: str) -> None:
    """A misspelt one would act with its typical value, and nobody would know."""
    whole = load_effect(effect).entry()
    parameters = {n: p for n, p in whole.parameters.items() if n != drop}
    if add:
        parameters[add] = whole.parameters[drop]
    model = Model.load().with_effect(replace(whole, parameters=parameters))
    with pytest.raises(HannesError, match=said):
        make_plant(model)


def test_a_refinement_of_an_effect_may_be_left_out_of_a_model() -> None:
    whole = load_effect("cogging").entry()
    plain = {n: p for n, p in whole.parameters.items() if "_" not in n}
    assert len(plain) == 3 and effect_of(replace(whole, parameters=plain)) is load_effect("cogging")


def test_an_effect_of_another_package_that_is_none_is_left_out_with_one_line(tmp_path: Path) -> None:
    """Every command reads the catalogue: one broken package would end them all."""
    info = tmp_path / "plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plugin\nVersion: 1.0\n")
    points = {
        "torn": "plugin_torn:Torn",
        "number": "plugin_parts:NUMBER",
        "odd": "plugin_parts:Odd",
        "twin": "plugin_parts:Twin",
        "good": "plugin_parts:Good",
    }
    lines = [f"{name} = {value}" for name, value in points.items()]
    (info / "entry_points.txt").write_text("\n".join(["[hannes.effects]", *lines]))
    (tmp_path / "plugin_torn.py").write_text("import no_such_module\n")
    (tmp_path / "plugin_parts.py").write_text(
        "from hannes_sim.effects.cogging import Cogging\n"
        "NUMBER = 3\n"
        "class Odd(Cogging):\n    name, parameters = 'odd', (3,)\n"
        "class Twin(Cogging):\n    pass\n"
        "class Good(Cogging):\n    name, title = 'good', 'good cogging'\n"
    )
    told = subprocess.run(
        [sys.executable, "-m", "hannes_bringup.cli", "model", "effects", "--json"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    whole, said = json.loads(told.stdout)["effects"], told.stderr.splitlines()
    names = {effect["name"] for effect in whole}
    assert {"cogging", "good"} <= names and "odd" not in names
    assert len(said) == 4 and all(line.startswith("warning: effect '") for line in said), told.stderr
    assert (
        "warning: effect 'torn' of plugin (plugin_torn:Torn) cannot be imported: ModuleNotFoundError: No module named "
        "'no_such_module'; it is left out" in said
    )
    assert any(
        "(plugin_parts:NUMBER) is not a subclass of hannes_sim.effect.Effect;" in line for line in said
    )
    assert any("an effect named 'cogging' exists already;" in line for line in said)
