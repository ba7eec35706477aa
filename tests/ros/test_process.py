"""A node as a process: signals, arguments, parameters, help, diagnostics."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep

import pytest
from graph import PROGRAMS, NodeProcess, processes
from hannes_ros.parameter_files import unread_sections
from patience import PATIENCE

NODES = [name for name in PROGRAMS if name != "composed"]
READY = {
    "hand_sim": "waiting for",
    "motor_controller": "",
    "emg_source": "synthetic EMG",
    "emg_reference": "",
}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_all_nodes_quietly(peer, number):
    peer.hear_diagnostics()
    nodes = {name: NodeProcess(name, clock="lockstep") for name in NODES}
    with processes(*nodes.values()):
        peer.until(lambda: all(peer.status(name) for name in NODES), what="diagnostics of all nodes")
        for node in nodes.values():
            node.send(number)
        assert {name: node.wait() for name, node in nodes.items()} == dict.fromkeys(NODES, 0)
    assert not [node.output for node in nodes.values() if "Traceback" in node.output]


def test_signals_end_real_time_nodes_quietly(peer):
    peer.hear_diagnostics()
    nodes = {name: NodeProcess(name) for name in NODES}
    with processes(*nodes.values()):
        peer.until(lambda: all(peer.status(name) for name in NODES), what="diagnostics of all nodes")
        ending = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGHUP)
        for number, node in zip(ending, nodes.values(), strict=True):
            node.send(number)
        assert {name: node.wait() for name, node in nodes.items()} == dict.fromkeys(NODES, 0)
    assert not [node.output for node in nodes.values() if "Traceback" in node.output]


def importing(node: NodeProcess) -> bool:
    """Whether the process is at least in the imports of its node module (rclpy's library is mapped)."""
    try:
        return "_rclpy_pybind11" in Path(f"/proc/{node.process.pid}/maps").read_text()
    except OSError:
        return False


@pytest.mark.parametrize("delay", [0.0, 0.1, 0.3, 0.6])
def test_early_signals_end_quietly(ros_environment, delay):
    nodes = [
        NodeProcess("motor_controller", clock="lockstep"),
        NodeProcess("emg_reference", clock="lockstep"),
    ]
    with processes(*nodes):
        for node, number in zip(nodes, (signal.SIGINT, signal.SIGTERM), strict=True):
            end = monotonic() + PATIENCE
            while not importing(node):
                assert monotonic() < end
                sleep(0.005)
            sleep(delay)
            node.send(number)
        codes = [node.wait() for node in nodes]
        assert not [node.output for node in nodes if "Traceback" in node.output]
        assert codes == [0, 0]


@pytest.mark.parametrize(
    ("name", "arguments", "parameters", "message"),
    [
        ("hand_sim", (), {"modle": "x"}, "Node 'hand_sim' has no parameter 'modle'; valid are model, plant,"),
        ("hand_sim", (), {"model": "nobody"}, "No model 'nobody'"),
        ("hand_sim", (), {"object_size": 0.05}, "need an object"),
        ("hand_sim", (), {"period": 0.00009}, "it must be between 0.0001 and 0.1 s"),
        ("hand_sim", ("object:=rigid",), {}, "give it as '--ros-args -p object:=rigid'"),
        (
            "emg_source",
            ("--ros-args", "-p", "clock:=realtime", "--", "emg_source:seed:=1"),
            {},
            "'emg_source:seed:=1'",
        ),
        (
            "motor_controller",
            (),
            {"reference": "sinus"},
            "'motor_controller' is 'sinus'; valid are topic, half_sine",
        ),
        ("motor_controller", (), {"period": "fast"}, "it must be a number"),
        ("emg_reference", (), {"envelope_cutoff": -1.0}, "it must be between 0.1 and 45.0 Hz"),
        ("emg_reference", ("--verbose",), {}, "Unknown argument '--verbose'"),
        ("emg_source", ("--ros-args", "--params-file", "/nowhere.yaml"), {}, "ROS arguments are not valid"),
        ("composed", ("--nodes", "hand_sim,foot"), {}, "There is no node 'foot' to compose"),
        ("composed", ("--nodes", "hand_sim"), {"foot:size": 1}, "There is no node 'foot' in this process"),
    ],
)
def test_mistakes_are_one_line_and_exit_code_2(ros_environment, name, arguments, parameters, message):
    with processes(NodeProcess(name, *arguments, **parameters)) as (node,):
        assert node.wait() == 2, node.output
    assert message in node.output
    assert "Traceback" not in node.output
    assert len([line for line in node.lines if "[rcl]" not in line]) == 1, node.output


def test_help_lists_the_parameters(ros_environment):
    node = NodeProcess("composed", "--help")
    assert node.wait() == 0
    for text in (
        "hand_sim: The simulated hand",
        "object := 'none'",
        "one of none, soft, rigid",
        "envelope_cutoff",
    ):
        assert text in node.output


def test_help_says_which_section_of_a_file_is_read(peer, tmp_path):
    file = tmp_path / "parameters.yaml"
    node = NodeProcess("hand_sim", "--help")
    assert node.wait() == 0
    sections = re.findall(r"'(/\S+hand_sim):'", node.output)
    assert len(sections) == 2
    for section in sections:
        file.write_text(f"{section}: {{ros__parameters: {{object: ball}}}}\n")
        with processes(NodeProcess("hand_sim", "--ros-args", "--params-file", str(file))) as (node,):
            assert node.wait() == 2 and "is 'ball'; valid are none, soft, rigid" in node.output


def test_a_section_of_another_namespace_is_said(peer, tmp_path):
    """ROS passes over it in silence, and the hand would hold nothing."""
    peer.hear_diagnostics()
    file = tmp_path / "parameters.yaml"
    file.write_text("hand_sim: {ros__parameters: {object: rigid, nonsense: 3}}\n")
    with processes(NodeProcess("hand_sim", "--ros-args", "--params-file", str(file))) as (node,):
        peer.until(lambda: bool(peer.status("hand_sim")), what="diagnostics")
        node.end()
        assert node.output.count("'hand_sim:' is not read") == 1, node.output
        assert "this node is /hannes/hand_sim: name it '/hannes/hand_sim:', or '/**/hand_sim:'" in node.output


@pytest.mark.parametrize(
    ("content", "unread"),
    [
        ("hand_sim: {ros__parameters: {}}", ["hand_sim"]),
        ("/left/hand_sim: {ros__parameters: {}}", ["/left/hand_sim"]),
        ("left: {hand_sim: {ros__parameters: {}}}", ["left/hand_sim"]),
        ("/left/hand_sim: {ros__parameters: {}}\n/hannes/hand_sim: {ros__parameters: {}}", []),
        ("hannes: {hand_sim: {ros__parameters: {}}}", []),
        ("/*/hand_sim: {ros__parameters: {}}", []),
        ("/**/hand_sim: {ros__parameters: {}}", []),
        ("/**: {ros__parameters: {}}\nother: {ros__parameters: {hand_sim: {a: 1}}}", []),
        ("just a text", []),
        ("{", []),
    ],
)
def test_which_sections_are_not_for_a_node(tmp_path, content, unread):
    file = tmp_path / "parameters.yaml"
    file.write_text(content)
    assert unread_sections(file, "/hannes/hand_sim") == unread


def test_a_topic_is_renamed_in_the_old_way_too(peer):
    peer.hear_diagnostics()
    with processes(NodeProcess("hand_sim", "motor/voltage:=/volts", "reference_position:=/x", "__node:=sim")):
        peer.until(lambda: bool(peer.status("/hannes/sim")), what="diagnostics")


@pytest.mark.parametrize("period", [1e-4, 0.00033, 0.1])
def test_any_control_period_of_the_range_will_do(peer, period):
    peer.hear_diagnostics()
    with processes(NodeProcess("hand_sim", period=period)):
        peer.until_status("hand_sim", lambda s: int(s["tick"]) > 0, "a tick")


def test_a_diverging_plant_ends_the_node_with_one_line(ros_environment, tmp_path):
    plant = tmp_path / "broken.py"
    plant.write_text(
        "from hannes_sim.plant import PlantDiverged\n"
        "from hannes_sim.reduced import ReducedPlant\n"
        "class Broken(ReducedPlant):\n"
        "    def advance(self, voltage, steps):\n"
        "        raise PlantDiverged('The plant diverged at t = 0.001 s (index_mcp).')\n"
    )
    node = NodeProcess("hand_sim", plant=f"{plant}:Broken")
    assert node.wait() == 2
    assert "hand_sim" in node.output or "sim_node" in node.output
    assert "diverged at t = 0.001 s (index_mcp)" in node.output
    assert "Traceback" not in node.output


def test_diagnostics_tell_rate_age_and_counts(peer):
    peer.hear_diagnostics()
    with processes(
        NodeProcess("hand_sim", clock="lockstep", duration=1e5),
        NodeProcess("motor_controller", clock="lockstep", reference="half_sine"),
    ):
        sim = peer.until_status("hand_sim", lambda s: float(s["rate_hz"]) > 100.0, "a rate")
        control = peer.until_status("motor_controller", lambda s: float(s["rate_hz"]) > 100.0, "a rate")
    assert {"input_age_s", "missed_cycles", "command_timeouts", "rejected_commands", "tick"} <= set(sim)
    assert {"input_age_s", "missed_cycles", "state_timeouts", "rejected_states", "active"} <= set(control)
    assert {status.name for status in peer.diagnostics} == {"/hannes/hand_sim", "/hannes/motor_controller"}


@pytest.mark.parametrize("code", [0, 2])
def test_a_process_that_is_stuck_with_the_interpreter_s_lock_leaves_by_its_deadline(code: int) -> None:
    stuck = (
        f"import ctypes; from hannes_ros.leave import leave_within; print('said'); leave_within(0.3, {code}); "
        "ctypes.PyDLL(None).sleep(600)"
    )
    answer = subprocess.run(
        [sys.executable, "-c", stuck], capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert (answer.returncode, answer.stdout) == (code, "said\n"), answer.stderr
