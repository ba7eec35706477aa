"""`hannes describe`: what a bag does not say of itself is said afterwards, and the lab takes it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from lab.foreign_bags import hannes, signals_of_set, write_set


@pytest.fixture
def bags(tmp_path: Path) -> Path:
    """Two bags of a recorder that describes nothing."""
    write_set(tmp_path / "set", signals_of_set(closures=3, conditions=["slow", "fast"]))
    return tmp_path / "set"


def test_what_is_said_is_what_the_lab_takes(
    bags: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(*words: str) -> tuple[int, str, str]:
        return hannes(*words, capsys=capsys, monkeypatch=monkeypatch)

    said = ["--say", "control_period=0.002", "--say", "object=none", "--say", "reference_held=true"]
    code, out, err = run("describe", str(bags), *said)
    assert (code, err) == (0, "")
    assert f"{bags / 'fast'}: control_period 0.002, object none, reference_held true" in out.splitlines()
    code, out, _ = run("trials", str(bags), "--json")
    assert code == 0 and {t["period"] for t in json.loads(out)["trials"]} == {0.002}

    sensors = {"current_rectified": True, "current_window": 0.03}
    code, out, _ = run(
        "describe", str(bags / "slow"), "--say", "object=", "--say", f"sensors={json.dumps(sensors)}",
        "--say", "condition= 7 ", "--json",
    )  # fmt: skip
    content = {"condition": "7", "control_period": 0.002, "reference_held": True, "sensors": sensors}
    assert code == 0 and json.loads(out) == {str(bags / "slow"): content}
    code, out, _ = run("trials", str(bags), "--json")
    assert code == 0 and {t["name"] for t in json.loads(out)["trials"]} == {"7", "fast"}


@pytest.mark.parametrize(
    ("words", "mistake"),
    [
        (["control_period=2"], "its `control_period` is 2; it must be the period"),
        (["control_period=fast"], "its `control_period` is 'fast'"),
        (["objekt=none"], "nothing called 'objekt' in a recording's metadata; valid are condition, object,"),
        (["object=ball"], "Unknown object 'ball'; valid are none, soft, rigid"),
        (['object={"size": "big"}'], "{'size': 'big'} is not understood"),
        (['object={"place": 3}'], "{'place': 3} is not understood"),
        (['object={"size": -1}'], "Object size is -1; it must be a finite number above 0"),
        (['object={"size": 80}'], "Object size is 80; it is in m, and no hand grasps more than 0.5 m: 0.08"),
        (['object={"shape": "cube"}'], "Object shape 'cube' is unknown; valid are"),
        (["plant=Reduced"], "its `plant` is 'Reduced'; did you mean reduced?"),
        (["sensors=thesis"], "they must be a mapping"),
        (['sensors={"current_window": -1}'], "must be finite and at least 0"),
        (["reference_held=yes"], "it must be true"),
        (["object"], "give KEY=VALUE"),
        (["object=none", "object=soft"], "something else is said of 'object' already"),
    ],
)
def test_a_mistake_is_one_line_and_changes_nothing(
    words: list[str],
    mistake: str,
    bags: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = {path: path.read_bytes() for path in bags.rglob("*") if path.is_file()}
    given = [part for word in words for part in ("--say", word)]
    code, out, err = hannes("describe", str(bags), *given, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and out == "" and mistake in err and err.count("\n") == 1
    assert before == {path: path.read_bytes() for path in bags.rglob("*") if path.is_file()}
