import pickle

import numpy as np
import pytest
from bags.bag_samples import recording
from hannes_bags.recording import Channel, Recording
from hannes_description.errors import HannesError


def test_channel_names_the_culprit() -> None:
    time = np.arange(5.0)
    good = np.zeros(5)
    with pytest.raises(HannesError, match=r"'motor_current'.*nan at index 2"):
        Channel(time, np.array([0, 0, np.nan, 0, 0]), "A", "motor_current")
    with pytest.raises(HannesError, match=r"goes back at index 3"):
        Channel(np.array([0, 1, 2, 1, 4.0]), good, "A", "motor_current")
    with pytest.raises(HannesError, match=r"'mA'.*'A'"):
        Channel(time, good, "mA", "motor_current")
    with pytest.raises(HannesError, match=r"Unknown signal 'current'.*motor_current"):
        Channel(time, good, "A", "current")
    with pytest.raises(HannesError, match=r"n = 5.*\(4,\)"):
        Channel(time, np.zeros(4), "A", "motor_current")
    with pytest.raises(HannesError, match=r"13 columns"):
        Channel(time, np.zeros((5, 12)), "rad", "joint_positions")
    with pytest.raises(HannesError, match="n >= 1"):
        Channel(np.zeros(0), np.zeros(0), "A", "motor_current")
    with pytest.raises(HannesError, match="cannot be read as numbers"):
        Channel(time, ["a"] * 5, "A", "motor_current")  # type: ignore[arg-type]


def test_arrays_are_read_only_copies() -> None:
    values = np.zeros(3)
    channel = Channel(np.arange(3.0), values, "A", "motor_current")
    values[0] = 1.0
    assert channel.values[0] == 0.0
    with pytest.raises(ValueError):
        channel.values[0] = 1.0


def test_require_lists_missing_and_present() -> None:
    short = recording(names=("motor_current", "motor_voltage"))
    with pytest.raises(
        HannesError, match=r"lacks grip_force \(topic grip_force\), encoder_position.*It has: motor_current"
    ):
        short.require(("grip_force", "encoder_position", "motor_current"))
    with pytest.raises(HannesError, match="Unknown signal 'force'"):
        short.require(("force",))


def test_slices_partition_and_rebase() -> None:
    whole = recording(n=400)
    parts = [whole.slice(0.0, 0.15), whole.slice(0.15, 1.0)]
    for name, channel in whole.channels.items():
        joined = np.concatenate([part[name].values for part in parts])
        assert np.array_equal(joined, channel.values)
    assert parts[1].start_ns == 150_000_000
    assert parts[1].begin == pytest.approx(0.0, abs=1e-3)
    assert parts[0].sha256 != whole.sha256
    with pytest.raises(HannesError, match="must be earlier"):
        whole.slice(0.2, 0.1)
    with pytest.raises(HannesError, match="no sample from 7"):
        whole.slice(7.0, 8.0)


def test_resample() -> None:
    time = np.array([0.0, 1.0, 2.0])
    made = Recording({"motor_current": Channel(time, np.array([0.0, 10.0, 0.0]), "A", "motor_current")})
    assert made.resample("motor_current", [0.5, 1.25]).tolist() == [5.0, 7.5]
    assert made.resample("motor_current", [0.9, 1.0], "previous").tolist() == [0.0, 10.0]
    assert made.resample("motor_current", [0.9, 1.4], "nearest").tolist() == [10.0, 10.0]
    with pytest.raises(HannesError, match=r"runs from 0.000000 s to 2.000000 s"):
        made.resample("motor_current", [5.0])
    everything = recording()
    assert everything.resample("joint_positions", [0.01, 0.02]).shape == (2, 13)
    with pytest.raises(HannesError, match="text"):
        everything.resample("stiffness_label", [0.02])
    assert everything.resample("stiffness_label", [0.02], "previous").shape == (1,)


def test_content_hash_and_copies_between_processes() -> None:
    one, two = recording(seed=1), recording(seed=1)
    assert one.sha256 == two.sha256 != recording(seed=2).sha256
    copy = pickle.loads(pickle.dumps(one))
    assert copy.sha256 == one.sha256 and copy.differences(one) == []
