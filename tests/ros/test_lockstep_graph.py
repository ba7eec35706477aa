"""Lock-step: the node graph, the composed graph and the rollout give the same trajectory."""

from __future__ import annotations

import signal
from contextlib import closing

import numpy as np
import pytest
from graph import PATIENT, NodeProcess, Peer, processes
from hannes_control.double_pid import DoublePID
from hannes_control.emg import SyntheticEmg, emg_reference, synthesise
from hannes_control.reference import half_sine
from hannes_description.model import Model
from hannes_ros import convert
from hannes_sim.factory import make_plant
from hannes_sim.objects import named_object
from hannes_sim.rollout import Rollout, rollout
from rclpy.context import Context

SECONDS = 0.8
TICKS = 800
SIGNALS = ("encoder_position", "motor_current", "motor_voltage", "reference_position")


def in_process(reference: np.ndarray, grasp: str, plant: str = "reduced") -> Rollout:
    model = Model.load("nominal").with_plant(plant)
    return rollout(make_plant(model, named_object(grasp)), DoublePID.of_model(model.parameters), reference)


def columns(peer) -> dict[str, np.ndarray]:
    """The heard signals as arrays."""
    states = [convert.MOTOR_STATE.decode(data) for data in peer.heard["encoder_position"]]
    out = {name: np.array([convert.float64_value(data) for data in peer.heard[name]]) for name in SIGNALS[1:]}
    out["stamp_ns"] = np.array([state.stamp_ns for state in states])
    out["encoder_position"] = np.array([state.position[0] for state in states])
    out["encoder_velocity"] = np.array([state.velocity[0] for state in states])
    return out


def last_stamp(peer) -> int:
    """Time of the last state heard [ns]."""
    return convert.MOTOR_STATE.decode(peer.heard["encoder_position"][-1]).stamp_ns


def run_graph(context: Context, followers: int, *nodes: NodeProcess) -> dict[str, np.ndarray]:
    """Run until hand_sim, the last of the nodes, has ended; what was heard by a peer, the last of its followers."""
    with processes(*nodes), closing(Peer(context)) as peer:
        peer.hear_diagnostics()
        # hand_sim waits for all who hear motor/state, but for only one who hears motor/current: when that one, the
        # controller, is there, the peer listens too, to motor/state last, so that nobody misses the first tick.
        peer.until_status(
            "hand_sim",
            lambda s: s["message"] == f"waiting for {followers} subscriber(s) of motor/state",
            "all but the peer",
        )
        peer.hear(*reversed(SIGNALS))
        peer.until(lambda: nodes[-1].process.poll() is not None, what="the end of hand_sim")
        assert nodes[-1].wait() == 0, nodes[-1].output
        # The peer is slower than the graph, but nothing may be lost.
        peer.until(lambda: all(len(peer.heard[name]) >= TICKS for name in SIGNALS), what="all messages")
        for node in nodes[:-1]:
            node.send(signal.SIGINT)
        assert [node.wait() for node in nodes[:-1]] == [0] * (len(nodes) - 1)
        assert not [node.output for node in nodes if "Traceback" in node.output]
        return columns(peer)


def assert_equal(heard: dict[str, np.ndarray], expected: Rollout) -> None:
    np.testing.assert_array_equal(heard["stamp_ns"], np.arange(TICKS) * 1_000_000)
    for name in ("encoder_position", "encoder_velocity", "motor_current", "motor_voltage"):
        np.testing.assert_array_equal(heard[name], expected.signal(name), err_msg=name)


@pytest.mark.parametrize(
    ("kind", "plant"), [("processes", "reduced"), ("composed", "reduced"), ("composed", "mujoco")]
)
def test_simulator_and_controller_equal_the_rollout_bit_for_bit_twice(ros_context, kind, plant):
    # One more subscriber than the loop needs: the peer must not miss the first tick.
    sim = {"clock": "lockstep", "duration": SECONDS, "subscribers": 2, "object": "soft", "plant": plant}
    sim |= PATIENT
    control = {"clock": "lockstep", "reference": "half_sine", "reference_period": 1.6, "subscribers": 2}
    runs = []
    for _ in range(2):
        if kind == "processes":
            nodes = [NodeProcess("motor_controller", **control), NodeProcess("hand_sim", **sim)]
        else:
            parameters = {f"hand_sim:{k}": v for k, v in sim.items()} | {
                f"motor_controller:{k}": v for k, v in control.items()
            }
            nodes = [NodeProcess("composed", "--nodes", "hand_sim,motor_controller", **parameters)]
        runs.append(run_graph(ros_context, 2, *nodes))
    for name, values in runs[0].items():
        np.testing.assert_array_equal(values, runs[1][name], err_msg=name)
    assert_equal(runs[0], in_process(half_sine(period=1.6)[:TICKS], "soft", plant))
    assert runs[0]["motor_voltage"].max() > 1.0


@pytest.mark.parametrize("kind", ["processes", "composed"])
def test_the_whole_chain_from_emg_equals_the_rollout(ros_context, kind):
    emg = synthesise(SyntheticEmg(), seed=5)
    samples = [k * 300 // 1000 for k in range(TICKS)]  # the last sample with a time <= k ms
    reference = emg_reference(emg.flexor, emg.extensor).reference[samples]
    assert reference[-1] > 1.0
    own = {
        "hand_sim": {"duration": SECONDS, "subscribers": 4, **PATIENT},
        "emg_source": {"seed": 5},
        "emg_reference": {"subscribers": 2},
        "motor_controller": {"subscribers": 2},
    }
    order = ("emg_source", "emg_reference", "motor_controller", "hand_sim")
    if kind == "processes":
        nodes = [NodeProcess(name, clock="lockstep", **own[name]) for name in order]
    else:
        rules = {f"{node}:{key}": value for node, values in own.items() for key, value in values.items()}
        nodes = [NodeProcess("composed", "--nodes", ",".join(order), clock="lockstep", **rules)]
    heard = run_graph(ros_context, 4, *nodes)
    np.testing.assert_allclose(heard["reference_position"], reference, rtol=0, atol=1e-12)
    assert_equal(heard, in_process(heard["reference_position"], "none"))


def test_a_killed_controller_stops_time_and_its_successor_goes_on(peer):
    """The peer gives the reference of each reading that it hears: so the graph cannot run away from a slow peer."""
    peer.hear("motor_voltage")
    peer.hear_diagnostics()
    states = peer.heard.setdefault("encoder_position", [])

    def refer(data: bytes) -> None:
        states.append(data)
        peer.say("reference_position", convert.float64_bytes(5.0))

    control = {"clock": "lockstep", "subscribers": 2}
    sim = NodeProcess("hand_sim", clock="lockstep", duration=1e5, subscribers=2)
    first = NodeProcess("motor_controller", **control)
    with processes(sim, first):
        peer.matched("reference_position")
        peer.hear("encoder_position", callback=refer)
        peer.until(lambda: len(peer.heard["motor_voltage"]) > 500, what="commands")
        first.send(signal.SIGKILL)
        first.wait()
        peer.diagnostics.clear()
        # The peer is slower than the graph: the report of the stall can come before what was sent ahead of it.
        status = peer.until_status(
            "hand_sim",
            lambda s: s["message"].startswith("waiting") and last_stamp(peer) == int(s["tick"]) * 1_000_000,
            "the stall and its last tick",
        )
        assert int(status["stalls"]) >= 1
        stopped = len(states)
        peer.spin(0.3)
        assert len(states) == stopped
        with processes(NodeProcess("motor_controller", **control)):
            peer.until(lambda: len(states) > stopped + 300, what="the loop going on")
        stamps = [convert.MOTOR_STATE.decode(data).stamp_ns for data in states]
        assert set(np.diff(stamps)) <= {
            0,
            1_000_000,
        }  # no tick is skipped; one may be repeated to the newcomer
