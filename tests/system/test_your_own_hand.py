"""docs/your-own-hand.md as its reader has it: the files as pasted, the commands run."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from hannes_description.model import Model
from hannes_lab.hide import make_set
from hannes_sim.measurement import Sensors

PAGE = Path(__file__).resolve().parents[2] / "docs" / "your-own-hand.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page's files, and a log of the device that its model file describes."""
    out = tmp_path_factory.mktemp("hand")
    for name, text in re.findall(
        r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL
    ):
        (out / name).write_text(text, encoding="utf-8")
    logger = Sensors(motor_rate=250.0, reference_rate=250.0)
    model = Model.load(out / "my_device.yaml")
    (made,), _ = make_set(model, [], seed=3, closures=4, conditions=("fast",), sensors=logger)
    time = made["reference_position"].time
    columns = [made[name] for name in ("reference_position", "encoder_position", "motor_current")]
    table = np.column_stack([time, *(np.interp(time, c.time, c.values) for c in columns)])
    np.savetxt(out / "slow.csv", table, delimiter=",", header="time,reference,position,current")
    assert run(out, sys.executable, "write_bag.py").strip() == "my_bags/slow"
    return out


def run(folder: Path, *words: str) -> str:
    told = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=300)
    assert told.returncode == 0, told.stderr
    return told.stdout


def hannes(folder: Path, *words: str) -> str:
    return run(folder, sys.executable, "-m", "hannes_bringup.cli", *words)


def test_the_bag_says_what_the_page_says_that_it_says(folder: Path) -> None:
    information = yaml.safe_load((folder / "my_bags" / "slow" / "metadata.yaml").read_text())
    said = information["rosbag2_bagfile_information"]["custom_data"]
    (shown,) = re.findall(r"```yaml\n(  custom_data:.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    page = yaml.safe_load(shown)["custom_data"]
    assert {name: said[name] for name in ("condition", "object")} == {
        n: page[n] for n in ("condition", "object")
    }
    assert yaml.safe_load(said["sensors"]).keys() == yaml.safe_load(page["sensors"]).keys()
    assert "/hannes/motor/current" in hannes(folder, "info", "my_bags/slow")


def test_the_model_and_its_law_are_those_of_the_log(folder: Path) -> None:
    """Bounds that the file does not give are those of the nominal hand."""
    model = Model.load(folder / "my_device.yaml")
    own, nominal = model.parameters["friction.coulomb"], Model.load().parameters["friction.coulomb"]
    assert (own.lower, own.upper, own.value) == (nominal.lower, nominal.upper, 0.024)
    assert model.parameters["hand.travel"].upper == 20.0
    told = hannes(folder, "compare", "my_bags", "--model", "my_device.yaml", "--fitted", "--json")
    other = hannes(folder, "compare", "my_bags", "--fitted", "--json")
    of_law, of_double_pid = (yaml.safe_load(text)["overall"] for text in (told, other))
    assert of_law < 4.0 and of_double_pid > 4.0 * of_law


def test_an_effect_of_ones_own_strength_is_hidden(folder: Path) -> None:
    assert "2.5" in run(folder, sys.executable, "hide_mine.py")
    assert {path.name for path in (folder / "hidden").iterdir()} == {"fast", "grasp_fast"}
    assert yaml.safe_load((folder / "hidden_truth.yaml").read_text())["effects"][0]["name"] == "supply_sag"
