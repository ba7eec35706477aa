"""write_recording and read_bag, each also against the independent implementations (rosbags, mcap)."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import yaml
from bags.bag_samples import MOTOR, recording
from hannes_bags.reading import bag_info, read_bag
from hannes_bags.recording import Channel, Recording
from hannes_bags.storage import load_metadata
from hannes_bags.writing import BagWriter, Qos, write_recording
from hannes_description.errors import HannesError
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

pytestmark = pytest.mark.filterwarnings("ignore::hannes_bags.reading.RecordingWarning")


@pytest.mark.parametrize("compression", ["none", "zstd"])
@pytest.mark.parametrize("start_ns", [0, 1_795_254_430_865_171_302])
def test_values_stamps_and_metadata_come_back_exactly(
    tmp_path: Path, compression: str, start_ns: int
) -> None:
    made = recording(start_ns=start_ns)
    back = read_bag(write_recording(made, tmp_path / "bag", compression=compression))  # type: ignore[arg-type]
    assert back.differences(made) == []
    assert {key: back.metadata[key] for key in made.metadata} == dict(made.metadata)
    again = read_bag(write_recording(back, tmp_path / "again", compression=compression))  # type: ignore[arg-type]
    assert again.differences(made) == [] and again.sha256 == back.sha256


def test_extreme_numbers_survive(tmp_path: Path) -> None:
    values = np.array([0.0, -0.0, 5e-324, 1.7976931348623157e308, -1e-300, np.pi])
    channel = Channel(np.arange(6.0), values, "A", "motor_current")
    back = read_bag(write_recording(Recording({"motor_current": channel}), tmp_path / "bag"))
    assert back["motor_current"].values.tobytes() == values.tobytes()


def test_bytes_are_the_same_for_the_same_recording(tmp_path: Path) -> None:
    paths = [write_recording(recording(), tmp_path / name) for name in ("one", "another_name")]
    files = [(path / f"{path.name}_0.mcap").read_bytes() for path in paths]
    assert files[0] == files[1]
    assert read_bag(paths[0]).sha256 == hashlib.sha256(files[0]).hexdigest()
    assert write_recording(recording(seed=1), tmp_path / "c").joinpath("c_0.mcap").read_bytes() != files[0]


def test_a_slice_keeps_its_time_zero(tmp_path: Path) -> None:
    part = recording().slice(0.0105, 0.2)
    back = read_bag(write_recording(part, tmp_path / "bag"))
    assert back.start_ns == part.start_ns == 10_500_000
    for name in part.channels:
        assert back[name].time == pytest.approx(part[name].time, abs=1e-9)


@pytest.mark.parametrize("single_file", [False, True])
def test_rosbags_reads_what_we_write(tmp_path: Path, single_file: bool) -> None:
    made = recording()
    path = write_recording(made, tmp_path / "bag")
    with AnyReader([path / "bag_0.mcap" if single_file else path]) as reader:
        store = get_typestore(Stores.ROS2_JAZZY)
        currents, stamps, logs = [], [], []
        for connection, log_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/hannes/motor/current":
                currents.append((log_ns, message.data))
            if connection.topic == "/hannes/motor/state":
                stamps.append(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
                logs.append(log_ns)
                assert message.name == ["motor_pulley"]
        for connection in reader.connections:
            if not single_file:
                assert connection.digest == store.hash_rihs01(connection.msgtype)
            assert connection.ext.offered_qos_profiles[0].depth == 10
        assert reader.message_count == bag_info(path).message_count
    assert [value for _, value in currents] == made["motor_current"].values.tolist()
    assert [log_ns for log_ns, _ in currents] == np.rint(made["motor_current"].time * 1e9).tolist()
    assert stamps == logs == np.rint(made["encoder_position"].time * 1e9).tolist()


def test_the_official_mcap_reader_agrees(tmp_path: Path) -> None:
    path = write_recording(recording(), tmp_path / "bag")
    with (path / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == sum(1 for _ in reader.iter_messages())
        names = {record.name: record.metadata for record in reader.iter_metadata()}
        assert names["hannes"]["condition"] == '"slow"'
        assert yaml.safe_load(names["rosbag2"]["serialized_metadata"])["version"] == 9
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        logs = [message.log_time for _, _, message in reader.iter_messages()]
        assert logs == sorted(logs)


def test_metadata_yaml_is_rosbag2_version_9(tmp_path: Path) -> None:
    path = write_recording(recording(names=MOTOR), tmp_path / "bag")
    information = load_metadata(path / "metadata.yaml")
    assert information["version"] == 9 and information["storage_identifier"] == "mcap"
    assert information["custom_data"]["seed"] == "0"
    assert all(isinstance(value, str) for value in information["custom_data"].values())
    counts = {
        t["topic_metadata"]["name"]: t["message_count"] for t in information["topics_with_message_count"]
    }
    assert sum(counts.values()) == information["message_count"] == information["files"][0]["message_count"]
    first = information["topics_with_message_count"][0]["topic_metadata"]
    assert first["offered_qos_profiles"][0]["reliability"] == "reliable"
    assert first["type_description_hash"].startswith("RIHS01_")


def test_a_bag_is_never_overwritten(tmp_path: Path) -> None:
    path = write_recording(recording(names=MOTOR), tmp_path / "bag")
    before = (path / "bag_0.mcap").read_bytes()
    with pytest.raises(HannesError, match="exists already"):
        write_recording(recording(names=MOTOR, seed=5), path)
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(HannesError, match="exists already"):
        BagWriter(tmp_path / "link")
    assert (path / "bag_0.mcap").read_bytes() == before


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    whole = recording(names=MOTOR)
    shifted = Channel(
        whole["encoder_velocity"].time + 1e-3, whole["encoder_velocity"].values, "rad/s", "encoder_velocity"
    )
    with pytest.raises(HannesError, match="encoder_velocity and encoder_position share"):
        write_recording(Recording({**whole.channels, "encoder_velocity": shifted}), tmp_path / "a")
    with pytest.raises(HannesError, match="without the position"):
        write_recording(Recording({"motor_effort": whole["motor_effort"]}), tmp_path / "b")
    with pytest.raises(HannesError, match="'tool' cannot be stored"):
        write_recording(whole.with_metadata(tool=object()), tmp_path / "c")
    with pytest.raises(HannesError, match="compression 'rar'"):
        write_recording(whole, tmp_path / "d", compression="rar")  # type: ignore[arg-type]
    with pytest.raises(HannesError, match="Cannot write"):
        (tmp_path / "file").write_text("")
        write_recording(whole, tmp_path / "file" / "bag")
    assert not any((tmp_path / name).exists() for name in "abcd")


def test_qos_is_read_in_every_version() -> None:
    new = "- history: keep_all\n  depth: 7\n  reliability: best_effort\n  durability: transient_local\n"
    old = "- history: 2\n  depth: 7\n  reliability: 2\n  durability: 1\n"
    assert Qos.from_text(new) == Qos.from_text(old) == Qos("best_effort", "transient_local", "keep_all", 7)
    for text in ("", "[", "- 3", "- {history: [1], depth: -1}", "[" * 5000):
        assert Qos.from_text(text) == Qos()
