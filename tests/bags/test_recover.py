"""What `recover` saves."""

import json
import re
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
import typer
import yaml
from bags.bag_samples import MOTOR, foreign_bag, motor_messages, recording
from hannes_bags import cdr
from hannes_bags.cli import info
from hannes_bags.reading import bag_info, read_bag
from hannes_bags.recover import recover
from hannes_bags.writing import BagWriter, write_recording
from hannes_bringup.cli.bags import recover as recover_command
from hannes_description.errors import HannesError
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from typer.testing import CliRunner

pytestmark = pytest.mark.filterwarnings("ignore::hannes_bags.reading.RecordingWarning")
STAMPS = np.arange(1, 2001, dtype=np.int64) * 1_000_000


def long_bag(path: Path) -> Path:
    return write_recording(recording(n=3000, names=MOTOR), path)


def test_without_metadata_yaml_everything_is_kept(tmp_path: Path) -> None:
    bag = long_bag(tmp_path / "bag")
    whole = read_bag(bag)
    (bag / "metadata.yaml").unlink()
    saved = recover(bag, tmp_path / "saved")
    back = read_bag(tmp_path / "saved")
    assert back.differences(whole) == []
    assert back.metadata["condition"] == "slow" and back.metadata["recovered_from"] == "bag"
    assert (saved.damage, saved.unread_bytes, saved.lost_s) == ((), 0, 0.0)
    assert saved.losses == "no message is missing"
    assert saved.messages == whole.metadata["bag"]["messages"]
    with AnyReader([tmp_path / "saved"]) as reader:
        assert reader.message_count == saved.messages


@pytest.mark.parametrize("part", [0.05, 0.31, 0.5, 0.77, 0.99])
def test_a_cut_file_keeps_all_up_to_the_cut(tmp_path: Path, part: float) -> None:
    bag = long_bag(tmp_path / "bag")
    whole = read_bag(bag)
    file = bag / "bag_0.mcap"
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * part)])
    (bag / "metadata.yaml").unlink()
    before = {path.name: path.read_bytes() for path in bag.iterdir()}
    saved = recover(bag, tmp_path / "saved")
    assert {path.name: path.read_bytes() for path in bag.iterdir()} == before
    assert len(saved.damage) == 1 and "cut" in saved.damage[0]
    assert saved.recorded is None and saved.losses.startswith("how much is missing is not known")
    back = read_bag(tmp_path / "saved")
    for name, channel in back.channels.items():
        n = channel.time.size
        assert np.array_equal(channel.values, whole[name].values[:n])
    assert saved.duration >= 0.85 * part * whole.duration
    assert saved.duration + saved.lost_s >= 0.8 * part * whole.duration


def test_a_hole_in_the_middle_costs_its_chunk_only(tmp_path: Path) -> None:
    bag = long_bag(tmp_path / "bag")
    file = bag / "bag_0.mcap"
    data = bytearray(file.read_bytes())
    place = len(data) // 2
    data[place : place + 10] = b"\xaa" * 10
    file.write_bytes(data)
    saved = recover(file, tmp_path / "saved")
    total = bag_info(long_bag(tmp_path / "twin")).message_count
    assert total - 700 < saved.messages < total
    assert any("checksum" in sentence for sentence in saved.damage) and saved.recorded is None
    told = recover(file.parent, tmp_path / "told")
    assert (told.recorded, told.lost_s) == (total, 0.0)
    del data[place : place + 13]
    file.write_bytes(data)
    assert recover(file, tmp_path / "again").messages == saved.messages


def test_a_chunk_that_was_cut_gives_its_messages(tmp_path: Path) -> None:
    """Other recorders write chunks of a megabyte: what lies in front of the cut is kept."""
    for name, mode in (("plain", CompressionMode.NONE), ("packed", CompressionMode.STORAGE)):
        writer = Writer(tmp_path / name, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection("/hannes/grip_force", cdr.FLOAT64, typestore=cdr.typestore())
            for k, data in enumerate(cdr.encode_float64(np.random.default_rng(0).normal(size=5000))):
                writer.write(connection, k * 1_000_000, data)
        file = tmp_path / name / f"{name}.mcap"
        with file.open("r+b") as stream:
            stream.truncate(50_000)
        saved = recover(file, tmp_path / f"{name}_saved")
        assert saved.messages > (1000 if name == "plain" else 500)
        values = read_bag(tmp_path / f"{name}_saved")["grip_force"].values
        assert np.array_equal(values, np.random.default_rng(0).normal(size=5000)[: values.size])


def test_nothing_to_save(tmp_path: Path) -> None:
    for name, data in (("empty", b""), ("text", b"this is no bag at all"), ("magic", b"\x89MCAP0\r\n")):
        (tmp_path / f"{name}.mcap").write_bytes(data)
        with pytest.raises(HannesError, match="no message to save"):
            recover(tmp_path / f"{name}.mcap", tmp_path / "saved")
        assert not (tmp_path / "saved").exists()
    BagWriter(tmp_path / "quiet").close()
    with pytest.raises(HannesError, match="whole but empty"):
        recover(tmp_path / "quiet", tmp_path / "saved")
    with pytest.raises(HannesError, match="There is no bag"):
        recover(tmp_path / "nowhere", tmp_path / "saved")
    (tmp_path / "folder").mkdir()
    with pytest.raises(HannesError, match=r"no \.mcap or \.db3 file"):
        recover(tmp_path / "folder", tmp_path / "saved")


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    bag = long_bag(tmp_path / "bag")
    (tmp_path / "there").mkdir()
    with pytest.raises(HannesError, match="exists already"):
        recover(bag, tmp_path / "there")
    with pytest.raises(HannesError, match="lies within the bag"):
        recover(bag, bag / "saved")


def test_types_that_jazzy_does_not_know_are_kept(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic(
            "/x", "own_msgs/msg/Own", definition=("ros2msg", b"float64 a\n"), type_hash="RIHS01_00"
        )
        writer.write("/x", b"\0\1\0\0" + bytes(8), 5)
        with pytest.raises(HannesError, match="'own_msgs/msg/Other' of /y is not known"):
            writer.add_topic("/y", "own_msgs/msg/Other")
    recover(tmp_path / "bag", tmp_path / "saved")
    entry = bag_info(tmp_path / "saved").topics[0]
    assert (entry.type, entry.count, entry.type_hash) == ("own_msgs/msg/Own", 1, "RIHS01_00")


# ---- SQLite -------------------------------------------------------------------------------------------------------


def sqlite_file(folder: Path) -> Path:
    path = foreign_bag(folder, motor_messages(STAMPS), StoragePlugin.SQLITE3)
    return path / f"{path.name}.db3"


def test_sqlite_without_metadata(tmp_path: Path) -> None:
    file = sqlite_file(tmp_path / "bag")
    (file.parent / "metadata.yaml").unlink()
    saved = recover(file.parent, tmp_path / "saved")
    assert saved.messages == 4000 and saved.damage == ()
    back = read_bag(tmp_path / "saved")
    assert np.array_equal(back["encoder_position"].values, np.sin(STAMPS * 1e-9))


def test_sqlite_with_its_log(tmp_path: Path) -> None:
    """A recorder that was killed leaves what was not yet merged in the write-ahead log."""
    file = sqlite_file(tmp_path / "bag")
    connection = sqlite3.connect(file)
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("PRAGMA wal_autocheckpoint=0")
    for k in range(500):
        data = cdr.encode_float64([float(k)])[0]
        connection.execute(
            "INSERT INTO messages (topic_id, timestamp, data) VALUES (2, ?, ?)",
            (3_000_000_000 + k * 1_000_000, data),
        )
    connection.commit()
    killed = tmp_path / "killed"
    shutil.copytree(file.parent, killed)
    connection.close()
    with pytest.raises(HannesError, match=r"was not closed.*hannes recover"):
        read_bag(killed)
    before = {path.name: path.read_bytes() for path in killed.iterdir()}
    assert recover(killed, tmp_path / "saved").messages == 4500
    assert {path.name: path.read_bytes() for path in killed.iterdir()} == before


def test_sqlite_with_damage_keeps_both_ends(tmp_path: Path) -> None:
    file = sqlite_file(tmp_path / "bag")
    data = bytearray(file.read_bytes())
    place = len(data) // 2 // 4096 * 4096
    data[place : place + 4096] = b"\xff" * 4096
    file.write_bytes(data)
    saved = recover(file, tmp_path / "saved")
    assert 2000 < saved.messages < 4000 and saved.damage
    assert bag_info(tmp_path / "saved").message_count == saved.messages
    file.write_bytes(data[: len(data) // 3])
    try:
        assert recover(file, tmp_path / "less").messages > 0
    except HannesError as error:
        assert "no message to save" in str(error)


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_what_is_missing_against_metadata_yaml(tmp_path: Path, storage: StoragePlugin) -> None:
    path = foreign_bag(tmp_path / "bag", motor_messages(STAMPS), storage)
    file = next(child for child in path.iterdir() if child.suffix != ".yaml")
    if storage == StoragePlugin.MCAP:
        file.write_bytes(file.read_bytes()[:100_000])
    else:
        with sqlite3.connect(file) as connection:
            connection.execute("DELETE FROM messages WHERE timestamp > 1000000000")
        connection.close()
    saved = recover(path, tmp_path / "saved")
    assert saved.recorded == 4000 and saved.lost_s == pytest.approx(2.0 - saved.end_ns * 1e-9, abs=2e-6)
    assert saved.losses.startswith(
        f"{4000 - saved.messages} of 4000 messages are missing, about {saved.lost_s:.3f}"
    )
    stale = path / "metadata.yaml"
    stale.write_text(stale.read_text().replace("4000", "7"))
    assert recover(path, tmp_path / "again").recorded == (None if saved.damage else saved.messages)


def test_a_file_that_is_missing_in_the_middle_is_named_and_so_is_the_hole(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    path.mkdir()
    for k, part in enumerate(np.array_split(STAMPS, 4)):
        foreign_bag(tmp_path / "part", motor_messages(part), StoragePlugin.MCAP)
        (file,) = (tmp_path / "part").glob("*.mcap")
        file.rename(path / f"bag_{k}.mcap")
        information = yaml.safe_load((tmp_path / "part" / "metadata.yaml").read_text())
        shutil.rmtree(tmp_path / "part")
    told = information["rosbag2_bagfile_information"]
    told["relative_file_paths"] = [f"bag_{k}.mcap" for k in range(4)]
    told["message_count"] = 4000
    (path / "metadata.yaml").write_text(yaml.safe_dump(information))
    (path / "bag_2.mcap").unlink()
    saved = recover(path, tmp_path / "saved")
    assert saved.messages == 3000 and saved.damage == ("bag_2.mcap is missing.",)
    assert saved.gap == pytest.approx((1.0 - 0.001, 1.5), abs=1.1e-3)
    assert saved.losses.endswith("; none is there from 0.999 to 1.500 s")


# ---- commands -----------------------------------------------------------------------------------------------------


def test_the_command_that_tells_what_is_in_a_bag(tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(info)
    bag = long_bag(tmp_path / "bag")
    told = CliRunner().invoke(app, [str(bag)])
    assert told.exit_code == 0 and "/hannes/motor/voltage" in told.output and "sha256" in told.output
    content = json.loads(CliRunner().invoke(app, [str(bag), "--json"]).output)
    assert content["sha256"] == read_bag(bag).sha256 and content["metadata"]["condition"] == "slow"
    two = long_bag(tmp_path / "two")
    told = CliRunner().invoke(app, [str(tmp_path)])
    assert told.exit_code == 0 and re.findall(r"^\S+: mcap", told.output, re.M) == [
        f"{bag}: mcap",
        f"{two}: mcap",
    ]
    both = json.loads(CliRunner().invoke(app, [str(tmp_path), "--json"]).output)
    assert [one["path"] for one in both] == [str(bag), str(two)]
    for file in two.glob("*.mcap"):
        file.write_bytes(file.read_bytes()[:-100])
    told = CliRunner().invoke(app, [str(tmp_path)])
    assert f"{bag}: mcap" in told.output and "1 of 2 bags" in str(told.exception)
    (bag / "metadata.yaml").unlink()
    assert recover(bag, tmp_path / "saved").as_dict()["messages"] == content["message_count"]
    saving = typer.Typer()
    saving.command()(recover_command)
    told = CliRunner().invoke(saving, [str(bag), str(tmp_path / "said")])
    assert told.exit_code == 0 and "no message is missing" in told.output
    assert isinstance(CliRunner().invoke(app, [str(bag)]).exception, HannesError)
