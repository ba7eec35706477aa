"""Recordings and bags that the tests of hannes_bags share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from hannes_bags import cdr
from hannes_bags.recording import Channel, Recording
from hannes_description.signals import SIGNALS
from rosbags.rosbag2 import StoragePlugin, Writer

MOTOR = (
    "reference_position",
    "encoder_position",
    "encoder_velocity",
    "motor_effort",
    "motor_current",
    "motor_voltage",
)


def canonical(time: np.ndarray) -> np.ndarray:
    """Times as a bag gives them back: whole nanoseconds."""
    return np.rint(time * 1e9) / 1e9


def values_of(name: str, n: int, rng: np.random.Generator) -> Any:
    if name.startswith("joint_"):
        return rng.normal(size=(n, 13))
    if name in ("stiffness_probability", "stiffness_estimate"):
        return rng.random((n, 3))
    if name == "stiffness_label":
        return np.array(["void", "soft", "rigid"])[rng.integers(0, 3, n)]
    return rng.normal(size=n)


def recording(
    n: int = 400, names: tuple[str, ...] = tuple(SIGNALS), seed: int = 0, start_ns: int = 0
) -> Recording:
    """Every signal: JointState topics each ms, the others in odd multiples of it with an offset."""
    rng = np.random.default_rng(seed)
    channels = {}
    for k, name in enumerate(names):
        joints = SIGNALS[name].type == cdr.JOINT_STATE
        time = (
            np.arange(n) * 1e-3
            if joints
            else 1e-4 * k + np.arange(max(1, n // (1 + k % 4))) * 1e-3 * (1 + k % 4)
        )
        channels[name] = Channel(canonical(time), values_of(name, len(time), rng), SIGNALS[name].unit, name)
    metadata = {
        "condition": "slow",
        "object": {"shape": "sphere", "size": 0.06},
        "closures": [0.0, 4.0],
        "seed": seed,
    }
    return Recording(channels, metadata, "memory", "", start_ns)


def foreign_bag(
    path: Path,
    messages: dict[str, tuple[str, list[tuple[int, bytes]]]],
    storage: StoragePlugin = StoragePlugin.SQLITE3,
    custom: dict[str, str] | None = None,
) -> Path:
    """A bag by another tool (rosbags' writer): by topic, its type and its (log time ns, CDR)."""
    with Writer(path, version=9, storage_plugin=storage) as writer:
        for key, value in (custom or {}).items():
            writer.set_custom_data(key, value)
        queue = []
        for topic, (msgtype, entries) in messages.items():
            connection = writer.add_connection(topic, msgtype, typestore=cdr.typestore())
            queue += [(log_ns, connection, data) for log_ns, data in entries]
        for log_ns, connection, data in sorted(queue, key=lambda entry: entry[0]):
            writer.write(connection, log_ns, data)
    return path


def motor_messages(
    stamps: np.ndarray,
    logs: np.ndarray | None = None,
    joint: tuple[str, ...] = ("motor_pulley",),
    prefix: str = "/hannes",
) -> dict[str, tuple[str, list[tuple[int, bytes]]]]:
    """motor/state stamped `stamps` ns and logged at `logs` ns, motor/current logged just behind it."""
    logs = stamps if logs is None else logs
    angle = np.sin(stamps * 1e-9)[:, None] * np.ones((1, len(joint)))
    states = cdr.encode_joint_states(stamps, joint, angle, 2 * angle, 3 * angle)
    currents = cdr.encode_float64(np.cos(stamps * 1e-9))
    return {
        f"{prefix}/motor/state": (cdr.JOINT_STATE, list(zip(logs.tolist(), states, strict=True))),
        f"{prefix}/motor/current": (cdr.FLOAT64, list(zip((logs + 1000).tolist(), currents, strict=True))),
    }
