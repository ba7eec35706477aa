"""Bags of other tools, clocks, wrong data, and files that are not where they should be."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
import zstandard
from bags.bag_samples import MOTOR, foreign_bag, motor_messages, recording
from hannes_bags import cdr
from hannes_bags.clocks import spread
from hannes_bags.mcap_file import Limits
from hannes_bags.reading import RecordingWarning, bag_info, read_bag
from hannes_bags.recording import Recording
from hannes_bags.writing import write_recording
from hannes_description.errors import HannesError
from hannes_description.joints import JOINT_NAMES
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

STAMPS = np.arange(1, 301, dtype=np.int64) * 1_000_000
WALL = 1_795_254_430_000_000_000


def read_quietly(path: Path, **options: object) -> Recording:
    with pytest.warns(RecordingWarning):
        return read_bag(path, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_bags_of_rosbags(tmp_path: Path, storage: StoragePlugin) -> None:
    path = foreign_bag(tmp_path / "bag", motor_messages(STAMPS), storage, {"seed": "3", "note": "by hand"})
    back = read_bag(path)
    assert back.metadata["seed"] == 3 and back.metadata["note"] == "by hand"
    assert back.start_ns == 1_000_000
    assert np.array_equal(back["encoder_position"].values, np.sin(STAMPS * 1e-9))
    assert np.array_equal(back["motor_effort"].values, 3 * np.sin(STAMPS * 1e-9))
    assert np.array_equal(back["motor_current"].time, (STAMPS + 1000 - 1_000_000) / 1e9)
    assert back.metadata["warnings"] == [] and back.metadata["clock"]["kind"] == "same"
    single = next(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
    assert read_bag(single).differences(back) == []
    assert read_bag(single).sha256 == back.sha256
    assert read_bag(path / "metadata.yaml").differences(back) == []
    info = bag_info(path)
    assert info.message_count == 600 and [entry.count for entry in info.topics] == [300, 300]


@pytest.mark.parametrize(
    ("mode", "storage"),
    [
        (CompressionMode.MESSAGE, StoragePlugin.SQLITE3),
        (CompressionMode.MESSAGE, StoragePlugin.MCAP),
        (CompressionMode.FILE, StoragePlugin.MCAP),
        (CompressionMode.STORAGE, StoragePlugin.MCAP),
    ],
)
def test_compressed_bags(tmp_path: Path, mode: CompressionMode, storage: StoragePlugin) -> None:
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        for topic, (msgtype, entries) in motor_messages(STAMPS).items():
            connection = writer.add_connection(topic, msgtype, typestore=cdr.typestore())
            for log_ns, data in entries:
                writer.write(connection, log_ns, data)
    assert np.array_equal(read_bag(tmp_path / "bag")["encoder_position"].values, np.sin(STAMPS * 1e-9))


def test_a_packed_sqlite_file_is_refused_with_advice(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/hannes/grip_force", cdr.FLOAT64, typestore=cdr.typestore())
        writer.write(connection, 1, cdr.encode_float64([1.0])[0])
    with pytest.raises(HannesError, match="zstd -d"):
        read_bag(tmp_path / "bag")
    (packed,) = (tmp_path / "bag").glob("*.db3.zstd")
    with packed.open("rb") as stream:
        packed.with_suffix("").write_bytes(zstandard.ZstdDecompressor().stream_reader(stream).read())
    assert read_bag(tmp_path / "bag")["grip_force"].values.tolist() == [1.0]
    packed.unlink()
    assert read_bag(tmp_path / "bag")["grip_force"].values.tolist() == [1.0]


def test_times_that_a_recorder_had_to_guess_are_said(tmp_path: Path) -> None:
    path = foreign_bag(tmp_path / "bag", motor_messages(STAMPS), custom={"misplaced_messages": "12"})
    with pytest.warns(RecordingWarning, match="12 messages have too early a log time"):
        read_bag(path)


def test_any_namespace_and_renamed_topics(tmp_path: Path) -> None:
    path = foreign_bag(tmp_path / "a", motor_messages(STAMPS, prefix="/left/hand"))
    assert read_bag(path).metadata["bag"]["topics"]["encoder_position"] == "/left/hand/motor/state"
    renamed = {
        "/amps" if "current" in topic else topic: entry for topic, entry in motor_messages(STAMPS).items()
    }
    path = foreign_bag(tmp_path / "b", renamed)
    assert "motor_current" not in read_bag(path)
    assert "motor_current" in read_bag(path, topics={"motor_current": "/amps"})
    with pytest.raises(HannesError, match=r"no message on /volts.*/amps"):
        read_bag(path, topics={"motor_current": "volts"})
    assert read_bag(path).metadata["bag"]["unread"] == {"/amps": "std_msgs/msg/Float64"}
    with pytest.raises(HannesError, match=r"unknown signal 'amps'.*motor_current"):
        read_bag(path, topics={"amps": "/amps"})
    two = {**motor_messages(STAMPS), **motor_messages(STAMPS, prefix="/other")}
    path = foreign_bag(tmp_path / "c", two)
    with pytest.raises(
        HannesError, match=r"several topics that may be motor/state: /hannes/motor/state, /other/motor/state"
    ):
        read_bag(path)
    chosen = read_bag(path, topics={"encoder_position": "/other/motor/state", "motor_current": None})
    assert set(chosen.channels) == {"encoder_position", "encoder_velocity", "motor_effort"}


def test_no_known_topic(tmp_path: Path) -> None:
    path = foreign_bag(tmp_path / "a", {"/temperature": (cdr.FLOAT64, [(5, cdr.encode_float64([20.0])[0])])})
    with pytest.raises(
        HannesError, match=r"none of the topics.*motor/state.*It has: /temperature \(std_msgs/msg/Float64\)"
    ):
        read_bag(path)


def plain(msgtype: str, values: np.ndarray) -> tuple[str, list[tuple[int, bytes]]]:
    """Messages of one number, one for each of STAMPS."""
    store = cdr.typestore()
    kind = store.types[msgtype]
    return msgtype, [
        (log, bytes(store.serialize_cdr(kind(value), msgtype)))
        for log, value in zip(STAMPS.tolist(), values.tolist(), strict=True)
    ]


@pytest.mark.parametrize("msgtype", sorted(cdr.NUMBERS))
def test_any_plain_number(tmp_path: Path, msgtype: str) -> None:
    values = np.arange(300) % 50 - (0 if "UInt" in msgtype else 25)
    number = values.astype(np.float64 if "Float" in msgtype else np.int64)
    entry = plain(msgtype, number)
    path = foreign_bag(tmp_path / "a", {"/reference_position": entry, "/enc": entry})
    back = read_bag(path, topics={"encoder_position": "/enc"})
    assert set(back.channels) == {"reference_position", "encoder_position"}
    for channel in back.channels.values():
        assert np.array_equal(channel.values, number)
        assert np.array_equal(channel.time, (STAMPS - STAMPS[0]) / 1e9), "the log times are the stamps"
    padded = [(log, data + bytes(-len(data) % 4)) for log, data in entry[1]]
    back = read_bag(foreign_bag(tmp_path / "b", {"/reference_position": (msgtype, padded)}))
    assert np.array_equal(back["reference_position"].values, number)


def test_a_reference_that_is_a_joint_state_and_a_velocity_of_its_own_topic(tmp_path: Path) -> None:
    messages = motor_messages(STAMPS, prefix="/rig")
    command = cdr.encode_joint_states(STAMPS, ("any",), np.cos(STAMPS * 1e-9)[:, None])
    messages["/rig/command"] = (cdr.JOINT_STATE, list(zip(STAMPS.tolist(), command, strict=True)))
    messages["/rig/velocity"] = plain("std_msgs/msg/Float32", 4.0 * np.ones(300))
    path = foreign_bag(tmp_path / "a", messages)
    named = {"reference_position": "/rig/command", "encoder_velocity": "/rig/velocity", "motor_effort": None}
    back = read_quietly(path, topics=named)
    assert set(back.channels) == {
        "reference_position",
        "encoder_position",
        "encoder_velocity",
        "motor_current",
    }
    assert np.array_equal(back["reference_position"].values, np.cos(STAMPS * 1e-9))
    assert (back["encoder_velocity"].values == 4.0).all()
    assert back.metadata["clock"]["topic"] == "/rig/motor/state", "the encoder's stamps lead"
    assert set(read_bag(path, topics={"encoder_position": None}).channels) == {"motor_current"}
    with pytest.raises(HannesError, match="/rig/command is named for two signals"):
        read_bag(path, topics={"reference_position": "/rig/command", "motor_current": "/rig/command"})
    with pytest.raises(HannesError, match="/rig/command is a sensor_msgs/msg/JointState, but motor_current"):
        read_bag(path, topics={"motor_current": "/rig/command"})


def test_wrong_type(tmp_path: Path) -> None:
    entry = (cdr.STRING, [(5, cdr.encode_strings(["3 N"])[0])])
    path = foreign_bag(tmp_path / "a", {**motor_messages(STAMPS), "/hannes/grip_force": entry})
    with pytest.raises(
        HannesError,
        match="/hannes/grip_force is a std_msgs/msg/String, but grip_force is a std_msgs/msg/Float64",
    ):
        read_bag(path)
    assert "grip_force" not in read_bag(path, topics={"grip_force": None})
    path = foreign_bag(tmp_path / "b", {**motor_messages(STAMPS), "/hannes/reference_position": entry})
    with pytest.raises(HannesError, match=r"Name another topic with --topic SIGNAL=TOPIC \(.*Python\)\.$"):
        read_bag(path)


def test_the_encoder_by_name_or_alone(tmp_path: Path) -> None:
    path = foreign_bag(tmp_path / "a", motor_messages(STAMPS, joint=("gear", "motor_pulley")))
    assert read_bag(path).metadata["warnings"] == []
    path = foreign_bag(tmp_path / "b", motor_messages(STAMPS, joint=("spool",)))
    assert "'spool'; it was taken as 'motor_pulley'" in read_quietly(path).warnings[0]
    path = foreign_bag(tmp_path / "c", motor_messages(STAMPS, joint=("spool", "gear")))
    with pytest.raises(HannesError, match="has the joints spool, gear, but not 'motor_pulley'"):
        read_bag(path)


@pytest.mark.parametrize(
    ("names", "told"),
    [(("thumb", "motor_pulley"), "1 for thumb, motor_pulley"), (("motor_pulley",), "2 for motor_pulley")],
)
def test_more_or_fewer_numbers_than_joints(tmp_path: Path, names: tuple[str, ...], told: str) -> None:
    messages = motor_messages(STAMPS, joint=names)
    other = cdr.encode_joint_states(STAMPS, names, np.zeros((300, 3 - len(names))))
    messages["/hannes/motor/state"] = (cdr.JOINT_STATE, list(zip(STAMPS.tolist(), other, strict=True)))
    path = foreign_bag(tmp_path / "a", messages)
    with pytest.raises(HannesError, match=f"another number of positions than of names .message 0: {told}"):
        read_bag(path)
    assert set(read_bag(path, topics={"encoder_position": None}).channels) == {"motor_current"}


def joint_bag(path: Path, names: tuple[str, ...], velocity: bool = True) -> Path:
    angles = np.arange(len(names)) * 0.01 + np.zeros((len(STAMPS), 1))
    states = cdr.encode_joint_states(STAMPS, names, angles, angles if velocity else None)
    return foreign_bag(
        path, {"/joint_states": (cdr.JOINT_STATE, list(zip(STAMPS.tolist(), states, strict=True)))}
    )


def test_joints_are_ordered_by_name(tmp_path: Path) -> None:
    shuffled = ("wrist", *reversed(JOINT_NAMES))
    back = read_bag(joint_bag(tmp_path / "a", shuffled))
    assert back["joint_positions"].values[5].tolist() == [pytest.approx(0.01 * (13 - k)) for k in range(13)]
    back = read_bag(joint_bag(tmp_path / "b", JOINT_NAMES, velocity=False))
    assert "joint_velocities" not in back and not back.warnings, "velocity is optional in a JointState"
    with pytest.raises(HannesError, match="lack the joints thumb_abd"):
        read_bag(joint_bag(tmp_path / "c", JOINT_NAMES[:-1]))


def test_messages_of_other_joints_on_the_same_topic_are_left_out(tmp_path: Path) -> None:
    hand = cdr.encode_joint_states(STAMPS, JOINT_NAMES, np.zeros((300, 13)))
    arm = cdr.encode_joint_states(STAMPS, ("elbow",), np.zeros((300, 1)))
    entries = [(log, message) for k, log in enumerate(STAMPS.tolist()) for message in (hand[k], arm[k])]
    back = read_quietly(foreign_bag(tmp_path / "a", {"/joint_states": (cdr.JOINT_STATE, entries)}))
    assert back["joint_positions"].values.shape == (300, 13)
    assert any("300 messages on /joint_states are of other joints" in text for text in back.warnings)


def test_messages_without_any_joint_are_said_to_be_empty(tmp_path: Path) -> None:
    messages = motor_messages(STAMPS)
    kind, entries = messages["/hannes/motor/state"]
    nothing = cdr.encode_joint_states(STAMPS, (), np.zeros((300, 0)))
    messages["/hannes/motor/state"] = (
        kind,
        [*entries[:200], *zip(STAMPS[200:].tolist(), nothing, strict=False)],
    )
    back = read_quietly(foreign_bag(tmp_path / "a", messages))
    assert back["encoder_position"].time.size == 200
    assert back.warnings == ("100 messages on /hannes/motor/state have no joint at all; they were left out.",)


def test_positions_that_are_all_nan_are_not_said_to_be_missing(tmp_path: Path) -> None:
    for k, (values, told) in enumerate(((np.nan, "have NaN for every position"), (None, "have no position"))):
        angles = np.zeros((300, 0)) if values is None else np.full((300, 1), values)
        states = cdr.encode_joint_states(STAMPS, ("motor_pulley",), angles)
        messages = motor_messages(STAMPS)
        messages["/hannes/motor/state"] = (cdr.JOINT_STATE, list(zip(STAMPS.tolist(), states, strict=True)))
        back = read_quietly(foreign_bag(tmp_path / str(k), messages))
        assert told in back.warnings[0] and set(back.channels) == {"motor_current"}


def test_samples_that_are_not_finite_are_left_out_and_told(tmp_path: Path) -> None:
    messages = motor_messages(STAMPS)
    entries = messages["/hannes/motor/current"][1]
    entries[17] = (entries[17][0], cdr.encode_float64([np.nan])[0])
    back = read_quietly(foreign_bag(tmp_path / "a", messages))
    assert back["motor_current"].time.size == len(entries) - 1
    assert any("1 of 300 samples of motor_current are not finite" in text for text in back.warnings)
    states = cdr.encode_joint_states(STAMPS, ("motor_pulley",), np.zeros((300, 1)), np.full((300, 1), np.nan))
    messages = {"/motor/state": (cdr.JOINT_STATE, list(zip(STAMPS.tolist(), states, strict=True)))}
    assert set(read_quietly(foreign_bag(tmp_path / "b", messages)).channels) == {"encoder_position"}


def test_undecodable_message(tmp_path: Path) -> None:
    messages = motor_messages(STAMPS)
    messages["/hannes/motor/current"][1][3] = (4_001_000, b"\x00\x01\x00\x00\x00")
    with pytest.raises(
        HannesError, match="message 3 on /hannes/motor/current cannot be read as std_msgs/msg/Float64"
    ):
        read_bag(foreign_bag(tmp_path / "a", messages))


def test_units_that_look_wrong_are_told(tmp_path: Path) -> None:
    names = ("motor_pulley",)
    for scale, expected in ((40_000.0, "encoder counts"), (800.0, "degrees")):
        states = cdr.encode_joint_states(STAMPS, names, scale * np.linspace(0, 1, 300)[:, None])
        messages = {"/motor/state": (cdr.JOINT_STATE, list(zip(STAMPS.tolist(), states, strict=True)))}
        assert any(
            expected in text for text in read_quietly(foreign_bag(tmp_path / expected, messages)).warnings
        )
    amperes = {"/motor/current": (cdr.FLOAT64, [(5, cdr.encode_float64([1500.0])[0])])}
    assert "looks like mA" in read_quietly(foreign_bag(tmp_path / "c", amperes)).warnings[0]


# ---- clocks -------------------------------------------------------------------------------------------------------


def test_one_clock_with_latency(tmp_path: Path) -> None:
    logs = STAMPS + WALL + np.random.default_rng(0).integers(50_000, 900_000, 300)
    back = read_bag(foreign_bag(tmp_path / "a", motor_messages(STAMPS + WALL, logs)))
    assert back.metadata["clock"]["kind"] == "same" and back.start_ns == WALL + 1_000_000
    assert np.array_equal(back["encoder_position"].time, (STAMPS - 1_000_000) / 1e9)


def test_simulated_stamps_against_wall_log_times_at_one_rate(tmp_path: Path) -> None:
    logs = STAMPS + WALL + np.random.default_rng(0).integers(-100_000, 100_000, 300)
    back = read_quietly(foreign_bag(tmp_path / "a", motor_messages(STAMPS, logs)))
    assert back.metadata["clock"]["kind"] == "offset" and "different clocks" in back.warnings[0]
    assert np.allclose(back["motor_current"].time, back["encoder_position"].time, atol=2.1e-4)
    assert back.start_ns < 2_000_000


def test_simulated_stamps_at_another_rate(tmp_path: Path) -> None:
    """A simulation five times as fast as real time for the first half, half as fast for the second."""
    steps = np.where(np.arange(3000) < 1500, 200_000, 2_000_000)
    stamps = np.arange(1, 3001, dtype=np.int64) * 1_000_000
    back = read_quietly(foreign_bag(tmp_path / "a", motor_messages(stamps, WALL + np.cumsum(steps))))
    assert back.metadata["clock"]["kind"] == "warped" and "different rates" in back.warnings[0]
    assert np.abs(back["motor_current"].time - back["encoder_position"].time).max() <= 1e-3


def test_unstamped_joint_states_take_the_log_time(tmp_path: Path) -> None:
    back = read_quietly(foreign_bag(tmp_path / "a", motor_messages(0 * STAMPS, STAMPS + WALL)))
    assert "carry no stamp" in back.warnings[0] and back.metadata["clock"]["kind"] == "log"
    assert np.array_equal(back["encoder_position"].time, (STAMPS - 1_000_000) / 1e9)


def test_some_messages_without_a_stamp(tmp_path: Path) -> None:
    """On a clock that is set no stamp is zero; simulated time may begin with one, and does not come back to it."""
    for k, (zero, start, told) in enumerate(((50, WALL, 1), (0, WALL, 1), (50, 0, 1), (0, 0, 0))):
        stamps = STAMPS + start
        stamps[zero] = 0
        back = read_quietly(foreign_bag(tmp_path / str(k), motor_messages(stamps, STAMPS + WALL)))
        said = "1 of 300 messages on /hannes/motor/state carry no stamp (it is zero)"
        assert sum(said in text for text in back.warnings) == told
        if told:
            assert np.array_equal(back["encoder_position"].time, (STAMPS - 1_000_000) / 1e9)


def test_two_stamped_topics_on_two_clocks(tmp_path: Path) -> None:
    states = cdr.encode_joint_states(STAMPS, JOINT_NAMES, np.zeros((300, 13)))
    logs = (STAMPS + WALL).tolist()
    messages = motor_messages(STAMPS + WALL)
    messages["/joint_states"] = (cdr.JOINT_STATE, list(zip(logs, states, strict=True)))
    back = read_quietly(foreign_bag(tmp_path / "a", messages))
    assert "another clock" in back.warnings[0]
    assert np.allclose(back["joint_positions"].time, back["encoder_position"].time, atol=1e-4)


def test_two_runs_in_one_bag(tmp_path: Path) -> None:
    stamps = np.concatenate([STAMPS, STAMPS])
    logs = WALL + np.arange(600) * 1_000_000
    with pytest.raises(HannesError, match="go back at message 300"):
        read_bag(foreign_bag(tmp_path / "a", motor_messages(stamps, logs)))


def test_swapped_neighbours_are_sorted_and_repeats_dropped(tmp_path: Path) -> None:
    stamps = STAMPS.copy()
    stamps[[10, 11]] = stamps[[11, 10]]
    back = read_quietly(foreign_bag(tmp_path / "a", motor_messages(stamps, STAMPS)))
    assert any("1 sample of encoder_position came out of order" in text for text in back.warnings)
    assert np.array_equal(back["encoder_position"].values, np.sin(STAMPS * 1e-9))
    repeated = np.concatenate([STAMPS[:5], STAMPS[4:]])
    logs = np.arange(301) * 1_000_000
    messages = motor_messages(repeated, logs)
    currents = messages["/hannes/motor/current"][1]
    currents[8:8] = 2 * [currents[7]]
    back = read_quietly(foreign_bag(tmp_path / "b", messages))
    assert back["encoder_position"].time.size == 300 and back["motor_current"].time.size == 301
    said = "stamp too, were left out: 1 on /hannes/motor/state, 2 on /hannes/motor/current."
    assert any(said in text for text in back.warnings)


# ---- what is on disk ----------------------------------------------------------------------------------------------


def edit(path: Path, **changes: object) -> None:
    content = yaml.safe_load((path / "metadata.yaml").read_text())
    content["rosbag2_bagfile_information"].update(changes)
    (path / "metadata.yaml").write_text(yaml.safe_dump(content))


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_recording(recording(names=MOTOR), tmp_path / "home" / "bag")


def test_nothing_outside_the_folder_is_read(bag: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret.mcap"
    shutil.copy(bag / "bag_0.mcap", secret)
    for name in (str(secret), "../../secret.mcap", "sub/../../../secret.mcap"):
        edit(bag, relative_file_paths=[name])
        with pytest.raises(HannesError, match="outside the bag's folder"):
            read_bag(bag)
    (bag / "link.mcap").symlink_to(secret)
    (bag / "folder").symlink_to(tmp_path)
    for name in ("link.mcap", "folder/secret.mcap"):
        edit(bag, relative_file_paths=[name])
        with pytest.raises(HannesError, match="leads out of the bag's folder"):
            read_bag(bag)
    (bag / "metadata.yaml").rename(tmp_path / "metadata.yaml")
    (bag / "metadata.yaml").symlink_to(tmp_path / "metadata.yaml")
    with pytest.raises(HannesError, match="leads out of the bag's folder"):
        read_bag(bag)


def test_links_within_the_folder_and_to_the_bag_are_fine(bag: Path, tmp_path: Path) -> None:
    (bag / "bag_0.mcap").rename(bag / "real.mcap")
    (bag / "bag_0.mcap").symlink_to("real.mcap")
    (tmp_path / "alias").symlink_to(bag)
    assert read_bag(tmp_path / "alias").differences(recording(names=MOTOR)) == []


@pytest.mark.parametrize("name", ["pipe.mcap", "pipe.db3"])
def test_a_pipe_is_not_waited_for(bag: Path, name: str) -> None:
    os.mkfifo(bag / name)
    edit(bag, relative_file_paths=[name])
    with pytest.raises(HannesError, match="is not a file"):
        read_bag(bag)
    with pytest.raises(HannesError, match="neither a folder nor a file"):
        read_bag(bag / name)


def test_files_that_are_missing(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(HannesError, match="There is no bag at"):
        read_bag(tmp_path / "nowhere")
    (bag / "metadata.yaml").rename(bag / "kept")
    with pytest.raises(HannesError, match=r"no metadata.yaml.*hannes recover"):
        read_bag(bag)
    (bag / "kept").rename(bag / "metadata.yaml")
    (bag / "bag_0.mcap").rename(bag / "other.txt")
    with pytest.raises(HannesError, match=r"lacks its file 'bag_0.mcap'"):
        read_bag(bag)
    with pytest.raises(HannesError, match="not a bag: expected"):
        read_bag(bag / "other.txt")
    (tmp_path / "empty").mkdir()
    with pytest.raises(HannesError, match=r"neither metadata\.yaml nor"):
        read_bag(tmp_path / "empty")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[" * 100_000,
        "- " * 50_000,
        "a: &a [*a, *a]",
        "rosbag2_bagfile_information: 3",
        "rosbag2_bagfile_information: {version: .inf}",
        "rosbag2_bagfile_information: {version: 10}",
        "rosbag2_bagfile_information: {version: 9, storage_identifier: [mcap]}",
        "rosbag2_bagfile_information: {version: 9, storage_identifier: mcap, relative_file_paths: {a: b}}",
        "rosbag2_bagfile_information: {version: 9, storage_identifier: mcap, relative_file_paths: [2024-99-99]}",
        "rosbag2_bagfile_information: !!python/object/apply:os.system [false]",
        "x: " + "9" * 5000,
        "\0",
        "a" * 300_000,
    ],
)
def test_metadata_that_is_not_metadata(bag: Path, text: str) -> None:
    (bag / "metadata.yaml").write_text(text)
    with pytest.raises(HannesError, match=r"metadata\.yaml"):
        read_bag(bag)


def test_metadata_that_is_not_text(bag: Path) -> None:
    (bag / "metadata.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(HannesError, match="not readable YAML"):
        read_bag(bag)


def test_zero_messages(tmp_path: Path) -> None:
    path = foreign_bag(tmp_path / "a", {"/hannes/grip_force": (cdr.FLOAT64, [])})
    with pytest.raises(HannesError, match="holds no message"):
        read_bag(path)
    assert bag_info(path).message_count == 0


def test_limits(bag: Path) -> None:
    with pytest.raises(HannesError, match="more than 100 messages"):
        read_bag(bag, limits=Limits(messages=100))
    with pytest.raises(HannesError, match="unpack to more than 1000 bytes"):
        read_bag(bag, limits=Limits(total_bytes=1000))


def test_a_split_bag(bag: Path) -> None:
    """Two storage files in one folder, as rosbag2 makes when it splits."""
    whole = recording(names=MOTOR, n=400)
    parts = [whole.slice(0.0, 0.2), whole.slice(0.2, 1.0)]
    for k, part in enumerate(parts):
        made = write_recording(Recording(part.channels, {}, "", "", part.start_ns), bag.parent / f"part{k}")
        shutil.copy(made / f"part{k}_0.mcap", bag / f"bag_{k}.mcap")
    edit(bag, relative_file_paths=["bag_0.mcap", "bag_1.mcap"])
    back = read_bag(bag)
    for name, channel in whole.channels.items():
        assert np.array_equal(back[name].values, channel.values)


def test_times_of_a_slow_clock_are_spread(tmp_path: Path) -> None:
    """`ros2 bag play --clock` ticks at 40 Hz: what has no header has one time for 25 messages."""
    stamps = np.arange(0, 2000, dtype=np.int64) * 1_000_000
    coarse = stamps // 25_000_000 * 25_000_000
    bag = foreign_bag(tmp_path / "bag", motor_messages(stamps, coarse))
    with pytest.warns(
        RecordingWarning, match=r"come in steps of 25 ms .* spread over it, on /hannes/motor/current"
    ):
        found = read_bag(bag)
    current = found["motor_current"]
    assert current.time.size == 2000, "none repeats the one before"
    np.testing.assert_allclose(current.time - current.time[0], stamps * 1e-9, atol=2e-3)
    assert (np.diff(current.time) > 0.0).all()
    times, step = spread(np.array([5, 5, 5]))
    assert step == 0 and times.tolist() == [5, 5, 5]
    times, step = spread(np.array([0, 0, 10, 10, 10, 10, 90, 90]))
    assert step == 45 and times.tolist() == [0, 5, 10, 21, 32, 43, 90, 112]


def test_messages_that_stand_twice_are_no_slow_clock(tmp_path: Path) -> None:
    """Two recorders in one bag: each message again, stamp and all."""
    stamps = np.repeat(np.arange(0, 500, dtype=np.int64) * 1_000_000, 2)
    bag = foreign_bag(tmp_path / "bag", motor_messages(stamps))
    with pytest.warns(RecordingWarning, match="repeat the one before, its stamp too, were left out: 500 on"):
        found = read_bag(bag)
    assert found["motor_current"].time.size == found["encoder_position"].time.size == 500


def test_what_comes_oftener_than_the_ticks_of_a_lockstep_is_no_slow_clock(tmp_path: Path) -> None:
    """EMG of 300 Hz beside ticks of 10 ms: three samples of one time each."""
    stamps = np.arange(0, 200, dtype=np.int64) * 10_000_000
    messages = motor_messages(stamps)
    emg = list(zip(np.repeat(stamps, 3).tolist(), cdr.encode_float64(np.sin(np.arange(600.0))), strict=True))
    messages["/hannes/emg/flexor"] = (cdr.FLOAT64, emg)
    found = read_bag(foreign_bag(tmp_path / "bag", messages))
    assert not any("slow /clock" in warning for warning in found.warnings)
