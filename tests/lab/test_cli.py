"""The lab's commands as a user types them: output, files, JSON, exit codes."""

import json
import math
import os
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from hannes_description.model import EffectEntry, Model
from hannes_lab import cli
from hannes_lab.cli_files import check_writable
from hannes_lab.cli_show import _show_conditions, relative_error
from hannes_lab.compare import MetricRow
from hannes_lab.diagnosis import Diagnosis, Fall
from hannes_lab.hide import make_set, visibility
from hannes_lab.wording import condition_apart, failure_notes
from hannes_sim.effect import load_effect, strength_of
from lab.foreign_bags import hannes, hannes_in_one_line, signals_of_set, write_bag, write_set


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small set with a stiff glove; the truth lies beside, not inside."""
    from hannes_lab.hide import make_set, write_set
    from hannes_sim.effect import strength_of

    folder = tmp_path_factory.mktemp("set")
    recordings, truth = make_set(Model.load(), [strength_of("glove_stiffness", 1.0)], seed=301, closures=6)
    write_set(recordings, truth, folder / "bags", folder / "truth.yaml")
    return folder / "bags"


def test_compare(bags: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    code, out, _ = hannes("compare", str(bags), capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and "fails" in out and "times the repeatability" in out and "Nothing is fitted: " in out
    assert "Relative error: (measured - model) / measured." in out
    code, out, _ = hannes("compare", str(bags), "--json", capsys=capsys, monkeypatch=monkeypatch)
    content = json.loads(out)
    assert code == 0 and content["overall"] > 2.0 and content["metrics"] and content["cells"]


def test_trials(bags: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """What is read, before anything is simulated."""
    code, out, _ = hannes("trials", str(bags), "--json", capsys=capsys, monkeypatch=monkeypatch)
    slow = next(t for t in json.loads(out)["trials"] if t["name"] == "slow")
    assert code == 0 and [(c["name"], c["closures"]) for c in slow["conditions"]] == [("slow", 6)]
    signals = {s["name"]: s for s in slow["signals"]}
    assert signals["reference"]["unit"] == "rad" and signals["reference"]["rate"] == pytest.approx(1000.0)
    assert signals["motor_current"]["rate"] == pytest.approx(30.0, rel=0.02)
    assert signals["encoder_position"]["highest"] == pytest.approx(12.0, abs=1.5)
    code, out, _ = hannes("trials", str(bags), capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and "motor_current" in out and "control period" in out and "e-1" not in out
    code, out, err = hannes("trials", "nowhere", capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and "No bag 'nowhere'" in err


def test_named_closures_are_left_out(
    bags: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def starts(*options: str) -> list[float]:
        code, out, _ = hannes("trials", str(bags), "--json", *options, capsys=capsys, monkeypatch=monkeypatch)
        assert code == 0
        slow = next(t for t in json.loads(out)["trials"] if t["name"] == "slow")
        return slow["conditions"][0]["starts"]

    whole = starts()
    assert starts("--leave-out", "slow=1", "--leave-out", "slow=4,2") == [whole[2], *whole[4:]]
    _, out, _ = hannes("compare", str(bags), "--leave-out", "slow=1", capsys=capsys, monkeypatch=monkeypatch)
    assert "left out, as asked for: closure 1 of 'slow', at 0.5 s" in " ".join(out.split())


@pytest.mark.parametrize(
    ("given", "said"),
    (
        ("slow", "give CONDITION=NUMBER"),
        ("slow=0", "the first closure is 1"),
        ("slow=one", "give CONDITION=NUMBER"),
        ("slwo=1", "unknown condition 'slwo'; these recordings have fast, grasp, slow"),
        ("slow=7", "'slow' has 6 closures only"),
        ("slow=1,2,3,4,5,6", "leaves no closure of 'slow'"),
    ),
)
def test_closures_that_are_not_there_cannot_be_left_out(
    bags: Path, given: str, said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out, err = hannes(
        "compare", str(bags), "--leave-out", given, capsys=capsys, monkeypatch=monkeypatch
    )
    assert code == 2 and not out and said in " ".join(err.split())


@pytest.mark.parametrize("count", [1, 3, 9])
def test_the_error_of_each_condition_is_a_table_of_its_own(
    count: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Names and numbers stand apart, however many conditions there are."""
    names = [f"a_condition_with_a_long_name_{k}" for k in range(count)]
    falls = [
        Fall(
            added, 2.0 * ratio, 2.1 * ratio, {c: ratio * (k + 1.5) for k, c in enumerate(names)}, (), {}, 3.3
        )
        for added, ratio in (("nominal, as given", 5.0), ("nominal, fitted", 4.0), ("glove_stiffness", 1.0))
    ]
    _show_conditions(falls)
    rows = [line.split("│")[1:-1] for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    cells = [[cell.strip() for cell in row] for row in rows if "glove" in row[0]]
    last = [f"{k + 1.5:.3g}" for k in range(count)]
    shown = {1: [], 3: [["+ glove_stiffness", *last]], 9: [["+ glove_stiffness", "9.5", names[-1]]]}
    assert cells == shown[count]


def test_brackets_in_the_name_of_a_condition_are_brackets(capsys: pytest.CaptureFixture[str]) -> None:
    falls = [Fall("nominal, as given", 1.0, 1.0, {"0 to 5 [mm]": 1.0, "a[/b]": 2.0}, (), {}, 1.6)]
    _show_conditions(falls)
    said = capsys.readouterr().out
    assert "0 to 5 [mm]" in said and "a[/b]" in said


@pytest.mark.parametrize(
    ("errors", "said"),
    [
        ({"slow": 1.0, "fast": 1.2, "grasp": 5.0}, "'grasp' is foretold much worse (5.0 times"),
        ({"slow": 1.0, "fast": 50.0}, "the other conditions (at most 1.0)"),
        ({"slow": 1.0, "fast": 2.4}, ""),
        ({"slow": 3.0, "fast": 5.0, "grasp": 4.0}, ""),
        ({"slow": 4.0}, ""),
        ({"slow": math.nan, "fast": math.nan}, ""),
    ],
)
def test_a_condition_that_is_foretold_much_worse_than_the_others_is_pointed_at(
    errors: dict[str, float], said: str
) -> None:
    notes = condition_apart([Fall("nominal, fitted", 1.0, 1.0, errors, (), {}, math.nan)])
    assert len(notes) == bool(said) and all(said in note for note in notes)


@pytest.mark.slow
def test_diagnose_add_and_report(
    bags: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, page = tmp_path / "my_hand.yaml", tmp_path / "report.html"
    only = [
        word for name in ("glove_stiffness", "wire_slack", "gearbox_inertia") for word in ("--only", name)
    ]
    words = (
        "diagnose",
        str(bags),
        *only,
        "--add",
        "--out",
        str(model),
        "--report",
        str(page),
        "--json",
        "--jobs",
        "1",
    )
    code, out, _ = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    content = json.loads(out)
    assert code == 0 and content["verdict"] == "effects"
    assert [e["name"] for e in content["effects"]] == ["glove_stiffness"]
    assert [e.name for e in Model.load(model).effects] == ["glove_stiffness"]
    assert content["model"] == {"name": "nominal", "sha256": Model.load().sha256}
    assert content["fitted_model"]["sha256"] == Model.load(model).sha256
    assert "glove" in page.read_text(encoding="utf-8") and content["model_file"] == str(model)
    # all is in the store now; the verdict is seen though its report fails
    words = ("diagnose", str(bags), *only, "--jobs", "1", "--report", "/dev/full")
    code, out, err = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and out.startswith("EFFECTS") and "No space left" in err
    words = ("add", str(bags), "--effect", "glove_stiffness", "--out", str(tmp_path / "added.yaml"))
    code, _, _ = hannes(*words, "--jobs", "1", "--report", str(page), capsys=capsys, monkeypatch=monkeypatch)
    text = page.read_text(encoding="utf-8")
    assert code == 0 and "The model has glove stiffness now." in text and "How the error falls" in text
    # with the effect in the model, nothing is missing any more
    code, out, _ = hannes(
        "compare",
        str(bags),
        "--model",
        str(model),
        "--fitted",
        "--json",
        capsys=capsys,
        monkeypatch=monkeypatch,
    )
    compared = json.loads(out)
    assert code == 0 and compared["overall"] < 1.3
    assert compared["values"]["hand.stiffness"] > 0.0
    row = compared["nuisances"]["hand.stiffness"]
    assert row["value"] == compared["values"]["hand.stiffness"] and row["unit"] == "N.m/rad"
    assert abs(row["prior_sds"]) < 3.0 and row["nominal"] > 0.0
    # the diagnosis again, from what it kept: the parameters of the hand itself stand in its text too
    code, out, _ = hannes("diagnose", str(bags), *only, "--jobs", "1", capsys=capsys, monkeypatch=monkeypatch)
    table = out.partition("The model's own parameters, as fitted")[2].partition("others moved less")[0]
    rows = [line.split("│") for line in table.splitlines() if line.startswith("│")]
    assert code == 0 and len(rows) == 10
    farthest = [abs(float(row[5])) for row in rows]
    assert farthest == sorted(farthest, reverse=True) and all(".." in row[3] for row in rows)


def test_hide_keeps_the_truth_away_from_the_bags(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (
        "hide",
        str(tmp_path / "set"),
        "--truth",
        str(tmp_path / "truth.yaml"),
        "--effect",
        "wire_slack=2",
        "--closures",
        "2",
        "--condition",
        "fast",
    )
    code, _, _ = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0
    assert "wire_slack" in (tmp_path / "truth.yaml").read_text()
    for file in (tmp_path / "set").rglob("*"):
        if file.is_file():
            assert b"slack" not in file.read_bytes()
    code, _, err = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and "exists already" in err


def test_how_much_an_effect_changes_is_counted_in_the_closures_scatter() -> None:
    model, how = Model.load(), {"seed": 4, "closures": 4, "conditions": ("fast",)}

    def seen(*effects: EffectEntry, closures: int = 4) -> dict[str, dict[str, float]]:
        asked = {**how, "closures": closures}
        return visibility(make_set(model, effects, **asked)[0], make_set(model, [], **asked)[0])

    assert seen() == {"fast": {"encoder_position": 0.0, "motor_current": 0.0}}
    once, twice = (seen(strength_of("viscous_friction", factor))["fast"] for factor in (1.0, 2.0))
    assert (
        all(1.5 * once[name] < twice[name] < 2.5 * once[name] for name in once) and min(once.values()) > 0.5
    )
    assert seen(strength_of("viscous_friction", 1.0), closures=1) == {}, "one closure has no scatter"


def test_values_of_a_hidden_effect_may_be_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A strength and a shape; what is not given is as the factor makes it."""
    truth = tmp_path / "truth.yaml"
    words = ("hide", str(tmp_path / "set"), "--truth", str(truth), "--closures", "3", "--condition", "fast")
    own = ("--effect", "cogging=2", "--value", "cogging.period=2.9", "--value", "cogging.cosine=-0.004")
    code, _, err = hannes(
        *words, *own, "--effect", "viscous_friction", capsys=capsys, monkeypatch=monkeypatch
    )
    assert code == 0, err
    cogging, viscous = yaml.safe_load(truth.read_text())["effects"]
    values = {name: p["value"] for name, p in cogging["parameters"].items()}
    assert (values["period"], values["cosine"]) == (2.9, -0.004)
    twice = strength_of("cogging", 2.0).values
    assert {n: v for n, v in values.items() if n not in ("period", "cosine")} == pytest.approx(
        {n: v for n, v in twice.items() if n not in ("period", "cosine")}
    )
    assert cogging["parameters"]["period"]["source"] == "given to hannes hide"
    assert (
        viscous["parameters"]["coefficient"]["value"]
        == strength_of("viscous_friction", 1.0).values["coefficient"]
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("compare", "no/such/bag"), "does not exist"),
        (("diagnose", "BAGS", "--effect", "wire_slak"), "Unknown effect"),
        (("diagnose", "BAGS", "--effect", "cogging:period"), "is given by its name alone, cogging"),
        (("diagnose", "BAGS", "--only", "glove_stifness"), "did you mean glove_stiffness?"),
        (("compare", "EMPTY", "--rig", "EMPS"), "A folder: '"),
        (("compare", "BROKEN"), "while parsing a flow sequence in"),
        (
            ("compare", "SILENT"),
            "no topics but those that were read: /hannes/motor/state as encoder_position",
        ),
        (("diagnose", "BAGS", "--effect", "bad.py:Good"), "(line 3, in Bad)"),
        (("diagnose", "BAGS", "--effect", "nameless.py:Nameless"), "nameless.py, class Nameless: the effect"),
        (("diagnose", "BAGS", "--model", "nothing"), "No model"),
        (("diagnose", "BAGS", "--dask", "foo"), "tcp://HOST:8786"),
        (("add", "BAGS", "--effect", "mine.py:Mine"), "No file"),
        (("compare", "BAGS", "--object", "slow"), "CONDITION="),
        (("compare", "BAGS", "--object", "quick=soft"), "unknown conditions"),
        (("compare", "EMPTY"), "holds no bag"),
        (("validate", "--row", "R01", "--model-out", "x.yaml"), "only --calibrate writes a model file"),
        (("validate", "--calibrate", "--motor", "none"), "--motor none: valid are"),
        (("hide", "OUT", "--truth", "T", "--effect", "wire_slack=much"), "wire_slack=much"),
        (("hide", "OUT", "--truth", "T", "--condition", "quick"), "slow"),
        # files that cannot be written are named before anything is read
        (("compare", "no/such/bag", "--report", "NOWHERE"), "The report cannot be written to"),
        (("diagnose", "no/such/bag", "--report", "NOWHERE"), "Not a directory"),
        (("diagnose", "no/such/bag", "--report", "EMPTY"), "it is a folder; name a file"),
        (("diagnose", "no/such/bag", "--add", "--out", "NOWHERE.yaml"), "The model file cannot be written"),
        (("add", "no/such/bag", "--effect", "cogging", "--out", "NOWHERE.yaml"), "The model file cannot"),
        (("add", "no/such/bag", "--effect", "cogging", "--out", "mine.txt"), "a model file ends in .yaml"),
        (("report", "no/such/bag", "--out", "NOWHERE"), "The report cannot be written to"),
        (
            ("calibrate", "no/such/bag", "--free", "motor.kt", "--out", "NOWHERE.yaml"),
            "The model file cannot",
        ),
        (("hide", "OUT", "--truth", "NOWHERE"), "The truth cannot be written to"),
    ],
)
def test_a_mistake_gives_one_line_and_exit_code_2(
    words: tuple[str, ...],
    message: str,
    bags: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    (tmp_path / "file").touch()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "metadata.yaml").write_text("a: [1, 2\n   b: }", encoding="utf-8")
    signals = {"encoder_position": (np.arange(9.0), np.arange(9.0))}
    write_bag(tmp_path / "silent", signals)
    imported = "from hannes_sim.effect import Effect, EffectParameter\n"
    bad = "class Bad(Effect):\n    parameters = (EffectParameter('a', 'N', 2.0, 1.0, 3.0),)\n"
    (tmp_path / "bad.py").write_text(imported + bad, encoding="utf-8")
    (tmp_path / "nameless.py").write_text(imported + "class Nameless(Effect):\n    pass\n", encoding="utf-8")
    places = {
        "BAGS": str(bags),
        "BROKEN": str(tmp_path / "broken"),
        "SILENT": str(tmp_path / "silent"),
        "EMPS": f"{Path(__file__).parents[2] / 'examples' / 'emps' / 'emps.py'}:Emps",
        "bad.py:Good": f"{tmp_path / 'bad.py'}:Good",
        "nameless.py:Nameless": f"{tmp_path / 'nameless.py'}:Nameless",
        "NOWHERE": str(tmp_path / "file" / "x"),
        "NOWHERE.yaml": str(tmp_path / "file" / "x.yaml"),
        "EMPTY": str(empty),
        "OUT": str(tmp_path / "out"),
        "T": str(tmp_path / "t.yaml"),
    }
    code, _, err = hannes(*(places.get(word, word) for word in words), capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2
    assert message in err and "Traceback" not in err
    assert len(err.strip().splitlines()) == 1 and "  " not in err


def test_to_ask_whether_a_file_can_be_written_changes_nothing(tmp_path: Path) -> None:
    there = tmp_path / "there.html"
    there.write_text("mine", encoding="utf-8")
    for path in (there, tmp_path / "new.html", tmp_path / "a" / "b" / "new.html", Path("/dev/stdout")):
        check_writable(path, "The report")
    assert [p.name for p in tmp_path.iterdir()] == ["there.html"] and there.read_text() == "mine"


def test_the_answer_is_printed_though_the_report_cannot_be_written(
    bags: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("compare", str(bags), "--report", "/dev/full")
    code, out, err = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and "times the repeatability" in out and "Report:" not in out
    assert err == "hannes: The report cannot be written to '/dev/full': No space left on device.\n"


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One closure of each of two conditions."""
    folder = tmp_path_factory.mktemp("single")
    return write_set(folder / "bags", signals_of_set(closures=1))


def test_one_closure_of_each_condition_is_compared_in_the_signals_units(
    single: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out, _ = hannes_in_one_line("compare", str(single), capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and re.search(r"Overall error: [\d.]+ rad \(encoder_position\), [\d.]+ A", out)
    assert "No condition was repeated: there is no repeatability to hold the error against." in out
    assert "one closure of fast, slow: how well it repeats is not known" in out
    assert "the repeatability is a guess" not in out


def test_effects_are_added_to_one_closure_of_each_condition_in_the_signals_units(
    single: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("add", str(single), "--effect", "load_dependent_friction", "--jobs", "1", "--no-cache")
    out_file = ("--out", str(tmp_path / "mine.yaml"), "--report", str(tmp_path / "mine.html"))
    code, out, _ = hannes_in_one_line(*words, *out_file, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and "Error on conditions that were left out of the fit" in out
    assert "Error of the fit" in out, "an effect that helps each condition alone is seen in it"
    assert "repeatability" not in out and " - " not in out
    assert re.search(r"coefficient = [\d.e-]+ \(", out), "a number without a dimension has no unit"
    page = (tmp_path / "mine.html").read_text(encoding="utf-8")
    assert "No condition was repeated" in page and "nothing could be held out" not in page


def test_a_note_on_no_condition_has_no_name_of_one(
    bags: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("compare", str(bags), str(bags / "slow"), "--json")
    code, out, _ = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    said = f"left out: '{bags / 'slow'}' is the same recording as '{bags / 'slow'}'"
    assert code == 0 and said in json.loads(out)["notes"]


@pytest.mark.parametrize("words", [(), ("--json",)], ids=["text", "json"])
def test_a_full_output_is_one_line_and_a_reader_that_has_gone_none(
    words: tuple[str, ...], bags: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout", os.fdopen(os.open("/dev/full", os.O_WRONLY), "w"))
    code, _, err = hannes("compare", str(bags), *words, capsys=capsys, monkeypatch=monkeypatch)
    assert (code, err) == (1, "hannes: the output cannot be written: No space left on device.\n")
    reader, writer = os.pipe()
    os.close(reader)
    monkeypatch.setattr("sys.stdout", os.fdopen(writer, "w"))
    code, _, err = hannes("compare", str(bags), *words, capsys=capsys, monkeypatch=monkeypatch)
    assert (code, err) == (141, "")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--effect", "load_dependent_friction=-1"), "coefficient would be -0.1"),
        (("--effect", "cogging=0"), "but not 0"),
        (("--effect", "cogging=inf"), "but not 0"),
        (("--effect", "cogging", "--effect", "cogging=3"), "cogging is given more than once"),
        (("--condition", "fast", "--condition", "fast"), "fast is asked for more than once"),
        (("--effect", "cogging", "--value", "cogging.period"), "give EFFECT.PARAMETER=NUMBER"),
        (("--effect", "cogging", "--value", "cogging.period=long"), "give EFFECT.PARAMETER=NUMBER"),
        (("--effect", "cogging", "--value", "cogging.period=nan"), "give EFFECT.PARAMETER=NUMBER"),
        (
            ("--effect", "cogging", "--value", "gravity.sine=0.1"),
            "'gravity' is not hidden (--effect); hidden are: cogging",
        ),
        (("--value", "gravity.sine=0.1"), "hidden are: none"),
        (("--effect", "cogging", "--value", "cogging.wave=1"), "has no parameter wave; valid are sine"),
        (("--effect", "cogging", "--value", "cogging.period=99999"), "period = 99999.0 rad is outside"),
        (("--effect", "wire_slack", "--value", "wire_slack.slack=0"), "'wire_slack' hides nothing"),
        (
            ("--effect", "cogging", *("--value", "cogging.period=2", "--value", "cogging.period=3")),
            "cogging.period is given more than once",
        ),
        (("--seed", "-3"), "greater than or equal to 0"),
    ],
)
def test_hide_refuses_what_would_hide_something_else(
    words: tuple[str, ...],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    where = (str(tmp_path / "set"), "--truth", str(tmp_path / "truth.yaml"), "--closures", "1")
    code, _, err = hannes("hide", *where, *words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and said in " ".join(err.split())
    assert not (tmp_path / "truth.yaml").exists()


@pytest.mark.parametrize(
    ("measured", "sd", "model", "said"),
    [
        (2.0, 0.1, 1.5, "25 %"),
        (2.0, 0.1, 5.0, "-150 %"),
        (0.02, 0.001, 1.18, "59 x too large"),
        (-0.02, math.nan, 0.2, "10 x too large, other sign"),
        (0.02, 0.03, 1.18, "-"),
        (0.0, math.nan, 1.0, "-"),
    ],
)
def test_a_relative_error_can_be_read(measured: float, sd: float, model: float, said: str) -> None:
    percent = (measured - model) / measured * 100.0 if measured else math.nan
    assert relative_error(MetricRow("slow", "closure_time", "s", measured, sd, model, percent)) == said


def test_simulations_that_failed_are_harmless_where_they_are_few() -> None:
    counts = SimpleNamespace(failures=3, simulations=1000)
    assert "3 of 1000 simulations" in failure_notes(counts)[0] and "harmless" in failure_notes(counts)[0]
    counts.failures = 60
    assert "harmless" not in failure_notes(counts)[0] and "above 5 %" in failure_notes(counts)[0]
    counts.failures = 0
    assert not failure_notes(counts)


def test_effects_that_the_model_has_are_not_looked_for_in_silence(
    bags: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = Model.load().with_effect(load_effect("cogging").entry()).save(tmp_path / "has.yaml")
    for command, word in (("diagnose", "--only"), ("add", "--effect")):
        code, _, err = hannes(
            command, str(bags), word, "cogging", "--model", str(model), capsys=capsys, monkeypatch=monkeypatch
        )
        assert code == 2 and "in the model already" in " ".join(err.split())


def test_a_signal_that_nobody_recorded_is_named_with_those_that_are_there(
    bags: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("compare", str(bags), "--signal", "encoder_position", "--signal", "foo")
    code, _, err = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and "No recording has the signal foo; they have" in " ".join(err.split())


def test_greedy_needs_two_conditions(
    bags: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("diagnose", str(bags / "fast"), "--greedy", "--only", "cogging", "--jobs", "1")
    code, _, err = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and "there is one condition only" in " ".join(err.split())


def test_another_object_than_the_recording_says_is_taken_and_said(
    bags: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("compare", str(bags), "--object", "grasp=none")
    code, out, _ = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and "object is none, but the recording itself says rigid" in " ".join(out.split())
    words = ("compare", str(bags), "--object", "grasp=rigid")
    code, out, _ = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and "the recording itself says" not in " ".join(out.split())


def test_what_was_not_looked_for_may_be_in_the_catalogue(
    bags: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("diagnose", str(bags), "--only", "supply_sag", "--jobs", "1")
    code, out, _ = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    said = " ".join(out.split())
    assert code == 0 and said.startswith("UNKNOWN")
    assert (
        "is not one of those that were looked for (supply_sag)" in said and "not in the catalogue" not in said
    )


@pytest.mark.parametrize(
    ("effects", "said"),
    (
        ((), "the fitted nominal model, which does not explain the recordings"),
        (("an effect",), "of the nearest effects, which are no finding"),
    ),
)
def test_the_model_file_of_an_unknown_says_that_it_is_no_finding(
    effects: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    found = object.__new__(Diagnosis)
    model = replace(Model.load(), provenance={"recordings": {}})
    for name, value in {"verdict": "unknown", "effects": effects, "model": model}.items():
        object.__setattr__(found, name, value)
    assert cli._model_file(found, tmp_path / "mine.yaml").remark == said
