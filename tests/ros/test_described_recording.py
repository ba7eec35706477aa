"""A recording of this project's own loop says what made it; one of any other machine does not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from graph import NodeProcess, Peer, processes
from hannes_bags.recorder_node import description
from hannes_description.model import Model
from hannes_lab.hand import is_of
from hannes_lab.prepare import load_trials
from hannes_ros.telling import LOOP, Told, loop_of
from hannes_sim.sim_node import HandSimParameters
from patience import PATIENCE

pytestmark = [
    pytest.mark.ros,
    pytest.mark.filterwarnings("ignore::hannes_bags.reading.RecordingWarning"),
]
NOMINAL = Model.load()
CONTROLLER = {"control_period": 0.001, LOOP: loop_of(NOMINAL)}


def hannes(*words: str, env: dict[str, str]) -> str:
    told = subprocess.run(
        [sys.executable, "-m", "hannes_bringup.cli", *words],
        env=env, capture_output=True, text=True, timeout=PATIENCE,
    )  # fmt: skip
    assert told.returncode == 0, told.stdout + told.stderr
    return " ".join(told.stdout.split())


@pytest.mark.slow
def test_what_the_graph_recorded_is_compared_as_its_own(
    tmp_path: Path, ros_environment: dict[str, str]
) -> None:
    words = ("--clock", "lockstep", "--object", "soft", "--duration", "6", "--record", str(tmp_path / "bag"))
    hannes("run", "graph", *words, env=ros_environment)
    (trial,) = load_trials([tmp_path / "bag"])
    assert is_of(trial, NOMINAL) and trial.options["object"] == "soft" and trial.period == 0.001
    printed = hannes("compare", str(tmp_path / "bag"), env=ros_environment)
    assert "Overall error" in printed and "do not tell" not in printed


def told(**parameters: Any) -> dict[str, Any]:
    return HandSimParameters(**{"clock": "lockstep", **parameters}).told(NOMINAL)


def test_no_plant_is_named_of_another_hand_or_of_a_controller_of_other_gains() -> None:
    assert description({}, CONTROLLER, {}) == {}
    other = {**CONTROLLER, LOOP: {**CONTROLLER[LOOP], "control.kp": 1.0}}
    assert set(description(told(), other, {})) == {"object", "sensors"}
    assert set(description(told(), {}, {})) == {"object", "sensors"}  # a bag that is played drives the motor
    late = description(told(clock="realtime"), CONTROLLER, {})
    assert set(late) == {"object", "sensors", "control_period"}, "messages take their time"
    own = description(told(current_noise=0.01), CONTROLLER, {})
    assert own["plant"] == "reduced" and own["control_period"] == 0.001 and own["object"] == "none"
    assert own["sensors"] == {"current_rectified": False, "current_window": 0.0, "current_noise": 0.01}


def test_what_the_user_said_stands_but_for_an_object_of_other_measures() -> None:
    assert "object" not in description(told(object="soft"), CONTROLLER, {"object": "soft"})
    measured = description(told(object="soft", object_stiffness=900.0), CONTROLLER, {"object": "soft"})
    assert measured["object"]["stiffness"] == 900.0


def test_who_publishes_a_topic_is_asked_and_two_are_nobody(peer: Peer) -> None:
    """The peer, which tells nothing of itself, drives the motor too from some time on."""
    asked = Told(peer.node, "motor/voltage")

    def look() -> bool:
        asked.look()
        return bool(asked.of("motor/voltage"))

    with processes(NodeProcess("motor_controller", autostart=False)):
        peer.until(look, what="the controller's answer")
        assert asked.of("motor/voltage") == CONTROLLER
        peer.publisher("motor_voltage")
        peer.until(lambda: not look(), what="the second source")
