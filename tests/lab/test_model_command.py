"""`hannes model change`: a model file with effects and values of one's choice."""

from __future__ import annotations

from pathlib import Path

import pytest
from hannes_description.model import Model
from hannes_sim.effect import strength_of
from lab.foreign_bags import hannes_in_one_line


def changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str
) -> tuple[int, str]:
    out = ("--out", str(tmp_path / "mine.yaml"))
    code, _, err = hannes_in_one_line("model", "change", *words, *out, capsys=capsys, monkeypatch=monkeypatch)
    return code, err


def test_effects_and_values_are_written_and_changed_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = ("nominal", "--effect", "cogging", "--set", "cogging.period=2.1", "--set", "motor.kt=0.0172")
    assert changed(tmp_path, capsys, monkeypatch, *first) == (0, "")
    model = Model.load(tmp_path / "mine.yaml")
    assert model.name == "mine" and model.parameters.value("motor.kt") == 0.0172
    assert model.named("cogging.period").value == 2.1
    typical = strength_of("cogging", 1.0).values["sine"]
    assert model.named("cogging.sine").value == typical > 0.0
    again = (str(tmp_path / "mine.yaml"), "--effect", "glove_stiffness", "--set", "cogging.sine=0.004")
    assert changed(tmp_path, capsys, monkeypatch, *again) == (0, "")
    model = Model.load(tmp_path / "mine.yaml")
    assert [e.name for e in model.effects] == ["cogging", "glove_stiffness"]
    assert (model.named("cogging.sine").value, model.named("cogging.period").value) == (0.004, 2.1)
    assert model.parameters.value("motor.kt") == 0.0172


@pytest.mark.parametrize(
    ("words", "said"),
    (
        (("--set", "motor.kt"), "give NAME=NUMBER"),
        (("--set", "motor.kt=nan"), "give NAME=NUMBER"),
        (("--set", "motor.kt=17.2"), "outside its bounds, 0.01 .. 0.025 N.m/A"),
        (("--set", "motor.torque=1"), "Unknown parameter 'motor.torque'"),
        (("--set", "cogging.sine=0.01"), "the model has no effect 'cogging'; add it by --effect cogging"),
        (("--effect", "cogging", "--set", "cogging.sine=9"), "outside [-0.1, 0.1]"),
        (("--effect", "cogging", "--set", "cogging.amplitude=1"), "has no parameter amplitude"),
        (("--effect", "coging"), "Unknown effect 'coging'"),
        (("--effect", "cogging", "--effect", "cogging"), "the model has 'cogging' already"),
        (("--set", "motor.kt=0.017", "--set", "motor.kt=0.018"), "given more than once"),
    ),
)
def test_what_cannot_be_set_is_one_line(
    words: tuple[str, ...],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    code, err = changed(tmp_path, capsys, monkeypatch, "nominal", *words)
    assert code == 2 and said in err and not (tmp_path / "mine.yaml").exists()
