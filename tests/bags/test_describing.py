"""What a bag says of itself, written afterwards."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from bags.bag_samples import MOTOR, foreign_bag, motor_messages, recording
from hannes_bags.describing import describe, described
from hannes_bags.reading import read_bag
from hannes_bags.recover import recover
from hannes_bags.writing import write_recording
from hannes_description.errors import HannesError
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin

pytestmark = pytest.mark.filterwarnings("ignore::hannes_bags.reading.RecordingWarning")
STAMPS = np.arange(1, 121, dtype=np.int64) * 1_000_000


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_a_bag_of_another_tool_is_described(tmp_path: Path, storage: StoragePlugin) -> None:
    bag = foreign_bag(tmp_path / "bag", motor_messages(STAMPS), storage, custom={"operator": "somebody"})
    before = {path.name: path.read_bytes() for path in bag.iterdir()}
    assert describe([bag], {"object": "none", "control_period": 0.002}) == [bag / "metadata.yaml"]
    after = {path.name: path.read_bytes() for path in bag.iterdir()}
    assert {name for name in before if before[name] != after[name]} == {"metadata.yaml"}
    said = read_bag(bag).metadata
    assert (said["operator"], said["object"], said["control_period"]) == ("somebody", "none", 0.002)
    was, now = (yaml.safe_load(files["metadata.yaml"]) for files in (before, after))
    for content in (was, now):
        del content["rosbag2_bagfile_information"]["custom_data"]
    assert was == now
    with AnyReader([bag]) as reader:
        assert reader.message_count == sum(1 for _ in reader.messages())


def test_what_is_said_in_the_file_too_can_be_changed_and_taken_back(tmp_path: Path) -> None:
    """Bags of this project hold it twice, so that it survives a kill; the folder's metadata.yaml has the last word."""
    bag = write_recording(recording(n=100, names=MOTOR), tmp_path / "bag")
    assert read_bag(bag).metadata["condition"] == "slow"
    describe([bag], {"condition": "fast", "object": None})
    assert described(bag)["object"] is None
    recover(bag, tmp_path / "saved")
    for there in (bag, tmp_path / "saved"):
        said = read_bag(there).metadata
        assert said["condition"] == "fast" and "object" not in said and said["seed"] == 0


def test_all_bags_are_described_or_none(tmp_path: Path) -> None:
    good = write_recording(recording(n=100, names=MOTOR), tmp_path / "good")
    alone = good / "good_0.mcap"
    before = (good / "metadata.yaml").read_bytes()
    with pytest.raises(
        HannesError, match=r"good_0\.mcap is a single file.*name that folder, or make one with"
    ):
        describe([good, alone], {"object": "soft"})
    with pytest.raises(HannesError, match=r"cannot be stored"):
        describe([good], {"object": float("nan")})
    assert (good / "metadata.yaml").read_bytes() == before
    assert sorted(path.name for path in good.iterdir()) == ["good_0.mcap", "metadata.yaml"]


def test_what_others_have_said_stays_as_they_wrote_it(tmp_path: Path) -> None:
    """A recorder writes its texts without quotes; in YAML 1.1 many of them are numbers, times and truths."""
    bag = foreign_bag(tmp_path / "bag", motor_messages(STAMPS), StoragePlugin.MCAP)
    file = bag / "metadata.yaml"
    texts = {"time": "12:30:00", "run": "007", "flag": "yes", "serial": "0x1F", "day": "2025-11-28"}
    said = "".join(f"    {key}: {text}\n" for key, text in texts.items())
    content = yaml.safe_load(file.read_text(encoding="utf-8"))
    content["rosbag2_bagfile_information"].pop("custom_data", None)
    head = "rosbag2_bagfile_information:\n"
    plain = yaml.safe_dump(content, sort_keys=False).replace(head, f"{head}  custom_data:\n{said}", 1)
    file.write_text(plain + "beside: it\n", encoding="utf-8")
    describe([bag], {"object": "none"})
    assert described(bag) == {**texts, "object": "none"}
    again = file.read_text(encoding="utf-8")
    assert yaml.safe_load(again)["beside"] == "it"
    assert yaml.safe_load(again)["rosbag2_bagfile_information"]["custom_data"] == {
        **texts,
        "object": '"none"',
    }
    assert read_bag(bag).metadata["run"] == "007"


def test_a_folder_that_takes_no_file_is_said_before_any_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bags = [write_recording(recording(n=100, names=MOTOR), tmp_path / name) for name in ("a", "b")]
    before = (bags[0] / "metadata.yaml").read_bytes()
    monkeypatch.setattr("os.access", lambda path, mode: Path(path) != bags[1])
    with pytest.raises(
        HannesError, match=r"Cannot write .*b.metadata\.yaml: nothing can be written into its folder"
    ):
        describe(bags, {"object": "soft"})
    assert (bags[0] / "metadata.yaml").read_bytes() == before
