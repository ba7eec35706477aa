"""hand_sim: the simulated hand as a ROS 2 node; motor/voltage in, the sensors out."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from time import monotonic
from typing import Any

import hannes_ros.early  # noqa: F401  (signals are safe from here on)
import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_ros import convert, topics
from hannes_ros.command import CommandGate
from hannes_ros.diagnostics import ERROR, OK, WARN, Diagnostics, Health
from hannes_ros.lockstep import Pace, Peers, Probe, StallWatch, stamp_of_tick
from hannes_ros.loop import RealtimeLoop
from hannes_ros.node import CLOCK_HELP, CLOCKS, DEFAULT_NAMESPACE, HannesNode
from hannes_ros.node_parameters import declare, parameter
from hannes_ros.run import run_node
from hannes_ros.sources import Sources
from hannes_ros.telling import LOOP, loop_of, tell
from rclpy.node import Node

from .factory import make_plant
from .objects import GraspObject, named_object
from .rollout import step_of, substeps_of

_CHECK_S = 0.02
_LONGEST_CATCH_UP_S = 0.1


@dataclass(frozen=True)
class HandSimParameters:
    """ROS parameters of hand_sim."""

    model: str = parameter("nominal", "model: name of a shipped one or path of a model file")
    plant: str = parameter(
        "", "plant instead of the model's: reduced, mujoco or path.py:Class; empty for the model's"
    )
    object: str = parameter("none", "object to grasp", choices=("none", "soft", "rigid"))
    object_size: float = parameter(
        0.0, "size instead of the object's, 0 for its own", lower=0.0, upper=0.2, unit="m"
    )
    object_stiffness: float = parameter(
        0.0,
        "contact stiffness of a fingertip instead of the object's, 0 for its own",
        lower=0.0,
        upper=1e7,
        unit="N/m",
    )
    clock: str = parameter("realtime", CLOCK_HELP, choices=CLOCKS)
    period: float = parameter(1e-3, "control period", lower=1e-4, upper=1e-1, unit="s")
    command_timeout_ms: float = parameter(
        80.0,
        "0 V this long after the last command (realtime); in lockstep the "
        "wait for a command after which it is reported",
        lower=1.0,
        upper=1e4,
        unit="ms",
    )
    duration: float = parameter(
        0.0, "simulated time after which the node ends, 0 for never", lower=0.0, upper=1e6, unit="s"
    )
    joint_states_rate: float = parameter(
        100.0, "rate of joint_states and grip_force", lower=1.0, upper=1e4, unit="Hz"
    )
    subscribers: int = parameter(
        1, "subscribers that motor/state must have before the first tick of lockstep", lower=1, upper=100
    )
    current_noise: float = parameter(
        0.0, "standard deviation of noise on the measured current", lower=0.0, upper=1.0, unit="A"
    )
    seed: int = parameter(0, "seed of the noise", lower=0, upper=2**31)

    def grasp(self) -> GraspObject | None:
        """The object to grasp, None for the empty hand."""
        named = named_object(self.object)
        if named is None:
            if self.object_size or self.object_stiffness:
                raise HannesError(
                    "Parameters object_size and object_stiffness need an object; set object to soft or rigid."
                )
            return None
        return replace(
            named, size=self.object_size or named.size, stiffness=self.object_stiffness or named.stiffness
        )

    def told(self, model: Model) -> dict[str, Any]:
        """What a recording of this hand may say of itself (docs/your-own-hand.md), and the loop of its model.

        Only lock-step is the model to rounding, so that its plant may be named: in real time readings and commands are
        late by what messages take.
        """
        exact = {"plant": model.plant} if self.clock == "lockstep" else {}
        grasp = self.grasp()
        own = grasp is not None and grasp != named_object(self.object)
        return {
            "object": grasp.to_dict() if own and grasp else self.object,
            "sensors": {
                "current_rectified": False,
                "current_window": 0.0,
                "current_noise": self.current_noise,
            },
            LOOP: loop_of(model),
        } | exact


class HandSim(HannesNode, Node):
    """The simulated hand: takes motor/voltage, publishes its sensors, keeps real time or waits for each command."""

    node_name = "hand_sim"
    parameters = HandSimParameters

    def __init__(self, cli_args: list[str] | None = None) -> None:
        super().__init__(self.node_name, namespace=DEFAULT_NAMESPACE, cli_args=cli_args)
        self._p = p = declare(self, HandSimParameters)
        model = Model.load(p.model)
        model = model.with_plant(p.plant) if p.plant else model
        self._plant = make_plant(model, p.grasp(), dt=step_of(p.period))
        tell(self, p.told(model))
        self._substeps = substeps_of(p.period, self._plant.dt)
        self._gate = CommandGate(model.parameters.value("supply.voltage"), p.command_timeout_ms / 1e3)
        self._torque_constant = model.parameters.value("motor.kt") * model.parameters.value("gear.ratio")
        self._rng = np.random.default_rng(p.seed)
        self._period_ns = round(p.period * 1e9)
        self._slow_every = max(1, round(1.0 / (p.joint_states_rate * p.period)))
        self._ticks = round(p.duration / p.period) if p.duration > 0.0 else sys.maxsize
        self._tick = 0
        self._waiting = False
        self._timeout_reported = 0
        self._began = 0.0
        self._applied = 0.0
        self._health = Health("unexpected_commands")

        self._watch = StallWatch(p.command_timeout_ms / 1e3)
        self._lockstep = p.clock == "lockstep"
        self._clock_heard = False
        if self._lockstep:
            # First: who finds another topic, and looks for simulated time, finds this too.
            self._sim_clock = topics.clock_publisher(self, self._on_clock_match)
        self._state = topics.publisher(self, "encoder_position", self._on_match)
        self._current = topics.publisher(self, "motor_current", self._on_match)
        self._joints = topics.publisher(self, "joint_positions")
        self._force = topics.publisher(self, "grip_force")
        if self._lockstep:
            self._pace = Pace(self._state, self._current, self._sim_clock)
        self._last: tuple[bytes, bytes] = (b"", b"")
        on_voltage = self._on_tick_voltage if self._lockstep else self._on_voltage
        self._sources = Sources(self, "motor_voltage", rule="only one may drive the motor")
        self._probe = Probe(self._sources.mixed)
        self._held: float | None = None
        topics.subscription(self, "motor_voltage", on_voltage, self._probe.on_match)
        self._peers = Peers(
            {
                "a publisher of motor/voltage": (self._voltage_publishers, 1),
                f"{p.subscribers} subscriber(s) of motor/state": (
                    self._state.get_subscription_count,
                    p.subscribers,
                ),
                "a subscriber of motor/current": (self._current.get_subscription_count, 1),
            }
        )
        self._reported: list[str] = []
        self._diagnostics = Diagnostics(self, self._health, self._status)
        self._loop = RealtimeLoop(p.period, self._step)
        self.wall_timer(_CHECK_S, self._check_lockstep if self._lockstep else self._check_realtime)
        if not self._lockstep:
            self._loop.start()
        held = "nothing" if p.object == "none" else f"a {p.object} object"
        self.get_logger().info(
            f"model {model.name}, plant {model.plant}, holding {held}, {p.clock}, {1 / p.period:g} Hz"
        )

    def stop(self) -> None:
        """End the real-time loop."""
        self._loop.stop()

    # -- both clocks -------------------------------------------------------------------------------------------------
    def _publish(self, stamp_ns: int) -> None:
        """The sensors, as they are now."""
        reading = self._plant.read()
        current, effort = reading.current, reading.effort
        if self._p.current_noise > 0.0:
            noise = self._p.current_noise * float(self._rng.standard_normal())
            current, effort = current + noise, effort + self._torque_constant * noise
        state = convert.MOTOR_STATE.encode(stamp_ns, (reading.position,), (reading.velocity,), (effort,))
        self._last = state, convert.float64_bytes(current)
        self._state.publish(state)  # first: most of the graph waits for it
        self._current.publish(self._last[1])
        if self._tick % self._slow_every == 0:
            self._joints.publish(
                convert.FINGER_STATES.encode(
                    stamp_ns, reading.joint_positions.tolist(), reading.joint_velocities.tolist()
                )
            )
            self._force.publish(convert.float64_bytes(reading.grip_force))
        self._health.cycles += 1

    def _advance(self, voltage: float, periods: int) -> bool:
        """Whether the plant went on; the node ends if it failed or is at its end."""
        try:
            self._plant.advance(voltage, periods * self._substeps)
        except HannesError as error:
            self.fail(error)
            return False
        self._tick += periods
        if self._tick >= self._ticks:
            elapsed = max(monotonic() - self._began, 1e-9)
            self.get_logger().info(
                f"finished {self._tick * self._p.period:g} s in {elapsed:.2f} s "
                f"({self._tick * self._p.period / elapsed:.1f} x real time)"
            )
            self.done = True
            return False
        return True

    def _status(self) -> tuple[bytes, str, dict[str, object]]:
        gate, self._health.missed = self._gate, self._loop.missed
        self._health.last_input = gate.last_command
        age = "" if gate.age_at_zero is None else f"{gate.age_at_zero:.4f}"
        values: dict[str, object] = {
            "tick": self._tick,
            "stalls": self._watch.stalls,
            "rejected_commands": gate.rejected,
            "clamped_commands": gate.clamped,
            "command_timeouts": gate.timeouts,
            "command_age_at_zero_s": age,
        }
        if several := self._sources.several():
            return ERROR, several, values
        if not self._lockstep:
            values["applied_voltage"] = f"{self._applied:.6g}"
            if gate.last_command is None:
                return WARN, "no command yet: 0 V", values
            return (ERROR, "command timed out: 0 V", values) if gate.timed_out else (OK, "running", values)
        if self._reported:
            return WARN, f"waiting for {', '.join(self._reported)}", values
        if self._watch.stalled:
            waited = self._watch.waiting(monotonic())
            return ERROR, f"waiting {waited:.1f} s for motor/voltage of tick {self._tick}", values
        return OK, "running", values

    # -- real time ---------------------------------------------------------------------------------------------------
    def _on_voltage(self, data: bytes) -> None:
        self._command(convert.float64_value(data))

    def _command(self, voltage: float) -> float:
        """What the motor gets (V); that the gate takes none is said: the hand stands as if nobody drove it."""
        rejected = self._gate.rejected
        applied = self._gate.command(voltage, monotonic())
        if self._gate.rejected == rejected:
            self._health.faults.good("motor/voltage")
        else:
            self._health.faults.bad("motor/voltage", ERROR, f"motor/voltage is not finite ({voltage}): 0 V")
        return applied

    def _step(self, now: float, elapsed: int) -> None:
        """One period of the real-time thread; periods that were missed are made up for, within reason."""
        self._began = self._began or now
        self._applied = self._gate.voltage(now)
        if not self.done and self._advance(
            self._applied, min(elapsed, max(1, round(_LONGEST_CATCH_UP_S / self._p.period)))
        ):
            self._publish(self.get_clock().now().nanoseconds)

    def _check_realtime(self) -> None:
        if self._loop.error is not None:
            self.fail(f"The simulation stopped: {self._loop.error!r}")
        if self._gate.timeouts > self._timeout_reported:
            self._timeout_reported = self._gate.timeouts
            self.get_logger().warning("no command: 0 V")
            self._diagnostics.publish()

    # -- lock-step ---------------------------------------------------------------------------------------------------
    def _on_match(self, status: object) -> None:
        if status.current_count_change > 0:  # type: ignore[attr-defined]
            self._watch.newcomer()

    def _on_clock_match(self, status: object) -> None:
        self._clock_heard = status.current_count > 0  # type: ignore[attr-defined]

    def _voltage_publishers(self) -> int:
        return self._sources.count("motor_voltage")

    def _publish_tick(self) -> None:
        stamp_ns = stamp_of_tick(self._tick, self._period_ns)
        if self._clock_heard:
            self._sim_clock.publish(convert.clock_bytes(stamp_ns))
        self._waiting = True
        self._publish(stamp_ns)
        self._pace.after(self._tick)
        self._watch.published(monotonic())

    def _on_tick_voltage(self, data: bytes) -> None:
        if not self._waiting:
            self._health.count("unexpected_commands")
            return
        if self._held is not None:
            self.fail(self._sources.surplus("motor_voltage"))
            return
        voltage = convert.float64_value(data)
        if self._probe.holds():
            self._held = voltage
            return
        self._take(voltage)

    def _take(self, voltage: float) -> None:
        self._waiting = False
        if self._advance(self._command(voltage), 1):
            self._publish_tick()

    def _check_lockstep(self) -> None:
        """Start when the peers are there; report a stall; repeat the reading to newcomers."""
        if not self._peers.complete:
            missing = self._peers.missing()
            if missing and missing != self._reported:
                self.get_logger().info(f"waiting for {', '.join(missing)}")
            self._reported = missing
            if not missing:
                self.get_logger().info("all peers are there: starting")
                self._began = monotonic()
                self._publish_tick()
            return
        if self.done or not self._waiting:
            return
        if self._probe.over() and self._held is not None:
            voltage, self._held = self._held, None
            self._take(voltage)
        if self._held is not None:
            return
        before = self._watch.stalls
        if self._watch.check(monotonic()):
            state, current = self._last
            self._state.publish(state)
            self._current.publish(current)
        if self._watch.stalls > before:
            self.get_logger().warning(f"waiting for motor/voltage of tick {self._tick}")
            self._diagnostics.publish()


def main() -> None:
    """Run the node."""
    sys.exit(run_node("hannes_sim.sim_node:HandSim"))


if __name__ == "__main__":
    main()
