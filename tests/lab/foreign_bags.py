"""Bags as others write them: plain rosbag2 without metadata, damaged where a test wants it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hannes_bringup.cli import main
from hannes_description.model import EffectEntry, Model
from hannes_lab.hide import make_set
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

Signals = dict[str, tuple[np.ndarray, np.ndarray]]
Damage = Callable[[Signals], Signals]

STORE = get_typestore(Stores.ROS2_JAZZY)
FLOAT = STORE.types["std_msgs/msg/Float64"]
JOINTS = STORE.types["sensor_msgs/msg/JointState"]
HEADER = STORE.types["std_msgs/msg/Header"]
TIME = STORE.types["builtin_interfaces/msg/Time"]
TOPICS = {
    "reference_position": "/hannes/reference_position",
    "encoder_position": "/hannes/motor/state",
    "motor_current": "/hannes/motor/current",
    "motor_voltage": "/hannes/motor/voltage",
}


def signals_of_set(
    *,
    model: Model | None = None,
    effects: Sequence[EffectEntry] = (),
    conditions: Sequence[str] = ("slow", "fast"),
    closures: int = 5,
    seed: int = 5,
    sensors: str = "thesis",
) -> dict[str, Signals]:
    """By condition, the signals of a simulated set (time in s, values in SI)."""
    recordings, _ = make_set(
        model or Model.load(), effects, seed=seed, closures=closures, conditions=conditions, sensors=sensors
    )
    return {
        str(r.metadata["condition"]): {
            name: (np.array(c.time), np.array(c.values)) for name, c in r.channels.items() if name in TOPICS
        }
        for r in recordings
    }


def scaled(**factors: float) -> Damage:
    """Signals in other units or with the other sign."""

    def damage(signals: Signals) -> Signals:
        return {n: (t, v * factors.get(n, 1.0)) for n, (t, v) in signals.items()}

    return damage


def one_after_the_other(first: Signals, *others: Signals) -> Signals:
    """What a recorder that was not stopped between them has of them."""
    out = first
    for signals in others:
        later = max(float(t[-1]) for t, _ in out.values()) + 0.05
        out = {
            n: (np.append(t, signals[n][0] + later), np.append(v, signals[n][1])) for n, (t, v) in out.items()
        }
    return out


def write_bag(
    folder: Path,
    signals: Signals,
    *,
    clock: float = 0.0,
    sqlite: bool = False,
    topics: Mapping[str, str] = TOPICS,
    number: str = FLOAT.__msgtype__,
    stamped: bool = True,
) -> None:
    """A rosbag2 folder.

    clock    s, added to the header stamps only, as if the motor board had its own clock
    topics   by signal name
    number   type of all that is a plain number; the encoder is one too if not `stamped`
    """
    kinds = dict.fromkeys(signals, STORE.types[number])
    if stamped and "encoder_position" in kinds:
        kinds["encoder_position"] = JOINTS
    events = sorted(
        ((float(t), name, float(v)) for name, pair in signals.items() for t, v in zip(*pair, strict=True)),
        key=lambda event: event[0],
    )
    plugin = StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        connections = {
            name: writer.add_connection(topics[name], kind.__msgtype__, typestore=STORE)
            for name, kind in kinds.items()
        }
        for time, name, value in events:
            log = round((100.0 + time) * 1e9)
            if kinds[name] is JOINTS:
                stamp = round((100.0 + time + clock) * 1e9)
                header = HEADER(TIME(stamp // 10**9, stamp % 10**9), "")
                none = np.zeros(0)
                message = JOINTS(header, ["motor_pulley"], np.array([value]), none, none)
            else:
                message = kinds[name](value)
            writer.write(connections[name], log, STORE.serialize_cdr(message, message.__msgtype__))


def write_set(folder: Path, conditions: dict[str, Signals], damage: Damage | None = None, **how: Any) -> Path:
    """One bag per condition below the folder."""
    folder.mkdir(parents=True)
    for name, signals in conditions.items():
        copy = {key: (time.copy(), values.copy()) for key, (time, values) in signals.items()}
        write_bag(folder / name, damage(copy) if damage else copy, **how)
    return folder


def hannes(
    *words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of one command."""
    monkeypatch.setattr("sys.argv", ["hannes", *words])
    try:
        code = main()
    except SystemExit as end:
        code = int(end.code or 0)
    said = capsys.readouterr()
    return code, said.out, said.err


def hannes_in_one_line(
    *words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> tuple[int, str, str]:
    """The same with the output's lines joined: sentences may be broken anywhere."""
    code, out, err = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    return code, " ".join(out.split()), err
