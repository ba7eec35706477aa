"""The recorder's and player's cores, without ROS."""

from pathlib import Path

import numpy as np
import pytest
from bags.bag_samples import MOTOR, foreign_bag, motor_messages, recording
from hannes_bags import cdr
from hannes_bags.player import Schedule, load_playlist
from hannes_bags.reading import bag_info, read_bag
from hannes_bags.recorder import LossCounter, Received, Recorder, SimulatedTimes
from hannes_bags.writing import BagWriter, write_recording
from hannes_description.errors import HannesError

MS = 1_000_000


def lockstep_traffic(ticks: int) -> list[Received]:
    """What four publishers send in lock-step, each message sent 10 us after the one before."""
    sent, messages = 0, []
    for tick in range(ticks):
        stamp = np.array([tick * MS])
        state = cdr.encode_joint_states(stamp, ("motor_pulley",), np.full((1, 1), float(tick)))[0]
        number = cdr.encode_float64([float(tick)])[0]
        for topic, data in (
            ("/clock", cdr.encode_clock(stamp)[0]),
            ("current", number),
            ("state", state),
            ("reference", number),
            ("voltage", number),
        ):
            sent += 10_000
            messages.append(Received(topic, data, sent, sent + 50_000, sent + 60_000))
    return messages


@pytest.mark.parametrize("seed", range(5))
def test_in_lockstep_every_message_gets_the_time_of_its_tick(seed: int) -> None:
    """However the topics overtake each other on the way, as each topic keeps its order."""
    rng = np.random.default_rng(seed)
    traffic = lockstep_traffic(300)
    queues = {
        topic: [m for m in traffic if m.topic == topic] for topic in dict.fromkeys(m.topic for m in traffic)
    }
    times = SimulatedTimes("/clock", hold_ns=10**15)
    got: list[tuple[Received, int]] = []
    while any(queues.values()):
        topic = rng.choice([name for name, queue in queues.items() if queue])
        for _ in range(rng.integers(1, 40)):
            if queues[topic]:
                times.add(queues[topic].pop(0))
        got += times.release(0)
    got += times.release(0, everything=True)
    assert len(got) == len(traffic) and times.waiting == 0
    for message, log_ns in got:
        assert log_ns == (message.sent_ns // 10_000 - 1) // 5 * MS


def test_without_a_later_clock_a_message_waits_no_longer_than_the_hold() -> None:
    times = SimulatedTimes("/clock", hold_ns=50)
    times.add(Received("/clock", cdr.encode_clock(np.array([7]))[0], 10, 10, 10))
    times.add(Received("voltage", b"", 20, 20, 40))
    assert [log for _, log in times.release(30)] == [7]
    assert times.waiting == 1
    assert times.release(89) == [], "the recorder was held up, and took it late"
    assert [(m.topic, log) for m, log in times.release(91)] == [("voltage", 7)]
    times.add(Received("/clock", cdr.encode_clock(np.array([8]))[0], 30, 95, 95))
    assert times.misplaced == 0


def test_what_was_given_out_before_the_clock_of_its_time_came_is_counted() -> None:
    times = SimulatedTimes("/clock", hold_ns=50)
    times.add(Received("/clock", cdr.encode_clock(np.array([7]))[0], 10, 10, 10))
    for sent in (11, 21, 22):
        times.add(Received("voltage", b"", sent, sent, sent))
    assert [log for _, log in times.release(100)] == [7, 7, 7, 7]
    times.add(Received("/clock", cdr.encode_clock(np.array([8]))[0], 20, 101, 101))
    assert times.misplaced == 2
    times.add(Received("/clock", cdr.encode_clock(np.array([9]))[0], 30, 102, 102))
    assert times.misplaced == 2


def test_messages_before_the_first_clock_take_its_time() -> None:
    times = SimulatedTimes("/clock")
    times.add(Received("emg", b"", 5, 5, 5))
    assert times.release(10**12) == []
    times.add(Received("/clock", cdr.encode_clock(np.array([3 * MS]))[0], 10, 10, 10))
    assert [log for _, log in times.release(10**12)] == [3 * MS, 3 * MS]


def test_without_simulated_time_messages_count_when_received(tmp_path: Path) -> None:
    for name, simulated in (("plain", None), ("decided", SimulatedTimes("/clock"))):
        recorder = Recorder(BagWriter(tmp_path / name, {"condition": "slow"}), simulated)
        recorder.writer.add_topic("/hannes/grip_force", cdr.FLOAT64)
        for k, data in enumerate(cdr.encode_float64([1.0, 2.0])):
            info = {
                "received_timestamp": 10 + k,
                "source_timestamp": 5 + k,
                "publication_sequence_number": 1 + 3 * k,
            }
            recorder.take("/hannes/grip_force", data, info, 99)
        recorder.use_receive_times(99)
        recorder.close(99)
        back = read_bag(tmp_path / name)
        assert back.start_ns == 10 and back["grip_force"].time.tolist() == [0.0, 1e-9]
        assert back.metadata["lost_messages"] == {"/hannes/grip_force": 2}
        assert back.metadata["condition"] == "slow"
        single = read_bag(tmp_path / name / f"{name}_0.mcap")
        assert single.metadata["lost_messages"] == {"/hannes/grip_force": 2}


def test_losses_are_counted_for_one_publisher() -> None:
    counter = LossCounter()
    for number in (3, 4, 7, 8, None, 10, 11):
        counter.saw("a", number)
    for number in (1, 2, 5, 3, 9):
        counter.saw("several publishers", number)
    assert counter.lost == {"a": 3}


def test_shifted_stamps() -> None:
    state = cdr.encode_joint_states(np.array([1_999_999_999]), ("a",), np.zeros((1, 1)))[0]
    assert cdr.stamp_at(cdr.shift_stamp(state, 2)) == 2_000_000_001
    assert cdr.shift_stamp(b"\x00\x01\x00\x00", 5) == b"\x00\x01\x00\x00"


def test_a_loop_goes_on_from_a_first_stamp_of_zero(tmp_path: Path) -> None:
    """The first tick of a lock-step has it; a message of a topic that is never stamped keeps its 0."""
    stamps = np.arange(0, 5, dtype=np.int64) * MS
    looped = Schedule(load_playlist(foreign_bag(tmp_path / "bag", motor_messages(stamps))), loop=True)
    ticks = looped.due(0.02)
    states = [
        cdr.stamp_at(data) for _, messages in ticks for topic, data in messages if topic.endswith("state")
    ]
    assert len(states) > 10 and states == sorted(set(states))


def test_the_schedule_follows_the_rate_and_loops(tmp_path: Path) -> None:
    stamps = np.arange(1, 11, dtype=np.int64) * MS
    bag = foreign_bag(tmp_path / "bag", motor_messages(stamps))
    playlist = load_playlist(bag)
    assert len(playlist.entries) == 20 and playlist.duration == pytest.approx(9.001e-3)
    schedule = Schedule(playlist, rate=2.0)
    assert [t for t, _ in schedule.due(0.0)] == [MS]
    assert [t for t, _ in schedule.due(1e-3)] == [MS + 1000, 2 * MS, 2 * MS + 1000, 3 * MS]
    assert sum(len(messages) for _, messages in schedule.due(1.0)) == 15 and schedule.done
    fast = Schedule(playlist, rate=0.0)
    assert len(fast.due(0.0, at_most=7)) == 7 and not fast.done
    looped = Schedule(playlist, rate=1.0, loop=True)
    ticks = looped.due(0.05)
    assert not looped.done and looped.round >= 4
    times = [t for t, _ in ticks]
    assert times == sorted(times) and len(set(times)) == len(times)
    states = [
        cdr.stamp_at(data) for t, messages in ticks for topic, data in messages if topic.endswith("state")
    ]
    assert states == [t for t, messages in ticks if messages[0][0].endswith("state")]
    with pytest.raises(HannesError, match="rate of playing"):
        Schedule(playlist, rate=-1.0)


def test_what_is_played(tmp_path: Path) -> None:
    bag = write_recording(recording(names=MOTOR), tmp_path / "bag")
    assert {topic for topic, _ in load_playlist(bag, topics=["/hannes/motor/voltage"]).entries} == {
        "/hannes/motor/voltage"
    }
    assert load_playlist(bag, start=0.3).log_ns[0] >= 300 * MS
    with pytest.raises(HannesError, match="no topic /nothing"):
        load_playlist(bag, topics=["/nothing"])
    with pytest.raises(HannesError, match="nothing is left after 100"):
        load_playlist(bag, start=100.0)
    assert bag_info(bag).duration == pytest.approx(load_playlist(bag).duration)


def test_a_clock_that_goes_back_is_counted() -> None:
    times = SimulatedTimes("/clock")
    for sent, value in enumerate((0, 1, 2, 3, 0, 1), start=1):
        times.heard(cdr.encode_clock(np.array([value * MS]))[0], sent)
    assert (times.ticks, times.went_back) == (6, 1)
    late = SimulatedTimes("/clock")
    for sent, value in ((1, 0), (3, 2), (2, 1)):
        late.heard(cdr.encode_clock(np.array([value * MS]))[0], sent)
    assert late.went_back == 0, "one that overtook another did not go back"


def test_the_clock_of_a_bag_is_played_where_it_is_named(tmp_path: Path) -> None:
    messages = motor_messages(np.arange(1, 4, dtype=np.int64) * MS)
    messages["/clock"] = ("rosgraph_msgs/msg/Clock", [(MS, cdr.encode_clock(np.array([5 * MS]))[0])])
    bag = foreign_bag(tmp_path / "bag", messages)
    assert {topic for topic, _ in load_playlist(bag, topics=["/clock"], clock=True).entries} == {"/clock"}
    for named in ((), ("/clock", "/hannes/motor/state")):
        assert "/clock" not in {topic for topic, _ in load_playlist(bag, topics=named).entries}
