"""Parameters with provenance, and model files: what is refused, and what comes back unchanged."""

import json
from pathlib import Path

import pytest
from hannes_description.errors import HannesError
from hannes_description.model import EffectEntry, Model
from hannes_description.parameters import Parameter, ParameterSet, load_parameters
from hannes_sim.effect import load_effect
from hannes_sim.factory import make_plant

OTHER_UNIT = "{value: 10, unit: mN.m, lower: 0, upper: 100, status: assumed, source: x}"

OTHER = "overrides: {%s: {value: %s, unit: %s, lower: -1, upper: 1, status: assumed, source: x}}"
KT = "{value: %s, unit: N.m/A, lower: 0, upper: 2, status: assumed, source: x}"


def test_every_shipped_number_has_unit_bounds_status_and_source() -> None:
    parameters = load_parameters("hannes")
    assert len(parameters) > 30
    for name, p in parameters.items():
        assert p.unit and p.source and p.lower <= p.value <= p.upper, name


def test_a_model_file_comes_back_the_same(tmp_path: Path) -> None:
    effect = load_effect("stribeck_friction")
    model = (
        Model.load()
        .with_values({"motor.resistance": 1.0 / 3.0 + 1.2})
        .with_effect(effect.entry({"stiction": 0.1 / 3.0}))
    )
    again = Model.load(model.save(tmp_path / "m.yaml"))
    assert again.sha256 == model.sha256
    assert again.parameters.value("motor.resistance") == 1.0 / 3.0 + 1.2
    assert again.effects[0].values["stiction"] == 0.1 / 3.0


def test_the_hash_tells_simulations_apart_not_names() -> None:
    from dataclasses import replace

    model = Model.load()
    assert replace(model, name="other", provenance={"a": 1}).sha256 == model.sha256
    assert model.with_values({"motor.kt": 0.018}).sha256 != model.sha256
    assert model.with_plant("mujoco").sha256 != model.sha256


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("schema: hannes/model/2\n", "schema"),
        ("schema: hannes/model/1\nspeed: 3\n", r"unknown keys \['speed'\]"),
        ("schema: hannes/model/1\noverrides: {motor.resistence: {value: 1}}\n", r"motor\.resistance"),
        ("schema: hannes/model/1\noverrides: {motor.resistance: {value: 1}}\n", "missing keys"),
        (f"schema: hannes/model/1\noverrides: {{friction.coulomb: {OTHER_UNIT}}}\n", "must be in 'N.m'"),
        (
            f"schema: hannes/model/1\noverrides: {{motor.kt: {KT % 'true'}}}\n",
            "value is True; it must be a number",
        ),
        (
            f"schema: hannes/model/1\noverrides: {{motor.kt: {KT % repr('0.017')}}}\n",
            "value is '0.017'; it must be",
        ),
        (
            "schema: hannes/model/1\nplant: reduced\nplant: mujoco\n",
            "line 3, column 1: the key 'plant' is given",
        ),
        ("schema: hannes/model/1\nparameters: nobody\n", "shipped are"),
        ("schema: hannes/model/1\neffects: [{name: x}]\n", "every effect needs"),
        ("schema: [\n", "not valid YAML"),
        (
            "schema: a\n\tb: c\n",
            r"not valid YAML: line 2, column 1: while scanning .* cannot start any token",
        ),
        ("- 1\n", "must be a mapping"),
        ("schema: !!python/object/apply:os.system [ls]\n", "not valid YAML"),
        ("a: " + "[" * 20000, "not valid YAML"),
    ],
)
def test_a_broken_model_file_gives_one_clear_error(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "broken.yaml"
    file.write_text(text)
    with pytest.raises(HannesError, match=message) as caught:
        Model.load(file)
    assert (
        str(file) in str(caught.value)
        or "shipped" in str(caught.value)
        or "Unknown parameter" in str(caught.value)
    )


@pytest.mark.parametrize(
    ("value", "lower", "upper", "status", "message"),
    [
        (2.0, 0.0, 1.0, "assumed", "outside its bounds"),
        (float("nan"), 0.0, 1.0, "assumed", "finite"),
        (0.5, 0.0, 1.0, "guessed", "datasheet"),
    ],
)
def test_a_wrong_parameter_is_refused(
    value: float, lower: float, upper: float, status: str, message: str
) -> None:
    with pytest.raises(HannesError, match=message):
        Parameter(value, "V", lower, upper, status, "test")


@pytest.mark.parametrize(
    ("value", "fixed", "tolerance", "message"),
    [
        (0.5, False, -0.1, r"tolerance is -0\.1; it must be 0 \(known\) or more, a part of the value"),
        (0.5, False, float("nan"), "tolerance is nan; it must be 0"),
        (0.5, True, 0.1, "it is fixed and has a tolerance"),
        (0.0, False, 0.1, "a part of the value, which is 0 V"),
    ],
)
def test_a_tolerance_that_says_nothing_is_refused(
    value: float, fixed: bool, tolerance: float, message: str
) -> None:
    with pytest.raises(HannesError, match=message):
        Parameter(value, "V", 0.0, 1.0, "measured", "test", fixed, tolerance)


def test_a_tolerance_is_kept_in_the_file(tmp_path: Path) -> None:
    entry = "{value: 0.9, unit: N.m/rad, status: measured, source: bench, tolerance: 0.1}"
    file = tmp_path / "mine.yaml"
    file.write_text(f"schema: hannes/model/1\noverrides: {{wire.stiffness: {entry}}}\n")
    model = Model.load(file)
    assert Model.load(model.save(tmp_path / "again.yaml")).parameters["wire.stiffness"].tolerance == 0.1
    assert model.sha256 == Model.load().with_values({"wire.stiffness": 0.9}).sha256, (
        "simulations are the same"
    )
    assert model.with_values({"wire.stiffness": 0.8}).parameters["wire.stiffness"].tolerance == 0.1
    file.write_text(file.read_text().replace("tolerance: 0.1", "tolerance: 10 %"))
    with pytest.raises(HannesError, match="tolerance is '10 %'; it must be a number"):
        Model.load(file)


def test_unknown_names_list_their_group() -> None:
    with pytest.raises(HannesError, match=r"motor\.resistance, motor\.inductance"):
        load_parameters("hannes")["motor.resistanse"]
    with pytest.raises(HannesError, match="No parameter group"):
        ParameterSet({}, "x").values_of("motor")


def test_an_effect_twice_is_refused() -> None:
    entry = EffectEntry("a", {})
    with pytest.raises(HannesError, match="listed twice"):
        Model("m", "reduced", load_parameters("hannes"), effects=(entry, entry))


def test_a_unit_of_one_needs_no_quotes(tmp_path: Path) -> None:
    """YAML reads `unit: 1` as a number."""
    file = tmp_path / "mine.yaml"
    entry = "{value: 16.0, unit: 1, status: measured, source: x}"
    file.write_text(f"schema: hannes/model/1\noverrides: {{gear.ratio: {entry}}}\n")
    assert Model.load(file).parameters.value("gear.ratio") == 16.0


def test_what_a_model_file_overrides_is_told_by_its_own_name(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    for value in (0, -1e-6):
        entry = f"{{value: {value}, unit: kg.m2, lower: -1, upper: 1, status: assumed, source: x}}"
        file.write_text(f"schema: hannes/model/1\noverrides: {{motor.armature: {entry}}}\n")
        with pytest.raises(HannesError, match=r"armature is .* more than 0") as caught:
            make_plant(Model.load(file))
        assert str(caught.value).startswith(f"{file}: ")


EFFECT = (
    "effects: [{name: %s, parameters: {%s: "
    "{value: 0.1, unit: %s, lower: 0, upper: 1, status: assumed, source: x}}}]"
)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (EFFECT % ("coulomb_friction", "level", "mN.m"), "'coulomb_friction': level is in 'mN.m'; it must be in 'N.m'"),
        (EFFECT % ("coulomb_friction", "level", "N"), "level is in 'N'; it must be in 'N.m'"),
        (EFFECT % ("load_dependent_friction", "coefficient", "N"), "coefficient is in 'N'; it must be in '1'"),
        (EFFECT % ("coulomb_friction", "level", "N.m"), ""),
        (EFFECT % ("coulomb_friction", "level", "kg.m2/s2"), ""),
        (OTHER % ("wire.stiffness", "-0.74", "N.m/rad"), "wire.stiffness is -0.74 N.m/rad; .* needs 0 or more"),
        (OTHER % ("friction.coulomb", "-1e-3", "N.m"), "friction.coulomb is -0.001 N.m; .* needs 0 or more"),
        (OTHER % ("motor.inductance", "1e-4", "H"), ""),
        ("variant: {foo: 1}", "unknown options foo; valid are return_mechanism"),
    ],
)  # fmt: skip
def test_what_a_plant_cannot_mean_is_refused(tmp_path: Path, more: str, message: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(f"schema: hannes/model/1\n{more}\n")
    if not message:
        make_plant(Model.load(file))
        return
    with pytest.raises(HannesError, match=message) as caught:
        make_plant(Model.load(file))
    assert str(caught.value).startswith(f"{file}: ") or "variant" in more


@pytest.mark.parametrize(("name", "unit"), [("motor.armature", "kg"), ("gear.ratio", "rad/m")])
def test_an_effect_on_a_linear_machine_is_in_newtons(tmp_path: Path, name: str, unit: str) -> None:
    """A linear motor, and a rotor on a lead screw."""
    base = tmp_path / "base.yaml"
    shown = {name: p.to_dict() for name, p in load_parameters("hannes").items()}
    shown[name]["unit"] = unit
    base.write_text(json.dumps(shown))
    file = tmp_path / "mine.yaml"
    for unit in ("N", "N.m", "mN"):
        entry = EFFECT % ("coulomb_friction", "level", unit)
        file.write_text(f"schema: hannes/model/1\nparameters: base.yaml\n{entry}\n")
        if unit != "mN":
            make_plant(Model.load(file))
    with pytest.raises(HannesError, match="level is in 'mN'; it must be in 'N'"):
        make_plant(Model.load(file))


def test_unreadable_and_missing_files(tmp_path: Path) -> None:
    with pytest.raises(HannesError, match="Cannot read"):
        Model.load(tmp_path / "none.yaml")
    with pytest.raises(HannesError, match="nominal"):
        Model.load("none")


def test_an_effect_file_that_has_moved_is_told_with_its_model_file(tmp_path: Path) -> None:
    effect = "effects: [{name: mine, source: 'mine.py:Mine', parameters: {}}]\n"
    (tmp_path / "hand.yaml").write_text(f"schema: hannes/model/1\n{effect}")
    (tmp_path / "mine.py").touch()
    assert Model.load(tmp_path / "hand.yaml").effects[0].source == f"{tmp_path / 'mine.py'}:Mine"
    (tmp_path / "mine.py").unlink()
    with pytest.raises(HannesError, match=r"hand\.yaml: effect 'mine' .* 'mine\.py:Mine'.*`source`"):
        Model.load(tmp_path / "hand.yaml")
